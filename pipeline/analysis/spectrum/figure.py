"""Draw spectra: of one parameter point in panels, and along a parameter as colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps, rcParams
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from scipy.signal import find_peaks

from pipeline.analysis.spectrum.analysis import AVERAGE, FOLDED, LINES, NONE, axes_of
from pipeline.analysis.spectrum.declaration import (
    SpectraOptions,
    SpectrumFigureOptions,
    SpectrumOptions,
    WaterfallOptions,
)
from pipeline.analysis.spectrum.estimate import Settings, power_unit
from pipeline.analysis.spectrum.motions import swept_by
from pipeline.layout.vocabulary import ATTRACTS, KINDS, STABILITIES, TORUS, letter
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.results.run import OpenRun


@style.drawn
def plot_spectrum(
    ds: xr.Dataset,
    *,
    axis: str = "",
    degrees: bool = False,
    looks: list[tuple[str, str]] | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw each spectrum of a dataset in a panel: amplitudes of lines, or power where a motion does not close.

    Parameters
    ----------
    ds
        From the analysis ``spectrum`` or from `magpend.spectrum_of`; the 6 rows of the largest share are
        drawn.
    axis
        ``order`` or ``Hz``; by default orders where the dataset has them.
    degrees
        Degrees for a channel that is an angle.
    looks
        Colour and name of each row.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Of a torus the lines f, f2 and their first combinations are named. Its `data` are the rows drawn.

    Raises
    ------
    ValueError
        If nothing could be measured, or orders are asked for without a drive.
    """
    most = 6  # spectra of one point that are drawn: those of the largest shares
    looks = looks or [("black", "")] * ds.sizes["spectrum"]
    good = [i for i in range(ds.sizes["spectrum"]) if "estimate" not in ds or int(ds["estimate"][i]) != NONE]
    if not good:
        raise ValueError("no spectrum could be measured: every trajectory failed.")
    if "share" in ds:
        good = sorted(sorted(good, key=lambda i: -np.nan_to_num(float(ds["share"][i])))[:most])
    data = ds.isel(spectrum=good)
    column = _column(ds, axis)
    measure = _measure(ds, degrees)
    fig = style.new_figure(1.3 + 1.75 * len(good), data, frame)
    axes = fig.subplots(len(good), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (colour, name), k in zip(axes, [looks[i] for i in good], range(len(good)), strict=True):
        style.style_axes(ax)
        one = data.isel(spectrum=k)
        _draw_one(ax, one, column, measure, colour)
        ax.set_title(style.join([name, *_evidence(one, column)]), loc="left", fontsize=fig.look.legend)
    style.limits(axes[-1], frame, (0.0, 1.02 * max(_end(data.isel(spectrum=k), column) for k in range(len(good)))))
    for ax, k in zip(axes, range(len(good)), strict=True):
        _name_lines(ax, data.isel(spectrum=k), column)
    style.label_axes(axes[-1], _label(ds, column))
    fig.align_ylabels(axes)
    if text := _fixed(data):
        fig.suptitle(text, x=0.01, ha="left", fontsize=fig.look.title)
    style.finish(fig)
    return fig


def _end(one: xr.Dataset, column: str) -> float:
    """Return the frequency below which almost all of the power lies; the larger ones would be an empty plane."""
    is_lines = "estimate" in one and int(one["estimate"]) == LINES
    x, power = one[column].values, one["amplitude"].values ** 2 if is_lines else one["power"].values
    there = np.isfinite(x) & (power > 0.0)
    x, power = x[there], power[there]
    if not len(x):
        return 1.0
    beyond = power.sum() - np.cumsum(power)
    return max(float(x[np.argmax(beyond <= FOLDED * power.sum())]), 2.0 if column == "order" else 0.0)


def _fixed(data: xr.Dataset) -> str:
    """Return a caption with the parameter values that all rows share."""
    rows = {swept_by(name): data[name] for name in axes_of(data)}
    own = {name: ((), float(v[0]), v.attrs) for name, v in rows.items() if (v == v[0]).all()}
    plain = data.drop_vars([n for n, v in data.coords.items() if v.dims])
    return labels.caption(plain.assign_coords(own), with_start=False)


def _column(ds: xr.Dataset, axis: str) -> str:
    if axis == "order" and "order" not in ds.coords:
        raise ValueError("axis order: there is no drive whose multiples orders could be; take Hz.")
    return "order" if "order" in ds.coords and axis != "Hz" else "frequency_hz"


def _label(ds: xr.Dataset, column: str) -> str:
    return "frequency [Hz]" if column == "frequency_hz" else "order [multiples of the drive frequency]"


def _measure(ds: xr.Dataset, degrees: bool) -> Measure:
    channel, unit = str(ds.attrs["channel"]), str(ds.attrs["unit"])
    try:
        return labels.quantity_measure(ds, channel, degrees)
    except (LookupError, ValueError):
        if degrees:
            raise
    return Measure(channel, channel, unit)  # a recording may have variables that no model has


def _draw_one(ax: Axes, one: xr.Dataset, column: str, measure: Measure, colour: str) -> None:
    # decades below the largest value that are drawn: further down are errors of the integration
    of_lines, of_power = 6.0, 11.0
    is_lines = "estimate" in one and int(one["estimate"]) == LINES
    x = one[column].values
    y = one["amplitude"].values * measure.factor if is_lines else one["power"].values * measure.factor**2
    there = np.isfinite(x) & (y > 0.0)
    x, y = x[there], y[there]
    ax.set_yscale("log")
    if is_lines:
        low = max(y.max(initial=0.0) * 10.0**-of_lines, 10.0 * float(one["error"])) if len(y) else 1e-6
        x, y = x[y > low], y[y > low]
        ax.vlines(x, low, y, color=colour, linewidth=1.1, gid="lines")
        style.points(ax, x, y, 3.4, colour, gid="tops")
        what, unit = "amplitude", measure.unit
    else:
        low = y.max(initial=1e-12) * 10.0**-of_power
        ax.plot(x, y, color=colour, linewidth=0.8, gid="power")
        scaling = str(one.attrs["scaling"])
        what, unit = "density" if scaling == "density" else "power", power_unit(measure.unit, scaling)
    if len(y):
        ax.set_ylim(max(low, 0.3 * y.min()), 10.0 * y.max())
    else:
        style.write(ax, "at rest")
    style.label_axes(ax, None, labels.with_unit(f"{what} of {measure.symbol}", unit if unit != "1" else ""))


def _evidence(one: xr.Dataset, column: str) -> list[str]:
    """Return what a spectrum rests on: the resolution of an average; of a torus its second frequency."""
    if "estimate" in one and int(one["estimate"]) == LINES:
        return []
    told = [_resolution(one, column)]
    if "n_interpolated" in one:  # of a series; orders of a run are cut where the user says
        told += [f"{int(n)} samples interpolated"] if (n := one["n_interpolated"]) else []
        told += [f"{float(kept):.0%} of the variance in the bins"] if (kept := one["kept"]) < Settings.kept else []
    if "kind" in one and int(one["kind"]) == TORUS:
        second = float(one["second_hz"])
        told.insert(0, f"$f_2$ = {second:.6g} Hz" if np.isfinite(second) else "no second frequency decided")
    return told


def _resolution(one: xr.Dataset, column: str) -> str:
    """Return the number of averages of a spectrum, and its resolution."""
    width, rate = (float(one[name]) if name in one else np.nan for name in ("resolution_hz", "rate_hz"))
    fine = f"{width / rate:.3g} orders" if column == "order" and np.isfinite(rate) else f"{width:.3g} Hz"
    return style.join([f"{int(one['n_averages'])} averages", f"resolution {fine}"])


def _name_lines(ax: Axes, one: xr.Dataset, column: str) -> None:
    """Name the largest lines of a torus by its two frequencies, such as 2f - f2, where the names do not collide."""
    most_names, apart = 6, (0.055, 0.07)  # largest number of names, and their least distances on the axes
    if "second_hz" not in one or not np.isfinite(float(one["second_hz"])):
        return
    x, y = np.asarray(ax.get_lines()[0].get_xydata()).T
    (left, right), (low, high) = ax.get_xlim(), np.log10(ax.get_ylim())
    level = np.maximum(np.log10(y), low)
    peaks, _ = find_peaks(level, prominence=1.0)
    names = _names(one, column)
    taken: list[tuple[float, float]] = []
    for peak in peaks[np.argsort(-level[peaks])]:
        name = next((text for place, text in names if abs(place - x[peak]) <= x[1] - x[0]), "")
        spot = (x[peak] - left) / (right - left), (level[peak] - low) / (high - low)
        free = all(abs(spot[0] - a) > apart[0] or abs(spot[1] - b) > apart[1] for a, b in taken)
        if name and free and 0.03 < spot[0] < 0.97 and len(taken) < most_names:
            taken.append(spot)
            look: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom"}
            ax.annotate(
                name, (x[peak], y[peak]), (0, 2), path_effects=style.halo(), fontsize=style.look_of(ax).tick, **look
            )


def _names(one: xr.Dataset, column: str) -> list[tuple[float, str]]:
    """Return places and names of the combinations of the two frequencies of a torus, the simplest first."""
    largest = 3  # sum of multiples in the name of a line of a torus
    first, second = float(one["first_hz"]), float(one["second_hz"])
    unit = first if column == "order" else 1.0
    both = [(m, n) for m in range(-largest, largest + 1) for n in range(-largest, largest + 1)]
    both.sort(key=lambda one: abs(one[0]) + abs(one[1]))
    places = [((m * first + n * second) / unit, _combination(m, n)) for m, n in both]
    return [(place, name) for place, name in places if place > 0.0]


def _combination(first: int, second: int) -> str:
    """Return the name of a combination of the frequencies f and f2, its positive part first."""
    parts = sorted(((first, "f"), (second, "f_2")), key=lambda part: part[0] < 0)
    text = ""
    for number, name in parts:
        if number:
            sign = "-" if number < 0 else "+" if text else ""
            text += f"{sign}{abs(number) if abs(number) > 1 else ''}{name}"
    return f"${text}$"


@style.drawn
def plot_waterfall(
    ds: xr.Dataset, *, axis: str = "", degrees: bool = False, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw spectra over a swept parameter, as colours: at each value that of the set with the largest share.

    Parameters
    ----------
    ds
        From the analysis ``spectrum``.
    axis, degrees, frame
        See `plot_spectrum`.

    Returns
    -------
    DataFigure
        Colours are amplitudes: those of lines, and of a motion that does not close that of a sine with the power of a
        bin. With the scaling ``density`` they are power per hertz, of a line over the width of a bin. Its `data` are
        the spectra drawn.

    Raises
    ------
    ValueError
        If nothing could be measured, there is not one axis, or orders are asked for without a drive.
    """
    decades = 3.0  # that the colours span
    swept = [name for name in axes_of(ds) if len(np.unique(ds[name])) > 1]
    if len(swept) != 1:
        raise ValueError(f"a waterfall is drawn along one axis, and the spectra have {', '.join(swept) or 'none'}.")
    along = swept[0]
    data = ds.isel(spectrum=_largest(ds, along))
    if not data.sizes["spectrum"]:
        raise ValueError("no spectrum could be measured: every trajectory failed.")
    column, measure = _column(ds, axis), _measure(ds, degrees)
    x = np.unique(ds[along].values)
    top = max(frame.ylim) if frame.ylim else max(_end(data.isel(spectrum=k), column) for k in range(len(x)))
    y, image = _image(data, along, x, column, min(1.02 * top, float(np.nanmax(data[column]))))
    is_density = str(ds.attrs["scaling"]) == "density"
    image = image * measure.factor ** (2 if is_density else 1)
    fig = style.new_figure(4.4, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=False)
    brightest = float(np.nanmax(image))
    low = brightest * 10.0 ** -(decades * (2 if is_density else 1))
    norm = LogNorm(low, brightest)
    shown = np.ma.masked_invalid(np.where(image < low, np.nan, image))
    ramp = colormaps[rcParams["image.cmap"]].reversed()  # faint values are light, as the paper beside them
    ax.pcolormesh(style.edges(x), style.edges(y), shown, norm=norm, cmap=ramp, rasterized=True, gid="waterfall")
    style.limits(ax, frame, None, (0.0, float(y.max())))
    coordinate = ds[along].rename(swept_by(along))
    style.label_axes(ax, labels.parameter_label(coordinate), _label(ds, column))
    unit = power_unit(measure.unit, "density") if is_density else measure.unit
    text = f"{'density' if is_density else 'amplitude'} of {measure.symbol}"
    bar = fig.colorbar(ScalarMappable(norm, ramp), ax=ax, pad=0.015, aspect=32, extend="min")
    style.style_bar(bar, labels.with_unit(text, unit if unit != "1" else ""))
    style.caption(ax, _told(data, column))
    style.finish(fig)
    return fig


def _told(data: xr.Dataset, column: str) -> str:
    """Return the caption: what the colours of motions that do not close rest on."""
    own = data["estimate"].values == AVERAGE
    parts = [_fixed(data)]
    if own.any():
        told = _resolution(data.isel(spectrum=int(np.flatnonzero(own)[0])), column)
        parts.append(f"where no orbit closes: {told}")
    ids = sorted(set(data["attractor"].values.tolist()))
    parts.append(f"sets {', '.join(map(letter, ids))}" if len(ids) > 1 else f"set {letter(ids[0])}")
    return style.join(parts)


def _largest(ds: xr.Dataset, along: str) -> np.ndarray:
    """Return for each value of the parameter the row of the set with the largest share, those that attract first."""
    values = ds[along].values
    order = np.lexsort(
        (ds["attractor"].values, -np.nan_to_num(ds["share"].values), ds["stability"].values != ATTRACTS, values)
    )
    order = order[ds["estimate"].values[order] != NONE]
    _, first = np.unique(values[order], return_index=True)
    return np.asarray(order[first])


def _image(data: xr.Dataset, along: str, x: np.ndarray, column: str, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places on the vertical axis up to `top`, and the colour of each at each parameter value; NaN where there
    is none.
    """
    n_rows = 720  # rows of the image
    bins = data[column].values
    y = (np.arange(n_rows) + 0.5) * top / n_rows
    image = np.full((n_rows, len(x)), np.nan)
    is_density = str(data.attrs["scaling"]) == "density"
    for k in range(data.sizes["spectrum"]):
        one = data.isel(spectrum=k)
        place = int(np.searchsorted(x, float(one[along])))
        own = bins[k][np.isfinite(bins[k])]
        if not len(own):
            continue
        nearest = np.clip(np.searchsorted(own, y - 0.5 * (own[1] - own[0] if len(own) > 1 else 0.0)), 0, len(own) - 1)
        if int(one["estimate"]) == AVERAGE:
            power = one["power"].values[: len(own)]
            shown = power if is_density else np.sqrt(2.0 * power)
            image[:, place] = np.where(y <= own[-1], shown[nearest], np.nan)
            continue
        amplitude = one["amplitude"].values[: len(own)]
        shown = 0.5 * amplitude**2 / float(one["bandwidth_hz"]) if is_density else amplitude
        # of equal orders the same, in spite of rounding
        rows = np.floor(own / top * n_rows + 1e-6).astype(int)
        rows, shown = rows[rows <= n_rows], shown[rows <= n_rows]
        for thick in (-1, 0, 1):
            near = np.clip(rows + thick, 0, n_rows - 1)
            image[near, place] = np.fmax(image[near, place], shown)
    return y, image


def draw_spectrum(run: OpenRun, options: SpectrumFigureOptions) -> style.DataFigure:
    """Draw the figure ``spectrum`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("spectrum", **{**options.part(SpectrumOptions), "at": at})
    looks = _looks(run, found, options.cell)
    figure = plot_spectrum(found, axis=options.axis, degrees=options.degrees, looks=looks, frame=frame_of(options))
    return noted(figure, notes)


def _looks(run: OpenRun, found: xr.Dataset, cell: int | None) -> list[tuple[str, str]]:
    """Return the colour of each row's attractor, and its letter with the kind."""
    cast = palette.cast_of(run.derive("attractors"))
    looks = []
    for i, number in enumerate(found["attractor"].values.tolist()):
        kind, stability = KINDS[int(found["kind"][i])], int(found["stability"][i])
        period = int(found["orbit_period"][i])
        words = f"period {period}" if period else kind.replace("_", " ")
        if stability != ATTRACTS:
            words += f", {STABILITIES[stability].replace('_', ' ')}"
        name = f"{letter(number)}: {words}" if number >= 0 else words
        looks.append((cast.colours.get(number, "black"), f"cell {cell}, {name}" if cell is not None else name))
    return looks


def draw_waterfall(run: OpenRun, options: WaterfallOptions) -> style.DataFigure:
    """Draw the figure ``waterfall`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("spectrum", **{**options.part(SpectraOptions), "at": at})
    figure = plot_waterfall(found, axis=options.axis, degrees=options.degrees, frame=frame_of(options))
    return noted(figure, notes)
