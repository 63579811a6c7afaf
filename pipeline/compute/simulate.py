"""One trajectory: a labelled time series, as CSV or NetCDF and as a figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models import load_model
from pipeline.spec.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr

SUFFIXES = (".csv", ".nc")
STATES, STATE_UNITS = load_model().state_names, load_model().state_units
MAX_SAMPLES = 100_000_000
_NAMES = ("angle of link 1", "angle of link 2", "rate of link 1", "rate of link 2")


def simulate(
    frequency_hz: float,
    initial_state: Sequence[float],
    *,
    preset: str = "wojna2018",
    overrides: Mapping[str, float] | None = None,
    n_transient: int = 0,
    n_periods: int = 10,
    samples_per_period: int = 200,
    rtol: float = 1e-8,
    atol: float = 1e-8,
) -> xr.Dataset:
    """Integrate one trajectory from a rising edge of the drive.

    Parameters
    ----------
    frequency_hz
        Drive frequency [Hz].
    initial_state
        psi1, psi2 [rad], psi1_dot, psi2_dot [rad/s] at time 0.
    preset, overrides
        Parameters by name, see `magpend_core.load_preset`.
    n_transient
        Drive periods before the series begins.
    n_periods, samples_per_period
        Length and density of the series; both ends are included.
    rtol, atol
        Tolerances.

    Returns
    -------
    xarray.Dataset
        The states and the drive's ``torque`` over ``time`` [s since the first rising edge]; angles are
        not wrapped.

    Raises
    ------
    SpecError
        With all that is wrong with the arguments.
    ArithmeticError
        If the trajectory diverges or meets the step limit.
    """
    import xarray as xr

    from magpend_core import ParameterError, load_preset, torques, trajectory

    problems = _problems(frequency_hz, initial_state, n_transient, n_periods, samples_per_period, rtol, atol)
    try:
        parameters = load_preset(preset, **(overrides or {}))
    except ParameterError as error:
        problems += error.problems
    if problems:
        raise SpecError(problems)
    count = n_periods * samples_per_period + 1
    time = (n_transient + np.arange(count) / samples_per_period) / frequency_hz
    state = np.array(initial_state, dtype=np.float64)
    series = trajectory(parameters, frequency_hz, state, time, rtol=rtol, atol=atol)
    drive = torques(time, series, parameters, frequency_hz).drive
    variables: dict[str, Any] = {
        name: ("time", series[:, i], {"units": STATE_UNITS[i], "long_name": _NAMES[i]})
        for i, name in enumerate(STATES)
    }
    variables["torque"] = ("time", np.asarray(drive), {"units": "N m", "long_name": "driving torque"})
    axis = ("time", time, {"units": "s", "long_name": "time since the first rising edge of the drive"})
    attrs = {
        "title": "trajectory of the forced double pendulum",
        "frequency_hz": float(frequency_hz),
        "initial_state": state,
        "n_transient": n_transient,
        "rtol": rtol,
        "atol": atol,
        "preset": preset,
        **{f"parameter_{name}": value for name, value in parameters.as_dict().items()},
    }
    return xr.Dataset(variables, coords={"time": axis}, attrs=attrs)


def _problems(
    frequency_hz: float,
    state: Sequence[float],
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
    found += [
        f"{n} = {v!r}: must be a finite number."
        for n, v in zip(STATES, state, strict=True)
        if not math.isfinite(v)
    ]
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
    names = ["time", *STATES, "torque"]
    units = [ds[name].attrs["units"].replace("/", "_per_").replace(" ", "_") for name in names]
    table = np.column_stack([ds[name].values for name in names])
    header = ",".join(f"{name}_{unit}" for name, unit in zip(names, units, strict=True))
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")
    return path
