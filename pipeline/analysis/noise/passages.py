"""Find when noisy cells leave a box or a ball: their paths are integrated again, and tested in every step."""

from __future__ import annotations

import numpy as np

from magpend_core.engine.passage import Region
from magpend_core.models.model import Model
from magpend_core.noisy import cell_words, first_passages, noisy_sections
from magpend_core.status import Status
from pipeline.analysis.noise.cells import PointCells
from pipeline.analysis.noise.exits import NOT_LEFT, Exits
from pipeline.analysis.run import OpenRun
from pipeline.layout.cells import CellMap, parameter_axes
from pipeline.motion.noisy import Noisy
from pipeline.motion.steady import Inputs
from pipeline.products.noise import EscapeOptions


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
        weight = np.broadcast_to(counts / np.array(model.scales), shape)
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
    inputs = _inputs_at(run, cells)
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


def _inputs_at(run: OpenRun, cells: PointCells) -> Inputs:
    """Return the inputs of the cells of a parameter point."""
    layout = CellMap(run.spec)
    block = {d: slice(0, n) for d, n in zip(layout.dims, layout.shape, strict=True)}
    for axis in parameter_axes(run.spec):
        if axis.dim in cells.at:
            i = int(np.flatnonzero(axis.values == cells.values[axis.dim])[0])
            block[axis.dim] = slice(i, i + 1)
    return layout.inputs(tuple(block.values()))
