"""Track edge states: sets on the boundary between two basins that attract within the boundary.

A pair of states, one in each basin, is bisected until it is close. Both are integrated over a section, which drives
them apart along the unstable direction while it contracts them within the boundary. When they are too far apart,
they are bisected again. So the pair follows a trajectory on the boundary to its edge state (Skufca, Yorke and
Eckhardt, Phys. Rev. Lett. 96, 174101, 2006). All pairs are tracked in step, and a bisection tries several states of
a segment at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from magpend_core.models.sectioned import of_flow
from magpend_core.sampling import sample
from magpend_core.status import Status
from pipeline.analysis.attractors.destinations import UNDECIDED, Destinations
from pipeline.analysis.attractors.extension.clouds import is_stationary
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.analysis.attractors.finding.equilibria import equilibria_near
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.requests import LEG
from pipeline.analysis.resilience.edge_orbits import n_unstable, separates
from pipeline.analysis.tolerances import PORTRAIT_RTOL, RECURRENCE
from pipeline.products.reporting import report

REASONS = ("none", "third_attractor", "undecided", "lost", "not_settled", "parted")
NONE, THIRD, UNKNOWN, LOST, NOT_SETTLED, PARTED = range(len(REASONS))
"""Why a pair has no edge state."""

PARTS = 8
"""Parts into which a segment is divided at once."""

MOST_DIVISIONS = 40
"""Most divisions of a segment in one bisection."""

CLOSE = 10.0
"""Distance within which a path recurs, and from its edge state, in units of the pair's largest distance."""


WIDEST = 100.0
"""Distance of a pair after one section, in units of the largest distance, beyond which it no longer shows where the
boundary is: the segment between its states may cross other parts of it."""

INSTANTS = 1024
"""Instants between two sections at which it is seen where a trajectory is slow."""


@dataclass(frozen=True)
class Limits:
    """Limits of the tracking.

    Attributes
    ----------
    closest, farthest : float
        Scaled distance to which a pair is bisected, and beyond which it is bisected again.
    returns : int
        Most sections of a path.
    longest : int
        Longest period of an edge orbit.
    """

    closest: float
    farthest: float
    returns: int
    longest: int


@dataclass
class Pair:
    """A pair of states, one in each basin, and its path along the boundary.

    Attributes
    ----------
    start : ndarray, (2, state)
        The two initial states.
    ends : ndarray, (2, state)
        The two states now.
    path : list of ndarray
        Middle of the pair at each section after the first bisection.
    found : Orbit, Equilibrium, ndarray or None
        Edge state: an orbit, an equilibrium, or section points (n, state) of a bounded set.
    reason : int
        Index into `REASONS`.
    """

    start: np.ndarray
    ends: np.ndarray
    path: list[np.ndarray] = field(default_factory=list)
    found: Orbit | Equilibrium | np.ndarray | None = None
    reason: int = NONE

    @property
    def goes_on(self) -> bool:
        """Whether the pair is still tracked."""
        return self.found is None and self.reason == NONE


class Tracking:
    """The tracking of pairs between two attractors.

    Parameters
    ----------
    there
        Attractors of the parameter point.
    between
        Ids of the two attractors, in the order of each pair's states.
    limits
        Limits of the tracking.
    """

    def __init__(self, there: Destinations, between: tuple[int, int], limits: Limits) -> None:
        self._there, self._between, self._limits = there, between, limits
        self._geometry = there.geometry

    def choose(self, candidates: Sequence[Pair], n: int) -> list[Pair]:
        """Bisect candidates; return `n` of them, those with a common boundary of the two basins first."""
        self._bisect(candidates)
        return sorted(candidates, key=lambda pair: not pair.goes_on)[:n]

    def run(self, pairs: Sequence[Pair]) -> None:
        """Track bisected pairs until each has an edge state, or a reason why it has none, in place."""
        self._note(pairs)
        for n in range(1, self._limits.returns + 1):
            going = [pair for pair in pairs if pair.goes_on]
            report("tracking edge states", n, self._limits.returns)
            if not going:
                break
            before = [self._width(pair) for pair in going]
            self._advance(going)
            self._bisect([p for p, width in zip(going, before, strict=True) if p.goes_on and self._is_due(p, width)])
            self._note(going)
            for pair in going:
                if pair.goes_on:
                    self._settle(pair)
        for pair in pairs:
            if pair.goes_on:
                self._as_set(pair)

    def _note(self, pairs: Sequence[Pair]) -> None:
        """Add the middle of each pair to its path."""
        for pair in pairs:
            if pair.goes_on:
                pair.path.append(self._between_ends(pair, np.array([0.5]))[0])

    # ---- pairs ---------------------------------------------------------------------------------

    def _width(self, pair: Pair) -> float:
        return float(self._geometry.distance(pair.ends[0], pair.ends[1]))

    def _is_due(self, pair: Pair, before: float) -> bool:
        """Return whether a pair is to be bisected: too wide after one more section, if it grows as it did from
        `before`, or so close that it lies in one basin.
        """
        width = self._width(pair)
        grown = width * max(width / before, 1.0)
        return grown > self._limits.farthest or width < 1e-2 * self._limits.closest

    def _between_ends(self, pair: Pair, shares: np.ndarray) -> np.ndarray:
        """Return the states at shares of the segment from one end of a pair to the other."""
        jump = self._geometry.difference(pair.ends[1], pair.ends[0]) * np.asarray(self._geometry.scales)
        return np.asarray(pair.ends[0] + shares[:, None] * jump)

    def _advance(self, pairs: Sequence[Pair]) -> None:
        """Integrate pairs to the next section."""
        flight = self._there.fly(np.concatenate([pair.ends for pair in pairs]))
        found = flight.advance(1)
        states = found.state.reshape(len(pairs), 2, -1)
        status = found.status.reshape(len(pairs), 2)
        for i, (pair, own, codes) in enumerate(zip(pairs, states, status, strict=True)):
            if np.isin(codes, (Status.PERIODIC, Status.BOUNDED)).all() and (own[0] != own[1]).any():
                before, pair.ends = pair.ends[0], own
                if self._width(pair) > WIDEST * self._limits.farthest:
                    pair.reason = PARTED
                    if self._there.point.is_flow:
                        self._pass(pair, before, float(flight.seconds[2 * i, 0]))
                continue
            pair.reason = LOST
            if self._there.point.can_rest and (codes == Status.NO_RETURN).any():
                self._rest(pair, own[codes == Status.NO_RETURN])

    # ---- bisection -----------------------------------------------------------------------------

    def _bisect(self, pairs: Sequence[Pair]) -> None:
        """Divide the segments between pairs until their states are close, in place."""
        shares = np.arange(PARTS + 1) / PARTS
        due = {id(pair) for pair in pairs}
        for _ in range(MOST_DIVISIONS):
            going = [p for p in pairs if p.goes_on and (id(p) in due or self._width(p) > self._limits.closest)]
            if not going:
                return
            states = np.stack([self._between_ends(pair, shares) for pair in going])
            labels = self._there.follow(states.reshape(-1, states.shape[2])).label.reshape(len(going), -1)
            for pair, own, label in zip(going, states, labels, strict=True):
                if self._take(pair, own, label):
                    due.discard(id(pair))
        for pair in pairs:
            if pair.goes_on and (id(pair) in due or self._width(pair) > self._limits.farthest):
                pair.reason = UNKNOWN

    def _take(self, pair: Pair, states: np.ndarray, label: np.ndarray) -> bool:
        """Replace a pair by the two closest states of the two basins, with no third basin between them if possible.

        A pair that has left one of the two basins is widened. Return whether it has both.
        """
        first, second = (np.flatnonzero(label == number) for number in self._between)
        if not len(first) or not len(second):
            pair.ends = self._between_ends(pair, np.array([-1.0, 2.0]))
            if not self._width(pair) <= CLOSE * self._limits.farthest:
                pair.reason = LOST
            return False
        steps = []
        for i in first.tolist():
            for j in second.tolist():
                inside = label[min(i, j) + 1 : max(i, j)]
                steps.append((bool((inside != UNDECIDED).any()), abs(i - j), i, j))
        has_third, length, i, j = min(steps)
        if length == PARTS:
            pair.reason = THIRD if has_third else UNKNOWN
            return False
        pair.ends = states[[i, j]]
        return True

    # ---- edge states ---------------------------------------------------------------------------

    def _settle(self, pair: Pair) -> None:
        """Find the orbit or the equilibrium to which a pair's path has come, if there is one."""
        path = np.array(pair.path)
        near = CLOSE * self._limits.farthest
        most = min(self._limits.longest, len(path) - 1)
        if most < 2:
            return
        # twice in turn: a chaotic path recurs once by chance more often
        lags = [self._geometry.distance(path[-2:], path[-2 - p : -p]).max() for p in range(1, most)]
        if not min(lags) <= near:
            return
        period = int(np.argmax(np.array(lags) <= near)) + 1
        if self._there.point.can_rest and self._rest(pair, path[-1:]):
            return
        (orbit,) = self._there.polished(path[-1:], np.array([period]))
        if orbit is None or n_unstable(orbit) != 1:
            return
        if self._geometry.distance(orbit.points, path[-1]).min() <= near:
            pair.found = orbit

    def _rest(self, pair: Pair, states: np.ndarray) -> bool:
        """Take the equilibrium near the end of a pair's path as its edge state, if there is one."""
        near = CLOSE * self._limits.farthest
        for one in equilibria_near(self._there.point, states, self._geometry):
            unstable = one.eigenvalues.real > one.eigenvalue_error
            if unstable.sum() == 1 and self._geometry.distance(states, one.state).min() <= near:
                pair.found, pair.reason = one, NONE
                return True
        return False

    def _pass(self, pair: Pair, state: np.ndarray, seconds: float) -> None:
        """Take the saddle that a parting pair passes between two sections as its edge state, if it is one."""
        assert self._there.point.parameters is not None
        parameters = of_flow(self._there.point.parameters)
        states = sample(
            parameters.model.system,
            parameters.pack()[None],
            state[None],
            [np.linspace(0.0, seconds, INSTANTS)],
            rtol=PORTRAIT_RTOL,
            atol=PORTRAIT_RTOL,
        ).states[0]
        speed = self._geometry.distance(states[1:], states[:-1])
        slow = 1 + np.flatnonzero((speed[1:-1] <= speed[:-2]) & (speed[1:-1] <= speed[2:]))
        for one in equilibria_near(self._there.point, states[slow], self._geometry) if len(slow) else ():
            passes = self._geometry.distance(states, one.state).min() <= RECURRENCE
            if passes and separates(one, self._there, self._between):
                pair.found, pair.reason = one, NONE
                return

    def _as_set(self, pair: Pair) -> None:
        """Take the later half of a path as section points of a bounded set, if both its halves fill the same points."""
        later = np.array(pair.path[len(pair.path) // 2 :])
        if len(later) >= LEG and is_stationary(later, self._geometry, self._limits.farthest):
            pair.found = later
        else:
            pair.reason = NOT_SETTLED


def nearest_pairs(
    states: np.ndarray, labels: np.ndarray, between: tuple[int, int], n: int, there: Destinations, seed: int
) -> list[Pair]:
    """Return pairs of initial states, one in each basin, close to each other and spread along the boundary.

    Parameters
    ----------
    states, labels
        Initial states of the cells (cell, state), and the attractor on which each ends.
    between
        Ids of the two attractors.
    n
        Most pairs.
    there
        Attractors of the parameter point.
    seed
        Seed that chooses among the closer half of the possible pairs.
    """
    geometry = there.geometry
    first, second = (states[labels == number] for number in between)
    if not len(first) or not len(second):
        return []
    away, nearest = geometry.tree(first).query(geometry.scaled(second), p=np.inf)
    closer = np.argsort(away, kind="stable")[: max(len(away) // 2, 1)]
    chosen = np.random.default_rng(seed).permutation(closer)[:n]
    starts = [np.stack([first[nearest[k]], second[k]]) for k in chosen]
    return [Pair(start, start) for start in starts]
