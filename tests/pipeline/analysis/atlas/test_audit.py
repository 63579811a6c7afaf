"""The parts of the audit of a plane, on planes made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.atlas.effects import crossings
from pipeline.analysis.atlas.further import Wanted, dataset_of, wanted, with_further
from pipeline.analysis.atlas.lines import lines_through
from pipeline.analysis.atlas.plane import Plane, changes_of, pairs_on
from pipeline.analysis.atlas.regions import variables_of_regions
from pipeline.analysis.atlas.verdicts import Verdict
from pipeline.analysis.atlas.windows import carried, chosen, set_lines
from pipeline.analysis.events.kinds import CASCADE, UNDECIDED
from pipeline.layout.vocabulary import CHAOTIC_SET, EQUILIBRIUM, PERIODIC_ORBIT

SYSTEM = SimpleNamespace(scales=(1.0,), is_angle=(False,), n_states=1)


def plane_with(shape, sets):
    """A plane over the unit square; `sets` are (node, id, kind, period, points, cells)."""
    axes = [np.linspace(0.0, 1.0, n) for n in shape]
    values = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(len(values)).reshape(shape)
    edges = [np.stack([number[:-1].ravel(), number[1:].ravel()], axis=-1)]
    edges += [np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=-1)]
    edges = np.concatenate(edges)
    node, ids, kinds, periods, points, cells = zip(*sets, strict=True)
    return Plane(
        ("a", "b"),
        shape,
        values,
        edges,
        np.arange(len(edges)),
        np.zeros(len(edges), bool),
        np.full(len(values), 10),
        np.full(len(values), 10),
        xr.Dataset(),
        np.zeros((0, 10), int),
        np.array(node),
        np.array(ids),
        np.array(kinds),
        np.array(periods),
        np.array(cells),
        np.ones(len(node), bool),
        [np.array(one, float).reshape(-1, 1) for one in points],
    )


def orbits(shape, state, period=1, number=0):
    """One orbit at each point, whose first section point is a function of the parameters."""
    plane = plane_with(shape, [(0, 0, PERIODIC_ORBIT, 1, [0.0], 10)])
    return [
        (node, number, PERIODIC_ORBIT, period, state(*values), 10) for node, values in enumerate(plane.values.tolist())
    ]


def test_changes__none_of_a_smooth_sheet():
    plane = plane_with((9, 7), orbits((9, 7), lambda a, b: [np.sin(a) + 0.1 * (1 + b) ** 2]))
    assert changes_of(plane, SYSTEM) == []


def test_changes__an_attractor_that_a_neighbour_lacks():
    sets = [one for one in orbits((5, 3), lambda a, b: [0.1 * a]) if one[0] < 9]
    plane = plane_with((5, 3), sets)
    found = changes_of(plane, SYSTEM)
    assert [(one.here, one.there, one.other) for one in found] == [(6, 9, -1), (7, 10, -1), (8, 11, -1)]
    assert all(plane.axis_of(one.edge) == 0 for one in found)


def test_changes__another_period_is_one_each_way():
    sets = [
        (n, i, k, 2 if n >= 3 else 1, [0.0, 0.1] if n >= 3 else [0.0], c)
        for n, i, k, _, _, c in orbits((2, 3), lambda a, b: [0.0])
    ]
    found = changes_of(plane_with((2, 3), sets), SYSTEM)
    assert [(one.here, one.there) for one in found] == [(0, 3), (3, 0), (1, 4), (4, 1), (2, 5), (5, 2)]
    assert all(one.other >= 0 for one in found)


def test_changes__a_jump_of_one_id_from_sheet_to_sheet():
    plane = plane_with((9, 3), orbits((9, 3), lambda a, b: [0.2 * a + (0.5 if a > 0.55 else 0.0)]))
    found = {(one.here // 3, one.there // 3) for one in changes_of(plane, SYSTEM)}
    assert found == {(4, 5), (5, 4)}


def test_changes__phases_of_an_orbit_are_matched():
    shift = {}

    def state(a, b):
        shift[a] = not shift.get(a, False)
        points = [0.1 * a, 1.0 + 0.1 * a]
        return points[::-1] if shift[a] else points

    assert changes_of(plane_with((5, 4), orbits((5, 4), state, 2)), SYSTEM) == []


def test_pairs_on__orbits_of_one_id_and_period():
    sets = [
        (0, 0, PERIODIC_ORBIT, 1, [0.0], 5),
        (1, 0, PERIODIC_ORBIT, 1, [0.1], 5),
        (1, 1, PERIODIC_ORBIT, 2, [2, 3], 5),
    ]
    sets += [(0, 1, PERIODIC_ORBIT, 2, [2, 3], 5), (0, 2, EQUILIBRIUM, 0, [5.0], 5)]
    plane = plane_with((1, 2), sets)
    assert [(one.row, one.other) for one in pairs_on(plane, 0, 1)] == [(0, 1), (1, 0)]
    assert [(one.row, one.other) for one in pairs_on(plane, 0, 2)] == [(3, 2), (2, 3)]
    assert pairs_on(plane, 0, 0) == []


def test_lines__places_on_the_edges_of_neighbouring_faces_are_joined():
    plane = plane_with((4, 4), orbits((4, 4), lambda a, b: [0.0]))
    upright = [k for k in range(len(plane.edges)) if plane.axis_of(k) == 0 and plane.edges[k, 0] // 4 == 1]
    items = [(edge, ("fold", 1), np.array([0.5, plane.values[plane.edges[edge, 0], 1]])) for edge in upright]
    (line,) = lines_through(plane, items)
    assert (line.what, line.period) == ("fold", 1)
    np.testing.assert_allclose(np.sort(line.places[:, 1]), [0, 1 / 3, 2 / 3, 1])
    other = items + [(upright[1], ("fold", 1), np.array([0.55, 1 / 3]))]  # not unique: two on one edge
    assert len(lines_through(plane, other)) > 1


def test_lines__around_a_point_close():
    plane = plane_with((3, 3), orbits((3, 3), lambda a, b: [0.0]))
    items = [(k, ("fold", 1), plane.values[edge].mean(axis=0)) for k, edge in enumerate(plane.edges) if 4 in edge]
    (line,) = lines_through(plane, items)
    assert len(line.items) == 5
    assert line.items[0] == line.items[-1]


def test_crossings__are_those_of_the_segments():
    plane = plane_with((6, 5), orbits((6, 5), lambda a, b: [0.0]))
    rng = np.random.default_rng(1)
    track = np.cumsum(rng.uniform(-0.1, 0.15, (40, 2)), axis=0) * 0.4 + 0.1
    stable = rng.uniform(size=40) > 0.2
    found = crossings(plane, [track], [stable])
    wanted_ = set()
    for k in range(39):
        for e, (m, n) in enumerate(plane.edges):
            p, q = plane.values[m], plane.values[n]
            matrix = np.stack([track[k + 1] - track[k], p - q], axis=-1)
            s, t = np.linalg.solve(matrix, p - track[k])
            if stable[k] and stable[k + 1] and 0 <= s < 1 and 0 <= t < 1:
                wanted_.add((k, e))
    assert set(zip(found.segment, found.edge, strict=True)) == wanted_
    for k, share, e in zip(found.segment, found.share, found.edge, strict=True):
        place = track[k] + share * (track[k + 1] - track[k])
        axis = 1 - plane.axis_of(e)
        assert place[axis] == pytest.approx(plane.values[plane.edges[e, 0], axis])


def test_regions__parted_by_a_line_with_their_attractors():
    sets = [one for one in orbits((11, 5), lambda a, b: [0.0], number=0)]
    sets += [(n, 1 if n < 45 else 2, PERIODIC_ORBIT, 3, [1, 2, 3], 4) for n, *_ in sets if n >= 30]
    plane = plane_with((11, 5), sets)
    track = np.array([[0.55, -0.1], [0.55, 1.1]])
    ds = xr.Dataset(variables_of_regions(plane, [track], [np.ones(2, bool)], [], np.zeros((0, 2), int)))
    np.testing.assert_allclose(ds["area"], [0.55, 0.45])
    assert ds["region_label"].values.tolist() == ["1", "1 + 3"]
    assert ds["region_points"].values.tolist() == [30, 25]
    assert ds["is_thin"].values.tolist() == [0, 1]  # 300 and 250 cells
    shares = {
        (int(r), int(i)): float(s)
        for r, i, s in zip(ds["of_region"], ds["member_attractor"], ds["member_share"], strict=True)
    }
    assert shares == pytest.approx({(0, 0): 1.0, (1, 0): 1.0, (1, 1): 15 * 4 / 250, (1, 2): 10 * 4 / 250})
    link = np.array([[len(sets) - 11, len(sets) - 10]])  # rows of ids 1 and 2 that are one attractor
    joined = xr.Dataset(variables_of_regions(plane, [track], [np.ones(2, bool)], [], link))
    assert joined.sizes["member"] == 3
    assert joined["neighbour"].values.tolist() == [[0, 1]]


def test_windows__names_are_carried_between_places_that_agree():
    plane = plane_with((2, 9), [(n, 0, CHAOTIC_SET, 0, [0.0], 10) for n in range(9)])
    changes = changes_of(plane, SYSTEM)
    assert len(changes) == 9
    (line,) = set_lines(plane, changes)
    tested = [line.items[i] for i in (0, 4, 8)]
    assert chosen([line], 3) == sorted(tested)

    def told(*whats):
        found = [Verdict(UNDECIDED, np.zeros(2), 0.1) for _ in changes]
        for k, what in zip(tested, whats, strict=True):
            found[k].what = what
        carried([line], found, tested)
        return [found[k].what for k in line.items]

    assert told(CASCADE, CASCADE, CASCADE) == [CASCADE] * 9
    assert told(CASCADE, CASCADE, UNDECIDED) == [CASCADE] * 5 + [UNDECIDED] * 4
    tested = tested[:1]  # one place alone names no other
    assert told(CASCADE) == [CASCADE] + [UNDECIDED] * 8


def further_of(plane, points, sets):
    """Further points with the sets (point, kind, period, points)."""
    results = []
    for k, one in enumerate(points):
        own = [s for s in sets if s[0] == k]
        n_points = np.array([len(s[3]) for s in own], int)
        results.append(
            xr.Dataset(
                {
                    "attractor": ("set", np.arange(len(own))),
                    "kind": ("set", np.array([s[1] for s in own], int)),
                    "orbit_period": ("set", np.array([s[2] for s in own], int)),
                    "stability": ("set", np.ones(len(own), int)),
                    "n_cells": ("set", np.full(len(own), one.n_starts)),
                    "is_polished": ("set", np.ones(len(own), bool)),
                    "n_points": ("set", n_points),
                    "n_sets": ((), len(own)),
                    "attractor_points": (
                        ("sample", "state"),
                        np.concatenate([np.zeros(0), *(np.array(s[3]) for s in own)])[:, None],
                    ),
                    "attractor_id": ("initial_condition", np.zeros(one.n_starts, int)),
                    "decision": ("initial_condition", np.zeros(one.n_starts, int)),
                    "status": ("initial_condition", np.ones(one.n_starts, int)),
                },
                {"state": ["x"]},
                {"n_ids": len(own)},
            )
        )
    return dataset_of(list(points), results, ["x"])


def test_further_points__part_edges_and_add_starts():
    plane = plane_with((2, 2), orbits((2, 2), lambda a, b: [0.1 * a]))
    points = [
        Wanted((0.5, 0.0), 10, edge=(0, 2)),
        Wanted((0.0, 1.0), 300, node=1),
        Wanted((0.25, 0.0), 10, edge=(0, 4)),
    ]
    sets = [(0, PERIODIC_ORBIT, 1, [0.05]), (1, PERIODIC_ORBIT, 1, [0.0]), (1, PERIODIC_ORBIT, 1, [0.7])]
    more = with_further(plane, further_of(plane, points, [*sets, (2, PERIODIC_ORBIT, 1, [0.025])]), SYSTEM)
    assert more.values[4:].tolist() == [[0.5, 0.0], [0.25, 0.0]]
    assert more.n_cells.tolist() == [10, 300, 10, 10, 10, 10]
    alive = more.edges[~more.is_parted].tolist()
    assert [4, 2] in alive
    assert [0, 5] in alive
    assert [5, 4] in alive
    assert [0, 2] not in alive
    assert more.parent[more.edges.tolist().index([5, 4])] == plane.edges.tolist().index([0, 2])
    at = {int(n): sorted(more.attractor[more.node == n].tolist()) for n in range(6)}
    assert at[1] == [0, 3]  # the orbit that was known keeps its id, the other has one of its own
    changes = changes_of(more, SYSTEM)
    assert (1, 0, -1) in [(one.here, one.there, one.other) for one in changes]  # the orbit that more starts found


def test_wanted__unexplained_orbits_first_then_thin_regions_within_the_budget():
    plane = plane_with((3, 3), orbits((3, 3), lambda a, b: [0.0]))
    flags = {"flag_values": [0, 1], "flag_meanings": f"{UNDECIDED} fold"}
    ds = xr.Dataset(
        {
            "what": ("change", [0, 1, 0], flags),
            "change_set": ("change", [PERIODIC_ORBIT, PERIODIC_ORBIT, CHAOTIC_SET]),
            "here_first": ("change", [0.0] * 3),
            "there_first": ("change", [0.5] * 3),
            **{f"{role}_second": ("change", [0.5] * 3) for role in ("here", "there")},
            "is_thin": ("region", [0, 1]),
            "region_cells": ("region", [500, 20]),
            "label_first": ("region", [0.2, 0.9]),
            "label_second": ("region", [0.5, 0.9]),
        }
    )
    region = np.array([0, 0, 0, 0, 0, 0, 0, 1, 1])
    found = wanted(plane, ds, region, 1000)
    assert found == [Wanted((0.25, 0.5), 10, edge=(1, 4)), Wanted((1.0, 1.0), 289, 8)]
    assert wanted(plane, ds, region, 100) == found[:1]
    assert wanted(plane, ds, region, 5) == []
    told = replace(plane, n_cells=np.where(np.arange(9) == 8, 289, plane.n_cells))
    assert wanted(told, ds, region, 1000) == found[:1]  # the thin region had its starts


def test_further_points__without_an_attractor_have_cells_alone():
    plane = plane_with((2, 2), orbits((2, 2), lambda a, b: [0.1 * a]))
    more = with_further(plane, further_of(plane, [Wanted((0.5, 0.0), 10, edge=(0, 2))], []), SYSTEM)
    assert (len(more.values), len(more.node), len(more.points)) == (5, 4, 4)
    assert [(one.here, one.there) for one in changes_of(more, SYSTEM) if 4 in (one.here, one.there)] == [(0, 4), (2, 4)]
