"""Points of codimension two in planes of CO oxidation and Lorenz-84, published or computed without magpend.

Bykov, Yablonskii and Kim, Dokl. Akad. Nauk SSSR 242 (1978) 637; its points in MatCont's tutorial on two-parameter
bifurcations of equilibria. Kuznetsov, Meijer and van Veen, Int. J. Bifurcation Chaos 14 (2004) 2253.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.curves import CURVE, continue_curves
from pipeline.analysis.branches.equilibrium_curves import EquilibriumCurve
from pipeline.analysis.branches.homoclinic import HomoclinicSettings
from pipeline.analysis.branches.homoclinic_curves import homoclinic_curves, loops_beside
from pipeline.analysis.branches.problems import Family
from tests.core.flows import model_of

OXIDATION = model_of(
    {"x": "2*q1*z^2 - 2*q5*x^2 - q3*x*y", "y": "q2*z - q6*y - q3*x*y", "s": "q4*z - K*q4*s"},
    {"q1": 2.5, "q2": 1.0, "q3": 10.0, "q4": 0.0675, "q5": 1.0, "q6": 0.1, "K": 0.4},
    define={"z": "1 - x - y - s"},
)


def oxidation(u, q2, k):
    x, y, s = u
    z = 1.0 - x - y - s
    return np.array([5.0 * z**2 - 2.0 * x**2 - 10.0 * x * y, q2 * z - 0.1 * y - 10.0 * x * y, 0.0675 * (z - k * s)])


CIRCULATION = model_of(
    {
        "x": "-y^2 - z^2 - a*x + a*F - g*u^2",
        "y": "x*y - b*x*z - y + G",
        "z": "b*x*y + x*z - z",
        "u": "-d*u + g*u*x + T",
    },
    {"F": 1.5, "T": 0.01, "G": 0.25, "a": 0.25, "b": 1.0, "g": 0.987, "d": 1.04},
)


def circulation(u, f, t):
    x, y, z, w = u
    return np.array(
        [
            -(y**2) - z**2 - 0.25 * x + 0.25 * f - 0.987 * w**2,
            x * y - x * z - y + 0.25,
            x * y + x * z - z,
            -1.04 * w + 0.987 * w * x + t,
        ]
    )


def jacobian(rates, u, *values):
    """Exact up to rounding: the rates are quadratic."""
    h = 0.125
    return np.array([rates(u + s, *values) - rates(u - s, *values) for s in h * np.eye(len(u))]).T / (2.0 * h)


def lyapunov(rates, u, *values):
    """First Lyapunov coefficient of quadratic rates, up to a positive factor (Kuznetsov 2004, Eq. 5.34)."""
    matrix, zero = jacobian(rates, u, *values), rates(0.0 * u, *values)

    def pure(v):
        return rates(v, *values) + rates(-v, *values) - 2.0 * zero

    def second(a, b):
        def real(p, q):
            return 0.25 * (pure(p + q) - pure(p - q))

        parts = [real(p, q) for p in (a.real, a.imag) for q in (b.real, b.imag)]
        return parts[0] - parts[3] + 1j * (parts[1] + parts[2])

    eigenvalues, vectors = np.linalg.eig(matrix)
    k = np.argmin(np.abs(eigenvalues.real) + 1e9 * (eigenvalues.imag <= 0.0))
    q, p = vectors[:, k], np.linalg.inv(vectors)[k].conj()
    omega, one = eigenvalues[k].imag, np.eye(len(u))
    mean = np.linalg.solve(matrix, second(q, q.conj()))
    double = np.linalg.solve(2j * omega * one - matrix, second(q, q))
    return float(np.vdot(p, second(q.conj(), double) - 2.0 * second(q, mean)).real)


CONDITIONS = {
    "bogdanov_takens": lambda a, *_: [a[-1], a[-2]],
    "zero_hopf": lambda a, *_: [a[-1], a[1] * a[2] - a[3]],
    "double_hopf": lambda a, *_: [a[1], a[3]],
    "generalised_hopf": lambda a, *at: [_hopf(a), lyapunov(*at)],
}
"""What vanishes at points of codimension two, from the characteristic polynomial of the Jacobian."""


def _hopf(a):
    return a[1] * a[2] - a[3] if len(a) == 4 else a[1] * a[2] * a[3] - a[3] ** 2 - a[1] ** 2 * a[4]


def known(rates, one):
    """Values of both parameters at a point of codimension two, by a solver of its own from a guess nearby."""
    n = len(one.family.system.state_names)

    def conditions(z):
        at = (rates, z[:n], *z[n:])
        return [*rates(z[:n], *z[n:]), *CONDITIONS[one.kind](np.poly(jacobian(*at)), *at)]

    return fsolve(conditions, np.append(one.family.state(one.point.u), one.values) + 1e-4, xtol=1e-13)[n:]


def curves_of(model, rates, kind, state, values, free, bounds, generations=1):
    """Follow a curve of equilibria, from the equilibrium near a state."""
    rate, scales = model.crossing.frequency_hz if model.crossing else 1.0, tuple(high - low for low, high in bounds)
    family = Family(model.system, 0, rate, model.load().pack(), free, scales)
    rest = fsolve(rates, state, tuple(values), xtol=1e-12)
    start = EquilibriumCurve(family, kind).start(family.unknowns(rest, values))
    return continue_curves([(0, family, kind, start)], bounds, generations=generations)


def oxidation_curves(model=OXIDATION, bounds=((0.7, 1.5), (0.1, 1.2)), generations=1):
    free, start = ("q2", "K"), ([0.0247, 0.4503, 0.375], [1.0522, 0.4])
    return curves_of(model, oxidation, "fold", *start, free, bounds, generations), bounds


def specials(curves, kind):
    """Return the points of a kind on some curves, each once."""
    found = [one for curve in curves for one in curve.special if one.kind == kind]
    return [one for i, one in enumerate(found) if all(np.abs(one.values - o.values).max() > 1e-6 for o in found[:i])]


@pytest.mark.slow
def test_oxidation__published():
    """Bogdanov-Takens points and cusp as MatCont's tutorial prints them, generalised Hopf points by a solver."""
    curves, _ = oxidation_curves()
    takens = sorted(tuple(one.values) for one in specials(curves, "bogdanov_takens"))
    np.testing.assert_allclose(takens, [(1.161199, 0.722339), (1.417628, 0.971397)], atol=1e-6)
    (cusp,) = specials(curves, "cusp")
    np.testing.assert_allclose(cusp.values, (1.006408, 0.355991), atol=1e-6)
    hopf = specials(curves, "generalised_hopf")
    assert len(hopf) == 2
    for one in hopf:
        np.testing.assert_allclose(one.values, known(oxidation, one), atol=1e-7)


@pytest.mark.slow
def test_oxidation__folds_of_cycles():
    """From a generalised Hopf point q2 rises along the curve, so that it has no cusp, whatever orbit it starts from."""
    seen = sectioned(OXIDATION, Crossing("x - y", longest=1000.0))
    curves, bounds = oxidation_curves(seen, ((0.85, 1.43), (0.2, 1.0)), generations=2)
    assert [one.family.period for one in specials(curves, "cusp")] == [0]
    (cycles,) = (curve for curve in curves if curve.kind == "fold" and curve.family.period)
    hopf = min(specials(curves, "generalised_hopf"), key=lambda one: np.abs(one.values - cycles.values[0]).max())
    np.testing.assert_allclose(cycles.values[0], hopf.values, atol=1e-4)
    short = replace(CURVE, max_points=25)
    starts = [[(0, cycles.family, "fold", p.u)] for p in cycles.points[:20:4]]
    again = [curve for start in starts for curve in continue_curves(start, bounds, short, generations=0)]
    assert len(again) == len(starts)
    for curve in (cycles, *again):
        rises = np.diff(curve.values[:, 0]) * np.sign(curve.values[-1, 0] - curve.values[0, 0])
        assert (rises > 0.0).all()
        assert not curve.special
        assert not curve.n_missed


@pytest.mark.slow
def test_circulation():
    """Extended Lorenz-84: the points on the Hopf and fold curves of the plane, by a solver."""
    free, bounds = ("F", "T"), ((0.25, 3.0), (0.0, 0.1))
    hopf = curves_of(
        CIRCULATION, circulation, "hopf", [1.0784, -0.0168, 0.2306, -0.4106], [1.9579678, 0.01], free, bounds
    )
    fold = curves_of(
        CIRCULATION, circulation, "fold", [1.1613, -0.0293, 0.2112, -0.0941], [1.3781693, 0.01], free, bounds
    )
    for kind in ("zero_hopf", "double_hopf", "generalised_hopf"):
        found = specials([*hopf, *fold], kind)
        assert found
        for one in found:
            np.testing.assert_allclose(one.values, known(circulation, one), atol=1e-7)


def turns_back(saddle, q2, k):
    """Whether the unstable manifold comes back to the other side of the saddle's stable manifold, by LSODA."""
    saddle = fsolve(oxidation, saddle, (q2, k), xtol=1e-13)
    values, vectors = np.linalg.eig(jacobian(oxidation, saddle, q2, k))
    i = int(np.argmax(values.real))
    out, left = vectors[:, i].real, np.linalg.inv(vectors)[i].real
    end = solve_ivp(
        lambda _, u: oxidation(u, q2, k),
        (0.0, 1500.0),
        saddle - 1e-6 * out * np.sign(out[0]) * np.sign(left @ out),
        "LSODA",
        rtol=1e-11,
        atol=1e-13,
        jac=lambda _, u: jacobian(oxidation, u, q2, k),
    ).y[:, -1]
    return float(left @ (end - saddle)) * np.sign(out[0]) > 0.1


@pytest.mark.slow
def test_oxidation__homoclinic_orbits():
    """From the first Bogdanov-Takens point to a saddle node on the fold curve; between them by shooting."""
    curves, bounds = oxidation_curves()
    (takens,) = (one for one in specials(curves, "bogdanov_takens") if one.values[0] < 1.3)
    (curve,) = homoclinic_curves(loops_beside(takens), bounds)
    assert curve.ends == ("saddle_node_homoclinic", "bogdanov_takens")
    saddles = np.array([curve.family.state(p.u) for p in curve.points])
    points = np.array([curve.family.values(p.u) for p in curve.points])
    near = np.argsort(np.abs(points[:, 1] - 0.5))[:8]
    middle, unit = points[near, 1].mean(), np.ptp(points[near, 1])
    q2 = np.polyval(np.polyfit((points[near, 1] - middle) / unit, points[near, 0], 7), (0.5 - middle) / unit)
    assert turns_back(saddles[near[0]], q2 - 1e-6, 0.5)
    assert not turns_back(saddles[near[0]], q2 + 1e-6, 0.5)
    (end,) = (one for one in curve.special if one.kind == "saddle_node_homoclinic")

    def fold(z):
        return [*oxidation(z[:3], z[3], end.values[1]), np.linalg.det(jacobian(oxidation, z[:3], z[3], end.values[1]))]

    assert end.values[0] == pytest.approx(fsolve(fold, [*saddles[0], end.values[0]], xtol=1e-13)[3], abs=1e-6)


@pytest.mark.slow
def test_oxidation__within_a_budget():
    """What was found before the limit is kept, and what was not found is named."""
    curves, bounds = oxidation_curves()
    takens = specials(curves, "bogdanov_takens")[:1]
    loops = [loop for one in takens for loop in loops_beside(one)]
    (curve,) = homoclinic_curves(loops[:1], bounds, HomoclinicSettings(to_follow=20))
    assert curve.ends == ("budget", "budget")
    assert len(curve.points) > 5
    lost = []
    assert homoclinic_curves(loops, bounds, HomoclinicSettings(to_start=3), lost) == []
    assert lost == loops
