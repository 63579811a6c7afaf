"""Read a measured branch from a CSV table of orbits, or from recordings of orbits listed in a specification."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from pydantic import Field

from magpend_core.models.model import Model
from magpend_core.models.parameters import near_names
from pipeline.analysis.branches.units import parameter_units
from pipeline.layout.attributes import code_flags
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_attribute
from pipeline.rig.recordings import parse_mapping, read_recording
from pipeline.specification.files import read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, unknown_name
from pipeline.specification.tables import Table

# ---- cycles ----------------------------------------------------------------------------------------

N_HARMONICS = 3
"""Harmonics that are measured, the first included."""

HYSTERESIS = 0.3
"""Band about the mean that a cycle must cross, in units of the signal's standard deviation: noise crosses less."""

LEAST_CYCLES = 3


class CyclesError(ValueError):
    """Error raised for a signal with too few whole cycles."""


@dataclass(frozen=True)
class Cycles:
    """Periodic motion in one signal: medians over its cycles, and the scatter of single cycles."""

    n: int
    # half of the peak-to-peak value [the signal's unit]
    amplitude: float
    amplitude_sd: float
    mean: float  # over a cycle
    mean_sd: float
    frequency: float  # [Hz]
    frequency_sd: float
    # (N_HARMONICS,) amplitudes of the Fourier components of a cycle, the first at the frequency itself
    harmonics: np.ndarray


def cycles_of(time: np.ndarray, values: np.ndarray) -> Cycles:
    """Measure the cycles of a signal at rising, even times; each lies between two upward crossings of the signal's
    mean.

    Samples that are not finite end the signal. Raise `CyclesError` if there are fewer than `LEAST_CYCLES` whole cycles.
    """
    last = len(values) if np.isfinite(values).all() else int(np.argmin(np.isfinite(values)))
    time, values = time[:last], values[:last]
    starts = _upward_crossings(time, values)
    if len(starts) < LEAST_CYCLES + 1:
        raise CyclesError(f"the signal has {max(len(starts) - 1, 0)} whole cycles; at least {LEAST_CYCLES} are needed.")
    found = np.array([_cycle(time, values, a, b) for a, b in itertools.pairwise(starts)])
    middle, scatter = np.median(found, axis=0), np.std(found, axis=0, ddof=1)
    return Cycles(len(found), middle[0], scatter[0], middle[1], scatter[1], middle[2], scatter[2], middle[3:])


def _upward_crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the times [s] at which a signal rises through its mean. Before each crossing, the signal must have been
    below a hysteresis band about the mean.
    """
    if len(values) < 2:
        return np.zeros(0)
    away = values - values.mean()
    band = HYSTERESIS * away.std()
    found, is_low = [], False
    for i in range(1, len(away)):
        is_low = is_low or away[i - 1] < -band
        if is_low and away[i - 1] < 0.0 <= away[i]:
            found.append(time[i - 1] - away[i - 1] * (time[i] - time[i - 1]) / (away[i] - away[i - 1]))
            is_low = False
    return np.array(found)


def _cycle(time: np.ndarray, values: np.ndarray, begin: float, end: float) -> np.ndarray:
    inside = (time > begin) & (time < end)
    n = max(64, int(inside.sum()))
    even = np.interp(begin + (end - begin) * np.arange(n) / n, time, values)
    lines = np.abs(np.fft.rfft(even)) / n
    peaks = values[inside]
    return np.array(
        [0.5 * np.ptp(peaks), lines[0] * np.sign(even.mean()), 1.0 / (end - begin), *2.0 * lines[1 : N_HARMONICS + 1]]
    )


STABILITIES = ("unknown", "stable", "unstable")

_YES = {
    "yes": "stable", "no": "unstable", "unknown": "unknown", "true": "stable", "false": "unstable",
    "stable": "stable", "unstable": "unstable",
}  # fmt: skip
_NUMBERS = ("amplitude", "amplitude_sd", "mean", "mean_sd", "frequency", "frequency_sd")
_HARMONICS = tuple(f"harmonic_{k + 1}" for k in range(N_HARMONICS))
_KNOWN = ("name", "stable", "stability", "n_cycles", *_NUMBERS, *_HARMONICS)


class RecordedOrbit(Table):
    """Table ``[[measured.branch.orbits]]``: recording of one orbit."""

    name: str = Field(min_length=1, description="Name of the orbit.")
    value: float = Field(description="Value of the parameter [SI].")
    stable: Literal["yes", "no", "unknown"] = Field(default="unknown", description="Whether the orbit is stable.")
    file: str = Field(
        default="", description="Recording, relative to the specification; by default that of the branch."
    )
    channel: str = Field(description="Channel of the state, as magpend recordings show lists it.")


class MeasuredBranch(Table):
    """Table ``[measured.branch]``: recorded orbits along a parameter."""

    model: Any = Field(default="", description="Model: its name, a file or a table; by default that of the file.")
    parameter: str = Field(description="Parameter along which orbits were measured, or frequency_hz.")
    state: str = Field(description="State whose cycles are measured.")
    file: str = Field(default="", description="Recording, relative to the specification.")
    unit: str = Field(default="", description="Unit of the channels in the file; by default the state's.")
    scale: float | None = Field(default=None, description="SI units per unit of the file.")
    sampling_rate_hz: float | None = Field(
        default=None, gt=0, description="Sampling rate, if the files do not state it."
    )
    orbits: tuple[RecordedOrbit, ...] = Field(strict=False, min_length=1, description="The recorded orbits.")


def read_branch(path: str | Path, model: Model | None = None, state: str = "") -> xr.Dataset:
    """Read a measured branch from a CSV table of orbits, or from a TOML specification of recorded orbits,
    ``[measured.branch]``.

    The first column of a CSV file is the parameter of `model`; others are ``amplitude``, ``amplitude_sd``, ``mean``,
    ``frequency`` (with ``_sd``), ``stable`` (yes, no, unknown) and ``name``. The tables that ``magpend measured branch
    --csv`` writes can be read as well. `state` is by default the model's first. Return over the dim ``orbit`` the
    parameter's ``value``, ``amplitude``, ``mean`` and ``frequency`` with the scatter ``..._sd``, ``harmonic``
    amplitudes, ``stability`` (codes of `STABILITIES`), ``n_cycles``; NaN where unknown.

    Raise `SpecError` if the file cannot be read, or for unknown or missing keys, columns and numbers; all at once.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return _from_csv(path, model, state)
    return _from_recordings(path)


# ---- recordings --------------------------------------------------------------------------------


def _from_recordings(path: Path) -> xr.Dataset:
    tables = read_toml(path)
    table = tables.get("measured", {}).get("branch") if isinstance(tables.get("measured"), dict) else None
    if table is None:
        raise SpecError(f"{path}: has no table [measured.branch]; give one, or a CSV file of orbits.")
    problems: list[str] = []
    spec = checked(MeasuredBranch, table, "measured.branch", problems)
    if spec is None:
        raise SpecError([f"{path}: {p}" for p in problems])
    reference = spec.model or tables.get("model")
    if not reference:
        raise SpecError(f"{path}: measured.branch.model: missing; name the model whose orbits were measured.")
    model = add_model(reference, path.parent, problems)
    if model is not None:
        problems += _name_problems(model, spec.parameter, spec.state)
    problems += [
        f"measured.branch.orbits: {one.name!r} has no file." for one in spec.orbits if not (one.file or spec.file)
    ]
    if problems or model is None:
        raise SpecError([f"{path}: {p}" for p in problems])
    rows, cycles = [], []
    for one in spec.orbits:
        rows.append({"name": one.name, "value": one.value, "stable": one.stable})
        cycles.append(_recorded(path, spec, reference, one))
    return _dataset(
        model, spec.parameter, spec.state, rows, [_columns_of(c) for c in cycles], [c.harmonics for c in cycles]
    )


def _recorded(path: Path, spec: MeasuredBranch, reference: Any, one: RecordedOrbit) -> Cycles:
    channel: dict[str, Any] = {"channel": one.channel}
    channel |= {"unit": spec.unit} if spec.unit else {}
    channel |= {"scale": spec.scale} if spec.scale is not None else {}
    rate = {"sampling_rate_hz": spec.sampling_rate_hz} if spec.sampling_rate_hz else {}
    mapping = parse_mapping({"model": reference, "channels": {spec.state: channel}, **rate}, str(path), path.parent)
    recording = read_recording(path.parent / (one.file or spec.file), mapping)
    try:
        return cycles_of(recording["time"].values, recording[spec.state].values)
    except CyclesError as error:
        raise SpecError(f"{path}: measured.branch.orbits: {one.name!r}: {error}") from None


def _columns_of(cycles: Cycles) -> dict[str, float]:
    return {name: float(getattr(cycles, name)) for name in _NUMBERS} | {"n_cycles": cycles.n}


# ---- tables ------------------------------------------------------------------------------------


def _from_csv(path: Path, model: Model | None, state: str) -> xr.Dataset:
    if model is None:
        raise SpecError(
            f"{path}: a table of orbits names no model; name it with --model, or give the run that it is compared "
            "with: --over RUN."
        )
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *lines = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(f"{path}: cannot be read as a CSV table ({error}).") from None
    lines = [line for line in lines if any(field.strip() for field in line)]
    if len(header) > 1 and header[0].strip() == "name":
        # as magpend writes it: the name, then the parameter
        header, *lines = ([*line[1:2], *line[:1], *line[2:]] for line in (header, *lines))
    if not header or not lines:
        raise SpecError(f"{path}: has no rows; give a header and a row for each orbit.")
    # by position, since the parameter may have the name of another column
    parameter, *others = (name.strip() for name in header)
    chosen = state or model.section_states[0]
    problems = _name_problems(model, parameter, chosen)
    problems += [
        f"column {name!r}: {near_names(name, _KNOWN, 'columns')}" for name in others if name not in _KNOWN and name
    ]
    if "amplitude" not in others:
        problems.append("column 'amplitude': missing; give half of the peak-to-peak value of each orbit.")
    rows, columns = [], []
    for i, (first, *rest) in enumerate(lines, 2):
        line = dict(zip(others, rest, strict=False))
        found = {name: _number(line.get(name), f"row {i}, {name}", problems) for name in _NUMBERS}
        found |= {name: _number(line.get(name), f"row {i}, {name}", problems) for name in ("n_cycles", *_HARMONICS)}
        word = (line.get("stable") or line.get("stability") or "unknown").strip().lower()
        if word not in _YES:
            problems.append(f"row {i}, stable = {word!r}: must be yes, no or unknown.")
        value = _number(first, f"row {i}, {parameter}", problems)
        if not math.isfinite(value):
            problems.append(f"row {i}, {parameter}: missing; each orbit needs the parameter's value.")
        if not math.isfinite(found["amplitude"]):
            problems.append(f"row {i}, amplitude: missing; each orbit needs one.")
        rows.append({"name": line.get("name") or f"orbit {i - 1}", "value": value, "stable": word})
        columns.append(found | {"n_cycles": int(np.nan_to_num(found["n_cycles"]))})
    if problems:
        raise SpecError([f"{path}: {p}" for p in problems])
    harmonics = [np.array([c[name] for name in _HARMONICS]) for c in columns] if set(_HARMONICS) & set(others) else None
    return _dataset(model, parameter, chosen, rows, columns, harmonics)


def _number(text: str | None, where: str, problems: list[str]) -> float:
    if text is None or not text.strip():
        return math.nan
    try:
        return float(text)
    except ValueError:
        problems.append(f"{where} = {text!r}: must be a number.")
        return math.nan


def _name_problems(model: Model, parameter: str, state: str) -> list[str]:
    names = (*model.parameter_names, *(() if model.crossing is not None else (FREQUENCY_DIM,)))
    found = [] if axis_name(parameter) in names else [unknown_name("parameter", parameter, names)]
    return found + ([] if state in model.state_names else [unknown_name("state", state, model.state_names)])


def _dataset(
    model: Model,
    parameter: str,
    state: str,
    rows: list[dict[str, Any]],
    columns: list[dict[str, float]],
    harmonics: list[np.ndarray] | None,
) -> xr.Dataset:
    unit = model.state(state).unit
    units = {"frequency": "Hz"}
    variables: dict[str, Any] = {
        "value": ("orbit", [row["value"] for row in rows], {"units": parameter_units(axis_name(parameter), model)}),
        "stability": (
            "orbit",
            np.array([STABILITIES.index(_YES[str(row["stable"])]) for row in rows], np.int8),
            {**code_flags(STABILITIES), "units": "1"},
        ),
        "n_cycles": ("orbit", np.array([c["n_cycles"] for c in columns], np.int32), {"units": "1"}),
    }
    for name in _NUMBERS:
        about = {"units": units.get(name.removesuffix("_sd"), unit), "long_name": _LONG[name.removesuffix("_sd")]}
        variables[name] = ("orbit", [c[name] for c in columns], about)
    if harmonics is not None:
        about = {"units": unit, "long_name": "amplitude of the Fourier component"}
        variables["harmonic"] = (("orbit", "order"), np.array(harmonics), about)
    coords: dict[str, Any] = {"name": ("orbit", [row["name"] for row in rows])}
    coords |= {"order": ("order", np.arange(1, N_HARMONICS + 1))} if harmonics is not None else {}
    attrs = {"model": model_attribute(model), "parameter": axis_name(parameter), "state": state}
    return xr.Dataset(variables, coords, attrs)


_LONG: Mapping[str, str] = {
    "amplitude": "half of the peak-to-peak value",
    "mean": "mean over a cycle",
    "frequency": "frequency of the cycles",
}
