"""Read a measured branch from a CSV table of orbits, or from recordings of orbits listed in a specification."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from pydantic import Field

from magpend_core.models.model import Model
from magpend_core.models.parameters import near_names
from pipeline.analysis.branches.units import parameter_units
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_attribute
from pipeline.rig.measured_branch.cycles import N_HARMONICS, Cycles, CyclesError, cycles_of
from pipeline.rig.recordings import parse_mapping, read_recording
from pipeline.specification.files import read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, unknown_name
from pipeline.specification.tables import Table

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
    """Read a measured branch from a CSV table of orbits, or from a specification of recorded orbits.

    Parameters
    ----------
    path
        A CSV file, or a TOML file with the table ``[measured.branch]``. The first column of a CSV file is the
        parameter; others are ``amplitude``, ``amplitude_sd``, ``mean``, ``frequency`` (with ``_sd``), ``stable``
        (yes, no, unknown) and ``name``. The tables that ``magpend measured branch --csv`` writes can be read as well.
    model
        Model of a CSV file; its parameter and state are looked up there.
    state
        State that a CSV file's amplitudes are of; by default the model's first.

    Returns
    -------
    Dataset
        Over the dim ``orbit``: the parameter's ``value``, ``amplitude``, ``mean`` and ``frequency`` with the scatter
        ``..._sd``, ``harmonic`` amplitudes, ``stability`` (codes of `STABILITIES`), ``n_cycles``; NaN where
        unknown.

    Raises
    ------
    SpecError
        If the file cannot be read, or for unknown or missing keys, columns and numbers; all at once.
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
