"""Read the events of attractors for the page: their sentences, and cells on the orbits before and after them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.sizes import LEVEL
from pipeline.analysis.branches.analysis import fixed_of
from pipeline.analysis.branches.kinds import KINDS, NAMES
from pipeline.analysis.events.kinds import EVENTS, RANGE_END, UNDECIDED
from pipeline.explorer import RequestError
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import finite
from pipeline.explorer.data.overlays import SAME_ON_AXIS
from pipeline.explorer.data.parameter_plane import packed_orbit
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, frequency_of, parameter_name
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import isel
from pipeline.runs.derive import AnalysedRun, options_of, shown_table
from pipeline.store.run import RunDirectory


def events(run: RunDirectory, x: str, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the events along the horizontal axis of a diagram.

    Each of ``events`` has its number ``event``, ``label``, ``sentence``, ``x`` (None if it is not decided), ``low`` and
    ``high`` (the values of the run between which it lies), ``before`` and ``after`` (numbers of a cell on the attractor
    and of the cell with the same start beyond; None if the run has no such cell), and ``orbit``: whether the orbit at
    its bifurcation can be integrated (`event_orbit`). ``note`` says why there are none.
    """
    explored = ExploredRun.open(run)
    explored.axis(x)
    found = _kept(explored, x, explored.place(at, but=x))
    if found is None:
        return {"events": [], "note": "not computed along this axis: magpend analyse events DIR"}
    own = [row for row in shown_table("events", found).rows if row["what"] != RANGE_END]
    return {"events": [_event(explored, found, row, x, at) for row in own], "note": None}


def _kept(run: ExploredRun, x: str, place: Mapping[str, int]) -> xr.Dataset | None:
    """Return the stored events along an axis, at the place of the other axes."""
    for one in run.kept_each("events"):
        given = options_of(one.attrs)["at"]
        there = {axis_name(name): value for name, value in given.items()}
        values = {name: float(run.axis(name).values[i]) for name, i in place.items()}
        if str(one.attrs["parameter"]) == x and all(
            math.isclose(there.get(name, value), value, rel_tol=SAME_ON_AXIS) for name, value in values.items()
        ):
            return one
    return None


def _event(
    run: ExploredRun, found: xr.Dataset, row: Mapping[str, Any], x: str, at: Mapping[str, int]
) -> dict[str, Any]:
    one = found.isel(event=row["event"])
    seen, beyond = float(one["seen"]), float(one["beyond"])
    before, after = _cells(run, one, x, run.place(at, but=x))
    low, high = sorted((seen, beyond)) if math.isfinite(beyond) else (seen, seen)
    return {
        "event": row["event"],
        "label": row["label"] or EVENTS[row["what"]].text,
        "sentence": row["sentence"],
        "x": finite(one["value"]),
        "low": low,
        "high": high,
        "open": row["what"] == UNDECIDED,
        "before": before,
        "after": after,
        # the numbers of bifurcations are those of the run that has the further values
        "orbit": int(one["bifurcation"]) >= 0 and row["period"] > 0 and not found.attrs.get("refined"),
    }


def _cells(run: ExploredRun, one: xr.Dataset, x: str, place: Mapping[str, int]) -> tuple[int | None, int | None]:
    """Return a cell on the attractor at the last value with cells, and the cell with the same start beyond."""
    attractors = run.kept("attractors")
    seen, beyond = (_index(run.axis(x).values, float(one[name])) for name in ("seen", "beyond"))
    if attractors is None or seen is None:
        return None, None
    ids = outcomes(isel(attractors, place))
    here = ids.isel({x: seen}) == int(one["attractor"])
    if "direction" in here.coords:
        here &= here["direction"] == ("up" if int(one["rises"]) else "down")
    if beyond is not None:
        same = here & (ids.isel({x: beyond}) == int(one["to_attractor"][0]))
        here = same if bool(same.any()) else here
    if not bool(here.any()):
        return None, None
    start = dict(zip(map(str, here.dims), np.argwhere(here.values)[0].tolist(), strict=True))
    before, after = (None if i is None else run.number({**start, **place, x: i}) for i in (seen, beyond))
    return before, after


def _index(values: np.ndarray, value: float) -> int | None:
    near = np.flatnonzero(np.isclose(values, value, rtol=SAME_ON_AXIS, atol=0.0))
    return int(near[0]) if near.size else None


def event_orbit(run: RunDirectory, x: str, at: Mapping[str, int], event: int) -> bytes:
    """Integrate the orbit at the bifurcation of an event; return it packed for the page.

    Raise RequestError if the event has no such orbit, ArithmeticError if the trajectory ends early.
    """
    explored = ExploredRun.open(run)
    listed = {one["event"]: one for one in events(run, x, at)["events"]}
    if event not in listed or not listed[event]["orbit"]:
        raise RequestError(f"event = {event}: no orbit is located there.")
    found = _kept(explored, x, explored.place(at, but=x))
    assert found is not None
    located = AnalysedRun.of(run).derive("branches", parameter=parameter_name(x))
    k = int(found["bifurcation"].values[event])
    branch = int(located["of_branch"].values[k])
    values = {parameter_name(x): float(located["value"].values[k])}
    values |= {name: value for name, value in fixed_of(located, branch).items() if name != LEVEL}
    frequency = parameter_name(FREQUENCY_DIM)
    base = {FREQUENCY_DIM: values.get(frequency, explored.spec.frequency_hz)}
    own = {name: value for name, value in values.items() if name != frequency}
    clock_hz = frequency_of(explored.model, {n: v for n, v in (base | own).items() if v is not None})
    parameters = explored.parameters.replace(**own)
    state, period = located["bifurcation_section"].values[k, 0], max(int(located["orbit_period"].values[branch]), 1)
    return packed_orbit(explored, parameters, clock_hz, state, period, NAMES[KINDS[int(located["kind"].values[k])]])
