"""Fit the power law of lifetimes beyond the value at which a chaotic set meets an orbit, or is lost into a transient.

Beyond this value trajectories stay for a while where the set has been. Whatever the set has met, their mean lifetime is
a power of the distance from the value (Grebogi, Ott and Yorke, Phys. Rev. Lett. 57, 1986, 1284). So where a set is lost
and no orbit that it meets is proved, lifetimes give the value and the exponent, but not the orbit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pipeline.analysis.events.contact import SETTLE, Approach, Contact, Effort, Sample, SectionMap, last_stays


@dataclass(frozen=True)
class LifetimeSettings:
    """Numbers of the measurement of lifetimes and of the fit of their law."""

    longest_span: float = 8.0  # largest distance at which lifetimes are taken, in units of that of the clearances
    # ratio of the first two distances at which lifetimes are taken; the others follow from the lifetimes
    first_ratio: float = 0.7
    # relative deviation of lifetimes from a power law that counts as one standard deviation: they have fine structure
    scatter: float = 0.05
    # trajectories that leave at a parameter value, and fewest and most values of the parameter, for a fit of lifetimes;
    # more err less, and take longer
    fewest_escapes: int = 40
    fewest: int = 4
    most: int = 8
    # least share of trajectories that have left, and stay away for half of the time, at the value beyond the loss
    stay_away: float = 0.98
    lanes: int = 64  # most trajectories at a value
    looked_at: int = 16  # of these, that are looked at first, and the further sections for which they are
    further: int = 64
    halvings: int = 10  # bisections for the value up to which the set lives as long as trajectories are followed
    largest_error: float = 0.2  # largest error of the exponent, as a share of it


@dataclass(frozen=True)
class Lifetimes:
    """Lifetimes beyond contact, and the fitted law ``c |p - p_c|^-exponent``."""

    values: tuple[float, ...]
    means: tuple[float, ...]
    exponent: float  # with p_c at the contact
    exponent_error: float
    value: float  # p_c, fitted without knowledge of the contact
    value_error: float
    free_exponent: tuple[float, float]  # the exponent fitted with it, and its error


def lifetimes_of(
    approach: Approach, contact: Contact, beyond: float, settings: LifetimeSettings = LifetimeSettings()
) -> Lifetimes | None:
    """Fit a power law to mean lifetimes at several values beyond contact; None if there are too few of them."""
    span = min(abs(beyond - contact.value), settings.longest_span * contact.span) * float(
        np.sign(beyond - contact.value)
    )
    values: list[float] = []
    means: list[float] = []
    counts: list[int] = []
    ratio = settings.first_ratio
    for _ in range(2 * settings.most):
        value = contact.value + span
        mean, n = approach.lifetimes(value, 4 * approach.effort.length)
        if (n < settings.fewest_escapes and values) or len(values) == settings.most:
            break
        if n >= settings.fewest_escapes and mean >= SETTLE:
            if means and mean > means[-1]:  # to the distance at which they are twice as long
                power = np.log(mean / means[-1]) / np.log((values[-1] - contact.value) / span)
                ratio = float(np.clip(0.5 ** (1.0 / power), 0.5, 0.9))
            values, means, counts = [*values, value], [*means, mean], [*counts, n]
        span *= ratio
    if len(values) < settings.fewest:
        return None
    return fit_lifetimes(values, means, counts, contact.value, settings)


def fit_lifetimes(
    values: Sequence[float],
    means: Sequence[float],
    counts: Sequence[int],
    contact: float,
    settings: LifetimeSettings = LifetimeSettings(),
) -> Lifetimes:
    """Fit ``c |p - p_c|^-gamma`` to mean lifetimes: gamma with p_c at the contact, and p_c with both free.

    Parameters
    ----------
    values, means, counts
        Parameter values, mean lifetimes there, and numbers of trajectories that left, the nearest value last.
    contact
        Value of the contact.
    settings
        Numbers to choose.
    """
    away, logs = np.asarray(values) - contact, np.log(means)
    unit, sigma = away[-1], np.sqrt(1.0 / np.asarray(counts) + settings.scatter**2)

    def residual(u: np.ndarray) -> np.ndarray:
        shift = u[2] if len(u) == 3 else 0.0
        return np.asarray((u[0] - u[1] * np.log(away / unit - shift) - logs) / sigma)

    def fitted(start: list[float]) -> tuple[np.ndarray, np.ndarray]:
        most = [np.inf, np.inf, 0.999][: len(start)]
        found = least_squares(residual, start, bounds=([-np.inf] * len(start), most))
        scatter = max(1.0, 2.0 * found.cost / max(len(logs) - len(start), 1))
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac) * scatter))

    fixed, errors = fitted([float(logs[-1]), 1.0])
    free, free_errors = fitted([*fixed.tolist(), 0.0])
    value, value_error = float(contact + unit * free[2]), float(abs(unit) * free_errors[2])
    own = float(free[1]), float(free_errors[1])
    return Lifetimes(tuple(values), tuple(means), float(fixed[1]), float(errors[1]), value, value_error, own)


@dataclass(eq=False)
class Place:
    """Place of a chaotic set: its points, and starts on it, at the last value at which it was seen to live."""

    along: SectionMap
    starts: np.ndarray
    points: np.ndarray
    size: float
    effort: Effort

    @property
    def length(self) -> int:
        """Sections for which trajectories are followed."""
        return 4 * self.effort.length

    def stays(self, value: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the section points of trajectories at a value, and when each one was last near the set."""
        paths = self.along.paths(value, self.starts, SETTLE + self.length)
        return paths, self._last(paths)

    def _last(self, paths: np.ndarray) -> np.ndarray:
        return last_stays(paths, self.points, self.effort.around * self.size, self.along.geometry)

    def stays_or_comes_back(self, value: float, settings: LifetimeSettings) -> bool:
        """Return whether more trajectories than may be are near the set in the second half of the time.

        A part of them is looked at first, for a part of this half.
        """
        half, most = (SETTLE + self.length) // 2, (1.0 - settings.stay_away) * len(self.starts)
        paths = self.along.paths(value, self.starts[: settings.looked_at], half + settings.further)
        if (self._last(paths) > half).sum() > most:
            return True
        return bool((self.stays(value)[1] > half).sum() > most)

    def lifetime(self, value: float) -> tuple[float, int]:
        """Return the mean lifetime of trajectories at a parameter value [sections], and how many of them left.

        The set is followed: if none left, its points at this value replace those before.
        """
        paths, until = self.stays(value)
        left = until <= paths.shape[1] - self.effort.away * self.length
        settled = until >= SETTLE
        if not left.any():
            self.points = paths[:, -max(len(self.points) // len(paths), 1) :].reshape(-1, paths.shape[2])
            self.starts = paths[:, -1]
        n = int(left[settled].sum())
        return float((until[settled] - SETTLE).sum()) / max(n, 1), n


def transient_of(
    along: SectionMap,
    sample: Sample,
    seen: float,
    beyond: float,
    effort: Effort,
    settings: LifetimeSettings = LifetimeSettings(),
) -> Lifetimes | str:
    """Measure the lifetimes of a set that is lost between two values; return why there is no law, if there is none.

    Returns
    -------
    Lifetimes
        Its `value` and `free_exponent` are fitted together; `exponent` is the one at this value.
    """
    place = Place(along, sample.starts[: settings.lanes], sample.points, sample.size(along.geometry), effort)
    if place.stays_or_comes_back(beyond, settings):
        return "beyond, its trajectories stay near it or come back"
    low, high = seen, beyond
    for _ in range(settings.halvings):
        middle = 0.5 * (low + high)
        lives = place.lifetime(middle)[0] > place.length
        low, high = (middle, high) if lives else (low, middle)
    values: list[float] = []
    means: list[float] = []
    counts: list[int] = []
    for k in range(settings.halvings):
        value = low + (beyond - low) * 0.5**k
        mean, n = place.lifetime(value)
        if mean >= SETTLE and n >= settings.fewest_escapes:
            values, means, counts = [*values, value], [*means, mean], [*counts, n]
    if len(values) < settings.fewest:
        return "beyond, too few of its trajectories leave at times that can be measured"
    values, means, counts = values[-settings.most :], means[-settings.most :], counts[-settings.most :]
    found = fit_lifetimes(values, means, counts, low, settings)
    found = fit_lifetimes(values, means, counts, found.value, settings)
    exponent, error = found.free_exponent
    if not (error <= settings.largest_error * exponent and found.value_error <= 0.25 * abs(values[0] - found.value)):
        return (
            f"beyond, its trajectories leave at mean times, {means[0]:.3g} to {means[-1]:.3g}, that show no power law"
        )
    if (found.value - seen) * (beyond - seen) < 0.0:
        return "the law of lifetimes beyond would have it lost where it lives"
    return found
