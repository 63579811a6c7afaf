"""Order rows of numbers so that their last digits, which differ between processors, do not decide."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

SAME_DIGITS = 1e-6
"""Gap below which two values count as equal in an order: far above the errors of polished orbits."""


def canonical_order(rows: np.ndarray) -> np.ndarray:
    """Return the lexicographic order of rows (n, column) in which values without a gap between them count as equal.

    Values are sorted, and a gap of more than `SAME_DIGITS` separates them. Rounding them to a grid would not do: a
    value at the edge of a cell falls to either side. Rows that are equal in all columns stay in the given order.
    """
    return order_of_columns(np.asarray(rows, np.float64).T, len(rows))


def order_of_columns(columns: Iterable[np.ndarray], n: int) -> np.ndarray:
    """Return the canonical order of `n` rows by their columns, of which no more are read than decide."""
    rank = np.zeros(n, np.int64)
    for column in columns:
        if n < 2 or rank.max() == n - 1:
            break
        values = np.nan_to_num(np.asarray(column, np.float64), nan=np.inf)
        order = np.lexsort((values, rank))
        value, group = values[order], rank[order]
        with np.errstate(invalid="ignore"):  # infinity less infinity: equal
            new = (np.diff(value) > SAME_DIGITS) | (np.diff(group) > 0)
        rank[order] = np.concatenate([[0], np.cumsum(new)])
    return np.argsort(rank, kind="stable")
