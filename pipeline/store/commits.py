"""Read and pack the commit records of tasks, and remove files that belong to no record.

A commit record is the only proof that a task is done. A task without a valid record is pending: its files are
removed (`sweep`) and it is computed again. The bytes in ``cube.zarr`` and ``commits`` do not depend on time, on the
workers or on the order of tasks: an interrupted run ends with the same bytes as an uninterrupted one.

A *record* lies in a file of its own until all tasks of its block have one; then they are merged into a *pack*.

Reading order: `pipeline.store.tasks` (how a task is committed), `read_commits` and `scan` (which records are valid),
`_Scan` (records and packs in one folder), `sweep` (what is removed). Texts of records and packs are in
`pipeline.store.records`.

Only the holder of the lock may pack. A pack is durable before the single records that it replaces are removed: a crash
at any moment leaves every record either there or in the pack.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any

from pipeline.layout.writing import NoFileError
from pipeline.store.errors import DamagedError, UnreadableError
from pipeline.store.files import COMMITS, CUBE, TIMINGS, Files
from pipeline.store.keys import Owners
from pipeline.store.record_copy import copied_records, remove_copy
from pipeline.store.records import (
    BLOCK,
    Commit,
    Pack,
    Records,
    block_of_pack,
    line_of,
    marker_key,
    pack_key,
    pack_text,
    read_pack,
    read_record,
    salvage,
)
from pipeline.store.runfile import RunInfo

Echo = Callable[[str], None]

_MOST_SCANS = 100
"""Largest number of attempts to read the folder while another process packs records."""


def is_packed(info: RunInfo, index: int) -> bool:
    """Return whether a task's commit record lies in a pack, a file of many records."""
    block = index // BLOCK
    if not info.files.is_there(pack_key(block)):
        return False
    pack = read_pack(info.files.read(pack_key(block)), info.digest, block)
    return isinstance(pack, Pack) and index not in pack.without


def log_timing(info: RunInfo, entry: Mapping[str, Any]) -> None:
    """Append the timing of a task to ``timings.jsonl``, which is not part of the result."""
    info.files.append(TIMINGS, json.dumps(entry, sort_keys=True))


# ---- reading -----------------------------------------------------------------------------------


def read_commits(info: RunInfo) -> Records:
    """Return the valid commit records by task: undamaged, of this run, and of a task in its plan.

    A record's files must all exist, and have their sizes if no record is packed. In larger runs sizes would take as
    long as reading all records; there they are left to `verify`, `pipeline.runs.run` and the reading of chunks.

    Raise `DamagedError` if a file of a record is missing or has another size: its task is done, and not pending. Raise
    `UnreadableError` if a record or a folder exists and cannot be read: its tasks are not taken for pending, since a
    failing disk must not cause a sweep. Raise `RefusedError` if a folder is a link.
    """
    records, _ = scan(info, copies=info.files.local is None)
    if _lost(info, records):
        # another process may have withdrawn a record before its files: look at both again
        records, _ = scan(info)
        if lost := _lost(info, records):
            more = f" (and files of {len(lost) - 1} more tasks)" if len(lost) > 1 else ""
            raise DamagedError(f"{info.name}/{CUBE}/{next(iter(lost.values()))}{more}. {remedy(info.name)}")
    return records


def _lost(info: RunInfo, records: Records) -> dict[int, str]:
    """Find committed tasks whose files are gone, by listing the folders; return the problems by task."""
    if not records.packs:
        return absent_objects(info, records)
    cube, owners = info.files.below(CUBE), Owners(info.plan)
    found: dict[int, str] = {}
    for folder in (v.name for v in info.plan.variables):
        there = {f"{folder}/{name}" for name in _names(cube.below(folder))}
        for key in owners.keys(folder):
            index = None if key in there else owners.task(key)
            if index is not None and index in records:
                found.setdefault(index, f"{key} is missing")
    return found


def remedy(name: str) -> str:
    """Return the sentence that says what to do about damaged chunks of the run with a name."""
    return (
        "Give the command that made the run again: it computes what is damaged; or look at all of it with: "
        f"magpend verify {name}"
    )


def absent_objects(info: RunInfo, records: Mapping[int, Commit]) -> dict[int, str]:
    """Find tasks with a file that is missing or has another size than recorded; return the problems by task."""
    # a chunk is durable before its record is, so a missing one was lost later
    sizes = info.files.below(CUBE).sizes() if records else {}
    found = {}
    for index in records:
        try:
            objects = records[index].objects
        except DamagedError as error:  # a line of a pack is no record
            found[index] = str(error)
            continue
        keys = (key for key, entry in objects.items() if sizes.get(key) != entry["size"])
        key = next(keys, None)
        if key is not None:
            found[index] = f"{key} is missing or has another size"
    return found


def read_commit(info: RunInfo, index: int) -> Commit | None:
    """Return the valid commit record of one task, or None; the files that it lists are not checked."""
    return scan(info, (index // BLOCK,))[0].get(index)


def scan(
    info: RunInfo, blocks: Container[int] | None = None, *, copies: bool = False
) -> tuple[Records, dict[str, str]]:
    """Read the folder ``commits``; return the valid commit records, and the problems of the others by file name.

    With `copies`, the copy of a record (`pipeline.store.record_copy`) may be read in the place of its file. Raise
    `UnreadableError` if a file exists and cannot be read, or if the folder changes at every attempt.
    """
    info.files.refuse_links(COMMITS)
    folder = info.files.below(COMMITS)
    sizes = folder.sizes() if copies else {}
    names = sorted(sizes) if copies else _names(folder)
    for _ in range(_MOST_SCANS):
        found = _Scan(info, blocks)
        found.singles |= copied_records(info, sizes) if sizes else {}
        vanished = found.read(folder, names)
        records = Records(info.files, info.digest, found.singles, found.packs)
        if not vanished and len(records) == info.plan.n_tasks:  # nothing can be missing
            return records, found.rejected
        sizes = {}  # what changes meanwhile is read itself
        before, names = names, _names(folder)
        # another process may have packed a block meanwhile: its records vanish, its pack appears; read again
        if not vanished and _packs(before) == _packs(names):
            return records, found.rejected
    raise UnreadableError(
        f"{folder.name}: changes while it is read, {_MOST_SCANS} times in a row; look who writes there, then "
        "give the same command again."
    )


def _names(folder: Files) -> list[str]:
    try:
        return folder.names()
    except (FileNotFoundError, NotADirectoryError):
        return []


def _packs(names: Iterable[str]) -> list[str]:
    return [name for name in names if block_of_pack(name) is not None]


class _Scan:
    """Valid commit records and packs (files of many records) found in ``commits``, and the problems of damaged ones."""

    def __init__(self, info: RunInfo, blocks: Container[int] | None) -> None:
        self._info = info
        self._blocks = blocks
        self.singles: dict[int, Commit] = {}
        self.packs: dict[int, Pack] = {}
        self.rejected: dict[str, str] = {}

    def read(self, folder: Files, names: list[str]) -> bool:
        """Read all packs, then all files with one commit record; return whether a file disappeared meanwhile."""
        vanished = False
        # packs first: a single record that is also in a pack is a leftover of packing and is not read
        blocks = {name: block_of_pack(name) for name in _packs(names)}
        for name, content in folder.read_each(n for n, block in blocks.items() if self._asked(block)):
            vanished |= self._take(name, content, self._pack)
        for name, content in folder.read_each(n for n in names if n.endswith(".json") and self._alone(n)):
            vanished |= self._take(name, content, self._single)
        return vanished

    def _asked(self, block: int | None) -> bool:
        return block is not None and (self._blocks is None or block in self._blocks)

    def _alone(self, name: str) -> bool:
        """Return whether a file with one commit record must be read because no valid pack holds its record."""
        stem = name.removesuffix(".json")
        if not stem.isdecimal():
            return self._blocks is None  # not the name of a record: read it in a full scan, to report it
        if int(stem) in self.singles:  # its copy was read
            return False
        pack = self.packs.get(int(stem) // BLOCK)
        return self._asked(int(stem) // BLOCK) and (pack is None or int(stem) in pack.without)

    def _take(self, name: str, content: bytes | FileNotFoundError, read: Callable[[str, bytes], str]) -> bool:
        if isinstance(content, NoFileError):  # a folder or a link instead of a file
            self.rejected[name] = str(content)
        elif isinstance(content, FileNotFoundError):
            return True  # removed after the folder was listed: its record was packed or withdrawn
        elif problem := read(name, content):
            self.rejected[name] = problem
        return False

    def _pack(self, name: str, content: bytes) -> str:
        block = int(name.partition("-")[0]) // BLOCK
        found = read_pack(content, self._info.digest, block)
        is_inside = (block + 1) * BLOCK <= self._info.plan.n_tasks
        if isinstance(found, Pack) and is_inside:
            self.packs[block] = found
            return ""
        # use the undamaged records of a damaged pack
        saved = salvage(content, self._info.digest, block) if is_inside else {}
        self.singles |= saved
        problem = found if isinstance(found, str) else "of no tasks of this run"
        return f"{problem}, with {len(saved)} whole records"

    def _single(self, name: str, content: bytes) -> str:
        found = read_record(content, self._info.digest)
        if isinstance(found, str):
            return found
        # a file named after one task must not hold the record of another
        if not 0 <= found.task < self._info.plan.n_tasks or marker_key(found.task) != f"{COMMITS}/{name}":
            return "torn or damaged"
        self.singles[found.task] = found
        return ""


def cube_digest(info: RunInfo, commits: Mapping[int, Commit]) -> str:
    """Return a digest of a run's committed cells, computed from the run's digest and all commit records."""
    own = isinstance(commits, Records)
    lines = commits.lines() if own else (line_of(commits[i], info.digest) for i in sorted(commits))  # type: ignore[attr-defined]
    digest = hashlib.sha256(info.digest.encode())
    for line in lines:
        digest.update(line)
    return digest.hexdigest()[:32]


# ---- files without a record --------------------------------------------------------------------


def leftover_keys(info: RunInfo, commits: Records) -> list[str]:
    """Return the keys of files in ``cube.zarr`` and ``commits`` that belong to no valid commit record."""
    info.files.refuse_links(CUBE, COMMITS)
    owners = Owners(info.plan)

    def is_kept(key: str) -> bool:
        owner = owners.task(key)
        return key in info.skeleton or (owner is not None and owner in commits)

    chunks = [f"{CUBE}/{key}" for key in info.files.below(CUBE).everything() if not is_kept(key)]
    own = {marker_key(i) for i in commits.singles} | {pack_key(block) for block in commits.packs}
    records = (f"{COMMITS}/{key}" for key in info.files.below(COMMITS).everything())
    return chunks + [key for key in records if key not in own]


def sweep(info: RunInfo, commits: Records, echo: Echo | None = None) -> int:
    """Remove files in ``cube.zarr`` and ``commits`` that belong to no valid commit record; return their number.

    Only the holder of the lock may call this, with all valid records, as `read_commits` has just returned them. Files
    outside ``cube.zarr`` and ``commits`` stay. A link inside them is removed, its target stays.
    """
    leftovers = leftover_keys(info, commits)
    info.files.remove(leftovers)
    if leftovers and echo:
        more = f" and {len(leftovers) - 3} more" if len(leftovers) > 3 else ""
        echo(f"removed {len(leftovers)} files that no commit record vouches for: {', '.join(leftovers[:3])}{more}")
    return len(leftovers)


# ---- packs -----------------------------------------------------------------------------------------


class Packer:
    """Counter of committed tasks that packs the records of each complete block of tasks in one file."""

    def __init__(self, info: RunInfo, commits: Records) -> None:
        self._info = info
        self._n_whole = info.plan.n_tasks // BLOCK
        self._counts = Counter(i // BLOCK for i in commits)
        packed = {block for block, pack in commits.packs.items() if not pack.without}
        for block in sorted(set(self._counts) - packed):
            self._pack_if_whole(block)

    def add(self, index: int) -> None:
        """Count a newly committed task; pack the records of its block if that is complete."""
        self._counts[index // BLOCK] += 1
        self._pack_if_whole(index // BLOCK)

    def _pack_if_whole(self, block: int) -> None:
        if block < self._n_whole and self._counts[block] >= BLOCK:
            pack_block(self._info, block)


def pack_block(info: RunInfo, block: int) -> bool:
    """Merge the commit records of a block of tasks into one file if all of them are valid; return whether they are."""
    tasks = range(block * BLOCK, (block + 1) * BLOCK)
    commits, _ = scan(info, blocks={block})
    if not all(index in commits for index in tasks):
        return False
    pack = commits.packs.get(block)
    if pack is None or pack.without:
        info.files.write(pack_key(block), pack_text(commits, info.digest, block))
    info.files.remove([marker_key(index) for index in tasks])
    return True


def withdraw(info: RunInfo, names: Iterable[str]) -> None:
    """Remove commit records, so that the next run computes their tasks again.

    `names` are file names of the records, as if each had its own file; or the name of a damaged pack, whose whole
    records stay.
    """
    info.files.refuse_links(COMMITS)
    remove_copy(info)
    folder = info.files.below(COMMITS)
    blocks: dict[int, set[int]] = {}
    for name in names:
        block = block_of_pack(name)
        stem = name.removesuffix(".json")
        if block is not None:
            blocks.setdefault(block, set())
        elif stem.isdecimal() and marker_key(int(stem)) == f"{COMMITS}/{name}":
            blocks.setdefault(int(stem) // BLOCK, set()).add(int(stem))
        folder.remove([name] if block is None else [])
    for block, tasks in blocks.items():
        _rewrite(info, block, tasks)


def _rewrite(info: RunInfo, block: int, tasks: set[int]) -> None:
    """Rewrite a pack (a file of many commit records) without the records of some tasks and without damaged ones."""
    try:
        content = info.files.read(pack_key(block))
    except FileNotFoundError:  # none, or a link, which is not read
        content = b""
    kept: Mapping[int, Commit] = {
        index: commit for index, commit in salvage(content, info.digest, block).items() if index not in tasks
    }
    if kept:
        info.files.write(pack_key(block), pack_text(kept, info.digest, block))
    else:
        info.files.remove([pack_key(block)])
