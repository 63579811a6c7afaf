"""From a run and the options of a figure to the figure: what every ``draw`` needs, and `draw_figure`.

Each figure of `pipeline.products.registry` names a function ``draw(run, options)`` of this package. It
reads ``run.cube()`` and ``run.derive(name, **options)``, and hands numbers to a ``plot_...`` function,
which knows nothing of runs. What was asked for, and where the numbers come from, is added here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import xarray as xr

from pipeline.analysis.selection import place, snap
from pipeline.layout.vocabulary import told_by
from pipeline.plots.files import with_provenance
from pipeline.plots.style import DataFigure, Frame
from pipeline.products.animation import AnimationOptions
from pipeline.products.product import FigureOptions, Options, function_of
from pipeline.products.registry import FIGURES


class Run(Protocol):
    """What a figure uses of a run; see `pipeline.runs.derive.AnalysedRun`."""

    @property
    def info(self) -> Any:
        """What ``run.json`` holds."""

    @property
    def digest(self) -> str:
        """Digest of the committed cells."""

    @property
    def echo(self) -> Callable[[str], None]:
        """Prints a line."""

    def of(self, source: str) -> Run:
        """Another run."""

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Cells of the run."""

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Result of an analysis."""


def draw_figure(run: Run, name: str, options: FigureOptions) -> DataFigure:
    """Draw a figure of a run, with its provenance.

    Parameters
    ----------
    run
        The run.
    name
        One of `pipeline.products.registry.FIGURES`.
    options
        Those of the figure.

    Returns
    -------
    DataFigure
        The attributes of its `data` say what was drawn of what: the figure and the options that are not
        as by default, title and digest of the run, digest of the cells, model and parameters, versions,
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
    """Return what was asked for: the figure, and its options that are not as by default."""
    wanted = {key: value for key, value in options.changed().items() if key not in ("out", "format")}
    return {"figure": name, "options": wanted}


def run_provenance(run: Run) -> dict[str, Any]:
    """Return where the numbers of a run come from."""
    info, attrs = run.info, run.cube().attrs
    found: dict[str, Any] = {
        "source": str(attrs.get("source", "magpend")), "run": info.title, "digest": info.digest,
        "cube_digest": run.digest, "versions": info.versions, **getattr(info, "provenance", {}),
    }  # fmt: skip
    return found | {key: str(value) for key, value in told_by(attrs).items()}


def frame_of(options: FigureOptions) -> Frame:
    """Return the size and the ranges that are asked for."""
    return Frame(options.width, options.xlim, options.ylim)


def values_of(run: Run, options: FigureOptions | AnimationOptions) -> tuple[dict[str, float], list[str]]:
    """Return the values of axes that are drawn, and what to say where they are not those asked for.

    Raises
    ------
    ValueError
        If an axis is unknown, or does not have a value and ``nearest`` is not asked for: before anything
        is computed.
    """
    given: Mapping[str, float] = options.at
    cube = run.cube()
    axes = [str(d) for d in cube["status"].dims if d in cube.coords]
    for name in given:
        if name not in axes:
            raise ValueError(f"unknown axis {name!r}; values can be chosen of: {', '.join(axes) or 'none'}")
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
    """Return a figure that says more to whoever asked for it."""
    figure.notes.extend(notes)
    return figure


def attractors_of(run: Run, options: Options) -> xr.Dataset:
    """Return the attractors of a run, found with those options that say how."""
    from pipeline.products.attractors import AttractorOptions

    return run.derive("attractors", **options.part(AttractorOptions))
