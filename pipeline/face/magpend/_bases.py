"""Define what the generated methods of runs and figures call."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.store.run import Run as StoredRun

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

Panels = np.ndarray[tuple[int], np.dtype[np.object_]]
"""The axes of several panels, in the order in which they are drawn."""


def options_in(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options among the local names of a generated method."""
    aside = ("self", "echo", "workers", "scheduler", "ax", "figure")
    return {name: dict(v) if isinstance(v, Mapping) else v for name, v in given.items() if name not in aside}


class AnalysingRun(StoredRun):
    """An opened run that computes analyses by name."""

    def _analysed(self, name: str, given: Mapping[str, Any]) -> xr.Dataset:
        from pipeline.products.registry import ANALYSES
        from pipeline.runs.arguments import options_in_errors
        from pipeline.runs.derive import derive

        with options_in_errors(ANALYSES[name].options) if name in ANALYSES else nullcontext():
            places = {key: given[key] for key in ("echo", "workers", "scheduler") if key in given}
            return derive(self, name, options_in(given), **places)


class Drawing:
    """Draws figures by name, of an opened run or of a cube.

    Parameters
    ----------
    source
        An opened run, or a cube.
    """

    def __init__(self, source: StoredRun | xr.Dataset) -> None:
        self._source = source

    def __repr__(self) -> str:
        from pipeline.products.registry import FIGURES

        return f"figures: {', '.join(FIGURES)}"

    def _one(self, name: str, given: Mapping[str, Any]) -> Axes:
        (ax,) = self._drawn(name, given)
        return ax

    def _several(self, name: str, given: Mapping[str, Any]) -> Panels:
        drawn = self._drawn(name, given)
        panels = np.empty(len(drawn), object)
        panels[:] = drawn
        return panels

    def _either(self, name: str, given: Mapping[str, Any]) -> Any:
        panels = self._several(name, given)
        return panels[0] if panels.size == 1 else panels

    def _drawn(self, name: str, given: Mapping[str, Any]) -> list[Axes]:
        from pipeline.products.registry import FIGURES
        from pipeline.runs.arguments import options_in_errors
        from pipeline.runs.drawing import draw_panels

        places = {key: given[key] for key in ("ax", "figure", "echo")}
        with options_in_errors(FIGURES[name].options):
            return draw_panels(self._source, name, options_in(given), **places)
