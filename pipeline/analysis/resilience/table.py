"""Tabulate the response of attractors to shocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.ragged import dims_of
from pipeline.analysis.tabular import (
    FEW_POINTS,
    Row,
    Words,
    number,
    point_table,
    points_of,
    ranges,
    sets_of,
    summary,
    values,
)
from pipeline.layout.vocabulary import ATTRACTS, letter, model_of, periods_of
from pipeline.products.product import Table

_ENDS = {-1: "-", DIVERGED: "diverges", -3: "elsewhere"}

_PLAIN = (
    "n_cells",
    "basin_stability",
    "basin_stability_low",
    "basin_stability_high",
    "arrived",
    "arrived_low",
    "arrived_high",
    "mean_time",
    "mean_time_stderr",
    "longest_time",
    "n_timed",
)

_SEARCHED = ("low", "high", "phase", "to", "safe", "n_below", "n_undecided")


def end_of(label: int) -> str:
    """Return the letter of the attractor where a shock leads, or a word for another end."""
    return _ENDS.get(label) or letter(label)


def resilience_table(ds: xr.Dataset) -> Table:
    """Return a row per attractor and parameter point; of more than a few points, print a line per attractor."""
    dims = dims_of(ds)
    rows = _rows(ds)
    lines = [_head(ds)]
    if int(np.prod([ds.sizes[d] for d in dims])) > FEW_POINTS:
        lines += summary(ds, rows, dims, _label_summary, "attractor_id")
    else:
        for _, where in points_of(ds, dims):
            lines += point_table(ds, where, rows, _words)
    lines.append(
        "the largest shocks that never led away, and the numbers of smaller ones tried, are in --csv and --json"
    )
    n_unknown = sum(row["shock_n_undecided"] + row["distance_n_undecided"] for row in rows)
    if n_unknown:
        lines.append(f"{n_unknown} smaller shocks end on no known attractor; sizes are intervals where that matters")
    return Table(rows, lines, "" if rows else "no attractor of the run can be disturbed: none was shown to attract.")


def _head(ds: xr.Dataset) -> str:
    norm = {"euclidean": "root of the sum of squares", "largest": "largest"}[ds.attrs["resilience_norm"]]
    scales = zip(ds["state"].values, ds["state_scale"].values, strict=True)
    units = ", ".join(f"{name} {scale:g}" for name, scale in scales)
    periods = periods_of(model_of(ds))
    return (
        f"shocks of {ds.attrs['resilience_states']} at {ds.attrs['resilience_phases']} phases, distances of all "
        f"states; sizes: {norm} of the jumps over their scales ({units}); times in {periods}"
    )


def _rows(ds: xr.Dataset) -> list[Row]:
    rows = []
    names = [str(name) for name in ds["state"].values]
    for where, one in sets_of(ds, ds["stability"].values == ATTRACTS):
        i = int(one["attractor"])
        row: Row = {**where, "attractor_id": i, "letter": letter(i), **values(one, *_PLAIN)}
        for what in ("shock", "distance"):
            row |= values(one, *(f"{what}_{name}" for name in _SEARCHED))
            row[f"{what}_leads_to"] = end_of(int(one[f"{what}_to"]))
            row |= {f"{what}_{name}": float(one[what][k]) for k, name in enumerate(names)}
            row |= {f"{what}_from_{name}": float(one[f"{what}_from"][k]) for k, name in enumerate(names)}
        for k, name in enumerate(names):
            row |= {f"along_{name}_{end}": float(one[f"along_{end}"][k]) for end in ("low", "high")}
            row |= {f"along_{name}": float(one["along"][k]), f"along_{name}_leads_to": end_of(int(one["along_to"][k]))}
        rows.append(row)
    return rows


def size_of(low: float, high: float) -> str:
    """Format the interval of a size: a number where it is short, else both ends."""
    if not np.isfinite(low):
        return "-"
    if np.isinf(high):
        return f"above {low:.4g}"
    return f"{high:.5g}" if high - low <= 1e-3 * high else f"{low:.4g} to {high:.4g}"


def _words(row: Row) -> Words:
    share = f"{row['basin_stability']:.4f} ({row['basin_stability_low']:.4f} to {row['basin_stability_high']:.4f})"
    return {
        "letter": row["letter"],
        "basin stability": share if np.isfinite(row["basin_stability"]) else "-",
        "in time": number(row["arrived"], ".3f"),
        "mean time": number(row["mean_time"], ".1f"),
        "longest": number(row["longest_time"], ".0f"),
        "critical shock": size_of(row["shock_low"], row["shock_high"]),
        "phase": number(row["shock_phase"], ".3g"),
        "to": row["shock_leads_to"],
        "distance": size_of(row["distance_low"], row["distance_high"]),
        "to ": row["distance_leads_to"],
    }


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> Words:
    def span(name: str, spec: str) -> str:
        found = [row[name] for row in rows if np.isfinite(row[name])]
        return f"{min(found):{spec}} to {max(found):{spec}}" if found else "-"

    least = min(rows, key=lambda row: row["shock_high"])
    where = ", ".join(f"{d} {least[d]:g}" for d in dims)
    return {
        "letter": rows[0]["letter"],
        **ranges(ds, rows, dims),
        "basin stability": span("basin_stability", ".3f"),
        "mean time": span("mean_time", ".1f"),
        "critical shock": span("shock_high", ".4g"),
        "least at": where if np.isfinite(least["shock_high"]) else "-",
        "distance": span("distance_high", ".4g"),
    }
