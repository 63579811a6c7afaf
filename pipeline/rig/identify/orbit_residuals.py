"""Compute the residuals of measured orbits and bifurcations, and their derivatives by the unknowns of a fit.

The computed orbit at a measured value of the parameter is found by Newton's method from the orbit of the last
accepted parameters. Where this fails, the way there is made in smaller steps. So no trajectory settles, and unstable
orbits serve as well as stable ones.

Close to a fold, the orbit at a given value of the parameter ends with the fold. There the parameter of a measurement
has an error too: the computed orbit is the nearest one on the branch (orthogonal distance regression: Boggs, Byrd and
Schnabel, SIAM J. Sci. Stat. Comput. 8, 1987, 1052), which is there on both sides of the fold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.analysis.branches.arclength import Point, correct
from pipeline.analysis.branches.carrying import NEWTON, ORBIT, PARAMETER, Array, OrbitData, raw_of, solution_of, solve
from pipeline.analysis.branches.following import problem_of
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.rig.identify.problem import Problem
from pipeline.rig.measured.branch_computed import shapes_of

LOST = 1e6
"""Residual, in units of the noise, of a trajectory that diverged, and of an orbit that could not be found."""


def nearest(table: OrbitData, packed: Array) -> list[list[Point | None]]:
    """Return the computed orbit or bifurcation nearest to each measured one, for each row of parameters; None where
    none is found.

    An orbit whose parameter has an error is moved along its branch to where it is nearest to the measured one.
    """
    # longest step along a branch towards the nearest orbit, the step that ends the search, and most steps
    longest_step, last_step, rounds = 0.05, 1e-6, 40
    points = solve(table, packed)
    longest = np.full((len(packed), len(table.data)), longest_step)
    going = [(i, k) for i in range(len(packed)) for k, d in enumerate(table.data) if d.is_free and points[i][k]]
    for _ in range(rounds):
        if not going:
            break
        slopes = slopes_along(table, packed, going, points)
        steps = _steps_along(table, packed, going, points, slopes)
        steps = [float(np.clip(s, -longest[place], longest[place])) for s, place in zip(steps, going, strict=True)]
        moved = run_together(
            [_moved(table, k, packed[i], points[i][k], step) for (i, k), step in zip(going, steps, strict=True)]
        )
        left = []
        for (i, k), point, step in zip(going, moved, steps, strict=True):
            if point is None:
                longest[i, k] *= 0.25
            else:
                points[i][k] = point
            if abs(step) > last_step:
                left.append((i, k))
        going = left
    return points


def slopes_along(
    table: OrbitData, packed: Array, places: Sequence[tuple[int, int]], points: Sequence[Sequence[Point | None]]
) -> list[Array]:
    """Return each orbit's derivatives of its quantities by arclength, divided by their standard deviations."""
    aside = 1e-3  # arclength to a neighbour on the branch, for derivatives along it
    beside = [
        run_together([_moved(table, k, packed[i], points[i][k], side) for i, k in places]) for side in (aside, -aside)
    ]
    found = []
    for n, (i, k) in enumerate(places):
        part = replace(table, data=(table.data[k],))
        ahead, behind = (quantities_of(part, packed[i][None], [[side[n]]])[0][0] for side in beside)
        found.append((ahead - behind) / (2.0 * aside) / table.data[k].sd)
    return found


def _steps_along(
    table: OrbitData,
    packed: Array,
    places: Sequence[tuple[int, int]],
    points: Sequence[Sequence[Point | None]],
    slopes: Sequence[Array],
) -> list[float]:
    """Return the arclength step that brings each computed orbit nearest to the measured one (Gauss-Newton)."""
    found = []
    for (i, k), slope in zip(places, slopes, strict=True):
        datum = table.data[k]
        value = quantities_of(replace(table, data=(datum,)), packed[i][None], [[points[i][k]]])[0][0]
        rows = (datum.measured - value) / datum.sd
        known = np.isfinite(slope).all() and slope @ slope > 0.0
        found.append(float(rows @ slope / (slope @ slope)) if known else 0.0)
    return found


def _moved(table: OrbitData, k: int, packed: Array, point: Point | None, step: float) -> Steps[Point | None]:
    """Return the orbit at the arclength `step` from another orbit on its branch; None if Newton's method fails."""
    assert point is not None
    problem = problem_of(table.along.family(table.data[k].period, packed))
    found = yield from correct(problem, point.u + step * point.tangent, point.tangent, NEWTON)
    return found


def quantities_of(table: OrbitData, packed: Array, points: Sequence[Sequence[Point | None]]) -> list[list[Array]]:
    """Return the computed values of the measured quantities, for each row of packed parameters and each measured orbit
    or bifurcation.

    NaN where an orbit is lost.
    """
    found = [[np.full(len(d.measured), np.nan) for d in table.data] for _ in packed]
    orbits: dict[int, list[tuple[int, int, Point]]] = {}
    for i, row in enumerate(points):
        for k, (datum, point) in enumerate(zip(table.data, row, strict=True)):
            if point is None:
                continue
            if datum.kind == ORBIT:
                orbits.setdefault(datum.period, []).append((i, k, point))
            else:
                found[i][k][:] = raw_of(table, datum, point)[-1]
    for period, places in orbits.items():
        raw = np.array([raw_of(table, table.data[k], point) for _, k, point in places])
        rows = np.concatenate(
            [table.along.rows(packed[i], [r[-1]])[0] for (i, _, _), r in zip(places, raw, strict=True)]
        )
        seconds = np.array([point.value.seconds for _, _, point in places])
        columns = shapes_of(table.along.model, rows, raw[:, :-1], seconds, period, table.state).columns()
        columns[PARAMETER] = raw[:, -1]
        for j, (i, k, _) in enumerate(places):
            found[i][k] = np.array([columns[name][j] for name in table.data[k].quantities])
    return found


# ---- residuals -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OrbitRows:
    """Residuals of measured orbits for one set of unknowns."""

    rows: Array  # (m,) measured less computed, in standard deviations
    jacobian: Array  # (m, n_free) derivative of `rows` by the unknowns; empty without slopes
    lost: int  # number of orbits that were not found
    tables: tuple[OrbitData, ...]  # tables with the computed orbits of these unknowns, to start from next


def orbit_rows(problem: Problem, thetas: Array, *, slopes: bool) -> list[OrbitRows]:
    """Compute the residuals of all measured orbits and bifurcations for each row of unknowns."""
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
    """Return the residuals of a table of orbits in standard deviations, and which of them were not found."""
    rows = np.concatenate([(d.measured - v) / d.sd for d, v in zip(table.data, values, strict=True)])
    is_lost = ~np.isfinite(rows)
    return np.where(is_lost, LOST, rows), is_lost


def _slopes(problem: Problem, table: OrbitData, theta: Array, values: Sequence[Array]) -> tuple[Array, OrbitData]:
    """Return the derivatives of a table's residuals by the unknowns, and the table with those of its orbits."""
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
    share = 1e-4  # step of the central differences by an unknown, in units of its size; their error is about its square
    ends, widths = [], []
    for i in problem.moving:
        free = problem.free[i]
        h = share * max(abs(float(theta[i])), free.size)
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
