"""The variables that every cube has. A new one is a new line in `VARIABLES`; those that a specification
has to ask for stand with their product, in `pipeline.products`.

Every variable has the cell dims of the run (swept parameters, initial conditions or branches) first,
then its own.
"""

from __future__ import annotations

import math

from magpend_core.status import Status
from pipeline.products.lyapunov import LYAPUNOV_VARIABLES as LYAPUNOV_VARIABLES
from pipeline.products.lyapunov import LyapunovFlag as LyapunovFlag
from pipeline.products.variable import Variable, flag_attrs

FORMAT = 1
"""Version of the run directory's layout."""

REFINEMENT = 1
"""Version of what is inferred in refined grids (`pipeline.compute.refinement`); part of their identity."""

STATES = ("psi1", "psi2", "psi1_dot", "psi2_dot")
STATE_UNITS = ("rad", "rad", "rad/s", "rad/s")
LINKS = ("psi1", "psi2")


VARIABLES = (
    Variable(
        "section", ("period_index", "state"), "float64", math.nan, "rad, rad, rad/s, rad/s",
        "state at the drive's rising edge, angles wrapped to (-pi, pi]",
    ),
    Variable("turns", ("link",), "int32", 0, "1", "full turns of the link over the kept periods"),
    Variable("status", (), "int8", int(Status.PENDING), "1", "what became of the cell", flag_attrs(Status)),
    Variable("orbit_period", (), "int16", 0, "1", "period of the closed orbit [drive periods]; 0: none"),
    Variable("n_periods", (), "int32", 0, "1", "drive periods integrated in all"),
    Variable("n_steps", (), "int32", 0, "1", "accepted integration steps"),
    Variable("n_rejected", (), "int32", 0, "1", "rejected integration steps"),
)  # fmt: skip


def own_sizes(n_keep: int, n_exponents: int = 0, n_blocks: int = 0) -> dict[str, int]:
    """Sizes of the dims that are not cell dims."""
    return {
        "period_index": n_keep,
        "state": len(STATES),
        "link": len(LINKS),
        "exponent": n_exponents,
        "block": n_blocks,
    }
