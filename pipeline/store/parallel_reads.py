"""Read many small chunks of a zarr array in threads, which is faster than zarr's coroutines.

The result equals that of zarr. A chunk in any other form is left to zarr. The class here derives from the
registered pipeline class and overrides `read` of `zarr.abc.codec.CodecPipeline`.
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
from zarr.registry import get_pipeline_class, register_pipeline
from zarr.storage import StorePath

from pipeline.store.view import CommittedStore

_CHAIN = (BytesCodec, BloscCodec, Crc32cCodec)
_BATCH = 200
_CHECKSUM_BYTES = 4


_Registered: Any = get_pipeline_class()


class QuickPipeline(_Registered):  # type: ignore[misc]
    """A codec pipeline for zarr that reads small chunks of a `CommittedStore` in a local folder faster, in threads."""

    async def read(self, batch_info: Iterable[Any], out: Any, drop_axes: tuple[int, ...] = ()) -> None:
        """Read and decode chunks into `out`; see `zarr.abc.codec.CodecPipeline.read`."""
        items = list(batch_info)
        if len(items) > 1 and not drop_axes and _codecs_of(self) == _CHAIN:
            target = out.as_ndarray_like()
            batches = [items[i : i + _BATCH] for i in range(0, len(items), _BATCH)]
            # threads, so that a disk or a server is asked for many files at a time
            left = await asyncio.gather(*(asyncio.to_thread(_put_all, batch, target) for batch in batches))
            items = [item for batch in left for item in batch]
        if items:
            await super().read(items, out, drop_axes)


def _codecs_of(pipeline: Any) -> tuple[type, ...]:
    return tuple(type(codec) for codec in pipeline) if isinstance(pipeline, Iterable) else ()


def _put_all(items: list[Any], target: np.ndarray) -> list[Any]:
    return [item for item in items if not _put(item, target)]


def _put(item: Any, target: np.ndarray) -> bool:
    place, spec, chunk_selection, selection, *_ = item
    if not (isinstance(place, StorePath) and isinstance(place.store, CommittedStore)):
        return False
    content = place.store.small_chunk(place.path)
    if content is None:
        return False
    # small_chunk has compared the chunk's crc32c
    data = numcodecs.blosc.decompress(content[:-_CHECKSUM_BYTES])
    dtype = spec.dtype.to_native_dtype().newbyteorder("<")
    target[selection] = np.frombuffer(data, dtype).reshape(spec.shape)[chunk_selection]
    return True


register_pipeline(QuickPipeline)


@contextlib.contextmanager
def quick_reading() -> Iterator[None]:
    """Use `QuickPipeline` for zarr arrays that are opened inside this context."""
    with zarr.config.set({"codec_pipeline.path": f"{QuickPipeline.__module__}.{QuickPipeline.__qualname__}"}):
        yield
