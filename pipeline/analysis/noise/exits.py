"""Find when noisy cells leave: for another class of motion, by their sections, or a box or a ball, in every step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.passage import Region
from magpend_core.models.model import Model
from magpend_core.models.text.scene import MIXED
from magpend_core.noisy import cell_words, first_passages, noisy_sections
from magpend_core.status import Status
from pipeline.analysis.noise.declaration import EscapeOptions
from pipeline.layout.cells import CellMap, parameter_axes
from pipeline.layout.vocabulary import FREQUENCY_DIM, parameters_of, split_dims
from pipeline.motion.noisy import Noisy
from pipeline.motion.steady import Inputs
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun

NOT_LEFT = -1

Labels = Callable[[np.ndarray, Mapping[str, float]], np.ndarray]
"""From sections (cell, section, state) and the values of a point to codes: 0 or more in a set, below 0 undecided."""


@dataclass(frozen=True)
class Exits:
    """Exits of the cells of a parameter point, seen in intervals of time of equal length."""

    counted: np.ndarray  # bool, (cell,): cells that are in a set at the first counted section
    begin: np.ndarray  # int, (cell,): code of the set in which a cell begins
    # int, (cell,): number of the first section after the exit, counted from the first counted one; `NOT_LEFT`
    first_out: np.ndarray
    # int, (cell,): code of the set to which a cell goes; `NOT_LEFT` where a cell did not leave, or diverged
    end: np.ndarray
    place: np.ndarray  # (cell, state): state after the exit; NaN if there is none
    at_risk: np.ndarray  # int, (cell,): intervals at whose begin a cell was in its set
    n_intervals: int  # intervals in the record
    interval: float  # length of an interval [s]


def find_exits(codes: np.ndarray, cells: PointCells, skip: int, n_transient: int, period: float) -> Exits:
    """Find the first section at which each cell is in another set than at the first.

    Parameters
    ----------
    codes
        Code of the set at each section, shape (cell, section); negative ones decide nothing.
    cells
        The cells; those that diverged leave in the period in which they did.
    skip, n_transient
        Sections that are not counted, and periods before the first section.
    period
        Time between sections [s].
    """
    seen = codes[:, skip:]
    begin = seen[:, 0]
    outside = (seen != begin[:, None]) & (seen >= 0)
    left = outside.any(axis=1)
    rows, first = np.arange(len(seen)), outside.argmax(axis=1)
    first_out = np.where(left, first, NOT_LEFT)
    end = np.where(left, seen[rows, first], NOT_LEFT)
    place = np.where(left[:, None], cells.section[rows, skip + first], np.nan)
    counted = begin >= 0
    gone = cells.status == Status.DIVERGED
    when = cells.n_periods - n_transient - 1 - skip
    # a diverged cell has no sections: it was inside as long as it was there
    first_out = np.where(gone, when, first_out)
    counted = np.where(gone, when > 0, counted & (cells.status == Status.BOUNDED))
    begin = np.where(gone, 0, begin)
    end = np.where(gone, NOT_LEFT, end)
    has_left = first_out > 0
    n = seen.shape[1] - 1
    at_risk = np.where(counted, np.where(has_left, first_out, n), 0)
    return Exits(counted, begin, np.where(has_left, first_out, NOT_LEFT), end, place, at_risk, n, period)


def labels_of(model: Model, cube: xr.Dataset) -> Labels:
    """Return the function that tells in which class of motion each section is."""
    classifier = model.classifier
    assert classifier is not None
    fixed_values = dict(parameters_of(cube))
    # one section that meets no condition of a text is between the classes, and no class of its own
    undecided = [0, *classifier.neutral, *(k for k, word in enumerate(classifier.words) if word == MIXED)]

    def by_motion(section: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        one = section.reshape(-1, 1, section.shape[-1])
        finite = np.isfinite(one).all(axis=(1, 2))
        codes = np.full(len(one), -1)
        no_turns = np.zeros((int(finite.sum()), len(model.angles)), np.int64)
        hz = np.full(int(finite.sum()), values[FREQUENCY_DIM])
        found = classifier.classify(one[finite], no_turns, hz, {**fixed_values, **values})
        decided = ~np.isin(found, undecided)
        codes[finite] = np.where(decided, found, -1)
        return codes.reshape(section.shape[:-1])

    return by_motion


def region_of(model: Model, options: EscapeOptions, first: np.ndarray) -> Region:
    """Return the box or the ball that cells leave.

    Parameters
    ----------
    model, options
        The options give a box, or the radius of a ball.
    first
        First counted section of each cell, shape (cell, state): the centre of a ball by default.
    """
    names, shape = model.state_names, first.shape
    if options.radius is not None:
        given = np.array([options.centre.get(name, np.nan) for name in names])
        counts = np.isfinite(given) if options.centre else np.ones(len(names), bool)
        centre = np.where(counts, given, 0.0) if options.centre else first
        sides = np.full(shape, np.inf)
        weight = np.broadcast_to(counts / np.array(model.units), shape)
        return Region(np.broadcast_to(centre, shape), -sides, sides, weight, np.full((len(first), 1), options.radius))
    low, high = (
        np.array([sides.get(name, end) for name in names])
        for sides, end in ((options.low, -np.inf), (options.high, np.inf))
    )
    # an angle of a section is in (-pi, pi], so one bound alone has another at the cut
    cut = np.array(model.is_angle) & ((low > -np.pi) | (high < np.pi))
    low, high = (np.where(cut, np.clip(end, -np.pi, np.pi), end) for end in (low, high))
    centre = np.zeros(len(names))
    centre[cut] = 0.5 * (low[cut] + high[cut])
    where, least, most = (np.broadcast_to(end, shape) for end in (centre, low - centre, high - centre))
    return Region(where, least, most, np.zeros(shape), np.full((len(first), 1), np.inf))


def find_passages(run: OpenRun, cells: PointCells, options: EscapeOptions, *, halves: bool = False) -> Exits:
    """Find the step in which each cell of a parameter point first leaves its box or ball.

    Each path is that of the run. With `halves` it is integrated by halved steps, on the same path of the noise.
    """
    model, motion = run.model, run.spec.motion
    assert isinstance(motion, Noisy)
    inputs = inputs_at(run, cells)
    steps = int(motion.steps(inputs)[0])
    n_before = run.spec.integration.n_transient + options.skip + 1
    words = cell_words(inputs.parameters[:, 0], inputs.frequency_hz[:, 0], inputs.initial_states)
    own = {**motion.path, "steps_per_period": steps}
    first = cells.section[:, options.skip].copy()
    # cells that diverged have no sections
    gone = np.flatnonzero((cells.status == Status.DIVERGED) & (cells.n_periods > n_before))
    if len(gone):
        some = inputs.take(gone)
        arrays = some.parameters[:, 0], some.frequency_hz[:, 0], some.initial_states
        again = noisy_sections(*arrays, **own, n_transient=n_before - 1, n_keep=1, checks_step=False)
        first[gone] = again.section[:, 0]
    counted = (cells.status == Status.BOUNDED) | (cells.status == Status.DIVERGED)
    counted &= np.isfinite(first).all(axis=1) & region_of(model, options, first).contains(first, model.is_angle)
    go = np.flatnonzero(counted)
    some, n_periods = inputs.take(go), cells.section.shape[1] - options.skip - 1
    found = first_passages(
        some.parameters[:, 0],
        some.frequency_hz[:, 0],
        first[go],
        region_of(model, options, first[go]),
        **own,
        n_periods=n_periods,
        first_period=n_before,
        words=words[go],
        halves=halves,
    )
    parts = steps * (2 if halves else 1)
    left = np.isfinite(found.steps)
    ends = np.zeros(len(go), np.int64)
    ends[left] = np.rint(found.steps[left] * (parts // steps)).astype(np.int64)
    ends[~left] = parts * found.n_periods[~left]
    has_left = left | (found.status == Status.DIVERGED)

    def of_all(values: np.ndarray, otherwise: float) -> np.ndarray:
        whole = np.full((len(counted), *values.shape[1:]), otherwise, values.dtype)
        whole[go] = values
        return whole

    return Exits(
        counted,
        begin=np.zeros(len(counted), np.int64),
        first_out=of_all(np.where(has_left, -(-ends // parts), NOT_LEFT), NOT_LEFT),
        end=of_all(np.where(left, 1, NOT_LEFT), NOT_LEFT),
        place=of_all(found.place, np.nan),
        at_risk=of_all(ends, 0),
        n_intervals=parts * n_periods,
        interval=1.0 / float(inputs.frequency_hz[0, 0]) / parts,
    )


def inputs_at(run: OpenRun, cells: PointCells) -> Inputs:
    """Return the inputs of the cells of a parameter point."""
    layout = CellMap(run.spec)
    block = {d: slice(0, n) for d, n in zip(layout.dims, layout.shape, strict=True)}
    for axis in parameter_axes(run.spec):
        if axis.dim in cells.at:
            i = int(np.flatnonzero(axis.values == cells.values[axis.dim])[0])
            block[axis.dim] = slice(i, i + 1)
    return layout.inputs(tuple(block.values()))


@dataclass(frozen=True)
class PointCells:
    """Cells of one parameter point, realizations and initial states in one dim."""

    at: dict[str, int]  # index of the point by dim
    values: dict[str, float]  # parameter values of the point by dim
    section: np.ndarray  # (cell, section, state): NaN in cells that diverged
    # (cell,)
    status: np.ndarray
    n_periods: np.ndarray


def point_dims(cube: xr.Dataset) -> list[str]:
    """Return the dims of the parameter points of a noisy run."""
    return list(split_dims(cube["status"])[0])


def cells_at_points(cube: xr.Dataset) -> Iterator[PointCells]:
    """Yield the cells of each parameter point."""
    dims, starts = split_dims(cube["status"])
    n_states = cube.sizes["state"]
    for index in track([*np.ndindex(*(cube.sizes[d] for d in dims))], "parameter points"):
        at = dict(zip(dims, index, strict=True))
        part = cube[["section", "status", "n_periods"]].isel(at).transpose(*starts, ...).load()
        section = part["section"].transpose(*starts, "period_index", "state").values
        yield PointCells(
            at,
            {d: float(cube[d].values[i]) for d, i in at.items()},
            section.reshape(-1, section.shape[-2], n_states),
            part["status"].values.ravel(),
            part["n_periods"].values.ravel(),
        )


def coordinates_of(cube: xr.Dataset, dims: Sequence[str]) -> dict[str, Any]:
    """Return the coordinates of a cube that lie along given dims, and its scalar ones."""
    return {str(name): c for name, c in cube.coords.items() if set(c.dims) <= set(dims)}
