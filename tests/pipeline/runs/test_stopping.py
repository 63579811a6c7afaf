"""Signals at every stage of a command: one message, nothing left behind, nobody left running."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.slow

SPEC = """
kind = "sweep"
model = "duffing"
[axes]
frequency_hz = { start = 0.1, stop = 0.3, num = 8 }
[initial_conditions]
kind = "random"
n = 64
x = [-1, 1]
[integration]
n_transient = 300
n_keep = 4
[execution]
trajectories_per_task = 16
"""
LONG = SPEC.replace("n_transient = 300", "n_transient = 3_000_000")
PROMPT_S = 2.0 if os.environ.get("MAGPEND_LONG") == "1" else 20.0
"""Two seconds on a machine that does nothing else; other tests may run beside this one."""


def heed_signals():
    """What runs the tests may ignore them, as `nohup` does, and processes inherit that."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def begin(tmp_path):
    """Begin the run in a session and a folder for temporary files of its own."""
    (tmp_path / "spec.toml").write_text(SPEC)
    (tmp_path / "long.toml").write_text(LONG)
    (tmp_path / "temporary").mkdir()
    begun = []

    def begin(spec="spec.toml", *options):
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline.cli.main", "run", spec, "--out", "run", "--workers", "2", *options],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=heed_signals,
            env=dict(os.environ, TMPDIR=str(tmp_path / "temporary")),
        )
        begun.append(process)
        return process

    yield begin
    for process in begun:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_for(process, found):
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None:
        if found():
            return
        time.sleep(0.005)
    raise AssertionError((process.poll(), process.communicate()))


def ended(process, folder, code):
    """What it said; that it ended with this code, and left nothing."""
    running = psutil.Process(process.pid).children(recursive=True)
    out, err = process.communicate(timeout=200)
    assert process.returncode == code, (out, err)
    for sign in ("Traceback", "leaked", "Error", "distributed"):
        assert sign not in err, err
    assert err.count("magpend: ") == 1, err
    assert psutil.wait_procs(running, timeout=100)[1] == []
    assert list((folder / "temporary").rglob("*")) == []
    return err


def test_stopping__while_it_loads(begin, tmp_path):
    process = begin()
    maps = Path(f"/proc/{process.pid}/maps")
    wait_for(process, lambda: b"numpy" in maps.read_bytes())
    os.killpg(process.pid, signal.SIGINT)
    ended(process, tmp_path, 130)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("scheduler", "number"),
    [("threads", signal.SIGHUP), ("threads", signal.SIGINT), ("threads", signal.SIGTERM), ("processes", signal.SIGINT)],
)
def test_stopping__beside_running_kernels(begin, tmp_path, scheduler, number):
    """The tasks take minutes, and the command ends in less than two seconds, and frees the directory."""
    process = begin("long.toml", "--scheduler", scheduler)
    own = psutil.Process(process.pid)
    commits = tmp_path / "run" / "commits"
    wait_for(process, lambda: commits.is_dir() and busy(own) > 1.0)
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
    wait_for(process, lambda: len(list((tmp_path / "run" / "commits").glob("*.json"))) > 1)
    os.killpg(process.pid, signal.SIGINT)
    os.killpg(process.pid, signal.SIGINT)
    ended(process, tmp_path, 130)
