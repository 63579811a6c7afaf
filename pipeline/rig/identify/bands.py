"""Compute 95 % bands of the amplitude along branches, and 95 % intervals of bifurcation values, from draws of the
posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.branches.bands import bifurcation_data, carried, orbit_data, place_variables, solvable
from pipeline.analysis.branches.carrying import ORBIT, OrbitData, Solution, solve
from pipeline.analysis.draws import LEVELS, interval_of, stretches
from pipeline.products.product import Table
from pipeline.rig.identify.directory import ORBITS, read_info, read_result
from pipeline.rig.identify.measured_orbits import MeasuredTable, stored_table
from pipeline.rig.identify.orbits import quantities_of


def stored_tables(directory: str | Path) -> list[MeasuredTable]:
    """Return the measured orbits of a finished identification, one `MeasuredTable` per table ``[[orbits]]``."""
    info, result = read_info(directory), read_result(directory)
    model = load_model(result["model"])
    found = []
    for i, table in enumerate(info.identity["spec"]["orbits"]):
        with xr.open_dataset(Path(directory) / ORBITS.format(i), engine="scipy") as ds:
            # a dim of length 0 is read as an unlimited one
            measured = ds.load().drop_encoding()
        found.append(stored_table(table["data"], model, measured if "orbit" in measured.sizes else None))
    return found


def bands(table: MeasuredTable, best: dict[str, float], drawn: xr.Dataset) -> xr.Dataset:
    """Compute amplitudes on the branches and values of the bifurcations for each draw of the posterior.

    Each orbit and each bifurcation is carried from the best parameters to those of a draw by Newton's method, in
    steps where this is necessary. No branch is computed again.

    Parameters
    ----------
    table
        Measured orbits: model, parameter and interval.
    best
        Values of all parameters at the best fit.
    drawn
        From `draw_posterior`.

    Returns
    -------
    Dataset
        ``bifurcation_value`` over (draw, bifurcation) with ``kind`` and ``best_value``, and ``amplitude`` over (draw,
        orbit) with ``branch``, ``parameter_value``, ``n_unstable`` and ``best_amplitude``; NaN where a draw has none.
    """
    branches, _ = table.branches(best)
    points, states, _ = bifurcation_data(branches)
    orbits, guesses, places = orbit_data(table.along, branches, ("amplitude",))
    data = [*points, *orbits]
    packed = table.along.model.load().replace(**_own(table, best)).pack()
    guess = np.array([*states, *guesses]).reshape(len(data), -1)
    known = Solution(packed, guess, np.zeros_like(guess))
    start, solved = solvable(OrbitData(table.along, table.state, tuple(data), known, table.settings))
    values = _carried(start, drawn)
    n_points = sum(d.kind != ORBIT for d in start.data)
    own = [k - len(points) for k in solved[n_points:]]
    best_values = quantities_of(start, packed[None], solve(start, packed[None]))[0]
    share = np.isfinite(values[:, n_points:]).mean(axis=0)
    return xr.Dataset(
        {
            "bifurcation_value": (("draw", "bifurcation"), values[:, :n_points]),
            "best_value": ("bifurcation", [v[0] for v in best_values[:n_points]]),
            "kind": ("bifurcation", np.array([d.kind for d in start.data[:n_points]], object)),
            "period": ("bifurcation", [d.period for d in start.data[:n_points]]),
            "amplitude": (("draw", "orbit"), values[:, n_points:]),
            "best_amplitude": ("orbit", [v[0] for v in best_values[n_points:]]),
            **place_variables([orbits[k] for k in own], [places[k] for k in own], share),
        },
        attrs={"parameter": table.along.parameter, "state": table.state},
    )


def _own(table: MeasuredTable, values: dict[str, float]) -> dict[str, float]:
    return {name: v for name, v in {**values, **table.settings}.items() if name in table.along.model.parameter_names}


def _carried(table: OrbitData, drawn: xr.Dataset) -> np.ndarray:
    """Return amplitude or bifurcation value for each measured orbit or bifurcation, shape (draw, datum); NaN where none
    is found.
    """
    names = [str(name) for name in drawn["parameter"].values]
    packed = np.array([table.packed(dict(zip(names, row, strict=True))) for row in drawn["value"].values])
    found = [[v[0] for v in row] for own, points in carried(table, packed) for row in quantities_of(table, own, points)]
    return np.array(found).reshape(len(packed), len(table.data))


def bands_table(found: Sequence[xr.Dataset]) -> Table:
    """Return a table of the bifurcations: best value, median and 95 % interval over the draws with this bifurcation."""
    rows, lines = [], []
    for ds in found:
        for b in range(ds.sizes["bifurcation"]):
            values = ds["bifurcation_value"].values[:, b]
            low, middle, high, n = interval_of(values)
            kind, best = str(ds["kind"].values[b]).replace("_", " "), float(ds["best_value"].values[b])
            row = {"kind": kind, "period": int(ds["period"].values[b]), "best": best, "median": middle}
            rows.append({**row, "low": low, "high": high, "n_draws": n})
            lines.append(
                f"{kind} at {ds.attrs['parameter']} = {best:.6g}   95 %: {low:.6g} to {high:.6g} "
                f"({n} of {len(values)} draws have it)"
            )
    return Table(rows, lines)


def tubes(found: xr.Dataset) -> list[dict[str, np.ndarray]]:
    """Return the 95 % amplitude bands, one per branch and stability: parameter values with lower and upper amplitude.

    A band is there where at least half of the draws have the orbit.
    """
    bands_of = []
    for _, _, chosen in stretches(found):
        low, _, high = np.nanquantile(found["amplitude"].values[:, chosen], LEVELS, axis=0)
        bands_of.append({"x": found["parameter_value"].values[chosen], "low": low, "high": high})
    return bands_of
