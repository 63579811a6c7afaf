"""Tabulate escapes and densities of noisy runs."""

from __future__ import annotations

import numpy as np
import xarray as xr

from pipeline.analysis.noise.escapes import strength_dim
from pipeline.analysis.tabular import Row, Words, aligned, at_point, number, points_of, unit_of, values, words_of
from pipeline.products.product import Table

_ESCAPE = (
    "n_cells",
    "n_left",
    "at_risk",
    "rate",
    "rate_low",
    "rate_high",
    "rate_halved",
    "left_share",
    "left_low",
    "left_high",
    "constant_p",
)
_UNEVEN = 0.01
"""Level below which a rate counts as changing along the record."""


def escapes_table(ds: xr.Dataset) -> Table:
    """Return a row per parameter point and set: cells, cells that left, rate with interval, where they went."""
    dims = [str(d) for d in ds["rate"].dims if d != "set"]
    sets = words_of(ds["set"])
    targets = words_of(ds["set"])
    rows: list[Row] = []
    for at, where in points_of(ds, dims):
        for k in range(ds.sizes["set"]):
            one = ds.isel({**at, "set": k})
            row = {**where, "begins": sets[int(one["set"])], **values(one, *_ESCAPE)}
            row |= {f"to_{word}": int(n) for word, n in zip(targets, one["n_to"].values, strict=False)}
            row |= {f"exit_{s}": float(one["exit_mean"].sel(state=s)) for s in ds["state"].values.tolist()}
            rows.append(row)
    level = f"{100 * ds.attrs['confidence']:g} %"
    looked = "in every step" if np.isfinite(ds["rate_halved"]).any() else "at the sections"
    lines = [
        f"escapes, looked for {looked}, intervals of {level}",
        *aligned([_escape_words(ds, row, dims) for row in rows]),
    ]
    lines += [line for row in rows if (line := _uneven_line(ds, row, dims))]
    lines += _kramers_lines(ds, dims)
    return Table(rows, lines, "" if any(row["n_cells"] for row in rows) else "no cell begins in the set")


def _escape_words(ds: xr.Dataset, row: Row, dims: list[str]) -> Words:
    to = ", ".join(f"{n} {key[3:]}" for key, n in row.items() if key.startswith("to_") and n)
    mean = 1.0 / row["rate"] if 0.0 < row["rate"] < np.inf else np.nan
    interval = f"{number(row['rate_low'], '.3g')} to {number(row['rate_high'], '.3g')}"
    halved = {} if np.isnan(row["rate_halved"]) else {"halved steps": number(row["rate_halved"], ".4g")}
    return {
        **at_point(ds, row, dims),
        "begins": row["begins"],
        "cells": str(row["n_cells"]),
        "left": str(row["n_left"]),
        "to": to or "-",
        "rate [1/s]": number(row["rate"], ".4g"),
        "interval": interval,
        **halved,
        "mean time [s]": number(mean, ".4g"),
    }


def _uneven_line(ds: xr.Dataset, row: Row, dims: list[str]) -> str:
    """Return a warning if cells leave at another rate early in the record than late."""
    if not row["constant_p"] < _UNEVEN:
        return ""
    place = ", ".join(f"{d} {row[d]:g}{unit_of(ds, d)}" for d in dims)
    return (
        f"  warning: {place or 'here'}: the rate early in the record differs from that late in it "
        f"(p = {row['constant_p']:.1g}); raise n_transient or --skip, or the set holds more than one attractor"
    )


def _kramers_lines(ds: xr.Dataset, dims: list[str]) -> list[str]:
    """Return the lines on the fit of Kramers' law."""
    if "barrier" not in ds:
        return []
    along = strength_dim(dims)
    others = [d for d in dims if d != along]
    lines = []
    for at, where in points_of(ds, others):
        for k in range(ds.sizes["set"]):
            one = ds.isel({**at, "set": k})
            place = ", ".join(f"{d} {v:g}{unit_of(ds, d)}" for d, v in where.items())
            head = f"  {place + ': ' if place else ''}{words_of(ds['set'])[int(one['set'])]}: "
            if not np.isfinite(float(one["barrier"])):
                lines.append(f"{head}no fit of Kramers' law: three strengths are needed, two of them with escapes")
                continue
            value, low, high = (float(one[name]) for name in ("barrier", "barrier_low", "barrier_high"))
            lines.append(
                f"{head}rate = {np.exp(float(one['log_factor'])):.4g} /s exp(-{value:.4g}/{along}²), exponent "
                f"{low:.4g} to {high:.4g}, {int(one['n_fitted'])} strengths, misfit p = {float(one['misfit_p']):.2g}"
            )
    return lines


_DENSITY = ("n_points", "n_effective", "variance", "skewness", "kurtosis", "bandwidth", "n_peaks")


def density_table(ds: xr.Dataset) -> Table:
    """Return a row per parameter point: points, moments, bandwidth, number and places of the peaks."""
    dims = [str(d) for d in ds["n_peaks"].dims]
    state = str(ds.attrs["density_of"])
    rows: list[Row] = []
    for at, where in points_of(ds, dims):
        one = ds.isel(at)
        row = {**where, "state": state, "mean": float(one["mean"].sel(state=state)), **values(one, *_DENSITY)}
        rows.append(row | {"peaks": [float(x) for x in one["peak"].values if np.isfinite(x)]})
    rule = "Silverman's rule with the effective number of points"
    lines = [f"density of {state} at the sections; bandwidth by {rule}"]
    lines += aligned([_density_words(ds, row, dims) for row in rows])
    for row in rows:
        row["peaks"] = " ".join(f"{x:.6g}" for x in row["peaks"])
    return Table(rows, lines)


def _density_words(ds: xr.Dataset, row: Row, dims: list[str]) -> Words:
    return {
        **at_point(ds, row, dims),
        "points": str(row["n_points"]),
        "independent": number(row["n_effective"], ".0f"),
        "mean": number(row["mean"], ".4g"),
        "variance": number(row["variance"], ".4g"),
        "skewness": number(row["skewness"], ".2f"),
        "kurtosis": number(row["kurtosis"], ".2f"),
        "bandwidth": number(row["bandwidth"], ".2g"),
        "peaks": f"{row['n_peaks']}: {', '.join(f'{x:.3g}' for x in sorted(row['peaks']))}",
    }
