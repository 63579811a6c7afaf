"""Carry orbits and bifurcations from known parameters to others by Newton's method.

The orbit at a value of the parameter is found from the one of known parameters. Where this fails, the way there is made
in smaller steps. So no trajectory settles and no branch is followed again, and unstable orbits serve as well as stable
ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magpend_core.models.model import Model
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.bifurcations import n_unstable
from pipeline.analysis.branches.equilibrium_curves import EquilibriumCurve
from pipeline.analysis.branches.following import end_of_crossings, problem_of
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.analysis.branches.problems import BifurcationProblem, Family
from pipeline.layout.vocabulary import FREQUENCY_DIM

Array = NDArray[np.float64]

ORBIT = "orbit"
"""Kind of a datum that is an orbit; the others are kinds of bifurcations."""

PARAMETER = "parameter"
"""Name of the quantity that is the parameter itself."""


NEWTON = Settings(tolerance=1e-10, max_iterations=10)
LOCATED = Settings(tolerance=1e-8, max_iterations=12)
"""Settings of Newton's method for orbits, and for bifurcations: their residual is limited by finite differences."""


@dataclass(frozen=True)
class Along:
    """Parameter interval of branches."""

    model: Model  # forced model, or a flow with its Poincare section
    parameter: str  # parameter that changes, ``frequency`` for the drive frequency
    # interval [SI]
    low: float
    high: float
    # drive frequency [Hz], unless it is the parameter; of a flow one over the longest time between crossings
    frequency_hz: float = float("nan")
    max_period: int = 2  # longest period of the orbits [drive periods or returns]

    def family(self, period: int, packed: np.ndarray) -> Family:
        """Return the family of the orbits of one period, or with period 0 of the equilibria, along the parameter."""
        scale = self.high - self.low
        return Family(self.model.system, period, self.frequency_hz, packed, (self.parameter,), (scale,))

    def rows(self, packed: np.ndarray, values: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return packed parameters (n, n_parameters) and drive frequencies (n,) at values of the parameter."""
        rows, frequency = np.tile(packed, (len(values), 1)), np.full(len(values), self.frequency_hz)
        if self.parameter == FREQUENCY_DIM:
            frequency = np.array(values, float)
        else:
            rows[:, self.model.parameter_names.index(self.parameter)] = values
        return rows, frequency


@dataclass(frozen=True)
class Datum:
    """Measured orbit or bifurcation."""

    name: str  # name, by which it can be held out
    kind: str  # `ORBIT`, ``fold``, ``period_doubling``, ``neimark_sacker`` or ``hopf``
    value: float  # value of the parameter, of a bifurcation its measured value [SI]
    period: int  # drive periods or returns of the orbit; 0 for an equilibrium
    stability: int  # 0 unknown, 1 stable, 2 unstable: an orbit of the other stability is not taken
    # measured quantities, as in `Shapes.columns`; ``parameter`` of a bifurcation, and of an orbit whose parameter has
    # an error
    quantities: tuple[str, ...]
    # (n_quantities,): measured values and their standard deviations [SI]
    measured: Array
    sd: Array

    @property
    def is_free(self) -> bool:
        """Whether the orbit's parameter has an error, so that the nearest orbit of the branch is taken."""
        return self.kind == ORBIT and PARAMETER in self.quantities


@dataclass(frozen=True)
class Solution:
    """Computed orbits of a table's data for one set of parameters."""

    packed: Array  # (n_parameters,): packed parameters of the model
    unknowns: Array  # (n_datum, n_states + 1): section point and value of the parameter of each orbit [SI]
    tangents: Array  # (n_datum, n_states + 1): unit tangents of the branches there, in scaled unknowns
    # dict of ndarray, (n_datum, n_states + 1): derivatives of `unknowns` by parameters of the model, as far as they
    # are known
    slopes: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class OrbitData:
    """Measured orbits and bifurcations of one table, with the computed orbits from which Newton's method starts."""

    along: Along  # model, parameter along which was measured, and its interval
    state: str  # state that was measured
    data: tuple[Datum, ...]  # orbits and bifurcations
    known: Solution  # computed orbits for the parameters accepted last
    settings: Mapping[str, float] = field(default_factory=dict)  # values of parameters in these measurements alone

    def packed(self, values: Mapping[str, float]) -> Array:
        """Return packed parameters for the values of the fit, with the table's own settings."""
        merged = {**values, **self.settings}
        names = self.along.model.parameter_names
        return np.array([merged.get(name, self.known.packed[i]) for i, name in enumerate(names)])


def solve(table: OrbitData, packed: Array) -> list[list[Point | None]]:
    """Carry the known orbits and bifurcations of a table to each row of packed parameters; None where one is lost.

    Orbits stay at the value of the parameter, or if it has an error in the plane normal to the branch.
    """
    found = run_together([_carried(table, k, row) for row in packed for k in range(len(table.data))])
    n = len(table.data)
    return [found[i * n : (i + 1) * n] for i in range(len(packed))]


def _carried(table: OrbitData, k: int, packed: Array) -> Steps[Point | None]:
    """Carry one orbit from the known parameters to others, in one step or several; None if it is lost."""
    cuts = (1, 2, 4, 8, 16)  # numbers of steps, tried in turn, from the last accepted parameters to new ones
    known, datum = table.known, table.data[k]
    if not np.isfinite(known.unknowns[k]).all():
        return None
    change = packed - known.packed
    names = table.along.model.parameter_names
    slope = sum(
        (by[k] * change[names.index(name)] for name, by in known.slopes.items()), np.zeros(known.unknowns.shape[1])
    )
    for n in cuts:
        here, step, normal, point = known.unknowns[k], slope / n, known.tangents[k], None
        for i in range(1, n + 1):
            point = yield from _solved(table, datum, known.packed + change * (i / n), here + step, normal)
            if point is None and i == 1 and np.any(step):
                point = yield from _solved(table, datum, known.packed + change * (i / n), here, normal)
            if point is None:
                break
            there = raw_of(table, datum, point)
            here, step = there, there - here
            normal = point.tangent if datum.is_free else normal
        if point is not None and _is_wanted(table, datum, point):
            return point
    return None


def _solved(table: OrbitData, datum: Datum, packed: Array, guess: Array, tangent: Array) -> Steps[Point | None]:
    """Solve the equations of one orbit or bifurcation for packed parameters, from a guess of its unknowns."""
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
    problem: BifurcationProblem | EquilibriumCurve = BifurcationProblem(family, datum.kind)
    if not datum.period:
        problem = EquilibriumCurve(family, datum.kind)
        u = problem.start(u)
    found = yield from correct(problem, u, np.append(np.zeros(len(u) - 1), 1.0), LOCATED)
    return found


def _is_wanted(table: OrbitData, datum: Datum, point: Point) -> bool:
    """Return whether a solution is an orbit, not the equilibrium that it has shrunk to, and as stable as the measured
    one.
    """
    if datum.kind != ORBIT:
        return True
    if end_of_crossings(table.along.family(datum.period, table.known.packed), point):
        return False
    return datum.is_free or not datum.stability or (n_unstable(point) > 0) == (datum.stability == 2)


def raw_of(table: OrbitData, datum: Datum, point: Point) -> Array:
    """Return section point and parameter value of a solution [SI]."""
    scales = np.asarray(table.along.model.system.scales)
    n = len(scales)
    value = point.u[n] if datum.kind == ORBIT else point.u[-2]
    return np.append(point.u[:n] * scales, value * (table.along.high - table.along.low))


def solution_of(table: OrbitData, packed: Array, points: Sequence[Point | None]) -> Solution:
    """Return section points, parameter values and tangents of all orbits of a table; NaN for lost ones."""
    unknowns = np.full(table.known.unknowns.shape, np.nan)
    tangents = unknowns.copy()
    for k, (datum, point) in enumerate(zip(table.data, points, strict=True)):
        if point is not None:
            unknowns[k] = raw_of(table, datum, point)
            tangents[k] = point.tangent[: len(tangents[k])]
    return Solution(packed, unknowns, tangents)


def settled(table: OrbitData) -> OrbitData | None:
    """Solve the equations of all first guesses of a table at the values of the parameter; None if one fails."""
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
