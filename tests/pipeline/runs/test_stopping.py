"""Signals at every stage of a command: one message, nothing left behind, nobody left running."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from pipeline.compute import local

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


def heed_signals():
    """What runs the tests may ignore them, as `nohup` does, and processes inherit that."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def begin(tmp_path):
    """Begin the run in a session and a folder for temporary files of its own."""
    (tmp_path / "spec.toml").write_text(SPEC)
    (tmp_path / "temporary").mkdir()
    begun = []

    def begin():
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline.cli.main", "run", "spec.toml", "--out", "run", "--workers", "2"],
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


def test_stopping__hang_up_while_workers_start(begin, tmp_path):
    process = begin()
    wait_for(process, lambda: list((tmp_path / "temporary").glob(f"{local.PREFIX}*/key.pem")))
    os.killpg(process.pid, signal.SIGHUP)
    assert "the same command continues" in ended(process, tmp_path, 129)


def test_stopping__twice(begin, tmp_path):
    process = begin()
    wait_for(process, lambda: len(list((tmp_path / "run" / "commits").glob("*.json"))) > 1)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    ended(process, tmp_path, 130)


def test_scratch__of_killed_processes_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    killed = tmp_path / f"{local.PREFIX}killed"
    killed.mkdir()
    (killed / "lock").touch()
    (killed / "key.pem").touch()
    with local._scratch() as mine:
        assert [f.name for f in tmp_path.iterdir()] == [mine.name]
        assert mine.stat().st_mode & 0o777 == 0o700
        with local._scratch() as other:
            assert sorted([mine, other]) == sorted(tmp_path.iterdir())
    assert list(tmp_path.iterdir()) == []
