"""Equilibria of flows among the ends of cells, told apart from limit cycles.

A cell that comes to rest does not come back to a section by crossing: it has the status ``NO_RETURN``
and left its last state in ``rest_state``. Where the section runs through the equilibrium, a cell that spirals
in crosses it to the end, and its sections close on the equilibrium as they would on an orbit of period 1; at
even times they do so in any case. Newton's method on the rates tells: a cell is at rest if an equilibrium
lies within `NEAR` of the state in which it waited in vain, or within the tolerance of closed cells from its
last section, and is stable; or if it is on the equilibrium itself. Cells that are farther away wait on, up to
`WAITS` times as long, until they are near or do come back.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from magpend_core.equilibria import find_equilibria, newton_steps
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.points import Point
from pipeline.analysis.sets import Geometry, rounded_points

NEAR = 0.1
"""Largest scaled distance from a stable equilibrium of a state in which a cell waited in vain."""

WAITS = 16
"""How often a cell that is near no equilibrium yet waits again for as long."""

RTOL = 1e-8
"""Tolerance of the trajectories of cells that wait."""

ON_IT = 1e-9
"""Scaled distance from an equilibrium, stable or not, within which a cell is on it."""

SAME = 1e-6
"""Equilibria at most this far apart are one."""

MOST = 64
"""Most equilibria of a parameter point: where whole lines of them attract there is no end of them."""


@dataclass(frozen=True)
class Equilibrium:
    """A state that stays as it is.

    Attributes
    ----------
    state : ndarray, (state,)
    eigenvalues : ndarray of complex, (state,)
        Of the Jacobian [1/s], by falling real part.
    residual : float
        Scaled length of the last Newton step.
    """

    state: np.ndarray
    eigenvalues: np.ndarray
    residual: float

    @property
    def is_stable(self) -> bool:
        """Whether all eigenvalues have negative real parts."""
        return bool(self.eigenvalues.real.max() < 0.0)


def tell_rest(points: Iterable[Point], tolerance: float, geometry: Geometry) -> None:
    """Find the equilibria that cells of some parameter points are at, in place.

    Parameters
    ----------
    points
        Of a flow.
    tolerance
        Scaled distance within which a closed cell is on what it closed on.
    geometry
        Of the states.
    """
    for point in points:
        states, reach = _ends(point, tolerance)
        point.equilibria, point.at_rest = _settled(point, states, reach, geometry)


def _ends(point: Point, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Last state of each cell, NaN where it says nothing, and how near an equilibrium has to be."""
    states = np.full((point.n_cells, point.n_states), np.nan)
    reach = np.full(point.n_cells, tolerance)
    for block in point.blocks():
        own = block.is_closed | block.is_bounded
        states[block.cells][own] = block.section[own, -1]
        if block.rest is not None:
            left = block.status == Status.NO_RETURN
            states[block.cells][left] = _waited(point, block.rest[left])
            reach[block.cells][left] = NEAR
    return states, reach


def _waited(point: Point, states: np.ndarray) -> np.ndarray:
    """States of cells that waited in vain once they are near an equilibrium; NaN for those that come back."""
    states, system = states.copy(), point.integrates
    far = np.flatnonzero(np.isfinite(states).all(axis=1))
    for _ in range(WAITS):
        steps, _ = newton_steps(system, states[far], point.packed)
        away = np.abs(steps / np.asarray(system.scales)).max(axis=1, initial=0.0)
        far = far[~(away <= 0.5 * NEAR)]
        if not len(far):
            break
        result = run_branches(
            np.tile(point.packed, (len(far), 1, 1)), np.full((len(far), 1), point.frequency), states[far],
            n_transient=0, n_keep=1, rtol=RTOL, atol=RTOL, system=system,
        )  # fmt: skip
        waits = result.status[:, 0] == Status.NO_RETURN
        states[far] = np.where(waits[:, None], result.final_state[:, 0], np.nan)
        far = far[waits]
    return states


def _settled(
    point: Point, states: np.ndarray, reach: np.ndarray, geometry: Geometry
) -> tuple[list[Equilibrium], np.ndarray]:
    """Equilibria in canonical order, and which of them each cell is at; -1 for none."""
    at_rest = np.full(len(states), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(states).all(axis=1))
    system = point.integrates
    steps, _ = newton_steps(system, states[rows], point.packed)
    length = np.abs(steps / np.asarray(geometry.scales)).max(axis=1, initial=0.0)
    # beyond twice the reach the linear step cannot end within it but by chance
    rows = rows[length <= 2.0 * reach[rows]]
    if not len(rows):
        return [], at_rest
    boxes = geometry.boxes(states[rows], SAME)
    _, first = np.unique(boxes, axis=0, return_index=True)
    found = find_equilibria(system, states[rows[first]], point.packed)
    equilibria: list[Equilibrium] = []
    for i in np.flatnonzero(found.converged):
        if len(equilibria) == MOST:
            break
        one = Equilibrium(found.states[i], found.eigenvalues[i], float(found.residual[i]))
        if all(geometry.distance(one.state, other.state) > SAME for other in equilibria):
            equilibria.append(one)
    if not equilibria:
        return [], at_rest
    order = np.lexsort(rounded_points(np.array([e.state for e in equilibria]), geometry).T[::-1])
    used: list[Equilibrium] = []
    for i in order:
        away = geometry.distance(states[rows], equilibria[i].state)
        near = away <= (reach[rows] if equilibria[i].is_stable else ON_IT)
        if near.any():
            at_rest[rows[near]] = len(used)
            used.append(equilibria[i])
    return used, at_rest
