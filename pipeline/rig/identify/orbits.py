"""Find the computed counterparts of measured orbits and bifurcations for any parameters, by Newton's method.

The computed orbit at a measured value of the parameter is found by Newton's method from the orbit of the last
accepted parameters. Where this fails, the way there is made in smaller steps. So no trajectory settles, and unstable
orbits serve as well as stable ones.

Close to a fold, the orbit at a given value of the parameter ends with the fold. There the parameter of a measurement
has an error too: the computed orbit is the nearest one on the branch (orthogonal distance regression: Boggs, Byrd and
Schnabel, SIAM J. Sci. Stat. Comput. 8, 1987, 1052), which is there on both sides of the fold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.analysis.branches.arclength import Point, correct
from pipeline.analysis.branches.carrying import NEWTON, ORBIT, PARAMETER, Array, OrbitData, raw_of, solve
from pipeline.analysis.branches.following import problem_of
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.rig.measured_branch.shapes import shapes_of

BESIDE = 1e-3
"""Arclength to a neighbour on the branch, for derivatives along it."""

LONGEST, NEAREST, ROUNDS = 0.05, 1e-6, 40
"""Longest step along a branch towards the nearest orbit, the step that ends the search, and most steps."""


def nearest(table: OrbitData, packed: Array) -> list[list[Point | None]]:
    """Return the computed orbit or bifurcation nearest to each measured one, for each row of parameters; None where
    none is found.

    An orbit whose parameter has an error is moved along its branch to where it is nearest to the measured one.
    """
    points = solve(table, packed)
    longest = np.full((len(packed), len(table.data)), LONGEST)
    going = [(i, k) for i in range(len(packed)) for k, d in enumerate(table.data) if d.is_free and points[i][k]]
    for _ in range(ROUNDS):
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
            if abs(step) > NEAREST:
                left.append((i, k))
        going = left
    return points


def slopes_along(
    table: OrbitData, packed: Array, places: Sequence[tuple[int, int]], points: Sequence[Sequence[Point | None]]
) -> list[Array]:
    """Return each orbit's derivatives of its quantities by arclength along the branch, divided by their standard
    deviations.
    """
    beside = [
        run_together([_moved(table, k, packed[i], points[i][k], side) for i, k in places]) for side in (BESIDE, -BESIDE)
    ]
    found = []
    for n, (i, k) in enumerate(places):
        part = replace(table, data=(table.data[k],))
        ahead, behind = (quantities_of(part, packed[i][None], [[side[n]]])[0][0] for side in beside)
        found.append((ahead - behind) / (2.0 * BESIDE) / table.data[k].sd)
    return found


def _steps_along(
    table: OrbitData,
    packed: Array,
    places: Sequence[tuple[int, int]],
    points: Sequence[Sequence[Point | None]],
    slopes: Sequence[Array],
) -> list[float]:
    """Return the arclength step along the branch that brings each computed orbit nearest to the measured one
    (Gauss-Newton).
    """
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
