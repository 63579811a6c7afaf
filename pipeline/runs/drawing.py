"""Draw figures by name: of a run, as ``magpend plot`` does, or of a cube in memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

from pipeline.layout.vocabulary import model_of
from pipeline.products.product import FigureOptions
from pipeline.products.registry import FIGURES
from pipeline.products.reporting import silent
from pipeline.runs.derive import AnalysedRun, Echo, Source, prepared, refused
from pipeline.runs.naming import named
from pipeline.specification.problems import SpecError, unknown_name, validated
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from magpend_core.models.model import Model
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
        Options that differ from the defaults.
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


def draw_panels(
    source: Source | xr.Dataset,
    name: str,
    options: Mapping[str, Any],
    *,
    ax: Axes | None = None,
    figure: Figure | SubFigure | None = None,
    echo: Echo | None = None,
) -> list[Axes]:
    """Draw a figure of a run into axes or a figure of the caller, or into a new figure of pyplot.

    Parameters
    ----------
    source
        Run directory, opened run, or a cube for figures that use nothing but cells.
    name, options, echo
        See `figure`. With `ax` or a figure, the option ``width`` follows from it.
    ax
        Axes for a figure of one panel.
    figure
        Empty figure or subfigure.

    Returns
    -------
    list of Axes
        The panels, without colour bars.

    Raises
    ------
    SpecError
        See `figure`; also if both `ax` and `figure` are given, if `ax` is given for a figure of several
        panels, or if the given figure has axes already.
    """
    from pipeline.plots.targets import PanelsError, drawing_into, width_of

    wanted: Any = validated(FIGURES[name].options, options)
    _check_style(wanted)
    host = ax if ax is not None else figure
    if ax is not None and figure is not None:
        raise SpecError("ax= and figure= are both given; drop one.")
    if ax is not None and FIGURES[name].panels_with(wanted) == "several":
        raise SpecError(f"{name}: {PanelsError()}")
    make = None
    if host is not None:
        wanted = wanted.model_copy(update={"width": width_of(host)})
    else:
        from matplotlib import pyplot

        make = pyplot.figure
    run: Any
    if isinstance(source, str | Path | RunDirectory):
        run, wanted = ready(source, name, wanted, echo)
    else:
        run, wanted = ready_cube(source, name, wanted, echo)
    with refused(f"{run.name}: {name}"), drawing_into(host, make):
        return drawn(run, name, wanted).panels


def ready(source: Source, name: str, options: FigureOptions, echo: Echo | None) -> tuple[AnalysedRun, FigureOptions]:
    """Open a run to draw a figure; return it with the figure's completed options."""
    _check_style(options)
    run = AnalysedRun.of(source, echo)
    settled: Any = prepared(run, FIGURES[name], options)
    return run, settled


def _check_style(options: FigureOptions) -> None:
    if options.style:
        from pipeline.plots.looks import check_style

        check_style(options.style)


def drawn(run: AnalysedRun, name: str, options: FigureOptions) -> DataFigure:
    """Draw a figure of an opened run, with the options that `ready` has completed."""
    from pipeline.plots import draw_figure

    with refused(run.name):
        return draw_figure(run, name, options)


_REMEDY = "Analyses are of whole runs: open the run with magpend.Run.open(DIR), and use run.plot."


@dataclass(frozen=True)
class CubeRun:
    """A cube in the place of a run, for figures that use nothing but cells."""

    ds: xr.Dataset  # a cube from `pipeline.open_run`, or a part of it
    echo: Echo  # function that prints a line

    digest = ""
    name = "the cube"

    @property
    def info(self) -> Any:
        """Return what the cube's attributes tell of its run."""
        attrs = self.ds.attrs
        provenance = {key: attrs[key] for key in ("created", "host", "git_commit") if key in attrs}
        return SimpleNamespace(
            title=attrs.get("title", ""), digest=attrs.get("digest", ""), versions={}, provenance=provenance
        )

    @property
    def model(self) -> Model:
        """Model that was integrated."""
        return model_of(self.ds)

    def of(self, source: str) -> AnalysedRun:
        """Open another run by its directory."""
        return AnalysedRun.of(source)

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the cube."""
        return self.ds

    def derive(self, name: str, **options: Any) -> NoReturn:
        """Raise ValueError: an analysis needs the whole run."""
        raise ValueError(f"this figure needs the analysis {name}. {_REMEDY}")


def ready_cube(
    ds: xr.Dataset, name: str, options: FigureOptions, echo: Callable[[str], None] | None
) -> tuple[CubeRun, FigureOptions]:
    """Return a cube to draw a figure of, with the figure's completed options.

    Raises
    ------
    SpecError
        If the figure needs an analysis, or an option names what the cube does not have.
    """
    run: Any = CubeRun(ds, echo or silent)
    options_of_analyses = {"parameter", "second"} & type(options).model_fields.keys()
    if FIGURES[name].needs or options_of_analyses:
        raise SpecError(f"the cube: {name} needs an analysis. {_REMEDY}")
    completed: Any = named(run, options)
    return run, completed
