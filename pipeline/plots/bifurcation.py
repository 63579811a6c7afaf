"""Draw bifurcation diagrams: section points over the swept parameter, coloured by class of motion.

The cube is read block by block, twice: first for the range of the points and the shares of absent cells,
then for the points. So memory does not grow with the cube.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.analysis.run import OpenRun
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import split_dims
from pipeline.plots import labels, pixels, style
from pipeline.plots.bands import draw_bands, with_bands
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.plots.missing_cells import absent_handles, draw_absent, say_empty
from pipeline.plots.points import Survey, View, make_view, survey
from pipeline.plots.selection import at_points
from pipeline.products.figures import BifurcationOptions

LAYOUTS = ("overlay", "side")
EXTREMES = ("min", "max", "mean")


@style.drawn
def plot_bifurcation(
    ds: xr.Dataset,
    *,
    state: str = "",
    quantity: str = "",
    degrees: bool = False,
    layout: str = "overlay",
    at: Mapping[str, float] | None = None,
    bands: xr.Dataset | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the bifurcation diagram of a run: its section points over the swept parameter, coloured by class of motion.

    Everything is read from the cube; nothing is integrated. The model's classifier defines the classes of
    motion; without a classifier, all points have one colour. Where cells are pending, diverged, failed or
    not reached, a strip below the diagram shows their share at each value of the parameter. The legend gives
    their numbers. The diagram is shaded where no cell is left to draw.

    Parameters
    ----------
    ds
        Cube of a continuation or a sweep, as `pipeline.open_run` gives it.
    state
        Name of the state drawn; by default the model's first.
    quantity
        Instead of a state at the section: the least, largest or mean value of a quantity in each kept
        period, as ``NAME.min``, ``NAME.max`` or ``NAME.mean``; the cube needs the product ``extremes``.
    degrees
        Degrees instead of radians.
    layout
        ``overlay``: branches up (small dark points) over branches down (larger light points) in one
        panel. ``side``: a panel each.
    at
        Values of all swept parameters but one.
    bands
        From the analysis ``bands``: 95 % bands of the orbits and intervals of the bifurcations, drawn below the points.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        For a cube without a finished cell it says so. Its `data` hold the points drawn, as
        `pipeline.plots.pixels.draw_points` says, and the numbers of ``cells`` and of ``absent`` cells.

    Raises
    ------
    ValueError
        If the state, quantity or layout is unknown, if not exactly one swept parameter is left, or if the
        layout is ``side`` and the cube lacks a direction.
    """
    style.check_choice("layout", layout, LAYOUTS)
    diagram = Diagram.of(ds, state=state, quantity=quantity, degrees=degrees, at=at, frame=frame)
    fig = style.new_figure(4.3, xr.Dataset(), frame)
    panels = _panels(fig, diagram, _layers(diagram.view.layers, layout))
    handles = diagram.handles(layers=layout == "overlay")
    if bands is not None:
        if quantity:
            raise ValueError(f"bands are of states at the section; drop the quantity {quantity!r}, or the posterior")
        for panel in panels:
            entries = draw_bands(panel.ax, bands, diagram.measure)
        handles += entries
    style.complete(fig, panels[0].ax, diagram.caption, handles)
    fig.data = diagram.draw(panels)
    if bands is not None:
        fig.data = with_bands(fig.data, bands)
    return fig


@dataclass(frozen=True)
class Diagram:
    """A bifurcation diagram that can be drawn into axes of any figure.

    Attributes
    ----------
    measure : Measure
        The vertical axis.
    """

    view: View
    survey: Survey
    measure: Measure
    parameter: str
    frame: style.Frame

    @classmethod
    def of(
        cls,
        ds: xr.Dataset,
        *,
        state: str = "",
        quantity: str = "",
        degrees: bool = False,
        at: Mapping[str, float] | None = None,
        frame: style.Frame = style.WIDE,
    ) -> Diagram:
        """Prepare the bifurcation diagram of a result cube, with the arguments of `plot_bifurcation`."""
        if quantity and state:
            raise ValueError(f"a diagram is drawn of a state or of a quantity; drop {state!r} or {quantity!r}")
        part = at_points(ds, at)
        parameter = swept_parameter(part)
        if quantity:
            measure, values = _extreme(part, quantity, degrees)
        else:
            measure, values = _section(part, state, degrees)

        def coordinates(block: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
            dims = block["status"].dims
            x = (xr.zeros_like(block["status"], dtype=np.float64) + block[parameter]).transpose(*dims)
            return x.values[..., None], measure.shown(values(block).transpose(*dims, "period_index").values)

        view = make_view(part, ("extremes" if quantity else "section",), coordinates)
        found = survey(view, along=parameter, xlim=frame.xlim, ylim=frame.ylim)
        return cls(view, found, measure, parameter, frame)

    @property
    def x(self) -> np.ndarray:
        """Return the values of the swept parameter."""
        return np.asarray(self.view.ds[self.parameter].values, dtype=np.float64)

    @property
    def layers(self) -> tuple[int, ...]:
        """Indices of the directions of continuation (up, down) that the diagram shows; one index for a sweep."""
        return tuple(range(len(self.view.layers)))

    @property
    def caption(self) -> str:
        """Caption of the diagram: the values of all axes that are not drawn."""
        return labels.caption(self.view.ds, drop=[self.parameter])

    @property
    def with_strip(self) -> bool:
        """Whether a strip below the diagram is needed, which shows the share of cells without points."""
        return any(counts.any() for counts in self.survey.absent.values())

    def dress(self, ax: Axes) -> None:
        """Set the limits, the ticks and the vertical label of axes for the diagram."""
        style.style_axes(ax)
        style.limits(ax, self.frame, style.span(self.x), self._heights())
        labels.angle_ticks(ax, self.measure)
        style.label_axes(ax, y=self.measure.label)
        if self.survey.empty:
            say_empty(ax, self.survey, "in these ranges")

    def _heights(self) -> tuple[float, float]:
        if self.survey.empty:
            half = self.measure.half_turn if self.measure.on_circle else 1.0
            return -half, half
        low, high = self.survey.y
        least = 2e-3 * (self.measure.half_turn if self.measure.on_circle else max(abs(low), abs(high), 1e-12))
        margin = max(0.04 * (high - low), least)
        if self.measure.on_circle:
            reach = max(1.01 * self.measure.half_turn, abs(low), abs(high))
            return max(low - margin, -reach), min(high + margin, reach)
        return low - margin, high + margin

    def handles(self, *, layers: bool = True, absent: bool = True) -> list[Any]:
        """Return the legend's entries for classes of motion, directions of continuation and cells without points."""
        motions, kinds = self.view.motions, {code for _, code in self.survey.classes}
        found: list[Any] = []
        if motions.told:
            found += [style.dot(motions.words[c], motions.colours[c]) for c in motions.drawn if c in kinds]
        if layers and len(self.view.layers) > 1 and not self.survey.empty:
            for i, look in pixels.looks(1.0, range(len(self.view.layers))).items():
                found.append(style.dot(self.view.layers[i], style.tinted("black", look.tint), 3.0 + 3.0 * i))
        return found + (absent_handles(self.survey) if absent else [])

    def draw(self, panels: Sequence[pixels.Panel]) -> xr.Dataset:
        """Draw the points into axes that have their final positions, and return the drawn data."""
        width = 72.0 * self.frame.width_in * 0.88 / len(panels)
        left, right = panels[0].ax.get_xlim()
        shown = int(np.count_nonzero((self.x >= min(left, right)) & (self.x <= max(left, right))))
        drawn = pixels.draw_points(panels, self.view, min(1.7, max(0.75, 0.8 * width / max(shown, 1))))
        axis = self.view.ds[self.parameter]
        drawn["x"].attrs = {"units": shown_unit(axis.attrs), "long_name": self.parameter}
        drawn["y"].attrs = {"units": self.measure.unit, "long_name": self.measure.name}
        counts = {
            "cells": self.survey.cells,
            **{f"absent_{k.replace(' ', '_')}": v for k, v in self.survey.absent.items()},
        }
        dims = ("layer", self.parameter)
        drawn = drawn.assign({name: (dims, values) for name, values in counts.items() if values.any()})
        drawn = drawn.assign_coords({self.parameter: axis.variable, **fixed_of(self.view.ds)})
        return drawn.assign_attrs(title="bifurcation diagram", parameter=self.parameter)


def with_diagram(data: xr.Dataset, drawn: xr.Dataset) -> xr.Dataset:
    """Add the drawn data of a bifurcation diagram to the data of a figure, under names that end in ``_diagram``."""
    drawn = drawn.drop_vars([c for c in drawn.coords if c in data.variables or c in data.dims])
    renamed = drawn.rename({str(n): f"{n}_diagram" for n in (*drawn.data_vars, *drawn.dims)})
    return data.merge(renamed).assign_attrs(data.attrs)


def fixed_of(ds: xr.Dataset) -> dict[str, Any]:
    """Return the scalar coordinates of a dataset that are floating-point numbers, by name."""
    return {str(k): v.variable for k, v in ds.coords.items() if not v.ndim and v.dtype.kind == "f"}


def _section(ds: xr.Dataset, state: str, degrees: bool) -> tuple[Measure, Any]:
    measure = labels.state_measure(ds, state, degrees)
    return measure, lambda block: block["section"].sel(state=measure.name, drop=True)


def _extreme(ds: xr.Dataset, quantity: str, degrees: bool) -> tuple[Measure, Any]:
    """Return the axis label of an extreme such as ``NAME.max``, and a function that reads its values."""
    if "extremes" not in ds:
        wanted = quantity.rpartition(".")[0] or quantity
        raise ValueError(
            "the cube has no extremes of quantities; run it with "
            f'[products] extremes = {{ quantities = ["{wanted}"] }} in its specification'
        )
    name, _, kind = quantity.rpartition(".")
    if kind not in EXTREMES or not name:
        raise ValueError(f"quantity {quantity!r}: must be NAME.min, NAME.max or NAME.mean")
    style.check_choice("quantity", name, [str(n) for n in ds["quantity"].values])
    plain = labels.quantity_measure(ds, name, degrees)
    words = {"min": "least", "max": "largest", "mean": "mean"}
    measure = Measure(f"{name}.{kind}", f"{words[kind]} {plain.symbol}", plain.unit, plain.factor, False)
    return measure, lambda block: block["extremes"].sel(quantity=name, extreme=kind, drop=True)


def swept_parameters(ds: xr.Dataset) -> list[str]:
    """Return the names of the swept parameters of a result cube."""
    return list(split_dims(ds["status"])[0])


def swept_parameter(ds: xr.Dataset, instead: str = "draw a map of regimes") -> str:
    """Return the one swept parameter of a result cube; raise ValueError if there are several or none.

    `instead` says what to draw over two parameters.
    """
    outer = swept_parameters(ds)
    long = [dim for dim in outer if ds.sizes[dim] > 1]
    if len(long) > 1:
        first = long[1] if long[0] == "frequency" else long[0]
        value = float(np.asarray(ds[first].values)[0])
        raise ValueError(
            f"the cube sweeps {' and '.join(long)}, and a diagram has one axis for them; "
            f"choose a value first, such as --at {first}={value:g}, or {instead}"
        )
    if not outer:
        raise ValueError("the cube sweeps no parameter: there is nothing to draw the sections over")
    return (long or outer)[0]


def _layers(names: Sequence[str], layout: str) -> list[tuple[int, ...]]:
    if layout == "overlay":
        return [tuple(range(len(names)))]
    if len(names) < 2:
        raise ValueError(
            "layout 'side' needs branches up and down, and this cube has "
            f"{names[0] or 'no directions'} only; use layout 'overlay'"
        )
    return [(i,) for i in range(len(names))]


def _panels(fig: style.DataFigure, diagram: Diagram, layers: Sequence[tuple[int, ...]]) -> list[pixels.Panel]:
    """Make the diagram's panels. Each has axes for the points and, if needed, a strip for cells without points."""
    strip = diagram.with_strip
    grid = fig.add_gridspec(2 if strip else 1, len(layers), height_ratios=[1.0, 0.08] if strip else None)
    panels: list[pixels.Panel] = []
    label = labels.parameter_label(diagram.view.ds[diagram.parameter])
    for column, shown in enumerate(layers):
        ax = fig.add_subplot(grid[0, column], sharey=panels[0].ax if panels else None)
        diagram.dress(ax)
        lowest = ax
        if strip:
            lowest = fig.add_strip(ax, grid[1, column])
            style.style_axes(lowest, minor=False)
            draw_absent(ax, lowest, diagram.x, diagram.survey, shown)
            ax.tick_params(labelbottom=False)
        style.label_axes(lowest, x=label)
        if column:
            ax.set_ylabel("")
            for axes in (ax, lowest):
                axes.tick_params(labelleft=False)
        if len(layers) > 1:
            ax.text(
                0.045, 0.955, diagram.view.layers[column], transform=ax.transAxes, va="top", fontsize=fig.look.label
            )
        panels.append(pixels.Panel(ax, shown))
    return panels


def draw(run: OpenRun, options: BifurcationOptions) -> style.DataFigure:
    """Draw the figure ``bifurcation`` of a run."""
    cube = run.cube()
    at, notes = values_of(run, options)
    figure = plot_bifurcation(
        cube,
        state="" if options.quantity else options.state,
        quantity=options.quantity,
        degrees=options.degrees,
        layout=options.layout,
        at=at,
        bands=run.derive("bands", posterior=options.posterior) if options.posterior else None,
        frame=frame_of(options),
    )
    return noted(figure, notes)
