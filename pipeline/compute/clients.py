"""Choose where tasks run, connect to dask, and check that workers have the same software and see the run directory."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from magpend_core.versions import ENGINE
from pipeline.compute.addresses import OPTION, Address, SchedulerError, ask, read_address, security_of
from pipeline.compute.jobqueue import check_means, job_cluster, jobs_folder
from pipeline.layout.identity import CELLS
from pipeline.layout.writing import TEMPORARY
from pipeline.specification.clusters import QUEUES, Cluster, clock, load_cluster, seconds_of
from pipeline.specification.problems import SpecError, import_extra
from pipeline.store.errors import StoreError
from pipeline.store.files import COMMITS
from pipeline.store.objects import open_files

# ---- checks of workers -----------------------------------------------------------------------------

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
    """Raise `SchedulerError` unless all workers have the same software versions as this process."""
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
    """Raise `SchedulerError` unless all workers can read and write the run directory.

    All workers must read a temporary file there, so that another directory with the same name is detected.
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

    The required `programs` are by default those of this process, see `installation`.
    """

    def __init__(self, task: Callable[[int], dict[str, Any]], programs: dict[str, str] | None = None) -> None:
        self.task, self.programs = task, programs or installation()

    def __call__(self, index: int) -> dict[str, Any]:
        """Run the task; raise MisfitError if the worker has other software versions."""
        if why := _difference(self.programs, installation()):
            raise MisfitError(f"this worker has other programs ({why}); install the same versions everywhere")
        return self.task(index)


# ---- places ----------------------------------------------------------------------------------------

Echo = Callable[[str], None]

ALLOWED_FAILURES = 3
"""Worker deaths that dask allows per task: a single one may have another cause than the task."""

THREADS, PROCESSES, IN_PROCESS = "threads", "processes", "none"
"""Places on this machine: threads of this process, processes, and the calling thread."""

ADDRESS, CLUSTER_FILE, WAIT = "DASK_SCHEDULER_ADDRESS", "MAGPEND_CLUSTER", "MAGPEND_WAIT_FOR_WORKERS"
WAIT_FOR_WORKERS = "00:10:00"
_SAY_EVERY_S, _CONNECT_S = 30.0, 10.0


@dataclass(frozen=True)
class Where:
    """Choice of where tasks run: in threads or processes of this machine, on a dask scheduler or as batch jobs."""

    # ``threads`` or ``processes`` of this machine, ``none`` for the calling thread, a scheduler's address or JSON file,
    # or the name of a batch system. By default ``DASK_SCHEDULER_ADDRESS``, else ``threads``.
    scheduler: str | None = None
    # file with the ``[cluster]`` table of a batch system; by default the value of ``MAGPEND_CLUSTER``
    cluster_file: Path | None = None
    # whether to serve dask's dashboard on loopback, and print its address; not for places on this machine
    dashboard: bool = False
    place: str | None = None  # place of the run directory, which all workers must see (`open_files`)

    @classmethod
    def of(cls, scheduler: Where | str | None) -> Where:
        """Convert the name or address of a scheduler to a `Where`; return a `Where` unchanged."""
        return scheduler if isinstance(scheduler, Where) else cls(scheduler)

    def resolved(self) -> Address | Cluster | str:
        """Decide where tasks run, and start nothing: an address, a batch system, or a place on this machine."""
        found = self._resolved()
        if self.dashboard and isinstance(found, str):
            raise SpecError(
                "--dashboard: shows a dask scheduler, and there is none on this machine; leave it out, or give "
                "--scheduler an address or a batch system."
            )
        if isinstance(found, Address):
            import_extra("distributed", "cluster", OPTION)
        if self.dashboard and isinstance(found, Cluster):
            import_extra("bokeh", "dashboard", "--dashboard")
        return found

    def _resolved(self) -> Address | Cluster | str:
        wanted = (self.scheduler or "").strip()
        if wanted.lower() in QUEUES or (not wanted and self.cluster_file is not None):
            return self._cluster(wanted.lower())
        if self.cluster_file is not None:
            raise SpecError(
                f"--cluster {self.cluster_file}: says what a job of a batch system is, and --scheduler "
                f"{wanted} asks for none; leave one of them out, or give "
                f"{' or '.join(f'--scheduler={kind}' for kind in QUEUES)}."
            )
        if wanted.lower() in (THREADS, PROCESSES, IN_PROCESS):
            return wanted.lower()
        if wanted:
            return read_address(wanted, OPTION)
        inherited = os.environ.get(ADDRESS, "").strip()
        return read_address(inherited, ADDRESS) if inherited else THREADS

    def _cluster(self, kind: str) -> Cluster:
        file = self.cluster_file or os.environ.get(CLUSTER_FILE)
        if not file:
            raise SpecError(
                f"--scheduler {kind}: what is a job? Say it in a file with a [cluster] table and give "
                f"--cluster FILE, or set {CLUSTER_FILE}; docs/clusters.md has an example."
            )
        cluster = load_cluster(file)
        if kind and cluster.kind != kind:
            raise SpecError(
                f"--scheduler {kind}: {file} describes jobs of {cluster.kind}; leave --scheduler out, or "
                "give another file."
            )
        check_means(cluster)
        return cluster


def reach(where: Where) -> None:
    """Check within seconds that the chosen dask scheduler answers; do nothing if none was chosen."""
    target = where.resolved()
    if isinstance(target, Address):
        ask(target)


@contextlib.contextmanager
def connected(where: Where, echo: Echo = print) -> Iterator[Any]:
    """Yield a dask client when it has workers that have the same software and see the run directory.

    Raise `SpecError` or `SchedulerError` if there are no such workers, before anything is computed.
    """
    import dask
    import distributed  # noqa: F401  its defaults come with it, and would go with a setting made before them

    target = where.resolved()
    with contextlib.ExitStack() as stack:
        stack.enter_context(_without_tracebacks())
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": ALLOWED_FAILURES}))
        if isinstance(target, Address):
            ask(target)
            client = stack.enter_context(_client(target.url, security_of(target)))
            _wait(client, target.named, _patience(), echo)
        else:
            assert isinstance(target, Cluster)
            folder = jobs_folder(where.place or "magpend")
            jobs = stack.enter_context(job_cluster(target, folder, dashboard=where.dashboard, echo=echo))
            client = stack.enter_context(_client(jobs, None))
            _wait(client, f"jobs of {target.kind}", target.wait_s, echo)
        if where.dashboard:
            echo(f"dashboard: {client.dashboard_link}")
        _check(client, where.place)
        yield client


@contextlib.contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Keep dask's client from logging; what it logs of a lost scheduler also comes as an error of ours."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _client(scheduler: Any, security: Any) -> Any:
    from distributed import Client

    keys = {} if security is None else {"security": security}
    return Client(scheduler, set_as_default=False, timeout=_CONNECT_S, **keys)  # type: ignore[no-untyped-call]


def _patience() -> int:
    """Return the longest wait for the workers of an existing scheduler [s]."""
    text = os.environ.get(WAIT) or WAIT_FOR_WORKERS
    try:
        return seconds_of(text)
    except ValueError as error:
        raise SpecError(f"{WAIT} = {error}") from None


def _wait(client: Any, name: str, patience_s: int, echo: Echo) -> None:
    """Wait for the first worker of a scheduler, and print a line now and then."""
    started = said = time.monotonic()
    first = True
    while not _workers(client):
        now = time.monotonic()
        if now - started > patience_s:
            raise SchedulerError(
                f"{name}: no worker came within {clock(patience_s)}, so nothing was computed; start workers "
                "(dask worker ADDRESS), look at what the jobs say, or wait longer (docs/clusters.md)."
            )
        if first or now - said >= _SAY_EVERY_S:
            so_far = "" if first else f", {now - started:.0f} s so far"
            echo(f"{name}: no workers yet; waiting up to {clock(patience_s)}{so_far}")
            first, said = False, now
        time.sleep(0.2)


def _workers(client: Any) -> list[str]:
    return list(client.scheduler_info(n_workers=-1)["workers"])


def _check(client: Any, place: str | None) -> None:
    workers = _workers(client)
    check_versions(client, workers)
    if place is not None:
        check_directory(client, workers, place)
