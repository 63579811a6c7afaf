"""Report how a model agrees with measured orbits and bifurcations, fitted and held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import words_of
from pipeline.layout.writing import json_value
from pipeline.rig.measured_branch.comparison import branch_table

GROUPS = ("fitted", "held_out")


def orbits_result(judged: Sequence[xr.Dataset]) -> list[dict[str, Any]]:
    """Return the comparison of measured and computed orbits and bifurcations as plain data, one entry per table
    ``[[orbits]]``.

    Parameters
    ----------
    judged
        From `judge_orbits`, one dataset per table.

    Returns
    -------
    list of dict
        For each table ``parameter``, ``orbits`` and ``bifurcations`` with a row each, and ``rms``: the root mean square
        of the relative errors of amplitude and frequency, for fitted and for held-out orbits of each stability.
    """
    return [
        {
            "parameter": str(ds.attrs.get("parameter", "")),
            "orbits": _orbit_rows(ds),
            "bifurcations": _bifurcation_rows(ds),
            "rms": _rms(ds),
        }
        for ds in judged
    ]


def _orbit_rows(ds: xr.Dataset) -> list[dict[str, Any]]:
    if "orbit" not in ds.sizes:
        return []
    rows = branch_table(ds).rows
    held = ds["held_out"].values
    return [json_value(row) | {"held_out": bool(h)} for row, h in zip(rows, held, strict=True)]


def _bifurcation_rows(ds: xr.Dataset) -> list[dict[str, Any]]:
    return [
        {
            "name": str(one["bifurcation"].item()),
            "measured": float(one["measured_value"]),
            "measured_sd": float(one["measured_value_sd"]),
            "computed": json_value(float(one["computed_value"])),
            "held_out": bool(one["bifurcation_held_out"]),
        }
        for one in (ds.isel(bifurcation=k) for k in range(ds.sizes["bifurcation"]))
    ]


def _rms(ds: xr.Dataset) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the rms of the relative errors by group (fitted, held out), stability and quantity; None if an orbit was
    not found.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {group: {} for group in GROUPS}
    if "orbit" not in ds.sizes:
        return found
    words, held = words_of(ds["stability"]), ds["held_out"].values
    for is_held, group in enumerate(GROUPS):
        for code, word in enumerate(words):
            chosen = (held == is_held) & (ds["stability"].values == code)
            if not chosen.any():
                continue
            own = {"amplitude": ds["relative_error"].values[chosen], "frequency": ds["frequency_error"].values[chosen]}
            found[group][word] = {name: json_value(float(np.sqrt(np.mean(e**2)))) for name, e in own.items()}
    return found


def orbit_lines(result: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the comparison of measured and computed orbits in ``result.json`` as printed lines."""
    lines = []
    for table in result:
        for group in GROUPS:
            for word, errors in table["rms"][group].items():
                shown = ", ".join(
                    f"{name} {'lost' if rms is None else format(100.0 * rms, '.2g') + ' %'}"
                    for name, rms in errors.items()
                )
                stability = "" if word == "unknown" else f"{word} "
                lines.append(f"{group.replace('_', ' ')} {stability}orbits: root mean square errors {shown}")
        for one in table["bifurcations"]:
            computed = "none" if one["computed"] is None else f"{one['computed']:.6g}"
            held = ", held out" if one["held_out"] else ""
            lines.append(f"{one['name']}{held}: measured {one['measured']:.6g} ± {one['measured_sd']:.2g}, {computed}")
    return lines
