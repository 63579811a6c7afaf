"""Read measured orbits along a parameter from a table or from recordings, and compare them with computed branches."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from pydantic import Field

from magpend_core.models.model import Model
from magpend_core.models.parameters import near_names
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import spelling_of
from pipeline.layout.vocabulary import axes_of, model_attribute, model_of, parameter_name, parameter_units
from pipeline.products.product import Table
from pipeline.results.points import OWN, PointFile
from pipeline.results.tabular import Row, Words, aligned, counted, number, values, words_of
from pipeline.rig.recordings import parse_mapping, read_recording
from pipeline.specification import tables as specification
from pipeline.specification.files import read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, unknown_name

# ---- cycles ----------------------------------------------------------------------------------------

N_HARMONICS = 3
"""Harmonics that are measured, the first included."""


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

    Samples that are not finite end the signal. Raise `CyclesError` if there are fewer than 3 whole cycles.
    """
    least = 3
    last = len(values) if np.isfinite(values).all() else int(np.argmin(np.isfinite(values)))
    time, values = time[:last], values[:last]
    starts = _upward_crossings(time, values)
    if len(starts) < least + 1:
        raise CyclesError(f"the signal has {max(len(starts) - 1, 0)} whole cycles; at least {least} are needed.")
    found = np.array([_cycle(time, values, a, b) for a, b in itertools.pairwise(starts)])
    middle, scatter = np.median(found, axis=0), np.std(found, axis=0, ddof=1)
    return Cycles(len(found), middle[0], scatter[0], middle[1], scatter[1], middle[2], scatter[2], middle[3:])


def _upward_crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the times [s] at which a signal that was below a band about its mean rises through the mean."""
    # band about the mean that a cycle must cross, in units of the signal's standard deviation: noise crosses less
    hysteresis = 0.3
    if len(values) < 2:
        return np.zeros(0)
    away = values - values.mean()
    band = hysteresis * away.std()
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
_BESIDE = " (parameter)"
"""Suffix of the parameter's name in tables if another column has the name."""
_KNOWN = ("name", "stable", "stability", "n_cycles", *_NUMBERS, *_HARMONICS)


class RecordedOrbit(specification.Table):
    """Table ``[[measured.branch.orbits]]``: recording of one orbit."""

    name: str = Field(min_length=1, description="Name of the orbit.")
    value: float = Field(description="Value of the parameter [SI].")
    stable: Literal["yes", "no", "unknown"] = Field(default="unknown", description="Whether the orbit is stable.")
    file: str = Field(
        default="", description="Recording, relative to the specification; by default that of the branch."
    )
    channel: str = Field(description="Channel of the state, as magpend recordings show lists it.")


class MeasuredBranch(specification.Table):
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

    The first column of a CSV file is the parameter of `model`, in any spelling (`pipeline.results.points`). Others are
    ``amplitude``, ``amplitude_sd``, ``mean``, ``frequency`` (with ``_sd``), ``stable`` (yes, no, unknown) and ``name``.
    The tables that ``magpend measured branch --csv`` writes can be read as well. `state` is by default the model's
    first. Return over the dim ``orbit`` the parameter's ``value``, ``amplitude``, ``mean`` and ``frequency`` with the
    scatter ``..._sd``, ``harmonic`` amplitudes, ``stability`` (codes of `STABILITIES`), ``n_cycles``; NaN where
    unknown.

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
        axis, convert = spelling_of(spec.parameter, model)
        problems += _name_problems(model, axis, spec.state, spec.parameter)
    problems += [
        f"measured.branch.orbits: {one.name!r} has no file." for one in spec.orbits if not (one.file or spec.file)
    ]
    if problems or model is None:
        raise SpecError([f"{path}: {p}" for p in problems])
    rows, cycles = [], []
    for one in spec.orbits:
        rows.append({"name": one.name, "value": convert(one.value), "stable": one.stable})
        cycles.append(_recorded(path, spec, reference, one))
    return _dataset(model, axis, spec.state, rows, [_columns_of(c) for c in cycles], [c.harmonics for c in cycles])


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
    file = PointFile.read(path)
    # by position, since the parameter may have the name of another column; magpend writes the name before it
    first = 1 if file.header[0] == "name" and len(file.header) > 1 else 0
    parameter = file.header[first]
    others = {name: file.place(name, {name}, first + 1) for name in _KNOWN[1:]}
    others["name"] = 0 if first else file.place("name", {"name"}, 1)
    own = parameter.removesuffix(_BESIDE).removeprefix(OWN)
    axis, convert = spelling_of(own if own in _KNOWN else parameter, model)
    chosen = state or model.section_states[0]
    file.problems.extend(_name_problems(model, axis, chosen, parameter))
    file.problems.extend(
        f"column {name!r}: {near_names(name, _KNOWN, 'columns')}"
        for name in file.header[first + 1 :]
        if name not in _KNOWN and name
    )
    if others["amplitude"] < 0:
        file.problems.append("column 'amplitude': missing; give half of the peak-to-peak value of each orbit.")
    own_values = file.numbers(first, convert, needed=True)
    found = {
        name: file.numbers(others[name], needed=name == "amplitude") for name in (*_NUMBERS, "n_cycles", *_HARMONICS)
    }
    rows = _words_of_rows(file, others, own_values)
    file.refuse()
    columns = [{name: float(found[name][i]) for name in _NUMBERS} for i in range(len(rows))]
    for one, n_cycles in zip(columns, np.nan_to_num(found["n_cycles"]), strict=True):
        one["n_cycles"] = int(n_cycles)
    harmonics = None
    if any(others[name] >= 0 for name in _HARMONICS):
        harmonics = list(np.transpose([found[name] for name in _HARMONICS]))
    return _dataset(model, axis, chosen, rows, columns, harmonics)


def _words_of_rows(file: PointFile, places: Mapping[str, int], own: np.ndarray) -> list[dict[str, Any]]:
    """Return the name, the parameter's value and the stability of each row, and note problems of the stability."""
    rows = []
    for i, (line, row) in enumerate(zip(file.lines, file.rows, strict=True), 1):
        name, *words = (row[places[k]] if places[k] >= 0 else "" for k in ("name", "stable", "stability"))
        word = (words[0] or words[1] or "unknown").lower()
        if word not in _YES:
            file.problems.append(f"row {line}, stable = {word!r}: must be yes, no or unknown.")
        rows.append({"name": name or f"orbit {i}", "value": own[i - 1], "stable": word})
    return rows


def _name_problems(model: Model, axis: str, state: str, parameter: str) -> list[str]:
    """Return problems of the axis, which the table calls `parameter`, and of the state."""
    names = axes_of(model)
    found = [] if axis in names else [unknown_name("parameter", parameter, names)]
    return found + ([] if state in model.state_names else [unknown_name("state", state, model.state_names)])


def _dataset(
    model: Model,
    axis: str,
    state: str,
    rows: list[dict[str, Any]],
    columns: list[dict[str, float]],
    harmonics: list[np.ndarray] | None,
) -> xr.Dataset:
    unit = model.state(state).unit
    units = {"frequency": "Hz"}
    variables: dict[str, Any] = {
        "value": ("orbit", [float(row["value"]) for row in rows], {"units": parameter_units(axis, model)}),
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
    attrs = {"model": model_attribute(model), "parameter": axis, "state": state}
    return xr.Dataset(variables, coords, attrs)


_LONG: Mapping[str, str] = {
    "amplitude": "half of the peak-to-peak value",
    "mean": "mean over a cycle",
    "frequency": "frequency of the cycles",
}


# ---- comparison ------------------------------------------------------------------------------------


def compare(measured: xr.Dataset, branches: xr.Dataset, computed: np.ndarray) -> xr.Dataset:
    """Find the computed orbit nearest to each measured one. It must have the measured stability, if that is known.

    `branches` is the result of the analysis ``branches`` along the same parameter, `computed` that of `amplitudes`.
    Return `measured` with ``computed_amplitude``, ``computed_frequency``, ``relative_error`` of the amplitude and
    ``frequency_error`` (computed over measured, less 1), ``distance`` (difference of the amplitudes in units of their
    scatter, NaN without one), and ``branch``, -1 where no computed orbit has the parameter's value and the stability.
    """
    if str(branches.attrs["parameter"]) != str(measured.attrs["parameter"]):
        raise SpecError(
            f"the orbits were measured along {measured.attrs['parameter']}, and the branches of the run follow "
            f"{branches.attrs['parameter']}; give a run that sweeps {measured.attrs['parameter']}."
        )
    n = measured.sizes["orbit"]
    amplitude, frequency = np.full(n, np.nan), np.full(n, np.nan)
    chosen = np.full(n, -1, np.int32)
    for k in range(n):
        best = _nearest(measured.isel(orbit=k), branches, computed)
        if best is not None:
            chosen[k], amplitude[k], frequency[k] = best
    error = amplitude / measured["amplitude"].values - 1.0
    scatter = measured["amplitude_sd"].where(measured["amplitude_sd"] > 0.0).values
    columns = {
        "computed_amplitude": (amplitude, measured["amplitude"].attrs["units"]),
        "computed_frequency": (frequency, "Hz"),
        "relative_error": (error, "1"),
        "frequency_error": (frequency / measured["frequency"].values - 1.0, "1"),
        "distance": ((amplitude - measured["amplitude"].values) / scatter, "1"),
        "branch": (chosen, "1"),
    }
    return measured.assign({name: ("orbit", array, {"units": unit}) for name, (array, unit) in columns.items()})


def _nearest(one: xr.Dataset, branches: xr.Dataset, computed: np.ndarray) -> tuple[int, float, float] | None:
    place = nearest_orbit(branches, computed, float(one["value"]), int(one["stability"]), float(one["amplitude"]))
    if place is None:
        return None
    i, j, share = place
    rates = int(branches["orbit_period"][i]) / branches["period_s"].values[i, j : j + 2]
    amplitude = float(computed[i, j] + share * (computed[i, j + 1] - computed[i, j]))
    return i, amplitude, float(rates[0] + share * (rates[1] - rates[0]))


def nearest_orbit(
    branches: xr.Dataset, computed: np.ndarray, value: float, stability: int, amplitude: float, period: int = 0
) -> tuple[int, int, float] | None:
    """Find the computed orbit at a value of the parameter whose amplitude is nearest to a given one.

    Only orbits of the `stability` (a code of `STABILITIES`) count, unless it is unknown, and only those of the
    `period`, unless it is 0. Return branch, index of the point before the value, and the share of the way to the next
    point.
    """
    # amplitude, in units of the measured one, below which a computed orbit is an equilibrium that a trajectory nears
    at_rest = 1e-3
    best, least = None, np.inf
    for i in range(branches.sizes["branch"]):
        n, own = int(branches["n_points"][i]), int(branches["orbit_period"][i])
        if not own or (period and own != period):
            continue
        x, unstable = branches["parameter"].values[i, :n], branches["n_unstable"].values[i, :n] > 0
        for j in np.flatnonzero((x[:-1] - value) * (x[1:] - value) <= 0.0):
            near = j if abs(x[j] - value) <= abs(x[j + 1] - value) else j + 1
            if stability and unstable[near] != (stability == 2):
                continue
            share = (value - x[j]) / (x[j + 1] - x[j]) if x[j + 1] != x[j] else 0.0
            size = float(computed[i, j] + share * (computed[i, j + 1] - computed[i, j]))
            if abs(size - amplitude) < least and size > at_rest * amplitude:
                best, least = (i, int(j), share), abs(size - amplitude)
    return best


def rms_of(measured: xr.Dataset, stability: str) -> float:
    """Return the root mean square of the relative amplitude errors of all measured orbits with a given stability."""
    words = words_of(measured["stability"])
    errors = measured["relative_error"].values[measured["stability"].values == words.index(stability)]
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")


def branch_table(measured: xr.Dataset) -> Table:
    """Return a table of the measured orbits, with their distances from the computed branches if they were compared."""
    name = parameter_name(str(measured.attrs["parameter"]))
    name = f"{name}{_BESIDE}" if name in _KNOWN else name
    rows = [_row(measured.isel(orbit=k), name) for k in range(measured.sizes["orbit"])]
    lines = [f"{counted(len(rows), 'measured orbit')} of {measured.attrs['state']} along {name}"]
    unit = _unit(measured)
    lines += aligned([_words(row, name, unit) for row in rows])
    if "relative_error" in measured:
        lines += [""] + [
            f"{word} orbits: root mean square of the amplitudes' relative errors {100.0 * rms:.1f} %"
            for word in words_of(measured["stability"])
            if np.isfinite(rms := rms_of(measured, word))
        ]
        lost = [row["name"] for row in rows if row["branch"] < 0]
        lines += [f"no computed orbit of that stability: {', '.join(lost)}"] if lost else []
    return Table(rows, lines)


def _unit(measured: xr.Dataset) -> str:
    unit = model_of(measured).state(str(measured.attrs["state"])).unit
    return "" if unit == "1" else f" {unit}"


_SHOWN = ("amplitude", "amplitude_sd", "mean", "mean_sd", "frequency", "frequency_sd", "n_cycles")
_COMPARED = ("computed_amplitude", "computed_frequency", "relative_error", "frequency_error", "distance", "branch")


def _row(one: xr.Dataset, parameter: str) -> Row:
    harmonics = {}
    if "harmonic" in one:
        harmonics = {f"harmonic_{int(k)}": float(one["harmonic"].sel(order=k)) for k in one["order"].values}
    first = {"name": str(one["name"].item()), parameter: float(one["value"]), **values(one, "stability")}
    return {**first, **values(one, *_SHOWN), **harmonics, **values(one, *_COMPARED)}


def _words(row: Row, parameter: str, unit: str) -> Words:
    words = {
        "orbit": row["name"],
        parameter: f"{row[parameter]:g}",
        "stability": row["stability"],
        f"amplitude{unit}": _with_scatter(row["amplitude"], row["amplitude_sd"]),
        "frequency Hz": _with_scatter(row["frequency"], row["frequency_sd"]),
    }
    if "distance" not in row:
        return words
    return words | {
        "computed": number(row["computed_amplitude"], ".4g"),
        "error %": number(100.0 * row["relative_error"], "+.1f"),
        "in scatters": number(row["distance"], "+.1f"),
        "frequency error %": number(100.0 * row["frequency_error"], "+.2f"),
    }


def _with_scatter(value: float, scatter: float) -> str:
    text = number(value, ".4g")
    return f"{text} ± {scatter:.1g}" if np.isfinite(scatter) and np.isfinite(value) else text
