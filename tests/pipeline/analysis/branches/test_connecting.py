"""Orbits connected by continuation, and the ids that follow from it."""

import numpy as np
import pytest
import xarray as xr

from magpend_core import trajectory
from magpend_core.models import load_model
from pipeline.analysis.attractors.matching import BASES, grouped
from pipeline.analysis.branches import connecting
from pipeline.analysis.branches.connecting import Web, connect
from pipeline.analysis.branches.sheets import BORDER, ENDED, LINKED, Axis, Grid
from pipeline.layout.vocabulary import PERIODIC_ORBIT
from tests.core.cells import polish
from tests.core.flows import table
from tests.pipeline.analysis.cubes import attributes_of
from tests.pipeline.analysis.dense_sets import match

DUFFING = load_model("duffing")
FREQUENCY = 1.2 / (2.0 * np.pi)
# the orbit in one well doubles its period at 0.2656 and again at 0.2867
TWIN_WELL = DUFFING.load("twin-well", damping=0.3)
HARDENING = DUFFING.load("hardening")


def closed(parameters, frequency, state, period):
    """Section points of the orbit near a state, none if Newton's method fails."""
    found = polish(parameters, [state], period, frequency)
    assert found.converged[0]
    assert found.orbit_period[0] == period
    return found.points[0, :period]


@pytest.fixture(scope="module")
def wells(cascade):
    """Orbits of one well by period and amplitude, taken from its branches."""
    _, branches = cascade

    def orbit(period, amplitude):
        branch = next(b for b in branches if b.family.period == period)
        near = min(branch.points, key=lambda p: abs(branch.family.values(p.u)[0] - amplitude))
        return closed(TWIN_WELL.replace(amplitude=amplitude), FREQUENCY, branch.family.state(near.u), period)

    return orbit


def other_well(amplitude, points):
    """The same motion in the other well: the mirror image, half a period later."""
    parameters = TWIN_WELL.replace(amplitude=amplitude)
    (end,) = trajectory(parameters, FREQUENCY, points[0], np.array([0.5 / FREQUENCY]))
    return closed(parameters, FREQUENCY, -end, len(points))


def line(*orbits, more=(), free="amplitude", parameters=TWIN_WELL, frequency=FREQUENCY):
    """Link orbits (place, value, points) along one parameter, which has more values beyond."""
    system, values = parameters.model.system, np.array(sorted({*(value for _, value, _ in orbits), *more}))
    packed, frequencies = np.tile(parameters.pack(), (len(values), 1)), np.full(len(values), frequency)
    column = -1 if free == "frequency" else system.parameter_names.index(free)
    (packed[:, column] if column >= 0 else frequencies)[:] = values
    grid = Grid(system, values.shape, packed, frequencies, (Axis(0, column, values),))
    return connect(grid, np.array([place for place, *_ in orbits]), [x for *_, x in orbits])


def test_connect__through_the_unstable_part(wells):
    """Single orbits of both wells, beyond the doubling unstable: each with its own well's."""
    orbits = []
    for place, value in enumerate((0.2, 0.3)):
        own = wells(1, value)
        orbits += [(place, value, own), (place, value, other_well(value, own))]
    found = line(*orbits)
    assert sorted(found.links.tolist()) == [[0, 2, 0], [1, 3, 0]]
    assert found.ways[:, 0].tolist() == 2 * [[LINKED, BORDER]] + 2 * [[BORDER, LINKED]]
    # From the orbit of period 4 down to that of period 2, and from there to the single one
    orbits = [(0, 0.26, wells(1, 0.26)), (1, 0.28, wells(2, 0.28)), (2, 0.29, wells(4, 0.29))]
    found = line(*orbits)
    assert sorted(link for link in found.links.tolist() if max(link) < 3) == [[1, 0, 1], [2, 1, 1]]
    assert found.ways[1:3, 0, 1].tolist() == [ENDED, ENDED]


@pytest.fixture(scope="module")
def resonance(settled):
    """Orbits of a hardening spring, on the upper branch below the fold and on the lower one above."""
    low = settled(HARDENING, 0.15, [0.3, 0.0])
    high = settled(HARDENING, 0.3, low)
    return closed(HARDENING, 0.15, low, 1), closed(HARDENING, 0.3, high, 1)


def test_connect__beyond_a_fold_is_another_branch(resonance):
    low, high = resonance
    found = line((0, 0.15, low), (1, 0.3, high), free="frequency", parameters=HARDENING)
    assert not len(found.links)
    assert found.ways[0, 0, 0] == ENDED


Y = 1.0 / (1.0 + 4.0 * np.pi**2)
"""State of y' = -y + cos(2 pi t) at the strobe."""


@pytest.mark.parametrize(
    ("rate", "middle", "low", "high"),
    [
        ("0.2 - sqrt(0.3 - b)", "b", -0.6, 0.29),  # det(1 - M) falls towards its zero as before a fold
        ("4*b", "exp(-6*b)", -0.3, 0.1),
        ("60*b", "exp(-15*b)", -0.05, 0.05),  # the slope changes much over the steps near the zero
    ],
)
def test_connect__an_orbit_that_loses_its_symmetry_goes_on(rate, middle, low, high):
    """At a pitchfork det(1 - M) changes its sign, and the symmetric orbit is on both sides. At a fold there is none."""
    away = f"(x - {middle})"
    model = load_model(table("fork", {"x": f"({rate})*{away} - {away}^3", "y": "-y + cos(2*pi*f*t)"}, {"b": 0.0}))
    values = np.array([low, high])
    column = model.system.parameter_names.index("b")
    packed = np.zeros((2, len(model.system.parameter_names)))
    packed[:, column] = values
    grid = Grid(model.system, (2,), packed, np.ones(2), (Axis(0, column, values),))
    states = [eval(middle, {"b": value, "exp": np.exp}) for value in values]
    orbits = [np.array([[x, Y]]) for x in states]
    assert connect(grid, np.array([0, 1]), orbits).links.tolist() == [[0, 1, 0]]
    for first in (0, 1):  # from each side to the other
        found = connect(grid, np.array([first, 1 - first]), [orbits[first], orbits[1 - first] + [5.0, 0.0]])
        assert found.ways[0, 0].tolist() == [[LINKED, BORDER], [BORDER, LINKED]][first]


def test_taken__an_unstable_orbit_is_known_at_each_phase(wells):
    """Section points after the first are off by a Newton step that the map has stretched."""
    points = wells(2, 0.28)
    values = np.array([0.28, 0.29])
    column = TWIN_WELL.model.system.parameter_names.index("amplitude")
    packed = np.tile(TWIN_WELL.pack(), (2, 1))
    packed[:, column] = values
    grid = Grid(TWIN_WELL.model.system, (2,), packed, np.full(2, FREQUENCY), (Axis(0, column, values),))
    for off, is_known in ((1e-4, True), (1e-2, False)):
        flood = connecting._Flood(grid, np.array([0]), [points], connecting.SheetSettings())
        new = flood.nodes.copy()
        new["points"][0], new["det"] = points[::-1] + np.array([[off], [0.0]]), -20.0
        assert (flood._taken(new)[0] == 0) == is_known


def test_connect__neighbours_take_no_walk(wells, monkeypatch):
    """Orbits near each other are held against each other's tangent: one evaluation for all."""
    monkeypatch.setattr(connecting._Flood, "_advance", None)
    values = 0.2 + 0.002 * np.arange(6)
    found = line(*((i, v, wells(1, v)) for i, v in enumerate(values)), more=[0.3])
    assert found.links.tolist() == [[i, i + 1, 0] for i in range(5)]


def test_connect__a_near_orbit_of_another_branch_is_none(wells, monkeypatch):
    """The second orbit is off the first one's tangent by more than a step allows for."""
    monkeypatch.setattr(connecting._Flood, "_advance", lambda flood: setattr(flood, "walk", flood.walk[:0]))
    a, b = wells(1, 0.2), wells(1, 0.202)
    assert len(line((0, 0.2, a), (1, 0.202, b), more=[0.3]).links) == 1
    assert not len(line((0, 0.2, a), (1, 0.202, b + 1e-2), more=[0.3]).links)


def test_grouped__no_two_of_one_place_together():
    places = np.array([0, 1, 1, 2])
    web = Web(places, np.array([[0, 1, 0], [2, 0, 1], [2, 3, 0]]), np.zeros((4, 1, 2)))
    group, branch = grouped(web, 4)
    assert group.tolist() == branch.tolist() == [0, 0, 2, 2]


# ---- two parameters ----------------------------------------------------------------------------

CUSP = load_model(table("cusp", {"x": "a + b*x - x^3", "y": "-y + cos(2*pi*f*t)"}, {"a": 0.0, "b": 0.0}))
"""Two sheets and their fold over a and b, with a cusp at 0, beside a damped state that the drive moves."""


def cusp(places):
    """Grid over a and b, and the stable orbits at some of its points: places and states."""
    system = CUSP.system
    a, b = np.linspace(-0.6, 0.6, 13), np.linspace(-0.4, 1.2, 9)
    columns = [system.parameter_names.index(name) for name in "ab"]
    packed = np.zeros((117, len(system.parameter_names)))
    packed[:, columns] = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    axes = tuple(Axis(i, column, values) for i, (column, values) in enumerate(zip(columns, (a, b), strict=True)))
    grid = Grid(system, (13, 9), packed, np.ones(117), axes)
    roots = [(place, x) for place in places for x in np.roots([-1.0, 0.0, *packed[place, columns][::-1]])]
    stable = [(p, x.real) for p, x in roots if abs(x.imag) < 1e-9 and packed[p, columns[1]] < 3.0 * x.real**2]
    return grid, np.array([p for p, _ in stable]), np.array([x for _, x in stable])


def test_connect__a_sheet_around_a_cusp():
    """Both sheets at the far side are one around the cusp at a = b = 0; where they coexist each has its own id.

    The points share hardly a row or a column: orbits are followed through all the others.
    """
    grid, place, x = cusp(sorted({*range(8, 117, 9), *range(1, 117, 10)}))
    web = connect(grid, place, [[[one, Y]] for one in x])
    n = len(place)
    group, branch = (own[:n] for own in grouped(web, n))
    assert np.array_equal(group, branch)
    assert len(np.unique(group)) == 2
    for sheet in (x > 0.9, x < -0.9):
        assert len(np.unique(group[sheet])) == 1
    assert len(np.unique(np.column_stack([group, place]), axis=0)) == n
    # neither the order of the orbits nor that of the axes counts
    order = np.random.default_rng(1).permutation(n)
    again = grouped(connect(grid, place[order], [[[one, Y]] for one in x[order]]), n)[0][:n]
    assert len(set(zip(group[order].tolist(), again.tolist(), strict=True))) == 2


# ---- ids ---------------------------------------------------------------------------------------


def appearances(axis, values, *points, parameters=TWIN_WELL, sides=None):
    """Dataset as of `identify`: per value a list of orbits."""
    rows = max(len(p) for p in points)
    n_states = parameters.model.system.n_states
    section = np.full((len(values), rows, 8, n_states), np.nan)
    period = np.zeros((len(values), rows), np.int32)
    for i, orbits in enumerate(points):
        for k, orbit in enumerate(orbits):
            section[i, k, : len(orbit)], period[i, k] = orbit, len(orbit)
    dims = (axis, "attractor")
    present = (period > 0).astype(np.int8)
    n_angles = len(parameters.model.angles)
    ds = xr.Dataset(
        {
            "kind": (dims, PERIODIC_ORBIT * present),
            "is_polished": (dims, present),
            "orbit_period": (dims, period),
            "attractor_points": ((*dims, "point", "state"), section),
            "rotation": ((*dims, "angle"), np.zeros((*period.shape, n_angles))),
            "attractor_id": ((axis, "initial_condition"), np.where(present, np.arange(rows), -1).astype(np.int32)),
        },
        coords={axis: list(values)},
        attrs=attributes_of(parameters),
    )
    if sides is not None:
        ds["side"] = (dims, np.asarray(sides, np.int8))
    return ds if axis == "frequency" else ds.assign_coords(frequency=FREQUENCY)


def told(ds):
    """Id and basis of the attractors at each value."""
    ids = ds["attractor"].values
    return [[(int(i), BASES[b]) for i, b in zip(ids, basis, strict=True) if b] for basis in ds["match_basis"].values]


@pytest.mark.slow
def test_match__ids_rest_on_followed_branches(wells):
    """However far apart: the unstable part of a branch and a doubling connect, distance never did."""
    ds = appearances("amplitude", [0.2, 0.28, 0.3], [wells(1, 0.2)], [wells(2, 0.28)], [wells(1, 0.3)])
    assert told(match(ds, threshold=1e-9)) == [[(0, "first_appearance")], [(0, "doubling")], [(0, "branch")]]
    assert match(ds, threshold=1e-9, connect=False).sizes["attractor"] == 3
    # The single orbit is listed beside the doubled one: the doubled one is another attractor then
    ds = appearances("amplitude", [0.26, 0.28], [wells(1, 0.26)], [wells(1, 0.28), wells(2, 0.28)])
    named = match(ds)
    assert told(named) == [[(0, "first_appearance")], [(0, "branch"), (1, "first_appearance")]]
    assert named["orbit_period"].values.tolist() == [[1, 0], [1, 2]]


def test_match__distance_does_not_overrule_a_fold(resonance):
    ds = appearances("frequency", [0.15, 0.3], *([x] for x in resonance), parameters=HARDENING)
    assert told(match(ds, threshold=10.0)) == [[(0, "first_appearance")], [(1, "first_appearance")]]
    assert told(match(ds, threshold=10.0, connect=False)) == [[(0, "first_appearance")], [(0, "distance")]]


RIGHT = {
    2.36: [[0.019654934855959906, 0.2044846549647774, -2.4241413580609077, 3.246013398715133]],
    2.46: [
        [-0.016203399766600908, 0.23457264851946077, -1.5135037492984205, 2.708073475235969],
        [0.052074141021559696, 0.13573149169405302, -3.010831505544555, 3.2088992011369446],
    ],
    2.52: [[0.022375994918196775, 0.20199041782206717, -2.174246902956021, 2.887164301857044]],
}
LEFT = {
    2.36: [[-0.05446501715455949, -0.13463572135597812, -2.432485069423176, 3.2992593656943976]],
    2.52: [[-0.0525061722282977, -0.14391116883755964, -2.1802136026000456, 2.947427560659119]],
}


@pytest.mark.slow
def test_match__one_sided_motions_through_the_chaotic_band():
    """Period 1 is unstable from 2.372 to 2.499 Hz on the right, from 2.386 to 2.506 on the left."""
    parameters = load_model("pendulum").load()
    points = [[RIGHT[f], LEFT[f]] if f in LEFT else [RIGHT[f]] for f in RIGHT]
    ds = appearances("frequency", list(RIGHT), *points, parameters=parameters, sides=[[2, 1], [2, 0], [2, 1]])
    named = match(ds, threshold=1e-9)
    periods, sides = named["orbit_period"].values, named["side"].values
    assert sorted(zip(sides[0].tolist(), periods.T.tolist(), strict=True)) == [(1, [1, 0, 1]), (2, [1, 2, 1])]
