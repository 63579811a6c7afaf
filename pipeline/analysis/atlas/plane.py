"""Lay out the attractors of a run over a plane of two parameters, and list where neighbouring points differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import ATTRACTS
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dims_of, point_of_rows
from pipeline.results.selection import choose, start_dims

Array = np.ndarray[Any, Any]


class Change(NamedTuple):
    """An attractor at one of two neighbouring points that is not at the other, or has another kind or period there."""

    edge: int
    here: int  # node at which it is
    there: int  # the neighbour
    row: int  # its row at `here`
    other: int  # row of the same attractor at `there`, -1 none


@dataclass(frozen=True, eq=False)
class Plane:
    """Attractors at the points (nodes) of a plane, and the pairs of neighbouring points (edges)."""

    names: tuple[str, str]  # axes
    shape: tuple[int, int]  # numbers of values along them
    values: Array  # parameter values of the nodes, (node, 2); the second parameter varies first
    edges: Array  # (edge, 2): two neighbours, the one with the larger value last
    sets: xr.Dataset  # result with rows of sets, of the two axes alone
    rows: Array  # rows of attractors
    node: Array  # node of each of these
    n_cells: Array  # (node,): cells
    n_known: Array  # (node,): cells with a known outcome

    @property
    def low(self) -> Array:
        """Least values of the parameters."""
        return np.asarray(self.values.min(axis=0))

    @property
    def size(self) -> Array:
        """Lengths of the ranges of the parameters."""
        return np.asarray(np.ptp(self.values, axis=0))

    def scaled(self, values: Array) -> Array:
        """Return parameter values in units of the plane, from 0 to 1."""
        return np.asarray((values - self.low) / self.size)

    def axis_of(self, edge: int) -> int:
        """Return the parameter that varies along an edge."""
        a, b = self.edges[edge]
        return int(self.values[a, 0] == self.values[b, 0])


def plane_of(found: xr.Dataset, names: tuple[str, str], at: Mapping[str, float] | None = None) -> Plane:
    """Lay out a result of the analysis ``attractors`` over two of its axes.

    Raises
    ------
    ValueError
        If a further axis has several values and `at` names none of them.
    """
    part = choose(found, at, (*names, *start_dims(found)), f"the plane has the axes {names[0]} and {names[1]}")
    axes = [np.asarray(part[name].values, np.float64) for name in names]
    shape = (len(axes[0]), len(axes[1]))
    order = [np.argsort(one, kind="stable") for one in axes]
    number = np.arange(shape[0] * shape[1]).reshape(shape)  # by rising values
    place = np.empty(shape, np.int64)
    place[np.ix_(*order)] = number
    own = place if dims_of(part) == names else place.T
    rows = np.flatnonzero(part["stability"].values == ATTRACTS)
    values = np.stack(np.meshgrid(*(np.sort(one) for one in axes), indexing="ij"), axis=-1).reshape(-1, 2)
    is_known = (outcomes(part) != -1).transpose(*names, ...).values.reshape(*shape, -1)
    known = is_known.sum(axis=-1)[np.ix_(*order)].ravel()
    n_cells = np.full(len(known), is_known.shape[-1])
    edges = [np.stack([number[:-1].ravel(), number[1:].ravel()], axis=-1)]
    edges += [np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=-1)]
    node = own.ravel()[point_of_rows(part)[rows]]
    return Plane(names, shape, values, np.concatenate(edges), part, rows, node, n_cells, known)


def changes_of(plane: Plane) -> list[Change]:
    """List the attractors that differ between neighbouring points, by edge and id."""
    numbers, kinds, periods = (plane.sets[name].values for name in ("attractor", "kind", "orbit_period"))
    at: list[dict[int, int]] = [{} for _ in range(len(plane.values))]
    for row, node in zip(plane.rows.tolist(), plane.node.tolist(), strict=True):
        at[node][int(numbers[row])] = row
    alike = np.stack([kinds, periods], axis=-1).tolist()
    found = []
    for edge, (a, b) in enumerate(plane.edges.tolist()):
        for number in sorted(at[a].keys() | at[b].keys()):
            rows = at[a].get(number, -1), at[b].get(number, -1)
            if rows[0] < 0:
                found.append(Change(edge, b, a, rows[1], -1))
            elif rows[1] < 0 or alike[rows[0]] != alike[rows[1]]:
                found.append(Change(edge, a, b, *rows))
    return found
