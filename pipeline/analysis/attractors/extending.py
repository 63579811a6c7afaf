"""Cells that no orbit or equilibrium accounts for are extended until it is known what they are on.

A sample of them goes on from its last section, leg by leg. After each leg cells leave that have reached an
orbit or an equilibrium, found before or by now. Those that stay are grouped into sets (`clouds`), and each
set gets a kind (`growth`) and a stability (`stability`). It goes on until the sample has stayed long enough,
nothing is in doubt any more, or the budget is spent; then the other cells are told by the points of the sets
that were found, and what is left is sampled again.

Budget: `options.budget` times the periods that the run itself integrated at the parameter point, and
`LEAST_BUDGET` periods at least. Nothing here depends on the clock, so the same run gives the same verdicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from magpend_core.status import Status
from pipeline.analysis.attractors import stability
from pipeline.analysis.attractors.cells import Block, ClosedCells, Guesses, marks_of
from pipeline.analysis.attractors.clouds import OTHER, Cloud, group, is_stationary, members, mixing, thinned
from pipeline.analysis.attractors.deciding import REACH, decide
from pipeline.analysis.attractors.equilibria import approaching, rest_near, rest_of_orbit
from pipeline.analysis.attractors.growth import Growth, growth_of, kind_of
from pipeline.analysis.attractors.lifetimes import lifetime_interval
from pipeline.analysis.attractors.orbits import Orbit, number_of
from pipeline.analysis.attractors.points import Point
from pipeline.analysis.attractors.requests import LEG, Extended, Leg, Polish, Settings, Slopes, Work
from pipeline.analysis.attractors.spirals import keys_of, leap, near_closed
from pipeline.analysis.sets import Geometry
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, NEUTRAL, NOT_SETTLED, TRANSIENT

LEAST_BUDGET = 16_384
"""Periods of a parameter point that may be integrated whatever the run itself took."""

LEAST_STAY = 512
"""Least extension of a cell [sections]: so many points tell two sets apart, and chaos from a torus."""

DOUBLINGS = 3
"""How often the extension is doubled while a set is in doubt."""

ROUNDS = 6
"""Most samples of a parameter point; each is twice as large as the one before."""

MOST_SLOPES = 4096
"""Most derivatives of the section map for the exponents of a set."""

LEAST_SEEN = 8
"""Fewest section points of a cell on a set that it left."""

LOOK_BACK = 4
"""Legs in which a period is looked for: those of up to twice as many sections as a leg has are seen."""

ON_SET, FAILED, DIVERGED, AT_REST = -1, -2, -3, -4
"""Ends of extended cells that are no orbits; `AT_REST` minus a number is an equilibrium."""


@dataclass
class Course:
    """A sampled cell on its way.

    Attributes
    ----------
    cell : int
        Its place among the cells of the point.
    key : int
        Box of its last kept section.
    kept : ndarray, (n, state)
        Sections of the run.
    state, step
        With which it goes on.
    legs : list of ndarray
        Sections since.
    end : int
        Number of an orbit, or one of the codes above.
    periods : float
        Drive periods or returns from its last kept section until it came near where it ended.
    is_leaving : bool
        Whether it was near there from the start.
    """

    cell: int
    key: int
    kept: np.ndarray
    state: np.ndarray
    step: float = 0.0
    legs: list[np.ndarray] = field(default_factory=list)
    end: int = ON_SET
    periods: float = 0.0
    is_leaving: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether it has not ended."""
        return self.end == ON_SET

    @property
    def extension(self) -> np.ndarray:
        """All sections since, shape (n, state)."""
        return np.concatenate([self.kept[:0], *self.legs])

    @property
    def stayed(self) -> np.ndarray:
        """Section points on the set: of a cell that goes on its extension, of one that left what was before."""
        if self.goes_on:
            return self.extension if self.legs else self.kept
        return np.asarray(self.extension[: int(self.periods)])

    @property
    def length(self) -> int:
        """Sections since."""
        return sum(len(leg) for leg in self.legs)


def rest_number(end: int) -> int | None:
    """Number of the equilibrium that an end stands for, None if it is another end."""
    return AT_REST - end if end <= AT_REST else None


@dataclass(frozen=True, eq=False)
class BoundedSet:
    """A set that does not close, and what was shown of it.

    Attributes
    ----------
    cells : ndarray of int64
        Sampled cells that are on it at the end.
    cloud : Cloud or None
    points : ndarray, (n, state)
        Some of its section points.
    kind, stability, evidence : int
    growth : Growth or None
        None if there are not enough sections.
    n_sampled, n_left, n_leaving : int
        Cells that were extended, that left it, and that were near their end from the start.
    time_at_risk : float
        Of all sampled cells together [drive periods or returns].
    ended : dict
        Where cells that left it went: numbers of cells by `Course.end`.
    closes_above : int
        Period that it may close with, above the longest looked for; 0 if none is seen.
    """

    cells: np.ndarray
    cloud: Cloud | None
    points: np.ndarray
    kind: int
    stability: int
    evidence: int
    growth: Growth | None
    n_sampled: int
    n_left: int
    n_leaving: int
    time_at_risk: float
    ended: dict[int, int]
    closes_above: int = 0

    @classmethod
    def neutral(cls) -> BoundedSet:
        """Everything in a flow that preserves volume."""
        none = np.zeros(0, np.int64)
        evidence = stability.BY_VOLUME
        return cls(none, None, none, BOUNDED_SET, NEUTRAL, evidence, None, 0, 0, 0, 0.0, {})


@dataclass
class Outcome:
    """What the extension of a parameter point found.

    Attributes
    ----------
    orbits : list of Orbit
        All that are known now.
    courses : list of Course
    sets : list of BoundedSet
    spent : int
        Periods integrated.
    ran_out : bool
        Whether the budget ended the work.
    """

    orbits: list[Orbit]
    courses: list[Course]
    sets: list[BoundedSet]
    spent: int = 0
    ran_out: bool = False


def extend(
    point: Point, orbits: Sequence[Orbit], label: np.ndarray, settings: Settings, budget: float, n_sample: int
) -> Work[Outcome]:
    """Extend samples of the cells of a point that are labelled -1 until it is known what they are on.

    Parameters
    ----------
    point
        With its equilibria.
    orbits
        Known ones.
    label
        Of each cell; read, not written.
    settings
        How trajectories go on.
    budget
        In units of the run's own work; 0 extends nothing.
    n_sample
        Cells of the first sample.
    """
    work = _Extension(point, list(orbits), settings, budget)
    loose = np.flatnonzero(label < 0)
    for _ in range(ROUNDS):
        chosen = work.sample(loose, n_sample)
        if not chosen:
            break
        work.courses += chosen
        if work.ran_out:
            break
        yield from (work.run() if work.budget else work.conclude())
        loose = work.left_of(loose)
        n_sample *= 2
    if any(course.goes_on for course in work.courses):
        yield from work.conclude()
    work.add_transient()
    return Outcome(work.orbits, work.courses, work.sets, work.spent, work.ran_out)


class _Extension:
    """The extension of one parameter point."""

    def __init__(self, point: Point, orbits: list[Orbit], settings: Settings, budget: float) -> None:
        self.point, self.orbits, self.settings = point, orbits, settings
        self.geometry: Geometry = settings.geometry
        self.budget = int(max(budget * point.n_periods, LEAST_BUDGET)) if budget > 0.0 else 0
        self.courses: list[Course] = []
        self.sets: list[BoundedSet] = []
        self.spent, self.ran_out = 0, False
        self._tried: set[int] = set()

    @property
    def has_budget(self) -> bool:
        """Whether anything may be integrated yet."""
        return self.spent < self.budget

    # ---- samples -------------------------------------------------------------------------------

    def sample(self, loose: np.ndarray, n: int) -> list[Course]:
        """Next `n` cells by rising hash of their sections, of each box of last sections one."""
        known = {course.key for course in self.courses}
        best: dict[int, tuple[int, int, np.ndarray, float]] = {}
        is_loose = np.zeros(self.point.n_cells, bool)
        is_loose[loose] = True
        for block in self.point.blocks():
            rows = np.flatnonzero(is_loose[block.cells] & (block.is_bounded | block.is_closed))
            section = block.section[rows]
            keys, marks = keys_of(section, self.settings.closure, self.geometry), marks_of(section)
            for row, key, mark in zip(rows, keys.tolist(), marks.tolist(), strict=True):
                if key not in known and (key not in best or mark < best[key][0]):
                    step = 0.0 if block.step is None else float(np.nan_to_num(block.step[row]))
                    best[key] = mark, int(row) + block.cells.start, block.section[row], step
            if len(best) > 4 * n:  # those of least hash are enough
                best = dict(sorted(best.items(), key=lambda item: item[1][0])[: 2 * n])
        chosen = sorted(best.items(), key=lambda item: item[1][0])[:n]
        return [Course(cell, key, kept, kept[-1], step) for key, (_, cell, kept, step) in chosen]

    def left_of(self, loose: np.ndarray) -> np.ndarray:
        """Cells that are on no set that was found to stay, nor beside a sampled one."""
        done = np.zeros(self.point.n_cells, bool)
        done[self.told(loose)[0]] = True
        done[[course.cell for course in self.courses]] = True
        return loose[~done[loose]]

    def told(self, loose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Loose cells that lie on sets that need no further look, and the numbers of these."""
        final = [
            i
            for i, one in enumerate(self.sets)
            if one.stability in (ATTRACTS, NEUTRAL) or not self.budget
        ]
        clouds = [one for i in final if (one := self.sets[i].cloud) is not None]
        is_loose = np.zeros(self.point.n_cells, bool)
        is_loose[loose] = True
        cells, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for block in self.point.blocks() if final else ():
            rows = np.flatnonzero(is_loose[block.cells] & (block.is_bounded | block.is_closed))
            own = members(block.section[rows], clouds, self.geometry)
            cells.append(rows[own >= 0] + block.cells.start)
            numbers.append(np.array(final, np.int64)[own[own >= 0]])
        return np.concatenate(cells), np.concatenate(numbers)

    def add_transient(self) -> None:
        """Add the set that cells have left, if that is none of those on which others stayed."""
        left = [c for c in self.courses if self._was_on_a_set(c)]
        if not left or any(one.n_left for one in self.sets):
            return
        ended: dict[int, int] = {}
        for course in left:
            ended[course.end] = ended.get(course.end, 0) + 1
        paths = [course.stayed for course in left]
        at_risk = float(sum(course.periods for course in left))
        n_leaving = sum(course.is_leaving for course in self.courses)
        none = np.zeros(0, np.int64)
        self.sets.append(BoundedSet(
            none, Cloud.of(paths, self.geometry, self.settings.closure), np.concatenate(paths), BOUNDED_SET,
            TRANSIENT, stability.BY_LEAVING, None, len(left), len(left), n_leaving, at_risk, ended,
        ))  # fmt: skip

    @staticmethod
    def _was_on_a_set(course: Course) -> bool:
        """Whether a cell that ended stayed elsewhere for some time before."""
        return not course.goes_on and not course.is_leaving and len(course.stayed) >= LEAST_SEEN

    # ---- legs ----------------------------------------------------------------------------------

    def run(self) -> Work[None]:
        """Extend what goes on until the sample has stayed, and longer while a set is in doubt."""
        target = LEAST_STAY
        for _ in range(DOUBLINGS + 1):
            yield from self._extend(target)
            if not any(course.goes_on for course in self.courses):
                self.sets = []
                return
            in_doubt = yield from self._tell_sets()
            if not in_doubt or not self.has_budget:
                return
            target = 2 * max(c.length for c in self.courses if c.goes_on)

    def conclude(self) -> Work[None]:
        """Tell the sets of what goes on, as it stands."""
        yield from self._tell_sets()

    def _extend(self, target: int) -> Work[None]:
        while True:
            going = [course for course in self.courses if course.goes_on]
            if not going or self._has_stayed(going, target):
                return
            if not self.has_budget:
                self.ran_out = True
                return
            # those that are behind first: the sample of a later round
            least = min(course.length for course in going)
            going = [course for course in going if course.length == least]
            leg: Extended = yield Leg(np.array([c.state for c in going]), np.array([c.step for c in going]))
            self.spent += LEG * len(going)
            yield from self._take(going, leg)

    def _has_stayed(self, going: Sequence[Course], target: int) -> bool:
        """Whether the cells that go on have stayed for long enough."""
        least = min(course.length for course in going)
        if least < target:
            return False
        longest = stability.TIMES_LONGEST * self._longest_transient()
        at_risk = float(sum(course.length for course in going))
        return least >= longest or lifetime_interval(0, at_risk)[0] >= longest

    def _longest_transient(self) -> float:
        """Longest time that a cell of the point was seen to be elsewhere than where it ended."""
        left = [c.periods for c in self.courses if not c.goes_on and not c.is_leaving]
        return self.settings.seen + max(left, default=0.0)

    def _take(self, going: Sequence[Course], leg: Extended) -> Work[None]:
        """Note what became of cells during a leg."""
        computed = np.isin(leg.status, (Status.PERIODIC, Status.BOUNDED))
        for course, state, step, section, ok in zip(
            going, leg.state, leg.step, leg.section, computed, strict=True
        ):
            course.state, course.step = state, float(step)
            if ok:
                course.legs.append(section)
        for i in np.flatnonzero(~computed).tolist():
            self._fail(going[i], int(leg.status[i]))
        rows = np.flatnonzero(computed)
        if not len(rows):
            return
        block = Block(
            slice(0, 0), leg.section[rows], leg.status[rows], leg.orbit_period[rows], leg.turns[rows]
        )
        own = [going[i] for i in rows.tolist()]
        yield from self._search(own, block)
        label, _ = decide(block, self.orbits, 10.0 * self.settings.closure, self.geometry)
        for course, number in zip(own, label.tolist(), strict=True):
            if number >= 0 and self.orbits[number].is_stable:
                self._leave(course, number)
        self._rest(own, leg.section[rows], leg.seconds[rows])
        self._leap(own, leg.section[rows])

    def _fail(self, course: Course, status: int) -> None:
        """End a cell that did not finish its leg: at rest, diverged, or not integrated."""
        course.periods = float(course.length)
        course.is_leaving = not course.length
        course.end = DIVERGED if status == Status.DIVERGED else FAILED
        if status == Status.NO_RETURN and self.point.can_rest:
            number = rest_near(self.point, course.state, self.geometry)
            if number is not None:
                course.end = AT_REST - number

    def _search(self, own: Sequence[Course], block: Block) -> Work[None]:
        """Find orbits that cells close on, or come back to."""
        label, _ = decide(block, self.orbits, 10.0 * self.settings.closure, self.geometry)
        rest = np.flatnonzero(label < 0).tolist()
        closed = ClosedCells(
            self.geometry, 10.0 * self.settings.closure, Guesses.none(block.section.shape[2])
        )
        closed.add(block.take(np.array(rest, np.int64)))
        found = closed.guesses
        depths = [min(LOOK_BACK, len(own[i].legs)) for i in rest]
        for depth in set(depths):
            rows = [i for i, d in zip(rest, depths, strict=True) if d == depth and block.is_bounded[i]]
            if rows:
                section = np.stack([np.concatenate(own[i].legs[-depth:]) for i in rows])
                found = found.joined(near_closed(section, self.settings.longest, self.geometry))
        new = [i for i, key in enumerate(found.key.tolist()) if key not in self._tried]
        self._tried.update(found.key[new].tolist())
        if not new:
            return
        polished: list[Orbit | None] = yield Polish(found.take(np.array(new, np.int64)))
        for orbit in polished:
            if orbit is None or self._rests(orbit):
                continue
            if number_of(orbit, self.orbits, self.geometry) == len(self.orbits):
                self.orbits.append(orbit)

    def _rests(self, orbit: Orbit) -> bool:
        """Whether an orbit is an equilibrium that the section runs through."""
        return self.point.can_rest and rest_of_orbit(self.point, orbit.points[0], self.geometry) is not None

    def _leave(self, course: Course, number: int) -> None:
        """Note when a cell came near an orbit for good."""
        orbit, states = self.orbits[number], np.concatenate([course.kept, course.extension])
        phase = int(np.argmin(self.geometry.distance(orbit.points, states[-1])))
        back = np.arange(len(states))
        on_phase = orbit.points[(phase - back) % orbit.period]
        near = self.geometry.distance(states[::-1], on_phase) <= REACH
        entered = len(states) - (len(near) if near.all() else int(np.argmin(near)))
        course.end, course.periods = number, float(max(entered - len(course.kept), 0))
        course.is_leaving = entered <= len(course.kept)

    def _rest(self, own: Sequence[Course], section: np.ndarray, seconds: np.ndarray) -> None:
        """End the cells that are on their way to a stable equilibrium."""
        if not self.point.can_rest:
            return
        going = [i for i, course in enumerate(own) if course.goes_on]
        if not going:
            return
        number = approaching(self.point, section[going], seconds[going], self.settings.closure, self.geometry)
        for i, k in zip(going, number.tolist(), strict=True):
            if k >= 0:
                own[i].end, own[i].periods = AT_REST - k, float(own[i].length)
                own[i].is_leaving = len(own[i].legs) <= 1

    def _leap(self, own: Sequence[Course], section: np.ndarray) -> None:
        """Let cells that leave an unstable orbit slowly go on farther from it."""
        rows = [i for i, course in enumerate(own) if course.goes_on]
        if not rows:
            return
        states = leap(section[rows], self.orbits, self.geometry)
        for i, state in zip(rows, states, strict=True):
            if np.isfinite(state).all():
                own[i].state, own[i].step = state, 0.0

    # ---- sets ----------------------------------------------------------------------------------

    def _tell_sets(self) -> Work[bool]:
        """Group the cells that go on into sets and describe them; returns whether anything is in doubt."""
        going = [course for course in self.courses if course.goes_on]
        has_stayed = bool(going[0].legs) and self._has_stayed(going, LEAST_STAY)
        numbers, is_sure = group([c.stayed for c in going], self.geometry, self.settings.closure)
        self.sets, in_doubt = [], not is_sure
        gone = [course for course in self.courses if self._was_on_a_set(course)]
        members_of = [
            [course for course, n in zip(going, numbers, strict=True) if n == k]
            for k in range(int(numbers.max()) + 1)
        ]
        if not has_stayed:
            members_of = self._with_those_left(members_of, gone)
        for own in members_of:
            one = yield from self._describe(own, gone, has_stayed)
            self.sets.append(one)
            in_doubt |= one.stability == NOT_SETTLED or one.kind == BOUNDED_SET
        return in_doubt

    def _with_those_left(
        self, members_of: Sequence[list[Course]], gone: Sequence[Course]
    ) -> list[list[Course]]:
        """Join the sets that cells have left: what is on its way through a transient set is no set of its own."""
        is_left = [
            any(self._were_on(course, np.concatenate([c.stayed for c in own])) for course in gone)
            for own in members_of
        ]
        joined = [course for own, left in zip(members_of, is_left, strict=True) if left for course in own]
        others = [own for own, left in zip(members_of, is_left, strict=True) if not left]
        return [joined, *others] if joined else others

    def _describe(self, own: Sequence[Course], gone: Sequence[Course], has_stayed: bool) -> Work[BoundedSet]:
        """Kind, stability and lifetimes of the set that some cells are on."""
        paths = [course.stayed for course in own]
        pooled = np.concatenate(paths)
        growth = yield from self._growth(own)
        kind = kind_of(growth, thinned(pooled, 1024), self.geometry) if growth is not None else BOUNDED_SET
        left = [c for c in gone if self._were_on(c, pooled)] if not has_stayed else []
        at_risk = float(sum(c.length for c in own) + sum(c.periods for c in left))
        verdict, evidence = self._verdict(own, left, growth, has_stayed)
        ended: dict[int, int] = {}
        for course in left:
            ended[course.end] = ended.get(course.end, 0) + 1
        return BoundedSet(
            np.array([c.cell for c in own], np.int64),
            Cloud.of(paths, self.geometry, self.settings.closure), pooled, kind, verdict, evidence, growth,
            len(own) + len(left), len(left), sum(c.is_leaving for c in self.courses), at_risk, ended,
            self._closes_above(own, growth),
        )  # fmt: skip

    def _were_on(self, course: Course, points: np.ndarray) -> bool:
        """Whether a cell that left was on the set before."""
        share = mixing(course.stayed, points, self.geometry, self.settings.closure)
        return bool(share >= OTHER)

    def _verdict(
        self, own: Sequence[Course], left: Sequence[Course], growth: Growth | None, has_stayed: bool
    ) -> tuple[int, int]:
        if growth is not None and growth.preserves_volume:
            return NEUTRAL, stability.BY_VOLUME
        if left:
            return TRANSIENT, stability.BY_LEAVING
        if not has_stayed or growth is None or growth.contracts:
            return NOT_SETTLED, stability.BY_NOTHING
        least = self.settings.closure
        if not all(is_stationary(course.stayed, self.geometry, least) for course in own):
            return NOT_SETTLED, stability.BY_NOTHING
        return ATTRACTS, stability.BY_STAYING

    def _growth(self, own: Sequence[Course]) -> Work[Growth | None]:
        """Exponents of the section map along the extended cells of a set; None if they are too short."""
        n = min(course.length for course in own)
        if n < LEG:
            return None
        n_states = self.geometry.n_states
        most = min(MOST_SLOPES, max(256, 20_000_000 // n_states**2))
        n_cells = max(1, min(len(own), most // min(n, most)))
        n = min(n, most // n_cells)
        # the last ones: transients are over
        paths = np.stack([course.extension[-n:] for course in own[:n_cells]])
        before, after = paths[:, :-1].reshape(-1, n_states), paths[:, 1:].reshape(-1, n_states)
        slopes: np.ndarray = yield Slopes(before)
        self.spent += 2 * n * n_cells
        volumes = self.point.volumes(slopes, before, after).reshape(n_cells, n - 1)
        derivatives = slopes.reshape(n_cells, n - 1, n_states, n_states)
        whole = np.isfinite(derivatives).all(axis=(1, 2, 3))
        if not whole.any():
            return None
        scales = np.asarray(self.geometry.scales)
        return growth_of(derivatives[whole] * scales / scales[:, None], self.point.n_neutral, volumes[whole])

    def _closes_above(self, own: Sequence[Course], growth: Growth | None) -> int:
        """Least period above the longest looked for that the cells of a contracting set come back after."""
        if growth is None or not growth.contracts:
            return 0
        path = min((c.extension for c in own), key=len)
        for p in range(self.settings.longest + 1, len(path) // 2):
            if (self.geometry.distance(path[-p:], path[-2 * p : -p]) <= 100.0 * self.settings.closure).all():
                return p
        return 0
