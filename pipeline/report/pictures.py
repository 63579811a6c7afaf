"""Draw the pictures of a study: figures of runs, recordings, torque readings, and model quantities."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from pipeline.report.page import Block, Note, picture_of
from pipeline.report.results import Results
from pipeline.report.runs import command_of
from pipeline.report.study import PictureTable
from pipeline.runs.drawing import figure
from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    from magpend_core.models.model import Parameters
    from pipeline.plots.style import DataFigure

_FINE = 2001
"""Points over a drive period."""


def picture(results: Results, table: PictureTable) -> Block:
    """Draw a picture of a study as a block of the page; if it cannot be drawn, return a note with the reason."""
    alt = f"{table.caption.rstrip('.')} ({table.of})"
    try:
        drawn = _DRAW[table.kind](results, table)
    except SpecError as error:
        return Note(f"{table.caption} Not drawn: {error}")
    return picture_of(drawn, alt, table.caption, _command(results, table))


def _plot(results: Results, table: PictureTable) -> DataFigure:
    return figure(results.run(table.of), table.figure, table.options)


def _quantities(results: Results, table: PictureTable) -> DataFigure:
    return draw_quantities(results.run(table.of).parameters, table.quantities, table.frequency_hz or 1.0)


def _recording(results: Results, table: PictureTable) -> DataFigure:
    from pipeline.plots.style import Frame
    from pipeline.rig.recordings.figure import plot_recording

    low, high = table.options.get("xlim", (None, None))
    return plot_recording(results.recording(table.of), frame=Frame(xlim=(low, high) if low is not None else None))


def _series(results: Results, table: PictureTable) -> DataFigure:
    from pipeline.rig.measured.figures import plot_series

    return plot_series(results.series(table.of, int(table.options.get("periods", 10))))


def _torques(results: Results, table: PictureTable) -> DataFigure:
    from pipeline.report.torque_curves import drawn

    return drawn(results.torques(table.of), table.figure)


_DRAW = {"plot": _plot, "quantities": _quantities, "recording": _recording, "series": _series, "torques": _torques}


def _command(results: Results, table: PictureTable) -> str:
    if table.kind == "plot":
        place = shlex.quote(str(results.folder / "runs" / table.of))
        return command_of(f"plot {table.figure}", table.options, place)
    if table.kind == "recording":
        file = results.folder / "recordings" / f"{table.of}.csv"
        mapping, out = file.with_suffix(".toml"), file.with_suffix(".png")
        return f"magpend recordings show {shlex.quote(str(file))} --mapping {mapping} --out {out}"
    return ""


def draw_quantities(parameters: Parameters, names: tuple[str, ...], frequency_hz: float) -> DataFigure:
    """Draw quantities of a model over one drive period, with all states at 0.

    Parameters
    ----------
    parameters
        Parameters of the model.
    names
        Names of the model's quantities.
    frequency_hz
        Drive frequency [Hz].
    """
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
