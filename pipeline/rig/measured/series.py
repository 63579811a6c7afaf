"""Compare a recorded time series with a trajectory computed from the recorded state at a rising edge of the drive."""

from __future__ import annotations

import json
import math

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.layout.vocabulary import model_attribute, model_of
from pipeline.rig.edges import DRIVE, Edges, edges_of
from pipeline.rig.measured.declaration import WINDOW_S
from pipeline.rig.measured.sections import find_sections, name_of, section_phase
from pipeline.rig.measured.steps import constant_spans
from pipeline.specification.problems import SpecError

_LEAST_EDGES = 3
"""Fewest edges that determine a frequency."""


def series_of(
    recording: xr.Dataset,
    parameters: Parameters,
    *,
    start_s: float | None = None,
    n_periods: int = 10,
    window_s: float = WINDOW_S,
    hysteresis: float | None = None,
) -> xr.Dataset:
    """Return part of a recording from a rising edge of the drive on, with the model's trajectory from the same state.

    The first rising edge from `start_s` on is taken; the part ends before `n_periods` if the drive frequency changes.
    Local polynomials give the model's initial state at the edge. The drive frequency is that of a line through the
    edges of the stretch of constant frequency. Over ``time`` [s since the edge] there are the measured states, smoothed
    rates if rates are not measured, and the computed states with the suffix ``_computed``. Attributes:
    ``frequency_hz``, ``start_s`` of the edge, ``start`` and ``rms`` (JSON by state; angles on their circle).

    Raise `SpecError` if the parameters are of another model, a state is unknown, or no edge after `start_s` has samples
    around it and periods of one frequency after it, and `ArithmeticError` if the model diverges.
    """
    model = parameters.model
    if model_of(recording) is not model:
        raise SpecError(
            f"{name_of(recording)}: mapped to the model {model_of(recording).name}, while {model.name} is to "
            "be computed: choose one of them."
        )
    if n_periods < 1:
        raise SpecError(f"periods = {n_periods}: must be at least 1.")
    edges = edges_of(recording, hysteresis=hysteresis)
    timing = _first_timing(edges)
    later = section_phase(parameters, timing) / timing
    at = Edges(edges.rising + later, edges.falling, edges.resolution_s) if later else edges
    sections = find_sections(recording, at, window_s=window_s)
    missing = [n for n in model.state_names if n not in sections["state"].values]
    if missing:
        raise SpecError(
            f"{name_of(recording)}: {', '.join(missing)} at the start is not known: map its channel, or that "
            "of the angle whose rate it is."
        )
    first, last = _part(recording, edges, sections, start_s, n_periods)
    own = _fitted(edges, first, last)
    period = (own[-1] - own[0]) / (own.size - 1)
    part = int(np.flatnonzero(sections["number"].values == first)[0])
    start = sections["section"].values[part]
    # the start is placed at the detected edge; the frequency comes from the line through many edges
    start_time = float(edges.rising[first]) + later
    return _dataset(recording, parameters, edges, start, start_time, 1 / period, last - first)


def _part(
    recording: xr.Dataset, edges: Edges, sections: xr.Dataset, start_s: float | None, n_periods: int
) -> tuple[int, int]:
    """Return the first and last rising edge of the compared part, in which the drive frequency is constant."""
    begin = -math.inf if start_s is None else start_s
    known = [int(n) for n in sections["number"].values if edges.rising[int(n)] >= begin]
    for first in known:
        for a, b in constant_spans(edges):
            # the drive changes its frequency within stretches of a few periods
            if a <= first < b and b - a >= _LEAST_EDGES:
                return first, min(b, first + n_periods)
    raise SpecError(
        f"start_s = {begin:g}: {name_of(recording)} has no rising edge with samples around it and {_LEAST_EDGES} "
        f"periods of one frequency after it; edges lie from {edges.rising[0]:.3f} to "
        f"{edges.rising[-1]:.3f} s."
    )


def _first_timing(edges: Edges) -> float:
    if edges.rising.size < _LEAST_EDGES:
        raise SpecError(f"drive: {edges.rising.size} rising edges; a series needs {_LEAST_EDGES} of them.")
    return 1 / float(np.median(np.diff(edges.rising)))


def _fitted(edges: Edges, first: int, last: int) -> np.ndarray:
    """Return the times of edges `first` to `last` on a line through all edges of their constant stretch."""
    a, b = next((a, b) for a, b in constant_spans(edges) if a <= first < b)
    rising = edges.rising[a : b + 1]
    n = np.arange(rising.size, dtype=np.float64)
    slope, begin = np.polyfit(n - n.mean(), rising - rising.mean(), 1)
    line = rising.mean() + begin + slope * (n - n.mean())
    return np.asarray(line[first - a : last - a + 1])


def _dataset(
    recording: xr.Dataset,
    parameters: Parameters,
    edges: Edges,
    start: np.ndarray,
    begin: float,
    frequency_hz: float,
    n_periods: int,
) -> xr.Dataset:
    from magpend_core import trajectory
    from pipeline.rig.recordings import smooth

    rtol = 1e-9
    model = parameters.model
    chosen = (recording["time"].values >= begin) & (recording["time"].values <= begin + n_periods / frequency_hz)
    margin = (recording["time"].values > begin - 1) & (recording["time"].values < begin + n_periods / frequency_hz + 1)
    around = np.concatenate([edges.rising, edges.falling])
    smoothed = smooth(recording.isel(sample=np.flatnonzero(margin)), edges_s=np.sort(around))
    inner = chosen[margin]
    time = recording["time"].values[chosen] - begin
    states = trajectory(parameters, frequency_hz, start, time, rtol=rtol, atol=rtol)
    variables, rms = {}, {}
    for i, s in enumerate(model.states):
        source = recording[s.name].values[chosen] if s.name in recording else smoothed[s.name].values[inner]
        # the recording and the model may differ by full turns
        shift = 2 * np.pi * np.round((source[0] - states[0, i]) / (2 * np.pi)) if s.on_circle else 0.0
        off = source - shift - states[:, i]
        off = off - 2 * np.pi * np.round(off / (2 * np.pi)) if s.on_circle else off
        about = {"units": s.unit, "long_name": s.meaning}
        variables[s.name] = ("time", source - shift, about)
        variables[f"{s.name}_computed"] = ("time", states[:, i], {**about, "long_name": f"{s.meaning}, computed"})
        rms[s.name] = float(np.sqrt(np.nanmean(off**2)))
    if DRIVE in recording:
        variables[DRIVE] = ("time", recording[DRIVE].values[chosen], dict(recording[DRIVE].attrs))
    axis = ("time", time, {"units": "s", "long_name": f"time since {model.section}"})
    return xr.Dataset(variables, coords={"time": axis}).assign_attrs(
        title="recording and model from the same state",
        model=model_attribute(model),
        frequency_hz=frequency_hz,
        start_s=begin,
        start=json.dumps(dict(zip(model.state_names, start.tolist(), strict=True))),
        rms=json.dumps(rms),
        simulated=int(recording.attrs.get("simulated", 0)),
        file=name_of(recording),
        parameters="\n".join(f"{n} = {v!r}" for n, v in parameters.as_dict().items()),
    )
