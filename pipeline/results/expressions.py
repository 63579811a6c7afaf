"""Evaluate the densities and the quantities that users write as expressions of states, parameters and results."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import value_of
from pipeline.layout.evaluation import parameter_points
from pipeline.layout.vocabulary import frequency_of, parameters_of, split_dims
from pipeline.results.run import OpenRun
from pipeline.results.selection import refuse_origins, start_states
from pipeline.specification.expressions import read_expression
from pipeline.specification.tables import FREQUENCY


def mean_over_cells(tree: Tree, known: Mapping[str, Any], weights: np.ndarray) -> float:
    """Return the value of an expression, as the weighted mean over cells if it depends on states.

    Values of its names are numbers, and arrays of shape (cell,), as the weights. NaN if it depends on states and there
    is no cell with a weight.
    """
    value = np.asarray(value_of(tree, {"pi": np.pi, **known}), np.float64)
    if not value.ndim:
        return float(value)
    counts = weights > 0.0
    return float(np.average(value[counts], weights=weights[counts])) if counts.any() else np.nan


def check_density(run: OpenRun, text: str) -> None:
    """Raise ValueError unless an expression is a density of a run's starts, at both ends of every axis."""
    cube = run.cube()
    if text != "1":
        refuse_origins(cube, "a density")
    columns = start_states(cube, split_dims(cube["status"])[1]).T
    states = dict(zip(run.model.state_names, columns, strict=True))
    for point in parameter_points(run.spec):
        density_at(text, {"f": point[FREQUENCY], **point}, states)


def weights_of(ds: xr.Dataset, dims: Sequence[str], starts: tuple[str, ...], text: str) -> np.ndarray:
    """Return the density of the starts of cells as their weights, shape (parameter point, cell).

    `ds` has the coordinates of a cube; its parameter points are those over `dims`.
    """
    base = parameters_of(ds)
    states = dict(zip(base.model.state_names, start_states(ds, starts).T, strict=True))
    fixed = {str(name): float(v) for name, v in ds.coords.items() if not v.ndim and v.dtype.kind == "f"}
    points = itertools.product(*(ds[d].values.tolist() for d in dims))
    found = []
    for values in points:
        here = {**fixed, **dict(zip(dims, values, strict=True))}
        known = {**base, **{name: value for name, value in here.items() if name in base}}
        found.append(density_at(text, {"f": frequency_of(base.model, here), **known}, states))
    return np.array(found)


def density_at(text: str, known: Mapping[str, Any], states: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the density of initial states at cells, as their weights, shape (cell,); not normalised.

    The text may use known numbers and states, the values of which have shape (cell,).

    Raises
    ------
    ValueError
        If the text is no such expression, or the density is negative or not finite at a cell, or 0 at all cells.
    """
    tree = read_expression("density", text, [*known, *states])
    n = len(next(iter(states.values())))
    with np.errstate(all="ignore"):
        value = value_of(tree, {"pi": np.pi, **known, **states})
    weights = np.array(np.broadcast_to(np.asarray(value, np.float64), n))
    bad = np.flatnonzero(~(np.isfinite(weights) & (weights >= 0.0)))
    if len(bad):
        at = ", ".join(f"{name} = {column[bad[0]]:g}" for name, column in states.items())
        raise ValueError(f"density = {text!r}: is {weights[bad[0]]:g} at {at}; must be 0 or greater at all starts.")
    if not weights.any():
        raise ValueError(f"density = {text!r}: is 0 at all starts of the run; it must be greater than 0 at some.")
    return weights
