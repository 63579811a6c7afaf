"""Cells labelled with what the search found, and attractors described."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from magpend_core.multipliers import orbit_exponents
from pipeline.analysis.attractors import features as feature
from pipeline.analysis.attractors.bounded import Clouds, assign, find_sets
from pipeline.analysis.attractors.cells import Block, marks_of
from pipeline.analysis.attractors.deciding import AT_REST, CLOSED, RUN_ON, SAME_SET, UNDECIDED, decide
from pipeline.analysis.attractors.features import Cells, Features
from pipeline.analysis.attractors.orbits import Orbit, raw_orbit
from pipeline.analysis.attractors.points import Point
from pipeline.analysis.attractors.searching import Search, State
from pipeline.analysis.attractors.spirals import Recurrence, keys_of
from pipeline.analysis.sets import Geometry, order_by_points
from pipeline.analysis.sides import UNKNOWN
from pipeline.layout.vocabulary import BOUNDED_SET, CLOSED_ORBIT

UNSETTLED = -2
"""Label of spirals that were not run on, until the sets are told."""


@dataclass
class Found:
    """Attractors of one parameter point."""

    label: np.ndarray
    decision: np.ndarray
    features: list[Features]
    counts: list[int]


def conclude(point: Point, state: State, search: Search) -> Found:
    """Label all cells, and describe what they are labelled with."""
    label = np.full(point.n_cells, -1, np.int64)
    decision = np.zeros(point.n_cells, np.int8)
    raw: dict[int, tuple[float, int, np.ndarray]] = {}
    left = np.full(point.n_cells, -1, np.int64)
    for block in point.blocks():
        label[block.cells], decision[block.cells] = decide(
            block, state.orbits, search.tolerance, search.geometry
        )
        _label_spirals(block, state.spirals, label, decision, search)
        if search.is_loose:
            _label_ends(block, state.ends, label, decision)
            continue
        own = state.closed.group_of(block, state.keys, state.group)
        own[label[block.cells] >= 0] = -1
        left[block.cells] = own
        _representatives(block, own, raw, search.geometry)
    numbers = {g: len(state.orbits) + i for i, g in enumerate(sorted(raw))}
    for g, number in numbers.items():
        label[left == g] = number
    decision[left >= 0] = CLOSED
    orbits = [*state.orbits, *(raw_orbit(raw[g][2], search.geometry) for g in sorted(raw))]
    _label_sets(point, len(orbits), label, decision, search)
    label[label == UNSETTLED] = -1
    resting = first = int(label.max(initial=-1)) + 1
    for told, known, code in (
        (point.at_rest, point.equilibria, AT_REST), (point.on_cycle, point.cycles, CLOSED),
    ):  # fmt: skip
        if told is not None:
            own = told >= 0
            label[own], decision[own] = first + told[own], code
            first += len(known)
    return _describe(point, orbits, resting, label, decision, search)


def _label_spirals(
    block: Block, spirals: Mapping[int, int], label: np.ndarray, decision: np.ndarray, search: Search,
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
    is_near = Recurrence.of(section, search.options.max_orbit_period, search.geometry).is_near
    keys = keys_of(section, search.tolerance, search.geometry)
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


def _label_sets(point: Point, first: int, label: np.ndarray, decision: np.ndarray, search: Search) -> None:
    """Label the bounded cells that no orbit accounts for, in place, from number `first` on."""
    rule = search.rule
    for _ in range(rule.n_rounds):
        anchors: Clouds | None = None
        for block in point.blocks():
            loose = np.flatnonzero(block.is_bounded & (label[block.cells] == -1))
            if len(loose):
                clouds = Clouds.of(block.section[loose], block.turns[loose], search.geometry, rule)
                anchors = (clouds if anchors is None else anchors.joined(clouds)).first(rule.n_anchors)
        if anchors is None:
            return
        sets = find_sets(anchors, search.geometry, rule)
        for block in point.blocks():
            loose = np.flatnonzero(block.is_bounded & (label[block.cells] == -1))
            if len(loose):
                clouds = Clouds.of(block.section[loose], block.turns[loose], search.geometry, rule)
                own = assign(clouds, sets, rule)
                cells = loose[own >= 0] + block.cells.start
                label[cells], decision[cells] = first + own[own >= 0], SAME_SET
        first += len(sets)


# ---- description -------------------------------------------------------------------------------


def _describe(
    point: Point,
    orbits: list[Orbit],
    resting: int,
    label: np.ndarray,
    decision: np.ndarray,
    search: Search,
) -> Found:
    """Features of all labels that have cells, and labels in canonical order.

    From `resting` on they are equilibria, and then limit cycles seen at even times.
    """
    cells: dict[int, Cells] = {}
    for block in point.blocks():
        own = label[block.cells]
        sides = feature.sides_of(block.section, block.turns, point.frequency, point.parameters)
        for number in np.unique(own[own >= 0]):
            found = cells.setdefault(int(number), Cells(search.options.n_points))
            found.add(block, np.flatnonzero(own == number), sides, search.geometry)
    features = {}
    for number, found in cells.items():
        told = number - resting
        if 0 <= told < len(point.equilibria):
            rest = point.equilibria[told]
            features[number] = feature.of_equilibrium(rest, point.parameters, point.n_angles)
            continue
        orbit = orbits[number] if number < len(orbits) else None
        features[number] = _features(found, orbit, point, search)
        if told >= 0:
            feature.fill_cycle(features[number], point.cycles[told - len(point.equilibria)])
    numbers = list(features)
    order = [numbers[i] for i in order_by_points([features[n].points for n in numbers], search.geometry)]
    ranked = [features[n] for n in order]
    model = search.dynamics.model
    if model is not None and model.mirror is not None:
        feature.pair_mirrors(ranked, model.mirror, search.options.mirror_threshold, search.geometry)
    table = np.full(max(numbers, default=0) + 2, -1, np.int32)
    table[order] = np.arange(len(order))
    return Found(
        table[label],
        np.where(label >= 0, decision, UNDECIDED).astype(np.int8),
        ranked,
        [cells[n].n for n in order],
    )


def _features(cells: Cells, orbit: Orbit | None, point: Point, search: Search) -> Features:
    if orbit is None:
        assert cells.points is not None
        points = feature.sorted_points(cells.points, search.geometry)
    else:
        points = orbit.points
    found = Features(
        points, BOUNDED_SET if orbit is None else CLOSED_ORBIT, orbit.period if orbit else 0,
        cells.mean_rotation, UNKNOWN, cells.low, cells.high,
    )  # fmt: skip
    if point.parameters is not None:
        found.side = cells.side(point.parameters, point.frequency)
    frequency = point.frequency
    if orbit is not None and orbit.is_polished:
        is_flow = search.dynamics.is_flow
        frequency = orbit.period / orbit.seconds if is_flow else frequency
        _fill_orbit(found, orbit, is_flow)
    if point.parameters is None or not search.options.polish:
        return found
    if found.is_polished:
        feature.follow_orbit(found, point.parameters, frequency, search.geometry)
        turns = np.round(found.rotation * found.orbit_period).astype(np.int64)
        found.side = int(feature.sides_of(points[None], turns[None], point.frequency, point.parameters)[0])
    else:
        feature.follow_points(found, point.parameters, point.frequency)
    return found


def _fill_orbit(found: Features, orbit: Orbit, is_flow: bool) -> None:
    found.multipliers, found.residual, found.is_polished = orbit.multipliers, orbit.residual, True
    found.is_stable = int(orbit.is_stable)
    found.lyapunov_max = float(orbit_exponents(orbit.multipliers, orbit.seconds, is_flow)[0])
    found.period_s = orbit.seconds
    # whole turns over its period: the cells' mean has not closed to the last digit
    found.rotation = np.round(found.rotation * orbit.period) / orbit.period + 0.0  # no -0.0
