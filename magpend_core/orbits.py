"""Find periodic orbits by Newton's method on the stroboscopic or return map, with multipliers.

The return map of a flow takes a point of a section by crossing to its next crossing; `poincare` has its derivative.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache

import numpy as np

from magpend_core.engine.entry import integrate
from magpend_core.engine.observers import MAP, MapSettings
from magpend_core.engine.system import System
from magpend_core.engine.variational import with_tangents
from magpend_core.ordering import order_of_columns
from magpend_core.poincare import section_of
from magpend_core.pointwise import rates_packed
from magpend_core.precision import limits_at
from magpend_core.status import Status
from magpend_core.validation import check_array, check_frequency, check_states, check_tolerance

RTOL = 1e-12
"""Tolerance of the integrations here: the residual can then go below 1e-10."""

ROUNDING = 1e-12
"""Residual that the rounding of the states leaves, relative to their largest value."""

TRUST = 0.5
"""Longest Newton step in units of the system's scales; a longer one is shortened to this."""


@dataclass(frozen=True)
class PeriodicOrbits:
    """Periodic orbits that Newton's method found from guesses, one per row.

    Attributes
    ----------
    section : ndarray, (n, n_states)
        A point of the orbit on the section, angles in (-pi, pi] [rad, rad/s].
    orbit_period : ndarray of int, (n,)
        Least period found [drive periods, or returns].
    multipliers : ndarray of complex, (n, n_states)
        Floquet multipliers over the orbit's period, by falling modulus; with a section by crossing one of
        them is 0 and stands for the flow's own, 1 along the orbit.
    residual : ndarray, (n,)
        Certificate: scaled distance between the point and its image after the period.
    converged : ndarray of bool, (n,)
        Whether the residual is within the tolerance.
    n_iterations : ndarray of int, (n,)
        Newton steps taken.
    seconds : ndarray, (n,)
        Period [s]; NaN for rows that did not converge.
    points : ndarray, (n, longest period, n_states)
        The orbit's section points in the order of time, `section` first; NaN beyond the period and for rows
        that did not converge.
    derivative : ndarray, (n, n_states, n_states)
        Monodromy matrix at `section`; NaN for rows that did not converge.
    status : ndarray of int, (n,)
        Codes of `Status`: ``PERIODIC`` for rows that converged, ``BOUNDED`` where Newton's method did not converge,
        else what ended an integration.
    """

    section: np.ndarray
    orbit_period: np.ndarray
    multipliers: np.ndarray
    residual: np.ndarray
    converged: np.ndarray
    n_iterations: np.ndarray
    seconds: np.ndarray
    points: np.ndarray
    derivative: np.ndarray
    status: np.ndarray

    @property
    def is_stable(self) -> np.ndarray:
        """Whether all Floquet multipliers of each orbit lie inside the unit circle."""
        return np.asarray(np.abs(self.multipliers).max(axis=1) < 1.0)


@dataclass(frozen=True, eq=False)
class Returns:
    """Images of section points under the stroboscopic or return map, one row per point.

    Attributes
    ----------
    images : ndarray, (n, n_periods, n_states)
        Sections after 1, 2, ... periods, angles in (-pi, pi]; NaN where the integration failed, and beyond the
        periods of the row.
    derivatives : ndarray, (n, n_states, n_states)
        Derivative of the last image by the point, on the section if that is one by crossing: the monodromy
        matrix of a periodic orbit.
    times : ndarray, (n, n_periods)
        How long each period took [s].
    status : ndarray of int, (n,)
        Codes of `Status`; ``BOUNDED`` for rows that were integrated to the end.
    """

    images: np.ndarray
    derivatives: np.ndarray
    times: np.ndarray
    status: np.ndarray


def section_map(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    points: np.ndarray,
    n_periods: int | np.ndarray,
    *,
    rtol: float = RTOL,
    system: System,
) -> Returns:
    """Iterate the section map from given points; return all images, and the derivative of each last image with respect
    to its starting point.

    Parameters
    ----------
    parameters
        Packed parameters, shape (n, n_parameters) [SI].
    frequency_hz
        Drive frequencies, shape (n,) [Hz]; with a section by level crossing, 1 over the longest time to wait.
    points
        Shape (n, n_states); they are moved onto the section, see `on_section`. Rows that are not finite give NaN.
    n_periods
        Number of drive periods or returns: one number, or one per row; the derivative is that of the row's last image.
    rtol
        Relative tolerance; see `magpend_core.precision` for the absolute one, and for the steps a period may take.
    system
        System to integrate.

    Raises
    ------
    ValueError
        See `run_branches`.
    """
    n, packed, frequency = system.n_states, np.asarray(parameters), np.asarray(frequency_hz)
    rows, most = np.arange(len(points)), int(np.max(n_periods, initial=1))
    periods = np.broadcast_to(n_periods, len(points))
    starts = on_section(points, packed, system)
    is_finite = np.isfinite(starts).all(axis=1)
    sizes = np.asarray(system.sizes)
    identity = np.broadcast_to(np.diag(sizes).ravel(), (len(starts), n * n))
    extended = np.concatenate([np.where(is_finite[:, None], starts, 0.0), identity], axis=1)
    # the longest first, so that the last of them do not run alone
    order = np.argsort(-periods, kind="stable")
    cells = integrate(
        _with_controlled_tangents(system),
        MAP,
        MapSettings(),
        parameters=packed[order, None, :],
        frequency_hz=frequency[order, None],
        initial_states=extended[order],
        n_keep=most,
        n_measures=1,
        measures=periods[order, None, None],
        **limits_at(rtol),
    )
    back = np.argsort(order)
    states = np.where(is_finite[:, None, None], cells.section[back, 0], np.nan)
    images, status = states[:, :, :n], cells.status[back, 0]
    # tangent vector k, the derivative by state k, is a column
    derivatives = states[rows, periods - 1, n:].reshape(len(starts), n, n).transpose(0, 2, 1) / sizes
    section = section_of(system)
    if section is None:
        return Returns(images, derivatives, np.repeat(1.0 / frequency[:, None], most, axis=1), status)
    last = images[rows, periods - 1]
    slopes = rates_packed(system, last, packed, frequency)
    derivatives = section.of_map(derivatives, slopes, section.normals(starts, packed), section.normals(last, packed))
    return Returns(images, derivatives, cells.return_times[back, 0], status)


def on_section(points: np.ndarray, parameters: np.ndarray, system: System) -> np.ndarray:
    """Move points onto the Poincare section along one state; see `Section.placed`. Points of a driven system stay
    unchanged.

    Parameters
    ----------
    points
        Shape (..., n_states).
    parameters
        Packed parameters, of a shape whose leading part broadcasts with theirs.
    system
        Whose section it is.
    """
    section = section_of(system)
    if section is None:
        return np.array(points, dtype=np.float64)
    return wrap_angles(section.placed(points, np.asarray(parameters)), system)


@cache
def _with_controlled_tangents(system: System) -> System:
    # tangents in the error control: near a rest the trajectory alone would allow any step, and a corner in the
    # Jacobian leaves an error in the multipliers that the tolerance does not bound
    return dataclasses.replace(with_tangents(system, system.n_states), n_controlled=None)


def wrap_angles(states: np.ndarray, system: System) -> np.ndarray:
    """Wrap the angles among states (or differences of states) to (-pi, pi]."""
    wrapped = np.array(states, dtype=np.float64)
    angles = np.asarray(system.is_angle)
    values = wrapped[..., angles]
    wrapped[..., angles] = values - 2.0 * np.pi * np.ceil((values - np.pi) / (2.0 * np.pi))
    return wrapped


def scaled_distance(a: np.ndarray, b: np.ndarray, system: System) -> np.ndarray:
    """Return the largest scaled difference between states, with angles on their circle."""
    difference = np.abs(wrap_angles(np.asarray(a) - np.asarray(b), system)) / np.asarray(system.scales)
    return np.asarray(difference.max(axis=-1))


def polish_orbits(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    points: np.ndarray,
    orbit_period: np.ndarray,
    *,
    tolerance: float = 1e-10,
    max_iterations: int = 12,
    rtol: float = RTOL,
    least_period: bool = True,
    system: System,
) -> PeriodicOrbits:
    """Find the periodic orbits near given section points by Newton's method.

    Parameters
    ----------
    parameters
        Packed parameters of each orbit, shape (n, n_parameters) [SI].
    frequency_hz
        Shape (n,) [Hz].
    points
        Guesses of one section point each, shape (n, n_states) [rad, rad/s].
    orbit_period
        Period of each orbit in drive periods, shape (n,).
    tolerance
        Scaled residual at which an orbit counts as found.
    max_iterations
        Limit on the Newton steps.
    rtol
        Relative tolerance of the integration, which bounds the residual that can be reached.
    least_period
        Whether a multiple of the true period is reduced. Not with a large `tolerance`: beside its doubling an
        orbit would be taken for the one of half its period.
    system
        What is integrated.

    Returns
    -------
    PeriodicOrbits
        In the order of the guesses; rows that did not converge hold the last iterate.

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds.
    """
    frequency = check_frequency(frequency_hz, 1)
    packed = check_array("parameters", parameters, 2)
    guesses = check_states(points, 2, system.n_states, "points")
    tolerance = max(check_tolerance("tolerance", tolerance), ROUNDING * system.farthest)
    periods = np.asarray(orbit_period)
    if not (len(packed) == len(frequency) == len(guesses) == len(periods)):
        raise ValueError(
            f"parameters, frequency_hz, points and orbit_period have {len(packed)}, {len(frequency)}, "
            f"{len(guesses)} and {len(periods)} rows; they must agree."
        )
    if len(periods) and (not np.issubdtype(periods.dtype, np.integer) or periods.min() < 1):
        raise ValueError(f"orbit_period = {periods.tolist()} must be whole numbers of 1 or more.")
    n, longest = system.n_states, int(periods.max(initial=1))
    found = PeriodicOrbits(
        section=on_section(guesses, packed, system),
        orbit_period=periods.astype(np.int64),
        multipliers=np.full((len(guesses), n), np.nan, dtype=np.complex128),
        residual=np.full(len(guesses), np.nan),
        converged=np.zeros(len(guesses), dtype=bool),
        n_iterations=np.zeros(len(guesses), dtype=np.int64),
        seconds=np.full(len(guesses), np.nan),
        points=np.full((len(guesses), longest, n), np.nan),
        derivative=np.full((len(guesses), n, n), np.nan),
        status=np.full(len(guesses), int(Status.BOUNDED)),
    )
    rows = np.arange(len(guesses))
    while len(rows):
        ends = section_map(
            packed[rows], frequency[rows], found.section[rows], found.orbit_period[rows], rtol=rtol, system=system
        )
        going = _take(found, rows, ends, tolerance, least_period, system)
        # a row with a smaller period starts again from its point: no step yet
        again = going & (found.n_iterations[rows] < 0)
        stepping = going & ~again & (found.n_iterations[rows] < max_iterations)
        last = ends.images[np.arange(len(rows)), found.orbit_period[rows] - 1]
        mismatch = wrap_angles(last - found.section[rows], system)[stepping]
        steps = _newton_steps(ends.derivatives[stepping], mismatch, system)
        own = rows[stepping]
        found.section[own] = wrap_angles(found.section[own] + steps, system)
        found.n_iterations[rows[again | stepping]] += 1
        rows = rows[again | stepping]
    return found


def _take(
    found: PeriodicOrbits, rows: np.ndarray, ends: Returns, tolerance: float, least_period: bool, system: System
) -> np.ndarray:
    """Store residuals and converged orbits after a Newton iteration; return a mask of the guesses to iterate further.

    A row that closes after a divisor of its period gets this period, and -1 iterations.
    """
    last = ends.images[np.arange(len(rows)), found.orbit_period[rows] - 1]
    residual = found.residual[rows] = scaled_distance(last, found.section[rows], system)
    going = np.isfinite(residual)
    found.status[rows] = np.where(going, int(Status.BOUNDED), ends.status)
    for i in np.flatnonzero(residual <= tolerance):
        row, period = rows[i], int(found.orbit_period[rows[i]])
        images = ends.images[i, :period]
        least = _least_period(images, tolerance, system) if least_period else period
        if least < period:
            found.orbit_period[row], found.n_iterations[row] = least, -1
            continue
        going[i] = False
        found.seconds[row] = ends.times[i, :period].sum()
        found.points[row, 0], found.points[row, 1:period] = found.section[row], images[:-1]
    done = np.flatnonzero((residual <= tolerance) & ~going)
    found.multipliers[rows[done]] = _by_modulus(np.linalg.eigvals(ends.derivatives[done]))
    found.derivative[rows[done]] = ends.derivatives[done]
    found.converged[rows[done]], found.status[rows[done]] = True, int(Status.PERIODIC)
    return np.asarray(going)


def _by_modulus(multipliers: np.ndarray) -> np.ndarray:
    """Sort the multipliers (orbit, state) of each orbit by falling modulus; those of one modulus by their phase, the
    positive first.
    """
    flat = multipliers.ravel()
    modulus, phase = np.maximum(np.abs(flat), 1e-300), np.angle(flat)
    orbit = np.repeat(np.arange(len(multipliers)), multipliers.shape[1])
    order = order_of_columns([orbit, -np.log(modulus), -np.cos(phase), -np.sin(phase)], len(flat))
    return np.asarray(flat[order].reshape(multipliers.shape))


def _newton_steps(derivatives: np.ndarray, mismatch: np.ndarray, system: System) -> np.ndarray:
    """Solve (1 - M) step = mismatch for each orbit, in the least-squares sense if singular; too long steps are
    shortened.
    """
    sizes = np.asarray(system.sizes)
    matrices = np.eye(system.n_states) - derivatives * sizes / sizes[:, None]
    steps = np.einsum("nij,nj->ni", np.linalg.pinv(matrices, rcond=1e-14), mismatch / sizes) * sizes
    longest = np.abs(steps / np.asarray(system.scales)).max(axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, TRUST / np.maximum(longest, 1e-300)))


def _least_period(orbit: np.ndarray, tolerance: float, system: System) -> int:
    """Return the smallest divisor of the period after which the orbit closes.

    Images of a point that is off by the tolerance differ by a multiple of it along the orbit.
    """
    period = len(orbit)
    back = scaled_distance(orbit, orbit[-1], system) <= 1e4 * tolerance
    return next(q for q in range(1, period + 1) if period % q == 0 and back[q - 1])


def orbit_exponents(multipliers: np.ndarray, seconds: float, is_flow: bool = False) -> np.ndarray:
    """Return a periodic orbit's Lyapunov exponents [1/s], in falling order, from its multipliers.

    Parameters
    ----------
    multipliers
        Shape (n_states,), by falling modulus.
    seconds
        The orbit's period [s].
    is_flow
        Whether they are those of a return map: the least of them stands for the flow's own direction, whose
        exponent is 0.
    """
    rates = np.log(np.maximum(np.abs(multipliers), 1e-300)) / seconds
    return np.sort(np.append(rates[:-1], 0.0))[::-1] if is_flow else rates
