"""Commit records: one file a task, and packs of these once a block of tasks is whole.

A record is one line of JSON under its own checksum. When all tasks of a block of `BLOCK` are committed, the
holder of the lock puts their lines into one file, as they are, and removes the single ones: opening a run of
100,000 tasks then reads a hundred files. A pack's last line counts its cells by status and seals the whole.
Its bytes follow from the records, so that they do not depend on when it was written, or by whom.

A damaged pack loses the records on its damaged lines, and no others.
"""

from __future__ import annotations

import json
from collections import Counter, OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.store.errors import DamagedError
from pipeline.store.files import COMMITS
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


def pack_text(lines: Sequence[bytes], digest: str, block: int) -> bytes:
    """The pack of a block's records, which are there as they were written, in the order of their tasks."""
    cells: Counter[str] = Counter()
    for line in lines:
        cells.update(json.loads(line)["status"])
    last = {"cells": dict(cells), "digest": digest, "first": block * BLOCK, "n": len(lines)}
    body = b"".join(lines).decode()
    return seal(body + json.dumps(last, sort_keys=True)).encode()


def pack_totals(content: bytes, digest: str, block: int) -> dict[str, int] | None:
    """Cells by status of a pack that is whole, of this run and of this block; else None."""
    if not fits(content):
        return None
    try:
        last = json.loads(content[content.rindex(b"\n", 0, -1) + 1 :])
        is_own = (last["digest"], last["first"], last["n"]) == (digest, block * BLOCK, BLOCK)
        return dict(last["cells"]) if is_own else None
    except (ValueError, KeyError, TypeError):
        return None


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
        Cells by status, by block, of packs that have been found whole.
    """

    def __init__(
        self,
        files: Any,
        digest: str,
        singles: Mapping[int, Commit],
        packs: Mapping[int, Mapping[str, int]] | None = None,
    ) -> None:
        self._files = files
        self._digest = digest
        self.packs = dict(sorted((packs or {}).items()))
        self.singles = {i: c for i, c in sorted(singles.items()) if i // BLOCK not in self.packs}
        self._lines: OrderedDict[int, list[bytes | Commit]] = OrderedDict()

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and (index in self.singles or index // BLOCK in self.packs)

    def __len__(self) -> int:
        return len(self.singles) + BLOCK * len(self.packs)

    def __iter__(self) -> Iterator[int]:
        packed = (i for block in self.packs for i in range(block * BLOCK, (block + 1) * BLOCK))
        return iter(sorted([*packed, *self.singles])) if self.singles else packed

    def __getitem__(self, index: int) -> Commit:
        if index in self.singles:
            return self.singles[index]
        block, place = divmod(index, BLOCK)
        if block not in self.packs:
            raise KeyError(index)
        lines = self._block(block)
        line = lines[place]
        if isinstance(line, bytes):
            data = json.loads(line)
            line = lines[place] = Commit(data["task"], data["status"], data["objects"])
        return line

    def _block(self, block: int) -> list[bytes | Commit]:
        """Lines of a pack, each replaced by its record once that was asked for."""
        if block in self._lines:
            self._lines.move_to_end(block)
            return self._lines[block]
        try:
            content = self._files.read(pack_key(block))
        except FileNotFoundError:
            content = b""
        if pack_totals(content, self._digest, block) is None:
            raise DamagedError(
                f"{self._files.name}/{pack_key(block)}: has changed since the run was opened; open it again."
            )
        self._lines[block] = list(content.split(b"\n")[:BLOCK])
        if len(self._lines) > _OPEN_PACKS:
            self._lines.popitem(last=False)
        return self._lines[block]

    def cells(self) -> dict[str, int]:
        """Committed cells by status."""
        found: Counter[str] = Counter()
        for totals in self.packs.values():
            found.update(totals)
        for commit in self.singles.values():
            found.update(commit.status)
        return dict(found)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_lines": OrderedDict()}
