"""Trace solution curves of a system of equations by pseudo-arclength continuation (Keller 1977).

The predictor extends the cubic through the last two points by a step along the tangent. The corrector is
Newton's method in the plane normal to the tangent, so that it also passes folds in the parameter.
Unknowns are scaled; lengths are Euclidean in them.

The longest step is a share of the range that each unknown has covered so far, or of its size in the settings if this is
more. A curve that moves far, as at a sharp resonance, takes longer steps in the unknowns that move far, but not in the
others. So the number of points grows with the logarithm of the distance. The steps in a free parameter do not grow: its
scale is the interval that it stays in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pipeline.analysis.branches.lockstep import Query, Steps
from pipeline.analysis.branches.problems import Problem, Value


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings of a continuation: step lengths, tolerance and limits, also for bifurcations and what starts there."""

    # arclengths; a trace ends if it needs a step below the shortest
    first_step: float = 1e-3
    longest_step: float = 5e-3  # in units of the range that an unknown has covered, or of `size` if this is more
    shortest_step: float = 1e-7
    size: float | np.ndarray = 1.0  # scaled; of all unknowns, or of each
    max_points: int = 4000  # points of one trace
    tolerance: float = 1e-10  # largest scaled residual of a point
    max_iterations: int = 6  # Newton steps before a step is halved
    largest_turn: float = 0.25  # largest angle between neighbouring tangents [rad]
    beyond: int = 0  # points after which a branch without stability ends; 0: never
    # bifurcations
    bracket: float = 1e-8  # width to which one is located [arclength]; in its scale, the parameter changes by less
    # shifts of a guess that may be a branch point itself, where no tangent is unique, in units of `bracket`
    shifts: tuple[float, ...] = (0.0, 1e-3, 0.3)
    # first steps from a branch point onto its second branch, in units of `first_step`, tried in turn: more find
    # branches that bend more; and the largest distance of the first orbit from the point, in units of the step
    crossing_steps: tuple[float, ...] = (1.0, 5.0, 25.0, 0.2, 0.04, 0.008)
    near_crossing: float = 5.0
    # scaled distances from an equilibrium, or another point, at which the first orbit of a branch or curve is looked
    # for, tried in turn
    amplitudes: tuple[float, ...] = (0.02, 0.05, 0.1)
    # step across an impact at the strobe, in units of `shortest_step`; it is tried again with multiples of this step
    across: float = 100.0
    longest_cut: float = 0.05  # `longest_step` of cut orbits, whose nodes and periods are unknowns that vary smoothly
    longest_at_rest: float = 0.05  # `longest_step` of equilibria, on whose branches tests see two zeros within a step


@dataclass(frozen=True, eq=False)
class Point:
    """Point of a solution curve: its unknowns, its unit tangent, the value of the equations and the number of Newton
    steps.
    """

    u: np.ndarray
    tangent: np.ndarray
    value: Value
    n_iterations: int

    @property
    def residual(self) -> float:
        """Largest scaled residual of the equations at this point."""
        return float(np.abs(self.value.residual).max())

    @cached_property
    def determinant(self) -> float:
        """Determinant of the derivative and the tangent, which vanishes where curves cross."""
        return float(np.linalg.det(np.vstack([self.value.derivative, self.tangent])))


@dataclass(eq=False)
class Trace:
    """Points of a traced solution curve in order, and the reason why the trace ended."""

    points: list[Point] = field(default_factory=list)
    end: str = ""


def correct(
    problem: Problem, guess: np.ndarray, normal: np.ndarray, settings: Settings, along: np.ndarray | None = None
) -> Steps[Point | None]:
    """Refine a guess of a curve point by Newton's method, in the plane through the guess normal to `normal`; None on
    failure.

    The point's tangent goes along `along`, by default along the normal.
    """
    u = guess.copy()
    last = np.inf
    for iteration in range(settings.max_iterations + 1):
        value = yield Query(problem, u)
        if not value.is_finite:
            return None
        residual = float(np.abs(value.residual).max())
        if residual <= settings.tolerance:
            tangent = tangent_of(value, normal if along is None else along)
            return None if tangent is None else Point(u, tangent, value, iteration)
        if residual > 2.0 * last or iteration == settings.max_iterations:
            return None
        last = residual
        matrix = np.vstack([value.derivative, normal])
        right = np.append(-value.residual, -normal @ (u - guess))
        try:
            step = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            return None
        if not np.abs(step).max() < 0.5:
            return None
        u = u + step
    return None


def tangent_of(value: Value, along: np.ndarray) -> np.ndarray | None:
    """Return the unit tangent of the solution curve whose direction agrees with `along`; None if the tangent is not
    unique.
    """
    matrix = np.vstack([value.derivative, along])
    right = np.zeros(len(matrix))
    right[-1] = 1.0
    try:
        tangent = np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return None
    with np.errstate(over="ignore"):  # where the matrix is singular but for rounding
        length = np.linalg.norm(tangent)
    return tangent / length if np.isfinite(length) else None


def kernel_of(value: Value) -> np.ndarray:
    """Return a unit vector in the kernel of the derivative of the curve's equations; its sign is arbitrary."""
    return np.asarray(np.linalg.svd(value.derivative)[2][-1])


Between = Callable[[Point, Point], "Steps[bool]"]
"""A check between two neighbouring points; it returns False to ask for a shorter step."""

Stop = Callable[[list[Point]], str]
"""A check of the points so far; it returns the reason to end the trace, or an empty text."""


Across = Callable[[Point], "Steps[tuple[Point, Point] | None]"]
"""A way on where no step is short enough: the last point in other unknowns and the next point, or None."""


def trace(
    problem: Problem,
    start: Point,
    settings: Settings,
    stop: Stop | None = None,
    between: Between | None = None,
    across: Across | None = None,
) -> Steps[Trace]:
    """Follow a solution curve from a start point along its tangent.

    `between` may refuse a step, which is then tried with half the length; `stop` is asked after every
    point, but not where the unknowns jump (`across`). The start is the first of the points.
    """
    found = Trace([start])
    step, low, high = settings.first_step, start.u, start.u
    while len(found.points) < settings.max_points:
        here = found.points[-1]
        guess = _ahead(found.points, step)
        there = yield from correct(problem, guess, here.tangent, settings)
        ranges = np.maximum(high - low, settings.size)
        is_near = there is not None and _is_near(here, there, step, ranges, settings)
        if there is None or not is_near or (between and not (yield from between(here, there))):
            step *= 0.5
            if step >= settings.shortest_step:
                continue
            pair = (yield from across(here)) if across else None
            if pair is None or (between and not (yield from between(*pair))):
                found.end = "stuck"
                return found
            found.points.append(pair[1])
            step, low, high = settings.first_step, pair[1].u, pair[1].u
            continue
        found.points.append(there)
        found.end = stop(found.points) if stop else ""
        if found.end:
            return found
        low, high = np.minimum(low, there.u), np.maximum(high, there.u)
        longest = _longest(there, np.maximum(high - low, settings.size), settings)
        if there.n_iterations <= 3:
            step *= 1.5
        elif there.n_iterations > 4:
            step *= 0.7
        step = min(step, longest)
    found.end = "max_points"
    return found


def crawls(points: Sequence[Point], many: int = 20) -> bool:
    """Return whether the last `many` steps of a curve led nowhere: Newton's method converges from no other point.

    So it is near canards, where the cycles change by as much as they are large within differences of the parameters.
    """
    nowhere = 1e-4  # distance that the steps cover [arclength]
    return len(points) > many and bool(np.linalg.norm(points[-1].u - points[-1 - many].u) < nowhere)


def cubic(a: Point, b: Point, share: float) -> np.ndarray:
    """Interpolate between two points of a curve by a cubic, at the fraction `share` of their chord (above 1:
    extrapolate).
    """
    length = float(np.linalg.norm(b.u - a.u))
    s, rest = share, 1.0 - share
    middle = rest**2 * (1.0 + 2.0 * s) * a.u + s**2 * (3.0 - 2.0 * s) * b.u
    return np.asarray(middle + length * s * rest * (rest * a.tangent - s * b.tangent))


def _ahead(points: list[Point], step: float) -> np.ndarray:
    """Predict the next point of the curve, at the distance `step` along the tangent."""
    here = points[-1]
    straight = here.u + step * here.tangent
    if len(points) < 2:
        return straight
    length = float(np.linalg.norm(here.u - points[-2].u))
    if step > 2.0 * length:
        return straight
    bent = cubic(points[-2], here, 1.0 + step / length)
    return np.asarray(bent - (here.tangent @ (bent - straight)) * here.tangent)


def _longest(here: Point, ranges: np.ndarray, settings: Settings) -> float:
    """Return the longest step at a point, for the ranges of the unknowns so far."""
    return settings.longest_step * float(np.linalg.norm(here.tangent) / np.linalg.norm(here.tangent / ranges))


def _is_near(here: Point, there: Point, step: float, ranges: np.ndarray, settings: Settings) -> bool:
    """Return whether a step stayed on the solution curve: the tangent turned little, and the correction was small, both
    in the unknowns and in units of their ranges.
    """
    for unit in (np.ones_like(ranges), ranges):
        first, last, moved = here.tangent / unit, there.tangent / unit, (there.u - here.u) / unit
        length = float(np.linalg.norm(first))
        cosine = float(first @ last) / (length * float(np.linalg.norm(last)))
        if cosine < np.cos(settings.largest_turn) or np.linalg.norm(moved - step * first) > 0.5 * step * length:
            return False
    return True
