"""Hold the trajectories (cells) of parameter points in blocks, and collect guesses of closed orbits from them.

A block may hold the cells of many points: `owner` is the number of each cell's point. Nothing that is computed for a
point depends on the other points of the block.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from magpend_core.status import Status
from pipeline.results.sets import Geometry, groups, hashes


@dataclass(frozen=True)
class Block:
    """Some cells (trajectories) of one or several parameter points, with their section points and status."""

    cells: slice  # their places among all cells of the point or points
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
    owners: np.ndarray | None = None  # int64, (cell,): number of each cell's parameter point; None if all are of one

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
    def owner(self) -> np.ndarray:
        """Number of each cell's parameter point."""
        return np.zeros(len(self.status), np.int64) if self.owners is None else self.owners

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
    owner: np.ndarray  # number of the parameter point, which is a part of the key

    @classmethod
    def none(cls, n_states: int) -> Guesses:
        """Return an empty collection of guesses."""
        marks, whole = np.zeros(0, np.uint64), np.zeros(0, np.int64)
        return cls(marks, np.zeros(0), marks, np.zeros((0, n_states)), whole, whole)

    def take(self, rows: np.ndarray) -> Guesses:
        """Return the guesses at the given indices."""
        return Guesses(*(getattr(self, one.name)[rows] for one in fields(self)))

    def of(self, owner: int) -> Guesses:
        """Return the guesses of one parameter point, as if there were no other."""
        own = self.take(np.flatnonzero(self.owner == owner))
        return replace(own, key=of_owner(own.key, own.owner), owner=np.zeros_like(own.owner))

    def best(self, key: np.ndarray | None = None) -> Guesses:
        """Return the best guess for each key, sorted by key. By default, a guess's key is its box of section points."""
        keys = self.key if key is None else key
        order = np.lexsort((self.mark, self.score, keys))
        first = np.ones(len(order), bool)
        first[1:] = keys[order][1:] != keys[order][:-1]
        return self.take(order[first])

    def least(self, n: int) -> Guesses:
        """Return the `n` guesses of each parameter point with the lowest score, sorted by the hashes of their cells."""
        least = first_of_each(np.lexsort((self.mark, self.score, self.owner)), self.owner, n)
        return self.take(least[np.lexsort((self.mark[least], self.owner[least]))])

    def without_period(self) -> Guesses:
        """Return the same guesses with all periods set to unknown."""
        return replace(self, period=np.zeros_like(self.period))

    def joined(self, other: Guesses) -> Guesses:
        """Merge two collections of guesses, and keep the best guess of each box."""
        return self.followed_by(other).best()

    def followed_by(self, *others: Guesses) -> Guesses:
        """Append the guesses of other collections to these guesses."""
        names = [one.name for one in fields(self)]
        return Guesses(*(np.concatenate([getattr(one, name) for one in (self, *others)]) for name in names))


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
        for p in np.unique(block.orbit_period[block.is_closed]).tolist():
            cells = np.flatnonzero(block.is_closed & (block.orbit_period == p))
            section, owner = block.section[cells], block.owner[cells]
            rows, keys = _rows_of(section[:, -p:], p, owner, self.geometry, self.tolerance)
            self._keep(rows.reshape(-1, rows.shape[-1]), keys.ravel())
            if keys.shape[1] > 1:
                edges = np.stack([keys[:, :-1].ravel(), keys[:, 1:].ravel()], axis=1)
                self._edges.append(np.unique(edges, axis=0))
            last = section[:, -1]
            back = section[:, -1 - p] if section.shape[1] > p else last
            away, period = self.geometry.distance(last, back), np.full(len(cells), p, np.int64)
            found = Guesses(keys[:, -1], away, block.marks[cells], last, period, owner)
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
        pairs.append(self.geometry.box_pairs(rows[:, 2:], self.tolerance, rows[:, :2]))
        return keys, groups(len(keys), np.concatenate(pairs))

    def best(self, keys: np.ndarray, group: np.ndarray) -> Guesses:
        """Return the best guess of each group, with the keys and numbers that `close` returned."""
        return self.guesses.best(group[np.searchsorted(keys, self.guesses.key)].astype(np.uint64))

    def group_of(self, block: Block, keys: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Return the group number of each cell of a block; -1 for cells that are not closed (periodic)."""
        found = np.full(len(block.status), -1, np.int64)
        for p in np.unique(block.orbit_period[block.is_closed]).tolist():
            cells = np.flatnonzero(block.is_closed & (block.orbit_period == p))
            _, own = _rows_of(block.section[cells, -1:], p, block.owner[cells], self.geometry, self.tolerance)
            found[cells] = group[np.searchsorted(keys, own[:, 0])]
        return found


def _rows_of(
    points: np.ndarray, p: int, owner: np.ndarray, geometry: Geometry, side: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (owner, period, box) of section points (cell, section, state), and their hashes."""
    boxes = geometry.boxes(points, side)
    first = np.broadcast_to(owner[:, None, None], (*boxes.shape[:-1], 1))
    rows = np.concatenate([first, np.full(first.shape, p, np.int64), boxes], axis=-1)
    return rows, of_owner(hashes(rows[..., 1:]), owner[:, None])


def of_owner(keys: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return hashes that also depend on the number of the parameter point; those of point 0 stay as they are."""
    return np.asarray(keys ^ (owner.astype(np.uint64) * np.uint64(0xD1342543DE82EF95)))


def first_of_each(order: np.ndarray, owner: np.ndarray, n: int) -> np.ndarray:
    """Return the first `n` rows of each parameter point from an order of rows that is sorted by `owner`."""
    owners = owner[order]
    return np.asarray(order[np.arange(len(order)) - np.searchsorted(owners, owners) < n])


def marks_of(section: np.ndarray) -> np.ndarray:
    """Compute a hash of each cell's section points (cell, period_index, state)."""
    return hashes(section.reshape(len(section), section.shape[1] * section.shape[2]))
