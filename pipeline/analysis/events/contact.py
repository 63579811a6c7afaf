"""Measure the clearance between a chaotic set and the stable manifold of a saddle orbit, and lifetimes beyond contact.

A chaotic set that is lost, grows or merges with another one in a crisis touches the stable manifold of an unstable
orbit (Grebogi, Ott and Yorke, Physica D 7, 1983, 181). Near such an orbit a trajectory is on one side of the manifold
or on the other. The left eigenvector of the orbit's one unstable multiplier u tells the side, most exactly at the
closest approach; divided by u for each turn since the trajectory came near, this coordinate is the *clearance* with
which it came. While the set lives, the least clearance of many passages is positive. It is 0 where the set touches the
manifold. Beyond, trajectories with a negative clearance leave, and their mean lifetime is a power of the distance
(Grebogi, Ott and Yorke, Phys. Rev. Lett. 57, 1986, 1284).

Bands of a set may lie on both sides of an orbit between them. So passages are sorted by the section point of the orbit
and by time modulo the number of bands. The number of states does not matter, but the orbit has one unstable multiplier.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import lcm

import numpy as np

from magpend_core.engine.entry import integrate
from magpend_core.engine.lanes import Cells
from magpend_core.engine.observers import MAP, MapSettings
from magpend_core.orbits import polish_orbits, section_map
from magpend_core.precision import limits_at
from magpend_core.status import Status
from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.problems import Family, Rows
from pipeline.analysis.events.scene import Scene
from pipeline.results.sets import Geometry, nearest_distances
from pipeline.results.tolerances import PORTRAIT_RTOL

SETTLE = 24
"""Least sections that trajectories run before they count: they start on the set of a neighbouring value."""


@dataclass(frozen=True)
class Effort:
    """Numbers of the search for a contact; those without a default are the effort, with which errors fall.

    Pairs are of maps and of flows.
    """

    # trajectories, section points of each, and limits of the search for orbits
    lanes: int
    length: int
    longest: int  # period
    starts: int  # of Newton's method for each period
    rounds: int  # of deflation
    is_flow: bool = False  # few trajectories: clearances are lowered between them, see `Approach._lowest`
    # distances within which a trajectory passes an orbit, tried in turn, and the largest one if a set is further away,
    # as shares of the set's size
    near: tuple[float, ...] = (0.03, 0.018, 0.05)
    widest: float = 0.25
    least_passages: int = 32  # fewest that show on which side of the manifold a set lies
    looked_at: int = 32  # trajectories that are looked at first
    # distance from a set, as a share of its size, beyond which a trajectory is away from it; the share of the time, at
    # its end, in which a trajectory that has left is away; and the largest share of trajectories that come back after
    # this time, if a set is lost: those of sets that merge stay long in one of them, and come back
    around: float = 0.1
    away: float = 1.0 / 16.0
    back_again: float = 0.02
    parts: int = 8  # the error of the least clearance is its median change if one part of the trajectories is taken
    # sections before a passage at which the start of a trajectory is moved, and the number of passages of each part of
    # the trajectories: the lowest ones
    back: int = 12
    lowered: int = 2
    radii: tuple[int, int] = (6, 16)  # powers of 1/4 of the set's size by which a start is moved first
    moves: int = 7  # rounds of the search in which it is moved
    # turns about the orbit after the passage: nearer to the stable manifold the closest approach is later, and closer
    turns_on: int = 2
    # most parameter values at which the clearance is computed to find its zero
    steps_to_root: tuple[int, int] = (40, 12)
    close: float = 0.25  # least clearance, in units of its error, at which the search for its zero ends
    shortest: float = 1e-12  # shortest interval of the parameter in the search, as a share of the first one
    jump: float = 0.01  # largest clearance where it changes its sign, as a share of the distance of passages
    # values on both sides of the zero at which the clearance is taken, in units of the largest distance; and the
    # clearance there as a share of the distance of passages: for flows it counts less how few pass
    spread: tuple[float, ...] = (-1.0, -0.8, -0.6, -0.4, 0.4, 0.6, 0.8, 1.0)
    shares: tuple[float, float] = (0.5, 0.25)
    # shares of the distance of the values at which lines of flows are taken, too: far away the clearance need not be a
    # straight line; those with the least error count
    closer: tuple[float, ...] = (0.25, 0.0625)
    # largest distance of the zero from those of the lines on each side, as a share of the distance of their values
    curved: float = 0.2


@dataclass(frozen=True, eq=False)
class Saddle:
    """A saddle orbit: its section points, and the scaled right and left eigenvectors of its one unstable multiplier.

    The largest component of a right eigenvector (period, state) is 1, and its product with the left one is 1.
    """

    points: np.ndarray
    directions: np.ndarray
    covectors: np.ndarray
    multiplier: float

    @property
    def period(self) -> int:
        """Least period."""
        return len(self.points)

    def turn(self, n_bands: int) -> tuple[int, np.float64]:
        """Return the sections after which a trajectory is in the same band and on the same side, and the growth of its
        coordinate in them.
        """
        step = lcm(self.period * (2 if self.multiplier < 0.0 else 1), n_bands)
        return step, np.float64(self.multiplier) ** (step // self.period)


@dataclass(frozen=True, eq=False)
class SectionMap:
    """The section map along a parameter: a family of period 1, the geometry of its states, and a tolerance."""

    family: Family
    geometry: Geometry
    rtol: float

    def paths(self, value: float | np.ndarray, starts: np.ndarray, length: int) -> np.ndarray:
        """Return the next section points of trajectories at one value or at one each, (trajectory, length, state); NaN
        after their end.
        """
        value = np.broadcast_to(value, len(starts))
        cells = self._integrate(value, starts, np.full(len(starts), length))
        section, failed = cells.section[:, 0], np.flatnonzero(cells.status[:, 0] != Status.BOUNDED)
        if len(failed):
            # the engine keeps nothing of cells that fail: the same bits again, up to the section before
            lasted = np.maximum(cells.n_periods[failed, 0] - 1, 1)
            again = self._integrate(value[failed], starts[failed], lasted).section[:, 0]
            section[failed, : again.shape[1]] = again
        return np.asarray(section)

    def _integrate(self, value: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> Cells:
        rows = self.rows(value, starts)
        return integrate(
            self.family.system,
            MAP,
            MapSettings(),
            parameters=rows.parameters[:, None, :],
            frequency_hz=rows.frequency_hz[:, None],
            initial_states=rows.states,
            n_keep=int(lengths.max()),
            n_measures=1,
            measures=lengths[:, None, None],
            **limits_at(self.rtol),
        )

    def rows(self, value: float | np.ndarray, states: np.ndarray) -> Rows:
        """Return section points at one value of the parameter or at one each, with their packed parameters."""
        return self.family.rows(np.column_stack([states, np.broadcast_to(value, len(states))]) / self.family.unit)

    def saddle(self, value: float, state: np.ndarray, period: int) -> Saddle | None:
        """Return the saddle orbit to which Newton's method leads from a state; None without such an orbit."""
        return self.saddles(value, state[None], [period])[0]

    def saddles(self, value: float, states: np.ndarray, periods: Sequence[int]) -> list[Saddle | None]:
        """Return the saddle orbits to which Newton's method leads from states; None where it leads to none."""
        system, asked = self.family.system, np.asarray(periods, np.int64)
        rows = self.rows(value, states)
        found = polish_orbits(rows.parameters, rows.frequency_hz, rows.states, asked, system=system)
        kept = np.flatnonzero(found.converged & (found.orbit_period == asked))
        orbits = [found.points[k, : asked[k]] for k in kept]
        saddles: list[Saddle | None] = [None] * len(asked)
        if orbits:
            rows = self.rows(value, np.concatenate(orbits))
            turns = np.repeat(asked[kept], asked[kept])
            ends = section_map(rows.parameters, rows.frequency_hz, rows.states, turns, system=system).derivatives
            scales = np.asarray(self.geometry.scales)
            for k, points, own in zip(kept, orbits, np.split(ends, np.cumsum(asked[kept])[:-1]), strict=True):
                saddles[k] = _saddle(points, own, scales)
        return saddles


def map_along(scene: Scene, place: int) -> SectionMap:
    """Return the section map along the parameter, with the other parameters of a place on the axis."""
    return SectionMap(scene.family(place, 1), geometry_of(scene.attractors), PORTRAIT_RTOL)


def _saddle(points: np.ndarray, derivatives: np.ndarray, scales: np.ndarray) -> Saddle | None:
    directions, covectors, multiplier = [], [], 0.0
    for matrix in derivatives * scales / scales[:, None]:
        if not np.isfinite(matrix).all():
            return None
        values, right = np.linalg.eig(matrix)
        left_values, left = np.linalg.eig(matrix.T)
        if (np.abs(values) > 1.0).sum() != 1:
            return None
        multiplier = float(values[np.abs(values).argmax()].real)
        v, w = right[:, np.abs(values).argmax()].real, left[:, np.abs(left_values).argmax()].real
        v = v / v[np.abs(v).argmax()]
        directions.append(v)
        covectors.append(w / (w @ v))
    return Saddle(points, np.array(directions), np.array(covectors), multiplier)


@dataclass(frozen=True, eq=False)
class Sample:
    """Trajectories on a chaotic set at its last value, which start in one and the same of its bands."""

    starts: np.ndarray  # (trajectory, state)
    points: np.ndarray  # (n, state): points of the set, in the order of time
    n_bands: int

    def size(self, geometry: Geometry) -> float:
        """Return the largest scaled extent of the set."""
        return float(geometry.distance(self.points, self.points[:1]).max())


def sample_of(along: SectionMap, value: float, state: np.ndarray, effort: Effort) -> Sample:
    """Follow a trajectory on a chaotic set, count the bands, and choose starts in one band."""
    length = max(4 * effort.length, 2 * SETTLE + 32 * effort.lanes)
    points = along.paths(value, state[None], length)[0, 2 * SETTLE :]
    points = points[np.isfinite(points).all(axis=1)]
    n_bands = count_bands(points, along.geometry)
    return Sample(points[:: n_bands * max(1, 32 // n_bands)][: effort.lanes], points, n_bands)


def count_bands(points: np.ndarray, geometry: Geometry) -> int:
    """Return the number of bands that a chaotic trajectory visits in turn, from section points in the order of time.

    All times between visits of one small neighbourhood are multiples of it; it is their greatest common divisor. Two
    bands that are closer than neighbouring points of the trajectory count as one.
    """
    neighbours, references = 48, 8  # section points nearest to a reference point, and reference points
    rng = np.random.default_rng(0)
    tree, found = geometry.tree(points), []
    for k in rng.integers(len(points), size=references).tolist():
        _, nearest = tree.query(geometry.scaled(points[k]), k=min(neighbours, len(points)), p=np.inf)
        found.append(int(np.gcd.reduce(np.abs(nearest - k))))
    return max(int(np.gcd.reduce(np.array(found))), 1)


Passages = Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Clearances of passages, their trajectories and the times of their closest approach, by section point of the orbit
and class of time."""

Sided = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Clearances of passages, positive on the side of the living set, their trajectories, times and section points."""


def passages(paths: np.ndarray, saddle: Saddle, n_bands: int, reach: float, geometry: Geometry) -> Passages:
    """Find where trajectories, shape (trajectory, time, state), pass a saddle orbit within a scaled distance."""
    slack = 5.0  # largest coordinate along the unstable direction at the end of a passage, in units of the reach
    step, factor = saddle.turn(n_bands)
    with np.errstate(invalid="ignore"):
        near = np.array([geometry.distance(paths, x) < 2.0 * reach for x in saddle.points])
    turned = _followed(near)
    found = {}
    for k in range(saddle.period):
        lane, time = np.nonzero(near[k])
        offset = geometry.difference(paths[lane, time], saddle.points[k])
        along = offset @ saddle.covectors[k]
        beside = np.abs(offset - along[:, None] * saddle.directions[k]).max(axis=-1)
        away = np.maximum(np.abs(along), beside)
        order = np.flatnonzero(away < reach)  # by trajectory and time
        order = order[np.argsort(lane[order] * step + time[order] % step, kind="stable")]
        along, away, lane, time = along[order], away[order], lane[order], time[order]
        if not len(lane):
            continue
        begins = np.append(True, (np.diff(lane) != 0) | (np.diff(time) != step))
        # it has left, and come back by chance, if it does not follow the orbit in between
        begins |= turned[(k - time) % saddle.period, lane, time] < step
        number = np.cumsum(begins) - 1
        nearest = np.flatnonzero(away == np.minimum.reduceat(away, np.flatnonzero(begins))[number])
        closest = nearest[np.diff(number[nearest], prepend=-1) > 0]
        first, turns = time[begins], np.bincount(number)
        gone = (time[closest] - first) // step
        with np.errstate(over="ignore"):
            # where the orbit's linear map holds, a trajectory leaves when the coordinate has grown to the reach
            passes = np.abs(along[closest]) * factor ** (turns - 1 - gone) <= slack * reach
        passes &= first >= step  # the others came near before
        closest, gone = closest[passes], gone[passes]
        clearance = along[closest] * (1.0 / factor) ** gone
        for phase in np.unique(time[closest] % step).tolist():
            own = time[closest] % step == phase
            found[k, phase] = clearance[own], lane[closest][own], time[closest][own]
    return found


def _followed(near: np.ndarray) -> np.ndarray:
    """Count the sections up to each one in which a trajectory follows an orbit point by point.

    Parameters
    ----------
    near
        Whether each point of the orbit is near at each section, shape (point, trajectory, time).

    Returns
    -------
    ndarray
        Counts, shape (phase, trajectory, time); the phase is the orbit's point at time 0.
    """
    period, _, n = near.shape
    time = np.arange(n, dtype=np.int32)
    left = np.empty(near.shape, np.int32)  # last section at which the point of the phase was not near
    for phase in range(period):
        here = near[(phase + time) % period, :, time].T
        np.maximum.accumulate(np.where(here, np.int32(-1), time), axis=1, out=left[phase])
    return np.asarray(time - left)


@dataclass(frozen=True)
class Clearance:
    """Least clearance of a set at a parameter value [scaled], and its error by the finite sample.

    ``least`` is NaN if no trajectory passed; ``has_left`` tells whether trajectories ended.
    """

    least: float
    error: float
    has_left: bool

    @property
    def is_beyond(self) -> bool:
        """Whether the set has been lost: a passage on the other side, or none because trajectories end."""
        return self.least < 0.0 or bool(np.isnan(self.least) and self.has_left)


@dataclass(eq=False)
class Approach:
    """The approach of a chaotic set to a saddle orbit along the parameter, beginning at `value` where the set lives."""

    along: SectionMap
    sample: Sample
    value: float
    first: Saddle
    effort: Effort
    near: float = 0.0  # share of the set's size; 0: the first one of the effort
    sides: dict[tuple[int, int], float] = field(default_factory=dict)
    is_lost: bool = False  # whether most trajectories were seen to leave for good
    _known: dict[float, Saddle] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._known[self.value] = self.first
        self.near = self.near or self.effort.near[0]

    @cached_property
    def size(self) -> float:
        """Size of the set [scaled]."""
        return self.sample.size(self.along.geometry)

    def saddle(self, value: float) -> Saddle | None:
        """Return the orbit at a parameter value, followed from the nearest known one."""
        near = min(self._known, key=lambda known: abs(known - value))
        steps = 2 if abs(value - near) < 0.02 * self.along.family.scales[0] else 5
        for x in np.linspace(near, value, steps)[1:].tolist() if near != value else []:
            known = self._known[near]
            found = self.along.saddle(x, known.points[0], known.period)
            if found is None:
                return None
            self._known[x], near = found, x
        return self._known[near]

    def paths(self, value: float, length: int | None = None) -> np.ndarray:
        """Return the trajectories at a parameter value, `SETTLE` sections and others."""
        return self.along.paths(value, self.sample.starts, SETTLE + (length or self.effort.length))

    def passages(self, value: float, paths: np.ndarray) -> tuple[Passages, float]:
        """Return the passages at a parameter value, and the distance within which they were looked for [scaled]."""
        saddle = self.saddle(value)
        if saddle is None:
            return {}, np.nan
        reach = self._reach(saddle, paths)
        if not reach <= self.effort.widest * self.size:
            return {}, np.nan
        return passages(paths, saddle, self.sample.n_bands, reach, self.along.geometry), reach

    def _reach(self, saddle: Saddle, paths: np.ndarray) -> float:
        with np.errstate(invalid="ignore"):
            away = min(float(np.nanmin(self.along.geometry.distance(paths, x))) for x in saddle.points)
        return max(2.0 * away, self.near * self.size)

    def begin(self, some: np.ndarray, every: Callable[[], np.ndarray]) -> bool:
        """Find the sides on which the living set passes; return whether it keeps to one side in each class.

        `some` are the trajectories that are looked at first, and `every` returns all, which are integrated if needed.
        """
        # another part of the set may lie on the other side of the manifold, but further away
        for near in self.effort.near[:2]:
            self.near = near
            if self._keeps_to_one_side(some) and self._keeps_to_one_side(every()):
                return bool(self.sides)
        return False

    def _keeps_to_one_side(self, paths: np.ndarray) -> bool:
        found, _ = self.passages(self.value, paths)
        sides = {
            key: (np.sign(np.median(a)), a) for key, (a, _, _) in found.items() if len(a) >= self.effort.least_passages
        }
        self.sides = {key: float(side) for key, (side, _) in sides.items()}
        return all((side * a).min() > 0.0 for side, a in sides.values())

    def least(self, value: float, paths: np.ndarray | None = None) -> Clearance:
        """Compute the least clearance at a parameter value."""
        paths = self.paths(value) if paths is None else paths
        passed = self._until_left(value, paths)
        has_left = not np.isfinite(paths[:, -1]).all()
        if not len(passed[0]):
            return Clearance(np.nan, np.nan, has_left)
        lowest, part = self._lowest(value, paths, passed)
        parts = [lowest[part == i].min(initial=np.inf) for i in range(self.effort.parts)]
        return Clearance(float(lowest.min()), float(np.median(parts) - lowest.min()), has_left)

    def _lowest(self, value: float, paths: np.ndarray, passed: Sided) -> tuple[np.ndarray, np.ndarray]:
        """Return the least clearances of each part of the trajectories, with the number of the part; those of
        flows are lowered between trajectories.

        A flow's set is a curve along the unstable direction, many times folded, and a fold is what comes nearest. The
        starts of these passages, `back` sections before, are moved to both sides: what this changes across the curve
        has died out at the passage, and what it changes along the curve leads to the fold.
        """
        order = np.argsort(passed[0], kind="stable")
        parts = passed[1][order] % self.effort.parts
        order = np.concatenate([order[parts == i][: self.effort.lowered] for i in range(self.effort.parts)])
        a, lane, at, k = (x[order] for x in passed)
        saddle = self.saddle(value)
        if not self.effort.is_flow or saddle is None:
            return a, lane % self.effort.parts
        geometry, starts, reach = self.along.geometry, paths[lane, at - self.effort.back], self._reach(saddle, paths)
        points, covectors = saddle.points[k], saddle.covectors[k]
        step, factor = saddle.turn(self.sample.n_bands)
        scale = a / (geometry.difference(paths[lane, at], points) * covectors).sum(axis=1)
        unit = np.eye(geometry.n_states)[0] * geometry.scales[0]

        def moved(s: np.ndarray) -> np.ndarray:
            begins = (starts[:, None] + s[..., None] * unit).reshape(-1, geometry.n_states)
            ends = self.along.paths(value, begins, self.effort.back + self.effort.turns_on * step)[
                :, self.effort.back - 1 :: step
            ]
            offset = geometry.difference(ends.reshape(*s.shape, -1, geometry.n_states), points[:, None, None])
            away = np.abs(offset).max(axis=-1)
            away = np.where(np.logical_and.accumulate(away < reach, axis=-1), away, np.inf)
            closest = away.argmin(axis=-1)[..., None]
            along = np.take_along_axis((offset * covectors[:, None, None]).sum(axis=-1), closest, -1) / factor**closest
            return np.where(np.isfinite(away[..., 0]), scale[:, None] * along[..., 0], np.inf)

        shares = self.size * 4.0 ** -np.arange(*self.effort.radii)
        s = np.tile([0.0, *shares, *-shares], (len(a), 1))
        width = np.zeros(len(a))
        for number in range(self.effort.moves):
            found = moved(s)
            best = found.argmin(axis=1)[:, None]
            middle, lowest = np.take_along_axis(s, best, 1)[:, 0], np.take_along_axis(found, best, 1)[:, 0]
            width = 0.4 * width if number else np.maximum(0.8 * np.abs(middle), shares[-1])
            s = middle[:, None] + width[:, None] * np.linspace(-1.0, 1.0, 9)
        within = np.abs(middle) < shares[0]
        return np.where(within & np.isfinite(lowest), lowest, a), lane % self.effort.parts

    def _until_left(self, value: float, paths: np.ndarray) -> Sided:
        """Return the passages of each settled trajectory up to its first one on the other side: after it the trajectory
        may come back from elsewhere.
        """
        a, lane, at, k = self._sided(value, paths)
        until = _until(a, lane, at, paths)
        kept = (at <= until[lane]) & (at >= SETTLE)
        return a[kept], lane[kept], at[kept], k[kept]

    def _sided(self, value: float, paths: np.ndarray) -> Sided:
        """Return all passages."""
        found, _ = self.passages(value, paths)
        own = [
            (side * found[key][0], *found[key][1:], np.full(len(found[key][0]), key[0]))
            for key, side in self.sides.items()
            if key in found
        ]
        if not own:
            return np.zeros(0), np.zeros(0, int), np.zeros(0, int), np.zeros(0, int)
        a, lane, at, k = (np.concatenate(parts) for parts in zip(*own, strict=True))
        return a, lane, at, k

    def lifetimes(self, value: float, length: int) -> tuple[float, int]:
        """Return the mean time after which trajectories leave at a parameter value [sections], and how many left."""
        paths = self.paths(value, length)
        until = _until(*self._sided(value, paths)[:3], paths)
        if self.effort.is_flow:  # of a lost set, most trajectories leave far from the orbit, and none comes back
            near = _are_near(paths, self.sample.points, self.effort.around * self.size, self.along.geometry)
            last = _last(near)
            gone = last <= paths.shape[1] - self.effort.away * length
            self.is_lost |= bool(
                gone.mean() > 0.5 and have_come_back(near, self.effort.away * length).mean() <= self.effort.back_again
            )
            until = np.where(gone, last, paths.shape[1]) if self.is_lost else until
        left = until < paths.shape[1]
        settled = until >= SETTLE
        n = int(left[settled].sum())
        return float((until[settled] - SETTLE).sum()) / max(n, 1), n

    def returning(self, value: float, paths: np.ndarray) -> float:
        """Return the share of leaving trajectories that later pass the orbit on the side of the set.

        Only those count that leave in the first half of the time.
        """
        a, lane, at, _ = self._sided(value, paths)
        until, half = _until(a, lane, at, paths), paths.shape[1] // 2
        again = np.zeros(len(paths), bool)
        again[lane[(a > 0.0) & (at > half)]] = True
        left = until < half
        return float(again[left].mean()) if left.sum() >= self.effort.least_passages else np.nan


def last_stays(paths: np.ndarray, points: np.ndarray, radius: float, geometry: Geometry) -> np.ndarray:
    """Return the number of sections up to the last one of each trajectory within a distance of a set; 0 if none is."""
    return _last(_are_near(paths, points, radius, geometry))


def _are_near(paths: np.ndarray, points: np.ndarray, radius: float, geometry: Geometry) -> np.ndarray:
    is_near, lives = np.zeros(paths.shape[:2], bool), np.isfinite(paths).all(axis=2)
    is_near[lives] = nearest_distances(paths[lives], points, geometry) <= radius
    return is_near


def _last(is_near: np.ndarray) -> np.ndarray:
    return np.where(is_near.any(axis=1), is_near.shape[1] - np.argmax(is_near[:, ::-1], axis=1), 0)


def have_come_back(is_near: np.ndarray, away: float) -> np.ndarray:
    """Return whether trajectories come near a set again after more than `away` sections elsewhere."""
    return np.array([(np.diff(np.flatnonzero(one)) > away).any() for one in is_near])


def _until(a: np.ndarray, lane: np.ndarray, at: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return the time at which each trajectory passes on the other side or ends; the number of sections if neither."""
    until = np.isfinite(paths).all(axis=2).sum(axis=1)
    np.minimum.at(until, lane[a < 0.0], at[a < 0.0])
    return np.asarray(until)


@dataclass(frozen=True)
class Contact:
    """Parameter value at which a set touches a saddle orbit's stable manifold, and the clearance's slope there."""

    value: float
    error: float
    slope: float  # of the clearance by the parameter
    living: float  # the same value, extrapolated from the side on which the set lives
    beyond: float  # and from the other side
    span: float  # distance at which the clearance was taken for them


def contact_of(approach: Approach, beyond: float) -> Contact | None:
    """Find the zero of the least clearance between the value where the set lives and another one; None without it.

    The zero is found by the Illinois method, up to the error of the sample. Lines through the clearances on each side
    must lead to the same zero.
    """
    low, high, effort = approach.value, beyond, approach.effort
    here, there = approach.least(low), approach.least(high)
    if here.is_beyond or not there.is_beyond:
        return None
    weights, last, best = [1.0, 1.0], 0, here
    for _ in range(effort.steps_to_root[effort.is_flow]):
        a, b = weights[0] * here.least, weights[1] * there.least
        x = low + (high - low) * (a / (a - b) if np.isfinite(a) and np.isfinite(b) else 0.5)
        if x in (low, high):
            break
        best = approach.least(x)
        if best.is_beyond:
            high, there, weights = x, best, [0.5 * weights[0] if last > 0 else 1.0, 1.0]
        else:
            low, here, weights = x, best, [1.0, 0.5 * weights[1] if last < 0 else 1.0]
        last = 1 if best.is_beyond else -1
        if abs(best.least) <= effort.close * best.error < np.inf:
            break
        if abs(high - low) <= effort.shortest * abs(beyond - approach.value):
            break
    if not abs(best.least) <= max(best.error, effort.jump * effort.near[0] * approach.size):
        return None  # it jumps there
    for near in effort.near:
        approach.near = near
        h = _span(approach, x, beyond)
        if h is None:
            continue
        found = _confirmed_at(approach, x, best, h)
        if found is not None:
            return _closer(approach, found, (x, best), h) if effort.is_flow else found
    return None


def _closer(approach: Approach, found: Contact, zero: tuple[float, Clearance], h: float) -> Contact:
    """Take the lines of a flow again nearer to where they lead; return those with the least error."""
    span = found.span
    for share in approach.effort.closer:
        x = 0.5 * (found.living + found.beyond)
        x -= approach.least(x).least / found.slope
        closer = [_confirmed_at(approach, *one, h * share) for one in (zero, (x, approach.least(x)))]
        found = min([found, *(one for one in closer if one is not None)], key=lambda one: one.error)
    return replace(found, span=span)


def _confirmed_at(approach: Approach, value: float, best: Clearance, h: float) -> Contact | None:
    values = value + h * np.array(approach.effort.spread)
    least = np.array([approach.least(float(one)).least for one in values])
    return _confirmed(value, best, values, least, approach.effort)


def _confirmed(value: float, best: Clearance, x: np.ndarray, y: np.ndarray, effort: Effort) -> Contact | None:
    """Extrapolate the clearances y at values x on both sides to 0; None unless both lines lead to the value found.

    A trajectory may come within the distance of passages a turn later at one of the values: then there is no line. Of
    flows, the value is the mean of the zero and of both lines, and their scatter tells the error: the lowest fold is
    not met at each value.
    """
    h, half = x[-1] - value, len(x) // 2
    if not (y * effort.spread < 0.0).all():
        return None
    u = (x - value) / h
    sides = slice(half), slice(half, None)
    lines = [np.polyfit(u[part], y[part], 1) for part in sides]
    if not all(line[0] < 0.0 for line in lines):
        return None
    living, far = (float(value - h * line[1] / line[0]) for line in lines)
    slope = float((y[half] - y[half - 1]) / (x[half] - x[half - 1]))
    away, error = max(abs(living - value), abs(far - value)), 2.0 * max(best.error, abs(best.least)) / abs(slope)
    if effort.is_flow:
        scatter = max(np.std(y[part] - np.polyval(line, u[part])) for part, line in zip(sides, lines, strict=True))
        three = np.array([value, living, far])
        value = float(three.mean())
        error = 2.0 * max(three.std(ddof=1), float(scatter) * np.sqrt(half / (half - 2.0)) / abs(slope))
    if not error <= 0.5 * abs(h) or (not effort.is_flow and away > effort.curved * abs(h)):
        return None
    return Contact(value, error, slope, living, far, float(abs(h)))


def _span(approach: Approach, value: float, beyond: float) -> float | None:
    """Return the distance from the zero, with its sign, at which the clearance is a share of the reach."""
    effort = approach.effort
    share = effort.shares[effort.is_flow]
    reach = approach.near * approach.size
    h = min(abs(beyond - value), abs(value - approach.value)) * float(np.sign(beyond - value))
    for _ in range(effort.steps_to_root[effort.is_flow]):
        found = approach.least(value - h).least
        if found <= share * reach:
            return h
        h *= 0.5 if not np.isfinite(found) else max(0.8 * share * reach / found, 0.1)
    return None
