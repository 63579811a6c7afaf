"""Refine closed orbits by Newton's method, integrate guesses until they close, and compare orbits.

`polish` runs Newton's method of the core, and `run_on` runs the engine. Both take one section point per
guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import PeriodicOrbits, polish_orbits
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.known_sets import position_error
from pipeline.analysis.attractors.finding.stability import by_margin, largest_error
from pipeline.layout.vocabulary import ATTRACTS, NEUTRAL, NOT_SETTLED
from pipeline.results.sets import Geometry, order_by_points, order_of_points, rounded_points
from pipeline.results.tolerances import (
    EXTEND_CLOSURE,
    EXTEND_RTOL,
    MATRIX_ERROR,
    NEAR_RESIDUAL,
    NEAR_RTOL,
    NEARLY_RESIDUAL,
    PLACE_ERROR,
    SAME_HALF,
    SAME_ORBIT,
)


@dataclass(frozen=True)
class Orbit:
    """A closed orbit at one parameter point, by its section points and its multipliers."""

    # (period, state): section points in the order of time, the least one in canonical order first
    points: np.ndarray
    multipliers: np.ndarray  # complex, (state,): NaN if not polished
    residual: float  # residual of `polish_orbits`; NaN if not polished
    derivative: np.ndarray  # (state, state): monodromy matrix at the first point; NaN if not polished
    seconds: float = np.nan  # period [s]; NaN if not polished
    # scaled distance from which trajectories on both sides came nearer; 0 if not tried or not seen
    approached_within: float = 0.0
    failed: int = 0  # `Status` with which Newton's method ended in vain; 0 if it converged or was not tried
    # units of the states in which errors of the monodromy matrix are estimated; empty for 1
    sizes: tuple[float, ...] = ()

    @property
    def period(self) -> int:
        """Number of drive periods, or of returns to the section, until the orbit closes."""
        return len(self.points)

    @property
    def is_polished(self) -> bool:
        """Whether Newton's method converged on the orbit."""
        return bool(np.isfinite(self.residual))

    @cached_property
    def multiplier_error(self) -> float:
        """Estimated error of the largest modulus of the multipliers.

        It adds the error of the monodromy matrix and the error of the orbit's place: near a fold the
        multiplier changes with the square root of the residual.
        """
        sizes = np.asarray(self.sizes or 1.0)
        matrix = self.derivative * sizes / sizes[..., None]
        of_matrix = MATRIX_ERROR * float(np.abs(matrix).max(initial=1.0))
        return largest_error(matrix, of_matrix) + PLACE_ERROR * float(np.sqrt(self.residual))

    @cached_property
    def stability(self) -> int:
        """Stability of the orbit, decided by its multipliers and their error or, if these do not decide, by nearby
        trajectories.
        """
        if not self.is_polished:
            return NOT_SETTLED
        found = by_margin(float(np.abs(self.multipliers).max()), 1.0, self.multiplier_error)
        return ATTRACTS if found == NEUTRAL and self.approached_within > 0.0 else found

    @property
    def is_stable(self) -> bool:
        """Whether the orbit is shown to attract."""
        return self.stability == ATTRACTS

    @property
    def error(self) -> float:
        """Estimated distance from the true orbit, from the residual of Newton's method."""
        return position_error(self.residual, self.multipliers)


def scaled_derivative(orbit: Orbit, geometry: Geometry) -> np.ndarray:
    """Return the orbit's monodromy matrix for states that are divided by their scales."""
    scales = np.asarray(geometry.scales)
    return np.asarray(orbit.derivative * scales[None, :] / scales[:, None])


def raw_orbit(points: np.ndarray, geometry: Geometry, failed: int = 0) -> Orbit:
    """Make an orbit from its section points (period, state), without refining it by Newton's method; `failed` says how
    that ended.
    """
    n = points.shape[1]
    none = np.full(n, np.nan + 0j)
    return Orbit(_rolled(points, geometry), none, np.nan, np.full((n, n), np.nan), failed=failed)


def _rolled(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    return np.roll(points, -int(order_of_points(points, geometry)[0]), axis=0)


def polish(
    packed: np.ndarray,
    frequency: np.ndarray,
    points: np.ndarray,
    period: np.ndarray,
    *,
    geometry: Geometry,
    system: System,
    tolerance: float,
    known: dict[bytes, Orbit | None] | None = None,
    status: np.ndarray | None = None,
) -> list[Orbit | None]:
    """Refine many guesses of closed orbits by Newton's method in one call; each guess can have its own parameters.

    Parameters
    ----------
    packed, frequency, points, period
        Parameters, frequency [Hz], section point and period, a row per guess; see `polish_orbits`.
    geometry, system
        Geometry of the states, and the system to integrate.
    tolerance
        Scaled residual to reach.
    known
        Results of earlier calls with the same system and tolerance; this call adds its own. Guesses that lead
        to an orbit of an earlier call are not polished again.
    status
        Array of codes that is filled with the `status` of `polish_orbits`, if it is given: what ended the search for
        each guess.

    Returns
    -------
    list
        An orbit per guess; None where Newton's method did not converge. An orbit depends on its guess
        alone.
    """
    most_steps = 8  # most Newton steps of the first polish
    if not len(points):
        return []
    known = {} if known is None else known
    near = polish_orbits(
        packed,
        frequency,
        points,
        period,
        tolerance=NEAR_RESIDUAL,
        max_iterations=most_steps,
        rtol=NEAR_RTOL,
        least_period=False,
        system=system,
    )
    first, periods = near.section.copy(), near.orbit_period.copy()
    for row in np.flatnonzero(near.converged):
        own = near.points[row, : periods[row]]
        periods[row] = _least_period(own, geometry)
        first[row] = _rolled(own[: periods[row]], geometry)[0]
    # very unstable orbits miss NEAR_RESIDUAL at the loose tolerance: keep them up to NEARLY_RESIDUAL and polish on
    good = np.flatnonzero(near.residual <= NEARLY_RESIDUAL)
    rounded = rounded_points(first[good], geometry)
    rows = np.column_stack([packed[good], frequency[good], periods[good], rounded])
    keys = [row.tobytes() for row in rows]
    new: dict[bytes, int] = {}
    for i, key in enumerate(keys):
        if key not in known and (key not in new or first[good[i]].tolist() < first[good[new[key]]].tolist()):
            new[key] = i
    once = np.array(sorted(new.values()), np.int64)
    # start from the rounded point, so that an orbit does not depend on which guess came first; but a state that rounds
    # to 0 may be small and not 0 (a population that is almost extinct)
    starts = np.where(rounded[once] == 0.0, first[good[once]], rounded[once] * np.asarray(geometry.scales))
    orbits, ended = _polished(
        packed[good[once]], frequency[good[once]], starts, periods[good[once]], geometry, system, tolerance
    )
    if status is not None:
        status[:] = near.status
        of_key = dict(zip([keys[i] for i in once], ended.tolist(), strict=True))
        status[good] = [of_key.get(key, Status.BOUNDED) for key in keys]
    known.update(zip([keys[i] for i in once], orbits, strict=True))
    found: list[Orbit | None] = [None] * len(points)
    for place, key in zip(good.tolist(), keys, strict=True):
        found[place] = known[key]
    return found


def _least_period(points: np.ndarray, geometry: Geometry) -> int:
    """Return the smallest divisor of an orbit's period after which its section points (period, state) repeat."""
    period = len(points)
    back = geometry.distance(points, points[0])
    return next(q for q in range(1, period + 1) if period % q == 0 and (q == period or back[q] <= SAME_HALF))


def _polished(
    packed: np.ndarray,
    frequency: np.ndarray,
    points: np.ndarray,
    period: np.ndarray,
    geometry: Geometry,
    system: System,
    tolerance: float,
) -> tuple[list[Orbit | None], np.ndarray]:
    """Refine guesses of orbits by Newton's method, and then once more from the first section point in canonical
    order. Return the orbits, and the status of each (see `polish_orbits`).
    """
    found = polish_orbits(packed, frequency, points, period, tolerance=tolerance, system=system)
    orbits = [orbit_of(found, row, system) if found.converged[row] else None for row in range(len(points))]
    status = found.status.copy()
    least = {row: _rolled(one.points, geometry)[0] for row, one in enumerate(orbits) if one is not None}
    rows = [row for row, point in least.items() if (point != orbits[row].points[0]).any()]  # type: ignore[union-attr]
    if rows:
        starts = np.array([least[row] for row in rows])
        again = polish_orbits(
            packed[rows], frequency[rows], starts, found.orbit_period[rows], tolerance=tolerance, system=system
        )
        status[rows] = again.status
        for i, row in enumerate(rows):
            orbits[row] = orbit_of(again, i, system) if again.converged[i] else None
    return orbits, status


def orbit_of(found: PeriodicOrbits, row: int, system: System) -> Orbit:
    """Return a row of orbits that Newton's method found."""
    return Orbit(
        found.points[row, : found.orbit_period[row]],
        found.multipliers[row],
        float(found.residual[row]),
        found.derivative[row],
        float(found.seconds[row]),
        sizes=system.sizes,
    )


def run_on(
    packed: np.ndarray, frequency: np.ndarray, points: np.ndarray, max_orbit_period: int, system: System
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate from section points (n, state) until each trajectory closes on a periodic orbit within a tolerance.

    Returns
    -------
    points : ndarray, (n, state)
        Last sections.
    period : ndarray of int64, (n,)
        Drive periods; 0 for points that have not closed after a largest number.
    """
    most_periods = 2000  # most drive periods for which a guess is integrated until it closes
    if not len(points):
        return points, np.zeros(0, np.int64)
    result = run_branches(
        packed[:, None],
        frequency[:, None],
        points,
        n_transient=most_periods,
        n_keep=1,
        **limits_at(EXTEND_RTOL),
        stop_when_closed=True,
        closure_tolerance=EXTEND_CLOSURE,
        max_orbit_period=max_orbit_period,
        system=system,
    )
    return result.section[:, 0, -1], result.orbit_period[:, 0].astype(np.int64)


def distinct(orbits: Sequence[Orbit], geometry: Geometry) -> list[Orbit]:
    """Merge orbits that coincide, and sort them by period and canonical order. The result does not depend on the order
    in which they were given.
    """
    kept: list[Orbit] = []
    for orbit in sorted(orbits, key=lambda one: (one.period, one.points.tobytes())):
        if not any(_coincide(orbit, other, geometry) for other in kept):
            kept.append(orbit)
    ordered = [kept[i] for i in order_by_points([one.points for one in kept], geometry)]
    return sorted(ordered, key=lambda one: one.period)


def number_of(orbit: Orbit, orbits: Sequence[Orbit], geometry: Geometry) -> int:
    """Return the index of an orbit in a list of orbits, or the length of the list if the orbit is not in it."""
    return next((i for i, other in enumerate(orbits) if _coincide(orbit, other, geometry)), len(orbits))


def _coincide(a: Orbit, b: Orbit, geometry: Geometry) -> bool:
    if a.period != b.period:
        return False
    allowed = SAME_ORBIT + a.error + b.error
    # every start within the error: two points of one orbit may be as near to each other
    starts = np.flatnonzero(geometry.distance(b.points, a.points[0]) <= allowed)
    return any(geometry.distance(np.roll(b.points, -i, axis=0), a.points).max() <= allowed for i in starts)
