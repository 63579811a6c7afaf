"""Create a run directory, or rebuild damaged metadata and coordinates of its result cube from the specification."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipeline.layout.identity import differences, digest_of, numbered
from pipeline.layout.plan import Plan
from pipeline.store.checking import ODD, odd_keys, verify
from pipeline.store.commits import withdraw
from pipeline.store.declared import METADATA
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import COMMITS, CUBE, HOLDER, OWN_NAMES, RECORD_COPY, RUN_FILE, TIMINGS, Files, is_temporary
from pipeline.store.local import is_note, run_around
from pipeline.store.objects import open_files
from pipeline.store.runfile import RunInfo, is_run, read_run, write_run
from pipeline.store.skeleton import entries_of, lacking, skeleton_keys, skeleton_problems, write_skeleton
from pipeline.store.stored_json import fits

Echo = Callable[[str], None]


def check(place: str | Path | Files, identity: Mapping[str, Any]) -> RunInfo | None:
    """Check whether a run can be started or continued in a directory, without changing anything there.

    Return the run that is there already; None if it can be set up, or its ``run.json`` must be rebuilt. Raise
    `RefusedError` if the directory holds another run (the message lists the differences) or other files.
    """
    files = open_files(place)
    if files.local is not None:
        _refuse_place(files.local)
    try:
        names = files.names()
    except NotADirectoryError:
        raise RefusedError(f"{files.name}: is a file; give another --out.") from None
    except FileNotFoundError:
        return None
    files.refuse_links(*sorted(OWN_NAMES))
    try:
        info = read_run(files) if is_run(files) else None
    except DamagedError:
        info = None
    if info is None:
        _refuse_foreign(files, names, digest_of(identity))
        return None
    lines = differences(numbered(info.identity), identity)
    if lines and all(line.startswith(_VERSIONS) for line in lines):
        raise RefusedError(_other_version(info, lines))
    if lines:
        raise RefusedError(
            f"{files.name}: holds another run. Give another --out, or remove it. Differences:\n  " + "\n  ".join(lines)
        )
    return info


_VERSIONS = "versions."
"""Begin of the keys of an identity that differ where only the version of magpend does."""


def _other_version(info: RunInfo, lines: list[str]) -> str:
    """Explain why a run of another version is not continued, and what keeps its finished cells."""
    commit = info.provenance.get("git_commit", "")
    made = info.versions.get("magpend", "unknown") + (f", commit {commit[:12]}" if commit else "")
    return (
        f"{info.name}: was begun by another version of magpend ({made}), and cells of two versions are not mixed in "
        "one run. Its finished cells stay, and this version opens, analyses and draws them: magpend status, analyse, "
        f"plot or report {info.name}. To complete it, give the command again with that version; or compute all of it "
        "with this one: --out ANOTHER_DIR. Differences:\n  " + "\n  ".join(lines)
    )


def _refuse_place(folder: Path) -> None:
    if folder.is_symlink() and not folder.exists():
        raise RefusedError(f"{folder}: is a link that leads nowhere; remove it, or give another --out.")
    outer = run_around(folder.absolute().resolve().parent)
    if outer is not None:
        raise RefusedError(f"{folder}: lies inside of the run directory {outer}; give another --out.")


def _refuse_foreign(files: Files, names: list[str], digest: str) -> None:
    """Raise `RefusedError` for a directory without a valid ``run.json`` that holds what is not of this run."""
    foreign = [name for name in names if not _is_own(name)]
    if foreign:
        raise RefusedError(
            f"{files.name}: is not empty and no run directory ({', '.join(foreign[:5])}); give another --out."
        )
    held = [name for name in (RUN_FILE, CUBE, COMMITS) if _holds_something(files, name)]
    if not held:
        _refuse_notes(files)
        return
    found = _digests(files)
    if found - {digest}:
        raise RefusedError(
            f"{files.name}: holds what another run has left (digest {', '.join(sorted(found - {digest}))}; "
            f"this one's is {digest}), and no sound {RUN_FILE} that tells how they differ. "
            "Give another --out, or remove it."
        )
    if not found:
        raise RefusedError(
            f"{files.name}: has {', '.join(held)}, and nothing in it shows that this run has left them; "
            "give another --out, or remove it."
        )


def _refuse_notes(files: Files) -> None:
    for name, is_own in ((HOLDER, is_note), (TIMINGS, _is_timings), (RECORD_COPY, fits)):
        for _, content in files.read_each([name]):
            if isinstance(content, bytes) and not is_own(content):
                raise RefusedError(f"{files.name}: has a {name} that no run has left; give another --out.")


def _is_timings(content: bytes) -> bool:
    try:
        first = json.loads(content.split(b"\n")[0] or b'{"task": 0}')
    except (ValueError, RecursionError):
        return False
    return isinstance(first, dict) and "task" in first


def _is_own(name: str) -> bool:
    written = tuple(f".{name}." for name in (RUN_FILE, HOLDER, RECORD_COPY))
    return name in OWN_NAMES or (name.startswith(written) and is_temporary(name))


def _names(files: Files) -> list[str]:
    try:
        return files.names()
    except FileNotFoundError:
        return []


def _holds_something(files: Files, name: str) -> bool:
    """Return whether a file or folder of a run directory holds more than empty folders and temporary files."""
    if name not in _names(files):
        return False
    try:
        files.below(name).names()
    except (FileNotFoundError, NotADirectoryError):
        return True
    return not all(is_temporary(key.rpartition("/")[2]) for key in files.below(name).everything())


def _digests(files: Files) -> set[str]:
    """Return the digests of runs that the result cube's metadata and the commit records name."""
    records = [f"{COMMITS}/{key}" for key in files.below(COMMITS).everything() if key.endswith((".json", ".jsonl"))]
    # a pack names the digest in its first record
    found = {_text_in(content, "digest") for _, content in files.read_each(records)}
    for _, content in files.read_each([f"{CUBE}/{METADATA}"]):
        found.add(_text_in(content, "attributes", "digest"))
    return {digest for digest in found if digest}


def _text_in(content: bytes | FileNotFoundError, *keys: str) -> str | None:
    if isinstance(content, FileNotFoundError):
        return None
    try:
        data = json.loads(content if len(keys) > 1 else content.split(b"\n")[0])
        for key in keys:
            data = data[key]
    except (ValueError, TypeError, KeyError):
        return None
    return data if isinstance(data, str) else None


def create(place: str | Path | Files, plan: Plan, identity: Mapping[str, Any] | None = None) -> RunInfo:
    """Create a run directory: an empty result cube (metadata and coordinates), then ``run.json``.

    Call `check` first: files with the same names are replaced. An `identity` that an earlier version wrote is kept.
    """
    from pipeline.store.empty_cube import skeleton_files

    files, identity = open_files(place), identity or plan.identity
    contents = skeleton_files(plan, identity)
    files.prepare(COMMITS)
    write_skeleton(files, contents, contents)
    return write_run(files, plan, identity, entries_of(contents))


def establish(place: str | Path | Files, plan: Plan, echo: Echo, *, alone: bool = True) -> RunInfo:
    """Create a run directory or, if it exists, open it and rebuild damaged metadata and coordinates of its result cube.

    Only the holder of the lock may call this. If ``run.json`` or a file of the skeleton had to be rebuilt, the
    committed tasks are compared with their records, and tasks that do not fit are withdrawn. Raise `RefusedError` as
    `check`.
    """
    files = open_files(place)
    for key in odd_keys(files, skeleton_keys(plan)):
        echo(f"{key}: {ODD}; moved to {files.move_aside(key)}")
    info = check(files, plan.identity)
    if info is not None and lacking(info):
        info = None
    names = _names(files)
    if alone:  # else another process may be writing these files now
        left = (f".{RUN_FILE}.", f".{HOLDER}.", f".{RECORD_COPY}.")
        files.remove([name for name in names if name.startswith(left)])
    if COMMITS not in names:
        files.prepare(COMMITS)
    if info is None:
        before = _holds_something(files, COMMITS)
        info = create(files, plan)
        if not before:
            return info
        echo(f"{files.below(RUN_FILE).name}: rebuilt from the specification")
    else:
        problems = skeleton_problems(info)
        if not problems:
            return info
        rest = rebuild_skeleton(info)
        for problem in problems:
            echo(f"{CUBE}/{problem}: rebuilt from the specification")
        if rest:
            # another version of zarr writes other metadata: write all files and digests again
            info = create(files, info.plan, info.identity)
    damaged = verify(info).damaged
    withdraw(info, damaged)
    for problem in damaged.values():
        echo(f"{problem}: its task is computed again")
    return info


def rebuild_skeleton(info: RunInfo) -> list[str]:
    """Rebuild damaged metadata and coordinates of the result cube; return the problems that remain.

    A file is written only if its digest is the one in ``run.json``. Another version of zarr or of magpend may
    write other bytes.
    """
    from pipeline.store.empty_cube import skeleton_files

    problems = skeleton_problems(info)
    if not problems:
        return []
    damaged = [key for key in info.skeleton if any(p.startswith(f"{key}: ") for p in problems)]
    for described in (True, False):  # cubes of earlier versions have fewer attributes
        contents = skeleton_files(info.plan, info.identity, described=described)
        entries = entries_of(contents)
        same = [key for key in damaged if entries.get(key) == info.skeleton[key]]
        write_skeleton(info.files, contents, same)
        damaged = [key for key in damaged if key not in same]
        if not damaged:
            break
    return skeleton_problems(info)
