"""Keep periodic orbits at the points of a parameter grid, with their slopes and with links between neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from magpend_core.engine.system import System
from magpend_core.orbits import section_map
from pipeline.analysis.branches.problems import ONE_SIDED_STEP
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import CONNECT_RTOL, SAME_CONNECTED

Array = np.ndarray


@dataclass(frozen=True)
class SheetSettings:
    """Numbers of following orbits over a grid (`connecting`)."""

    # largest distance of an orbit from the step along the tangent, as a share of the step's length; more takes longer
    # steps, and may link two sheets
    near: float = 0.1
    longest: float = 0.1  # longest step, in units of the states' scales and the axes' ranges
    # largest det(1 - M) of an orbit that is followed further: beyond, Newton's method needs ever shorter steps
    wildest: float = 1e2
    most_rows: int = 8192  # trajectories in one call of the engine; more take more memory
    # step at which following ends [ranges of the axis]; it is shorter where `least_steps` of them exceed the way
    shortest: float = 2.0**-13
    least_steps: int = 16
    before_first: float = 1.0 / 64.0  # share of `shortest` that the first step may have: two orbits tell a fold
    # a step is refused if it shrinks an orbit's distance from orbits of a part of its period to less than this share
    collapsed: float = 0.2
    halved: float = 0.2  # largest distance of the two halves of an orbit at a period doubling
    agreed: float = 0.1  # largest difference between two estimates of where a fold is, as a share of its distance
    singular: float = 0.25  # least share of a slope's part that grows as det(1 - M) falls, before a fold
    beyond: float = (
        0.5  # Newton step beyond a foreseen fold, as a share of the step's length, above which the orbit ends
    )
    together: int = 8  # Newton steps of all orbits on their way before others are sent; fewer follow fewer in vain
    corrections: int = 6  # most Newton steps at one point


UNTRIED, LINKED, ENDED, OPEN, BORDER, GOING = range(6)
"""States of the way from an orbit to the next point: `ENDED` at a fold or a doubling, `BORDER` of the grid."""


class Axis(NamedTuple):
    """Axis of the grid: which dim it is, the column of its packed parameter (-1: drive frequency), rising values."""

    dim: int
    column: int
    values: Array


@dataclass(frozen=True, eq=False)
class Grid:
    """Parameter points in C order of `shape`, with the axes along which orbits are followed.

    `packed` (point, parameter) and `frequency_hz` (point) are the parameters of each.
    """

    system: System
    shape: tuple[int, ...]
    packed: Array
    frequency_hz: Array
    axes: tuple[Axis, ...]

    def neighbour(self, place: Array, axis: int, way: int) -> Array:
        """Return the next point along an axis, up (1) or down (-1); -1 beyond the border."""
        at, dim = list(np.unravel_index(place, self.shape)), self.axes[axis].dim
        at[dim] = at[dim] + way
        inside = (at[dim] >= 0) & (at[dim] < self.shape[dim])
        return np.where(inside, np.ravel_multi_index(tuple(at), self.shape, mode="clip"), -1)

    def value(self, place: Array, axis: int) -> Array:
        """Return the value of an axis at points, in units of the axis' range."""
        own = self.axes[axis]
        return np.asarray(own.values[np.unravel_index(place, self.shape)[own.dim]] / np.ptp(own.values))

    def parameters(self, place: Array, axis: Array, value: Array) -> tuple[Array, Array]:
        """Return packed parameters and frequencies, with another value on one axis of each row."""
        packed, frequency = self.packed[place], self.frequency_hz[place]
        for i, own in enumerate(self.axes):
            rows = np.flatnonzero(axis == i)
            column = packed[:, own.column] if own.column >= 0 else frequency
            column[rows] = value[rows] * np.ptp(own.values)
        return packed, frequency

    def displaced(self, packed: Array, frequency: Array, axis: int) -> tuple[Array, Array]:
        """Return parameters with a slightly larger value on an axis."""
        packed, frequency, own = packed.copy(), frequency.copy(), self.axes[axis]
        column = packed[:, own.column] if own.column >= 0 else frequency
        column += ONE_SIDED_STEP * np.ptp(own.values)
        return packed, frequency


class Values(NamedTuple):
    """Newton step, slope by each axis, images, det(1 - M) and the sign of det(1 + M) at states."""

    step: Array
    slopes: Array
    images: Array
    det: Array
    sign: Array


class Orbits:
    """Orbits on a grid (`nodes`), the links between them, and the number of each orbit's component."""

    def __init__(self, grid: Grid, place: Array, orbits: list[Array], settings: SheetSettings) -> None:
        self.settings = settings
        self.grid, self.geometry = grid, Geometry.of(grid.system)
        self.scales = np.asarray(grid.system.scales)
        n, n_axes, longest = grid.system.n_states, len(grid.axes), max(map(len, orbits))
        node: Any = [("place", "i8"), ("period", "i8"), ("points", "f8", (longest, n)), ("slopes", "f8", (n_axes, n))]
        node += [("det", "f8"), ("ways", "i1", (n_axes, 2)), ("reach", "f8", n_axes)]
        self._store: Any = np.zeros(2 * len(orbits), node)
        self.nodes: Any = self._store[: len(orbits)]
        self._links: list[Array] = [np.zeros((0, 3), np.int64)]
        self._joined: list[tuple[Array, Array]] = []
        self.component = np.arange(len(orbits))
        self.nodes["place"], self.nodes["period"] = place, [len(x) for x in orbits]
        self.nodes["points"], self.nodes["reach"] = np.nan, np.inf
        for own, x in zip(self.nodes["points"], orbits, strict=True):
            own[: len(x)] = x
        keys = self._key(self.nodes["period"], self.nodes["place"])
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]
        n, firsts = len(place), self.nodes["points"][:, 0]
        found = self._evaluated(place, np.full(n, -1), np.zeros(n), firsts, self.nodes["period"], np.ones(n, bool))
        self.nodes["slopes"], self.nodes["det"] = found.slopes, found.det
        self._mark_borders(np.arange(len(place)))

    # ---- equations -----------------------------------------------------------------------------

    def _evaluated(self, place: Array, axis: Array, u: Array, z: Array, period: Array, whole: Array) -> Values:
        """Evaluate the equations of orbits at states, with the value of one axis of each row changed.

        Slopes are by this axis, in `whole` rows by each; the others are NaN.
        """
        m, n = z.shape
        here = self.grid.parameters(place, axis, u)
        wanted = [np.flatnonzero((axis == i) | whole) for i in range(len(self.grid.axes))]
        beside = [self.grid.displaced(here[0][rows], here[1][rows], i) for i, rows in enumerate(wanted)]
        packed, frequency = (np.concatenate([here[k], *(one[k] for one in beside)]) for k in (0, 1))
        every = np.concatenate([np.arange(m), *wanted])
        periods, states = period[every], z[every] * self.scales
        last, derivatives = np.empty((len(states), n)), np.empty((len(states), n, n))
        images = np.full((m, int(period.max(initial=1)), n), np.nan)
        order = np.argsort(-periods, kind="stable")
        for rows in np.split(order, range(self.settings.most_rows, len(order), self.settings.most_rows)):
            ends = section_map(
                packed[rows], frequency[rows], states[rows], periods[rows], rtol=CONNECT_RTOL, system=self.grid.system
            )
            last[rows] = ends.images[np.arange(len(rows)), periods[rows] - 1]
            derivatives[rows] = ends.derivatives
            own = rows < m
            images[rows[own], : ends.images.shape[1]] = ends.images[own] / self.scales
        one_minus = np.eye(n) - derivatives[:m] * self.scales / self.scales[:, None]
        with np.errstate(invalid="ignore", over="ignore"):  # a trajectory that diverged has no derivative
            det, sign = np.linalg.det(one_minus), np.sign(np.linalg.det(2.0 * np.eye(n) - one_minus))
        one_minus[det == 0.0] = np.nan
        right = np.full((m, n, 1 + len(wanted)), np.nan)
        right[:, :, 0] = self._difference(last[:m], states[:m])
        for i, (rows, x) in enumerate(zip(wanted, np.split(last, np.cumsum([m, *map(len, wanted)]))[1:], strict=False)):
            right[rows, :, 1 + i] = self._difference(x, last[rows]) / ONE_SIDED_STEP
        solved = np.moveaxis(np.linalg.solve(one_minus, right), -1, 1)
        return Values(solved[:, 0], solved[:, 1:], images, det, sign)

    def _difference(self, a: Array, b: Array) -> Array:
        return self.geometry.difference(a, b)

    def _away(self, a: Array, b: Array) -> Array:
        """Return the distance of scaled states."""
        return np.asarray(np.linalg.norm(self._difference(a * self.scales, b * self.scales), axis=-1))

    def _gap(self, z: Array, images: Array, period: Array) -> Array:
        """Return the distance of orbits from orbits of a part of their period."""
        gap = np.full(len(z), np.inf)
        for part in range(1, images.shape[1] // 2 + 1):
            rows = np.flatnonzero((period % part == 0) & (period > part))
            gap[rows] = np.minimum(gap[rows], self._away(images[rows, part - 1], z[rows]))
        return gap

    # ---- known orbits --------------------------------------------------------------------------

    @property
    def links(self) -> Array:
        """Pairs of linked orbits, with the number of period doublings between them."""
        self._links = [np.concatenate(self._links)]
        return self._links[0]

    def _key(self, period: Array, place: Array) -> Array:
        return np.asarray(period * len(self.grid.packed) + place)

    def _mark_borders(self, own: Array) -> None:
        """Mark the ways of new orbits: an orbit that is very unstable, or at a bifurcation, is not followed."""
        nodes = self.nodes[own]
        can_follow = np.isfinite(nodes["slopes"]).all(axis=(1, 2)) & (np.abs(nodes["det"]) <= self.settings.wildest)
        for axis in range(len(self.grid.axes)):
            for side, way in enumerate((1, -1)):
                beyond = self.grid.neighbour(nodes["place"], axis, way) < 0
                self.nodes["ways"][own, axis, side] = np.where(beyond, BORDER, np.where(can_follow, UNTRIED, OPEN))

    def _pairs(self, own: Array, place: Array) -> tuple[Array, Array]:
        """Return pairs of given orbits and all those of their period at given points."""
        wanted = self._key(self.nodes["period"][own], place)
        begin, end = (np.searchsorted(self._keys, wanted, side=side) for side in ("left", "right"))
        count = np.where(place >= 0, end - begin, 0)
        first = np.repeat(np.arange(len(own)), count)
        offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return own[first], self._order[begin[first] + offset]

    def _nearest(self, z: Array, others: Array) -> tuple[Array, Array]:
        """Return the distance of states from the nearest section point of orbits, and the number of that point."""
        away, phase = np.full(len(z), np.inf), np.zeros(len(z), np.int64)
        for period in np.unique(self.nodes["period"][others]).tolist():
            rows = np.flatnonzero(self.nodes["period"][others] == period)
            each = self._away(self.nodes["points"][others[rows], :period], z[rows, None])
            phase[rows] = each.argmin(axis=1)
            away[rows] = each.min(axis=1)
        return away, phase

    def _compare(self, new: Any) -> None:
        """Link new orbits with those at neighbouring points to which one step along the tangent leads."""
        for axis in range(len(self.grid.axes)):
            for way in (1, -1):
                a, b = self._pairs(new, self.grid.neighbour(self.nodes["place"][new], axis, way))
                if way < 0:
                    a, b = b, a
                a, b = self._free(a, b, axis)
                good = self._is_one_step(a, b, axis)
                a, b = a[good], b[good]
                only = (np.bincount(a, minlength=1)[a] == 1) & (np.bincount(b, minlength=1)[b] == 1)
                self._link(a[only], b[only], axis)
        self._join()

    def _free(self, a: Array, b: Array, axis: int) -> tuple[Array, Array]:
        """Return the pairs of orbits that are not linked yet, up and down an axis."""
        free = (self.nodes["ways"][a, axis, 0] != LINKED) & (self.nodes["ways"][b, axis, 1] != LINKED)
        return a[free], b[free]

    def _is_one_step(self, a: Array, b: Array, axis: int) -> Array:
        """Return whether a step along the tangent from each of two orbits leads to the other, at one phase."""
        change = self.grid.value(self.nodes["place"][b], axis) - self.grid.value(self.nodes["place"][a], axis)
        good, phases = np.ones(len(a), bool), np.zeros(len(a), np.int64)
        for one, other, step in ((a, b, change), (b, a, -change)):
            move = self.nodes["slopes"][one, axis] * step[:, None]
            away, phase = self._nearest(self.nodes["points"][one, 0] + move, other)
            length = np.hypot(np.linalg.norm(move, axis=1), step)
            good &= (length <= self.settings.longest) & (away <= self.settings.near * length)
            phases += phase
        return np.asarray(good & (phases % self.nodes["period"][a] == 0))

    def _link(self, a: Array, b: Array, axis: int) -> None:
        """Link orbits with those at the next points up an axis."""
        self.nodes["ways"][a, axis, 0] = LINKED
        self.nodes["ways"][b, axis, 1] = LINKED
        self._links.append(np.column_stack([a, b, np.zeros(len(a), np.int64)]))
        self._joined.append((a, b))

    def _join(self) -> None:
        """Merge the components of all that was linked."""
        a, b = (np.concatenate(x) for x in zip(*self._joined, strict=True))
        self._joined.clear()
        if len(a):
            self.component = _merged(self.component, a, b)

    def _taken(self, new: Any) -> Array:
        """Add orbits unless they are known, and return the number of each."""
        n, m = len(self.nodes), len(new)
        if n + m > len(self._store):
            self._store = np.empty(2 * (n + m), new.dtype)
            self._store[:n] = self.nodes
        self._store[n : n + m], self.nodes = new, self._store[: n + m]
        a, b = self._pairs(np.arange(n, n + m), new["place"])
        keys = self._key(new["period"], new["place"])
        own, other = np.nonzero((keys[:, None] == keys) & (np.arange(m)[:, None] > np.arange(m)))
        a, b = np.concatenate([a, n + own]), np.concatenate([b, n + other])
        # points after the first are images of a state before its last Newton step, whose length the map has stretched
        reach = SAME_CONNECTED * np.maximum(1.0, np.abs(self.nodes["det"][a]))
        same = self._nearest(self.nodes["points"][a, 0], b)[0] <= reach
        known = np.arange(n, n + m)
        np.minimum.at(known, a[same] - n, b[same])
        among = known >= n
        known[among] = known[known[among] - n]
        kept = np.flatnonzero(known == np.arange(n, n + m))
        among = known >= n
        number = known.copy()
        number[among] = n + np.searchsorted(kept, known[among] - n)
        self._store[n : n + len(kept)] = new[kept]
        self.nodes = self._store[: n + len(kept)]
        self.component = np.append(self.component, self.component.max() + 1 + np.arange(len(kept)))
        order = np.argsort(keys[kept], kind="stable")
        at = np.searchsorted(self._keys, keys[kept][order], side="right")
        self._keys, self._order = np.insert(self._keys, at, keys[kept][order]), np.insert(self._order, at, n + order)
        self._mark_borders(np.arange(n, n + len(kept)))
        return number


def _merged(labels: Array, a: Array, b: Array) -> Array:
    """Merge the components of linked pairs; components are numbered by their first members."""
    ends, local = np.unique(labels[np.concatenate([a, b])], return_inverse=True)
    n, local = len(ends), local.reshape(2, -1)
    graph = coo_array((np.ones(len(a)), (local[0], local[1])), shape=(n, n))
    merged = connected_components(graph, directed=False)[1]
    least = np.full(n, len(labels))
    np.minimum.at(least, merged, ends)
    into = np.arange(int(labels.max()) + 1)
    into[ends] = least[merged]
    rank = np.cumsum(into == np.arange(len(into))) - 1
    return np.asarray(rank[into][labels])
