"""Carry draws of the parameters through the branches of a diagram: intervals of bifurcations, bands about orbits.

No branch is followed again: each orbit and each bifurcation is carried from the parameters of the diagram to those of a
draw by Newton's method (`carrying`). An orbit that is lost on the way counts as missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.bifurcations import DOUBLING, FOLD, HOPF, TORUS
from pipeline.analysis.branches.carrying import (
    ORBIT,
    PARAMETER,
    Along,
    Array,
    Datum,
    OrbitData,
    Solution,
    settled,
    solve,
)
from pipeline.analysis.tabular import words_of
from pipeline.products.reporting import report

GRID = 41
"""Values of the parameter at which bands are computed."""

DRAWS = 16
"""Draws that are carried in one call of the engine."""

FOLLOWED = (FOLD, DOUBLING, TORUS, HOPF)
"""Kinds of bifurcations that get an interval."""


@dataclass(frozen=True)
class Place:
    """Place of a carried orbit in a diagram.

    Attributes
    ----------
    branch : int
        Index of the branch.
    run : int
        Number of the stretch of the branch in which the parameter keeps rising or falling.
    step : int
        Index of the value of the parameter, of `GRID` ones.
    """

    branch: int
    run: int
    step: int


def bifurcation_data(branches: xr.Dataset) -> tuple[list[Datum], list[np.ndarray], list[int]]:
    """Return the located bifurcations of computed branches as data to be carried, their orbits with the value of the
    parameter, and their indices.
    """
    if "kind" not in branches:
        return [], [], []
    words, periods = words_of(branches["kind"]), branches["orbit_period"].values[branches["of_branch"].values]
    data, states, chosen = [], [], []
    for e, value in enumerate(branches["value"].values):
        kind, period = words[int(branches["kind"].values[e])], int(periods[e])
        # a fold of equilibria has equations of its own
        if kind in FOLLOWED and (period > 0 or kind == HOPF):
            one = np.ones(1)
            data.append(Datum(f"{kind} {e}", kind, float(value), period, 0, (PARAMETER,), one * value, one))
            states.append(np.append(branches["bifurcation_section"].values[e, 0], value))
            chosen.append(e)
    return data, states, chosen


def orbit_data(
    along: Along, branches: xr.Dataset, quantities: tuple[str, ...] = ()
) -> tuple[list[Datum], list[np.ndarray], list[Place]]:
    """Return orbits of computed branches at even values of the parameter as data to be carried, guesses of their
    section points with the value of the parameter, and their places.
    """
    found, guesses, places = [], [], []
    none = np.full(len(quantities), np.nan)
    for i in range(branches.sizes["branch"]):
        n, period = int(branches["n_points"][i]), int(branches["orbit_period"][i])
        if not period:
            continue
        x = branches["parameter"].values[i, :n]
        rising = np.sign(np.diff(x))
        turns = np.concatenate([[0], np.cumsum(np.diff(rising) != 0)])
        is_stable = branches["n_unstable"].values[i, :n] == 0
        for step, value in enumerate(np.linspace(along.low, along.high, GRID)):
            for j in np.flatnonzero((x[:-1] - value) * (x[1:] - value) <= 0.0):
                share = (value - x[j]) / (x[j + 1] - x[j]) if x[j + 1] != x[j] else 0.0
                stability = 1 if is_stable[j if share < 0.5 else j + 1] else 2
                datum = Datum(f"{i} {j} {value!r}", ORBIT, float(value), period, stability, quantities, none, none)
                a, b = branches["section"].values[i, j : j + 2, 0]
                found.append(datum)
                guesses.append(np.append(a + share * (b - a), value))
                places.append(Place(i, int(turns[j]), step))
    return found, guesses, places


def solvable(table: OrbitData) -> tuple[OrbitData, list[int]]:
    """Return the table without data whose equations cannot be solved at the known parameters, the others solved, and
    the indices of these.
    """
    everything = list(range(len(table.data)))
    whole = settled(table)
    if whole is not None:
        return whole, everything
    keep = []
    for k in everything:
        known = Solution(table.known.packed, table.known.unknowns[k : k + 1], table.known.tangents[k : k + 1])
        one = settled(replace(table, data=(table.data[k],), known=known))
        if one is not None:
            keep.append((k, one.known))
    rows = [np.zeros((0, table.known.unknowns.shape[1]))]
    unknowns, tangents = (
        np.concatenate([*rows, *(getattr(own, name) for _, own in keep)]) for name in ("unknowns", "tangents")
    )
    chosen = [k for k, _ in keep]
    known = Solution(table.known.packed, unknowns, tangents)
    return replace(table, data=tuple(table.data[k] for k in chosen), known=known), chosen


def carried(table: OrbitData, packed: Array) -> Iterator[tuple[Array, list[list[Point | None]]]]:
    """Yield some rows of packed parameters with the orbits and bifurcations carried to them, until all are done."""
    for first in range(0, len(packed), DRAWS):
        report("draws", first, len(packed))
        own = packed[first : first + DRAWS]
        yield own, solve(table, own)


def place_variables(data: list[Datum], places: list[Place], share: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return the variables over ``orbit`` that `stretches` reads, and the value of the parameter."""
    return {
        "branch": ("orbit", np.array([p.branch for p in places], np.int64)),
        "run": ("orbit", np.array([p.run for p in places], np.int64)),
        "step": ("orbit", np.array([p.step for p in places], np.int64)),
        "parameter_value": ("orbit", np.array([d.value for d in data], np.float64)),
        "is_stable": ("orbit", np.array([d.stability == 1 for d in data], bool)),
        "share": ("orbit", share),
    }
