"""Normal forms of maps, tests of stability, and continuation of curves, all of which stand on paper: no integration."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.branches.arclength import Point, Settings, correct, cubic, kernel_of, tangent_of, trace
from pipeline.analysis.branches.bifurcations import CONTRADICTORY, Bifurcation, _explains, _root, find_root, turns_twice
from pipeline.analysis.branches.homoclinic_curves import saddle_quantity
from pipeline.analysis.branches.kinds import BRANCHING, DOUBLING, FOLD, HOPF, PITCHFORK, TORUS, TRANSCRITICAL
from pipeline.analysis.branches.lockstep import Query, run_alone, run_together
from pipeline.analysis.branches.normal_forms import (
    FORMS,
    Case,
    _cubic,
    _judge_sign,
    _quadratic,
    _tell_branch_point,
    critical_vectors,
    settled,
)
from pipeline.analysis.branches.problems import Rows, Value

PLAIN = SimpleNamespace(scaled=lambda matrix: matrix)
"""A family whose states have the scale 1."""


def coefficient(kind: str, n: int, slope, form=None) -> tuple[float, float]:
    """Return a coefficient of a map of n states with its fixed point at 0, from its derivative, and its error."""
    case = Case(PLAIN, kind, np.zeros(n + 1), slope(np.zeros(n)))
    neighbours = np.array([slope(u[:n]) for u in case.neighbours()])
    value, error, _ = settled(case.coefficients(form or FORMS[kind], neighbours))
    return value, error


@pytest.mark.parametrize(("a", "b"), [(0.7, 0.0), (0.5, -0.1), (0.0, 0.3), (1.0, -2.0)])
def test_doubling__of_a_map_with_square_and_cube(a: float, b: float) -> None:
    """x -> -x + a x^2 + b x^3: a^2 + b (Kuznetsov 2004, Ch. 4)."""
    found, error = coefficient(DOUBLING, 1, lambda x: np.array([[-1.0 + 2.0 * a * x[0] + 3.0 * b * x[0] ** 2]]))
    assert found == pytest.approx(a * a + b, abs=1e-8)
    assert error < 1e-6


def test_doubling__along_a_centre_manifold() -> None:
    """(x, y) -> (-x + x y, y/2 + x^2): y = 2 x^2 on it, so x -> -x + 2 x^3."""

    def slope(s: np.ndarray) -> np.ndarray:
        return np.array([[-1.0 + s[1], s[0]], [2.0 * s[0], 0.5]])

    assert coefficient(DOUBLING, 2, slope)[0] == pytest.approx(2.0, abs=1e-8)


def test_fold__is_half_of_the_second_derivative() -> None:
    """(x, y) -> (x + a x^2 + y^2, y/2): the eigenvector is x alone, and its sign is free."""

    def slope(s: np.ndarray) -> np.ndarray:
        return np.array([[1.0 - 1.5 * s[0], 2.0 * s[1]], [0.0, 0.5]])

    assert abs(coefficient(FOLD, 2, slope)[0]) == pytest.approx(0.75, abs=1e-9)


@pytest.mark.parametrize("d", [-0.4, 0.25 + 0.6j])
@pytest.mark.parametrize("angle", [0.7, 2.3])
def test_torus__of_a_rotation_with_a_cubic_term(d: complex, angle: float) -> None:
    """z -> e^(i angle) z (1 + d |z|^2) with z = x + i y: 2 Re d, since the unit eigenvector has z = sqrt(2) w."""
    turn = np.exp(1j * angle)

    def image(s: np.ndarray) -> np.ndarray:
        z = s[0] + 1j * s[1]
        w = turn * z * (1.0 + d * abs(z) ** 2)
        return np.array([w.real, w.imag])

    def slope(s: np.ndarray) -> np.ndarray:  # complex steps are not for |z|: the cubic's exact derivative by parts
        x, y = s[:2]
        z = x + 1j * y
        by_x, by_y = (turn * (e * (1.0 + d * abs(z) ** 2) + z * d * 2.0 * r) for e, r in ((1.0, x), (1j, y)))
        return np.array([[by_x.real, by_y.real], [by_x.imag, by_y.imag]])

    step = 1e-6
    difference = (image(np.array([0.3 + step, 0.2])) - image(np.array([0.3 - step, 0.2]))) / (2.0 * step)
    np.testing.assert_allclose(slope(np.array([0.3, 0.2]))[:, 0], difference, atol=1e-8)
    found, error = coefficient(TORUS, 2, slope)
    assert found == pytest.approx(2.0 * np.real(d), abs=1e-7)
    assert error < 1e-6


def test_cubic__of_a_pitchfork_along_a_centre_manifold() -> None:
    """(x, y) -> (x + x y - x^3, y/2 + x^2): y = 2 x^2, so x -> x + x^3; the square vanishes."""

    def slope(s: np.ndarray) -> np.ndarray:
        return np.array([[1.0 + s[1] - 3.0 * s[0] ** 2, s[0]], [2.0 * s[0], 0.5]])

    assert coefficient(BRANCHING, 2, slope, _cubic)[0] == pytest.approx(1.0, abs=1e-8)
    assert coefficient(BRANCHING, 2, slope, _quadratic)[0] == pytest.approx(0.0, abs=1e-9)


def test_critical_vectors__are_dual_and_belong_to_the_kind() -> None:
    matrix = np.array([[1.0, 3.0, 0.0], [0.0, -1.0, 2.0], [0.0, 0.0, 0.4]])
    for kind, value in ((FOLD, 1.0), (DOUBLING, -1.0)):
        critical, q, p = critical_vectors(matrix, kind)
        assert critical == pytest.approx(value)
        np.testing.assert_allclose(matrix @ q, value * q, atol=1e-12)
        np.testing.assert_allclose(matrix.T @ p, value * p, atol=1e-12)
        assert np.vdot(p, q) == pytest.approx(1.0)
    turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    critical, q, p = critical_vectors(turn, TORUS)
    assert critical == pytest.approx(np.exp(1j))
    assert np.vdot(p, q) == pytest.approx(1.0)


def test_settled__takes_the_flattest_size_of_step() -> None:
    assert settled(np.array([3.0, 2.0, 1.01, 1.0, 1.02, 7.0]))[::2] == (1.0, 3)
    assert settled(np.array([3.0, 2.0, 1.01, 1.0, 1.02, 7.0]))[1] == pytest.approx(0.02)
    value, error, k = settled(np.full(5, np.nan))
    assert np.isnan([value, error]).all()
    assert k == -1


def located(kind: str, **more: object) -> Bifurcation:
    value = Value(np.array([0.0]), np.zeros((1, 2)), np.zeros((1, 1)), np.eye(1))
    return Bifurcation(kind, Point(np.zeros(2), np.zeros(2), value, 0), 0.0, 0, 1, True, **more)


@pytest.mark.parametrize(
    ("kind", "coefficient_", "word"),
    [
        (DOUBLING, 0.5, "supercritical"),
        (DOUBLING, -0.5, "subcritical"),
        (TORUS, -0.5, "supercritical"),
        (HOPF, 0.5, "subcritical"),
        (DOUBLING, 0.05, ""),  # smaller than its error
        (FOLD, 0.5, ""),  # has no sign
    ],
)
def test_judge_sign__by_coefficients_beyond_their_errors(kind, coefficient_, word) -> None:
    one = located(kind, coefficient=coefficient_, coefficient_error=0.1)
    _judge_sign(one)
    assert one.criticality == word


def test_judge_sign__two_witnesses_may_contradict_each_other() -> None:
    one = located(DOUBLING, coefficient=0.5, coefficient_error=0.1, criticality="subcritical")
    _judge_sign(one)
    assert one.criticality == CONTRADICTORY


@pytest.mark.parametrize(
    ("square", "cubic_", "kind"),
    [
        ((1.0, 1e-9), (0.0, 1e-9), TRANSCRITICAL),
        ((1e-12, 1e-12), (-2.0, 1e-6), PITCHFORK),
        ((0.01, 0.02), (-2.0, 1e-6), BRANCHING),  # neither certain nor small
        ((np.nan, np.nan), (-2.0, 1e-6), BRANCHING),
    ],
)
def test_tell_branch_point__by_its_square(square, cubic_, kind) -> None:
    one = located(BRANCHING)
    _tell_branch_point(one, square, cubic_, 1.0)
    assert one.kind == kind
    assert (one.criticality == "supercritical") == (kind == PITCHFORK)


@pytest.mark.parametrize(
    ("jacobian", "sum_"),
    [
        (np.diag([0.5, -0.8, -3.0]), -0.3),
        (np.diag([2.0, 1.0, -0.25]), 0.75),
        (np.array([[1.0, 0, 0], [0, -0.4, -2.0], [0, 2.0, -0.4]]), 0.6),  # a saddle focus
        (np.diag([-1.0, -2.0]), np.nan),
    ],
)
def test_saddle_quantity__adds_the_leading_rates(jacobian, sum_) -> None:
    assert saddle_quantity(jacobian) == pytest.approx(sum_, nan_ok=True)


@pytest.mark.parametrize(
    ("kinds", "change", "explained"),
    [([], 0, True), ([], 1, False), ([TORUS], 2, True), ([TORUS], 1, False), ([FOLD, DOUBLING], 2, True)],
)
def test_explains__changes_of_stability(kinds, change, explained) -> None:
    assert _explains(kinds, change) == explained


# ---- curves ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plane:
    """One equation in two unknowns: no trajectory is integrated."""

    function: object
    gradient: object
    system = SimpleNamespace(label="plane", n_states=1)
    size = 2

    def rows(self, u: np.ndarray) -> Rows:
        return Rows(np.zeros((0, 1)), np.zeros(0), np.zeros((0, 0)), 1)

    def value(self, u: np.ndarray, ends: object) -> Value:
        slope = np.asarray(self.gradient(*u))
        return Value(np.array([self.function(*u)]), slope[None], np.zeros((1, 1)), np.eye(1))


CIRCLE = Plane(lambda x, p: x * x + p * p - 1.0, lambda x, p: [2.0 * x, 2.0 * p])
FINE = Settings(first_step=0.02, longest_step=0.05, max_points=200, tolerance=1e-12)


def point_on(problem: Plane, u: tuple[float, float], along: tuple[float, float]) -> Point:
    return run_alone(correct(problem, np.array(u), np.array(along), FINE))


def test_trace__goes_round_a_circle_past_its_folds() -> None:
    found = run_alone(trace(CIRCLE, point_on(CIRCLE, (1.0, 0.0), (0.0, 1.0)), FINE))
    u = np.array([p.u for p in found.points])
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, atol=1e-12)
    angle = np.unwrap(np.arctan2(u[:, 1], u[:, 0]))
    assert (np.diff(angle) > 0.0).all()
    assert angle[-1] > 2.0 * np.pi
    assert np.diff(angle).max() <= 2.0 * 0.0501  # the circle has the range 2
    tangents = np.array([p.tangent for p in found.points])
    np.testing.assert_allclose(tangents, np.stack([-u[:, 1], u[:, 0]], axis=1), atol=1e-12)
    assert found.end == "max_points"


def test_trace__is_stuck_where_the_curve_ends() -> None:
    """The curve x = sqrt(p) from p = 1 down, in the half plane x > .1 alone."""
    half = Plane(
        lambda x, p: x * x - p if x > 0.1 else np.nan, lambda x, p: [2.0 * x, -1.0] if x > 0.1 else [np.nan, np.nan]
    )
    found = run_alone(trace(half, point_on(half, (1.0, 1.0), (-0.4, -0.8)), FINE))
    assert found.end == "stuck"
    assert found.points[-1].u == pytest.approx([0.1, 0.01], abs=1e-4)


def test_trace__between_and_stop_have_a_say() -> None:
    start = point_on(CIRCLE, (1.0, 0.0), (0.0, 1.0))

    def short(a: Point, b: Point):
        yield from ()
        return float(np.linalg.norm(b.u - a.u)) < 0.011

    found = run_alone(trace(CIRCLE, start, FINE, lambda points: "far" if points[-1].u[1] > 0.5 else "", short))
    assert found.end == "far"
    steps = np.linalg.norm(np.diff([p.u for p in found.points], axis=0), axis=1)
    assert steps.max() < 0.011
    assert found.points[-1].u[1] == pytest.approx(0.5, abs=0.011)


def test_correct__none_where_there_is_no_solution() -> None:
    assert run_alone(correct(CIRCLE, np.array([3.0, 0.0]), np.array([0.0, 1.0]), FINE)) is None
    never = Plane(lambda x, p: x * x + 1.0, lambda x, p: [2.0 * x, 0.0])
    assert run_alone(correct(never, np.array([0.5, 0.0]), np.array([0.0, 1.0]), FINE)) is None


def test_tangent_of__follows_the_direction_and_is_none_at_a_crossing() -> None:
    value = run_alone(_value(CIRCLE, (0.6, 0.8)))
    np.testing.assert_allclose(tangent_of(value, np.array([0.0, 1.0])), [-0.8, 0.6])
    np.testing.assert_allclose(tangent_of(value, np.array([0.0, -1.0])), [0.8, -0.6])
    np.testing.assert_allclose(np.abs(kernel_of(value)), [0.8, 0.6])
    cross = Plane(lambda x, p: x * p, lambda x, p: [p, x])
    assert tangent_of(run_alone(_value(cross, (0.0, 0.0))), np.array([1.0, 0.0])) is None


def _value(problem: Plane, u: tuple[float, float]):
    return (yield Query(problem, np.array(u)))


def test_run_together__answers_each_its_own_problem() -> None:
    line = Plane(lambda x, p: x - 3.0 * p, lambda x, p: [1.0, -3.0])
    one, other = run_together([_value(CIRCLE, (2.0, 0.0)), _value(line, (2.0, 1.0))])
    assert (one.residual.item(), other.residual.item()) == (3.0, -1.0)


def test_cubic__is_exact_between_and_beyond_for_cubics() -> None:
    """Of the graph (s, s^3 - s) over its chord; tangents count with the length of the chord."""
    a, b = (SimpleNamespace(u=np.array([s, s**3 - s]), tangent=np.array([1.0, 3.0 * s * s - 1.0])) for s in (0.0, 1.0))
    for share in (0.25, 0.5, 1.2):
        np.testing.assert_allclose(cubic(a, b, share), [share, share**3 - share], atol=1e-14)


def test_turns_twice__two_folds_within_a_step() -> None:
    def ends(depth: float) -> list[SimpleNamespace]:
        """Points at x = -1 and 1 of p = x^3 - depth x, with unit tangents."""
        found = []
        for x in (-1.0, 1.0):
            tangent = np.array([1.0, 3.0 - depth])
            found.append(SimpleNamespace(u=np.array([x, x**3 - depth * x]), tangent=tangent / np.linalg.norm(tangent)))
        return found

    assert turns_twice(*ends(0.9))
    assert not turns_twice(*ends(-0.5))  # p rises throughout


def test_find_root__brackets_a_zero_on_a_curve() -> None:
    """On the circle from (1, 0) to (0, 1), x = p at sqrt(1/2)."""
    ends = [point_on(CIRCLE, (np.cos(t), np.sin(t)), (-np.sin(t), np.cos(t))) for t in (0.6, 1.0)]

    def tested(point: Point):
        yield from ()
        return float(point.u[0] - point.u[1])

    start, stop = ((p, p.u[0] - p.u[1]) for p in ends)
    (low, at_low), (high, at_high) = run_alone(find_root(CIRCLE, start, stop, tested, FINE))
    assert at_low * at_high <= 0.0
    for one in (low, high):
        np.testing.assert_allclose(one.u, np.sqrt(0.5), atol=1e-6)
        assert np.linalg.norm(one.u) == pytest.approx(1.0, abs=1e-12)


def test_root__of_inverse_interpolation() -> None:
    """Through three values of x^3 - 2 the inverse parabola has its exact root where the inverse is a parabola."""
    parabola = [(y * y + 3.0 * y + 5.0, y) for y in (1.0, -0.5, 2.0)]
    assert _root(parabola) == pytest.approx(5.0)
    assert np.isnan(_root([(0.0, 1.0), (1.0, 1.0)]))
