"""What a run does to its files, step by step: written down, failing or fatal where a test says so."""

from __future__ import annotations

import builtins
import contextlib
import io
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

READ, OPEN, WRITE, SYNC, RENAME, MKDIR, UNLINK = "read", "open", "write", "sync", "rename", "mkdir", "unlink"
CHANGES = frozenset({OPEN, WRITE, SYNC, RENAME, MKDIR, UNLINK})


@dataclass(frozen=True)
class Step:
    """One call of the operating system; of a write, the content."""

    kind: str
    path: Path
    target: Path | None = None
    content: bytes = b""


Act = Callable[[int, Step], None]


def _put(functions: dict[str, Callable[..., Any]], opener: Callable[..., Any]) -> None:
    for name, function in functions.items():
        setattr(os, name, function)
    io.open = builtins.open = opener  # type: ignore[assignment]


@dataclass
class Steps:
    """Calls for what lies below a folder, in order; before each of them `act` may kill or raise.

    Nothing is synced in truth: a kill loses nothing that was written, and a power cut is played.
    """

    folder: Path
    act: Act | None = None
    log: list[Step] = field(default_factory=list)
    _lock: Any = field(default_factory=threading.Lock)

    def take(self, step: Step) -> None:
        with self._lock:
            self.log.append(step)
            number = len(self.log)
        if self.act is not None:
            self.act(number, step)

    def here(self, path: Any) -> Path | None:
        """The path, if it is below the folder."""
        if isinstance(path, int):
            with contextlib.suppress(OSError):
                return self.here(os.readlink(f"/proc/self/fd/{path}"))
            return None
        found = Path(os.path.abspath(os.fspath(path)))
        return found if found == self.folder or self.folder in found.parents else None

    @contextlib.contextmanager
    def watching(self) -> Iterator[Steps]:
        """Put this between the program and the operating system."""
        original = {name: getattr(os, name) for name in ("fsync", "replace", "rename", "mkdir", "unlink")}
        plain_open, scandir, low_open = io.open, os.scandir, os.open

        def fsync(fd: int) -> None:
            path = self.here(fd)
            if path is None:
                return original["fsync"](fd)
            self.take(Step(SYNC, path))

        def move(name: str) -> Callable[..., None]:
            def call(source: Any, target: Any, **options: Any) -> None:
                path = self.here(source)
                if path is not None:
                    self.take(Step(RENAME, path, self.here(target)))
                return original[name](source, target, **options)

            return call

        def simple(name: str, kind: str) -> Callable[..., None]:
            def call(path: Any, *args: Any, **options: Any) -> None:
                if (below := self.here(path)) is not None:
                    self.take(Step(kind, below))
                return original[name](path, *args, **options)

            return call

        def opening(file: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
            path = None if isinstance(file, int) else self.here(file)
            if path is None:
                return plain_open(file, mode, *args, **options)
            writes = any(letter in mode for letter in "wax+")
            self.take(Step(OPEN if writes else READ, path))
            opened = plain_open(file, mode, *args, **options)
            return _Written(opened, path, self) if writes else opened

        def low_opening(path: Any, flags: int, *args: Any, **options: Any) -> int:
            below = self.here(path)
            # the lock's file is no part of the result; a folder is opened to be synced
            if below is not None and flags & (os.O_WRONLY | os.O_RDWR):
                self.take(Step(OPEN, below))
            return low_open(path, flags, *args, **options)

        def listing(path: Any = ".") -> Any:
            below = self.here(path)
            if below is not None:
                self.take(Step(READ, below))
            return scandir(path)

        patched = {
            "fsync": fsync,
            "replace": move("replace"),
            "rename": move("rename"),
            "open": low_opening,
            "mkdir": simple("mkdir", MKDIR),
            "unlink": simple("unlink", UNLINK),
            "scandir": listing,
        }
        original |= {"open": low_open, "scandir": scandir}
        try:
            _put(patched, opening)
            yield self
        finally:
            _put(original, plain_open)


class _Written:
    """A file whose every write is a step; one that fails, or is the last, leaves half of the content."""

    def __init__(self, file: Any, path: Path, steps: Steps) -> None:
        self._file, self._path, self._steps = file, path, steps

    def write(self, content: Any) -> int:
        data = content if isinstance(content, str) else bytes(content)
        half = len(data) // 2
        self._file.write(data[:half])
        self._file.flush()
        self._steps.take(Step(WRITE, self._path, content=data.encode() if isinstance(data, str) else data))
        return half + int(self._file.write(data[half:]))

    def __enter__(self) -> _Written:
        self._file.__enter__()
        return self

    def __exit__(self, *error: Any) -> Any:
        return self._file.__exit__(*error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


# ---- power cuts --------------------------------------------------------------------------------


@dataclass
class File:
    """A file's content as programs see it, and as it is on the disk; None if it was never synced."""

    content: bytes = b""
    kept: bytes | None = None

    @property
    def is_kept(self) -> bool:
        """Whether all of it is on the disk."""
        return self.kept == self.content


@dataclass
class Disk:
    """A file system without any order but that of syncs: what is not synced may be there, or not."""

    # there from the begin, with its own entry on the disk
    top: Path
    # entries by folder, as programs see them and as they are on the disk; a folder is None
    names: dict[Path, dict[str, File | None]] = field(default_factory=dict)
    kept_names: dict[Path, dict[str, File | None]] = field(default_factory=dict)

    def take(self, step: Step) -> None:
        """Do what a program does."""
        folder, name = step.path.parent, step.path.name
        entries = self.names.setdefault(folder, {})
        if step.kind == OPEN:
            entries[name] = File()
        elif step.kind == WRITE:
            file = entries[name]
            assert file is not None
            file.content += step.content
        elif step.kind == RENAME:
            assert step.target is not None
            self.names.setdefault(step.target.parent, {})[step.target.name] = entries.pop(name)
        elif step.kind == MKDIR:
            entries.setdefault(name, None)
            self.names.setdefault(step.path, {})
        elif step.kind == UNLINK:
            entries.pop(name, None)
        elif step.kind == SYNC and step.path in self.names:
            self.kept_names[step.path] = dict(self.names[step.path])
        elif step.kind == SYNC and (file := entries.get(name)) is not None:
            file.kept = file.content

    def files(self) -> list[Path]:
        """All files that programs see."""
        return [folder / name for folder, names in self.names.items() for name, f in names.items() if f]

    def after_a_cut(self, folder: Path, keeps: Callable[[Path], bool]) -> dict[Path, bytes]:
        """Files below a folder that are there when the power is back.

        Parameters
        ----------
        folder
            Where to look.
        keeps
            For a folder, whether its last names are on the disk though nobody synced them; for a file,
            whether its last content is. A file whose name is there and whose content is not has zeros.
        """
        found: dict[Path, bytes] = {}
        names = self.names if keeps(folder) else self.kept_names
        for name, file in names.get(folder, {}).items():
            path = folder / name
            if file is None:
                found |= self.after_a_cut(path, keeps)
            elif keeps(path):
                found[path] = file.content
            else:
                found[path] = bytes(len(file.content)) if file.kept is None else file.kept
        return found
