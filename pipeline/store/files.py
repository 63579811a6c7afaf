"""Files of a run directory: written whole, synced in order, removed without following a link."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.store.errors import LockedError, RefusedError, UnreadableError

RUN_FILE, CUBE, COMMITS, LOCK, TIMINGS = "run.json", "cube.zarr", "commits", "lock", "timings.jsonl"
DERIVED, FIGURES, EXTENDED = "derived", "figures", "extended.json"
OWN_NAMES = frozenset({RUN_FILE, CUBE, COMMITS, LOCK, TIMINGS, DERIVED, FIGURES, EXTENDED})
TEMPORARY = ".tmp"

# one letter before the colon is a drive; pathlib makes one slash of two
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def local_path(path: str | Path) -> Path:
    """Return a path of the local file system.

    Raises
    ------
    RefusedError
        If `path` looks like a URL: runs are kept in local folders.
    """
    text = str(path)
    if _URL.match(text):
        scheme = text.partition(":")[0]
        raise RefusedError(f"{text}: {scheme}: is no local folder, and runs are kept in these; give a path.")
    return Path(path)


def sync_file(path: Path) -> None:
    """Have a file's content on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Have a folder's entries on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync(files: Iterable[Path], top: Path) -> None:
    """Sync files, then every folder from theirs up to `top`."""
    folders: set[Path] = set()
    for file in files:
        sync_file(file)
        folders.update(p for p in file.parents if p == top or top in p.parents)
    for folder in sorted(folders, key=lambda p: -len(p.parts)):
        sync_folder(folder)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a small file so that after a crash it is there whole or not at all."""
    temporary = temporary_beside(path)
    with temporary.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    sync_folder(path.parent)


def temporary_beside(path: Path) -> Path:
    """A name that nobody else has, in the same folder."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")


def is_temporary(name: str) -> bool:
    """Whether a file was being written when it was left: a name of `temporary_beside`."""
    return name.startswith(".") and name.endswith(TEMPORARY)


def entry_of(data: bytes) -> dict[str, Any]:
    """Size and sha256 of a content, as commit records and ``run.json`` hold them."""
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def object_entry(path: Path) -> dict[str, Any]:
    """Size and sha256 of a file."""
    return entry_of(path.read_bytes())


def files_below(folder: Path) -> Iterator[Path]:
    """All that is below a folder and is no folder; a link is an entry, wherever it leads."""
    with os.scandir(folder) as entries:
        found = sorted(entries, key=lambda entry: entry.name)
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            yield from files_below(Path(entry.path))
        else:
            yield Path(entry.path)


def is_there(path: Path) -> bool:
    """Whether a plain file is there; a link, or a folder, is none.

    Raises
    ------
    UnreadableError
        If the file system does not say.
    """
    try:
        with unreadable(path):
            return stat.S_ISREG(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


@contextlib.contextmanager
def unreadable(path: Path) -> Iterator[None]:
    """Turn an error of the file system into one that stops the run; that something is absent is none.

    Raises
    ------
    UnreadableError
        For any `OSError` but `FileNotFoundError` and `NotADirectoryError`.
    """
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise UnreadableError(
            f"{error.filename or path}: cannot be read ({error.strerror or error}), so whether it is there "
            "and whole is not known. Nothing was removed; mend the file system or the access rights, then "
            "give the same command again."
        ) from error


def refuse_links(*folders: Path) -> None:
    """Refuse to work below a link: what it leads to is not the run's own.

    Raises
    ------
    RefusedError
        Naming the link.
    """
    for folder in folders:
        if folder.is_symlink():
            raise RefusedError(
                f"{folder}: is a link, which magpend does not follow inside of a run directory; put the "
                "folder itself there. The run directory as a whole may be a link."
            )


def remove_tree(path: Path) -> None:
    """Remove a file, a link (not what it leads to) or a folder; one that is gone already is no error."""
    with contextlib.suppress(FileNotFoundError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextlib.contextmanager
def writer_lock(directory: Path) -> Iterator[None]:
    """Hold the directory's lock: a courtesy between people, the commit protocol does not rest on it.

    Raises
    ------
    LockedError
        If another process holds it.
    """
    from filelock import FileLock, Timeout

    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(directory / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise LockedError(
            f"{directory}: another magpend run is writing here. Wait for it or stop it, then run again."
        ) from None
    except (NotImplementedError, OSError) as error:
        warnings.warn(f"{directory}: no file lock here ({error}); start one run at a time.", stacklevel=3)
        yield
        return
    try:
        yield
    finally:
        lock.release()


def problems_of(folder: Path, objects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Compare files with their sizes and digests; a line per file that is not what was written.

    Parameters
    ----------
    folder
        Where the keys of `objects` lie.
    objects
        Size and sha256 by key, as of `object_entry`.
    """
    problems = []
    for key, entry in objects.items():
        path = folder / key
        with unreadable(path):
            if path.is_symlink():
                problems.append(f"{key}: is a link")
            elif not is_there(path):
                problems.append(f"{key}: missing")
            elif object_entry(path) != dict(entry):
                problems.append(f"{key}: its content has changed")
    return problems
