"""What is derived from a text, each against something that shares no code with it."""

import contextlib
import itertools
import math
import time

import mpmath
import numpy as np
import pytest
import sympy
from hypothesis import example, given, reject
from hypothesis import strategies as st

from magpend_core import evaluate, sections
from magpend_core.engine.plain_python import plain
from magpend_core.expressions import graph
from magpend_core.models import ModelError
from magpend_core.models.text.grammar import FUNCTIONS, parse
from magpend_core.models.text.numeric import value_of
from tests.core.flows import model_of

FREQUENCY = 0.7


def model_with_value(text):
    """A model of a drawn text, if numpy has something to compare with."""
    model = model_of({"x": "v", "v": text}, PARAMETERS)
    try:
        at(model, (0.1, 0.2))
    except ZeroDivisionError:  # compiled code has infinity there, plain Python nothing
        reject()
    return model


def parts(tree):
    yield tree
    for arg in tree.args:
        yield from parts(arg)


def has_values(text, names):
    """Whether all parts of a text have a value there: from what has none, a comparison makes some side."""
    return all(np.isfinite(value_of(part, names)) for part in parts(parse(text)) if part.kind != "inverse")


def at(model, state, t=0.3, **values):
    """Constants, modes behind them, and forcing of a model at a state, all as plain numbers."""
    system, p = model.system, model.load(**values).pack()
    with np.errstate(all="ignore"):
        c = np.zeros(system.n_constants)
        plain(system.constants)(FREQUENCY, p, c)
        table = np.zeros((3, system.n_edges))
        plain(system.edges)(FREQUENCY, p, *table)
        modes = np.ones(system.n_modes)
        if system.has_segments:
            modes[-1] = np.count_nonzero(table[0] <= t)
        c = np.concatenate([c, modes])
        if system.n_switches:
            state, still = tuple(map(np.float64, state)), (np.float64(0.0),) * len(state)
            for k, (value, _) in enumerate(plain(system.switches)(t, state, still, tuple(c))):
                c[system.n_constants + k] = -1.0 if value < 0.0 else 1.0
        return tuple(c), plain(system.forcing)(t, tuple(c))


def plain_rates(model, state, t=0.3, **values):
    c, u = at(model, state, t, **values)
    with np.errstate(all="ignore"):
        return np.array(plain(model.system.rhs)(tuple(map(np.float64, state)), u, c))


def plain_jacobian(model, state, t=0.3, **values):
    c, u = at(model, state, t, **values)
    n = len(state)
    with np.errstate(all="ignore"):
        return np.reshape(plain(model.system.jacobian)(tuple(map(np.float64, state)), u, c), (n, n))


PARAMETERS = {"a": 0.6, "b": -1.7}


def known_at(x, v, t=0.3):
    """All that a text may name, at a state and a time."""
    return {"x": x, "v": v, "t": t, "f": FREQUENCY, "phase": t * FREQUENCY, "pi": math.pi, **PARAMETERS}


SMOOTH_FUNCTIONS = ("sin", "cos", "atan", "tanh", "exp", "sqrt", "log", "sinh", "cosh")
LEAVES = ["x", "v", "a", "b", "t", "phase", "f", "2", "0.5", "1", "0"]


def joined(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/"]), inner).map(lambda p: f"({' '.join(p)})"),
        st.tuples(inner, st.sampled_from(["2", "3", "5", "-1", "0.5", "-2", "1.5"])).map(
            lambda p: f"({p[0]})**({p[1]})"
        ),
        st.tuples(st.sampled_from(SMOOTH_FUNCTIONS), inner).map(lambda p: f"{p[0]}({p[1]})"),
        inner.map(lambda text: f"(-{text})"),
    )


SMOOTH = st.recursive(st.sampled_from(LEAVES), joined, max_leaves=10)
CORNERED = st.recursive(
    st.sampled_from(LEAVES),
    lambda inner: st.one_of(
        joined(inner),
        st.tuples(st.sampled_from(["abs", "sign"]), inner).map(lambda p: f"{p[0]}({p[1]})"),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner).map(lambda p: f"{p[0]}({p[1]}, {p[2]})"),
        st.tuples(inner, st.sampled_from(["<", "<=", ">", ">="]), inner, inner, inner).map(
            lambda p: f"where({p[0]} {p[1]} {p[2]}, {p[3]}, {p[4]})"
        ),
        inner.map(lambda text: f"square(2*t*f + {text}, 0.3)"),
    ),
    max_leaves=8,
)


@pytest.mark.slow
@given(SMOOTH, st.floats(0.1, 2.0), st.floats(-2.0, 2.0))
def test_rates__are_what_the_text_says(text, x, v):
    model = model_with_value(text)
    wanted = float(value_of(parse(text), known_at(x, v)))
    found = plain_rates(model, (x, v))
    # parts that cancel leave rounding errors of their own size
    if math.isfinite(wanted) and abs(wanted) < 1e10 and np.isfinite(found).all():
        assert found[0] == v
        assert found[1] == pytest.approx(wanted, rel=1e-9, abs=1e-6) or abs(wanted) > 1e5


@pytest.mark.slow
@example("square(2*t*f + sin(square(2*t*f + a, 0.3)), 0.3)", 1.0, 0.0)
@given(CORNERED, st.floats(0.11, 2.0), st.floats(-2.0, 2.0))
def test_rates__are_what_the_text_says_on_each_side_of_its_corners(text, x, v):
    model = model_with_value(text)
    names = known_at(x, v)
    wanted = float(value_of(parse(text), names))
    nearby = [float(value_of(parse(text), {**names, "x": x + d, "v": v - 0.7 * d})) for d in (-1e-7, 1e-7)]
    close = [abs(n - wanted) < 1e-4 * (1.0 + abs(wanted)) for n in nearby]
    if not (has_values(text, names) and all(close)) or abs(wanted) > 1e5:
        return  # on a corner, or where numpy has no value
    found = plain_rates(model, (x, v))[1]
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-6) or not math.isfinite(found)


@pytest.mark.parametrize(
    "text",
    [
        "abs(x)",
        "sign(x)",
        "abs(-2*x) + v*sign(-x)",
        "max(x, v)",
        "min(x, v)",
        "max(x, v, a)",
        "min(x, v, b, 0.1)",
        "sign(x - sign(v))*x",
        "where(square(t*f, 0.3) > 0, x, v)",
        "abs(x - abs(v)) + sign(-v)",
        "where(t*f + 0.1*square(t*f, 0.5) < 0.33, x, v)",
        "sign(max(x, v) - min(a, v) - 0.01)",
        "where(x < v, 1, 2)",
        "where(x <= v, x, v)",
        "where(x > v, 1, 2)",
        "where(x >= v, x, v)",
        "where(not x < v, 1, 2)",
        "where(x < 0 and v < 0, 1, 2)",
        "where(x < 0 or v < 0, 1, 2)",
        "where(x > 0, sqrt(x), v)",
        "abs(x)*sign(x - v)",
        "square(t*f + a, 0.3)",
        "where(phase < 0.2, x, v)",
        "where(t < 0.2, x, v)",
        "square(2*t*f + where(x < x, a, x), 0.3)",
        "where(x >= x, x, v)",
        "sign(sign(x) - sign(v))*x",
        "where(sign(v) < square(2*t*f + x, 0.3), x, v)",
        "where(sign(x) <= sign(v), 1, 2)",
        "abs(sign(x) - sign(v))",
        "sign(sin(2*pi*f*t) - 0.2)",
        "abs(cos(6*pi*f*t))*x",
        "floor(3*x + 0.1)*v + ceil(v/0.4)",
        "mod(x, 0.7) + mod(-v, a)*x + mod(x, b)",
        "heaviside(x - 0.5)*v + heaviside(-v)",
        "floor(x*v + sign(x)/2)",
        "mod(3*f*t + a, 1)*x + floor(2*x - sin(2*pi*f*t))",
        "mod(t, 1/(2*f)) + mod(0.3 - f*t, 1)",
    ],
)
def test_rates__on_either_side_of_a_corner(text):
    model = model_of({"x": "v", "v": text}, PARAMETERS)
    for x, v, t in itertools.product((-0.9, -0.2, 0.3, 1.1), (-1.0, -0.15, 0.25, 0.8), (0.05, 0.3, 0.9)):
        wanted = float(value_of(parse(text), known_at(x, v, t)))
        assert plain_rates(model, (x, v), t)[1] == pytest.approx(wanted, rel=1e-14, abs=1e-14), (x, v, t)


@pytest.mark.slow
@given(SMOOTH)
def test_jacobian__is_sympys_derivative(text):
    x, v = 0.83, -0.57
    model = model_of({"x": text, "v": "x*v"}, PARAMETERS)
    symbols = sympy.symbols("x v")
    scope = {name: getattr(sympy, name) for name in SMOOTH_FUNCTIONS}
    expression = sympy.sympify(text, locals={**scope, **known_at(*symbols)})
    wanted = []
    for symbol in symbols:
        slope = sympy.diff(expression, symbol).subs(dict(zip(symbols, (x, v), strict=True)))
        number = complex(slope.evalf(30)) if slope.is_number and not slope.has(sympy.zoo, sympy.nan) else math.nan
        wanted.append(number)
    try:
        found = plain_jacobian(model, (x, v))
    except ZeroDivisionError:  # Python's own, of numbers in the text
        return
    for a, b in zip(found[0], wanted, strict=True):
        if np.isfinite(b) and b.imag == 0.0 and abs(b) < 1e8 and np.isfinite(a):
            assert a == pytest.approx(b.real, rel=1e-8, abs=1e-7)
    np.testing.assert_allclose(found[1], [v, x])


@pytest.mark.parametrize("text", ["x/(exp(x) - 1)", "0.5*x*exp(-x/2)*2/(1 - exp(-x))*exp(-x/2)"])
def test_rates__of_ion_channels_at_their_removable_singularity(text):
    """x/(exp(x) - 1) = 1 - x/2 + x**2/12 - ... has all its digits near 0, where exp(x) - 1 as a difference has none."""
    model = model_of({"x": text})
    for x in (1e-12, -3e-9, 2e-6, -7e-5):
        assert plain_rates(model, (x,))[0] == pytest.approx(1.0 - x / 2.0 + x * x / 12.0, rel=1e-15)
        assert plain_jacobian(model, (x,))[0, 0] == pytest.approx(x / 6.0 - 0.5, abs=1e-15 / abs(x))


@pytest.fixture(scope="module")
def functions():
    """A model with a quantity for each function, powers besides."""
    texts = {
        "f_" + name: f"{name}({', '.join(['x', 'a', '2.5'][:least])})"
        for name, (least, _) in FUNCTIONS.items()
        if name not in ("where", "square")
    }
    texts |= {
        "where1": "where(x < a, x, v)",
        "where2": "where(x > a or v > 1, x, v)",
        "where3": "where(x >= a, 1, 2)",
        "square1": "square(v, 0.3)",
        "power1": "x**a",
        "power2": "x**7",
        "power3": "x**-3",
        "power4": "x**2.5",
        "power5": "x**-0.5",
        "power6": "x**0.3",
    }
    return model_of({"x": "v", "v": "-x"}, {"a": 0.4}, quantities=texts)


def exact(name, x, v, a):
    m = mpmath
    powers = {"power1": a, "power2": 7, "power3": -3, "power4": 2.5, "power5": -0.5, "power6": 0.3}
    if name in powers:
        return m.power(x, m.mpf(powers[name]))
    if name.startswith("where"):
        holds = {"where1": x < a, "where2": x > a or v > 1, "where3": x >= a}[name]
        yes, no = (1, 2) if name == "where3" else (x, v)
        return yes if holds else no
    own = {
        "square1": lambda: 1 if v - math.floor(v) < 0.3 else -1,
        "f_abs": lambda: abs(x),
        "f_min": lambda: min(x, a),
        "f_max": lambda: max(x, a),
        "f_sign": lambda: (x > 0) - (x < 0),
        "f_heaviside": lambda: x >= 0,
        "f_mod": lambda: x - a * m.floor(x / a),
        "f_atan2": lambda: m.atan2(x, a),
    }
    return own[name]() if name in own else getattr(m, name.removeprefix("f_"))(x)


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.7, 0.013, -0.4, 0.999, 1e-9, 0.4])
def test_functions__agree_with_mpmath(functions, x):
    """Compiled, to a few units in the last place."""
    names = [q.name for q in functions.quantities]
    found = evaluate(names, 0.0, [[x, 1.3]], functions.load(), FREQUENCY)[0]
    with mpmath.workdps(40):
        for name, number in zip(names, found, strict=True):
            try:
                wanted = exact(name, mpmath.mpf(x), mpmath.mpf(1.3), mpmath.mpf(0.4))
            except ValueError:
                continue
            if isinstance(wanted, mpmath.mpc):  # numpy has no value there, either
                assert math.isnan(number), name
            else:
                assert abs(number - wanted) <= 3e-15 * abs(wanted), name


def test_functions__are_the_same_bits_alone_and_among_others(functions):
    """Where the one beside it has no value, too: a third of the roots and logarithms have none."""
    names, states = [q.name for q in functions.quantities], np.random.default_rng(4).normal(size=(41, 2))
    together = evaluate(names, 0.0, states, functions.load(), FREQUENCY)
    assert 0.0 < np.isnan(together).mean() < 0.5
    for i in range(41):
        alone = evaluate(names, 0.0, states[[i]], functions.load(), FREQUENCY)
        np.testing.assert_array_equal(alone[0].view(np.uint64), together[i].view(np.uint64))


def test_forcing__is_the_largest_part_that_is_one_number(monkeypatch):
    one = model_of({"x": "v", "v": "a + b*cos(2*pi*f*t) - x"}, PARAMETERS).derived.forcing
    assert one.op == "add"
    scaled = model_of({"x": "v + a*cos(2*pi*f*t)", "v": "b*x*cos(2*pi*f*t)"}, PARAMETERS).derived.forcing
    assert scaled.op == "cos"
    assert model_of({"x": "v", "v": "cos(2*pi*f*t) + x*sin(2*pi*f*t)"}).derived.forcing.op == "time"
    assert model_of({"x": "v", "v": "-x*f"}).derived.forcing is None
    preferred = model_of(
        {"x": "v", "v": "a + b*drive - x"}, PARAMETERS, define={"drive": "2*cos(2*pi*f*t)"}
    ).derived.forcing  # a recording takes the place of what is called the drive
    assert preferred.op == "held"
    assert preferred.args[0].args[0].is_number(2.0)
    model = model_of({"x": "cos(2*t) - x*sin(3*t)"})
    with pytest.raises(ValueError, match="differs between time 0 and 1/frequency"):
        sections(model.load(), [1.0], [[0.5]], n_transient=0, n_keep=1)
    define = {"a0": "sin(x*v)"} | {f"a{i}": f"sin(a{i - 1}*x)*cos(a{i - 1}*v)" for i in range(1, 120)}
    equations = {"x": "a119", "v": "a119", **{s: f"a119*{s}" for s in "ABCDEFGHIJKLMNOPQRST"}}
    model = model_of(equations, define=define)
    monkeypatch.setattr(graph, "MAX_NODES", 2000)
    with pytest.raises(ModelError, match="more than 2000 parts; simplify them"):
        _ = model.derived


MANY = {
    "steep places": "+".join(f"atan({i}*x + 1)" for i in range(1, 500)),
    "surfaces": "+".join(f"abs(x + {i})" for i in range(500)),
    "instants": "+".join(f"square({i}*t*f, 0.3)" for i in range(1, 15)),
    "": "*".join(f"(x**63 + {i}*v**61)" for i in range(400)),
    " ": "+".join(f"sin({i}*t)*cos({i}.5*t*x)" for i in range(300)),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", MANY)
def test_derived__takes_seconds_at_most(what):
    """The largest expression of each sort is worked off, or refused."""
    table = {f"a{i}": f"({MANY[what]})*{i} + x*v" for i in range(40)}
    text = "+".join(table)
    begin = time.process_time()
    model = model_of({"x": "v", "v": text}, define=table)
    with contextlib.ExitStack() as stack:
        if what.strip():
            stack.enter_context(pytest.raises(ModelError, match=f"more than .* {what}"))
        _ = model.digest
    assert time.process_time() - begin < 200.0
