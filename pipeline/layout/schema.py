"""Define the variables of a run's result cube: those of every cube, and those that the run's products add.

Every variable has the cell dims of the run first (swept parameters, initial conditions or branches), then its
own dims. `pipeline.products` declares the variables of products.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from magpend_core.models.model import Model
from magpend_core.status import Status
from pipeline.products.product import Options, Variable, flag_attrs
from pipeline.products.registry import CELL_PRODUCTS

FORMAT = 3
"""Version of the run directory's layout."""

REFINEMENT = 1
"""Version of the inference in refined grids (`pipeline.compute.refinement`), part of their identity."""


def base_variables(model: Model) -> tuple[Variable, ...]:
    """Return the variables that every result cube of a model has, in order."""
    wrapped = ", angles wrapped to (-pi, pi]" if model.angles else ""
    units = {"comment": "units of the components: see state_units"}
    section = Variable(
        "section", ("period_index", "state"), "float64", math.nan, "", f"state at {model.section}{wrapped}", units
    )
    turns = Variable("turns", (model.angle_dim,), "int32", 0, "1", f"full turns over the kept {model.clock.periods}")
    flow = (RETURN_TIME, replace(REST_STATE, attrs=units)) if model.crossing is not None else ()
    noise = (STRONG_ERROR,) if model.disturbance is not None else ()
    return (section, *([turns] if model.angles else []), *_counts(model.clock.periods), *flow, *noise)


RETURN_TIME = Variable("return_time", ("period_index",), "float64", math.nan, "s", "time since the crossing before")
REST_STATE = Variable(
    "rest_state", ("state",), "float64", math.nan, "", "state in which a cell that does not return was left"
)
"""Additional variables of cubes whose sections are taken at crossings."""

STRONG_ERROR = Variable(
    "strong_error",
    (),
    "float64",
    math.nan,
    "1",
    "largest change of the last period's end when its steps are halved on the same path, in units of the scales",
)
"""Additional variable of cubes with noise."""


def _counts(periods: str) -> tuple[Variable, ...]:
    codes = flag_attrs(Status)
    return (
        Variable("status", (), "int8", int(Status.PENDING), "1", "what became of the cell", codes),
        Variable("orbit_period", (), "int16", 0, "1", f"period of the closed orbit [{periods}]; 0: none"),
        Variable("n_periods", (), "int32", 0, "1", f"{periods} integrated in all"),
        Variable("n_steps", (), "int32", 0, "1", "accepted integration steps"),
        Variable("n_rejected", (), "int32", 0, "1", "rejected integration steps"),
        Variable("step_size", (), "float64", math.nan, "s", "step that would come next; NaN: it failed"),
    )


def variables_of(model: Model, products: Mapping[str, Options]) -> tuple[Variable, ...]:
    """Return the variables of the result cube for a model and given products."""
    own = (CELL_PRODUCTS[name].variables(options, model) for name, options in products.items())
    return (*base_variables(model), *(variable for variables in own for variable in variables))


def sizes_of(model: Model, products: Mapping[str, Options], n_keep: int) -> dict[str, int]:
    """Return the sizes of the dims that variables have besides the dims of the cells."""
    sizes = {"period_index": n_keep, "state": len(model.states), model.angle_dim: len(model.angles)}
    for name, options in products.items():
        sizes |= CELL_PRODUCTS[name].sizes(options, model)
    return sizes
