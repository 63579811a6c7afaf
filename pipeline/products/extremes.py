"""Declare the product ``extremes``: minimum, maximum and mean of quantities over each stored drive period."""

from __future__ import annotations

import math
from typing import Any

from pipeline.products.product import CellProduct, Options, Variable, option

KINDS = ("min", "max", "mean")


class ExtremesOptions(Options):
    """Options of the product ``extremes`` in a specification's table ``[products]``."""

    quantities: tuple[str, ...] = option(
        help="Names of quantities and states of the model, such as an energy.", min_length=1, strict=False
    )


def _variables(options: ExtremesOptions, model: Any) -> tuple[Variable, ...]:
    name = "least and largest value and mean of the quantity over the drive period that ends at the section"
    return (Variable("extremes", ("period_index", "quantity", "extreme"), "float64", math.nan, "", name),)


def _sizes(options: ExtremesOptions, model: Any) -> dict[str, int]:
    return {"quantity": len(options.quantities), "extreme": len(KINDS)}


def _settled(options: ExtremesOptions, model: Any) -> ExtremesOptions:
    known = (*model.state_names, *(q.name for q in model.quantities))
    from magpend_core.models.parameters import near_names

    problems = [
        f"{name!r} is not a quantity of {model.name}; {near_names(name, known, 'names')}"
        for name in options.quantities
        if name not in known
    ]
    problems += [
        f"{name!r} is given twice; keep one."
        for name in dict.fromkeys(options.quantities)
        if options.quantities.count(name) > 1
    ]
    if problems:
        raise ValueError(f"quantities: {' '.join(problems)}")
    return options


def _names(options: ExtremesOptions, model: Any) -> dict[str, Any]:
    return {"quantity": options.quantities, "extreme": KINDS}


def _cost(options: ExtremesOptions) -> float:
    return 0.0


def _watched(options: ExtremesOptions) -> tuple[str, ...]:
    return options.quantities


EXTREMES = CellProduct(
    "extremes",
    "Least and largest value and mean of named quantities over each kept drive period.",
    ExtremesOptions,
    _variables,
    _sizes,
    _cost,
    "pipeline.compute.extremes:extremes",
    settle=_settled,
    coordinates=_names,
    watches=_watched,
    follows_motion=True,
)
