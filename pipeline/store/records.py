"""Read and write commit records: one file per task, later one file (a pack) per block of 1000 tasks.

A record is one line of JSON with its own checksum. When all tasks of a block of `BLOCK` are committed, the
holder of the lock puts their lines, unchanged, into one file, the pack, and removes the single files. Opening
a run of 100,000 tasks then reads a hundred files. A pack's last line counts its cells by status and holds a
checksum of the whole pack. Its bytes follow from the records alone, not from the time or the writer.

A damaged pack loses only the records on its damaged lines. If a task of a block is withdrawn, its pack is
written again without that line, and once more when the task has been computed again.
"""

from __future__ import annotations

import heapq
import json
import threading
from collections import Counter, OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.store.errors import DamagedError
from pipeline.store.files import COMMITS, Files
from pipeline.store.stored_json import CHECKSUM, StoredCommit, StoredPack, WrongTypeError, fits, parsed, seal, unseal

BLOCK = 1000
"""Tasks whose records make a pack; this number is part of the directory's format."""

_OPEN_PACKS = 8


@dataclass(frozen=True)
class Commit:
    """A valid commit record: the number of cells by status, and size and sha256 of the task's files."""

    task: int  # index of the task
    status: dict[str, int]  # number of cells by status name
    objects: dict[str, dict[str, Any]]  # size and sha256 of the task's files, by key below ``cube.zarr``


# ---- names -------------------------------------------------------------------------------------


def marker_key(index: int) -> str:
    """Return the key (path) of the file that holds a task's commit record until it is packed."""
    return f"{COMMITS}/{index:06d}.json"


def pack_key(block: int) -> str:
    """Return the key (path) of the pack, the file that holds the commit records of a block of tasks."""
    return f"{COMMITS}/{block * BLOCK:06d}-{(block + 1) * BLOCK - 1:06d}.jsonl"


def block_of_pack(name: str) -> int | None:
    """Return the block of tasks whose pack has the given file name; None if the name is not that of a pack."""
    first = name.partition("-")[0]
    if not (first.isascii() and first.isdigit() and int(first) % BLOCK == 0):
        return None
    block = int(first) // BLOCK
    return block if pack_key(block) == f"{COMMITS}/{name}" else None


# ---- texts -------------------------------------------------------------------------------------


def record_text(record: Mapping[str, Any]) -> str:
    """Return a commit record as it is stored: one line of JSON with a checksum; equal records give equal lines."""
    return seal(json.dumps(record, sort_keys=True, allow_nan=False, ensure_ascii=False))


def read_record(content: bytes, digest: str) -> Commit | str:
    """Parse a commit record; return it if it is undamaged and of this run, otherwise return the problem as text."""
    try:
        data = parsed(StoredCommit, unseal(content))
    except WrongTypeError as error:
        return f"torn or damaged ({error})"
    except (ValueError, KeyError, TypeError, RecursionError):
        return "torn or damaged"
    return Commit(**data) if data.pop("digest") == digest else "of another run"


def line_of(commit: Commit, digest: str) -> bytes:
    """Return the line of a commit record, byte for byte as `write_task` wrote it."""
    record = {"digest": digest, "task": commit.task, "status": commit.status, "objects": commit.objects}
    return record_text(record).encode()


@dataclass(frozen=True)
class Pack:
    """Summary in the last line of a pack, a file of many commit records."""

    block: int  # index of the block
    cells: dict[str, int]  # number of committed cells by status name
    without: tuple[int, ...]  # tasks of the block without a record: they were withdrawn

    @property
    def tasks(self) -> list[int]:
        """Tasks that have a record in the pack, in the order of its lines."""
        absent = set(self.without)
        return [i for i in range(self.block * BLOCK, (self.block + 1) * BLOCK) if i not in absent]


def pack_text(commits: Mapping[int, Commit], digest: str, block: int) -> bytes:
    """Return the content of a pack: the commit records of a block of tasks in order, then a summary line."""
    cells: Counter[str] = Counter()
    lines = []
    without = []
    for index in range(block * BLOCK, (block + 1) * BLOCK):
        if index in commits:
            lines.append(line_of(commits[index], digest))
            cells.update(commits[index].status)
        else:
            without.append(index)
    last = {"block": block, "cells": dict(cells), "digest": digest, "without": without}
    body = b"".join(lines)
    return body + seal(json.dumps(last, sort_keys=True, ensure_ascii=False), body).encode()


def read_pack(content: bytes, digest: str, block: int) -> Pack | str:
    """Return the summary of a pack if it is undamaged and of this run; otherwise return the problem."""
    if not fits(content):
        return "torn or damaged"
    try:
        last = json.loads(content[content.rfind(b"\n", 0, -1) + 1 :])
        del last[CHECKSUM]
        last = parsed(StoredPack, last)
    except WrongTypeError as error:
        return f"torn or damaged ({error})"
    except (ValueError, KeyError, TypeError, RecursionError):
        return "torn or damaged"
    if last["digest"] != digest:
        return "of another run"
    pack = Pack(last["block"], last["cells"], tuple(last["without"]))
    return pack if pack.block == block and len(pack.tasks) == content.count(b"\n") - 1 else "torn or damaged"


def salvage(content: bytes, digest: str, block: int) -> dict[int, Commit]:
    """Return the undamaged records in a damaged pack (a file of many commit records), by task."""
    found = {}
    for line in content.split(b"\n"):
        commit = read_record(line + b"\n", digest)
        if isinstance(commit, Commit) and commit.task // BLOCK == block:
            found[commit.task] = commit
    return found


# ---- all records of a run ----------------------------------------------------------------------


class Records(Mapping[int, Commit]):
    """Valid commit records of a run by task; records in packs (files of many records) are read on demand.

    `singles` have their own files, or were salvaged from a damaged pack; `packs` are whole.
    """

    def __init__(
        self, files: Files, digest: str, singles: Mapping[int, Commit], packs: Mapping[int, Pack] | None = None
    ) -> None:
        self._files = files
        self._digest = digest
        self.packs = dict(sorted((packs or {}).items()))
        self._without = {block: frozenset(pack.without) for block, pack in self.packs.items()}
        self.singles = {i: c for i, c in sorted(singles.items()) if not self.is_packed(i)}
        self._open: OrderedDict[int, dict[int, bytes | Commit]] = OrderedDict()
        self._lock = threading.Lock()

    def is_packed(self, index: int) -> bool:
        """Return whether the record of a task lies in a pack, a file of many records."""
        block = index // BLOCK
        return block in self.packs and index not in self._without[block]

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and (index in self.singles or self.is_packed(index))

    def __len__(self) -> int:
        return len(self.singles) + sum(BLOCK - len(absent) for absent in self._without.values())

    def __iter__(self) -> Iterator[int]:
        packed = (i for pack in self.packs.values() for i in pack.tasks)
        return heapq.merge(packed, self.singles)

    def __getitem__(self, index: int) -> Commit:
        if index in self.singles:
            return self.singles[index]
        if not self.is_packed(index):
            raise KeyError(index)
        lines = self._block(index // BLOCK)
        line = lines[index]
        if isinstance(line, bytes):
            found = read_record(line, self._digest)
            if isinstance(found, str) or found.task != index:
                key, problem = pack_key(index // BLOCK), found if isinstance(found, str) else "of another task"
                raise DamagedError(f"{self._files.name}/{key}: its record of task {index} is {problem}.")
            line = lines[index] = found
        return line

    def _block(self, block: int) -> dict[int, bytes | Commit]:
        """Return the contents of a pack by task: lines of JSON, replaced by parsed records when they are first used."""
        with self._lock:
            if block not in self._open:
                self._open[block] = self._read(block)
                if len(self._open) > _OPEN_PACKS:
                    self._open.popitem(last=False)
            self._open.move_to_end(block)
            return self._open[block]

    def _read(self, block: int) -> dict[int, bytes | Commit]:
        key, pack = pack_key(block), self.packs[block]
        try:
            content = self._files.read(key)
        except FileNotFoundError:
            content = b""
        if read_pack(content, self._digest, block) != pack:
            raise DamagedError(f"{self._files.name}/{key}: has changed since the run was opened; open it again.")
        lines = content.split(b"\n")
        return {index: line + b"\n" for index, line in zip(pack.tasks, lines, strict=False)}

    def cells(self) -> dict[str, int]:
        """Return the number of committed cells by status."""
        found: Counter[str] = Counter()
        for pack in self.packs.values():
            found.update(pack.cells)
        for commit in self.singles.values():
            found.update(commit.status)
        return dict(found)

    def lines(self) -> Iterator[bytes]:
        """Yield all commit records as they are stored, lines of JSON, in the order of tasks."""
        for index in self:
            if index in self.singles:
                yield line_of(self.singles[index], self._digest)
            else:
                line = self._block(index // BLOCK)[index]
                yield line if isinstance(line, bytes) else line_of(line, self._digest)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict(), "_lock": None}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()
