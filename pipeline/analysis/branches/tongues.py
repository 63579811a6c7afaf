"""Find phase-locked orbits with rotation number p/q along a row of cells whose rotation numbers are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor

import numpy as np

from magpend_core import run_branches
from magpend_core.engine.system import System
from magpend_core.orbits import scaled_distance
from magpend_core.rotation import CLOSED_TURNS, TurningState, rotation_numbers
from pipeline.analysis.branches.arclength import Settings, correct, kernel_of
from pipeline.analysis.branches.following import Branch, problem_of
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.lockstep import Query, Steps, run_together
from pipeline.analysis.branches.problems import Family

BISECTIONS = 26
"""Most halvings of an interval of the parameter in which a fraction is passed between two cells."""

N_TRANSIENT = 300
"""Drive periods for which a trajectory settles after each halving."""

RECURRENCES = 8
"""Periods q among which the closest return of a trajectory is sought, as a first guess of the orbit."""

TOLERANCE = 1e-9
"""Tolerance of the integrations for the search; Newton's method has its own."""

LOCKED = 1e-6
"""Largest distance of a closed cell's rotation number from a fraction that counts as equal."""


@dataclass(frozen=True, eq=False)
class Row:
    """Cells along one parameter, with their rotation numbers, orbit periods (0: not closed) and section points.

    Attributes
    ----------
    values : ndarray, (value,)
        Rising values of the parameter.
    rotation : ndarray, (value, start)
        NaN where unknown.
    orbit_period : ndarray, (value, start)
    section : ndarray, (value, start, state)
        A section point of each.
    """

    values: np.ndarray
    rotation: np.ndarray
    orbit_period: np.ndarray
    section: np.ndarray


@dataclass(frozen=True, eq=False)
class Search:
    """Settings of the search for locked orbits: the family of orbits, the rotating state and the number of periods to
    average over.
    """

    family: Family
    turning: TurningState
    n_periods: int

    @property
    def system(self) -> System:
        """System that is integrated."""
        return self.family.system

    def rotation(self, values: np.ndarray, states: np.ndarray, closed: np.ndarray | None = None) -> np.ndarray:
        """Compute the rotation numbers of trajectories that start at given states and values of the free parameter."""
        rows = self.family.rows(self._unknowns(values, states))
        found = rotation_numbers(
            rows.parameters,
            rows.frequency_hz,
            rows.states,
            system=self.system,
            turning=self.turning,
            n_periods=self.n_periods,
            orbit_period=closed,
            rtol=TOLERANCE,
            atol=TOLERANCE,
        )
        return np.asarray(np.where(found.error <= CLOSED_TURNS, found.rotation, np.nan))

    def sections(self, values: np.ndarray, states: np.ndarray, n_transient: int, n_keep: int) -> np.ndarray:
        """Integrate trajectories over a transient, and return the next `n_keep` section points, shape (trajectory,
        n_keep, state).
        """
        rows = self.family.rows(self._unknowns(values, states))
        found = run_branches(
            rows.parameters[:, None],
            rows.frequency_hz[:, None],
            rows.states,
            n_transient=n_transient,
            n_keep=n_keep,
            rtol=TOLERANCE,
            atol=TOLERANCE,
            system=self.system,
        )
        return np.asarray(found.section[:, 0])

    def _unknowns(self, values: np.ndarray, states: np.ndarray) -> np.ndarray:
        return np.asarray(np.column_stack([states, values]) / self.family.unit)


def fractions_between(low: float, high: float, most: int) -> list[Fraction]:
    """Return all fractions in an interval with denominators up to `most`, in rising order."""
    return sorted(
        {Fraction(p, q) for q in range(1, most + 1) for p in range(ceil(low * q - 1e-9), floor(high * q + 1e-9) + 1)}
    )


def locked_orbits(row: Row, search: Search, most: int) -> dict[Fraction, Start | None]:
    """Find an orbit for each rotation number p/q that occurs along a row of cells.

    Parameters
    ----------
    row
        The cells.
    search
        The setting of the search.
    most
        Largest denominator.

    Returns
    -------
    dict
        Starting orbit by fraction, in rising order; None where no closed cell has it and the search failed.
    """
    known = row.rotation[np.isfinite(row.rotation)]
    if not known.size:
        return {}
    wanted = fractions_between(float(known.min()), float(known.max()), most)
    found = {fraction: _of_cells(row, search, fraction) for fraction in wanted}
    missing = {f: gap for f in wanted if found[f] is None and (gap := _passed(row, f)) is not None}
    found |= _between_cells(row, search, missing)
    ready = {f: start for f, start in found.items() if start is not None}
    corrected = run_together([_corrected(start, k) for k, start in enumerate(ready.values())], "polishing orbits")
    return found | dict(zip(ready, corrected, strict=True))


def _of_cells(row: Row, search: Search, fraction: Fraction) -> Start | None:
    """Return the periodic orbit of least period among the cells with a given rotation number; None if there is no such
    cell.
    """
    has = (row.orbit_period > 0) & (np.abs(row.rotation - float(fraction)) < LOCKED)
    if not has.any():
        return None
    period = int(row.orbit_period[has].min())
    places = np.argwhere(has & (row.orbit_period == period))
    i, j = places[len(places) // 2]
    family = replace(search.family, period=period)
    return Start(family, row.section[i, j], float(row.values[i]))


def _passed(row: Row, fraction: Fraction) -> tuple[int, int] | None:
    """Find a cell after which the rotation number passes a fraction; return its indices (value, start), or None."""
    off = row.rotation - float(fraction)
    places = np.argwhere(off[:-1] * off[1:] < 0.0)
    if not len(places):
        return None
    steps = [abs(row.rotation[i + 1, j] - row.rotation[i, j]) for i, j in places]
    i, j = places[int(np.argmin(steps))]
    return int(i), int(j)


def _between_cells(row: Row, search: Search, gaps: dict[Fraction, tuple[int, int]]) -> dict[Fraction, Start | None]:
    """Find locked orbits between adjacent cells by bisection in the parameter, for all fractions at once."""
    if not gaps:
        return {}
    targets = np.array([float(f) for f in gaps])
    ends = np.array([[row.values[i], row.values[i + 1]] for i, _ in gaps.values()])
    rising = np.array([row.rotation[i, j] < row.rotation[i + 1, j] for i, j in gaps.values()])
    states = np.array([row.section[i, j] for i, j in gaps.values()])
    for _ in range(BISECTIONS):
        middle = ends.mean(axis=1)
        reached = search.sections(middle, states, N_TRANSIENT, 1)[:, -1]
        states = np.where(np.isfinite(reached).all(axis=1)[:, None], reached, states)
        off = search.rotation(middle, states) - targets
        is_low = (off < 0.0) == rising
        is_done = ~(np.abs(off) > LOCKED)  # NaN: nothing more can be learnt there
        ends = np.where(is_done[:, None], np.stack([middle, middle], axis=1), ends)
        ends[is_low & ~is_done, 0] = middle[is_low & ~is_done]
        ends[~is_low & ~is_done, 1] = middle[~is_low & ~is_done]
        if is_done.all():
            break
    longest = max(f.denominator for f in gaps)
    sections = search.sections(ends.mean(axis=1), states, 0, (RECURRENCES + 1) * longest)
    return {
        f: _closest_return(replace(search.family, period=f.denominator), points, float(value))
        for f, points, value in zip(gaps, sections, ends.mean(axis=1), strict=True)
    }


def _closest_return(family: Family, points: np.ndarray, value: float) -> Start | None:
    distance = scaled_distance(points[family.period :], points[: -family.period], family.system)
    if not np.isfinite(distance).all():
        return None
    return Start(family, points[int(np.argmin(distance))], value)


def _corrected(start: Start, number: int) -> Steps[Start | None]:
    """Refine an orbit together with its parameter value, since a thin tongue has the orbit near one value only."""
    problem, u = problem_of(start.family), start.family.unknowns(start.state, [start.value])
    value = yield Query(problem, u)
    found = (yield from correct(problem, u, kernel_of(value), Settings())) if value.is_finite else None
    if found is None:
        return None
    state, parameter = start.family.state(found.u), float(start.family.values(found.u)[0])
    return Start(start.family, state, parameter, number)


def fractions_of(branches: Sequence[Branch], search: Search) -> list[Fraction | None]:
    """Return the rotation number p/q of each branch, from its first orbit; None if the orbit's turns are not a whole
    number.
    """
    return [_fraction_of(branch, search) for branch in branches]


def _fraction_of(branch: Branch, search: Search) -> Fraction | None:
    family, first = branch.family, branch.points[0]
    values, states = family.values(first.u), family.state(first.u)[None]
    closed = None if search.turning.of_section else np.array([family.period])
    whole = float(search.rotation(values, states, closed)[0]) * family.period
    return Fraction(round(whole), family.period) if abs(whole - np.round(whole)) < LOCKED else None
