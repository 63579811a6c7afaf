"""Decide by nearest neighbours whether two samples of section points lie on the same set.

Two trajectories on one ergodic set visit the same points equally often; two attractors are a distance
apart. So each point of the later half of a sample looks for its nearest neighbour among equally many points
of the earlier half of its own sample and of the other sample. The share of neighbours in the other sample
is one half for samples of one set. For two sets it falls to 0 once the points are denser than the gap.
Comparing one half with the other excludes neighbours in time, which every trajectory finds in itself
(Schilling, J. Am. Stat. Assoc. 81, 799, 1986, has the statistic for independent points).

A share of `SAME` or more means one set, and a share below `OTHER` means two. In between more points decide.
If a share stays in between, one set is assumed, since the share of two separate sets would keep falling. The
measured rate of errors is in docs/attractors.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from magpend_core.neighbours import n_nearer
from pipeline.results.sets import Geometry, nearest_distances

SAME, OTHER = 0.25, 0.05
"""Share of neighbours in the other sample from which two samples are one set, and below which two sets."""

MOST_COMPARED = 4096
"""Most points per sample in a comparison."""

INSIDE, REACHED = 0.9, 3.0
"""A cell is on a set if the share `INSIDE` of its points lies within `REACHED` times the set's spacing."""


def thinned(points: np.ndarray, n: int) -> np.ndarray:
    """Draw at most `n` points of a sample (m, state) at random, and keep their order in time.

    Points are drawn at random with a fixed seed. A regular stride would be wrong: on a set of two pieces that
    alternate, every second point lies on one piece.
    """
    return points if len(points) <= n else np.asarray(points[_drawn(len(points), n)])


@lru_cache(maxsize=256)
def _drawn(n_all: int, n: int) -> np.ndarray:
    """Draw `n` of `n_all` indices with a fixed seed, in rising order."""
    return np.sort(np.random.default_rng(n_all).choice(n_all, n, replace=False))


def mixing(a: np.ndarray, b: np.ndarray, geometry: Geometry, least: float = 0.0, enough: float = np.inf) -> float:
    """Compute how well two samples of section points mix: about 0.5 if both lie on one set, 0 if they lie on distant
    sets.

    Parameters
    ----------
    a, b
        Section points in the order of time, shapes (n, state) and (m, state).
    geometry
        Geometry of the states.
    least
        Scaled distances up to this count as 0: two cells that close on one orbit are on one set.
    enough
        The count ends once the share is certain to be at least this. The result may then be smaller than the
        share, but not smaller than `enough`.

    Returns
    -------
    float
        About 0.5 for samples of one set, 0 for distant ones; NaN if either has fewer than 4 points.
    """
    n = min(len(a), len(b), MOST_COMPARED) // 2
    if n < 2:
        return float("nan")
    a, b = (geometry.scaled(thinned(points, 2 * n)) for points in (a, b))
    return min(_crossing(a, b, n, geometry, least, enough), _crossing(b, a, n, geometry, least, enough))


def _crossing(own: np.ndarray, other: np.ndarray, n: int, geometry: Geometry, least: float, enough: float) -> float:
    # take points from the whole duration of the other sample
    points = own[:n], thinned(other, n), own[n : 2 * n]
    return n_nearer(*points, geometry.circumference, least, enough * n) / n


def is_stationary(path: np.ndarray, geometry: Geometry, least: float = 0.0) -> bool:
    """Return whether the first and the second half of a trajectory visit the same set."""
    half = len(path) // 2
    share = mixing(path[:half], path[half:], geometry, least, OTHER)
    return bool(share >= OTHER)


def group(samples: Sequence[np.ndarray], geometry: Geometry, least: float = 0.0) -> tuple[np.ndarray, bool]:
    """Group trajectories by the set on which their section points lie.

    Parameters
    ----------
    samples
        Points of each cell in the order of time, shape (n, state) each.
    geometry
        Geometry of the states.
    least
        Scaled distances up to this count as 0, see `mixing`.

    Returns
    -------
    set : ndarray of int64
        Number of the set of each sample, in the order in which they appear.
    is_sure : bool
        Whether no share lay between `OTHER` and `SAME`.
    """
    sets: list[list[int]] = []
    is_sure = True
    for i, sample in enumerate(samples):
        shares = [mixing(sample, _pooled([samples[k] for k in own]), geometry, least, SAME) for own in sets]
        near = [k for k, share in enumerate(shares) if share >= OTHER]
        is_sure &= not any(OTHER <= share < SAME for share in shares)
        if not near:
            sets.append([i])
            continue
        # a sample near several sets joins them
        joined = sorted(k for n in near for k in sets[n])
        sets = [own for n, own in enumerate(sets) if n not in near]
        sets.append([*joined, i])
    number = np.zeros(len(samples), np.int64)
    for k, own in enumerate(sorted(sets, key=min)):
        number[own] = k
    return number, is_sure


def _pooled(samples: Sequence[np.ndarray]) -> np.ndarray:
    each = max(4, MOST_COMPARED // len(samples))
    if len({len(sample) for sample in samples}) == 1:
        return thinned(np.stack(samples, axis=1), each).reshape(-1, samples[0].shape[1])
    parts = [thinned(sample, each) for sample in samples]
    n = min(len(part) for part in parts)
    return np.stack([part[:n] for part in parts], axis=1).reshape(-1, parts[0].shape[1])


@dataclass(frozen=True, eq=False)
class Cloud:
    """Section points of one set, to test whether other trajectories lie on the same set."""

    points: np.ndarray  # (n, state): section points of its trajectories
    geometry: Geometry  # geometry of the states
    least: float  # smallest spacing of points to assume

    @classmethod
    def of(cls, samples: Sequence[np.ndarray], geometry: Geometry, least: float) -> Cloud:
        """Pool the section points of a set's trajectories."""
        return cls(_pooled(samples), geometry, least)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the scaled points."""
        return self.geometry.tree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Scaled distance within which nearly every point of the set finds another."""
        # distances from one half to the other: a safe spacing, since the whole is twice as dense
        order = np.random.default_rng(0).permutation(len(self.points))
        half, rest = np.array_split(self.points[order], 2)
        away = nearest_distances(rest, half, self.geometry) if len(rest) else np.zeros(1)
        return max(float(np.quantile(away, 0.99)), self.least)

    def distances(self, section: np.ndarray, most: float = np.inf) -> np.ndarray:
        """Return the distance of each section point (..., state) from the set, in units of the spacing of the set's
        points. A distance above `most` may be infinite, which ends the search for it sooner.
        """
        bound = 1.001 * most * self.spacing
        away = self.tree.query(self.geometry.scaled(section), p=np.inf, distance_upper_bound=bound)[0]
        return np.asarray(away / self.spacing)


def members(section: np.ndarray, clouds: Sequence[Cloud]) -> np.ndarray:
    """Return the index of the set (in `clouds`) on which each cell's section points lie; -1 for none."""
    if not clouds or not len(section):
        return np.full(len(section), -1, np.int64)
    away = np.stack([cloud.distances(section, REACHED) for cloud in clouds])
    inside = (away <= REACHED).mean(axis=2)
    middle = np.median(away, axis=2)
    best = np.where(inside >= INSIDE, middle, np.inf).argmin(axis=0)
    found = inside[best, np.arange(len(section))] >= INSIDE
    return np.where(found, best, -1).astype(np.int64)
