"""Track edge states: sets on the boundary between two basins that attract within the boundary.

A pair of states, one in each basin, is bisected until it is close. Both are integrated over a section, which drives
them apart along the unstable direction while it contracts them within the boundary. When they are too far apart,
they are bisected again. So the pair follows a trajectory on the boundary to its edge state (Skufca, Yorke and
Eckhardt, Phys. Rev. Lett. 96, 174101, 2006). All pairs are tracked in step, and a bisection tries several states of
a segment at once.

Where the boundary is fractal, the edge is a chaotic saddle: a path on it never settles, and saddle orbits lie dense
in it. Newton's method from points of the path finds the shortest ones. An orbit is on the boundary if arbitrarily
close to it, along its unstable direction, states of both basins are found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from magpend_core.models.sectioned import of_flow
from magpend_core.status import Status
from pipeline.analysis.attractors.destinations import UNDECIDED, Destinations
from pipeline.analysis.attractors.extension.clouds import is_stationary
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct
from pipeline.analysis.attractors.finding.equilibria import equilibria_near
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.requests import LEG
from pipeline.analysis.branches.deflation import DeflationSettings, search_orbits
from pipeline.analysis.flown import flown
from pipeline.analysis.resilience.declaration import EdgeOptions
from pipeline.products.reporting import report
from pipeline.results.sets import nearest_distances
from pipeline.results.tolerances import RECURRENCE

REASONS = ("none", "third_attractor", "undecided", "lost", "not_settled", "parted")
NONE, THIRD, UNKNOWN, LOST, NOT_SETTLED, PARTED = range(len(REASONS))
"""Why a pair has no edge state."""


@dataclass(frozen=True)
class TrackingSettings:
    """Numbers of the tracking of an edge, and of the search for orbits on it."""

    parts: int = 8  # parts into which a segment is divided at once
    most_divisions: int = 40  # most divisions of a segment in one bisection
    # distance within which a path recurs, and from its edge state, in units of the pair's largest distance
    close: float = 10.0
    # distance of a pair after one section, in units of the largest distance, beyond which it no longer shows where the
    # boundary is: the segment between its states may cross other parts of it
    widest: float = 100.0
    instants: int = 1024  # instants between two sections at which it is seen where a trajectory is slow
    # points of the paths from which Newton's method starts, for each period: those that recur most closely, and others
    # drawn at random; more find more orbits, and take longer
    most_recurrences: int = 64
    n_starts: int = 336
    # scaled standard deviation by which the random ones are moved: strongly unstable orbits attract Newton's method
    # from a narrow strip, which few points of a path hit
    beside: float = 0.05
    rounds: int = 6  # most rounds of the search in which known orbits are deflated


SHIFTS = 10.0 ** np.arange(-8.0, -3.0, 0.25)
"""Scaled distances from an orbit at which both basins are looked for."""

NEAREST = len(SHIFTS) // 2
"""How many of the smaller distances must show both basins."""


@dataclass
class Pair:
    """A pair of states, one in each basin, and its path along the boundary."""

    start: np.ndarray  # (2, state): the two initial states
    ends: np.ndarray  # (2, state): the two states now
    path: list[np.ndarray] = field(default_factory=list)  # middle of the pair at each section after the first bisection
    # edge state: an orbit, an equilibrium, or section points (n, state) of a bounded set
    found: Orbit | Equilibrium | np.ndarray | None = None
    reason: int = NONE  # index into `REASONS`

    @property
    def goes_on(self) -> bool:
        """Whether the pair is still tracked."""
        return self.found is None and self.reason == NONE


class Tracking:
    """The tracking of pairs between two attractors, whose ids are in the order of each pair's states."""

    def __init__(
        self,
        there: Destinations,
        between: tuple[int, int],
        options: EdgeOptions,
        settings: TrackingSettings = TrackingSettings(),
    ) -> None:
        self.settings = settings
        self._there, self._between, self._options, self._geometry = there, between, options, there.geometry

    def choose(self, candidates: Sequence[Pair], n: int) -> list[Pair]:
        """Bisect candidates; return `n` of them, those with a common boundary of the two basins first."""
        self._bisect(candidates)
        return sorted(candidates, key=lambda pair: not pair.goes_on)[:n]

    def run(self, pairs: Sequence[Pair]) -> None:
        """Track bisected pairs until each has an edge state, or a reason why it has none, in place."""
        self._note(pairs)
        for n in range(1, self._options.returns + 1):
            going = [pair for pair in pairs if pair.goes_on]
            report("tracking edge states", n, self._options.returns)
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
        return grown > self._options.farthest or width < 1e-2 * self._options.closest

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
                if self._width(pair) > self.settings.widest * self._options.farthest:
                    pair.reason = PARTED
                    if self._there.point.has_returns:
                        self._pass(pair, before, float(flight.seconds[2 * i, 0]))
                continue
            pair.reason = LOST
            if self._there.point.can_rest and (codes == Status.NO_RETURN).any():
                self._rest(pair, own[codes == Status.NO_RETURN])

    # ---- bisection -----------------------------------------------------------------------------

    def _bisect(self, pairs: Sequence[Pair]) -> None:
        """Divide the segments between pairs until their states are close, in place."""
        shares = np.arange(self.settings.parts + 1) / self.settings.parts
        due = {id(pair) for pair in pairs}
        for _ in range(self.settings.most_divisions):
            going = [p for p in pairs if p.goes_on and (id(p) in due or self._width(p) > self._options.closest)]
            if not going:
                return
            states = np.stack([self._between_ends(pair, shares) for pair in going])
            labels = self._there.follow(states.reshape(-1, states.shape[2])).label.reshape(len(going), -1)
            for pair, own, label in zip(going, states, labels, strict=True):
                if self._take(pair, own, label):
                    due.discard(id(pair))
        for pair in pairs:
            if pair.goes_on and (id(pair) in due or self._width(pair) > self._options.farthest):
                pair.reason = UNKNOWN

    def _take(self, pair: Pair, states: np.ndarray, label: np.ndarray) -> bool:
        """Replace a pair by the two closest states of the two basins, with no third basin between them if possible.

        A pair that has left one of the two basins is widened. Return whether it has both.
        """
        first, second = (np.flatnonzero(label == number) for number in self._between)
        if not len(first) or not len(second):
            pair.ends = self._between_ends(pair, np.array([-1.0, 2.0]))
            if not self._width(pair) <= self.settings.close * self._options.farthest:
                pair.reason = LOST
            return False
        steps = [
            (bool((label[min(i, j) + 1 : max(i, j)] != UNDECIDED).any()), abs(i - j), i, j)
            for i, j in product(first.tolist(), second.tolist())
        ]
        has_third, length, i, j = min(steps)
        if length == self.settings.parts:
            pair.reason = THIRD if has_third else UNKNOWN
            return False
        pair.ends = states[[i, j]]
        return True

    # ---- edge states ---------------------------------------------------------------------------

    def _settle(self, pair: Pair) -> None:
        """Find the orbit or the equilibrium to which a pair's path has come, if there is one."""
        path = np.array(pair.path)
        near = self.settings.close * self._options.farthest
        most = min(self._there.options.max_orbit_period, len(path) - 1)
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
        near = self.settings.close * self._options.farthest
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
        states = flown(parameters, state[None], np.linspace(0.0, seconds, self.settings.instants)).states[0]
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
        if len(later) >= LEG and is_stationary(later, self._geometry, self._options.farthest):
            pair.found = later
        else:
            pair.reason = NOT_SETTLED


def nearest_pairs(
    states: np.ndarray, labels: np.ndarray, between: tuple[int, int], n: int, there: Destinations, options: EdgeOptions
) -> list[Pair]:
    """Return at most `n` pairs of initial states, one in each basin, close to each other and spread along the boundary.

    States (cell, state) have the ids of the attractors on which they end as labels.
    """
    geometry = there.geometry
    first, second = (states[labels == number] for number in between)
    if not len(first) or not len(second):
        return []
    away, nearest = geometry.tree(first).query(geometry.scaled(second), p=np.inf)
    closer = np.argsort(away, kind="stable")[: max(len(away) // 2, 1)]
    chosen = np.random.default_rng(options.seed).permutation(closer)[:n]
    starts = [np.stack([first[nearest[k]], second[k]]) for k in chosen]
    return [Pair(start, start) for start in starts]


def orbits_on(
    paths: Sequence[np.ndarray],
    there: Destinations,
    between: tuple[int, int],
    max_period: int,
    settings: TrackingSettings = TrackingSettings(),
) -> list[Orbit]:
    """Return the saddle orbits on the boundary that Newton's method finds from points of paths along it, and that the
    paths come near. Paths are section points of shape (n, state).
    """
    point = there.point
    if not paths or not max_period or point.n_neutral:
        return []
    starts = [_starts(paths, period, there, settings) for period in range(1, max_period + 1)]
    periods = np.repeat(np.arange(1, max_period + 1), [len(own) for own in starts])
    found = search_orbits(
        np.concatenate(starts),
        periods,
        point.frequency,
        point.packed,
        point.integrates,
        settings=DeflationSettings(rounds=settings.rounds),
    )
    polished = there.polished(
        np.array([one.points[0] for one in found]).reshape(len(found), point.n_states),
        np.array([one.period for one in found], np.int64),
    )
    every = np.concatenate(paths)
    near = [
        one
        for one in polished
        if one is not None
        and n_unstable(one) == 1
        and nearest_distances(one.points, every, there.geometry).min() <= RECURRENCE
    ]
    return [one for one in distinct(near, there.geometry) if is_on_boundary(one, there, between)]


def _starts(paths: Sequence[np.ndarray], period: int, there: Destinations, settings: TrackingSettings) -> np.ndarray:
    """Return points of the paths that nearly recur after a period, and states beside others."""
    lags = np.concatenate([there.geometry.distance(path[period:], path[:-period]) for path in paths])
    recurring = np.concatenate([path[:-period] for path in paths])
    closest = recurring[np.argsort(lags, kind="stable")[: settings.most_recurrences]]
    every, rng = np.concatenate(paths), np.random.default_rng(0)
    drawn = every[rng.integers(len(every), size=settings.n_starts)]
    moved = drawn + settings.beside * np.asarray(there.geometry.scales) * rng.standard_normal(drawn.shape)
    return np.concatenate([closest, moved])


def n_unstable(orbit: Orbit) -> int:
    """Return how many multipliers of an orbit lie outside the unit circle, by more than their error."""
    return int((np.abs(orbit.multipliers) > 1.0 + orbit.multiplier_error).sum())


def is_on_boundary(orbit: Orbit, there: Destinations, between: tuple[int, int]) -> bool:
    """Return whether states of both basins lie arbitrarily close to a saddle orbit, along its unstable direction."""
    values, vectors = np.linalg.eig(orbit.derivative)
    direction = vectors[:, int(np.abs(values).argmax())].real
    labels = _beside(orbit.points[0], direction, there)
    return set(between) <= set(labels[:, :NEAREST].ravel().tolist())


def separates(rest: Equilibrium, there: Destinations, between: tuple[int, int]) -> bool:
    """Return whether an equilibrium has one unstable direction, and leaving along it leads to one of two attractors on
    one side, and to the other on the other side.
    """
    if (rest.eigenvalues.real > rest.eigenvalue_error).sum() != 1:
        return False
    values, vectors = np.linalg.eig(rest.jacobian)
    direction = vectors[:, int(values.real.argmax())].real * np.asarray(there.geometry.scales)
    sides = [set(own.tolist()) - {UNDECIDED} for own in _beside(rest.state, direction, there)]
    return sorted(map(sorted, sides)) == [[number] for number in sorted(between)]


def _beside(state: np.ndarray, direction: np.ndarray, there: Destinations) -> np.ndarray:
    """Return the labels of states beside another along a direction, shape (side, shift)."""
    direction = direction / np.abs(direction / np.asarray(there.geometry.scales)).max()
    shifts = np.concatenate([SHIFTS, -SHIFTS])
    return np.asarray(there.follow(state + shifts[:, None] * direction).label.reshape(2, -1))
