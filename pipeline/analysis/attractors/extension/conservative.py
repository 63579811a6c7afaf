"""Tell the sets of a system that preserves volume apart. None of them attracts.

Quantities of the model that stay constant along every cell keep cells apart: cells of different energy never meet. Of
one value of these quantities, a cell is chaotic if small distances grow along it. Chaotic cells are one set where their
section points mix. All other cells of one value share a row, although each is on an orbit or a torus of its own.
Trajectories that grow are on no set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magpend_core.pointwise import evaluate
from magpend_core.status import Status
from pipeline.analysis.attractors.extension.bounded_sets import BoundedSet, slopes_along
from pipeline.analysis.attractors.extension.clouds import Cloud, group, members
from pipeline.analysis.attractors.extension.courses import COURSE_GROWS, FAILED, ON_SET, Course
from pipeline.analysis.attractors.extension.extending import sample_cells
from pipeline.analysis.attractors.extension.growth import Escape, Growth, growth_of
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.requests import LEG, Leg, Settings, Work
from pipeline.layout.vocabulary import CHAOTIC_SET
from pipeline.results.tolerances import SLOPE_RTOL


def conservative_sets(
    point: Point, settings: Settings, budget: float, n_sample: int
) -> Work[tuple[list[BoundedSet], list[Course]]]:
    """Return the neutral sets of a parameter point, with all their cells, and the cells that were integrated further.

    Parameters
    ----------
    point
        Parameter point of a system that preserves volume.
    settings
        Tolerances and the integration.
    budget
        With 0 nothing is integrated, and no cell is shown to be chaotic.
    n_sample
        Number of cells in the first sample.
    """
    level = levels_of(point)
    courses, growths = (yield from _extended(point, settings, n_sample)) if budget > 0.0 else ([], [])
    chaotic = [(c, g) for c, g in zip(courses, growths, strict=True) if g is not None and g.is_chaotic]
    sets = []
    for k in np.unique(level[level >= 0]).tolist():
        own = [course for course, _ in chaotic if level[course.cell] == k]
        found = yield from _chaotic_sets(own, point, settings)
        cells = np.flatnonzero(level == k)
        on = np.full(len(cells), -1)
        if found:
            on = _members(point, cells, [one.cloud for one in found if one.cloud is not None])
            known = {int(c.cell) for c in courses}
            # a cell that was integrated further is where it was seen, not where its kept sections look like
            on = np.where([int(cell) in known for cell in cells], -1, on)
        taken = np.concatenate([np.zeros(0, np.int64), *(one.cells for one in found)])
        sets += [replace(one, cells=np.union1d(one.cells, cells[on == i])) for i, one in enumerate(found)]
        rest = np.setdiff1d(cells[on < 0], taken)
        if len(rest):
            sampled = [g for c, g in zip(courses, growths, strict=True) if g is not None and c.cell in rest]
            widest = max(sampled, key=lambda g: abs(g.rate), default=None)
            sets.append(replace(BoundedSet.neutral(), cells=rest, growth=widest, n_sampled=len(sampled)))
    return sets, courses


def levels_of(point: Point) -> np.ndarray:
    """Return for each cell a number that differs where a constant quantity of the model does; -1 for failed cells."""
    most_levels = 32  # most values of constant quantities whose cells get rows of their own
    seen = 16  # last kept sections of each cell at which quantities are compared
    level = np.full(point.n_cells, -1)
    names = [q.name for q in point.parameters.model.quantities] if point.parameters is not None else []
    values = np.full((point.n_cells, seen, len(names)), np.nan)
    for block in point.blocks():
        rows = np.flatnonzero(block.is_closed | block.is_bounded)
        level[rows + block.cells.start] = 0
        states = block.section[rows, -seen:]
        if names and len(rows):
            assert point.parameters is not None
            found = evaluate(names, 0.0, states.reshape(-1, states.shape[2]), point.parameters, point.frequency)
            values[rows + block.cells.start, : states.shape[1]] = found.reshape(*states.shape[:2], len(names))
    known = np.flatnonzero(level >= 0)
    for one in np.moveaxis(values[known], 2, 0):
        level[known] = _split(level[known], one)
    return level if level.max(initial=0) < most_levels else np.minimum(level, 0)


def _split(level: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Divide the levels of cells by a quantity (cell, section), if it is constant along each cell."""
    # least ratio of the range of a quantity over all cells to its largest range along one, if it is constant along
    # cells; and its least gap between cells of different values, in units of the latter
    apart = 100.0
    ranges = np.nanmax(values, axis=1) - np.nanmin(values, axis=1) if values.size else np.zeros(0)
    mean = np.nanmean(values, axis=1) if values.size else np.zeros(0)
    # the rounding of values is no difference
    within = max(float(ranges.max(initial=0.0)), 1e-12 * float(np.abs(mean).max(initial=0.0)))
    if not np.isfinite(within) or np.ptp(mean) < apart * within or within == 0.0 == np.ptp(mean):
        return level
    order = np.argsort(mean, kind="stable")
    number = np.empty(len(mean), np.int64)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(mean[order]) > apart * within)])
    return np.unique(np.stack([level, number]), axis=1, return_inverse=True)[1].reshape(-1)


def _extended(point: Point, settings: Settings, n_sample: int) -> Work[tuple[list[Course], list[Growth | None]]]:
    """Integrate samples of the cells further; return them with the growth of small distances along each, None if it is
    not known.
    """
    courses: list[Course] = []
    growths: list[Growth | None] = []
    for _ in range(settings.effort.rounds):
        left = max(settings.effort.least_budget // settings.effort.least_stay - len(courses), 0)
        known = np.array([course.key for course in courses], np.uint64)
        chosen = sample_cells(point, np.arange(point.n_cells), min(n_sample, left), settings, known) if left else []
        if not chosen:
            break
        yield from _advance(chosen, settings)
        for course in chosen:
            if course.goes_on and Escape.of(course.extension, settings.geometry) is not None:
                course.end = COURSE_GROWS
        courses += chosen
        growths += yield from _growths(chosen, point, settings)
        n_sample *= 2
    return courses, growths


def _advance(courses: Sequence[Course], settings: Settings) -> Work[None]:
    n = settings.effort.least_stay // LEG
    legs = yield Leg(np.array([c.state for c in courses]), np.array([c.step for c in courses]), n_legs=n)
    assert legs.step is not None
    assert legs.seconds is not None
    state, seconds = legs.state, legs.seconds.sum(axis=1)
    n_whole = np.isin(legs.status, (Status.PERIODIC, Status.BOUNDED)).reshape(-1, n).sum(axis=1)
    for i, (course, whole) in enumerate(zip(courses, n_whole.tolist(), strict=True)):
        own, last = slice(i * n, i * n + whole), i * n + max(whole - 1, 0)
        course.add(legs.section[own], seconds[own], state[last], float(legs.step[last]))
        course.end = ON_SET if whole == n else FAILED


def _growths(courses: Sequence[Course], point: Point, settings: Settings) -> Work[list[Growth | None]]:
    """Return the growth of small distances along each trajectory; None for those that failed or grow."""
    own = [course for course in courses if course.goes_on]
    if not own or settings.geometry.n_states == point.n_neutral:
        return [None] * len(courses)
    paths = np.stack([course.extension for course in own])
    derivatives, volumes = yield from slopes_along(paths, point, settings, SLOPE_RTOL)
    known = {
        course.cell: growth_of(derivatives[i : i + 1], point.n_neutral, volumes[i : i + 1])
        for i, course in enumerate(own)
        if np.isfinite(derivatives[i]).all()
    }
    return [known.get(course.cell) for course in courses]


def _chaotic_sets(own: Sequence[Course], point: Point, settings: Settings) -> Work[list[BoundedSet]]:
    """Return the sets of chaotic trajectories of one level: those whose section points mix are on one set."""
    if not own:
        return []
    number, _ = group([course.extension for course in own], settings.geometry, settings.closure)
    found = []
    for k in range(int(number.max()) + 1):
        mixed = [course for course, n in zip(own, number, strict=True) if n == k]
        paths = np.stack([course.extension for course in mixed])
        derivatives, volumes = yield from slopes_along(paths, point, settings, SLOPE_RTOL)
        found.append(
            replace(
                BoundedSet.neutral(),
                cells=np.array([course.cell for course in mixed], np.int64),
                cloud=Cloud.of(list(paths), settings.geometry, settings.closure),
                kind=CHAOTIC_SET,
                growth=growth_of(derivatives, point.n_neutral, volumes),
                n_sampled=len(mixed),
            )
        )
    return found


def _members(point: Point, cells: np.ndarray, clouds: Sequence[Cloud]) -> np.ndarray:
    """Return on which chaotic set the kept sections of each cell lie; -1 for none."""
    on = np.full(point.n_cells, -1)
    for block in point.blocks():
        rows = np.flatnonzero(block.is_bounded)
        on[rows + block.cells.start] = members(block.section[rows], clouds)
    return np.asarray(on[cells])
