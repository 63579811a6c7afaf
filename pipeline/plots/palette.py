"""Give each class of motion and each attractor a colour and a name, which are the same in every figure of a run.

The attractors with the most cells have the colours of the style; the others share one more. The twelve of magpend's
style come from Okabe & Ito (https://jfly.uni-koeln.de/color/) and five chosen for their distance from them: any two,
and any of them and the greys of cells without an attractor, differ by 11 or more in CIELAB to normal eyes and to those
with protanopia, deuteranopia and tritanopia (simulated after Machado et al., IEEE Trans. Vis. Comput. Graph. 15, 2009).
Letters tell attractors apart where colours do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from scipy.ndimage import distance_transform_edt

from pipeline.layout.vocabulary import (
    ABSENT,
    ATTRACTS,
    BOUNDED_SET,
    CHAOTIC_SET,
    EQUILIBRIUM,
    NEUTRAL,
    NOT_SETTLED,
    PERIODIC_ORBIT,
    STABILITIES,
    TORUS,
    TRANSIENT,
    UNSTABLE,
    letter,
    model_of,
)
from pipeline.plots import style
from pipeline.results import outcomes
from pipeline.results.ragged import N_IDS, SET, is_ragged
from pipeline.results.sets import rows_by_number
from pipeline.results.sides import classify

MOTION_COLOURS = (
    style.BLUE,
    style.VERMILLION,
    style.GREEN,
    style.PURPLE,
    style.ORANGE,
    style.SKY,
    "#5B3A1E",
    "#332288",
)
"""Of the words of a classifier, in their order; a ninth begins again."""

PLAIN = "#1A3A5C"
"""Colour of all motions where nothing tells them apart."""


@dataclass(frozen=True)
class Motions:
    """Names and colours of the classes of motion of a run, by code."""

    words: tuple[str, ...]
    colours: tuple[str, ...]
    drawn: tuple[int, ...]  # codes in the order of legends: motions, then what is neutral

    @property
    def told(self) -> bool:
        """Whether the model distinguishes classes of motion."""
        return len(self.words) > 1


def motions_of(ds: xr.Dataset) -> Motions:
    """Return the names and colours of a model's classes of motion; a model without a classifier has one class."""
    classifier = model_of(ds).classifier
    if classifier is None:
        plain = PLAIN if style.colours() == style.PALETTE else style.colours()[0]
        return Motions(("motion",), (plain,), (0,))
    own = [c for c in range(1, len(classifier.words)) if c not in classifier.neutral]
    colours = [style.GREY] * len(classifier.words)
    for k, code in enumerate(own):
        colours[code] = style.as_hex(MOTION_COLOURS[k % len(MOTION_COLOURS)])
    neutral = [c for c in range(1, len(classifier.words)) if c in classifier.neutral]
    return Motions(classifier.words, tuple(colours), (*own, *neutral))


def motion_codes(cells: xr.Dataset) -> xr.DataArray:
    """Return the class of motion of each cell, as a code."""
    found = classify(cells)
    return xr.zeros_like(cells["status"], dtype=np.int8) if found is None else found


COLOURS = style.PALETTE
OTHERS = "#C8E6C0"

GREYS = {
    "not settled": "0.7",
    "on a transient set": "0.82",
    "on an unstable orbit or equilibrium": "#6b5d4f",
    "on a neutral set": "#acbfd2",
    "diverged": "0.0",
    "growing": "#ccb3a0",
    "failed": "0.45",
    "no return": "0.17",
    "chatter": "#320836",
    "pending": "0.95",
}
"""Cells that do not end on an attractor, with their greys; see `pipeline.results.outcomes`.

Three are tinted: between twelve colours there are not ten greys that can be told apart.
"""

SETS = {
    "not settled": NOT_SETTLED,
    "on a transient set": TRANSIENT,
    "on an unstable orbit or equilibrium": UNSTABLE,
    "on a neutral set": NEUTRAL,
}
"""Stability of the sets that such cells are on."""

GREY_OF = {code: GREYS[name] for name, code in SETS.items()}
"""Grey of a set that does not attract, by its stability."""

_KINDS = (PERIODIC_ORBIT, TORUS, CHAOTIC_SET, BOUNDED_SET, EQUILIBRIUM)
"""Kinds of sets in the order of legends."""

_FAILED = ("step limit", "step underflow", "unreached")


def other_cells(part: xr.Dataset) -> dict[str, np.ndarray]:
    """Return which cells end on no attractor, as masks by reason, with the swept parameters first."""
    found: dict[str, np.ndarray] = {}
    for name, which in outcomes.other_cells(part).items():
        own = "failed" if name in _FAILED else name
        found[own] = found.get(own, np.zeros(which.shape, bool)) | which
    return found


@dataclass(frozen=True)
class Cast:
    """Colours and names of the attractors (and other sets) of a run."""

    colours: dict[int, str]  # colour by id; of a set that attracts nowhere the grey of its stability
    names: dict[int, str]  # name by id, such as ``A: period 1, left``
    main: tuple[int, ...]  # ids with a colour of their own: attractors
    order: tuple[int, ...]  # all ids as legends list them: by rising period, then tori, chaotic sets and others


def cast_of(attractors: xr.Dataset, part: xr.Dataset | None = None) -> Cast:
    """Choose colours and names for the attractors (and other sets) of a run.

    `attractors` are those of the whole run, so that a colour does not change with what is selected of it; `part` is
    what the names describe, by default all.
    """
    sets = _sets(attractors)
    attracts = [one["stability"].values == ATTRACTS for one in sets]
    cells = np.array([int(one["n_cells"].values[own].sum()) for one, own in zip(sets, attracts, strict=True)])
    own = np.flatnonzero([one.any() for one in attracts])
    ranked = own[np.lexsort((own, -cells[own]))][: len(style.colours())].tolist()
    colours = {i: _grey_of(one["stability"]) for i, one in enumerate(sets)}
    colours |= dict.fromkeys(own.tolist(), OTHERS) | dict(zip(ranked, style.colours(), strict=False))
    described = sets if part is None else _sets(part)
    names = {i: f"{letter(i)}: {describe(one)}" for i, one in enumerate(described)}
    order = sorted(names, key=lambda i: _rank(described[i]))
    return Cast(colours, names, tuple(sorted(ranked)), tuple(order))


_TOLD = ("n_cells", "stability", "kind", "orbit_period", "side", "rotation", "period_s")
"""Variables of a set by which it is named and coloured."""


def _sets(attractors: xr.Dataset) -> list[xr.Dataset]:
    """Return what is told of each set of a run, by its id, at the parameter points where it is."""
    told = attractors[[name for name in _TOLD if name in attractors]]
    if not is_ragged(attractors):
        return [told.isel(attractor=i) for i in range(told.sizes["attractor"])]
    rows = rows_by_number(attractors["attractor"].values)
    return [told.isel({SET: rows.get(i, [])}) for i in range(int(attractors.attrs[N_IDS]))]


def _grey_of(stability: xr.DataArray) -> str:
    """Return the grey for a set that attracts nowhere, by its most frequent stability."""
    codes = stability.values[np.isin(stability.values, list(GREY_OF))]
    return GREY_OF[int(np.bincount(codes).argmax())] if codes.size else OTHERS


def _rank(one: xr.Dataset) -> tuple[int, int]:
    """Return the place of a set in a legend: that of its first kind, and its least period."""
    kinds, periods = (one[name].values.ravel() for name in ("kind", "orbit_period"))
    if (periods > 0).any():
        return 0, int(periods[periods > 0].min())
    return min((_KINDS.index(k) for k in kinds.tolist() if k in _KINDS), default=len(_KINDS)), 0


def describe(one: xr.Dataset) -> str:
    """Describe an attractor (or other set) in words, for instance by its period and its class of motion.

    Only points where the set is present count.
    """
    present = one["kind"].values.ravel() > 0
    if not present.any():
        return "absent"
    words = _words(one, one["side"].values.ravel()[present]) if "side" in one else ""
    kinds, periods = (one[name].values.ravel()[present] for name in ("kind", "orbit_period"))
    told = _periods(periods, kinds) + _seconds(one)
    return style.join([told, words, _turns(one, present), _stability(one)])


def _stability(one: xr.Dataset) -> str:
    found = sorted({int(code) for code in one["stability"].values.ravel()} - {ABSENT, ATTRACTS})
    words = " or ".join(STABILITIES[code].replace("_", " ") for code in found)
    return f"{words} in parts" if words and (one["stability"].values == ATTRACTS).any() else words


def _seconds(one: xr.Dataset) -> str:
    if not model_of(one).clock.has_equilibria or "period_s" not in one:
        return ""
    known = one["period_s"].values[np.isfinite(one["period_s"].values)]
    if not known.size:
        return ""
    low, high = (f"{value:.4g}" for value in (known.min(), known.max()))
    return f" ({low if low == high else f'{low} to {high}'}\u00a0s)"


def _periods(periods: np.ndarray, kinds: np.ndarray) -> str:
    closed = sorted({int(p) for p in periods if p > 0})
    parts = []
    if closed:
        listed = ", ".join(map(str, closed)) if len(closed) < 4 else f"{closed[0]} to {closed[-1]}"
        parts.append(f"period {listed}")
    words = ("limit cycle", "quasi-periodic", "chaotic", "not periodic", "at rest")
    for kind, text in zip(_KINDS, words, strict=True):
        if ((periods == 0) & (kinds == kind)).any() and text not in parts:
            parts.append(text)
    return " or ".join(parts)


def _words(one: xr.Dataset, codes: np.ndarray) -> str:
    classifier = model_of(one).classifier
    if classifier is None:
        return ""
    found = sorted({int(c) for c in codes} - {0, *classifier.neutral})
    return " or ".join(classifier.words[c] for c in found)


def _turns(one: xr.Dataset, present: np.ndarray) -> str:
    """Return a text with the mean turns per period; an empty text unless they are equal at all parameter points."""
    dim = model_of(one).angle_dim
    if "rotation" not in one or dim not in one["rotation"].dims:
        return ""
    turns = one["rotation"].transpose(..., dim).values.reshape(-1, one.sizes[dim])[present]
    if np.abs(turns).max(axis=1).min() < 0.05 or not np.ptp(turns, axis=0).max() <= 0.05:
        return ""
    told = [_signed(x) for x in turns.mean(axis=0)]
    word = "turn" if told in (["+1"], ["\N{MINUS SIGN}1"]) else "turns"
    return f"{' and '.join(told)} {word} per {model_of(one).clock.period}"


def _signed(turns: float) -> str:
    rounded = float(f"{turns:.2g}")
    if abs(rounded) < 0.005:
        return "0"
    return f"{rounded:+g}".replace("-", "\N{MINUS SIGN}")


Entry = tuple[str, str] | Artist
"""Line of a legend: a text and the colour of its patch, or an artist with a label."""


def new_panel(
    data: xr.Dataset, entries: Sequence[Entry], frame: style.Frame, height: float = 4.3, *, handle: float = 0.0
) -> tuple[style.DataFigure, Axes]:
    """Make a figure with one panel, and a legend beside it (or below it in a narrow figure).

    `height` is the least one [in] at full width; the figure grows with the legend. `handle` is the length of the
    legend's handles in units of its letters, which dashes need longer.
    """
    look = style.sizes()
    room = frame.width_in * (1.0 if frame.compact else 0.33) - 0.35
    lines = [style.folded(_text(e), room, look.legend, "   ") for e in entries]
    line = 1.55 * look.legend / 72.0
    if frame.compact:
        columns = style.columns(frame, lines, look.legend)
        rows = -(-len(lines) // columns) if all("\n" not in t for t in lines) else len(lines)
        needed = 0.66 * height + line * rows
    else:
        needed = max(height, sum(line * (1 + t.count("\n")) for t in lines) + 0.4)
    fig = style.new_figure(needed, data, frame, exact=True)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=False)
    handles = [_handle(entry, text) for entry, text in zip(entries, lines, strict=True)]
    if frame.compact:
        style.legend_below(fig, handles, handle or 1.2)
    elif handles:
        fig.legend(
            handles=handles,
            loc="outside right upper",
            frameon=False,
            fontsize=look.legend,
            borderpad=0.0,
            borderaxespad=0.2,
            handlelength=handle or 1.1,
            handleheight=0.9,
            handletextpad=0.5,
            labelspacing=0.42,
        )
    return fig, ax


def _text(entry: Entry) -> str:
    return str(entry.get_label()) if isinstance(entry, Artist) else entry[0]


def _handle(entry: Entry, text: str) -> Artist:
    if isinstance(entry, Artist):
        return entry
    return Patch(facecolor=entry[1], edgecolor="0.4", linewidth=0.3, label=text)


def percent(share: float) -> str:
    """Format a share as a percentage with one decimal."""
    text = f"{100.0 * share:.1f}" if share >= 5e-4 or share == 0.0 else "<\u00a00.1"
    return text + "\u00a0%"


def write_letters(ax: Axes, codes: np.ndarray, attractors: Iterable[int]) -> None:
    """Write the letter of each attractor into the widest part of its area in an image, if the letter fits there.

    The axes are at their final place. `codes` are ids on a raster of equal cells, rows from below; some 400 each way
    are enough.
    """
    box = ax.get_window_extent()
    sampling = np.array([box.height / codes.shape[0], box.width / codes.shape[1]]) / ax.figure.dpi
    padded = np.pad(codes, 1, constant_values=np.iinfo(np.int32).min)
    size = style.look_of(ax).label
    for number in attractors:
        depth = distance_transform_edt(padded == number, sampling=sampling)[1:-1, 1:-1]
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        if depth[row, column] >= 0.011 * size:
            ax.text(
                (column + 0.5) / codes.shape[1],
                (row + 0.5) / codes.shape[0],
                letter(number),
                transform=ax.transAxes,
                ha="center",
                va="center",
                fontsize=size,
                path_effects=[withStroke(linewidth=2.0, foreground="white")],
            )
