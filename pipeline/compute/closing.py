"""Decide whether a trajectory has closed on a periodic orbit, or estimate how long it will take to close."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magpend_core.engine.system import System
from pipeline.specification.tables import Integration

LOOKED_AT = 129
"""Number of last sections of a trajectory that are compared."""

FEWEST = 8
"""Fewest sections for a decision."""

NEAR = 0.1
"""Largest distance from an orbit at which a rate is trusted: chaotic sections also approach by chance."""

LONGEST: int = Integration.model_fields["max_orbit_period"].default
TOLERANCE: float = Integration.model_fields["closure_tolerance"].default
"""Longest period looked for and largest distance of a closed motion: the defaults of runs."""


class Closing(NamedTuple):
    """How far a trajectory is from a periodic orbit, and how long it would take to close on it."""

    period: int  # drive periods after which the motion comes back closest
    # bound on the distance from the orbit if the motion is closed or closes, else the largest distance of late sections
    # that are `period` apart; in the scales of the states, angles on the circle
    distance: float
    # drive periods until the motion closes if it goes on as it does: 0 if it has closed, infinite if the distance does
    # not shrink
    to_go: float

    @property
    def is_closed(self) -> bool:
        """Whether the trajectory lies within `TOLERANCE` of a periodic orbit."""
        return self.to_go == 0.0

    def sentence(self, n_transient: int) -> str:
        """Return a sentence on whether the trajectory has closed; if not, it suggests a value of ``--transient`` that
        suffices.
        """
        periods = f"{self.period} drive period{'s' if self.period > 1 else ''}"
        if self.is_closed:
            return f"closed: the motion repeats after {periods} (distance {self.distance:.1e})"
        text = f"not closed: after {periods} the motion comes back to a distance of {self.distance:.1e}"
        if math.isinf(self.to_go):
            return f"{text}, which does not shrink steadily (closed: {TOLERANCE:g})"
        enough = n_transient + math.ceil(self.to_go)
        return (
            f"{text}; if this distance goes on shrinking as it does, the motion has closed ({TOLERANCE:g}) "
            f"after --transient {enough}"
        )


def closing_of(sections: np.ndarray, system: System) -> Closing | None:
    """Decide whether a trajectory has closed on a periodic orbit, by comparing its stroboscopic points.

    The distances of a period fall into four quarters. If the largest of each quarter shrinks from quarter
    to quarter, the sum of all that follow bounds the distance from the orbit, as in
    `magpend_core.engine.observers.closed_period`.

    Parameters
    ----------
    sections
        Consecutive last sections of a trajectory, shape (n, n_states) [the states' units].
    system
        System that was integrated; gives the scales of the states and the angles.

    Returns
    -------
    Closing or None
        None for fewer than `FEWEST` sections.
    """
    n = len(sections)
    if n < FEWEST:
        return None
    lags = [_lag_distances(sections, p, system) for p in range(1, min(LONGEST, n // 4) + 1)]
    found = [_judged(p, distances) for p, distances in enumerate(lags, 1)]
    closed = [one for one in found if one.is_closed]
    if closed:
        return next(
            one._replace(distance=closed[0].distance, to_go=0.0)
            for one, distances in zip(found, lags, strict=True)
            # see `observers._smallest_divisor`
            if closed[0].period % one.period == 0 and _late(distances) <= 10.0 * TOLERANCE
        )
    # prefer a shrinking distance to a small one; multiples of a period have about the same bound
    least = min(found, key=lambda one: (math.isinf(one.to_go), one.distance))
    return next(
        one
        for one in found
        if one.distance <= 3.0 * least.distance and math.isinf(one.to_go) == math.isinf(least.to_go)
    )


def _lag_distances(sections: np.ndarray, p: int, system: System) -> np.ndarray:
    apart = np.abs(sections[p:] - sections[:-p])
    angles = np.array(system.is_angle, dtype=bool)
    turned = apart[:, angles] % (2.0 * np.pi)
    apart[:, angles] = np.minimum(turned, 2.0 * np.pi - turned)
    return np.asarray((apart / np.array(system.scales)).max(axis=1))


def _late(distances: np.ndarray) -> float:
    return float(distances[-(len(distances) // 4) :].max())


def _judged(p: int, distances: np.ndarray) -> Closing:
    """Decide from the distances between points `p` periods apart whether a trajectory closes with period `p`."""
    quarter = len(distances) // 4
    last = distances[len(distances) - 4 * quarter :].reshape(4, quarter).max(axis=1)
    if last[2:].max() <= 0.01 * TOLERANCE:  # errors of integration hide what shrinks
        return Closing(p, float(last[-1]), 0.0)
    rate = math.log(last[1] / last[3]) / (2 * quarter) if last[3] > 0.0 else 0.0
    bound = float(last[-1] / -math.expm1(-rate * p)) if rate > 0.0 else math.inf
    if bound > NEAR or not (np.diff(last) < 0.0).all():
        return Closing(p, float(last[-1]), math.inf)
    return Closing(p, bound, max(0.0, math.log(bound / TOLERANCE) / rate))
