"""Compare measured orbits with the computed branches of a run. Differences are given in per cent and in units of the
measured scatter.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import Row, Words, aligned, counted, number, values, words_of
from pipeline.layout.vocabulary import model_of, parameter_name
from pipeline.products.product import Table
from pipeline.specification.problems import SpecError

REST = 1e-3
"""Amplitude, in units of the measured one, below which a computed orbit is an equilibrium that a trajectory nears."""


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
            if abs(size - amplitude) < least and size > REST * amplitude:
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
    name = f"{name} (parameter)" if name in _COLUMNS else name
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


_COLUMNS = ("amplitude", "amplitude_sd", "mean", "mean_sd", "frequency", "frequency_sd", "n_cycles")
_COMPARED = ("computed_amplitude", "computed_frequency", "relative_error", "frequency_error", "distance", "branch")


def _row(one: xr.Dataset, parameter: str) -> Row:
    harmonics = {}
    if "harmonic" in one:
        harmonics = {f"harmonic_{int(k)}": float(one["harmonic"].sel(order=k)) for k in one["order"].values}
    first = {"name": str(one["name"].item()), parameter: float(one["value"]), **values(one, "stability")}
    return {**first, **values(one, *_COLUMNS), **harmonics, **values(one, *_COMPARED)}


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
