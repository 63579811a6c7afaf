"""List all products by name: analyses and figures in groups, with the run that each of them needs.

A line names the module that declares an analysis, its figure, or both: ``NAME`` in capital letters is the `Analysis`,
``NAME_FIGURE`` the `Figure`. Packages add theirs by entry points of the group ``magpend.analyses``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import TypeVar

from pipeline.products.product import Analysis, CellProduct, Figure

P = TypeVar("P", CellProduct, Analysis, Figure)


@dataclass(frozen=True)
class Line:
    """An analysis, its figure, or both: the declaring module, and the words on the run that each needs.

    There are no words for one that takes any steady run, and None stands for one that is not there.
    """

    module: str
    analysis: str | None = None
    figure: str | None = None


def _room(name: str) -> str:
    return f"pipeline.analysis.{name}.declaration"


_POINT = "one parameter point (--at)"
_ONE, _TWO = "one swept parameter (--at chooses values of others)", "two swept parameters"
_SWEEP, _NOISE, _DRIFT = "a sweep", "a run with [noise]", "a run with [drift]"
_AT_A_POINT = f"{_SWEEP}, and {_POINT}"
_ROTATION, _EXPONENTS = "the product rotation", "the product lyapunov"
_CYCLES = "a flow with a section"
_CELLS = "pipeline.products.diagrams"

_OWN: dict[str, dict[str, Line]] = {
    "Sections and attractors": {
        "bifurcation": Line(_CELLS, None, _ONE),
        "section": Line(_CELLS, None, _POINT),
        "attractors": Line(_room("attractors"), "", _ONE),
        "gallery": Line(_room("attractors"), None, _POINT),
        "regimes": Line(_room("basins"), None, _TWO),
        "settling": Line(_room("attractors"), ""),
        "hysteresis": Line(_room("attractors"), "a continuation in both directions"),
    },
    "Basins and shocks": {
        "basins": Line(
            _room("basins"),
            "a sweep; all numbers but fractions need starts on a grid",
            f"a sweep with starts on a grid, and {_POINT}",
        ),
        "fractions": Line(_room("basins"), None, _ONE),
        "resilience": Line(_room("resilience"), _SWEEP, f"{_SWEEP}, and at most {_ONE}"),
        "edge": Line(_room("resilience"), _AT_A_POINT, _AT_A_POINT),
        "transfer": Line(_room("transfer"), _SWEEP, _AT_A_POINT),
        "overlaps": Line(_room("tipping"), "a sweep along the parameter that changes"),
    },
    "Chaos and spectra": {
        "chaos": Line(_room("chaos"), ""),
        "lyapunov": Line(_room("chaos"), None, f"{_EXPONENTS}, and {_ONE}; two with --map"),
        "convergence": Line(_room("chaos"), None, f"{_EXPONENTS}, and {_POINT}"),
        "dimension": Line(_room("chaos"), "", _POINT),
        "spectrum": Line(_room("spectrum"), "", f"{_POINT}, or a cell"),
        "waterfall": Line(_room("spectrum"), None, _ONE),
        "series": Line(
            _room("series"), "one motion (--at, --attractor or --cell)", f"one attractor of {_POINT}, or a cell"
        ),
    },
    "Orbits and branches, stable or not": {
        "branches": Line(_room("branches"), "", ""),
        "multipliers": Line(_room("branches"), None, ""),
        "phase": Line(_room("phase"), _CYCLES, _CYCLES),
        "isochrones": Line(_room("phase"), None, f"{_CYCLES} and two states, and {_POINT}"),
        "events": Line(_room("events"), "a sweep or continuation along one parameter"),
        "genealogy": Line(_room("events"), None, _ONE),
        "response": Line(_room("response"), "", ""),
        "backbone": Line(_room("response"), "", ""),
        "bands": Line(_room("branches"), "a posterior of magpend identify"),
        "sensitivities": Line(_room("branches"), "", ""),
        "curves": Line(_room("branches"), "", ""),
        "atlas": Line(_room("atlas"), f"a sweep over {_TWO}", f"a sweep over {_TWO}"),
        "orbits": Line(_room("branches"), _POINT),
        "rotation": Line(_room("branches"), None, f"{_ROTATION}, and {_ONE}, or {_TWO}"),
        "tongues": Line(_room("branches"), _ROTATION, f"{_ROTATION}, and {_ONE}"),
        "manifolds": Line(_room("manifolds"), _POINT, _POINT),
        "tangency": Line(_room("manifolds"), f"{_POINT}, and two states"),
    },
    "Moving parameters": {
        "drift": Line(_room("tipping"), None, _DRIFT),
        "tipping": Line(_room("tipping"), _DRIFT, f"{_DRIFT}, and {_ONE}, or {_TWO}"),
        "delay": Line(_room("tipping"), _DRIFT),
    },
    "Noise": {"escapes": Line(_room("noise"), _NOISE, _NOISE), "density": Line(_room("noise"), _NOISE, _NOISE)},
}

OWN = tuple(name for group in _OWN.values() for name in group)
"""Names of the analyses and figures of magpend itself."""

_ENDS = {"analysis": "", "figure": "_FIGURE"}
"""Ends of the names of declarations, by their kind."""

Groups = dict[str, dict[str, tuple[str, str]]]
"""By title of a group and by name: the place of a product, ``module:object``, and the words on the run that it needs.
Products in the group without a title are not listed.
"""


@cache
def _of_other_packages() -> dict[str, Line]:
    found: dict[str, Line] = {}
    for entry in entry_points(group="magpend.analyses"):
        told = f"the analysis {entry.name} of another package ({entry.value}) is left out"
        if entry.name in found or entry.name in OWN:
            warnings.warn(f"{told}: its name is taken; rename it.", stacklevel=2)
            continue
        try:
            module = entry.load()
        except Exception as error:  # whatever is wrong with it, magpend goes on
            warnings.warn(f"{told}: it cannot be imported ({type(error).__name__}: {error}).", stacklevel=2)
            continue
        kinds = {kind: "" for kind, end in _ENDS.items() if hasattr(module, entry.name.upper() + end)}
        found[entry.name] = Line(entry.value, **kinds)
    return found


def _groups(kind: str) -> Groups:
    """Return the analyses, or the figures, with those of other packages."""
    groups: Groups = {}
    for title, lines in {**_OWN, "Of other packages": _of_other_packages()}.items():
        for name, line in lines.items():
            if (words := getattr(line, kind)) is not None:
                place = f"{line.module}:{name.upper()}{_ENDS[kind]}"
                groups.setdefault(title, {})[name] = place, words
    return groups


class Registry(Mapping[str, P]):
    """Mapping from names to products; each product is imported when it is first used.

    Parameters
    ----------
    find
        Function that returns the products.
    """

    def __init__(self, find: Callable[[], Groups]) -> None:
        self._find = find

    @property
    def groups(self) -> dict[str, dict[str, str]]:
        """Words on the runs that listed products need, by title and by name."""
        titled = {title: group for title, group in self._find().items() if title}
        return {title: {name: words for name, (_, words) in group.items()} for title, group in titled.items()}

    @property
    def listed(self) -> tuple[str, ...]:
        """Names of the listed products, such as the analyses that have a table and therefore a command."""
        return tuple(name for group in self.groups.values() for name in group)

    def _places(self) -> dict[str, str]:
        return {name: place for group in self._find().values() for name, (place, _) in group.items()}

    def __getitem__(self, name: str) -> P:
        product: P = resolve_name(self._places()[name])
        return product

    def __iter__(self) -> Iterator[str]:
        return iter(self._places())

    def __len__(self) -> int:
        return len(self._places())


_CELLS_OWN: Groups = {"": {n: (f"pipeline.products.{n}:{n.upper()}", "") for n in ("lyapunov", "extremes", "rotation")}}
_FOR_OTHERS: Groups = {
    "": {
        "identified": (f"{_room('attractors')}:IDENTIFIED", ""),
        "orbit_ends": (f"{_room('atlas')}:ORBIT_ENDS", ""),
        "set_ends": (f"{_room('atlas')}:SET_ENDS", ""),
        "further": (f"{_room('atlas')}:FURTHER", ""),
    }
}

CELL_PRODUCTS: Registry[CellProduct] = Registry(lambda: _CELLS_OWN)
ANALYSES: Registry[Analysis] = Registry(lambda: {**_groups("analysis"), **_FOR_OTHERS})
FIGURES: Registry[Figure] = Registry(lambda: _groups("figure"))
