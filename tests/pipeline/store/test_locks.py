"""Two coordinators in one directory: the second is told who the first is, and without locks both end well."""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import subprocess
import sys
import time

import pytest

from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.store.errors import LockedError
from pipeline.store.local import writer_lock
from tests.pipeline.factories import duffing, quietly

pytestmark = pytest.mark.slow

SPEC = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 20 }",
    'kind = "grid"\nx = 0.5\nv = 0.1',
    execution="trajectories_per_task = 1",
)

WITHOUT_LOCKS = """
import sys, time, warnings
import filelock
from pipeline.runs.run import run
def broken(self, *arguments, **options):
    raise NotImplementedError("no locks here")
filelock.FileLock.acquire = broken
warnings.simplefilter("ignore")
spec, out, start = sys.argv[1:]
while time.time() < float(start):
    time.sleep(0.01)
assert run(spec, out, workers=0, echo=lambda line: None).complete
"""


def _hold(directory, ready, done):
    with writer_lock(directory):
        ready.set()
        done.wait(60)


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock of a directory."""
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(tmp_path, ready, done))
    process.start()
    assert ready.wait(60)
    yield process
    process.kill()
    process.join()


def test_writer_lock__names_its_holder_and_frees_a_killed_one(holder, tmp_path):
    with pytest.raises(LockedError) as caught, writer_lock(tmp_path):
        pass
    said = str(caught.value)
    assert f"(process {holder.pid} on {platform.node()} since 20" in said
    assert "Wait for it or stop it" in said
    holder.kill()
    holder.join()
    with writer_lock(tmp_path) as alone:  # at once: it waits for nobody
        assert alone
        assert json.loads((tmp_path / "lock.json").read_text())["pid"] == os.getpid()
    assert not (tmp_path / "lock.json").exists()


def test_writer_lock__holder_unknown(holder, tmp_path):
    for text in ("", "{", '{"pid": "x"}', "[]"):
        (tmp_path / "lock.json").write_text(text)
        with pytest.raises(LockedError, match=r"is writing here\. Wait"), writer_lock(tmp_path):
            pass


def test_run__two_without_locks_end_with_the_same_bytes(write_spec, tmp_path, environment, bytes_of):
    spec = write_spec(SPEC)
    quietly(spec, tmp_path / "alone")
    # once the imports are done, both begin at the same moment
    arguments = [sys.executable, "-c", WITHOUT_LOCKS, str(spec), str(tmp_path / "both"), str(time.time() + 6)]
    both = [subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    errors = [process.communicate(timeout=200)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    assert state(tmp_path / "both").complete
    found = verify_run(tmp_path / "both")
    assert (found.sound, found.leftovers) == (True, [])
    assert bytes_of(tmp_path / "both") == bytes_of(tmp_path / "alone")
