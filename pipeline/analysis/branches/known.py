"""Tell which orbits lie on branches that have been followed, so that no branch is followed twice.

An orbit may come by any route: from the cells of a run, from another branch, at any of its section points, or over
several of its periods. It lies on a branch if Newton's method from the branch's neighbouring points, at the value of
the orbit's parameter, leads to the same orbit, within what the residuals of the two leave open.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.following import Branch, problem_of
from pipeline.analysis.branches.kinds import FOLD
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.results.tolerances import SAME_ON_BRANCH

GUESS = 0.05
"""Largest scaled distance from a branch's chord at which an orbit is tested for lying on the branch."""


AT_FOLD, NEAR_FOLD = 1e-9, 1e-3
"""Largest distances of an orbit from a fold, in the parameter and in the states [scaled], at which it is the fold's: it
may lie beyond the last point of its branch, and is found to the root of its residual alone."""

SAME_VALUE = 1e-12
"""Largest distance of two values of the parameter that are one but for rounding [scale of the parameter]."""


@dataclass(frozen=True, eq=False)
class Start:
    """An orbit from which a branch starts: its family, a section point, the parameter value and the attractor's id (-1:
    none).
    """

    family: Family
    state: np.ndarray
    value: float
    attractor: int = -1

    @property
    def unknowns(self) -> np.ndarray:
        """Section point and parameter value, scaled."""
        return self.family.unknowns(self.state, [self.value])


def lie_on(starts: Sequence[Start], branches: Sequence[Branch]) -> list[bool]:
    """Return for each orbit whether it lies on one of some branches."""
    asked = [
        (i, branch.family, guess) for i, s in enumerate(starts) for branch in branches for guess in _near(s, branch)
    ]
    there = run_together([at_value(family, guess) for _, family, guess in asked])
    candidates = [(i, point) for (i, _, _), point in zip(asked, there, strict=True) if point is not None]
    near = sorted({i for i, _ in candidates})
    polished = run_together([at_value(starts[i].family, starts[i].unknowns) for i in near])
    own = dict(zip(near, polished, strict=True))
    known = {i for i, point in candidates if _is_same(starts[i], own[i], point)}
    return [i in known or any(_is_fold_of(start, branch) for branch in branches) for i, start in enumerate(starts)]


def _is_fold_of(start: Start, branch: Branch) -> bool:
    """Return whether an orbit is at a fold of a branch."""
    family, here = branch.family, start.unknowns
    if start.family.period != family.period or not same_others(family, start.family):
        return False
    folds = [one.point for one in branch.bifurcations if one.kind == FOLD and abs(one.point.u[-1] - here[-1]) < AT_FOLD]
    return any(gap(family, here, point) < NEAR_FOLD for point in folds)


def _is_same(start: Start, polished: Point | None, point: Point) -> bool:
    """Return whether an orbit, as given or refined to the residual of a branch, is one of a branch's orbits."""
    given = start.unknowns
    here = given if polished is None else polished.u
    reach = SAME_ON_BRANCH + error_of(point) + (0.0 if polished is None else error_of(polished))
    if polished is not None and np.abs(polished.u - given).max() > GUESS:  # it left for another orbit
        here = given
    return min(float(np.abs(start.family.mismatch(here, x)).max()) for x in point.value.images) <= reach


def error_of(point: Point) -> float:
    """Bound the distance of a point from the exact orbit, by its residual and the derivative's least singular value.

    Both vanish towards a bifurcation: at a distance x from the orbit as x^2 and 2 x near a fold, and as x^3 and 3 x^2
    where branches cross symmetrically, as those of twice the period at a doubling.
    """
    inexact = 1e-12  # error of the residual of an orbit [scaled]
    least = float(np.linalg.svd(point.value.derivative[:, :-1], compute_uv=False)[-1])
    residual = 3.0 * (point.residual + inexact)
    return float(residual / max(least, residual ** (2.0 / 3.0)))


def shorter_orbit(family: Family, point: Point) -> tuple[Family, np.ndarray] | None:
    """Return the family and the unknowns of the orbit of a part of the period that a point is within its error; None if
    there is none.
    """
    for period in (p for p in range(1, family.period) if family.period % p == 0):
        away = np.array([family.mismatch(point.u, x) for x in point.value.images[period - 1 :: period]])
        if np.abs(away).max() <= 3.0 * error_of(point):
            return replace(family, period=period), point.u + np.append(away.mean(axis=0), 0.0)
    return None


def at_value(family: Family, guess: np.ndarray) -> Steps[Point | None]:
    """Refine a guess of an orbit by Newton's method at its value of the parameter; None on failure."""
    normal = np.zeros(len(guess))
    normal[-1] = 1.0
    found = yield from correct(problem_of(family), guess, normal, Settings())
    return found


def _near(start: Start, branch: Branch) -> Iterator[np.ndarray]:
    """Yield guesses of the orbits on a branch that have a starting orbit's parameter value and lie near it."""
    family, own = branch.family, start.family
    divides = own.period % family.period == 0 if family.period else not own.period
    if not divides or not same_others(family, own):
        return
    here = start.unknowns
    for a, b, share, guess in chords_at(branch, here[-1]):
        for x, y in zip(a.value.images, b.value.images, strict=True):
            first, second = family.mismatch(here, x), family.mismatch(here, y)
            # phases move at different rates along a branch: between two points as far as they are apart
            if np.abs(first + share * (second - first)).max() < GUESS + 0.5 * np.abs(second - first).max():
                yield guess
                break


def chords_at(branch: Branch, value: float) -> Iterator[tuple[Point, Point, float, np.ndarray]]:
    """Yield where a branch passes a value of its parameter [its scale]: the points before and after it, the share of
    the way between them, and a guess of the orbit there.
    """
    away = np.array([point.u[-1] for point in branch.points]) - value
    away[np.abs(away) <= SAME_VALUE] = 0.0
    for i in np.flatnonzero(away[:-1] * away[1:] <= 0.0):
        a, b = branch.points[i], branch.points[i + 1]
        share = away[i] / (away[i] - away[i + 1]) if away[i] != away[i + 1] else 0.0
        guess = a.u + share * (b.u - a.u)
        guess[-1] = value
        yield a, b, share, guess


def same_others(a: Family, b: Family) -> bool:
    """Return whether two families have the same free parameters and the same values of the others."""
    return a.free == b.free and np.array_equal(fixed(a), fixed(b))


def fixed(family: Family) -> np.ndarray:
    """Return the values of the parameters that are not free, and the drive frequency."""
    values = np.append(family.parameters, family.frequency_hz)
    names = (*family.system.parameter_names, FREQUENCY)
    return np.array([v for n, v in zip(names, values, strict=True) if n not in family.free])


def gap(family: Family, u: np.ndarray, point: Point) -> float:
    """Return the scaled distance between a section point and the nearest one of an orbit."""
    return min(float(np.linalg.norm(family.mismatch(u, x))) for x in point.value.images)
