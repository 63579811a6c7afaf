"""Signals at every stage of a command: one message, nothing left behind, nobody left running."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

import psutil
import pytest

from tests.pipeline.factories import duffing, n_committed, wait_for

pytestmark = pytest.mark.slow

SPEC = duffing(
    "frequency_hz = { start = 0.1, stop = 0.3, num = 8 }",
    'kind = "random"\nn = 64\nx = [-1, 1]',
    n_transient=300,
    n_keep=4,
    execution="trajectories_per_task = 16",
)
PROMPT_S = 2.0 if os.environ.get("MAGPEND_LONG") == "1" else 20.0
"""Two seconds on a machine that does nothing else; other tests may run beside this one."""


@pytest.fixture
def begin(start, write_spec):
    """Begin a run whose tasks take seconds, or minutes."""

    def call(n_transient=300, scheduler="threads"):
        path = write_spec(SPEC.replace("n_transient = 300", f"n_transient = {n_transient}"))
        return start("run", path, "--out", "run", "--workers", 2, "--scheduler", scheduler)

    return call


def ended(process, folder, code):
    """What it said; that it ended with this code, and left nothing."""
    running = psutil.Process(process.pid).children(recursive=True)
    out, err = process.communicate(timeout=200)
    assert process.returncode == code, (out, err)
    for sign in ("Traceback", "leaked", "Error", "distributed"):
        assert sign not in err, err
    assert err.count("magpend: ") == 1, err
    assert psutil.wait_procs(running, timeout=100)[1] == []
    assert list((folder / "scratch").rglob("*")) == []
    return err


def test_stopping__while_it_loads(begin, tmp_path):
    process = begin()
    maps = Path(f"/proc/{process.pid}/maps")
    wait_for(lambda: b"numpy" in maps.read_bytes(), process)
    os.killpg(process.pid, signal.SIGINT)
    ended(process, tmp_path, 130)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("scheduler", "number"),
    [("threads", signal.SIGHUP), ("threads", signal.SIGINT), ("threads", signal.SIGTERM), ("processes", signal.SIGINT)],
)
def test_stopping__beside_running_kernels(begin, tmp_path, scheduler, number):
    """The tasks take minutes, and the command ends in less than two seconds, and frees the directory."""
    process = begin(3_000_000, scheduler)
    own = psutil.Process(process.pid)
    commits = tmp_path / "run" / "commits"
    wait_for(lambda: commits.is_dir() and busy(own) > 1.0, process)
    started = time.monotonic()
    os.killpg(process.pid, number)
    err = ended(process, tmp_path, 128 + number)
    assert time.monotonic() - started < PROMPT_S
    assert "the same command continues" in err
    assert list(commits.iterdir()) == []
    assert not (tmp_path / "run" / "lock.json").exists()


def busy(process):
    """Processor time of kernels: of the children, or of all threads but the first one [s]."""
    times = [t.user_time for t in process.threads() if t.id != process.pid]
    for child in process.children():
        with contextlib.suppress(psutil.NoSuchProcess):
            times.append(child.cpu_times().user)
    return sum(times)


def test_stopping__twice(begin, tmp_path):
    process = begin()
    wait_for(lambda: n_committed(tmp_path / "run") > 1, process)
    os.killpg(process.pid, signal.SIGINT)
    os.killpg(process.pid, signal.SIGINT)
    ended(process, tmp_path, 130)
