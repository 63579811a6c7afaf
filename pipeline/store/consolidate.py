"""Rewrite a run's result cube for browsers, which read it over HTTP: small chunks, and one file that describes all
arrays.

A browser can decompress gzip but not blosc. It cannot list a folder. It asks for one state at a few values
of the horizontal axis. A chunk here therefore holds one state of all cells at some values of that axis,
compressed by gzip, and the group's metadata describe every array. The numbers equal the cube's bit for bit.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BytesCodec, Crc32cCodec, GzipCodec
from zarr.codecs.numcodecs import Shuffle
from zarr.storage import LocalStore

from pipeline.layout.cells import parameter_axes
from pipeline.products.reporting import report
from pipeline.store.files import CUBE, entry_of
from pipeline.store.run import RunDirectory

CHUNK_BYTES = 500_000
"""Bytes of a chunk before compression, so large that a request's delay is short beside its transfer."""

SLAB_BYTES = 200_000_000
"""Bytes that are held in memory at a time."""


PRIVATE = ("host",)
"""Attributes of an opened cube that are not published."""


@dataclass(frozen=True)
class Layer:
    """An additional array that is stored with the result cube: one value, or an array of values, for each cell."""

    values: np.ndarray  # in the shape of the cells, followed by `own_dims`
    attrs: Mapping[str, Any]  # attributes of the array, such as its unit
    own_dims: tuple[str, ...] = ()  # dims after those of the cells


Layers = Mapping[str, Layer]


def write_cube(run: RunDirectory, folder: Path, along: str | None, layers: Layers) -> dict[str, dict[str, Any]]:
    """Write the committed cells of a run as a zarr cube with small chunks, which browsers can read, in a new
    ``cube.zarr``.

    Cells that the run has not committed read as pending there, too. `along` is the dim of the swept parameter on the
    horizontal axis. Return size and sha256 of every file, by its path below `folder`. Raise `DamagedError` if the
    content of a chunk has changed.
    """
    place = folder / CUBE
    place.mkdir(parents=True)
    store = LocalStore(place)
    with _unwarned():
        _write_group(run, store, _Columns(run, along), layers)
        zarr.consolidate_metadata(store)
    files = sorted(path for path in place.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): entry_of(path.read_bytes()) for path in files}


class _Columns:
    """Chunks of the rewritten cube: one state for all initial conditions at values of one parameter."""

    def __init__(self, run: RunDirectory, along: str | None) -> None:
        self.dims, self.shape, self._sizes = run.plan.dims, run.plan.shape, run.plan.sizes
        swept = [axis.dim for axis in parameter_axes(run.spec)]
        starts = [dim for dim in reversed(self.dims) if dim not in swept]
        others = [dim for dim in reversed(swept) if dim != along]
        self._along = along
        # a chunk first takes in the dims that are read together, other parameters only if room is left
        self._order = [*starts, *([] if along is None else [along]), *others]

    def chunks(self, itemsize: int, own: tuple[str, ...] = ()) -> tuple[int, ...]:
        """Return the chunk shape of an array over the cells and the further dims `own`, such as ``state``."""
        apart = tuple(1 if dim == "state" else self._sizes[dim] for dim in own)
        room = max(1, CHUNK_BYTES // (itemsize * math.prod(apart)))
        found = {}
        for dim in self._order:
            found[dim] = min(self.shape[self.dims.index(dim)], room)
            room = max(1, room // found[dim])
        return (*(found[dim] for dim in self.dims), *apart)

    def slabs(self, chunks: tuple[int, ...], bytes_per_cell: int) -> Iterator[tuple[slice, ...]]:
        """Yield index slices along the horizontal axis: as many whole chunks as fit in some memory."""
        if self._along is None:
            yield (slice(None),) * len(self.dims)
            return
        i = self.dims.index(self._along)
        per_value = math.prod(self.shape) // self.shape[i] * bytes_per_cell
        step = max(1, SLAB_BYTES // (per_value * chunks[i])) * chunks[i]
        for first in range(0, self.shape[i], step):
            part = slice(first, min(first + step, self.shape[i]))
            yield tuple(part if k == i else slice(None) for k in range(len(self.dims)))


def _write_group(run: RunDirectory, store: LocalStore, columns: _Columns, layers: Layers) -> None:
    ds = run.cube()
    attrs = {str(k): v for k, v in ds.attrs.items() if k not in PRIVATE}
    others = " ".join(sorted(str(name) for name in ds.coords if name not in ds.dims))
    group = zarr.create_group(store, zarr_format=3, attributes=_plain({**attrs, "coordinates": others}))
    for name, coordinate in ds.coords.items():
        values = coordinate.values
        array = _create(group, str(name), coordinate.dims, values, values.shape, None, coordinate.attrs)
        array[...] = values.astype(object) if values.dtype.kind == "U" else values
    for name, layer in layers.items():
        values, dims = layer.values, (*columns.dims, *layer.own_dims)
        chunks = columns.chunks(values.dtype.itemsize, layer.own_dims)
        fill = np.nan if values.dtype.kind == "f" else 0
        _create(group, name, dims, values, chunks, fill, layer.attrs)[...] = values
    total = float(sum(ds[v.name].nbytes for v in run.plan.variables))
    done = 0.0
    for variable in run.plan.variables:
        source = ds[variable.name]
        chunks = columns.chunks(source.dtype.itemsize, variable.own_dims)
        array = _create(group, variable.name, source.dims, source, chunks, variable.fill, source.attrs)
        for slab in columns.slabs(chunks, variable.itemsize(run.plan.sizes)):
            values = source[slab].values
            array[slab] = values
            done += values.nbytes
            report("rewriting the cube", done / 1e6, total / 1e6)


def _create(
    group: zarr.Group,
    name: str,
    dims: Iterable[Any],
    like: Any,
    chunks: tuple[int, ...],
    fill: Any,
    attrs: Mapping[Any, Any],
) -> Any:
    """Create a zarr array with codecs that browsers can decode, and a checksum at the end of each chunk."""
    level = 6  # of gzip
    dtype: np.dtype[Any] = like.dtype
    texts = dtype.kind == "U"
    shuffled = [] if texts or dtype.itemsize == 1 else [Shuffle(elementsize=dtype.itemsize)]
    serializer: Any = "auto" if texts else BytesCodec(endian="little" if dtype.itemsize > 1 else None)
    if fill is None:
        fill = "" if texts else (math.nan if dtype.kind == "f" else 0)
    return group.create_array(
        name,
        shape=like.shape,
        chunks=tuple(max(n, 1) for n in chunks),
        dtype="string" if texts else dtype,
        fill_value=fill,
        serializer=serializer,
        compressors=[*shuffled, GzipCodec(level=level), Crc32cCodec()],
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=tuple(map(str, dims)),
        attributes=_plain(attrs),
        config={"write_empty_chunks": True},
    )


def _plain(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k): v.tolist() if isinstance(v, (np.ndarray, np.generic)) else v for k, v in attrs.items()}


@contextlib.contextmanager
def _unwarned() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        warnings.filterwarnings("ignore", message="Numcodecs codecs are not")
        yield
