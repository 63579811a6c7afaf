"""What a worker must have in common with whoever sends it tasks: programs, and the run directory."""

from __future__ import annotations

import os
import platform
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.compute.addresses import SchedulerError

PACKAGES = ("numpy", "numba", "zarr", "numcodecs", "dask", "distributed")
_ROOMS = ("spec", "layout", "products", "compute", "store")
_SHOWN = 3
_LATE_S = 5.0
"""A network's file system may take so long to show a new file."""


@cache
def installation() -> dict[str, str]:
    """What computes and writes here: versions, and digests of what magpend's own code means."""
    from magpend_core.meaning import kernel_version, meaning_digest

    pipeline = Path(__file__).parents[1]
    found = {"Python": ".".join(platform.python_version_tuple()[:2])}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    found["magpend's kernel"] = kernel_version()
    found["magpend's code"] = meaning_digest(pipeline / room for room in _ROOMS)
    return found


def check_versions(client: Any, workers: Iterable[str]) -> None:
    """Refuse workers whose programs are other than here: they would compute or write something else.

    Raises
    ------
    SchedulerError
        Naming workers, what differs, and the remedy.
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
    if isinstance(there, (ModuleNotFoundError, AttributeError)):
        return "has no magpend, or one of another version"
    if isinstance(there, BaseException):
        return f"does not answer ({type(there).__name__}: {there})"
    found = {n: (there.get(n, "none"), here[n]) for n in here if there.get(n, "none") != here[n]}
    return ", ".join(f"{name} {theirs}, here {ours}" for name, (theirs, ours) in found.items())


def check_directory(client: Any, workers: Iterable[str], directory: Path) -> None:
    """Refuse workers that do not see the run directory, or cannot write to it.

    A file of one moment goes through all of them: another directory by the same name does not pass.

    Raises
    ------
    SchedulerError
        Naming workers, and the remedy.
    """
    directory = directory.absolute()
    token = uuid.uuid4().hex
    # where, and named as, leftovers are swept by the next run, should this process be killed here
    path = directory / "commits" / f".probe.{token}.tmp"
    path.parent.mkdir(exist_ok=True)
    path.write_text(token, "ascii")
    try:
        answers = client.run(sees, str(path), token, workers=list(workers), on_error="return")
    finally:
        path.unlink(missing_ok=True)
    blind = {address: str(answer) for address, answer in answers.items() if answer != ""}
    if blind:
        raise SchedulerError(
            f"{len(blind)} of {len(answers)} workers cannot use {directory}: {_listed(blind)}. Workers write "
            "their results there themselves: choose, with --out, a folder of a file system that all of them "
            "see by this path and may write to."
        )


def sees(path: str, token: str) -> str:
    """Say what bars this process from a run directory; empty if nothing does."""
    file, deadline = Path(path), time.monotonic() + _LATE_S
    while True:
        try:
            found = file.read_text("ascii")
        except OSError as error:
            if time.monotonic() < deadline and isinstance(error, FileNotFoundError) and file.parent.is_dir():
                time.sleep(0.2)
                continue
            return f"does not see it ({error.strerror or error})"
        if found != token:
            return "sees another one by that name"
        return "" if os.access(file.parent, os.W_OK | os.X_OK) else "may not write to it"


def _listed(problems: Mapping[str, str]) -> str:
    shown = [f"{address} {why}" for address, why in list(problems.items())[:_SHOWN]]
    return "; ".join(shown) + (f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else "")


class MisfitError(Exception):
    """A worker that came later has other programs than whoever sends it tasks."""


class Fitting:
    """A task that is done by workers with the same programs alone, also by those that come later.

    Parameters
    ----------
    task
        Takes an index.
    programs
        See `installation`; by default those here.
    """

    def __init__(self, task: Callable[[int], dict[str, Any]], programs: dict[str, str] | None = None) -> None:
        self.task, self.programs = task, programs or installation()

    def __call__(self, index: int) -> dict[str, Any]:
        """Do the task; raises `MisfitError` where it would not be the same."""
        if why := _difference(self.programs, installation()):
            raise MisfitError(f"this worker has other programs ({why}); install the same versions everywhere")
        return self.task(index)
