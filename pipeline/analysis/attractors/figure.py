"""Draw all attractors of one parameter point: phase portraits, and the path of a point of the model's drawing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from pipeline.layout.vocabulary import ATTRACTS, letter, model_of, parameters_of, told_by
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.trajectory import DrawnMotion, draw_path, draw_portrait, equalise, fixed_handles
from pipeline.products.product import FigureOptions
from pipeline.results.outcomes import left_out
from pipeline.results.ragged import dense, dims_of, isel
from pipeline.results.run import OpenRun
from pipeline.results.selection import place

_PANEL_IN, _LABEL_IN, _LINE_IN = 0.9, 0.44, 0.17


@style.drawn
def plot_gallery(
    attractors: xr.Dataset, portraits: xr.Dataset, *, degrees: bool = False, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw each attractor of one parameter point: its phase portraits, and the path of a point of the model's drawing.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match`; gives colours and names.
    portraits
        Result of `pipeline.analysis.attractors.portraits.portraits` for one of its parameter points.
    degrees
        Degrees instead of radians.
    frame
        Width of the figure.

    Returns
    -------
    DataFigure
        Lines are the motion, dots its section. The portrait of an angle that turns over is
        drawn on the circle, from -pi to pi. The 8 attractors with the largest share are
        drawn, in the order of their ids; where there are fewer, also sets that do not attract, in grey. The
        heading counts the cells that end elsewhere, with the reason. A figure with a single panel is at most
        110 mm wide. Its `data` are the portraits drawn.

    Raises
    ------
    ValueError
        If there is no attractor, or if degrees are asked for of a model without angles.
    """
    # most attractors that are shown, and the width of a figure with a single panel [mm]: a wider one would be half
    # empty
    most_rows, lone_mm = 8, 110.0
    model = model_of(attractors)
    labels.some_angle(model, degrees, "portraits")
    n = portraits.sizes["attractor"]
    if n == 0:
        raise ValueError("there is no attractor at this parameter point: nothing to draw")
    ranked = np.argsort(-portraits["share"].values, kind="stable")[:most_rows]
    data = portraits.isel(attractor=np.sort(ranked)).assign_attrs(told_by(attractors.attrs))
    here = _described(attractors, portraits)
    cast = palette.cast_of(attractors, here)
    each = len(model.portraits) + (model.drawing is not None)
    if each * data.sizes["attractor"] == 1:
        frame = replace(frame, width=min(frame.width, lone_mm))
    head = style.folded(_told(data, portraits, here), frame.width_in - 0.2, style.sizes().legend)
    layout = _Layout.of(frame, data.sizes["attractor"], each, model.drawing is not None, head.count("\n") + 1)
    titles = [_title(data.isel(attractor=k), cast, layout) for k in range(data.sizes["attractor"])]
    layout = replace(layout, title_lines=1 + max(title.count("\n") for title in titles))
    fig = style.new_figure(layout.height, data, frame, arranged=False, exact=True)
    shown: set[str] = set()
    for k, title in enumerate(titles):
        shown |= _draw_one(fig, layout, k, data.isel(attractor=k), (title, cast), degrees)
    _write_head(fig, head, data, shown)
    style.finish(fig)
    return fig


@dataclass(frozen=True)
class _Layout:
    """Positions of the panels of a gallery [in]: attractors side by side in rows, with several panels for each."""

    frame: style.Frame
    rows: int
    beside: int
    each: int
    drawing: bool
    lines: int
    title_lines: int = 1

    @classmethod
    def of(cls, frame: style.Frame, n: int, each: int, drawing: bool, lines: int) -> _Layout:
        most = max(1, (2 if frame.compact else 3) // each)
        rows = -(-n // most)
        return cls(frame, rows, -(-n // rows), each, drawing, lines)

    @property
    def left(self) -> float:
        return 0.5 if self.frame.compact else 0.58

    @property
    def pitch(self) -> float:
        return self.frame.width_in / (self.each * self.beside)

    @property
    def panel(self) -> tuple[float, float]:
        height = {1: 2.2, 2: 1.35}.get(self.each * self.beside, _PANEL_IN)
        return self.pitch - self.left - 0.16, height

    @property
    def row(self) -> float:
        return self.panel[1] + self.title_lines * _LINE_IN + 0.06 + _LABEL_IN

    @property
    def height(self) -> float:
        return _LINE_IN * (self.lines + 1) + 0.08 + self.rows * self.row

    def axes(self, fig: style.DataFigure, k: int, column: int) -> Axes:
        path_in = 0.14  # further room for the tick labels of a path, which are long
        width, height = self.panel
        x = self.left + ((k % self.beside) * self.each + column) * self.pitch
        if self.drawing and column == self.each - 1:
            room = 0.0 if self.frame.compact else path_in
            x, width = x + room, width - room
        y = (self.rows - 1 - k // self.beside) * self.row + _LABEL_IN
        size = fig.get_size_inches()
        ax = fig.add_axes((x / size[0], y / size[1], width / size[0], height / size[1]))
        style.style_axes(ax)
        return ax


def _described(attractors: xr.Dataset, portraits: xr.Dataset) -> xr.Dataset:
    dims = [d for d in dims_of(attractors) if d in portraits.coords]
    return dense(isel(attractors, {d: place(attractors[d], float(portraits[d])) for d in dims}))


def _title(one: xr.Dataset, cast: palette.Cast, layout: _Layout) -> str:
    attracts = int(one["stability"]) == ATTRACTS
    share = f", share {palette.percent(float(one['share']))}" if attracts else ""
    room, size = layout.each * layout.pitch - layout.left, style.sizes().legend
    return style.folded(f"{cast.names[int(one['attractor'])]}{share}", room, size, "   ")


def _draw_one(
    fig: style.DataFigure, layout: _Layout, k: int, one: xr.Dataset, named: tuple[str, palette.Cast], degrees: bool
) -> set[str]:
    model, number = model_of(one), int(one["attractor"])
    title, cast = named
    motion = DrawnMotion(
        {name: one["orbit"].sel(state=name).values for name in model.state_names},
        {name: one["attractor_points"].sel(state=name).values for name in model.state_names},
        palette.GREY_OF.get(int(one["stability"]), cast.colours[number]),
        letter(number),
    )
    axes = [layout.axes(fig, k, column) for column in range(layout.each)]
    axes[0].text(0.0, 1.04, title, transform=axes[0].transAxes, fontsize=fig.look.legend, va="bottom")
    for ax, pair in zip(axes, model.portraits, strict=False):
        draw_portrait(ax, one, pair, motion, degrees=degrees)
    shown: list[str] = []
    if model.drawing is not None:
        shown = draw_path(axes[-1], model.drawing, _parameters(one), motion)
        style.few_ticks(axes[-1], 3)
        equalise(axes[-1])
    if layout.panel[0] < 0.8:
        for ax in axes:
            ax.xaxis.set_major_locator(MaxNLocator(2 if layout.panel[0] > 0.6 else 1))
    return set(shown)


def _parameters(one: xr.Dataset) -> dict[str, float]:
    values = parameters_of(one).as_dict()
    return {name: float(one[name]) if name in one.coords else value for name, value in values.items()}


def _told(data: xr.Dataset, portraits: xr.Dataset, here: xr.Dataset) -> str:
    text = labels.caption(portraits.assign_attrs(data.attrs), with_start=False)
    if (rest := portraits.sizes["attractor"] - data.sizes["attractor"]) > 0:
        share = palette.percent(float(portraits["share"].sum() - data["share"].sum()))
        text += f"; {rest} more sets, with a share of {share}, are not shown"
    return style.join([text, left_out(here)])


def _write_head(fig: style.DataFigure, text: str, data: xr.Dataset, shown: set[str]) -> None:
    width, height = fig.get_size_inches()
    size = fig.look.legend
    fig.text(0.08 / width, 1.0 - 0.06 / height, text, fontsize=size, va="top", linespacing=1.1)
    handles: list[Any] = [style.dot(model_of(data).clock.once, "black", 3.0), *_fixed_handles(data, shown)]
    fig.legend(
        handles=handles,
        loc="upper left",
        frameon=False,
        bbox_to_anchor=(0.04 / width, 1.0 - (0.06 + _LINE_IN * (text.count("\n") + 1)) / height),
        ncols=len(handles),
        fontsize=size,
        borderpad=0.0,
        borderaxespad=0.0,
        handletextpad=0.2,
        columnspacing=1.0,
        handlelength=1.2,
    )


def _fixed_handles(data: xr.Dataset, shown: set[str]) -> list[Any]:
    drawing = model_of(data).drawing
    return [] if drawing is None else fixed_handles(drawing, _parameters(data), shown)


def draw(run: OpenRun, options: FigureOptions) -> style.DataFigure:
    """Draw the figure ``gallery`` of a run; the motion on each attractor is integrated for it."""
    from pipeline.analysis.attractors.portraits import portraits

    at, notes = values_of(run, options)
    found = run.derive("attractors")
    figure = plot_gallery(found, portraits(found, at=at), degrees=options.degrees, frame=frame_of(options))
    return noted(figure, notes)
