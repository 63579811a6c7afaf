"""Attractors built by hand: which cells belong together, ids along an axis, hysteresis."""

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binomtest

from pipeline.analysis.attractors.analysis import _others_lines
from pipeline.analysis.attractors.attractors import _shares
from pipeline.analysis.attractors.features import Features
from pipeline.analysis.attractors.finding.points import PASSING
from pipeline.analysis.attractors.hysteresis import find_hysteresis
from pipeline.analysis.attractors.labelling import Found
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, NO_RETURN, NOT_SETTLED, PERIODIC_ORBIT
from pipeline.products.reporting import reporting
from pipeline.results.outcomes import share_interval, shares_of_others
from tests.pipeline.analysis.cubes import STATES
from tests.pipeline.analysis.dense_sets import identify, match
from tests.pipeline.plots.made_up import make_attractors

K = 64
PERIODIC, BOUNDED = 1, 2


def orbit(points, phase=0, noise=0.0, rng=None):
    """Kept sections of a cell on a closed orbit."""
    section = np.asarray(points, float)[(np.arange(K) + phase) % len(points)]
    return section if rng is None else section + noise * rng.normal(size=section.shape)


def cloud(centre, rng, size=0.3):
    """Kept sections of a cell on a set that does not close: the circle map's doubling on a ring."""
    angle = rng.uniform(0, 2 * np.pi)
    section = np.tile(np.asarray(centre, float), (K, 1))
    for i in range(K):
        section[i, 0] += size * np.cos(angle)
        section[i, 1] += size * np.sin(angle)
        angle = (2 * angle + 1e-3 * rng.normal()) % (2 * np.pi)
    return section


def cube(cells, **coords):
    """Cube of one parameter point from (sections, status, orbit_period, turns in all)."""
    section = np.stack([c[0] for c in cells])
    wraps = np.ceil((section[..., :2] - np.pi) / (2 * np.pi))
    section[..., :2] -= 2 * np.pi * wraps
    turns = np.array([c[3] for c in cells]) + np.nan_to_num(wraps[:, -1] - wraps[:, 0])
    return xr.Dataset(
        {
            "section": (("initial_condition", "period_index", "state"), section),
            "status": ("initial_condition", np.array([c[1] for c in cells], np.int8)),
            "orbit_period": ("initial_condition", np.array([c[2] for c in cells], np.int16)),
            "turns": (("initial_condition", "link"), turns.astype(np.int32)),
        },
        coords={"state": STATES, **coords},
    )


def on(points, turns=(0, 0), **options):
    return orbit(points, **options), PERIODIC, len(points), turns


A = [[0.2, 0.3, 1.0, 2.0]]
B = [[-0.4, 0.1, -1.0, 2.0], [-0.3, 0.2, -2.0, 1.0], [-0.5, 0.0, 3.0, 1.0]]


def test_identify__known_labels():
    rng = np.random.default_rng(0)
    cells, truth = [], []
    for i in range(40):
        cells += [
            on(A, noise=1e-7, rng=rng),
            on(B, phase=i, noise=1e-7, rng=rng),
            (cloud([1.5, 1.0, 0, 0], rng), BOUNDED, 0, (0, 0)),
            (cloud([1.5, -1.0, 0, 0], rng), BOUNDED, 0, (0, 0)),
            # what was kept of a failed cell says nothing
            (np.full((K, 4), np.nan) if i % 2 else cloud([1.5, 1.0, 0, 0], rng), 3 + i % 4, 0, (0, 0)),
        ]
        truth += [1, 0, 3, 2, -1]
    found = identify(cube(cells), polish=False)
    # by the least point of each: B, A, then the clouds by psi1 (their left ends, near 1.2)
    ids = found["attractor_id"].values
    for label in range(-1, 4):
        assert len(set(ids[np.array(truth) == label])) == 1
    assert (ids == -1).tolist() == [t == -1 for t in truth]
    assert found.sizes["attractor"] == 4
    assert found["attractor_id"].values[:2].tolist() == [1, 0]
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT, PERIODIC_ORBIT, BOUNDED_SET, BOUNDED_SET]
    assert found["orbit_period"].values.tolist() == [3, 1, 0, 0]
    assert found["n_cells"].values.tolist() == [40] * 4
    # nothing was integrated, so nothing was shown to attract
    assert set(found["stability"].values.tolist()) == {NOT_SETTLED}
    assert found["share"].values.tolist() == [0.0] * 4
    failed = np.array(truth) == -1
    assert set(found["status"].values[failed]) == {3, 4, 5, 6}
    assert not found["decision"].values[failed].any()
    rng = np.random.default_rng(0)
    computed = [on(A, noise=1e-7, rng=rng), on(B, noise=1e-7, rng=rng)]
    inferred = [(section.copy(), 7, period, turns) for section, _, period, turns in computed]
    found = identify(cube([*computed, *inferred, inferred[0]]), polish=False)
    assert found["attractor_id"].values.tolist() == [1, 0, 1, 0, 1]
    assert found["n_cells"].values.tolist() == [2, 3]
    assert found["status"].values.tolist() == [1, 1, 7, 7, 7]


@pytest.mark.slow
def test_identify__shuffled_cells_keep_their_ids():
    rng = np.random.default_rng(0)
    cells = [on(B, phase=i, noise=1e-6, rng=rng) for i in range(30)]
    cells += [on(A, noise=1e-6, rng=rng) for _ in range(20)]
    cells += [(cloud([1.5, s, 0, 0], rng), BOUNDED, 0, (0, 0)) for s in (1, -1) for _ in range(40)]
    ds = cube(cells)
    order = np.random.default_rng(1).permutation(len(cells))
    plain = identify(ds, polish=False)
    shuffled = identify(ds.isel(initial_condition=order), polish=False)
    assert np.array_equal(shuffled["attractor_id"].values, plain["attractor_id"].values[order])
    for name in ("attractor_points", "rotation", "state_min", "n_cells"):
        assert np.array_equal(shuffled[name].values, plain[name].values, equal_nan=True), name
    told = []
    with reporting(lambda what, done, total, expected_s=0.0: told.append((what, done, total))):
        blocks = identify(ds, polish=False, block_bytes=10 * K * 4 * 8)
    assert {done for what, done, total in told if (what, total) == (PASSING, len(cells))} >= {0, 2, len(cells) - 2}
    assert np.array_equal(blocks["attractor_id"].values, plain["attractor_id"].values)
    assert np.array_equal(blocks["attractor_points"].values, plain["attractor_points"].values, equal_nan=True)


def test_identify__an_angle_is_on_its_circle():
    """An orbit beside pi shows both signs there; it is one orbit, and not the one beside 0."""
    rng = np.random.default_rng(1)
    rotating = [on([[0.1, np.pi, 0, 20.0]], turns=(0, K - 1), noise=1e-6, rng=rng) for _ in range(30)]
    resting = [on([[0.1, 0.0, 0, 20.0]], noise=1e-6, rng=rng) for _ in range(5)]
    ds = cube(rotating + resting)
    signs = np.sign(ds["section"].values[:30, -1, 1])
    assert {-1.0, 1.0} <= set(signs)
    found = identify(ds, polish=False)
    assert found.sizes["attractor"] == 2
    ids = found["attractor_id"].values
    assert set(ids[:30]) != set(ids[30:])
    assert len(set(ids[:30])) == 1
    # turns are counted over K - 1 periods
    assert found["rotation"].values[ids[0]] == pytest.approx([0, 1], abs=1e-6)
    assert found["rotation"].values[ids[-1]] == pytest.approx([0, 0], abs=1e-6)


def test_identify__many_cells_few_anchors():
    """More sets than one round of anchors meets: the next rounds find the rest."""
    rng = np.random.default_rng(3)
    cells = [(cloud([0, 0, 0, 0], rng), BOUNDED, 0, (0, 0)) for _ in range(200)]
    cells += [(cloud([2, 2, 0, 0], rng), BOUNDED, 0, (0, 0)) for _ in range(2)]
    found = identify(cube(cells), polish=False, n_sample=20)
    assert sorted(found["n_cells"].values.tolist()) == [2, 200]
    rng = np.random.default_rng(4)
    near = np.array(A) + [[3e-3, 0, 0, 0]]
    cells = [on(A, noise=1e-7, rng=rng) for _ in range(4)] + [on(near, noise=1e-7, rng=rng) for _ in range(4)]
    assert identify(cube(cells), polish=False).sizes["attractor"] == 2
    assert identify(cube(cells), polish=False, tolerance=1e-2).sizes["attractor"] == 1


# ---- along an axis -----------------------------------------------------------------------------

AXIS = 2.0 + 0.05 * np.arange(9)


def sweep(seed=0, order=None):
    """Three attractors over nine frequencies.

    `a` (period 1) moves up and `b` (period 2) down through it in psi1: they cross at the middle. `a` is
    missing at 2.2; `b` dies after 2.3; a cloud is born at 2.15. Returns the cube, and for each
    frequency and cell the name.
    """
    rng = np.random.default_rng(seed)
    points, names = [], []
    for i, f in enumerate(AXIS):
        shift = 0.05 * (i - 4)
        a = [[shift, 0.5, 0, 0]]
        b = [[-shift, 1.0, 2.0, 0], [-shift, 0.8, -2.0, 0]]
        cells = []
        if i != 4:
            cells += [("a", on(a, noise=1e-7, rng=rng)) for _ in range(6)]
        if i <= 6:
            cells += [("b", on(b, phase=j, noise=1e-7, rng=rng)) for j in range(6)]
        if i >= 3:
            cells += [("c", (cloud([1.5 + shift, 1, 0, 0], rng), BOUNDED, 0, (0, 0))) for _ in range(12)]
        cells += [("-", (np.full((K, 4), np.nan), 3, 0, (0, 0)))] * (30 - len(cells))
        cells = [cells[j] for j in (np.arange(30) if order is None else order)]
        points.append(cube([c for _, c in cells], frequency=f))
        names.append([n for n, _ in cells])
    return xr.concat(points, "frequency"), np.array(names)


@pytest.mark.slow
def test_match__ids_follow_through_gap_crossing_birth_and_death():
    ds, names = sweep()
    named = match(identify(ds, polish=False))
    ids = named["attractor_id"].values
    # b has the least point at the first frequency but for a, whose psi1 starts at -0.2
    assert {n: set(ids[names == n]) for n in "abc-"} == {"a": {0}, "b": {1}, "c": {2}, "-": {-1}}
    kind = named["kind"].values
    assert (kind[:, 0] > 0).tolist() == [i != 4 for i in range(9)]
    assert (kind[:, 1] > 0).tolist() == [i <= 6 for i in range(9)]
    assert kind[:, 2].tolist() == [0, 0, 0] + [BOUNDED_SET] * 6
    assert named["orbit_period"].values[0].tolist() == [1, 2, 0]
    assert named["n_cells"].values[4].tolist() == [0, 6, 12]
    assert np.isnan(named["attractor_points"].values[4, 0]).all()
    order = np.random.default_rng(8).permutation(30)
    shuffled = match(identify(sweep(order=order)[0], polish=False))
    assert np.array_equal(shuffled["attractor_id"].values, ids[:, order])
    assert np.array_equal(shuffled["attractor_points"].values, named["attractor_points"].values, equal_nan=True)


@pytest.mark.slow
def test_match__options_decide_what_follows():
    found = identify(sweep()[0], polish=False)
    # no look back beyond the gap: a comes back as another
    assert match(found, look_back=1).sizes["attractor"] == 4
    # steps of 0.05 in psi1 are beyond this threshold
    assert match(found, threshold=0.04).sizes["attractor"] > 10
    again = match(match(found, threshold=0.04), threshold=0.3)
    assert np.array_equal(again["attractor_id"].values, match(found)["attractor_id"].values)
    with pytest.raises(ValueError, match="threshold"):
        match(found, threshold=0.0)
    with pytest.raises(ValueError, match="look_back"):
        match(found, look_back=0)


def rows(*points, rotation=None):
    """Attractors by hand: a list of psi1 per frequency."""
    n = max(len(p) for p in points)
    section = np.full((len(points), n, 1, 4), np.nan)
    kind = np.zeros((len(points), n), np.int8)
    for i, p in enumerate(points):
        section[i, : len(p), 0] = 0.0
        section[i, : len(p), 0, 0] = p
        kind[i, : len(p)] = PERIODIC_ORBIT
    ids = np.where(kind > 0, np.arange(n), -1).astype(np.int32)
    turned = np.zeros((len(points), n, 2)) if rotation is None else np.asarray(rotation, float)
    dims = ("frequency", "attractor")
    return xr.Dataset(
        {
            "kind": (dims, kind),
            "orbit_period": (dims, (kind == PERIODIC_ORBIT).astype(np.int32)),
            "attractor_points": ((*dims, "point", "state"), section),
            "rotation": ((*dims, "link"), turned),
            "mirror_partner": (dims, np.where(kind > 0, np.arange(n)[::-1], -1).astype(np.int32)),
            "attractor_id": (("frequency", "initial_condition"), ids),
        },
        coords={"frequency": np.arange(len(points), dtype=float), "state": STATES},
    )


def test_match__assigns_all_at_once():
    """Nearest first would give 0.25 the id of 0.2 (0.05), and leave 0.5 without (0.5 from 0.0)."""
    named = match(rows([0.0, 0.2], [0.1, 0.25]), threshold=0.3)
    assert named["attractor_id"].values.tolist() == [[0, 1], [0, 1]]
    # each alone may stay without a partner rather than take another's: 0.0 died, 0.45 was born
    named = match(rows([0.0, 0.25], [0.2, 0.45]), threshold=0.3)
    assert named["attractor_id"].values.tolist() == [[0, 1], [1, 2]]
    named = match(rows([0.0, 1.0], [0.02, 0.98], [-3.0, 1.0]), threshold=0.3)
    assert named["attractor_id"].values.tolist() == [[0, 1], [0, 1], [2, 1]]
    assert named["mirror_partner"].values.tolist() == [[1, 0, -1], [1, 0, -1], [-1, 2, 1]]
    one = rows([0.0, 1.0], [0.05, 0.95])
    two = xr.concat([one, one.isel(attractor=slice(None, None, -1))], "q").assign_coords(q=[1.0, 2.0])
    two = two.transpose("q", "frequency", ...)
    named = match(two)
    points = named["attractor_points"].values[..., 0, 0]
    assert points.tolist() == [[[0.0, 1.0], [0.05, 0.95]]] * 2


def test_match__rotation_and_side_tell_apart():
    ds = rows([0.0], [0.0], rotation=[[[0, 0]], [[0, 1]]])
    assert match(ds)["attractor_id"].values.tolist() == [[0], [1]]
    # Left never takes the id of right; what is not known of a motion says nothing
    ds = rows([0.0], [0.0])
    dims = ("frequency", "attractor")
    assert match(ds.assign(side=(dims, [[1], [2]])))["attractor_id"].values.tolist() == [[0], [1]]
    unknown = match(ds.assign(side=(dims, [[1], [0]])))
    assert unknown["attractor_id"].values.tolist() == [[0], [0]]
    words = unknown["match_basis"].attrs["flag_meanings"].split()
    assert [words[b] for b in unknown["match_basis"].values[:, 0]] == ["first_appearance", "distance"]


# ---- hysteresis --------------------------------------------------------------------------------


def test_hysteresis__loop_and_jumps():
    """Up stays on 0 until 2.4 and jumps to 1; down stays on 1 until 2.2; a third branch fails."""
    axis = [2.0, 2.1, 2.2, 2.3, 2.4, 2.5]
    up, down = [0, 0, 0, 0, 0, 1], [0, 0, 1, 1, 1, 1]
    lost = [0, -1, 1, 1, 1, 1]
    values = np.array([up, up, down, lost], np.int32).T
    direction = ["up", "up", "down", "down"]
    coords = {"frequency": ("frequency", axis, {"units": "Hz"}), "direction": ("branch", direction)}
    dims = ("frequency", "branch")
    ds = xr.Dataset({"status": (dims, np.ones((6, 4), np.int8))}, coords, attrs={"path": "frequency"})
    shown = np.full((6, 2), ATTRACTS, np.int8)
    states = {"attractor_id": values, "status": np.ones_like(values), "decision": np.zeros_like(values)}
    ids = xr.Dataset(
        {**{name: (dims, v) for name, v in states.items()}, "stability": (("frequency", "attractor"), shown)},
        {**coords, "attractor": [0, 1]},
    )
    table = find_hysteresis(ds, ids)
    assert table["differs"].values.tolist() == [False, False, True, True, True, False]
    assert table["loop_from"].values.tolist() == [2.2]
    assert table["loop_to"].values.tolist() == [2.4]
    assert table["loop_points"].values.tolist() == [3]
    assert table["only_up"].values.tolist() == [[3, 0]]
    assert table["only_down"].values.tolist() == [[0, 3]]
    assert table["present"].sel(direction="up").values.tolist() == [[1, 0]] * 5 + [[0, 1]]
    jumps = set(
        zip(
            *(table[f"jump_{n}"].values.tolist() for n in ("direction", "from", "to", "from_id", "to_id", "count")),
            strict=True,
        )
    )
    assert jumps == {(1, 2.4, 2.5, 0, 1, 2), (-1, 2.2, 2.1, 1, 0, 1), (-1, 2.2, 2.0, 1, 0, 1)}
    with pytest.raises(ValueError, match="both"):
        find_hysteresis(ds.isel(branch=[0, 1]), ids.isel(branch=[0, 1]))
    # what is not shown to attract makes no loop
    ids["stability"][:, 0] = NOT_SETTLED
    assert not find_hysteresis(ds, ids)["differs"].any()


@pytest.mark.parametrize(
    ("periods", "width", "same"),
    [
        ((3, 6), 0.2, True),  # a doubling, points up to 0.2 apart
        ((3, 7), 0.2, False),
        ((3, 7), 0.0, False),
        ((3, 0), 0.2, False),  # an orbit inside of wide chaos
        ((3, 0), 0.0, False),  # narrow bands of chaos
        ((0, 0), 0.2, True),
    ],
)
def test_match__unlike_things_have_different_ids_however_near(periods, width, same):
    centres = np.array([[0.0, 0.0], [0.4, 1.0], [-0.3, -2.0]])
    points = np.full((2, 1, 12, 4), np.nan)
    points[0, 0, :3, :2] = centres
    points[1, 0, :, :2] = np.repeat(centres, 4, axis=0)
    points[1, 0, ::4, 0] += width  # a quarter of the points
    points[..., 2:] = np.where(np.isfinite(points[..., :1]), 0.0, np.nan)
    ds, dims = rows([0.0], [0.0]).drop_vars("attractor_points"), ("frequency", "attractor")
    kinds = [[PERIODIC_ORBIT if p else BOUNDED_SET] for p in periods]
    ds = ds.assign(kind=(dims, kinds), orbit_period=(dims, np.array(periods)[:, None]))
    ds["attractor_points"] = ((*dims, "point", "state"), points)
    assert match(ds).sizes["attractor"] == (1 if same else 2)


def test_attractors_table__shares_are_of_all_cells():
    """15 of 24 cells never cross the section: the attractor of the others has 9/24, the rest is named."""
    ids = np.full((1, 24), -1)
    ids[0, :9] = 0
    status = np.where(ids >= 0, PERIODIC, NO_RETURN).astype(np.int8)
    none = np.zeros(4)
    one = Features(none[None], PERIODIC_ORBIT, 1, none[:2], 0, none, none, stability=ATTRACTS)
    assert _shares(Found(ids[0], np.zeros(24), [one], [9])).tolist() == [9 / 24]
    made = make_attractors(ids, ("frequency", "initial_condition"), {"frequency": [1.0]}, status=status)
    assert {name: share.tolist() for name, share in shares_of_others(made).items()} == {"no return": [15 / 24]}
    low, high = share_interval(np.array([9]), np.array([9 / 24]))
    assert [low[0], high[0]] == pytest.approx([*binomtest(9, 24).proportion_ci(0.95, "wilson")])
    assert _others_lines(made) == [["  on no attractor: 0.6250 (0.4271 to 0.7884) no return"]]
