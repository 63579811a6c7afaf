"""Search for the closed orbits of parameter points, one block of cells after another.

Cells are read in blocks, several times. The data kept between blocks (boxes, best guesses, least hashes,
sums) do not depend on how the cells were cut into blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from pipeline.analysis.attractors.declaration import IdentifyOptions
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block, ClosedCells, Guesses, of_owner
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct, number_of
from pipeline.analysis.attractors.finding.equilibria import rest_of_orbit
from pipeline.analysis.attractors.finding.points import Dynamics, Point, Slab
from pipeline.analysis.attractors.finding.requests import FINDING, Settings, polish_guesses
from pipeline.analysis.attractors.finding.spirals import beside, near_closed
from pipeline.products.reporting import UNTOLD, report
from pipeline.results.sets import Geometry, rows_by_number
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
    """Result of the search for orbits at all parameter points of a slab, before cells are labelled."""

    orbits: list[list[Orbit]]  # orbits of each point, those of the last rounds last
    # keys of the boxes of closed cells, and the group of each box
    keys: np.ndarray
    group: np.ndarray
    closed: ClosedCells  # closed cells by group
    # for each point the index of the orbit that a closed cell reached after further integration, by the cell's mark
    ends: list[dict[int, int]]
    # `Status` with which Newton's method ended in vain, by the key of the guess (its box of section points)
    unpolished: dict[int, int]

    def decide(self, block: Block, search: Search) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the orbit of each cell, among those of its parameter point, and the decision; see
        `assigning.decide`.
        """
        owner = np.repeat(range(len(self.orbits)), [len(own) for own in self.orbits])
        label, decision = decide(block, list(chain(*self.orbits)), search.tolerance, search.geometry, owner)
        return np.where(label < 0, -1, label - np.searchsorted(owner, block.owner)), decision


def search_orbits(slab: Slab, search: Search) -> State:
    """Find the closed orbits that the cells of parameter points have reached or approach."""
    rounds, rounds_loose = 3, 6  # most rounds of guessing and polishing, with a strict and with a loose tolerance
    points = slab.points
    closed = ClosedCells(search.geometry, search.box, Guesses.none(search.geometry.n_states))
    for block in slab.blocks():
        closed.add(block)
    keys, group = closed.close()
    state = State([[] for _ in points], keys, group, closed, [{} for _ in points], {})
    if not search.options.polish:
        return state
    guesses = closed.best(keys, group)
    if search.is_loose:
        guesses = guesses.least(search.most_guesses)
    goes_on = np.ones(len(points), bool)
    for _ in range(rounds_loose if search.is_loose else rounds):
        for k, polished in _polished(guesses, points, state, search).items():
            more = distinct([*state.orbits[k], *(one for one in polished if one is not None)], search.geometry)
            goes_on[k] = len(more) > len(state.orbits[k])
            state.orbits[k] = more if goes_on[k] else state.orbits[k]
        report(FINDING, int((~goes_on).sum()), len(points), UNTOLD)
        guesses = _undecided(slab, goes_on, state, search)
        goes_on = np.isin(np.arange(len(points)), guesses.owner)
        if not goes_on.any():
            break
    if search.is_loose:
        _follow_loose(slab, state, search)
    return state


def _polished(guesses: Guesses, points: Sequence[Point], state: State, search: Search) -> dict[int, list[Orbit | None]]:
    """Refine guesses of orbits; return those of each parameter point. An orbit that is really an equilibrium is added
    to the point's equilibria, and None stands for it.
    """
    if not len(guesses.key):
        return {}
    orbits, status = polish_guesses(guesses, points, search.settings)
    for key, one, ended in zip(guesses.key.tolist(), orbits, status.tolist(), strict=True):
        if one is None:
            state.unpolished.setdefault(key, ended)
    rows = rows_by_number(guesses.owner)
    return {k: moving([orbits[i] for i in own.tolist()], points[k], search.geometry) for k, own in rows.items()}


def moving(orbits: Sequence[Orbit | None], point: Point, geometry: Geometry) -> list[Orbit | None]:
    """Replace each orbit that is really an equilibrium by None, and add the equilibrium to the parameter point."""
    if not point.can_rest:
        return list(orbits)
    return [None if o is None or rest_of_orbit(point, o.points[0], geometry) is not None else o for o in orbits]


def _follow_loose(slab: Slab, state: State, search: Search) -> None:
    """Integrate the closed (periodic) cells that are on no known orbit until they close more exactly; store the orbits
    on which they end.
    """
    rest = Guesses.none(search.geometry.n_states)
    for block in slab.blocks():
        label, _ = state.decide(block, search)
        cells = np.flatnonzero(block.is_closed & (label < 0))
        marks, zero = block.marks[cells], np.zeros(len(cells))
        owner = block.owner[cells]
        own = Guesses(of_owner(marks, owner), zero, marks, block.section[cells, -1], zero.astype(np.int64), owner)
        rest = rest.joined(own)
    rows = rows_by_number(rest.owner)
    for k, found in _polished(rest, slab.points, state, search).items():
        orbits = state.orbits[k]
        for mark, orbit in zip(rest.mark[rows[k]].tolist(), found, strict=True):
            if orbit is not None and orbit.is_stable:
                number = state.ends[k][mark] = number_of(orbit, orbits, search.geometry)
                orbits += [orbit] if number == len(orbits) else []


def _undecided(slab: Slab, which: np.ndarray, state: State, search: Search) -> Guesses:
    """Make guesses of closed orbits from all cells of some parameter points that are on no known orbit."""
    none = Guesses.none(search.geometry.n_states)
    closed, near = ClosedCells(search.geometry, search.box, none), none
    for block in slab.blocks() if which.any() else ():
        label, _ = state.decide(block, search)
        rest = np.flatnonzero((label < 0) & which[block.owner])
        closed.add(block.take(rest))
        loose = rest[block.is_bounded[rest]]
        marks, owner = block.marks[loose], block.owner[loose]
        near = near.joined(near_closed(block.section[loose], search.longest, search.geometry, marks, owner))
    own = closed.best(*closed.close())
    if search.is_loose:
        # the observed period may be half the true one, or the orbit unstable: try without a period as well
        own = closed.guesses.least(search.most_guesses)
        own = own.followed_by(own.without_period())
    orbits = [(one, k) for k in np.unique(near.owner).tolist() for one in state.orbits[k]]
    around = beside([one for one, _ in orbits], [k for _, k in orbits], search.longest, search.geometry)
    return own.followed_by(around, near.least(search.most_guesses))
