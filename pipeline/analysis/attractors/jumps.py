"""Add instants to motions wherever a state jumps, as on a relaxation oscillation: equal times miss its peaks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np


def with_jumps(
    fly: Callable[[list[int], list[np.ndarray]], Sequence[np.ndarray]], times: list[np.ndarray], sizes: Sequence[float]
) -> list[np.ndarray]:
    """Return the states of motions at the instants `times`, after instants have been added where a state jumps.

    Parameters
    ----------
    fly
        Takes the numbers of some motions and the instants of each; returns the states of each, (n, n_states).
    times
        Rising instants of each motion. Instants are added in place.
    sizes
        Units of the states.
    """
    rounds = 5  # a jump that takes 32**-5 of an interval is resolved
    rows = list(range(len(times)))
    paths = list(fly(rows, times))
    for _ in range(rounds):
        coarse = {row: _is_coarse(paths[row], np.asarray(sizes)) for row in rows}
        rows = [row for row in rows if coarse[row].any()]
        if not rows:
            break
        for row in rows:
            times[row] = _divided(times[row], coarse[row])
        for row, path in zip(rows, fly(rows, [times[row] for row in rows]), strict=True):
            paths[row] = path
    return paths


def _is_coarse(path: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Tell the intervals between states along a path (n, n_states) on which a state changes by much of its range, or
    that adjoin its least or its largest value and are not flat.
    """
    much, flat = 1 / 16, 1 / 64  # shares of the range; a parabola is at most a quarter of the second above its samples
    rounding = 1e-6  # range, relative to the largest value, that may be errors of the steps
    least = rounding * np.maximum(np.abs(path).max(axis=0), sizes)
    share = np.abs(np.diff(path, axis=0)) / np.maximum(np.ptp(path, axis=0), least)
    coarse = (share > much).any(axis=1)
    for k, column in enumerate(path.T):
        for at in (int(column.argmin()), int(column.argmax())):
            beside = slice(max(at - 1, 0), at + 1)
            coarse[beside] |= share[beside, k] > flat
    return np.asarray(coarse)


def _divided(times: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return instants with others between them in the intervals that are chosen."""
    parts = 32
    begins, lengths = times[:-1][where], np.diff(times)[where]
    between = begins[:, None] + lengths[:, None] * (np.arange(1, parts) / parts)
    return np.sort(np.append(times, between))
