"""Find the equilibria of flows at which a switch or a contact holds the state.

On a surface where the state slides, or rests after impacts, the rates of both sides do not vanish, but the motion along
the surface does: Filippov's pseudo-equilibria, a body at rest on a stop. The engine carries out sliding and contact, so
trajectories tell: Newton's method on the map over some time finds a state that the map does not move, two times
without a common multiple show that the state does not move between them either, and the derivatives of the map have
the eigenvalues exp(lambda t). A direction in which the state reaches the surface in finite time has a multiplier of 0
and so the eigenvalue minus infinity.
"""

from __future__ import annotations

import numpy as np

from magpend_core.engine.system import System
from magpend_core.equilibria import can_hold, is_held
from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import polish_orbits, section_map
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from magpend_core.sizes import natural_size
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.points import Point
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import BRANCH_RTOL, MATRIX_ERROR, NEAR_REST, SAME_EQUILIBRIUM, WAIT_RTOL

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Ratio of the two times over which a state must not move: no motion has a period that divides both."""

SHARES = 0.25 ** np.arange(10, -1, -1)
"""Shares of a time over which the map's derivative is taken: the longest that leaves logarithms of multipliers at most
1 in modulus, so that no turn is missed.
"""


def ways(point: Point, states: np.ndarray, seconds: float, geometry: Geometry) -> np.ndarray:
    """Return how far trajectories from some states get [scaled], seen after a time and after its golden section;
    infinity where the integration fails.
    """
    flow = of_flow(_parameters(point))
    farthest = np.zeros(len(states))
    for time in (seconds, GOLDEN * seconds):
        found = run_branches(
            np.tile(flow.pack(), (len(states), 1, 1)),
            np.full((len(states), 1), 1.0 / time),
            states,
            n_transient=0,
            n_keep=1,
            **limits_at(WAIT_RTOL),
            system=flow.model.system,
        )
        away = geometry.distance(found.section[:, 0, 0], states)
        farthest = np.maximum(farthest, np.nan_to_num(away, nan=np.inf))
    return farthest


def held_near(point: Point, states: np.ndarray, seconds: float, geometry: Geometry) -> list[Equilibrium]:
    """Find the distinct equilibria near states (n, state) at which a switch or a contact holds the state.

    Parameters
    ----------
    point
        Parameter point of a flow.
    states
        Guesses.
    seconds
        Order of magnitude of the time in which the flow changes the states [s].
    geometry
        Geometry of the states.
    """
    if not (len(states) and can_hold(point.integrates)):
        return []
    near = states[ways(point, states, seconds, geometry) <= NEAR_REST]
    if not len(near):
        return []
    flow, n = of_flow(_parameters(point)), len(near)
    packed, system = flow.pack(), flow.model.system
    found = polish_orbits(np.tile(packed, (n, 1)), np.full(n, 1.0 / seconds), near, np.ones(n, np.int64), system=system)
    good = np.flatnonzero(found.converged)
    if len(good):
        good = good[ways(point, found.section[good], seconds, geometry) <= SAME_EQUILIBRIUM]
    kept: list[Equilibrium] = []
    for i in good:
        state = found.section[i]
        if not is_held(system, state, packed):
            continue
        if all(geometry.distance(state, other.state) > SAME_EQUILIBRIUM for other in kept):
            one = _equilibrium(state, float(found.residual[i]), packed, system, seconds)
            kept += [one] if one is not None else []
    return kept


def _parameters(point: Point) -> Parameters:
    assert point.parameters is not None  # of a model: equilibria are searched of models alone
    return point.parameters


def _equilibrium(
    state: np.ndarray, residual: float, packed: np.ndarray, system: System, seconds: float
) -> Equilibrium | None:
    """Return an equilibrium with the eigenvalues that derivatives of the map show; None if they do not show them."""
    times, scales = seconds * SHARES, np.asarray(system.scales)
    n = len(times)
    maps = section_map(np.tile(packed, (n, 1)), 1.0 / times, np.tile(state, (n, 1)), 1, rtol=BRANCH_RTOL, system=system)
    shown = rates_shown(times, maps.derivatives * scales / scales[:, None])
    if shown is None:
        return None
    eigenvalues, jacobian, time = shown
    return Equilibrium(state, eigenvalues, residual, jacobian, rate=natural_size(1.0 / time))


def rates_shown(times: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return the eigenvalues of a linear flow by falling real part, its Jacobian and the time that shows them, from its
    matrices (n, state, state) over rising times; None if these are too long.

    Directions that vanish at once have the eigenvalue minus infinity; in the Jacobian they decay within the matrix'
    error.
    """
    found = None
    for time, matrix in zip(times, matrices, strict=True):
        if not np.isfinite(matrix).all():
            break
        values, vectors = np.linalg.eig(matrix)
        gone = np.abs(values) <= MATRIX_ERROR
        logs = np.log(np.where(gone, 1.0, values).astype(np.complex128))
        if np.abs(logs).max() > 1.0:
            break
        found = float(time), logs / time, gone, vectors
    if found is None:
        return None
    time, rates, gone, vectors = found
    fast = np.where(gone, np.log(MATRIX_ERROR) / time, rates)
    jacobian = ((vectors * fast) @ np.linalg.pinv(vectors)).real
    eigenvalues = np.where(gone, complex(-np.inf, 0.0), rates)
    return eigenvalues[np.lexsort((eigenvalues.imag, -eigenvalues.real))], jacobian, time
