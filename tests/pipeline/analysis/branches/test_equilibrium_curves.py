"""Curves of equilibria in two parameters, and their points of codimension two, against closed forms.

The normal forms are seen through a nonlinear change of the states and a change of time, with a stable state coupled to
them, so that their centre manifolds are bent and every term of the reduction is at work.
"""

from itertools import pairwise

import numpy as np
import pytest
import sympy
from scipy.optimize import brentq, fsolve

from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import curves_table
from pipeline.analysis.branches.curves import UNFOLDED, continue_curves, curves_dataset
from pipeline.analysis.branches.equilibrium_curves import EquilibriumCurve
from pipeline.analysis.branches.problems import Family
from tests.core.flows import model_of

FIRST, SECOND = "(p - (x^2 + y^2)/2 + 3*(z^2 + w^2)/10)", "(q - 2*(x^2 + y^2)/5 + 7*(z^2 + w^2)/10)"
OSCILLATORS = {
    "x": f"{FIRST}*x - 2*y",
    "y": f"{FIRST}*y + 2*x",
    "z": f"{SECOND}*z - 73*w/100",
    "w": f"{SECOND}*w + 73*z/100",
}
"""Normal form of a double Hopf point at p = q = 0."""

GROWTH = "(p + q*(x^2 + y^2) + 3*(x^2 + y^2)^2)"
BAUTIN = {"x": f"{GROWTH}*x - (17/10 + (x^2 + y^2)/2)*y", "y": f"{GROWTH}*y + (17/10 + (x^2 + y^2)/2)*x"}
"""Normal form of a generalised Hopf point at p = q = 0."""

SHIFT = 0.4
"""Place of the equilibria of interest, in each state."""


def disguised(rates, parameters, factor="1"):
    """Return a model with the given rates, whose states are bent by maps that are the identity to first order.

    In turn, each state gets a function of the next one added; the rates are multiplied by a positive factor, a change
    of time.
    """
    names = list(rates)
    ring = [*names, names[0]]
    shears = [(t, f"3*{o}^2/10 + {o}^3/7") for t, o in pairwise(ring)] if len(names) > 1 else []
    level, define = {n: f"({n} - {SHIFT})" for n in names}, {}
    levels = [level]
    for k, (t, e) in enumerate(reversed(shears)):
        define[f"{t}_{k}"] = f"{level[t]} - ({_with(e, level)})"
        level = {**level, t: f"{t}_{k}"}
        levels.append(level)
    define["factor_0"] = _with(factor, level)
    for n, rate in rates.items():
        define[f"rate_{n}"] = f"({_with(rate, level)})*factor_0"
    own = {n: f"rate_{n}" for n in names}
    for k, (t, e) in enumerate(shears):
        (o,) = [str(s) for s in sympy.sympify(e.replace("^", "**")).free_symbols]
        slope = str(sympy.sympify(e.replace("^", "**")).diff(o))
        define[f"pushed_{k}"] = f"{own[t]} + ({_with(slope, levels[-1 - k])})*{own[o]}"
        own = {**own, t: f"pushed_{k}"}
    return model_of(own, parameters, define=define)


def _with(text, names):
    text = str(sympy.sympify(text.replace("^", "**")).subs({n: sympy.Symbol(f"_{n}_") for n in names}))
    for n, other in names.items():
        text = text.replace(f"_{n}_", other)
    return text


def curves_of(model, kind, state, values, bounds=((-1.0, 1.0), (-1.0, 1.0)), omega=None, generations=3):
    """Follow the curve of a bifurcation in the plane of the first two parameters, and those that spring from it."""
    free = tuple(model.parameter_names[:2])
    scales = tuple(high - low for low, high in bounds)
    rate = model.crossing.frequency_hz if model.crossing else 1.0
    family = Family(model.system, 0, rate, model.load().pack(), free, scales)
    u = family.unknowns(np.array(state, float), values)
    start = EquilibriumCurve(family, kind).start(u, omega)
    return continue_curves([(0, family, kind, start)], bounds, generations=generations)


def only_at_origin(curves, kind):
    """Return the one located point of a kind, which lies at the origin, as a row of the table."""
    (row,) = [row for row in curves_table(curves_dataset(curves, "p", "q")).rows if row["type"] == kind]
    np.testing.assert_allclose([row["p"], row["q"]], 0.0, atol=1e-8)
    return row


def on(curves, kind):
    return np.concatenate([curve.values for curve in curves if curve.kind == kind])


def test_cusp():
    """x' = p + q x - 1.3 x^3: folds at 27*1.3 p^2 = 4 q^3."""
    model = disguised({"x": "p + q*x - 13*x^3/10", "y": "-2*y + x^2"}, {"p": 0.0, "q": 0.0})
    q = 0.3
    x = np.sqrt(q / 3.9)
    p = -q * x + 1.3 * x**3
    y = x**2 / 2.0
    curves = curves_of(model, "fold", bent([x, y]), [p, q])
    p, q = on(curves, "fold").T
    assert len(p) > 20
    np.testing.assert_allclose(27.0 * 1.3 * p**2, 4.0 * q**3, atol=1e-9)
    row = only_at_origin(curves, "cusp")
    assert row["coefficient_c"] == pytest.approx(-1.3, abs=1e-9)


def bent(states):
    """Return the states that `disguised` makes of others."""
    found = list(map(float, states))
    n = len(found)
    for i in range(n if n > 1 else 0):
        o = found[(i + 1) % n]
        found[i] += 0.3 * o**2 + o**3 / 7.0
    return [value + SHIFT for value in found]


@pytest.mark.slow
def test_bogdanov_takens():
    """x' = y, y' = p + q x + 1.4 x^2 - .7 x y: folds at q^2 = 5.6 p, Hopf points at p = 0 > q."""
    rates = {"x": "y", "y": "p + q*x + 7*x^2/5 - 7*x*y/10", "z": "-z + x^2 - y^2"}
    model = disguised(rates, {"p": 0.0, "q": 0.0})
    q = 0.5
    x = -q / 2.8
    curves = curves_of(model, "fold", bent([x, 0.0, x**2]), [q**2 / 5.6, q])
    assert sorted(c.kind for c in curves) == ["fold", "hopf"]
    p, q = on(curves, "fold").T
    np.testing.assert_allclose(q**2, 5.6 * p, atol=1e-9)
    p, q = on(curves, "hopf").T
    np.testing.assert_allclose(p, 0.0, atol=1e-9)
    assert q.min() < -0.9
    assert q.max() < 1e-8
    assert "bogdanov_takens" in next(c for c in curves if c.kind == "hopf").ends
    row = only_at_origin(curves, "bogdanov_takens")
    np.testing.assert_allclose([row["coefficient_a"], row["coefficient_b"]], [1.4, -0.7], atol=1e-9)


@pytest.mark.slow
def test_generalised_hopf():
    """z' = (p + i w) z + q z |z|^2 + 3 z |z|^4: with z = sqrt(2) w, lyapunov2 = 4 * 3 / 1.7."""
    rates = {**BAUTIN, "z": "-z + x^2 - x*y/3"}
    model = disguised(rates, {"p": 0.0, "q": 0.0}, "1 + 3*x/10 - y/5 + x*y/4")
    curves = curves_of(model, "hopf", bent([0, 0, 0]), [0.0, -0.5], generations=0)
    np.testing.assert_allclose(on(curves, "hopf")[:, 0], 0.0, atol=1e-10)
    row = only_at_origin(curves, "generalised_hopf")
    assert row["coefficient_lyapunov2"] == pytest.approx(12.0 / 1.7, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fold", "hopf"])
def test_zero_hopf(kind):
    """x' = p - .8 x^2 + .5 |z|^2, z' = (q + 1.3 i) z + (.6 - .2 i) x z + .9 x^2 z, in another time."""
    s = "(y^2 + z^2)"
    rates = {
        "x": f"p - 4*x^2/5 + {s}/2",
        "y": "(q + 3*x/5 + 9*x^2/10)*y - (13/10 - x/5)*z",
        "z": "(q + 3*x/5 + 9*x^2/10)*z + (13/10 - x/5)*y",
    }
    model = disguised(rates, {"p": 0.0, "q": 0.0}, f"1 + 2*x/5 + 3*{s}/7 + y/5")
    x = 0.0 if kind == "fold" else 0.3
    values = [0.0, -0.5] if kind == "fold" else [0.8 * x**2, -0.6 * x - 0.9 * x**2]
    curves = curves_of(model, kind, bent([x, 0, 0]), values, generations=1)
    assert sorted(c.kind for c in curves if not c.family.period) == ["fold", "hopf"]
    np.testing.assert_allclose(on(curves, "fold")[:, 0], 0.0, atol=1e-9)
    row = only_at_origin(curves, "zero_hopf")
    np.testing.assert_allclose(
        [row[f"coefficient_{name}"] for name in ("s", "theta", "e")], [-1.0, -0.75, 0.9], atol=1e-8
    )


@pytest.mark.slow
def test_double_hopf():
    """Two oscillators: p11 = -.5, p12 = .3, p21 = -.4, p22 = .7; with z = sqrt(2) w the coefficients double."""
    model = disguised(OSCILLATORS, {"p": 0.0, "q": 0.0})
    curves = curves_of(model, "hopf", bent([0, 0, 0, 0]), [0.0, -0.5], omega=2.0, generations=1)
    hopf = [c.values for c in curves if c.kind == "hopf"]
    assert len(hopf) == 2
    assert sorted(np.abs(values).max(axis=0).argmin() for values in hopf) == [0, 1]
    for values in hopf:
        np.testing.assert_allclose(np.abs(values).min(axis=1), 0.0, atol=1e-10)
    row = only_at_origin(curves, "double_hopf")
    found = [row[f"coefficient_{name}"] for name in ("p11", "p22", "theta", "delta")]
    np.testing.assert_allclose(found, [1.4, -1.0, -0.4 / -0.5, 0.3 / 0.7], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "kind"), [("-x^3", "pitchfork"), ("+x^2", "transcritical")])
def test_branch_points(rate, kind):
    """Branch points at p + q^2 = 0; an imperfect one is not followed."""
    model = disguised({"x": f"(p + q^2)*x {rate} + e", "y": "-y + x^2"}, {"p": 0.0, "q": 0.0, "e": 0.0})
    curves = curves_of(model, kind, bent([0, 0]), [-0.25, 0.5])
    p, q = on(curves, kind).T
    np.testing.assert_allclose(p, -(q**2), atol=1e-8)
    assert q.min() < -0.9
    assert q.max() > 0.9
    family = curves[0].family
    broken = model.load(e=1e-3).pack()
    start = EquilibriumCurve(family, kind).start(family.unknowns(np.array(bent([0, 0])), [-0.25, 0.5]))
    other = Family(family.system, 0, 1.0, broken, family.free, family.scales)
    assert continue_curves([(0, other, kind, start)], ((-1.0, 1.0), (-1.0, 1.0))) == []


def test_branch_points__double_zero():
    """x'' = p x + q x' - x^3 - 2 x^2 x': pitchforks at p = 0, Hopf points at q = 0 > p."""
    model = disguised({"x": "y", "y": "p*x + q*y - x^3 - 2*x^2*y", "z": "-z + x^2"}, {"p": 0.0, "q": 0.0})
    curves = curves_of(model, "pitchfork", bent([0, 0, 0]), [0.0, -0.5], generations=1)
    assert sorted(c.kind for c in curves) == ["hopf", "pitchfork"]
    p, q = on(curves, "hopf").T
    np.testing.assert_allclose(q, 0.0, atol=1e-9)
    assert p.min() < -0.9
    only_at_origin(curves, "bogdanov_takens")


@pytest.mark.slow
def test_branch_points__without_a_quadratic_or_cubic_term():
    """x' = p x + q x^2 - 1.3 x^3 has a cusp; x' = p x + q x^3 - .6 x^5, where folds with q^2 = -2.4 p begin."""
    model = disguised({"x": "p*x + q*x^2 - 13*x^3/10", "y": "-y + x^2"}, {"p": 0.0, "q": 0.0})
    curves = curves_of(model, "transcritical", bent([0, 0]), [0.0, -0.5], generations=0)
    row = only_at_origin(curves, "cusp")
    assert row["coefficient_c"] == pytest.approx(-1.3, abs=1e-8)
    model = disguised({"x": "p*x + q*x^3 - 3*x^5/5", "y": "-y + x^2"}, {"p": 0.0, "q": 0.0})
    curves = curves_of(model, "pitchfork", bent([0, 0]), [0.0, -0.5], generations=1)
    row = only_at_origin(curves, "degenerate_pitchfork")
    assert row["coefficient_quintic"] == pytest.approx(-0.6, abs=1e-7)
    p, q = on(curves, "fold").T
    np.testing.assert_allclose(q**2, -2.4 * p, atol=1e-8)
    assert q.max() > 0.9


def test_branch_points__zero_hopf():
    """A pitchfork at p = 0 with a pair (q + 1.3 i): at the origin, without a fold's coefficients."""
    rates = {"x": "p*x - x^3 + x*(y^2 + z^2)", "y": "(q + x^2)*y - 13*z/10", "z": "(q + x^2)*z + 13*y/10"}
    model = disguised(rates, {"p": 0.0, "q": 0.0})
    row = only_at_origin(curves_of(model, "pitchfork", bent([0, 0, 0]), [0.0, -0.5], generations=0), "zero_hopf")
    assert not {f"coefficient_{name}" for name in ("s", "theta", "e")} & row.keys()


def test_branch_points__unfolded_by_the_second_parameter():
    """x' = p x - x^3 + q: the pitchfork at q = 0 has no curve, and is left out with a reason."""
    model = model_of({"x": "p*x - x**3 + q"}, {"p": 0.0, "q": 0.0})
    family = Family(model.system, 0, 1.0, model.load().pack(), ("p", "q"), (2.0, 2.0))
    start = EquilibriumCurve(family, "pitchfork").start(family.unknowns(np.zeros(1), [0.0, 0.0]))
    left_out = {}
    assert continue_curves([(7, family, "pitchfork", start)], ((-1, 1), (-1, 1)), left_out=left_out) == []
    assert left_out == {7: UNFOLDED}


# ---- mechanics ---------------------------------------------------------------------------------

FOLLOWER = model_of(
    {"u": "du", "v": "dv", "du": "(first - co*second)/(3 - co^2)", "dv": "(3*second - co*first)/(3 - co^2)"},
    {"load": 1.5, "share": 1.0, "c": 0.3},
    define={
        "co": "cos(u - v)",
        "si": "sin(u - v)",
        "first": "load*sin(u - share*v) - c*(2*du - dv) - 2*u + v - dv^2*si",
        "second": "load*sin((1 - share)*v) - c*(dv - du) + u - v + du^2*si",
    },
)
"""Ziegler's column: two rods, elastic and viscous joints, a load that turns with the tip in some share."""


def follower_polynomial(load, share, c=0.3):
    """Characteristic polynomial of the straight column."""
    mass, damping = np.array([[3.0, 1.0], [1.0, 1.0]]), c * np.array([[2.0, -1.0], [-1.0, 1.0]])
    stiffness = np.array([[2.0 - load, load * share - 1.0], [-1.0, 1.0 - (1.0 - share) * load]])
    return np.poly(first_order(mass, damping, stiffness))


def first_order(mass, damping, stiffness):
    n = len(mass)
    return np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )


def routh(polynomial):
    """Vanishes where two eigenvalues of four have the sum 0; relative."""
    _, a, b, c, d = polynomial
    return 1.0 - c / (a * b) - a * d / (b * c)


def least_sum(polynomial):
    """Least sum of two eigenvalues, relative."""
    values = np.roots(polynomial)
    i, j = np.triu_indices(len(values), 1)
    return np.abs(values[i] + values[j]).min() / np.abs(values).max()


@pytest.mark.slow
def test_follower_force():
    """Flutter by Routh and Hurwitz, divergence where det K = 0; both meet at the double zero."""
    flutter = brentq(lambda load: routh(follower_polynomial(load, 1.0)), 1.0, 2.0, xtol=1e-12)
    bounds = ((0.2, 4.0), (0.0, 1.2))
    curves = curves_of(FOLLOWER, "hopf", [0, 0, 0, 0], [flutter, 1.0], bounds, generations=1)
    curve, sprung = curves
    assert (curve.kind, sprung.kind) == ("hopf", "pitchfork")
    assert "bogdanov_takens" in curve.ends
    assert max(least_sum(follower_polynomial(*values)) for values in curve.values) < 1e-9
    buckling = brentq(lambda load: follower_polynomial(load, 0.2)[-1], 0.1, 0.8, xtol=1e-12)
    (divergence,) = curves_of(FOLLOWER, "pitchfork", [0, 0, 0, 0], [buckling, 0.2], bounds, generations=0)
    for values in (*divergence.values, *sprung.values):
        assert abs(follower_polynomial(*values)[-1]) < 1e-9
    known = fsolve(lambda x: follower_polynomial(*x)[-2:], curve.special[0].values + 1e-3, xtol=1e-12)
    (double_zero,) = (one for one in curve.special if one.kind == "bogdanov_takens")
    np.testing.assert_allclose(double_zero.values, known, atol=1e-9)
    assert dict(double_zero.coefficients) == {"a": 0.0, "b": 0.0}  # by symmetry


FLUTTER = model_of(
    {
        "h": "dh",
        "a": "da",
        "dh": "(r2*lift - offset*moment)/(r2 - offset^2)",
        "da": "(moment - offset*lift)/(r2 - offset^2)",
    },
    {"speed": 1.0, "offset": 0.2, "r2": 0.25, "heave3": 2.0, "pitch3": 0.4},
    define={
        "lift": "-.2*h - .3*speed^2*a - (.02 + .1*speed)*dh - heave3*h^3",
        "moment": "-r2*a + .06*speed^2*a - .02*da - pitch3*a^3",
    },
)
"""Aerofoil with heave and pitch in a steady flow, hardening in both."""


def flutter_matrices(speed, offset):
    mass = np.array([[1.0, offset], [offset, 0.25]])
    return (
        mass,
        np.diag([0.02 + 0.1 * speed, 0.02]),
        np.array([[0.2, 0.3 * speed**2], [0.0, 0.25 - 0.06 * speed**2]]),
        np.array([2.0, 0.4]),
    )


WHEELSET = model_of(
    {
        "y": "dy",
        "a": "da",
        "dy": "-creep*(dy/speed - a) - .6*y - soft*y^3",
        "da": "(-.7*creep*da/speed - cone*creep*y*(1 + 3*y^2/2) - .9*a - .2*a^3)/.6",
    },
    {"speed": 1.0, "cone": 0.3, "creep": 3.0, "soft": 3.6},
)
"""Wheelset on springs: creep forces, and a conicity that grows with the lateral displacement."""


def wheelset_matrices(speed, cone):
    damping = np.diag([3.0 / speed, 2.1 / speed])
    return np.diag([1.0, 0.6]), damping, np.array([[0.6, -3.0], [3.0 * cone, 0.9]]), np.array([3.6, 0.2, 4.5 * cone])


def cubic_lyapunov(mass, damping, stiffness, cubic):
    """First Lyapunov coefficient of M x'' + C x' + K x + k x^3 = 0, up to a positive factor."""
    matrix = first_order(mass, damping, stiffness)
    values, vectors = np.linalg.eig(matrix)
    k = np.argmin(np.abs(values.real) + 1e9 * (values.imag <= 0.0))
    q = vectors[:, k]
    p = np.linalg.inv(vectors).conj()[k]
    x = q[:2]
    force = cubic[:2] * x * np.abs(x) ** 2
    if len(cubic) > 2:
        force = force + np.array([0.0, cubic[2] * x[0] * abs(x[0]) ** 2])
    return float(-np.vdot(p[2:], np.linalg.solve(mass, force)).real)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "matrices", "bounds", "at"),
    [
        (FLUTTER, flutter_matrices, ((0.3, 2.0), (0.0, 0.4)), 0.2),
        (WHEELSET, wheelset_matrices, ((0.1, 9.0), (0.02, 1.0)), 0.3),
    ],
)
def test_flutter_and_hunting(model, matrices, bounds, at):
    """The Hopf curve by Routh and Hurwitz; it changes its criticality where a coefficient of our own does."""

    def of(first, second):
        return routh(np.poly(first_order(*matrices(first, second)[:3])))

    def hopf(second):
        grid = np.linspace(*bounds[0], 400)
        values = [of(x, second) for x in grid]
        k = int(np.flatnonzero(np.diff(np.sign(values)))[0])
        return brentq(of, grid[k], grid[k + 1], args=(second,), xtol=1e-12)

    curves = curves_of(model, "hopf", [0, 0, 0, 0], [hopf(at), at], bounds, generations=0)
    (curve,) = curves
    assert max(least_sum(np.poly(first_order(*matrices(*values)[:3]))) for values in curve.values) < 1e-9
    found = [one.values for one in curve.special if one.kind == "generalised_hopf"]
    assert found
    for values in found:
        known = fsolve(lambda x: [of(*x), cubic_lyapunov(*matrices(*x))], values + 1e-3, xtol=1e-12)
        assert values == pytest.approx(known, abs=1e-8)


# ---- curves of cycles that spring from points of equilibria ---------------------------------------


def seen(model, of):
    """Return a model seen where a state crosses the place of its equilibrium."""
    return sectioned(model, Crossing(of, SHIFT, longest=60.0))


@pytest.mark.slow
def test_switching__fold_of_cycles():
    """From a generalised Hopf point: p + q r^2 + 3 r^4 has a double root where q^2 = 12 p, q < 0."""
    model = seen(disguised(BAUTIN, {"p": 0.0, "q": 0.0}), "y")
    curves = curves_of(model, "hopf", bent([0, 0]), [0.0, -0.5], ((-0.2, 0.2), (-1.0, 1.0)))
    assert sorted((c.kind, c.family.period) for c in curves) == [("fold", 1), ("hopf", 0)]
    cycles = next(c for c in curves if c.kind == "fold")
    p, q = cycles.values.T
    large = q < -0.05  # the smallest cycles have the least effect of p on their growth
    assert large.sum() > 5
    np.testing.assert_allclose(q[large] ** 2, 12.0 * p[large], atol=1e-7)
    assert q.max() < 0.0
    assert q.min() < -0.9
    assert "equilibrium" in cycles.ends


@pytest.mark.slow
def test_switching__tori():
    """From a double Hopf point: the cycle r^2 = 2 p at q = .4 r^2, and the cycle s^2 = -q/.7 at p = -.3 s^2."""
    model = seen(disguised(OSCILLATORS, {"p": 0.0, "q": 0.0}), "y")
    curves = curves_of(model, "hopf", bent([0, 0, 0, 0]), [0.0, -0.2], ((-0.2, 0.2), (-0.2, 0.2)), omega=2.0)
    tori = [c for c in curves if c.kind == "neimark_sacker"]
    p, q = np.concatenate([c.values[np.abs(c.values).max(axis=1) > 0.02] for c in tori]).T
    first, second = np.abs(q - 0.8 * p), np.abs(p - 0.3 * q / 0.7)
    assert np.minimum(first, second).max() < 1e-7


@pytest.mark.slow
def test_switching__zero_hopf():
    """From a zero-Hopf point: on the circle of cycles the trace 2 b x + ... vanishes."""
    s = "(y^2 + z^2)"
    rates = {
        "x": f"p - 4*x^2/5 + {s}/2",
        "y": "(q - 3*x/5 + 9*x^2/10)*y - 13*z/10",
        "z": "(q - 3*x/5 + 9*x^2/10)*z + 13*y/10",
    }
    model = seen(disguised(rates, {"p": 0.0, "q": 0.0}), "z")
    curves = curves_of(model, "fold", bent([0, 0, 0]), [0.0, -0.2], ((-0.2, 0.2), (-0.2, 0.2)))
    (torus,) = [c for c in curves if c.kind == "neimark_sacker"]
    # d(x')/dx + d(r')/dr = -1.6 x + (q - .6 x + .9 x^2) = 0 and x' = r' = 0: x = 0, q = 0
    np.testing.assert_allclose(torus.values[:, 1], 0.0, atol=1e-7)
    assert torus.values[:, 0].min() < -0.15
