"""Cells that do not close but come back near: what orbit they may be on their way to.

A slow spiral looks like a bounded set: near a bifurcation of its orbit a motion takes thousands of periods
to close. Its sections show it in two ways. They recur: sections p apart lie close together, whether the
distance falls (towards the orbit) or still rises (away from an unstable one that it passed). Or they
contract: the sections of each phase scatter less and less about their mean, however fast they turn about
it. Both make guesses for Newton's method; and what no orbit accounts for then is run on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.analysis.attractors.cells import Guesses, marks_of
from pipeline.analysis.attractors.orbits import Orbit, scaled_derivative
from pipeline.analysis.sets import Geometry, hashes

NEAR = 0.05
"""Scaled distance between recurring sections of a cell that is not closed, at which it makes a guess."""

SPREAD = 0.3
"""Largest scaled distance of sections from the mean of their phase, at which this makes a guess."""

N_PARTS, SHRINKS = 4, 0.7
"""The spread shrinks if it falls from part to part of the sections, to at most this share of the first's."""

PER_PHASE = 4
"""Fewest sections of a phase in each part."""

SAME_LAG = 1.5
"""A shorter period is taken if its sections lie at most this much farther apart."""

MAX_GUESSES = 64
"""Most guesses per parameter point from cells that are not closed."""

SPIRALS_PER = 20
"""One cell in so many is run on at most, where that is more than `MAX_GUESSES`."""

SLOWLY, BESIDE = 1.2, (0.005, 0.01, 0.02, 0.04, 0.08)
"""Largest multiplier of an unstable orbit beside which others are looked for, and scaled distances there."""

RUN_ON_LEGS = 32
"""How long spirals are run on, in legs of `following.LEG` drive periods."""


@dataclass(frozen=True)
class Recurrence:
    """How the sections of cells come back.

    Attributes
    ----------
    period : ndarray of int64, (cell,)
        After which the younger half of the sections lies within `NEAR` of itself; 0 if there is none.
    lag : ndarray, (cell,)
        Last distance after that period; infinite if there is none.
    centred : ndarray of int64, (cell,)
        Period at which sections contract to the mean of their phase; 0 if there is none.
    centre : ndarray, (cell, state)
        Mean of the last section's phase over the last part.
    """

    period: np.ndarray
    lag: np.ndarray
    centred: np.ndarray
    centre: np.ndarray

    @classmethod
    def of(cls, section: np.ndarray, max_period: int, geometry: Geometry) -> Recurrence:
        """Recurrence of cells with sections (cell, period_index, state)."""
        period, lag = _recurring(section, max_period, geometry)
        centred, centre = _contracting(section, max_period, geometry)
        return cls(period, lag, centred, centre)

    @property
    def is_near(self) -> np.ndarray:
        """Cells that may be on their way to an orbit."""
        return np.asarray((self.period > 0) | (self.centred > 0))


def _recurring(section: np.ndarray, max_period: int, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    n, k = section.shape[:2]
    longest = min(max_period, k // 2)
    farthest, last = np.full((n, longest + 1), np.inf), np.full((n, longest + 1), np.inf)
    for p in range(1, longest + 1):
        half = max((k - p) // 2, 1)
        lag = geometry.distance(section[:, k - half :], section[:, k - half - p : k - p])
        farthest[:, p], last[:, p] = lag.max(axis=1), lag[:, -1]
    near = farthest <= np.minimum(NEAR, SAME_LAG * farthest.min(axis=1))[:, None]
    period = near.argmax(axis=1)  # 0 where none is near
    return period, last[np.arange(n), period]


def _contracting(section: np.ndarray, max_period: int, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    n, k, n_states = section.shape
    period, centre = np.zeros(n, np.int64), section[:, -1].copy()
    for p in range(1, min(max_period, k // (N_PARTS * PER_PHASE)) + 1):
        m = k // (N_PARTS * p)
        rest = np.flatnonzero(period == 0)
        own = section[rest, k - N_PARTS * m * p :].reshape(len(rest), N_PARTS, m, p, n_states)
        # about the last section of its phase, so that a circle is cut on its far side
        away = geometry.difference(own, own[:, -1:, -1:])
        mean = away.mean(axis=2, keepdims=True)
        spread = np.abs(away - mean).max(axis=(2, 3, 4))
        falls = (spread[:, 1:] < spread[:, :-1]).all(axis=1)
        found = falls & (spread[:, -1] <= np.minimum(SPREAD, SHRINKS * spread[:, 0]))
        period[rest[found]] = p
        centre[rest[found]] += mean[found, -1, 0, -1] * np.asarray(geometry.scales)
    return period, centre


def near_closed(section: np.ndarray, max_period: int, geometry: Geometry) -> Guesses:
    """Guesses from cells that are not closed but come back near, the best one of each box.

    From each the last section and the period after which the sections lie nearest; and, if they contract,
    the mean of its phase.
    """
    found = Recurrence.of(section, max_period, geometry)
    marks = marks_of(section)
    recurring, contracting = np.flatnonzero(found.period), np.flatnonzero(found.centred)
    spirals = _guesses(
        found.period[recurring], found.lag[recurring], marks[recurring], section[recurring, -1], geometry
    )
    # after those that recur: a mean is no section
    away = geometry.distance(found.centre[contracting], section[contracting, -1]) + NEAR
    means = _guesses(
        found.centred[contracting], away, marks[contracting], found.centre[contracting], geometry
    )
    return spirals.joined(means)


def _guesses(
    period: np.ndarray, score: np.ndarray, mark: np.ndarray, point: np.ndarray, geometry: Geometry
) -> Guesses:
    # by decades of the score: what was no good guess from afar may be one from near by
    decade = np.floor(np.log10(np.maximum(score, 1e-12))).astype(np.int64)
    rows = np.concatenate([period[:, None], decade[:, None], geometry.boxes(point, NEAR)], axis=1)
    return Guesses(hashes(rows), score, mark, point, period).best()


def beside(orbits: Sequence[Orbit], max_period: int, geometry: Geometry) -> Guesses:
    """Guesses of the orbits that sprang from unstable ones, along their unstable directions.

    A cell that left an orbit which lost its stability a little way back goes on to the one that took its
    place: of twice the period where the multiplier is below -1, of the same where it is above 1.
    """
    points, periods = [], []
    for orbit in orbits:
        values, vectors = np.linalg.eig(scaled_derivative(orbit, geometry))
        k = int(np.abs(values).argmax())
        period = orbit.period * (1 if values[k].real > 0.0 else 2)
        if not 1.0 < np.abs(values[k]) < SLOWLY or values[k].imag != 0.0 or period > max_period:
            continue
        direction = vectors[:, k].real / np.abs(vectors[:, k].real).max()
        for size in BESIDE:
            points += [
                orbit.points[0] + sign * size * direction * np.asarray(geometry.scales) for sign in (1, -1)
            ]
            periods += [period, period]
    if not points:
        return Guesses.none(len(geometry.scales))
    point, period_of = np.array(points), np.array(periods, np.int64)
    mark = hashes(np.concatenate([period_of[:, None], geometry.boxes(point, 1e-6)], axis=1))
    return Guesses(mark, np.zeros(len(mark)), mark, point, period_of).best()


def spirals_of(section: np.ndarray, max_period: int, side: float, geometry: Geometry) -> Guesses:
    """Cells that come back near, the best one of each box of a side, to be run on: keys are `keys_of`."""
    found = Recurrence.of(section, max_period, geometry)
    rows = np.flatnonzero(found.is_near)
    last = section[rows, -1]
    score = np.minimum(found.lag[rows], NEAR)
    own = keys_of(section[rows], side, geometry)
    return Guesses(own, score, marks_of(section[rows]), last, found.period[rows]).best()


def keys_of(section: np.ndarray, side: float, geometry: Geometry) -> np.ndarray:
    """Hash of the box that the last section of each cell lies in."""
    return hashes(geometry.boxes(section[:, -1], side))
