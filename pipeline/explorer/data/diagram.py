"""Read the points of a bifurcation diagram: the section points of the cells along one axis.

The cube is read block by block in the chunks of the store, each compared with its sha256; what stays in
memory is one number per point. A diagram of too many points shows the last sections of each cell, as
many as fit, and says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.data.colours import NO_CODE, Scheme, schemes
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.verticals import Vertical, vertical
from pipeline.layout.vocabulary import PENDING
from pipeline.plots.points import DRAWN, selections
from pipeline.store.run import RunDirectory


@dataclass(frozen=True)
class Points:
    """Points of a diagram, cell by cell along the horizontal axis."""

    x: np.ndarray  # (n_x,); values of the horizontal axis, ascending
    cell: np.ndarray  # uint32 (m,); flat numbers of the cells, sorted by `at`
    at: np.ndarray  # uint32 (m,); place of each cell in `x`
    first: np.ndarray  # uint32 (m + 1,); a cell's points are ``y[first[i] : first[i + 1]]``
    y: np.ndarray  # (n,)
    status: np.ndarray  # int8 (m,)
    codes: Mapping[str, np.ndarray]  # colour codes by scheme, uint16 (m,)
    kept: int  # number of section points shown per cell, the last ones


def diagram(run: RunDirectory, x: str, y: str, at: Mapping[str, int], most_points: int = 20_000_000) -> bytes:
    """Return the points of a bifurcation diagram, packed for the page.

    `x` is a swept axis, `y` a state, a quantity of the model or a kept extreme such as ``NAME.max``, and `at` the index
    on each other swept axis. Raise RequestError if one is not there, or the cells are more than `most_points`;
    8 bytes of each point go to the page.
    """
    explored = ExploredRun.open(run)
    upwards = vertical(explored, y)
    found = points(explored, x, y, at, most_points)
    arrays = {
        "x": found.x,
        "cell": found.cell,
        "at": found.at,
        "first": found.first,
        "y": found.y,
        "status": found.status,
        **{f"colour_{name}": codes for name, codes in found.codes.items()},
    }
    attrs = {
        "x": x,
        "y": y,
        "unit": upwards.unit,
        "at": explored.place(at, but=x),
        "kept": found.kept,
        "n_keep": explored.n_keep,
    }
    return pack_arrays(arrays, attrs)


def points(run: ExploredRun, x: str, y: str, at: Mapping[str, int], most_points: int = 20_000_000) -> Points:
    """Read the points of a bifurcation diagram; the arguments are those of `diagram`."""
    axis, upwards, place = run.axis(x), vertical(run, y), run.place(at, but=x)
    ds = _numbered(run).isel({name: slice(i, i + 1) for name, i in place.items()})
    sizes = tuple(ds.sizes[d] for d in run.plan.dims)
    n_cells = int(np.prod(sizes, dtype=np.int64))
    if n_cells > most_points:
        raise RequestError(
            f"a diagram shows {most_points:,} cells at most, and there are {n_cells:,} here; "
            "look at the plane of initial states, or at a zoom of the run."
        )
    kept = max(1, min(run.n_keep, most_points // n_cells))
    table = _Table(run, upwards, sizes, kept)
    for selection in selections(ds[upwards.variable]):
        table.read(ds, selection)
    return table.points(axis.values, _cell_numbers(run, place))


def _numbered(run: ExploredRun) -> xr.Dataset:
    """Return the run's result cube with the indices along each dim as additional coordinates."""
    ds = run.cube()
    return ds.assign_coords({f"_{d}": (d, np.arange(n)) for d, n in zip(run.plan.dims, run.plan.shape, strict=True)})


def _cell_numbers(run: ExploredRun, place: Mapping[str, int]) -> np.ndarray:
    """Return the flat indices, in the run's result cube, of the cells at fixed indices on some axes."""
    dims, shape = run.plan.dims, run.plan.shape
    chosen = [np.array([place[d]]) if d in place else np.arange(n) for d, n in zip(dims, shape, strict=True)]
    return np.asarray(np.ravel_multi_index(np.ix_(*chosen), shape)).astype(np.uint32)


class _Table:
    """Values, status and colour codes of the selected cells, in the order of the cube's dims."""

    def __init__(self, run: ExploredRun, upwards: Vertical, sizes: tuple[int, ...], kept: int) -> None:
        self.dims, self.upwards, self.kept = run.plan.dims, upwards, kept
        self.schemes: list[Scheme] = schemes(run)
        names = {upwards.variable, "status", *(n for s in self.schemes for n in s.needs)}
        self.names = [str(n) for n in run.cube().data_vars if n in names]
        self.values = np.full((*sizes, kept), np.nan)
        self.status = np.full(sizes, PENDING, np.int8)
        self.codes = {s.name: np.full(sizes, NO_CODE, np.uint16) for s in self.schemes}

    def read(self, ds: xr.Dataset, selection: Mapping[str, slice]) -> None:
        block = ds[self.names].isel(selection).load()
        where: Any = tuple(selection[d] for d in self.dims)
        status = block["status"].transpose(*self.dims)
        values = self.upwards.values(block).transpose(*self.dims, "period_index").values[..., -self.kept :]
        drawn = np.isin(status.values, DRAWN)[..., None] & np.isfinite(values)
        self.values[where] = np.where(drawn, values, np.nan)
        self.status[where] = status.values
        zero = xr.zeros_like(status, dtype=np.int32)
        for scheme in self.schemes:
            found = (zero + scheme.codes(block).drop_vars(list(ds.coords), errors="ignore")).transpose(*self.dims)
            self.codes[scheme.name][where] = np.where(found.values < 0, NO_CODE, found.values)

    def points(self, x: np.ndarray, cells: np.ndarray) -> Points:
        """Return all points that can be drawn, ordered along the horizontal axis."""
        n = self.status.size

        def ordered(array: np.ndarray) -> np.ndarray:
            # dims of starts come last, and of the other axes one place is left: x is the first that is long
            return array.reshape(n, *array.shape[len(self.dims) :])

        values = ordered(self.values)
        there = np.isfinite(values)
        first = np.zeros(len(values) + 1, np.uint32)
        np.cumsum(there.sum(axis=1), out=first[1:])
        at = np.repeat(np.arange(len(x), dtype=np.uint32), len(values) // len(x))
        return Points(
            x=np.asarray(x, np.float64),
            cell=ordered(cells),
            at=at,
            first=first,
            y=values.ravel() if there.all() else values[there],
            status=ordered(self.status),
            codes={name: ordered(codes) for name, codes in self.codes.items()},
            kept=self.kept,
        )
