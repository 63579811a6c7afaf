"""List all products by name: analyses and figures in groups, with the run that each of them needs."""

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
    groups
        By title of a group and by name: the module of `pipeline.products` that declares the product, under its name
        in capital letters, and the words on the run that it needs; no words for a product that takes any steady run.
        Products in the group without a title are not listed.

    Attributes
    ----------
    groups : dict
        By title and by name: the words on the run.
    """

    def __init__(self, groups: Mapping[str, Mapping[str, tuple[str, str]]]) -> None:
        self.groups = {
            title: {name: needs for name, (_, needs) in group.items()} for title, group in groups.items() if title
        }
        self._modules = {name: module for group in groups.values() for name, (module, _) in group.items()}

    def __getitem__(self, name: str) -> P:
        product: P = resolve_name(f"pipeline.products.{self._modules[name]}:{name.upper()}")
        return product

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules)

    def __len__(self) -> int:
        return len(self._modules)


_POINT = "one parameter point (--at)"
_ONE, _TWO = "one swept parameter (--at chooses values of others)", "two swept parameters"
_NOISE, _DRIFT = "a run with [noise]", "a run with [drift]"
_ROTATION, _EXPONENTS = "the product rotation", "the product lyapunov"

CELL_PRODUCTS: Registry[CellProduct] = Registry({"": {n: (n, "") for n in ("lyapunov", "extremes", "rotation")}})

ANALYSES: Registry[Analysis] = Registry(
    {
        "Attractors, of any run without noise and drift": {
            "attractors": ("attractors", ""),
            "settling": ("attractors", ""),
            "hysteresis": ("attractors", "a continuation in both directions"),
        },
        "Basins and shocks": {
            "basins": ("basins", "a sweep; all numbers but fractions need starts on a grid"),
            "resilience": ("resilience", "a sweep"),
            "edge": ("resilience", "a sweep, and " + _POINT),
            "transfer": ("transfer", "a sweep"),
            "overlaps": ("tipping", "a sweep along the parameter that changes"),
        },
        "Chaos and spectra": {
            "chaos": ("chaos", ""),
            "dimension": ("chaos", ""),
            "spectrum": ("spectrum", ""),
            "series": ("spectrum", "one motion (--at, --attractor or --cell)"),
        },
        "Orbits and branches, stable or not": {
            "branches": ("branches", ""),
            "events": ("events", "a sweep or continuation along one parameter"),
            "response": ("response", ""),
            "backbone": ("backbone", ""),
            "bands": ("branches", "a posterior of magpend identify"),
            "sensitivities": ("branches", ""),
            "curves": ("branches", ""),
            "orbits": ("branches", _POINT),
            "tongues": ("branches", _ROTATION),
            "manifolds": ("manifolds", _POINT),
            "tangency": ("manifolds", _POINT + ", and two states"),
        },
        "Moving parameters": {"tipping": ("tipping", _DRIFT), "delay": ("tipping", _DRIFT)},
        "Noise": {"escapes": ("noise", _NOISE), "density": ("noise", _NOISE)},
        "": {"identified": ("attractors", "")},
    }
)

COMMANDS = tuple(name for group in ANALYSES.groups.values() for name in group)
"""Analyses that have a table, and therefore a command."""

_FIGURES = {
    "Sections and attractors": {
        "bifurcation": _ONE,
        "section": _POINT,
        "attractors": _ONE,
        "gallery": _POINT,
        "regimes": _TWO,
    },
    "Basins and shocks": {
        "basins": "a sweep with starts on a grid, and " + _POINT,
        "fractions": _ONE,
        "resilience": "a sweep, and at most " + _ONE,
        "edge": "a sweep, and " + _POINT,
        "transfer": "a sweep, and " + _POINT,
    },
    "Chaos and spectra": {
        "lyapunov": f"{_EXPONENTS}, and {_ONE}; two with --map",
        "convergence": f"{_EXPONENTS}, and {_POINT}",
        "dimension": _POINT,
        "spectrum": f"{_POINT}, or a cell",
        "waterfall": _ONE,
        "series": f"one attractor of {_POINT}, or a cell",
    },
    "Orbits and branches, stable or not": {
        "branches": "",
        "multipliers": "",
        "sensitivities": "",
        "curves": "",
        "genealogy": _ONE,
        "response": "",
        "backbone": "",
        "rotation": f"{_ROTATION}, and {_ONE}, or {_TWO}",
        "tongues": f"{_ROTATION}, and {_ONE}",
        "manifolds": _POINT,
    },
    "Moving parameters": {"drift": _DRIFT},
    "Noise": {"escapes": _NOISE, "density": _NOISE},
}

FIGURES: Registry[Figure] = Registry(
    {title: {name: ("figures", needs) for name, needs in group.items()} for title, group in _FIGURES.items()}
)
