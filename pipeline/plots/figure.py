"""Draw a figure of a run by its name, with helpers for the ``draw`` functions of all figures.

Each figure of `pipeline.products.registry` names a function ``draw(run, options)`` of this package. It
reads ``run.cube()`` and ``run.derive(name, **options)``, and hands numbers to a ``plot_...`` function,
which knows nothing about runs. This module adds the request and the provenance to the figure's data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import place, snap
from pipeline.layout.vocabulary import told_by
from pipeline.plots.files import with_provenance
from pipeline.plots.style import DataFigure, Frame
from pipeline.products.animation import AnimationOptions
from pipeline.products.product import FigureOptions, Options, function_of
from pipeline.products.registry import FIGURES
from pipeline.specification.problems import unknown_name


def draw_figure(run: OpenRun, name: str, options: FigureOptions) -> DataFigure:
    """Draw a figure of a run by the figure's name, and record in its data where they come from.

    Parameters
    ----------
    run
        The run.
    name
        One of `pipeline.products.registry.FIGURES`.
    options
        The figure's options.

    Returns
    -------
    DataFigure
        The attributes of its `data` hold the provenance: the figure and its options that differ from the
        defaults, title and digest of the run, digest of the cells, model and parameters, versions,
        host, date and commit as in ``run.json``.

    Raises
    ------
    ValueError
        If the run does not have what the figure shows.
    """
    figure: DataFigure = function_of(FIGURES[name].draw)(run, options)
    figure.data = with_provenance(figure.data, {**run_provenance(run), **request(name, options)})
    for note in figure.notes:
        run.echo(note)
    return figure


def request(name: str, options: Options) -> dict[str, Any]:
    """Return what identifies a figure: its name, and the options that differ from their defaults."""
    wanted = {key: value for key, value in options.changed().items() if key not in ("out", "format")}
    return {"figure": name, "options": wanted}


def run_provenance(run: OpenRun) -> dict[str, Any]:
    """Return where a run's data come from: source, title, digests and versions."""
    info, attrs = run.info, run.cube().attrs
    found: dict[str, Any] = {
        "source": str(attrs.get("source", "magpend")),
        "run": info.title,
        "digest": info.digest,
        "cube_digest": run.digest,
        "versions": info.versions,
        **getattr(info, "provenance", {}),
    }
    return found | {key: str(value) for key, value in told_by(attrs).items()}


def frame_of(options: FigureOptions) -> Frame:
    """Return the width, the axis ranges and the style of a figure from its options."""
    return Frame(options.width, options.xlim, options.ylim, options.style, options.dpi)


def values_of(run: OpenRun, options: FigureOptions | AnimationOptions) -> tuple[dict[str, float], list[str]]:
    """Return the axis values at which a figure is drawn, and notes where they differ from the options.

    Raises
    ------
    ValueError
        If an axis is unknown, or lacks the value and ``nearest`` is not set. Raised before any computation.
    """
    given: Mapping[str, float] = options.at
    cube = run.cube()
    axes = [str(d) for d in cube["status"].dims if d in cube.coords]
    for name in given:
        if name not in axes:
            raise ValueError(unknown_name("axis", name, axes))
    if not options.nearest:
        for name, value in given.items():
            place(cube[name], value)
        return dict(given), []
    found = snap(cube, given)
    notes = [
        f"{name} = {given[name]:.10g} is not on its axis; drawn at the nearest, {value:.10g}"
        for name, value in found.items()
        if abs(value - given[name]) > 1e-6 * max(abs(value), 1e-300)
    ]
    return found, notes


def noted(figure: DataFigure, notes: list[str]) -> DataFigure:
    """Add notes for the user to a figure, and return the figure."""
    figure.notes.extend(notes)
    return figure
