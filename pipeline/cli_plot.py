"""``magpend plot``: figures from stored products; nothing is computed again."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli_common import EXIT_HELP, Directory, refusals

plot_app = typer.Typer(
    help="Draw figures from a stored cube; nothing is computed again.", no_args_is_help=True
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


def figure_target(directory: Path, name: str, out: Path | None, file_format: Format | None) -> Path:
    """Return where a figure goes: `out`, or a file of that name in the run's folder of figures."""
    suffix = f".{(file_format or Format.PNG).value}"
    if out is None:
        return directory / "figures" / f"{name}{suffix}"
    target = out.with_name(out.name + suffix) if file_format and out.suffix.lower() != suffix else out
    check_figure_path(target)
    return target


def check_figure_path(path: Path) -> None:
    """Refuse a path that cannot be written to, before anything is computed."""
    from pipeline.problems import SpecError

    suffixes = [f".{f.value}" for f in Format]
    if path.suffix.lower() not in suffixes:
        raise SpecError([f"{path}: the suffix must be one of {', '.join(suffixes)}."])
    if not path.parent.is_dir():
        raise SpecError([f"{path.parent}: no such folder; make it first."])
