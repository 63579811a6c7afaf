"""Test systems of Attractors.jl: values that its tests assert, and our own computations where these are loose.

Its tests draw 1000 random states, so that a fraction errs by .016; ours are of grids. The "dumb map" with its table of
stability quantifiers is in `test_local_stability`, the smallest shock of the magnetic pendulum in `test_resilience`.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import fsolve
from scipy.spatial.distance import cdist

from pipeline.analysis.resilience.declaration import ResilienceOptions
from pipeline.analysis.resilience.shocks import Asked, Bases, search_together
from pipeline.results.ragged import dense
from pipeline.runs.derive import AnalysedRun
from tests.core.flows import table
from tests.pipeline.analysis.cubes import WELLS, line, sweep
from tests.pipeline.analysis.resilience.test_resilience import UNIT_HZ, WELL_VALUES, at_point

pytestmark = pytest.mark.slow

DRAWN = 3.0 * 0.016
"""Three standard deviations of a fraction of 1000 random states, as in test/mapping/attractor_mapping.jl."""

FEW = {"directions": 8, "confirmations": 8, "phases": 1, "timed": 0}


def plane(size, num, names=("x", "y")):
    return {"kind": "grid", **dict.fromkeys(names, line(-size, size, num))}


def iterated(name, equations, starts, lengths=(200, 8), parameters=None, axes=(), **more):
    """A sweep of a map."""
    model = {**table(name, equations, parameters or {}, **more), "kind": "map"}
    spec = sweep(model, starts, axes=axes)
    return {**spec, "integration": {"n_transient": lengths[0], "n_keep": lengths[1]}}


def starts_and_labels(run):
    """Initial states (cell, 2) and attractors of the cells of a run in a plane."""
    labels = dense(run.derive("attractors"))["attractor_id"].squeeze()
    x, y = (labels[dim].values for dim in labels.dims)
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2), labels.values.ravel()


# ---- three magnets -----------------------------------------------------------------------------

PLACES = np.array([[1.0, 0.0], [-0.5, np.sqrt(0.75)], [-0.5, -np.sqrt(0.75)]])
_PULLS = [f"g{k}/((x - {a!r})**2 + (y - {b!r})**2 + d**2)**1.5" for k, (a, b) in enumerate(PLACES.tolist())]
_SUMS = [" - ".join(f"({s} - {p[i]!r})*p{k}" for k, p in enumerate(PLACES.tolist())) for i, s in enumerate("xy")]
MAGNETS = table(
    "magnets",
    {"x": "vx", "y": "vy", "vx": f"-w**2*x - a*vx - {_SUMS[0]}", "vy": f"-w**2*y - a*vy - {_SUMS[1]}"},
    {"g0": 1.0, "g1": 1.0, "g2": 1.0, "w": 0.8, "a": 0.2, "d": 0.2},
    define={f"p{k}": pull for k, pull in enumerate(_PULLS)},
)


def force(places):
    """Acceleration of bobs at rest, shape (bob, 2), at w = .8, d = .2 and strengths 1."""
    away = places[:, None] - PLACES
    return -0.64 * places - (away / (np.sum(away**2, axis=-1) + 0.04)[..., None] ** 1.5).sum(axis=1)


def released(places, n_periods=80, seconds=2.0, step=0.01):
    """States (period, bob, 4) of bobs released at rest, by RK4 with steps of .01 s."""

    def rates(z):
        return np.hstack([z[:, 2:], force(z[:, :2]) - 0.2 * z[:, 2:]])

    z = np.hstack([places, np.zeros_like(places)])
    found = [z]
    for _ in range(n_periods):
        for _ in range(round(seconds / step)):
            k1 = rates(z)
            k2 = rates(z + 0.5 * step * k1)
            k3 = rates(z + 0.5 * step * k2)
            k4 = rates(z + step * k3)
            z = z + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        found.append(z)
    return np.array(found)


def test_magnets__all_quantifiers(computed):
    """Of 40 x 40 bobs the fractions, times and means by RK4, and of their rests what matrix exponentials tell.

    Attractors.jl: fractions .347, .335 and .318 of 1000 random places (to .01 of its own draw).
    """
    spec = sweep(MAGNETS, plane(2.0, 40), frequency_hz=0.5, tolerance=1e-8, closes=1e-5, lengths=(120, 4))
    run = AnalysedRun.of(computed(spec))
    found = run.derive("resilience", quantity="x**2 + y**2", within=20, **{**FEW, "timed": 1600})
    rests = np.array([np.append(fsolve(lambda u: force(u[None])[0], at, xtol=1e-13), [0.0, 0.0]) for at in PLACES])
    order = [int(np.argmin(np.linalg.norm(found["distance_from"].values - rest, axis=1))) for rest in rests]
    assert found["distance_from"].values[order] == pytest.approx(rests, abs=1e-8)
    places, _ = starts_and_labels(run)
    states = released(places)
    own = np.argmin(np.linalg.norm(states[-1, :, None] - rests, axis=-1), axis=1)
    assert np.linalg.norm(states[-1] - rests[own], axis=1).max() < 1e-3
    inside = np.abs(states - rests[own]).max(axis=-1) <= 0.01
    entered = len(inside) - np.argmin(inside[::-1], axis=0)
    theirs = [0.347, 0.335, 0.318]
    for k, row in enumerate(order):
        one, mine = found.isel(set=row), own == k
        # 2 cells of 1600 lie so near to a boundary that RK4 and the tolerance 1e-8 may differ
        assert float(one["basin_stability"]) == pytest.approx(mine.mean(), abs=2.1 / 1600)
        assert float(one["basin_stability"]) == pytest.approx(theirs[k], abs=DRAWN)
        assert float(one["mean_time"]) == pytest.approx(entered[mine].mean(), rel=5e-3)
        assert abs(float(one["longest_time"]) - entered[mine].max()) <= 1
        assert float(one["arrived"]) == pytest.approx((mine & (entered <= 20)).mean(), abs=4.1 / 1600)
        assert float(one["quantity"]) == pytest.approx((places[mine] ** 2).sum(axis=1).mean(), rel=5e-3)
        step = 1e-5
        at = rests[k, :2] + step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        slopes = (force(at)[::2] - force(at)[1::2]).T / (2.0 * step)
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [slopes, -0.2 * np.eye(2)]])
        assert float(one["return_time"]) == pytest.approx(-1.0 / np.linalg.eigvals(matrix).real.max(), rel=1e-6)
        assert float(one["reactivity"]) == pytest.approx(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[-1], rel=1e-6)
        sizes = [np.linalg.norm(expm(t * matrix), 2) for t in np.linspace(0.0, 2.0, 4001)]
        assert float(one["amplification"]) == pytest.approx(max(sizes), rel=1e-5)
        # of its definition the nearest start of another basin, which is no nearer than the boundary
        assert float(one["distance_high"]) <= np.linalg.norm(places[~mine] - rests[k, :2], axis=1).min() + 1e-6


def test_magnets__third_one_weaker(computed):
    """Attractors.jl: at w = .5, d = .3 two attractors below .2 of the third magnet's strength, three above .22."""
    axes = {"g0": {"values": [0.1, 0.19, 0.23, 1.0]}}
    parameters = {"overrides": {"w": 0.5, "d": 0.3}}
    spec = sweep(MAGNETS, plane(3.0, 21), axes=axes, frequency_hz=0.5, closes=1e-4, parameters=parameters)
    found = AnalysedRun.of(computed(spec)).derive("resilience", **FEW)
    assert found["n_sets"].values.tolist() == [2, 2, 3, 3]
    # at a rest a direction swings by l**2 + .2 l + k = 0, k > .01: all disturbances shrink by exp(-.1 t)
    assert found["return_time"].values == pytest.approx(np.full(10, 10.0))
    # with three equal magnets two basins are mirror images, also on the square grid
    shares = np.sort(found["basin_stability"].values[7:])
    assert np.diff(shares).min() <= 2.1 / 441
    assert shares.sum() == pytest.approx(1.0)


# ---- maps --------------------------------------------------------------------------------------


def test_newton__smallest_shock(computed):
    """Newton's method for z**3 = 1. Attractors.jl: .62009 to .629, .622 to 1 %, and equal by symmetry."""
    equations = {"x": "x - re", "y": "y - im"}
    define = {"n": "3*(x**2 + y**2)**2", "re": "x/3 - (x**2 - y**2)/n", "im": "y/3 + 2*x*y/n"}
    found = AnalysedRun.of(computed(iterated("newton", equations, plane(1.5, 40), (200, 8), define=define))).derive(
        "resilience", **{**FEW, "directions": 64, "confirmations": 256}
    )
    assert found["distance_high"].values == pytest.approx(np.full(3, 0.622), rel=1e-2)
    assert ((found["distance_high"] > 0.62009) & (found["distance_high"] < 0.629)).all()
    # circles about 1 with 4000 directions: all smaller shocks come back, some larger ones do not
    size = float(found["distance_high"].min())
    z = 1.0 + np.outer(size * np.array([0.97, 0.985, 0.9995, 1.0005]), np.exp(2j * np.pi * np.arange(4000) / 4000))
    for _ in range(200):
        z = z - (z**3 - 1.0) / (3.0 * z**2)
    stays = np.abs(z - 1.0) < 1e-6
    assert stays[:3].all()
    assert not stays[3].all()
    assert (found["return_time"] < 0.05).all()  # 0 at the root itself


def test_henon__fixed_point_and_period_three(computed):
    """The map of its test "Discrete time", which asserts no value: one fixed point and one orbit of period 3."""
    starts = {"kind": "grid", "x": line(-3.0, 3.0, 51), "y": line(-3.0, 4.0, 51)}
    spec = iterated("henon_alter", {"x": "1 - 1.05*x**2 + y", "y": "-0.9*x"}, starts, (600, 12))
    run = AnalysedRun.of(computed(spec))
    found = run.derive("resilience", **FEW)
    assert sorted(found["orbit_period"].values.tolist()) == [1, 3]
    points, _ = starts_and_labels(run)
    z = points.copy()
    with np.errstate(all="ignore"):
        for _ in range(3000):
            z = np.column_stack([1.0 - 1.05 * z[:, 0] ** 2 + z[:, 1], -0.9 * z[:, 0]])
        again = np.column_stack([1.0 - 1.05 * z[:, 0] ** 2 + z[:, 1], -0.9 * z[:, 0]])
    finite = np.isfinite(z).all(axis=1)
    still = finite & (np.abs(again - z).max(axis=1) < 1e-6)
    row = int(np.argmin(found["orbit_period"].values))
    rest, other = found.isel(set=row), found.isel(set=1 - row)
    assert float(rest["basin_stability"]) == pytest.approx(still.mean())
    assert float(other["basin_stability"]) == pytest.approx((finite & ~still).mean())
    x = (-1.9 + np.sqrt(1.9**2 + 4.2)) / 2.1  # 1 - 1.05 x**2 - .9 x = x
    matrix = np.array([[-2.1 * x, 1.0], [-0.9, 0.0]])
    assert float(rest["return_time"]) == pytest.approx(-1.0 / np.log(np.abs(np.linalg.eigvals(matrix)).max()), rel=1e-6)
    assert float(rest["reactivity"]) == pytest.approx(np.log(np.linalg.norm(matrix, 2)), rel=1e-9)
    nearest = np.linalg.norm(points[~still] - [x, -0.9 * x], axis=1).min()
    assert 0.5 * nearest < float(rest["distance_high"]) <= nearest


def test_dumb_map__quantifiers_of_the_user(computed):
    """Starts of a basin with x > r: 0 and 3 at r = .5, none at r = 1."""
    to = "where(r < 0.5, 0, where(x >= 0, r, -r))"
    axes = {"r": {"values": [0.5, 1.0]}}
    spec = iterated("dumb_map", {"x": to, "y": to}, plane(1.0, 3), (20, 4), {"r": 1.0}, axes)
    found = AnalysedRun.of(computed(spec)).derive("resilience", quantity="n_cells*where(x > r, 1, 0)", **FEW)
    assert sorted(found["quantity"].values[:2].tolist()) == [0.0, 3.0]
    assert found["quantity"].values[2:].tolist() == [0.0, 0.0]


def test_dumb_map__what_a_few_lines_give(computed):
    """Largest non-critical shocks 2 and 2.23607 at r = 1, and intermingledness .66 and 1, from labels and starts."""
    to = "where(x >= 0, 1, -1)"
    run = AnalysedRun.of(computed(iterated("dumb_map_1", {"x": to, "y": to}, plane(1.0, 3), (20, 4))))
    points, labels = starts_and_labels(run)
    ends = np.where(points[:, :1] >= 0.0, 1.0, -1.0)
    away = np.linalg.norm(points - ends, axis=1)
    assert sorted(away[labels == k].max() for k in (0, 1)) == pytest.approx([2.0, 2.23607], abs=1e-5)
    run = AnalysedRun.of(
        computed(iterated("dumb_map_0", {"x": "where(x >= 0, 0.9, -0.9)", "y": "0*y"}, plane(1.0, 21)))
    )
    points, labels = starts_and_labels(run)
    for columns, value, tolerance in ((slice(None), 0.66, 0.1), (slice(1, 2), 1.0, 1e-14)):
        groups = [points[labels == k][:, columns] for k in (0, 1)]
        for k in (0, 1):
            ratio = cdist(groups[k], groups[k]).mean() / cdist(groups[k], groups[1 - k]).mean()
            assert ratio == pytest.approx(value, abs=tolerance)


def test_henon__share_that_stays(computed):
    """Henon's map at a = 1.4 and b = .3: .451 of the states in [-2, 2]**2 come to its attractor, the others leave."""
    spec = iterated("henon_map", {"x": "1 - 1.4*x**2 + y", "y": "0.3*x"}, plane(2.0, 101), (300, 64))
    fractions = dense(AnalysedRun.of(computed(spec)).derive("basins"))["fraction"].squeeze()
    stays = float(fractions.sel(attractor=fractions["attractor"] >= 0).sum())
    assert stays == pytest.approx(0.451, abs=DRAWN)


# ---- flows -------------------------------------------------------------------------------------


def test_duffing__shares_of_two_wells(computed):
    """Duffing's oscillator at F = .2: .511 on the right, .489 on the left, of states in [-2.2, 2.2]**2."""
    spec = sweep(
        "duffing", plane(2.2, 61, ("x", "v")), frequency_hz=UNIT_HZ, closes=1e-6, parameters={"overrides": WELL_VALUES}
    )
    found = AnalysedRun.of(computed(spec)).derive("resilience", **FEW)
    right = int(np.argmin(np.abs(found["distance_from"].values - WELLS[1]).max(axis=1)))
    assert float(found["basin_stability"][right]) == pytest.approx(0.511, abs=DRAWN)
    assert float(found["basin_stability"][1 - right]) == pytest.approx(0.489, abs=DRAWN)


def test_thomas__shocks_equal_by_symmetry(computed):
    """Thomas' flow at b = .1665 maps x to y to z. Attractors.jl: equal shocks from (1.5, 0, 0) and (0, 1.5, 0)."""
    equations = {"x": "sin(y) - b*x", "y": "sin(z) - b*y", "z": "sin(x) - b*z"}
    model = table("thomas", equations, {"b": 0.1665})
    starts = {"kind": "random", "n": 100, "seed": 1, **{name: [-6.0, 6.0] for name in "xyz"}}
    section = {"of": "x", "value": 0.0, "direction": "up"}
    there = at_point(AnalysedRun.of(computed(sweep(model, starts, section=section, lengths=(300, 32)))))
    sizes = []
    for state in 1.5 * np.eye(3):
        own = int(there.follow(state[None]).label[0])
        bases = Bases(state[None], np.zeros(1), np.ones(1, bool))
        asked = Asked.of(own, bases, np.arange(3), ResilienceOptions(largest=6.0))
        sizes.append(search_together({"it": asked}, there, np.ones(3))["it"].high)
    assert sizes == pytest.approx(np.full(3, sizes[0]), abs=1e-4)
