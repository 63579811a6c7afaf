"""Colours, letters and names of attractors, the same in every figure of a run.

Twelve colours go to the attractors with most cells; the others share one more. They are those of Okabe
& Ito (https://jfly.uni-koeln.de/color/) and five chosen for their distance from them: any two, and any
of them and the greys of cells without an attractor, differ by 11 or more in CIELAB to normal eyes and to
those with protanopia, deuteranopia and tritanopia (simulated after Machado et al., IEEE Trans. Vis.
Comput. Graph. 15, 2009). Letters tell attractors apart where colours do not.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from scipy.ndimage import distance_transform_edt

from pipeline.analysis.sides import Side
from pipeline.layout import vocabulary
from pipeline.plots import style

COLOURS = (
    style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, "#56B4E9", style.PURPLE,
    "#5B3A1E", "#F0E442", "#332288", "#882255", "#BBDDFF", "#B08D57",
)  # fmt: skip
OTHERS = "#C8E6C0"

UNASSIGNED: dict[str, tuple[int, ...]] = {
    "undecided": (vocabulary.PERIODIC, vocabulary.BOUNDED, vocabulary.INFERRED),
    "diverged": (vocabulary.DIVERGED,),
    "failed": vocabulary.FAILED,
    "pending": (vocabulary.PENDING,),
}
"""What a cell without an attractor is called, by its status."""

GREYS = {"undecided": "0.75", "diverged": "0.0", "failed": "0.45", "pending": "0.95"}


_LETTERS_PER_IN = 17.5
_LINE_IN, _GAP_IN = 0.192, 0.045
_LETTER_IN = 0.11
"""Half the height of a letter with some air around it [in]."""


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
        Result of `pipeline.analysis.attractors.attractors.match` for the whole run, so that a colour does not
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
    return ", ".join(part for part in (_periods(periods), _sides(sides) + _turns(one, sides)) if part)


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
    return " or ".join(Side(s).name.lower() for s in found)


def _turns(one: xr.Dataset, sides: np.ndarray) -> str:
    """Mean turns per drive period, where the motion rotates at every point and always alike."""
    if not (sides == Side.ROTATING).all():
        return ""
    links = one["rotation"].transpose(..., "link").values.reshape(-1, one.sizes["link"])
    links = links[one["kind"].values.ravel() > 0]
    if np.ptp(links, axis=0).max() > 0.05:
        return ""
    # no-break spaces: a legend's line is not folded here
    return "\u00a0({})".format(",\u00a0".join(_signed(x) for x in links.mean(axis=0)))


def _signed(turns: float) -> str:
    rounded = float(f"{turns:.2g}")
    if abs(rounded) < 0.005:
        return "0"
    return f"{rounded:+g}".replace("-", "\N{MINUS SIGN}")


Entry = tuple[str, str] | Artist
"""Line of a legend: a text and the colour of its patch, or an artist with a label."""


def legend_column(fig: Figure, entries: Sequence[Entry], left_in: float, top_in: float) -> Legend:
    """Put a legend into the space right of the axes, its corner given from the left and the top [in]."""
    width, height = fig.get_size_inches()
    handles: list[Any] = [
        entry
        if isinstance(entry, Artist)
        else Patch(facecolor=entry[1], edgecolor="0.4", linewidth=0.3, label=_folded(entry[0], left_in))
        for entry in entries
    ]
    return fig.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(left_in / width, 1.0 - top_in / height),
        frameon=False, fontsize=style.LEGEND_PT, borderpad=0.0, borderaxespad=0.0, handlelength=1.1,
        handleheight=0.9, handletextpad=0.5, labelspacing=0.42,
    )  # fmt: skip


def column_height(entries: Sequence[Entry], left_in: float) -> float:
    """Height [in] that a legend column will take."""
    texts = [str(e.get_label()) if isinstance(e, Artist) else _folded(e[0], left_in) for e in entries]
    lines = [1 + text.count("\n") for text in texts]
    return sum(_LINE_IN * n + (_GAP_IN if n > 1 else 0.0) for n in lines)


def _folded(text: str, left_in: float) -> str:
    letters = int((style.WIDTH_IN - left_in - 0.35) * _LETTERS_PER_IN)
    return textwrap.fill(text, letters, subsequent_indent="   ", break_long_words=False)


def percent(share: float) -> str:
    """Write a share as a percentage with one decimal."""
    text = f"{100.0 * share:.1f}" if share >= 5e-4 or share == 0.0 else "<\u00a00.1"
    return text + "\u00a0%"


def write_letters(ax: Axes, codes: np.ndarray, attractors: Iterable[int]) -> None:
    """Write each attractor's letter into the widest place of its area, if one is wide enough.

    Parameters
    ----------
    ax
        Axes that the codes fill.
    codes
        Ids on a raster of equal cells, rows from below; some 400 each way are enough.
    attractors
        Ids to be written.
    """
    box = ax.get_window_extent()
    sampling = np.array([box.height / codes.shape[0], box.width / codes.shape[1]]) / ax.figure.dpi
    padded = np.pad(codes, 1, constant_values=np.iinfo(np.int32).min)
    for number in attractors:
        depth = distance_transform_edt(padded == number, sampling=sampling)[1:-1, 1:-1]
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        if depth[row, column] >= _LETTER_IN:
            ax.text(
                (column + 0.5) / codes.shape[1], (row + 0.5) / codes.shape[0], letter(number),
                transform=ax.transAxes, ha="center", va="center", fontsize=style.LABEL_PT,
                path_effects=[withStroke(linewidth=2.0, foreground="white")],
            )  # fmt: skip


def caption(ds: xr.Dataset, *, with_start: bool = True) -> str:
    """Name the values at which a selection was made: of parameters, and of the initial state."""
    parts = []
    # parameters first, then the initial state
    for name in sorted(map(str, ds.coords), key=lambda name: name.endswith("_0")):
        coordinate = ds.coords[name]
        if coordinate.ndim or coordinate.dtype.kind != "f" or (name.endswith("_0") and not with_start):
            continue
        symbol = "$f$" if name == "frequency" else _start_symbol(name)
        unit = coordinate.attrs.get("units", "Hz" if name == "frequency" else "1")
        parts.append(f"{symbol} = {float(coordinate):.6g}" + (f" {unit}" if unit != "1" else ""))
    return ", ".join(parts)


def _start_symbol(name: str) -> str:
    state = name.removesuffix("_0")
    return f"{style.STATE_SYMBOLS[state]}(0)" if state in style.STATE_SYMBOLS else name
