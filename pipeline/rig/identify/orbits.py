"""Find the computed counterparts of measured orbits and bifurcations for any parameters, by Newton's method.

The computed orbit at a measured value of the parameter is found by Newton's method from the orbit of the last
accepted parameters. Where this fails, the way there is made in smaller steps. So no trajectory settles, and unstable
orbits serve as well as stable ones.

Close to a fold, the orbit at a given value of the parameter ends with the fold. There the parameter of a measurement
has an error too: the computed orbit is the nearest one on the branch (orthogonal distance regression: Boggs, Byrd and
Schnabel, SIAM J. Sci. Stat. Comput. 8, 1987, 1052), which is there on both sides of the fold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.bifurcations import HOPF, n_unstable
from pipeline.analysis.branches.equilibria import HopfProblem
from pipeline.analysis.branches.following import end_of_crossings, problem_of
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.analysis.branches.problems import BifurcationProblem
from pipeline.rig.measured_branch.computing import Along
from pipeline.rig.measured_branch.shapes import shapes_of

Array = NDArray[np.float64]

ORBIT = "orbit"
"""Kind of a datum that is an orbit; the others are kinds of bifurcations."""

PARAMETER = "parameter"
"""Name of the quantity that is the parameter itself."""

CUTS = (1, 2, 4, 8, 16)
"""Numbers of steps, tried in turn, from the last accepted parameters to new ones."""

NEWTON = Settings(tolerance=1e-10, max_iterations=10)
BESIDE = 1e-3
"""Arclength to a neighbour on the branch, for derivatives along it."""

LONGEST, NEAREST, ROUNDS = 0.05, 1e-6, 40
"""Longest step along a branch towards the nearest orbit, the step that ends the search, and most steps."""

LOCATED = Settings(tolerance=1e-8, max_iterations=12)
"""Settings of Newton's method for orbits, and for bifurcations: their residual is limited by finite differences."""


@dataclass(frozen=True)
class Datum:
    """One measured orbit or bifurcation.

    Attributes
    ----------
    name : str
        Name, by which it can be held out.
    kind : str
        `ORBIT`, ``fold``, ``period_doubling``, ``neimark_sacker`` or ``hopf``.
    value : float
        Value of the parameter, of a bifurcation its measured value [SI].
    period : int
        Drive periods or returns of the orbit; 0 for an equilibrium.
    stability : int
        0 unknown, 1 stable, 2 unstable: an orbit of the other stability is not taken.
    quantities : tuple of str
        Measured quantities, as in `Shapes.columns`; ``parameter`` of a bifurcation, and of an orbit whose parameter
        has an error.
    measured, sd : ndarray, (n_quantities,)
        Measured values and their standard deviations [SI].
    """

    name: str
    kind: str
    value: float
    period: int
    stability: int
    quantities: tuple[str, ...]
    measured: Array
    sd: Array

    @property
    def is_free(self) -> bool:
        """Whether the orbit's parameter value is uncertain; the fit then uses the nearest orbit of the branch."""
        return self.kind == ORBIT and PARAMETER in self.quantities


@dataclass(frozen=True)
class Solution:
    """Computed orbits and bifurcations at one set of parameters, one for each measured orbit or bifurcation of a table.

    Attributes
    ----------
    packed : ndarray, (n_parameters,)
        Packed parameters of the model.
    unknowns : ndarray, (n_datum, n_states + 1)
        Section point and value of the parameter of each orbit [SI].
    tangents : ndarray, (n_datum, n_states + 1)
        Unit tangents of the branches there, in scaled unknowns.
    slopes : dict of ndarray, (n_datum, n_states + 1)
        Derivatives of `unknowns` by parameters of the model, as far as they are known.
    """

    packed: Array
    unknowns: Array
    tangents: Array
    slopes: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class OrbitData:
    """Measured orbits and bifurcations of a table ``[[orbits]]``, with computed ones from which Newton's method starts.

    Attributes
    ----------
    along : Along
        Model, parameter along which was measured, and its interval.
    state : str
        State that was measured.
    data : tuple of Datum
        Orbits and bifurcations.
    known : Solution
        Computed orbits for the parameters accepted last.
    settings : dict
        Values of parameters in these measurements alone.
    """

    along: Along
    state: str
    data: tuple[Datum, ...]
    known: Solution
    settings: Mapping[str, float] = field(default_factory=dict)

    def packed(self, values: Mapping[str, float]) -> Array:
        """Return packed parameters from values by name. Settings of the table of orbits replace values of the fit."""
        merged = {**values, **self.settings}
        names = self.along.model.parameter_names
        return np.array([merged.get(name, self.known.packed[i]) for i, name in enumerate(names)])


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


def solve(table: OrbitData, packed: Array) -> list[list[Point | None]]:
    """Compute a table's orbits and bifurcations at each row of packed parameters, starting from those at the last
    accepted parameters; None for those not found.

    Orbits stay at the value of the parameter, or if it has an error in the plane normal to the branch.
    """
    found = run_together([_carried(table, k, row) for row in packed for k in range(len(table.data))])
    n = len(table.data)
    return [found[i * n : (i + 1) * n] for i in range(len(packed))]


def _carried(table: OrbitData, k: int, packed: Array) -> Steps[Point | None]:
    """Follow one orbit from the last accepted parameters to others, in as few steps as possible; None if the orbit
    cannot be followed.
    """
    known, datum = table.known, table.data[k]
    if not np.isfinite(known.unknowns[k]).all():
        return None
    change = packed - known.packed
    names = table.along.model.parameter_names
    slope = sum(
        (by[k] * change[names.index(name)] for name, by in known.slopes.items()), np.zeros(known.unknowns.shape[1])
    )
    for n in CUTS:
        here, step, normal, point = known.unknowns[k], slope / n, known.tangents[k], None
        for i in range(1, n + 1):
            point = yield from _solved(table, datum, known.packed + change * (i / n), here + step, normal)
            if point is None and i == 1 and np.any(step):
                point = yield from _solved(table, datum, known.packed + change * (i / n), here, normal)
            if point is None:
                break
            there = _raw(table, datum, point)
            here, step = there, there - here
            normal = point.tangent if datum.is_free else normal
        if point is not None and _is_wanted(table, datum, point):
            return point
    return None


def _solved(table: OrbitData, datum: Datum, packed: Array, guess: Array, tangent: Array) -> Steps[Point | None]:
    """Solve the equations of one orbit or bifurcation at given parameters by Newton's method, from a guess."""
    along = table.along
    family = along.family(datum.period, packed)
    if datum.kind == ORBIT:
        u = family.unknowns(guess[:-1], [guess[-1] if datum.is_free else datum.value])
        normal = tangent if datum.is_free else np.append(np.zeros(len(u) - 1), 1.0)
        found = yield from correct(problem_of(family), u, normal, NEWTON)
        return found
    # a second free parameter, which stays where it is: the equations of curves ask for two
    second = next(name for name in along.model.parameter_names if name != along.parameter)
    value = float(packed[along.model.parameter_names.index(second)])
    family = replace(family, free=(along.parameter, second), scales=(family.scales[0], abs(value) or 1.0))
    u = family.unknowns(guess[:-1], [guess[-1], value])
    problem = HopfProblem(family) if datum.kind == HOPF else BifurcationProblem(family, datum.kind)
    found = yield from correct(problem, u, np.append(np.zeros(len(u) - 1), 1.0), LOCATED)
    return found


def _is_wanted(table: OrbitData, datum: Datum, point: Point) -> bool:
    """Return whether a solution is still an orbit (not an equilibrium) and has the measured stability."""
    if datum.kind != ORBIT:
        return True
    if end_of_crossings(table.along.family(datum.period, table.known.packed), point):
        return False
    return datum.is_free or not datum.stability or (n_unstable(point) > 0) == (datum.stability == 2)


def _raw(table: OrbitData, datum: Datum, point: Point) -> Array:
    """Return section point and parameter value of a computed orbit in SI units, from the scaled unknowns of Newton's
    method.
    """
    scales = np.asarray(table.along.model.system.scales)
    n = len(scales)
    return np.append(point.u[:n] * scales, point.u[n] * (table.along.high - table.along.low))


def solution_of(table: OrbitData, packed: Array, points: Sequence[Point | None]) -> Solution:
    """Return section points, parameter values and tangents of all orbits of a table; NaN for orbits that were not
    found.
    """
    unknowns = np.full(table.known.unknowns.shape, np.nan)
    tangents = unknowns.copy()
    for k, (datum, point) in enumerate(zip(table.data, points, strict=True)):
        if point is not None:
            unknowns[k] = _raw(table, datum, point)
            tangents[k] = point.tangent[: len(tangents[k])]
    return Solution(packed, unknowns, tangents)


def settled(table: OrbitData) -> OrbitData | None:
    """Solve all orbits of a table at their measured parameter values, starting from its first guesses; None if one
    fails.
    """
    plain = tuple(
        replace(d, quantities=tuple(q for q in d.quantities if q != PARAMETER or d.kind != ORBIT)) for d in table.data
    )
    points = run_together(
        [
            _solved(table, d, table.known.packed, guess, np.zeros(len(guess)))
            for d, guess in zip(plain, table.known.unknowns, strict=True)
        ]
    )
    if any(point is None for point in points):
        return None
    return replace(table, known=solution_of(table, table.known.packed, points))


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
                found[i][k][:] = _raw(table, datum, point)[-1]
    for period, places in orbits.items():
        raw = np.array([_raw(table, table.data[k], point) for _, k, point in places])
        rows = np.concatenate(
            [table.along.rows(packed[i], [r[-1]])[0] for (i, _, _), r in zip(places, raw, strict=True)]
        )
        seconds = np.array([point.value.seconds for _, _, point in places])
        columns = shapes_of(table.along.model, rows, raw[:, :-1], seconds, period, table.state).columns()
        columns[PARAMETER] = raw[:, -1]
        for j, (i, k, _) in enumerate(places):
            found[i][k] = np.array([columns[name][j] for name in table.data[k].quantities])
    return found
