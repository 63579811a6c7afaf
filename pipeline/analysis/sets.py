"""Sets of states: distances on circles and lines, occupied boxes, groups.

States are compared in units of the system's scales, angles on their circle, by the largest
difference of a component. Nothing here depends on the order of its rows, and nothing is quadratic in
their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from magpend_core.engine.system import System
    from magpend_core.models.model import Model

TWO_PI = 2.0 * np.pi


@dataclass(frozen=True)
class Geometry:
    """Which components are angles, and what counts as 1 in each.

    Attributes
    ----------
    is_angle : tuple of bool
    scales : tuple of float
    """

    is_angle: tuple[bool, ...]
    scales: tuple[float, ...]

    @classmethod
    def of(cls, owner: System | Model) -> Geometry:
        """Geometry of the states of a system, or of a model."""
        return cls(owner.is_angle, owner.scales)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.scales)

    @property
    def circumference(self) -> np.ndarray:
        """Scaled length of each component's circle, 0 for those on a line."""
        return np.where(self.is_angle, TWO_PI / np.asarray(self.scales), 0.0)

    def scaled(self, points: np.ndarray) -> np.ndarray:
        """States in units of the scales, angles in [0, circumference)."""
        scaled = np.asarray(points, np.float64) / np.asarray(self.scales)
        for i, length in enumerate(self.circumference):
            if length > 0.0:
                folded = np.mod(scaled[..., i], length)
                scaled[..., i] = np.where(folded >= length, 0.0, folded)
        return np.asarray(scaled)

    def difference(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Scaled a - b, the short way round on circles."""
        difference = (np.asarray(a) - np.asarray(b)) / np.asarray(self.scales)
        for i, length in enumerate(self.circumference):
            if length > 0.0:
                difference[..., i] -= length * np.round(difference[..., i] / length)
        return np.asarray(difference)

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Largest scaled difference of a component."""
        return np.asarray(np.abs(self.difference(a, b)).max(axis=-1))

    def tree(self, points: np.ndarray) -> cKDTree:
        """Search tree over states (query with `scaled` states and ``p=inf``)."""
        return cKDTree(self.scaled(points), boxsize=self.circumference)

    def boxes(self, points: np.ndarray, side: float) -> np.ndarray:
        """Whole numbers of the box that each state lies in; a circle holds a whole number of boxes."""
        scaled = self.scaled(points)
        boxes = np.empty(scaled.shape, np.int64)
        for i, length in enumerate(self.circumference):
            if length > 0.0:
                n = self._n_boxes(length, side)
                boxes[..., i] = np.minimum((scaled[..., i] * (n / length)).astype(np.int64), n - 1)
            else:
                boxes[..., i] = np.floor(scaled[..., i] / side)
        return boxes

    def box_pairs(self, boxes: np.ndarray, side: float) -> np.ndarray:
        """Pairs of rows of `boxes` (unique) that touch, corners included; shape (n, 2)."""
        if len(boxes) < 2:
            return np.empty((0, 2), np.int64)
        # in units of one box, so that a circle is as long as it has boxes
        lengths = [float(self._n_boxes(x, side)) if x > 0.0 else 0.0 for x in self.circumference]
        tree = cKDTree(boxes.astype(np.float64), boxsize=np.array(lengths))
        return np.asarray(tree.query_pairs(1.5, p=np.inf, output_type="ndarray"), np.int64)

    @staticmethod
    def _n_boxes(length: float, side: float) -> int:
        return max(1, int(length / side))


def hashes(rows: np.ndarray) -> np.ndarray:
    """One uint64 per row that depends on the row's bits alone: an order without a history.

    Zeros of either sign count as one number.
    """
    values = np.ascontiguousarray(rows)
    bits = (values + 0.0 if values.dtype.kind == "f" else values.astype(np.int64)).view(np.uint64)
    total = np.full(bits.shape[:-1], 0x9E3779B97F4A7C15, np.uint64)
    for i in range(bits.shape[-1]):
        x = total ^ bits[..., i]
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
        total = x ^ (x >> np.uint64(31))
    return total


def groups(n: int, pairs: np.ndarray) -> np.ndarray:
    """Number of the connected group of each of `n` nodes."""
    edges = np.asarray(pairs, np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def nearest_distances(a: np.ndarray, b: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Distance of each state of `a` from the nearest of `b`."""
    return np.asarray(geometry.tree(b).query(geometry.scaled(a), p=np.inf)[0])


def mean_distance(a: np.ndarray, b: np.ndarray, geometry: Geometry) -> float:
    """Mean distance of the states of one set from the other set, the larger of both directions.

    For samples of a chaotic set the largest distance is set by outliers; the mean is not (the
    modified Hausdorff distance of Dubuisson and Jain, Proc. 12th ICPR, 1994, p. 566).
    """
    there, back = nearest_distances(a, b, geometry), nearest_distances(b, a, geometry)
    return float(max(there.mean(), back.mean()))


def order_by_points(points: list[np.ndarray], geometry: Geometry) -> list[int]:
    """Canonical order of sets: lexicographic by the rounded least point of each.

    Ties go to the shorter set, then to all points in the order given.
    """

    def key(i: int) -> tuple[tuple[float, ...], int, bytes]:
        rounded = rounded_points(points[i], geometry)
        return tuple(min(rounded.tolist())), len(rounded), rounded.tobytes()

    return sorted(range(len(points)), key=key)


def rounded_points(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Scaled points, angles in (-pi, pi], rounded to 1e-6: an order that survives another CPU."""
    centred = geometry.difference(points, np.zeros(points.shape[-1]))
    return np.asarray(np.round(centred, 6) + 0.0)
