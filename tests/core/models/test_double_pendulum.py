"""The double pendulum against Lagrange's equations, drag by quadrature, and the balance of energy."""

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import quad, solve_ivp

from magpend_core import evaluate
from magpend_core.models import load_model
from magpend_core.pointwise import rates
from magpend_core.sampling import sample

pytestmark = pytest.mark.slow

MODEL = load_model("double-pendulum")
VALUES = MODEL.load(T1=1e-3, T2=8e-4, c1=3e-4, c2=1e-4, mu0=0.7, c0=2.0, eps=30.0, k1=0.05, k2=0.03, l2=0.28, q=0.02)


def some_states(n=12, seed=4):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-3, 3, (n, 2)), rng.uniform(-6, 6, (n, 2))])


def lagrange(p):
    """Accelerations from the Lagrangian of two rigid links and generalised torques on them, by sympy."""
    t, q1, q2 = sp.symbols("t q1 q2")
    a, b = sp.Function("a")(t), sp.Function("b")(t)
    x1, y1 = p["e1"] * sp.sin(a), -p["e1"] * sp.cos(a)
    x2 = p["l1"] * sp.sin(a) + p["e2"] * sp.sin(b)
    y2 = -p["l1"] * sp.cos(a) - p["e2"] * sp.cos(b)
    kinetic = sum(
        p[m] * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2 + p[J] * angle.diff(t) ** 2 / 2
        for m, J, x, y, angle in (("m1", "J1", x1, y1, a), ("m2", "J2", x2, y2, b))
    )
    potential = p["g"] * (p["m1"] * y1 + p["m2"] * y2)
    L = kinetic - potential
    equations = [L.diff(z.diff(t)).diff(t) - L.diff(z) - q for z, q in ((a, q1), (b, q2))]
    names = sp.symbols("A B v w dv dw")
    plain = dict(zip([a, b, a.diff(t), b.diff(t), a.diff(t, 2), b.diff(t, 2)], names, strict=True))
    order = [a.diff(t, 2), b.diff(t, 2), a.diff(t), b.diff(t), a, b]
    equations = [sp.expand(e.doit()).subs([(o, plain[o]) for o in order]) for e in equations]
    solution = sp.solve(equations, names[4:], dict=True)[0]
    return sp.lambdify([*names[:4], q1, q2], [solution[names[4]], solution[names[5]]])


def torques(p, state, drive):
    """Generalised torques of drive, joints and air on both links; the air by quadrature along the links."""
    a, b, v, w = state

    def dry(T, c, rate):
        stribeck = (1 - p["mu0"]) * np.exp(-p["c0"] * abs(rate)) + p["mu0"]
        return T * 2 / np.pi * np.arctan(p["eps"] * rate) * stribeck + c * rate

    def across(s):
        return p["l1"] * v * np.cos(a - b) + s * w

    R1, R2 = dry(p["T1"], p["c1"], v), dry(p["T2"], p["c2"], w - v)
    force = quad(lambda s: p["k2"] * abs(across(s)) * across(s), 0, p["l2"])[0]
    moment = quad(lambda s: s * p["k2"] * abs(across(s)) * across(s), 0, p["l2"])[0]
    own = quad(lambda s: s * p["k1"] * abs(s * v) * s * v, 0, p["l1"])[0]
    return drive - R1 + R2 - own - p["l1"] * np.cos(a - b) * force, -R2 - moment


def test_rates__are_those_of_lagrange_with_drag_by_quadrature():
    p = VALUES.as_dict()
    solve = lagrange(p)
    states = some_states(60)
    # where the velocity across link 2 changes its sign along it, Gauss points are not exact
    start = p["l1"] * states[:, 2] * np.cos(states[:, 0] - states[:, 1])
    states = states[start * (start + p["l2"] * states[:, 3]) > 0][:12]
    assert len(states) == 12
    t, f = 0.21, 1.3
    found = rates(t, states, VALUES, f)
    for state, rate in zip(states, found, strict=True):
        q1, q2 = torques(p, state, p["q"] * np.sin(2 * np.pi * f * t))
        np.testing.assert_allclose(rate[2:], solve(*state, q1, q2), rtol=1e-10)


def test_energy__is_lost_as_the_quantities_say():
    """The energy at the end is that of the start, less what joints and air took, plus what the drive gave."""
    times = np.linspace(0, 2, 4001)
    start = [[1.2, -0.8, 3.0, -2.0]]
    off = VALUES.replace(q=0.0)
    states = sample(MODEL.system, off.pack()[None], start, [times], rtol=1e-11, atol=1e-11).states[0]
    energy, lost = evaluate(["energy", "power_dissipated"], times, states, off, 1.0).T
    taken = np.sum((lost[1:] + lost[:-1]) / 2 * np.diff(times))
    assert energy[0] - energy[-1] == pytest.approx(taken, rel=2e-6)
    assert energy[0] - energy[-1] > 0.1 * energy[0]


def test_sample__is_that_of_another_integrator():
    p = VALUES.replace(q=0.0).as_dict()
    solve = lagrange(p)
    start, times = some_states(1)[0], np.linspace(0, 1.0, 101)

    def rhs(t, y):
        x, w = np.polynomial.legendre.leggauss(3)
        x, w = (x + 1) / 2 * p["l2"], w / 2 * p["l2"]
        across = p["l1"] * y[2] * np.cos(y[0] - y[1]) + x * y[3]
        force = p["k2"] * np.sum(w * abs(across) * across)
        moment = p["k2"] * np.sum(w * x * abs(across) * across)
        q1, q2 = torques({**p, "k2": 0.0}, y, 0.0)
        return [y[2], y[3], *solve(*y, q1 - p["l1"] * np.cos(y[0] - y[1]) * force, q2 - moment)]

    other = solve_ivp(rhs, (0, 1), start, "DOP853", times, rtol=1e-10, atol=1e-10, max_step=2e-3)
    packed = VALUES.replace(q=0.0).pack()[None]
    found = sample(MODEL.system, packed, start[None], [times], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found.states[0], other.y.T, atol=2e-7)
