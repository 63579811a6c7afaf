"""Find the motion of a set or a cell of a run, and sample a quantity along it."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
import xarray as xr

from magpend_core.models.model import Model, Parameters, Quantity, State
from magpend_core.models.sectioned import of_flow
from magpend_core.pointwise import evaluate
from magpend_core.sampling import Drive
from magpend_core.status import Status
from pipeline.analysis.attractors.portraits import mean_return
from pipeline.analysis.flown import flown
from pipeline.analysis.spectrum.declaration import SPECTRUM_COLUMNS, MotionOptions, SetOptions
from pipeline.layout.vocabulary import BOUNDED_SET, NOT_SETTLED, frequency_of, letter, parameters_of, split_dims
from pipeline.results.ragged import dims_of, places_of_rows, points_of_rows
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points
from pipeline.specification.problems import unknown_name

Chosen = TypeVar("Chosen", bound=SetOptions)
OfChannel = TypeVar("OfChannel", bound=MotionOptions)


class Motion(NamedTuple):
    """A motion that is measured: a set at a parameter point, or where a cell goes on."""

    where: dict[str, float]  # values of the swept parameters
    attractor: int  # id, -1 of a cell on no set
    kind: int
    stability: int
    period: int  # drive periods or returns, 0 if it does not close
    seconds: float  # of the period
    share: float  # of the initial conditions
    state: np.ndarray
    parameters: Parameters
    clock_hz: float  # frequency of the drive or the strobe; of a flow with a section one over its longest return


def channels_of(model: Model) -> list[State | Quantity]:
    """Return the states and quantities of a model."""
    both: list[State | Quantity] = [*model.flow.states, *model.flow.quantities]
    return both


def needs_motion(run: OpenRun, options: MotionOptions) -> None:
    """Raise ValueError unless the options name a channel, and a set or a cell that can be there."""
    names = [v.name for v in channels_of(run.model)]
    if options.channel and options.channel not in names:
        raise ValueError(unknown_name("channel", options.channel, names))
    needs_set(run, options)
    status = run.cube()["status"]
    cell = getattr(options, "cell", None)
    if cell is None:
        return
    if cell >= status.size:
        raise ValueError(f"cell = {cell} is out of bounds: the run has cells 0 to {status.size - 1}.")
    if options.at or options.attractor:
        raise ValueError("cell names a motion already: drop at and attractor.")


def needs_set(run: OpenRun, options: SetOptions) -> None:
    """Raise ValueError unless the options name a set that can be there."""
    if options.attractor and not options.attractor.strip().isalnum():
        raise ValueError(f"attractor {options.attractor!r}: give its letter or its id.")
    select_points(run.cube(), options.at)


def settle_motion(run: OpenRun, options: OfChannel) -> OfChannel:
    """Fill in the channel, and replace the id of an attractor by its letter."""
    channel = options.channel or run.model.state_names[0]
    return settle_set(run, options).model_copy(update={"channel": channel})


def settle_set(run: OpenRun, options: Chosen) -> Chosen:
    """Replace the id of an attractor by its letter."""
    name = options.attractor.strip().upper()
    return options.model_copy(update={"attractor": letter(int(name)) if name.isdigit() else name})


def motions_of(run: OpenRun, options: SetOptions, wanted: Container[int] | None = None) -> list[Motion]:
    """Return the motions of the chosen sets, or of a cell; all, or those with the wanted numbers."""
    found = run.derive("attractors")
    dims, _ = split_dims(found["attractor_id"])
    chosen, where, attractor = run.cube(), dict(options.at), options.attractor
    cell_number = getattr(options, "cell", None)
    if cell_number is not None:
        status = chosen["status"]
        place = np.unravel_index(cell_number, status.shape)
        index = {str(d): int(i) for d, i in zip(status.dims, place, strict=True)}
        cell = chosen[["status", "section"]].isel(index).load()
        where = {d: float(found[d][index[d]]) for d in dims}
        number = int(found["attractor_id"].isel(index))
        if number < 0:
            return [_of_cell(found, cell, where)]
        attractor = letter(number)
    here = select_points(found, where)
    axes = dict(zip(dims, places_of_rows(here, dims_of(here)), strict=True))
    points = points_of_rows(here)
    rows = [i for i, number in enumerate(here["attractor"].values.tolist()) if attractor in ("", letter(number))]
    motions = []
    for k, i in enumerate(rows):
        if wanted is None or k in wanted:
            number, at = int(here["attractor"].values[i]), {d: float(values[i]) for d, values in axes.items()}
            columns = ("kind", "stability", "orbit_period", "period_s", "share")
            told = (here[name].values[i].item() for name in columns)
            motions.append(Motion._make((at, number, *told, points[i][0], *_parameters(found, at))))
    if not rows:
        there = ", ".join(letter(i) for i in sorted(set(here["attractor"].values.tolist()))) or "none"
        raise ValueError(f"no set {attractor} is there; it has {there} (magpend analyse attractors).")
    return motions


def _of_cell(found: xr.Dataset, cell: xr.Dataset, where: dict[str, float]) -> Motion:
    """Return the motion of a cell that is on no known set: where its trajectory goes on."""
    section = cell["section"].transpose("period_index", "state").values
    kept = np.flatnonzero(np.isfinite(section).all(axis=1))
    if not len(kept):
        raise ValueError(f"the cell has no section from which it could go on: {Status(int(cell['status'])).advice}.")
    told = (BOUNDED_SET, NOT_SETTLED, 0, np.nan, np.nan)
    return Motion._make((where, -1, *told, section[kept[-1]], *_parameters(found, where)))


def _parameters(found: xr.Dataset, where: Mapping[str, float]) -> tuple[Parameters, float]:
    """Return the parameters at a point, and the frequency of the drive or the strobe [Hz]."""
    base = parameters_of(found)
    values = {**{str(k): float(v) for k, v in found.coords.items() if not v.ndim and v.dtype.kind == "f"}, **where}
    return base.replace(**{k: v for k, v in values.items() if k in base}), frequency_of(base.model, values)


def row_axis(name: str) -> str:
    """Return the name of the coordinate with a swept parameter along the rows."""
    return f"parameter_{name}" if name in _COLUMNS else name


def swept_by(axis: str) -> str:
    """Return the swept parameter whose values a coordinate along the rows has."""
    name = axis.removeprefix("parameter_")
    return name if name in _COLUMNS else axis


_COLUMNS = {column.name for column in SPECTRUM_COLUMNS}


def clock_of(motion: Motion) -> float:
    """Return the frequency of the drive or the strobe, or of a flow with a section the mean rate of returns [Hz]."""
    if motion.parameters.model.crossing is None:
        return motion.clock_hz
    rate = 1.0 / mean_return(motion.state[None], motion.parameters, motion.clock_hz)
    return rate if np.isfinite(rate) else motion.clock_hz


def sampled(motion: Motion, rate: float, n_periods: int, n_samples: int, place: int) -> np.ndarray | None:
    """Return a channel at even instants of a trajectory, without an angle's mean turning; None if it fails."""
    flow = of_flow(motion.parameters)
    times = np.arange(n_periods * n_samples) / (rate * n_samples)
    # for a flow intervals only bound the steps
    drive = Drive(np.full(n_periods + 1, 1.0 / rate))
    found = flown(flow, motion.state[None], times, drive, limits_first_step=False)
    if found.status[0] != Status.BOUNDED:
        return None
    n_states = len(flow.model.states)
    if place >= n_states:
        name = flow.model.quantities[place - n_states].name
        return np.asarray(evaluate([name], times, found.states[0], flow, rate)[:, 0])
    values = found.states[0, :, place]
    turns = values[-1] - values[0]
    if flow.model.system.is_angle[place] and abs(turns) > 2.0 * np.pi:
        values = values - turns * np.linspace(0.0, 1.0, len(values))
    return np.asarray(values)
