"""The variables that every cube has, and those of its products, which stand in `pipeline.products`.

Every variable has the cell dims of the run (swept parameters, initial conditions or branches) first,
then its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from magpend_core.models.model import Model
from magpend_core.status import Status
from pipeline.products.product import Options
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.products.variable import Variable, flag_attrs

FORMAT = 2
"""Version of the run directory's layout."""

REFINEMENT = 1
"""Version of what is inferred in refined grids (`pipeline.compute.refinement`); part of their identity."""


def base_variables(model: Model) -> tuple[Variable, ...]:
    """Return the variables that every cube of a model has, in order."""
    wrapped = ", angles wrapped to (-pi, pi]" if model.angles else ""
    section = Variable(
        "section", ("period_index", "state"), "float64", math.nan, "", f"state at {model.section}{wrapped}",
        {"comment": "units of the components: see state_units"},
    )  # fmt: skip
    turns = Variable("turns", (model.angle_dim,), "int32", 0, "1", "full turns over the kept periods")
    return (section, *([turns] if model.angles else []), *COUNTS)


COUNTS = (
    Variable("status", (), "int8", int(Status.PENDING), "1", "what became of the cell", flag_attrs(Status)),
    Variable("orbit_period", (), "int16", 0, "1", "period of the closed orbit [drive periods]; 0: none"),
    Variable("n_periods", (), "int32", 0, "1", "drive periods integrated in all"),
    Variable("n_steps", (), "int32", 0, "1", "accepted integration steps"),
    Variable("n_rejected", (), "int32", 0, "1", "rejected integration steps"),
)  # fmt: skip


def variables_of(model: Model, products: Mapping[str, Options]) -> tuple[Variable, ...]:
    """Return the variables of a cube with these products."""
    own = (CELL_PRODUCTS[name].variables(options, model) for name, options in products.items())
    return (*base_variables(model), *(variable for variables in own for variable in variables))


def sizes_of(model: Model, products: Mapping[str, Options], n_keep: int) -> dict[str, int]:
    """Return the sizes of the dims that are not cell dims."""
    sizes = {"period_index": n_keep, "state": len(model.states), model.angle_dim: len(model.angles)}
    for name, options in products.items():
        sizes |= CELL_PRODUCTS[name].sizes(options, model)
    return sizes
