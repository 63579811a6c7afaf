"""Find the limit cycles of autonomous flows that are sampled at equal times.

Sampled once per strobe period, a limit cycle is a curve, which sections fill if the two periods have no
common multiple. If they have one, every cell closes at its own phase: there are as many closed orbits as
cells, and Newton's method on the stroboscopic map fails at the multiplier 1 along the flow. So this module
takes the crossings of a level of one state instead, the level of one of the cells. The return map there has
the cycle as a periodic point (`magpend_core.orbits`), and all cells on the cycle cross at the same points.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from magpend_core.engine.crossing import with_section
from magpend_core.orbits import polish_orbits
from magpend_core.pointwise import rates_at
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from pipeline.analysis.attractors.finding.closed_orbits import orbit_of
from pipeline.analysis.attractors.finding.known_sets import Cycle
from pipeline.analysis.attractors.finding.points import Point
from pipeline.layout.vocabulary import ATTRACTS
from pipeline.results.sets import Geometry, hashes
from pipeline.results.tolerances import BRANCH_RTOL, CROSSING_RTOL, REACH, SAME_ORBIT, SAME_RETURN, SAME_SECONDS


class _Crossings:
    """Upward crossings of a fixed level by one state variable, for the trajectories of one parameter point."""

    def __init__(self, point: Point, state: int, longest_s: float) -> None:
        self._packed, self._rate = point.packed, 1.0 / longest_s
        self._system = with_section(point.integrates, point.integrates.state_names[state], 1)
        self.state = state

    def of(self, states: np.ndarray, level: float, rtol: float = CROSSING_RTOL) -> np.ndarray:
        """Integrate each start state over a fixed number of upward crossings; return (cell, crossing, state), padded
        with NaN.
        """
        returns = 32  # most crossings of the level per period
        n = len(states)
        found = run_branches(
            np.tile(np.append(self._packed, level), (n, 1, 1)),
            np.full((n, 1), self._rate),
            states,
            n_transient=0,
            n_keep=returns,
            **limits_at(rtol),
            system=self._system,
        )
        return np.asarray(found.section[:, 0])

    def cycle_of(self, start: np.ndarray, geometry: Geometry, residual: float) -> tuple[Cycle, np.ndarray] | None:
        """Return the stable limit cycle that passes through a state, with its crossings of the level; None if there is
        none.
        """
        level = float(start[self.state])
        path = self.of(start[None], level)[0]
        # a state almost tangent to the level may start with a crossing that is not the cycle's
        near = np.flatnonzero(geometry.distance(path[1:], path[0]) <= SAME_RETURN)
        if not len(near):
            return None
        packed, rate = np.append(self._packed, level)[None], np.array([self._rate])
        found = polish_orbits(packed, rate, path[-1:], np.array([near[0] + 1]), tolerance=residual, system=self._system)
        # one multiplier is 1, along the flow; with a second one the cycle lies in a family, and does not attract
        if not found.converged[0] or orbit_of(found, 0, self._system).stability != ATTRACTS:
            return None
        own = found.multipliers[0][:-1]  # the last one is 0: the direction of the flow
        multipliers = np.append(1.0 + 0.0j, own)
        cycle = Cycle(found.section[0], self.state, float(found.seconds[0]), multipliers, float(found.residual[0]))
        return cycle, self.of(found.section, level)[0, : int(found.orbit_period[0])]

    def reach(self, states: np.ndarray, where: np.ndarray, tolerance: float, geometry: Geometry) -> np.ndarray:
        """Return which trajectories reach a cycle, given by its crossings of a level (crossing, state)."""
        rounds = 8  # most times that a cell which comes nearer to a cycle is integrated
        reached, rows, before = np.zeros(len(states), bool), np.arange(len(states)), np.full(len(states), REACH)
        for _ in range(rounds):
            # compare last crossings: the first ones may still show the cell's distance from the cycle
            last = self.of(states[rows], float(where[0, self.state]))[:, -1]
            away = np.nan_to_num(geometry.distance(last[:, None], where).min(axis=1), nan=np.inf)
            reached[rows] = away <= tolerance
            going = (away > tolerance) & (away < before)
            rows, before = rows[going], away[going]
            if not len(rows):
                break
            states = states.copy()
            states[rows] = last[going]
        return reached


def number_of_cycle(
    cycle: Cycle, known: Sequence[np.ndarray], allowed: Sequence[float], point: Point, geometry: Geometry
) -> int:
    """Return the index of the first of some states of one period from which the flow leads through a cycle's own state.

    Cycles are compared as curves, whatever the phase of their states.

    Parameters
    ----------
    cycle
        Cycle whose state is looked for.
    known
        A state of each known cycle.
    allowed
        Scaled distance of each known state from its cycle; the error of `cycle` is added.
    point
        Parameter point of all cycles.
    geometry
        Geometry of the states.

    Returns
    -------
    int
        The length of `known` if no trajectory leads there.
    """
    if not known:
        return 0
    seen = _Crossings(point, cycle.crossed, 2.0 * cycle.seconds).of(
        np.stack(known), float(cycle.state[cycle.crossed]), BRANCH_RTOL
    )
    away = np.nan_to_num(geometry.distance(seen, cycle.state), nan=np.inf).min(axis=1)
    same = away <= SAME_ORBIT + cycle.error + np.asarray(allowed)
    return int(np.argmax(same)) if same.any() else len(known)


def number_among(cycle: Cycle, cycles: Sequence[Cycle], point: Point, geometry: Geometry) -> int:
    """Return the index of a cycle in a list of cycles, or the length of the list if the cycle is not in it."""
    alike = [k for k, one in enumerate(cycles) if abs(one.seconds - cycle.seconds) <= SAME_SECONDS * cycle.seconds]
    states, errors = [cycles[k].state for k in alike], [cycles[k].error for k in alike]
    return [*alike, len(cycles)][number_of_cycle(cycle, states, errors, point, geometry)]


def tell_cycles(points: Iterable[Point], tolerance: float, longest: int, residual: float, geometry: Geometry) -> None:
    """Find the limit cycles of each parameter point and the cells that are on one; store both in the point.

    Parameters
    ----------
    points
        Parameter points of a flow sampled at equal times, with known equilibria.
    tolerance
        Scaled distance within which a cell is on a cycle.
    longest
        Longest period [strobe periods].
    residual
        Scaled residual that Newton's method is to reach.
    geometry
        Geometry of the states.
    """
    for point in points:
        _tell(point, tolerance, longest, residual, geometry)


def _tell(point: Point, tolerance: float, longest: int, residual: float, geometry: Geometry) -> None:
    tries = 3  # cells without a cycle after which the search at a parameter point ends
    states, is_closed = _ends(point)
    rows = np.flatnonzero(np.isfinite(states).all(axis=1))
    if not len(rows):
        return
    spread = np.ptp(geometry.scaled(states[rows]), axis=0)
    crossings = _Crossings(point, int(np.argmax(spread)), longest / point.frequency)
    # try closed cells first, then fast crossings: crossings almost tangent to the level scatter
    speed = np.abs(rates_at(point.integrates, states[rows], point.packed)[:, crossings.state])
    left = rows[np.lexsort((hashes(states[rows]), -speed, ~is_closed[rows]))]
    on_cycle = np.full(point.n_cells, -1, np.int64)
    cycles: list[Cycle] = []
    failures = 0
    while len(left) and failures < tries:
        found = crossings.cycle_of(states[left[0]], geometry, residual)
        if found is None:
            failures, left = failures + 1, left[1:]
            continue
        cycle, where = found
        own = crossings.reach(states[left], where, tolerance, geometry)
        own[0] = True
        number = number_among(cycle, cycles, point, geometry)
        on_cycle[left[own]] = number
        cycles += [cycle] if number == len(cycles) else []
        left = left[~own]
    point.cycles, point.on_cycle = cycles, on_cycle


def _ends(point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Return the last state of each cell (NaN if it has none), and whether the cell is on a periodic orbit."""
    states = np.full((point.n_cells, point.n_states), np.nan)
    is_closed = np.zeros(point.n_cells, bool)
    for block in point.blocks():
        own = block.is_closed | block.is_bounded
        states[block.cells][own] = block.section[own, -1]
        is_closed[block.cells] = block.is_closed
    return states, is_closed
