"""Define a view of a result cube that shows only committed cells: others read as pending, changed chunks raise an
error.

Every chunk is compared with the sha256 in its commit record when it is read; metadata and coordinates are
compared with ``run.json``. ``MAGPEND_VERIFY=0`` in the environment turns this off. The chunk's own crc32c
then still reveals changed bytes, but not a whole chunk in the place of another.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Mapping
from typing import Any

import google_crc32c
from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from pipeline.store.commits import remedy
from pipeline.store.declared import Declared
from pipeline.store.errors import DamagedError
from pipeline.store.files import CUBE, Files, checks_chunks
from pipeline.store.keys import Owners
from pipeline.store.records import Commit
from pipeline.store.runfile import RunInfo

SMALL = 200_000
"""Largest size in bytes of a chunk that `pipeline.store.reading` reads; zarr reads larger ones."""


class Shown:
    """Files of the result cube that readers see (metadata, coordinates and committed chunks), with size and sha256."""

    def __init__(self, info: RunInfo, commits: Mapping[int, Commit]) -> None:
        self._skeleton = info.skeleton
        self._owners = Owners(info.plan)
        self.declared = Declared(info.plan)
        self._commits = commits

    def arrays(self) -> list[str]:
        """Return the names of the arrays in the result cube."""
        return sorted({key.partition("/")[0] for key in self._skeleton if "/" in key})

    def entry(self, key: str) -> Mapping[str, Any] | None:
        """Return the recorded size and sha256 of a file; None if readers do not see the file."""
        if key in self._skeleton:
            return self._skeleton[key]
        task = self._owners.task(key)
        if task is None or task not in self._commits:
            return None
        return self._commits[task].objects.get(key)


class CommittedStore(WrapperStore[Store]):
    """A read-only zarr store of the result cube, in which chunks without a valid commit record do not exist.

    zarr then reads the fill value, which means pending. A chunk that has a record but is missing or has changed raises
    `DamagedError`. Contents of files in `known` were compared already.
    """

    def __init__(
        self, store: Store, files: Files, shown: Shown, checks: bool = True, known: Mapping[str, bytes] | None = None
    ) -> None:
        super().__init__(store)
        self._files = files
        self._shown = shown
        self._checks = checks
        self._known = known or {}

    def _with_store(self, store: Store) -> CommittedStore:
        return type(self)(store, self._files, self._shown, self._checks, self._known)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the content of a file of the result cube for zarr; None if readers must not see the file.

        Raises
        ------
        DamagedError
            If the content has changed since it was written.
        """
        entry = self._shown.entry(key)
        if entry is None:
            return None
        if key in self._known:
            content: Any = self._compare(key, entry, self._known[key])
        elif self._files.local is not None:
            # a thread reads and compares, while the event loop asks for other chunks
            content = await asyncio.to_thread(self._read, key, entry)
        else:
            found = await self._store.get(key, prototype)
            content = None if found is None else found.to_bytes()
            await asyncio.to_thread(self._compare, key, entry, content)
        whole = prototype.buffer.from_bytes(content)
        return whole if byte_range is None else whole[_slice(byte_range, len(whole))]

    def small_chunk(self, key: str) -> bytes | None:
        """Return the content of a small committed chunk in a local folder; None for anything else.

        It is compared with the crc32c at its end, as zarr does with larger chunks, and with its record unless that is
        turned off.
        """
        entry = self._shown.entry(key) if self._files.local is not None else None
        if entry is None or entry["size"] > SMALL:
            return None
        content = self._read(key, entry)
        if not _crc32c_fits(content):
            raise self._damaged(key, "is not what was written: its content has changed")
        return content

    def _read(self, key: str, entry: Mapping[str, Any]) -> bytes:
        """Read a local file and compare it with its recorded size and sha256."""
        try:
            content: bytes | None = self._files.read(f"{CUBE}/{key}")
        except FileNotFoundError:
            content = None
        return self._compare(key, entry, content)

    def _compare(self, key: str, entry: Mapping[str, Any], content: bytes | None) -> bytes:
        if content is None:
            raise self._damaged(key, "is missing")
        if self._checks and (len(content) != entry["size"] or hashlib.sha256(content).hexdigest() != entry["sha256"]):
            raise self._damaged(key, "is not what was written: its content has changed")
        if problem := self._shown.declared.problem(key, content):
            raise self._damaged(key, f"is not what was written: {problem}")
        return content

    def _damaged(self, key: str, problem: str) -> DamagedError:
        name = self._files.name
        return DamagedError(f"{name}/{CUBE}/{key}: {problem}. {remedy(name)}")

    def arrays(self) -> list[str]:
        """Return the names of the arrays in the result cube."""
        return self._shown.arrays()

    async def exists(self, key: str) -> bool:
        """Return whether a key belongs to the metadata, the coordinates or a committed chunk of the result cube."""
        return self._shown.entry(key) is not None

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield the names in a folder of the result cube; at its top level, the names of its arrays."""
        if prefix.strip("/"):
            async for name in self._store.list_dir(prefix):
                yield name
        else:
            for name in self._shown.arrays():
                yield name

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Return the requested byte ranges of several files of the result cube, for zarr."""
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
    info: RunInfo, commits: Mapping[int, Commit], *, check: bool | None = None, known: Mapping[str, bytes] | None = None
) -> CommittedStore:
    """Return a read-only zarr store that shows the metadata, the coordinates and the committed chunks of a run's result
    cube.

    By default `checks_chunks` says whether chunks are compared with their records. Files in `known` were compared
    already.
    """
    store = info.files.below(CUBE).zarr(read_only=True)
    shown = Shown(info, commits)
    return CommittedStore(store, info.files, shown, checks_chunks() if check is None else check, known)
