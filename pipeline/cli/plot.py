"""Define ``magpend plot NAME DIR``, with a command for each figure in the registry."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipeline.cli import console
from pipeline.cli.common import Directory
from pipeline.cli.groups import Groups, command_group, made, registry_group
from pipeline.cli.options import taking
from pipeline.cli.outputs import check_file

if TYPE_CHECKING:
    from pipeline.products.product import FigureOptions
    from pipeline.store.files import Files

SUFFIXES = (".png", ".pdf", ".svg")

Out = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Figure file; by default in DIR/figures, named by its options.")
]
Format = Annotated[
    Literal["png", "pdf", "svg"] | None,
    typer.Option(metavar="png|pdf|svg", help="File format; by default png, or that of --out."),
]


def _groups() -> Groups:
    from pipeline.products.registry import FIGURES

    return FIGURES.groups


def _make(name: str) -> Any:
    from pipeline.products.registry import FIGURES

    def command(directory: Directory, options: Any, out: Out = None, format: Format = None) -> None:
        draw(directory, name, options, out, format)

    figure = FIGURES[name]
    command.__name__ = f"figure {name}"
    return made(name, taking(figure.options, command), figure.help)


plot_app = command_group(
    "Draw figures from a stored cube; no cell is computed again.", registry_group("plot", _groups, _make)
)


def draw(directory: str, name: str, options: FigureOptions, out: Path | None = None, suffix: str | None = None) -> None:
    """Draw a figure of a run, write it with its data, and print where they are."""
    from pipeline.runs.drawing import drawn, ready
    from pipeline.runs.naming import options_in_own_words
    from pipeline.store.errors import RefusedError
    from pipeline.store.files import FIGURES
    from pipeline.store.local import make_folder, refuse_links, unwritable
    from pipeline.store.runfile import read_run

    if out is not None:
        if suffix and out.suffix.lower() != f".{suffix}":
            out = out.with_name(f"{out.name}.{suffix}")
        check_figure_path(out, FIGURES, [read_run(directory).digest])
    run, wanted = ready(directory, name, options, console.note)
    label = options_in_own_words(wanted, run.spec.rate).label()
    target = out or _folder_of(run.info.files) / f"{name}{label}.{suffix or 'png'}"
    if out is None and run.info.files.local is None:  # runs of other buckets may have the same name
        for file in (target, target.with_suffix(".nc")):
            check_file(file, digests=[run.info.digest])
    if out is None:
        refuse_links(target.parent, target, target.with_suffix(".nc"))
    if problem := unwritable(target.parent):
        raise RefusedError(f"{problem}; give another place for the figure: --out FILE.")
    figure = drawn(run, name, wanted)
    from pipeline.plots import save_data, save_figure

    if out is None:
        make_folder(target.parent)
    console.result(f"figure: {save_figure(figure, target)}")
    console.result(f"data: {save_data(figure, target)}")


def _folder_of(files: Files) -> Path:
    """Return the folder of figures: in the run directory or, for a run in an object store, ``figures/NAME``."""
    return files.local / "figures" if files.local else Path("figures") / files.name.rpartition("/")[2]


def check_figure_path(path: Path, within: str = "", digests: Collection[str] = ()) -> None:
    """Raise an error if a figure file cannot be written, before anything is computed; see `check_file`."""
    from pipeline.specification.files import check_new_file

    check_new_file(path, SUFFIXES)
    for file in (path, path.with_suffix(".nc")):
        check_file(file, within=within, digests=digests)
