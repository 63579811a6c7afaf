"""Draw the pictures of a study: figures of runs, quantities of a model, and kinds that plug-ins add."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import xarray as xr
from pydantic import Field

from pipeline.products.plugins import added
from pipeline.report.estimates import Results
from pipeline.report.page import Block, Note, picture_of
from pipeline.report.report import command_of
from pipeline.runs.derive import derive
from pipeline.runs.drawing import figure
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import Table

if TYPE_CHECKING:
    from magpend_core.models.model import Parameters
    from pipeline.plots.style import DataFigure

_FINE = 2001
"""Points over a drive period."""


def _no_command(folder: Path, table: PictureTable) -> str:
    return ""


class PictureTable(Table):
    """Table ``[[figures.pictures]]`` of a study's file: a picture that reproduces (part of) a figure of the paper."""

    kind: str = Field(description="Kind of picture.")
    of: str = Field(description="Name of the run or of another input.")
    figure: str = Field("", description="Name of the figure of a run, or of another input that has several.")
    quantities: Annotated[tuple[str, ...], Field(strict=False)] = Field((), description="Names of the quantities.")
    frequency_hz: Annotated[float, Field(gt=0)] | None = Field(None, description="Drive frequency [Hz].")
    caption: str = Field(description="Sentence below the picture.")
    options: dict[str, Any] = Field({}, description="Options of the figure, as its command has them.")
    branches: dict[str, Any] = Field({}, description="Options with which the run's branches are found before.")


@dataclass(frozen=True)
class Picture:
    """A kind of picture: its meaning, how it is drawn, and the command that draws it from the study's folder."""

    meaning: str
    draw: Callable[[Results, PictureTable], DataFigure]
    command: Callable[[Path, PictureTable], str] = _no_command


def kinds() -> dict[str, Picture]:
    """Return all kinds of pictures by name."""
    own = {
        "plot": Picture("a figure of a run, by the name of its command", _plot, _command_of_plot),
        "quantities": Picture("quantities of the model over a drive period", _quantities),
    }
    return own | added("pictures")


def picture(results: Results, table: PictureTable) -> Block:
    """Draw a picture of a study as a block of the page; if it cannot be drawn, return a note with the reason."""
    alt = f"{table.caption.rstrip('.')} ({table.of})"
    kind = kinds()[table.kind]
    try:
        drawn = kind.draw(results, table)
    except SpecError as error:
        return Note(f"{table.caption} Not drawn: {error}")
    return picture_of(drawn, alt, table.caption, kind.command(results.folder, table))


def _plot(results: Results, table: PictureTable) -> DataFigure:
    run = results.run(table.of)
    if table.branches:
        derive(run, "branches", table.branches)
    return figure(run, table.figure, table.options)


def _command_of_plot(folder: Path, table: PictureTable) -> str:
    place = shlex.quote(str(folder / "runs" / table.of))
    found = [command_of("analyse branches", table.branches, place)] if table.branches else []
    return "\n".join([*found, command_of(f"plot {table.figure}", table.options, place)])


def _quantities(results: Results, table: PictureTable) -> DataFigure:
    return draw_quantities(results.run(table.of).parameters, table.quantities, table.frequency_hz or 1.0)


def draw_quantities(parameters: Parameters, names: tuple[str, ...], frequency_hz: float) -> DataFigure:
    """Draw quantities of a model over one drive period, with all states at 0."""
    from magpend_core import evaluate
    from pipeline.plots import style
    from pipeline.plots.labels import with_unit
    from pipeline.plots.looks import look

    model = parameters.model
    share = np.linspace(0.0, 1.0, _FINE, endpoint=False)
    rest = np.zeros((_FINE, len(model.states)))
    values = np.asarray(evaluate(list(names), share / frequency_hz, rest, parameters, frequency_hz))
    about = [model.quantity(name) for name in names]
    data = xr.Dataset(
        {q.name: ("share", values[:, k], {"units": q.unit, "long_name": q.meaning}) for k, q in enumerate(about)},
        coords={"share": ("share", share, {"units": "1", "long_name": "share of the drive's period"})},
        attrs={"title": "quantities over a drive period", "frequency_hz": frequency_hz},
    )
    with look():
        drawn = style.new_figure(1.2 + 1.6 * len(names), data)
        for row, (ax, q) in enumerate(
            zip(drawn.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0], about, strict=True)
        ):
            style.style_axes(ax)
            ax.plot(share, values[:, row], color=style.BLUE, linewidth=1.2)
            ax.axhline(0.0, color="0.75", linewidth=0.7, zorder=0)
            style.label_axes(ax, y=with_unit(f"${q.symbol}$" if q.symbol else q.name, q.unit))
        style.label_axes(ax, x=f"time since {model.section} [drive periods]")
        ax.set_xlim(0.0, 1.0)
        style.complete(drawn, drawn.axes[0], f"$f$ = {frequency_hz:.6g} Hz, the model at rest")
    return drawn
