"""The one registry of the cube's variables. A new variable is a new line in `VARIABLES`, one that a
specification has to ask for in `LYAPUNOV_VARIABLES`.

Every variable has the cell dims of the run (swept parameters, initial conditions or branches) first,
then its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from magpend_core.status import Status

FORMAT = 2
"""Version of the run directory's layout."""

REFINEMENT = 1
"""Version of what is inferred in refined grids (`pipeline.compute.refinement`); part of their identity."""

STATES = ("psi1", "psi2", "psi1_dot", "psi2_dot")
STATE_UNITS = ("rad", "rad", "rad/s", "rad/s")
LINKS = ("psi1", "psi2")


@dataclass(frozen=True)
class Variable:
    """One variable of the cube.

    Attributes
    ----------
    name : str
    own_dims : tuple of str
        Dims after the cell dims.
    dtype : str
        In the store.
    fill : float or int
        What a pending cell reads as.
    units : str
        Empty where the components have units of their own.
    long_name : str
    attrs : mapping
        Further attributes.
    """

    name: str
    own_dims: tuple[str, ...]
    dtype: str
    fill: float | int
    units: str
    long_name: str
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def attributes(self) -> dict[str, Any]:
        """All attributes as written to the store."""
        units = {"units": self.units} if self.units else {}
        return {**units, "long_name": self.long_name, **self.attrs}

    def itemsize(self, sizes: Mapping[str, int]) -> int:
        """Bytes per cell, uncompressed."""
        return np.dtype(self.dtype).itemsize * math.prod(sizes[d] for d in self.own_dims)


def _flag_attrs(codes: Any) -> dict[str, Any]:
    return {
        "flag_values": [int(s) for s in codes],
        "flag_meanings": " ".join(s.name.lower() for s in codes),
        "comment": "; ".join(f"{int(s)} {s.name.lower()}: {s.sentence}" for s in codes),
    }


VARIABLES = (
    Variable(
        "section", ("period_index", "state"), "float64", math.nan, "",
        "state at the drive's rising edge, angles wrapped to (-pi, pi]; units by component: state_units",
    ),
    Variable("turns", ("link",), "int32", 0, "1", "full turns of the link over the kept periods"),
    Variable("status", (), "int8", int(Status.PENDING), "1", "what became of the cell", _flag_attrs(Status)),
    Variable("orbit_period", (), "int16", 0, "1", "period of the closed orbit [drive periods]; 0: none"),
    Variable("n_periods", (), "int32", 0, "1", "drive periods integrated in all"),
    Variable("n_steps", (), "int32", 0, "1", "accepted integration steps"),
    Variable("n_rejected", (), "int32", 0, "1", "rejected integration steps"),
)  # fmt: skip


class LyapunovFlag(IntEnum):
    """How far a cell's Lyapunov exponents can be trusted."""

    ABSENT = 0
    GOOD = 1
    AUDIT_FAILED = 2
    UNRESOLVED = 3
    FAILED = 4

    @property
    def sentence(self) -> str:
        """What it means."""
        return _FLAG_SENTENCES[self]


_FLAG_SENTENCES = {
    LyapunovFlag.ABSENT: "pending, or the cell has no attractor to go on from",
    LyapunovFlag.GOOD: "no objection",
    LyapunovFlag.AUDIT_FAILED: "the exponents do not add up to the divergence; use a smaller rtol",
    LyapunovFlag.UNRESOLVED: "tangent vectors became parallel; only the first exponent is resolved",
    LyapunovFlag.FAILED: "the integration failed",
}

LYAPUNOV_VARIABLES = (
    Variable(
        "lyapunov", ("exponent",), "float64", math.nan, "1/s",
        "Lyapunov exponents per unit time, in falling order",
        {"comment": "divided by the frequency: per drive period. Plain averages; weighted Birkhoff averages "
         "where the orbit is closed"},
    ),
    Variable("lyapunov_stderr", ("exponent",), "float64", math.nan, "1/s", "standard error over the blocks"),
    Variable(
        "lyapunov_blocks", ("block", "exponent"), "float64", math.nan, "1/s",
        "mean growth rate in each block of drive periods",
    ),
    Variable("divergence", (), "float64", math.nan, "1/s", "time average of the flow's divergence"),
    Variable(
        "lyapunov_flag", (), "int8", int(LyapunovFlag.ABSENT), "1", "trust in the exponents",
        _flag_attrs(LyapunovFlag),
    ),
)  # fmt: skip
"""Variables of ``[products] lyapunov``."""


def own_sizes(n_keep: int, n_exponents: int = 0, n_blocks: int = 0) -> dict[str, int]:
    """Sizes of the dims that are not cell dims."""
    return {
        "period_index": n_keep,
        "state": len(STATES),
        "link": len(LINKS),
        "exponent": n_exponents,
        "block": n_blocks,
    }
