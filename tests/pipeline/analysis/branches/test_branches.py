"""Branches of periodic orbits, against exact solutions and scipy's integrators."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve

from magpend_core import load_preset
from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.orbits import scaled_distance
from pipeline.analysis.branches.analysis import table_of, windows_of
from pipeline.analysis.branches.arclength import Point, Settings
from pipeline.analysis.branches.bifurcations import Bifurcation, counts_of, multipliers_of, n_unstable, tell_apart
from pipeline.analysis.branches.curves import continue_curves
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, cross, explore
from pipeline.analysis.branches.following import Branch, first_point
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.lockstep import Query, run_alone, run_together
from pipeline.analysis.branches.problems import Family, OrbitProblem, Value, doubling_test, fold_test, torus_test
from pipeline.analysis.branches.starting_orbits import orbits_near
from tests.core.cells import run_cells, scipy_end, stroboscopic_map
from tests.core.flows import model_of

DUFFING, VAN_DER_POL = load_model("duffing").system, load_model("forced-van-der-pol").system
LONG = Settings(longest_step=0.02)


def coefficients(parameters):
    """Damping, nonlinear damping, linear and cubic stiffness and force, of (mu, A) or (damping, linear, cubic, A)."""
    if len(parameters) == 2:
        return -parameters[0], parameters[0], 1.0, 0.0, parameters[1]
    return parameters[0], 0.0, *parameters[1:]


def family(frequency, parameters, free, scale, period=1, system=None):
    system = system or {2: VAN_DER_POL, 4: DUFFING}[len(parameters)]
    return Family(system, period, frequency, np.array(parameters, float), (free,), (scale,))


def flow(state, frequency, parameters, share=1.0):
    """Image of a state and the derivative of the map, by scipy."""
    damping, nonlinear, linear, cubic, amplitude = coefficients(parameters)
    omega = 2.0 * np.pi * frequency

    def rates(t, z):
        x, v, *m = z
        stiffness = linear + 3.0 * cubic * x * x + 2.0 * nonlinear * x * v
        friction = damping + nonlinear * x * x
        force = amplitude * np.cos(omega * t) - friction * v - linear * x - cubic * x**3
        m = np.reshape(m, (2, 2))
        return [v, force, *m[1], *(-stiffness * m[0] - friction * m[1])]

    start = [*state, 1.0, 0.0, 0.0, 1.0]
    end = scipy_end(rates, start, share / frequency)
    return end[:2], end[2:].reshape(2, 2)


def settled(state, frequency, parameters, n_periods=60):
    """Section point after some periods, by scipy."""

    damping, nonlinear, linear, cubic, amplitude = coefficients(parameters)

    def rates(t, z):
        force = amplitude * np.cos(2.0 * np.pi * frequency * t)
        return [z[1], force - (damping + nonlinear * z[0] * z[0]) * z[1] - linear * z[0] - cubic * z[0] ** 3]

    return scipy_end(rates, state, n_periods / frequency, 1e-8)


def recomputed(bifurcation, orbits, test, parameters_at):
    """Where scipy finds the same bifurcation, from a start that is a little off."""

    def equations(unknowns):
        frequency, parameters = parameters_at(unknowns[2])
        image, matrix = flow(unknowns[:2], frequency, parameters)
        return [*(image - unknowns[:2]), test(matrix)]

    u = bifurcation.point.u
    start = np.append(orbits.state(u), orbits.values(u)[0]) * (1.0 + 1e-4)
    found, _, good, _ = fsolve(equations, start, xtol=1e-13, full_output=True)
    assert good == 1
    return found[2]


def only(branch, kind):
    return [b for b in branch.bifurcations if b.kind == kind]


@pytest.mark.slow
def test_explore__linear_oscillator():
    """The exact orbit and multipliers at every frequency."""
    damping, linear, amplitude = 0.3, 4.0, 1.0
    orbits = family(0.2, [damping, linear, 0, amplitude], "frequency", 0.5)
    (branch,) = explore([Start(orbits, np.zeros(2), 0.2)], Scope(0.1, 0.6, settings=LONG))
    assert branch.ends == ("bound", "bound")
    assert not branch.bifurcations
    np.testing.assert_array_equal(branch.values[[0, -1]], [0.1, 0.6])
    omega = 2.0 * np.pi * branch.values
    response = amplitude / (linear - omega**2 + 1j * damping * omega)
    states = np.array([orbits.state(p.u) for p in branch.points])
    np.testing.assert_allclose(states, np.stack([response.real, -omega * response.imag], axis=1), atol=1e-9)
    root = -damping / 2.0 + 1j * np.sqrt(linear - damping**2 / 4.0)
    exact = np.exp(root / branch.values)
    for point, value in zip(branch.points, exact, strict=True):
        assert np.abs(multipliers_of(point) - value).min() < 1e-9


@pytest.fixture(scope="module")
def resonance():
    """The bent resonance of a hardening spring: stable, unstable, stable again."""
    orbits = family(0.1, [0.1, 1.0, 1.0, 0.3], "frequency", 0.3)
    (branch,) = explore([Start(orbits, np.array([0.3, 0.0]), 0.1)], Scope(0.1, 0.4))
    return orbits, branch


@pytest.mark.slow
def test_explore__folds_of_duffing(resonance):
    orbits, branch = resonance
    upper, lower = only(branch, "fold")
    assert branch.bifurcations == [upper, lower]
    for fold, sides in ((upper, (0, 1)), (lower, (1, 0))):
        assert (fold.n_unstable_before, fold.n_unstable_after) == sides
        assert fold.bracket < 1e-8
        assert abs(fold.critical_multiplier - 1.0) < 1e-6
        there = recomputed(fold, orbits, fold_test, lambda f: (f, orbits.parameters))
        assert orbits.values(fold.point.u)[0] == pytest.approx(there, abs=1e-8)
    # Liouville: the flow contracts areas by exp(-damping T), on stable and unstable orbits
    _, branch = resonance
    found = [np.linalg.det(p.value.monodromy) for p in branch.points]
    np.testing.assert_allclose(found, np.exp(-0.1 / branch.values), rtol=1e-9)
    assert {n_unstable(p) for p in branch.points} == {0, 1}
    assert max(p.residual for p in branch.points) < 1e-10


@pytest.mark.slow
def test_explore__starts_on_one_branch(resonance):
    """All coexisting orbits at one frequency lie on the one bent branch, which is followed once."""
    orbits, branch = resonance
    folds = [orbits.values(b.point.u)[0] for b in branch.bifurcations]
    middle = float(np.mean(folds))
    crossings = np.flatnonzero(np.diff(branch.values > middle))
    guesses = [np.append(branch.points[i].u[:2], middle / 0.3) for i in crossings]
    points = run_together([first_point(OrbitProblem(orbits), u, Settings()) for u in guesses])
    starts = [Start(orbits, orbits.state(p.u), middle) for p in points]
    assert len({round(float(s.state[0]), 3) for s in starts}) == 3
    assert len(explore(starts, Scope(0.1, 0.4, settings=Settings(longest_step=0.03)))) == 1


@pytest.mark.slow
def test_dataset_of__resonance(resonance):
    """Three stable segments' worth of tables: numbers as on the branch."""
    _, branch = resonance
    ds = dataset_of([branch], "frequency", load_model("duffing").load())
    assert (ds.sizes["angle"], "side" in ds) == (0, False)
    upper, lower = sorted(table_of(ds), key=lambda row: -row["frequency_hz"])
    assert [upper["type"], lower["type"]] == ["fold", "fold"]
    assert (upper["unstable_below"], upper["unstable_above"]) == ("0|1", "none")
    assert (lower["unstable_below"], lower["unstable_above"]) == ("none", "0|1")
    first, second = windows_of(ds)
    assert (first["begins"], first["ends"]) == ("bound", "fold")
    assert (second["begins"], second["ends"]) == ("fold", "bound")
    assert (first["to"], second["from"]) == (upper["frequency_hz"], lower["frequency_hz"])


@pytest.mark.slow
def test_explore__period_doublings(cascade):
    orbits, branches = cascade
    assert [b.family.period for b in branches] == [1, 2, 4]
    first, second = (only(b, "period_doubling")[0] for b in branches[:2])
    there = recomputed(first, orbits, doubling_test, lambda a: (orbits.frequency_hz, [*orbits.parameters[:3], a]))
    assert orbits.values(first.point.u)[0] == pytest.approx(there, abs=1e-8)
    assert (first.n_unstable_before, first.n_unstable_after) == (0, 1)
    assert first.criticality == second.criticality == "supercritical"
    assert first.child is branches[1]
    assert branches[1].origin is first
    # the doubled orbit is stable until its own doubling, and not the single one
    point = branches[1].points[5]
    assert n_unstable(point) == 0
    image, _ = flow(
        branches[1].family.state(point.u), orbits.frequency_hz, [*orbits.parameters[:3], branches[1].values[5]]
    )
    assert np.abs(image - branches[1].family.state(point.u)).max() > 1e-3


@pytest.mark.slow
def test_explore__start_on_doubled_orbit(cascade):
    """From the doubled orbit the single one is found as the branch that it ends on."""
    orbits, branches = cascade
    middle = branches[1].points[10]
    state, value = branches[1].family.state(middle.u), branches[1].values[10]
    again = explore([Start(branches[1].family, state, float(value))], Scope(0.2, 0.3, max_period=2))
    assert sorted(b.family.period for b in again) == [1, 2]
    single, double = sorted(again, key=lambda b: b.family.period)
    assert only(single, "period_doubling")[0].child is double
    np.testing.assert_allclose(
        orbits.values(only(single, "period_doubling")[0].point.u),
        orbits.values(only(branches[0], "period_doubling")[0].point.u),
        atol=1e-8,
    )


@pytest.mark.slow
def test_explore__neimark_sacker():
    """A forced van der Pol oscillator leaves entrainment through a torus."""
    parameters = [0.2, 0.4]
    orbits = family(0.16, parameters, "frequency", 0.05)
    (branch,) = explore(
        [Start(orbits, settled([1.0, 1.5], 0.16, parameters), 0.16)],
        Scope(0.15, 0.22, settings=Settings(longest_step=0.03)),
    )
    tori = only(branch, "neimark_sacker")
    assert tori
    for torus in tori:
        assert abs(abs(torus.critical_multiplier) - 1.0) < 1e-7
        assert torus.critical_multiplier.imag > 0.1
        assert sorted((torus.n_unstable_before, torus.n_unstable_after)) == [0, 2]
        there = recomputed(torus, orbits, torus_test, lambda f: (f, parameters))
        assert orbits.values(torus.point.u)[0] == pytest.approx(there, abs=1e-8)


@pytest.mark.slow
def test_explore__symmetry_breaking():
    """The symmetric orbit of a symmetric spring; scipy finds the pitchfork with the half-period map."""
    parameters = [0.1, 0.0, 1.0, 0.3]
    orbits = family(1.0 / (2.0 * np.pi), parameters, "amplitude", 1.0)
    settings = Settings(longest_step=0.01)
    scope = Scope(0.1, 2.5, max_period=1, settings=settings)
    branches = explore([Start(orbits, settled([0.0, 0.0], orbits.frequency_hz, parameters), 0.3)], scope)
    pitchfork = only(branches[0], "pitchfork")[0]
    broken = pitchfork.child
    assert broken is not None

    def equations(unknowns):
        image, matrix = flow(unknowns[:2], orbits.frequency_hz, [*parameters[:3], unknowns[2]], share=0.5)
        # the symmetry: x(t + T/2) = -x(t), so that the half-period map with a turn has the orbit as its
        # fixed point, and the multiplier -1 where the symmetry breaks
        return [*(-image - unknowns[:2]), doubling_test(-matrix)]

    u = pitchfork.point.u
    start = np.append(orbits.state(u), orbits.values(u)[0])
    there, _, good, _ = fsolve(equations, start * (1 + 1e-5), xtol=1e-13, full_output=True)
    assert good == 1
    assert orbits.values(u)[0] == pytest.approx(there[2], abs=1e-7)

    # where an arm is followed first, through the point and on to its mirror image, all is the same
    i = len(broken.points) // 4
    arm, symmetric = Start(orbits, orbits.state(broken.points[i].u), float(broken.values[i])), branches[0]
    ends = broken.points[0], broken.points[-1], symmetric.points[-1]
    at_bound = [Start(orbits, orbits.state(point.u), 2.5) for point in ends]
    again = explore([arm, *at_bound], scope)
    assert len(again) == 2
    (same,) = [b for branch in again for b in only(branch, "pitchfork")]
    assert same.child is again[0]
    assert same.criticality == pitchfork.criticality == "supercritical"
    assert orbits.values(same.point.u)[0] == pytest.approx(orbits.values(u)[0], abs=1e-8)
    for found in (branches, again):
        ds = dataset_of(found, "amplitude", None)
        assert sorted(row["type"] for row in table_of(ds)) == ["fold", "fold", "pitchfork"]
        (row,) = [row for row in table_of(ds) if row["type"] == "pitchfork"]
        assert (row["unstable_below"], row["unstable_above"]) == ("0", "1")
        windows = [w for w in windows_of(ds) if w["begins"] == "supercritical pitchfork"]
        assert [w["from"] for w in windows] == pytest.approx([orbits.values(u)[0]] * 2)
        assert min(w["to"] - w["from"] for w in windows) > 1e-3

    far = broken.points[-1] if broken.points[0] is pitchfork.point else broken.points[0]
    half, _ = flow(orbits.state(far.u), orbits.frequency_hz, [*parameters[:3], orbits.values(far.u)[0]], 0.5)
    assert np.abs(half + orbits.state(far.u)).max() > 1e-2
    # at the branch point the tangent is any vector of a plane, by LAPACK's last bits: it must not matter
    plane = np.linalg.svd(pitchfork.point.value.derivative)[2][-2:]
    for tangent in (plane[0], plane.sum(axis=0) / np.sqrt(2.0)):
        pitchfork.child = None
        pitchfork.point.tangent[:] = tangent
        cross([(branches[0], pitchfork)], branches[:1], (0.1, 2.5), settings)
        assert pitchfork.child is not None
        ends = [orbits.values(pitchfork.child.points[i].u)[0] for i in (0, -1)]
        assert ends == pytest.approx([2.5, 2.5])  # the symmetric branch ends at 0.1


@pytest.mark.slow
def test_explore__pitchforks_of_a_doubled_orbit():
    """The damped Meissner equation with a cubic spring: x(t + T) = -x(t), until the multiplier +1 of one period."""
    equations = {"x": "v", "v": "-c*v - (d + 0.5*sign(cos(2*pi*f*t)))*x - x**3"}
    model = model_of(equations, {"c": 0.1, "d": 0.3})
    frequency, parameters = 1.0 / (2.0 * np.pi), model.load().pack()
    reached, _ = stroboscopic_map(
        parameters[None], np.array([frequency]), np.array([[0.5, 0.1]]), 400, system=model.system
    )
    orbits = family(frequency, parameters, "d", 0.3, period=2, system=model.system)
    scope = Scope(0.05, 0.35, max_period=2, max_generations=0, settings=LONG)
    (branch,) = explore([Start(orbits, reached[0, -1], 0.3)], scope)
    rows = table_of(dataset_of([branch], "d", None))
    assert [row["type"] for row in rows] == ["pitchfork", "pitchfork"]
    assert [(row["unstable_below"], row["unstable_above"]) for row in rows] == [("0", "1"), ("1", "0")]

    def broken(unknowns):
        z = np.append(unknowns[:2], [1.0, 0.0, 0.0, 1.0])
        for sign, quarters in ((1.0, 1.0), (-1.0, 2.0), (1.0, 1.0)):
            stiffness = unknowns[2] + 0.5 * sign

            def rates(t, z, k=stiffness):
                m = np.reshape(z[2:], (2, 2))
                return [z[1], -0.1 * z[1] - k * z[0] - z[0] ** 3, *m[1], *(-(k + 3.0 * z[0] ** 2) * m[0] - 0.1 * m[1])]

            z = scipy_end(rates, z, quarters * np.pi / 2.0)
        return [*(z[:2] + unknowns[:2]), fold_test(z[2:].reshape(2, 2))]

    for one, value in zip(
        sorted(branch.bifurcations, key=lambda b: b.point.u[-1]), (0.0878658, 0.1839501), strict=True
    ):
        found = fsolve(broken, np.append(orbits.state(one.point.u), value), xtol=1e-13)
        assert orbits.values(one.point.u)[0] == pytest.approx(found[2], abs=1e-8)
        assert found[2] == pytest.approx(value, abs=6e-8)


@pytest.mark.slow
def test_continue_curves__fold_of_duffing(resonance):
    """The fold at another amplitude, against scipy."""
    orbits, branch = resonance
    family_2 = Family(DUFFING, 1, 0.1, orbits.parameters, ("frequency", "amplitude"), (0.3, 0.2))
    fold = only(branch, "fold")[0]
    start = family_2.unknowns(orbits.state(fold.point.u), [orbits.values(fold.point.u)[0], 0.3])
    (curve,) = continue_curves([(0, family_2, "fold", start)], ((0.1, 0.4), (0.2, 0.4)))
    assert max(p.residual for p in curve.points) <= 1e-8
    far = min(curve.points, key=lambda p: abs(family_2.values(p.u)[1] - 0.35))
    frequency, amplitude = family_2.values(far.u)
    parameters = [*orbits.parameters[:3], amplitude]

    def equations(unknowns):
        image, matrix = flow(unknowns[:2], unknowns[2], parameters)
        return [*(image - unknowns[:2]), fold_test(matrix)]

    there = fsolve(equations, np.append(family_2.state(far.u), frequency) * (1 + 1e-5), xtol=1e-13)
    assert frequency == pytest.approx(there[2], abs=1e-8)
    assert abs(frequency - orbits.values(fold.point.u)[0]) > 1e-3
    # a second point of the same curve is recognised
    both = [(0, family_2, "fold", start), (1, family_2, "fold", far.u)]
    assert [c.start for c in continue_curves(both, ((0.1, 0.4), (0.2, 0.4)))] == [0]


@pytest.mark.slow
def test_explore__rotation():
    """A pendulum that turns over once per period: closed on its circle, one turn, round a fold."""
    model = load_model("driven-pendulum")
    frequency, parameters = 0.32, {"d": 0.5, "w0": 1.0, "A": 1.0, "bias": 1.0}

    def rates(t, z):
        force = parameters["A"] * np.cos(2.0 * np.pi * frequency * t) + parameters["bias"]
        return [z[1], force - parameters["d"] * z[1] - parameters["w0"] ** 2 * np.sin(z[0])]

    end = scipy_end(rates, [0.0, 2.0], 80 / frequency, 1e-8)
    end[0] = np.remainder(end[0], 2.0 * np.pi)
    orbits = family(frequency, model.load(**parameters).pack(), "A", 1.0, system=model.system)
    (branch,) = explore([Start(orbits, end, 1.0)], Scope(0.05, 1.2, max_period=1))
    folds = only(branch, "fold")
    assert len(folds) == 1
    ds = dataset_of([branch], "A", None)
    assert ds["rotation"].values.tolist() == [[1.0]]
    parameters["A"] = float(branch.values[7])
    state = orbits.state(branch.points[7].u)
    image = scipy_end(rates, state, 1 / frequency)
    np.testing.assert_allclose(image - state, [2.0 * np.pi, 0.0], atol=1e-9)


@pytest.mark.slow
def test_orbits_near__chaotic_well():
    """Recurrences of a chaotic trajectory lead to unstable orbits, each a fixed point by scipy too."""
    parameters = [0.3, -1.0, 1.0, 0.5]
    frequency = 1.2 / (2.0 * np.pi)
    # by the engine, whose bits depend on no CPU: with those of scipy, chaos makes it another trajectory
    points, _ = stroboscopic_map(
        np.array([parameters]), np.array([frequency]), np.array([[1.0, 0.0]]), 400, system=DUFFING
    )
    found = orbits_near(points[:, 30:], frequency, np.array(parameters), 4, DUFFING)
    assert len(found) >= 5
    seen = []
    for state, period in found:
        assert not any(np.abs(state - other).max() < 1e-6 for other in seen)
        image = state
        matrix = np.eye(2)
        for k in range(period):
            image, step = flow(image, frequency, parameters)
            seen.append(image)
            matrix = step @ matrix
            assert (np.abs(image - state).max() < 1e-8) == (k == period - 1)
        assert np.abs(np.linalg.eigvals(matrix)).max() > 1.0


def test_run_together__same_bits():
    """Values do not depend on what else is computed, nor on the periods beside."""
    settings = Settings()
    orbits = [family(0.1, [0.1, 1.0, 1.0, 0.3], "frequency", 0.3, period=p) for p in (1, 2, 3)]

    def corrected(o):
        return first_point(OrbitProblem(o), o.unknowns(np.array([0.4, 0.1]), [0.1]), settings)

    alone = [run_alone(corrected(o)) for o in orbits]
    for count in (3, 9):
        together = run_together([corrected(o) for o in orbits * (count // 3)])
        for a, b in zip(alone * (count // 3), together, strict=True):
            np.testing.assert_array_equal(a.u, b.u)
            np.testing.assert_array_equal(a.value.monodromy, b.value.monodromy)


def evaluated(problem, u):
    value = yield Query(problem, u)
    return value


@pytest.mark.slow
def test_orbit_problem__periods_side_by_side_are_the_whole_orbit():
    """Three periods from a point that is on no orbit: image, monodromy matrix and slope are scipy's."""
    parameters = [0.1, 1.0, 1.0, 0.3]
    orbits = family(0.2, parameters, "amplitude", 0.5, period=3)
    problem = OrbitProblem(orbits)

    def by_scipy(state, amplitude):
        matrix = np.eye(2)
        for _ in range(3):
            state, one = flow(state, 0.2, [*parameters[:3], amplitude])
            matrix = one @ matrix
        return state, matrix

    for x, amplitude in ((0.4, 0.3), (0.401, 0.3), (0.43, 0.32), (-0.6, 0.2)):
        state, step = np.array([x, 0.1]), 1e-5
        u = orbits.unknowns(state, [amplitude])
        value = run_alone(evaluated(problem, u))
        image, monodromy = by_scipy(state, amplitude)
        above, below = (by_scipy(state, amplitude + d)[0] for d in (step, -step))
        np.testing.assert_allclose(value.images[-1], image, atol=1e-9)
        np.testing.assert_allclose(value.residual, image - state, atol=1e-9)
        # off a solution the derivative may err by the gaps between the periods
        np.testing.assert_allclose(value.monodromy, monodromy, atol=1e-4)
        # a difference over 1e-7 of a map that is known to 1e-12
        np.testing.assert_allclose(value.derivative[:, 2], 0.5 * (above - below) / (2.0 * step), atol=1e-4)
        assert value.seconds == pytest.approx(15.0)
        assert problem.rows(u).period == (1 if x > 0.0 else 3)  # the last one is too far from the one before
    start = orbits.unknowns(settled([0.4, 0.1], 0.2, parameters), [0.3])
    closed = run_alone(first_point(problem, start, Settings()))
    image, monodromy = by_scipy(orbits.state(closed.u), 0.3)
    np.testing.assert_allclose(closed.value.images[-1], image, atol=1e-9)
    np.testing.assert_allclose(closed.value.monodromy, monodromy, atol=1e-8)


@pytest.mark.slow
def test_explore__followed_ahead(resonance):
    """The first starts of other attractors are followed beside; the branches are those without this."""
    orbits, branch = resonance
    starts = [
        Start(orbits, orbits.state(branch.points[i].u), float(branch.values[i]), attractor)
        for i, attractor in ((3, 0), (9, 0), (12, 1), (20, 2))
    ]
    scope = Scope(0.1, 0.4, settings=Settings(longest_step=0.03))
    ahead, alone = (
        explore([replace(s, attractor=a(s)) for s in starts], scope) for a in (lambda s: s.attractor, lambda s: -1)
    )
    assert len(ahead) == len(alone) == 1
    assert len(ahead[0].points) > 20
    for a, b in zip(ahead[0].points, alone[0].points, strict=True):
        np.testing.assert_array_equal(a.u, b.u)


def point_of(matrix):
    """Point of a branch with a monodromy matrix."""
    value = Value(np.zeros(2), np.zeros((2, 3)), np.zeros((1, 2)), matrix)
    return Point(np.zeros(3), np.array([0.0, 0.0, 1.0]), value, 0)


def test_watch__neutral_saddle():
    """A real pair of product 1 makes the torus test vanish and is dropped; a complex pair is kept."""
    saddle, angle = np.diag([2.0, 0.5]), 1.0
    torus = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    found = []
    for matrix in (saddle, torus):
        assert torus_test(matrix) == pytest.approx(0.0)
        found.append(Bifurcation("neimark_sacker", point_of(matrix), 0.0, 1, 1, True))
    assert tell_apart(found, found[0].point) == found[1:]
    # Rounding decides the counts within a bracket, and at points beside it; the points farther away are certain
    points = [point_of(np.diag([mu, 0.1])) for mu in (0.9, 0.97, 1.0 + 1e-9, 1.03, 1.1)]
    (one,) = ones = [Bifurcation("branch_point", points[2], 0.0, 0, 0, True, after=2)]
    branch = Branch(family(1.0, [0.2, 0.4], "frequency", 1.0), points, ones, ("bound", "bound"))
    assert (one.n_unstable_before, one.n_unstable_after) == (0, 1)
    assert counts_of(branch.points, ones) == [0, 0, 0, 1, 1]
    # a branch that ends just beyond it has no point that is certain: the number changes by one
    for moduli, counts in (((0.9, 0.97, 1.0 - 1e-9), [0, 0, 1]), ((1.1, 1.03, 1.0 + 1e-9), [1, 1, 0])):
        points = [point_of(np.diag([mu, 0.1])) for mu in moduli]
        ones = [Bifurcation("branch_point", point_of(np.diag([1.0, 0.1])), 0.0, 0, 0, True, after=1)]
        Branch(branch.family, points, ones, ("bound", "bound"))
        assert (ones[0].n_unstable_before, ones[0].n_unstable_after) == (counts[1], counts[2])
        assert counts_of(points, ones) == counts
        ones[0].after = 0
        assert counts_of(points[::-1], ones) == counts[::-1]
    # where another branch that lists the bifurcation crosses, points between unequal ones keep their own numbers
    points = [point_of(np.diag([mu, 0.1])) for mu in (1.03, 1.0 - 5e-5, 0.97)]
    assert (counts_of(points, []), counts_of(points[::-1], [])) == ([1, 0, 0], [0, 0, 1])
    # two in one step, from 0 to 3: the pair that a torus changes and the fold's one
    points = [point_of(np.diag([mu, nu, xi])) for mu, nu, xi in ((0.9, 0.9, 0.9), (1.1, 1.1, 1.1))]
    two = [Bifurcation(kind, points[0], 0.0, 3, 3, True, after=0) for kind in ("fold", "neimark_sacker")]
    Branch(branch.family, points, two, ("bound", "bound"))
    assert [(one.n_unstable_before, one.n_unstable_after) for one in two] == [(0, 1), (1, 3)]


@pytest.mark.slow
def test_explore__closed_branch():
    """A weakly forced van der Pol oscillator: the entrained orbits and their saddles form a closed curve."""
    parameters = [0.2, 0.1]
    frequency = 1.0 / (2.0 * np.pi)
    orbits = family(frequency, parameters, "frequency", 0.02)
    start = Start(orbits, settled([1.0, 1.5], frequency, parameters, 200), frequency)
    (branch,) = explore([start], Scope(0.15, 0.17, max_period=1, settings=Settings(longest_step=0.05)))
    assert branch.ends == ("closed", "closed")
    assert sorted(b.kind for b in branch.bifurcations) == ["fold", "fold"]
    assert np.abs(branch.points[-1].u - branch.points[0].u).max() < 0.1
    # stable from fold to fold, across the start
    (window,) = windows_of(dataset_of([branch], "frequency", None))
    folds = sorted(orbits.values(b.point.u)[0] for b in branch.bifurcations)
    assert [window["from"], window["to"]] == folds
    # another orbit of it is recognised
    again = Start(orbits, orbits.state(branch.points[9].u), float(branch.values[9]))
    assert len(explore([start, again], Scope(0.15, 0.17, max_period=1, settings=Settings(longest_step=0.05)))) == 1


# ---- the pendulum ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def right_family():
    """The right one-sided orbit of period 1 and what hangs on it, around the period halving near 2.5 Hz."""
    parameters = load_preset()
    state = [0.01421118, 0.19932267, -2.74881127, 3.65512389]
    orbits = family(2.2, parameters.pack(), "frequency", 1.0, system=PENDULUM_FITTED)
    scope = Scope(2.15, 2.55, max_period=2, max_generations=1, settings=Settings(longest_step=0.02))
    return parameters, orbits, explore([Start(orbits, np.array(state), 2.2)], scope)


@pytest.mark.slow
def test_explore__right_family(right_family):
    """Where stability ends and comes back: the abrupt end is a subcritical doubling, the halving none."""
    _, orbits, branches = right_family
    single, double = branches
    abrupt, halving = only(single, "period_doubling")
    assert orbits.values(abrupt.point.u)[0] == pytest.approx(2.372224517, abs=1.5e-8)
    assert orbits.values(halving.point.u)[0] == pytest.approx(2.498608281, abs=1.5e-8)
    assert (abrupt.criticality, halving.criticality) == ("subcritical", "supercritical")
    assert abrupt.child is halving.child is double
    assert double.ends == ("start", "period_halving")
    # The multipliers next to a located doubling move on smoothly: friction's corner leaves no trace here
    _, orbits, (single, _) = right_family
    halving = only(single, "period_doubling")[1]
    at = orbits.values(halving.point.u)[0]
    tests = []
    for offset in (-2e-4, -1e-4, 1e-4, 2e-4):
        u = halving.point.u + offset / halving.point.tangent[-1] * halving.point.tangent
        u[-1] = at + offset
        tests.append(doubling_test(run_alone(first_point(OrbitProblem(orbits), u, Settings())).value.monodromy))
    left, right = tests[1] - tests[0], tests[3] - tests[2]
    # the slope changes by its own derivative only: with a corner, the two would differ at any offset
    assert left == pytest.approx(right, rel=1e-2)
    assert tests[1] * tests[2] < 0.0


@pytest.mark.slow
def test_explore__brute_force_agrees(right_family):
    """Inside the stable segments, sections of trajectories lie on the branch to 1e-6."""
    parameters, _, branches = right_family
    ds = dataset_of(branches, "frequency", parameters)
    chosen = [
        (i, j)
        for i, branch in enumerate(branches)
        for j in range(1, len(branch.points), 2)
        # nearer to a bifurcation the approach takes thousands of periods
        if np.abs(multipliers_of(branch.points[j])).max() < 0.985
    ]
    orbits = [ds["section"].values[i, j, : branches[i].family.period] for i, j in chosen]
    n = len(chosen)
    values = [branches[i].values[j] for i, j in chosen]
    starts = np.array([orbit[0] for orbit in orbits]) + [1e-3, -1e-3, 1e-2, 1e-2]
    options = {"n_transient": 1500, "n_keep": 4, "stop_when_closed": True, "closure_tolerance": 1e-7}
    result = run_cells(PENDULUM_FITTED, parameters.pack(), values, starts, rtol=1e-9, **options)
    assert result.orbit_period[:, 0].tolist() == [branches[i].family.period for i, _ in chosen]
    for orbit, sections in zip(orbits, result.section[:, 0], strict=True):
        for section in sections:
            assert scaled_distance(orbit, section, PENDULUM_FITTED).min() < 1e-6
    assert {i for i, _ in chosen} == {0, 1}
    assert n > 15
    assert set(np.unique(ds["side"].values[:, 0])) == {Side.RIGHT}


@pytest.mark.slow
def test_explore__doubled_branch_that_turns_at_once():
    """Of x' = -(1 + e) x - a x^3 + b x^5, orbits +-x at e = b x^4 - a x^2: subcritical, with a fold at -a^2/(4 b)."""
    a, b = 0.03, 1500.0
    model = model_of({"x": "-(1 + e)*x - a*x^3 + b*x^5"}, {"e": 0.0, "a": a, "b": b}, kind="map")
    family = Family(model.system, 1, 1.0, model.load().pack(), ("e",), (1.0,))
    parent, child, *_ = explore([Start(family, np.array([0.0]), -0.3)], Scope(-0.5, 0.3, 2))
    ((doubling,), (fold,)) = parent.bifurcations, child.bifurcations
    assert (doubling.kind, doubling.criticality) == ("period_doubling", "subcritical")
    assert fold.kind == "fold"
    # a residual of 1e-10 is 1.6e-8 of e at the small amplitude of the fold
    assert fold.point.u[-1] == pytest.approx(-(a**2) / (4.0 * b), abs=1e-8)
