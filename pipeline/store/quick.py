"""Reading very many small chunks: without a coroutine for every step of every chunk, as zarr has them.

What is read and decoded here is what zarr would have read and decoded; all it cannot do goes to zarr.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import numcodecs.blosc
import numpy as np
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec
from zarr.core.codec_pipeline import BatchedCodecPipeline
from zarr.registry import register_pipeline

from pipeline.store.view import CommittedStore

_CHAIN = (BytesCodec, BloscCodec, Crc32cCodec)
_BATCH = 200
_CHECKSUM_BYTES = 4


class QuickPipeline(BatchedCodecPipeline):
    """zarr's own way to read, but for small chunks of a `CommittedStore` in a local folder."""

    async def read(self, batch_info: Iterable[Any], out: Any, drop_axes: tuple[int, ...] = ()) -> None:
        """Put chunks where they belong in `out`; see zarr."""
        items = list(batch_info)
        if len(items) > 1 and not drop_axes and tuple(type(codec) for codec in self) == _CHAIN:
            target = out.as_ndarray_like()
            batches = [items[i : i + _BATCH] for i in range(0, len(items), _BATCH)]
            # threads: a disk, or a server, is asked for many files at a time
            left = await asyncio.gather(*(asyncio.to_thread(_put_all, batch, target) for batch in batches))
            items = [item for batch in left for item in batch]
        if items:
            await super().read(items, out, drop_axes)


def _put_all(items: list[Any], target: np.ndarray) -> list[Any]:
    """Decode chunks into an array; returns those that are left to zarr."""
    return [item for item in items if not _put(item, target)]


def _put(item: Any, target: np.ndarray) -> bool:
    place, spec, chunk_selection, selection, *_ = item
    if not isinstance(place.store, CommittedStore):
        return False
    content = place.store.small_chunk(place.path)
    if content is None:
        return False
    # the sha256 of the whole chunk, or its crc32c, has just been compared
    data = numcodecs.blosc.decompress(content[:-_CHECKSUM_BYTES])
    dtype = spec.dtype.to_native_dtype().newbyteorder("<")
    target[selection] = np.frombuffer(data, dtype).reshape(spec.shape)[chunk_selection]
    return True


register_pipeline(QuickPipeline)


@contextlib.contextmanager
def quick_reading() -> Iterator[None]:
    """Let arrays that are opened within read as `QuickPipeline` does."""
    with zarr.config.set({"codec_pipeline.path": f"{QuickPipeline.__module__}.{QuickPipeline.__qualname__}"}):
        yield
