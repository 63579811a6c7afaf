"""Check that workers have the same software as this process, and see the same run directory."""

from __future__ import annotations

import os
import platform
import re
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import metadata
from typing import Any

from magpend_core.versions import ENGINE
from pipeline.compute.addresses import SchedulerError
from pipeline.layout.identity import CELLS
from pipeline.layout.writing import TEMPORARY
from pipeline.store.errors import StoreError
from pipeline.store.files import COMMITS
from pipeline.store.places import open_files

PACKAGES = ("numpy", "numba", "zarr", "numcodecs", "dask", "distributed")
_SHOWN = 3
_LATE_S, _AGAIN_S = 5.0, 0.2
"""Longest wait for a new file on a network's file system, and time between two looks [s]."""


@cache
def installation() -> dict[str, str]:
    """Return the versions of Python and of the installed packages, and the numbers of magpend's own versions."""
    found = {"Python": ".".join(platform.python_version_tuple()[:2])}
    for name in ("magpend", *PACKAGES):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    found["magpend's engine"] = str(ENGINE)
    found["magpend's cells"] = str(CELLS)
    return found


def check_versions(client: Any, workers: Iterable[str]) -> None:
    """Raise SchedulerError unless all workers have the same software versions as this process.

    Raises
    ------
    SchedulerError
        If they differ; the message names workers, differences and the remedy.
    """
    here = installation()
    answers = client.run(installation, workers=list(workers), on_error="return")
    different = {address: _difference(here, answer) for address, answer in answers.items()}
    different = {address: why for address, why in different.items() if why}
    if different:
        raise SchedulerError(
            f"{len(different)} of {len(answers)} workers have other programs than this process: "
            f"{_listed(different)}. Install the same versions everywhere: start scheduler and workers from "
            "the environment that magpend runs in, on a file system that all see."
        )


def _difference(here: Mapping[str, str], there: Any) -> str:
    # what cannot be unpickled there comes back as an Exception with the error's text
    if isinstance(there, Exception) and re.search(r"ModuleNotFoundError|AttributeError", repr(there)):
        return "has no magpend, or one of another version"
    if isinstance(there, BaseException):
        return f"does not answer ({type(there).__name__}: {there})"
    found = {n: (there.get(n, "none"), here[n]) for n in here if there.get(n, "none") != here[n]}
    return ", ".join(f"{name} {theirs}, here {ours}" for name, (theirs, ours) in found.items())


def check_directory(client: Any, workers: Iterable[str], place: str) -> None:
    """Raise SchedulerError unless all workers can read and write the run directory.

    All workers must read a temporary file there, so that another directory with the same name is detected.

    Raises
    ------
    SchedulerError
        If workers do not; the message names them and the remedy.
    """
    files, token = open_files(place), uuid.uuid4().hex
    # where, and named as, leftovers are swept by the next run, should this process be killed here
    key = f"{COMMITS}/.probe.{token}{TEMPORARY}"
    files.write(key, token.encode())
    try:
        answers = client.run(sees, place, key, token, workers=list(workers), on_error="return")
    finally:
        files.remove([key])
    blind = {address: str(answer) for address, answer in answers.items() if answer != ""}
    if blind:
        raise SchedulerError(
            f"{len(blind)} of {len(answers)} workers cannot use {files.name}: {_listed(blind)}. Workers "
            "write their results there themselves: choose, with --out, a folder of a file system that all of "
            "them see by this path and may write to."
        )


def sees(place: str, key: str, token: str) -> str:
    """Return the reason why this process cannot use a run directory; an empty text if it can."""
    deadline = time.monotonic() + _LATE_S
    while True:
        try:
            files = open_files(place)
            files.names()
            found = files.read(key).decode(errors="replace")
            break
        except (OSError, StoreError) as error:
            if time.monotonic() > deadline or not isinstance(error, FileNotFoundError):
                return f"does not see it ({_reason(error)})"
            time.sleep(_AGAIN_S)
    if found != token:
        return "sees another one by that name"
    mine = f"{COMMITS}/.probe.{uuid.uuid4().hex}{TEMPORARY}"
    try:
        files.write(mine, b"")
        files.remove([mine])
    except (OSError, StoreError) as error:
        return f"cannot write to it ({_reason(error)})"
    return ""


def _reason(error: Exception) -> str:
    # writing names a hidden file and another remedy: the system's own words are enough here
    code = getattr(error, "errno", None)
    return os.strerror(code) if code else str(error)


def _listed(problems: Mapping[str, str]) -> str:
    shown = [f"{address} {why}" for address, why in list(problems.items())[:_SHOWN]]
    return "; ".join(shown) + (f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else "")


class MisfitError(Exception):
    """Raised on a worker that has other software versions than the process that sent the task."""


class Fitting:
    """Task that first checks whether its worker has the same software versions as the process that sent it.

    Parameters
    ----------
    task
        Function of an index.
    programs
        Required programs, see `installation`; by default those of this process.
    """

    def __init__(self, task: Callable[[int], dict[str, Any]], programs: dict[str, str] | None = None) -> None:
        self.task, self.programs = task, programs or installation()

    def __call__(self, index: int) -> dict[str, Any]:
        """Run the task; raise MisfitError if the worker has other software versions."""
        if why := _difference(self.programs, installation()):
            raise MisfitError(f"this worker has other programs ({why}); install the same versions everywhere")
        return self.task(index)
