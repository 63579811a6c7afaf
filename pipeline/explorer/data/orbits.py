"""Integrate orbits for the page: through a clicked point of the diagram, or from an initial state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from magpend_core import evaluate, trajectory
from magpend_core.models.model import Model, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.status import Status
from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.data.colours import schemes
from pipeline.explorer.data.explored import ExploredRun
from pipeline.layout.vocabulary import ATTRACTS, BRANCH, EVIDENCE, KINDS, PENDING, STABILITIES, UNSTABLE, grid_dim
from pipeline.plots.palette import motion_codes, motions_of
from pipeline.results.outcomes import share_interval
from pipeline.results.ragged import dense, dims_of, isel
from pipeline.store.run import RunDirectory

SAMPLES_PER_PERIOD = 128
"""Instants per drive period or return."""


def drawn_points(model: Model, parameters: Mapping[str, float], states: np.ndarray) -> np.ndarray | None:
    """Return the moving points of the model's drawing, shape (n, n_points, 2); None if it has no drawing.

    They are in the order in which `Drawing.points` names them.
    """
    if model.drawing is None:
        return None
    places = model.drawing.points(states, parameters)
    return np.stack([np.broadcast_to(p, (len(states), 2)) for p in places.values()], axis=1).astype(float)


def fixed_points(model: Model, parameters: Mapping[str, float]) -> dict[str, list[float]]:
    """Return the positions of those points of the model's drawing that do not move, by name."""
    if model.drawing is None:
        return {}
    return {name: [float(x) for x in place] for name, place in model.drawing.fixed(parameters).items()}


def series(
    parameters: Parameters,
    clock_hz: float,
    state: np.ndarray,
    times: np.ndarray,
    *,
    rtol: float,
    atol: float,
    with_quantities: bool = True,
) -> dict[str, np.ndarray]:
    """Integrate from a section point; return the states over time, the quantities and the drawing's points.

    Parameters
    ----------
    parameters
        Parameters of the model, with or without its Poincare section.
    clock_hz
        Drive frequency [Hz]; for a flow any frequency, which affects only the limit on steps.
    state, times
        At time 0, shape (n_states,); rising times [s], shape (n,).

    Returns
    -------
    dict
        ``time`` (n,), ``states`` (n, n_states) with angles that run on, ``quantities`` (n, n_quantities), and
        ``drawing`` (n, n_points, 2) if the model has one.

    Raises
    ------
    ArithmeticError
        If the trajectory ends before the last time.
    """
    own = of_flow(parameters)
    states = trajectory(own, clock_hz, state, times, rtol=rtol, atol=atol)
    found = {"time": np.asarray(times, np.float64), "states": states}
    if with_quantities:
        names = [q.name for q in own.model.quantities]
        found["quantities"] = evaluate(names, times, states, own, clock_hz)
    drawing = drawn_points(own.model, own, states)
    if drawing is not None:
        found["drawing"] = drawing
    return found


def orbit_series(
    parameters: Parameters,
    clock_hz: float,
    state: np.ndarray,
    n_periods: int,
    seconds: float,
    *,
    rtol: float = 1e-9,
    atol: float = 1e-9,
) -> dict[str, np.ndarray]:
    """Integrate over the periods of an orbit, both ends included, and return what `series` returns."""
    n = max(1, min(n_periods * parameters.model.clock.samples(SAMPLES_PER_PERIOD), 65_536))
    times = seconds * np.arange(n + 1) / n
    return series(parameters, clock_hz, state, times, rtol=rtol, atol=atol)


ORBIT_RTOL = 1e-9
"""Relative and absolute, of what is integrated here; the run's own where that is smaller."""


@dataclass(frozen=True)
class Cell:
    """A cell (trajectory) of a run's result cube, with its parameters and its initial state."""

    number: int
    index: Mapping[str, int]  # index on each of the cube's dims
    data: xr.Dataset  # the cell itself, loaded
    parameters: Parameters  # with the swept ones
    clock_hz: float  # drive frequency; of a flow what stands for it [Hz]
    start: np.ndarray  # (n_states,); the initial state; of a walk that with which it began

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
    """Read a cell of the run by its number; raise RequestError if there is no such cell."""
    index = run.cell(number)
    cube = run.cube()
    names = [n for n in ("section", "turns", "status", "orbit_period", "lyapunov") if n in cube]
    data = cube[names].isel(index).load()
    inputs = run.inputs(index)
    values = dict(zip(run.parameters.names, inputs.parameters[0, 0].tolist(), strict=True))
    parameters = Parameters(run.model, values)
    return Cell(number, index, data, parameters, float(inputs.frequency_hz[0, 0]), inputs.initial_states[0])


def orbit(run: RunDirectory, cell: int, point: int, *, linearised: bool = True) -> bytes:
    """Integrate the orbit through a kept section point of a cell; return it packed for the page.

    `linearised` says whether the multipliers of a closed orbit are computed where no analysis has them. Raise
    RequestError if there is no such point or the run's motion has no orbits, ArithmeticError if the trajectory ends
    early.
    """
    usual = 10  # drive periods, or returns, that are shown of a motion that does not close
    explored = ExploredRun.open(run)
    if problem := run.spec.motion.refusal("an orbit"):
        raise RequestError(f"{run.name}: {problem}")
    found = cell_of(explored, cell)
    section = found.section
    kept = np.isfinite(section).all(axis=1)
    if not 0 <= point < len(section) or not kept[point]:
        raise RequestError(_no_point(found, point, int(kept.sum())))
    attractor = _attractor(explored, found)
    period = found.period or attractor["period"]
    n_periods = period or usual
    seconds = _seconds(run, found, section[point], n_periods)
    tolerances = {name: min(ORBIT_RTOL, float(getattr(run.spec.integration, name))) for name in ("rtol", "atol")}
    arrays = orbit_series(found.parameters, found.clock_hz, section[point], n_periods, float(seconds[-1]), **tolerances)
    arrays = {**arrays, "section": section[kept], "section_times": np.concatenate([[0.0], seconds])}
    said = _attrs(explored, found, attractor, linearised)
    attrs = {**said, "period": period or None, "point": point, "n_periods": n_periods}
    return pack_arrays(arrays, attrs)


def facts(run: ExploredRun, cell: int, point: int | None = None) -> dict[str, Any]:
    """Return what is known of a section point (by default the cell's last) without integrating, as JSON can say it.

    ``state`` has the section point and ``start`` the initial state, by the names of the states; ``attractor`` and what
    follows from it is None where no analysis has it. Raise RequestError if there is no such point.
    """
    found = cell_of(run, cell)
    kept = np.flatnonzero(np.isfinite(found.section).all(axis=1))
    chosen = point if point is not None else int(kept[-1]) if len(kept) else 0
    if chosen not in kept:
        raise RequestError(_no_point(found, chosen, len(kept)))
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
    """Return the time at which each period (without a drive, return) after a section point ends [s]."""
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
        raise RequestError("the trajectory does not come back to the section from here.")
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
    return {
        "cell": cell.number,
        "at": {a.name: cell.index.get(a.name, 0) for a in run.axes},
        "parameters": cell.parameters.as_dict(),
        "frequency": cell.clock_hz if run.model.clock.hertz is None else None,
        "status": cell.status.name.lower().replace("_", " "),
        "status_meaning": cell.status.sentence,
        "motion": names.words[code] if names.told and code > 0 else None,
        **{key: told[key] for key in _TOLD},
        "stable": _is_stable(told["stability"], multipliers),
        "multipliers": None if multipliers is None else parts_of(multipliers),
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
    here = attractor_of(run.kept("attractors"), cell.index)
    if here is None:
        return nothing
    told = {**nothing, "attractor": int(here["attractor"]), "share": finite(here["share"]), **shown(here)}
    told |= share_bounds(run, here)
    multipliers = here["multiplier_real"].values + 1j * here["multiplier_imag"].values
    period = int(here["orbit_period"])
    told["period"] = period
    # an attractor's period may be a divisor of the cell's, whose sections close more loosely
    if np.isfinite(multipliers).all() and period == (cell.period or period):
        told |= {"multipliers": multipliers, "seconds": finite(here["period_s"])}
    return told


def share_bounds(run: ExploredRun, one: xr.Dataset) -> dict[str, float | None]:
    """Return the interval of an attractor's share; branches of a continuation are no sample and have none."""
    if BRANCH in run.start_dims:
        return {"low": None, "high": None}
    low, high = share_interval(np.array([int(one["n_cells"])]), np.array([float(one["share"])]))
    return {"low": finite(low[0]), "high": finite(high[0])}


def parts_of(numbers: np.ndarray) -> list[list[float | None]]:
    """Return the real and the imaginary part of each complex number."""
    return [[finite(number.real), finite(number.imag)] for number in numbers]


def attractor_of(attractors: xr.Dataset | None, index: Mapping[str, int]) -> xr.Dataset | None:
    """Return the stored attractor on which the cell at an index ends; None if there is none."""
    number = -1 if attractors is None else int(attractors["attractor_id"].isel(index))
    if attractors is None or number < 0:
        return None
    return dense(isel(attractors, {d: index[d] for d in dims_of(attractors)})).isel(attractor=number)


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
    most = 200  # initial states that are listed as leading to an attractor
    cube, found = run.cube(), run.kept("attractors")
    own = tuple(cell.index[d] for d in run.start_dims)
    chosen = [own]
    if found is not None:
        number = int(found["attractor_id"].isel(cell.index))
        ids = found["attractor_id"].isel(_parameter_index(run, cell)).transpose(*run.start_dims).values
        if number >= 0:
            others = [tuple(int(i) for i in row) for row in np.argwhere(ids == number)[: most + 1]]
            chosen += [row for row in others if row != own]
    origin = run.origins(cell.index)
    columns = {s.name: _starts_of(run, grid_dim(s.name)) + origin[s.name] for s in run.model.states}
    return [
        {**{name: float(values[row]) for name, values in columns.items()}, "label": _seed_label(cube, run, row)}
        for row in chosen[:most]
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
