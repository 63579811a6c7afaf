"""Integrate trajectories on after their parameters have moved, at the final parameters, and find their attractors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from magpend_core import Status
from magpend_core.models.drift.ramps import motions_of
from magpend_core.models.model import Model, Parameters
from pipeline.analysis.attractors.attractors import identify
from pipeline.analysis.tipping.declaration import TippingOptions
from pipeline.layout.vocabulary import FREQUENCY_DIM, START, model_attribute
from pipeline.motion.steady import Inputs, Steady
from pipeline.products.reporting import track
from pipeline.results.outcomes import DIVERGED, outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.specification.spec import Spec

GOOD = (Status.PERIODIC, Status.BOUNDED)

UNKNOWN_END = -1
"""Outcome of a cell that ends on no known attractor."""


@dataclass(frozen=True)
class Final:
    """The constant parameters at which trajectories go on after the drift."""

    parameters: Parameters  # of the model whose parameters do not move
    frequency_hz: float

    @property
    def key(self) -> bytes:
        """Bytes that are equal for equal parameters."""
        return self.parameters.pack().tobytes() + np.float64(self.frequency_hz).tobytes()


def finals_of(spec: Spec, packed: np.ndarray, frequency_hz: np.ndarray) -> list[Final]:
    """Return the final parameters of cells of a run, from their own (cell, n_parameters) and their frequencies."""
    still: Model = spec.model.still  # type: ignore[attr-defined]
    ends = {m.ramp.parameter: m.end for m in motions_of(spec.ramps, spec.values.names, packed, frequency_hz)}
    own = dict(zip(spec.values.names, packed.T, strict=True)) | ends
    rows = np.column_stack([*(own[name] for name in still.parameter_names), frequency_hz])
    distinct, which = np.unique(rows, axis=0, return_inverse=True)
    values = [(dict(zip(still.parameter_names, row, strict=False)), row[-1]) for row in distinct.tolist()]
    finals = [Final(Parameters(still, given), frequency) for given, frequency in values]
    return [finals[k] for k in which.ravel()]


def ends_s(spec: Spec, packed: np.ndarray, frequency_hz: np.ndarray) -> np.ndarray:
    """Return the times after which no parameter of cells moves, shape (cell,) [s]."""
    motions = motions_of(spec.ramps, spec.values.names, packed, frequency_hz)
    return np.asarray(np.max([m.end_s for m in motions], axis=0))


@dataclass(frozen=True)
class Group:
    """Cells that go on at the same final parameters, with what became of them."""

    final: Final
    cells: np.ndarray  # their numbers
    ids: xr.Dataset | None  # result of `identify`; its cells are those that were integrated on
    integrated: np.ndarray  # their numbers
    settled: np.ndarray  # (len(integrated), n_states): their states after the integration
    outcome: np.ndarray  # int, (len(cells),): attractors' ids in `ids`, `DIVERGED`, or `UNKNOWN_END`


def endings(
    run: OpenRun, finals: list[Final], states: np.ndarray, status: np.ndarray, options: TippingOptions
) -> Iterator[Group]:
    """Integrate cells on at their final parameters, and find the attractors on which they end.

    Finals, last sections (cell, n_states) and codes of `Status` are those of the cells.
    """
    keys = [final.key for final in finals]
    for key in track([*dict.fromkeys(keys)], "final parameters"):
        cells = np.flatnonzero([k == key for k in keys])
        final = finals[cells[0]]
        going = cells[np.isin(status[cells], GOOD)]
        outcome = np.where(status[cells] == Status.DIVERGED, DIVERGED, UNKNOWN_END)
        ids, settled = None, np.zeros((0, states.shape[1]))
        if len(going):
            cube = _going_on(run, final, states[going], options)
            ids = dense(identify(cube, parameters=final.parameters), points=True)
            settled = cube["section"].values[:, -1]
            outcome[np.searchsorted(cells, going)] = outcomes(ids).values
        yield Group(final, cells, ids, going, settled, outcome)


def _going_on(run: OpenRun, final: Final, states: np.ndarray, options: TippingOptions) -> xr.Dataset:
    """Return a cube of trajectories that go on from given states at constant parameters, as of a sweep."""
    model, n = final.parameters.model, len(states)
    length = {"n_transient": options.settle, "n_keep": options.keep}
    motion = Steady(model, run.spec.integration.model_copy(update={**length, "stop_when_closed": False}))
    inputs = Inputs(np.tile(final.parameters.pack(), (n, 1, 1)), np.full((n, 1), final.frequency_hz), states)
    found, _ = motion.integrate(inputs, None)
    names = ("status", "orbit_period", "n_periods", "n_steps", "n_rejected", "step_size")
    data: dict[str, Any] = {name: ((START,), getattr(found, name)[:, 0]) for name in names}
    data["section"] = ((START, "period_index", "state"), found.section[:, 0])
    if model.angles:
        data["turns"] = ((START, model.angle_dim), found.turns[:, 0])
    attrs = {**run.spec.integration.model_dump(), **length, "kind": "sweep", "model": model_attribute(model)}
    attrs["parameters"] = "\n".join(f"{k} = {v!r}" for k, v in final.parameters.items())
    units = ("state", list(model.state_units))
    coords = {"state": list(model.state_names), "state_units": units, FREQUENCY_DIM: final.frequency_hz}
    return xr.Dataset(data, coords=coords, attrs=attrs)
