"""Collect the data of an exported page: description of the run, diagrams, curves, planes of initial states.

The points of diagrams fit a size limit in full, or rounded, or with fewer section points.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.status import Status
from pipeline.explorer.answers import ANSWERS
from pipeline.explorer.data.arrays import pack_zipped, unpack_arrays, zip_json
from pipeline.explorer.data.diagram import points
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.verticals import Vertical
from pipeline.explorer.data.view import describe_view
from pipeline.plots.points import DRAWN
from pipeline.products.reporting import track
from pipeline.specification.problems import SpecError, unknown_name

MOST_PLACES = 4000
"""Answers of a kind that a copy holds, one for each place of the axes."""


Place = dict[str, int]


@dataclass
class Copied:
    """Data of an exported page, and notes to its reader, as collected so far."""

    run: ExploredRun
    view: dict[str, Any]  # as `describe_view` gives it
    about: dict[str, Any]  # facts on the export for the page's script
    objects: dict[str, bytes] = field(default_factory=dict)  # data by name
    sentences: list[str] = field(default_factory=list)  # notes on the export for its readers

    @property
    def x(self) -> str:
        """Name of the horizontal axis that is shown first."""
        return str(self.view["axes"][0]["name"])


def gather(run: ExploredRun, quantities: Sequence[str] = ()) -> Copied:
    """Collect the data that every export has: all except the points of the diagrams and the orbits.

    `quantities` are those of the model that can be on the vertical axis, besides states and kept extremes; raise
    SpecError if the model lacks one.
    """
    view, left = _view(run, quantities)
    about: dict[str, Any] = {
        "dims": [{"name": d, "size": n} for d, n in zip(run.plan.dims, run.plan.shape, strict=True)],
        "drawn": [int(s) for s in DRAWN],
        "status": {int(s): s.name.lower().replace("_", " ") for s in Status},
        "answers": {},
        "columns": {},
    }
    copied = Copied(run, view, about)
    if not run.complete:
        cells = view["cells"]
        copied.sentences.append(
            f"The run was not complete: {cells['pending']:,} of {cells['total']:,} cells were not computed."
        )
    if left:
        copied.sentences.append(
            f"{left} quantities of the model are not among the vertical axes here; "
            "magpend export --quantity NAME adds one."
        )
    known = {
        "curves": True,
        "branches": view["has"]["branches"],
        "events": view["has"]["events"],
        "attractors": view["has"]["attractors"],
        "disturbances": bool(run.kept_each("resilience") or run.kept_each("edge")),
    }
    for kind, is_known in known.items():
        _answers(copied, kind, alike=not is_known)
    return copied


def _view(run: ExploredRun, quantities: Sequence[str]) -> tuple[dict[str, Any], int]:
    """Return the description of a run with only the given quantities, and the number of axes left out."""
    known = [q.name for q in run.model.quantities]
    if problems := [unknown_name("--quantity", name, known) for name in quantities if name not in known]:
        raise SpecError(problems)
    view = describe_view(run, live=False)
    away = set(known) - set(quantities)
    shown = [v for v in view["verticals"] if v["name"] not in away]
    left = len(view["verticals"]) - len(shown)
    return {**view, "verticals": shown}, left


def places(run: ExploredRun, but: str = "") -> Iterator[Place]:
    """Yield every combination of indices on the swept axes of a run, except on the axis `but`."""
    swept = [a for a in run.axes if a.swept and a.name != but]
    for indices in itertools.product(*(range(len(a.values)) for a in swept)):
        yield {a.name: i for a, i in zip(swept, indices, strict=True)}


def place_key(run: ExploredRun, at: Mapping[str, int], x: str = "") -> str:
    """Return the key of a point on the axes, such as ``frequency=3&amplitude=0``, as the page's script does."""
    parts = [f"{a.name}={at.get(a.name, 0)}" for a in run.axes if a.name != x]
    return "&".join([*([f"x={x}"] if x else []), *parts])


def _requests(copied: Copied, kind: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the key and the computation of each request of one kind that a page can make."""
    run, answer = copied.run, ANSWERS[kind]
    takes = answer.arguments or ()
    xs = [a.name for a in run.axes] if "x" in takes else [""]
    ys = [str(v["name"]) for v in copied.view["verticals"]] if "y" in takes else [""]
    for y, x in itertools.product(ys, xs):
        for at in places(run, but=x):
            key = (f"y={y}&" if y else "") + place_key(run, at, x)
            given = {"x": x, "y": y, "at": at}
            yield key, partial(answer.function, run, **{name: given[name] for name in takes})


def _answers(copied: Copied, kind: str, alike: bool) -> None:
    """Compute the answers to all requests of one kind, and pack them into an export.

    If they are all alike, such as how to compute what is missing, the first stands for all.
    """
    each = 1_000_000  # answers lie together in objects of about so many bytes before compression
    asked = list(itertools.islice(_requests(copied, kind), 1 if alike else MOST_PLACES + 1))
    if alike:
        copied.about["answers"][kind] = {"blocks": {}, "missing": "", "alike": asked[0][1]()}
        return
    if len(asked) > MOST_PLACES:
        text = f"The {kind} are not in this copy: there are more than {MOST_PLACES:,} places of the axes."
        copied.about["answers"][kind] = {"blocks": {}, "missing": text, "alike": None}
        copied.sentences.append(text)
        return
    blocks: dict[str, int] = {}
    held: dict[str, Any] = {}
    number, size = 0, 0
    for key, answer in track(asked, f"copying {kind}"):
        held[key] = answer()
        blocks[key] = number
        size += len(json.dumps(held[key]))
        if size > each:
            copied.objects[f"{kind}-{number}"] = zip_json(held)
            held, number, size = {}, number + 1, 0
    if held:
        copied.objects[f"{kind}-{number}"] = zip_json(held)
    copied.about["answers"][kind] = {"blocks": blocks, "missing": "", "alike": None}


def add_planes(copied: Copied, most_bytes: float) -> None:
    """Add the planes of initial states, coloured by outcome, to an export, up to a total size."""
    run, size, none = copied.run, 0, None
    objects: dict[str, str] = {}
    found = list(itertools.islice(places(run), MOST_PLACES + 1))
    for at in track(found[:MOST_PLACES], "copying planes"):
        arrays, attrs = unpack_arrays(ANSWERS["plane"].function(run, at))
        if attrs.get("source") is None:
            none = attrs
            continue
        name = f"plane-{len(objects)}"
        content = pack_zipped(arrays, attrs)
        size += len(content)
        if size > most_bytes:
            break
        objects[place_key(run, at)] = name
        copied.objects[name] = content
    left = size > most_bytes or len(found) > MOST_PLACES
    n_planes = math.prod(len(axis.values) for axis in run.axes if axis.swept)
    missing = f"Of the planes of initial states this copy has {len(objects):,} of {n_planes:,}." if left else ""
    if left:
        copied.sentences.append(missing)
    copied.about["planes"] = {"objects": objects, "missing": missing, "none": none or {"source": None}}


@dataclass(frozen=True)
class Column:
    """Points of a diagram for one vertical axis, and the number of points of each cell."""

    count: np.ndarray  # uint32 (n_cells,)
    y: np.ndarray  # (n,)


def column(run: ExploredRun, x: str, y: str) -> tuple[Column, dict[str, np.ndarray]]:
    """Read the diagram points of one vertical axis, with the status and colour codes of the cells."""
    parts = [points(run, x, y, at) for at in places(run, but=x)]
    cells = np.concatenate([part.cell for part in parts])
    order = np.argsort(cells, kind="stable")
    counts = np.concatenate([np.diff(part.first) for part in parts])
    first = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    values = np.concatenate([part.y for part in parts])
    layers = {"status": [part.status for part in parts]}
    for name in parts[0].codes:
        layers[f"colour_{name}"] = [part.codes[name] for part in parts]
    count = counts[order].astype(np.uint32)
    moved = values[ranges(first[:-1][order], count)]
    return Column(count, moved), {name: np.concatenate(found)[order] for name, found in layers.items()}


def ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Concatenate the index ranges ``first[i], ..., first[i] + count[i] - 1`` for all i."""
    ends = np.cumsum(count, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    return np.asarray(np.arange(total) + np.repeat(np.asarray(first, np.int64) - (ends - count), count))


def place_of(run: ExploredRun, vertical: Vertical) -> tuple[str, list[int | None]]:
    """Return the variable of the result cube that a vertical axis shows, and the index on each of its further dims.

    The index is None on the dim of sections.
    """
    source = run.cube()[vertical.variable]
    own = [str(d) for d in source.dims if d not in run.plan.dims]
    shape = [source.sizes[d] for d in own]
    numbers = xr.DataArray(
        np.arange(math.prod(shape)).reshape(shape),
        dims=own,
        coords={d: source.coords[d] for d in own if d in source.coords},
    )
    first = int(vertical.values(xr.Dataset({vertical.variable: numbers})).isel(period_index=0))
    index = np.unravel_index(first, shape)
    return vertical.variable, [None if d == "period_index" else int(i) for d, i in zip(own, index, strict=True)]


@dataclass(frozen=True)
class Level:
    """Level of detail of exported diagrams: precision of the numbers, and which section points are kept."""

    dtype: str  # type of the values
    # step between kept section points of cells on no closed orbit; 0 keeps all points of all cells. With any
    # other number, cells on closed orbits keep one period.
    each: int


@dataclass(frozen=True)
class Fitted:
    """Diagram points that fit the size limit, packed, with their level of detail."""

    objects: dict[str, bytes]  # data by name of the vertical axis
    level: Level
    kept: int  # kept, total: points of the first vertical axis, here and in the run
    total: int
    closed: int  # closed, others: cells with points that are on closed orbits, and that are not
    others: int

    def sentences(self) -> list[str]:
        """Return sentences that tell the reader of the page about rounded numbers and omitted points."""
        found = []
        if self.level.dtype == "float32":
            found.append("Numbers are rounded to 24 bits, so each is right to 6e-8 of its size.")
        if self.kept < self.total:
            each = self.level.each
            rest = "all sections" if each == 1 else f"every {_ordinal(each)} section, the last one among them"
            found.append(
                f"Sections were left out: this copy has {self.kept:,} of {self.total:,} points. Of "
                f"{self.closed:,} cells on closed orbits it has the last period; of {self.others:,} others "
                f"{rest}. "
                "magpend export --folder leaves nothing out."
            )
        return found


def _ordinal(n: int) -> str:
    return f"{n}{'th' if 10 < n % 100 < 14 else {1: 'st', 2: 'nd', 3: 'rd'}.get(n % 10, 'th')}"


def levels(most: int) -> Iterator[Level]:
    """Yield levels of detail, from all section points in full precision to one point per cell."""
    yield Level("float64", 0)
    yield Level("float32", 0)
    for each in itertools.chain([1], *([2 * 2**k, 3 * 2**k] for k in range(most.bit_length()))):
        yield Level("float32", each)


def fit(columns: Mapping[str, Column], period: np.ndarray, most_bytes: float) -> Fitted | None:
    """Pack the diagram points at the finest level of detail that fits a size limit [bytes]; None if no level fits.

    `period` is that of each cell's closed orbit; 0 where there is none.
    """
    longest = max((int(c.count.max(initial=0)) for c in columns.values()), default=0)
    first = next(iter(columns.values()))
    closed = int(((first.count > 0) & (period > 0)).sum())
    others = int((first.count > 0).sum()) - closed
    for level in levels(longest):
        objects = _packed(columns, period, level, most_bytes)
        if objects is not None:
            kept = int(thinned(first, period, level.each).count.sum())
            return Fitted(objects, level, kept, len(first.y), closed, others)
    return None


def _packed(
    columns: Mapping[str, Column], period: np.ndarray, level: Level, most_bytes: float
) -> dict[str, bytes] | None:
    objects, size = {}, 0
    for name, column in columns.items():
        part = thinned(column, period, level.each)
        objects[name] = pack_zipped({"count": part.count, "y": part.y.astype(level.dtype)})
        size += len(objects[name])
        if size > most_bytes:
            return None
    return objects


def thinned(column: Column, period: np.ndarray, each: int) -> Column:
    """Keep the last period of each periodic cell, and every `each`-th section point of the others; 0 keeps all points.

    The last section of every cell stays. Nothing is left out if `each` is 0.
    """
    if each == 0:
        return column
    count = column.count.astype(np.int64)
    first = np.cumsum(count) - count
    # sections that come after each one, in its cell
    after = np.repeat(count, count) - 1 - (np.arange(len(column.y)) - np.repeat(first, count))
    orbit = np.repeat(period.astype(np.int64), count)
    stays = np.where(orbit > 0, after < orbit, after % each == 0)
    kept = np.add.reduceat(np.append(stays, False), first, dtype=np.int64) if len(first) else count
    return Column(np.where(count > 0, kept, 0).astype(np.uint32), column.y[stays])
