"""Check which Runge-Kutta methods a run can use."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.products.product import Options
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.tables import Integration


def method_problems(integration: Integration | None, products: Mapping[str, Options], is_recorded: bool) -> list[str]:
    """Return the problems of `integration.method`: products that interpolate within steps need the method of order
    5.
    """
    if integration is None or integration.method == "dopri5":
        return []
    inside = [f"products.{n} looks" for n, o in products.items() if CELL_PRODUCTS[n].watches(o)]
    inside += ["a recorded drive has edges"] * is_recorded
    key = f'integration.method = "{integration.method}"'
    return [f'{key}: {what} within steps; drop one of the two, or set method = "dopri5".' for what in inside]
