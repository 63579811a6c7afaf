"""Collect the data of an exported page: description of the run, diagrams, curves, planes of initial states."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.status import Status
from pipeline.explorer.copies.packing import packed, packed_json
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.diagram import points
from pipeline.explorer.data.disturbances import disturbances
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.overlays import attractors, branches, curves
from pipeline.explorer.data.planes import plane
from pipeline.explorer.data.verticals import Vertical
from pipeline.explorer.data.view import describe_view
from pipeline.plots.points import DRAWN
from pipeline.products.reporting import track
from pipeline.specification.problems import SpecError, unknown_name

MOST_PLACES = 4000
"""Answers of a kind that a copy holds, one for each place of the axes."""

BLOCK_BYTES = 1_000_000
"""Answers lie together in objects of about so many bytes before compression."""

Place = dict[str, int]


@dataclass
class Copied:
    """Data of an exported page, and notes to its reader, as collected so far.

    Attributes
    ----------
    view : dict
        As `describe_view` gives it.
    about : dict
        Facts on the export for the page's script.
    objects : dict
        Data by name.
    sentences : list of str
        Notes on the export for its readers.
    """

    run: ExploredRun
    view: dict[str, Any]
    about: dict[str, Any]
    objects: dict[str, bytes] = field(default_factory=dict)
    sentences: list[str] = field(default_factory=list)

    @property
    def x(self) -> str:
        """Name of the horizontal axis that is shown first."""
        return str(self.view["axes"][0]["name"])

    def size(self) -> int:
        """Return the size of the collected data [bytes]."""
        return sum(map(len, self.objects.values()))


def gather(run: ExploredRun, quantities: Sequence[str] = ()) -> Copied:
    """Collect the data that every export has: all except the points of the diagrams and the orbits.

    Parameters
    ----------
    run
        The run.
    quantities
        Those of the model that can be on the vertical axis, besides states and kept extremes.

    Raises
    ------
    SpecError
        If the model has no such quantity.
    DamagedError
        If what is read of the run is not what was written.
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
    lines = [(a.name, place) for a in run.axes for place in places(run, but=a.name)]
    heights = [str(v["name"]) for v in view["verticals"]]
    _answers(copied, "curves", ((place_key(run, at, x), partial(curves, run, x, at)) for x, at in lines))
    known = view["has"]
    # what is not computed has one answer everywhere: how to compute it
    asked = ((y, x, at) for y in (heights if known["branches"] else heights[:1]) for x, at in lines)
    _answers(
        copied,
        "branches",
        ((f"y={y}&{place_key(run, at, x)}", partial(branches, run, x, y, at)) for y, x, at in asked),
        alike=not known["branches"],
    )
    everywhere = ((place_key(run, at), partial(attractors, run, at)) for at in places(run))
    _answers(copied, "attractors", everywhere, alike=not known["attractors"])
    disturbed = bool(run.kept_each("resilience") or run.kept_each("edge"))
    everywhere = ((place_key(run, at), partial(disturbances, run, at)) for at in places(run))
    _answers(copied, "disturbances", everywhere, alike=not disturbed)
    return copied


def _view(run: ExploredRun, quantities: Sequence[str]) -> tuple[dict[str, Any], int]:
    """Return the description of a run with only the given quantities of the model, and the number of vertical axes left
    out.
    """
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
    """Return the key of a point on the axes, such as ``frequency=3&amplitude=0``; the page's script makes the same
    keys.
    """
    parts = [f"{a.name}={at.get(a.name, 0)}" for a in run.axes if a.name != x]
    return "&".join([*([f"x={x}"] if x else []), *parts])


def _answers(copied: Copied, kind: str, asked: Iterable[tuple[str, Callable[[], Any]]], alike: bool = False) -> None:
    """Compute the answers to all requests of one kind that a page can make, and pack them into an export.

    If they are all alike, the first stands for all.
    """
    asked = list(itertools.islice(asked, 1 if alike else MOST_PLACES + 1))
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
        if size > BLOCK_BYTES:
            copied.objects[f"{kind}-{number}"] = packed_json(held)
            held, number, size = {}, number + 1, 0
    if held:
        copied.objects[f"{kind}-{number}"] = packed_json(held)
    copied.about["answers"][kind] = {"blocks": blocks, "missing": "", "alike": None}


def add_planes(copied: Copied, most_bytes: float) -> None:
    """Add the planes of initial states, coloured by outcome, to an export, up to a total size."""
    run, size, none = copied.run, 0, None
    objects: dict[str, str] = {}
    found = list(itertools.islice(places(run), MOST_PLACES + 1))
    for at in track(found[:MOST_PLACES], "copying planes"):
        arrays, attrs = unpack_arrays(plane(run, at))
        if attrs.get("source") is None:
            none = attrs
            continue
        name = f"plane-{len(objects)}"
        content = packed(arrays, attrs)
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
    """Points of a diagram for one vertical axis, and the number of points of each cell.

    Attributes
    ----------
    count : ndarray of uint32, (n_cells,)
    y : ndarray, (n,)
    """

    count: np.ndarray
    y: np.ndarray


def column(run: ExploredRun, x: str, y: str) -> tuple[Column, dict[str, np.ndarray]]:
    """Read the diagram points of one vertical axis, with the status and colour codes of the cells.

    Raises
    ------
    DamagedError
        If what is read of the run is not what was written.
    """
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
