"""Detect bifurcations on a branch by test functions, and locate them by inverse interpolation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate, groupby, pairwise, product
from typing import Any

import numpy as np

from pipeline.analysis.branches.arclength import Point, Settings, correct, cubic
from pipeline.analysis.branches.kinds import BRANCHING, DOUBLING, FOLD, HOPF, TORUS
from pipeline.analysis.branches.lockstep import Steps
from pipeline.analysis.branches.problems import FollowedProblem, Problem, doubling_test, hopf_test, torus_product

CONTRADICTORY = "contradictory"
"""Criticality of a period doubling or pitchfork whose coefficient and whose other branch disagree."""


SAME_PLACE = 1e-4
"""Largest scaled distance between two locations of one branch point: there Newton's method is as exact as the root of
its residual."""

Test = Callable[[Point], float]


def multipliers_of(point: Point) -> np.ndarray:
    """Return the Floquet multipliers by falling modulus, shape (state,); NaN for an equilibrium."""
    if point.value.is_rest:
        return np.full(len(point.value.monodromy), complex(np.nan, np.nan))
    found = point.value.multipliers
    return found[np.argsort(-np.abs(found), kind="stable")]


def eigenvalues_of(point: Point) -> np.ndarray:
    """Return the eigenvalues of an equilibrium by falling real part [1/s], shape (state,); NaN for an orbit."""
    if not point.value.is_rest:
        return np.full(len(point.value.monodromy), complex(np.nan, np.nan))
    found = point.value.multipliers
    return found[np.lexsort((found.imag, -found.real))]


def n_unstable(point: Point) -> int:
    """Count the multipliers outside the unit circle, or the eigenvalues with positive real parts."""
    if point.value.is_rest:
        return int((point.value.multipliers.real > 0.0).sum())
    return int((np.abs(point.value.multipliers) > 1.0).sum())


def _margin(point: Point) -> float:
    """Return the distance of the nearest multiplier from the unit circle, or of an eigenvalue from the imaginary axis,
    relative to the largest one.
    """
    values = point.value.multipliers
    if point.value.is_rest:
        return float(np.abs(values.real).min() / max(np.abs(values).max(), np.finfo(float).tiny))
    return float(np.abs(np.abs(values) - 1.0).min())


def _doubling_test(point: Point) -> float:
    if point.value.is_rest:
        return 1.0
    value = point.value
    return float(np.prod(1.0 + value.multipliers).real if value.is_graded else doubling_test(value.monodromy))


TESTS: dict[str, Test] = {
    FOLD: lambda point: float(point.tangent[-1]),
    DOUBLING: _doubling_test,
    TORUS: lambda point: 1.0 if point.value.is_rest else torus_product(point.value.multipliers),
    BRANCHING: lambda point: point.determinant,
    HOPF: lambda point: hopf_test(point.value.multipliers) if point.value.is_rest else 1.0,
}
"""Functions of a point that change their sign at a bifurcation.

A fold turns the tangent back in the parameter. At a branch point (pitchfork, transcritical) the equations
and the tangent are dependent.
"""


@dataclass(eq=False)
class Bifurcation:
    """A bifurcation that was located on a branch of periodic orbits or equilibria."""

    kind: str  # one of `KINDS`
    point: Point  # the orbit there
    bracket: float  # distance of the parameter values between which the test function changes its sign
    # multipliers outside the unit circle on both sides, in the order of the branch (see `settle_sides`)
    n_unstable_before: int
    n_unstable_after: int
    rises_before: bool  # whether the parameter rises along the branch before it; at a fold it turns
    after: int = -1  # index of the point of the branch after which it comes
    # ``supercritical``, ``subcritical`` or, if unknown, empty, by the sign of `coefficient`. The branch that leaves a
    # period doubling or pitchfork tells it as well: `CONTRADICTORY` if the two disagree.
    criticality: str = ""
    child: Any = None  # the other branch through it, if that is known
    stuck: Any = None  # the beginning of its doubled branch, if that could not be followed
    # normal form coefficient and its error (see `normal_forms`); NaN if unknown
    coefficient: float = np.nan
    coefficient_error: float = np.nan

    @property
    def critical_multiplier(self) -> complex:
        """The multiplier on the unit circle, or the eigenvalue on the imaginary axis [1/s].

        For a complex pair it is the one with positive imaginary part.
        """
        if self.point.value.is_rest:
            values = eigenvalues_of(self.point)
            upper = values[values.imag > 0.0] if self.kind == HOPF else values
            return complex(upper[np.argmin(np.abs(upper.real))])
        multipliers = multipliers_of(self.point)
        if self.kind == TORUS:
            upper = multipliers[multipliers.imag > 0.0]
            return complex(upper[np.argmin(np.abs(np.abs(upper) - 1.0))])
        target = -1.0 if self.kind == DOUBLING else 1.0
        return complex(multipliers[np.argmin(np.abs(multipliers - target))])


_CHANGES = {FOLD: 1, DOUBLING: 1, TORUS: 2, BRANCHING: 1, HOPF: 2}


@dataclass(eq=False)
class Watch:
    """Detector of bifurcations between successive points of a branch; it stores the located bifurcations."""

    problem: FollowedProblem
    settings: Settings
    skip_first: bool = False
    found: list[Bifurcation] = field(default_factory=list)
    n_steps: int = 0
    tell: Callable[[Bifurcation], None] = lambda _: None  # called with each one at once
    halves: Callable[[Point, Point], bool] = lambda *_: False  # whether a step passes an orbit of half the period
    _last: Point | None = None

    def between(self, a: Point, b: Point) -> Steps[bool]:
        """Locate the bifurcations between two successive points. Return False if the change of stability needs a
        shorter step.
        """
        short = 1e-4  # length of a step that is not made shorter where a test function nearly vanishes [arclength]
        if self.skip_first and self.n_steps == 0:
            self.n_steps += 1
            return True
        kinds = [kind for kind in TESTS if TESTS[kind](a) * TESTS[kind](b) < 0.0]
        step = float(np.linalg.norm(b.u - a.u))
        long = step > 100.0 * self.settings.shortest_step
        if long and not _explains(kinds, n_unstable(b) - n_unstable(a)):
            return False
        if long and turns_twice(a, b):
            return False
        # an orbit of half the period has squares as multipliers, none of them -1: a doubling lies before it
        if long and TESTS[DOUBLING](a) < 0.0 and self.halves(a, b):
            return False
        if step > short and any(self._turned_back(kind, a, b, step) for kind in (BRANCHING, HOPF) if kind not in kinds):
            return False
        located = []
        for kind in kinds:
            one = yield from locate(self.problem, a, b, kind, self.settings)
            if one is None and long:
                return False
            if one is None:
                one = yield from locate(self.problem, a, b, kind, self.settings, self.settings.shifts)
            if one is not None:
                one.after = self.n_steps
                located.append(one)
        told_apart = tell_apart(located, a)
        self.found += told_apart
        for one in told_apart:
            self.tell(one)
        self.n_steps += 1
        self._last = a
        return True

    def _turned_back(self, kind: str, a: Point, b: Point, step: float) -> bool:
        """Return whether a test function goes to 0 at a point, and away from it at the next.

        Then the step may have passed two Hopf points, or have left a branch that turns at a pitchfork for the one that
        passes straight through.
        """
        if self._last is None:
            return False
        before, here, there = (TESTS[kind](point) for point in (self._last, a, b))
        ahead = here + (here - before) * step / float(np.linalg.norm(a.u - self._last.u))
        return here * ahead < 0.0 < here * there


def turns_twice(a: Point, b: Point) -> bool:
    """Return whether the parameter turns back and forth between two points, by the cubic through both: two folds, at
    whose far sides all test functions have the same signs.
    """
    # least change of the parameter between two folds in one step for which the step is made shorter, in its scale: less
    # is rounding
    hidden = 1e-8
    d = b.u - a.u
    chord, (first, last) = float(d[-1]), float(np.linalg.norm(d)) * np.array([a.tangent[-1], b.tangent[-1]])
    bend = first + last - 2.0 * chord  # the slope is a parabola, with this curvature
    if first * last <= 0.0 or bend * first <= 0.0:
        return False
    lowest = (2.0 * first + last - 3.0 * chord) / (3.0 * bend)
    slope = first - 3.0 * bend * lowest**2
    half_width = np.sqrt(max(-slope / (3.0 * bend), 0.0))
    return bool(0.0 < lowest < 1.0 and 4.0 * abs(bend) * half_width**3 > hidden)


def _explains(kinds: list[str], change: int) -> bool:
    """Return whether bifurcations of the given kinds can together change the number of unstable multipliers by
    `change`.
    """
    reachable = {0}
    for kind in kinds:
        step = _CHANGES[kind]
        # a sign change may leave the count: at a neutral saddle, or at a fold
        reachable = {r + s for r in reachable for s in (-step, 0, step)}
    return change in reachable


def locate(
    problem: FollowedProblem, a: Point, b: Point, kind: str, settings: Settings, shifts: Sequence[float] = (0.0,)
) -> Steps[Bifurcation | None]:
    """Locate the bifurcation between two points of a branch where its test function vanishes; None if Newton's method
    fails, also at the `shifts` of its guesses.
    """
    test = TESTS[kind]

    def tested(point: Point) -> Steps[float]:
        return test(point)
        yield  # type: ignore[unreachable]  # a computation that asks for nothing

    found = yield from find_root(problem, (a, test(a)), (b, test(b)), tested, settings, shifts)
    if found is None:
        return None
    (low, at_low), (high, at_high) = found
    bracket = abs(high.u[-1] - low.u[-1]) * problem.family.scales[0]
    nearest = low if abs(at_low) <= abs(at_high) else high
    rises = bool(low.tangent[-1] > 0.0)
    return Bifurcation(kind, nearest, float(bracket), n_unstable(low), n_unstable(high), rises)


Tested = tuple[Point, float]
"""A point and the value of a test function there."""


def find_root(
    problem: Problem,
    a: Tested,
    b: Tested,
    test: Callable[[Point], Steps[float]],
    settings: Settings,
    shifts: Sequence[float] = (0.0,),
) -> Steps[tuple[Tested, Tested] | None]:
    """Bracket a zero of a test function between two points of a curve; None if Newton's method fails."""
    (first, at_first), (last_point, at_last) = a, b
    chord = last_point.u - first.u
    length = float(np.linalg.norm(chord))
    low, high = (0.0, first, at_first), (1.0, last_point, at_last)
    known = [low[::2], high[::2]]
    least, last = settings.bracket / length, np.inf
    for trial in range(60):
        if high[0] - low[0] <= least:
            break
        root = _root(known[-3:]) if trial % 6 < 5 else 0.5 * (low[0] + high[0])
        if not low[0] < root < high[0]:
            root = 0.5 * (low[0] + high[0])
        # once the root stands still, put an end of the bracket on each side of it
        away = 0.4 * least if abs(root - last) < 0.3 * least else 0.0
        last, at = root, root - away if root - low[0] > least else root + away
        at = min(max(at, low[0] + 0.4 * least), high[0] - 0.4 * least)
        inward = least if at - low[0] < high[0] - at else -least
        for shift in shifts:
            guess = _between(first, last_point, at + shift * inward)
            middle = yield from correct(problem, guess, chord / length, settings, first.tangent)
            if middle is not None:
                at += shift * inward
                break
        if middle is None:
            return None
        value = yield from test(middle)
        known.append((at, value))
        if value * low[2] > 0.0:
            low = (at, middle, value)
        else:
            high = (at, middle, value)
    return low[1:], high[1:]


def _root(known: list[tuple[float, float]]) -> float:
    """Estimate the root of a function by inverse interpolation of (argument, value) pairs; NaN if two values are
    equal.
    """
    total = 0.0
    for i, (at, value) in enumerate(known):
        others = [v for j, (_, v) in enumerate(known) if j != i]
        if value in others:
            return float("nan")
        total += at * float(np.prod([v / (v - value) for v in others]))
    return total


def _between(a: Point, b: Point, share: float) -> np.ndarray:
    """Interpolate between two points of a curve, at a fraction of their chord and in the plane normal to it."""
    chord = b.u - a.u
    bent = cubic(a, b, share)
    return np.asarray(bent + (share - (bent - a.u) @ chord / (chord @ chord)) * chord)


def counts_of(points: Sequence[Point], found: Sequence[Bifurcation]) -> list[int]:
    """Count the unstable multipliers at each point of a branch with some bifurcations.

    Near a bifurcation rounding decides on which side of the circle a multiplier lies. There a point has the number of
    the nearest points before and after it, up to the next bifurcation, that are certain, if these agree. Where none is,
    as at the end of a branch just beyond a bifurcation, the number follows from that on the bifurcation's other side.
    """
    # distance of all multipliers from the unit circle, or of all scaled eigenvalues from the imaginary axis, above
    # which their number outside is certain: where two meet, each errs by the root of the error of the matrix
    certain = 1e-4
    counts, margins = [n_unstable(point) for point in points], np.array([_margin(point) for point in points])
    places = sorted({0, len(points), *(one.after + 1 for one in found)})
    unsure = []
    for first, last in pairwise(places):
        sure = first + np.flatnonzero(margins[first:last] > certain)
        for i in first + np.flatnonzero(margins[first:last] <= certain) if len(sure) else ():
            numbers = {counts[k] for k in (*sure[sure < i][-1:], *sure[sure > i][:1])}
            if len(numbers) == 1:  # else another branch crosses here, which lists the bifurcation
                (counts[i],) = numbers
        unsure += [] if len(sure) else [(first, last)]
    for first, last in unsure:
        for beside, place in ((first - 1, first), (last, last)):
            known = [one for one in found if one.after + 1 == place]
            is_sure = 0 <= beside < len(points) and not any(a <= beside < b for a, b in unsure)
            if is_sure and len(known) == 1:
                counts[first:last] = [_beyond(known[0], points[beside], counts[beside])] * (last - first)
    return counts


def _beyond(one: Bifurcation, point: Point, count: int) -> int:
    """Return the number of unstable multipliers on the other side of a bifurcation, from a point on one side."""
    change = _CHANGES.get(one.kind, 1)
    values = point.value.multipliers
    critical = values[np.argmin(np.abs(values - one.critical_multiplier))]
    is_unstable = critical.real > 0.0 if point.value.is_rest else abs(critical) > 1.0
    return count - change if is_unstable else count + change


def settle_sides(points: Sequence[Point], found: Sequence[Bifurcation]) -> None:
    """Take from a branch's points what holds on both sides of each bifurcation, in place: the numbers of unstable
    multipliers, and whether the parameter rises before it.

    Between bifurcations of one step there is no point; there the number follows from how each kind changes it. The
    tangent at a branch point is any vector of a plane.
    """
    counts = counts_of(points, found) if found else []
    for after, group in groupby(found, lambda one: one.after):
        ones = list(group)
        first, last = counts[after], counts[after + 1]
        changes = [(c, -c, 0) for c in (_CHANGES.get(one.kind, 1) for one in ones)]
        chains = [list(accumulate(steps, initial=first)) for steps in product(*changes)]
        *own, _ = min(chains, key=partial(_doubt, last=last, ones=ones))
        for one, *sides in zip(ones, own, [*own[1:], last], strict=True):
            one.n_unstable_before, one.n_unstable_after = sides
            rise = one.point.u[-1] - points[after].u[-1] or points[after + 1].u[-1] - points[after].u[-1]
            one.rises_before = bool(rise > 0.0)


def _doubt(chain: Sequence[int], last: int, ones: Sequence[Bifurcation]) -> tuple[bool, int, int]:
    """Rank the numbers of unstable multipliers between bifurcations of one step: the least is the most likely."""
    still = sum(a == b for a, b in pairwise(chain))
    return chain[-1] != last, still, sum(n != one.n_unstable_after for n, one in zip(chain[1:], ones, strict=True))


def tell_apart(located: list[Bifurcation], a: Point) -> list[Bifurcation]:
    """Keep the true bifurcations in the order of the branch. Drop neutral saddles, folds that are really branch
    points, and changes of sign by rounding.
    """
    branching = [one.point.u for one in located if one.kind == BRANCHING]
    kept = []
    for one in located:
        if (one.kind == TORUS and not has_torus(one.point)) or (one.kind == HOPF and not _is_pair(one)):
            continue
        if one.kind in (FOLD, DOUBLING) and one.point.value.is_graded and not _is_critical(one):
            continue
        if one.kind == FOLD and any(np.abs(one.point.u - u).max() < SAME_PLACE for u in branching):
            continue
        kept.append(one)
    return sorted(kept, key=lambda one: float(a.tangent @ (one.point.u - a.u)))


def has_torus(point: Point) -> bool:
    """Return whether a zero of the torus test is a bifurcation (complex multipliers), and not a neutral saddle (real
    multipliers).
    """
    multipliers = multipliers_of(point)
    complex_pairs = multipliers[multipliers.imag > 0.0]
    return bool(len(complex_pairs)) and bool(np.abs(np.abs(complex_pairs) - 1.0).min() < 1e-4)


def _is_critical(one: Bifurcation) -> bool:
    """Return whether a multiplier is near +1 at a fold, near -1 at a doubling. Else rounding has changed a sign, as it
    does on a canard, where the parameter stands still.
    """
    return bool(abs(one.critical_multiplier - (1.0 if one.kind == FOLD else -1.0)) < 0.1)


def _is_pair(one: Bifurcation) -> bool:
    """Return whether a located zero is a Hopf point (complex eigenvalues), and not a neutral saddle (real
    eigenvalues).
    """
    values = eigenvalues_of(one.point)
    upper = values[values.imag > 0.0]
    return bool(len(upper)) and bool(np.abs(upper.real / np.abs(upper)).min() < 1e-4)
