"""Search for the closed orbits of a parameter point, one block of cells after another.

Cells are read in blocks, several times. The data kept between blocks (boxes, best guesses, least hashes,
sums) do not depend on how the cells were cut into blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.analysis.attractors.declaration import IdentifyOptions
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import ClosedCells, Guesses
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct, number_of
from pipeline.analysis.attractors.finding.equilibria import rest_of_orbit
from pipeline.analysis.attractors.finding.points import Dynamics, Point
from pipeline.analysis.attractors.finding.requests import Polish, Settings, Work
from pipeline.analysis.attractors.finding.spirals import beside, near_closed
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import LOOSE_SHARE, STRICT


@dataclass(frozen=True)
class Search:
    """Options of the search for attractors, with the dynamics and the settings of the run."""

    options: IdentifyOptions  # options of `identify`
    tolerance: float  # tolerance of the options, or the default that follows from the run
    dynamics: Dynamics  # model, parameters and system
    settings: Settings  # settings by which trajectories are extended
    # most guesses of a point from cells that are not closed; more find more orbits, and take longer
    most_guesses: int = 64

    @property
    def geometry(self) -> Geometry:
        """Geometry of the state space: which states are angles, and the scale of each state."""
        return self.dynamics.geometry

    @property
    def longest(self) -> int:
        """Longest orbit period to search for [drive periods, or returns to the section]."""
        return self.options.max_orbit_period

    @property
    def is_loose(self) -> bool:
        """Whether the closure tolerance is so large that a cell can count as closed without being on an orbit."""
        return self.options.polish and self.tolerance > STRICT

    @property
    def box(self) -> float:
        """Side of the boxes of section points by which closed (periodic) cells are grouped."""
        return LOOSE_SHARE * self.tolerance if self.is_loose else self.tolerance


@dataclass
class State:
    """Result of the search for orbits at one parameter point, before its cells are labelled."""

    orbits: list[Orbit]  # orbits, those of the last rounds last
    # keys of the boxes of closed cells, and the group of each box
    keys: np.ndarray
    group: np.ndarray
    closed: ClosedCells  # closed cells by group
    ends: dict[int, int]  # index of the orbit that a closed cell reached after further integration, by the cell's mark


def search_orbits(point: Point, search: Search) -> Work[State]:
    """Find the closed orbits that the cells of a parameter point have reached or approach."""
    rounds, rounds_loose = 3, 6  # most rounds of guessing and polishing, with a strict and with a loose tolerance
    n_states = len(search.geometry.scales)
    closed = ClosedCells(search.geometry, search.box, Guesses.none(n_states))
    for block in point.blocks():
        closed.add(block)
    keys, group = closed.close()
    orbits: list[Orbit] = []
    if search.options.polish:
        guesses = closed.guesses
        guesses = guesses.best(group[np.searchsorted(keys, guesses.key)].astype(np.uint64))
        if search.is_loose:
            guesses = guesses.least(search.most_guesses)
        for _ in range(rounds_loose if search.is_loose else rounds):
            if len(guesses.key):
                polished = moving((yield Polish(guesses)), point, search.geometry)
                more = distinct([*orbits, *(o for o in polished if o is not None)], search.geometry)
                if len(more) == len(orbits):
                    break
                orbits = more
            guesses = _undecided(point, orbits, search)
            if not len(guesses.key):
                break
    ends: dict[int, int] = {}
    if search.is_loose:
        rest = _closed_undecided(point, orbits, search)
        if len(rest.key):
            answers = moving((yield Polish(rest)), point, search.geometry)
            for mark, orbit in zip(rest.mark, answers, strict=True):
                if orbit is not None and orbit.is_stable:
                    number = number_of(orbit, orbits, search.geometry)
                    orbits = orbits if number < len(orbits) else [*orbits, orbit]
                    ends[int(mark)] = number
    return State(orbits, keys, group, closed, ends)


def moving(orbits: Sequence[Orbit | None], point: Point, geometry: Geometry) -> list[Orbit | None]:
    """Replace each orbit that is really an equilibrium by None, and add the equilibrium to the parameter point."""
    if not point.can_rest:
        return list(orbits)
    return [None if o is None or rest_of_orbit(point, o.points[0], geometry) is not None else o for o in orbits]


def _closed_undecided(point: Point, orbits: Sequence[Orbit], search: Search) -> Guesses:
    """Make guesses of orbits, without periods, from the closed (periodic) cells that are on no known orbit."""
    found = Guesses.none(len(search.geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, search.tolerance, search.geometry)
        rest = np.flatnonzero(block.is_closed & (label < 0))
        marks, zero = block.marks[rest], np.zeros(len(rest))
        own = Guesses(marks, zero, marks, block.section[rest, -1], zero.astype(np.int64))
        found = found.joined(own)
    return found


def _undecided(point: Point, orbits: Sequence[Orbit], search: Search) -> Guesses:
    """Make guesses of closed orbits from all cells that are on no known orbit."""
    closed = ClosedCells(search.geometry, search.box, Guesses.none(len(search.geometry.scales)))
    near = Guesses.none(len(search.geometry.scales))
    for block in point.blocks():
        label, _ = decide(block, orbits, search.tolerance, search.geometry)
        rest = np.flatnonzero(label < 0)
        if not len(rest):
            continue
        closed.add(block.take(rest))
        loose = rest[block.is_bounded[rest]]
        near = near.joined(near_closed(block.section[loose], search.longest, search.geometry, block.marks[loose]))
    if not len(closed.guesses.key) and not len(near.key):
        return near
    keys, group = closed.close()
    own = closed.guesses.best(group[np.searchsorted(keys, closed.guesses.key)].astype(np.uint64))
    if search.is_loose:
        # the observed period may be half the true one, or the orbit unstable: try without a period as well
        own = closed.guesses.least(search.most_guesses)
        own = own.followed_by(own.without_period())
    if len(near.key):
        own = own.followed_by(beside(orbits, search.longest, search.geometry))
    return own.followed_by(near.least(search.most_guesses))
