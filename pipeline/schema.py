"""The one registry of the cube's variables. A new variable is a new line in `VARIABLES`.

Every variable has the cell dims of the run (swept parameters, initial conditions or branches) first,
then its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magpend_core.status import Status

FORMAT = 1
"""Version of the run directory's layout."""

REFINEMENT = 1
"""Version of what is inferred in refined grids (`pipeline.refinement`); part of such a run's identity."""

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
        return {"units": self.units, "long_name": self.long_name, **self.attrs}

    def itemsize(self, sizes: Mapping[str, int]) -> int:
        """Bytes per cell, uncompressed."""
        return np.dtype(self.dtype).itemsize * math.prod(sizes[d] for d in self.own_dims)


def _status_attrs() -> dict[str, Any]:
    return {
        "flag_values": [int(s) for s in Status],
        "flag_meanings": " ".join(s.name.lower() for s in Status),
        "comment": "; ".join(f"{int(s)} {s.name.lower()}: {s.sentence}" for s in Status),
    }


VARIABLES = (
    Variable(
        "section", ("period_index", "state"), "float64", math.nan, "rad, rad, rad/s, rad/s",
        "state at the drive's rising edge, angles wrapped to (-pi, pi]",
    ),
    Variable("turns", ("link",), "int32", 0, "1", "full turns of the link over the kept periods"),
    Variable("status", (), "int8", int(Status.PENDING), "1", "what became of the cell", _status_attrs()),
    Variable("orbit_period", (), "int16", 0, "1", "period of the closed orbit [drive periods]; 0: none"),
    Variable("n_periods", (), "int32", 0, "1", "drive periods integrated in all"),
    Variable("n_steps", (), "int32", 0, "1", "accepted integration steps"),
    Variable("n_rejected", (), "int32", 0, "1", "rejected integration steps"),
)  # fmt: skip


def own_sizes(n_keep: int) -> dict[str, int]:
    """Sizes of the dims that are not cell dims."""
    return {"period_index": n_keep, "state": len(STATES), "link": len(LINKS)}
