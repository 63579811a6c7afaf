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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import lcm

import numpy as np
from scipy.optimize import least_squares

from magpend_core.defaults import MOST_STEPS
from magpend_core.engine.entry import integrate
from magpend_core.engine.lanes import Cells
from magpend_core.engine.observers import MAP, MapSettings
from magpend_core.orbits import polish_orbits, section_map
from magpend_core.status import Status
from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.problems import Family, Rows
from pipeline.analysis.events.scene import Scene
from pipeline.analysis.sets import Geometry
from pipeline.analysis.tolerances import PORTRAIT_RTOL

NEAR, WIDEST = (0.03, 0.018, 0.05), 0.25
"""Distances within which a trajectory passes an orbit, tried in turn, and the largest one if a set is further away, as
shares of the set's size."""

SLACK = 5.0
"""Largest coordinate along the unstable direction at the end of a passage, in units of the reach."""

SETTLE = 24
"""Least sections that trajectories run before they count: they start on the set of a neighbouring value."""

LEAST = 32
"""Fewest passages that show on which side of the manifold a set lies."""

FEW = 32
"""Trajectories that are looked at first."""

SUBSAMPLE = 8
"""The error of the least clearance is its change if an eighth of the trajectories is taken."""

NEIGHBOURS, REFERENCES = 48, 8
"""Section points nearest to a reference point, and reference points, whose return times tell the number of bands."""

MOST_STEPS_TO_ROOT = 40
"""Most parameter values at which the clearance is computed to find its zero."""

SHORTEST = 1e-12
"""Shortest interval of the parameter in which the zero is looked for, as a share of the first one."""

JUMP = 0.01
"""Largest clearance at the value where it changes its sign, as a share of the distance of passages."""

CURVED = 0.2
"""Largest distance of the zero from those of the lines on each side, as a share of the distance of their values."""

LONGEST_SPAN = 8.0
"""Largest distance at which lifetimes are taken, in units of that of the clearances."""

SCATTER = 0.05
"""Relative deviation of lifetimes from a power law that counts as one standard deviation: they have fine structure."""

FEWEST_ESCAPES, FEWEST_LIFETIMES, MOST_LIFETIMES = 40, 4, 8
"""Trajectories that leave at a parameter value, and fewest and most values of the parameter, for a fit of lifetimes."""


@dataclass(frozen=True)
class Effort:
    """Number of trajectories and of section points of each, and limits of the search for orbits."""

    lanes: int
    length: int
    longest: int  # period
    starts: int  # of Newton's method for each period
    rounds: int  # of deflation


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
            rtol=self.rtol,
            atol=self.rtol,
            max_steps_per_period=MOST_STEPS,
        )

    def rows(self, value: float | np.ndarray, states: np.ndarray) -> Rows:
        """Return section points at one value of the parameter or at one each, with their packed parameters."""
        return self.family.rows(np.column_stack([states, np.broadcast_to(value, len(states))]) / self.family.unit)

    def saddle(self, value: float, state: np.ndarray, period: int) -> Saddle | None:
        """Return the saddle orbit to which Newton's method leads from a state; None without such an orbit."""
        system = self.family.system
        rows = self.rows(value, state[None])
        found = polish_orbits(rows.parameters, rows.frequency_hz, rows.states, np.array([period]), system=system)
        if not found.converged[0] or found.orbit_period[0] != period:
            return None
        rows = self.rows(value, found.points[0, :period])
        ends = section_map(rows.parameters, rows.frequency_hz, rows.states, period, system=system)
        return _saddle(found.points[0, :period], ends.derivatives, np.asarray(self.geometry.scales))


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
    rng = np.random.default_rng(0)
    tree, found = geometry.tree(points), []
    for k in rng.integers(len(points), size=REFERENCES).tolist():
        _, nearest = tree.query(geometry.scaled(points[k]), k=min(NEIGHBOURS, len(points)), p=np.inf)
        found.append(int(np.gcd.reduce(np.abs(nearest - k))))
    return max(int(np.gcd.reduce(np.array(found))), 1)


Passages = Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Clearances of passages, their trajectories and their times, by section point of the orbit and class of time."""


def passages(paths: np.ndarray, saddle: Saddle, n_bands: int, reach: float, geometry: Geometry) -> Passages:
    """Find where trajectories, shape (trajectory, time, state), pass a saddle orbit within a scaled distance."""
    step = lcm(saddle.period * (2 if saddle.multiplier < 0.0 else 1), n_bands)
    factor = np.float64(saddle.multiplier) ** (step // saddle.period)
    found = {}
    for k in range(saddle.period):
        offset = geometry.difference(paths, saddle.points[k])
        with np.errstate(invalid="ignore"):
            lane, time = np.nonzero(np.abs(offset).max(axis=-1) < 2.0 * reach)
        offset = offset[lane, time]
        along = offset @ saddle.covectors[k]
        beside = np.abs(offset - along[:, None] * saddle.directions[k]).max(axis=-1)
        away = np.maximum(np.abs(along), beside)
        order = np.lexsort((time, time % step, lane))
        order = order[away[order] < reach]
        along, away, lane, time = along[order], away[order], lane[order], time[order]
        if not len(lane):
            continue
        begins = np.append(True, (np.diff(lane) != 0) | (np.diff(time) != step))
        number = np.cumsum(begins) - 1
        closest = np.lexsort((away, number))[np.flatnonzero(begins)]
        first, turns = time[begins], np.bincount(number)
        gone = (time[closest] - first) // step
        with np.errstate(over="ignore"):
            # where the orbit's linear map holds, a trajectory leaves when the coordinate has grown to the reach
            passes = np.abs(along[closest]) * factor ** (turns - 1 - gone) <= SLACK * reach
        passes &= first >= step  # the others came near before
        closest, gone = closest[passes], gone[passes]
        clearance = along[closest] * (1.0 / factor) ** gone
        for phase in np.unique(time[closest] % step).tolist():
            own = time[closest] % step == phase
            found[k, phase] = clearance[own], lane[closest][own], time[closest][own]
    return found


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
    near: float = NEAR[0]  # share of the set's size
    sides: dict[tuple[int, int], float] = field(default_factory=dict)
    _known: dict[float, Saddle] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._known[self.value] = self.first

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
        geometry = self.along.geometry
        with np.errstate(invalid="ignore"):
            away = min(float(np.nanmin(geometry.distance(paths, x))) for x in saddle.points)
        reach = max(2.0 * away, self.near * self.size)
        if not reach <= WIDEST * self.size:
            return {}, np.nan
        return passages(paths, saddle, self.sample.n_bands, reach, geometry), reach

    def begin(self, paths: np.ndarray) -> bool:
        """Find the sides on which the living set passes; return whether it keeps to one side in each class."""
        for some in (paths[:FEW], paths):  # few show that most orbits lie inside of the set
            found, _ = self.passages(self.value, some)
            sides = {key: (np.sign(np.median(a)), a) for key, (a, _, _) in found.items() if len(a) >= LEAST}
            self.sides = {key: float(side) for key, (side, _) in sides.items()}
            if any((side * a).min() <= 0.0 for side, a in sides.values()):
                return False
        return bool(self.sides)

    def least(self, value: float, paths: np.ndarray | None = None) -> Clearance:
        """Compute the least clearance at a parameter value."""
        paths = self.paths(value) if paths is None else paths
        a, lane, _ = self._until_left(value, paths)
        has_left = not np.isfinite(paths[:, -1]).all()
        if not len(a):
            return Clearance(np.nan, np.nan, has_left)
        some = a[lane % SUBSAMPLE == int(lane[a.argmin()] + 1) % SUBSAMPLE]
        return Clearance(float(a.min()), float(some.min(initial=np.inf) - a.min()), has_left)

    def _until_left(self, value: float, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return clearances, trajectories and times of the passages of each settled trajectory up to its first one on
        the other side: after it the trajectory may come back from elsewhere.
        """
        a, lane, at = self._sided(value, paths)
        until = _until(a, lane, at, paths)
        kept = (at <= until[lane]) & (at >= SETTLE)
        return a[kept], lane[kept], at[kept]

    def _sided(self, value: float, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return clearances, positive on the side of the living set, trajectories and times of all passages."""
        found, _ = self.passages(value, paths)
        own = [(side * found[key][0], *found[key][1:]) for key, side in self.sides.items() if key in found]
        if not own:
            return np.zeros(0), np.zeros(0, int), np.zeros(0, int)
        a, lane, at = (np.concatenate(parts) for parts in zip(*own, strict=True))
        return a, lane, at

    def lifetimes(self, value: float, length: int) -> tuple[float, int]:
        """Return the mean time before trajectories leave at a parameter value, and the number that left."""
        paths = self.paths(value, length)
        until = _until(*self._sided(value, paths), paths)
        left = until < paths.shape[1]
        settled = until >= SETTLE
        n = int(left[settled].sum())
        return float((until[settled] - SETTLE).sum()) / max(n, 1), n

    def returning(self, value: float, paths: np.ndarray) -> float:
        """Return the share of leaving trajectories that later pass the orbit on the side of the set.

        Only those count that leave in the first half of the time.
        """
        a, lane, at = self._sided(value, paths)
        until, half = _until(a, lane, at, paths), paths.shape[1] // 2
        again = np.zeros(len(paths), bool)
        again[lane[(a > 0.0) & (at > half)]] = True
        left = until < half
        return float(again[left].mean()) if left.sum() >= FEWEST_ESCAPES else np.nan


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

    The zero is found by the Illinois method, up to the error of the sample. Lines through the clearances at two values
    on each side must lead to the same zero.
    """
    low, high = approach.value, beyond
    here, there = approach.least(low), approach.least(high)
    if here.is_beyond or not there.is_beyond:
        return None
    weights, last, best = [1.0, 1.0], 0, here
    for _ in range(MOST_STEPS_TO_ROOT):
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
        if abs(best.least) <= best.error or abs(high - low) <= SHORTEST * abs(beyond - approach.value):
            break
    if not abs(best.least) <= max(best.error, JUMP * NEAR[0] * approach.size):
        return None  # it jumps there
    for near in NEAR:
        approach.near = near
        h = _span(approach, x, beyond)
        values = x + (0.0 if h is None else h) * np.array([-1.0, -0.5, 0.5, 1.0])
        least = np.array([approach.least(float(one)).least for one in values])
        if not ((least[:2] > 0.0).all() and (least[2:] < 0.0).all()):
            return None
        found = _confirmed(x, best, values, least)
        if found is not None:
            return found
    return None


def _confirmed(value: float, best: Clearance, x: np.ndarray, y: np.ndarray) -> Contact | None:
    """Extrapolate the clearances y at two values x on each side to 0; None unless both lead to the value found.

    A trajectory may come within the distance of passages a turn later at one of the values: then there is no line.
    """
    if not y[0] > y[1] > y[2] > y[3]:
        return None
    h = x[3] - value
    living, far = (float(x[i] - y[i] * (x[j] - x[i]) / (y[j] - y[i])) for i, j in ((0, 1), (3, 2)))
    slope = float((y[2] - y[1]) / (x[2] - x[1]))
    error = 2.0 * max(best.error, abs(best.least)) / abs(slope)
    if max(abs(living - value), abs(far - value)) > CURVED * abs(h) or not np.isfinite(error):
        return None
    return Contact(value, error, slope, living, far, float(abs(h)))


def _span(approach: Approach, value: float, beyond: float) -> float | None:
    """Return the distance from the zero, with its sign, at which the clearance is half of the reach."""
    reach = approach.near * approach.size
    h = min(abs(beyond - value), abs(value - approach.value)) * float(np.sign(beyond - value))
    for _ in range(MOST_STEPS_TO_ROOT):
        found = approach.least(value - h).least
        if found <= 0.5 * reach:
            return h
        h *= 0.5 if not np.isfinite(found) else max(0.4 * reach / found, 0.1)
    return None


@dataclass(frozen=True)
class Lifetimes:
    """Lifetimes beyond contact, and the fitted law ``c |p - p_c|^-exponent``."""

    values: tuple[float, ...]
    means: tuple[float, ...]
    exponent: float  # with p_c at the contact
    exponent_error: float
    value: float  # p_c, fitted without knowledge of the contact
    value_error: float


def lifetimes_of(approach: Approach, contact: Contact, beyond: float) -> Lifetimes | None:
    """Fit a power law to mean lifetimes at several values beyond contact; None if there are too few of them."""
    span = min(abs(beyond - contact.value), LONGEST_SPAN * contact.span) * float(np.sign(beyond - contact.value))
    values: list[float] = []
    means: list[float] = []
    counts: list[int] = []
    for k in range(MOST_LIFETIMES):
        value = contact.value + span * 0.5**k
        mean, n = approach.lifetimes(value, 4 * approach.effort.length)
        if n < FEWEST_ESCAPES and values:
            break
        if n >= FEWEST_ESCAPES and mean >= SETTLE:
            values, means, counts = [*values, value], [*means, mean], [*counts, n]
    if len(values) < FEWEST_LIFETIMES:
        return None
    return fit_lifetimes(values, means, counts, contact.value)


def fit_lifetimes(values: Sequence[float], means: Sequence[float], counts: Sequence[int], contact: float) -> Lifetimes:
    """Fit ``c |p - p_c|^-gamma`` to mean lifetimes: gamma with p_c at the contact, and p_c with both free.

    Parameters
    ----------
    values, means, counts
        Parameter values, mean lifetimes there, and numbers of trajectories that left, the nearest value last.
    contact
        Value of the contact.
    """
    away, logs = np.asarray(values) - contact, np.log(means)
    unit, sigma = away[-1], np.sqrt(1.0 / np.asarray(counts) + SCATTER**2)

    def residual(u: np.ndarray) -> np.ndarray:
        shift = u[2] if len(u) == 3 else 0.0
        return np.asarray((u[0] - u[1] * np.log(away / unit - shift) - logs) / sigma)

    def fitted(start: list[float]) -> tuple[np.ndarray, np.ndarray]:
        most = [np.inf, np.inf, 0.999][: len(start)]
        found = least_squares(residual, start, bounds=([-np.inf] * len(start), most))
        scatter = max(1.0, 2.0 * found.cost / max(len(logs) - len(start), 1))
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac) * scatter))

    fixed, errors = fitted([float(logs[-1]), 1.0])
    free, free_errors = fitted([*fixed.tolist(), 0.0])
    value, value_error = float(contact + unit * free[2]), float(abs(unit) * free_errors[2])
    return Lifetimes(tuple(values), tuple(means), float(fixed[1]), float(errors[1]), value, value_error)
