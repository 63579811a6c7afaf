"""Find nearest neighbours among states, by compiled loops: for few points a search tree costs more than its search.

States are scaled, and angles lie in [0, circumference). The distance of two states is the largest difference of a
component, along the shorter arc for angles: the numbers are those of `scipy.spatial.cKDTree` with ``p=inf``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.engine.jit import inline, kernel


def nearest_distances(points: np.ndarray, asked: np.ndarray, circumference: np.ndarray) -> np.ndarray:
    """Return the distance of each state of `asked` (m, state) from the nearest of `points` (n, state).

    Parameters
    ----------
    points, asked
        Scaled states.
    circumference
        Length of the circle of each state, 0 for states that are no angles; shape (state,).
    """
    # another order in memory would be compiled anew
    points, asked = np.ascontiguousarray(points), np.ascontiguousarray(asked)
    axis, found = _widest(points), np.empty(len(asked))
    _nearest_distances(_sorted(points, axis), asked, axis, circumference, found)
    return found


def n_nearer(
    own: np.ndarray, other: np.ndarray, asked: np.ndarray, circumference: np.ndarray, least: float, enough: float
) -> float:
    """Count the states of `asked` that are nearer to the points `other` than to the points `own`; equally near ones
    count half.

    Parameters
    ----------
    own, other, asked
        Scaled states, shapes (n, state).
    circumference
        As for `nearest_distances`.
    least
        Distances up to this count as equal.
    enough
        The count ends once it has reached this.
    """
    own, other, asked = (np.ascontiguousarray(points) for points in (own, other, asked))
    axis = _widest(own)
    return float(_n_nearer(_sorted(own, axis), _sorted(other, axis), asked, axis, circumference, least, enough))


@kernel
def _widest(points: Any) -> int:
    """Return the state in which points differ most: sorted by it, few of them lie near another."""
    axis, widest = 0, -1.0
    for k in range(points.shape[1]):
        low, high = np.inf, -np.inf
        for i in range(len(points)):
            low, high = min(low, points[i, k]), max(high, points[i, k])
        if high - low > widest:
            axis, widest = k, high - low
    return axis


def _sorted(points: np.ndarray, axis: int) -> np.ndarray:
    return np.asarray(points[np.argsort(points[:, axis])])


@inline
def _difference(a: float, b: float, length: float) -> float:
    difference = a - b
    if difference < -0.5 * length:
        difference += length
    elif difference > 0.5 * length:
        difference -= length
    return abs(difference)


@inline
def _nearest(points: Any, state: Any, axis: int, circumference: Any, within: float, ends_below: float) -> float:
    """Return the distance of a state from the nearest point that is at most `within` away, infinity if there is none.

    The search ends at a distance below `ends_below`. Points are sorted by the state `axis`.
    """
    n, length, value = len(points), circumference[axis], state[axis]
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if points[middle, axis] < value:
            low = middle + 1
        else:
            high = middle
    best, bound = np.inf, within
    for step in (1, -1):
        i = low if step > 0 else low - 1
        for _ in range(n):
            if i < 0 or i >= n:
                if length == 0.0:
                    break
                i -= step * n
            # points follow each other around the circle: half of it belongs to the other direction
            arc = step * (points[i, axis] - value)
            if arc < 0.0:
                arc += length
            if arc > bound or (length > 0.0 and arc > 0.5 * length):
                break
            away = 0.0
            for k in range(len(circumference)):
                away = max(away, _difference(points[i, k], state[k], circumference[k]))
                if away > bound:
                    break
            if away <= bound:
                best = bound = away
                if best < ends_below:
                    return best
            i += step
    return best


@kernel
def _nearest_distances(points: Any, asked: Any, axis: int, circumference: Any, found: Any) -> None:
    for row in range(len(asked)):
        found[row] = _nearest(points, asked[row], axis, circumference, np.inf, 0.0)


@kernel
def _n_nearer(own: Any, other: Any, asked: Any, axis: int, circumference: Any, least: float, enough: float) -> float:
    count = 0.0
    for row in range(len(asked)):
        near = max(_nearest(own, asked[row], axis, circumference, np.inf, least), least)
        below = near if near > least else -1.0
        away = _nearest(other, asked[row], axis, circumference, near, below)
        if away < below:
            count += 1.0
        elif away <= near:
            count += 0.5
        if count >= enough:
            break
    return count
