"""Tabulate chaos and correlation dimensions, with a row per attractor and parameter point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.per_attractor import Nature
from pipeline.analysis.tabular import (
    FEW_POINTS,
    Row,
    aligned,
    axis_ranges,
    labels,
    number,
    point_table,
    points_of,
    unit_of,
    where_of,
    with_error,
    words_of,
)
from pipeline.layout.vocabulary import APERIODIC, KINDS, split_dims
from pipeline.products.product import Table

_COUNTS = ("n_transient", "n_contradicting", "n_drifting", "n_audit_failed", "n_unresolved", "n_failed")
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
    """Return the table of exponents, multipliers, dimensions and 0-1 test per attractor and point."""
    rows = _rows(ds)
    dims, _ = split_dims(ds["motion"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    lines = [f"{ds['motion'].size} cells at {n_points} parameter point{'s' * (n_points != 1)}"]
    if n_points > FEW_POINTS:
        lines += _summary(ds, rows, dims)
    else:
        for _, where in points_of(ds, dims):
            lines += point_table(ds, where, rows, _words)
    lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return Table(rows, lines)


def _rows(ds: xr.Dataset) -> list[Row]:
    dims, _ = split_dims(ds["motion"])
    natures, sources = words_of(ds["nature"]), words_of(ds["exponents_from"])
    rows = []
    present = ds["kind"].transpose(*dims, "attractor").values > 0
    for *index, i in np.argwhere(present).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at).isel(attractor=i)
        row: Row = {
            **where_of(ds, at),
            "attractor_id": int(one["attractor"]),
            **labels(one, "kind", "stability"),
            "nature": natures[int(one["nature"])],
            "orbit_period": int(one["orbit_period"]),
            "n_cells": int(one["n_cells"]),
            "share": float(one["share"]),
            "exponents_from": sources[int(one["exponents_from"])],
        }
        row |= {name: int(one[name]) for name in _COUNTS}
        row |= _spectrum(one)
        row |= {name: float(one[f"attractor_{name}"]) for name in _NUMBERS}
        rows.append(row | {name: float(one[name]) for name in _TEST})
    return rows


def _spectrum(one: xr.Dataset) -> Row:
    """Return the columns of exponents, per unit time and per drive period, and of multipliers."""
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


def _words(row: Row) -> dict[str, str]:
    found = {
        "id": str(row["attractor_id"]),
        "kind": row["kind"].replace("_", " "),
        "stability": row["stability"].replace("_", " "),
        "motion": _nature_words(row),
        "period": str(row["orbit_period"] or "-"),
        "cells": str(row["n_cells"]),
        "share": f"{row['share']:.3f}",
        "exponents per s": _exponents(row),
        "|multipliers|": _multipliers(row),
        "Kaplan-Yorke": with_error(row["kaplan_yorke"], row["kaplan_yorke_stderr"]),
        "correlation": with_error(row["correlation"], row["correlation_stderr"]),
    }
    if np.isfinite(row["median_zero_one"]):
        low, high = (number(row[f"{name}_zero_one"], ".2f") for name in ("least", "largest"))
        found["0-1 K"] = f"{number(row['median_zero_one'], '.2f')} ({low} to {high})"
    flags = [f"{row[name]} {text}" for name, text in _FLAGS.items() if row[name]]
    return found | {"flags": ", ".join(flags) or "-"}


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
    """Return lines on where each motion occurs, on the largest exponent, and on the flags."""
    table = []
    for nature in Nature:
        own = [row for row in rows if row["nature"] == nature.name.lower()]
        if own:
            ids = sorted({row["attractor_id"] for row in own})
            places = {tuple(row[d] for d in dims) for row in own}
            words = {
                "motion": nature.words,
                "ids": ", ".join(map(str, ids[:8])) + (f" and {len(ids) - 8} more" if len(ids) > 8 else ""),
                "cells": str(sum(r["n_cells"] for r in own)),
                "points": str(len(places)),
            }
            table.append(words | {f"{d}{unit_of(ds, d)}": axis_ranges(ds, d, own, len(dims) == 1) for d in dims})
    counts = [(text, sum(row[name] for row in rows)) for name, text in _FLAGS.items()]
    flags = ", ".join(f"{n} {text}" for text, n in counts if n)
    return aligned(table) + _extremes(ds, rows, dims) + [f"  cells flagged: {flags or 'none'}"]


def _extremes(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    """Return a line with the largest exponent of all attractors, in both units, and its place."""
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
    """Return the table of dimensions per attractor and point, with the reason if there is none."""
    rows = _dimension_rows(ds)
    dims = [str(d) for d in ds["reason"].dims if d != "attractor"]
    lines = ["correlation dimension of the sections of attractors that do not close"]
    open_rows = [row for row in rows if row["kind"] in _OPEN]
    if not open_rows:
        lines.append("  none: all sets close, and have the dimension 0 on the section")
    table = [_dimension_words(ds, row, dims) for row in open_rows]
    return Table(rows, lines + aligned(table))


def _dimension_rows(ds: xr.Dataset) -> list[Row]:
    reasons, kinds = words_of(ds["reason"]), words_of(ds["kind"])
    dims = [str(d) for d in ds["reason"].dims]
    rows = []
    for index in np.argwhere(ds["kind"].transpose(*dims).values > 0).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at)
        row: Row = where_of(ds, {d: i for d, i in at.items() if d != "attractor"})
        row |= {"attractor_id": int(one["attractor"]), "kind": kinds[int(one["kind"])]}
        row |= {"reason": reasons[int(one["reason"])]}
        row |= {name: int(one[name]) for name in ("n_cells", "n_sampled", "n_left", "n_points")}
        rows.append(row | {name: float(one[name]) for name in ("lifetime_low", *_CURVE)})
    return rows


def _dimension_words(ds: xr.Dataset, row: Row, dims: Sequence[str]) -> dict[str, str]:
    value = with_error(row["correlation_dimension"], row["correlation_dimension_stderr"])
    stays = f"{row['n_left']} of {row['n_sampled']} left"
    if not row["n_left"] and np.isfinite(row["lifetime_low"]):
        stays = f"stays, lifetime above {row['lifetime_low']:.0f} periods"
    ends = f"{row['fit_low']:.3g} to {row['fit_high']:.3g}" if np.isfinite(row["fit_low"]) else "-"
    return {
        **{f"{d}{unit_of(ds, d)}": f"{row[d]:g}" for d in dims},
        "id": str(row["attractor_id"]),
        "cells": str(row["n_cells"]),
        "extended": stays,
        "points": str(row["n_points"]),
        "dimension": _WHY.get(row["reason"], value),
        "fitted radii": ends,
        "lower minus upper half": number(row["correlation_dimension_spread"], "+.2f"),
        "resolvable": number(row["largest_resolved"], ".1f"),
    }
