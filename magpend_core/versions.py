"""Number what decides the bits of results. A number is raised when results change on purpose; golden bits tell when.

Every run names these numbers, and is completed only by code with the same ones. So code may be moved, renamed and
rewritten as long as the results stay the same to the last bit (``tests/pipeline/runs/test_golden_bits.py``).
"""

from __future__ import annotations

ENGINE = 1
"""Number of the results of the numerical core: integration, events, noise, exponents, orbits."""

TEXT = 1
"""Number of the translation of text models into functions for the engine."""

IMPACTS = 2
"""Number of the results of text models with impacts. Since 2 an impact that a trajectory passes happens once."""

DRIFT = 1
"""Number of the motion of parameters."""

_FIRST = {
    "double-pendulum": "26766d29f9e3b32c",
    "drift": "8e433ddffba31df2",
    "duffing": "50abb2a3528c7140",
    **{f"pendulum{end}": "06eb098c8fddee0a" for end in ("", "-sine", "-dipole", "-dipole-sine", "-free", "-free-sine")},
    "text": "1e4ee970cd2a921c",
}


def written(name: str, number: int) -> str:
    """Return how a run writes a version that is part of its model's digest.

    A first version is written as the digest of source code that stood there before versions were numbers, so that
    runs of that time are completed.
    """
    return _FIRST[name] if number == 1 and name in _FIRST else f"{name} {number}"
