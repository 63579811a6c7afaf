"""Define the zarr store of a run in an object store."""

from __future__ import annotations

from typing import Any

from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import ObjectStore

from pipeline.store.objects import ObjectFiles, explain


class RunStore(ObjectStore[Any]):
    """A zarr store in an object store: errors have magpend's messages, and writers read metadata only once."""

    def __init__(self, files: ObjectFiles, *, read_only: bool = False) -> None:
        super().__init__(files.store, read_only=read_only)
        self._files = files

    def __reduce__(self) -> tuple[Any, ...]:
        return _run_store, (self._files, self.read_only)

    def with_read_only(self, read_only: bool = False) -> RunStore:
        """Return the same store for zarr, with the given read-only setting."""
        return RunStore(self._files, read_only=read_only)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the content of a key for zarr; None if the object does not exist."""
        kept = self._files.metadata
        if key in kept and not self.read_only:
            return kept[key]
        try:
            found = await super().get(key, prototype, byte_range)
        except Exception as error:
            raise explain(self._files.path(key), error) from None
        if found is not None and key.endswith("zarr.json") and not self.read_only:
            kept[key] = found
        return found

    async def set(self, key: str, value: Buffer) -> None:
        """Write the content of a key for zarr."""
        try:
            await super().set(key, value)
        except Exception as error:
            raise explain(self._files.path(key), error, writing=True) from None


def _run_store(files: ObjectFiles, read_only: bool) -> RunStore:
    return RunStore(files, read_only=read_only)
