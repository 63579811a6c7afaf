"""Assign the cells (trajectories) of one parameter point to attractors and other sets, and describe these sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magpend_core.orbits import orbit_exponents
from pipeline.analysis.attractors import features as feature
from pipeline.analysis.attractors.extension.bounded_sets import BoundedSet
from pipeline.analysis.attractors.extension.clouds import members
from pipeline.analysis.attractors.extension.conservative import conservative_sets
from pipeline.analysis.attractors.extension.courses import AT_REST as RESTS
from pipeline.analysis.attractors.extension.courses import COURSE_DIVERGED, COURSE_GROWS, ON_SET, Course, rest_number
from pipeline.analysis.attractors.extension.extending import Outcome, extend
from pipeline.analysis.attractors.extension.growth import Escape
from pipeline.analysis.attractors.features import Cells, Features
from pipeline.analysis.attractors.finding import stability
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block, marks_of
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct, raw_orbit
from pipeline.analysis.attractors.finding.equilibria import put_at_rest
from pipeline.analysis.attractors.finding.limit_cycles import number_among
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.probing import is_approaching, probe_equilibrium, probe_orbit
from pipeline.analysis.attractors.finding.requests import Slopes, Work
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
from pipeline.results.sets import Geometry, looked_up, order_by_points, rows_by_number
from pipeline.results.sides import UNKNOWN
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
class _Labels:
    """Number of the set on which each cell of one parameter point ends, and the evidence for this assignment
    (`decision`).
    """

    label: np.ndarray
    decision: np.ndarray

    @classmethod
    def of(cls, n_cells: int) -> _Labels:
        return cls(np.full(n_cells, -1, np.int64), np.zeros(n_cells, np.int8))

    def put(self, cells: np.ndarray, number: int | np.ndarray, decision: int) -> None:
        self.label[cells], self.decision[cells] = number, decision


def analyse(point: Point, search: Search) -> Work[Found]:
    """Find the sets on which the cells of a parameter point end, with their kind, stability and evidence."""
    labels = _Labels.of(point.n_cells)
    if search.options.polish and (yield from _preserves_volume(point, search)):
        return (yield from _conservative(point, labels, search))
    state = yield from search_orbits(point, search)
    groups = _label_orbits(point, state, labels, search)
    if search.options.polish:
        yield from _probe(point, state, labels, search)
    options = search.options
    budget = options.budget if options.extend and options.polish else 0.0
    in_family = _in_families(point, state.orbits, labels)
    loose = np.where(_is_elsewhere(point), 0, np.where(in_family, -1, labels.label))
    found = yield from extend(point, state.orbits, loose, search.settings, budget, options.n_sample)
    state.orbits = found.orbits
    found.sets = _with_families(found.sets, in_family, labels)
    _label_courses(point, found, labels, groups, search)
    raw = _label_raw(point, state, groups, labels, search)
    _label_sets(point, len(state.orbits) + len(raw), found.sets, labels, groups, search)
    result = _describe(point, [*state.orbits, *raw], found.sets, labels, search)
    result.ran_out = found.ran_out
    _fill_growth(result, found.courses, point, search)
    return result


def _is_elsewhere(point: Point) -> np.ndarray:
    """Return which cells are at an equilibrium, or on a limit cycle of a flow sampled at equal times."""
    found = np.zeros(point.n_cells, bool)
    for told in (point.at_rest, point.on_cycle):
        if told is not None:
            found |= told >= 0
    return found


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


def _preserves_volume(point: Point, search: Search) -> Work[bool]:
    """Return whether the flow (or its section map) preserves volumes, tested at a sample of points."""
    if point.can_rest and point.n_states == 1:
        return False  # a flow that returns to its only state's level: all starts are on one orbit, no volume beside it
    points = _some_points(point)
    # the first point alone shows most systems that do not
    for before in (points[:1], points[1:]):
        if not len(before):
            return bool(len(points))
        # integrate anew: the run's own next section has the error of the run's tolerance
        after, derivatives = yield Slopes(before, VOLUME_RTOL)
        if not np.isfinite(derivatives).all():
            return False
        if not (np.abs(point.volumes(derivatives, before, after)) <= PRESERVED_VOLUME).all():
            return False
    return True


def _some_points(point: Point, n: int = 16) -> np.ndarray:
    """Return the last section points of `n` cells, shape (n, state); the choice of cells is reproducible."""
    found = np.zeros((0, 1, point.n_states))
    for block in point.blocks():
        more = np.concatenate([found, block.section[block.is_closed | block.is_bounded, -1:]])
        found = more[np.unique(marks_of(more), return_index=True)[1][:n]]
    return found[:, 0]


def _conservative(point: Point, labels: _Labels, search: Search) -> Work[Found]:
    options = search.options
    budget = options.budget if options.extend else 0.0
    sets, courses = yield from conservative_sets(point, search.settings, budget, options.n_sample)
    for i, one in enumerate(sets):
        labels.put(one.cells, i, SAME_SET)
    for course in courses:
        if course.end == COURSE_GROWS:
            labels.put(np.array([course.cell]), -1, GROWS)
    result = _describe(point, [], sets, labels, search)
    _fill_growth(result, courses, point, search)
    return result


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


def _label_orbits(point: Point, state: State, labels: _Labels, search: Search) -> np.ndarray:
    """Label the cells on known orbits. Return the group number of each other cell that has closed on a periodic orbit,
    and -1 for the rest.
    """
    groups = np.full(point.n_cells, -1, np.int64)
    for block in point.blocks():
        own = block.cells
        labels.label[own], labels.decision[own] = decide(block, state.orbits, search.tolerance, search.geometry)
        if search.is_loose:
            _label_ends(block, state.ends, labels.label, labels.decision)
            continue
        group = state.closed.group_of(block, state.keys, state.group)
        groups[own] = np.where(labels.label[own] >= 0, -1, group)
    return groups


def _probe(point: Point, state: State, labels: _Labels, search: Search) -> Work[None]:
    most = 8  # degenerate orbits, and most degenerate equilibria, of a point that are probed by trajectories
    neutral = [i for i, orbit in enumerate(state.orbits) if orbit.is_polished and orbit.stability == NEUTRAL]
    for i in neutral[:most]:
        within = yield from probe_orbit(state.orbits[i], search.geometry)
        if within:
            state.orbits[i] = replace(state.orbits[i], approached_within=within)
            for block in point.blocks():
                rows = np.flatnonzero((block.is_closed | block.is_bounded) & (labels.label[block.cells] < 0))
                near = is_approaching(block.section[rows], state.orbits[i], search.geometry)
                labels.put(rows[near] + block.cells.start, i, APPROACHING)
    degenerate = [k for k, one in enumerate(point.equilibria) if one.stability == NEUTRAL]
    for k in degenerate[:most]:
        point.equilibria[k] = yield from probe_equilibrium(point.equilibria[k], search.geometry)
    if any(one.approached_within for one in point.equilibria):
        put_at_rest(point, search.geometry)


def _in_families(point: Point, orbits: Sequence[Orbit], labels: _Labels) -> np.ndarray:
    """Return which cells lie on a neutral orbit of an autonomous flow, around which there may be a torus."""
    neutral = [i for i, orbit in enumerate(orbits) if orbit.is_polished and orbit.stability == NEUTRAL]
    return np.isin(labels.label, neutral) & point.can_rest


def _with_families(sets: Sequence[BoundedSet], in_family: np.ndarray, labels: _Labels) -> list[BoundedSet]:
    """Give the cells on neutral orbits to the tori on which these orbits lie; drop all other sets around the orbits."""
    found = []
    for one in sets:
        own = in_family[one.cells]
        is_torus = one.dimension > 0 and one.stability == ATTRACTS
        if own.any() and is_torus:
            cells = np.flatnonzero(np.isin(labels.label, labels.label[one.cells[own]]))
            one = replace(one, cells=np.union1d(one.cells, cells))
            labels.put(cells, -1, UNDECIDED)
        if is_torus or not len(own) or not own.all():
            found.append(one)
    return found


def _label_courses(point: Point, found: Outcome, labels: _Labels, groups: np.ndarray, search: Search) -> None:
    """Label cells by the end of a similar cell that was integrated further. Cells are similar if they share a box or a
    group of section points.
    """
    ended = [course for course in found.courses if not course.goes_on and not course.is_neighbour]
    if not ended:
        return
    ends = {course.key: course.end for course in ended}
    by_group = {int(groups[course.cell]): course.end for course in ended if groups[course.cell] >= 0}
    elsewhere = _is_elsewhere(point)
    for block in point.blocks():
        rows = np.flatnonzero((block.is_closed | block.is_bounded) & (labels.label[block.cells] < 0))
        cells = rows + block.cells.start
        rows, cells = rows[~elsewhere[cells]], cells[~elsewhere[cells]]
        keys = keys_of(block.section[rows], search.settings.closure, search.geometry)
        end = looked_up(ends, keys, looked_up(by_group, groups[cells], ON_SET))
        labels.put(cells[end >= 0], end[end >= 0], EXTENDED)
        labels.decision[cells[end == COURSE_DIVERGED]] = DIVERGES
        labels.decision[cells[end == COURSE_GROWS]] = GROWS
        if point.at_rest is not None:
            rests = end <= RESTS
            point.at_rest[cells[rests]] = RESTS - end[rests]


def _label_raw(point: Point, state: State, groups: np.ndarray, labels: _Labels, search: Search) -> list[Orbit]:
    """Label the closed (periodic) cells that are on no refined orbit, and return an unrefined orbit for each group of
    them.

    After a search by Newton's method there may be no orbit: beside the ghost of a fold, cells move too slowly to see.
    """
    left = np.where((labels.label < 0) & ~np.isin(labels.decision, ENDLESS) & ~_is_elsewhere(point), groups, -1)
    if left.max(initial=-1) < 0:
        return []
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    for block in point.blocks():
        _representatives(block, left[block.cells], best, search.geometry)
    rows = rows_by_number(left)
    for i, g in enumerate(sorted(best)):
        labels.put(rows[g], len(state.orbits) + i, SAME_SET if search.options.polish else CLOSED)
    return [raw_orbit(best[g][2], search.geometry, _failure(point, state, g)) for g in sorted(best)]


def _failure(point: Point, state: State, group: int) -> int:
    """Return the `Status` with which Newton's method ended for the boxes of a group; 0 if it was not tried there."""
    ended = [point.unpolished.get(key, 0) for key in state.keys[state.group == group].tolist()]
    return max(ended, default=0)


def _label_sets(
    point: Point, first: int, sets: Sequence[BoundedSet], labels: _Labels, groups: np.ndarray, search: Search
) -> None:
    """Label the cells on each non-periodic set: the sampled cells by which it was found, and all cells whose section
    points lie on it.
    """
    for i, one in enumerate(sets):
        own = one.cells[labels.label[one.cells] < 0]
        labels.put(own, first + i, SAME_SET)
    if not sets:
        return
    clouds, elsewhere = [one.cloud for one in sets if one.cloud is not None], _is_elsewhere(point)
    for block in point.blocks():
        free = (labels.label[block.cells] < 0) & ~np.isin(labels.decision[block.cells], ENDLESS)
        rows = np.flatnonzero(block.is_bounded & free & ~elsewhere[block.cells])
        own = members(block.section[rows], clouds)
        labels.put(rows[own >= 0] + block.cells.start, first + own[own >= 0], SAME_SET)


def _label_ends(block: Block, ends: Mapping[int, int], label: np.ndarray, decision: np.ndarray) -> None:
    """Label each closed (periodic) cell whose orbit was found by a longer integration; change `label` and `decision` in
    place.
    """
    rest = np.flatnonzero(block.is_closed & (label[block.cells] < 0))
    end = looked_up(ends, block.marks[rest], -1)
    own = rest[end >= 0] + block.cells.start
    label[own], decision[own] = end[end >= 0], EXTENDED


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


def _describe(
    point: Point, orbits: Sequence[Orbit], sets: Sequence[BoundedSet], labels: _Labels, search: Search
) -> Found:
    """Compute the features of all sets that have cells, and renumber the sets in canonical order."""
    resting = len(orbits) + len(sets)
    _assert_distinct(point, orbits, search.geometry)
    _label_elsewhere(point, resting, labels)
    cells: dict[int, Cells] = {}
    for block in point.blocks():
        own = labels.label[block.cells]
        sides = feature.sides_of(block.section, block.turns, point.frequency, point.parameters)
        for number, rows in rows_by_number(own).items():
            found = cells.setdefault(number, Cells(search.options.n_points))
            found.add(block, rows, sides, search.geometry)
    features = {n: _features_of(n, found, orbits, sets, point, search) for n, found in cells.items()}
    numbers = list(features)
    order = [numbers[i] for i in order_by_points([features[n].points for n in numbers], search.geometry)]
    ranked = [features[n] for n in order]
    table = np.full(max(numbers, default=0) + 2, -1, np.int32)
    table[order] = np.arange(len(order))
    _number_ends(ranked, order, sets, len(orbits), resting, table)
    decided = (labels.label >= 0) | np.isin(labels.decision, ENDLESS)
    return Found(
        table[labels.label],
        np.where(decided, labels.decision, UNDECIDED).astype(np.int8),
        ranked,
        [cells[n].n for n in order],
    )


def _assert_distinct(point: Point, orbits: Sequence[Orbit], geometry: Geometry) -> None:
    """Raise AssertionError if two polished orbits or two limit cycles, which get an id each, are one."""
    polished = [orbit for orbit in orbits if orbit.is_polished]
    assert len(distinct(polished, geometry)) == len(polished), "two ids of one orbit"
    for k, cycle in enumerate(point.cycles):
        # from later cycles to this one: the search went from earlier ones
        later = point.cycles[k + 1 :]
        assert number_among(cycle, later, point, geometry) == len(later), "two ids of one limit cycle"


def _label_elsewhere(point: Point, first: int, labels: _Labels) -> None:
    for told, known, code in ((point.at_rest, point.equilibria, AT_REST), (point.on_cycle, point.cycles, CLOSED)):
        if told is not None:
            own = told >= 0
            labels.put(own, first + told[own], code)
        first += len(known)


def _number_ends(
    ranked: Sequence[Features],
    order: Sequence[int],
    sets: Sequence[BoundedSet],
    first: int,
    resting: int,
    table: np.ndarray,
) -> None:
    """Count where the trajectories that left each transient set ended; store the counts in the set's feature `n_to`."""
    for features, number in zip(ranked, order, strict=True):
        if first <= number < resting:
            ended = np.zeros(len(order), np.int64)
            for end, n in sets[number - first].ended.items():
                rest = rest_number(end)
                at = end if end >= 0 else -1 if rest is None else resting + rest
                if 0 <= at < len(table) and table[at] >= 0:
                    ended[table[at]] += n
            features.n_to = ended


def _features_of(
    number: int, cells: Cells, orbits: Sequence[Orbit], sets: Sequence[BoundedSet], point: Point, search: Search
) -> Features:
    resting = len(orbits) + len(sets)
    if number < len(orbits):
        return _of_orbit(cells, orbits[number], point, search)
    if number < resting:
        return _of_set(cells, sets[number - len(orbits)], point, search)
    told = number - resting
    if told < len(point.equilibria):
        return feature.of_equilibrium(point.equilibria[told], point.parameters, point.n_angles)
    found = _of_points(cells, BOUNDED_SET, 0, point, search)
    feature.fill_cycle(found, point.cycles[told - len(point.equilibria)])
    return found


def _of_points(cells: Cells, kind: int, period: int, point: Point, search: Search) -> Features:
    assert cells.points is not None
    points = feature.sorted_points(cells.points, search.geometry)
    found = Features(points, kind, period, cells.mean_rotation, UNKNOWN, cells.low, cells.high)
    if point.parameters is not None:
        found.side = cells.side(point.parameters, point.frequency)
        if search.options.polish:
            feature.follow_points(found, point.parameters, point.frequency)
    return found


def _of_set(cells: Cells, one: BoundedSet, point: Point, search: Search) -> Features:
    found = _of_points(cells, one.kind, 0, point, search)
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


def _of_orbit(cells: Cells, orbit: Orbit, point: Point, search: Search) -> Features:
    is_shown = orbit.is_polished or not search.options.polish
    found = Features(
        orbit.points,
        PERIODIC_ORBIT if is_shown else BOUNDED_SET,
        orbit.period if is_shown else 0,
        cells.mean_rotation,
        UNKNOWN,
        cells.low,
        cells.high,
        stability=orbit.stability,
        evidence=stability.by_failure(orbit.failed),
    )
    if point.parameters is not None:
        found.side = cells.side(point.parameters, point.frequency)
    if orbit.is_polished:
        _fill_orbit(found, orbit, search.dynamics.has_returns)
    if point.parameters is None or not search.options.polish:
        return found
    if not found.is_polished:
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
