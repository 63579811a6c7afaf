"""Compute distances between sets of states, the boxes that they occupy, and connected groups.

States are compared in units of the system's scales, angles on their circle, by the largest difference of a
component. Results do not depend on the order of rows, and the work is not quadratic in their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from magpend_core.ordering import SAME_DIGITS, canonical_order, order_of_columns

if TYPE_CHECKING:
    from magpend_core.engine.system import System
    from magpend_core.models.model import Model

_MIXING = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))
"""Shifts and factors of the generator splitmix64, which `hashes` mixes bits with."""

_LAST_SHIFT = np.uint64(31)


@dataclass(frozen=True)
class Geometry:
    """Geometry of the state space: which states are angles, and the scale of each state."""

    is_angle: tuple[bool, ...]  # whether each component is an angle
    scales: tuple[float, ...]  # change of each component that counts as 1 [the states' units]

    @classmethod
    def of(cls, owner: System | Model) -> Geometry:
        """Return the geometry of the states of a system or a model."""
        return cls(owner.is_angle, owner.scales)

    @classmethod
    def in_units(cls, owner: System | Model) -> Geometry:
        """Return the geometry in which distances that a user gives or reads are told: in the states' units."""
        return cls(owner.is_angle, owner.units)

    @property
    def n_states(self) -> int:
        """Number of state variables."""
        return len(self.scales)

    @cached_property
    def circumference(self) -> np.ndarray:
        """Circumference of each angle's circle in units of its scale; 0 for states that are no angles."""
        return np.where(self.is_angle, 2.0 * np.pi / self._divisors, 0.0)

    @cached_property
    def _divisors(self) -> np.ndarray:
        return np.asarray(self.scales)

    @cached_property
    def _circles(self) -> list[tuple[int, float]]:
        return [(i, length) for i, length in enumerate(self.circumference.tolist()) if length > 0.0]

    def scaled(self, points: np.ndarray) -> np.ndarray:
        """Divide states (..., state) by their scales, and wrap angles to [0, circumference)."""
        scaled = np.asarray(points, np.float64) / self._divisors
        for i, length in self._circles:
            folded = np.mod(scaled[..., i], length)
            scaled[..., i] = np.where(folded >= length, 0.0, folded)
        return np.asarray(scaled)

    def difference(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the difference a - b in units of the scales, along the shorter arc for angles."""
        difference = (np.asarray(a) - np.asarray(b)) / self._divisors
        for i, length in self._circles:
            difference[..., i] -= length * np.round(difference[..., i] / length)
        return np.asarray(difference)

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the distance between states: the largest of the scaled differences of their components."""
        return np.asarray(np.abs(self.difference(a, b)).max(axis=-1))

    def tree(self, points: np.ndarray) -> cKDTree:
        """Build a nearest-neighbour search tree of states (query it with `scaled` states and ``p=inf``)."""
        # sliding midpoints: trees are asked a few times each, and a balanced one costs more than it saves
        boxsize = self.circumference if self._circles else None
        return cKDTree(self.scaled(points), boxsize=boxsize, balanced_tree=False, compact_nodes=False)

    def boxes(self, points: np.ndarray, side: float) -> np.ndarray:
        """Return the integer coordinates of the box that holds each state; boxes have the side `side` in scaled
        states.
        """
        scaled = self.scaled(points)
        boxes = np.empty(scaled.shape, np.int64)
        for i, length in enumerate(self.circumference):
            if length > 0.0:
                n = self._n_boxes(length, side)
                boxes[..., i] = np.minimum((scaled[..., i] * (n / length)).astype(np.int64), n - 1)
            else:
                boxes[..., i] = np.floor(scaled[..., i] / side)
        return boxes

    def box_pairs(self, boxes: np.ndarray, side: float, numbers: np.ndarray) -> np.ndarray:
        """Return which boxes touch each other (also at corners), as pairs of row numbers (n, 2). Boxes that differ in
        their `numbers` (box, number) do not touch.
        """
        if len(boxes) < 2:
            return np.empty((0, 2), np.int64)
        # lengths in boxes: a circle is as long as its number of boxes
        lengths = [float(self._n_boxes(x, side)) if x > 0.0 else 0.0 for x in self.circumference]
        rows = np.concatenate([2 * numbers, boxes], axis=1).astype(np.float64)
        tree = cKDTree(rows, boxsize=np.array([0.0] * numbers.shape[1] + lengths))
        return np.asarray(tree.query_pairs(1.5, p=np.inf, output_type="ndarray"), np.int64)

    @staticmethod
    def _n_boxes(length: float, side: float) -> int:
        return max(1, int(length / side))


def rows_by_number(numbers: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows (ascending) that have each number; negative numbers stand for none."""
    order = np.argsort(numbers, kind="stable")
    found, begins = np.unique(numbers[order], return_index=True)
    rows = np.split(order, begins)[1:]
    return {number: own for number, own in zip(found.tolist(), rows, strict=True) if number >= 0}


def looked_up(values: Mapping[int, int], keys: np.ndarray, default: np.ndarray | int) -> np.ndarray:
    """Return the value of each key of an array in a mapping, and a default for keys that are not in it."""
    if not values:
        return np.full(len(keys), default, np.int64) if np.ndim(default) == 0 else np.asarray(default)
    known = np.array(sorted(values), keys.dtype)
    found = np.array([values[key] for key in sorted(values)], np.int64)
    at = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return np.where(known[at] == keys, found[at], default)


def hashes(rows: np.ndarray) -> np.ndarray:
    """Hash each row of an array to a uint64. The hash depends on the row's bits alone, so that sorting by it is
    reproducible.

    Zeros of both signs have the same hash.
    """
    values = np.ascontiguousarray(rows)
    bits = (values + 0.0 if values.dtype.kind == "f" else values.astype(np.int64)).view(np.uint64)
    total = np.full(bits.shape[:-1], 0x9E3779B97F4A7C15, np.uint64)
    if not total.size:
        return total
    shifted = np.empty_like(total)
    # in place: rows are few and long, so that an operation's overhead counts
    for column in np.ascontiguousarray(np.moveaxis(bits, -1, 0)):
        np.bitwise_xor(total, column, out=total)
        for shift, factor in _MIXING:
            np.bitwise_xor(total, np.right_shift(total, shift, out=shifted), out=total)
            np.multiply(total, factor, out=total)
        np.bitwise_xor(total, np.right_shift(total, _LAST_SHIFT, out=shifted), out=total)
    return total


def groups(n: int, pairs: np.ndarray) -> np.ndarray:
    """Return the number of the connected component of each node, in a graph of `n` nodes with edges (m, 2)."""
    edges = np.asarray(pairs, np.int64).reshape(-1, 2)
    if not len(edges):
        return np.arange(n)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def nearest_distances(a: np.ndarray, b: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the distance of each state of `a` from the nearest state of `b`."""
    from magpend_core import neighbours  # figures need no compiler

    return neighbours.nearest_distances(geometry.scaled(b), geometry.scaled(a), geometry.circumference)


def mean_distance(a: np.ndarray, b: np.ndarray, geometry: Geometry) -> float:
    """Compute the mean distance of one set's states from another set, in both directions, and return the larger value.

    This is the modified Hausdorff distance of Dubuisson and Jain (Proc. 12th ICPR, 1994, p. 566). For samples
    of a chaotic set, outliers determine the largest distance, but not the mean.
    """
    there, back = nearest_distances(a, b, geometry), nearest_distances(b, a, geometry)
    return float(max(there.mean(), back.mean()))


def order_by_points(points: list[np.ndarray], geometry: Geometry, owner: np.ndarray | None = None) -> list[int]:
    """Return a canonical order of sets, by the least point of each; see `canonical_order`. Those of one `owner` follow
    each other.

    In a tie the shorter set comes first; then all points decide, from the least one on.
    """
    if len(points) < 2:
        return list(range(len(points)))
    sizes = np.array([len(own) for own in points])
    states, first = centred(np.concatenate(points), geometry), np.cumsum(sizes) - sizes
    states = states[order_of_columns(chain([np.repeat(np.arange(len(points)), sizes)], states.T), len(states))]

    def columns() -> Iterator[np.ndarray]:
        yield np.zeros(len(points)) if owner is None else owner
        yield from states[first].T
        yield sizes
        for k in range(1, int(sizes.max())):
            row = np.full((len(points), geometry.n_states), np.inf)
            row[sizes > k] = states[first[sizes > k] + k]
            yield from row.T

    return [int(i) for i in order_of_columns(columns(), len(points))]


def order_of_points(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the canonical order of states (n, state), the least one first; see `canonical_order`."""
    return canonical_order(centred(points, geometry))


def centred(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Scale states and wrap their angles to half a circle around 0; angles that are nearly the lower end are at the
    upper one.
    """
    found = geometry.difference(points, np.zeros(points.shape[-1]))
    is_low = (geometry.circumference > 0.0) & (found <= -0.5 * geometry.circumference + SAME_DIGITS)
    return np.asarray(np.where(is_low, found + geometry.circumference, found))


def rounded_points(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Scale states, wrap their angles, and round them to 1e-6, so that most guesses of one orbit are equal."""
    return np.asarray(np.round(geometry.difference(points, np.zeros(points.shape[-1])), 6) + 0.0)
