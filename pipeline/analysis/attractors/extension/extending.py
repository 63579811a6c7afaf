"""Integrate trajectories that are on no known orbit or equilibrium further, until the set on which they end is known.

A sample of these cells is integrated further from the last section, leg by leg. After each leg, cells that
reached an orbit or an equilibrium, known or new, leave the sample. The others are grouped into sets
(`clouds`), and each set gets a kind (`growth`) and a stability (`stability`). A round ends when the sample
has stayed long enough and no set is in doubt, or when the budget is spent. Then the remaining cells are
compared with the points of the sets. Cells that match none are sampled again, in the next round.

The budget is `options.budget` times the periods that the run integrated at the parameter point, and at least
`Effort.least_budget` periods. Nothing here depends on the clock, so the same run gives the same verdicts.

Reading order: `extend` has the rounds, `_Extension.run` a round, `_take` one leg, `_tell_sets` the verdicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magpend_core.status import Status
from pipeline.analysis.attractors.extension.bounded_sets import (
    BoundedSet,
    describe,
    is_one_torus,
    left_behind,
    lie_on,
    were_on,
)
from pipeline.analysis.attractors.extension.clouds import group, members
from pipeline.analysis.attractors.extension.courses import AT_REST, COURSE_DIVERGED, COURSE_GROWS, FAILED, Course
from pipeline.analysis.attractors.extension.growth import Escape
from pipeline.analysis.attractors.finding import stability
from pipeline.analysis.attractors.finding.cell_blocks import Block, ClosedCells, Guesses
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, number_of
from pipeline.analysis.attractors.finding.equilibria import approaching, rest_near, rest_of_orbit
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.requests import LEG, Decide, Leg, Polish, Recur, Settings, Work
from pipeline.analysis.attractors.finding.spirals import keys_of, leap
from pipeline.layout.vocabulary import ATTRACTS, CHAOTIC_SET, NEUTRAL, NOT_SETTLED
from pipeline.results.intervals import lifetime_interval
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import REACH


@dataclass
class Outcome:
    """Result of the further integration of the trajectories of one parameter point."""

    orbits: list[Orbit]  # known orbits, old and new
    courses: list[Course]  # sampled cells
    sets: list[BoundedSet]  # sets that do not close
    spent: int = 0  # periods integrated
    ran_out: bool = False  # whether the budget ended the work


def extend(
    point: Point, orbits: Sequence[Orbit], label: np.ndarray, settings: Settings, budget: float, n_sample: int
) -> Work[Outcome]:
    """Integrate a sample of the cells without a known attractor (label -1) further, and find the sets on which they
    end.

    Parameters
    ----------
    point
        Parameter point with its equilibria.
    orbits
        Known orbits.
    label
        Label of each cell, shape (cell,); not changed.
    settings
        Tolerances and the integration.
    budget
        Budget in units of the periods that the run integrated; 0 extends nothing.
    n_sample
        Number of cells in the first sample.
    """
    work = _Extension(point, list(orbits), settings, budget)
    loose = np.flatnonzero(label < 0)
    for _ in range(settings.effort.rounds):
        chosen = work.sample(loose, n_sample) if len(loose) else []
        if not chosen:
            break
        work.courses += chosen
        if work.ran_out:
            break
        yield from (work.run() if work.budget else work.conclude())
        loose = work.left_of(loose)
        n_sample *= 2
    work.end_growing()
    if any(course.goes_on for course in work.courses):
        yield from work.conclude()
    work.add_transient()
    n_leaving = sum(course.is_leaving for course in work.courses)
    sets = [replace(one, n_leaving=n_leaving) for one in work.sets]
    return Outcome(work.orbits, work.courses, sets, work.spent, work.ran_out)


def sample_cells(point: Point, loose: np.ndarray, n: int, settings: Settings, known: np.ndarray) -> list[Course]:
    """Choose at most `n` of the cells `loose` to integrate further, none in a box of section points that is `known`."""
    best: dict[int, tuple[int, Course]] = {}
    is_loose = np.zeros(point.n_cells, bool)
    is_loose[loose] = True
    for block in point.blocks():
        rows = np.flatnonzero(is_loose[block.cells] & (block.is_bounded | block.is_closed))
        keys = keys_of(block.section[rows], settings.closure, settings.geometry)
        new = np.flatnonzero(~np.isin(keys, known))
        rows, keys, marks = rows[new], keys[new], block.marks[rows[new]]
        # the least hash of each box, and of these the least `n`
        order = np.argsort(marks, kind="stable")
        order = order[np.sort(np.unique(keys[order], return_index=True)[1])[:n]]
        for row, key, mark in zip(rows[order], keys[order].tolist(), marks[order].tolist(), strict=True):
            if key not in best or mark < best[key][0]:
                step = 0.0 if block.step is None else float(np.nan_to_num(block.step[row]))
                kept = block.section[row].copy()
                best[key] = mark, Course(int(row) + block.cells.start, key, kept, kept[-1], step)
    return [course for _, course in sorted(best.values(), key=lambda item: item[0])[:n]]


def _has_no_shape(one: BoundedSet) -> bool:
    """Return whether a set may be a part of a torus, on no closed curve that was seen."""
    settled = one.dimension > 0 and one.stability == ATTRACTS
    return one.is_regular and one.curve is None and not one.n_left and not settled


@dataclass(frozen=True)
class _Seen:
    """What each leg of a trajectory shows: whether it was completed, and which orbit or equilibrium it approaches."""

    is_whole: np.ndarray  # whether it was integrated to the end
    # index of the orbit that the leg is on or approaches, the same if it attracts, and index of the equilibrium that it
    # approaches; -1 for none
    label: np.ndarray
    orbit: np.ndarray
    rest: np.ndarray
    leap: np.ndarray  # (row, state): a later state, if the trajectory slowly leaves an unstable orbit; else NaN

    @cached_property
    def leaps(self) -> np.ndarray:
        return np.asarray(np.isfinite(self.leap).all(axis=1))

    @property
    def is_end(self) -> np.ndarray:
        """Whether the trajectory does not go on from the end of the leg."""
        return np.asarray(~self.is_whole | (self.orbit >= 0) | (self.rest >= 0) | self.leaps)


class _Extension:
    """Further integration at one parameter point: the sampled trajectories, and the orbits and sets found so far."""

    def __init__(self, point: Point, orbits: list[Orbit], settings: Settings, budget: float) -> None:
        self.point, self.orbits, self.settings = point, orbits, settings
        self.geometry: Geometry = settings.geometry
        effort = settings.effort
        self.paths = int(np.clip(effort.least_paths * budget, effort.least_paths, effort.most_paths))
        # whatever the run's length, a budget of 1 suffices for the trajectories of one set
        needed = min(budget, effort.most_paths) * effort.least_paths * effort.times_longest * settings.seen
        self.budget = int(max(budget * point.n_periods, effort.least_budget, needed)) if budget > 0.0 else 0
        self.courses: list[Course] = []
        self.sets: list[BoundedSet] = []
        self.spent, self.ran_out = 0, False
        self._tried: set[int] = set()
        self._told: list[tuple[int, bool]] = []
        self._escapes: dict[int, tuple[int, bool]] = {}  # length, and whether it grows, of each trajectory

    @property
    def has_budget(self) -> bool:
        return self.spent < self.budget

    # ---- samples -------------------------------------------------------------------------------

    def sample(self, loose: np.ndarray, n: int) -> list[Course]:
        """Choose at most `n` unassigned cells to integrate further. The choice is reproducible, and takes one cell from
        each box of section points.
        """
        known = np.array([course.key for course in self.courses], np.uint64)
        return sample_cells(self.point, loose, n, self.settings, known)

    def left_of(self, loose: np.ndarray) -> np.ndarray:
        """Return the cells of `loose` whose end is still open: not integrated further, and on no set whose stability is
        decided.
        """
        left = np.setdiff1d(loose, [course.cell for course in self.courses])
        return np.setdiff1d(left, self.told(left)[0])

    def told(self, loose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of `loose` that lie on sets whose stability is decided, and the index of each cell's set."""
        final = [i for i, one in enumerate(self.sets) if one.stability in (ATTRACTS, NEUTRAL) or not self.budget]
        clouds = [one for i in final if (one := self.sets[i].cloud) is not None]
        is_loose = np.zeros(self.point.n_cells, bool)
        is_loose[loose] = True
        cells, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for block in self.point.blocks() if len(clouds) and len(loose) else ():
            rows = np.flatnonzero(is_loose[block.cells] & (block.is_bounded | block.is_closed))
            own = members(block.section[rows], clouds)
            cells.append(rows[own >= 0] + block.cells.start)
            numbers.append(np.array(final, np.int64)[own[own >= 0]])
        return np.concatenate(cells), np.concatenate(numbers)

    def add_transient(self) -> None:
        """Describe the set that trajectories have left, and store it as a transient set, unless one is stored
        already.
        """
        left = [course for course in self.courses if course.has_left]
        if left and not any(one.n_left for one in self.sets):
            self.sets.append(left_behind(left, self.settings))

    # ---- legs ----------------------------------------------------------------------------------

    def run(self) -> Work[None]:
        """Integrate the sampled trajectories further, until it is decided for each of them whether its set attracts."""
        target = self.settings.effort.least_stay
        for _ in range(self.settings.effort.doublings + 1):
            in_doubt = yield from self._extend_and_tell(target)
            if self.has_budget and self._draw_neighbours():
                in_doubt = yield from self._extend_and_tell(target)
            if not self.sets and not in_doubt:
                return
            if not in_doubt and all(one.stability in (ATTRACTS, NEUTRAL) for one in self.sets):
                self.ran_out = False  # the budget ended, but it was enough
            if not in_doubt or not self.has_budget:
                return
            target = 2 * max(c.length for c in self.courses if c.goes_on)

    def _extend_and_tell(self, target: int) -> Work[bool]:
        """Extend the trajectories and describe the sets on which they stay. Return whether a set is in doubt."""
        yield from self._extend(target)
        if any(course.goes_on for course in self.courses):
            return (yield from self._tell_sets())
        self.sets = []
        return False

    def conclude(self) -> Work[None]:
        """Describe the sets again if their trajectories were integrated further since the last description."""
        if self._told != self._lengths():
            yield from self._tell_sets()

    def _lengths(self) -> list[tuple[int, bool]]:
        return [(course.length, course.goes_on) for course in self.courses]

    def _extend(self, target: int) -> Work[None]:
        while True:
            going = [course for course in self.courses if course.goes_on]
            if not going or self._has_stayed(going, target):
                return
            # extend the shortest courses first: those of a later round, and those that leapt
            least = min(course.length for course in going)
            shortest = [course for course in going if course.length == least]
            if not self.has_budget and not any(course.length < course.sent for course in shortest):
                self.ran_out = True
                return
            states, steps = np.array([c.state for c in shortest]), np.array([c.step for c in shortest])
            n_legs = self._n_legs(going, shortest, target)
            for course in shortest:
                course.sent = least + n_legs * LEG
            legs = yield Leg(states, steps, self.spent / self.budget, n_legs)
            yield from self._take(shortest, legs, n_legs)

    def _n_legs(self, going: Sequence[Course], shortest: Sequence[Course], target: int) -> int:
        """Return over how many legs the shortest of the trajectories are integrated at once: as many as before, if
        nothing is to be decided earlier.
        """
        n_before = shortest[0].length // LEG
        most = min(max(n_before, 1), self.settings.effort.most_legs)
        for n in range(1, most):
            if (
                self._searches(n_before + n)
                or self.spent + n * LEG * len(shortest) >= self.budget
                or any(course.length == (n_before + n) * LEG for course in going)
                or self._has_stayed(going, target, n)
            ):
                return n
        return most

    def _searches(self, n_legs: int) -> bool:
        """Return whether orbits are searched after so many legs."""
        return n_legs.bit_count() == 1 or n_legs % self.settings.effort.search_each == 0

    def _has_stayed(self, going: Sequence[Course], target: int, n_legs: int = 0) -> bool:
        """Return whether the unfinished trajectories stayed on their set long enough to call the set an attractor, or
        will have after some more legs of the shortest of them.
        """
        lengths = [course.length for course in going]
        least = min(lengths) + n_legs * LEG
        if least < target:
            return False
        longest = self.settings.effort.times_longest * self._longest_transient()
        if any(course.is_neighbour for course in going):
            return least >= longest
        at_risk = float(sum(lengths) + n_legs * LEG * lengths.count(min(lengths)))
        return least >= longest or lifetime_interval(0, at_risk)[0] >= longest

    def _longest_transient(self) -> float:
        left = [c.periods for c in self.courses if not c.goes_on and not c.is_leaving]
        return self.settings.seen + max(left, default=0.0)

    def _take(self, going: Sequence[Course], legs: Block, n: int) -> Work[None]:
        """Record the newly integrated section points of each trajectory, `n` legs of it, up to the leg in which it
        failed, reached an orbit or an equilibrium, or leaps. Finish the trajectories that are at an end.
        """
        seen, known = (yield from self._seen(legs)), self._n_known
        begins = n * np.arange(len(going))
        ends = seen.is_end.reshape(-1, n)
        last = begins + np.where(ends.any(axis=1), ends.argmax(axis=1), n - 1)
        self.spent += LEG * int((last - begins + 1).sum())
        n_done = going[0].length // LEG + n
        assert legs.seconds is not None
        assert legs.step is not None
        state, seconds = legs.state, legs.seconds.sum(axis=1)
        for course, begin, row in zip(going, begins.tolist(), last.tolist(), strict=True):
            whole = slice(begin, row + int(seen.is_whole[row]))
            course.add(legs.section[whole], seconds[whole], state[row], float(legs.step[row]))
        is_done = seen.is_whole[last] & (last == begins + n - 1)
        for i in np.flatnonzero(~is_done).tolist():
            self._finish(going[i], seen, int(last[i]), int(legs.status[last[i]]))
        own, rows = [course for course, done in zip(going, is_done, strict=True) if done], last[is_done]
        if not own:
            return
        block = legs.take(rows)
        if self._searches(n_done):
            yield from self._search(own, block, seen.label[rows])
        if self._n_known != known:
            seen, rows = (yield from self._seen(block)), np.arange(len(own))
        for i, course in enumerate(own):
            self._finish(course, seen, int(rows[i]), int(block.status[i]))

    @property
    def _n_known(self) -> tuple[int, int]:
        return len(self.orbits), len(self.point.equilibria) if self.point.can_rest else 0

    def _seen(self, legs: Block) -> Work[_Seen]:
        is_whole = (legs.status == Status.PERIODIC) | (legs.status == Status.BOUNDED)
        label = yield Decide(legs, self.orbits)
        stable = np.array([*(orbit.is_stable for orbit in self.orbits), False])
        orbit, rest = np.where(stable[label], label, -1), np.full(len(label), -1)
        if self.point.can_rest:
            assert legs.seconds is not None
            rows = np.flatnonzero(is_whole & (orbit < 0))
            section, seconds = legs.section[rows], legs.seconds[rows]
            rest[rows] = approaching(self.point, section, seconds, self.settings.closure, self.geometry)
        return _Seen(is_whole, label, orbit, rest, leap(legs.section, self.orbits, self.geometry))

    def _finish(self, course: Course, seen: _Seen, row: int, status: int) -> None:
        """Finish a trajectory that is at an end after a leg, or advance it without integration if it slowly leaves an
        unstable orbit.
        """
        if not seen.is_whole[row]:
            self._fail(course, status)
        elif seen.orbit[row] >= 0:
            self._leave(course, int(seen.orbit[row]))
        elif seen.rest[row] >= 0:
            course.end, course.periods = AT_REST - int(seen.rest[row]), float(course.length)
            course.is_leaving = course.length <= LEG
        elif seen.leaps[row]:
            course.state, course.step = seen.leap[row], 0.0

    def _fail(self, course: Course, status: int) -> None:
        course.periods = float(course.length)
        course.is_leaving = not course.length
        course.end = COURSE_DIVERGED if status == Status.DIVERGED else FAILED
        if status == Status.NO_RETURN and self.point.can_rest:
            number = rest_near(self.point, course.state, self.geometry)
            if number is not None:
                course.end = AT_REST - number

    def _search(self, own: Sequence[Course], block: Block, label: np.ndarray) -> Work[None]:
        """Find closed orbits by Newton's method, started from trajectories that close or nearly close. The `label` is
        the known orbit of each.
        """
        rest = np.flatnonzero(label < 0).tolist()
        closed = ClosedCells(self.geometry, 10.0 * self.settings.closure, Guesses.none(block.section.shape[2]))
        closed.add(block.take(np.array(rest, np.int64)))
        found = closed.guesses
        depths = [min(self.settings.effort.look_back * LEG, own[i].length) for i in rest]
        for depth in set(depths):
            rows = [i for i, d in zip(rest, depths, strict=True) if d == depth and block.is_bounded[i]]
            if rows:
                found = found.joined((yield Recur(np.stack([own[i].extension[-depth:] for i in rows]))))
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
        return self.point.can_rest and rest_of_orbit(self.point, orbit.points[0], self.geometry) is not None

    def _leave(self, course: Course, number: int) -> None:
        """Finish a trajectory that has reached an orbit, and record from when on it stayed near the orbit."""
        orbit, states = self.orbits[number], np.concatenate([course.kept, course.extension])
        phase = int(np.argmin(self.geometry.distance(orbit.points, states[-1])))
        back = np.arange(len(states))
        on_phase = orbit.points[(phase - back) % orbit.period]
        near = self.geometry.distance(states[::-1], on_phase) <= REACH
        entered = len(states) - (len(near) if near.all() else int(np.argmin(near)))
        course.end, course.periods = number, float(max(entered - len(course.kept), 0))
        course.is_leaving = entered <= len(course.kept)

    def _draw_neighbours(self) -> bool:
        """Draw neighbours of the cells on each chaotic set with too few cells; return whether any were drawn."""
        # largest scaled distance of a neighbour from its cell: chaos separates them, and they start on the same set
        size = 1e-6
        random, scales = np.random.default_rng(0), np.asarray(self.geometry.scales)
        n_before = len(self.courses)
        for one in self.sets:
            if one.kind != CHAOTIC_SET or one.stability != NOT_SETTLED:
                continue
            on_set = [course for course in self.courses if course.goes_on and course.cell in one.cells]
            for i in range(self.paths - len(on_set)):
                near = on_set[i % len(on_set)]
                aside = size * random.uniform(-1.0, 1.0, len(scales)) * scales
                self.courses.append(Course(near.cell, near.key, near.kept, near.state + aside, is_neighbour=True))
        return len(self.courses) > n_before

    def _are_enough(self, own: Sequence[Course]) -> bool:
        """Return whether the trajectories on a chaotic set, neighbours included, are enough to say that it attracts."""
        stayed = not any(course.is_neighbour for course in own) or self._has_stayed(
            own, self.settings.effort.least_stay
        )
        return len(own) >= self.paths and stayed

    # ---- sets ----------------------------------------------------------------------------------

    def _tell_sets(self) -> Work[bool]:
        """Group the unfinished trajectories by set, and describe each set. Return whether any grouping or stability is
        still uncertain.
        """
        on_sets = [course for course in self.courses if course.goes_on]
        # what grows may still come to a set: its extension goes on
        going = [course for course in on_sets if not self._grows(course)]
        self._told, self.sets = self._lengths(), []
        if not going:
            return True
        cells = [course for course in going if not course.is_neighbour]
        has_stayed = bool(cells) and cells[0].length > 0 and self._has_stayed(cells, self.settings.effort.least_stay)
        numbers, is_sure = group([c.stayed for c in going], self.geometry, self.settings.closure)
        groups = [
            [course for course, n in zip(going, numbers, strict=True) if n == k] for k in range(int(numbers.max()) + 1)
        ]
        gone = [] if has_stayed else [course for course in self.courses if course.has_left]
        parts = self._with_those_left(groups, gone)
        sets = []
        for own, left in parts:
            one = yield from describe(own, left, self.point, self.settings, has_stayed)
            if one.kind == CHAOTIC_SET and one.stability == ATTRACTS and not self._are_enough(own):
                one = replace(one, stability=NOT_SETTLED, evidence=stability.BY_NOTHING)
            sets.append(one)
        self.sets = yield from self._joined(sets, [own for own, _ in parts], has_stayed)
        is_sure |= all(one.curve is not None for one in self.sets)
        in_doubt = any(one.stability == NOT_SETTLED or _has_no_shape(one) for one in self.sets)
        return len(going) < len(on_sets) or not is_sure or in_doubt

    def _grows(self, course: Course) -> bool:
        known = self._escapes.get(id(course))
        if known is None or known[0] != course.length:
            known = self._escapes[id(course)] = course.length, Escape.of(course.extension, self.geometry) is not None
        return known[1]

    def end_growing(self) -> None:
        """Finish the trajectories that grow to the end of the extension."""
        growing = [course for course in self.courses if course.goes_on and self._grows(course)]
        for course in growing:
            course.end, course.is_leaving = COURSE_GROWS, True
        if growing and all(one.stability in (ATTRACTS, NEUTRAL) for one in self.sets):
            self.ran_out = False

    def _joined(self, sets: list[BoundedSet], owns: list[list[Course]], has_stayed: bool) -> Work[list[BoundedSet]]:
        """Join tori that are the same: each trajectory on a torus may fill only a part of it."""
        n_own, k = [len(own) for own in owns], 0
        while k < len(sets):
            for i in range(k):
                if (yield from self._are_one_torus(sets[i], sets[k], owns[i], owns[k])):
                    owns[i] += owns.pop(k)
                    sets.pop(k), n_own.pop(k)
                    break
            else:
                k += 1
        for i, n in enumerate(n_own):
            if len(owns[i]) > n:
                sets[i] = yield from describe(owns[i], [], self.point, self.settings, has_stayed)
        return (yield from self._with_one_unsettled(sets, owns, has_stayed))

    def _are_one_torus(
        self, a: BoundedSet, b: BoundedSet, on_a: Sequence[Course], on_b: Sequence[Course]
    ) -> Work[bool]:
        """Return whether two sets are one torus, by their curve or by the states between them."""
        if a.n_left or b.n_left:
            return False
        on_one_curve = lie_on(a.curve, on_b, self.geometry) or lie_on(b.curve, on_a, self.geometry)
        if a.is_regular and b.is_regular and on_one_curve:
            return True
        # a trajectory may also fill a curve of the section of a torus of more frequencies
        alike = a.dimension == b.dimension >= 2 and a.stability == b.stability == ATTRACTS
        return alike and (yield from is_one_torus(on_a[0], on_b[0], self.geometry))

    def _with_one_unsettled(
        self, sets: list[BoundedSet], owns: list[list[Course]], has_stayed: bool
    ) -> Work[list[BoundedSet]]:
        """Join what may be parts of tori, and is not known apart, to one set that is not settled."""
        parts = [k for k, one in enumerate(sets) if _has_no_shape(one)]
        if len(parts) < 2:
            return sets
        own = [course for k in parts for course in owns[k]]
        one = yield from describe(own, [], self.point, self.settings, has_stayed)
        one = replace(one, stability=NOT_SETTLED, evidence=stability.BY_NOTHING)
        return [one, *(other for k, other in enumerate(sets) if k not in parts)]

    def _with_those_left(
        self, groups: Sequence[list[Course]], gone: Sequence[Course]
    ) -> list[tuple[list[Course], list[Course]]]:
        """Pair each group of unfinished trajectories with the trajectories that left the same set. Merge all groups
        whose set was left.
        """
        left = [[course for course in gone if were_on(course, own, self.settings)] for own in groups]
        joined = [course for own, some in zip(groups, left, strict=True) if some for course in own]
        found = [(own, some) for own, some in zip(groups, left, strict=True) if not some]
        if joined:
            found.insert(0, (joined, [c for c in gone if any(c is x for some in left for x in some)]))
        return found
