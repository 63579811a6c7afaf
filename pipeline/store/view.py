"""The cube as readers see it: a chunk without a valid commit record does not exist, and a changed one stops.

Every chunk is compared with the sha256 in its commit record when it is read, metadata and coordinates with
``run.json``. ``MAGPEND_VERIFY=0`` in the environment leaves that out: then the chunk's own crc32c notices
what has changed within it, and nothing notices a whole chunk in another's place.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
from collections.abc import AsyncGenerator, Iterable, Mapping
from typing import Any

from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from pipeline.store.commits import Commit
from pipeline.store.errors import DamagedError
from pipeline.store.files import CUBE
from pipeline.store.runfile import RunInfo

VERIFY = "MAGPEND_VERIFY"
"""Environment variable; ``0`` reads chunks without comparing them with their records."""

_LARGE = 1_000_000
"""Chunks of so many bytes are hashed in a thread of their own, so that others are read meanwhile."""


def checks_chunks() -> bool:
    """Whether what is read is compared with its record."""
    return os.environ.get(VERIFY, "1").strip().lower() not in ("0", "no", "false", "off")


class CommittedStore(WrapperStore[Store]):
    """A read-only view of the cube in which a chunk without a valid record does not exist.

    zarr then reads it as the fill value: pending. A chunk that has a record and is absent or not what was
    written raises `DamagedError`.
    """

    def __init__(
        self, store: Store, entries: Mapping[str, Mapping[str, Any]], name: str, checks: bool = True
    ) -> None:
        super().__init__(store)
        self._entries = entries
        self._name = name
        self._checks = checks

    def _with_store(self, store: Store) -> CommittedStore:
        return type(self)(store, self._entries, self._name, self._checks)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """As in zarr, without what is not committed.

        Raises
        ------
        DamagedError
            If what is there is not what was written.
        """
        entry = self._entries.get(key)
        if entry is None:
            return None
        whole = await self._store.get(key, prototype)
        if whole is None:
            raise self._damaged(key, "is missing")
        if self._checks:
            content = whole.as_buffer_like()
            if len(whole) != entry["size"] or await _sha256(content, len(whole)) != entry["sha256"]:
                raise self._damaged(key, "is not what was written: its content has changed")
        return whole if byte_range is None else whole[_slice(byte_range, len(whole))]

    def _damaged(self, key: str, problem: str) -> DamagedError:
        return DamagedError(
            f"{self._name}/{CUBE}/{key}: {problem}. Give the command that made the run again: it computes "
            f"what is damaged; or look at all of it with: magpend verify {self._name}"
        )

    async def exists(self, key: str) -> bool:
        """As in zarr, without what is not committed."""
        return key in self._entries

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


async def _sha256(content: Any, size: int) -> str:
    if size >= _LARGE:
        return await asyncio.to_thread(lambda: hashlib.sha256(content).hexdigest())
    return hashlib.sha256(content).hexdigest()


def _slice(byte_range: ByteRequest, size: int) -> slice:
    if isinstance(byte_range, RangeByteRequest):
        return slice(byte_range.start, byte_range.end)
    if isinstance(byte_range, OffsetByteRequest):
        return slice(byte_range.offset, None)
    return slice(max(0, size - byte_range.suffix), None)


def committed_view(
    info: RunInfo, commits: Mapping[int, Commit], *, check: bool | None = None
) -> CommittedStore:
    """Return the store to read from; it shows the skeleton and what `commits` vouch for.

    Parameters
    ----------
    info, commits
        The run, and its valid records.
    check
        Whether to compare what is read with its record; by default as the environment says.
    """
    entries: dict[str, Mapping[str, Any]] = dict(info.skeleton)
    for commit in commits.values():
        entries |= commit.objects
    store = info.files.below(CUBE).zarr(read_only=True)
    return CommittedStore(store, entries, info.name, checks_chunks() if check is None else check)
