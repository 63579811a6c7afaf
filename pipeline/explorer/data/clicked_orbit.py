"""Integrate the orbit through a clicked point of the diagram."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from magpend_core.status import Status
from pipeline.analysis.outcomes import share_interval
from pipeline.analysis.ragged import dense, isel
from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.data.colours import schemes
from pipeline.explorer.data.explored import ExploredRun, ExplorerError
from pipeline.explorer.data.series import fixed_points, orbit_series
from pipeline.layout.vocabulary import ATTRACTS, BRANCH, EVIDENCE, KINDS, PENDING, STABILITIES, UNSTABLE, grid_dim
from pipeline.plots.motions import motion_codes, motions_of
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Mapping

TOLERANCE = 1e-9
"""Relative and absolute, of what is integrated here; the run's own where that is smaller."""

N_PERIODS = 10
"""Drive periods, or returns, that are shown of a motion that does not close."""

MOST_SEEDS = 200
"""Initial states that are listed as leading to an attractor."""


@dataclass(frozen=True)
class Cell:
    """A cell (trajectory) of a run's result cube, with its parameters and its initial state.

    Attributes
    ----------
    index : dict
        Index on each of the cube's dims.
    data : Dataset
        The cell itself, loaded.
    parameters : Parameters
        With the swept ones.
    clock_hz : float
        Drive frequency; of a flow what stands for it [Hz].
    start : ndarray, (n_states,)
        The initial state; of a walk that with which it began.
    """

    number: int
    index: Mapping[str, int]
    data: xr.Dataset
    parameters: Parameters
    clock_hz: float
    start: np.ndarray

    @property
    def status(self) -> Status:
        """Status of the cell's integration."""
        return Status(int(self.data["status"]))

    @property
    def section(self) -> np.ndarray:
        """Stored section points, shape (n_keep, n_states); NaN for missing points."""
        return np.asarray(self.data["section"].transpose("period_index", "state").values, np.float64)

    @property
    def period(self) -> int:
        """Period of the orbit [drive periods or returns to the section]; 0 if the cell is not periodic."""
        closed = self.status in (Status.PERIODIC, Status.INFERRED)
        return int(self.data["orbit_period"]) if closed else 0


def cell_of(run: ExploredRun, number: int) -> Cell:
    """Read a cell of the run by its number; raise ExplorerError if there is no such cell."""
    index = run.cell(number)
    cube = run.cube()
    names = [n for n in ("section", "turns", "status", "orbit_period", "lyapunov") if n in cube]
    data = cube[names].isel(index).load()
    inputs = run.inputs(index)
    values = dict(zip(run.parameters.names, inputs.parameters[0, 0].tolist(), strict=True))
    parameters = Parameters(run.model, values)
    return Cell(number, index, data, parameters, float(inputs.frequency_hz[0, 0]), inputs.initial_states[0])


def orbit(run: RunDirectory, cell: int, point: int, *, linearised: bool = True) -> bytes:
    """Integrate the orbit through a point of the diagram; return arrays and attributes, packed for the page.

    Parameters
    ----------
    run
        An opened run.
    cell
        Flat number of a cell of the cube.
    point
        Number of one of its kept sections.
    linearised
        Whether the multipliers of a closed orbit are computed where no analysis has them.

    Raises
    ------
    ExplorerError
        If there is no such section, or the run's motion has no orbits.
    ArithmeticError
        If the trajectory ends early.
    """
    explored = ExploredRun.of(run)
    if problem := run.spec.motion.refusal("an orbit"):
        raise ExplorerError(f"{run.name}: {problem}")
    found = cell_of(explored, cell)
    section = found.section
    kept = np.isfinite(section).all(axis=1)
    if not 0 <= point < len(section) or not kept[point]:
        raise ExplorerError(_no_point(found, point, int(kept.sum())))
    attractor = _attractor(explored, found)
    period = found.period or attractor["period"]
    n_periods = period or N_PERIODS
    seconds = _seconds(run, found, section[point], n_periods)
    tolerances = {name: min(TOLERANCE, float(getattr(run.spec.integration, name))) for name in ("rtol", "atol")}
    arrays = orbit_series(found.parameters, found.clock_hz, section[point], n_periods, float(seconds[-1]), **tolerances)
    arrays = {**arrays, "section": section[kept], "section_times": np.concatenate([[0.0], seconds])}
    said = _attrs(explored, found, attractor, linearised)
    attrs = {**said, "period": period or None, "point": point, "n_periods": n_periods}
    return pack_arrays(arrays, attrs)


def facts(run: ExploredRun, cell: int, point: int | None = None) -> dict[str, Any]:
    """Return what is known of a section point without integrating: its cell, state and parameters, and its attractor.

    Parameters
    ----------
    cell
        Flat number of a cell of the cube.
    point
        Number of one of its kept sections; by default the last.

    Returns
    -------
    dict
        What JSON can say. ``state`` has the section point and ``start`` the initial state, by the names of the
        states; ``attractor`` and what follows from it is None where no analysis has it.

    Raises
    ------
    ExplorerError
        If there is no such section.
    """
    found = cell_of(run, cell)
    kept = np.flatnonzero(np.isfinite(found.section).all(axis=1))
    chosen = point if point is not None else int(kept[-1]) if len(kept) else 0
    if chosen not in kept:
        raise ExplorerError(_no_point(found, chosen, len(kept)))
    attractor = _attractor(run, found)
    said = _attrs(run, found, attractor, False)
    for name in ("fixed", "quantities", "seeds", "note"):  # for drawings of the orbit
        del said[name]
    names = next((s.categories for s in schemes(run) if s.name == "attractor"), ())
    label = next((c.label for c in names if c.number == said["attractor"]), None)
    state = {s.name: float(v) for s, v in zip(run.model.states, found.section[chosen], strict=True)}
    period = found.period or attractor["period"] or None
    return {"cell": cell, "point": chosen, "state": state, "period": period, **said, "label": label}


def _no_point(cell: Cell, point: int, n_points: int) -> str:
    if n_points:
        return f"point = {point} is out of bounds: cell {cell.number} keeps sections 0 to {n_points - 1}."
    if cell.status == PENDING:
        return f"cell {cell.number} is not computed yet: give the command that makes the run again."
    return f"cell {cell.number} has no section: {cell.status.sentence}."


def _seconds(run: RunDirectory, cell: Cell, state: np.ndarray, n_periods: int) -> np.ndarray:
    """Return the time at which each period after a section point ends [s]; without a drive, a period is a return to the
    section.
    """
    if run.model.crossing is None:
        return np.asarray(np.arange(1, n_periods + 1) / cell.clock_hz)
    from magpend_core.sections import run_branches

    own = run.spec.integration
    system = run.model.system
    result = run_branches(
        cell.parameters.pack()[None, None],
        np.array([[cell.clock_hz]]),
        state[None],
        n_transient=0,
        n_keep=n_periods,
        rtol=own.rtol,
        atol=own.atol,
        system=system,
        method=own.method,
    )
    times = np.cumsum(np.asarray(result.return_time)[0, 0])
    reached = times[np.isfinite(times)]
    if not len(reached):
        raise ExplorerError("the trajectory does not come back to the section from here.")
    return np.asarray(reached)


# ---------------------------------------------------------------- what is said of it


def _attrs(run: ExploredRun, cell: Cell, told: dict[str, Any], linearised: bool) -> dict[str, Any]:
    multipliers, seconds = told["multipliers"], told["seconds"]
    if multipliers is None and linearised and cell.period:
        multipliers, seconds = linearise(cell)
    awaited = multipliers is None and not linearised and cell.period > 0
    exponents, source = _exponents(cell, multipliers, seconds)
    names = motions_of(run.cube())
    code = int(motion_codes(cell.data))
    autonomous = run.model.crossing is not None
    return {
        "cell": cell.number,
        "at": {a.name: cell.index.get(a.name, 0) for a in run.axes},
        "parameters": cell.parameters.as_dict(),
        "frequency": None if autonomous else cell.clock_hz,
        "status": cell.status.name.lower().replace("_", " "),
        "status_meaning": cell.status.sentence,
        "motion": names.words[code] if names.told and code > 0 else None,
        **{key: told[key] for key in _TOLD},
        "stable": _is_stable(told["stability"], multipliers),
        "multipliers": None if multipliers is None else [[float(m.real), float(m.imag)] for m in multipliers],
        "note": "its multipliers are not ready yet: choose it again in a moment" if awaited else None,
        "exponents": exponents,
        "exponents_from": source,
        "start": {s.name: float(v) for s, v in zip(run.model.states, cell.start, strict=True)},
        "seeds": seeds(run, cell),
        "fixed": fixed_points(run.model, cell.parameters),
        "quantities": [q.name for q in run.model.quantities],
    }


_TOLD = ("attractor", "share", "low", "high", "kind", "stability", "evidence")
"""What the page is told of the set that a cell is on."""


def _is_stable(stability: str | None, multipliers: np.ndarray | None) -> bool | None:
    if stability is not None:
        return {STABILITIES[ATTRACTS]: True, STABILITIES[UNSTABLE]: False}.get(stability)
    return None if multipliers is None else bool(np.abs(multipliers).max() < 1.0)


def shown(one: xr.Dataset) -> dict[str, str | None]:
    """Return the kind, the stability and the evidence of an attractor or other set, as texts for the page."""
    evidence = int(one["evidence"])
    return {
        "kind": KINDS[int(one["kind"])].replace("_", " "),
        "stability": STABILITIES[int(one["stability"])].replace("_", " "),
        "evidence": EVIDENCE[evidence] if evidence else None,
    }


def _attractor(run: ExploredRun, cell: Cell) -> dict[str, Any]:
    """Return the stored data of the attractor on which a cell ends, such as its number and stability.

    A cell whose sections do not close may be on its way to a closed orbit all the same.
    """
    nothing: dict[str, Any] = dict.fromkeys((*_TOLD, "multipliers", "seconds"))
    nothing["period"] = 0
    found = run.kept("attractors")
    if found is None:
        return nothing
    number = int(found["attractor_id"].isel(cell.index))
    if number < 0:
        return nothing
    here = dense(isel(found, _parameter_index(run, cell))).isel(attractor=number)
    told = {**nothing, "attractor": number, "share": finite(here["share"]), **shown(here)}
    if BRANCH not in run.start_dims:  # branches of a continuation are no sample of initial states
        low, high = share_interval(np.array([int(here["n_cells"])]), np.array([float(here["share"])]))
        told |= {"low": finite(low[0]), "high": finite(high[0])}
    multipliers = here["multiplier_real"].values + 1j * here["multiplier_imag"].values
    period = int(here["orbit_period"])
    told["period"] = period
    # an attractor's period may be a divisor of the cell's, whose sections close more loosely
    if np.isfinite(multipliers).all() and period == (cell.period or period):
        told |= {"multipliers": multipliers, "seconds": finite(here["period_s"])}
    return told


def _parameter_index(run: ExploredRun, cell: Cell) -> dict[str, int]:
    return {d: i for d, i in cell.index.items() if d not in run.start_dims}


def linearise(cell: Cell) -> tuple[np.ndarray | None, float | None]:
    """Return the Floquet multipliers and the period [s] of a periodic cell.

    Newton's method begins at the last kept section; None if it does not end on an orbit of the cell's period
    within the distance at which cells of one orbit lie.
    """
    from magpend_core.orbits import polish_orbits, scaled_distance

    system = cell.parameters.model.system
    guess = cell.section[-1]
    if not np.isfinite(guess).all():
        return None, None
    found = polish_orbits(
        cell.parameters.pack()[None], np.array([cell.clock_hz]), guess[None], np.array([cell.period]), system=system
    )
    moved = float(scaled_distance(found.section[0], guess, system))
    if not found.converged[0] or int(found.orbit_period[0]) != cell.period or moved > 1e-2:
        return None, None
    return found.multipliers[0], float(found.seconds[0])


def _exponents(
    cell: Cell, multipliers: np.ndarray | None, seconds: float | None
) -> tuple[list[float] | None, str | None]:
    """Return Lyapunov exponents [1/s] from the result cube or else from the multipliers, and which of the two."""
    if "lyapunov" in cell.data:
        own = cell.data["lyapunov"].values
        if np.isfinite(own).all():
            return [float(v) for v in own], "cube"
    if multipliers is None or not seconds:
        return None, None
    sizes = np.abs(multipliers)
    # the multiplier of the state that crosses stands for the one along a flow's orbit, which is 1
    crossing = cell.parameters.model.crossing is not None
    if crossing:
        sizes = np.concatenate([[1.0], np.sort(sizes)[:0:-1]])
    if not (sizes > 0.0).all():
        return None, None
    return sorted((math.log(s) / seconds for s in sizes), reverse=True), "multipliers"


def finite(value: Any) -> float | None:
    """Convert a number to a float for JSON; None if it is not finite."""
    number = float(value)
    return number if math.isfinite(number) else None


def seeds(run: ExploredRun, cell: Cell) -> list[dict[str, Any]]:
    """Return the initial states at a cell's parameter point that end on the same attractor as the cell.

    Without attractors it is the cell's own alone. Each has a value of every state, and a ``label``.
    """
    cube, found = run.cube(), run.kept("attractors")
    own = tuple(cell.index[d] for d in run.start_dims)
    chosen = [own]
    if found is not None:
        number = int(found["attractor_id"].isel(cell.index))
        ids = found["attractor_id"].isel(_parameter_index(run, cell)).transpose(*run.start_dims).values
        if number >= 0:
            others = [tuple(int(i) for i in row) for row in np.argwhere(ids == number)[: MOST_SEEDS + 1]]
            chosen += [row for row in others if row != own]
    columns = {s.name: _starts_of(run, grid_dim(s.name)) for s in run.model.states}
    return [
        {**{name: float(values[row]) for name, values in columns.items()}, "label": _seed_label(cube, run, row)}
        for row in chosen[:MOST_SEEDS]
    ]


def _starts_of(run: ExploredRun, name: str) -> np.ndarray:
    """Return the initial values of one state, as an array over the dims of the initial conditions."""
    coordinate = run.cube().coords[name]
    sizes = [run.plan.shape[run.plan.dims.index(d)] for d in run.start_dims]
    shaped = [n if d in coordinate.dims else 1 for d, n in zip(run.start_dims, sizes, strict=True)]
    return np.broadcast_to(np.asarray(coordinate.values, np.float64).reshape(shaped), sizes)


def _seed_label(cube: xr.Dataset, run: ExploredRun, row: tuple[int, ...]) -> str:
    if BRANCH in run.start_dims:
        walk = row[run.start_dims.index(BRANCH)]
        return f"start {int(cube['seed'].values[walk])}, {cube['direction'].values[walk]}"
    sizes = [run.plan.shape[run.plan.dims.index(d)] for d in run.start_dims]
    return f"start {int(np.ravel_multi_index(row, sizes)) if sizes else 0}"
