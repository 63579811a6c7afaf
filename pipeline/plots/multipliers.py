"""Draw Floquet multipliers along a branch, in the complex plane."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from pipeline.analysis.run import OpenRun
from pipeline.plots import labels, style
from pipeline.plots.branches import KINDS, MARKERS, SHORT
from pipeline.plots.figure import frame_of
from pipeline.products.branches import BranchOptions
from pipeline.products.figures import MultiplierOptions

MOST = 2.0
"""Multipliers beyond this modulus are left out."""


@style.drawn
def plot_multipliers(ds: xr.Dataset, branch: int = 0, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    branch
        Number of the branch.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Multipliers of modulus beyond `MOST` are left out, and their number is stated. Its `data` hold
        ``real`` and ``imaginary`` parts and the ``parameter`` of each point of the branch.

    Raises
    ------
    ValueError
        If there is no such branch.
    """
    if not 0 <= branch < ds.sizes["branch"]:
        raise ValueError(f"branch = {branch} is out of bounds: there are branches 0 to {ds.sizes['branch'] - 1}.")
    n = int(ds["n_points"][branch])
    z = (ds["multiplier_real"] + 1j * ds["multiplier_imag"]).values[branch, :n]
    x = np.repeat(ds["parameter"].values[branch, :n, None], z.shape[1], axis=1)
    fig = style.new_figure(4.8, _multipliers(ds, branch, z, x[:, 0]), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor="0.5", linewidth=0.8))
    shown = np.abs(z) <= MOST
    points = ax.scatter(z.real[shown], z.imag[shown], c=x[shown], s=6.0, linewidths=0.0, zorder=3)
    here = np.flatnonzero(ds["of_branch"].values == branch)
    handles = _crossings(ax, ds, here)
    for axis in (ax.axhline, ax.axvline):
        axis(0.0, color="0.8", linewidth=0.5, zorder=0)
    reach = max(1.15, float(np.abs(np.stack([z.real[shown], z.imag[shown]])).max(initial=0.0)) * 1.05)
    style.limits(ax, frame, (-reach, reach), (-reach, reach))
    ax.set_aspect("equal")
    style.label_axes(ax, r"Re $\mu$", r"Im $\mu$")
    missing = int((~shown).sum())
    title = f"branch {branch}, period {int(ds['orbit_period'][branch])}"
    fixed = labels.caption(ds, with_start=False)
    style.caption(ax, style.join([title, fixed, f"{missing} beyond |μ| = {MOST:g}" if missing else ""]))
    label = labels.swept_label(str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"]))
    style.style_bar(fig.colorbar(points, ax=ax, pad=0.015, aspect=32), label)
    if frame.compact:
        style.legend_below(fig, handles)
    elif handles:
        fig.legend(
            handles=handles,
            loc="outside right upper",
            frameon=False,
            fontsize=fig.look.tick,
            handletextpad=0.2,
            borderpad=0.2,
        )
    style.finish(fig)
    return fig


def _multipliers(ds: xr.Dataset, branch: int, z: np.ndarray, x: np.ndarray) -> xr.Dataset:
    units = str(ds.attrs["parameter_units"])
    return xr.Dataset(
        {
            "real": (("point", "multiplier"), z.real.copy(), {"units": "1"}),
            "imaginary": (("point", "multiplier"), z.imag.copy(), {"units": "1"}),
            "parameter": ("point", x, {"units": units, "long_name": str(ds.attrs["parameter"])}),
        },
        attrs={"title": "Floquet multipliers", "branch": branch, "orbit_period": int(ds["orbit_period"][branch])},
    )


def _crossings(ax: Axes, ds: xr.Dataset, here: np.ndarray) -> list[Line2D]:
    """Mark the multipliers on the unit circle at bifurcations, and return legend entries for these bifurcations."""
    critical = (ds["critical_real"] + 1j * ds["critical_imag"]).values[here]
    look: dict[str, Any] = {
        "markerfacecolor": "none",
        "markeredgecolor": style.VERMILLION,
        "linestyle": "none",
        "zorder": 4,
    }
    handles = []
    for i in np.argsort(ds["value"].values[here], kind="stable"):
        kind, mu = KINDS[int(ds["kind"][here[i]])], critical[i]
        turning = kind == "neimark_sacker"
        for value in {mu, mu.conjugate()} if turning else {mu}:
            ax.plot(value.real, value.imag, marker=MARKERS[kind], markersize=5.5, markeredgewidth=1.0, **look)
        text = f"{SHORT[kind]} {float(ds['value'][here[i]]):.4f}"
        text += f", {np.degrees(np.angle(mu)):.0f}°" if turning else ""
        handles.append(Line2D([], [], marker=MARKERS[kind], markersize=5.0, label=text, **look))
    return handles


def draw_multipliers(run: OpenRun, options: MultiplierOptions) -> style.DataFigure:
    """Draw the figure ``multipliers`` of a run."""
    found = run.derive("branches", **options.part(BranchOptions))
    return plot_multipliers(found, options.branch, frame=frame_of(options))
