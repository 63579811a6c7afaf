"""What ``magpend analyse`` prints: tables and summaries of analysis products."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.basins.basins import DIVERGED, outcomes
from pipeline.analysis.basins.numbers import Interval, basin_fractions
from pipeline.analysis.chaos.chaos import KINDS
from pipeline.layout.vocabulary import split_dims

FEW_POINTS = 6
"""Up to so many parameter points get a table each."""

MOST_RANGES = 6
"""Up to so many ranges of an axis are listed."""

Row = dict[str, Any]


def attractor_rows(ds: xr.Dataset, *, interval: Interval = "wilson", confidence: float = 0.95) -> list[Row]:
    """Return a row per attractor and parameter point.

    `fraction` is that of the cells whose outcome is known, with its interval; a continuation's branches
    are no sample of initial conditions, so they have none.
    """
    dims, start_dims = split_dims(ds["attractor_id"])
    words = _words(ds["decision"])
    fractions = None
    if start_dims and start_dims != ("branch",):
        fractions = basin_fractions(
            outcomes(ds), dims=start_dims, ids=ds["attractor"].values.tolist(),
            confidence=confidence, method=interval,
        )  # fmt: skip
    rows = []
    for index in np.ndindex(*(ds.sizes[d] for d in dims)):
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at)
        cells = one["attractor_id"].values.ravel()
        decisions = np.zeros((len(words), ds.sizes["attractor"]), np.int64)
        np.add.at(decisions, (one["decision"].values.ravel()[cells >= 0], cells[cells >= 0]), 1)
        for i in np.flatnonzero(one["kind"].values > 0):
            row = {**_where(ds, at), **_attractor(one.isel(attractor=i))}
            if fractions is not None:
                own = fractions.isel(at).sel(label=i)
                row |= {name: float(own[name]) for name in ("fraction", "low", "high")}
            rows.append(row | {f"by_{name}": int(decisions[k, i]) for k, name in enumerate(words) if k})
    return rows


def _attractor(one: xr.Dataset) -> Row:
    largest = np.hypot(one["multiplier_real"].values, one["multiplier_imag"].values)
    kinds, sides = (_words(one[name]) for name in ("kind", "side"))
    rotation = {f"rotation_{n}": float(v) for n, v in zip(_links(one), one["rotation"].values, strict=True)}
    return {
        "attractor_id": int(one["attractor"]),
        "kind": kinds[int(one["kind"])],
        "orbit_period": int(one["orbit_period"]),
        "side": sides[int(one["side"])],
        **rotation,
        "multiplier_modulus": float(largest[0]) if np.isfinite(largest).any() else np.nan,
        "is_stable": int(one["is_stable"]),
        "mirror_partner": int(one["mirror_partner"]),
        "mirror_distance": float(one["mirror_distance"]),
        "n_cells": int(one["n_cells"]),
        **{name: _words(one[name])[int(one[name])] for name in ("match_basis",) if name in one},
    }


def attractor_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the table per parameter point if there are few, otherwise a line per attractor."""
    dims, start_dims = split_dims(ds["attractor_id"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    n = ds.sizes["attractor"]
    lines = [f"{n} attractor{'s' * (n != 1)} at {n_points} parameter point{'s' * (n_points != 1)}"]
    if n_points > FEW_POINTS:
        lines += _summary(ds, rows, dims, _id_summary)
    else:
        for index in np.ndindex(*(ds.sizes[d] for d in dims)):
            at = dict(zip(dims, index, strict=True))
            where = _where(ds, at)
            here = [row for row in rows if all(row[k] == v for k, v in where.items())]
            lines += _heading(ds, where) + _table([_attractor_words(row) for row in here])
    return lines + _cell_counts(ds, start_dims)


def _attractor_words(row: Row) -> dict[str, str]:
    turns = [v for k, v in row.items() if k.startswith("rotation_")]
    decided = ", ".join(f"{n} {k[3:].replace('_', ' ')}" for k, n in row.items() if k.startswith("by_") and n)
    words = {
        "id": str(row["attractor_id"]),
        "kind": row["kind"].replace("_", " "),
        "period": str(row["orbit_period"] or "-"),
        "side": row["side"],
        "rotation": " ".join(f"{round(v, 3) + 0.0:.3f}" for v in turns),
        "|multiplier|": _number(row["multiplier_modulus"], ".4f"),
        "cells": str(row["n_cells"]),
    }
    if "fraction" in row:
        words["share"] = _with_interval(row)
    partner = row["mirror_partner"]
    return words | {"mirror": str(partner) if partner >= 0 else "-", "decided": decided}


def _id_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    share = "fraction" if "fraction" in rows[0] else None
    words = {
        "id": str(rows[0]["attractor_id"]),
        "kind": _distinct(r["kind"].replace("_", " ") for r in rows),
        "periods": _distinct(r["orbit_period"] for r in rows if r["orbit_period"]) or "-",
        "side": _distinct(r["side"] for r in rows),
        **_ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "id rests on": _evidence([r["match_basis"] for r in rows if "match_basis" in r]),
    }
    if share:
        words["max share"] = _largest_share(ds, rows, dims)
    return words | {"mirror": _distinct(r["mirror_partner"] for r in rows if r["mirror_partner"] >= 0) or "-"}


def _evidence(bases: Sequence[str]) -> str:
    """Say what an id rests on: followed branches, doublings, or at how many points on distance alone."""
    links = [basis for basis in bases if basis != "first_appearance"]
    told = [name for name in ("branch", "doubling") if name in links]
    n = links.count("distance")
    if n and not told:
        return "distance alone"
    return ", ".join(told + ([f"distance at {n} of {len(links)}"] if n else [])) or "-"


# ---- basins ------------------------------------------------------------------------------------


def basin_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per outcome and parameter point: cells and fraction with its intervals."""
    dims, _ = split_dims(ds["attractor_id"])
    names = ("fraction", "low", "high", "fraction_if_none", "fraction_if_all", "low_if_none", "high_if_all")
    rows = []
    for index in np.ndindex(*(ds.sizes[d] for d in dims)):
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at)
        for i, label in enumerate(ds["label"].values.tolist()):
            row = {**_where(ds, at), "label": label, "n_cells": int(one["count"][i])}
            row["n_inferred"] = int(one["n_inferred"][i])
            rows.append(row | {name: float(one[name][i]) for name in names})
    return rows


def basin_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return fractions and numbers on boundaries: a table per point if there are few, or ranges."""
    dims, start_dims = split_dims(ds["attractor_id"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    seen = [row for row in rows if row["n_cells"]]
    confidence = f"{100 * ds.attrs['basin_confidence']:g} %"
    lines = [f"fractions of the cells whose outcome is known, {ds.attrs['basin_interval']}, {confidence}"]
    if n_points > FEW_POINTS:
        lines += _summary(ds, seen, dims, _label_summary)
        lines += [_range_line(ds, name, text) for name, text in _BOUNDARY.items() if name in ds]
    else:
        for index in np.ndindex(*(ds.sizes[d] for d in dims)):
            at = dict(zip(dims, index, strict=True))
            where = _where(ds, at)
            here = [row for row in seen if all(row[k] == v for k, v in where.items())]
            one = ds.isel(at)
            lines += _heading(ds, where) + _table([_basin_words(row) for row in here])
            if here:
                bound = float(one["unseen_high"])
                lines.append(f"  an attractor that no cell shows: at most {bound:.3g} of the region")
            lines += _boundary_lines(one)
    if ds.attrs["not_computed"]:
        lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return lines + _cell_counts(ds, start_dims)


def _label(code: int) -> str:
    return "diverged" if code == DIVERGED else str(code)


def _basin_words(row: Row) -> dict[str, str]:
    words = {"id": _label(row["label"]), "cells": str(row["n_cells"]), "fraction": _with_interval(row)}
    if row["fraction_if_all"] > row["fraction_if_none"]:
        words["with the unfinished"] = f"{row['low_if_none']:.4f} to {row['high_if_all']:.4f}"
    return words | _inferred([row])


def _inferred(rows: Sequence[Row]) -> dict[str, str]:
    """How many cells were not integrated, if any."""
    n = sum(row["n_inferred"] for row in rows)
    return {"inferred cells": str(n)} if n else {}


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    return {
        "id": _label(rows[0]["label"]),
        **_ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "max fraction": _largest_share(ds, rows, dims),
        **_inferred(rows),
    }


_BOUNDARY = {
    "basin_entropy": "basin entropy",
    "boundary_basin_entropy": "boundary basin entropy",
    "uncertainty_exponent": "uncertainty exponent",
    "wada_beyond": "cells off the common boundary (Wada)",
}


def _boundary_lines(one: xr.Dataset) -> list[str]:
    lines = []
    for name, text in _BOUNDARY.items():
        if name in one and np.isfinite(float(one[name])):
            value, error, low, high = (float(one[f"{name}{end}"]) for end in ("", "_stderr", "_low", "_high"))
            known = f"± {error:.2g} ({low:.4g} to {high:.4g})"
            lines.append(f"  {text}: {value:.4g} {known if np.isfinite(error) else '(error not known)'}")
    if int(one.get("above_ln2_surely", -1)) == 1:
        lines.append("  the boundary basin entropy exceeds ln 2: the boundary is fractal")
    if int(one.get("wada", -1)) >= 0:
        verdict = "passes" if int(one["wada"]) else "does not pass"
        lines.append(
            f"  Wada merge test: {verdict} with radius {one.attrs['basin_radius']} "
            f"(it takes {float(one['wada_distance']):g} cells)"
        )
    return lines


def _range_line(ds: xr.Dataset, name: str, text: str) -> str:
    values = ds[name].values[np.isfinite(ds[name].values)]
    if not values.size:
        return f"  {text}: nowhere"
    return f"  {text}: {values.min():.4g} to {values.max():.4g} at {values.size} points"


# ---- hysteresis --------------------------------------------------------------------------------


def jump_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per kind of jump: from where to where, which way, from which to which attractor."""
    names = ("jump_from", "jump_to", "jump_from_id", "jump_to_id", "jump_count")
    rows = []
    for i in range(ds.sizes["jump"]):
        row: Row = {"direction": "up" if ds["jump_direction"].values[i] > 0 else "down"}
        rows.append(row | {n.removeprefix("jump_"): ds[n].values[i].item() for n in names})
    return rows


def hysteresis_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the loops, then the from-to table."""
    n = ds.sizes["loop"]
    lines = [f"{n or 'no'} loop{'s' * (n != 1)}: neighbouring points where up and down meet other attractors"]
    path = ds.attrs["path"]
    unit = f"{path}{_unit(ds, path)}" if path in ds.coords else path
    lines += _table([_loop_words(ds.isel(loop=i), unit) for i in range(n)])
    lines.append(f"jumps of the branches: {sum(row['count'] for row in rows) or 'none'}")
    words = [
        {"direction": r["direction"], f"from {unit}": f"{r['from']:g}", "to": f"{r['to']:g}",
         "ids": f"{r['from_id']} -> {r['to_id']}", "branches": str(r["count"])}
        for r in rows
    ]  # fmt: skip
    return lines + _table(words)


def _loop_words(loop: xr.Dataset, unit: str) -> dict[str, str]:
    others = {str(n).removeprefix("loop_at_"): f"{float(loop[n]):g}" for n in loop if "loop_at_" in str(n)}
    words = {f"from {unit}": f"{float(loop['loop_from']):g}", "to": f"{float(loop['loop_to']):g}"}
    for name in ("only_up", "only_down"):
        counts = loop[name].values
        met = ", ".join(f"{i} ({counts[i]} point{'s' * int(counts[i] != 1)})" for i in np.flatnonzero(counts))
        words[name.replace("_", " ")] = met or "-"
    return others | words | {"points": str(int(loop["loop_points"]))}


# ---- settling ----------------------------------------------------------------------------------


def settling_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per bounded set and parameter point: what became of the sample that was run on."""
    dims = [str(d) for d in ds["verdict"].dims if d != "attractor"]
    words, n = _words(ds["verdict"]), ds.sizes["attractor"]
    rows = []
    for *index, i in np.argwhere(ds["verdict"].values > 0).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at).isel(attractor=i)
        row: Row = {**_where(ds, at), "attractor_id": i, "verdict": words[int(one["verdict"])]}
        row |= {name: int(one[name]) for name in ("n_sampled", "n_left", "n_leaving")}
        row |= {name: float(one[name]) for name in ("mean_lifetime", "lifetime_low", "lifetime_high")}
        to = [(f"orbit of period {int(one['new_orbit_period'][k - n])}" if k >= n else str(k), c)
              for k, c in enumerate(one["n_to"].values.tolist()) if c]  # fmt: skip
        rows.append(row | {"to": ", ".join(f"{name} ({count})" for name, count in to)})
    return rows


def settling_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the table of bounded sets."""
    n = ds.attrs["lifetimes_n_periods"]
    if not rows:
        return ["bounded sets: none, so there is nothing to run on"]
    lines = [f"bounded sets: {len(rows)}; run on for {n} drive periods, which lifetimes are in"]
    dims = [str(d) for d in ds["verdict"].dims if d != "attractor"]
    table = []
    for row in rows:
        where = {f"{d}{_unit(ds, d)}": f"{row[d]:g}" for d in dims}
        low, high = (_number(row[name], ".0f") for name in ("lifetime_low", "lifetime_high"))
        lifetime = f"{row['mean_lifetime']:.0f} ({low} to {high})"
        if not row["n_left"]:
            lifetime = f"above {low}" if low != "-" else low
        counts = {"sampled": "n_sampled", "near an orbit": "n_leaving", "left later": "n_left"}
        counts = {text: str(row[name]) for text, name in counts.items()}
        told = {"id": str(row["attractor_id"]), "verdict": row["verdict"]}
        table.append(where | told | counts | {"mean lifetime": lifetime, "to": row["to"] or "-"})
    return lines + _table(table)


# ---- chaos -------------------------------------------------------------------------------------


_COUNTS = ("n_transient", "n_drifting", "n_audit_failed", "n_unresolved", "n_failed")
_MEANS = (
    "mean_kaplan_yorke", "mean_kaplan_yorke_stderr", "median_zero_one", "least_zero_one", "largest_zero_one",
)  # fmt: skip
_FLAGS = {
    "n_transient": "transient", "n_drifting": "drifting", "n_audit_failed": "audit failed",
    "n_unresolved": "unresolved", "n_failed": "failed",
}  # fmt: skip


def chaos_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per kind of motion that occurs at a parameter point.

    ``all_chaotic`` has one where both chaotic and hyperchaotic cells are.
    """
    dims, _ = split_dims(ds["motion"])
    rows = []
    for *index, k in np.argwhere(ds["n_cells"].transpose(*dims, "kind").values > 0).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at).isel(kind=k)
        if KINDS[k] == "all_chaotic" and not _is_mixed(ds.isel(at)):
            continue
        row: Row = {**_where(ds, at), "motion": KINDS[k], "n_cells": int(one["n_cells"])}
        row |= {name: int(one[name]) for name in _COUNTS if name in one}
        if "mean_lyapunov" in one:
            for i in range(ds.sizes["exponent"]):
                e = one.isel(exponent=i)
                row |= {
                    f"lyapunov_{i + 1}{end}": float(e[f"mean_lyapunov{end}"])
                    for end in ("", "_stderr", "_between", "_per_period", "_per_period_stderr")
                }
        names = [name for name in _MEANS if name in one]
        rows.append(row | {name: float(one[name]) for name in names})
    return rows


def _is_mixed(one: xr.Dataset) -> bool:
    return bool((one["n_cells"].sel(kind=["chaotic", "hyperchaotic"]) > 0).all())


def chaos_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return tables per parameter point if there are few, otherwise a summary."""
    dims, _ = split_dims(ds["motion"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    lines = [f"motion of {ds['motion'].size} cells at {n_points} parameter point{'s' * (n_points != 1)}"]
    if n_points > FEW_POINTS:
        lines += _chaos_summary(ds, rows, dims)
    else:
        for index in np.ndindex(*(ds.sizes[d] for d in dims)):
            place = _where(ds, dict(zip(dims, index, strict=True)))
            here = [row for row in rows if all(row[k] == v for k, v in place.items())]
            lines += _heading(ds, place) + _table([_chaos_words(row) for row in here])
            lines += _exponent_table(here)
    return lines + [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]


def _chaos_words(row: Row) -> dict[str, str]:
    words = {"motion": row["motion"].replace("_", " "), "cells": str(row["n_cells"])}
    if "lyapunov_1" in row:
        words["Kaplan-Yorke"] = _with_error(row["mean_kaplan_yorke"], row["mean_kaplan_yorke_stderr"])
        words["transient"] = f"{row['n_transient'] / row['n_cells']:.0%}"
    if "median_zero_one" in row:
        low, high = (_number(row[f"{name}_zero_one"], ".2f") for name in ("least", "largest"))
        words["0-1 K"] = f"{_number(row['median_zero_one'], '.2f')} ({low} to {high})"
    flags = [
        f"{row[name]} {text}" for name, text in _FLAGS.items() if name != "n_transient" and row.get(name)
    ]
    return words | {"flags": ", ".join(flags) or "-"}


def _exponent_table(rows: Sequence[Row]) -> list[str]:
    """Exponents per second and per drive period, a line per motion and unit."""
    lines = []
    for row in rows:
        n = sum(f"lyapunov_{i}" in row for i in range(1, 10))
        for per, end in (("s", ""), ("drive period", "_per_period")):
            named = {
                f"exponent {i}": _with_error(row[f"lyapunov_{i}{end}"], row[f"lyapunov_{i}{end}_stderr"])
                for i in range(1, n + 1)
            }
            if n and any(text != "-" for text in named.values()):
                lines.append({"motion": row["motion"].replace("_", " "), "per": per} | named)
    return _table(lines)


def _with_error(value: float, error: float) -> str:
    """Value and standard error, both to two digits of the error, of the value six decimals at most."""
    if not np.isfinite(value):
        return "-"
    if not (np.isfinite(error) and error >= 1e-6):
        return f"{value:.6g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 6))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _chaos_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    """Where each motion occurs, extremes of the largest exponent, counts of flags."""
    lines = []
    for kind in KINDS[:-1]:
        own = [row for row in rows if row["motion"] == kind]
        if own:
            words = {
                "motion": kind.replace("_", " "),
                "cells": str(sum(r["n_cells"] for r in own)),
                "points": str(len(own)),
            }
            lines.append(
                words | {f"{d}{_unit(ds, d)}": _axis_ranges(ds, d, own, len(dims) == 1) for d in dims}
            )
    extremes = _extremes(ds, rows, dims) if "mean_lyapunov" in ds else []
    cells = [row for row in rows if row["motion"] != "all_chaotic"]
    counts = [(text, sum(row.get(name, 0) for row in cells)) for name, text in _FLAGS.items()]
    flags = ", ".join(f"{n} {text}" for text, n in counts if n)
    return _table(lines) + extremes + [f"  cells flagged: {flags or 'none'}"]


def _axis_ranges(ds: xr.Dataset, dim: str, rows: Sequence[Row], alone: bool) -> str:
    """Ranges of neighbouring values of the only axis; otherwise, or if they are many, the whole range."""
    axis = ds[dim].values.astype(np.float64)
    values = np.array(sorted({row[dim] for row in rows}))
    places = np.searchsorted(np.sort(axis), values)
    parts = np.split(values, np.flatnonzero(np.diff(places) > 1) + 1)
    if not alone or len(parts) > MOST_RANGES:
        more = f" in {len(parts)} ranges" if alone else ""
        return f"{values[0]:g} to {values[-1]:g}{more}"
    return ", ".join(f"{p[0]:g}" if len(p) == 1 else f"{p[0]:g} to {p[-1]:g}" for p in parts)


def _extremes(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    """Largest and smallest mean of the largest exponent, with its place."""
    known = [row for row in rows if np.isfinite(row["lyapunov_1"])]
    lines = []
    for name, choose in (("largest", max), ("smallest", min)):
        if known:
            row = choose(known, key=lambda r: float(r["lyapunov_1"]))
            rate = _with_error(row["lyapunov_1"], row["lyapunov_1_stderr"])
            period = _with_error(row["lyapunov_1_per_period"], row["lyapunov_1_per_period_stderr"])
            place = ", ".join(f"{d} {row[d]:g}{_unit(ds, d)}" for d in dims)
            motion = row["motion"].replace("_", " ")
            lines.append(
                f"  {name} mean of exponent 1: {rate} per s, {period} per drive period, {motion}, at {place}"
            )
    return lines


# ---- correlation dimension ---------------------------------------------------------------------

_CURVE = (
    "correlation_dimension", "correlation_dimension_stderr", "correlation_dimension_spread", "fit_low",
    "fit_high", "largest_resolved",
)  # fmt: skip


def dimension_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per parameter point."""
    rows = []
    for index in np.ndindex(*ds["n_cells"].shape):
        at = dict(zip(map(str, ds["n_cells"].dims), index, strict=True))
        one = ds.isel(at)
        row: Row = {**_where(ds, at), "n_cells": int(one["n_cells"]), "n_points": int(one["n_points"])}
        rows.append(row | {name: float(one[name]) for name in _CURVE})
    return rows


def dimension_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return a table with a line per parameter point."""
    lines = ["correlation dimension of the sections of the chaotic cells"]
    dims = [str(d) for d in ds["n_cells"].dims]
    found = []
    for row in rows:
        place = {f"{d}{_unit(ds, d)}": f"{row[d]:g}" for d in dims}
        value = _with_error(row["correlation_dimension"], row["correlation_dimension_stderr"])
        ends = "-"
        if np.isfinite(row["fit_low"]):
            ends = f"{row['fit_low']:.3g} to {row['fit_high']:.3g}"
        elif not row["n_cells"]:
            value = "no chaotic cell"
        elif not np.isfinite(row["correlation_dimension"]):
            value = "no range to fit: too few points"
        counts = {"cells": str(row["n_cells"]), "points": str(row["n_points"])}
        spread = _number(row["correlation_dimension_spread"], "+.2f")
        found.append(
            place | counts | {"dimension": value, "fitted radii": ends, "lower minus upper half": spread,
                              "resolvable": _number(row["largest_resolved"], ".1f")}
        )  # fmt: skip
    return lines + _table(found)


# ---- shared ------------------------------------------------------------------------------------


def write_csv(rows: Sequence[Row], path: Path) -> Path:
    """Write rows as CSV, NaN as empty fields."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows({k: "" if v != v else v for k, v in row.items()} for row in rows)
    return path


def _where(ds: xr.Dataset, at: Mapping[str, int]) -> Row:
    return {d: float(ds[d].values[i]) for d, i in at.items()}


def _links(ds: xr.Dataset) -> list[str]:
    n = ds["rotation"].sizes["link"]
    return [str(v) for v in ds["link"].values] if "link" in ds.coords else [str(i) for i in range(n)]


def _words(array: xr.DataArray) -> list[str]:
    return str(array.attrs["flag_meanings"]).split()


def _unit(ds: xr.Dataset, dim: str) -> str:
    unit = ds[dim].attrs.get("units", "1")
    return "" if unit == "1" else f" {unit}"


def _heading(ds: xr.Dataset, where: Row) -> list[str]:
    text = ", ".join(f"{d} {v:g}{_unit(ds, d)}" for d, v in where.items())
    return [f"{text}:"] if text else []


def _number(value: float, spec: str) -> str:
    return format(value, spec) if np.isfinite(value) else "-"


def _with_interval(row: Row) -> str:
    return f"{row['fraction']:.4f} ({row['low']:.4f} to {row['high']:.4f})"


def _distinct(values: Iterable[Any]) -> str:
    return ", ".join(map(str, sorted(set(values))))


def _ranges(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    words = {}
    for d in dims:
        values = [row[d] for row in rows]
        words[f"{d}{_unit(ds, d)}"] = f"{min(values):g} to {max(values):g}"
    return words | {"points": str(len(rows))}


def _largest_share(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> str:
    best = max(rows, key=lambda row: (np.nan_to_num(row["fraction"], nan=-1.0),))
    where = ", ".join(f"{best[d]:g}{_unit(ds, d)}" for d in dims)
    return f"{_number(best['fraction'], '.4f')} at {where}"


def _summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str], describe: Any) -> list[str]:
    """Return a table with a line per id."""
    key = "attractor_id" if rows and "attractor_id" in rows[0] else "label"
    groups: dict[int, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return _table([describe(ds, groups[i], dims) for i in sorted(groups)])


def _table(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Align rows under their headings."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names] + [[row.get(name, "") for name in names] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    lines = ["  ".join(w.ljust(n) for w, n in zip(line, widths, strict=True)).rstrip() for line in cells]
    return [f"  {line}" for line in lines] if rows else []


def _cell_counts(ds: xr.Dataset, start_dims: Sequence[str]) -> list[str]:
    """Return a line on the cells without an attractor, if there are any."""
    unknown = ds["attractor_id"].values < 0
    status = ds["status"].values
    names = str(ds["status"].attrs["flag_meanings"]).split()
    codes = [int(c) for c in ds["status"].attrs["flag_values"]]
    counts: dict[str, int] = {}
    for code, name in zip(codes, names, strict=True):
        n = int((unknown & (status == code)).sum())
        what = "undecided" if name in ("periodic", "bounded", "inferred") else name
        if n:
            counts[what] = counts.get(what, 0) + n
    if not counts:
        return [f"all {unknown.size} cells belong to an attractor"]
    texts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items())
    return [f"{int((~unknown).sum())} of {unknown.size} cells belong to an attractor; {texts}"]
