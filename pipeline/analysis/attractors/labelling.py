"""Assign the cells (trajectories) of parameter points to attractors and other sets, and describe these sets.

`analyse` does for all points together what most of them need. Only points with cells on no known orbit, or with
degenerate orbits, go on one by one: each is a generator (`Work`), and all of them advance in step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from magpend_core.orbits import orbit_exponents
from pipeline.analysis.attractors import features as feature
from pipeline.analysis.attractors.extension.bounded_sets import BoundedSet
from pipeline.analysis.attractors.extension.clouds import members
from pipeline.analysis.attractors.extension.conservative import conservative_sets
from pipeline.analysis.attractors.extension.courses import AT_REST as RESTS
from pipeline.analysis.attractors.extension.courses import COURSE_DIVERGED, COURSE_GROWS, ON_SET, Course, rest_number
from pipeline.analysis.attractors.extension.extending import extend
from pipeline.analysis.attractors.extension.growth import Escape
from pipeline.analysis.attractors.features import Cells, Features
from pipeline.analysis.attractors.finding import stability
from pipeline.analysis.attractors.finding.cell_blocks import Block, first_of_each
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct, raw_orbit
from pipeline.analysis.attractors.finding.equilibria import put_at_rest
from pipeline.analysis.attractors.finding.limit_cycles import number_among
from pipeline.analysis.attractors.finding.points import Point, Slab
from pipeline.analysis.attractors.finding.probing import is_approaching, probe_equilibrium, probe_orbit
from pipeline.analysis.attractors.finding.requests import Work, answer_all, map_slopes
from pipeline.analysis.attractors.finding.searching import Search, State, search_orbits
from pipeline.analysis.attractors.finding.spirals import keys_of
from pipeline.layout.vocabulary import (
    APPROACHING,
    AT_REST,
    ATTRACTS,
    BOUNDED_SET,
    CLOSED,
    DIVERGES,
    EXTENDED,
    GROWS,
    NEUTRAL,
    NOT_SETTLED,
    PERIODIC_ORBIT,
    SAME_SET,
    UNDECIDED,
)
from pipeline.results.intervals import lifetime_interval
from pipeline.results.sets import Geometry, hashes, looked_up, order_by_points, rows_by_number
from pipeline.results.tolerances import PRESERVED_VOLUME, VOLUME_RTOL

ENDLESS = (DIVERGES, GROWS)
"""Decisions on cells that end on no set."""


@dataclass
class Found:
    """Result of `analyse` at one parameter point: the sets on which its cells end, and the set of each cell."""

    label: np.ndarray  # int32, (cell,): index into `features`, -1 for none
    decision: np.ndarray  # int8, (cell,): codes of `vocabulary.DECISIONS`
    features: list[Features]  # features of each set
    counts: list[int]  # number of cells on each set
    ran_out: bool = False  # whether the budget of the extension ended before all cells were decided
    # of the cells that grow: relative growth of the distance from where they began at the end [1/s], its factor, and
    # the number of sections; NaN and 0 if there are none
    growth_rate: float = np.nan
    growth_factor: float = np.nan
    growth_length: int = 0


@dataclass
class _Ends:
    """Sets on which the cells of one parameter point end. They are numbered: orbits, other sets, equilibria, limit
    cycles.
    """

    label: np.ndarray  # (cell,): number of the set on which each cell ends, -1 for none
    decision: np.ndarray  # (cell,): evidence for this assignment
    group: np.ndarray  # (cell,): group of a closed (periodic) cell on no known orbit, -1 for all other cells
    orbits: list[Orbit]
    sets: list[BoundedSet] = field(default_factory=list)
    courses: list[Course] = field(default_factory=list)  # cells that were integrated further
    ran_out: bool = False

    @property
    def neutral(self) -> list[int]:
        """Numbers of the polished orbits whose stability the multipliers do not decide."""
        return [i for i, one in enumerate(self.orbits) if one.is_polished and one.stability == NEUTRAL]

    def put(self, cells: np.ndarray, number: int | np.ndarray, decision: int) -> None:
        self.label[cells], self.decision[cells] = number, decision


def analyse(slab: Slab, search: Search) -> dict[tuple[int, ...], Found]:
    """Find the sets on which the cells of parameter points end, with their kind, stability and evidence."""
    keeps = _preserve_volume(slab, search) if search.options.polish else np.zeros(len(slab), bool)
    ends: dict[tuple[int, ...], _Ends] = {}
    works: dict[tuple[int, ...], Work[None]] = {}
    rest = slab.only(~keeps)
    if rest:
        state = search_orbits(rest, search)
        known, is_open = _label_orbits(rest, state, search)
        ends = dict(zip(rest, known, strict=True))
        works = {i: _settle(rest[i], ends[i], state, search) for i, own in zip(rest, is_open, strict=True) if own}
    for index, point in slab.items():
        if index not in ends:
            none = np.full(point.n_cells, -1)
            ends[index] = _Ends(none, np.zeros(point.n_cells, np.int8), none.copy(), [])
            works[index] = _conservative(point, ends[index], search)
    if works:
        answer_all(works, slab, search.settings)
    return _describe(slab, {index: ends[index] for index in slab}, search)


def _settle(point: Point, ends: _Ends, state: State, search: Search) -> Work[None]:
    """Find the sets on which the cells of a parameter point end that are on no known orbit."""
    options = search.options
    if options.polish:
        yield from _probe(point, ends, search)
    budget = options.budget if options.extend and options.polish else 0.0
    # cells on a neutral orbit of an autonomous flow, around which there may be a torus
    in_family = np.isin(ends.label, ends.neutral) & point.can_rest
    loose = np.where(point.is_elsewhere, 0, np.where(in_family, -1, ends.label))
    found = yield from extend(point, ends.orbits, loose, search.settings, budget, options.n_sample)
    ends.orbits, ends.courses, ends.ran_out = found.orbits, found.courses, found.ran_out
    ends.sets = _with_families(found.sets, in_family, ends)
    _label_courses(point, ends, search)
    raw = _label_raw(point, ends, state, search)
    ends.orbits = [*ends.orbits, *raw]
    _label_sets(point, ends, search)
    _assert_distinct(point, ends.orbits, search.geometry)


def follow(found: Mapping[tuple[int, ...], Found], points: Mapping[tuple[int, ...], Point], search: Search) -> None:
    """Add the features of all orbits that need their motion over the whole period, and pair mirror images."""
    orbits = [
        (x, point.parameters, point.frequency)
        for one, point in zip(found.values(), (points[index] for index in found), strict=True)
        for x in one.features
        if x.is_polished and x.orbit_period and point.parameters is not None
    ]
    returns = search.dynamics.has_returns
    clocks = [x.orbit_period / x.period_s if returns else frequency for x, _, frequency in orbits]
    feature.follow_orbits([(x, p, clock) for (x, p, _), clock in zip(orbits, clocks, strict=True)], search.geometry)
    for x, parameters, frequency in orbits:
        turns = np.round(x.rotation * x.orbit_period).astype(np.int64)
        x.side = int(feature.sides_of(x.points[None], turns[None], frequency, parameters)[0])
    model = search.dynamics.model
    if model is not None and model.mirror is not None:
        for one in found.values():
            feature.pair_mirrors(one.features, model.mirror, search.options.mirror_threshold, search.geometry)


# ---- conservative systems ----------------------------------------------------------------------


def _preserve_volume(slab: Slab, search: Search) -> np.ndarray:
    """Return for each parameter point whether the flow (or its section map) preserves volumes, tested at a sample of
    section points.
    """
    points, keeps = slab.points, np.zeros(len(slab), bool)
    if search.dynamics.can_rest and search.geometry.n_states == 1:
        return keeps  # a flow that returns to its only state's level: all starts are on one orbit, no volume beside it
    states, owner = _some_states(slab, search.geometry)
    is_first = np.append(True, np.diff(owner) > 0)[: len(owner)]
    keeps[owner] = True
    # the first state alone shows most points that do not
    for which in (is_first, ~is_first):
        rows = np.flatnonzero(which & keeps[owner])
        # integrate anew: the run's own next section has the error of the run's tolerance
        after, derivatives = map_slopes(states[rows], owner[rows], points, search.settings, VOLUME_RTOL)
        finite = np.isfinite(derivatives).all(axis=(1, 2))
        keeps[owner[rows[~finite]]] = False
        by_point = rows_by_number(np.where(finite, owner[rows], -1))
        if search.dynamics.integrates.section is None:  # without the rates at the points' parameters
            by_point = {0: np.flatnonzero(finite)}
        for k, own in by_point.items():
            volumes = points[k].volumes(derivatives[own], states[rows[own]], after[own])
            keeps[owner[rows[own[np.abs(volumes) > PRESERVED_VOLUME]]]] = False
    return keeps


def _some_states(slab: Slab, geometry: Geometry, n: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Return the last section points (n, state) of `n` cells of each parameter point, and the number of the point of
    each; the choice of cells is reproducible.
    """
    states, owner = np.zeros((0, geometry.n_states)), np.zeros(0, np.int64)
    for block in slab.blocks():
        own = block.is_closed | block.is_bounded
        states = np.concatenate([states, block.section[own, -1]])
        owner = np.concatenate([owner, block.owner[own]])
        marks = hashes(states)
        order = np.lexsort((marks, owner))
        new = np.append(True, (np.diff(marks[order]) != 0) | (np.diff(owner[order]) != 0))[: len(order)]
        least = first_of_each(order[new], owner, n)
        states, owner = states[least], owner[least]
    return states, owner


def _conservative(point: Point, ends: _Ends, search: Search) -> Work[None]:
    options = search.options
    budget = options.budget if options.extend else 0.0
    ends.sets, ends.courses = yield from conservative_sets(point, search.settings, budget, options.n_sample)
    for i, one in enumerate(ends.sets):
        ends.put(one.cells, i, SAME_SET)
    for course in ends.courses:
        if course.end == COURSE_GROWS:
            ends.put(np.array([course.cell]), -1, GROWS)


def _fill_growth(result: Found, courses: Sequence[Course], point: Point, search: Search) -> None:
    """Describe the growth of the cells that grow, by the median over those that were integrated further."""
    growing = [course for course in courses if course.end == COURSE_GROWS]
    known = [(Escape.of(course.extension, search.geometry), course) for course in growing]
    rates = [
        (one.rate * (course.length / course.seconds if course.seconds else point.frequency), one.factor, one.length)
        for one, course in known
        if one is not None
    ]
    if rates:
        result.growth_rate, result.growth_factor, length = np.median(rates, axis=0).tolist()
        result.growth_length = int(length)


# ---- labels ------------------------------------------------------------------------------------


def _label_orbits(slab: Slab, state: State, search: Search) -> tuple[list[_Ends], np.ndarray]:
    """Label the cells on known orbits. Return the labels of each parameter point, and whether there are cells on no
    known orbit, or orbits or equilibria of undecided stability.
    """
    n, points = slab.n_cells, slab.points
    label, decision, group = np.full(n, -1), np.zeros(n, np.int8), np.full(n, -1)
    is_open = np.zeros(len(points), bool)
    for block in slab.blocks():
        label[block.cells], decision[block.cells] = state.decide(block, search)
        if search.is_loose:
            _label_ends(block, state.ends, label[block.cells], decision[block.cells])
        left = np.flatnonzero((block.is_closed | block.is_bounded) & (label[block.cells] < 0))
        is_open[block.owner[left]] = True
        if not search.is_loose:
            group[left + block.cells.start] = state.closed.group_of(block.take(left), state.keys, state.group)
    labels, decisions, groups = (np.split(x, len(points)) for x in (label, decision, group))
    ends = [_Ends(*own) for own in zip(labels, decisions, groups, state.orbits, strict=True)]
    degenerate = [bool(one.neutral or _degenerate(point)) for one, point in zip(ends, points, strict=True)]
    return ends, is_open | np.array(degenerate)


def _degenerate(point: Point) -> list[int]:
    return [k for k, one in enumerate(point.equilibria) if one.stability == NEUTRAL]


def _probe(point: Point, ends: _Ends, search: Search) -> Work[None]:
    most = 8  # degenerate orbits, and most degenerate equilibria, of a point that are probed by trajectories
    for i in ends.neutral[:most]:
        within = yield from probe_orbit(ends.orbits[i], search.geometry)
        if within:
            ends.orbits[i] = replace(ends.orbits[i], approached_within=within)
            for block in point.blocks():
                rows = np.flatnonzero((block.is_closed | block.is_bounded) & (ends.label[block.cells] < 0))
                near = is_approaching(block.section[rows], ends.orbits[i], search.geometry)
                ends.put(rows[near] + block.cells.start, i, APPROACHING)
    for k in _degenerate(point)[:most]:
        point.equilibria[k] = yield from probe_equilibrium(point.equilibria[k], search.geometry)
    if any(one.approached_within for one in point.equilibria):
        put_at_rest(point, search.geometry)


def _with_families(sets: Sequence[BoundedSet], in_family: np.ndarray, ends: _Ends) -> list[BoundedSet]:
    """Give the cells on neutral orbits to the tori on which these orbits lie; drop all other sets around the orbits."""
    found = []
    for one in sets:
        own = in_family[one.cells]
        is_torus = one.dimension > 0 and one.stability == ATTRACTS
        if own.any() and is_torus:
            cells = np.flatnonzero(np.isin(ends.label, ends.label[one.cells[own]]))
            one = replace(one, cells=np.union1d(one.cells, cells))
            ends.put(cells, -1, UNDECIDED)
        if is_torus or not len(own) or not own.all():
            found.append(one)
    return found


def _label_courses(point: Point, ends: _Ends, search: Search) -> None:
    """Label cells by the end of a similar cell that was integrated further. Cells are similar if they share a box or a
    group of section points.
    """
    ended = [course for course in ends.courses if not course.goes_on and not course.is_neighbour]
    if not ended:
        return
    by_key = {course.key: course.end for course in ended}
    by_group = {int(ends.group[course.cell]): course.end for course in ended if ends.group[course.cell] >= 0}
    elsewhere = point.is_elsewhere
    for block in point.blocks():
        rows = np.flatnonzero((block.is_closed | block.is_bounded) & (ends.label[block.cells] < 0))
        cells = rows + block.cells.start
        rows, cells = rows[~elsewhere[cells]], cells[~elsewhere[cells]]
        keys = keys_of(block.section[rows], search.settings.closure, search.geometry)
        end = looked_up(by_key, keys, looked_up(by_group, ends.group[cells], ON_SET))
        ends.put(cells[end >= 0], end[end >= 0], EXTENDED)
        ends.decision[cells[end == COURSE_DIVERGED]] = DIVERGES
        ends.decision[cells[end == COURSE_GROWS]] = GROWS
        if point.at_rest is not None:
            rests = end <= RESTS
            point.at_rest[cells[rests]] = RESTS - end[rests]


def _label_raw(point: Point, ends: _Ends, state: State, search: Search) -> list[Orbit]:
    """Label the closed (periodic) cells that are on no refined orbit, and return an unrefined orbit for each group of
    them.

    After a search by Newton's method there may be no orbit: beside the ghost of a fold, cells move too slowly to see.
    """
    left = np.where((ends.label < 0) & ~np.isin(ends.decision, ENDLESS) & ~point.is_elsewhere, ends.group, -1)
    if left.max(initial=-1) < 0:
        return []
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    for block in point.blocks():
        _representatives(block, left[block.cells], best, search.geometry)
    rows = rows_by_number(left)
    for i, g in enumerate(sorted(best)):
        ends.put(rows[g], len(ends.orbits) + i, SAME_SET if search.options.polish else CLOSED)
    return [raw_orbit(best[g][2], search.geometry, _failure(state, g)) for g in sorted(best)]


def _failure(state: State, group: int) -> int:
    """Return the `Status` with which Newton's method ended for the boxes of a group; 0 if it was not tried there."""
    ended = [state.unpolished.get(key, 0) for key in state.keys[state.group == group].tolist()]
    return max(ended, default=0)


def _label_sets(point: Point, ends: _Ends, search: Search) -> None:
    """Label the cells on each non-periodic set: the sampled cells by which it was found, and all cells whose section
    points lie on it.
    """
    first = len(ends.orbits)
    for i, one in enumerate(ends.sets):
        ends.put(one.cells[ends.label[one.cells] < 0], first + i, SAME_SET)
    if not ends.sets:
        return
    clouds, elsewhere = [one.cloud for one in ends.sets if one.cloud is not None], point.is_elsewhere
    for block in point.blocks():
        free = (ends.label[block.cells] < 0) & ~np.isin(ends.decision[block.cells], ENDLESS)
        rows = np.flatnonzero(block.is_bounded & free & ~elsewhere[block.cells])
        own = members(block.section[rows], clouds)
        ends.put(rows[own >= 0] + block.cells.start, first + own[own >= 0], SAME_SET)


def _label_ends(block: Block, ends: Sequence[Mapping[int, int]], label: np.ndarray, decision: np.ndarray) -> None:
    """Label each closed (periodic) cell whose orbit was found by a longer integration; change `label` and `decision` in
    place.
    """
    for k, rest in rows_by_number(np.where(block.is_closed & (label < 0), block.owner, -1)).items():
        end = looked_up(ends[k], block.marks[rest], -1)
        label[rest[end >= 0]], decision[rest[end >= 0]] = end[end >= 0], EXTENDED


def _representatives(
    block: Block, group: np.ndarray, best: dict[int, tuple[float, int, np.ndarray]], geometry: Geometry
) -> None:
    """Find one representative cell for each group of closed (periodic) cells: the cell whose orbit closes most
    exactly.
    """
    rows = np.flatnonzero(group >= 0)
    last, n = block.section[rows, -1], block.section.shape[1]
    periods = np.minimum(block.orbit_period[rows], n)
    back = block.section[rows, np.where(n > periods, n - 1 - periods, n - 1)]
    away, marks = geometry.distance(last, back), block.marks[rows]
    order = np.lexsort((marks, away, group[rows]))
    for i in order[np.unique(group[rows][order], return_index=True)[1]]:
        g, entry = int(group[rows[i]]), (float(away[i]), int(marks[i]), block.section[rows[i], -periods[i] :])
        if g not in best or entry[:2] < best[g][:2]:
            best[g] = entry


# ---- description -------------------------------------------------------------------------------


def _describe(slab: Slab, ends: Mapping[tuple[int, ...], _Ends], search: Search) -> dict[tuple[int, ...], Found]:
    """Compute the features of all sets that have cells, and renumber the sets of each parameter point in canonical
    order.
    """
    features: dict[tuple[int, ...], dict[int, Features]] = {}
    for index, one in ends.items():
        _label_elsewhere(slab[index], one)
        features[index] = _features_of(slab[index], one, search)
    sets = [(index, number) for index, own in features.items() for number in own]
    points = [features[index][number].points for index, number in sets]
    owner = np.repeat(range(len(ends)), [len(own) for own in features.values()])
    ranked: dict[tuple[int, ...], dict[int, Features]] = {index: {} for index in ends}
    for k in order_by_points(points, search.geometry, owner):
        index, number = sets[k]
        ranked[index][number] = features[index][number]
    return {index: _renumbered(slab[index], one, ranked[index], search) for index, one in ends.items()}


def _renumbered(point: Point, ends: _Ends, features: Mapping[int, Features], search: Search) -> Found:
    """Return the sets of a parameter point in the order of `features`, which has the features of each set by number."""
    order = list(features)
    table = np.full(max(order, default=0) + 2, -1, np.int32)
    table[order] = np.arange(len(order))
    _number_ends(features, ends, table)
    decided = (ends.label >= 0) | np.isin(ends.decision, ENDLESS)
    decision = np.where(decided, ends.decision, UNDECIDED).astype(np.int8)
    counts = np.bincount(ends.label + 1, minlength=len(table))[1:]
    result = Found(table[ends.label], decision, list(features.values()), counts[order].tolist(), ends.ran_out)
    _fill_growth(result, ends.courses, point, search)
    return result


def _assert_distinct(point: Point, orbits: Sequence[Orbit], geometry: Geometry) -> None:
    """Raise AssertionError if two polished orbits or two limit cycles, which get an id each, are one."""
    polished = [orbit for orbit in orbits if orbit.is_polished]
    assert len(distinct(polished, geometry)) == len(polished), "two ids of one orbit"
    for k, cycle in enumerate(point.cycles):
        # from later cycles to this one: the search went from earlier ones
        later = point.cycles[k + 1 :]
        assert number_among(cycle, later, point, geometry) == len(later), "two ids of one limit cycle"


def _label_elsewhere(point: Point, ends: _Ends) -> None:
    first = len(ends.orbits) + len(ends.sets)
    for told, known, code in ((point.at_rest, point.equilibria, AT_REST), (point.on_cycle, point.cycles, CLOSED)):
        if told is not None:
            own = told >= 0
            ends.put(own, first + told[own], code)
        first += len(known)


def _number_ends(features: Mapping[int, Features], ends: _Ends, table: np.ndarray) -> None:
    """Count where the trajectories that left each transient set ended; store the counts in the set's feature `n_to`."""
    for k, one in enumerate(ends.sets, len(ends.orbits)):
        if k not in features:
            continue
        ended = np.zeros(len(features), np.int64)
        for end, n in one.ended.items():
            rest = rest_number(end)
            at = end if end >= 0 else -1 if rest is None else len(ends.orbits) + len(ends.sets) + rest
            if 0 <= at < len(table) and table[at] >= 0:
                ended[table[at]] += n
        features[k].n_to = ended


def _features_of(point: Point, ends: _Ends, search: Search) -> dict[int, Features]:
    """Return the features of all sets with cells by number."""
    found: dict[int, Features] = {}
    orbits, resting = len(ends.orbits), len(ends.orbits) + len(ends.sets)
    cycles = resting + len(point.equilibria)
    numbers = np.unique(ends.label[ends.label >= 0]).tolist()
    # `follow` integrates polished orbits, and equilibria are no sections: both need no statistics of cells
    followed = [n for n in numbers if n < orbits and ends.orbits[n].is_polished and point.parameters is not None]
    rests = [n for n in numbers if resting <= n < cycles]
    cells = _statistics(point, ends.label, np.setdiff1d(numbers, [*followed, *rests]), search)
    for n in numbers:
        if n < orbits:
            found[n] = _of_orbit(cells.get(n), ends.orbits[n], point, search)
        elif n < resting:
            found[n] = _of_set(cells[n], ends.sets[n - orbits], point, search)
        elif n < cycles:
            found[n] = feature.of_equilibrium(point.equilibria[n - resting], point.parameters, point.n_angles)
        else:
            found[n] = _of_points(cells[n], BOUNDED_SET, point, search)
            feature.fill_cycle(found[n], point.cycles[n - cycles])
    return found


def _statistics(point: Point, label: np.ndarray, numbers: np.ndarray, search: Search) -> dict[int, Cells]:
    """Return the statistics of the cells on some sets by number."""
    found = {n: Cells(search.options.n_points) for n in numbers.tolist()}
    for block in point.blocks() if found else ():
        own = label[block.cells]
        for number, rows in rows_by_number(np.where(np.isin(own, numbers), own, -1)).items():
            found[number].add(block.take(rows), point, search.geometry)
    return found


def _of_points(cells: Cells, kind: int, point: Point, search: Search) -> Features:
    assert cells.points is not None
    points = feature.sorted_points(cells.points, search.geometry)
    found = Features(points, kind, 0)
    cells.fill(found, point)
    if point.parameters is not None and search.options.polish:
        feature.follow_points(found, point.parameters, point.frequency)
    return found


def _of_set(cells: Cells, one: BoundedSet, point: Point, search: Search) -> Features:
    found = _of_points(cells, one.kind, point, search)
    found.stability, found.evidence = one.stability, one.evidence
    found.closes_above, found.dimension = one.closes_above, one.dimension
    found.n_sampled, found.n_left, found.n_leaving = one.n_sampled, one.n_left, one.n_leaving
    if one.time_at_risk > 0.0:
        found.time_at_risk = one.time_at_risk
        found.mean_lifetime = one.time_at_risk / one.n_left if one.n_left else np.nan
        found.lifetime_low, found.lifetime_high = lifetime_interval(
            one.n_left, one.time_at_risk, search.options.lifetime_confidence
        )
    if one.growth is not None:
        # at crossings the section map lacks the exponent along the flow, which is 0
        rates = np.array([one.growth.rate, one.growth.low, one.growth.high]) / cells.mean_seconds
        rates = np.maximum(rates, 0.0) if point.has_returns else rates
        found.lyapunov_max, found.lyapunov_low, found.lyapunov_high = rates.tolist()
    return found


def _of_orbit(cells: Cells | None, orbit: Orbit, point: Point, search: Search) -> Features:
    is_shown = orbit.is_polished or not search.options.polish
    found = Features(orbit.points, PERIODIC_ORBIT, orbit.period) if is_shown else Features(orbit.points, BOUNDED_SET, 0)
    found.stability, found.evidence = orbit.stability, stability.by_failure(orbit.failed)
    if cells is not None:
        cells.fill(found, point)
    if orbit.is_polished:
        _fill_orbit(found, orbit, search.dynamics.has_returns)
    elif point.parameters is not None and search.options.polish:
        feature.follow_points(found, point.parameters, point.frequency)
    return found


def _fill_orbit(found: Features, orbit: Orbit, has_returns: bool) -> None:
    # largest excess of a multiplier over 1 that rounding errors leave to an orbit which trajectories approach; and
    # largest error of a multiplier with which one on the unit circle says that an orbit is neutral
    above, telling = 0.01, 0.1
    found.multipliers, found.residual, found.is_polished = orbit.multipliers, orbit.residual, True
    found.multiplier_error = orbit.multiplier_error
    modulus = float(np.abs(orbit.multipliers).max())
    if orbit.is_stable and modulus > 1.0 + above:
        raise AssertionError(
            f"an orbit with a multiplier of modulus {modulus:g} is said to attract: a fault of magpend."
        )
    found.evidence = stability.BY_APPROACH if orbit.approached_within else stability.BY_MULTIPLIERS
    if found.stability == NEUTRAL and orbit.multiplier_error > telling:
        found.stability, found.evidence = NOT_SETTLED, stability.BY_NOTHING
    exponents = orbit_exponents(orbit.multipliers, orbit.seconds, has_returns)
    found.lyapunov_max = found.lyapunov_low = found.lyapunov_high = float(exponents[0])
    found.period_s = orbit.seconds
    # round to whole turns per period: the mean over cells has not closed to the last digit
    found.rotation = np.round(found.rotation * orbit.period) / orbit.period + 0.0  # no -0.0
