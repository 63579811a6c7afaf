"""Models from Python functions: the equations are those of the same text, and their motions those of the function."""

import functools
import math
import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

import magpend
from magpend_core.models import ModelError
from magpend_core.models.text.functions import read_function
from magpend_core.models.text.numeric import rates_of
from magpend_core.models.text.tracing import RULES
from pipeline.layout.plan import make_plan
from pipeline.specification.spec import Spec


def duffing(t, y, p):
    x, v = y
    drive = p.A * np.cos(p.omega * t)
    return [v, -p.d * v + x - x**3 + drive]


def lorenz(t, y, sigma, rho, beta):
    x, y, z = y
    return sigma * (y - x), x * (rho - z) - y, x * y - beta * z


def double_pendulum(t, y, p):
    """With its mass matrix, by the functions of math."""
    m1, m2, l1, l2, g = p
    th1, th2, w1, w2 = y
    c, s = np.cos(th1 - th2), np.sin(th1 - th2)
    mass = np.array([[(m1 + m2) * l1**2, m2 * l1 * l2 * c], [m2 * l1 * l2 * c, m2 * l2**2]])
    force = np.zeros(2)
    force[0] = -m2 * l1 * l2 * w2**2 * s - (m1 + m2) * g * l1 * np.sin(th1)
    force[1] = m2 * l1 * l2 * w1**2 * s - m2 * g * l2 * np.sin(th2)
    return np.hstack([w1, w2, np.linalg.solve(mass, force)])


N = 8


def springs(stretch, p):
    return p["k"] * stretch + p["k3"] * stretch**3


def chain(t, y, p):
    """A chain of masses between two walls, in numpy's vectors; the first is driven."""
    x, v = y.reshape(2, N)
    force = springs(np.diff(np.concatenate(([0.0], x, [0.0]))), p)
    rates = np.zeros_like(y)
    rates[:N] = v
    rates[N:] = np.diff(force) - p["c"] * v
    rates[N] += p["A"] * np.cos(2 * np.pi * p["f"] * t)
    return rates


STIFFNESS = 2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)


def matrix(t, y, p):
    return np.concatenate([y[3:], -STIFFNESS @ y[:3] - p.c * y[3:] * np.sum(y[:3] ** 2)])


MODELS = {
    "duffing": (duffing, "x v", {"d": 0.2, "A": 0.3, "omega": 1.2}, "omega", 1.2 / (2 * math.pi)),
    "lorenz": (lorenz, "x y z", {"sigma": 10.0, "rho": 28.0, "beta": 8 / 3}, None, 1.0),
    "double pendulum": (
        double_pendulum,
        "th1 th2 w1 w2",
        {"m1": 1.0, "m2": 0.5, "l1": 1.0, "l2": 0.7, "g": 9.81},
        None,
        1.0,
    ),
    "chain": (
        chain,
        " ".join(f"{name}{i}" for name in "xv" for i in range(1, N + 1)),
        {"k": 1.0, "k3": 0.4, "c": 0.05, "A": 0.5, "f": 0.2},
        "f",
        0.2,
    ),
    "matrix": (matrix, "a b c_ da db dc", {"c": 0.1}, None, 1.0),
}


class Parameters(SimpleNamespace):
    """Parameters for scipy, by attribute, by key, and in their order."""

    def __getitem__(self, key):
        return vars(self)[key]

    def __iter__(self):
        return iter(vars(self).values())


def made(function, states, parameters, drive=None):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of angles
        return magpend.model(function, states=states.split(), parameters=parameters, drive=drive)


@pytest.mark.slow
@pytest.mark.parametrize("case", MODELS)
def test_model__moves_as_scipy_integrates_the_same_function(case):
    function, states, values, drive, frequency = MODELS[case]
    model = made(function, states, values, drive)
    start = np.random.default_rng(1).uniform(0.2, 1.0, len(model.states))
    times = np.linspace(0.0, 6.0, 13)
    args = tuple(values.values()) if function is lorenz else (Parameters(**values),)
    expected = solve_ivp(function, (0, 6), start, "DOP853", times, args=args, rtol=1e-13, atol=1e-13).y.T
    found = magpend.trajectory(model.load(), frequency, start, times, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max(), rtol=0.0)

    h, t = 1e-30, 0.7
    by_step = np.empty((len(start), len(start)))
    for j in range(len(start)):
        moved = start.astype(complex)
        moved[j] += 1j * h
        by_step[:, j] = np.imag(real_parts_too(function)(t, moved, *args)) / h
    jacobian = magpend.jacobian(t, start, model.load(), frequency)
    np.testing.assert_allclose(jacobian, by_step, atol=1e-12 * np.abs(by_step).max())


def real_parts_too(function):
    """The double pendulum's array of forces takes no complex numbers: the same function with one that does."""
    if function is not double_pendulum:
        return function
    names = {**function.__globals__, "np": SimpleNamespace(**{**vars(np), "zeros": lambda n: np.zeros(n, complex)})}
    return type(function)(function.__code__, names)


TEXT = """
x' = v
v' = -d*v + x - x**3 + drive
omega = 2*pi*f
drive = A*cos(omega*t)
"""


def test_model__is_that_of_the_same_text():
    function, states, values, drive, _ = MODELS["duffing"]
    model = made(function, states, values, drive)
    text = magpend.model(TEXT, name="duffing", d=0.2, A=0.3)
    assert model.digest == text.digest
    assert {k: v for k, v in model.reference.items() if k != "function"} == text.reference
    assert model.reference["function"].startswith("def duffing(t, y, p):\n    x, v = y\n")
    assert "def springs" in made(*MODELS["chain"][:4]).reference["function"]

    # the source is kept in the file and the run, for readers; it is no part of what a run is
    specs = [Spec("sweep", m).with_parameters(frequency_hz=0.2).with_start_grid(x=(-1, 1, 2)) for m in (model, text)]
    again = Spec.read(specs[0].toml())
    assert again.model.reference == model.reference
    assert make_plan(again).identity == make_plan(specs[1]).identity


def test_model__source_that_a_run_keeps_is_never_executed():
    table = {"name": "m", "states": {"x": "1"}, "equations": {"x": "-x"}, "function": "raise SystemExit\n1/0"}
    assert magpend.load_model(table).digest == magpend.model("x' = -x", name="m").digest
    with pytest.raises(ModelError, match="function: has 20001 characters"):
        magpend.load_model({**table, "function": "#" * 20001})


def equations(function, states="x v", drive=None, **values):
    table = made(function, states, values, drive).reference
    return {**table["equations"], **table.get("define", {})}


def test_model__takes_what_numpy_math_and_python_write():
    def f(t, y, p):
        x, v = y
        slip = v - p.v0
        stop = p.k * max(x - 1, 0) + (x < -1) * (x + 1) * p.k
        return v, -x - stop - p.mu * np.sign(slip) + np.clip(x, -0.5, 0.5)

    assert equations(f, v0=0.1, k=30.0, mu=0.2) == {
        "x": "v",
        "v": "-x - stop - mu*sign(slip) + min(max(x, -0.5), 0.5)",
        "slip": "v - v0",
        "stop": "k*max(x - 1, 0) + where(x < -1, 1, 0)*(x + 1)*k",
    }

    def g(t, y):
        x, v = y
        both = np.where((x > 0) & ~(v <= 1) | (abs(v) < 0.1), np.exp(-x), math.atan2(v, 2.0 + x**2))
        return [both, np.heaviside(v, 0.5) + math.hypot(x, 1) - 1 / (1 + v**2) ** 1.5 * x / 7e-3 * -v]

    assert equations(g) == {
        "x": "where((x > 0 and (not (v <= 1))) or abs(v) < 0.1, exp(-x), atan2(v, 2 + x**2))",
        "v": "0.5 + 0.5*sign(v) + sqrt(x**2 + 1) - 1/(1 + v**2)**1.5*x/0.007*(-v)",
    }


def square(t, y, p):
    level = np.where((2 * np.pi / p.T * t) % (2 * np.pi) < np.pi, 1.0, -1.0)
    return [level - y[0] + (t % p.T) / p.T]


def test_model__finds_what_the_drive_is_and_its_phase():
    assert equations(square, "x", "T", T=3.0) == {
        "x": "level - x + phase*T/T",
        "T": "1/f",
        "level": "where(phase*(2*pi) < pi, 1, -1)",
    }
    assert equations(lambda t, y, p: [-y[0] + math.sin(2 * math.pi * p.nu * t)], "x", "nu", nu=2.0) == {
        "x": "-x + sin(2*pi*f*t)"
    }
    # a drive without a value, and an amplitude that grows with it
    assert equations(lambda t, y, p: [-y[0] + p.w**2 * math.cos(3 * p.w * t)], "x", "w") == {
        "x": "-x + w**2*cos(3*w*t)",
        "w": "2*pi*f",
    }


@njit
def compiled(t, y, k):
    return -k * y


class Rig:
    """A rig whose rates are a method."""

    k = 3.0

    def rates(self, t, y, c):
        return [-self.k * y[0] - c * y[1], y[0]]


def test_model__takes_functions_of_all_kinds():
    assert equations(compiled, "x", k=1.0) == {"x": "-k*x"}
    assert equations(Rig().rates, c=0.1) == {"x": "-3*x - c*v", "v": "x"}
    assert equations(functools.partial(lorenz, beta=8 / 3), "x y z", sigma=1.0, rho=2.0)["z"] == f"x*y - {8 / 3}*z"
    assert equations(lambda t, y, k=2.0: -k * y, "x") == {"x": "-2*x"}


def test_model__solves_systems_and_splits_what_is_too_large():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-1, 1, (2, 4, 4))

    def solved(t, y):
        return np.linalg.solve(a + np.diag(3 + y**2), b @ y) + np.linalg.inv(a) @ y + np.linalg.det(b * y)

    def deep(t, y):
        x = y[0]
        for k in range(100):
            x = np.sin(x + k) / (1 + x**2)
        return [x - sum(np.cos(k * y[0]) for k in range(400))]

    # that the text has the values of the function is checked by `read_function`
    assert len(equations(solved, "p q r s")) > 4
    assert {"part1", "x"} < set(equations(deep, "u"))


VECTORS = {
    "max": lambda t, y: y * np.max(y) + max(y[0], 0.2),
    "mean": lambda t, y: y - np.mean(y) + np.std(y) ** 2,
    "prod": lambda t, y: np.cumsum(y) * np.prod(y),
    "einsum": lambda t, y: np.einsum("ij,j->i", np.eye(3), y) * np.einsum("i,i", y, y),
    "outer": lambda t, y: np.outer(y, y)[0] + np.kron(y, [1.0]),
    "cross": lambda t, y: np.cross([y[0], y[1], 1.0], [1.0, 2.0, y[2]]),
    "norm": lambda t, y: y / np.linalg.norm(y) + np.vdot(y, y) + np.trace(np.diag(y)),
    "polyval": lambda t, y: np.polyval([1.0, 2.0, 3.0], y) + np.polyval([0.5, 0.1], y[0]),
    "interp": lambda t, y: np.interp(y, [-0.5, 0.0, 0.7], [1.0, 0.0, 3.0]) + np.interp(y[0], [0.0, 1.0], [0.0, 2.0]),
    "piecewise": lambda t, y: np.piecewise(y, [y < 0, y >= 0], [lambda x: -x, lambda x: x**2]),
    "select": lambda t, y: np.select([y < -0.2, y > 0.2], [y + 0.2, y - 0.2], 0.0),
    "vectorize": lambda t, y: np.vectorize(lambda a: a**2)(y),
    "gradient": lambda t, y: np.gradient(y) + np.convolve(y, [1.0, 2.0, 1.0], "same"),
    "block": lambda t, y: np.block([[np.zeros((1, 3))], [np.ones((2, 3))]]).dot(y) + np.array([y[1], 0.0, 1.0]),
    "types": lambda t, y: y.astype(float) + np.zeros(3, dtype=float) + np.asarray(y, dtype=float).copy(),
    "indices": lambda t, y: y[[2, 0, 1]][::-1] * np.tile(y[:1], 3) + np.repeat(y[1], 3) + np.full(3, y[2]),
    "stack": lambda t, y: np.sum([y, np.roll(y, 1)], axis=0) + np.column_stack([y, y])[:, 1] + np.append(y[:2], 1.0),
}


@pytest.mark.parametrize("what", VECTORS)
def test_model__follows_vectors(what):
    """`read_function` compares the text with the function; here its text is compared once more, at other states."""
    function = VECTORS[what]
    model = made(function, "a b c_", {})
    for state in np.random.default_rng(2).uniform(-1.0, 1.0, (5, 3)):
        known = {"a": state[0], "b": state[1], "c_": state[2], "pi": math.pi, "t": 0.0, "f": 1.0, "phase": 0.0}
        found = rates_of(model.definition, known)
        np.testing.assert_allclose(list(found.values()), function(0.0, state), rtol=1e-12, atol=1e-12)


def test_model__text_has_the_rules_of_numpy():
    """Each rule against numpy's own function: a text whose rates differ from the function's is refused."""
    binary = {name for name in RULES if getattr(getattr(np, name), "nin", 3) == 2}
    skipped = {"equal", "not_equal", *(n for n in RULES if n.startswith(("logical", "bitwise")))}
    for name in RULES.keys() - skipped - {"invert"}:
        ufunc = getattr(np, name)
        if name == "clip":
            made(lambda t, y: np.array([y[0], y[1]]).clip(0.2, 0.5), "x v", {})
        elif name in binary:
            made(lambda t, y, u=ufunc: [u(y[0], 0.4 + y[1] ** 2) * 1.0, y[0] * u(np.array([y[1]]), 1.0)[0]], "x v", {})
        else:
            made(lambda t, y, u=ufunc: [u(0.9 * np.sin(y[0])) * 1.0, u(y[:1] ** 2)[0]], "x v", {})


def test_model__follows_both_ways_of_an_if():
    def f(t, y, p):
        x, v = y
        slip = v - p.v0
        if slip > 0:
            force = -p.mu
        elif slip < 0:
            force = p.mu
        else:
            force = 0
        if x > 1:
            force -= p.k * (x - 1)
        return [v, -x + force] if 0 < p.k < 10 else [v, 2 * p.mu]

    assert equations(f, v0=0.1, mu=0.2, k=2.0) == {
        "x": "v",
        "v": "where(k > 0, where(k < 10, -x + where(x > 1, -k*(x - 1), 0) + "
        "where(slip > 0, -mu, where(slip < 0, mu, 0)), 2*mu), 2*mu)",
        "slip": "v - v0",
    }
    assert equations(lambda t, y, p: [y[1], p.a * y[0] if y[0] > 0 else p.b * y[1]], a=1.0, b=2.0) == {
        "x": "v",
        "v": "where(x > 0, a*x, b*v)",
    }
    # a decision that changes nothing leaves no trace, and one that is taken twice is one
    assert equations(lambda t, y: [y[1], 1 if y[0] > 0 and not y[0] > 0 else y[1]]) == {"x": "v", "v": "v"}


def too_many(t, y):
    return [sum(y[0] if y[0] > k else y[1] for k in range(20)), 0.0]


def settles(t, y):
    x = y[0]
    while x > 1e-3:
        x = x / 2
    return [x, y[1]]


count = iter(range(10**6))


@pytest.mark.parametrize(
    ("function", "given", "words"),
    [
        (too_many, {}, r"the decisions .* more than 64 ways .*np.where\(condition, a, b\)"),
        (settles, {}, r"line \d+, `while x > 1e-3:`: the decisions"),
        (lambda t, y: [y[1], np.arcsinh(y[0])], {}, r"np.arcsinh has no equivalent ; use sqrt,"),
        (lambda t, y: [y[1], int(y[0])], {}, "a plain number is needed"),
        (lambda t, y, p: [y[1], sum(range(p.n))], {"n": 3}, "constant of the program"),
        (lambda t, y: [y[1], np.round(y[0])], {}, r"np.rint has no equivalent .* floor, ceil"),
        (lambda t, y: [y[1], y[0] == 0], {}, "compare with < or >"),
        (lambda t, y: [y[1], (2j * y[0]).real], {}, r"line \d+, `.*: 2j is no real number; .* as two states x and y"),
        (lambda t, y: [y[1], complex(y[0], y[1]).real], {}, r"line \d+, `.*: a complex number is made here; .* as two"),
        (lambda t, y: [y[1], next(count) + y[0]], {}, "depend on its arguments alone"),
        (lambda t, y: [y[1]], {}, "returns 1 rates; .* 2 states, x, v"),
        (lambda t, y: [y, y], {}, "an array within its result"),
        (lambda y: y, {}, r"def f\(t, y, p\)"),
        (lambda t, y, p: [y[1], p.gama], {"gamma": 1.0}, "'gama' is no parameter; did you mean gamma"),
        (lambda t, y, kk, c: [y[1], kk], {"k": 1.0, "c": 1.0}, "argument kk is no parameter; did you mean k"),
        (lambda t, y: [y[1], y[7]], {}, "fails at t = 0, x = .*IndexError"),
        (duffing, {"d": 0.1, "A": 1.0, "omega": 2.0}, 'drive="omega" .*2 pi/omega'),
        (lambda t, y: [y[1], np.cos(t)], {}, "depends on t: .* must be the angular frequency"),
        (lambda t, y, p: [y[1], p.k], {"k": 1.0, "drive": "k"}, "k drives nothing"),
        (
            lambda t, y, p: [y[1], np.cos(p.w * t) + np.cos(1.1 * p.w * t)],
            {"w": 1.0, "drive": "w"},
            "neither of 2 pi/w, 1/w, w",
        ),
        (lambda t, y, p: [y[1], p.t], {"t": 1.0}, "parameters.t: has a meaning of its own"),
    ],
)
def test_model__refuses_in_words(function, given, words):
    values = dict(given)
    with pytest.raises(ModelError) as caught:
        made(function, "x v", values, values.pop("drive", None))
    assert re.search(words, str(caught.value)), caught.value


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"states": 40}, "states = 40: must be names, in the order of y"),
        ({}, "states: name the states of the function"),
        ({"states": ("x",), "parameters": 4}, "parameters = 4: must be values by name"),
    ],
)
def test_model__of_a_function_refuses_other_tables_in_words(tables, words):
    with pytest.raises(ModelError, match=words):
        read_function(lambda t, y: [-y[0]], tables, {})


def test_model__drive_belongs_to_functions():
    with pytest.raises(ModelError, match=r'in the order of y: states=\("x", "v"\)'):
        magpend.model(duffing)
    with pytest.raises(magpend.SpecError, match="parameter of a function"):
        magpend.model("x' = -x", drive="omega")


def test_model__a_parameter_may_be_called_as_the_argument():
    """A function's one argument p is a parameter of this name, or all parameters, as the function uses it."""

    def all_of_them(t, y, p):
        return [y[1], -p.a * y[0] - p.p * y[1]]

    def in_order(t, y, p):
        a, b = p
        return [y[1], -a * y[0] - b * y[1]]

    assert equations(all_of_them, a=1.0, p=0.2)["v"] == "-a*x - p*v"
    assert equations(in_order, p=1.0, a=0.2)["v"] == "-p*x - a*v"
    assert equations(lambda t, y, p: [y[1], -p * y[0]], p=0.2)["v"] == "-p*x"
    assert equations(lambda t, y, f, p: [y[1], -p * y[0] + f], p=0.2, f=1.0)["v"] == "-p*x + f"
    with pytest.raises(ModelError, match="'b' is no parameter"):
        equations(lambda t, y, p: [y[1], p.b], a=1.0, p=0.2)
