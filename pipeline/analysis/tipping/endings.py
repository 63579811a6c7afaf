"""Integrate trajectories on after their parameters have moved, at the final parameters, and find their attractors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core import Status
from magpend_core.models.drift.ramps import RampOfCells, motions_of
from magpend_core.models.model import Model, Parameters
from pipeline.analysis.attractors.attractors import identify
from pipeline.analysis.attractors.destinations import ELSEWHERE
from pipeline.analysis.tipping.declaration import TippingOptions
from pipeline.layout.vocabulary import FREQUENCY_DIM, START, model_attribute
from pipeline.motion.drifting import Drifting
from pipeline.motion.steady import Inputs, Steady
from pipeline.products.reporting import track
from pipeline.results.outcomes import DIVERGED, outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.specification.spec import Spec

if TYPE_CHECKING:
    from magpend_core import Sections

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
    return held_at(spec, packed, frequency_hz, motions_of(spec.ramps, spec.values.names, packed, frequency_hz))


def held_at(
    spec: Spec, packed: np.ndarray, frequency_hz: np.ndarray, motions: Sequence[RampOfCells], value: str = "final"
) -> list[Final]:
    """Return the constant parameters of cells whose moving parameters are held at a value of their motions."""
    still: Model = spec.model.still  # type: ignore[attr-defined]
    own = dict(zip(spec.values.names, packed.T, strict=True))
    own |= {motion.ramp.parameter: getattr(motion, value) for motion in motions}
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


Known = Mapping[bytes, tuple[Final, np.ndarray, np.ndarray]]
"""By the key of the final parameters: these, states on attractors there (n, n_states), and the attractors' numbers."""


def known_of(groups: Sequence[Group], ids: Sequence[Mapping[int, int]]) -> Known:
    """Return what groups tell of attractors, which have the numbers `ids` in each group."""
    return {group.final.key: (group.final, *_examples(group, own)) for group, own in zip(groups, ids, strict=True)}


def _examples(group: Group, ids: Mapping[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return states on each attractor of a group, and the attractors' numbers."""
    most = 3  # cells of each attractor that go on beside those that are examined
    states, labels = [np.zeros((0, group.settled.shape[1]))], []
    own = group.outcome[np.searchsorted(group.cells, group.integrated)]
    for local, number in ids.items():
        chosen = np.flatnonzero(own == local)[:most]
        states.append(group.settled[chosen])
        labels += [number] * len(chosen)
    return np.concatenate(states), np.array(labels, np.int64)


def compared(
    run: OpenRun, known: Known, finals: Sequence[Final], states: np.ndarray, status: np.ndarray, options: TippingOptions
) -> np.ndarray:
    """Return the numbers of the known attractors on which cells end; states on these go on beside the cells.

    `DIVERGED`, `ELSEWHERE` or `UNKNOWN_END` for others. Finals, states and codes of `Status` are those of the cells.
    """
    outcome = np.full(len(finals), UNKNOWN_END)
    outcome[status == Status.DIVERGED] = DIVERGED
    keys = [final.key for final in finals]
    for key in dict.fromkeys(keys):
        own = np.flatnonzero([k == key for k in keys])
        if key not in known:
            continue
        final, examples, labels = known[key]
        n = len(examples)
        both = np.concatenate([examples, states[own]])
        codes = np.concatenate([np.full(n, int(Status.BOUNDED)), status[own]])
        (group,) = endings(run, [final] * len(both), both, codes, options)
        names = {int(o): int(label) for o, label in zip(group.outcome[:n], labels, strict=True) if o >= 0}
        names |= {DIVERGED: DIVERGED, UNKNOWN_END: UNKNOWN_END}
        outcome[own] = [names.get(int(o), ELSEWHERE) for o in group.outcome[n:]]
    return outcome


def drifted(motion: Drifting, packed: np.ndarray, frequency_hz: np.ndarray, starts: np.ndarray) -> Sections:
    """Integrate cells over the whole length of a run whose parameters move; only the last section is kept."""
    integration = motion.integration
    length = {"n_transient": integration.n_transient + integration.n_keep - 1, "n_keep": 1}
    return motion.sections(packed, frequency_hz, starts, **length, max_orbit_period=1)
