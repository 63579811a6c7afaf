"""List all products by name, with the modules that declare them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pkgutil import resolve_name
from typing import TypeVar

from pipeline.products.product import Analysis, CellProduct, Figure

P = TypeVar("P", CellProduct, Analysis, Figure)


class Registry(Mapping[str, P]):
    """Mapping from names to products; each product is imported when it is first used.

    Parameters
    ----------
    kind
        Word for the products, for messages.
    places
        ``"module:object"`` by name.
    """

    def __init__(self, kind: str, places: Mapping[str, str]) -> None:
        self.kind, self._places = kind, places

    def __getitem__(self, name: str) -> P:
        product: P = resolve_name(self._places[name])
        return product

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


CELL_PRODUCTS: Registry[CellProduct] = Registry(
    "product",
    {
        "lyapunov": "pipeline.products.lyapunov:LYAPUNOV",
        "extremes": "pipeline.products.extremes:EXTREMES",
        "rotation": "pipeline.products.rotation:ROTATION",
    },
)

ANALYSES: Registry[Analysis] = Registry(
    "analysis",
    {
        "identified": "pipeline.products.attractors:IDENTIFIED",
        "attractors": "pipeline.products.attractors:ATTRACTORS",
        "basins": "pipeline.products.basins:BASINS",
        "hysteresis": "pipeline.products.attractors:HYSTERESIS",
        "settling": "pipeline.products.attractors:SETTLING",
        "chaos": "pipeline.products.chaos:CHAOS",
        "dimension": "pipeline.products.chaos:DIMENSION",
        "branches": "pipeline.products.branches:BRANCHES",
        "bands": "pipeline.products.branches:BANDS",
        "curves": "pipeline.products.branches:CURVES",
        "orbits": "pipeline.products.branches:ORBITS",
        "tongues": "pipeline.products.tongues:TONGUES",
        "manifolds": "pipeline.products.manifolds:MANIFOLDS",
        "tangency": "pipeline.products.manifolds:TANGENCY",
        "tipping": "pipeline.products.tipping:TIPPING",
        "delay": "pipeline.products.tipping:DELAY",
        "overlaps": "pipeline.products.tipping:OVERLAPS",
        "resilience": "pipeline.products.resilience:RESILIENCE",
        "edge": "pipeline.products.resilience:EDGE",
        "escapes": "pipeline.products.noise:ESCAPES",
        "density": "pipeline.products.noise:DENSITY",
    },
)

COMMANDS = tuple(name for name in ANALYSES if name != "identified")
"""Analyses that have a table, and therefore a command."""

FIGURES: Registry[Figure] = Registry(
    "figure",
    {
        name: f"pipeline.products.figures:{name.upper()}"
        for name in (
            "bifurcation",
            "section",
            "attractors",
            "gallery",
            "basins",
            "fractions",
            "regimes",
            "lyapunov",
            "convergence",
            "dimension",
            "branches",
            "multipliers",
            "curves",
            "rotation",
            "tongues",
            "manifolds",
            "drift",
            "resilience",
            "edge",
            "escapes",
            "density",
        )
    },
)
