"""The cube as readers see it: a chunk without a valid commit record does not exist."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable, Mapping

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from pipeline.store.commits import Commit
from pipeline.store.files import CUBE
from pipeline.store.runfile import RunInfo


class CommittedStore(WrapperStore[Store]):
    """A read-only view of the cube in which a chunk without a valid marker does not exist.

    zarr then reads it as the fill value: pending.
    """

    def __init__(self, store: Store, visible: frozenset[str] = frozenset()) -> None:
        super().__init__(store)
        self._visible = visible

    def _with_store(self, store: Store) -> CommittedStore:
        return type(self)(store, self._visible)

    def _shows(self, key: str) -> bool:
        return key.endswith("zarr.json") or key in self._visible

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """As in zarr, without what is not committed."""
        return await self._store.get(key, prototype, byte_range) if self._shows(key) else None

    async def exists(self, key: str) -> bool:
        """As in zarr, without what is not committed."""
        return self._shows(key) and await self._store.exists(key)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """As in zarr, without what is not committed."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    async def _get_many(
        self, requests: Iterable[tuple[str, BufferPrototype, ByteRequest | None]]
    ) -> AsyncGenerator[tuple[str, Buffer | None], None]:
        for key, prototype, byte_range in requests:
            yield key, await self.get(key, prototype, byte_range)


def committed_view(info: RunInfo, commits: Mapping[int, Commit]) -> CommittedStore:
    """Return the store to read from; it shows the skeleton and what `commits` vouch for."""
    visible = frozenset({*info.skeleton, *(key for commit in commits.values() for key in commit.objects)})
    return CommittedStore(info.files.below(CUBE).zarr(read_only=True), visible)
