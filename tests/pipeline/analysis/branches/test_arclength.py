"""Step lengths of pseudo-arclength continuation: curves with a closed form, without an engine."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.branches.arclength import Point, Settings, kernel_of, trace
from pipeline.analysis.branches.bifurcations import Watch
from pipeline.analysis.branches.problems import Value


class Closed:
    """Zeros of a function of the unknowns, the last of which is the free parameter in its scale."""

    def __init__(self, function, matrix=None):
        self.function, self.matrix = function, matrix
        self.family = SimpleNamespace(scales=(1.0,))

    def value(self, u):
        step = 1e-6 * np.maximum(np.abs(u), 1e-4)
        slopes = [(self.function(u + h) - self.function(u - h)) / (2.0 * h.sum()) for h in np.diag(step)]
        matrix = np.diag(np.full(len(u) - 1, 0.5)) if self.matrix is None else self.matrix(u)
        return Value(np.asarray(self.function(u)), np.array(slopes).T, np.zeros((1, len(u) - 1)), matrix, 1.0)


def answered(computation):
    """Run a computation to its end, and return its result."""
    try:
        query = next(computation)
        while True:
            query = computation.send(query.problem.value(query.u))
    except StopIteration as end:
        return end.value


def followed(curve, u, stop, watch=False):
    """Follow a curve upwards from a solution; return its points, its end and its watch."""
    value = curve.value(np.array(u))
    tangent = kernel_of(value)
    start = Point(np.array(u), tangent * np.sign(tangent[-1]), value, 0)
    seen = Watch(curve, Settings()) if watch else None
    found = answered(trace(curve, start, Settings(), stop, seen and seen.between))
    return np.array([point.u for point in found.points]), found.end, seen


def until(high):
    """Return the rule that a curve ends above a value of the parameter."""
    return lambda points: "bound" if points[-1].u[-1] > high else ""


@pytest.mark.parametrize("size", [1.0, 60.0, 1e4])
def test_trace__a_curve_that_moves_far(size):
    """p = (x^3 - 3 x)/8 with x in units of 1/size, from fold to fold and on to the bound."""
    curve = Closed(lambda u: np.array([u[1] - ((u[0] / size) ** 3 - 3.0 * u[0] / size) / 8.0]))
    points, end, _ = followed(curve, [-2.2 * size, (-(2.2**3) + 6.6) / 8.0], until(0.5))
    assert end == "bound"
    assert len(points) < 2600
    x = points[:, 0] / size
    np.testing.assert_allclose(points[:, 1], (x**3 - 3.0 * x) / 8.0, atol=1e-9)
    assert (np.diff(x) > 0.0).all()
    assert np.abs(np.diff(points[:, 1])).max() < 1.1 * Settings().longest_step
    turns = np.flatnonzero(np.diff(np.sign(np.diff(points[:, 1]))))
    np.testing.assert_allclose(points[turns + 1, 1], [0.25, -0.25], atol=1e-4)


def test_trace__the_peak_of_a_linear_oscillator():
    """x'' = -.02 x' - x + .7 cos(omega t): the peak .7/(.02 sqrt(1 - .0001)) on one curve."""

    def function(u):
        omega = 0.5 + 1.5 * u[2]
        gap = (1.0 - omega**2 + 0.02j * omega) * complex(u[0], u[1]) - 0.7
        return np.array([gap.real, gap.imag])

    first = 0.7 / (1.0 - 0.25 + 0.01j)
    points, end, _ = followed(Closed(function), [first.real, first.imag, 0.0], until(1.0))
    assert end == "bound"
    assert len(points) < 2000
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(0.7 / (0.02 * np.sqrt(1.0 - 1e-4)), rel=1e-4)


def test_trace__an_unknown_that_moves_little_beside_one_that_moves_far():
    """x = 1000 p and y = sin(20 p), of range 2: the steps grow in x, and no more than twofold in y."""
    curve = Closed(lambda u: np.array([u[0] - 1e3 * u[2], u[1] - np.sin(20.0 * u[2])]))
    points, end, _ = followed(curve, [0.0, 0.0, 0.0], until(1.0))
    assert end == "bound"
    assert len(points) < 4000
    assert np.abs(np.diff(points[:, 1])).max() < 1.1 * 2.0 * Settings().longest_step


@pytest.mark.parametrize("ratio", [1.0, 1e3])
def test_trace__an_ellipse(ratio):
    """Once round a long ellipse: x = ratio cos s, p = .5 sin s."""
    curve = Closed(lambda u: np.array([(u[0] / ratio) ** 2 + (2.0 * u[1]) ** 2 - 1.0]))

    def stop(points):
        s = np.arctan2(2.0 * points[-1].u[1], points[-1].u[0] / ratio)
        return "closed" if len(points) > 5 and 0.0 > s > -0.01 else ""

    points, end, _ = followed(curve, [ratio, 0.0], stop)
    assert end == "closed"
    assert len(points) < 3000
    s = np.unwrap(np.arctan2(2.0 * points[:, 1], points[:, 0] / ratio))
    assert s[-1] == pytest.approx(2.0 * np.pi, abs=0.02)
    assert (np.diff(s) > 0.0).all()


def test_watch__folds_of_a_branch_that_moves_far():
    """p = x/1000 + .01 cos(pi x/30): it turns where sin(pi x/30) = 30/(10 pi), twice in each 60 of x."""
    curve = Closed(lambda u: np.array([u[1] - u[0] / 1e3 - 0.01 * np.cos(np.pi * u[0] / 30.0)]))
    _, end, seen = followed(curve, [0.0, 0.01], until(0.26), watch=True)
    assert end == "bound"
    x = [one.point.u[0] for one in seen.found if one.kind == "fold"]
    first = 30.0 / np.pi * np.arcsin(3.0 / np.pi)
    wanted = [60.0 * k + place for k in range(5) for place in (first, 30.0 - first)]
    np.testing.assert_allclose(x, wanted[: len(x)], atol=1e-4)
    assert len(x) >= 8
