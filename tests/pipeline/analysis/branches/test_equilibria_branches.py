"""Branches of equilibria of flows: folds, branch points, Hopf points, and the cycles that leave them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

from magpend_core.crossing import Crossing
from magpend_core.models import load_model
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import branches_table
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.bifurcations import n_unstable
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import EquilibriumProblem, Family
from tests.core.cells import scipy_end
from tests.core.flows import model_of, table
from tests.core.models.test_library import EQUATIONS

BRUSSELATOR = table(
    "brusselator",
    {"x": "a + x^2*y - (b + 1)*x", "y": "b*x - x^2*y"},
    {"a": 1.2, "b": 2.0},
    states={"x": {"scale": 2.0}, "y": {"scale": 0.5}},
)


def branches_of(model, parameter, interval, state, value, section=None, step=5e-3, **overrides):
    """Follow the branches of an equilibrium of a model."""
    seen = model if section is None else sectioned(model, section)
    parameters = seen.load(**overrides)
    low, high = interval
    rate, scope = section.frequency_hz if section else 1.0, Scope(low, high, 2, settings=Settings(longest_step=step))
    family = Family(seen.system, 0, rate, parameters.pack(), (parameter,), (high - low,))
    return explore([Start(family, np.array(state, float), value)], scope), parameters


def only(branch, kind):
    (found,) = [b for b in branch.bifurcations if b.kind == kind]
    return found, branch.family.values(found.point.u)[0]


@pytest.mark.slow
def test_equilibria__folds_of_a_cubic():
    """m = x^3 - 3 x: folds at x = -1 and 1, m = 2 and -2; stable, unstable, stable."""
    model = model_of({"x": "m + 3*x - x^3"}, {"m": 0.0})
    (branch,), _ = branches_of(model, "m", (-4.0, 4.0), [2.1], 2.1**3 - 6.3)
    folds = sorted((branch.family.values(b.point.u)[0], branch.family.state(b.point.u)[0]) for b in branch.bifurcations)
    np.testing.assert_allclose(folds, [(-2.0, 1.0), (2.0, -1.0)], atol=1e-7)
    states = np.array([branch.family.state(p.u)[0] for p in branch.points])
    np.testing.assert_allclose(branch.values, states**3 - 3.0 * states, atol=1e-8)
    unstable = [p.value.monodromy[0, 0] > 0.0 for p in branch.points]
    assert unstable == (np.abs(states) < 1.0).tolist()
    assert branch.ends == ("bound", "bound")


def test_equilibria__without_the_engine(monkeypatch):
    """Predator and prey, whose states reach 100: two folds within few evaluations, all of them in numpy."""
    rates = {"x": "x - x*z/(1 + p*x) - x^2/100", "z": "-z + x*z/(1 + p*x) - 3*z^2/10"}
    model, counted = model_of(rates, {"p": 0.3}), []
    monkeypatch.setattr("pipeline.analysis.branches.lockstep.section_map", None)
    value = EquilibriumProblem.value
    monkeypatch.setattr(EquilibriumProblem, "value", lambda *a: counted.append(1) or value(*a))

    def nullclines(x, p):
        z = (1.0 - x / 100.0) * (1.0 + p * x)
        return -1.0 + x / (1.0 + p * x) - 0.3 * z, z

    roots = [brentq(lambda x: nullclines(x, 0.3)[0], *ends) for ends in ((1.0, 10.0), (10.0, 40.0), (50.0, 80.0))]
    (branch,), _ = branches_of(model, "p", (0.05, 0.55), [roots[2], nullclines(roots[2], 0.3)[1]], 0.3)
    assert [b.kind for b in branch.bifurcations] == ["fold", "fold"]
    assert branch.ends == ("bound", "bound")
    assert len(counted) < 1200
    states = np.array([branch.family.state(p.u)[0] for p in branch.points])
    crossed = np.flatnonzero(np.diff(np.sign(branch.values - 0.3)))
    for root in roots:
        assert min(abs(states[k : k + 2].mean() - root) - np.ptp(states[k : k + 2]) for k in crossed) < 0.0


def test_equilibria__two_hopf_points_within_a_step():
    """Growth (p - .503)^2 - 1e-4: Hopf points at .493 and .513, nearer than the longest step."""
    model = model_of({"x": "g*x - y", "y": "x + g*y"}, {"p": 0.0}, define={"g": "(p - 503/1000)^2 - 1/10000"})
    (branch,), _ = branches_of(model, "p", (0.0, 1.0), [0.0, 0.0], 0.1)
    found = [branch.family.values(b.point.u)[0] for b in branch.bifurcations]
    np.testing.assert_allclose(found, [0.493, 0.513], atol=1e-7)


@pytest.mark.slow
def test_equilibria__folds_of_a_branch_whose_states_move_far():
    """Predator and prey: the prey moves from 2 to 80. At a fold the determinant of the Jacobian, taken here, is 0."""
    equations = {"x": "x - x*z/(1 + alpha*x) - 0.01*x^2", "z": "-z + x*z/(1 + alpha*x) - delta*z^2"}
    model = model_of(equations, {"alpha": 0.1, "delta": 0.3})
    (branch,), _ = branches_of(model, "alpha", (0.05, 0.55), [1.6, 1.2], 0.1)

    def fold(v):
        x, z, alpha = v
        eats, saturation = z / (1.0 + alpha * x) ** 2, x / (1.0 + alpha * x)
        slopes = [[alpha * x * eats - 0.01 * x, -saturation], [eats, -0.3 * z]]
        rates = (1.0 - z / (1.0 + alpha * x) - 0.01 * x, -1.0 + saturation - 0.3 * z)
        return (*rates, np.linalg.det(slopes))

    wanted = [fsolve(fold, guess)[-1] for guess in ((6.0, 3.0, 0.36), (45.0, 7.6, 0.28))]
    found = [branch.family.values(b.point.u)[0] for b in branch.bifurcations if b.kind == "fold"]
    np.testing.assert_allclose(found, wanted, rtol=1e-8)
    assert branch.ends == ("bound", "bound")
    assert len(branch.points) < 2000


@pytest.mark.parametrize("x", [0.5, 0.505, 0.51])
def test_equilibria__both_folds_in_one_step(x):
    """m = x^3 - 3 c^2 x: folds at x = -c and c, much nearer to each other than the longest step."""
    c = 0.002
    model = model_of({"x": "m + 3*c^2*x - x^3"}, {"m": 0.0, "c": c})
    (branch,), _ = branches_of(model, "m", (-1.0, 1.0), [x], x**3 - 3.0 * c**2 * x, step=0.02)
    folds = sorted((branch.family.values(b.point.u)[0], branch.family.state(b.point.u)[0]) for b in branch.bifurcations)
    assert [m for m, _ in folds] == pytest.approx([-2.0 * c**3, 2.0 * c**3], abs=2e-10)
    assert [x for _, x in folds] == pytest.approx([c, -c], abs=2e-6)


@pytest.mark.slow
def test_explore__a_start_at_a_fold_lies_on_the_branch_that_turns_there():
    """m = x^2: the branch is the same from (1, 1) and from its fold, beyond all points of it."""
    model = model_of({"x": "x^2 - m"}, {"m": 0.5})
    family = Family(model.system, 0, 1.0, model.load().pack(), ("m",), (1.5,))
    starts = [Start(family, np.array([-1.0]), 1.0), Start(family, np.array([1e-9]), 0.0)]
    for given in (starts, starts[::-1]):
        (branch,) = explore(given, Scope(-0.5, 1.0, 2))
        assert only(branch, "fold")[1] == pytest.approx(0.0, abs=1e-9)
        assert branch.ends == ("bound", "bound")


@pytest.mark.slow
def test_equilibria__lorenz():
    """Subcritical Hopf point at sigma (sigma + beta + 3)/(sigma - beta - 1) = 470/19."""
    x = np.sqrt(8.0 / 3.0 * 23.0)
    section = Crossing("z", 23.0, "up", 50.0)
    found, parameters = branches_of(load_model("lorenz"), "rho", (23.0, 26.0), [x, x, 23.0], 24.0, section, 0.05)
    wing = found[0]
    hopf, rho = only(wing, "hopf")
    assert rho == pytest.approx(470.0 / 19.0, abs=1e-7)
    assert hopf.criticality == "subcritical"
    # the characteristic polynomial there is (s + sigma + beta + 1)(s^2 + beta (sigma + rho))
    assert hopf.critical_multiplier.imag == pytest.approx(np.sqrt(8.0 / 3.0 * (10.0 + rho)), rel=1e-7)
    cycles = hopf.child
    assert cycles is not None
    assert cycles.family.period == 1
    assert cycles.ends[0] == "start"
    assert (np.diff(cycles.values[:20]) < 0.0).all()
    assert {int((np.abs(np.linalg.eigvals(p.value.monodromy)) > 1.0).sum()) for p in cycles.points[1:20]} == {1}
    lines = branches_table(dataset_of(found, "rho", parameters)).lines
    assert any("hopf" in line and "subcritical" in line and "equilibrium" in line for line in lines)


@pytest.mark.slow
def test_equilibria__pitchfork_that_the_first_guess_hits_exactly():
    """x' = (p - 1/2) x - x^3: at x = 0 the test function is p - 1/2, and no tangent is unique where it vanishes."""
    model = model_of({"x": "(p - 0.5)*x - x^3"}, {"p": 0.0})
    (branch, *_), _ = branches_of(model, "p", (0.0, 1.0), [0.0], 0.25, step=0.05)
    _, value = only(branch, "pitchfork")
    assert value == pytest.approx(0.5, abs=1e-9)


@pytest.mark.slow
def test_equilibria__pitchfork_of_lorenz():
    """At rho = 1 the branches of both wings cross that of rest, whose stability changes."""
    found, _ = branches_of(load_model("lorenz"), "rho", (0.5, 3.0), [0.0, 0.0, 0.0], 0.7, step=0.02)
    rest, wings = found
    at, rho = only(rest, "pitchfork")
    assert rho == pytest.approx(1.0, abs=1e-7)
    assert (at.n_unstable_before, at.n_unstable_after) == (0, 1)
    assert at.criticality == "supercritical"
    states = np.array([wings.family.state(p.u) for p in wings.points])
    np.testing.assert_allclose(states[:, 0] ** 2, 8.0 / 3.0 * (wings.values - 1.0), atol=1e-7)
    assert states[:, 0].min() < -2.0
    assert states[:, 0].max() > 2.0


@pytest.mark.slow
def test_hopf__of_the_brusselator_has_the_amplitude_of_its_cycles():
    """b = 1 + a^2, w = a, supercritical; amplitudes by the coefficient and by scipy."""
    a, model = 1.2, load_model(BRUSSELATOR)
    section = Crossing("x", a, "up", 100.0)
    found, parameters = branches_of(model, "b", (1.5, 3.5), [a, 2.0 / a], 2.0, section)
    hopf, b = only(found[0], "hopf")
    assert b == pytest.approx(1.0 + a * a, abs=1e-8)
    assert hopf.critical_multiplier.imag == pytest.approx(a, rel=1e-8)
    assert hopf.criticality == "supercritical"
    assert hopf.coefficient_error < 1e-5 * abs(hopf.coefficient)
    family, near = found[0].family, 4e-3
    # real part of the eigenvalues: (b - 1 - a^2)/2
    radius = np.sqrt(-0.5 * near / (a * hopf.coefficient))
    vector = np.linalg.eig(family.scaled(hopf.point.value.monodromy))[1][:, 0]

    def rates(t, z):
        x, y = z
        return [a + x * x * y - (b + near + 1.0) * x, (b + near) * x - x * x * y]

    settled = scipy_end(rates, [a + 0.08, (b + near) / a], 6e3, 1e-9)
    last = solve_ivp(rates, (0.0, 12.0), settled, method="DOP853", rtol=1e-10, atol=1e-12, max_step=0.01).y
    assert 2.0 * radius * abs(vector[0]) * 2.0 == pytest.approx(0.5 * np.ptp(last[0]), rel=0.01)
    cycles = hopf.child
    assert cycles is not None
    assert cycles.family.parameters[-1] == pytest.approx(a)
    ds = dataset_of(found, "b", parameters)
    assert ds["bifurcation_period_s"].values[ds["kind"].values == 4][0] == pytest.approx(2.0 * np.pi / a, rel=1e-7)
    assert family.period == 0


def test_equilibrium_problem__derivative():
    """Differences of the rates."""
    seen = sectioned(load_model("lorenz"), Crossing("z", 27.0))
    family = Family(seen.system, 0, 0.02, seen.load().pack(), ("rho",), (10.0,))
    problem = EquilibriumProblem(family)
    u = family.unknowns(np.array([3.0, 4.0, 12.0]), [14.0])
    value, h = problem.value(u, None), 1e-6
    by_differences = [
        (problem.value(u + h * e, None).residual - problem.value(u - h * e, None).residual) / (2.0 * h)
        for e in np.eye(4)
    ]
    np.testing.assert_allclose(value.derivative, np.transpose(by_differences), atol=1e-7)


@pytest.mark.slow
def test_equilibria__flutter_rig():
    """Hopf point and fold of the cycles as own shooting with DOP853 found them (Lee, Barton and Renson's model)."""
    found, _ = branches_of(load_model("flutter"), "U", (14.0, 20.0), [0.0] * 6, 19.0, Crossing("h", 0.0, "up", 5.0))
    hopf, speed = only(found[0], "hopf")
    assert speed == pytest.approx(17.957265, abs=1e-6)
    assert hopf.criticality == "subcritical"
    cycles = hopf.child
    assert cycles is not None
    _, fold = only(cycles, "fold")
    assert fold == pytest.approx(14.6601239, abs=1e-6)
    unstable = [p for p in cycles.points if 16.0 < cycles.family.values(p.u)[0] < 16.1 and n_unstable(p) == 1]
    assert unstable
    state, seconds = shooting(cycles.family, unstable[0])
    np.testing.assert_allclose(cycles.family.state(unstable[0].u), state, atol=1e-8)
    assert unstable[0].value.seconds == pytest.approx(seconds, rel=1e-8)


def shooting(family, point):
    """The same cycle by scipy and the rates of test_library: state where heave rises through 0, and period."""
    rates, published = EQUATIONS["flutter"]
    own = {**published, "U": float(family.values(point.u)[0])}

    def mismatch(unknowns):
        start = np.array([0.0, *unknowns[:5]])
        return scipy_end(lambda t, z: rates(t, z, own), start, unknowns[5]) - start

    guess = np.array([*family.state(point.u)[1:], point.value.seconds]) * (1.0 + 1e-4)
    found, _, good, _ = fsolve(mismatch, guess, xtol=1e-13, full_output=True)
    assert good == 1
    return np.array([0.0, *found[:5]]), found[5]
