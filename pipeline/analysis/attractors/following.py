"""Cells that are run on from their last section, leg by leg, until each is seen on its way to an orbit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magpend_core.engine.system import System
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.cells import Block, ClosedCells, Guesses
from pipeline.analysis.attractors.deciding import REACH, decide
from pipeline.analysis.attractors.orbits import Orbit, distinct, number_of, polish, scaled_derivative
from pipeline.analysis.attractors.spirals import PER_PHASE, Recurrence, near_closed
from pipeline.analysis.sets import Geometry
from pipeline.products.reporting import report

LEG = 64
"""Drive periods between two looks at where the cells are."""

TOLERANCE = 1e-4
"""Scaled distance within which a closed cell belongs to an orbit; its closure is ten times stricter."""

ON_SET, FAILED = -1, -2
"""Ends that are no orbits."""

Advance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""From rows to their next `LEG` sections (n, LEG, state), status and orbit period."""

Polish = Callable[[np.ndarray, np.ndarray, np.ndarray], list[Orbit | None]]
"""From parameter points (n,), guesses (n, state) and periods (n,) to orbits."""

Jump = Callable[[np.ndarray, np.ndarray], None]
"""Puts rows at states (n, state)."""

LEAP, LINEAR = 2.0, 0.1
"""How far a cell that leaves an unstable orbit leaps, in its distance, and the error of the linear map that
this allows, in units of the growth."""


class Engine:
    """Integrates cells of some parameter points, bit for bit as if without a stop.

    Parameters
    ----------
    packed, frequency
        Of the parameter points: shapes (point, parameter) and (point,).
    owner, state
        Parameter point of each cell, shape (n,), and its last section, shape (n, state).
    tolerances
        Relative and absolute.
    max_orbit_period
        Longest period at which a leg is seen to close [drive periods].
    residual
        Scaled residual that Newton's method is to reach.
    geometry, system
        Of the states, and what is integrated.
    """

    def __init__(
        self, packed: np.ndarray, frequency: np.ndarray, owner: np.ndarray, state: np.ndarray, *,
        tolerances: tuple[float, float], max_orbit_period: int, residual: float, geometry: Geometry,
        system: System,
    ) -> None:  # fmt: skip
        self._point_packed, self._point_frequency, self._owner = packed, frequency, owner
        self._state, self._step = state.copy(), np.zeros(len(owner))
        self._system, self._geometry, self._residual = system, geometry, residual
        self._options: dict[str, Any] = {
            "n_transient": 0, "n_keep": LEG, "rtol": tolerances[0], "atol": tolerances[1],
            "closure_tolerance": 0.1 * TOLERANCE, "max_orbit_period": max_orbit_period, "system": system,
        }  # fmt: skip

    def advance(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Advance`."""
        owner = self._owner[rows]
        result = run_branches(
            self._point_packed[owner][:, None], self._point_frequency[owner][:, None], self._state[rows],
            step_size=self._step[rows], **self._options,
        )  # fmt: skip
        self._state[rows], self._step[rows] = result.final_state[:, 0], result.step_size[:, 0]
        return result.section[:, 0], result.status[:, 0], result.orbit_period[:, 0]

    def jump(self, rows: np.ndarray, states: np.ndarray) -> None:
        """See `Jump`."""
        self._state[rows], self._step[rows] = states, 0.0

    def polish(self, owner: np.ndarray, point: np.ndarray, period: np.ndarray) -> list[Orbit | None]:
        """See `Polish`."""
        return polish(
            self._point_packed[owner], self._point_frequency[owner], point, period,
            geometry=self._geometry, system=self._system, tolerance=self._residual,
        )  # fmt: skip

    def known(self, orbits: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[list[Orbit]]:
        """Orbits of every parameter point with their monodromy matrices, which are not stored."""
        sizes = [len(rows) for rows, _, _ in orbits]
        polished = self.polish(
            np.repeat(np.arange(len(orbits)), sizes),
            np.concatenate([p for _, p, _ in orbits]),
            np.concatenate([q for _, _, q in orbits]),
        )
        if any(orbit is None for orbit in polished):
            raise ValueError("A stored orbit is none with these parameters; give those of the run.")
        found = [orbit for orbit in polished if orbit is not None]
        ends = np.cumsum(sizes)
        return [found[end - n : end] for n, end in zip(sizes, ends, strict=True)]


@dataclass
class Ends:
    """What became of the cells that were run on.

    Attributes
    ----------
    orbit : ndarray of int64
        Number among the orbits of the cell's parameter point, or `ON_SET`, `FAILED`.
    periods : ndarray
        Drive periods at risk.
    is_leaving : ndarray of bool
        Near the orbit from the start.
    orbits : list of list of Orbit
        Of each parameter point: those given, then those found.
    """

    orbit: np.ndarray
    periods: np.ndarray
    is_leaving: np.ndarray
    orbits: list[list[Orbit]] = field(default_factory=list)

    def take(self, rows: slice) -> Ends:
        """Some of the cells."""
        return Ends(self.orbit[rows], self.periods[rows], self.is_leaving[rows])


def follow(
    start: np.ndarray, owner: np.ndarray, orbits: Sequence[Sequence[Orbit]], advance: Advance,
    polish_new: Polish, n_legs: int, max_orbit_period: int, geometry: Geometry, *,
    jump: Jump | None = None,
) -> Ends:  # fmt: skip
    """Run cells on, leg by leg, until each is seen on its way to an orbit.

    Parameters
    ----------
    start
        Section points, shape (n, state).
    owner
        Parameter point of each, a number.
    orbits
        Known orbits of each parameter point.
    advance, polish_new
        What integrates.
    n_legs
        Legs of `LEG` drive periods, at most.
    max_orbit_period
        Longest period guessed.
    geometry
        Of the states.
    jump
        If given, cells are spirals: those that do not come back near any more within a leg are given up
        (they count as having stayed), and those that leave an unstable orbit slowly leap, see `leap`.
    """
    ends = Ends(
        np.full(len(start), ON_SET), np.full(len(start), float(n_legs * LEG)),
        np.zeros(len(start), bool), [list(x) for x in orbits],
    )  # fmt: skip
    paths = [[s[None]] for s in start]
    tried: list[set[int]] = [set() for _ in orbits]
    going = np.ones(len(start), bool)
    for leg in range(n_legs):
        rows = np.flatnonzero((ends.orbit == ON_SET) & going)
        report("running cells on", leg, n_legs)
        if not len(rows):
            break
        section, status, period = advance(rows)
        computed = np.isin(status, (Status.PERIODIC, Status.BOUNDED))
        ends.orbit[rows[~computed]], ends.periods[rows[~computed]] = FAILED, (leg + 1.0) * LEG
        rows, section = rows[computed], section[computed]
        for row, states in zip(rows, section, strict=True):
            paths[row].append(states)
        whole = Block(slice(0, 0), section, status[computed], period[computed], np.zeros((len(rows), 0)))
        _search(whole, owner[rows], ends.orbits, tried, polish_new, max_orbit_period, geometry)
        for point in np.unique(owner[rows]):
            own = np.flatnonzero(owner[rows] == point)
            label, _ = decide(whole.take(own), ends.orbits[point], TOLERANCE, geometry)
            for row, number in zip(rows[own], label, strict=True):
                if number >= 0 and ends.orbits[point][number].is_stable:
                    _leave(ends, row, number, ends.orbits[point][number], paths[row], geometry)
                    paths[row] = []
        if jump is not None:
            going[rows] = Recurrence.of(section, max_orbit_period, geometry).is_near
            for point in np.unique(owner[rows]):
                own = np.flatnonzero((owner[rows] == point) & (ends.orbit[rows] == ON_SET))
                states = leap(section[own], ends.orbits[point], geometry)
                there = np.isfinite(states).all(axis=1)
                jump(rows[own[there]], states[there])
    return ends


def leap(section: np.ndarray, orbits: Sequence[Orbit], geometry: Geometry) -> np.ndarray:
    """Where cells that leave an unstable orbit slowly will be when they are `LEAP` times as far from it.

    Beside a bifurcation that takes thousands of periods, along which the orbit's monodromy matrix tells the
    motion. Let u be the parts of a cell's distance along the unstable eigenvectors, at the sections that
    share the phase of the orbit's first point, and lambda the multipliers. A cell leaps as long as
    ``|u'' - lambda**2 u| <= 0.1 (|lambda|**2 - 1) |u|`` over the younger half of them, two returns apart:
    near a doubling what is quadratic cancels over two.

    Parameters
    ----------
    section
        A leg, shape (n, LEG, state).
    orbits
        Known orbits.
    geometry
        Of the states.

    Returns
    -------
    ndarray, (n, state)
        NaN for cells that do not leap.
    """
    states = np.full((len(section), section.shape[2]), np.nan)
    scales = np.asarray(geometry.scales)
    for orbit in orbits:
        growth = float(np.abs(orbit.multipliers).max())
        # where it is fast, nothing is gained
        if not 1.0 < growth < LEAP ** (orbit.period / LEG):
            continue
        values, vectors = np.linalg.eig(scaled_derivative(orbit, geometry))
        grows = np.abs(values) > 1.0
        values, onto = values[grows], np.linalg.inv(vectors)[grows].T
        n = 2 * int(np.log(LEAP) / np.log(growth) / 2)
        for phase in range(orbit.period):
            index = np.arange(section.shape[1] - 1 - phase, -1, -orbit.period)[::-1]
            distance = geometry.difference(section[:, index[len(index) // 2 :]], orbit.points[0])
            along = distance @ onto
            error = np.abs(along[:, 2:] - along[:, :-2] * values**2)
            allowed = LINEAR * (np.abs(values) ** 2 - 1.0) * np.abs(along[:, :-2])
            linear = (error <= allowed).all(axis=(1, 2)) & (distance.shape[1] > PER_PHASE)
            more = ((along[linear, -1] * (values**n - 1.0)) @ vectors[:, grows].T).real
            states[linear] = orbit.points[0] + (distance[linear, -1] + more) * scales
    return states


def _leave(
    ends: Ends, row: int, number: int, orbit: Orbit, path: list[np.ndarray], geometry: Geometry
) -> None:
    """Note when a cell came near the orbit for good."""
    states = np.concatenate(path)
    phase = int(np.argmin(geometry.distance(orbit.points, states[-1])))
    back = np.arange(len(states))
    near = geometry.distance(states[::-1], orbit.points[(phase - back) % orbit.period]) <= REACH
    entered = len(states) - (len(near) if near.all() else int(np.argmin(near)))
    ends.orbit[row], ends.periods[row], ends.is_leaving[row] = number, float(entered), entered == 0


def _search(
    block: Block, owner: np.ndarray, orbits: list[list[Orbit]], tried: list[set[int]],
    polish_new: Polish, max_orbit_period: int, geometry: Geometry,
) -> None:  # fmt: skip
    """Polish what undecided cells close on, or come back to, and add what is new to `orbits`."""
    guesses: list[Guesses] = []
    points: list[int] = []
    for point in np.unique(owner):
        own = block.take(np.flatnonzero(owner == point))
        label, _ = decide(own, orbits[point], TOLERANCE, geometry)
        rest = own.take(np.flatnonzero(label < 0))
        closed = ClosedCells(geometry, TOLERANCE, Guesses.none(len(geometry.scales)))
        closed.add(rest)
        loose = rest.section[rest.is_bounded]
        found = closed.guesses.joined(near_closed(loose, max_orbit_period, geometry))
        new = [i for i, key in enumerate(found.key.tolist()) if key not in tried[point]]
        tried[point].update(found.key[new].tolist())
        guesses.append(found.take(np.array(new, np.int64)))
        points += [int(point)] * len(new)
    if not points:
        return
    polished = polish_new(
        np.array(points),
        np.concatenate([g.point for g in guesses]),
        np.concatenate([g.period for g in guesses]),
    )
    for point in set(points):
        own_orbits = [o for o, p in zip(polished, points, strict=True) if p == point and o is not None]
        for orbit in distinct(own_orbits, geometry):
            if orbit.is_stable and number_of(orbit, orbits[point], geometry) == len(orbits[point]):
                orbits[point].append(orbit)
