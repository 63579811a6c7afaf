"""The search for attractors, one parameter point after the other, in blocks of cells.

Cells are read block by block, several times over; what is kept between blocks (boxes, best guesses,
least hashes, sums) does not depend on how they were cut. All points of a slab go in step, so that the
guesses of all are polished in one call of the engine.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magpend_core.engine.system import System
from pipeline.analysis.attractors import features as feature
from pipeline.analysis.attractors.bounded import Clouds, Rule, assign, find_sets
from pipeline.analysis.attractors.cells import Block, ClosedCells, Guesses, marks_of
from pipeline.analysis.attractors.deciding import (
    CLOSED,
    LOOSE_SHARE,
    RUN_ON,
    SAME_SET,
    STRICT,
    UNDECIDED,
    decide,
)
from pipeline.analysis.attractors.features import Cells, Features
from pipeline.analysis.attractors.following import Engine, follow
from pipeline.analysis.attractors.orbits import (
    RUN_ON_RTOL,
    Orbit,
    distinct,
    number_of,
    polish,
    raw_orbit,
    run_on,
)
from pipeline.analysis.attractors.points import Point
from pipeline.analysis.attractors.spirals import (
    MAX_GUESSES,
    RUN_ON_LEGS,
    Recurrence,
    keys_of,
    near_closed,
    spirals_of,
)
from pipeline.analysis.sets import Geometry, hashes, order_by_points
from pipeline.layout.vocabulary import BOUNDED_SET, CLOSED_ORBIT

ROUNDS, ROUNDS_LOOSE = 3, 6
"""Most rounds of guessing and polishing, with a strict and a loose tolerance."""

UNSETTLED = -2
"""Label of spirals that were not run on, until the sets are told."""


@dataclass(frozen=True)
class Options:
    """What the search is asked for; see `pipeline.analysis.attractors.attractors.identify`."""

    tolerance: float
    polish: bool
    residual: float
    max_orbit_period: int
    rule: Rule
    n_points: int
    mirror_threshold: float

    @property
    def is_loose(self) -> bool:
        """Whether closed cells may be too far from their orbit for an orbit of their own."""
        return self.polish and self.tolerance > STRICT

    @property
    def box(self) -> float:
        """Side of the boxes that group closed cells."""
        return LOOSE_SHARE * self.tolerance if self.is_loose else self.tolerance


@dataclass
class Found:
    """Attractors of one parameter point."""

    label: np.ndarray
    decision: np.ndarray
    features: list[Features]
    counts: list[int]


# ---- search ------------------------------------------------------------------------------------

_Search = Generator[Guesses, list[Orbit | None], "State"]


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


def search_all(
    points: Mapping[tuple[int, ...], Point], options: Options, system: System
) -> dict[tuple[int, ...], Found]:
    """Search all points in step, so that their orbits are polished and their spirals run on together."""
    geometry = Geometry.of(system)
    searches = {index: _search(point, options, geometry) for index, point in points.items()}
    answers: dict[tuple[int, ...], Any] = dict.fromkeys(searches)
    states: dict[tuple[int, ...], State] = {}
    while answers:
        asked: dict[tuple[int, ...], Guesses] = {}
        for index, answer in answers.items():
            try:
                asked[index] = searches[index].send(answer)
            except StopIteration as stop:
                states[index] = stop.value
        answers = _polish_together(asked, points, options, geometry, system)
    if options.polish:
        _run_spirals(states, points, options, geometry, system)
    return {index: _conclude(points[index], states[index], options, geometry) for index in points}


def _run_spirals(
    states: Mapping[tuple[int, ...], State], points: Mapping[tuple[int, ...], Point], options: Options,
    geometry: Geometry, system: System,
) -> None:  # fmt: skip
    """Run on what comes back near and no orbit accounts for, in place: before a bounded set is named."""
    asked = {i: _spirals(points[i], state.orbits, options, geometry) for i, state in states.items()}
    asked = {i: guesses for i, guesses in asked.items() if len(guesses.key)}
    if not asked:
        return
    owner = np.repeat(np.arange(len(asked)), [len(g.key) for g in asked.values()])
    start = np.concatenate([g.point for g in asked.values()])
    engine = Engine(
        np.stack([points[i].packed for i in asked]), np.array([points[i].frequency for i in asked]),
        owner, start, tolerances=(RUN_ON_RTOL, RUN_ON_RTOL), max_orbit_period=options.max_orbit_period,
        residual=options.residual, geometry=geometry, system=system,
    )  # fmt: skip
    known = [states[i].orbits for i in asked]
    ends = follow(
        start, owner, known, engine.advance, engine.polish, RUN_ON_LEGS, options.max_orbit_period, geometry,
        jump=engine.jump,
    )  # fmt: skip
    for number, (index, guesses) in enumerate(asked.items()):
        states[index].orbits = ends.orbits[number]
        reached = np.maximum(ends.orbit[owner == number], -1)
        states[index].spirals = dict(zip(guesses.key.tolist(), reached.tolist(), strict=True))


def _spirals(point: Point, orbits: Sequence[Orbit], options: Options, geometry: Geometry) -> Guesses:
    """Bounded cells that come back near and that none of the orbits accounts for."""
    found = Guesses.none(len(geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, options.tolerance, geometry)
        rest = block.section[block.is_bounded & (label < 0)]
        found = found.joined(spirals_of(rest, options.max_orbit_period, options.tolerance, geometry))
    return found.least(MAX_GUESSES)


def _polish_together(
    asked: Mapping[tuple[int, ...], Guesses], points: Mapping[tuple[int, ...], Point],
    options: Options, geometry: Geometry, system: System,
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
        packed[unknown], frequency[unknown], start[unknown], options.max_orbit_period, system
    )
    rows, place = _each_once(np.repeat(np.arange(len(sizes)), sizes), start, period, mark, unknown, geometry)
    polished = polish(
        packed[rows], frequency[rows], start[rows], period[rows],
        geometry=geometry, system=system, tolerance=options.residual,
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


def _search(point: Point, options: Options, geometry: Geometry) -> _Search:
    """Find the attractors of one point; yields guesses and is sent their orbits."""
    n_states = len(geometry.scales)
    closed = ClosedCells(geometry, options.box, Guesses.none(n_states))
    for block in point.blocks():
        closed.add(block)
    keys, group = closed.close()
    orbits: list[Orbit] = []
    if options.polish:
        guesses = closed.guesses
        guesses = guesses.best(group[np.searchsorted(keys, guesses.key)].astype(np.uint64))
        if options.is_loose:
            guesses = guesses.least(MAX_GUESSES)
        for _ in range(ROUNDS_LOOSE if options.is_loose else ROUNDS):
            if len(guesses.key):
                polished = yield guesses
                more = distinct([*orbits, *(o for o in polished if o is not None)], geometry)
                if len(more) == len(orbits):
                    break
                orbits = more
            guesses = _undecided(point, orbits, options, geometry)
            if not len(guesses.key):
                break
    ends: dict[int, int] = {}
    if options.is_loose:
        rest = _closed_undecided(point, orbits, options, geometry)
        if len(rest.key):
            answers = yield rest
            for mark, orbit in zip(rest.mark, answers, strict=True):
                if orbit is not None and orbit.is_stable:
                    number = number_of(orbit, orbits, geometry)
                    orbits = orbits if number < len(orbits) else [*orbits, orbit]
                    ends[int(mark)] = number
    return State(orbits, keys, group, closed, ends)


def _closed_undecided(point: Point, orbits: Sequence[Orbit], options: Options, geometry: Geometry) -> Guesses:
    """Return the closed cells that none of the orbits accounts for, to be run on."""
    found = Guesses.none(len(geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, options.tolerance, geometry)
        rest = np.flatnonzero(block.is_closed & (label < 0))
        section = block.section[rest]
        marks = marks_of(section)
        zero = np.zeros(len(rest))
        own = Guesses(marks, zero, marks, section[:, -1], zero.astype(np.int64))
        found = found.joined(own)
    return found


def _undecided(point: Point, orbits: Sequence[Orbit], options: Options, geometry: Geometry) -> Guesses:
    """Guesses from cells that none of the orbits accounts for."""
    closed = ClosedCells(geometry, options.box, Guesses.none(len(geometry.scales)))
    near = Guesses.none(len(geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, options.tolerance, geometry)
        rest = np.flatnonzero(label < 0)
        closed.add(block.take(rest))
        loose = rest[block.is_bounded[rest]]
        near = near.joined(near_closed(block.section[loose], options.max_orbit_period, geometry))
    keys, group = closed.close()
    own = closed.guesses.best(group[np.searchsorted(keys, closed.guesses.key)].astype(np.uint64))
    if options.is_loose:
        # the period seen may be half the true one, and the orbit an unstable one: the future tells
        own = closed.guesses.least(MAX_GUESSES)
        own = own.followed_by(own.without_period())
    return own.followed_by(near.least(MAX_GUESSES))


def _conclude(point: Point, state: State, options: Options, geometry: Geometry) -> Found:
    """Label all cells, and describe what they are labelled with."""
    label = np.full(point.n_cells, -1, np.int64)
    decision = np.zeros(point.n_cells, np.int8)
    raw: dict[int, tuple[float, int, np.ndarray]] = {}
    left = np.full(point.n_cells, -1, np.int64)
    for block in point.blocks():
        label[block.cells], decision[block.cells] = decide(block, state.orbits, options.tolerance, geometry)
        _label_spirals(block, state.spirals, label, decision, options, geometry)
        if options.is_loose:
            _label_ends(block, state.ends, label, decision)
            continue
        own = state.closed.group_of(block, state.keys, state.group)
        own[label[block.cells] >= 0] = -1
        left[block.cells] = own
        _representatives(block, own, raw, geometry)
    numbers = {g: len(state.orbits) + i for i, g in enumerate(sorted(raw))}
    for g, number in numbers.items():
        label[left == g] = number
    decision[left >= 0] = CLOSED
    orbits = [*state.orbits, *(raw_orbit(raw[g][2], geometry) for g in sorted(raw))]
    _label_sets(point, len(orbits), label, decision, options.rule, geometry)
    label[label == UNSETTLED] = -1
    return _describe(point, orbits, label, decision, options, geometry)


def _label_spirals(
    block: Block, spirals: Mapping[int, int], label: np.ndarray, decision: np.ndarray, options: Options,
    geometry: Geometry,
) -> None:  # fmt: skip
    """Label the bounded cells that come back near by where those of their box went, in place.

    There are more boxes than are run on where very many cells spiral at once. If all that were run on
    ended on orbits, the others make no set either: they stay undecided.
    """
    rest = np.flatnonzero(block.is_bounded & (label[block.cells] < 0)) if spirals else np.zeros(0, np.int64)
    if not len(rest):
        return
    section = block.section[rest]
    none_stayed = all(number >= 0 for number in spirals.values())
    is_near = Recurrence.of(section, options.max_orbit_period, geometry).is_near
    keys = keys_of(section, options.tolerance, geometry)
    for row, key, near in zip(rest + block.cells.start, keys.tolist(), is_near, strict=True):
        number = spirals.get(key, UNSETTLED if none_stayed else -1) if near else -1
        label[row] = number
        decision[row] = RUN_ON if number >= 0 else UNDECIDED


def _label_ends(block: Block, ends: Mapping[int, int], label: np.ndarray, decision: np.ndarray) -> None:
    """Label the closed cells that were run on by where they went, in place."""
    rest = np.flatnonzero(block.is_closed & (label[block.cells] < 0))
    for row, mark in zip(rest, marks_of(block.section[rest]), strict=True):
        if int(mark) in ends:
            label[row + block.cells.start], decision[row + block.cells.start] = ends[int(mark)], RUN_ON


def _representatives(
    block: Block, group: np.ndarray, best: dict[int, tuple[float, int, np.ndarray]], geometry: Geometry
) -> None:
    """Keep the last period of the best closed cell of each group, among those not on a polished orbit."""
    rows = np.flatnonzero(group >= 0)
    if not len(rows):
        return
    marks = marks_of(block.section[rows])
    for row, mark in zip(rows, marks, strict=True):
        p = min(int(block.orbit_period[row]), block.section.shape[1])
        section = block.section[row]
        back = section[-1 - p] if section.shape[0] > p else section[-1]
        entry = (float(geometry.distance(section[-1], back)), int(mark), section[-p:])
        g = int(group[row])
        if g not in best or entry[:2] < best[g][:2]:
            best[g] = entry


def _label_sets(
    point: Point, first: int, label: np.ndarray, decision: np.ndarray, rule: Rule, geometry: Geometry
) -> None:
    """Label the bounded cells that no orbit accounts for, in place, from number `first` on."""
    for _ in range(rule.n_rounds):
        anchors: Clouds | None = None
        for block in point.blocks():
            loose = np.flatnonzero(block.is_bounded & (label[block.cells] == -1))
            if len(loose):
                clouds = Clouds.of(block.section[loose], block.turns[loose], geometry, rule)
                anchors = (clouds if anchors is None else anchors.joined(clouds)).first(rule.n_anchors)
        if anchors is None:
            return
        sets = find_sets(anchors, geometry, rule)
        for block in point.blocks():
            loose = np.flatnonzero(block.is_bounded & (label[block.cells] == -1))
            if len(loose):
                clouds = Clouds.of(block.section[loose], block.turns[loose], geometry, rule)
                own = assign(clouds, sets, rule)
                cells = loose[own >= 0] + block.cells.start
                label[cells], decision[cells] = first + own[own >= 0], SAME_SET
        first += len(sets)


# ---- description -------------------------------------------------------------------------------


def _describe(
    point: Point,
    orbits: list[Orbit],
    label: np.ndarray,
    decision: np.ndarray,
    options: Options,
    geometry: Geometry,
) -> Found:
    """Features of all labels that have cells, and labels in canonical order."""
    cells: dict[int, Cells] = {}
    for block in point.blocks():
        own = label[block.cells]
        sides = feature.sides_of(block.section, block.turns, point.frequency, point.state_names)
        for number in np.unique(own[own >= 0]):
            found = cells.setdefault(int(number), Cells(options.n_points))
            found.add(block, np.flatnonzero(own == number), sides, geometry)
    features = {}
    for number, found in cells.items():
        orbit = orbits[number] if number < len(orbits) else None
        features[number] = _features(found, orbit, point, options, geometry)
    numbers = list(features)
    order = [numbers[i] for i in order_by_points([features[n].points for n in numbers], geometry)]
    ranked = [features[n] for n in order]
    feature.pair_mirrors(ranked, options.mirror_threshold, geometry)
    table = np.full(max(numbers, default=0) + 2, -1, np.int32)
    table[order] = np.arange(len(order))
    return Found(
        table[label],
        np.where(label >= 0, decision, UNDECIDED).astype(np.int8),
        ranked,
        [cells[n].n for n in order],
    )


def _features(
    cells: Cells, orbit: Orbit | None, point: Point, options: Options, geometry: Geometry
) -> Features:
    if orbit is None:
        assert cells.points is not None
        points = feature.sorted_points(cells.points, geometry)
    else:
        points = orbit.points
    found = Features(
        points, BOUNDED_SET if orbit is None else CLOSED_ORBIT, orbit.period if orbit else 0,
        cells.mean_rotation, cells.side, cells.low, cells.high,
    )  # fmt: skip
    if orbit is not None and orbit.is_polished:
        found.multipliers, found.residual, found.is_polished = orbit.multipliers, orbit.residual, True
        found.is_stable = int(orbit.is_stable)
        largest = max(float(np.abs(orbit.multipliers[0])), 1e-300)
        found.lyapunov_max = math.log(largest) * point.frequency / orbit.period
    if point.parameters is not None and options.polish:
        if found.is_polished:
            feature.follow_orbit(found, point.parameters, point.frequency, geometry)
            turns = np.round(found.rotation * found.orbit_period).astype(np.int64)
            found.side = int(
                feature.sides_of(points[None], turns[None], point.frequency, point.state_names)[0]
            )
        else:
            feature.follow_points(found, point.parameters, point.frequency)
    return found
