"""Tabulate frequency responses: a row for each orbit and channel; in words the peaks and the jumps."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.branches.table import fixed_of
from pipeline.analysis.tabular import Row, Words, aligned, words_of
from pipeline.layout.vocabulary import parameter_name
from pipeline.products.product import Table

_LANDED = {"not_closed": "no orbit within 20000 periods", "diverged": "beyond all bounds", "failed": "not integrated"}


def response_table(ds: xr.Dataset) -> Table:
    """Return the table of a response.

    Rows are those of the branches' points and channels: value of the parameter, fixed parameters, branch, period,
    whether the orbit is stable, ``amplitude`` (half of peak to peak), ``mean``, ``rms``, ``error``,
    ``dominant_order``, and ``harmonic_1``, ``phase_1`` [rad], ... The text shows the largest amplitude of each
    branch, and for each jump the amplitudes before and after it, of the first channel.
    """
    rows = _rows(ds)
    if not rows:
        return Table(rows, ["no orbit to measure"], "no branch: no closed orbit to begin with")
    name, first = parameter_name(str(ds.attrs["parameter"])), str(ds["channel"].values[0])
    lines = [f"amplitude of {first}{_unit(ds)} along {name}, the largest of each branch"]
    lines += ["", *aligned([_peak(ds, name, i) for i in range(ds.sizes["branch"])], "")]
    jumps = [_jump(ds, name, k) for k in np.argsort(_jump_values(ds), kind="stable")]
    lines += ["", "jumps", *aligned(jumps, "  ")] if jumps else ["", "no jump: no stable orbit ends at a fold"]
    return Table(rows, lines)


def _rows(ds: xr.Dataset) -> list[Row]:
    name = parameter_name(str(ds.attrs["parameter"]))
    rows = []
    arrays = {key: ds[key].values for key in ("parameter", "n_unstable", "orbit_period", "harmonic_amplitude", "phase")}
    measures = {key: ds[key].values for key in ("amplitude", "mean", "rms", "error", "dominant_order")}
    for i in range(ds.sizes["branch"]):
        fixed = fixed_of(ds, i)
        for j in range(int(ds["n_points"][i])):
            for c, channel in enumerate(ds["channel"].values):
                row: Row = {name: float(arrays["parameter"][i, j]), **fixed, "branch": i}
                row |= {"period": int(arrays["orbit_period"][i]), "stable": bool(arrays["n_unstable"][i, j] == 0)}
                row |= {"channel": str(channel), **{key: float(v[i, j, c]) for key, v in measures.items()}}
                for k, order in enumerate(ds["harmonic"].values):
                    row[f"harmonic_{order}"] = float(arrays["harmonic_amplitude"][i, j, c, k])
                    row[f"phase_{order}"] = float(arrays["phase"][i, j, c, k])
                rows.append(row)
    return rows


def _unit(ds: xr.Dataset) -> str:
    unit = str(ds["unit"].values[0])
    return "" if unit in ("", "1") else f" [{unit}]"


def _peak(ds: xr.Dataset, name: str, branch: int) -> Words:
    n = int(ds["n_points"][branch])
    amplitude = ds["amplitude"].values[branch, :n, 0]
    at = int(np.nanargmax(amplitude))
    x, stable = ds["parameter"].values[branch, :n], ds["n_unstable"].values[branch, :n] == 0
    return {
        "branch": str(branch),
        **{key: f"{value:g}" for key, value in fixed_of(ds, branch).items()},
        "period": str(int(ds["orbit_period"][branch]) or "equilibrium"),
        name: f"{x.min():.6g} to {x.max():.6g}",
        "largest": f"{amplitude[at]:.6g}",
        "at": f"{x[at]:.6g}",
        "stable": f"{stable.mean():.0%}",
    }


def _jump_values(ds: xr.Dataset) -> np.ndarray:
    return np.asarray(ds["value"].values[ds["jump_bifurcation"].values])


def _jump(ds: xr.Dataset, name: str, k: int) -> Words:
    one: Any = ds.isel(jump=int(k))
    event = int(one["jump_bifurcation"])
    branch = int(ds["of_branch"][event])
    word = words_of(ds["jump_landing"])[int(one["jump_landing"])]
    lands = f"{float(one['jump_amplitude'][0]):.6g} (period {int(one['jump_period'])})"
    return {
        **{key: f"{value:g}" for key, value in fixed_of(ds, branch).items()},
        name: f"{float(ds['value'][event]):.7g}",
        "as it": "rises" if bool(one["jump_rises"]) else "falls",
        "from": f"{float(ds['bifurcation_amplitude'][event, 0]):.6g} (period {int(ds['orbit_period'][branch])})",
        "to": _LANDED.get(word, lands),
    }
