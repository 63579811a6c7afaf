"""Compute the residuals of measured orbits and their derivatives by the unknowns of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.carrying import Array, OrbitData, solution_of, solve
from pipeline.rig.identify.orbits import nearest, quantities_of, slopes_along
from pipeline.rig.identify.problem import Problem

LOST = 1e6
"""Residual, in standard deviations, of an orbit that could not be found."""

STEP = 1e-4
"""Step of the central differences by an unknown, in units of its size; their error is about its square."""


@dataclass(frozen=True)
class OrbitRows:
    """Residuals of measured orbits for one set of unknowns."""

    rows: Array  # (m,) measured less computed, in standard deviations
    jacobian: Array  # (m, n_free) derivative of `rows` by the unknowns; empty without slopes
    lost: int  # number of orbits that were not found
    tables: tuple[OrbitData, ...]  # tables with the computed orbits of these unknowns, to start from next


def orbit_rows(problem: Problem, thetas: Array, *, slopes: bool) -> list[OrbitRows]:
    """Compute the residuals of all measured orbits and bifurcations for each row of unknowns.

    Parameters
    ----------
    problem
        Problem with the tables `Problem.orbits`.
    thetas
        Unknowns, shape (n, n_free) [SI].
    slopes
        Whether to compute derivatives: central differences of the computed orbits.
    """
    parts = [_table_rows(problem, table, thetas, slopes) for table in problem.orbits]
    found = []
    for member in zip(*parts, strict=True):
        rows = np.concatenate([one.rows for one in member])
        jacobian = np.vstack([one.jacobian for one in member])
        lost = sum(one.lost for one in member)
        found.append(OrbitRows(rows, jacobian, lost, tuple(one.tables[0] for one in member)))
    return found


def _table_rows(problem: Problem, table: OrbitData, thetas: Array, slopes: bool) -> list[OrbitRows]:
    packed = np.array([table.packed(problem.values(theta)) for theta in thetas])
    points = nearest(table, packed)
    values = quantities_of(table, packed, points)
    found = []
    for i, theta in enumerate(thetas):
        own = replace(table, known=solution_of(table, packed[i], points[i]))
        rows, is_lost = _residuals(table, values[i])
        jacobian = np.zeros((len(rows), len(problem.free) if slopes else 0))
        if slopes:
            jacobian, own = _slopes(problem, own, theta, values[i])
            jacobian = _along_removed(own, packed[i], points[i], jacobian)
        n_lost = sum(point is None for point in points[i])
        # with a lost orbit the next parameters start from where all were last
        found.append(
            OrbitRows(rows, np.where(is_lost[:, None], 0.0, jacobian), n_lost, (own if not n_lost else table,))
        )
    return found


def _residuals(table: OrbitData, values: Sequence[Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the residuals of a table of orbits in standard deviations, and a mask of the residuals of orbits that were
    not found.
    """
    rows = np.concatenate([(d.measured - v) / d.sd for d, v in zip(table.data, values, strict=True)])
    is_lost = ~np.isfinite(rows)
    return np.where(is_lost, LOST, rows), is_lost


def _slopes(problem: Problem, table: OrbitData, theta: Array, values: Sequence[Array]) -> tuple[Array, OrbitData]:
    """Return the derivatives by the unknowns of a table's residuals, and the table of orbits with the derivatives of
    its orbits added.
    """
    jacobian = np.zeros((sum(len(d.measured) for d in table.data), len(problem.free)))
    ends, widths = _ends(problem, theta)
    if not len(ends):
        return jacobian, table
    packed = np.array([table.packed(problem.values(row)) for row in ends])
    points = solve(table, packed)
    found = quantities_of(table, packed, points)
    here, by_name = np.concatenate(list(values)), {}
    for j, i in enumerate(problem.moving):
        two = range(2 * j, 2 * j + 2)
        jacobian[:, i] = _difference(here, [np.concatenate(found[k]) for k in two], widths[j])
        unknowns = [solution_of(table, packed[k], points[k]).unknowns for k in two]
        by_name[problem.free[i].name] = _difference(table.known.unknowns, unknowns, widths[j])
    sd = np.concatenate([d.sd for d in table.data])
    return -jacobian / sd[:, None], replace(table, known=replace(table.known, slopes=by_name))


def _ends(problem: Problem, theta: Array) -> tuple[Array, list[Array]]:
    """Return the unknowns for central differences, with one unknown moved up or down in turn, and all displacements."""
    ends, widths = [], []
    for i in problem.moving:
        free = problem.free[i]
        h = STEP * max(abs(float(theta[i])), free.size)
        both = np.tile(theta, (2, 1))
        both[:, i] = np.clip(theta[i] + h * np.array([1.0, -1.0]), free.lower, free.upper)
        ends.append(both)
        widths.append(both[:, i] - theta[i])
    return np.concatenate([np.zeros((0, len(theta))), *ends]), widths


def _difference(here: Array, there: Sequence[Array], widths: Array) -> Array:
    """Return a central difference, or a one-sided one where only one of the two values is finite; 0 where none is."""
    with np.errstate(invalid="ignore", divide="ignore"):
        central = (there[0] - there[1]) / (widths[0] - widths[1])
        sides = [(one - here) / width for one, width in zip(there, widths, strict=True)]
    found = np.where(np.isfinite(central), central, np.where(np.isfinite(sides[0]), sides[0], sides[1]))
    return np.asarray(np.where(np.isfinite(found), found, 0.0))


def _along_removed(table: OrbitData, packed: Array, points: Sequence[Point | None], jacobian: Array) -> Array:
    """Remove the component along the branch from the derivatives of those orbits whose parameter value is uncertain.

    Its place on the branch is fitted for every set of unknowns (variable projection; see ``local``).
    """
    places = [(0, k) for k, datum in enumerate(table.data) if datum.is_free and points[k] is not None]
    slopes = dict(zip((k for _, k in places), slopes_along(table, packed[None], places, [points]), strict=True))
    found, first = jacobian.copy(), 0
    for k, datum in enumerate(table.data):
        rows = slice(first, first + len(datum.measured))
        first = rows.stop
        if k not in slopes:
            continue
        direction = slopes[k]
        if np.isfinite(direction).all() and np.linalg.norm(direction) > 0.0:
            direction = direction / np.linalg.norm(direction)
            found[rows] -= np.outer(direction, direction @ found[rows])
    return found
