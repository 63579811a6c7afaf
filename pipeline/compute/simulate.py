"""One trajectory: a labelled time series, as CSV or NetCDF and as a figure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models import DEFAULT, load_model
from magpend_core.models.model import Model
from magpend_core.models.presets import Preset
from pipeline.spec.problems import SpecError, unknown_name

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.parameters import Parameters

SUFFIXES = (".csv", ".nc")
MAX_SAMPLES = 100_000_000
DEGREES = "_deg"


def simulate(
    frequency_hz: float,
    initial_state: Sequence[float],
    *,
    model: str = DEFAULT,
    preset: str | Path | Preset | None = None,
    overrides: Mapping[str, float] | None = None,
    n_transient: int = 0,
    n_periods: int = 10,
    samples_per_period: int = 200,
    rtol: float = 1e-8,
    atol: float = 1e-8,
) -> xr.Dataset:
    """Integrate one trajectory from the instant of a section.

    Parameters
    ----------
    frequency_hz
        Drive frequency [Hz].
    initial_state
        The model's states at time 0, in their units.
    model
        Name of a model, see `magpend_core.load_model`.
    preset, overrides
        Name or file of a preset and parameters by name, see `magpend_core.models.model.Model.load`.
    n_transient
        Drive periods before the series begins.
    n_periods, samples_per_period
        Length and density of the series; both ends are included.
    rtol, atol
        Tolerances.

    Returns
    -------
    xarray.Dataset
        The states and the model's quantities over ``time`` [s since the first section]; angles are not
        wrapped.

    Raises
    ------
    SpecError
        With all that is wrong with the arguments.
    ArithmeticError
        If the trajectory diverges or meets the step limit.
    """
    from magpend_core import trajectory
    from magpend_core.models.parameters import ParameterError

    chosen = load_model(model)
    problems = _problems(frequency_hz, n_transient, n_periods, samples_per_period, rtol, atol)
    problems += _state_problems(chosen, initial_state)
    try:
        found = chosen.preset(preset)
        parameters = chosen.load(found, **(overrides or {}))
    except ParameterError as error:
        problems += error.problems
    if problems:
        raise SpecError(problems)
    count = n_periods * samples_per_period + 1
    time = (n_transient + np.arange(count) / samples_per_period) / frequency_hz
    state = np.array(initial_state, dtype=np.float64)
    series = trajectory(parameters, frequency_hz, state, time, rtol=rtol, atol=atol)
    ds = _labelled(parameters, frequency_hz, time, series)
    origin = {**found.provenance, **dict.fromkeys(overrides or {}, "given")}
    sources = "\n".join(f"{name}: {origin.get(name, '')}" for name in parameters)
    return ds.assign_attrs(
        preset=found.name, sources=sources, initial_state=state, n_transient=n_transient, rtol=rtol, atol=atol
    )


def _labelled(
    parameters: Parameters, frequency_hz: float, time: np.ndarray, series: np.ndarray
) -> xr.Dataset:
    """States and quantities of a series, with names, units and what was integrated."""
    import xarray as xr

    from magpend_core import evaluate

    model = parameters.model
    variables: dict[str, Any] = {
        s.name: ("time", series[:, i], {"units": s.unit, "long_name": s.meaning})
        for i, s in enumerate(model.states)
    }
    if model.quantities:
        names = [q.name for q in model.quantities]
        values = evaluate(names, time, series, parameters, frequency_hz)
        for i, q in enumerate(model.quantities):
            variables[q.name] = ("time", values[:, i], {"units": q.unit, "long_name": q.meaning})
    axis = ("time", time, {"units": "s", "long_name": f"time since {model.section}"})
    attrs = {
        "title": f"trajectory of the {model.title}",
        "model": model.name,
        "parameters": "\n".join(f"{name} = {value!r}" for name, value in parameters.as_dict().items()),
        "frequency_hz": float(frequency_hz),
    }
    return xr.Dataset(variables, coords={"time": axis}, attrs=attrs)


def start_of(model: str, given: Mapping[str, float]) -> tuple[float, ...]:
    """Initial state of a model from values by name: a state's, or an angle's or rate's in degrees.

    Parameters
    ----------
    model
        Its name.
    given
        By name: ``x``, or ``x_deg`` of a state in rad or rad/s; the others are 0.

    Raises
    ------
    SpecError
        If a name is unknown, or a state is given twice.
    """
    found = load_model(model)
    in_degrees = [f"{s.name}{DEGREES}" for s in found.states if s.unit.startswith("rad")]
    problems, values = [], dict.fromkeys(found.state_names, 0.0)
    for name, value in given.items():
        plain = name.removesuffix(DEGREES) if name in in_degrees else name
        if plain not in values:
            problems.append(unknown_name(f"state of {model}", name, (*found.state_names, *in_degrees)))
        elif plain != name and plain in given:
            problems.append(f"{plain} and {name} are both given; keep one.")
        else:
            values[plain] = math.radians(value) if plain != name else value
    if problems:
        raise SpecError(problems)
    return tuple(values.values())


def _state_problems(model: Model, state: Sequence[float]) -> list[str]:
    names = model.state_names
    if len(state) != len(names):
        return [f"initial_state has {len(state)} numbers: {model.name} has the states {', '.join(names)}."]
    return [
        f"{name} = {value!r}: must be a finite number."
        for name, value in zip(names, state, strict=True)
        if not math.isfinite(value)
    ]


def _problems(
    frequency_hz: float,
    n_transient: int,
    n_periods: int,
    samples: int,
    rtol: float,
    atol: float,
) -> list[str]:
    found = []
    for name, value in {"frequency_hz": frequency_hz, "rtol": rtol, "atol": atol}.items():
        if not (math.isfinite(value) and value > 0):
            found.append(f"{name} = {value!r}: must be a finite number greater than 0.")
    if 0 < rtol < 1e-13:
        found.append(f"rtol = {rtol!r}: must be at least 1e-13.")
    for name, number, least in (
        ("n_transient", n_transient, 0), ("n_periods", n_periods, 1), ("samples_per_period", samples, 1),
    ):  # fmt: skip
        if number < least:
            found.append(f"{name} = {number!r}: must be at least {least}.")
    if n_periods * samples > MAX_SAMPLES:
        found.append(
            f"n_periods * samples_per_period = {n_periods * samples}: must be at most {MAX_SAMPLES}."
        )
    return found


def check_output(path: Path) -> None:
    """Raise `SpecError` if a series cannot be written there."""
    if path.suffix.lower() not in SUFFIXES:
        raise SpecError([f"{path}: the suffix must be one of {', '.join(SUFFIXES)}."])
    if not path.parent.is_dir():
        raise SpecError([f"{path.parent}: no such folder; make it first."])


def write_series(ds: xr.Dataset, path: Path) -> Path:
    """Write a series as CSV (names with units, 17 digits) or as NetCDF, by the suffix."""
    check_output(path)
    if path.suffix.lower() == ".nc":
        ds.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")
        return path
    names = ["time", *map(str, ds.data_vars)]
    units = [re.sub(r"\W+", "_", ds[name].attrs["units"].replace("/", "_per_")) for name in names]
    table = np.column_stack([ds[name].values for name in names])
    header = ",".join(f"{name}_{unit}" for name, unit in zip(names, units, strict=True))
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")
    return path
