"""Conclusions about attractors that must not be drawn: rotation at rest, families that attract, sets of one cell."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from magpend_core.crossing import Crossing
from magpend_core.equilibria import find_equilibria
from magpend_core.models import load_model
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.stability import BY_ONE_SIDE
from pipeline.layout.vocabulary import (
    ATTRACTS,
    BOUNDED_SET,
    CHAOTIC_SET,
    EQUILIBRIUM,
    NEUTRAL,
    NOT_SETTLED,
    PERIODIC_ORBIT,
    TORUS,
    TRANSIENT,
    UNSTABLE,
)
from pipeline.products.registry import ANALYSES
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive, shown_table
from pipeline.specification.problems import SpecError
from tests.core.flows import table
from tests.pipeline.analysis.cubes import flow_cube, sweep
from tests.pipeline.analysis.dense_sets import identify
from tests.pipeline.analysis.maps import FIXED, MapPoint, settle, tent
from tests.pipeline.factories import quietly

pytestmark = pytest.mark.slow

CIRCLE = {"on_circle": True}

UNIFORM_ANGLE = table("uniform_angle", {"r": "r*(1-r**2)", "th": "w"}, {"w": 1.0}, states={"th": CIRCLE})
"""Radius and angle: a limit cycle of 2 pi/w with the multiplier exp(-4 pi/w)."""

IDLE_CLOCK = table("idle_clock", {"x": "v", "v": "-c*v-x", "th": "w"}, {"w": 1.3, "c": 0.2}, states={"th": CIRCLE})
"""A damped oscillator at rest beside a clock: the multipliers exp(-c pi/w) are two."""

ANGLES = ("a", "b", "c")
KURAMOTO = table(
    "kuramoto",
    {x: f"w{x}+k/3*(" + "+".join(f"sin({y}-{x})" for y in ANGLES if y != x) + ")" for x in ANGLES},
    {"wa": 1.0, "wb": 1.1, "wc": 0.9, "k": 1.0},
    states=dict.fromkeys(ANGLES, CIRCLE),
)
"""Phase oscillators: locked, all turn at the mean of their frequencies."""


def oscillators(*rates):
    """Return oscillators without coupling, each with a limit cycle of radius 1: a torus of as many dimensions."""
    equations = {}
    for i, w in enumerate(rates):
        equations |= {
            f"x{i}": f"x{i}*(1 - x{i}**2 - y{i}**2) - {w}*y{i}",
            f"y{i}": f"y{i}*(1 - x{i}**2 - y{i}**2) + {w}*x{i}",
        }
    return table(f"oscillators{len(rates)}", equations, {"a": 1.0})


RATES = (1.0, float(np.sqrt(2.0)), float(np.sqrt(5.0) - 1.0))

HELD = table("held", {**oscillators(1.0)["equations"], "s": "0*s"}, {"a": 1.0})
"""A parameter written as a state: a limit cycle for each value of it."""

THREE_FATES = table("three_fates", {"x": "s*(y - x)", "y": "-x*z - y", "z": "x*y + 0.6*z"}, {"s": 0.125})
"""Lorenz with r = 0, b = -.6: two limit cycles, each the mirror image of the other."""


def three_fates(_, u):
    x, y, z = u
    return [0.125 * (y - x), -x * z - y, x * y + 0.6 * z]


PREY = table("prey", {"x": "x*(a - y)", "y": "y*(x - a)"}, {"a": 1.0})
"""Lotka and Volterra: closed orbits around a centre, and a volume that is preserved in logarithms only."""

PENDULUM = table("free_pendulum", {"x": "v", "v": "-w**2*sin(x)"}, {"w": 1.0}, states={"x": CIRCLE})


def found_of(equations, starts, **options):
    """Integrate cells of one parameter point, and find their sets."""
    return identify(flow_cube(equations, starts, **options))


# ---- turning is not resting --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("equations", "states", "is_rest"),
    [
        (UNIFORM_ANGLE, [[1.0, 0.3]], False),
        (KURAMOTO, [[0.0, 0.1, -0.1]], False),
        ({**UNIFORM_ANGLE, "equations": {"r": "r*(1-r**2)", "th": "w*(1-r)"}}, [[1.0, 0.3]], True),
        ({**UNIFORM_ANGLE, "equations": {"r": "-r**3", "th": "-w*sin(th)"}}, [[1e-3, 0.0]], True),
    ],
    ids=["clock", "locked", "line of equilibria", "degenerate"],
)
def test_find_equilibria__every_rate_vanishes(equations, states, is_rest):
    """The Jacobian of each is singular, so that a short Newton step proves nothing."""
    parameters = load_model(equations).load()
    found = find_equilibria(parameters.model.system, np.array(states), parameters.pack(), max_iterations=100)
    assert found.converged.tolist() == [is_rest]


@pytest.mark.parametrize("strobed", [False, True])
@pytest.mark.parametrize(
    ("equations", "starts", "of", "seconds", "multiplier"),
    [
        (UNIFORM_ANGLE, [[0.5, 1.0], [1.5, 2.0], [0.2, 0.0]], "th", 2.0 * np.pi, np.exp(-4.0 * np.pi)),
        (IDLE_CLOCK, [[0.5, 1.0, 0.3], [1.5, -2.0, 1.0]], "th", 2.0 * np.pi / 1.3, np.exp(-0.2 * np.pi / 1.3)),
        (KURAMOTO, [[0.0, 1.0, 2.0], [3.0, 1.0, 0.5]], "a", 2.0 * np.pi, None),
    ],
    ids=["angle", "clock", "locked"],
)
def test_identify__a_steady_rotation_is_a_limit_cycle(equations, starts, of, seconds, multiplier, strobed):
    """At crossings and at even times; never at rest."""
    section = {"frequency_hz": 0.37} if strobed else {"crossing": Crossing(of, 0.0, longest=50.0)}
    found = found_of(equations, starts, **section)
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT]
    assert found["stability"].values.tolist() == [ATTRACTS]
    assert float(found["period_s"][0]) == pytest.approx(seconds, rel=1e-9)
    own = np.hypot(found["multiplier_real"], found["multiplier_imag"]).values[0]
    if multiplier is not None:
        assert own[1 if strobed else 0] == pytest.approx(multiplier, rel=1e-6)
        assert not strobed or own[0] == 1.0


@pytest.mark.slow
def test_attractors__of_a_run_that_sees_a_turning_angle_at_instants(computed):
    """At the default tolerance the crossings of the cycle's level were lost, and the analysis ended in an error."""
    starts = [[0.5, 1.0], [1.5, 2.0], [0.2, 0.0]]
    run = sweep(UNIFORM_ANGLE, starts, frequency_hz=0.3, lengths=(200, 16), tolerance=1e-8)
    found = derive(computed(run), "attractors")
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT]
    assert found["stability"].values.tolist() == [ATTRACTS]
    assert float(found["period_s"][0]) == pytest.approx(2.0 * np.pi, rel=1e-9)
    assert found["n_cells"].values.tolist() == [3]


def test_identify__a_curve_has_one_id_at_any_phase():
    """A cycle of multiplier .64 that cells reach after the run, and its mirror image: scipy goes through all points."""
    rng = np.random.default_rng(0)
    starts = np.array([-2.1338, -1.0636, 5.9469]) + rng.uniform(-0.3, 0.3, (12, 3))
    both = np.concatenate([starts, starts * [-1.0, -1.0, 1.0]])
    found = found_of(THREE_FATES, rng.permutation(both), frequency_hz=0.5, n_transient=60)
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT] * 2
    is_bounded = np.isin(found["status"], (Status.PERIODIC, Status.BOUNDED))  # the others diverge
    assert found["n_cells"].values.tolist() == [is_bounded.sum() / 2] * 2
    seconds = found["period_s"].values
    assert np.ptp(seconds) <= 1e-6
    for k in range(2):
        own, other = found["attractor_points"].values[[k, 1 - k]]
        own, other = own[np.isfinite(own).all(axis=1)][::97], other[np.isfinite(other).all(axis=1)]
        flow = solve_ivp(three_fates, (0.0, seconds[k]), own[0], rtol=1e-10, atol=1e-10, dense_output=True)
        curve = cKDTree(flow.sol(np.linspace(0.0, seconds[k], 40_000)).T)
        assert curve.query(own)[0].max() <= 2e-2
        assert curve.query(other)[0].max() > 1.0


# ---- a multiplier of 1 is not attraction -------------------------------------------------------


STROBED, CROSSED = {"frequency_hz": 0.3}, {"crossing": Crossing("x0", 0.0, longest=50.0)}


@pytest.mark.parametrize(
    ("rates", "n", "section"), [((1.0, 1.0), 1, CROSSED), ((1.0, 1.0), 4, STROBED), (RATES, 4, CROSSED)]
)
def test_identify__oscillators_without_coupling_are_one_torus(rates, n, section):
    """Of equal rates each trajectory is closed, and neutral; otherwise it fills the torus. There is one torus."""
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, (n, 2 * len(rates)))
    found = found_of(oscillators(*rates), starts, **section)
    assert found["kind"].values.tolist() == [TORUS]
    assert found["stability"].values.tolist() == [ATTRACTS]
    assert found["dimension"].values.tolist() == [len(rates)]
    assert found["n_cells"].values.tolist() == [n]


def test_identify__tori_that_turn_against_each_other_are_two():
    """The ranges of all states are equal, and so are the exponents: x**2 + y**2 = 1 in both."""
    own = oscillators(1.0, 1.0)
    turn = {"z": "z*(1 - z**2)"}
    equations = {k: v.replace("1.0*", "z*") if k in ("x0", "y0") else v for k, v in own["equations"].items()}
    starts = np.random.default_rng(1).uniform(-1.5, 1.5, (4, 5))
    starts[:, 4] = [0.4, -0.4, 0.7, -0.7]
    found = found_of(table("turning", {**equations, **turn}, {"a": 1.0}), starts, frequency_hz=0.3)
    assert found["kind"].values.tolist() == [TORUS] * 2
    assert found["dimension"].values.tolist() == [2] * 2
    ids = found["attractor_id"].values
    assert ids[0] == ids[2] != ids[1] == ids[3]


@pytest.mark.parametrize("strobed", [False, True])
@pytest.mark.parametrize(
    ("equations", "of", "level", "starts"),
    [
        (HELD, "x0", 0.0, [[0.5, 0.2, 0.1], [1.2, 0.3, -0.8]]),
        (PREY, "x", 1.0, [[0.4, 0.9], [1.1, 1.7], [0.9, 0.3]]),
        (PENDULUM, "v", 0.0, [[1.0, 0.0], [2.0, 0.3], [0.0, 2.5]]),
    ],
    ids=["parameter as a state", "prey", "pendulum"],
)
def test_identify__a_family_of_orbits_does_not_attract(equations, of, level, starts, strobed):
    """No neighbour comes nearer, and neighbours differ in amplitude."""
    section = {"frequency_hz": 0.37} if strobed else {"crossing": Crossing(of, level, longest=50.0)}
    found = found_of(equations, starts, **section)
    assert set(found["stability"].values.tolist()) == {NEUTRAL}
    assert TORUS not in found["kind"]


# ---- one cell proves little --------------------------------------------------------------------


def extended(slope, start, seen, budget):
    """What the extension makes of the only cell of a tent map, of which a share of 2/slope stays at every step."""
    point = MapPoint(*tent(slope), np.array([[start]]), seen)
    return settle(point, [FIXED], budget=budget, seen=seen, scale=1.0 / 0.3, n_sample=24)


def long_lived(slope, least):
    """Return a start whose trajectory stays for `least` steps at least."""
    step, _ = tent(slope)
    for start in np.random.default_rng(0).uniform(0.0, 1.0, 400):
        x = np.array([[start]])
        for _ in range(least):
            x = step(x)
        if x[0, 0] <= 1.0:
            return start
    raise AssertionError("no start stays")


def test_extend__one_long_life_is_no_attraction():
    """The cell stays for six mean lifetimes of 401, longer than the bound asks; its neighbours do not."""
    slope = 2.005
    found = extended(slope, long_lived(slope, 1600), 100, 1.0)
    (one,) = [one for one in found.sets if one.n_sampled]
    assert one.stability == TRANSIENT
    assert one.n_left >= 4


def test_extend__neighbours_of_one_cell_show_that_a_set_attracts():
    """They stay for ten times the run, each; a tenth of the budget shows too little, more of it more."""
    least = [0.0, 0.0, 0.0]
    for i, budget in enumerate((0.1, 1.0, 2.0)):
        found = extended(1.9, 0.3, 2000, budget)
        (one,) = found.sets
        assert one.kind == CHAOTIC_SET or budget < 1.0
        assert one.stability == (NOT_SETTLED if budget < 1.0 else ATTRACTS)
        assert found.ran_out == (budget < 1.0)
        assert one.cells.tolist() == [0] * one.n_sampled
        least[i] = one.time_at_risk
    assert least[1] >= 8 * 10 * 2000
    assert least[2] >= 2 * least[1]


# ---- every analysis ends in a table or in a sentence -------------------------------------------


def run_of(model, starts, folder, lengths=(50, 16), **more):
    """Run cells of a model, by default for 66 s, and return the run directory."""
    quietly(sweep(model, starts, frequency_hz=1.0, lengths=lengths, **more), folder / "run")
    return folder / "run"


CORNERS = {
    "approached for ever": ({"x": {}}, {"x": "-x**2"}, [[1.0]]),
    "all diverged": ({"x": {"escape": 5.0}}, {"x": "a*x + cos(phase)"}, [[4.0], [3.0]]),
    "all at rest": ({"x": {}, "v": {}}, {"x": "v", "v": "-a*x - v"}, [[0.0, 0.0], [0.0, 0.0]]),
    "one cell": ({"x": {}}, {"x": "-a*x + cos(phase)"}, [[0.0]]),
    "no closed cell": ({"x": CIRCLE}, {"x": "a + 0.1*sin(x) + 0.1*cos(phase)"}, [[0.0], [1.0]]),
}


SWEPT = {"axes": {"a": {"values": [0.5, 1.0]}}}


@pytest.mark.parametrize("name", CORNERS)
def test_derive__every_analysis_of_a_corner_case(name, tmp_path):
    """One state, one cell, no closed cell, all diverged, all at rest; at a point or along a parameter."""
    states, equations, starts = CORNERS[name]
    axes = SWEPT if list(CORNERS).index(name) % 2 else {}
    directory = run_of(table("corner", equations, {"a": 1.0}, states=states), starts, tmp_path, **axes)
    shown = []
    for analysis in ANALYSES:
        try:
            found = derive(directory, analysis)
        except SpecError:  # a sentence: the analysis needs an option, or another kind of run
            continue
        if ANALYSES[analysis].table:
            assert shown_table(analysis, found).lines, analysis
            shown.append(analysis)
    assert {"attractors", "basins", "settling", "chaos"} <= set(shown)


# ---- ghosts and half-stable points -------------------------------------------------------------


def found_at(equations, starts, folder, lengths=(50, 16)):
    """Return kind, stability and evidence of each set, and the set of each cell."""
    model = table("point", equations, {"a": 1.0}, states={name: {"escape": 10.0} for name in equations})
    found = dense(derive(run_of(model, starts, folder, lengths), "attractors"), points=True)
    sets = zip(*(found[name].values.tolist() for name in ("kind", "stability", "evidence")), strict=True)
    return list(sets), found["attractor_id"].values.tolist()


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_attractors__half_stable_point(turned, tmp_path):
    """x' = x**2 beside y' = -y + x/2: 0 is the only equilibrium, approached along its centre manifold from x < 0 and
    left for x > 0; exactly, x = 1/(1/x0 - t).
    """
    rates = {"x": f"{turned}*x**2", "y": "-y + 0.5*x"}
    starts = [[-turned, 0.5], [-0.2 * turned, -0.5], [0.012 * turned, 0.006 * turned], [turned, 0.0]]
    sets, ids = found_at(rates, starts, tmp_path, lengths=(500, 16))
    assert sets[0] == (EQUILIBRIUM, UNSTABLE, BY_ONE_SIDE)
    assert ids[:2] == [0, 0]
    assert ids[2] != 0
    assert ids[3] == -1


def test_attractors__ghost_of_a_fold(tmp_path):
    """x' = e + x**2 has no equilibrium and no orbit; from 0 it takes pi/(2 sqrt(e)) = 5e4 s to leave."""
    sets, ids = found_at({"x": "1e-9 + x**2"}, [[-1.0], [-0.01], [0.0]], tmp_path)
    assert {(kind, stability) for kind, stability, _ in sets} == {(BOUNDED_SET, NOT_SETTLED)}
    assert -1 not in ids
