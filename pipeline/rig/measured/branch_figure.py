"""Draw measured orbits with error bars over computed branches. The markers of stable orbits are filled, the markers of
unstable orbits are open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.plots import labels, style
from pipeline.plots.bifurcation import thin
from pipeline.rig.measured.branch import STABILITIES


@dataclass(frozen=True)
class Bands:
    """Data of the 95 % bands in a figure: (``x``, ``low``, ``high``) per branch, (name, low, high) per bifurcation."""

    tubes: Sequence[Mapping[str, np.ndarray]]
    intervals: Sequence[tuple[str, float, float]]


_LOOKS = {"stable": (style.VERMILLION, "o"), "unstable": ("white", "o"), "unknown": ("white", "s")}
"""Face colour and marker."""


@style.drawn
def plot_branch(
    measured: xr.Dataset,
    branches: xr.Dataset | None = None,
    computed: np.ndarray | None = None,
    *,
    bands: Bands | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the amplitudes of measured orbits over the parameter, with computed branches and their bands if there are
    any.

    Computed branches are solid where stable and dashed where not. Measured orbits are filled where they were stable,
    open where not, squares where unknown; bars are 2 scatters of single cycles to both sides. The data are the
    measured orbits, with the computed ``branch_parameter`` and ``branch_amplitude``.
    """
    half = 2.0  # half length of the error bars, in scatters of single cycles
    data = measured.drop_vars([k for k, v in measured.variables.items() if v.dtype == object])
    if branches is not None and computed is not None:
        data = data.assign(
            branch_parameter=(("branch_index", "point"), branches["parameter"].values),
            branch_amplitude=(("branch_index", "point"), computed),
        )
    fig = style.new_figure(4.0, data.assign_attrs(title="measured branch"), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    if branches is not None and computed is not None:
        _draw_computed(ax, branches, computed)
    entries = _draw_bands(ax, bands) if bands is not None else []
    low, high = float(measured["value"].min()), float(measured["value"].max())
    for code, word in enumerate(STABILITIES):
        part = measured.isel(orbit=np.flatnonzero(measured["stability"].values == code))
        if not part.sizes["orbit"]:
            continue
        scatter = np.nan_to_num(part["amplitude_sd"].values)
        face, marker = _LOOKS[word]
        entries.append(
            ax.errorbar(
                part["value"].values,
                part["amplitude"].values,
                half * scatter,
                linestyle="none",
                color=style.VERMILLION,
                markersize=5.0,
                capsize=2.0,
                linewidth=0.9,
                label=f"measured, {word}" if word != "unknown" else "measured",
                zorder=5,
                markerfacecolor=face,
                marker=marker,
            )
        )
    state, unit = str(measured.attrs["state"]), str(measured["amplitude"].attrs["units"])
    style.label_axes(
        ax,
        labels.swept_label(str(measured.attrs["parameter"]), str(measured["value"].attrs["units"])),
        labels.with_unit(f"amplitude of {state}", unit),
    )
    room = 0.12 * (high - low) or 0.1 * abs(high) or 1.0
    bars = measured["amplitude"].values + half * np.nan_to_num(measured["amplitude_sd"].values)
    style.limits(ax, frame, (low - room, high + room), (0.0, 1.15 * float(np.nanmax(bars))))
    style.hold(ax, *_drawn(branches, computed, bands))
    if bands is not None and bands.tubes:
        width = max(float(np.nanmax(tube["high"] - tube["low"])) for tube in bands.tubes)
        entries[0].set_label(f"95 %{thin(width, ax.get_ylim(), unit)}")
    style.caption(ax, f"bars: ±{half:g} scatters of single cycles")
    style.legend_above(fig, [*_computed_entries(ax), *entries])
    style.finish(fig)
    return fig


def _drawn(
    branches: xr.Dataset | None, computed: np.ndarray | None, bands: Bands | None
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the parameters and the amplitudes of all computed curves and bands."""
    x, y = [], []
    if branches is not None and computed is not None:
        x.append(np.where(np.isfinite(computed), branches["parameter"].values, np.nan))
        y.append(computed)
    if bands is not None:
        x += [np.asarray(tube["x"]) for tube in bands.tubes] + [np.array(ends) for _, *ends in bands.intervals]
        y += [np.asarray(tube["high"]) for tube in bands.tubes]
    return x, y


def _draw_bands(ax: Axes, bands: Bands) -> list[Any]:
    entries: list[Any] = []
    for tube in bands.tubes:
        shade = ax.fill_between(
            tube["x"], tube["low"], tube["high"], color=style.BLUE, alpha=0.25, linewidth=0.0, zorder=1, label="95 %"
        )
        entries = [shade]
    for k, (name, low, high) in enumerate(bands.intervals):
        y = 0.06 + 0.06 * k
        ax.plot([low, high], [y, y], transform=ax.get_xaxis_transform(), color=style.BLUE, linewidth=3.0, zorder=4)
        ax.annotate(
            name, (0.5 * (low + high), y), xycoords=ax.get_xaxis_transform(), xytext=(0.0, 4.0),
            textcoords="offset points", ha="center", color=style.BLUE, fontsize=style.look_of(ax).legend,
        )  # fmt: skip
    return entries


def _draw_computed(ax: Axes, branches: xr.Dataset, computed: np.ndarray) -> None:
    for i in range(branches.sizes["branch"]):
        n = int(branches["n_points"][i])
        x, unstable = branches["parameter"].values[i, :n], branches["n_unstable"].values[i, :n] > 0
        for which, dashes, name in ((~unstable, "-", "computed, stable"), (unstable, "--", "computed, unstable")):
            if not which.any():
                continue
            # a segment belongs to a class if one of its ends does, so that no gap is left at a bifurcation
            shown = which | np.append(which[1:], False)
            y = np.where(shown, computed[i, :n], np.nan)
            ax.plot(x, y, dashes, color="black", linewidth=1.1, label=name, gid=f"branch:{i}", zorder=3)


def _computed_entries(ax: Axes) -> list[object]:
    found = {str(line.get_label()): line for line in ax.lines if str(line.get_label()).startswith("computed")}
    return [found[name] for name in sorted(found)]
