"""Define the sizes and names shared by the engine, the models and the pipeline."""

from __future__ import annotations

MAX_STATES = 64
"""Largest number of states of a model as text, and of any system with tangent vectors."""

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
        f"{name} has {n_states} states; Lyapunov exponents, multipliers and orbits are computed for at most "
        f"{MAX_STATES}."
    )


NOISE_PREFIX = "noise_"
"""The strength of white noise on the state x is the parameter noise_x."""

REALIZATION = "realization"
"""Parameter without effect on the equations: cells that differ in it alone have independent noise."""
