"""Define how a run's files are read and written by key (relative path), in a folder or in an object store."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.layout.writing import TEMPORARY, NoFileError
from pipeline.store.errors import RefusedError

if TYPE_CHECKING:
    from zarr.abc.store import Store

RUN_FILE, CUBE, COMMITS, LOCK, TIMINGS = "run.json", "cube.zarr", "commits", "lock", "timings.jsonl"
HOLDER = "lock.json"
DERIVED, FIGURES, EXTENDED, ASIDE = "derived", "figures", "extended.json", "aside"
RECORD_COPY = "records.jsonl"
OWN_FILES = (RUN_FILE, HOLDER, TIMINGS, EXTENDED, RECORD_COPY)
OWN_NAMES = frozenset({*OWN_FILES, CUBE, COMMITS, LOCK, DERIVED, FIGURES, ASIDE})

VERIFY = "MAGPEND_VERIFY"
"""Environment variable; ``0`` reads chunks without comparing them with their records."""

# one letter before the colon is a Windows drive; pathlib turns two slashes into one
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


class Files(Protocol):
    """Interface to the files of a run, or of a part of a run, by key (relative path).

    A key has parts joined by ``/``, such as ``commits/000001.json``.

    A file that exists and cannot be read raises `UnreadableError`.

    Attributes
    ----------
    name : str
        Name of the place in messages.
    place : str
        Path or URL by which another process opens it with `open_files`.
    local : Path or None
        The folder; None for an object store.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def place(self) -> str: ...  # noqa: D102

    @property
    def local(self) -> Path | None: ...  # noqa: D102

    def below(self, prefix: str) -> Files:
        """Return the files below a prefix (a subfolder), with keys relative to it."""
        ...

    def names(self) -> list[str]:
        """Return the first parts of all keys (the top-level names), sorted.

        Raise `FileNotFoundError` if the place does not exist, and `NotADirectoryError` if it is a file.
        """
        ...

    def is_there(self, key: str) -> bool:
        """Return whether a file exists at a key; a symbolic link does not count."""
        ...

    def read(self, key: str) -> bytes:
        """Return the content of a file.

        Raise `FileNotFoundError` if it does not exist, and `NoFileError` if the key leads to a link, a folder or
        anything else that is not a file.
        """
        ...

    def read_each(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes | FileNotFoundError]]:
        """Read several files; yield each key, in the given order, with the file's content, or with a
        `FileNotFoundError` for a missing file.

        This is faster than reading one key at a time.
        """
        ...

    def write(self, key: str, content: bytes) -> None:
        """Write a file atomically; it is durable when this returns."""
        ...

    def write_once(self, key: str, content: bytes) -> None:
        """Write a file that several processes may write at the same time, all with the same content."""
        ...

    def append(self, key: str, line: str) -> None:
        """Append a line to a file that is not part of the result, such as a log of timings."""
        ...

    def sizes(self) -> dict[str, int]:
        """Return the size of every file by key; an empty dict if the folder does not exist."""
        ...

    def everything(self) -> list[str]:
        """Return the keys of all files, symbolic links included."""
        ...

    def remove(self, keys: Iterable[str]) -> None:
        """Remove files; a file that does not exist is no error."""
        ...

    def sync(self, keys: Iterable[str]) -> None:
        """Make files that zarr wrote durable on disk, with their folders."""
        ...

    def prepare(self, prefix: str) -> None:
        """Create a folder; do nothing in an object store, which has no folders."""
        ...

    def odd(self, folders: Iterable[str]) -> list[str]:
        """Return the keys of folders found where files should be, and of files where the given `folders` should be."""
        ...

    def move_aside(self, key: str) -> str:
        """Move what occupies a path needed by the run into the run's folder ``aside``; return its new path."""
        ...

    def refuse_links(self, *prefixes: str) -> None:
        """Raise `RefusedError` if one of the given files or folders is a symbolic link."""
        ...

    def zarr(self, *, read_only: bool) -> Store:
        """Return a zarr store that reads and writes these files."""
        ...

    def lock(self) -> AbstractContextManager[bool | None]:
        """Hold the run's lock inside this context, so that no second writer starts; even without the lock, committed
        data stay intact.

        Yields False where locks do not work; another process may then be writing, too. Raise `LockedError` if another
        process holds it.
        """
        ...


def is_url(place: str | Path) -> bool:
    """Return whether a path or URL leads to an object store (``s3://``)."""
    return str(place).startswith("s3://")


def local_path(path: str | Path) -> Path:
    """Convert text to a path of the local file system; raise `RefusedError` for a URL."""
    text = str(path)
    if _URL.match(text):
        if is_url(text):
            raise RefusedError(f"{text}: must be a folder of this machine; runs alone are kept in object stores.")
        raise RefusedError(f"{text}: is no folder and no object store; give a path, or s3://BUCKET/PREFIX.")
    return Path(path)


def is_temporary(name: str) -> bool:
    """Return whether a file name is that of a temporary file, which an interrupted writer has left."""
    return name.startswith(".") and name.endswith(TEMPORARY)


def checks_chunks() -> bool:
    """Return whether chunks are compared with their records when read; MAGPEND_VERIFY=0 turns it off."""
    return os.environ.get(VERIFY, "1").strip().lower() not in ("0", "no", "false", "off")


def entry_of(data: bytes) -> dict[str, Any]:
    """Return the size and sha256 of a file's content, in the form that commit records and ``run.json`` hold."""
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def problems_of(files: Files, objects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Compare files with their recorded sizes and sha256 digests, by key; return a line for each file that differs."""
    return [problem for _, _, problem in compared(files, objects) if problem]


def compared(files: Files, objects: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, bytes, str]]:
    """Read files and compare them with their recorded sizes and sha256 digests, as of `entry_of`.

    Yield key, content (empty for a file that is missing) and a line of text, which is empty if the file is as recorded.
    """
    for key, content in files.read_each(objects):
        if isinstance(content, NoFileError):
            yield key, b"", f"{key}: {content}"
        elif isinstance(content, FileNotFoundError):
            yield key, b"", f"{key}: missing"
        else:
            yield key, content, "" if entry_of(content) == dict(objects[key]) else f"{key}: its content has changed"
