"""Commit records: one file a task, and packs of these once a block of tasks is whole.

A record is one line of JSON under its own checksum. When all tasks of a block of `BLOCK` are committed, the
holder of the lock puts their lines into one file, as they are, and removes the single ones: opening a run of
100,000 tasks then reads a hundred files. A pack's last line counts its cells by status and seals the whole.
Its bytes follow from the records, so that they do not depend on when it was written, or by whom.

A damaged pack loses the records on its damaged lines, and no others. Where a task of a block is withdrawn,
its pack is written again without that line, and once more when the task has been computed again.
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
from pipeline.store.seal import fits, seal, unseal

BLOCK = 1000
"""Tasks whose records make a pack; part of the directory's format."""

_OPEN_PACKS = 8


@dataclass(frozen=True)
class Commit:
    """A valid record."""

    task: int
    status: dict[str, int]
    objects: dict[str, dict[str, Any]]


# ---- names -------------------------------------------------------------------------------------


def marker_key(index: int) -> str:
    """Where a task's record lies, until it is packed."""
    return f"{COMMITS}/{index:06d}.json"


def pack_key(block: int) -> str:
    """Where the records of a block lie."""
    return f"{COMMITS}/{block * BLOCK:06d}-{(block + 1) * BLOCK - 1:06d}.jsonl"


def block_of_pack(name: str) -> int | None:
    """The block that a file in ``commits`` is the pack of; None if it is no pack."""
    first = name.partition("-")[0]
    if not (first.isascii() and first.isdigit() and int(first) % BLOCK == 0):
        return None
    block = int(first) // BLOCK
    return block if pack_key(block) == f"{COMMITS}/{name}" else None


# ---- texts -------------------------------------------------------------------------------------


def record_text(record: Mapping[str, Any]) -> str:
    """A commit record as it is stored: one line, the same for equal records, under its own checksum."""
    return seal(json.dumps(record, sort_keys=True, allow_nan=False, ensure_ascii=False))


def read_record(content: bytes, digest: str) -> Commit | str:
    """Return a record if it is whole and of this run; else what is wrong with it."""
    try:
        data = unseal(content)
        commit = Commit(int(data["task"]), dict(data["status"]), dict(data["objects"]))
        found = data["digest"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "torn or damaged"
    if found != digest:
        return "of another run"
    # nobody who opens a stranger's run is led out of it
    climbs = any(".." in key.split("/") or key.startswith("/") for key in commit.objects)
    return "torn or damaged" if climbs else commit


def line_of(commit: Commit, digest: str) -> bytes:
    """A record's line, as `write_task` has written it."""
    record = {"digest": digest, "task": commit.task, "status": commit.status, "objects": commit.objects}
    return record_text(record).encode()


@dataclass(frozen=True)
class Pack:
    """What the last line of a pack says.

    Attributes
    ----------
    block : int
    cells : dict
        Committed cells by status name.
    without : tuple of int
        Tasks of the block that it has no record of: they were withdrawn.
    """

    block: int
    cells: dict[str, int]
    without: tuple[int, ...]

    @property
    def tasks(self) -> list[int]:
        """Tasks that it has records of, in the order of its lines."""
        absent = set(self.without)
        return [i for i in range(self.block * BLOCK, (self.block + 1) * BLOCK) if i not in absent]


def pack_text(commits: Mapping[int, Commit], digest: str, block: int) -> bytes:
    """The pack of a block's records: their lines, in the order of their tasks, and what they add up to."""
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
    """Return what a pack says if it is whole, of this run and of this block; else what is wrong with it."""
    if not fits(content):
        return "torn or damaged"
    try:
        last = json.loads(content[content.rfind(b"\n", 0, -1) + 1 :])
        pack = Pack(int(last["block"]), dict(last["cells"]), tuple(map(int, last["without"])))
        found = last["digest"]
    except (ValueError, KeyError, TypeError):
        return "torn or damaged"
    if found != digest:
        return "of another run"
    return pack if pack.block == block else "torn or damaged"


def salvage(content: bytes, digest: str, block: int) -> dict[int, Commit]:
    """Records of a damaged pack that are whole themselves."""
    found = {}
    for line in content.split(b"\n"):
        commit = read_record(line + b"\n", digest)
        if isinstance(commit, Commit) and commit.task // BLOCK == block:
            found[commit.task] = commit
    return found


# ---- all records of a run ----------------------------------------------------------------------


class Records(Mapping[int, Commit]):
    """Valid records by task; those in packs are read when they are asked for.

    Parameters
    ----------
    files
        Of the run.
    digest
        Of the run.
    singles
        Records by task that lie in files of their own, or have been saved from a damaged pack.
    packs
        Those that have been found whole, by block.
    """

    def __init__(
        self,
        files: Files,
        digest: str,
        singles: Mapping[int, Commit],
        packs: Mapping[int, Pack] | None = None,
    ) -> None:
        self._files = files
        self._digest = digest
        self.packs = dict(sorted((packs or {}).items()))
        self._without = {block: frozenset(pack.without) for block, pack in self.packs.items()}
        self.singles = {i: c for i, c in sorted(singles.items()) if not self.is_packed(i)}
        self._open: OrderedDict[int, dict[int, bytes | Commit]] = OrderedDict()
        self._lock = threading.Lock()

    def is_packed(self, index: int) -> bool:
        """Whether a task's record lies in a pack."""
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
            data = json.loads(line)
            line = lines[index] = Commit(data["task"], data["status"], data["objects"])
        return line

    def _block(self, block: int) -> dict[int, bytes | Commit]:
        """Lines of a pack by task, each replaced by its record once that was asked for."""
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
            raise DamagedError(
                f"{self._files.name}/{key}: has changed since the run was opened; open it again."
            )
        lines = content.split(b"\n")
        return {index: line + b"\n" for index, line in zip(pack.tasks, lines, strict=False)}

    def cells(self) -> dict[str, int]:
        """Committed cells by status."""
        found: Counter[str] = Counter()
        for pack in self.packs.values():
            found.update(pack.cells)
        for commit in self.singles.values():
            found.update(commit.status)
        return dict(found)

    def lines(self) -> Iterator[bytes]:
        """All records as they are written, in the order of their tasks."""
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
