"""Order rows of numbers so that their last digits, which differ between processors, do not decide."""

from __future__ import annotations

import numpy as np

SAME_DIGITS = 1e-6
"""Gap below which two values count as equal in an order: far above the errors of polished orbits."""


def canonical_order(rows: np.ndarray, within: float = SAME_DIGITS) -> np.ndarray:
    """Return the lexicographic order of rows (n, column) in which values without a gap between them count as equal.

    Values are sorted, and a gap of more than `within` separates them. Rounding them to a grid would not do: a value at
    the edge of a cell falls to either side. Rows that are equal in all columns stay in the given order.
    """
    rank, n = np.zeros(len(rows), np.int64), len(rows)
    for column in np.nan_to_num(np.asarray(rows, np.float64), nan=np.inf).T:
        if n < 2 or rank.max() == n - 1:
            break
        order = np.lexsort((column, rank))
        value, group = column[order], rank[order]
        with np.errstate(invalid="ignore"):  # infinity less infinity: equal
            new = (np.diff(value) > within) | (np.diff(group) > 0)
        rank[order] = np.concatenate([[0], np.cumsum(new)])
    return np.argsort(rank, kind="stable")
