"""The cube as readers see it: a chunk without a valid commit record does not exist, and a changed one stops.

Every chunk is compared with the sha256 in its commit record when it is read, metadata and coordinates with
``run.json``. ``MAGPEND_VERIFY=0`` in the environment leaves that out: then the chunk's own crc32c notices
what has changed within it, and nothing notices a whole chunk in another's place.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Mapping
from typing import Any

import google_crc32c
from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from pipeline.layout.plan import Plan
from pipeline.store.declared import Declared
from pipeline.store.errors import DamagedError
from pipeline.store.files import CUBE, Files
from pipeline.store.keys import Owners
from pipeline.store.records import Commit
from pipeline.store.runfile import RunInfo

VERIFY = "MAGPEND_VERIFY"
"""Environment variable; ``0`` reads chunks without comparing them with their records."""

SMALL = 200_000
"""Chunks of so many bytes are read by `pipeline.store.quick`; larger ones by zarr, one by one."""


def checks_chunks() -> bool:
    """Whether what is read is compared with its record."""
    return os.environ.get(VERIFY, "1").strip().lower() not in ("0", "no", "false", "off")


class Shown:
    """Size and sha256 of what a reader sees, by key: the set-up's files, and what commits vouch for."""

    def __init__(self, info: RunInfo, plan: Plan, commits: Mapping[int, Commit]) -> None:
        self._skeleton = info.skeleton
        self._owners = Owners(plan)
        self.declared = Declared(plan)
        self._commits = commits

    def arrays(self) -> list[str]:
        """Names of what lies in the cube."""
        return sorted({key.partition("/")[0] for key in self._skeleton})

    def entry(self, key: str) -> Mapping[str, Any] | None:
        """Size and sha256 of a file; None if readers do not see it."""
        if key in self._skeleton:
            return self._skeleton[key]
        task = self._owners.task(key)
        if task is None or task not in self._commits:
            return None
        return self._commits[task].objects.get(key)


class CommittedStore(WrapperStore[Store]):
    """A read-only view of the cube in which a chunk without a valid record does not exist.

    zarr then reads it as the fill value: pending. A chunk that has a record and is absent or not what was
    written raises `DamagedError`.

    Parameters
    ----------
    store
        Where the cube lies.
    files
        Of the run.
    shown
        What is seen of it.
    checks
        Whether contents are compared with their records.
    """

    def __init__(self, store: Store, files: Files, shown: Shown, checks: bool = True) -> None:
        super().__init__(store)
        self._files = files
        self._shown = shown
        self._checks = checks

    def _with_store(self, store: Store) -> CommittedStore:
        return type(self)(store, self._files, self._shown, self._checks)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """As in zarr, without what is not committed.

        Raises
        ------
        DamagedError
            If what is there is not what was written.
        """
        entry = self._shown.entry(key)
        if entry is None:
            return None
        if self._files.local is not None:
            # read and compared in one go, away from the loop that asks for others meanwhile
            content: Any = await asyncio.to_thread(self._read, key, entry)
        else:
            found = await self._store.get(key, prototype)
            content = None if found is None else found.to_bytes()
            await asyncio.to_thread(self._compare, key, entry, content)
        whole = prototype.buffer.from_bytes(content)
        return whole if byte_range is None else whole[_slice(byte_range, len(whole))]

    def small_chunk(self, key: str) -> bytes | None:
        """Content of a small chunk in a local folder; None for anything else.

        It is compared with its record, or else with the checksum at its own end.

        Raises
        ------
        DamagedError
            If what is there is not what was written.
        """
        entry = self._shown.entry(key) if self._files.local is not None else None
        if entry is None or entry["size"] > SMALL:
            return None
        content = self._read(key, entry)
        if not self._checks and not _crc32c_fits(content):
            raise self._damaged(key, "is not what was written: its content has changed")
        return content

    def _read(self, key: str, entry: Mapping[str, Any]) -> bytes:
        """Content of a local file, compared with its record unless that is left out."""
        try:
            content: bytes | None = self._files.read(f"{CUBE}/{key}")
        except FileNotFoundError:
            content = None
        return self._compare(key, entry, content)

    def _compare(self, key: str, entry: Mapping[str, Any], content: bytes | None) -> bytes:
        if content is None:
            raise self._damaged(key, "is missing")
        if self._checks and (
            len(content) != entry["size"] or hashlib.sha256(content).hexdigest() != entry["sha256"]
        ):
            raise self._damaged(key, "is not what was written: its content has changed")
        if problem := self._shown.declared.problem(key, content):
            raise self._damaged(key, f"is not what was written: {problem}")
        return content

    def _damaged(self, key: str, problem: str) -> DamagedError:
        name = self._files.name
        return DamagedError(
            f"{name}/{CUBE}/{key}: {problem}. Give the command that made the run again: it computes "
            f"what is damaged; or look at all of it with: magpend verify {name}"
        )

    async def exists(self, key: str) -> bool:
        """As in zarr, without what is not committed."""
        return self._shown.entry(key) is not None

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """As in zarr; of the cube itself, what the set-up has put there."""
        if prefix.strip("/"):
            async for name in self._store.list_dir(prefix):
                yield name
        else:
            for name in self._shown.arrays():
                yield name

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


def _crc32c_fits(content: bytes) -> bool:
    return bool(google_crc32c.value(content[:-4]) == int.from_bytes(content[-4:], "little"))


def _slice(byte_range: ByteRequest, size: int) -> slice:
    if isinstance(byte_range, RangeByteRequest):
        return slice(byte_range.start, byte_range.end)
    if isinstance(byte_range, OffsetByteRequest):
        return slice(byte_range.offset, None)
    return slice(max(0, size - byte_range.suffix), None)


def committed_view(
    info: RunInfo, plan: Plan, commits: Mapping[int, Commit], *, check: bool | None = None
) -> CommittedStore:
    """Return the store to read from; it shows the skeleton and what `commits` vouch for.

    Parameters
    ----------
    info, plan, commits
        The run, and its valid records.
    check
        Whether to compare what is read with its record; by default as the environment says.
    """
    store = info.files.below(CUBE).zarr(read_only=True)
    shown = Shown(info, plan, commits)
    return CommittedStore(store, info.files, shown, checks_chunks() if check is None else check)
