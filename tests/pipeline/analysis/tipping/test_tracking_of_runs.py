"""Tracking, returning and tipping of runs whose parameter goes there and back: closed forms, and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.analysis.tipping.tracking import RETURN_TIPPING, RETURNING, TIPPING, TRACKING
from pipeline.runs.derive import derive
from pipeline.runs.drawing import figure
from tests.pipeline.factories import FOLD, quietly

pytestmark = pytest.mark.slow
EFFORT = {"settle": 60, "keep": 32, "steps": 32}


def run_of(folder, rate: str, *, rates, sizes, start, begin=0.0, n_keep=40, **drift):
    """Run x' = `rate` while l goes from `begin` to each size and back."""
    model = {**FOLD["model"], "equations": {"x": rate}}
    model["parameters"] = {"l": begin}
    axes = {"l_rate_per_s": {"values": rates}, "l_to": {"values": sizes}}
    starts = {"kind": "list", "points": [[start]]}
    integration = {**FOLD["integration"], "n_keep": n_keep}
    changes = {"model": model, "drift": {"l": drift}, "axes": axes, "initial_conditions": starts}
    quietly({**FOLD, **changes, "integration": integration}, folder)
    return folder


def courses_of(folder) -> np.ndarray:
    """Return the courses of a run over rates and sizes."""
    ds = derive(folder, "tipping", {**EFFORT, "parameter": "l_rate_per_s", "brackets": 0})
    return ds["course"].transpose("l_rate_per_s", "l_to", ...).values[..., 0]


def riccati(y: float, c: float, t: float) -> float:
    """Return the solution of y' = y**2 - c after a time; infinite if it diverges before."""
    if not np.isfinite(y):
        return np.inf
    w = np.sqrt(abs(c))
    if c < 0.0:
        angle = np.arctan(y / w) + w * t
        return w * np.tan(angle) if angle < 0.5 * np.pi else np.inf
    e = np.tanh(w * t)
    return w * (y - w * e) / (w - y * e) if y * e < w else np.inf


def of_fold(rate: float, size: float, hold: float) -> int:
    """Return the course of x' = (x + l)**2 - 1 from x = -1: y = x + l has y' = y**2 - 1 + l'."""
    turn = riccati(-1.0, 1.0 - rate, size / rate)
    end = riccati(riccati(turn, 1.0, hold), 1.0 + rate, size / rate)
    return (TRACKING if turn < 1.0 else RETURNING) if end < 1.0 else TIPPING


def test_courses__of_a_moving_fold_are_those_of_the_closed_form(tmp_path) -> None:
    rates, sizes, hold = [0.9, 1.2, 1.55, 1.7, 2.1, 3.2, 4.1], [1.5, 2.7, 3.1, 3.9, 4.9, 6.2], 0.2
    folder = run_of(tmp_path / "fold", "(x + l)**2 - 1", rates=rates, sizes=sizes, start=-1.0, hold_s=hold)
    expected = np.array([[of_fold(rate, size, hold) for size in sizes] for rate in rates])
    assert {TRACKING, RETURNING, TIPPING} == set(expected.ravel())
    np.testing.assert_array_equal(courses_of(folder), expected)
    # below the critical rate of long ramps, 1, the state is tracked at any size
    assert (expected[0] == TRACKING).all()
    drawn = figure(folder, "tipping", {**EFFORT, "parameter": "l_rate_per_s", "brackets": 0})
    np.testing.assert_array_equal(drawn.data["course"].transpose("l_rate_per_s", "l_to"), expected)


def test_tipping__critical_rate_of_a_smooth_shift(tmp_path) -> None:
    """For l = m (1 + tanh(m r t / 2)) / 2 the critical r is 4 / (m (m - 2)), m > 2: then y = x + l is linear in l.

    The ramp has the argument 10 times its share, so its mean rate is m**2 r / 20. It is cut at tanh(5).
    """
    sizes = [2.5, 4.0]
    folder = run_of(
        tmp_path / "smooth", "(x + l)**2 - 1", rates=[0.2, 0.3, 0.5, 1.2], sizes=sizes, start=-1.0, shape="tanh"
    )
    ds = derive(folder, "tipping", {**EFFORT, "parameter": "l_rate_per_s"})
    expected = [size**2 / 20.0 * 4.0 / (size * (size - 2.0)) for size in sizes]
    np.testing.assert_allclose(ds["critical_value"], expected, rtol=2e-3)
    course = ds["course"].transpose("l_rate_per_s", "l_to", ...).values[..., 0]
    rates = ds["l_rate_per_s"].values
    np.testing.assert_array_equal(course, np.where(rates[:, None] < expected, TRACKING, TIPPING))


def by_scipy(rate_of_x, x: float, begin: float, size: float, rate: float, hold: float) -> tuple[float, float]:
    """Return x at rest after a shift without the way back, and after one with it."""
    duration = abs(size - begin) / rate

    def far(t, y, *_):
        return abs(y[0]) - 50.0

    far.terminal = True

    def go(x, first, last, t):
        if abs(x) > 49.0:
            return x
        rhs = lambda s, y: [rate_of_x(y[0], first + (last - first) * s / t)]  # noqa: E731
        return solve_ivp(rhs, (0.0, t), [x], events=far, rtol=1e-10, atol=1e-12, method="DOP853").y[0, -1]

    turn = go(x, begin, size, duration)
    back = go(go(turn, size, size, hold), size, begin, duration)
    return go(turn, size, size, 60.0), go(back, begin, begin, 60.0)


def test_courses__between_two_thresholds_tip_on_the_way_back(tmp_path) -> None:
    """Thresholds at x + l = 2 and, on the way back, -1, which is crossed at a lower rate."""
    rates, sizes = [0.4, 0.8, 1.5, 2.0, 2.4, 3.5], [1.0, 2.0, 4.0, 6.0]
    folder = run_of(
        tmp_path / "two", "(x + l)*(x + l + 1)*(x + l - 2)", rates=rates, sizes=sizes, start=0.0, hold_s=0.3
    )
    expected = np.zeros((len(rates), len(sizes)), int)
    for i, j in np.ndindex(expected.shape):
        ends = by_scipy(lambda x, s: (x + s) * (x + s + 1) * (x + s - 2), 0.0, 0.0, sizes[j], rates[i], 0.3)
        away, stays = (abs(x + s) < 1e-6 for x, s in zip(ends, (sizes[j], 0.0), strict=True))
        expected[i, j] = (TRACKING if away else RETURNING) if stays else (RETURN_TIPPING if away else TIPPING)
    assert {TRACKING, TIPPING, RETURN_TIPPING} <= set(expected.ravel())
    np.testing.assert_array_equal(courses_of(folder), expected)


@pytest.mark.parametrize(("begin", "sizes"), [(0.0, [0.2, 0.36, 0.41, 0.7, 1.3]), (-1.0, [-0.5, 0.0, 0.36, 0.41, 1.0])])
def test_courses__past_a_saddle_node(tmp_path, begin, sizes) -> None:
    """x' = x - x**3 + l: the lower state ends at l = 0.385, so beyond no trajectory tracks it.

    From -1 there is one state only, at both ends of the largest shift, and two between.
    """
    rates = [0.05, 0.3, 1.0, 5.0]
    (x,) = (r.real for r in np.roots([-1.0, 0.0, 1.0, begin]) if abs(r.imag) < 1e-9 and r.real < -0.9)
    folder = run_of(
        tmp_path / "s", "x - x**3 + l", rates=rates, sizes=sizes, start=x, begin=begin, n_keep=100, hold_s=1.0
    )
    expected = np.zeros((len(rates), len(sizes)), int)
    for i, j in np.ndindex(expected.shape):
        away, end = by_scipy(lambda x, s: x - x**3 + s, x, begin, sizes[j], rates[i], 1.0)
        tracks = away < 0.0 and sizes[j] < 2.0 / 27.0**0.5
        expected[i, j] = (TRACKING if tracks else RETURNING) if end < -0.5 else TIPPING
    assert {TRACKING, RETURNING} <= set(expected.ravel())
    assert (TIPPING in expected) == (begin == 0.0)
    np.testing.assert_array_equal(courses_of(folder), expected)
