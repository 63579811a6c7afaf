"""Tabulate edge states."""

from __future__ import annotations

import numpy as np
import xarray as xr

from pipeline.analysis.resilience.edge_tracking import REASONS
from pipeline.analysis.tabular import Row, Words, aligned, counted, plain, words_of
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.products.product import Table


def edge_table(ds: xr.Dataset) -> Table:
    """Return a row per section point of each edge state; print a line per edge state, and one per reason for none."""
    letters = str(ds.attrs["between_letters"])
    n_pairs, found = ds.sizes["pair"], int((ds["pair_edge"] >= 0).sum())
    head = f"between {letters.replace(' ', ' and ')}: {counted(ds.sizes['edge'], 'edge state')}"
    lines = [f"{head}, from {found} of {counted(n_pairs, 'pair')}"]
    lines += aligned([_words(ds.isel(edge=i)) for i in range(ds.sizes["edge"])])
    reasons = ds["pair_reason"].values
    for code in np.unique(reasons[reasons > 0]).tolist():
        lines.append(f"  not decided, {counted(int((reasons == code).sum()), 'pair')}: {_SENTENCES[REASONS[code]]}")
    nothing = "" if n_pairs else f"no cells end on both of {letters}; grow the run, or choose two others."
    return Table(_rows(ds), lines, nothing)


_SENTENCES = {
    "third_attractor": "another basin lies between the two; start closer to their common boundary with a finer grid",
    "undecided": "states between the two end on no known attractor; a larger --budget may decide",
    "lost": "the pair diverged, did not return to the section, or left the boundary; a smaller --farthest may help",
    "parted": "it parts too far within one section to show where the boundary is; a smaller --closest may help",
    "not_settled": "its path has not come to a set that repeats itself; give more --returns",
}


def _rows(ds: xr.Dataset) -> list[Row]:
    names = [str(name) for name in ds["state"].values]
    rows = []
    for i in range(ds.sizes["edge"]):
        one = ds.isel(edge=i)
        for k in range(int(one["n_points"])):
            point = {name: float(value) for name, value in zip(names, one["section"].values[k], strict=True)}
            rows.append({"edge": i, "between": str(ds.attrs["between_letters"]), **_numbers(one), "point": k, **point})
    return rows


def _numbers(one: xr.Dataset) -> Row:
    row: Row = {
        "kind": words_of(one["kind"])[int(one["kind"])],
        "period": int(one["orbit_period"]),
        "n_pairs": int(one["n_pairs"]),
        "residual": float(one["residual"]),
    }
    for name in ("multiplier", "eigenvalue"):
        for k in range(one.sizes["multiplier"]):
            row |= {f"{name}{k + 1}_{part}": float(one[f"{name}_{part}"][k]) for part in ("real", "imag")}
    return row


def _words(one: xr.Dataset) -> Words:
    kind = int(one["kind"])
    name = {PERIODIC_ORBIT: "multipliers", EQUILIBRIUM: "eigenvalues [1/s]"}.get(kind)
    values = "" if name is None else ", ".join(_complex(one, "multiplier" if kind == PERIODIC_ORBIT else "eigenvalue"))
    point = ", ".join(f"{value:.9g}" for value in one["section"].values[0])
    return {
        "kind": plain(words_of(one["kind"])[kind]),
        "period": str(int(one["orbit_period"])) if kind == PERIODIC_ORBIT else "-",
        "found by": counted(int(one["n_pairs"]), "pair") if int(one["n_pairs"]) else "on a path",
        "first section point": point if kind != EQUILIBRIUM else f"at {point}",
        name or "multipliers": values or "-",
    }


def _complex(one: xr.Dataset, name: str) -> list[str]:
    real, imag = one[f"{name}_real"].values, one[f"{name}_imag"].values
    return [f"{a:.6g}" if abs(b) <= 1e-9 * abs(a) else f"{a:.6g}{b:+.6g}i" for a, b in zip(real, imag, strict=True)]
