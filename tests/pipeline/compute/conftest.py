"""Tasks that go wrong; schedulers and workers of dask as processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pipeline.factories import LOOPBACK, wait_for

QUIET = ("--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0")
"""Options of dask's commands."""


@pytest.fixture
def faulty(monkeypatch):
    """The tasks, from a folder that processes and workers find."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import faulty

    yield faulty
    sys.modules.pop("faulty", None)


@pytest.fixture
def scheduler(faulty):
    """Start a dask scheduler with two workers and some settings; returns its address."""
    import dask
    from distributed import LocalCluster

    with contextlib.ExitStack() as stack:

        def begin(n_workers=2, **settings):
            names = {name.replace("_", "-"): value for name, value in settings.items()}
            stack.enter_context(dask.config.set({f"distributed.scheduler.{n}": v for n, v in names.items()}))
            cluster = LocalCluster(n_workers=n_workers, threads_per_worker=1, silence_logs=60, **LOOPBACK)
            return stack.enter_context(cluster).scheduler_address

        yield begin


@pytest.fixture
def processes(tmp_path, environment):
    """Starts processes; all are gone at the end."""
    started = []
    path = os.pathsep.join([str(Path(__file__).parent), environment["PYTHONPATH"]])

    def begin(*words, before=(), **variables):
        log = (tmp_path / f"process-{len(started)}.log").open("wb")
        process = subprocess.Popen(
            [*before, sys.executable, "-m", *map(str, words)],
            cwd=tmp_path,
            env={**environment, "PYTHONPATH": path, **variables},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        log.close()
        started.append(process)
        return process

    begin.started = started
    yield begin
    for process in started:
        end(process)


def end(process):
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.fixture
def scheduler_file(tmp_path, processes):
    path = tmp_path / "scheduler.json"
    processes("distributed.cli.dask_scheduler", *QUIET, "--port", "0", "--scheduler-file", path)
    wait_for(lambda: path.exists() and "address" in json.loads(path.read_text() or "{}"))
    return path


@pytest.fixture
def worker(processes, scheduler_file, tmp_path):
    own = ("--scheduler-file", scheduler_file, "--nthreads", "1", "--local-directory", tmp_path / "scratch")

    def begin(**options):
        return processes("distributed.cli.dask_worker", *QUIET, *own, **options)

    return begin
