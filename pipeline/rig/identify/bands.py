"""Compute 95 % bands of the amplitude along branches, and 95 % intervals of bifurcation values, from draws of the
posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.branches.bifurcations import DOUBLING, FOLD, HOPF, TORUS
from pipeline.analysis.tabular import words_of
from pipeline.products.product import Table
from pipeline.products.reporting import report
from pipeline.rig.identify.directory import ORBITS, read_info, read_result
from pipeline.rig.identify.measured_orbits import MeasuredTable, stored_table
from pipeline.rig.identify.orbits import ORBIT, Datum, OrbitData, Solution, quantities_of, settled, solve
from pipeline.rig.identify.posterior import LEVELS

GRID = 41
"""Values of the parameter at which bands are computed."""

DRAWS = 16
"""Draws that are carried in one call of the engine."""

LEAST_SHARE = 0.5
"""Least share of the draws that have an orbit, for a band at that value of the parameter."""

FOLLOWED = (FOLD, DOUBLING, TORUS, HOPF)
"""Kinds of bifurcations that get an interval."""


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
    branches, computed = table.branches(best)
    points, states = _bifurcations(branches)
    orbits, guesses = _orbits(table, branches, computed)
    data = [*points, *(d for d, _ in orbits)]
    packed = table.along.model.load().replace(**_own(table, best)).pack()
    guess = np.array([*states, *guesses]).reshape(len(data), -1)
    known = Solution(packed, guess, np.zeros_like(guess))
    start = _solvable(OrbitData(table.along, table.state, tuple(data), known, table.settings))
    values = _carried(start, drawn)
    names = [d.name for d in start.data]
    n_points = sum(d.kind != ORBIT for d in start.data)
    places = {d.name: (branch, d) for d, branch in orbits}
    chosen = [places[name] for name in names[n_points:]]
    best_values = quantities_of(start, packed[None], solve(start, packed[None]))[0]
    return xr.Dataset(
        {
            "bifurcation_value": (("draw", "bifurcation"), values[:, :n_points]),
            "best_value": ("bifurcation", [v[0] for v in best_values[:n_points]]),
            "kind": ("bifurcation", np.array([d.kind for d in start.data[:n_points]], object)),
            "period": ("bifurcation", [d.period for d in start.data[:n_points]]),
            "amplitude": (("draw", "orbit"), values[:, n_points:]),
            "best_amplitude": ("orbit", [v[0] for v in best_values[n_points:]]),
            "branch": ("orbit", np.array([branch for branch, _ in chosen], int)),
            "parameter_value": ("orbit", [d.value for _, d in chosen]),
            "is_stable": ("orbit", np.array([d.stability == 1 for _, d in chosen], bool)),
        },
        attrs={"parameter": table.along.parameter, "state": table.state},
    )


def _own(table: MeasuredTable, values: dict[str, float]) -> dict[str, float]:
    return {name: v for name, v in {**values, **table.settings}.items() if name in table.along.model.parameter_names}


def _bifurcations(branches: xr.Dataset) -> tuple[list[Datum], list[np.ndarray]]:
    """Return the bifurcations of computed branches as `Datum` objects, each with a first guess (state, parameter)."""
    if "kind" not in branches:
        return [], []
    words, periods = words_of(branches["kind"]), branches["orbit_period"].values[branches["of_branch"].values]
    data, states = [], []
    for e, value in enumerate(branches["value"].values):
        kind, period = words[int(branches["kind"].values[e])], int(periods[e])
        # a fold of equilibria has equations of its own
        if kind in FOLLOWED and (period > 0 or kind == HOPF):
            one = np.ones(1)
            data.append(Datum(f"{kind} {e}", kind, float(value), period, 0, ("parameter",), one * value, one))
            states.append(np.append(branches["bifurcation_section"].values[e, 0], value))
    return data, states


def _orbits(
    table: MeasuredTable, branches: xr.Dataset, computed: np.ndarray
) -> tuple[list[tuple[Datum, int]], list[np.ndarray]]:
    """Return orbits of computed branches at evenly spaced parameter values as `Datum` objects, with first guesses."""
    found, guesses = [], []
    grid = np.linspace(table.along.low, table.along.high, GRID)
    for i in range(branches.sizes["branch"]):
        n, period = int(branches["n_points"][i]), int(branches["orbit_period"][i])
        if not period:
            continue
        x = branches["parameter"].values[i, :n]
        is_stable = branches["n_unstable"].values[i, :n] == 0
        for value in grid:
            for j in np.flatnonzero((x[:-1] - value) * (x[1:] - value) <= 0.0):
                share = (value - x[j]) / (x[j + 1] - x[j]) if x[j + 1] != x[j] else 0.0
                size = np.array([computed[i, j] + share * (computed[i, j + 1] - computed[i, j])])
                name, stability = f"{i} {j} {value!r}", 1 if is_stable[j] else 2
                datum = Datum(name, ORBIT, float(value), period, stability, ("amplitude",), size, np.ones(1))
                a, b = branches["section"].values[i, j : j + 2, 0]
                found.append((datum, i))
                guesses.append(np.append(a + share * (b - a), value))
    return found, guesses


def _solvable(table: OrbitData) -> OrbitData:
    """Return the table of orbits with each orbit solved at the best parameters; drop orbits for which Newton's method
    fails.
    """
    whole = settled(table)
    if whole is not None:
        return whole
    keep = []
    for k in range(len(table.data)):
        known = Solution(table.known.packed, table.known.unknowns[k : k + 1], table.known.tangents[k : k + 1])
        one = settled(replace(table, data=(table.data[k],), known=known))
        if one is not None:
            keep.append((table.data[k], one.known))
    unknowns, tangents = (np.concatenate([getattr(own, name) for _, own in keep]) for name in ("unknowns", "tangents"))
    return replace(table, data=tuple(d for d, _ in keep), known=Solution(table.known.packed, unknowns, tangents))


def _carried(table: OrbitData, drawn: xr.Dataset) -> np.ndarray:
    """Return amplitude or bifurcation value for each measured orbit or bifurcation, shape (draw, datum); NaN where none
    is found.
    """
    names = [str(name) for name in drawn["parameter"].values]
    packed = np.array([table.packed(dict(zip(names, row, strict=True))) for row in drawn["value"].values])
    found = []
    for first in range(0, len(packed), DRAWS):
        report("draws", first, len(packed))
        own = packed[first : first + DRAWS]
        found += [[v[0] for v in row] for row in quantities_of(table, own, solve(table, own))]
    return np.array(found).reshape(len(packed), len(table.data))


def bands_table(found: Sequence[xr.Dataset]) -> Table:
    """Return a table of the bifurcations: best value, median and 95 % interval over the draws with this bifurcation."""
    rows, lines = [], []
    for ds in found:
        for b in range(ds.sizes["bifurcation"]):
            values = ds["bifurcation_value"].values[:, b]
            known = values[np.isfinite(values)]
            low, middle, high = np.quantile(known, LEVELS) if len(known) else (np.nan, np.nan, np.nan)
            kind, best = str(ds["kind"].values[b]).replace("_", " "), float(ds["best_value"].values[b])
            row = {"kind": kind, "period": int(ds["period"].values[b]), "best": best, "median": middle}
            rows.append({**row, "low": low, "high": high, "n_draws": len(known)})
            lines.append(
                f"{kind} at {ds.attrs['parameter']} = {best:.6g}   95 %: {low:.6g} to {high:.6g} "
                f"({len(known)} of {len(values)} draws have it)"
            )
    return Table(rows, lines)


def tubes(found: xr.Dataset) -> list[dict[str, np.ndarray]]:
    """Return the 95 % amplitude bands, one per branch and stability: parameter values with lower and upper amplitude.

    A band is there where at least half of the draws have the orbit.
    """
    bands_of = []
    for branch in np.unique(found["branch"].values):
        for is_stable in (True, False):
            chosen = np.flatnonzero((found["branch"].values == branch) & (found["is_stable"].values == is_stable))
            amplitude = found["amplitude"].values[:, chosen]
            there = np.isfinite(amplitude).mean(axis=0) >= LEAST_SHARE if len(chosen) else np.zeros(0, bool)
            if there.sum() < 2:
                continue
            order = np.argsort(found["parameter_value"].values[chosen][there], kind="stable")
            low, _, high = np.nanquantile(amplitude[:, there], LEVELS, axis=0)[:, order]
            x = found["parameter_value"].values[chosen][there][order]
            bands_of.append({"x": x, "low": low, "high": high})
    return bands_of
