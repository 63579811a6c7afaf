"""Set a run directory up, or set a damaged one right: what the specification says is written again."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipeline.layout.identity import differences, digest_of
from pipeline.layout.plan import Plan
from pipeline.spec.parsing import Spec
from pipeline.store.commits import verify, withdraw
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import (
    COMMITS,
    CUBE,
    OWN_NAMES,
    RUN_FILE,
    files_below,
    is_temporary,
    is_there,
    local_path,
    refuse_links,
    sync_folder,
    unreadable,
)
from pipeline.store.runfile import RunInfo, is_run, read_run, write_run
from pipeline.store.skeleton import (
    GROUP_KEY,
    entries_of,
    skeleton_files,
    skeleton_problems,
    write_skeleton,
)

Echo = Callable[[str], None]


def check(directory: str | Path, identity: Mapping[str, Any]) -> RunInfo | None:
    """Say whether this run can be done in this directory; changes nothing.

    Returns
    -------
    RunInfo or None
        What is there already; None if the run can be set up, or its ``run.json`` has to be made again.

    Raises
    ------
    RefusedError
        If another run is there (with the difference), or something else.
    """
    directory = local_path(directory)
    if directory.exists() and not directory.is_dir():
        raise RefusedError(f"{directory}: is a file; give another --out.")
    if not directory.exists():
        return None
    refuse_links(directory / CUBE, directory / COMMITS)
    try:
        info = read_run(directory) if is_run(directory) else None
    except DamagedError:
        info = None
    if info is None:
        _refuse_foreign(directory, digest_of(identity))
        return None
    lines = differences(info.identity, identity)
    if lines:
        raise RefusedError(
            f"{directory}: holds another run. Give another --out, or remove it. What differs:\n  "
            + "\n  ".join(lines)
        )
    return info


def _refuse_foreign(directory: Path, digest: str) -> None:
    """Refuse a directory without a sound ``run.json`` unless it is empty or provably this run's."""
    with unreadable(directory):
        names = sorted(p.name for p in directory.iterdir() if not _is_own(p))
    if names:
        raise RefusedError(
            f"{directory}: is not empty and no run directory ({', '.join(names[:5])}); give another --out."
        )
    held = [name for name in (RUN_FILE, CUBE, COMMITS) if _holds_something(directory / name)]
    if not held:
        return
    found = _digests(directory)
    if found - {digest}:
        raise RefusedError(
            f"{directory}: holds what another run has left (digest {', '.join(sorted(found - {digest}))}; "
            f"this one's is {digest}), and no sound {RUN_FILE} that tells how they differ. "
            "Give another --out, or remove it."
        )
    if not found:
        raise RefusedError(
            f"{directory}: has {', '.join(held)}, and nothing in it shows that this run has left them; "
            "give another --out, or remove it."
        )


def _is_own(path: Path) -> bool:
    return path.name in OWN_NAMES or (path.name.startswith(f".{RUN_FILE}") and is_temporary(path.name))


def _holds_something(path: Path) -> bool:
    """Whether something is there but an empty folder, or what a set-up was writing when it was stopped."""
    with unreadable(path):
        if path.is_dir() and not path.is_symlink():
            return not all(is_temporary(name) for name in os.listdir(path))
        return os.path.lexists(path)


def _digests(directory: Path) -> set[str]:
    """Digests of runs that the group's metadata and the commit records name."""
    found = {_read(directory / CUBE / GROUP_KEY, "attributes", "digest")}
    folder = directory / COMMITS
    if folder.is_dir():
        found |= {_read(path, "digest") for path in files_below(folder) if path.suffix == ".json"}
    return {digest for digest in found if digest}


def _read(path: Path, *keys: str) -> str | None:
    """A text in a JSON file; None if it is not there or not whole."""
    if not is_there(path):
        return None
    with unreadable(path):
        content = path.read_bytes()
    try:
        data = json.loads(content)
        for key in keys:
            data = data[key]
    except (ValueError, TypeError, KeyError):
        return None
    return data if isinstance(data, str) else None


def create(directory: Path, spec: Spec, plan: Plan, identity: Mapping[str, Any], spec_text: str) -> RunInfo:
    """Make a run directory; ``run.json`` comes last, so that without it nothing has begun.

    Call `check` first: files of the same names are replaced.
    """
    files = skeleton_files(spec, plan, identity, spec_text, spec.title)
    (directory / COMMITS).mkdir(parents=True, exist_ok=True)
    write_skeleton(directory, files, files)
    info = write_run(directory, spec, identity, spec_text, entries_of(files))
    sync_folder(directory.parent)
    return info


def establish(
    directory: Path, spec: Spec, plan: Plan, identity: Mapping[str, Any], spec_text: str, echo: Echo
) -> RunInfo:
    """Make a run directory, or find one and rebuild what is damaged of its set-up. For the lock's holder.

    Where ``run.json`` or a file of the skeleton had to be made again, the committed tasks are compared with
    their records, and those that do not fit are withdrawn.

    Raises
    ------
    RefusedError
        As `check`.
    """
    info = check(directory, identity)
    for file in directory.glob(f".{RUN_FILE}.*"):
        file.unlink()
    if info is None:
        before = _holds_something(directory / COMMITS)
        info = create(directory, spec, plan, identity, spec_text)
        if not before:
            return info
        echo(f"{directory / RUN_FILE}: rebuilt from the specification")
    else:
        problems = skeleton_problems(info)
        if not problems and (directory / COMMITS).is_dir():
            return info
        (directory / COMMITS).mkdir(exist_ok=True)
        rest = rebuild_skeleton(info, spec, plan)
        for problem in problems:
            echo(f"{CUBE}/{problem}: rebuilt from the specification")
        if rest:
            # another version of zarr words the metadata otherwise: its files, and their digests
            info = create(directory, spec, plan, identity, info.spec_text)
    damaged = verify(info, plan).damaged
    withdraw(info, damaged)
    for problem in damaged.values():
        echo(f"{problem}: its task is computed again")
    return info


def rebuild_skeleton(info: RunInfo, spec: Spec, plan: Plan) -> list[str]:
    """Write damaged files of the skeleton again; returns the problems that stay.

    A file is written only if it has the digest that ``run.json`` names; another version of zarr, or of
    magpend, may word it otherwise.
    """
    problems = skeleton_problems(info)
    if not problems:
        return []
    damaged = [key for key in info.skeleton if any(p.startswith(f"{key}: ") for p in problems)]
    files = skeleton_files(spec, plan, info.identity, info.spec_text, info.title)
    entries = entries_of(files)
    same = [key for key in damaged if entries.get(key) == info.skeleton[key]]
    write_skeleton(info.directory, files, same)
    return skeleton_problems(info)
