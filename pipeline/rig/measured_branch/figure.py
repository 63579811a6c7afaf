"""Draw measured orbits over computed branches: stable filled, unstable open, with error bars."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.plots import labels, style
from pipeline.rig.measured_branch.reading import STABILITIES

BARS = 2.0
"""Half length of the error bars, in scatters of single cycles."""

_LOOKS = {"stable": (style.VERMILLION, "o"), "unstable": ("white", "o"), "unknown": ("white", "s")}
"""Face colour and marker."""


def plot_branch(
    measured: xr.Dataset,
    branches: xr.Dataset | None = None,
    computed: np.ndarray | None = None,
    *,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the amplitudes of measured orbits over the parameter, with computed branches if there are any.

    Parameters
    ----------
    measured
        From `read_branch`, compared or not.
    branches, computed
        Result of the analysis ``branches``, and the amplitudes of its orbits.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Computed branches are solid where stable and dashed where not. Measured orbits are filled where they were
        stable, open where not, squares where unknown; bars are `BARS` scatters of single cycles to both sides.
        Its `data` are the measured orbits, with the computed ``branch_parameter`` and ``branch_amplitude``.
    """
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
    low, high = float(measured["value"].min()), float(measured["value"].max())
    entries = []
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
                BARS * scatter,
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
    style.limits(ax, frame, (low - room, high + room), (0.0, 1.15 * float(measured["amplitude"].max())))
    style.caption(ax, f"bars: ±{BARS:g} scatters of single cycles")
    style.legend_above(fig, [*_computed_entries(ax), *entries])
    style.finish(fig)
    return fig


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
    """Return one line for each name of computed orbits."""
    found = {str(line.get_label()): line for line in ax.lines if str(line.get_label()).startswith("computed")}
    return [found[name] for name in sorted(found)]
