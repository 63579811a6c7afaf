"""Draw the figures of a run by name, as ``magpend plot`` does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipeline.products.product import FigureOptions
from pipeline.products.registry import FIGURES
from pipeline.runs.derive import AnalysedRun, Echo, Source, prepared, refused
from pipeline.specification.problems import SpecError, unknown_name, validated

if TYPE_CHECKING:
    from pipeline.plots.style import DataFigure


def figure(
    source: Source,
    name: str,
    options: Mapping[str, Any] | FigureOptions | None = None,
    *,
    echo: Echo | None = None,
    **more: Any,
) -> DataFigure:
    """Draw a figure of a run by the figure's name.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.FIGURES`.
    options, more
        Options that differ from the defaults; ``out`` and ``format`` are for the command line.
    echo
        Function that prints a line.

    Returns
    -------
    DataFigure
        The figure; its `data` are the Dataset drawn. `pipeline.plots.save_figure` writes it.

    Raises
    ------
    SpecError
        If the figure or an option is unknown or out of bounds, or if the run does not suit the figure.
    """
    if name not in FIGURES:
        raise SpecError(unknown_name("figure", name, FIGURES))
    if isinstance(options, FigureOptions):
        wanted = options
    else:
        wanted = validated(FIGURES[name].options, {**(options or {}), **more})
    run, wanted = ready(source, name, wanted, echo)
    return drawn(run, name, wanted)


def ready(source: Source, name: str, options: FigureOptions, echo: Echo | None) -> tuple[AnalysedRun, FigureOptions]:
    """Open a run to draw a figure; return it with the figure's completed options."""
    run = AnalysedRun.of(source, echo)
    settled: Any = prepared(run, FIGURES[name], options)
    return run, settled


def drawn(run: AnalysedRun, name: str, options: FigureOptions) -> DataFigure:
    """Draw a figure of an opened run, with the options that `ready` has completed."""
    from pipeline.plots import draw_figure

    with refused(run.name):
        return draw_figure(run, name, options)
