"""Check where a command may write: not into a run directory, and not over files of other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

_LOOKED_AT = 100_000
"""Bytes at both ends of a file that are searched for magpend's mark."""

_HEADER = re.compile(rb"[A-Za-z_][\w.]*(,[A-Za-z_][\w.]*)*")
_LOG_LINE = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} [A-Z]+ ")

_forced = False


def allow(force: bool) -> None:
    """Set whether this command may replace files that magpend did not write (``--force``)."""
    global _forced
    _forced = force


def check_place(path: Path, option: str = "--out", within: str = "") -> None:
    """Raise `RefusedError` if a path lies in a run directory, or is a link to a missing file.

    Parameters
    ----------
    path
        A file or a folder, which need not exist.
    option
        Option that gave it, for the message.
    within
        Folder of a run directory in which the command may write.

    Raises
    ------
    RefusedError
        If the path lies inside of a run directory, or is a link that leads nowhere.
    """
    from pipeline.store.local import refuse_place

    refuse_place(path, option, within)


def check_file(path: Path, option: str = "--out", within: str = "", digests: Collection[str] = ()) -> None:
    """Raise an error if a file cannot be written, or if it exists and magpend did not write it.

    Parameters
    ----------
    path, option, within
        See `check_place`.
    digests
        Digests of the runs that the file is to show, all of which an existing file must name.

    Raises
    ------
    RefusedError, SpecError
        If the place is impossible, or, without ``--force``, if such a file exists.
    """
    check_place(path, option, within)
    if path.is_file() and not _is_own(path):
        _refuse(path, option)
    if path.is_file() and path.stat().st_size and digests:
        content = path.read_bytes()
        # in a PDF, texts with letters beyond ASCII are in UTF-16
        if not all(d.encode() in content or d.encode("utf-16-be") in content for d in digests):
            _refuse(path, option, "shows another run")


def check_page(path: Path, digests: Collection[str] = (), remedy: str = "") -> None:
    """Raise an error if the HTML page cannot be written, before anything is computed; see `check_file`.

    `remedy` is a sentence on what to do where the name has another suffix.
    """
    from pipeline.specification.problems import SpecError
    from pipeline.store.errors import RefusedError
    from pipeline.store.local import unwritable

    if path.suffix.lower() not in (".html", ".htm"):
        raise SpecError(f"--out {path}: the suffix must be .html.{remedy}")
    if path.is_dir() or not path.parent.is_dir():
        raise SpecError(f"--out {path}: must be a file in a folder that exists.")
    check_file(path, digests=digests)
    if problem := unwritable(path.parent):
        raise RefusedError(f"{problem}; give another place for the page: --out FILE.")


def check_table(path: Path, header: str) -> None:
    """Raise SpecError if a CSV file exists and has another header, since it may be another program's table.

    Raises
    ------
    SpecError
        If such a table exists, unless ``--force`` is given.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        first = file.readline(_LOOKED_AT).rstrip(b"\r\n")
    if first and first != header.encode():
        _refuse(path, "--csv")


def check_document(path: Path, data: Any) -> None:
    """Raise SpecError if a JSON file exists with other keys than `data`, since it may be another program's.

    Raises
    ------
    SpecError
        If such a file exists, unless ``--force`` is given.
    """
    if not path.is_file() or not path.stat().st_size:
        return
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError:
        _refuse(path, "--json")
        return
    if _keys(found) != _keys(data):
        _refuse(path, "--json")


def _keys(data: Any) -> set[str]:
    rows = data if isinstance(data, list) else [data]
    return set(rows[0]) if rows and isinstance(rows[0], dict) else set()


def check_log(path: Path) -> None:
    """Raise SpecError if a file exists that is no log file of magpend.

    Raises
    ------
    SpecError
        If the file is not a log, unless ``--force`` is given.
    """
    check_place(path, "--log")
    if path.is_file():
        with path.open("rb") as file:
            first = file.readline(_LOOKED_AT)
        if first and not _LOG_LINE.match(first):
            _refuse(path, "--log")


def _refuse(path: Path, option: str, why: str = "magpend did not write it") -> None:
    from pipeline.specification.problems import SpecError

    if not _forced:
        raise SpecError(f"{option} {path}: exists, and {why}; give another name, or --force to replace it.")


def _is_own(path: Path) -> bool:
    """Return whether a file may be replaced, because it is empty, mentions magpend, or is a CSV table."""
    with path.open("rb") as file:
        begin = file.read(_LOOKED_AT)
        file.seek(max(0, path.stat().st_size - _LOOKED_AT))
        end = file.read()
    is_table = path.suffix.lower() == ".csv" and _HEADER.fullmatch(begin.partition(b"\n")[0].rstrip(b"\r"))
    return not begin or b"magpend" in begin or b"magpend" in end or bool(is_table)
