"""What a system declares wrongly is an error by name, before anything is compiled."""

import dataclasses
import importlib
import math

import numpy as np
import pytest

from magpend_core import accelerations, load_preset, lyapunov_exponents, polish_orbits, run_branches, trajectory
from magpend_core.engine import checks, entry
from magpend_core.engine import vecmath as elementary
from magpend_core.engine.checks import SystemCheckError, check_system
from magpend_core.engine.jit import inline
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System
from magpend_core.engine.variational import with_tangents
from magpend_core.engine.vecmath import TWO_PI, sincos
from magpend_core.models import load_model, model_names
from tests.core.flows import model_of, table

FREQUENCY = 0.16
DUFFING = [0.15, -1.0, 1.0, 0.2]


def found(system, parameters=DUFFING, frequency=FREQUENCY, states=((0.3, 0.2),), tangents=False):
    """Problems that a system has."""
    packed = np.atleast_2d(np.array(parameters, float))
    frequencies = np.broadcast_to(np.asarray(frequency, float), len(packed))
    start = np.array(states, float)
    if tangents:
        system = with_tangents(system, system.n_states)
        start = np.concatenate([start, np.ones((len(start), system.n_states - start.shape[1]))], axis=1)
    try:
        check_system(system, packed, frequencies, start)
    except SystemCheckError as error:
        return error.problems
    return []


@pytest.fixture
def broken(duffing):
    """The oscillator with some fields replaced."""

    def replaced(**changes):
        return dataclasses.replace(duffing, name="broken", **changes)

    return replaced


def test_check_system__finds_nothing_in_what_is_right(duffing, oscillator):
    assert found(duffing) == []
    assert found(duffing, tangents=True) == []
    six = [[0.3, 0.2, 1.0, 0.0, 0.0, 1.0]]
    assert found(oscillator, states=six) == []  # its Jacobian is not used


@pytest.mark.slow
@pytest.mark.parametrize("name", model_names())
def test_check_system__finds_nothing_in_the_models_that_ship(name):
    model, rng = load_model(name), np.random.default_rng(3)
    system, n = model.system, len(model.states)
    for _ in range(20):
        checks._CHECKED.clear()
        parameters = model.load().pack() * np.exp(rng.uniform(-0.2, 0.2, len(model.parameters)))
        starts = rng.uniform(-2.0, 2.0, (4, n)) * np.array(model.scales)
        assert found(system, parameters, 10.0 ** rng.uniform(-1.0, 1.0), starts, tangents=True) == []


@inline
def _three_rates(y, u, c):
    return y[1], u - c[0] * y[1], 0.0 * u


@inline
def _too_few_constants(frequency, p, out):
    for i in range(4):
        out[i] = p[i]


@inline
def _beyond_parameters(frequency, p, out):
    for i in range(5):
        out[i] = p[i]


@inline
def _infinite_constant(frequency, p, out):
    for i in range(4):
        out[i] = 1.0 / (p[3] - 0.7)
    out[4] = TWO_PI * frequency


def test_check_system__looks_at_extreme_parameters_wherever_they_are(broken):
    system = broken(constants=_infinite_constant)
    swept = np.tile(DUFFING, (5, 1))
    assert found(system, swept) == []
    swept[3, 3] = 0.7
    (problem,) = found(system, swept)
    assert "number 0 is inf" in problem


@inline
def _wrong_slope(y, u, c):
    zero = 0.0 * y[0]
    return (zero, zero + 1.0, -c[1] - 2.9 * c[2] * y[0] * y[0], zero - c[0])


@pytest.mark.parametrize(
    ("jacobian", "words"),
    [
        (_wrong_slope, "jacobian: entry 2, the derivative of the rate of v by x, is"),
        (inline(lambda y, u, c: (c[0], c[1], c[2])), "jacobian returns 3 numbers; it must return a tuple of 4"),
        (None, "jacobian is missing"),
    ],
)
def test_check_system__jacobian(broken, jacobian, words):
    system = broken(jacobian=jacobian)
    assert found(system) == []  # nobody asks for it
    (problem,) = found(system, tangents=True)
    assert problem.startswith(words)


@pytest.mark.parametrize(
    "door",
    [
        lambda p, f, y, system: lyapunov_exponents(p, f, y, system=system),
        lambda p, f, y, system: polish_orbits(p, f, y, np.array([1]), system=system),
    ],
)
def test_check_system__jacobian_is_held_against_differences_at_the_doors(broken, door):
    system = broken(jacobian=_wrong_slope)
    arguments = np.array([DUFFING]), np.array([FREQUENCY]), np.array([[0.3, 0.2]])
    with pytest.raises(SystemCheckError, match="entry 2"):
        door(*arguments, system)


def test_check_system__jacobian_is_not_compared_where_exponentials_are_cut_off():
    """States sampled 10,000 beside a start at 14,000: exp(x - 14000) is cut off there, and its differences are 0."""
    model = model_of({"x": "v", "v": "1 - exp(x - 14000) - d*v"}, {"d": 0.2})
    system = dataclasses.replace(model.system, units=(1e4, 100.0))
    assert found(system, [0.2], 1.0, ((14000.0, 0.0),), tangents=True) == []


@inline
def _two_quantities(t, y, dy, u, c):
    return y[0], t * u


@inline
def _pendulum_rhs(y, u, c):
    return y[1], u - c[0] * y[1] - sincos(y[0])[0]


def rates(function):
    return {"rhs": inline(function)}


def layers(function):
    return {"layers": inline(function), "has_layers": True}


def forcing(function):
    return {"forcing": inline(function)}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rhs": _three_rates}, "rhs returns 3 numbers"),
        (rates(lambda y, u, c: y[1]), "rhs returns a ndarray"),
        (rates(lambda y, u, c: (y[1], y[2])), "rhs fails: IndexError"),
        (rates(lambda y, u, c: (y[1], elementary.log(-1.0 - y[0] * y[0]))), "rhs is finite at none of 16 states"),
        ({"constants": _too_few_constants}, "number 4 is nan"),
        ({"constants": _beyond_parameters}, "constants fails: IndexError"),
        ({"is_angle": (True, False)}, "is_angle: x is declared an angle, but the rate of v"),
        ({"is_angle": (True, False), "rhs": _pendulum_rhs}, None),
        (layers(lambda y, dy, c: ((y[0], dy[0], 0.0 * y[0], c[0]),)), "layers: half_width of layer 0"),
        (layers(lambda y, dy, c: ((y[0], dy[0], c[0]),)), "layers must return a tuple of tuples"),
        (layers(lambda y, dy, c: ()), "layers returns none"),
        (forcing(lambda t, c: c[3] * sincos(2.5 * c[4] * t)[1]), "forcing is 0.2 at time 0 and -0.2 at 1/frequency"),
        (forcing(lambda t, c: sincos(c[4] * t)), "forcing returns a tuple"),
        ({"quantities": _two_quantities, "quantity_names": ("a", "b")}, None),
        ({"quantities": _two_quantities, "quantity_names": ("a",)}, "quantities returns 2 numbers"),
        ({"quantity_names": ("a",)}, "quantities is missing"),
    ],
)
def test_check_system__names_what_is_wrong(broken, changes, words):
    problems = found(broken(**changes), states=((0.3, 0.2), (400.0, 3.0)))
    assert any(words in problem for problem in problems) if words else not problems


@inline
def _edges_by_parameters(frequency, p, times, half_widths, jumps):
    times[0], times[1] = p[0] / frequency, p[1] / frequency
    for i in range(2):
        half_widths[i], jumps[i] = p[2], p[3]


@pytest.mark.parametrize(
    ("edges", "parameters", "words"),
    [
        (
            inline(lambda frequency, p, *out: None),
            DUFFING,
            "edges: time 0 is nan s at frequency_hz = 0.16; it must be in [0, 6.25) s",
        ),
        (_edges_by_parameters, [0.0, 1.0, 1.0, 1.0], "edges: time 1 is 6.25 s"),
        (_edges_by_parameters, [-0.1, 0.5, 1.0, 1.0], "edges: time 0 is -0.625 s"),
        (_edges_by_parameters, [0.5, 0.2, 1.0, 1.0], "edges: the times [3.125, 1.25] s"),
        (_edges_by_parameters, [0.2, 0.2, 1.0, 1.0], "edges: the times [1.25, 1.25] s"),
        (_edges_by_parameters, [0.2, 0.5, 0.0, 1.0], "edges: half-width 0 is 0 s"),
        (_edges_by_parameters, [0.2, 0.5, 1.0, -1.0], "edges: jump 0 is -1"),
    ],
)
def test_check_system__edges(broken, edges, parameters, words):
    problems = found(broken(n_edges=2, edges=edges), parameters)
    assert problems[0].startswith(words)


def test_check_system__edges_again_where_parameters_go_beyond(broken):
    system = broken(n_edges=2, edges=_edges_by_parameters)
    good, bad = [0.0, 0.5, 1.0, 0.1], [0.0, 1.5, 1.0, 0.1]
    assert found(system, [good, good]) == []
    assert found(system, [good, bad])[0].startswith("edges: time 1 is 9.375 s")
    assert found(system, [good]) == []


def test_check_system__names_all_problems_of_the_fields_at_once(broken):
    system = broken(
        is_angle=(True,),
        scales=(0.0, math.inf, 1.0),
        escape=(1.0,),
        n_controlled=3,
        parameter_names=("a", "a", "b", "c"),
        n_edges=-1,
    )
    starts = (
        "is_angle has 1 entries; it must have one for each of the 2 states (x, v)",
        "scales has 3 entries",
        "escape has 1 entries",
        "scales: 0.0 for x is out of bounds",
        "scales: inf for v",
        "parameter_names has 'a' twice",
        "n_edges = -1",
        "n_controlled = 3",
    )
    problems = found(system)
    assert len(problems) == len(starts)
    assert all(problem.startswith(start) for problem, start in zip(problems, starts, strict=True))


@pytest.mark.slow
def test_check_system__comes_before_compiling_and_runs_once(monkeypatch, broken):
    calls = []

    def rhs(y, u, c):
        calls.append(1)
        return _pendulum_rhs(y, u, c)

    @inline
    def constants(frequency, p, out):
        out[0] = p[0]

    system = System(
        name="counted",
        state_names=("a", "v"),
        is_angle=(True, False),
        parameter_names=("damping",),
        n_constants=1,
        constants=constants,
        rhs=inline(rhs),
    )
    before = list(getattr(_pendulum_rhs, "signatures", []))
    assert found(system, [0.1]) == []
    n = len(calls)
    assert n > 0
    assert found(system, [0.1]) == []
    assert len(calls) == n
    # without the compiler there are no signatures at all
    assert list(getattr(system.rhs, "signatures", [])) == []
    assert list(getattr(_pendulum_rhs, "signatures", [])) == before
    asked = []
    module = importlib.import_module("magpend_core.sampling")
    monkeypatch.setattr(module, "check_system", lambda *a: asked.append(a[0].name))
    trajectory(load_preset(), 2.2, [0.1, 0.0, 0.0, 0.0], [0.1])
    assert asked == ["pendulum_fitted"]
    monkeypatch.setattr(entry, "engine_of", None)
    with pytest.raises(SystemCheckError, match="cannot be integrated:\n- rhs returns 3"):
        run_branches(
            np.array([[DUFFING]]),
            np.array([[FREQUENCY]]),
            np.zeros((1, 2)),
            system=broken(rhs=_three_rates),
            n_transient=0,
            n_keep=1,
            rtol=1e-6,
            atol=1e-6,
        )


def test_plain__goes_down_to_modules_closures_and_itself():
    factor = inline(lambda x: 3.0 * x)

    @inline
    def nested(x):
        return factor(elementary.sin(x)) + sum(factor(k) for k in range(3))

    function = plain(nested)
    values = np.array([0.1, 0.2, 0.3])
    assert function(values) == pytest.approx(3.0 * np.sin(values) + 9.0)
    assert plain(math.sin) is math.sin
    assert accelerations is plain(accelerations)


def test_check_system__names_the_difference_of_angles_that_turn_together():
    def problems(rates):
        states = {name: {"on_circle": True} for name in rates}
        system = load_model(table("turning", rates, states=states)).system
        return found(system, [[]], 1.0, np.linspace(0.3, 0.9, len(rates))[None])

    told = problems({"a": "1 - 0.3*(a - b)", "b": "1.3 + 0.3*(a - b)", "c": "sin(c - a) + sin(b)"})
    assert len(told) == 4  # two rates of each
    assert all("take their difference as a state" in line for line in told)
    # alone it may not turn either, and nothing turns with it
    told = problems({"a": "-a", "b": "sin(a)"})
    assert told
    assert not any("difference" in line for line in told)
