"""Find the equilibria of flows, and the trajectories (cells) that are at an equilibrium or approach one.

Newton's method on the rates starts from the last states of cells, near or far; `held` finds the equilibria at which a
switch or a contact holds the state, where the rates do not vanish. A cell belongs to a stable
equilibrium in two cases: it lies on it, within the tolerance of closed cells or, without a return, within the error
of the integration; or its sections or states follow the linear flow towards it (`approaching`), since a
trajectory crosses the section thousands of times around a slow focus. A cell belongs to any other
equilibrium only if it lies on it within `AT_EQUILIBRIUM`. Cells without a return are integrated further, up to
`WAITS` times as long, until they come to rest or return.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from magpend_core.equilibria import can_hold, find_equilibria, newton_steps
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.held import held_near, ways
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.points import Point
from pipeline.results.sets import Geometry, hashes, order_of_points
from pipeline.results.tolerances import AT_EQUILIBRIUM, NEAR_REST, SAME_EQUILIBRIUM, WAIT_RTOL

WAITS = 16
"""Most repetitions of the wait for a return, for cells that are near no equilibrium yet."""


NOISE = 0.01
"""Error of a section, in units of the distance within which a closed cell is on a set."""

FLOW_RATES = 30.0
"""Rates of a flow per rate of its section, roughly: a section is often given some ten times as long as it needs."""


def tell_rest(points: Iterable[Point], tolerance: float, geometry: Geometry) -> None:
    """Find the equilibria of each parameter point and the cells that are at one; store both in the point.

    Parameters
    ----------
    points
        Parameter points of a flow.
    tolerance
        Scaled distance within which a closed cell is on a stable equilibrium.
    geometry
        Geometry of the states.
    """
    for point in points:
        _come_to_rest(point, tolerance, geometry)
        _label_approaching(point, tolerance, geometry)


def _ends(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Return each cell's last state (NaN if none), and whether the cell no longer crosses the section."""
    states, waits = np.full((point.n_cells, point.n_states), np.nan), np.zeros(point.n_cells, bool)
    for block in point.blocks():
        own = block.is_closed | block.is_bounded
        states[block.cells][own] = block.section[own, -1]
        if block.rest is not None:
            left = waits[block.cells] = block.status == Status.NO_RETURN
            states[block.cells][left] = block.rest[left]
    return states, waits


def _come_to_rest(point: Point, tolerance: float, geometry: Geometry) -> None:
    """Find the equilibria, the cells at them and the last states of all cells; store them in the point.

    Cells that no longer cross the section are integrated until each is shown to come to rest at an equilibrium.
    """
    states, waits = _ends(point)
    path = _path_to(states)
    reach = np.where(waits, NEAR_REST, tolerance)
    for i in range(WAITS + 1):
        finite = np.isfinite(path[:, -1]).all(axis=1)
        point.equilibria = _found(point, path[finite, -1], reach[finite], geometry)
        point.at_rest = _settled(point, path, waits, tolerance, geometry)
        going = np.flatnonzero(finite & waits & (point.at_rest < 0))
        if not len(going) or i == WAITS:
            break
        path[going] = _waited(point, path[going])
    point.last_states = path[:, -1]


def _path_to(states: np.ndarray) -> np.ndarray:
    """Return a path (n, 3, state) of which only the last states are known; the earlier ones are NaN."""
    path = np.full((len(states), 3, states.shape[1]), np.nan)
    path[:, -1] = states
    return path


def _waited(point: Point, path: np.ndarray) -> np.ndarray:
    """Integrate trajectories over one more wait for a return; append the new state to each path and drop the first.

    The new state is NaN if the trajectory crosses the section again.
    """
    result = run_branches(
        np.tile(point.packed, (len(path), 1, 1)),
        np.full((len(path), 1), point.frequency),
        path[:, -1],
        n_transient=0,
        n_keep=1,
        **limits_at(WAIT_RTOL),
        system=point.integrates,
    )
    waits = result.status[:, 0] == Status.NO_RETURN
    state = np.where(waits[:, None], result.final_state[:, 0], np.nan)
    return np.concatenate([path[:, 1:], state[:, None]], axis=1)


def _found(point: Point, states: np.ndarray, reach: np.ndarray, geometry: Geometry) -> list[Equilibrium]:
    """Find the equilibria near the cells' last states by Newton's method, in canonical order."""
    most, box = 64, 0.1  # far states from which Newton's method starts, and the side of the boxes with one start each
    if not len(states):
        return []
    steps, _, _ = newton_steps(point.integrates, states, point.packed)
    length = np.abs(steps / np.asarray(geometry.scales)).max(axis=1, initial=0.0)
    # a state with a Newton step beyond twice its reach is unlikely to be within reach of an equilibrium
    near = length <= 2.0 * reach
    if can_hold(point.integrates):
        near |= ways(point, states, _seconds(point), geometry) <= reach
    near = np.flatnonzero(near)
    _, first = np.unique(geometry.boxes(states[near], SAME_EQUILIBRIUM), axis=0, return_index=True)
    _, other = np.unique(hashes(geometry.boxes(states, box)), return_index=True)
    guesses = states[np.concatenate([near[first], other[:most]])]
    return equilibria_near(point, guesses, geometry)


def equilibria_near(point: Point, states: np.ndarray, geometry: Geometry) -> list[Equilibrium]:
    """Find the distinct equilibria to which Newton's method converges from given states (n, state), up to a fixed
    number.
    """
    most = 64  # equilibria of a parameter point: a line of equilibria has infinitely many
    iterations = 100  # most Newton steps: near a degenerate equilibrium convergence is only linear
    found = find_equilibria(point.integrates, states, point.packed, max_iterations=iterations)
    scales, rate = np.asarray(geometry.scales), FLOW_RATES * point.frequency
    kept: list[Equilibrium] = []
    for i in np.flatnonzero(found.converged):
        if all(geometry.distance(found.states[i], other.state) > SAME_EQUILIBRIUM for other in kept):
            jacobian = found.jacobians[i] * scales / scales[:, None]
            residual = float(found.residual[i])
            kept.append(Equilibrium(found.states[i], found.eigenvalues[i], residual, jacobian, rate=rate))
        if len(kept) == most:
            break
    for one in held_near(point, states, _seconds(point), geometry):
        if len(kept) < most and all(geometry.distance(one.state, other.state) > SAME_EQUILIBRIUM for other in kept):
            kept.append(one)
    if not kept:
        return []
    return [kept[i] for i in order_of_points(np.array([e.state for e in kept]), geometry)]


def _seconds(point: Point) -> float:
    """Return the order of magnitude of the time in which the flow changes the states [s]."""
    return 1.0 / (point.frequency * (FLOW_RATES if point.has_returns else 1.0))


def _settled(point: Point, path: np.ndarray, waits: np.ndarray, tolerance: float, geometry: Geometry) -> np.ndarray:
    """Return the index of the equilibrium that each cell is at or, without returns, comes to rest at; -1 for none."""
    at_rest = np.full(len(path), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(path[:, -1]).all(axis=1))
    nearest = np.full(len(rows), np.inf)
    reach = np.where(waits[rows], NOISE * tolerance, tolerance)
    for k, one in enumerate(point.equilibria):
        away = geometry.distance(path[rows, -1], one.state)
        own = (away <= (reach if one.is_stable else AT_EQUILIBRIUM)) & (away < nearest)
        at_rest[rows[own]], nearest[own] = k, away[own]
    rows = np.flatnonzero(waits & (at_rest < 0) & np.isfinite(path).all(axis=(1, 2)))
    seconds = np.full((len(rows), path.shape[1]), 1.0 / point.frequency)
    at_rest[rows] = approaching(point, path[rows], seconds, tolerance, geometry)
    return at_rest


def put_at_rest(point: Point, geometry: Geometry) -> None:
    """Mark cells near a degenerate equilibrium as at rest there, if trajectories approach it; changes
    `point.at_rest`.
    """
    states = point.last_states
    assert point.at_rest is not None
    assert states is not None
    for k, one in enumerate(point.equilibria):
        if one.approached_within:
            known = np.flatnonzero(np.isfinite(states).all(axis=1) & (point.at_rest < 0))
            point.at_rest[known[one.draws(states[known], geometry)]] = k


def _label_approaching(point: Point, tolerance: float, geometry: Geometry) -> None:
    assert point.at_rest is not None
    for block in point.blocks():
        rows = np.flatnonzero(block.is_closed | block.is_bounded)
        assert block.seconds is not None
        number = approaching(point, block.section[rows], block.seconds[rows], tolerance, geometry)
        own = rows[number >= 0]
        point.at_rest[own + block.cells.start] = number[number >= 0]


def approaching(
    point: Point, section: np.ndarray, seconds: np.ndarray, tolerance: float, geometry: Geometry
) -> np.ndarray:
    """Return the index of the stable equilibrium that each trajectory approaches; -1 for none.

    Parameters
    ----------
    point
        Parameter point with its equilibria.
    section, seconds
        Sections (n, k, state) and times between them (n, k) [s], see `Equilibrium.is_approached`.
    tolerance
        Scaled distance within which a closed cell is on a set; sections err by the share `NOISE` of it.
    geometry
        Geometry of the states.
    """
    found = np.full(len(section), -1, np.int64)
    for k, one in enumerate(point.equilibria):
        rows = np.flatnonzero(found < 0)
        if one.is_stable and len(rows):
            near = one.is_approached(section[rows], seconds[rows], NOISE * tolerance, geometry)
            found[rows[near]] = k
    return found


def rest_near(point: Point, state: np.ndarray, geometry: Geometry) -> int | None:
    """Find the stable equilibrium at which a trajectory comes to rest that no longer crosses the section. Return its
    index, and add it if it is new.
    """
    path = _path_to(state[None])
    seconds = np.full(path.shape[:2], 1.0 / point.frequency)
    for i in range(WAITS + 1):
        if not np.isfinite(path[0, -1]).all():
            return None
        for one in equilibria_near(point, path[:, -1], geometry):
            if one.is_stable and (
                geometry.distance(one.state, path[0, -1]) <= NOISE * SAME_EQUILIBRIUM
                or one.is_approached(path, seconds, NOISE * SAME_EQUILIBRIUM, geometry)[0]
            ):
                return number_of(one, point, geometry)
        if i < WAITS:
            path = _waited(point, path)
    return None


def number_of(one: Equilibrium, point: Point, geometry: Geometry) -> int:
    """Return the index of an equilibrium in the list of a parameter point; append it to the list if it is new."""
    for k, other in enumerate(point.equilibria):
        if geometry.distance(one.state, other.state) <= SAME_EQUILIBRIUM:
            return k
    point.equilibria.append(one)
    return len(point.equilibria) - 1


def rest_of_orbit(point: Point, state: np.ndarray, geometry: Geometry) -> int | None:
    """Return the index of the equilibrium to which a refined orbit has shrunk; None if the orbit has not shrunk to a
    point.
    """
    steps, _, _ = newton_steps(point.integrates, state[None], point.packed)
    is_near = np.abs(steps / np.asarray(geometry.scales)).max() <= 10.0 * SAME_EQUILIBRIUM
    if not (is_near or can_hold(point.integrates)):
        return None
    for one in equilibria_near(point, state[None], geometry):
        if geometry.distance(one.state, state) <= 10.0 * SAME_EQUILIBRIUM:
            return number_of(one, point, geometry)
    return None
