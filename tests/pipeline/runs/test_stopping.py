"""Signals at every stage of a command, and many small tasks: nothing left behind, nobody left running."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from pipeline.runs import run as runs
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
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


# ---- many small tasks: memory and file handles stay where they are ---------------------------------------


N_TASKS = 10_000 if os.environ.get("MAGPEND_LONG") == "1" else 150
KILOBYTES_PER_TASK = 10 if N_TASKS > 1000 else 40
"""What a process may grow by; over few tasks, what it takes in once weighs more."""
HANDLES = 4

AXES = f"frequency_hz = {{ start = 0.15, stop = 0.25, num = {N_TASKS} }}"
MANY_TASKS = duffing(AXES, 'kind = "grid"\nx = 0.5\nv = 0.1', execution="trajectories_per_task = 1")


class Watch:
    """Memory and open files of this process and its children, every so many tasks."""

    def __init__(self) -> None:
        self.n = 0
        self.seen: dict[int, list[SimpleNamespace]] = {}

    def look(self) -> None:
        self.n += 1
        if self.n % (N_TASKS // 30):
            return
        own = psutil.Process()
        for process in (own, *own.children(recursive=True)):
            try:
                sample = SimpleNamespace(n=self.n, rss=process.memory_info().rss, handles=process.num_fds())
            except psutil.Error:  # one that has just ended
                continue
            self.seen.setdefault(process.pid, []).append(sample)


def test_run__many_small_tasks_in_flat_memory(write_spec, tmp_path, monkeypatch):
    watch = Watch()
    original = runs.log_timing
    monkeypatch.setattr(runs, "log_timing", lambda *arguments: watch.look() or original(*arguments))
    where = {"workers": 1, "scheduler": "processes"}
    runs.run(write_spec(MANY_TASKS), tmp_path / "run", **where, echo=lambda line: None)
    assert state(tmp_path / "run").complete
    found = verify_run(tmp_path / "run")
    assert (found.sound, found.leftovers) == (True, [])
    assert len(list((tmp_path / "run/commits").iterdir())) == N_TASKS // 1000 + N_TASKS % 1000
    long_lived = [samples for samples in watch.seen.values() if len(samples) > 25]
    assert len(long_lived) >= 2  # this process and its child at least
    for samples in long_lived:
        later = samples[len(samples) // 3 :]
        n = later[-1].n - later[0].n
        first, last = (np.median([s.rss for s in part]) for part in (later[:5], later[-5:]))
        assert (last - first) / n < KILOBYTES_PER_TASK * 1024
        assert max(s.handles for s in later[-5:]) <= max(s.handles for s in later[:5]) + HANDLES
