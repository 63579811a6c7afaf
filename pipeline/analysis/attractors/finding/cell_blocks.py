"""Hold the trajectories (cells) of one parameter point in blocks, and collect guesses of closed orbits from them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from magpend_core.status import Status
from pipeline.results.sets import Geometry, groups, hashes


@dataclass(frozen=True)
class Block:
    """Some cells (trajectories) of one parameter point, with their section points and status."""

    cells: slice  # their places among all cells of the point
    section: np.ndarray  # (cell, period_index, state)
    # (cell,)
    status: np.ndarray
    orbit_period: np.ndarray
    turns: np.ndarray  # (cell, angle)
    # (cell, state): states in which cells waited in vain for a return, if sections are crossings of a flow
    rest: np.ndarray | None = None
    seconds: np.ndarray | None = None  # (cell, period_index): time from the previous section to each [s]
    step: np.ndarray | None = None  # (cell,): step size that continues each cell bit for bit from its last section [s]
    # uint64, (cell,): hashes of the cells' sections, if they were computed before
    known_marks: np.ndarray | None = None

    def take(self, rows: np.ndarray | slice) -> Block:
        """Return a block of the cells at the given indices. Its attribute `cells` is still the range of the whole
        block.
        """
        arrays = {f.name: value for f in fields(self)[1:] if (value := getattr(self, f.name)) is not None}
        return Block(self.cells, **{name: array[rows] for name, array in arrays.items()})

    @property
    def state(self) -> np.ndarray:
        """State with which each cell goes on, (cell, state); NaN if it cannot."""
        if self.rest is None:
            return self.section[:, -1]
        return np.where((self.status == Status.NO_RETURN)[:, None], self.rest, self.section[:, -1])

    @cached_property
    def marks(self) -> np.ndarray:
        """Hash of each cell's section points."""
        return marks_of(self.section) if self.known_marks is None else self.known_marks

    @cached_property
    def is_closed(self) -> np.ndarray:
        """Whether each cell is on a periodic orbit: its section points repeat, or its period was inferred from
        neighbouring cells.
        """
        closed = (self.status == Status.PERIODIC) | (self.status == Status.INFERRED)
        return np.asarray(closed & (self.orbit_period > 0) & self._finite)

    @cached_property
    def is_bounded(self) -> np.ndarray:
        """Whether each cell was integrated to the end without closing on a periodic orbit."""
        computed = (self.status == Status.PERIODIC) | (self.status == Status.BOUNDED)
        return np.asarray(computed & self._finite & ~self.is_closed)

    @cached_property
    def _finite(self) -> np.ndarray:
        return np.asarray(np.isfinite(self.section).all(axis=(1, 2)))


@dataclass(frozen=True)
class Guesses:
    """Starting guesses for closed orbits, each from the best cell of one box of section points."""

    key: np.ndarray  # the box
    score: np.ndarray  # smaller is better
    mark: np.ndarray  # hash of the cell's own sections; decides between equal scores
    point: np.ndarray  # (n, state): last section point
    period: np.ndarray  # period; 0 if unknown, and then the point is integrated further until it closes

    @classmethod
    def none(cls, n_states: int) -> Guesses:
        """Return an empty collection of guesses."""
        empty = np.zeros(0)
        whole = np.zeros(0, np.uint64)
        return cls(whole, empty, whole, np.zeros((0, n_states)), np.zeros(0, np.int64))

    def take(self, rows: np.ndarray) -> Guesses:
        """Return the guesses at the given indices."""
        return Guesses(self.key[rows], self.score[rows], self.mark[rows], self.point[rows], self.period[rows])

    def best(self, key: np.ndarray | None = None) -> Guesses:
        """Return the best guess for each key, sorted by key. By default, a guess's key is its box of section points."""
        keys = self.key if key is None else key
        order = np.lexsort((self.mark, self.score, keys))
        first = np.ones(len(order), bool)
        first[1:] = keys[order][1:] != keys[order][:-1]
        return self.take(order[first])

    def least(self, n: int) -> Guesses:
        """Return the `n` guesses with the lowest score, sorted by the hashes of their cells."""
        least = np.lexsort((self.mark, self.score))[:n]
        return self.take(least[np.argsort(self.mark[least], kind="stable")])

    def without_period(self) -> Guesses:
        """Return the same guesses with all periods set to unknown."""
        return Guesses(self.key, self.score, self.mark, self.point, np.zeros_like(self.period))

    def joined(self, other: Guesses) -> Guesses:
        """Merge two collections of guesses, and keep the best guess of each box."""
        return self.followed_by(other).best()

    def followed_by(self, other: Guesses) -> Guesses:
        """Append the guesses of another collection to these guesses."""
        names = ("key", "score", "mark", "point", "period")
        return Guesses(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


@dataclass
class ClosedCells:
    """Groups of closed (periodic) cells, formed by the boxes that hold their last section points.

    A cell of period p contributes the boxes of its last p sections, whose order does not matter.
    Boxes of side `tolerance` that touch are connected, and so are all boxes of one cell. Cells of
    one period whose boxes are connected form a group. So two cells with points closer than `tolerance`
    are in one group, in whatever order cells are added.
    """

    geometry: Geometry
    tolerance: float
    guesses: Guesses
    _rows: list[np.ndarray] = field(default_factory=list)
    _keys: list[np.ndarray] = field(default_factory=list)
    _edges: list[np.ndarray] = field(default_factory=list)

    def add(self, block: Block) -> None:
        """Add the closed (periodic) cells of a block to the groups."""
        for p in np.unique(block.orbit_period[block.is_closed]):
            cells = np.flatnonzero(block.is_closed & (block.orbit_period == p))
            section = block.section[cells]
            rows, keys = _rows_of(section[:, -int(p) :], int(p), self.geometry, self.tolerance)
            self._keep(rows.reshape(-1, rows.shape[-1]), keys.ravel())
            if keys.shape[1] > 1:
                edges = np.stack([keys[:, :-1].ravel(), keys[:, 1:].ravel()], axis=1)
                self._edges.append(np.unique(edges, axis=0))
            last = section[:, -1]
            back = section[:, -1 - int(p)] if section.shape[1] > p else last
            found = Guesses(
                keys[:, -1],
                self.geometry.distance(last, back),
                block.marks[cells],
                last,
                np.full(len(cells), int(p), np.int64),
            )
            self.guesses = self.guesses.joined(found)

    def _keep(self, rows: np.ndarray, keys: np.ndarray) -> None:
        unique, first = np.unique(keys, return_index=True)
        self._rows.append(rows[first])
        self._keys.append(unique)

    def close(self) -> tuple[np.ndarray, np.ndarray]:
        """Form the groups. Return the sorted keys (hashes) of the occupied boxes, and the number of each box's
        group.
        """
        if not self._keys:
            return np.zeros(0, np.uint64), np.zeros(0, np.int64)
        keys, first = np.unique(np.concatenate(self._keys), return_index=True)
        rows = np.concatenate(self._rows)[first]
        pairs = [np.searchsorted(keys, edges) for edges in self._edges]
        for p in np.unique(rows[:, 0]):
            own = np.flatnonzero(rows[:, 0] == p)
            pairs.append(own[self.geometry.box_pairs(rows[own, 1:], self.tolerance)])
        return keys, groups(len(keys), np.concatenate(pairs))

    def group_of(self, block: Block, keys: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Return the group number of each cell of a block; -1 for cells that are not closed (periodic)."""
        found = np.full(len(block.status), -1, np.int64)
        for p in np.unique(block.orbit_period[block.is_closed]):
            cells = np.flatnonzero(block.is_closed & (block.orbit_period == p))
            _, own = _rows_of(block.section[cells, -1:], int(p), self.geometry, self.tolerance)
            found[cells] = group[np.searchsorted(keys, own[:, 0])]
        return found


def _rows_of(points: np.ndarray, p: int, geometry: Geometry, side: float) -> tuple[np.ndarray, np.ndarray]:
    boxes = geometry.boxes(points, side)
    rows = np.concatenate([np.full((*boxes.shape[:-1], 1), p, np.int64), boxes], axis=-1)
    return rows, hashes(rows)


def marks_of(section: np.ndarray) -> np.ndarray:
    """Compute a hash of each cell's section points (cell, period_index, state)."""
    return hashes(section.reshape(len(section), section.shape[1] * section.shape[2]))
