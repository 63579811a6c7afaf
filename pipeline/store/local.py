"""Read and write a run's files in a local folder: atomically, durably, and without following symbolic links."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import stat
import uuid
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.layout.writing import open_plain, sync_folder, write_atomically, writing
from pipeline.store.errors import LockedError, RefusedError, UnreadableError
from pipeline.store.files import ASIDE, COMMITS, CUBE, HOLDER, LOCK, OWN_FILES, OWN_NAMES, RUN_FILE

if TYPE_CHECKING:
    from zarr.abc.store import Store


@dataclass(frozen=True)
class LocalFiles:
    """Files of a local folder by key (relative path), such as ``commits/000001.json``."""

    root: Path

    @property
    def name(self) -> str:
        """Path of the folder, as it was given."""
        return str(self.root)

    @property
    def place(self) -> str:
        """Absolute path of the folder, for other processes."""
        return str(self.root.absolute())

    @property
    def local(self) -> Path:
        """Path of the folder."""
        return self.root

    def below(self, prefix: str) -> LocalFiles:
        """Return the files of a subfolder, with keys relative to it."""
        return LocalFiles(self.root / prefix)

    def names(self) -> list[str]:
        """Return the names of all entries of the folder, sorted."""
        with unreadable(self.root), os.scandir(self.root) as entries:
            return sorted(entry.name for entry in entries)

    def is_there(self, key: str) -> bool:
        """Return whether a plain file exists at a path. A link or a folder does not count.

        Raise `UnreadableError` if the file system cannot tell.
        """
        return is_there(self.root / key)

    def read(self, key: str) -> bytes:
        """Return the content of a plain file."""
        path = self.root / key
        with unreadable(path), open_plain(path, "rb") as file:
            content: bytes = file.read()
        return content

    def read_each(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes | FileNotFoundError]]:
        """Read several files; yield each key with the content, or with a `FileNotFoundError`."""
        for key in keys:
            try:
                yield key, self.read(key)
            except FileNotFoundError as error:
                yield key, error

    def write(self, key: str, content: bytes) -> None:
        """Write a file atomically; it is durable when this returns."""
        path = self.root / key
        with writing(path):
            self.root.stat()  # raises if the folder was removed: it is not made again
            make_folder(path.parent)
        write_atomically(path, content)

    def write_once(self, key: str, content: bytes) -> None:
        """Write a file atomically. If two processes write the same content at once, one of the two files stays."""
        self.write(key, content)

    def append(self, key: str, line: str) -> None:
        """Append a line to a file that is not part of the result, without syncing it to disk."""
        path = self.root / key
        with writing(path), open_plain(path, "a", encoding="utf-8") as file:
            file.write(line + "\n")

    def sizes(self) -> dict[str, int]:
        """Return the size of every plain file below the folder by key; empty if the folder does not exist."""
        self.refuse_links("")
        found: dict[str, int] = {}
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            _measure(self.root, "", found)
        return found

    def everything(self) -> list[str]:
        """Return the keys of all files and links below the folder; empty if the folder does not exist."""
        with unreadable(self.root), contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return [path.relative_to(self.root).as_posix() for path in files_below(self.root)]
        return []

    def remove(self, keys: Iterable[str]) -> None:
        """Remove files and links but not the targets of links; a missing file is no error."""
        paths = [self.root / key for key in keys]
        for path in paths:
            with writing(path):
                path.unlink(missing_ok=True)
        for folder in sorted({path.parent for path in paths}):
            with contextlib.suppress(FileNotFoundError), writing(folder):
                sync_folder(folder)

    def sync(self, keys: Iterable[str]) -> None:
        """Make files durable on disk, then their folders, from the innermost folder up to this one."""
        sync((self.root / key for key in keys), self.root)

    def prepare(self, prefix: str) -> None:
        """Create a folder if it does not exist, and make its entry durable on disk."""
        make_folder(self.root / prefix)
        with writing(self.root):
            sync_folder(self.root.parent)

    def odd(self, folders: Iterable[str]) -> list[str]:
        """Return the keys of folders found where files should be, and of files found where folders should be."""
        found, expected = [], list(folders)
        for folder in expected:
            path = self.root / folder
            if path.is_dir():
                with unreadable(path), os.scandir(path) as entries:
                    below = sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
                found += [key for name in below if (key := f"{folder}/{name}") not in expected]
            elif os.path.lexists(path) and not path.is_symlink():
                found.append(folder)
        return found + [name for name in OWN_FILES if os.path.isdir(self.root / name)]

    def move_aside(self, key: str) -> str:
        """Move what occupies a path needed by the run into the subfolder ``aside``; return its new path."""
        path = self.root / key
        target = self.root / ASIDE / f"{key.replace('/', '-')}.{uuid.uuid4().hex[:8]}"
        refuse_links(target.parent)
        make_folder(target.parent)
        with writing(path):
            path.rename(target)
            sync_folder(path.parent)
            sync_folder(target.parent)
        return str(target)

    def refuse_links(self, *prefixes: str) -> None:
        """Raise `RefusedError` if one of the given folders is a symbolic link."""
        refuse_links(*(self.root / prefix for prefix in prefixes))

    def zarr(self, *, read_only: bool) -> Store:
        """Return the folder as a zarr store."""
        from zarr.storage import LocalStore

        return LocalStore(self.root, read_only=read_only)

    def lock(self) -> AbstractContextManager[bool]:
        """Return a context manager that holds the folder's file lock."""
        return writer_lock(self.root)


def _measure(folder: Path, prefix: str, found: dict[str, int]) -> None:
    """Add the size of each file below a folder by key; raise `RefusedError` for links directly in it."""
    with unreadable(folder), os.scandir(folder) as entries:
        below = list(entries)
    for entry in below:
        if entry.is_file(follow_symlinks=False):
            with unreadable(folder):
                found[prefix + entry.name] = entry.stat(follow_symlinks=False).st_size
        elif entry.is_dir(follow_symlinks=bool(not prefix)):
            refuse_links(Path(entry.path))
            _measure(Path(entry.path), f"{prefix}{entry.name}/", found)


def unwritable(folder: Path) -> str | None:
    """Return the reason why a folder, which need not exist yet, cannot be written to; None if it can."""
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        return f"{place}: is no folder"
    if not os.access(place, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
        return f"{place}: cannot be written to"
    return None


def make_folder(path: Path) -> None:
    """Create a folder and its parents, and make their entries durable on disk."""
    if path.is_dir():
        return
    make_folder(path.parent)
    with writing(path):
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


_TO_SYNC = "rb" if hasattr(os, "O_DIRECTORY") else "r+b"
"""Mode in which a file is opened to be synced: Windows refuses to sync one that is open for reading alone."""


def sync_file(path: Path) -> None:
    """Make a file's content durable on disk."""
    with writing(path), open_plain(path, _TO_SYNC) as file:
        os.fsync(file.fileno())


def sync(files: Iterable[Path], top: Path) -> None:
    """Make files durable on disk, then all folders that contain them, up to the folder `top`."""
    folders: set[Path] = set()
    for file in files:
        sync_file(file)
        folders.update(p for p in file.parents if p == top or top in p.parents)
    for folder in sorted(folders, key=lambda p: -len(p.parts)):
        with writing(folder):
            sync_folder(folder)


def files_below(folder: Path) -> Iterator[Path]:
    """Yield all files below a folder; a symbolic link counts as a file and is not followed."""
    with os.scandir(folder) as entries:
        found = sorted(entries, key=lambda entry: entry.name)
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            yield from files_below(Path(entry.path))
        else:
            yield Path(entry.path)


def is_there(path: Path) -> bool:
    """Return whether a plain file exists at a path. A link or a folder does not count.

    Raise `UnreadableError` if the file system cannot tell.
    """
    try:
        with unreadable(path):
            return stat.S_ISREG(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


@contextlib.contextmanager
def unreadable(path: Path) -> Iterator[None]:
    """Turn file system errors in this context into `UnreadableError`, except for missing files."""
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


def refuse_links(*paths: Path) -> None:
    """Raise `RefusedError` if one of the paths is a symbolic link.

    Raises
    ------
    RefusedError
        If one of the paths is a link; the message names it.
    """
    for path in paths:
        if path.is_symlink():
            raise RefusedError(
                f"{path}: is a link, which magpend does not follow inside of a run directory; remove it, or "
                "put the file or folder itself there. The run directory as a whole may be a link."
            )


def run_around(path: Path) -> Path | None:
    """Return the run directory at or above a path; None if there is none."""
    real = path.absolute().resolve()
    for folder in (real, *real.parents):
        if sum(os.path.lexists(folder / name) for name in (RUN_FILE, CUBE, COMMITS)) >= 2:
            return folder
    return None


def refuse_place(path: Path, option: str = "", within: str = "") -> None:
    """Raise `RefusedError` for a result path that lies inside a run directory or is a broken symbolic link.

    `option` is that of the command that gave the path, for the message; `within` a folder of a run directory in which
    results may lie.
    """
    name = f"{option} {path}".strip()
    if path.is_symlink() and not path.exists():
        raise RefusedError(f"{name}: is a link that leads nowhere; remove it, or give another name.")
    run = run_around(path)
    if run is not None and not (within and path.absolute().parent.resolve() == run / within):
        raise RefusedError(f"{name}: lies inside of the run directory {run}; give a place outside of it.")


def remove_tree(path: Path) -> None:
    """Remove a file, a link (not its target) or a folder; a missing one is no error."""
    with contextlib.suppress(FileNotFoundError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextlib.contextmanager
def writer_lock(directory: Path) -> Iterator[bool]:
    """Hold a file lock on a run directory against other writers inside this context.

    The system frees the lock when its process ends, however it ends. Yields False where locks fail. Raise
    `LockedError`, which names the other process, if it is held.
    """
    from filelock import FileLock, Timeout

    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    refuse_links(*(directory / name for name in sorted(OWN_NAMES)))
    lock = FileLock(directory / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        said = b""
        with contextlib.suppress(OSError), open_plain(directory / HOLDER, "rb") as file:
            said = file.read()
        raise LockedError(
            f"{directory}: another magpend run is writing here{in_words(said)}. Wait for it or stop it, then run again."
        ) from None
    except (NotImplementedError, OSError) as error:
        warnings.warn(f"{directory}: no file lock here ({error}); start one run at a time.", stacklevel=3)
        yield False
        return
    try:
        with _named(directory / HOLDER):
            yield True
    finally:
        lock.release()


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Write a note beside a lock that names its holder; remove the note at the end of the context."""
    content = json.dumps(holder()).encode()
    with contextlib.suppress(OSError):
        write_atomically(path, content)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            with open_plain(path, "rb") as file:
                is_own = file.read() == content  # else another run's note: the folder was renamed meanwhile
            if is_own:
                path.unlink()


def holder() -> dict[str, Any]:
    """Return a note that names this process as the holder of a lock: host, process id, and the time (UTC)."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"host": platform.node(), "pid": os.getpid(), "since": now}


def in_words(content: bytes) -> str:
    """Return a phrase that names the process holding a lock; empty if the note about it is damaged."""
    found = _holder_in(content)
    return f" (process {found['pid']} on {found['host']} since {found['since']})" if found else ""


def _holder_in(content: bytes) -> dict[str, Any] | None:
    try:
        data = json.loads(content)
        data = {"host": str(data["host"]), "pid": int(data["pid"]), "since": str(data["since"])}
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return data if all(text.isprintable() for text in (data["host"], data["since"])) else None


def has_ended(content: bytes) -> bool:
    """Return whether the holder of a lock was a process of this machine that has ended, as far as the system tells.

    Windows does not tell: there, `os.kill` with the signal 0 sends Ctrl-C.
    """
    found = _holder_in(content)
    if found is None or found["host"] != platform.node() or not hasattr(os, "killpg"):
        return False
    try:
        os.kill(found["pid"], 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


def is_note(content: bytes) -> bool:
    """Return whether a file's content is a note that names the holder of a lock."""
    return _holder_in(content) is not None
