"""Estimate the transfer operator of a section map by Ulam's method, and its slow sets, committors and passage times.

States are sorted into boxes of a grid. Of the pairs (state, image) that begin in box i, the share that ends in box j
is the probability P_ij of a Markov chain (Ulam, A Collection of Mathematical Problems, 1960, p. 73). All numbers below
are of that chain, in steps of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigs, splu

from magpend_core.engine.vecmath import TWO_PI

OUTSIDE = -1
"""Box of a state outside the grid, or of one that diverged."""

FEW_BOXES = 400
"""Chains of at most so many boxes are solved as dense matrices."""


@dataclass(frozen=True)
class Grid:
    """Even boxes in the space of some states."""

    low: np.ndarray  # (state,)
    high: np.ndarray
    bins: np.ndarray  # (state,), int
    circle: np.ndarray  # (state,), bool: angles

    def box_of(self, states: np.ndarray) -> np.ndarray:
        """Return the number of the box of each state, shape (n, state); `OUTSIDE` beyond the grid and for NaN."""
        wrapped = np.where(self.circle, (states + np.pi) % TWO_PI - np.pi, states)
        with np.errstate(invalid="ignore"):
            place = np.floor((wrapped - self.low) / (self.high - self.low) * self.bins)
            place = np.where(wrapped == self.high, self.bins - 1, place)
            inside = ((place >= 0) & (place < self.bins)).all(axis=1)
        found = np.full(len(states), OUTSIDE, np.int64)
        if inside.any():
            found[inside] = np.ravel_multi_index(tuple(place[inside].astype(np.int64).T), tuple(self.bins))
        return found

    def places_of(self, boxes: np.ndarray) -> np.ndarray:
        """Return the index of boxes along each state, shape (box, state)."""
        return np.stack(np.unravel_index(boxes, tuple(self.bins)), axis=-1)

    def centres_of(self, boxes: np.ndarray) -> np.ndarray:
        """Return the centres of boxes, shape (box, state)."""
        return np.asarray(self.low + (self.places_of(boxes) + 0.5) * (self.high - self.low) / self.bins)


@dataclass(frozen=True)
class Chain:
    """Markov chain between the boxes that pairs begin in."""

    boxes: np.ndarray  # (box,): numbers in the grid, rising
    counts: csr_array  # (box, box): pairs, or their weights
    out: np.ndarray  # (box,): pairs that end outside the grid
    unknown: float  # share of all pairs that end in a box in which no pair begins

    @property
    def p(self) -> csr_array:
        """Transition probabilities, shape (box, box), on condition that the image lies in a known box or outside.

        What rows lack to 1 goes outside. Boxes from which no path goes on have empty rows and columns.
        """
        known = np.ones(len(self.boxes))
        while True:
            totals = self.counts @ known + self.out
            on = known * (totals > 0.0)
            if (on == known).all():
                break
            known = on
        inverse = np.divide(1.0, totals, out=np.zeros_like(totals), where=totals > 0.0)
        return csr_array(self.counts.multiply(inverse[:, None]).multiply(known[None, :]))


def lasting(p: csr_array) -> np.ndarray:
    """Return the positions of the boxes from which a path goes on for ever."""
    kept = np.ones(p.shape[0], bool)
    links = csr_array(p > 0)
    while True:
        on = kept & ((links @ kept) > 0)
        if (on == kept).all():
            return np.flatnonzero(kept)
        kept = on


def chain_of(before: np.ndarray, after: np.ndarray, weights: np.ndarray | None = None) -> Chain:
    """Count pairs of boxes.

    Parameters
    ----------
    before, after
        Boxes of states and of their images, shape (pair,); pairs that begin `OUTSIDE` are left out.
    weights
        Weight of each pair; 1 by default. Boxes are kept where all of their pairs have the weight 0.
    """
    known = before != OUTSIDE
    before, after = before[known], after[known]
    own = np.ones(len(before)) if weights is None else weights[known]
    boxes, row = np.unique(before, return_inverse=True)
    n = len(boxes)
    column = np.minimum(np.searchsorted(boxes, after), n - 1)
    out = after == OUTSIDE
    hit = ~out & (boxes[column] == after)
    counts = csr_array((own[hit], (row[hit], column[hit])), shape=(n, n))
    counts.sum_duplicates()
    counts.eliminate_zeros()
    return Chain(boxes, counts, np.bincount(row, own * out, n), float(own[~hit & ~out].sum()) / float(own.sum()))


def conditioned(p: csr_array) -> csr_array:
    """Return a chain whose rows add to 1: its paths do not leave. Every row must have an entry."""
    return csr_array(p.multiply(1.0 / np.asarray(p.sum(axis=1))[:, None]))


def closed_classes(p: csr_array) -> list[np.ndarray]:
    """Return the closed communicating classes of a chain, as positions: sets of boxes that no path leaves."""
    n_classes, label = connected_components(p, directed=True, connection="strong")
    start, end = p.nonzero()
    leaves = np.zeros(p.shape[0], bool)
    leaves[start[label[start] != label[end]]] = True
    is_open = np.zeros(n_classes, bool)
    is_open[label[leaves]] = True
    return [np.flatnonzero(label == k) for k in range(n_classes) if not is_open[k]]


def stationary(p: csr_array) -> np.ndarray:
    """Return the stationary distribution of an irreducible chain, by Gaussian elimination."""
    n = p.shape[0]
    if n == 1:
        return np.ones(1)
    # (I - P^T) pi = 0 with one equation replaced by pi_0 = 1: the rest is nonsingular for an irreducible chain
    a = csc_array(eye_array(n) - p.T)
    pi = np.ones(n)
    pi[1:] = _solve(csc_array(a[1:, 1:]), -a[1:, [0]].toarray().ravel())
    pi = np.maximum(pi, 0.0)
    return np.asarray(pi / pi.sum())


def leading_eigenvalue(p: csr_array) -> float:
    """Return the leading eigenvalue of a substochastic chain; NaN if it is not found.

    ``-log`` of it is the rate of escape per step (Pianigiani and Yorke, Trans. AMS 252, 351, 1979).
    """
    n = p.shape[0]
    if n <= FEW_BOXES:
        return float(np.linalg.eigvals(p.toarray()).real.max())
    try:
        return float(eigs(csc_array(p.T), k=1, which="LR", v0=np.ones(n), return_eigenvectors=False).real[0])
    except ArpackNoConvergence:
        return np.nan


def slow_eigenvalues(p: csr_array, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k eigenvalues next to 1 and their right eigenvectors, the nearest first; fewer if there are fewer."""
    near_one = 1.0 + 1e-6  # eigenvalues are sought next to this number: at 1 itself the shifted matrix is singular
    n = p.shape[0]
    if n <= max(FEW_BOXES, k + 2):
        values, vectors = np.linalg.eig(p.toarray())
    else:
        start = np.ones(n)
        start[::2] = 0.5  # not an eigenvector of a stochastic matrix
        values, vectors = eigs(csc_array(p), k=k, sigma=near_one, v0=start)
    order = np.argsort(np.abs(values - 1.0), kind="stable")[:k]
    return values[order], vectors[:, order]


def memberships(values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return how far each box belongs to each almost invariant set, shape (box, set); rows add to 1.

    Slow right eigenvectors are almost constant on almost invariant sets. The boxes at the corners of the simplex that
    they span are the sets' representatives (inner simplex algorithm, Weber and Galliat, ZIB report 02-12, 2002;
    Deuflhard and Weber, Linear Algebra Appl. 398, 161, 2005). Complex pairs count by real and imaginary part.
    """
    real = [vectors[:, 0].real * 0.0 + 1.0]
    for value, vector in zip(values[1:], vectors[:, 1:].T, strict=True):
        real.append(vector.imag if value.imag < 0.0 else vector.real)
    x = np.stack(real, axis=1)
    x[:, 1:] /= np.maximum(np.abs(x[:, 1:]).max(axis=0), 1e-300)
    corners = _corners(x)
    chi = x @ np.linalg.pinv(x[corners])
    return np.asarray(chi)


def _corners(x: np.ndarray) -> list[int]:
    """Choose as many rows as there are columns, as corners of the simplex that holds all: each further one lies
    farthest from the plane through those before.
    """
    found = [int(np.argmax(np.linalg.norm(x - x.mean(axis=0), axis=1)))]
    rest = x - x[found[0]]
    for _ in range(x.shape[1] - 1):
        sizes = np.linalg.norm(rest, axis=1)
        found.append(int(np.argmax(sizes)))
        direction = rest[found[-1]] / max(sizes[found[-1]], 1e-300)
        rest = rest - np.outer(rest @ direction, direction)
    return found


def committors(p: csr_array, cores: Sequence[np.ndarray]) -> np.ndarray:
    """Return the probability that each box goes to each core before the others, shape (box, core).

    Rows add to less than 1 where trajectories leave for outside or unknown boxes, or reach no core.
    """
    found = np.zeros((p.shape[0], len(cores)))
    for k, core in enumerate(cores):
        found[core, k] = 1.0
    any_core = found.any(axis=1)
    reached = np.flatnonzero(_reaches(p, np.flatnonzero(any_core)) & ~any_core)
    if len(reached):
        a = csc_array(eye_array(len(reached)) - p[reached][:, reached])
        found[reached] = np.clip(_solve(a, np.asarray(p[reached] @ found)), 0.0, 1.0)
    return found


def passage_times(p: csr_array, target: np.ndarray) -> np.ndarray:
    """Return the mean number of steps from each box to a target (positions); infinite where it can be missed."""
    n = p.shape[0]
    sure = committors(p, [target])[:, 0] > 1.0 - 1e-9
    sure[target] = False
    free = np.flatnonzero(sure)
    found = np.full(n, np.inf)
    found[target] = 0.0
    if len(free):
        a = csc_array(eye_array(len(free)) - p[free][:, free])
        found[free] = _solve(a, np.ones(len(free)))
    return found


def _reaches(p: csr_array, target: np.ndarray) -> np.ndarray:
    """Return which boxes have a path to a target."""
    reached = np.zeros(p.shape[0], bool)
    reached[target] = True
    links = csr_array(p > 0)
    while True:
        more = reached | ((links @ reached) > 0)
        if (more == reached).all():
            return reached
        reached = more


def _solve(a: csc_array, right: np.ndarray) -> np.ndarray:
    return np.asarray(splu(a).solve(np.asarray(right, np.float64)))
