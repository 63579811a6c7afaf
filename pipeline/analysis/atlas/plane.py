"""Lay out the attractors of a run over a plane of two parameters, and list where neighbouring points differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.orbits import wrap_angles
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, BOUNDED_SET, EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dims_of, point_of_rows, points_of_rows
from pipeline.results.selection import choose, start_dims

Array = np.ndarray[Any, Any]


class Change(NamedTuple):
    """An attractor at one of two neighbouring points that is not at the other, has another kind or period there, or may
    have jumped.
    """

    edge: int
    here: int  # node at which it is
    there: int  # the neighbour
    row: int  # its row at `here`
    other: int  # row of the same attractor at `there`, -1 none


@dataclass(frozen=True, eq=False)
class Plane:
    """Attractors (rows) at the points (nodes) of a plane, and the pairs of neighbouring points (edges)."""

    names: tuple[str, str]  # axes
    shape: tuple[int, int]  # numbers of values along them
    values: Array  # parameter values of the nodes, (node, 2): those of the grid, the second first, then further ones
    edges: Array  # (edge, 2): two neighbours, the one with the larger value last; those of the grid first
    parent: Array  # (edge,): edge of the grid on which it lies
    is_parted: Array  # (edge,): whether further points part it
    n_cells: Array  # (node,): cells
    n_known: Array  # (node,): cells with a known outcome
    sets: xr.Dataset  # the sets on the grid
    labels: Array  # (node of the grid, cell): outcome of each cell, see `outcomes`
    # of each row
    node: Array
    attractor: Array  # id
    kind: Array
    period: Array
    cells: Array  # number of cells on it
    is_polished: Array
    points: list[Array]  # section points, (any, state)

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
    labels = outcomes(part).transpose(*names, ...).values.reshape(*shape, -1)[np.ix_(*order)]
    labels = labels.reshape(len(values), -1)
    edges = [np.stack([number[:-1].ravel(), number[1:].ravel()], axis=-1)]
    edges += [np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=-1)]
    return Plane(
        names,
        shape,
        values,
        np.concatenate(edges),
        np.arange(sum(map(len, edges))),
        np.zeros(sum(map(len, edges)), bool),
        np.full(len(labels), labels.shape[1]),
        (labels != -1).sum(axis=1),
        part,
        labels,
        own.ravel()[point_of_rows(part)[rows]],
        *columns_of(part, rows),
    )


def columns_of(part: xr.Dataset, rows: Array) -> tuple[Any, ...]:
    """Return of some sets the id, kind, period, number of cells, whether it is refined, and the section points."""
    names = ["attractor", "kind", "orbit_period", "n_cells", "is_polished"]
    points = points_of_rows(part)
    return (*(part[name].values[rows] for name in names), [points[row] for row in rows.tolist()])


def changes_of(plane: Plane, system: System) -> list[Change]:
    """List the attractors that differ, or may differ, between neighbouring points, by edge and id.

    Around a cusp one id passes from one sheet of orbits to the other. So an orbit that moves between two points by more
    than beside them is listed as well: it may have jumped.
    """
    at: list[dict[int, int]] = [{} for _ in range(len(plane.values))]
    for row, (node, number) in enumerate(zip(plane.node.tolist(), plane.attractor.tolist(), strict=True)):
        at[node][number] = row
    alike = np.stack([plane.kind, plane.period], axis=-1).tolist()
    found: list[Change] = []
    pairs: list[Change] = []
    same = continued(plane)
    for edge in np.flatnonzero(~plane.is_parted).tolist():
        a, b = plane.edges[edge].tolist()
        for number in sorted(at[a].keys() | at[b].keys()):
            rows = at[a].get(number, -1), at[b].get(number, -1)
            if rows[0] < 0:
                found += [Change(edge, b, a, rows[1], -1)] if (rows[1], a) not in same else []
            elif rows[1] < 0 and (rows[0], b) in same:
                continue
            elif rows[1] < 0 or alike[rows[0]] != alike[rows[1]]:
                found += _both_ways(edge, a, b, rows)
            elif plane.kind[rows[0]] not in APERIODIC:
                pairs.append(Change(edge, a, b, *rows))
    return sorted([*found, *_jumps(plane, pairs, system)])


def continued(plane: Plane) -> dict[tuple[int, int], int]:
    """Find sets other than orbits that go on at a neighbouring point of the grid under another id: all cells of each
    are there on the other. Return the row there by row and neighbour.
    """
    numbers = {(int(n), int(i)): row for row, (n, i) in enumerate(zip(plane.node, plane.attractor, strict=True))}
    own = np.flatnonzero(np.isin(plane.kind, APERIODIC) & (plane.node < len(plane.labels)))
    found: dict[tuple[int, int], int] = {}
    beside: dict[int, list[int]] = {}
    for a, b in plane.edges[: plane.parent.max() + 1].tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    for row in own.tolist():
        node, number = int(plane.node[row]), int(plane.attractor[row])
        for other in beside.get(node, []):
            here, there = plane.labels[node], plane.labels[other]
            to = set(there[here == number].tolist()) - {-1}
            heir = numbers.get((other, next(iter(to))), -1) if len(to) == 1 else -1
            if heir < 0 or plane.kind[heir] not in APERIODIC:
                continue
            kinds = {int(plane.kind[row]), int(plane.kind[heir])} - {BOUNDED_SET}
            if len(kinds) < 2 and set(here[there == plane.attractor[heir]].tolist()) - {-1} == {number}:
                found[row, other] = heir
    return found


def pairs_on(plane: Plane, edge: int, period: int) -> list[Change]:
    """Return the orbits of a period (0: equilibria) with one id at both points of an edge, as changes both ways."""
    own = (plane.kind == (PERIODIC_ORBIT if period else EQUILIBRIUM)) & (plane.period == period)
    a, b = plane.edges[edge].tolist()
    here, there = (
        {int(plane.attractor[row]): int(row) for row in np.flatnonzero(own & (plane.node == node))} for node in (a, b)
    )
    both = sorted(here.keys() & there.keys())
    return [one for number in both for one in _both_ways(edge, a, b, (here[number], there[number]))]


def _both_ways(edge: int, a: int, b: int, rows: tuple[int, int]) -> list[Change]:
    """Return the changes of an attractor from a point to the next if it is there, and back."""
    ahead = [Change(edge, a, b, rows[0], rows[1])]
    return ahead if rows[1] < 0 else [*ahead, Change(edge, b, a, rows[1], rows[0])]


def _jumps(plane: Plane, pairs: Sequence[Change], system: System) -> list[Change]:
    """Return the pairs of orbits that move otherwise than the pairs before and after them on their line of the grid."""
    least, other = 1e-3, 0.5  # scaled move that is none; largest difference of neighbouring moves, in units of the move
    moves = {(one.row, one.other): move for one, move in zip(pairs, _moves(plane, pairs, system), strict=True)}
    before = {(one.other, plane.axis_of(one.edge)): one.row for one in pairs}
    after = {(one.row, plane.axis_of(one.edge)): one.other for one in pairs}
    found = []
    for one in pairs:
        axis, (move, shift) = plane.axis_of(one.edge), moves[one.row, one.other]
        size = np.linalg.norm(move)
        beside = []  # in the order of the points at `here`
        if (left := before.get((one.row, axis), -1)) >= 0:
            beside.append(np.roll(*moves[left, one.row], axis=0))
        if (right := after.get((one.other, axis), -1)) >= 0:
            beside.append(np.roll(moves[one.other, right][0], -shift, axis=0))
        if size > least and not any(np.linalg.norm(move - step) < other * size for step in beside):
            found += _both_ways(one.edge, one.here, one.there, (one.row, one.other))
    return found


def _moves(plane: Plane, pairs: Sequence[Change], system: System) -> list[tuple[Array, int]]:
    """Return the scaled move of each orbit to its neighbour (phase, state), and the shift of phases to it."""
    scales, found = np.asarray(system.scales), []
    for one in pairs:
        phases = max(int(plane.period[one.row]), 1)
        here, there = plane.points[one.row][:phases], plane.points[one.other][:phases]
        shift = int(np.linalg.norm(wrap_angles(there - here[0], system) / scales, axis=-1).argmin())
        found.append((wrap_angles(np.roll(there, -shift, axis=0) - here, system) / scales, shift))
    return found
