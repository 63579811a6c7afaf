"""Define `Plots`, the figures of a run or a cube as methods."""

from __future__ import annotations

from types import MethodType
from typing import TYPE_CHECKING, Any

from magpend._methods import figure
from magpend._names import Figures
from pipeline.products.registry import FIGURES
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr


class Plots(Figures):
    """The figures of a run or a cube, by name; each method draws one and returns its axes.

    Parameters
    ----------
    source
        An opened run, or a cube.
    """

    def __init__(self, source: RunDirectory | xr.Dataset) -> None:
        self._source = source

    if not TYPE_CHECKING:  # which knows no figures of other packages

        def __getattr__(self, name: str) -> Any:
            if name not in FIGURES:
                raise AttributeError(f"no figure {name!r}; {self}")
            return MethodType(figure(name), self)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *FIGURES})

    def __repr__(self) -> str:
        return f"figures: {', '.join(FIGURES)}"
