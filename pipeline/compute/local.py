"""Run a dask cluster of processes on this machine, for the duration of a run.

The cluster is protected from other users of the machine. It listens on loopback alone. Every connection uses
TLS with a certificate on both sides, made for this cluster and kept in a folder that only its owner may
enter. Without the key, nobody can submit work or read results. Its HTTP servers answer nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from multiprocessing import resource_tracker, spawn
from pathlib import Path
from typing import Any

from pipeline.compute.addresses import SchedulerError

PREFIX = "magpend-workers-"
WORKER = "Dask Worker process"
"""Beginning of the names that dask gives to worker processes."""

START_S = 180.0
"""Longest wait for the first worker [s]."""

CLOSE_S = 60.0
"""Longest wait for the scheduler to close in order [s]."""

MOST_STARTS = 3
"""Number of times that workers are started if none of them stays."""

LOGGERS = [
    "tornado",
    "distributed",
    *(f"distributed.{part}" for part in ("client", "core", "nanny", "scheduler", "worker")),
]

REMOVALS = 20
"""Most attempts to remove a folder, a tenth of a second apart."""

SETTINGS: dict[str, Any] = {
    # switch off unread logs that grow with tasks and time: profiles, events, system states
    "distributed.worker.profile.enabled": False,
    "distributed.admin.low-level-log-length": 20,
    "distributed.admin.log-length": 100,
    "distributed.admin.system-monitor.log-length": 20,
    "distributed.worker.http.routes": [],
    # results are small: there is nothing to write to disk
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    # on a busy machine a worker may take long to come back
    "distributed.deploy.lost-worker-timeout": "1 hour",
}

NO_PAGES: dict[str, Any] = {"distributed.scheduler.http.routes": []}

_scratch_folders: set[Path] = set()


def memory_per_worker(n_workers: int) -> float:
    """Return the fraction of the machine's memory above which dask restarts a worker."""
    return 1.0 / n_workers


@contextlib.contextmanager
def local_cluster(n_workers: int, *, dashboard: bool = False) -> Iterator[Any]:
    """Yield a dask cluster of processes on this machine, whose connections need TLS keys made for it.

    The first worker has started; others may still be starting. The dashboard shows the computation to
    everyone on this machine.

    Raises
    ------
    SchedulerError
        If no worker starts.
    """
    import dask
    from distributed import LocalCluster

    _start_tracker()
    pages = {} if dashboard else NO_PAGES
    with contextlib.ExitStack() as stack:
        # postpone signals: a cluster that is partly started cannot be closed properly
        with _signals_put_off():
            stack.enter_context(_hushed())
            stack.enter_context(_script_left_alone())
            scratch = stack.enter_context(_scratch())
            settings = {**SETTINGS, **pages, "temporary-directory": str(scratch)}
            stack.enter_context(dask.config.set(settings))
            loop = stack.enter_context(_loop())
            cluster = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=0,
                threads_per_worker=1,
                memory_limit=memory_per_worker(n_workers),
                processes=True,
                host="127.0.0.1",
                protocol="tls",
                security=_security(scratch),
                # The scheduler serves HTTP even without a dashboard: by default at port 8787, with a
                # warning if another run is there.
                scheduler_kwargs={"dashboard": dashboard, "dashboard_address": "127.0.0.1:0"},
                local_directory=str(scratch),
                silence_logs=50,
                loop=loop,
            )
            stack.callback(_close, cluster)
        try:
            _start_workers(cluster, n_workers)
            yield cluster
        except BaseException:
            for nanny in cluster.workers.values():
                nanny.auto_restart = False
            kill_workers()
            raise


def _start_workers(cluster: Any, n_workers: int) -> None:
    """Start workers and wait for the first one. If all of them failed to start, try again: dask does not."""
    end, starts = time.monotonic() + START_S, 1
    given_up: list[Any] = []
    cluster.scale(n_workers)
    while not cluster.scheduler.workers:
        if time.monotonic() > end:
            raise SchedulerError(f"no worker process has started within {START_S:.0f} s.")
        nannies = [nanny for nanny in cluster.workers.values() if nanny not in given_up]
        if nannies and all(nanny.status.name in ("closed", "failed") for nanny in nannies):
            if starts == MOST_STARTS:
                raise SchedulerError(
                    f"worker processes ended as soon as they started, {starts} times; what they printed says why. "
                    "--workers 0 computes without them."
                )
            starts += 1
            given_up += nannies
            cluster.scale(0)
            cluster.scale(n_workers)
        time.sleep(0.02)


def _close(cluster: Any) -> None:
    """Close a cluster; kill its workers if it does not end in time, so that nobody waits for ever."""
    try:
        cluster.close(timeout=CLOSE_S)
    except TimeoutError:
        kill_workers()


@contextlib.contextmanager
def _loop() -> Iterator[Any]:
    """Yield an event loop that runs in a separate thread.

    Ctrl-C goes to every process of the terminal, but only the coordinator should handle it. Workers inherit
    the blocked signals from this thread.
    """
    from distributed.utils import LoopRunner

    with _blocked({signal.SIGINT, signal.SIGHUP}):
        runner = LoopRunner()
        runner.start()  # type: ignore[no-untyped-call]
    try:
        yield runner.loop
    finally:
        runner.stop()  # type: ignore[no-untyped-call]


def _security(scratch: Path) -> Any:
    """Create a TLS key and a certificate for this cluster; every connection needs them at both ends."""
    from distributed import Security

    made = Security.temporary()  # type: ignore[no-untyped-call]
    files = {}
    for name, text in (("certificate", made.tls_ca_file), ("key", made.tls_scheduler_key)):
        files[name] = str(scratch / f"{name}.pem")
        descriptor = os.open(files[name], os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(text)
    certificate, key = files["certificate"], files["key"]
    roles = {f"tls_{r}_cert": certificate for r in ("client", "scheduler", "worker")}
    keys = {f"tls_{r}_key": key for r in ("client", "scheduler", "worker")}
    return Security(  # type: ignore[no-untyped-call]
        require_encryption=True, tls_ca_file=certificate, **roles, **keys
    )


@contextlib.contextmanager
def _scratch() -> Iterator[Path]:
    """Yield a temporary folder of this process. Remove the folders that killed processes left behind."""
    _sweep()
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    _scratch_folders.add(folder)
    try:
        with (folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
    finally:
        _remove(folder)
        _scratch_folders.discard(folder)


def _remove(folder: Path) -> None:
    for _ in range(REMOVALS):
        kill_workers()
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(0.1)


def _sweep() -> None:
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            if status.st_uid != os.getuid() or not folder.is_dir() or folder.is_symlink():
                continue
            with (folder / "lock").open("r") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)


def _start_tracker() -> None:
    """Start the process that removes the semaphores of killed processes, and silence its warnings.

    Its purpose is to remove semaphores, so its warning about them helps nobody. The process must outlive a
    closing terminal, as it outlives Ctrl-C.
    """
    name, before = "PYTHONWARNINGS", os.environ.get("PYTHONWARNINGS")
    quiet = "ignore::UserWarning:multiprocessing.resource_tracker"
    os.environ[name] = f"{before},{quiet}" if before else quiet
    try:
        with _blocked({signal.SIGHUP}):
            resource_tracker.ensure_running()
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


@contextlib.contextmanager
def _script_left_alone() -> Iterator[None]:
    """Start worker processes inside this context without the main module of this process.

    A new process imports it under another name. A script without ``if __name__ == "__main__"`` would begin its
    run again in each worker. Tasks are functions of modules that workers import, and need nothing of a script.
    """
    original = spawn.get_preparation_data

    def prepared(name: str) -> dict[str, Any]:
        data: dict[str, Any] = original(name)
        if name.startswith(WORKER):
            data.pop("init_main_from_path", None)
            data.pop("init_main_from_name", None)
        return data

    spawn.get_preparation_data = prepared
    try:
        yield
    finally:
        spawn.get_preparation_data = original


@contextlib.contextmanager
def _signals_put_off() -> Iterator[None]:
    """Delay SIGINT, SIGTERM and SIGHUP until the end of the context."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are handled by the main thread alone
        return
    caught: list[int] = []
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    before = {number: handler for number, handler in before.items() if callable(handler)}
    for number in before:
        signal.signal(number, lambda number, frame: caught.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for late in caught:
        signal.raise_signal(late)


@contextlib.contextmanager
def _blocked(numbers: set[signal.Signals]) -> Iterator[None]:
    """Block signals for this thread, and for the threads and processes that it starts inside the context."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Silence dask's log messages about connections inside the context, and for good if the code inside raises.

    dask logs some connections only after a cluster has closed.
    """
    loggers = [logging.getLogger(name) for name in LOGGERS]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    yield
    for logger, level in zip(loggers, before, strict=True):
        logger.setLevel(level)


def kill_workers() -> None:
    """Kill the worker processes at once, without waiting for their tasks."""
    for process in multiprocessing.active_children():
        if process.name.startswith(WORKER):
            with contextlib.suppress(ValueError):  # closed meanwhile
                process.kill()


def abandon() -> None:
    """Kill the worker processes and remove their folders, just before this process exits."""
    kill_workers()
    for folder in list(_scratch_folders):
        _remove(folder)
