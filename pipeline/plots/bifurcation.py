"""Draw bifurcation diagrams, with bands about computed orbits, and the share of cells without points below."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import split_dims
from pipeline.plots import labels, pixels, style
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.plots.measured import columns_of, draw_sections, points_of, with_points
from pipeline.plots.points import Survey, View, make_view, survey
from pipeline.plots.style import hold
from pipeline.products.diagrams import BifurcationOptions
from pipeline.results.draws import LEAST_SHARE, interval_of, stretches
from pipeline.results.run import OpenRun

SHADE: dict[str, Any] = {"color": style.BLUE, "alpha": 0.3, "linewidth": 0.0, "zorder": 2.0}
BAR: dict[str, Any] = {"color": style.BLUE, "linewidth": 2.2, "solid_capstyle": "butt", "zorder": 7.5}


def draw_bands(ax: Axes, bands: xr.Dataset, measure: Measure, max_period: int | None = None) -> list[Any]:
    """Shade the bands about the section points of orbits, and draw the intervals of bifurcations as horizontal bars.

    A bar goes through the first section point of its bifurcation. Bifurcations at which no stable orbit begins or ends
    have none, and neither have those that fewer than half of the draws have. The axes are widened to hold both, unless
    the user chose them. Return handles for the legend; those of bands and bars that are as thin as a line have the
    width.
    """
    tubes = list(_tubes(bands, measure, max_period))
    bars = list(_bars(bands, measure, max_period))
    edges = [(x, y) for x, below, above in tubes for y in (below, above)] + [
        (np.array(b[:2]), np.array(b[2:])) for b in bars
    ]
    hold(ax, [x for x, _ in edges], [] if measure.on_circle else [y for _, y in edges])
    for x, below, above in tubes:
        ax.fill_between(x, below, above, **SHADE, gid="band")
    for low, high, y in bars:
        ax.plot([low, high], [y, y], scalex=False, scaley=False, gid="interval", **BAR)
    handles: list[Any] = []
    if tubes:
        width = max(float(np.nanmax(above - below)) for _, below, above in tubes)
        text = f"95 % of the orbits{thin(width, ax.get_ylim(), measure.unit)}"
        handles.append(Patch(label=text, **{**SHADE, "zorder": None}))
    if bars:
        unit = str(bands.attrs.get("parameter_units", ""))
        text = f"95 % of bifurcations{thin(max(b - a for a, b, _ in bars), ax.get_xlim(), unit)}"
        handles.append(Line2D([], [], label=text, color=BAR["color"], linewidth=BAR["linewidth"]))
    return handles


HAIRLINE = 0.01
"""Width of a band relative to that of the axes, below which it looks like a line and is stated as a number."""


def thin(width: float, limits: tuple[float, float], unit: str) -> str:
    """Return the largest width of bands as words if they look like a line on axes with such limits; else nothing."""
    if not width < HAIRLINE * abs(limits[1] - limits[0]):
        return ""
    return f", at most {width:.2g}{'' if unit in ('', '1') else f' {labels.raised(unit)}'} wide"


def _tubes(
    bands: xr.Dataset, measure: Measure, max_period: int | None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the parameter and the two edges of the band about each section point of each stretch of a branch."""
    levels = bands["section_level"].sel(state=measure.name).values
    low, high = levels[0], levels[-1]
    for _, _, chosen in stretches(bands):
        period = int(np.isfinite(low[chosen]).any(axis=0).sum())
        if max_period is None or period <= max_period:
            for phase in range(period):
                below, above = (measure.shown(edge[chosen, phase]) for edge in (low, high))
                yield bands["parameter_value"].values[chosen], below, above


def _bars(bands: xr.Dataset, measure: Measure, max_period: int | None) -> Iterator[tuple[float, float, float]]:
    """Yield the ends of the interval of each bifurcation, and its height."""
    for k in range(bands.sizes["bifurcation"]):
        one = bands.isel(bifurcation=k)
        low, _, high, n_known = interval_of(one["bifurcation_value"].values)
        too_long = max_period is not None and int(one["orbit_period"]) > max_period
        if not too_long and bool(one["is_border"]) and n_known >= LEAST_SHARE * bands.sizes["draw"]:
            yield low, high, float(measure.shown(one["bifurcation_section"].sel(state=measure.name).values)[0])


def with_bands(data: xr.Dataset, bands: xr.Dataset) -> xr.Dataset:
    """Add the drawn bands to the data of a figure, under names that end in ``_bands``."""
    plain = bands.drop_vars([k for k, v in bands.variables.items() if v.dtype == object or k == "state"])
    plain = plain.assign({k: v.astype(np.int8) for k, v in plain.data_vars.items() if v.dtype == bool})
    renamed = plain.rename({str(n): f"{n}_bands" for n in (*plain.variables, *plain.dims) if n != "state"})
    return data.merge(renamed).assign_attrs(data.attrs)


# Greys instead of hatching: some readers of SVG paint its patterns black.
LOOKS: dict[str, dict[str, Any]] = {
    "pending": {"facecolor": "0.92", "edgecolor": "0.6", "linewidth": 0.4},
    "diverged": {"facecolor": "0.0", "edgecolor": "0.0", "linewidth": 0.8},
    "failed": {"facecolor": "0.28", "edgecolor": "0.28", "linewidth": 0.8},
    "not reached": {"facecolor": "0.62", "edgecolor": "0.62", "linewidth": 0.8},
    "no return": {"facecolor": "0.8", "edgecolor": "0.3", "linewidth": 0.6},
    "chatter": {"facecolor": "0.45", "edgecolor": "0.1", "linewidth": 0.6},
    "without exponent": {"facecolor": "1.0", "edgecolor": "0.3", "linewidth": 0.6},
}


def draw_absent(ax: Axes, strip: Axes, x: np.ndarray, survey: Survey, layers: Sequence[int]) -> None:
    """Draw in a strip below a diagram the share of cells without points, and shade values where no cell has one.

    The survey counts the cells along the parameter `x`; `layers` are the indices of the directions that the axes show.
    """
    edges = style.edges(x)
    cells = survey.cells[list(layers)].sum(0)
    floor = np.zeros(cells.size)
    for name, counts in survey.absent.items():
        share = counts[list(layers)].sum(0) / np.maximum(cells, 1)
        if share.any():
            style.fill_columns(strip, edges, floor, floor + share, LOOKS[name], f"absent:{name}")
            floor = floor + share
    strip.set_ylim(0.0, 1.0)
    strip.set_yticks([0.5], ["absent"])
    strip.tick_params(axis="y", which="both", right=False, left=False)
    strip.tick_params(axis="x", which="both", top=False)
    shade_blank(ax, x, survey, layers)


def shade_blank(ax: Axes, x: np.ndarray, survey: Survey, layers: Sequence[int]) -> None:
    """Shade a diagram at the parameter values where no cell has a point."""
    shown = list(layers)
    absent = sum((counts[shown].sum(0) for counts in survey.absent.values()), np.zeros(x.size, np.int64))
    blank = (absent >= np.maximum(survey.cells[shown].sum(0), 1)).astype(float)
    if blank.any():
        looks = {"facecolor": "0.955", "linewidth": 0.0, "zorder": 1.5}
        area = style.fill_columns(ax, style.edges(x), np.zeros(blank.size), blank, looks, "blank")
        area.set_transform(ax.get_xaxis_transform())


def absent_handles(survey: Survey) -> list[Patch]:
    """Return legend entries for the cells that have no point in the diagram: their number for each reason."""
    total = int(survey.cells.sum())
    return [
        Patch(label=f"{name}: {int(counts.sum())} of {total} cells", **LOOKS[name])
        for name, counts in survey.absent.items()
        if counts.any()
    ]


def say_empty(ax: Axes, survey: Survey, shown: str = "") -> None:
    """Write into empty axes why there is nothing to draw."""
    n_cells = int(survey.cells.sum())
    absent = {name: int(counts.sum()) for name, counts in survey.absent.items() if counts.any()}
    text = f"nothing to draw: of {n_cells} cells, " + style.join(f"{n} {name}" for name, n in absent.items())
    if not n_cells:
        text = "nothing to draw: the cube has no cells"
    elif absent.get("pending", 0) == n_cells:
        text = f"nothing to draw yet: all {n_cells} cells are pending"
    elif sum(absent.values()) < n_cells:
        text = f"nothing to draw: no point lies {shown or 'here'}"
    size = style.look_of(ax).label
    width = 0.8 * style.figure_of(ax).frame.width_in
    ax.text(
        0.5,
        0.5,
        style.folded(text, width, size),
        transform=ax.transAxes,
        ha="center",
        va="center",
        fontsize=size,
        zorder=3,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
    )


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
    points: xr.Dataset | None = None,
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
    points
        Measured points from `read_points`: the drawn state or quantity over the parameter. Those at other values of
        the axes in `at` are open.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        For a cube without a finished cell it says so. Its `data` hold the points drawn, as
        `pipeline.plots.pixels.draw_points` says, and the numbers of ``cells`` and of ``absent`` cells. Names of
        measured points begin with ``measured_``.

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
    if points is not None:
        for panel in panels:
            measured = draw_sections(panel.ax, points, diagram.measure, [diagram.level])
        handles += measured
    if bands is not None:
        if quantity:
            raise ValueError(f"bands are of states at the section; drop the quantity {quantity!r}, or the posterior")
        for panel in panels:
            entries = draw_bands(panel.ax, bands, diagram.measure)
        handles += entries
    style.complete(fig, panels[0].ax, diagram.caption, handles)
    fig.data = with_points(diagram.draw(panels), points)
    if bands is not None:
        fig.data = with_bands(fig.data, bands)
    return fig


@dataclass(frozen=True)
class Diagram:
    """A bifurcation diagram that can be drawn into axes of any figure."""

    view: View
    survey: Survey
    measure: Measure  # the vertical axis
    parameter: str
    level: tuple[tuple[str, float], ...]  # values of the other swept parameters
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
        measure, values = _extreme(part, quantity, degrees) if quantity else _section(part, state, degrees)

        def coordinates(block: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
            dims = block["status"].dims
            x = (xr.zeros_like(block["status"], dtype=np.float64) + block[parameter]).transpose(*dims)
            return x.values[..., None], measure.shown(values(block).transpose(*dims, "period_index").values)

        view = make_view(part, ("extremes" if quantity else "section",), coordinates)
        found = survey(view, along=parameter, xlim=frame.xlim, ylim=frame.ylim)
        level = tuple((name, float(part[name].values.ravel()[0])) for name in swept_parameters(ds) if name != parameter)
        return cls(view, found, measure, parameter, level, frame)

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

    def dress(self, ax: Axes, alone: bool = True) -> None:
        """Set the limits, the ticks and the vertical label of axes for the diagram; say if they are empty, when nothing
        else is drawn.
        """
        style.style_axes(ax)
        style.limits(ax, self.frame, style.span(self.x), self._heights())
        labels.angle_ticks(ax, self.measure)
        style.label_axes(ax, y=self.measure.label)
        if self.survey.empty and alone:
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
        # a parameter may be called x or y, as the drawn points are
        fixed = {_free(name, drawn): variable for name, variable in fixed_of(self.view.ds).items()}
        along = _free(self.parameter, drawn)
        drawn = drawn.assign({name: (("layer", along), values) for name, values in counts.items() if values.any()})
        drawn = drawn.assign_coords({along: xr.Variable((along,), axis.values, axis.attrs), **fixed})
        return drawn.assign_attrs(title="bifurcation diagram", parameter=self.parameter)


def _free(name: str, ds: xr.Dataset) -> str:
    """Return the name of a parameter among some variables, changed if one of them has it."""
    return f"{name}_parameter" if name in ds.variables else name


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
    state = "" if options.quantity else options.state
    points = None
    if options.points:
        part = at_points(cube, at)
        measure, _ = _extreme(part, options.quantity, False) if options.quantity else _section(part, state, False)
        points = points_of(run, options.points, swept_parameter(part), **columns_of(measure))
    figure = plot_bifurcation(
        cube,
        state=state,
        quantity=options.quantity,
        degrees=options.degrees,
        layout=options.layout,
        at=at,
        bands=run.derive("bands", posterior=options.posterior) if options.posterior else None,
        points=points,
        frame=frame_of(options),
    )
    return noted(figure, notes)
