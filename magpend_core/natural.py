"""Choose the sizes that count as 1: powers of ten, and 1 itself for everything of the order of one."""

from __future__ import annotations

import math

LEAST, MOST = 0.1, 100.0
"""A size between these counts as 1: tolerances are made for it, and most systems keep their plain units."""


def natural_size(low: float, high: float | None = None) -> float:
    """Return the power of ten nearest to a size; 1 if the size is between `LEAST` and `MOST`, or not known.

    Parameters
    ----------
    low
        The size, 0 or more.
    high
        If the size is only known to be between `low` and this, 1 is returned where it can be 1, else the power of ten
        nearest to the middle of both on a logarithmic scale.

    Examples
    --------
    >>> natural_size(3e-9), natural_size(2.0), natural_size(4e8)
    (1e-09, 1.0, 1000000000.0)
    """
    high = low if high is None else high
    if not (0.0 < low <= high < math.inf) or (high >= LEAST and low <= MOST):
        return 1.0
    return float(f"1e{round(0.5 * (math.log10(low) + math.log10(high)))}")
