"""Guess the orbits that cells approach on slow spirals.

A slow spiral looks like a bounded set: near a bifurcation of its orbit a motion takes thousands of periods
to close. Its sections show the spiral in two ways. They recur: sections p apart lie close together, whether
the distance falls (towards the orbit) or still rises (away from an unstable orbit). Or they contract: the
sections of each phase scatter less and less about their mean, however fast they turn about it. Both give
guesses for Newton's method. Cells that are on no orbit afterwards are extended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.analysis.attractors.finding.cell_blocks import Guesses, marks_of, of_owner
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, scaled_derivative
from pipeline.results.sets import Geometry, hashes


@dataclass(frozen=True)
class SpiralSettings:
    """Numbers of the search for orbits that cells approach, or leave slowly."""

    # largest scaled distance between recurring sections at which a cell makes a guess; more guesses more, in vain where
    # chaos passes
    near: float = 0.05
    # largest scaled distance of sections from the mean of their phase at which this mean is a guess
    spread: float = 0.3
    # sections contract if their spread falls over `n_parts` parts, to at most `shrinks` times the first
    n_parts: int = 4
    shrinks: float = 0.7
    per_phase: int = 4  # fewest sections of a phase in each part
    # the shortest period is taken whose distance is at most this factor above the smallest distance
    same_lag: float = 1.5
    # largest multiplier of an unstable orbit near which other orbits are guessed, and the guesses' distances
    slowly: float = 1.2
    beside: tuple[float, ...] = (0.005, 0.01, 0.02, 0.04, 0.08)
    # longest period at which every recurrence is a guess: chaos passes many orbits, and long ones cost more
    cheap: int = 4
    # largest ratio of the distances between recurring sections, later half to earlier half, that closes in
    closes_in: float = 0.9
    # factor by which a leap increases the distance from an unstable orbit; and the largest error of the linear map that
    # allows it, in units of the growth
    leap: float = 2.0
    linear: float = 0.1


@dataclass(frozen=True)
class Recurrence:
    """Recurrence of each cell's section points: after how many periods, how closely, and about which centre."""

    # int64, (cell,): period after which the younger half of the sections recurs; 0 if there is none
    period: np.ndarray
    lag: np.ndarray  # (cell,): distance of the last section from that one period before; infinite without a period
    # int64, (cell,): period at which sections contract to the mean of their phase; 0 if there is none
    centred: np.ndarray
    centre: np.ndarray  # (cell, state): mean of the last section's phase over the last part

    @classmethod
    def of(
        cls, section: np.ndarray, max_period: int, geometry: Geometry, settings: SpiralSettings = SpiralSettings()
    ) -> Recurrence:
        """Measure how the section points (cell, period_index, state) of each cell recur."""
        period, lag = _recurring(section, max_period, geometry, settings)
        centred, centre = _contracting(section, max_period, geometry, settings)
        return cls(period, lag, centred, centre)

    @property
    def is_near(self) -> np.ndarray:
        """Whether each cell's section points recur or contract about a centre, so that it may approach an orbit."""
        return np.asarray((self.period > 0) | (self.centred > 0))


def _recurring(
    section: np.ndarray, max_period: int, geometry: Geometry, settings: SpiralSettings
) -> tuple[np.ndarray, np.ndarray]:
    n, k = section.shape[:2]
    longest = min(max_period, k // 2)
    farthest, last = np.full((n, longest + 1), np.inf), np.full((n, longest + 1), np.inf)
    if longest:
        last[:, 1:] = geometry.distance(section[:, -1:], section[:, -2 : -2 - longest : -1])
    # if the last section is not near, the farthest is not
    is_near = last <= settings.near
    for p in np.flatnonzero(is_near.any(axis=0)).tolist():
        rows, half = np.flatnonzero(is_near[:, p]), max((k - p) // 2, 1)
        lag = geometry.distance(section[rows, k - half :], section[rows, k - half - p : k - p])
        farthest[rows, p] = lag.max(axis=1)
    near = farthest <= np.minimum(settings.near, settings.same_lag * farthest.min(axis=1))[:, None]
    period = near.argmax(axis=1)  # 0 where none is near
    return period, last[np.arange(n), period]


def _contracting(
    section: np.ndarray, max_period: int, geometry: Geometry, settings: SpiralSettings
) -> tuple[np.ndarray, np.ndarray]:
    n, k = section.shape[:2]
    period, centre = np.zeros(n, np.int64), section[:, -1].copy()
    # limit the periods: among many long ones, one would shrink by chance
    for p in range(1, min(max_period, settings.cheap, k // (settings.n_parts * settings.per_phase)) + 1):
        m = k // (settings.n_parts * p)
        rest = np.flatnonzero(period == 0)
        # the last part alone rules out most
        rest = rest[_scatter(section[rest, k - m * p :], 1, p, geometry)[1][:, 0] <= settings.spread]
        if not len(rest):
            continue
        mean, spread = _scatter(section[rest, k - settings.n_parts * m * p :], settings.n_parts, p, geometry)
        falls = (spread[:, 1:] < spread[:, :-1]).all(axis=1)
        found = falls & (spread[:, -1] <= np.minimum(settings.spread, settings.shrinks * spread[:, 0]))
        period[rest[found]] = p
        centre[rest[found]] += mean[found, -1, -1] * np.asarray(geometry.scales)
    return period, centre


def _scatter(section: np.ndarray, n_parts: int, p: int, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the sections of each part and phase, from the last section of the phase, and the largest
    distance from the mean in each part.
    """
    n, k, n_states = section.shape
    own = section.reshape(n, n_parts, k // (n_parts * p), p, n_states)
    # measure from the last section, so that a circle of angles is cut on its far side
    away = geometry.difference(own, own[:, -1:, -1:])
    mean = away.mean(axis=2)
    return mean, np.abs(away - mean[:, :, None]).max(axis=(2, 3, 4))


def near_closed(
    section: np.ndarray,
    max_period: int,
    geometry: Geometry,
    marks: np.ndarray | None = None,
    owner: np.ndarray | None = None,
    *,
    closing_only: bool = False,
    settings: SpiralSettings = SpiralSettings(),
) -> Guesses:
    """Make guesses of orbits from cells whose section points recur without closing; keep one guess per box of the
    section.

    Each cell gives its last section with the period of recurrence and, if its sections contract, the mean of
    the last section's phase. Cells whose sections recur at falling distances guess at every period, unlike
    chaos that merely passes an orbit; others up to the period `cheap`, unless `closing_only`. `marks` are the
    hashes of the cells' sections, if they are known, and `owner` the numbers of their parameter points.
    """
    if not len(section):
        return Guesses.none(section.shape[2])
    found = Recurrence.of(section, max_period, geometry, settings)
    closes = _closes_in(section, found, geometry, settings)
    worth = (found.period > 0) & (closes if closing_only else closes | (found.period <= settings.cheap))
    recurring, contracting = np.flatnonzero(worth), np.flatnonzero(found.centred)
    if marks is None:
        marks = np.zeros(len(section), np.uint64)
        either = np.flatnonzero(worth | (found.centred > 0))
        marks[either] = marks_of(section[either])
    owner = np.zeros(len(section), np.int64) if owner is None else owner
    # rank means after recurring sections, since a mean is not a section
    centre = found.centre[contracting]
    away = geometry.distance(centre, section[contracting, -1]) + settings.near
    rows = np.concatenate([recurring, contracting])
    return _guesses(
        np.concatenate([found.period[recurring], found.centred[contracting]]),
        np.concatenate([found.lag[recurring], away]),
        marks[rows],
        np.concatenate([section[recurring, -1], centre]),
        owner[rows],
        geometry,
        settings,
    )


def _closes_in(section: np.ndarray, found: Recurrence, geometry: Geometry, settings: SpiralSettings) -> np.ndarray:
    """Return for each cell whether its section points recur ever more closely."""
    closes = found.centred > 0
    half = section.shape[1] // 2
    for p in np.unique(found.period[found.period > 0]).tolist():
        rows = np.flatnonzero(found.period == p)
        lag = geometry.distance(section[rows, p:], section[rows, :-p])
        middle = half - p // 2
        if 0 < middle < lag.shape[1]:
            closes[rows] |= lag[:, middle:].max(axis=1) <= settings.closes_in * lag[:, :middle].max(axis=1)
    return np.asarray(closes)


def _guesses(
    period: np.ndarray,
    score: np.ndarray,
    mark: np.ndarray,
    point: np.ndarray,
    owner: np.ndarray,
    geometry: Geometry,
    settings: SpiralSettings,
) -> Guesses:
    # separate decades of the score: a cell may guess well nearby after failing from far
    decade = np.floor(np.log10(np.maximum(score, 1e-12))).astype(np.int64)
    rows = np.concatenate([period[:, None], decade[:, None], geometry.boxes(point, settings.near)], axis=1)
    return Guesses(of_owner(hashes(rows), owner), score, mark, point, period, owner).best()


def beside(
    orbits: Sequence[Orbit],
    owner: Sequence[int],
    max_period: int,
    geometry: Geometry,
    settings: SpiralSettings = SpiralSettings(),
) -> Guesses:
    """Guess the orbits that branch off from slightly unstable orbits, along their unstable directions. `owner` has the
    number of each orbit's parameter point.

    Cells that leave an orbit shortly after it lost stability go to the orbit that replaced it. That orbit has
    twice the period if the multiplier is below -1, and the same period if it is above 1.
    """
    points, periods, owners = [], [], []
    for number, orbit in zip(owner, orbits, strict=True):
        values, vectors = np.linalg.eig(scaled_derivative(orbit, geometry))
        k = int(np.abs(values).argmax())
        period = orbit.period * (1 if values[k].real > 0.0 else 2)
        if not 1.0 < np.abs(values[k]) < settings.slowly or values[k].imag != 0.0 or period > max_period:
            continue
        direction = vectors[:, k].real / np.abs(vectors[:, k].real).max()
        for size in settings.beside:
            points += [orbit.points[0] + sign * size * direction * np.asarray(geometry.scales) for sign in (1, -1)]
            periods += [period, period]
            owners += [number, number]
    if not points:
        return Guesses.none(len(geometry.scales))
    point, period_of, owner_of = np.array(points), np.array(periods, np.int64), np.array(owners, np.int64)
    mark = hashes(np.concatenate([period_of[:, None], geometry.boxes(point, 1e-6)], axis=1))
    return Guesses(of_owner(mark, owner_of), np.zeros(len(mark)), mark, point, period_of, owner_of).best()


def keys_of(section: np.ndarray, side: float, geometry: Geometry) -> np.ndarray:
    """Return a hash of the box of the section that holds the last section point of each cell."""
    return hashes(geometry.boxes(section[:, -1], side))


def leap(
    section: np.ndarray, orbits: Sequence[Orbit], geometry: Geometry, settings: SpiralSettings = SpiralSettings()
) -> np.ndarray:
    """Predict where trajectories that slowly leave an unstable orbit will be when they are `leap` times as far from it.

    Near a bifurcation leaving takes thousands of periods, in which the motion follows the orbit's monodromy
    matrix. Let u be the components of a cell's distance along the unstable eigenvectors, at the sections that
    share the phase of the orbit's first point, and lambda the multipliers. A cell leaps if
    ``|u'' - lambda**2 u| <= 0.1 (|lambda|**2 - 1) |u|`` over the younger half of these sections. Here u'' is
    u two returns later: near a period doubling the quadratic terms cancel over two returns.

    Parameters
    ----------
    section
        Sections of a leg, shape (n, LEG, state).
    orbits
        Known orbits.
    geometry
        Geometry of the states.
    settings
        Numbers to choose.

    Returns
    -------
    ndarray, (n, state)
        Predicted states; NaN for cells that do not leap.
    """
    states = np.full((len(section), section.shape[2]), np.nan)
    scales = np.asarray(geometry.scales)
    for orbit in orbits:
        growth = float(np.abs(orbit.multipliers).max())
        # skip orbits that cells leave fast: a leap gains nothing
        if not 1.0 < growth < settings.leap ** (orbit.period / section.shape[1]):
            continue
        values, vectors = np.linalg.eig(scaled_derivative(orbit, geometry))
        grows = np.abs(values) > 1.0
        values, onto = values[grows], np.linalg.inv(vectors)[grows].T
        n = 2 * int(np.log(settings.leap) / np.log(growth) / 2)
        for phase in range(orbit.period):
            index = np.arange(section.shape[1] - 1 - phase, -1, -orbit.period)[::-1]
            distance = geometry.difference(section[:, index[len(index) // 2 :]], orbit.points[0])
            along = distance @ onto
            error = np.abs(along[:, 2:] - along[:, :-2] * values**2)
            allowed = settings.linear * (np.abs(values) ** 2 - 1.0) * np.abs(along[:, :-2])
            linear = (error <= allowed).all(axis=(1, 2)) & (distance.shape[1] > settings.per_phase)
            more = ((along[linear, -1] * (values**n - 1.0)) @ vectors[:, grows].T).real
            states[linear] = orbit.points[0] + (distance[linear, -1] + more) * scales
    return states
