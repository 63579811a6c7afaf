"""Bounded sets that do not close: told apart by the boxes that their sections occupy, and by rotation.

Two clouds of section points are held against each other on a grid of boxes: the share of the boxes of
one that are occupied, or touched, by the other, and the other way round. Two cells show the same set
if the smaller of both shares is at least `same_share` and their mean rotations agree. A cell with few
sections shows a part of its set only; so the comparison is between a number of *anchor* cells first,
groups of which (connected components of "same set") make up the sets, and all other cells are held
against the union of the boxes of each. Anchors are the cells whose sections have the least hashes: a
choice that depends on neither order nor chunks. So the work grows with the number of cells, not its
square.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import csr_array, vstack

from pipeline.analysis.sets import TWO_PI, Geometry, groups, hashes
from pipeline.products.attractors import IdentifyOptions


@dataclass(frozen=True)
class Rule:
    """When two clouds of section points count as one set.

    Attributes
    ----------
    box : float
        Side of the boxes, in units of the scales.
    same_share : float
        Least share of boxes in common, seen from either side.
    rotation : float
        Largest difference of the mean rotation of an angle [turns per drive period].
    n_anchors : int
        Cells compared with each other in one round.
    n_rounds : int
        Rounds; what is left after the last belongs to no set.
    """

    box: float
    same_share: float
    rotation: float
    n_anchors: int
    n_rounds: int

    @classmethod
    def of(cls, options: IdentifyOptions) -> Rule:
        """Rule that options of the search ask for."""
        return cls(**{f.name: getattr(options, f"rule_{f.name}") for f in fields(cls)})


@dataclass(frozen=True)
class Clouds:
    """Section points of some cells, as numbers of occupied boxes.

    Attributes
    ----------
    mark : ndarray of uint64, (cell,)
        Hash of each cell's sections.
    boxes : ndarray, (cell, period_index, state)
    rotation : ndarray, (cell, angle)
        Mean rotation [turns per drive period].
    """

    mark: np.ndarray
    boxes: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, section: np.ndarray, turns: np.ndarray, geometry: Geometry, rule: Rule) -> Clouds:
        """Clouds of cells, from their sections and turns."""
        return cls(
            hashes(section.reshape(len(section), -1)),
            geometry.boxes(section, rule.box).astype(np.int32),
            mean_rotation(section, turns, geometry),
        )

    def take(self, rows: np.ndarray) -> Clouds:
        """Clouds by row."""
        return Clouds(self.mark[rows], self.boxes[rows], self.rotation[rows])

    def first(self, n: int) -> Clouds:
        """Return the `n` different cells of least hash."""
        return self.take(np.unique(self.mark, return_index=True)[1][:n])

    def joined(self, other: Clouds) -> Clouds:
        """Both."""
        names = ("mark", "boxes", "rotation")
        return Clouds(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


def mean_rotation(section: np.ndarray, turns: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Mean rotation of each angle over the kept sections [turns per drive period], shape (cell, angle)."""
    angles = np.asarray(geometry.is_angle)
    change = section[:, -1, angles] - section[:, 0, angles]
    n = max(section.shape[1] - 1, 1)
    return np.asarray((change / TWO_PI + turns) / n)


def _incidence(boxes: np.ndarray, unique: np.ndarray) -> csr_array:
    """Which of the unique boxes (hashes, in rising order) each cell occupies; others are left out."""
    keys = hashes(boxes)
    place = np.minimum(np.searchsorted(unique, keys), len(unique) - 1)
    cell, index = np.nonzero(unique[place] == keys)
    entries = np.unique(np.stack([cell, place[cell, index]]), axis=1)
    shape = (len(boxes), len(unique))
    return csr_array((np.ones(entries.shape[1]), (entries[0], entries[1])), shape=shape)


@dataclass(frozen=True)
class Sets:
    """Bounded sets, by their occupied boxes.

    Attributes
    ----------
    boxes : ndarray, (box, state)
        All occupied boxes, in the order of `keys`.
    keys : ndarray of uint64, (box,)
    reached : csr_array, (set, box)
        Which of them each set occupies or touches.
    rotation : ndarray, (set, angle)
        Mean of the anchors.
    """

    boxes: np.ndarray
    keys: np.ndarray
    reached: csr_array
    rotation: np.ndarray

    def __len__(self) -> int:
        return len(self.rotation)


def _unique_boxes(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    flat = boxes.reshape(-1, boxes.shape[-1]).astype(np.int64)
    keys, first = np.unique(hashes(flat), return_index=True)
    return flat[first], keys


def _touching(boxes: np.ndarray, geometry: Geometry, side: float) -> csr_array:
    """Which boxes are the same or touch."""
    pairs = geometry.box_pairs(boxes, side)
    n = len(boxes)
    ends = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(n), 2).reshape(n, 2)])
    return csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))


def _shares(part: csr_array, whole: csr_array) -> np.ndarray:
    """Share of the boxes of each row of `part` among those of each row of `whole`."""
    counts = np.maximum(np.asarray(part.sum(axis=1)).ravel(), 1.0)
    return np.asarray((part @ whole.T).toarray() / counts[:, None])


def _agree(a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    return np.asarray((np.abs(a[:, None] - b[None]) <= tolerance).all(axis=-1))


def find_sets(anchors: Clouds, geometry: Geometry, rule: Rule) -> Sets:
    """Group anchor cells into sets; the sets come in the order of their least hash."""
    boxes, keys = _unique_boxes(anchors.boxes)
    occupied = _incidence(anchors.boxes.astype(np.int64), keys)
    touching = _touching(boxes, geometry, rule.box)
    reached = (occupied @ touching > 0).astype(np.float64)
    share = _shares(occupied, reached)
    same = (np.minimum(share, share.T) >= rule.same_share) & _agree(
        anchors.rotation, anchors.rotation, rule.rotation
    )
    group = groups(len(anchors.mark), np.argwhere(same))
    least = np.array([anchors.mark[group == i].min() for i in range(group.max() + 1)])
    order = np.argsort(least)
    union = vstack(
        [csr_array(occupied[group == i].sum(axis=0).reshape(1, -1) > 0) for i in order], format="csr"
    )
    rotation = np.stack([anchors.rotation[group == i].mean(axis=0) for i in order])
    return Sets(boxes, keys, csr_array(union.astype(np.float64) @ touching > 0), rotation)


def assign(clouds: Clouds, sets: Sets, rule: Rule) -> np.ndarray:
    """Set of each cell, -1 for none: the one that holds the largest share of the cell's points."""
    boxes = clouds.boxes.astype(np.int64)
    keys = hashes(boxes)
    place = np.minimum(np.searchsorted(sets.keys, keys), len(sets.keys) - 1)
    known = sets.keys[place] == keys
    share = np.zeros((len(boxes), len(sets)))
    for i in range(len(sets)):
        inside = sets.reached[i].toarray().ravel().astype(bool)
        share[:, i] = (inside[place] & known).mean(axis=1)
    share[~_agree(clouds.rotation, sets.rotation, rule.rotation)] = 0.0
    best = share.argmax(axis=1)
    return np.where(share.max(axis=1) >= rule.same_share, best, -1).astype(np.int64)
