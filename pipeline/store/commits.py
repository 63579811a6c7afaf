"""Tasks and their commit records: the only proof that a task is done.

A task writes whole chunks, syncs the files and their folders, then writes its record under a
temporary name, syncs, renames and syncs the folder. Whatever has no valid record reads as pending and
is swept when the run goes on. Nothing that depends on time, workers or order enters ``cube.zarr`` and
``commits``: an interrupted run ends with the same bytes as an uninterrupted one.

That a record is absent, torn or another run's makes its task pending. That it cannot be read does not:
that stops whoever asked, so that nothing is swept on the word of a failing disk.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from pipeline.layout.identity import digest_of
from pipeline.layout.plan import Plan
from pipeline.store.files import COMMITS, CUBE, TIMINGS, Files, LinkError, entry_of, problems_of
from pipeline.store.runfile import RunInfo
from pipeline.store.seal import seal, unseal

Echo = Callable[[str], None]


@dataclass(frozen=True)
class Commit:
    """A valid record."""

    task: int
    status: dict[str, int]
    objects: dict[str, dict[str, Any]]


# ---- writing -----------------------------------------------------------------------------------


def write_task(
    info: RunInfo, plan: Plan, index: int, values: Mapping[str, np.ndarray], counts: Mapping[str, int]
) -> None:
    """Write a task's cells and commit them.

    Parameters
    ----------
    info
        The run.
    plan
        Its plan.
    index
        The task.
    values
        Every variable, in the shape of the task's block followed by its own dims.
    counts
        Cells by status name, for `status`.

    Raises
    ------
    ValueError
        If an array has another shape or dtype than the store, or a block cuts a chunk.
    """
    info.files.refuse_links(CUBE, *(f"{CUBE}/{v.name}" for v in plan.variables), COMMITS)
    cube = info.files.below(CUBE)
    objects = [key for v in plan.variables for key in write_block(cube, plan, index, v.name, values[v.name])]
    cube.sync(objects)
    record = {
        "digest": info.digest,
        "task": index,
        "status": dict(counts),
        "objects": {key: entry_of(cube.read(key)) for key in objects},
    }
    info.files.write_once(marker_key(index), record_text(record).encode())


def write_block(cube: Files, plan: Plan, index: int, name: str, values: np.ndarray) -> list[str]:
    """Write one variable's chunks of a task and return their keys."""
    array = zarr.open_array(cube.zarr(read_only=False), path=name, mode="r+")
    # The setting is not stored: without it a block equal to the fill value would leave no file.
    array = array.with_config({"write_empty_chunks": True})
    block = plan.task(index)
    own = array.shape[len(block) :]
    region = (*block, *(slice(0, n) for n in own))
    expected = tuple(s.stop - s.start for s in region)
    if values.shape != expected or values.dtype != array.dtype:
        raise ValueError(
            f"{name}: {values.dtype} {values.shape} where the store has {array.dtype} {expected}."
        )
    keys = chunk_keys(name, region, array.chunks, array.shape)
    array[region] = values
    return keys


def chunk_keys(
    name: str, region: tuple[slice, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> list[str]:
    """Keys of the chunks in a region; a region that cuts a chunk would lose a neighbour's cells."""
    for s, c, n in zip(region, chunks, shape, strict=True):
        if s.start % c or (s.stop % c and s.stop != n):
            raise ValueError(f"{name}: region {region} cuts chunks of {chunks}.")
    places = [range(s.start // c, -(-s.stop // c)) for s, c in zip(region, chunks, strict=True)]
    if not places:
        return [f"{name}/c"]
    grid = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, len(places))
    return [f"{name}/c." + ".".join(map(str, place)) for place in grid]


def record_text(record: Mapping[str, Any]) -> str:
    """A commit record as it is stored: one line, the same for equal records, under its own checksum."""
    return seal(json.dumps(record, sort_keys=True, allow_nan=False, ensure_ascii=False))


def marker_key(index: int) -> str:
    """Where a task's record lies."""
    return f"{COMMITS}/{index:06d}.json"


def log_timing(info: RunInfo, entry: Mapping[str, Any]) -> None:
    """Append what a task took to ``timings.jsonl``; no part of the result, not synced."""
    info.files.append(TIMINGS, json.dumps(entry, sort_keys=True))


# ---- reading -----------------------------------------------------------------------------------


def read_commits(info: RunInfo, plan: Plan, echo: Echo | None = None) -> dict[int, Commit]:
    """Return the valid records by task: right digest, and all objects there in their size.

    Parameters
    ----------
    info, plan
        The run.
    echo
        Prints a line; names every record that does not count, and why.

    Raises
    ------
    UnreadableError
        If a record, or a folder, is there and cannot be read.
    RefusedError
        If a folder is a link.
    """
    whole, rejected = _read_records(info, plan)
    # taken after the records: a chunk is there before its record is
    sizes = info.files.below(CUBE).sizes()
    found = {}
    for commit in whole.values():
        absent = [key for key, entry in commit.objects.items() if sizes.get(key) != entry["size"]]
        if not absent:
            found[commit.task] = commit
        elif echo:
            echo(f"task {commit.task}: {absent[0]} is missing or has another size; it is computed again")
    if echo:
        for name, problem in rejected.items():
            echo(f"{COMMITS}/{name}: {problem}; it does not count")
    return found


def read_commit(info: RunInfo, plan: Plan, index: int) -> Commit | None:
    """Return the record of one task, None if it has no valid one; its objects are not looked at.

    Raises
    ------
    UnreadableError
        If it is there and cannot be read.
    """
    info.files.refuse_links(COMMITS)
    name = marker_key(index).removeprefix(f"{COMMITS}/")
    ((_, content),) = info.files.below(COMMITS).read_each([name])
    found = _read_record(name, content, info, plan)
    return found if isinstance(found, Commit) else None


def _read_records(info: RunInfo, plan: Plan) -> tuple[dict[str, Commit], dict[str, str]]:
    """Return the whole records of the run, and the problems of the others, both by file name."""
    info.files.refuse_links(COMMITS)
    folder = info.files.below(COMMITS)
    whole, rejected = {}, {}
    try:
        names = [name for name in folder.names() if name.endswith(".json")]
    except FileNotFoundError:
        return {}, {}
    for name, content in folder.read_each(names):
        found = _read_record(name, content, info, plan)
        if isinstance(found, Commit):
            whole[name] = found
        elif found:
            rejected[name] = found
    return whole, rejected


def _read_record(name: str, content: bytes | FileNotFoundError, info: RunInfo, plan: Plan) -> Commit | str:
    """Return a record if it is whole, of this run and of this task; else what is wrong with it."""
    if isinstance(content, FileNotFoundError):
        return "is a link" if isinstance(content, LinkError) else ""
    try:
        data = unseal(content)
        commit = Commit(int(data["task"]), dict(data["status"]), dict(data["objects"]))
        digest = data["digest"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "torn or damaged"
    if digest != info.digest:
        return "of another run"
    named = 0 <= commit.task < plan.n_tasks and f"{COMMITS}/{name}" == marker_key(commit.task)
    inside = all(key.partition("/")[0] in {v.name for v in plan.variables} for key in commit.objects)
    return commit if named and inside and not _climbs(commit) else "torn or damaged"


def _climbs(commit: Commit) -> bool:
    return any(".." in Path(key).parts for key in commit.objects)


def cube_digest(info: RunInfo, commits: Mapping[int, Commit]) -> str:
    """Digest of what is committed of a run: its identity, and the sha256 of every committed object."""
    objects = {str(index): commits[index].objects for index in sorted(commits)}
    return digest_of({"run": info.digest, "commits": objects})


# ---- what nothing vouches for ------------------------------------------------------------------


def sweep(info: RunInfo, commits: Mapping[int, Commit], echo: Echo | None = None) -> int:
    """Remove leftovers: chunk files and records that no valid record vouches for. Returns how many.

    Only for the holder of the lock. Nothing outside ``cube.zarr`` and ``commits`` is touched: a link in
    them is removed, what it leads to stays.

    Parameters
    ----------
    info
        The run.
    commits
        All its valid records, as `read_commits` has just returned them.
    echo
        Prints a line; says what is removed.
    """
    info.files.refuse_links(CUBE, COMMITS)
    keep = {f"{CUBE}/{key}" for key in info.skeleton}
    keep |= {f"{CUBE}/{key}" for commit in commits.values() for key in commit.objects}
    keep |= {marker_key(index) for index in commits}
    found = (f"{top}/{key}" for top in (CUBE, COMMITS) for key in info.files.below(top).everything())
    leftovers = [key for key in found if key not in keep]
    info.files.remove(leftovers)
    if leftovers and echo:
        more = f" and {len(leftovers) - 3} more" if len(leftovers) > 3 else ""
        echo(
            f"removed {len(leftovers)} files that no commit record vouches for: "
            f"{', '.join(leftovers[:3])}{more}"
        )
    return len(leftovers)


@dataclass(frozen=True)
class Verification:
    """What `verify` found.

    Attributes
    ----------
    n_tasks, n_committed : int
        Tasks of the run, and those that are committed and intact.
    damaged : dict
        Problem by the file name of the commit record.
    skeleton : list of str
        Problems of metadata and coordinates.
    leftovers : list of str
        Files that nothing vouches for; harmless, swept by the next run.
    rebuilt : list of str
        Problems of the skeleton that have been mended.
    """

    n_tasks: int
    n_committed: int
    damaged: dict[str, str]
    skeleton: list[str]
    leftovers: list[str]
    rebuilt: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Whether all that is committed is intact."""
        return not self.damaged and not self.skeleton


def verify(info: RunInfo, plan: Plan) -> Verification:
    """Read every committed file and compare its sha256 with its record.

    Raises
    ------
    UnreadableError
        If a file is there and cannot be read.
    """
    info.files.refuse_links(CUBE)
    cube = info.files.below(CUBE)
    whole, rejected = _read_records(info, plan)
    damaged = {name: f"{COMMITS}/{name}: {problem}" for name, problem in rejected.items()}
    vouched = set(info.skeleton)
    for name, commit in whole.items():
        vouched.update(commit.objects)
        problems = problems_of(cube, commit.objects)
        if problems:
            damaged[name] = "; ".join(problems)
    return Verification(
        n_tasks=plan.n_tasks,
        n_committed=len(whole) + len(rejected) - len(damaged),
        damaged=dict(sorted(damaged.items())),
        skeleton=problems_of(cube, info.skeleton),
        leftovers=sorted(key for key in cube.everything() if key not in vouched),
    )


def withdraw(info: RunInfo, names: Iterable[str]) -> None:
    """Remove commit records by file name, so that the next run computes their tasks again."""
    info.files.refuse_links(COMMITS)
    info.files.below(COMMITS).remove(names)
