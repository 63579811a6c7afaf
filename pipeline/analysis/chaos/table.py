"""Tabulate chaos and correlation dimensions, with one row per attractor and parameter point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.per_attractor import Nature
from pipeline.analysis.ragged import dims_of
from pipeline.analysis.tabular import (
    FEW_POINTS,
    Row,
    Words,
    aligned,
    at_point,
    axis_ranges,
    counted,
    number,
    plain,
    point_table,
    points_of,
    sets_of,
    unit_of,
    values,
    with_error,
    with_interval,
)
from pipeline.layout.vocabulary import APERIODIC, KINDS, split_dims
from pipeline.products.product import Table

_FLAGS = {
    "n_transient": "transient",
    "n_contradicting": "closed with a positive exponent",
    "n_drifting": "drifting",
    "n_audit_failed": "audit failed",
    "n_unresolved": "unresolved",
    "n_failed": "failed",
}
_NUMBERS = ("kaplan_yorke", "kaplan_yorke_stderr", "correlation", "correlation_stderr", "correlation_spread")
_TEST = ("median_zero_one", "least_zero_one", "largest_zero_one")


def chaos_table(ds: xr.Dataset) -> Table:
    """Return the table of exponents, multipliers, dimensions and the 0-1 test, per attractor and parameter point."""
    dims, _ = split_dims(ds["motion"])
    rows = [{**where, **_row(one)} for where, one in sets_of(ds)]
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    lines = [f"{ds['motion'].size} cells at {counted(n_points, 'parameter point')}"]
    if n_points > FEW_POINTS:
        lines += _summary(ds, rows, dims)
    else:
        for _, where in points_of(ds, dims):
            lines += point_table(ds, where, rows, _words)
    lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return Table(rows, lines)


def _row(one: xr.Dataset) -> Row:
    names = ("kind", "stability", "nature", "orbit_period", "n_cells", "share", "exponents_from", *_FLAGS)
    return {
        "attractor_id": int(one["attractor"]),
        **values(one, *names),
        **_spectrum(one),
        **{name: float(one[f"attractor_{name}"]) for name in _NUMBERS},
        **values(one, *_TEST),
    }


def _spectrum(one: xr.Dataset) -> Row:
    frequency = float(one.coords["frequency"]) if "frequency" in one.coords else np.nan
    row: Row = {}
    for k in range(one.sizes["rank"]):
        for end in ("", "_stderr", "_between"):
            value = float(one[f"attractor_lyapunov{end}"][k])
            row |= {f"lyapunov_{k + 1}{end}": value, f"lyapunov_{k + 1}{end}_per_period": value / frequency}
    for k in range(one.sizes["multiplier"]):
        for part in ("real", "imag"):
            row[f"multiplier_{k + 1}_{part}"] = float(one[f"multiplier_{part}"][k])
    return row


def _words(row: Row) -> Words:
    return {
        "id": str(row["attractor_id"]),
        "kind": plain(row["kind"]),
        "stability": plain(row["stability"]),
        "motion": _nature_words(row),
        "period": str(row["orbit_period"] or "-"),
        "cells": str(row["n_cells"]),
        "share": f"{row['share']:.3f}",
        "exponents per s": _exponents(row),
        "|multipliers|": _multipliers(row),
        "Kaplan-Yorke": with_error(row["kaplan_yorke"], row["kaplan_yorke_stderr"]),
        "correlation": with_error(row["correlation"], row["correlation_stderr"]),
        "0-1 K": with_interval(row, _TEST, ".2f") if np.isfinite(row[_TEST[0]]) else None,
        "flags": _flags([row]) or "-",
    }


def _flags(rows: Sequence[Row]) -> str:
    counts = [(sum(row[name] for row in rows), text) for name, text in _FLAGS.items()]
    return ", ".join(f"{n} {text}" for n, text in counts if n)


def _nature_words(row: Row) -> str:
    return Nature[row["nature"].upper()].words


def _exponents(row: Row) -> str:
    known = [k for k in range(1, 100) if np.isfinite(row.get(f"lyapunov_{k}", np.nan))]
    return ", ".join(with_error(row[f"lyapunov_{k}"], row[f"lyapunov_{k}_stderr"], 4) for k in known) or "-"


def _multipliers(row: Row) -> str:
    moduli = [
        np.hypot(row[f"multiplier_{k}_real"], row[f"multiplier_{k}_imag"])
        for k in range(1, 100)
        if np.isfinite(row.get(f"multiplier_{k}_real", np.nan))
    ]
    return ", ".join(f"{m:.4g}" for m in moduli) or "-"


def _summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    """Return text lines on where each class of motion occurs, on the largest exponent, and on flagged cells."""
    table = []
    for nature in Nature:
        if own := [row for row in rows if row["nature"] == nature.name.lower()]:
            ids = sorted({row["attractor_id"] for row in own})
            words = {
                "motion": nature.words,
                "ids": ", ".join(map(str, ids[:8])) + (f" and {len(ids) - 8} more" if len(ids) > 8 else ""),
                "cells": str(sum(r["n_cells"] for r in own)),
                "points": str(len({tuple(row[d] for d in dims) for row in own})),
            }
            table.append(words | {f"{d}{unit_of(ds, d)}": axis_ranges(ds, d, own, len(dims) == 1) for d in dims})
    return aligned(table) + _extremes(ds, rows, dims) + [f"  cells flagged: {_flags(rows) or 'none'}"]


def _extremes(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    known = [row for row in rows if np.isfinite(row["lyapunov_1"])]
    if not known:
        return []
    row = max(known, key=lambda r: float(r["lyapunov_1"]))
    rate = with_error(row["lyapunov_1"], row["lyapunov_1_stderr"])
    period = with_error(row["lyapunov_1_per_period"], row["lyapunov_1_stderr_per_period"])
    place = ", ".join(f"{d} {row[d]:g}{unit_of(ds, d)}" for d in dims)
    who = f"attractor {row['attractor_id']}, {_nature_words(row)}"
    each = f", {period} per drive period" if period != "-" else ""
    return [f"  largest exponent: {rate} per s{each}, {who}, at {place}"]


# ---- correlation dimension ---------------------------------------------------------------------

_CURVE = (
    "correlation_dimension",
    "correlation_dimension_stderr",
    "correlation_dimension_spread",
    "fit_low",
    "fit_high",
    "largest_resolved",
)
_WHY = {
    "closed": "none: it closes",
    "does_not_attract": "none: not shown to attract",
    "too_few_points": "none: too few points for a range to fit",
}


_OPEN = tuple(KINDS[code] for code in APERIODIC)


def dimension_table(ds: xr.Dataset) -> Table:
    """Return the table of correlation dimensions per attractor and parameter point, with the reason where there is no
    dimension.
    """
    dims = dims_of(ds)
    names = ("kind", "reason", "n_cells", "n_sampled", "n_left", "n_points", "lifetime_low", *_CURVE)
    found = sets_of(ds)
    rows = [{**where, "attractor_id": int(one["attractor"]), **values(one, *names)} for where, one in found]
    lines = ["correlation dimension of the sections of attractors that do not close"]
    open_rows = [row for row in rows if row["kind"] in _OPEN]
    if not open_rows:
        lines.append("  none: all sets close, and have the dimension 0 on the section")
    return Table(rows, lines + aligned([_dimension_words(ds, row, dims) for row in open_rows]))


def _dimension_words(ds: xr.Dataset, row: Row, dims: Sequence[str]) -> Words:
    value = with_error(row["correlation_dimension"], row["correlation_dimension_stderr"])
    stays = f"{row['n_left']} of {row['n_sampled']} left"
    if not row["n_left"] and np.isfinite(row["lifetime_low"]):
        stays = f"stays, lifetime above {row['lifetime_low']:.0f} periods"
    ends = f"{row['fit_low']:.3g} to {row['fit_high']:.3g}" if np.isfinite(row["fit_low"]) else "-"
    return {
        **at_point(ds, row, dims),
        "id": str(row["attractor_id"]),
        "cells": str(row["n_cells"]),
        "extended": stays,
        "points": str(row["n_points"]),
        "dimension": _WHY.get(row["reason"], value),
        "fitted radii": ends,
        "lower minus upper half": number(row["correlation_dimension_spread"], "+.2f"),
        "resolvable": number(row["largest_resolved"], ".1f"),
    }
