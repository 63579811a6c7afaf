"""The search for orbits, one parameter point after the other, in blocks of cells.

Cells are read block by block, several times over; what is kept between blocks (boxes, best guesses,
least hashes, sums) does not depend on how they were cut. All points of a slab go in step, so that the
guesses of all are polished in one call of the engine.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.analysis.attractors.bounded import Rule
from pipeline.analysis.attractors.cells import ClosedCells, Guesses, marks_of
from pipeline.analysis.attractors.deciding import LOOSE_SHARE, STRICT, decide
from pipeline.analysis.attractors.following import Engine, follow
from pipeline.analysis.attractors.orbits import RUN_ON_RTOL, Orbit, distinct, number_of, polish, run_on
from pipeline.analysis.attractors.points import Dynamics, Point
from pipeline.analysis.attractors.spirals import (
    MAX_GUESSES,
    RUN_ON_LEGS,
    SPIRALS_PER,
    beside,
    near_closed,
    spirals_of,
)
from pipeline.analysis.sets import Geometry, hashes
from pipeline.products.attractors import IdentifyOptions
from pipeline.products.reporting import report

ROUNDS, ROUNDS_LOOSE = 3, 6
"""Most rounds of guessing and polishing, with a strict and a loose tolerance."""


@dataclass(frozen=True)
class Search:
    """What the search is asked for, and of what.

    Attributes
    ----------
    options : IdentifyOptions
    tolerance : float
        That of the options, or what follows from the run.
    dynamics : Dynamics
    """

    options: IdentifyOptions
    tolerance: float
    dynamics: Dynamics

    @property
    def geometry(self) -> Geometry:
        """Of the states."""
        return self.dynamics.geometry

    @property
    def longest(self) -> int:
        """Longest period guessed."""
        return self.options.max_orbit_period

    @property
    def rule(self) -> Rule:
        """When bounded sets are the same."""
        return Rule.of(self.options)

    @property
    def is_loose(self) -> bool:
        """Whether closed cells may be too far from their orbit for an orbit of their own."""
        return self.options.polish and self.tolerance > STRICT

    @property
    def box(self) -> float:
        """Side of the boxes that group closed cells."""
        return LOOSE_SHARE * self.tolerance if self.is_loose else self.tolerance


@dataclass
class State:
    """What the search knows of one point before its cells are labelled.

    Attributes
    ----------
    orbits : list of Orbit
        In the order in which they were found.
    keys, group : ndarray
        Boxes of the closed cells, and the group of each.
    closed : ClosedCells
    ends : dict
        Orbit by the mark of a closed cell that was run on.
    spirals : dict
        Orbit by the box of a spiral that was run on, -1 where it stayed.
    """

    orbits: list[Orbit]
    keys: np.ndarray
    group: np.ndarray
    closed: ClosedCells
    ends: dict[int, int]
    spirals: dict[int, int] = field(default_factory=dict)


_Steps = Generator[Guesses, list[Orbit | None], State]


def search_all(points: Mapping[tuple[int, ...], Point], search: Search) -> dict[tuple[int, ...], State]:
    """Search all points in step, so that their orbits are polished and their spirals run on together."""
    searches = {index: _search(point, search) for index, point in points.items()}
    answers: dict[tuple[int, ...], Any] = dict.fromkeys(searches)
    states: dict[tuple[int, ...], State] = {}
    while answers:
        report("searching orbits", len(states), len(searches))
        asked: dict[tuple[int, ...], Guesses] = {}
        for index, answer in answers.items():
            try:
                asked[index] = searches[index].send(answer)
            except StopIteration as stop:
                states[index] = stop.value
        answers = _polish_together(asked, points, search)
    report("searching orbits", len(states), len(searches))
    if search.options.polish:
        _run_spirals(states, points, search)
    return states


def _run_spirals(
    states: Mapping[tuple[int, ...], State], points: Mapping[tuple[int, ...], Point], search: Search,
) -> None:  # fmt: skip
    """Run on what comes back near and no orbit accounts for, in place: before a bounded set is named."""
    asked = {i: _spirals(points[i], state.orbits, search) for i, state in states.items()}
    asked = {i: guesses for i, guesses in asked.items() if len(guesses.key)}
    if not asked:
        return
    owner = np.repeat(np.arange(len(asked)), [len(g.key) for g in asked.values()])
    start = np.concatenate([g.point for g in asked.values()])
    engine = Engine(
        np.stack([points[i].packed for i in asked]), np.array([points[i].frequency for i in asked]),
        owner, start, tolerances=(RUN_ON_RTOL, RUN_ON_RTOL), max_orbit_period=search.longest,
        residual=search.options.residual, geometry=search.geometry, system=search.dynamics.integrates,
    )  # fmt: skip
    known = [states[i].orbits for i in asked]
    ends = follow(
        start, owner, known, engine.advance, engine.polish, RUN_ON_LEGS, search.longest, search.geometry,
        jump=engine.jump,
    )  # fmt: skip
    for number, (index, guesses) in enumerate(asked.items()):
        states[index].orbits = ends.orbits[number]
        reached = np.maximum(ends.orbit[owner == number], -1)
        states[index].spirals = dict(zip(guesses.key.tolist(), reached.tolist(), strict=True))


def _spirals(point: Point, orbits: Sequence[Orbit], search: Search) -> Guesses:
    """Bounded cells that come back near and that none of the orbits accounts for."""
    found = Guesses.none(len(search.geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, search.tolerance, search.geometry)
        rest = block.section[block.is_bounded & (label < 0)]
        found = found.joined(spirals_of(rest, search.longest, search.tolerance, search.geometry))
    return found.least(max(MAX_GUESSES, point.n_cells // SPIRALS_PER))


def _polish_together(
    asked: Mapping[tuple[int, ...], Guesses], points: Mapping[tuple[int, ...], Point],
    search: Search,
) -> dict[tuple[int, ...], list[Orbit | None]]:  # fmt: skip
    if not asked:
        return {}
    sizes = [len(g.key) for g in asked.values()]
    packed = np.repeat([points[i].packed for i in asked], sizes, axis=0)
    frequency = np.repeat([points[i].frequency for i in asked], sizes)
    start = np.concatenate([g.point for g in asked.values()])
    period = np.concatenate([g.period for g in asked.values()])
    mark = np.concatenate([g.mark for g in asked.values()])
    unknown = np.flatnonzero(period == 0)
    start[unknown], period[unknown] = run_on(
        packed[unknown],
        frequency[unknown],
        start[unknown],
        search.longest,
        search.dynamics.integrates,
    )
    rows, place = _each_once(
        np.repeat(np.arange(len(sizes)), sizes), start, period, mark, unknown, search.geometry
    )
    polished = polish(
        packed[rows], frequency[rows], start[rows], period[rows],
        geometry=search.geometry, system=search.dynamics.integrates, tolerance=search.options.residual,
    )  # fmt: skip
    orbits = [polished[i] if i >= 0 else None for i in place]
    ends = np.cumsum(sizes)
    return {i: orbits[end - n : end] for i, n, end in zip(asked, sizes, ends, strict=True)}


def _each_once(
    search: np.ndarray, start: np.ndarray, period: np.ndarray, mark: np.ndarray, ended: np.ndarray,
    geometry: Geometry,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Rows to polish, and for each row the place of its own among them, -1 for none.

    Of rows that were run on and ended in one box, on one orbit that is, the one of least hash.
    """
    rows = np.arange(len(period))
    key = mark.copy()
    boxes = geometry.boxes(start[ended], STRICT)
    key[ended] = hashes(np.concatenate([period[ended, None], boxes], axis=1))
    group = np.stack([search.astype(np.uint64), np.isin(rows, ended).astype(np.uint64), key], axis=1)
    order = rows[np.lexsort((mark, *group.T[::-1]))]
    order = order[period[order] > 0]
    new = np.ones(len(order), bool)
    new[1:] = (group[order][1:] != group[order][:-1]).any(axis=1) | ~np.isin(order[1:], ended)
    place = np.full(len(period), -1)
    place[order] = np.cumsum(new) - 1
    return order[new], place


def _search(point: Point, search: Search) -> _Steps:
    """Find the attractors of one point; yields guesses and is sent their orbits."""
    n_states = len(search.geometry.scales)
    closed = ClosedCells(search.geometry, search.box, Guesses.none(n_states))
    for block in point.blocks():
        closed.add(block)
    keys, group = closed.close()
    orbits: list[Orbit] = []
    if search.options.polish:
        guesses = closed.guesses
        guesses = guesses.best(group[np.searchsorted(keys, guesses.key)].astype(np.uint64))
        if search.is_loose:
            guesses = guesses.least(MAX_GUESSES)
        for _ in range(ROUNDS_LOOSE if search.is_loose else ROUNDS):
            if len(guesses.key):
                polished = yield guesses
                more = distinct([*orbits, *(o for o in polished if o is not None)], search.geometry)
                if len(more) == len(orbits):
                    break
                orbits = more
            guesses = _undecided(point, orbits, search)
            if not len(guesses.key):
                break
    ends: dict[int, int] = {}
    if search.is_loose:
        rest = _closed_undecided(point, orbits, search)
        if len(rest.key):
            answers = yield rest
            for mark, orbit in zip(rest.mark, answers, strict=True):
                if orbit is not None and orbit.is_stable:
                    number = number_of(orbit, orbits, search.geometry)
                    orbits = orbits if number < len(orbits) else [*orbits, orbit]
                    ends[int(mark)] = number
    return State(orbits, keys, group, closed, ends)


def _closed_undecided(point: Point, orbits: Sequence[Orbit], search: Search) -> Guesses:
    """Return the closed cells that none of the orbits accounts for, to be run on."""
    found = Guesses.none(len(search.geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, search.tolerance, search.geometry)
        rest = np.flatnonzero(block.is_closed & (label < 0))
        section = block.section[rest]
        marks = marks_of(section)
        zero = np.zeros(len(rest))
        own = Guesses(marks, zero, marks, section[:, -1], zero.astype(np.int64))
        found = found.joined(own)
    return found


def _undecided(point: Point, orbits: Sequence[Orbit], search: Search) -> Guesses:
    """Guesses from cells that none of the orbits accounts for."""
    closed = ClosedCells(search.geometry, search.box, Guesses.none(len(search.geometry.scales)))
    near = Guesses.none(len(search.geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, search.tolerance, search.geometry)
        rest = np.flatnonzero(label < 0)
        closed.add(block.take(rest))
        loose = rest[block.is_bounded[rest]]
        near = near.joined(near_closed(block.section[loose], search.longest, search.geometry))
    keys, group = closed.close()
    own = closed.guesses.best(group[np.searchsorted(keys, closed.guesses.key)].astype(np.uint64))
    if search.is_loose:
        # the period seen may be half the true one, and the orbit an unstable one: the future tells
        own = closed.guesses.least(MAX_GUESSES)
        own = own.followed_by(own.without_period())
    if len(near.key):
        own = own.followed_by(beside(orbits, search.longest, search.geometry))
    return own.followed_by(near.least(MAX_GUESSES))
