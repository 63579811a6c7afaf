"""Colours, letters and names of attractors, the same in every figure of a run.

Twelve colours go to the attractors with most cells; the others share one more. They are those of Okabe
& Ito (https://jfly.uni-koeln.de/color/) and five chosen for their distance from them: any two, and any
of them and the greys of cells without an attractor, differ by 11 or more in CIELAB to normal eyes and to
those with protanopia, deuteranopia and tritanopia (simulated after Machado et al., IEEE Trans. Vis.
Comput. Graph. 15, 2009). Letters tell attractors apart where colours do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch

from pipeline.analysis.sides import Side
from pipeline.plots import style

COLOURS = (
    style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, "#56B4E9", style.PURPLE,
    "#5B3A1E", "#F0E442", "#332288", "#882255", "#BBDDFF", "#B08D57",
)  # fmt: skip
OTHERS = "#C8E6C0"

# Codes of magpend_core.status, which is not imported: it would bring the compiler with it.
UNASSIGNED: dict[str, tuple[int, ...]] = {
    "undecided": (1, 2, 7),
    "diverged": (3,),
    "step limit": (4, 5),
    "pending": (0, 6),
}
"""What a cell without an attractor is called, by its status."""

GREYS = {"undecided": "0.75", "diverged": "0.0", "step limit": "0.45", "pending": "0.95"}


@dataclass(frozen=True)
class Cast:
    """The attractors of a dataset as figures show them.

    Attributes
    ----------
    colours : dict
        Colour by id.
    names : dict
        Name by id, such as ``A: period 1, left``.
    main : tuple of int
        Ids with a colour of their own.
    """

    colours: dict[int, str]
    names: dict[int, str]
    main: tuple[int, ...]


def letter(attractor: int) -> str:
    """Letter of an id: A to Z, then AA and on."""
    text = ""
    attractor += 1
    while attractor:
        attractor, digit = divmod(attractor - 1, 26)
        text = chr(ord("A") + digit) + text
    return text


def cast_of(attractors: xr.Dataset, part: xr.Dataset | None = None) -> Cast:
    """Give the attractors of a dataset their colours and names.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.match` for the whole run, so that a colour does not
        change with what is selected of it.
    part
        What the names are to describe; by default all of it.
    """
    cells = attractors["n_cells"].sum([d for d in attractors["n_cells"].dims if d != "attractor"]).values
    ranked = np.lexsort((np.arange(cells.size), -cells))[: len(COLOURS)].tolist()
    colours = {**dict.fromkeys(range(cells.size), OTHERS), **dict(zip(ranked, COLOURS, strict=False))}
    described = attractors if part is None else part
    names = {i: f"{letter(i)}: {describe(described.isel(attractor=i))}" for i in range(cells.size)}
    return Cast(colours, names, tuple(sorted(ranked)))


def describe(one: xr.Dataset) -> str:
    """Describe an attractor: its periods and sides wherever it is present, and its turns if it rotates."""
    present = one["kind"].values.ravel() > 0
    if not present.any():
        return "absent"
    periods = one["orbit_period"].values.ravel()[present]
    sides = one["side"].values.ravel()[present]
    return ", ".join(part for part in (_periods(periods), _sides(sides), _turns(one, sides)) if part)


def _periods(periods: np.ndarray) -> str:
    closed = sorted({int(p) for p in periods if p > 0})
    parts = []
    if closed:
        listed = ", ".join(map(str, closed)) if len(closed) < 4 else f"{closed[0]} to {closed[-1]}"
        parts.append(f"period {listed}")
    if (periods == 0).any():
        parts.append("not periodic")
    return " or ".join(parts)


def _sides(sides: np.ndarray) -> str:
    found = sorted({int(s) for s in sides} - {int(Side.UNKNOWN), int(Side.UNDECIDED)})
    return "/".join(Side(s).name.lower() for s in found)


def _turns(one: xr.Dataset, sides: np.ndarray) -> str:
    """Mean turns per drive period, where the motion rotates at every point and always alike."""
    if not (sides == Side.ROTATING).all():
        return ""
    links = one["rotation"].transpose(..., "link").values.reshape(-1, one.sizes["link"])
    links = links[one["kind"].values.ravel() > 0]
    if np.ptp(links, axis=0).max() > 0.05:
        return ""
    return "({})".format(", ".join(_signed(x) for x in links.mean(axis=0)))


def _signed(turns: float) -> str:
    rounded = float(f"{turns:.2g}")
    if abs(rounded) < 0.005:
        return "0"
    return f"{rounded:+g}".replace("-", "\N{MINUS SIGN}")


def legend_column(fig: Figure, entries: list[tuple[str, str]], left_in: float, top_in: float) -> Legend:
    """Put colour patches with texts in a column, its corner given from the left and the top [in]."""
    width, height = fig.get_size_inches()
    handles: list[Any] = [
        Patch(facecolor=colour, edgecolor="0.4", linewidth=0.3, label=text) for text, colour in entries
    ]
    return fig.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(left_in / width, 1.0 - top_in / height),
        frameon=False, fontsize=style.LEGEND_PT, borderpad=0.0, borderaxespad=0.0, handlelength=1.1,
        handleheight=0.9, handletextpad=0.5, labelspacing=0.42,
    )  # fmt: skip


def parameter_dims(attractors: xr.Dataset) -> list[str]:
    """Names of the swept parameters."""
    return [str(d) for d in attractors["kind"].dims if d != "attractor"]


def start_dims(attractors: xr.Dataset) -> list[str]:
    """Names of the dims that tell the cells of one parameter point apart."""
    return [str(d) for d in attractors["attractor_id"].dims if d not in parameter_dims(attractors)]


def choose(ds: xr.Dataset, at: Mapping[str, float] | None, keep: tuple[str, ...], purpose: str) -> xr.Dataset:
    """Select one value of each axis that a figure has no room for.

    Parameters
    ----------
    ds
        With `attractor_id`.
    at
        Value by axis; the nearest one on the axis is taken.
    keep
        Axes of the figure.
    purpose
        What the figure shows, for messages.

    Raises
    ------
    ValueError
        If an axis is unknown, a value lies off its axis, or an axis longer than 1 is left over.
    """
    dims = [str(d) for d in ds["attractor_id"].dims]
    for name, value in (at or {}).items():
        style.check_choice("axis", name, [d for d in dims if d not in keep])
        ds = ds.isel({name: _nearest(ds[name], float(value))})
    left = [d for d in ds["attractor_id"].dims if d not in keep]
    long = [str(d) for d in left if ds.sizes[d] > 1]
    if long:
        axes = ", ".join(f"{d} ({ds.sizes[d]} values)" for d in long)
        one = ds[long[0]].values[ds.sizes[long[0]] // 2] if long[0] in ds.coords else 0
        raise ValueError(
            f"{purpose}, and the dataset also has {axes}: choose a value of each, such as {long[0]}={one:.6g}"
        )
    return ds.isel(dict.fromkeys(left, 0))


def _nearest(axis: xr.DataArray, value: float) -> int:
    values = axis.values.astype(np.float64)
    index = int(np.abs(values - value).argmin())
    step = np.diff(values).max() if values.size > 1 else 1e-6 * max(abs(values[0]), 1.0)
    if not abs(values[index] - value) <= 0.5001 * step:
        raise ValueError(
            f"{axis.name} = {value:g} lies off its axis, which runs from {values[0]:g} to {values[-1]:g}"
        )
    return index


def caption(ds: xr.Dataset) -> str:
    """Name the values at which a selection was made."""
    parts = []
    # parameters first, then the initial state
    for name in sorted(map(str, ds.coords), key=lambda name: name.endswith("_0")):
        coordinate = ds.coords[name]
        if coordinate.ndim or coordinate.dtype.kind != "f":
            continue
        symbol = "$f$" if name == "frequency" else _start_symbol(name)
        unit = coordinate.attrs.get("units", "Hz" if name == "frequency" else "1")
        parts.append(f"{symbol} = {float(coordinate):.6g}" + (f" {unit}" if unit != "1" else ""))
    return ", ".join(parts)


def _start_symbol(name: str) -> str:
    state = name.removesuffix("_0")
    return f"{style.STATE_SYMBOLS[state]}(0)" if state in style.STATE_SYMBOLS else name
