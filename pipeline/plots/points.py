"""Read the points to draw from a result cube in blocks, so that the needed memory does not grow with the cube."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import xarray as xr

from pipeline.layout import vocabulary
from pipeline.plots.palette import Motions, motion_codes, motions_of
from pipeline.products.reporting import track

DRAWN = (vocabulary.PERIODIC, vocabulary.BOUNDED, vocabulary.INFERRED)
ABSENT = {
    "pending": (vocabulary.PENDING,),
    "diverged": (vocabulary.DIVERGED,),
    "failed": (vocabulary.STEP_LIMIT, vocabulary.STEP_UNDERFLOW),
    "not reached": (vocabulary.UNREACHED,),
    "no return": (vocabulary.NO_RETURN,),
    "chatter": (vocabulary.CHATTER,),
}
"""What became of cells that have no point to draw."""

BLOCK_VALUES = 4_000_000
"""Most numbers of a block that is read at once."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Points:
    """Points to draw: x, y, class of motion and direction of continuation, each of shape (n,)."""

    x: np.ndarray
    y: np.ndarray
    motion: np.ndarray
    """Codes of `Motions`."""
    layer: np.ndarray
    """Index into the layers of the view."""

    def inside(self, x: Range | None, y: Range | None) -> Points:
        """Select the points inside ranges of x and y; None sets no limit."""
        kept = np.ones(self.x.size, bool)
        for values, limits in ((self.x, x), (self.y, y)):
            if limits is not None:
                kept &= (values >= min(limits)) & (values <= max(limits))
        return self if kept.all() else Points(*(a[kept] for a in (self.x, self.y, self.motion, self.layer)))


Coordinates = Callable[[xr.Dataset], tuple[np.ndarray, np.ndarray]]
"""What gives x and y of a loaded block: each of the shape of its cells and the kept periods, or one that
broadcasts to it."""


@dataclass(frozen=True)
class View:
    """Description of what is drawn of a result cube: its variables, a function that computes points, and colours."""

    ds: xr.Dataset
    names: tuple[str, ...]  # variables that are read
    coordinates: Coordinates
    n_points: int  # number of points if no cell is absent
    layers: tuple[str, ...]  # directions that lie on one another; a single empty one where there are none
    motions: Motions

    def blocks(self) -> Iterator[xr.Dataset]:
        """Load the result cube in blocks of at most some tens of megabytes, and yield them."""
        needed = {*self.names, "status", *(("section", "turns") if self.motions.told else ())}
        part = self.ds[[name for name in self.ds.data_vars if name in needed]]
        for selection in track(list(selections(self.ds[self.names[0]])), "reading the cube"):
            yield part.isel(selection).load()

    def points(self, block: xr.Dataset) -> Points:
        """Return the points to draw from one block of the result cube."""
        x, y = self.coordinates(block)
        shape = (*block["status"].shape, max(x.shape[-1], y.shape[-1]))
        x, y = np.broadcast_to(x, shape), np.broadcast_to(y, shape)
        there = block["status"].isin(DRAWN).values[..., None] & np.isfinite(y) & np.isfinite(x)
        spread = [
            np.broadcast_to(cells.transpose(*block["status"].dims).values[..., None], shape)[there]
            for cells in (self.kinds(block), self.layer_index(block))
        ]
        return Points(x[there], y[there], *spread)

    def all_points(self) -> Iterator[Points]:
        """Yield the points to draw, block by block."""
        for block in self.blocks():
            yield self.points(block)

    def kinds(self, block: xr.Dataset) -> xr.DataArray:
        """Return the colour code of each cell: its attractor if attractors are given, otherwise its class of motion."""
        if "_kind" in block.coords:
            return block["_kind"] + xr.zeros_like(block["status"], dtype=np.int32)
        return motion_codes(block)

    def layer_index(self, block: xr.Dataset) -> xr.DataArray:
        """Return the direction of continuation of each cell, as an index."""
        zero = xr.zeros_like(block["status"], dtype=np.int8)
        if self.layers == ("",):
            return zero
        names = block["direction"].values.astype(str)
        return zero + xr.DataArray(np.array([self.layers.index(n) for n in names], np.int8), dims="branch")


def make_view(ds: xr.Dataset, names: tuple[str, ...], coordinates: Coordinates) -> View:
    """Describe what is drawn of a result cube; `coordinates` computes the points from the variables `names`."""
    layers: tuple[str, ...] = ("",)
    if "branch" in ds["status"].dims and "direction" in ds.coords:
        present = {str(name) for name in ds["direction"].values}
        layers = tuple(sorted(present, key=lambda name: (name != "up", name)))
    n_points = ds["status"].size * ds.sizes["period_index"]
    return View(ds, names, coordinates, n_points, layers, motions_of(ds))


@dataclass
class Survey:
    """Ranges of the points to draw, the classes of motion that occur, and the numbers of cells."""

    x: Range = (math.inf, -math.inf)  # x, y: range of the points
    y: Range = (math.inf, -math.inf)
    classes: set[tuple[int, int]] = field(default_factory=set)  # pairs of layer and motion that occur
    cells: np.ndarray = field(default_factory=lambda: np.zeros((1, 1), np.int64))  # (layer, position); numbers of cells
    # numbers of those without a point, by what became of them
    absent: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        """Whether there is no point to draw."""
        return not self.classes

    def add(self, points: Points, n_motions: int) -> None:
        """Add points to the survey: widen its ranges, and note their classes of motion."""
        if not points.x.size:
            return
        self.x = _joined(self.x, points.x)
        self.y = _joined(self.y, points.y)
        codes = np.flatnonzero(np.bincount(points.layer.astype(np.int64) * n_motions + points.motion))
        self.classes |= {(int(c) // n_motions, int(c) % n_motions) for c in codes}


def _joined(known: Range, values: np.ndarray) -> Range:
    return min(known[0], float(values.min())), max(known[1], float(values.max()))


def survey(view: View, *, along: str = "", xlim: Range | None = None, ylim: Range | None = None) -> Survey:
    """Find the ranges of the points to draw, the classes of motion that occur, and the cells without points.

    Absent cells are counted along the dim `along`, by default all in one.
    """
    size = view.ds.sizes[along] if along else 1
    shape = (len(view.layers), size)
    found = Survey(cells=np.zeros(shape, np.int64), absent={name: np.zeros(shape, np.int64) for name in ABSENT})
    marked = view
    if along:
        position = xr.DataArray(np.arange(size), dims=along)
        marked = View(
            view.ds.assign_coords(_position=position),
            view.names,
            view.coordinates,
            view.n_points,
            view.layers,
            view.motions,
        )
    for block in marked.blocks():
        found.add(marked.points(block).inside(xlim, ylim), len(view.motions.words))
        _count_absent(marked, block, found)
    return found


def _count_absent(view: View, block: xr.Dataset, found: Survey) -> None:
    status = block["status"]
    zero = xr.zeros_like(status, dtype=np.int64)
    layer = view.layer_index(block).transpose(*status.dims).values.astype(np.int64).ravel()
    position = (zero + block["_position"] if "_position" in block.coords else zero).transpose(*status.dims)
    where = layer * found.cells.shape[1] + position.values.ravel()
    size = found.cells.size
    found.cells += np.bincount(where, minlength=size).reshape(found.cells.shape)
    for name, codes in ABSENT.items():
        chosen = status.isin(codes).values.ravel()
        found.absent[name] += np.bincount(where[chosen], minlength=size).reshape(found.cells.shape)


def selections(array: xr.DataArray) -> Iterator[dict[str, slice]]:
    """Yield selections of an array (a slice for each dim) that together cover all its cells once, chunk by chunk."""
    own = [str(d) for d in array.dims if d in _OWN_DIMS]
    dims = [str(dim) for dim in array.dims if dim not in own]
    each = math.prod(array.sizes[dim] for dim in own)
    chunks = _chunk_sizes(array)
    # whole chunks along the last dims, as many as fit
    sizes: dict[str, int] = {}
    for i, dim in enumerate(reversed(dims)):
        rest = math.prod(chunks[other] for other in dims[: len(dims) - 1 - i])
        fit = BLOCK_VALUES // max(1, each * rest * math.prod(sizes.values()))
        n_chunks = max(1, fit // chunks[dim])
        sizes[dim] = min(n_chunks * chunks[dim], max(1, array.sizes[dim]))
    # a chunk that is too large on its own is cut
    for dim in dims:
        total = each * math.prod(sizes.values())
        if total > BLOCK_VALUES:
            sizes[dim] = max(1, sizes[dim] * BLOCK_VALUES // total)
    slices = [[slice(i, i + sizes[dim]) for i in range(0, array.sizes[dim], sizes[dim])] for dim in dims]
    for chosen in product(*slices):
        yield dict(zip(dims, chosen, strict=True))


_OWN_DIMS = ("period_index", "state", "quantity", "extreme")


def _chunk_sizes(array: xr.DataArray) -> dict[str, int]:
    preferred = array.encoding.get("preferred_chunks") or {}
    sizes = {str(dim): int(preferred.get(dim, 1)) for dim in array.dims}
    sizes.update({str(dim): int(max(lengths)) for dim, lengths in array.variable.chunksizes.items()})
    return {dim: max(1, size) for dim, size in sizes.items()}
