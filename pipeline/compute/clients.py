"""Choose where tasks run, and connect to dask: jobs of a batch system, or an existing scheduler."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.compute.addresses import OPTION, Address, SchedulerError, ask, read_address, security_of
from pipeline.compute.jobqueue import check_means, job_cluster, jobs_folder
from pipeline.compute.probe import check_directory, check_versions
from pipeline.specification.clusters import QUEUES, Cluster, clock, load_cluster, seconds_of
from pipeline.specification.problems import SpecError, import_extra

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
    """Choice of where tasks run: in threads or processes of this machine, on a dask scheduler or as batch jobs.

    Attributes
    ----------
    scheduler : str, optional
        ``threads`` or ``processes`` of this machine, ``none`` for the calling thread, a scheduler's address or
        JSON file, or the name of a batch system. By default ``DASK_SCHEDULER_ADDRESS``, else ``threads``.
    cluster_file : Path, optional
        File with the ``[cluster]`` table of a batch system; by default the value of ``MAGPEND_CLUSTER``.
    dashboard : bool
        Whether to serve dask's dashboard on loopback, and print its address; not for places on this machine.
    place : str, optional
        Place of the run directory, which all workers must see (`open_files`).
    """

    scheduler: str | None = None
    cluster_file: Path | None = None
    dashboard: bool = False
    place: str | None = None

    @classmethod
    def of(cls, scheduler: Where | str | None) -> Where:
        """Convert the name or address of a scheduler to a `Where`; return a `Where` unchanged."""
        return scheduler if isinstance(scheduler, Where) else cls(scheduler)

    def resolved(self) -> Address | Cluster | str:
        """Decide where tasks run, without starting anything: an address, a batch system's settings, or a place on this
        machine.

        Raises
        ------
        SpecError
            If the statement is invalid, or not available here.
        """
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
    """Check within seconds that the chosen dask scheduler answers; do nothing if none was chosen.

    Raises
    ------
    SpecError, SchedulerError
        If the place is invalid or no scheduler answers; the message gives the remedy.
    """
    target = where.resolved()
    if isinstance(target, Address):
        ask(target)


@contextlib.contextmanager
def connected(where: Where, echo: Echo = print) -> Iterator[Any]:
    """Yield a dask client when it has workers that have the same software and see the run directory.

    Parameters
    ----------
    where
        Choice of where tasks run: a dask scheduler or a batch system.
    echo
        Function that prints a line.

    Raises
    ------
    SpecError, SchedulerError
        If there are no such workers, before anything is computed.
    """
    import dask
    import distributed  # noqa: F401  its defaults come with it, and would go with a setting made before them

    target = where.resolved()
    with contextlib.ExitStack() as stack:
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
