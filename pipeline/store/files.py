"""Files of a run by key: one interface, whatever holds them."""

from __future__ import annotations

import hashlib
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
OWN_FILES = (RUN_FILE, HOLDER, TIMINGS, EXTENDED)
OWN_NAMES = frozenset({RUN_FILE, CUBE, COMMITS, LOCK, HOLDER, TIMINGS, DERIVED, FIGURES, EXTENDED, ASIDE})

# one letter before the colon is a drive; pathlib makes one slash of two
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


class Files(Protocol):
    """Files of a run, or of a part of one, by key: parts joined by ``/``, such as ``commits/000001.json``.

    What cannot be read for another reason than that it is not there raises `UnreadableError`.

    Attributes
    ----------
    name : str
        What people call it: for messages.
    place : str
        What another process opens it by: see `open_files`.
    local : Path or None
        The folder, where it is one.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def place(self) -> str: ...  # noqa: D102

    @property
    def local(self) -> Path | None: ...  # noqa: D102

    def below(self, prefix: str) -> Files:
        """Files whose keys begin with a prefix and ``/``, by the rest of their keys."""
        ...

    def names(self) -> list[str]:
        """First parts of all keys, sorted.

        Raises
        ------
        FileNotFoundError
            If nothing is there.
        NotADirectoryError
            If a file is.
        """
        ...

    def is_there(self, key: str) -> bool:
        """Whether a file is there; a link is none."""
        ...

    def read(self, key: str) -> bytes:
        """Content of a file.

        Raises
        ------
        FileNotFoundError
            If there is none.
        NoFileError
            If a link, a folder or another thing that is no file is there.
        """
        ...

    def read_each(self, keys: Iterable[str]) -> Iterator[tuple[str, bytes | FileNotFoundError]]:
        """Contents, or why there is none, in the order of the keys; quicker than one by one."""
        ...

    def write(self, key: str, content: bytes) -> None:
        """Write a file so that it is there whole or not at all, and durable when this returns."""
        ...

    def write_once(self, key: str, content: bytes) -> None:
        """As `write`, for a file that has one right content, whoever writes it."""
        ...

    def append(self, key: str, line: str) -> None:
        """Add a line to a file that is no part of the result."""
        ...

    def sizes(self) -> dict[str, int]:
        """Size of every file by key; nothing if nothing is there."""
        ...

    def everything(self) -> list[str]:
        """Keys of all that is there, links too."""
        ...

    def remove(self, keys: Iterable[str]) -> None:
        """Remove files; one that is gone already is no error."""
        ...

    def sync(self, keys: Iterable[str]) -> None:
        """Make files durable that zarr wrote, with the folders that they lie in."""
        ...

    def prepare(self, prefix: str) -> None:
        """Make a folder, where there are folders."""
        ...

    def odd(self, folders: Iterable[str]) -> list[str]:
        """Keys of folders at the places of files, and of files at the places of folders.

        Parameters
        ----------
        folders
            All that should be folders.
        """
        ...

    def move_aside(self, key: str) -> str:
        """Move something out of the way, into a folder `ASIDE`; returns where it lies now."""
        ...

    def refuse_links(self, *prefixes: str) -> None:
        """Refuse to work below a link: what it leads to is not the run's own.

        Raises
        ------
        RefusedError
            Naming the link.
        """
        ...

    def zarr(self, *, read_only: bool) -> Store:
        """What zarr reads and writes here."""
        ...

    def lock(self) -> AbstractContextManager[bool | None]:
        """Hold the lock: a courtesy between people, the commit protocol does not rest on it.

        Gives False where locks do not work, so that another process may be writing, too.

        Raises
        ------
        LockedError
            If another process holds it.
        """
        ...


def open_files(place: str | Path | Files) -> Files:
    """Return the files of a run by its place: a folder, or ``s3://bucket/prefix``; files as they are.

    Raises
    ------
    RefusedError
        If `place` is another URL, or the object store cannot be used.
    """
    if not isinstance(place, (str, Path)):
        return place
    if is_url(place):
        from pipeline.store.objects import parse_url

        return parse_url(str(place))
    from pipeline.store.local import LocalFiles

    return LocalFiles(local_path(place))


def is_url(place: str | Path) -> bool:
    """Whether a place is an object store's."""
    return str(place).startswith("s3://")


def local_path(path: str | Path) -> Path:
    """Return a path of the local file system.

    Raises
    ------
    RefusedError
        If `path` looks like a URL.
    """
    text = str(path)
    if _URL.match(text):
        if is_url(text):
            raise RefusedError(
                f"{text}: must be a folder of this machine; runs alone are kept in object stores."
            )
        raise RefusedError(f"{text}: is no folder and no object store; give a path, or s3://BUCKET/PREFIX.")
    return Path(path)


def is_temporary(name: str) -> bool:
    """Whether a file was being written when it was left: a name of `temporary_beside`."""
    return name.startswith(".") and name.endswith(TEMPORARY)


def entry_of(data: bytes) -> dict[str, Any]:
    """Size and sha256 of a content, as commit records and ``run.json`` hold them."""
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def entries_of(files: Files, keys: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Size and sha256 by key of files that were just written, as they are read back."""
    found = {}
    for key, content in files.read_each(keys):
        if isinstance(content, FileNotFoundError):
            raise content
        found[key] = entry_of(content)
    return found


def problems_of(files: Files, objects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Compare files with their sizes and digests; a line per file that is not what was written.

    Parameters
    ----------
    files
        Where the keys of `objects` lie.
    objects
        Size and sha256 by key, as of `entry_of`.
    """
    problems = []
    for key, content in files.read_each(objects):
        if isinstance(content, NoFileError):
            problems.append(f"{key}: {content}")
        elif isinstance(content, FileNotFoundError):
            problems.append(f"{key}: missing")
        elif entry_of(content) != dict(objects[key]):
            problems.append(f"{key}: its content has changed")
    return problems
