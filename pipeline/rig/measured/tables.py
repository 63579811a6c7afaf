"""Make tables of a measured diagram: one row per frequency step, or one per frequency at which a regime ends."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import Row, Words, aligned, counted, number, values
from pipeline.layout.vocabulary import model_of
from pipeline.products.product import Table
from pipeline.rig.measured.windows import CONFIDENT, words_for

FAR = 5.0
"""Distance in noise floors above which the nearest attractor is not the rig's."""


def steps_table(measured: xr.Dataset) -> Table:
    """Return a table of the frequency steps: frequency, jitter, duty cycle, period, confidence, and the comparison with
    a computed run if there is one.
    """
    rows = [_row(measured.isel(step=i)) for i in range(measured.sizes["step"])]
    return Table(rows, [counted(len(rows), "step"), *aligned([_words(r) for r in rows])])


_MEASURED = ("frequency_error_hz", "direction", "recording", "start_s", "jitter_s", "duty_cycle", "duty_cycle_error")
_ORBIT = ("n_sections", "orbit_period", "confidence", "closure", "side")
_NEAREST = ("distance", "distance_in_noise", "runner_up", "noise_floor", "winner")
_COMPUTED = ("computed_period", "same_period", "same_side")


def _row(one: xr.Dataset) -> Row:
    labelled = ("computed_side",) if model_of(one).classifier else ()
    names = (*_MEASURED, *_ORBIT, *_NEAREST, *_COMPUTED, *labelled)
    return {"frequency_hz": float(one["frequency"]), **values(one, *names)}


def words_of(measured: xr.Dataset) -> tuple[str, ...]:
    """Return the labels of the model's motion classifier, or an empty tuple if the model has no classifier."""
    classifier = model_of(measured).classifier
    return classifier.words if classifier is not None else ()


def _words(row: Row) -> Words:
    error = row["frequency_error_hz"]
    digits = int(np.clip(1 - math.floor(math.log10(error)), 0, 8)) if 0 < error < 1 else 6
    words = {
        "frequency Hz": f"{row['frequency_hz']:.{digits}f} ± {error:.{digits}f}",
        "way": row["direction"],
        "jitter ms": number(1e3 * row["jitter_s"], ".3f"),
        "duty cycle": f"{row['duty_cycle']:.5f} ± {row['duty_cycle_error']:.5f}",
        "sections": str(row["n_sections"]),
        "period": str(row["orbit_period"] or "-"),
        "sure": f"{row['confidence']:.2f}",
        "side": row.get("side"),
    }
    if "winner" not in row:
        return words
    nobody = row["winner"] < 0
    return words | {
        "nearest": "-" if nobody else str(row["winner"]),
        "its period": "-" if nobody else str(row["computed_period"] or "-"),
        "its side": "-" if nobody and "computed_side" in row else row.get("computed_side"),
        "distance": number(row["distance"], ".4f"),
        "in noise": number(row["distance_in_noise"], ".2f"),
        "next": number(row["runner_up"], ".4f"),
    }


def edges_table(compared: xr.Dataset) -> Table:
    """Return a table of the frequencies at which regimes (period and class of motion) end on the rig and in
    the model.
    """
    words = words_of(compared)
    rows: list[Row] = []
    for k in range(compared.sizes.get("edge", 0)):
        one = compared.isel(edge=k)
        row: Row = {"direction": str(one["edge_direction"].values)}
        for n in ("before", "after"):
            row[n] = words_for((int(one[f"edge_{n}_period"]), int(one[f"edge_{n}_side"])), words)
        for n in ("measured", "computed", "shift"):
            row |= {f"{n}_hz": float(one[f"edge_{n}_hz"]), f"{n}_error_hz": float(one[f"edge_{n}_error_hz"])}
        rows.append(row | {"note": str(one["edge_note"].values)})
    return Table(rows, [counted(len(rows), "window edge"), *aligned([_edge_words(r) for r in rows])])


def _edge_words(row: Row) -> Words:
    return {
        "way": row["direction"],
        "from": row["before"],
        "to": row["after"],
        "measured Hz": _between(row, "measured"),
        "computed Hz": _between(row, "computed"),
        "shift Hz": _between(row, "shift"),
        "note": row["note"],
    }


def _between(row: Row, name: str) -> str:
    value, error = row[f"{name}_hz"], row[f"{name}_error_hz"]
    return "-" if math.isnan(value) else f"{value:.4f} ± {error:.4f}"


def summary_lines(compared: xr.Dataset) -> list[str]:
    """Return a printed summary of the comparison of a measured with a computed diagram."""
    covered = compared["winner"].values >= 0
    sure = covered & (compared["confidence"].values >= CONFIDENT)
    d = compared["distance_in_noise"].values[covered]
    lines = [
        f"{int(covered.sum())} of {covered.size} steps lie on the run's axis; distance from the nearest "
        f"attractor: median {np.median(d):.2f}, 90 % below {np.quantile(d, 0.9):.2f} noise floors"
    ]
    for name, what in (("same_period", "periods"), ("same_side", "sides")):
        known = sure & (compared[name].values >= 0)
        if known.any():
            share = compared[name].values[known].mean()
            lines.append(f"{what} agree at {100 * share:.0f} % of the {int(known.sum())} steps that are sure")
    far = int((d > FAR).sum())
    if far:
        lines.append(
            f"at {far} steps the nearest attractor is more than {FAR:g} noise floors away: the model is off, "
            "or the run did not find the attractor, which more initial conditions may"
        )
    return lines
