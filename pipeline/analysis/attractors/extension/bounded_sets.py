"""Describe non-periodic sets by the trajectories that stay on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.analysis.attractors.extension.clouds import OTHER, Cloud, is_stationary, mixing, thinned
from pipeline.analysis.attractors.extension.courses import Course
from pipeline.analysis.attractors.extension.growth import Growth, growth_of, kind_of
from pipeline.analysis.attractors.extension.tori import differs_in_phase
from pipeline.analysis.attractors.finding import stability
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.requests import LEG, Settings, Slopes, Work
from pipeline.analysis.tolerances import ROUGH_SLOPE_RTOL, SLOPE_RTOL
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, NEUTRAL, NOT_SETTLED, TORUS, TRANSIENT

SLOPES = (1024, 4096)
"""Most derivatives of the section map for the exponents of a set: at first, and if the first are too few."""

MOST_ASKED = 4
"""Most trajectories of a set whose neighbours show whether it is a torus or a family."""

MOST_SHAPED = 1024
"""Most section points that the test for a torus uses."""


@dataclass(frozen=True, eq=False)
class BoundedSet:
    """A non-periodic set: its kind (chaotic, torus or other bounded set), its stability and the evidence for it.

    Attributes
    ----------
    cells : ndarray of int64
        Sampled cells that are on it at the end.
    cloud : Cloud or None
        Section points to compare other cells with.
    points : ndarray, (n, state)
        Some of its section points.
    kind, stability, evidence : int
        Codes of `vocabulary.KINDS`, `STABILITIES` and `EVIDENCE`.
    growth : Growth or None
        None if there are not enough sections.
    n_sampled, n_left, n_leaving : int
        Numbers of cells that were extended, that left it, and that were near their end from the start.
    time_at_risk : float
        Sum over all sampled cells [drive periods or returns].
    ended : dict
        Numbers of cells that left it, by `Course.end`.
    closes_above : int
        Period with which it may close, longer than the search allows; 0 if none is seen.
    dimension : int
        Dimension of a torus; 0 of any other set.
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
    dimension: int = 0

    @classmethod
    def neutral(cls) -> BoundedSet:
        """Return the set that holds all cells of a volume-preserving flow; its stability is neutral."""
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
    for most in SLOPES if has_stayed else ():
        growth = yield from _growth(own, point, settings, most)
        if growth is None:
            break
        kind = kind_of(growth, thinned(pooled, MOST_SHAPED), settings.geometry)
        if kind != BOUNDED_SET or growth.contracts or growth.preserves_volume:
            break
    verdict, evidence = _verdict(left, growth, has_stayed)
    dimension = _dimension(growth, kind, point)
    in_phase, is_doubtful = None, growth is not None and growth.may_preserve_volume
    if verdict == ATTRACTS and _is_in_family(pooled, dimension, point, settings):
        # neighbours of one phase may come nearer for a while
        for course in own[:MOST_ASKED]:
            in_phase = yield from differs_in_phase(course, point, settings.geometry)
            if in_phase is not None:
                break
        is_doubtful |= in_phase is None
    if in_phase:
        kind = TORUS
    elif in_phase is not None:
        kind, verdict, evidence = BOUNDED_SET, NEUTRAL, stability.BY_MULTIPLIERS
    elif verdict == ATTRACTS and (is_doubtful or not _are_stationary(paths, settings)):
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
    )


def _are_stationary(paths: Sequence[np.ndarray], settings: Settings) -> bool:
    return all(is_stationary(path, settings.geometry, settings.closure) for path in paths)


def _dimension(growth: Growth | None, kind: int, point: Point) -> int:
    """Return the number of zero exponents of the flow, the phase of a drive included; 0 if it is not certain."""
    if growth is not None and growth.n_zero > 0:
        return growth.n_zero + 1 - point.n_neutral
    return 2 if kind == TORUS else 0


def _is_in_family(points: np.ndarray, dimension: int, point: Point, settings: Settings) -> bool:
    """Return whether the flow has more zero exponents than one trajectory with these section points fills."""
    if dimension < 2 or not (dimension > 2 or point.can_rest):
        return False
    if dimension > 2 or point.n_neutral:
        return True
    # at crossings a torus shows as a curve, and an orbit as a few points
    return len(np.unique(settings.geometry.boxes(points, 10.0 * settings.closure), axis=0)) <= 2 * settings.longest


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
    before, scales = paths[:, :-1].reshape(-1, n_states), np.asarray(settings.geometry.scales)
    for rtol in (ROUGH_SLOPE_RTOL, SLOPE_RTOL):
        after, slopes = yield Slopes(before, rtol)
        volumes = point.volumes(slopes, before, after).reshape(n_cells, n - 1)
        derivatives = slopes.reshape(n_cells, n - 1, n_states, n_states)
        whole = np.isfinite(derivatives).all(axis=(1, 2, 3))
        if not whole.any():
            return None
        growth = growth_of(derivatives[whole] * scales / scales[:, None], point.n_neutral, volumes[whole])
        if growth.is_clear:
            break
    return growth


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
