"""Decide whether trajectories with several zero exponents lie on one torus that attracts, or in a neutral family.

Where the section map has more zero exponents than the closure of a trajectory has dimensions, neighbours keep their
distance: the trajectory is one of a family. On a torus the members of the family differ in phase alone, as those of
oscillators without coupling do: each runs through the same range of every state. In a conservative system, or beside
a state that is a parameter, they differ in amplitude, and none attracts.

Two trajectories are on one torus if the states between them end between them: images of a segment stay together if
it lies in one basin, since nothing grows, and are torn apart at the boundary of two basins.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import rates_at
from magpend_core.status import Status
from magpend_core.trajectory import trajectory
from pipeline.analysis.attractors.extension.courses import Course
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.requests import LEG, Leg, Work
from pipeline.analysis.sets import TWO_PI, Geometry
from pipeline.analysis.tolerances import PORTRAIT_RTOL

ASIDE, KEPT = 0.2, 0.25
"""Scaled distance at which neighbours start, and the share of it from which they have kept their distance."""

ALIKE = 0.2
"""Largest difference of the ranges of two trajectories that differ in phase alone, in units of `ASIDE`."""

LEGS = 8
"""Legs after which neighbours have approached the family: exponents that are not 0 are below -`GROWN` over them."""

SAMPLES, STRETCHES = 8192, (1, 4, 16)
"""States along each trajectory whose range is compared, per leg, and the legs until it is known."""

LINKS, HALVINGS, TOGETHER = 16, 6, 0.1
"""States on a segment, how often its widest gap is divided, and the share of the segment's length that remains."""


def differs_in_phase(course: Course, point: Point, geometry: Geometry) -> Work[bool | None]:
    """Return whether the neighbours of a trajectory that keep their distance run through the same ranges of states;
    None if all come nearer, one fails, or a range is not known.
    """
    assert point.parameters is not None
    aside = ASIDE * np.diag(geometry.scales)
    states, seconds = course.state + np.concatenate([np.zeros((1, len(aside))), aside]), 0.0
    for _ in range(LEGS):
        leg = yield from _leg(states)
        if leg is None:
            return None
        states, seconds = leg.state, float(leg.seconds[0].sum())
    away = geometry.difference(states[1:], states[0])
    if point.n_neutral:
        flow = rates_at(point.integrates, states[:1], point.packed)[0] / np.asarray(geometry.scales)
        away -= np.outer(away @ flow, flow) / max(float(flow @ flow), 1e-300)
    kept = np.flatnonzero(np.abs(away).max(axis=1) >= KEPT * ASIDE)
    if not len(kept):
        return None
    flow_of, rate = of_flow(point.parameters), LEG / seconds
    for n in STRETCHES:
        times = np.linspace(0.0, n * seconds, n * SAMPLES)
        paths = [
            trajectory(flow_of, rate, states[i], times, rtol=PORTRAIT_RTOL, atol=PORTRAIT_RTOL)
            for i in [0, *(kept + 1)]
        ]
        turns = np.asarray(geometry.is_angle) & (np.ptp(paths[0], axis=0) >= TWO_PI)
        first, *others = (_ranges(path, geometry)[:, ~turns] for path in paths)
        if max(np.abs(other - first).max(initial=0.0) for other in others) <= ALIKE * ASIDE:
            return True
        # a range that still grows shows no difference
        early, late = (_ranges(half, geometry)[:, ~turns] for half in np.array_split(paths[0], 2))
        if np.abs(late - early).max(initial=0.0) <= 0.5 * ALIKE * ASIDE:
            return False
    return None


def _ranges(path: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the least and the largest value of each state along a trajectory, in units of the scales."""
    return np.asarray(np.stack([path.min(axis=0), path.max(axis=0)]) / np.asarray(geometry.scales))


def is_one_torus(a: Course, b: Course, geometry: Geometry) -> Work[bool]:
    """Return whether the states between two trajectories, on one torus or on two, end between them."""
    near = np.argmin(geometry.distance(b.extension, a.state))
    start, step = a.state, geometry.difference(b.extension[near], a.state) * np.asarray(geometry.scales)
    along = np.linspace(0.0, 1.0, LINKS + 1)
    length = float(np.abs(step / np.asarray(geometry.scales)).max())
    for _ in range(HALVINGS):
        leg = yield from _leg(start + along[:, None] * step)
        for _ in range(LEGS - 1):
            leg = (yield from _leg(leg.state)) if leg is not None else None
        if leg is None:
            return False
        gaps = geometry.distance(leg.state[1:], leg.state[:-1])
        widest = int(np.argmax(gaps))
        if gaps[widest] <= TOGETHER * length:
            return True
        along = np.linspace(along[widest], along[widest + 1], LINKS + 1)
    return False


def _leg(states: np.ndarray) -> Work[Any]:
    """Integrate states over a leg; return its `Block`, None if one of them does not return."""
    leg = yield Leg(states, np.zeros(len(states)))
    return leg if np.isin(leg.status, (Status.PERIODIC, Status.BOUNDED)).all() else None
