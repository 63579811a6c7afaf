"""Create zarr arrays in magpend's format: little-endian, lz4-compressed, with a crc32c checksum in each chunk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numcodecs.blosc
import numpy as np
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec

# With several threads blosc appends blocks in the order in which they finish: same data, other bytes.
numcodecs.blosc.use_threads = False


def create_array(
    group: zarr.Group,
    name: str,
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: str,
    fill: float | int | str,
    attrs: Mapping[str, Any],
) -> Any:
    """Create an array whose chunks carry checksums; the `dtype` ``string`` holds texts of any length."""
    serializer: Any = "auto"
    if dtype != "string":
        serializer = BytesCodec(endian="little" if np.dtype(dtype).itemsize > 1 else None)
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        fill_value=fill,
        serializer=serializer,
        compressors=[BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()],
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=dims,
        attributes=dict(attrs),
        config={"write_empty_chunks": True},
    )


def write_whole(
    group: zarr.Group, name: str, dims: tuple[str, ...], values: np.ndarray, attrs: Mapping[str, Any]
) -> None:
    """Write an array of numbers or texts in one chunk."""
    texts = values.dtype.kind in "UO"
    dtype = "string" if texts else str(values.dtype)
    fill = "" if texts else (np.nan if values.dtype.kind == "f" else 0)
    chunks = tuple(max(n, 1) for n in values.shape)
    array = create_array(group, name, dims, values.shape, chunks, dtype, fill, attrs)
    array[...] = values
