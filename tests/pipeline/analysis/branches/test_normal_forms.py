"""Coefficients of normal forms, against exact maps and the shape of the branches."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from pipeline.analysis.branches.bifurcations import CONTRADICTORY, Bifurcation
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.normal_forms import critical_vectors, judge
from pipeline.analysis.branches.problems import Family
from tests.core.flows import model_of, table

pytestmark = pytest.mark.slow

FREQUENCY = 0.5
PERIOD = 1.0 / FREQUENCY

RADIAL = table(
    "radial",
    {"x": "mu*x - w*y + a*x*(x^2 + y^2) + F*cos(2*pi*f*t) - G*sin(2*pi*f*t)", "y": "w*x + mu*y + a*y*(x^2 + y^2)"},
    {"mu": 0.0, "w": 1.3, "a": -0.7, "F": 0.0, "G": 0.0},
)
SCALAR = table(
    "scalar", {"x": "mu*x + a*x^2 + b*x^3 + F*cos(2*pi*f*t)", "y": "-y"}, {"mu": 0.0, "a": 0.0, "b": 0.0, "F": 0.0}
)


def at_rest(equations, interval=(-0.5, 0.4), **values):
    """Follow the orbit at 0 of a model along `mu`, and return its branches."""
    model = load_model(equations)
    family = Family(model.system, 1, FREQUENCY, model.load(**values).pack(), ("mu",), (1.0,))
    low, high = interval
    return explore([Start(family, np.zeros(2), low + 0.03)], Scope(low, high, max_period=1, max_generations=1))


def root_mean_square(family, u, q, period=1):
    """Root of the mean square of the motion that begins with q beside an orbit of the Duffing oscillator, by DOP853."""
    names = ("damping", "linear", "cubic", "amplitude")
    values = dict(zip(family.system.parameter_names, family.rows(u[None]).parameters[0], strict=True))
    damping, linear, cubic, amplitude = (values[name] for name in names)
    seconds = period / family.frequency_hz

    def rates(t, y):
        x, v, dx, dv, _ = y
        force = amplitude * np.cos(2.0 * np.pi * family.frequency_hz * t)
        bend = linear + 3.0 * cubic * x**2
        return [*(v, force - damping * v - linear * x - cubic * x**3), *(dv, -damping * dv - bend * dx, dx**2 + dv**2)]

    start = [*family.state(u), *q.real, 0.0]
    found = solve_ivp(rates, (0.0, seconds), start, method="DOP853", rtol=1e-11, atol=1e-12)
    return np.sqrt(found.y[-1, -1] / seconds)


def only(branch, kind):
    (found,) = [b for b in branch.bifurcations if b.kind == kind]
    return found


@pytest.mark.parametrize("a", [-0.7, 0.4])
def test_neimark_sacker__of_a_radial_flow(a):
    """r' = a r^3 at mu = 0, so that the map over T is r + a T r^3 + ..., and r^2 = 2 |z|^2 with |q| = 1."""
    one = only(at_rest(RADIAL, a=a)[0], "neimark_sacker")
    assert one.point.u[-1] == pytest.approx(0.0, abs=1e-8)
    assert one.coefficient == pytest.approx(2.0 * a * PERIOD, rel=1e-6)
    assert abs(one.coefficient - 2.0 * a * PERIOD) < 3.0 * one.coefficient_error + 1e-7
    assert one.criticality == ("supercritical" if a < 0.0 else "subcritical")


def test_neimark_sacker__of_a_flow_seen_at_even_times():
    """The map over T of a flow at its Hopf point: d = T w l1, quadratic terms included (Brusselator)."""
    found = {}
    for drive in ("", " + F*cos(2*pi*f*t)"):
        rates = {"x": "a + x^2*y - (b + 1)*x" + drive, "y": "b*x - x^2*y"}
        model = model_of(rates, {"a": 1.2, "b": 2.0, "F": 0.0})
        family = Family(model.system, 1 if drive else 0, FREQUENCY, model.load().pack(), ("b",), (1.0,))
        (branch, *_) = explore([Start(family, np.array([1.2, 2.0 / 1.2]), 2.0)], Scope(1.8, 2.8, 1, max_generations=1))
        (one,) = branch.bifurcations
        found[one.kind] = one
    hopf, torus = found["hopf"], found["neimark_sacker"]
    assert torus.point.u[-1] == pytest.approx(hopf.point.u[-1], abs=1e-8)
    assert torus.coefficient == pytest.approx(PERIOD * 1.2 * hopf.coefficient, rel=1e-5)


def test_equilibria__with_a_bent_centre_manifold_and_an_eigenvalue_near_one():
    """y = x^2/2 turns x' = x y into x^3/2; at the fold x' = -x^2 with q = (1, 1)/sqrt(2). The third state stays 0."""
    rates = {"x": "p*x + x*y", "y": "-2*y + x^2"}, {"x": "p - x^2", "y": "x - y"}
    known = ("pitchfork", 0.5), ("fold", np.sqrt(0.5))
    for own, start, (kind, value) in zip(rates, ([0.0, 0.0, 0.0], [1.0, 1.0, 0.0]), known, strict=True):
        model = model_of({**own, "z": "9*z/10"}, {"p": 0.0})
        family = Family(model.system, 0, FREQUENCY, model.load().pack(), ("p",), (1.0,))
        at = start[0] - 0.3 * (kind == "pitchfork")
        branch, *_ = explore([Start(family, np.array(start), at)], Scope(-0.5, 1.2, 1, max_generations=1))
        one = only(branch, kind)
        assert abs(one.coefficient) == pytest.approx(value, abs=1e-6)
        assert one.criticality == ("subcritical" if kind == "pitchfork" else "")


def test_judge__the_section_may_be_at_any_phase_of_the_drive():
    """A later phase is another drive, F cos(phase) and F sin(phase), of the same folds."""
    model, found = load_model(RADIAL), []
    for phase in (0.0, 1.0):
        own = model.load(w=3.0, F=0.3 * np.cos(phase), G=0.3 * np.sin(phase))
        family = Family(model.system, 1, FREQUENCY, own.pack(), ("mu",), (1.0,))
        (branch,) = explore([Start(family, np.zeros(2), -0.5)], Scope(-0.6, 1.2, 1, max_generations=1))
        found.append(sorted((one.point.u[-1], one.coefficient) for one in branch.bifurcations))
    assert len(found[0]) == 2
    np.testing.assert_allclose(*found, rtol=1e-7)  # a fold is located to 1e-8


@pytest.mark.parametrize("b", [-1.0, 0.5])
def test_branch_point__pitchfork(b):
    """x' = b x^3 at mu = 0: the map is x + b T x^3 + ..."""
    one = only(at_rest(SCALAR, b=b)[0], "pitchfork")
    assert one.coefficient == pytest.approx(b * PERIOD, rel=1e-6)
    assert one.criticality == ("supercritical" if b < 0.0 else "subcritical")


def test_branch_point__transcritical():
    """x' = a x^2 at mu = 0: the map is x + a T x^2 + ..."""
    one = only(at_rest(SCALAR, a=0.8, b=-1.0)[0], "transcritical")
    assert abs(one.coefficient) == pytest.approx(0.8 * PERIOD, rel=1e-6)
    assert one.criticality == ""


def test_fold__bends_the_branch_as_its_coefficient_says(settled):
    """On the centre manifold x = x + beta + b x^2: the orbits lie at x^2 = -beta/b, beta = <p, dF/dmu>."""
    parameters, frequency = load_model("duffing").load(damping=0.1, linear=1.0, cubic=1.0, amplitude=0.1), 0.7 / np.pi
    family = Family(parameters.model.system, 1, frequency, parameters.pack(), ("amplitude",), (1.95,))
    start = Start(family, settled(parameters, frequency, [0.0, 0.0], 100), 0.1)
    branch = explore([start], Scope(0.05, 2.0, max_period=2))[0]
    folds = [one for one in branch.bifurcations if one.kind == "fold"]
    assert len(folds) == 2
    for one in folds:
        family, u = branch.family, one.point.u
        _, q, p = critical_vectors(family.scaled(one.point.value.monodromy), "fold")
        slope = np.vdot(p, one.point.value.derivative[:, -1]).real
        along = np.array([np.vdot(p, point.u[:-1] - u[:-1]).real for point in branch.points])
        beta = slope * np.array([point.u[-1] - u[-1] for point in branch.points])
        away = np.array([np.linalg.norm(point.u - u) for point in branch.points])
        near = (away < 0.04) & (np.abs(along) > 2e-3)
        assert near.sum() > 4
        # the next order is odd: both sides together cancel it
        ratio = np.polynomial.Polynomial.fit(along[near], -beta[near] / along[near] ** 2, 2)(0.0)
        assert one.coefficient == pytest.approx(abs(ratio) / root_mean_square(family, u, q), rel=1e-3)
        assert one.coefficient_error < 1e-5 * abs(one.coefficient)


def test_doubling__orbits_of_twice_the_period_are_as_far_as_its_coefficient_says(cascade):
    """x -> -(1 + beta) x + c x^3: the orbits lie at x^2 = beta/c."""
    singles = [b for b in cascade[1] if b.family.period == 1]
    found = [(b, one) for b in singles for one in b.bifurcations if one.kind == "period_doubling" and one.child]
    assert found
    for parent, one in found:
        family, u, child = parent.family, one.point.u, one.child
        _, q, p = critical_vectors(family.scaled(one.point.value.monodromy), "period_doubling")
        multipliers = [np.linalg.eigvals(point.value.monodromy) for point in parent.points]
        least = np.array([m.real.min() for m in multipliers])
        values = np.array([point.u[-1] for point in parent.points])
        near = np.abs(values - u[-1]) < 0.03
        slope = np.polynomial.Polynomial.fit(values[near] - u[-1], least[near] + 1.0, 3).deriv()(0.0)
        shares = []
        for point in child.points:
            orbit = np.array([family.unknowns(x, [0.0])[:-1] for x in point.value.images])
            half = 0.5 * np.vdot(p, orbit[0] - orbit[1]).real
            if 3e-3 < abs(half) < 0.03:
                shares.append((half**2, -slope * (point.u[-1] - u[-1]) / half**2))
        assert len(shares) > 3
        ratio = np.polynomial.Polynomial.fit(*np.transpose(shares), 1)(0.0)
        assert one.coefficient == pytest.approx(ratio / root_mean_square(family, u, q) ** 2, rel=0.02)
        assert one.criticality == ("supercritical" if one.coefficient > 0.0 else "subcritical")
    parent, one = next(
        (b, one) for b in cascade[1] for one in b.bifurcations if one.kind == "period_doubling" and one.child
    )
    wrong = "subcritical" if one.criticality == "supercritical" else "supercritical"
    other = Bifurcation("period_doubling", one.point, 0.0, 0, 1, True, criticality=wrong)
    judge([(parent.family, other)])
    assert other.criticality == CONTRADICTORY
    assert other.coefficient == pytest.approx(one.coefficient, rel=1e-12)
