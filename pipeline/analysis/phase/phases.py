"""Compute the phase of states that tend to a limit cycle, and its gradient on the cycle.

The gradient Z at a point of the cycle is the left eigenvector of the monodromy matrix that begins there, with the
multiplier 1 and Z f = 1/T (Winfree, The Geometry of Biological Time, 2001; Ermentrout and Terman, Mathematical
Foundations of Neuroscience, 2010, eq. 8.9, where it solves the adjoint equation). Each phase has its own matrix, so
that nothing is integrated backwards, where a contracting cycle runs away. The phase of a state off the cycle is that of
a late crossing of the section, less the time until then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import polish_orbits, scaled_distance, section_map, wrap_angles
from magpend_core.pointwise import rates_packed
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.results.tolerances import BRANCH_RTOL, PORTRAIT_RTOL


@dataclass(frozen=True, eq=False)
class Cycle:
    """A limit cycle of a flow with a section: its section points, and the gradient of the phase there.

    Phases are shares of the period, and 0 at the first section point.
    """

    parameters: Parameters  # of the model with its section
    longest_hz: float  # 1 over the longest time to wait for a return [Hz]
    seconds: float  # period
    points: np.ndarray  # (return, state)
    point_phase: np.ndarray  # (return,)
    point_gradient: np.ndarray  # (return, state)
    contraction: float  # largest modulus of the multipliers but 1
    error: float  # relative error of the gradient, estimated


@dataclass(frozen=True, eq=False)
class Gradient:
    """The phase's gradient at points of a cycle [1 per unit of the state], and what it rests on."""

    values: np.ndarray  # (point, state)
    contraction: float
    error: float


def cycle_of(parameters: Parameters, longest_hz: float, state: np.ndarray, period: int) -> Cycle | None:
    """Refine a limit cycle from a section point; None if Newton's method does not converge or it does not attract."""
    system, packed = parameters.model.system, parameters.pack()
    one = np.array([longest_hz])
    found = polish_orbits(packed[None], one, state[None], np.array([period]), system=system)
    if not found.converged[0] or found.orbit_period[0] != period:
        return None
    points, seconds = found.points[0, :period], float(found.seconds[0])
    times = section_map(packed[None], one, points[:1], period, rtol=BRANCH_RTOL, system=system).times[0]
    gradient = gradient_at(of_flow(parameters), seconds, points)
    phase = np.concatenate([[0.0], np.cumsum(times)[:-1]]) / seconds
    if not gradient.contraction < 1.0:
        return None
    return Cycle(parameters, longest_hz, seconds, points, phase, gradient.values, gradient.contraction, gradient.error)


def gradient_at(flow: Parameters, seconds: float, states: np.ndarray) -> Gradient:
    """Compute the gradient of the phase at states of a cycle, shape (n, state); `flow` has no section."""
    system, packed = flow.model.system, np.tile(flow.pack(), (len(states), 1))
    once = np.full(len(states), 1.0 / seconds)
    scales = np.asarray(system.scales)
    matrices = section_map(packed, once, states, 1, rtol=BRANCH_RTOL, system=system).derivatives
    slopes = rates_packed(system, states, packed, once)
    values, error, contraction = np.full(states.shape, np.nan), 0.0, 0.0
    for k, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all():
            return Gradient(values, np.nan, np.nan)
        multipliers, vectors = np.linalg.eig((matrix * scales / scales[:, None]).T)
        own = np.argmin(np.abs(multipliers - 1.0))
        others = np.delete(multipliers, own)
        left = vectors[:, own].real / scales
        values[k] = left / (left @ slopes[k]) / seconds
        gap = np.abs(others - 1.0).min(initial=1.0)
        error = max(error, float(np.abs(multipliers[own] - 1.0) / gap))
        contraction = max(contraction, float(np.abs(others).max(initial=0.0)))
    return Gradient(values, contraction, error)


def states_along(cycle: Cycle, n: int) -> np.ndarray:
    """Return the states of a cycle at n even phases from 0 on, shape (n, state)."""
    flow = of_flow(cycle.parameters)
    rate_hz = np.array([n / cycle.seconds])
    images = section_map(flow.pack()[None], rate_hz, cycle.points[:1], n, rtol=BRANCH_RTOL, system=flow.model.system)
    return np.concatenate([cycle.points[:1], images.images[0, :-1]])


def phases_of(cycle: Cycle, states: np.ndarray) -> np.ndarray:
    """Return the phase of the cycle on which each state ends, shape (n,), 0 to 1; NaN if it does not come back."""
    # distance from the cycle [scaled] within which a state is back: the phase has an error of the order of its square;
    # and most turns until then
    near, most_turns = 1e-5, 400
    system, q = cycle.parameters.model.system, len(cycle.points)
    turns = np.log(near) / np.log(max(cycle.contraction, 1e-300))
    # twice as many, as states far away come near later than the multiplier says
    n_returns = q * int(np.clip(np.ceil(2.0 * turns) + 2, 4, most_turns))
    n = len(states)
    ends = run_branches(
        np.tile(cycle.parameters.pack(), (n, 1, 1)),
        np.full((n, 1), cycle.longest_hz),
        states,
        n_transient=0,
        n_keep=n_returns,
        system=system,
        **limits_at(PORTRAIT_RTOL),
    )
    assert ends.return_time is not None
    last, times = ends.section[:, 0, -1], ends.return_time[:, 0].sum(axis=-1)
    away = np.stack([scaled_distance(last, point, system) for point in cycle.points])
    nearest = np.argmin(np.where(np.isfinite(away), away, np.inf), axis=0)
    ahead = (cycle.point_gradient[nearest] * wrap_angles(last - cycle.points[nearest], system)).sum(axis=1)
    is_back = np.isfinite(times) & (away[nearest, np.arange(n)] < near)
    is_back &= np.isin(ends.status[:, 0], (Status.BOUNDED, Status.PERIODIC))
    phase = (cycle.point_phase[nearest] + ahead - times / cycle.seconds) % 1.0
    return np.where(is_back, phase, np.nan)
