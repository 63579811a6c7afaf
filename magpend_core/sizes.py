"""Define the sizes and names shared by the engine, the models and the pipeline."""

from __future__ import annotations

import math

MAX_STATES = 64
"""Largest number of states of a system with tangent vectors; a model as text with more has no Jacobian."""

MOST_STATES = 1024
"""Largest number of states of a model as text."""

WRITTEN_OUT = 6
"""Largest number of states of a system whose products of Jacobian and tangent vectors are written out.

For a larger system the engine loops over the vectors (see `engine.tangents`), and the Jacobian of a model as
text leaves out its zeros. The code then grows with the number of entries, not with that of entries times
vectors.
"""

LEVEL = "section_value"
"""Name of the level among the parameters of a system with such a section; the last of them."""


def too_many_states(name: str, n_states: int) -> str | None:
    """Return an error sentence if a system has too many states for tangent vectors, else None."""
    if n_states <= MAX_STATES:
        return None
    return (
        f"{name} has {n_states} states; attractors, branches, equilibria, multipliers and Lyapunov exponents need "
        f"tangents, which are computed for at most {MAX_STATES} states. Cells, quantities and trajectories need none."
    )


NOISE_PREFIX = "noise_"
"""The strength of white noise on the state x is the parameter noise_x."""

REALIZATION = "realization"
"""Parameter without effect on the equations: cells that differ in it alone have independent noise."""


NATURAL = (0.1, 100.0)
"""A size between these counts as 1: tolerances are made for it, and most systems keep their plain units."""


def natural_size(low: float, high: float | None = None) -> float:
    """Return the power of ten nearest to a size; 1 if the size is within `NATURAL`, or not known.

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
    if not (0.0 < low <= high < math.inf) or (high >= NATURAL[0] and low <= NATURAL[1]):
        return 1.0
    return float(f"1e{round(0.5 * (math.log10(low) + math.log10(high)))}")
