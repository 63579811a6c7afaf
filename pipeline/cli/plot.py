"""``magpend plot``: figures of a run's cube and of what is derived from it."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.analyse import ATTRACTOR_OPTIONS, DIMENSION_OPTIONS, takes
from pipeline.cli.common import EXIT_HELP, Directory, read_pairs, refusals

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.plots.style import DataFigure

plot_app = typer.Typer(
    help="Draw figures from a stored cube; no cell is computed again.", no_args_is_help=True
)


class State(StrEnum):
    """States that can be drawn."""

    PSI1 = "psi1"
    PSI2 = "psi2"
    PSI1_DOT = "psi1_dot"
    PSI2_DOT = "psi2_dot"


class Layout(StrEnum):
    """How directions share a figure."""

    OVERLAY = "overlay"
    SIDE = "side"


class Show(StrEnum):
    """What a map of regimes tells apart."""

    PERIODS = "periods"
    ATTRACTORS = "attractors"
    NUMBER = "number"


class Format(StrEnum):
    """File formats of figures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


@plot_app.command(epilog=EXIT_HELP)
def bifurcation(
    directory: Directory,
    state: Annotated[State, typer.Option(help="What is drawn over the parameter.")] = State.PSI1,
    out: Annotated[Path | None, typer.Option(help="Figure file; by default in DIR/figures.")] = None,
    degrees: Annotated[bool, typer.Option("--degrees", help="Degrees instead of radians.")] = False,
    layout: Annotated[
        Layout, typer.Option(help="Both directions in one panel, or a panel each.")
    ] = Layout.OVERLAY,
    file_format: Annotated[
        Format | None, typer.Option("--format", help="File format; by default png, or that of --out.")
    ] = None,
) -> None:
    """Draw a bifurcation diagram: left, right and straddling motions over the swept parameter."""
    path = draw_bifurcation(directory, state.value, out, degrees, layout.value, file_format)
    typer.echo(f"figure: {path}")


def draw_bifurcation(
    directory: Path,
    state: str = "psi1",
    out: Path | None = None,
    degrees: bool = False,
    layout: str = "overlay",
    file_format: Format | None = None,
) -> Path:
    """Write a bifurcation diagram and return its path."""
    from pipeline import open_run
    from pipeline.plots import plot_bifurcation, save_figure

    target = figure_target(directory, f"bifurcation_{state}", out, file_format)
    ds = open_run(directory)
    with refusals(directory):
        figure = plot_bifurcation(ds, state=state, degrees=degrees, layout=layout)
    target.parent.mkdir(exist_ok=True)
    return save_figure(figure, target)


At = Annotated[
    list[str] | None,
    typer.Option("--at", metavar="AXIS=VALUE", help="Value of an axis that the figure has no room for."),
]
Out = Annotated[Path | None, typer.Option(help="Figure file; by default in DIR/figures.")]
Degrees = Annotated[bool, typer.Option("--degrees", help="Degrees instead of radians.")]
FileFormat = Annotated[
    Format | None, typer.Option("--format", help="File format; by default png, or that of --out.")
]


@plot_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def basins(
    directory: Directory,
    at: At = None,
    shade: Annotated[bool, typer.Option("--shade", help="Darken what took longer to converge.")] = False,
    degrees: Degrees = False,
    out: Out = None,
    file_format: FileFormat = None,
    **options: Any,
) -> None:
    """Draw basins of attraction: which attractor each initial state of a grid ends on."""

    def draw(found: xr.Dataset) -> DataFigure:
        from pipeline import open_run
        from pipeline.plots import plot_basins

        periods = open_run(directory)["n_periods"] if shade else None
        return plot_basins(found, at=_positions(at, degrees), degrees=degrees, n_periods=periods)

    _draw_attractors(directory, "basins", draw, options, out, file_format, at)


@plot_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def fractions(
    directory: Directory, at: At = None, out: Out = None, file_format: FileFormat = None, **options: Any
) -> None:
    """Draw basin fractions over the swept parameter, as stacked bands."""

    def draw(found: xr.Dataset) -> DataFigure:
        from pipeline.plots import plot_fractions

        return plot_fractions(found, at=_positions(at))

    _draw_attractors(directory, "fractions", draw, options, out, file_format, at)


@plot_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def gallery(
    directory: Directory, at: At = None, out: Out = None, file_format: FileFormat = None, **options: Any
) -> None:
    """Draw the attractors of one parameter point: phase portraits and the path of the moving magnet.

    Integrates one period of each, for the portraits.
    """

    def draw(found: xr.Dataset) -> DataFigure:
        from pipeline.analysis.attractors.portraits import portraits
        from pipeline.plots import plot_gallery

        return plot_gallery(found, portraits(found, at=_positions(at)))

    _draw_attractors(directory, "gallery", draw, options, out, file_format, at)


@plot_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def attractors(
    directory: Directory,
    state: Annotated[State, typer.Option(help="What is drawn over the parameter.")] = State.PSI1,
    at: At = None,
    degrees: Degrees = False,
    out: Out = None,
    file_format: FileFormat = None,
    **options: Any,
) -> None:
    """Draw all coexisting attractors over the swept parameter, with the hysteresis of a continuation."""

    def draw(found: xr.Dataset) -> DataFigure:
        from pipeline.plots import plot_coexisting
        from pipeline.products import derived

        both = "direction" in found.coords and {"up", "down"} == set(found["direction"].values.tolist())
        loops = derived.hysteresis(directory, echo=typer.echo, **options) if both else None
        return plot_coexisting(found, state=state.value, at=_positions(at), degrees=degrees, hysteresis=loops)

    _draw_attractors(directory, f"attractors_{state.value}", draw, options, out, file_format, at)


@plot_app.command(epilog=EXIT_HELP)
@takes(*ATTRACTOR_OPTIONS)
def regimes(
    directory: Directory,
    show: Annotated[Show, typer.Option(help="What is told apart.")] = Show.PERIODS,
    at: At = None,
    out: Out = None,
    file_format: FileFormat = None,
    **options: Any,
) -> None:
    """Draw a map of two swept parameters: which periods or attractors coexist, or how many."""

    def draw(found: xr.Dataset) -> DataFigure:
        from pipeline.plots import plot_regimes

        return plot_regimes(found, show=show.value, at=_positions(at))

    _draw_attractors(directory, f"regimes_{show.value}", draw, options, out, file_format, at)


class Per(StrEnum):
    """Units of exponents."""

    S = "s"
    PERIOD = "period"


@plot_app.command(epilog=EXIT_HELP)
def lyapunov(
    directory: Directory,
    spectrum: Annotated[
        bool, typer.Option("--spectrum", help="All stored exponents, not the largest alone.")
    ] = False,
    as_map: Annotated[
        bool, typer.Option("--map", help="A map over two parameters instead of a diagram over one.")
    ] = False,
    per: Annotated[Per, typer.Option(help="Exponents per second or per drive period.")] = Per.S,
    state: Annotated[State, typer.Option(help="State of the diagram above.")] = State.PSI1,
    degrees: Degrees = False,
    at: At = None,
    out: Out = None,
    file_format: FileFormat = None,
) -> None:
    """Draw Lyapunov exponents, under the bifurcation diagram or as a map over two parameters."""
    from pipeline import open_run
    from pipeline.plots import plot_lyapunov, plot_lyapunov_map

    name = "lyapunov_map" if as_map else "lyapunov_spectrum" if spectrum else "lyapunov"
    target = figure_target(directory, name, out, file_format, at)
    ds, chosen = open_run(directory), _positions(at)
    with refusals(directory):
        if as_map:
            figure = plot_lyapunov_map(ds, per=per.value, at=chosen)
        else:
            figure = plot_lyapunov(
                ds, spectrum=spectrum, per=per.value, state=state.value, degrees=degrees, at=chosen
            )
    _write(figure, target)


@plot_app.command(epilog=EXIT_HELP)
def convergence(
    directory: Directory,
    exponent: Annotated[int, typer.Option(help="Which exponent, 1 the largest.")] = 1,
    per: Annotated[Per, typer.Option(help="Exponents per second or per drive period.")] = Per.S,
    at: At = None,
    out: Out = None,
    file_format: FileFormat = None,
) -> None:
    """Draw how the Lyapunov exponents of the cells of one parameter point converge."""
    from pipeline import open_run
    from pipeline.plots import plot_convergence

    target = figure_target(directory, f"convergence_{exponent}", out, file_format, at)
    chosen, ds = _positions(at), open_run(directory)
    with refusals(directory):
        figure = plot_convergence(ds, exponent=exponent, per=per.value, at=chosen)
    _write(figure, target)


@plot_app.command(epilog=EXIT_HELP)
@takes(*DIMENSION_OPTIONS)
def dimension(
    directory: Directory, at: At = None, out: Out = None, file_format: FileFormat = None, **options: Any
) -> None:
    """Draw the correlation sum of the chaotic sections of one parameter point, with fit and local slope."""
    target = figure_target(directory, "dimension", out, file_format, at)
    from pipeline import open_run
    from pipeline.analysis.selection import select_points
    from pipeline.plots import plot_dimension
    from pipeline.products import derived

    chosen = _positions(at)
    with refusals(directory):
        select_points(
            open_run(directory), chosen, purpose="a correlation sum is drawn of one parameter point"
        )
    found = derived.dimension(directory, at=chosen, echo=typer.echo, **options)
    with refusals(directory):
        figure = plot_dimension(found)
    _write(figure, target)


def _draw_attractors(
    directory: Path,
    name: str,
    draw: Callable[[xr.Dataset], DataFigure],
    options: dict[str, Any],
    out: Path | None,
    file_format: Format | None,
    at: list[str] | None,
) -> None:
    """Draw a figure of a run's attractors, finding them first if that was not done, and write its data."""
    target = figure_target(directory, name, out, file_format, at)
    from pipeline.products import derived

    found = derived.attractors(directory, echo=typer.echo, **options)
    with refusals(directory):
        figure = draw(found)
    _write(figure, target)


def _write(figure: DataFigure, target: Path) -> None:
    """Write a figure and its data, and say where."""
    from pipeline.plots import save_data, save_figure

    target.parent.mkdir(exist_ok=True)
    typer.echo(f"figure: {save_figure(figure, target)}")
    typer.echo(f"data: {save_data(figure, target)}")


def _positions(at: list[str] | None, degrees: bool = False) -> dict[str, float]:
    """Read ``AXIS=VALUE`` pairs; initial states are given in the unit of the figure."""
    import math

    found = read_pairs("--at", at or [], "frequency=2.2")
    turned = {name for name in found if degrees and name.startswith("psi")}
    return {name: math.radians(value) if name in turned else value for name, value in found.items()}


def figure_target(
    directory: Path, name: str, out: Path | None, file_format: Format | None, at: list[str] | None = None
) -> Path:
    """Return where a figure goes: `out`, or a file in the run's folder of figures, named by what it shows."""
    suffix = f".{(file_format or Format.PNG).value}"
    if out is None:
        chosen = "".join(
            f"_{axis}_{value:g}" for axis, value in read_pairs("--at", at or [], "frequency=2.2").items()
        )
        return directory / "figures" / f"{name}{chosen}{suffix}"
    target = out.with_name(out.name + suffix) if file_format and out.suffix.lower() != suffix else out
    check_figure_path(target)
    return target


def check_figure_path(path: Path) -> None:
    """Refuse a path that cannot be written to, before anything is computed."""
    from pipeline.spec.problems import SpecError

    suffixes = [f".{f.value}" for f in Format]
    if path.suffix.lower() not in suffixes:
        raise SpecError([f"{path}: the suffix must be one of {', '.join(suffixes)}."])
    if not path.parent.is_dir():
        raise SpecError([f"{path.parent}: no such folder; make it first."])
