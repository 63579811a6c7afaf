"""Describe non-periodic sets by the trajectories that stay on them.

Tori
----
Where the section map has more zero exponents than the closure of a trajectory has dimensions, neighbours keep their
distance: the trajectory is one of a family. On a torus the members of the family differ in phase alone, as those of
oscillators without coupling do: each runs through the same range of every state. In a conservative system, or beside
a state that is a parameter, they differ in amplitude, and none attracts.

Two trajectories are on one torus if the states between them end between them: images of a segment stay together if
it lies in one basin, since nothing grows, and are torn apart at the boundary of two basins.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import rates_at
from magpend_core.precision import tolerances_at
from magpend_core.status import Status
from magpend_core.trajectory import trajectory
from pipeline.analysis.attractors.extension.clouds import OTHER, Cloud, is_stationary, mixing, thinned
from pipeline.analysis.attractors.extension.courses import Course
from pipeline.analysis.attractors.extension.curves import Curve
from pipeline.analysis.attractors.extension.growth import Growth, growth_of, kind_of
from pipeline.analysis.attractors.finding import stability
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.requests import LEG, Leg, Settings, Slopes, Work
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, NEUTRAL, NOT_SETTLED, TORUS, TRANSIENT
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import PORTRAIT_RTOL, ROUGH_SLOPE_RTOL, SLOPE_RTOL


@dataclass(frozen=True, eq=False)
class BoundedSet:
    """A non-periodic set: its kind (chaotic, torus or other bounded set), its stability and the evidence for it."""

    cells: np.ndarray  # sampled cells that are on it at the end
    cloud: Cloud | None  # section points to compare other cells with
    points: np.ndarray  # (n, state): some of its section points
    # codes of `vocabulary.KINDS`, `STABILITIES` and `EVIDENCE`
    kind: int
    stability: int
    evidence: int
    growth: Growth | None  # None if there are not enough sections
    # numbers of cells that were extended, that left it, and that were near their end from the start
    n_sampled: int
    n_left: int
    n_leaving: int
    time_at_risk: float  # sum over all sampled cells [drive periods or returns]
    ended: dict[int, int]  # numbers of cells that left it, by `Course.end`
    closes_above: int = 0  # period with which it may close, longer than the search allows; 0 if none is seen
    dimension: int = 0  # dimension of a torus; 0 of any other set
    curve: Curve | None = None  # on which the section points of a torus of two frequencies lie; None if none is seen

    @property
    def is_regular(self) -> bool:
        """Whether volumes shrink, and small distances neither grow nor shrink beyond doubt: the set may be a torus."""
        return self.growth is not None and self.growth.may_be_torus

    @classmethod
    def neutral(cls) -> BoundedSet:
        """Return a set of a volume-preserving flow without its cells; its stability is neutral."""
        none = np.zeros(0, np.int64)
        evidence = stability.BY_VOLUME
        return cls(none, None, none, BOUNDED_SET, NEUTRAL, evidence, None, 0, 0, 0, 0.0, {})


def describe(
    own: Sequence[Course], left: Sequence[Course], point: Point, settings: Settings, has_stayed: bool
) -> Work[BoundedSet]:
    """Return the kind, stability and lifetimes of a non-periodic set, from the trajectories that stayed on it and those
    that left it.

    Parameters
    ----------
    own
        Cells on the set.
    left
        Cells that left it.
    point
        Parameter point of the cells.
    settings
        Tolerances and the integration.
    has_stayed
        Whether the cells stayed long enough for a verdict.
    """
    paths = [course.stayed for course in own]
    pooled = np.concatenate(paths)
    growth, kind = None, BOUNDED_SET
    for most in settings.effort.slopes if has_stayed else ():
        growth = yield from _growth(own, point, settings, most)
        if growth is None:
            break
        kind = kind_of(growth, thinned(pooled, settings.effort.shaped), settings.geometry)
        if kind != BOUNDED_SET or growth.contracts or growth.preserves_volume:
            break
    verdict, evidence = _verdict(left, growth, has_stayed)
    curve = _curve_of(paths, growth, settings)
    kind = kind if curve is None else TORUS
    dimension = _dimension(growth, kind, point)
    in_phase, is_doubtful = None, growth is not None and growth.may_preserve_volume
    if verdict == ATTRACTS and _is_in_family(pooled, dimension, point, settings):
        # neighbours of one phase may come nearer for a while
        for course in own[: settings.effort.asked]:
            in_phase = yield from differs_in_phase(course, point, settings.geometry)
            if in_phase is not None:
                break
        is_doubtful |= in_phase is None
    if in_phase:
        kind = TORUS
    elif in_phase is not None:
        kind, verdict, evidence = BOUNDED_SET, NEUTRAL, stability.BY_MULTIPLIERS
    elif verdict == ATTRACTS and (is_doubtful or not (curve or _are_stationary(paths, settings))):
        verdict, evidence = NOT_SETTLED, stability.BY_NOTHING
    return BoundedSet(
        np.array([c.cell for c in own], np.int64),
        Cloud.of(paths, settings.geometry, settings.closure),
        pooled,
        kind,
        verdict,
        evidence,
        growth,
        len(own) + len(left),
        len(left),
        0,
        float(sum(c.length for c in own) + sum(c.periods for c in left)),
        ends_of(left),
        _closes_above(own, growth, settings),
        dimension if kind == TORUS else 0,
        curve,
    )


def _curve_of(paths: Sequence[np.ndarray], growth: Growth | None, settings: Settings) -> Curve | None:
    """Return the closed curve on which all section points of a dissipative set lie; None if there is none."""
    if growth is None or not growth.may_be_torus:
        return None
    curve = Curve.fitted(paths[0], settings.geometry)
    return curve if curve is not None and all(curve.holds(path, settings.geometry) for path in paths) else None


def lie_on(curve: Curve | None, own: Sequence[Course], geometry: Geometry) -> bool:
    """Return whether the section points of trajectories lie on a curve, and run round it as the curve's own do."""
    return curve is not None and all(curve.holds(course.stayed, geometry) for course in own)


def _are_stationary(paths: Sequence[np.ndarray], settings: Settings) -> bool:
    return all(is_stationary(path, settings.geometry, settings.closure) for path in paths)


def _dimension(growth: Growth | None, kind: int, point: Point) -> int:
    """Return the number of zero exponents of the flow, the phase of a drive included; 0 if it is not certain."""
    if growth is not None and growth.n_zero > 0:
        return growth.n_zero + 1 - point.n_neutral
    return 2 if kind == TORUS else 0


def _is_in_family(points: np.ndarray, dimension: int, point: Point, settings: Settings) -> bool:
    """Return whether the flow has more zero exponents than one trajectory with these section points fills."""
    if dimension != 2 or point.n_neutral:
        return dimension >= 2
    # on a section a torus shows as a curve, and an orbit as a few points
    boxes = np.unique(settings.geometry.boxes(points, 10.0 * settings.closure), axis=0)
    return len(boxes) <= 2 * settings.longest


def left_behind(left: Sequence[Course], settings: Settings) -> BoundedSet:
    """Describe a transient set that every sampled trajectory has left, from the section points before they left it."""
    paths = [course.stayed for course in left]
    return BoundedSet(
        np.zeros(0, np.int64),
        Cloud.of(paths, settings.geometry, settings.closure),
        np.concatenate(paths),
        BOUNDED_SET,
        TRANSIENT,
        stability.BY_LEAVING,
        None,
        len(left),
        len(left),
        0,
        float(sum(course.periods for course in left)),
        ends_of(left),
    )


def ends_of(left: Iterable[Course]) -> dict[int, int]:
    """Count how many trajectories ended on each orbit, at each equilibrium, or by each kind of failure."""
    ended: dict[int, int] = {}
    for course in left:
        ended[course.end] = ended.get(course.end, 0) + 1
    return ended


def were_on(course: Course, own: Sequence[Course], settings: Settings) -> bool:
    """Return whether a trajectory that has left a set was on the same set as the trajectories `own`."""
    points = np.concatenate([other.stayed for other in own])
    return bool(mixing(course.stayed, points, settings.geometry, settings.closure, OTHER) >= OTHER)


def _verdict(left: Sequence[Course], growth: Growth | None, has_stayed: bool) -> tuple[int, int]:
    if growth is not None and growth.preserves_volume:
        return NEUTRAL, stability.BY_VOLUME
    if left:
        return TRANSIENT, stability.BY_LEAVING
    if not has_stayed or growth is None or growth.contracts:
        return NOT_SETTLED, stability.BY_NOTHING
    return ATTRACTS, stability.BY_STAYING


def _growth(own: Sequence[Course], point: Point, settings: Settings, most: int) -> Work[Growth | None]:
    """Compute the Lyapunov exponents of the section map along trajectories of a set; None if there are too few section
    points, or if the flow has one state and no direction beside its own.
    """
    n, n_states = min(course.length for course in own), settings.geometry.n_states
    if n < LEG or n_states == point.n_neutral:
        return None
    most = min(most, max(256, 20_000_000 // n_states**2))
    n_cells = max(1, min(len(own), most // min(n, most)))
    n = min(n, most // n_cells)
    # use the last sections, when transients are over
    paths = np.stack([course.extension[-n:] for course in own[:n_cells]])
    for rtol in (ROUGH_SLOPE_RTOL, SLOPE_RTOL):
        derivatives, volumes = yield from slopes_along(paths, point, settings, rtol)
        whole = np.isfinite(derivatives).all(axis=(1, 2, 3))
        if not whole.any():
            return None
        growth = growth_of(derivatives[whole], point.n_neutral, volumes[whole])
        if growth.is_clear:
            break
    return growth


def slopes_along(
    paths: np.ndarray, point: Point, settings: Settings, rtol: float
) -> Work[tuple[np.ndarray, np.ndarray]]:
    """Compute the scaled derivatives of the section map along trajectories, shape (cell, section, state, state), and
    the logarithms of its changes of volume (cell, section).
    """
    n_cells, n, n_states = paths.shape
    before, scales = paths[:, :-1].reshape(-1, n_states), np.asarray(settings.geometry.scales)
    after, slopes = yield Slopes(before, rtol)
    volumes = point.volumes(slopes, before, after).reshape(n_cells, n - 1)
    return (slopes * scales / scales[:, None]).reshape(n_cells, n - 1, n_states, n_states), volumes


def _closes_above(own: Sequence[Course], growth: Growth | None, settings: Settings) -> int:
    """Return an orbit period above the longest one searched for, if the trajectories close with it; 0 if they do
    not.
    """
    if growth is None or not growth.contracts:
        return 0
    path = min((c.extension for c in own), key=len)
    for p in range(settings.longest + 1, len(path) // 2):
        if (settings.geometry.distance(path[-p:], path[-2 * p : -p]) <= 100.0 * settings.closure).all():
            return p
    return 0


def differs_in_phase(course: Course, point: Point, geometry: Geometry) -> Work[bool | None]:
    """Return whether the neighbours of a trajectory that keep their distance run through the same ranges of states;
    None if all come nearer, one fails, or a range is not known.
    """
    # scaled distance at which neighbours start, the share of it from which they have kept their distance, and the
    # largest difference of the ranges of two trajectories that differ in phase alone, in units of it
    size, share, alike = 0.2, 0.25, 0.2
    legs = 8  # after which neighbours have approached the family: exponents that are not 0 are below -`GROWN` over them
    # states along each trajectory whose range is compared, per leg, and the legs until it is known
    samples, stretches = 8192, (1, 4, 16)
    assert point.parameters is not None
    aside = size * np.diag(geometry.scales)
    leg = yield from _last_leg(course.state + np.concatenate([np.zeros((1, len(aside))), aside]), legs)
    if leg is None:
        return None
    states, seconds = leg.state, float(leg.seconds[0].sum())
    away = geometry.difference(states[1:], states[0])
    if point.n_neutral:
        flow = rates_at(point.integrates, states[:1], point.packed)[0] / np.asarray(geometry.scales)
        away -= np.outer(away @ flow, flow) / max(float(flow @ flow), 1e-300)
    kept = np.flatnonzero(np.abs(away).max(axis=1) >= share * size)
    if not len(kept):
        return None
    flow_of, rate = of_flow(point.parameters), LEG / seconds
    for n in stretches:
        times = point.parameters.model.clock.instants(n * seconds, n * samples)
        paths = [trajectory(flow_of, rate, states[i], times, **tolerances_at(PORTRAIT_RTOL)) for i in [0, *(kept + 1)]]
        turns = np.asarray(geometry.is_angle) & (np.ptp(paths[0], axis=0) >= TWO_PI)
        first, *others = (_ranges(path, geometry)[:, ~turns] for path in paths)
        if max(np.abs(other - first).max(initial=0.0) for other in others) <= alike * size:
            return True
        # a range that still grows shows no difference
        early, late = (_ranges(half, geometry)[:, ~turns] for half in np.array_split(paths[0], 2))
        if np.abs(late - early).max(initial=0.0) <= 0.5 * alike * size:
            return False
    return None


def _ranges(path: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the least and the largest value of each state along a trajectory, in units of the scales."""
    return np.asarray(np.stack([path.min(axis=0), path.max(axis=0)]) / np.asarray(geometry.scales))


def is_one_torus(a: Course, b: Course, geometry: Geometry) -> Work[bool]:
    """Return whether the states between two trajectories, on one torus or on two, end between them."""
    legs = 8  # after which neighbours have approached the family: exponents that are not 0 are below -`GROWN` over them
    # states on a segment, how often its widest gap is divided, and the share of the segment's length that remains
    links, halvings, together = 16, 6, 0.1
    near = np.argmin(geometry.distance(b.extension, a.state))
    start, step = a.state, geometry.difference(b.extension[near], a.state) * np.asarray(geometry.scales)
    along = np.linspace(0.0, 1.0, links + 1)
    length = float(np.abs(step / np.asarray(geometry.scales)).max())
    for _ in range(halvings):
        leg = yield from _last_leg(start + along[:, None] * step, legs)
        if leg is None:
            return False
        gaps = geometry.distance(leg.state[1:], leg.state[:-1])
        widest = int(np.argmax(gaps))
        if gaps[widest] <= together * length:
            return True
        along = np.linspace(along[widest], along[widest + 1], links + 1)
    return False


def _last_leg(states: np.ndarray, n: int) -> Work[Any]:
    """Integrate states over `n` legs; return the `Block` of the last leg, None if one of them does not return."""
    legs = yield Leg(states, np.zeros(len(states)), n_legs=n)
    return legs.take(slice(n - 1, None, n)) if np.isin(legs.status, (Status.PERIODIC, Status.BOUNDED)).all() else None
