"""Define the analysis ``phase`` of a run: the phase response of its stable limit cycles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.sectioned import of_flow
from pipeline.analysis.phase.declaration import PhaseOptions
from pipeline.analysis.phase.phases import Cycle, cycle_of, gradient_at, phases_of, states_along
from pipeline.analysis.spectrum.motions import Motion, motions_of, needs_set
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import ATTRACTS, PERIODIC_ORBIT, told_by
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, counted, number, words_of
from pipeline.specification.problems import unknown_name

KNOWN, NO_CYCLE = range(2)
STATUSES = ("known", "no_cycle")
"""Whether a cycle's response is known, or Newton's method found no cycle that attracts."""


def needs_cycle(run: OpenRun, options: PhaseOptions) -> None:
    """Raise ValueError unless the run is of a flow with a section, and the options name states and a set of it."""
    model = run.model
    if model.crossing is None:
        raise ValueError(
            "phase responses are those of limit cycles of a flow with a section: the drive sets the phase of this "
            "model's motions."
            if model.clock.has_drive
            else "phase responses need a section by crossing ([section])."
        )
    for name in options.kick:
        if name not in model.state_names:
            raise ValueError(f"--kick: {unknown_name('state', name, list(model.state_names))}")
    if options.grid and len(model.state_names) != 2:
        n = len(model.state_names)
        raise ValueError(f"grid = {options.grid}: isochrones are lines in flows with two states; this one has {n}.")
    needs_set(run, options)


def numbered_cycles(run: OpenRun, options: PhaseOptions) -> list[int]:
    """Return the numbers of the chosen motions that are stable closed orbits."""
    motions = motions_of(run, options)
    found = [i for i, m in enumerate(motions) if m.kind == PERIODIC_ORBIT and m.stability == ATTRACTS]
    if not found:
        raise ValueError("no stable limit cycle is there (magpend analyse attractors lists what is).")
    return found


def phase(run: OpenRun, options: PhaseOptions, wanted: Sequence[int]) -> xr.Dataset:
    """Compute the phase response of some stable limit cycles of a run.

    Returns
    -------
    Dataset
        Over ``cycle`` (rows), ``phase`` and ``state``: ``response`` [1 per unit of the state], the gradient of the
        phase, and ``orbit``, the state there; ``shift`` by a kick. Rows have the swept parameters, ``attractor``,
        ``orbit_period``, ``period_s``, ``status`` (`STATUSES`), and the evidence: ``error``, relative, from the
        deviation of the neutral multiplier from 1 and its distance from the others, and ``contraction``, the largest
        of these. With a grid ``asymptotic_phase`` over ``cycle``, ``y`` and ``x``, with the states ``x_state`` and
        ``y_state``.
    """
    model, cube = run.model, run.cube()
    motions = motions_of(run, options, set(wanted))
    kick = np.array([options.kick.get(name, 0.0) for name in model.state_names])
    rows = [_row(motion, options, kick) for motion in track(motions, "phase responses")]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    dims = {"orbit": ("cycle", "phase", "state"), "response": ("cycle", "phase", "state"), "shift": ("cycle", "phase")}
    dims |= {"asymptotic_phase": ("cycle", "y", "x"), "x_state": ("cycle", "x"), "y_state": ("cycle", "y")}
    variables: dict[str, Any] = {name: (dims.get(name, ("cycle",)), value) for name, value in arrays.items()}
    variables["status"] = ("cycle", arrays["status"], code_flags(STATUSES))
    variables["orbit_period"] = ("cycle", np.array([m.period for m in motions], np.int32))
    variables["unit"] = ("state", [_per(unit) for unit in model.state_units])
    coords: dict[str, Any] = {
        "attractor": ("cycle", np.array([m.attractor for m in motions], np.int32)),
        "cycle_phase": ("phase", np.arange(options.phases) / options.phases),
        "state": list(model.state_names),
    }
    coords |= {str(k): v for k, v in cube.coords.items() if not v.ndim and v.dtype.kind == "f"}
    for name in motions[0].where:
        coords[name] = ("cycle", np.array([m.where[name] for m in motions]), dict(cube[name].attrs))
    kicks = ", ".join(f"{name} {value:g}" for name, value in options.kick.items())
    attrs = {"title": "phase response", "kick": kicks, "axes": " ".join(motions[0].where), **told_by(cube.attrs)}
    return xr.Dataset(variables, coords, attrs)


def _per(unit: str) -> str:
    return "1" if unit == "1" else f"1/({unit})" if "/" in unit else f"1/{unit}"


def _row(motion: Motion, options: PhaseOptions, kick: np.ndarray) -> dict[str, Any]:
    """Return the values of one cycle by the names of the result's variables."""
    n, states = options.phases, len(motion.state)
    shape = (n, states)
    row: dict[str, Any] = {"status": np.int8(NO_CYCLE), "error": np.nan, "contraction": np.nan, "period_s": np.nan}
    row |= {"orbit": np.full(shape, np.nan), "response": np.full(shape, np.nan)}
    if options.kick:
        row["shift"] = np.full(n, np.nan)
    if options.grid:
        row |= {"asymptotic_phase": np.full((options.grid, options.grid), np.nan)}
        row |= {name: np.full(options.grid, np.nan) for name in ("x_state", "y_state")}
    cycle = cycle_of(motion.parameters, motion.clock_hz, motion.state, motion.period)
    if cycle is None:
        return row
    orbit = states_along(cycle, n)
    gradient = gradient_at(of_flow(motion.parameters), cycle.seconds, orbit)
    row |= {"status": np.int8(KNOWN), "error": max(cycle.error, gradient.error), "period_s": cycle.seconds}
    row |= {"contraction": gradient.contraction, "orbit": orbit, "response": gradient.values}
    if options.kick:
        moved = phases_of(cycle, orbit + kick) - np.arange(n) / n
        row["shift"] = moved - np.round(moved)
    if options.grid:
        row |= _phases_around(cycle, orbit, options)
    return row


def _phases_around(cycle: Cycle, orbit: np.ndarray, options: PhaseOptions) -> dict[str, np.ndarray]:
    """Return the phases of states on a grid around a cycle of two states."""
    low, high = orbit.min(axis=0), orbit.max(axis=0)
    margin = options.reach * (high - low)
    x, y = np.linspace(low - margin, high + margin, options.grid).T
    states = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    phases = phases_of(cycle, states).reshape(len(y), len(x))
    return {"asymptotic_phase": phases, "x_state": x, "y_state": y}


def phase_table(ds: xr.Dataset) -> Table:
    """Return the table of phase responses: a row for each cycle and state, with the extremes of the response."""
    rows: list[Row] = []
    lines: list[Words] = []
    axes = str(ds.attrs.get("axes", "")).split()
    statuses = words_of(ds["status"])
    for i in range(ds.sizes["cycle"]):
        one = ds.isel(cycle=i).load()
        head: Row = {name: float(one[name]) for name in axes if name in one.coords}
        head |= {"attractor_id": int(one["attractor"]), "period_s": float(one["period_s"])}
        head |= {"status": statuses[int(one["status"])]}
        for k, name in enumerate(ds["state"].values.tolist()):
            values = one["response"].values[:, k]
            extremes = _extremes(values, one["cycle_phase"].values)
            evidence = {n: float(one[n]) for n in ("contraction", "error")}
            rows.append({**head, "state": name, **extremes, "unit": str(ds["unit"].values[k]), **evidence})
            lines.append(_words(rows[-1], axes))
    kick = f"; kick {ds.attrs['kick']}" if ds.attrs["kick"] else ""
    return Table(rows, [f"phase response of {counted(ds.sizes['cycle'], 'cycle')}{kick}", *aligned(lines)])


def _extremes(values: np.ndarray, phase: np.ndarray) -> Row:
    """Return the smallest and largest response with their phases."""
    if not np.isfinite(values).any():
        return dict.fromkeys(("least", "least_at", "largest", "largest_at"), np.nan)
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    return {
        "least": float(values[low]),
        "least_at": float(phase[low]),
        "largest": float(values[high]),
        "largest_at": float(phase[high]),
    }


def _words(row: Row, axes: Sequence[str]) -> Words:
    def told(name: str) -> str:
        return f"{number(row[name], '.5g')} at {number(row[name + '_at'], '.3f')}" if np.isfinite(row[name]) else "-"

    unit = "" if row["unit"] == "1" else f" [{row['unit']}]"
    return {
        **{name: f"{row[name]:.6g}" for name in axes if name in row},
        "id": str(row["attractor_id"]),
        "period [s]": number(row["period_s"], ".7g"),
        "jump of": row["state"] + unit,
        "least (delay) at phase": told("least"),
        "largest (advance) at phase": told("largest"),
        "error": number(row["error"], ".0e") if row["status"] == "known" else "no cycle found",
    }
