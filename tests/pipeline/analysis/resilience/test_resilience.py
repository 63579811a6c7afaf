"""Responses to shocks and edge states, against DOP853, closed forms and published numbers."""

import json

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import expm

from pipeline.analysis.attractors.destinations import ELSEWHERE, UNDECIDED, destinations_at
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.analysis.resilience.analysis import resilience_table
from pipeline.analysis.resilience.declaration import ResilienceOptions
from pipeline.analysis.resilience.edge import edge_table, ids_of
from pipeline.analysis.resilience.edge_figure import plot_edge
from pipeline.analysis.resilience.figure import plot_resilience
from pipeline.analysis.resilience.shocks import Asked, Bases, search_together
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, EQUILIBRIUM, KINDS, PERIODIC_ORBIT
from pipeline.results.ragged import dense
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError
from tests.core.cells import scipy_end
from tests.core.flows import table
from tests.pipeline.analysis.cubes import WELLS, line, sweep
from tests.pipeline.analysis.resilience.test_local_stability import growth, sizes_of

UNIT_HZ = 0.15915494309189535
WELL_VALUES = {"damping": 0.15, "linear": -1.0, "cubic": 1.0, "amplitude": 0.2}


def grid(size, num, *names):
    """Starts on a square about 0."""
    return {"kind": "grid", **dict.fromkeys(names, line(-size, size, num))}


MAGNETS = sweep("three-magnets", grid(1.4, 12, "x", "y"), frequency_hz=0.5, tolerance=1e-8, closes=1e-4)


@pytest.fixture(scope="module")
def duffing(computed):
    """Make a run of the Duffing oscillator with some values of its own."""

    def call(num=21, **values):
        parameters = {"overrides": {**WELL_VALUES, **values}}
        spec = sweep("duffing", grid(2.0, num, "x", "v"), frequency_hz=UNIT_HZ, closes=1e-6, parameters=parameters)
        return AnalysedRun.of(computed(spec))

    return call


@pytest.fixture(scope="module")
def wells(duffing):
    return duffing()


@pytest.fixture(scope="module")
def found(wells):
    return wells.derive("resilience")


@pytest.fixture(scope="module")
def magnets(computed):
    return AnalysedRun.of(computed(MAGNETS))


def at_point(a_run):
    """The only parameter point of a run, as ends of trajectories."""
    cube = a_run.cube()
    (points,) = slabs(cube, Dynamics.of(cube), SECTION_BYTES)
    ((_, there),) = destinations_at(cube, dense(a_run.derive("attractors"), points=True), points)
    return there


# ---- by DOP853 ---------------------------------------------------------------------------------


def flow(states, begin, end, amplitude=0.2, rtol=1e-9):
    """States (n, 2) of x'' + .15 x' - x + x^3 = F cos t at the end, from those at the begin, by scipy."""

    def rates(t, z):
        x, v = z.reshape(2, -1)
        return np.concatenate([v, amplitude * np.cos(t) - 0.15 * v + x - x**3])

    return scipy_end(rates, np.asarray(states).T.ravel(), end, rtol, begin).reshape(2, -1).T


def well_of(states, begin):
    """Which of the two orbits trajectories are on after some eighty periods; -1 for none yet."""
    ends = flow(states, begin, 80 * 2.0 * np.pi)
    away = np.abs(ends[:, None] - WELLS).max(axis=-1)
    return np.where(away.min(axis=1) < 1e-2, away.argmin(axis=1), -1)


@pytest.fixture(scope="module")
def exhaustive():
    """Smallest shock of v from each orbit at each of eight phases, from all multiples of .004 up to .3 (DOP853)."""
    sizes = np.arange(1, 76) * 0.004
    shocks = np.outer(np.concatenate([sizes, -sizes]), [0.0, 1.0])
    least = np.full((2, 8), np.inf)
    for k in range(8):
        begin = 2.0 * np.pi * k / 8
        base = flow(WELLS, 0.0, begin, rtol=1e-12) if k else WELLS
        ends = well_of((base[:, None] + shocks).reshape(-1, 2), begin).reshape(2, 2, -1)
        for well in (0, 1):
            away = (ends[well] == 1 - well).any(axis=0)
            least[well, k] = sizes[away.argmax()] if away.any() else np.inf
    return least


def separates(well_at, well):
    """Whether shares of a jump below 1 stay and some above 1 leave.

    Beyond the boundary, which is fractal, both ends lie close together. The shares are 1e-5 and more away from 1:
    scipy's tolerance and ours move the boundary by less.
    """
    off = 10.0 ** np.arange(-5.0, -2.0, 0.15)[:, None]
    return bool((well_at(1.0 - off) == well).all() and (well_at(1.0 + off) == 1 - well).any())


@pytest.mark.slow
def test_resilience__critical_shock_of_duffing_by_exhaustion(found, exhaustive):
    """No smaller multiple of .004 leads away at any phase; the shock found does, a slightly smaller one does not."""
    for well in (0, 1):
        one = found.isel(set=well)
        size, phase = float(one["shock_high"]), float(one["shock_phase"])
        assert exhaustive[well].min() - 0.004 <= size <= exhaustive[well].min()
        assert exhaustive[well, round(8 * phase)] == exhaustive[well].min()
        begin = 2.0 * np.pi * phase
        base = flow(WELLS[[well]], 0.0, begin, rtol=1e-12)[0]
        assert one["shock_from"].values == pytest.approx(base, abs=1e-8)
        jump = one["shock"].values
        assert jump[0] == 0.0
        assert abs(jump[1]) == pytest.approx(size)
        assert separates(lambda share, base=base, jump=jump, begin=begin: well_of(base + share * jump, begin), well)
        assert int(one["shock_to"]) == 1 - well
        assert one["shock_high"] - one["shock_low"] <= 1.1e-6 * size
        assert float(one["shock_safe"]) < size


@pytest.mark.slow
def test_resilience__distances_of_duffing(found):
    """In any direction at the section, and along each state: smaller shocks stay, larger ones leave (DOP853)."""
    turns = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    for well, point in enumerate(WELLS):
        one = found.isel(set=well)
        size = float(one["distance_high"])
        assert np.hypot(*one["distance"].values) == pytest.approx(size)
        inside = np.concatenate([share * size * circle for share in (0.7, 0.99)])
        assert (well_of(point + inside, 0.0) == well).all()
        assert separates(lambda share, p=point, jump=one["distance"].values: well_of(p + share * jump, 0.0), well)
        for k in (0, 1):
            along = np.zeros(2)
            along[k] = float(one["along"][k])
            assert separates(lambda share, p=point, jump=along: well_of(p + share * jump, 0.0), well)
            assert well_of(point - 0.9999 * along[None], 0.0)[0] == well
            assert abs(along[k]) >= size


@pytest.mark.slow
def test_resilience__basin_stability_and_table(found, wells):
    shares = found["basin_stability"].values
    fractions = dense(wells.derive("basins"))["fraction"].sel(attractor=[0, 1]).values
    assert shares == pytest.approx(fractions)
    assert (found["basin_stability_low"] < shares).all()
    assert (shares < found["basin_stability_high"]).all()
    shown = resilience_table(found)
    assert [row["letter"] for row in shown.rows] == ["A", "B"]
    assert [row["shock_leads_to"] for row in shown.rows] == ["B", "A"]
    assert shown.rows[0]["shock_v"] == pytest.approx(float(found["shock"].isel(set=0, state=1)))
    json.dumps([dict(row) for row in shown.rows])
    assert f"{float(found['shock_high'][0]):.5g}" in "\n".join(shown.lines)
    figure = plot_resilience(found, dense(wells.derive("attractors"), points=True))
    assert [ax.get_ylabel() for ax in figure.axes] == ["basin stability", "smallest shock", "arrival [drive periods]"]
    assert float(figure.data["shock_high"].isel(attractor=0)) == float(found["shock_high"][0])


# ---- one attractor -----------------------------------------------------------------------------


@pytest.mark.slow
def test_resilience__of_a_linear_oscillator(duffing):
    """x'' + .2 x' + 2 x = cos t: one orbit, which attracts all states.

    No shock leads away; arrivals and growth follow the matrix exponential (validation.md, 1).
    """
    linear = duffing(damping=0.2, linear=2.0, cubic=0.0, amplitude=1.0, num=5)
    one = linear.derive("resilience", within=7, largest=3.0).isel(set=0)
    assert float(one["shock_low"]) == 3.0
    assert np.isinf(one["shock_high"])
    assert int(one["shock_to"]) == UNDECIDED
    assert int(one["distance_n_below"]) > 1000
    away = np.stack(np.meshgrid(*[np.linspace(-2.0, 2.0, 5)] * 2), -1).reshape(-1, 2) - [0.9615384615, 0.1923076923]
    matrix = np.array([[0.0, 1.0], [-2.0, -0.2]])
    return_map = expm(2.0 * np.pi * matrix)
    inside, step = [], away.T
    for _ in range(60):
        inside.append(np.abs(step).max(axis=0) <= 0.01)
        step = return_map @ step
    inside = np.array(inside)
    # the first section from which on all are inside
    entered = len(inside) - np.argmin(inside[::-1], axis=0)
    assert int(one["n_timed"]) == 25
    assert float(one["mean_time"]) == pytest.approx(entered.mean())
    assert float(one["longest_time"]) == entered.max()
    assert float(one["arrived"]) == pytest.approx((entered <= 7).mean())
    assert 0.0 < float(one["arrived_low"]) < float(one["arrived"]) < float(one["arrived_high"]) < 1.0
    sizes = sizes_of(matrix, np.arange(200) * 2.0 * np.pi / 64)
    assert float(one["reactivity"]) == pytest.approx(growth(matrix), rel=1e-9)
    assert float(one["amplification"]) == pytest.approx(sizes.max(), rel=1e-7)
    assert float(one["amplification_time"]) == pytest.approx(np.argmax(sizes) * 2.0 * np.pi / 64)
    assert float(one["return_time"]) == pytest.approx(10.0, rel=1e-6)


# ---- magnets -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_shocks__magnetic_pendulum_as_published(magnets):
    """Test "Magnetic 2D" of Attractors.jl: .39 to .395 of place, in the Euclidean norm, from a magnet at rest.

    Its value is .3923. A magnet is no rest of the bob: that is .0097 nearer to the middle.
    """
    there = at_point(magnets)
    resting = np.array([one.state for one in there.point.equilibria])
    place, own = np.array([1.0, 0.0, 0.0, 0.0]), int(np.argmax(resting[:, 0]))
    for state, least in ((place, 0.3923), (resting[own], 0.40204)):
        bases, which = Bases(state[None], np.zeros(1), np.ones(1, bool)), np.array([0, 1])
        asked, units = Asked.of(own, bases, which, ResilienceOptions()), np.asarray(there.point.integrates.units)
        one = search_together({"it": asked}, there, units)["it"]
        assert one.high == pytest.approx(least, abs=1e-4)
        assert one.to in {0, 1, 2} - {own}
    # Bases of three equal magnets: the same sizes by symmetry, and jumps of place that agree with the search above
    found = magnets.derive("resilience", states="x,y", timed=0)
    assert found["shock_high"].values == pytest.approx(np.full(3, 0.40204), abs=1e-4)
    assert (found["shock"].values[:, 2:] == 0.0).all()
    assert (found["n_timed"] == 0).all()
    assert found.attrs["resilience_states"] == "x, y"


# ---- edge states -------------------------------------------------------------------------------

HILLTOP, MULTIPLIERS = (-0.099835710177, 0.007534227463), (324.501702, 0.00120079844)


@pytest.mark.slow
def test_edge__of_a_fractal_boundary(wells):
    """The boundary is fractal: its paths do not settle, and the orbit on the hilltop is one of those on it."""
    found = wells.derive("edge", between=("A", "B"), seed=2)
    points = found["section"].values[:, 0]
    k = int(np.argmin(np.abs(points - HILLTOP).max(axis=1)))
    assert points[k] == pytest.approx(HILLTOP, abs=1e-9)
    assert found["multiplier_real"].values[k] == pytest.approx(MULTIPLIERS, rel=1e-7)
    assert found["multiplier_imag"].values[k] == pytest.approx(0.0)
    assert int(found["kind"][k]) == PERIODIC_ORBIT
    assert int(found["n_pairs"][k]) == 0
    assert (found["kind"] == BOUNDED_SET).any()
    assert found.attrs["between"] == [0, 1]
    lines = edge_table(found).lines
    assert "on a path" in "\n".join(lines)
    figure = plot_edge(found)
    gids = {curve.get_gid().partition(":")[0] for curve in figure.axes[0].lines if ":" in (curve.get_gid() or "")}
    assert gids == {"edge orbit", "edge set"}


@pytest.mark.slow
def test_edge__of_a_smooth_boundary(duffing):
    """At F = .1 all pairs come to one saddle orbit: a fixed point by DOP853, between the two basins."""
    a_run = duffing(amplitude=0.1)
    found = a_run.derive("edge", between=("1", "0"))
    assert found.sizes["edge"] == 1
    assert int(found["n_pairs"][0]) == 4
    assert int(found["orbit_period"][0]) == 1
    point = found["section"].values[0, 0]
    assert flow(point[None], 0.0, 2.0 * np.pi, 0.1, 1e-13)[0] == pytest.approx(point, abs=1e-9)
    step = 1e-6
    columns = [
        (flow(point[None] + h, 0, 2 * np.pi, 0.1, 1e-13) - flow(point[None] - h, 0, 2 * np.pi, 0.1, 1e-13))[0]
        / (2 * step)
        for h in step * np.eye(2)
    ]
    values, vectors = np.linalg.eig(np.column_stack(columns))
    assert np.sort(found["multiplier_real"].values[0]) == pytest.approx(np.sort(values), rel=1e-5)
    across = vectors[:, np.argmax(np.abs(values))].real
    stored = dense(a_run.derive("attractors"), points=True)["attractor_points"].values
    points = stored[:, 0][[found.attrs["between"]]].reshape(2, 2)
    ends = flow(point + np.array([[1e-3], [-1e-3]]) * across, 0.0, 60 * 2.0 * np.pi, 0.1)
    nearest = np.abs(ends[:, None] - points).max(axis=-1)
    assert nearest.min(axis=1).max() < 1e-3
    assert set(nearest.argmin(axis=1).tolist()) == {0, 1}


@pytest.mark.slow
def test_edge__of_two_magnets(magnets):
    """On the line between two magnets' basins lies a rest: no force by its formula, one unstable eigenvalue."""
    found = magnets.derive("edge", between=("A", "B"), pairs=8)
    rests = np.flatnonzero(found["kind"].values == EQUILIBRIUM)
    assert len(rests) == 1
    assert found.sizes["edge"] == 1
    x, y, vx, vy = found["section"].values[rests[0], 0]
    assert (vx, vy) == pytest.approx((0.0, 0.0), abs=1e-12)
    places = np.array([[1.0, 0.0], [-0.5, np.sqrt(0.75)], [-0.5, -np.sqrt(0.75)]])

    def force(place):
        away = place - places
        return -0.64 * place - (away / (np.sum(away**2, axis=1) + 0.04)[:, None] ** 1.5).sum(axis=0)

    assert force(np.array([x, y])) == pytest.approx([0.0, 0.0], abs=1e-10)
    step = 1e-5
    slopes = [(force(np.array([x, y]) + h) - force(np.array([x, y]) - h)) / (2 * step) for h in step * np.eye(2)]
    matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [np.column_stack(slopes), -0.2 * np.eye(2)]])
    values = np.linalg.eigvals(matrix)
    assert np.sort(found["eigenvalue_real"].values[0]) == pytest.approx(np.sort(values.real), abs=1e-6)
    assert (values.real > 0.0).sum() == 1


THOMAS = sweep(
    table("thomas", {"x": "sin(y) - b*x", "y": "sin(z) - b*y", "z": "sin(x) - b*z"}, {"b": 0.16}),
    {"kind": "random", "n": 200, "seed": 1, "x": [-5.0, 5.0], "y": [-5.0, 5.0], "z": [-5.0, 5.0]},
    section={"of": "x", "value": 0.0, "direction": "up"},
    lengths=(200, 32),
)


@pytest.mark.slow
def test_edge__between_sections(computed):
    """Thomas' cycles: pairs part between two crossings, where they pass the saddles; no other set is an edge."""
    found = AnalysedRun.of(computed(THOMAS)).derive("edge", between=("A", "B"))
    assert found.sizes["edge"] >= 1
    assert (found["kind"] == EQUILIBRIUM).all()
    for state, real in zip(found["section"].values[:, 0], found["eigenvalue_real"].values, strict=True):
        assert np.sin(np.roll(state, -1)) - 0.16 * state == pytest.approx(np.zeros(3), abs=1e-9)
        assert np.linalg.norm(state) == pytest.approx(4.06585, abs=1e-5)
        matrix = np.diag(np.cos(np.roll(state, -1))) @ np.roll(np.eye(3), 1, axis=1) - 0.16 * np.eye(3)
        assert np.sort(real) == pytest.approx(np.sort(np.linalg.eigvals(matrix).real), abs=1e-6)


# ---- what does not suit ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("resilience", {"states": "x,w"}, "states = 'w' is no state of duffing; use x, v"),
        ("resilience", {"at": {"damping": 0.1}}, "damping"),
        ("edge", {"between": ("A", "a")}, "give two different attractors"),
        ("edge", {"between": ("A", "0")}, "give two different attractors"),
        ("edge", {"between": ("A", "Q")}, "attractor Q is not at the parameter point; it has A, B"),
        ("edge", {"between": ("A", "B"), "closest": 1e-4}, "--closest 0.0001 must be less than --farthest 0.0001"),
    ],
)
def test_resilience__refuses(wells, name, options, message):
    with pytest.raises(SpecError, match=message):
        wells.derive(name, **options)


def test_edge__needs_a_section_for_a_limit_cycle_at_even_times():
    """Without crossings it has no period; an equilibrium, an orbit with a period and a chaotic set can be told."""
    kinds = [EQUILIBRIUM, PERIODIC_ORBIT, PERIODIC_ORBIT, KINDS.index("chaotic_set")]
    columns = {"kind": kinds, "orbit_period": [0, 0, 2, 0], "stability": [ATTRACTS] * 4}
    here = xr.Dataset({name: ("attractor", np.array(values)) for name, values in columns.items()})
    assert ids_of(here, ("A", "C")) == (0, 2)
    assert ids_of(here, ("A", "D")) == (0, 3)
    with pytest.raises(ValueError, match=r"attractor B is a limit cycle seen at even times.* a table \[section\]"):
        ids_of(here, ("A", "B"))


@pytest.mark.slow
def test_edge__says_what_is_not_decided(wells):
    """A path of 16 sections on a fractal boundary has not settled."""
    found = wells.derive("edge", between=("A", "B"), seed=2, returns=16, max_period=0)
    assert found.sizes["edge"] == 0
    assert (found["pair_edge"] == -1).all()
    assert "not decided, 4 pairs: its path has not come to a set that repeats itself" in "\n".join(
        edge_table(found).lines
    )


def test_destinations__ends_of_trajectories(wells):
    """Near an orbit they end on it; an orbit that is not known is elsewhere, and undecided without the extension."""
    there = at_point(wells)
    near = WELLS + 0.01
    assert there.follow(near).label.tolist() == [0, 1]
    there.orbits, there.orbit_ids = there.orbits[:1], there.orbit_ids[:1]
    assert there.follow(near).label.tolist() == [0, ELSEWHERE]
    there.options = there.options.model_copy(update={"extend": False})
    assert there.follow(near).label.tolist() == [0, UNDECIDED]
