"""Many small tasks: memory and file handles stay where they are.

150 tasks as part of the suite; ``MAGPEND_LONG=1`` takes 10,000.
"""

from __future__ import annotations

import os
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from pipeline.runs import run as runs
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from tests.pipeline.factories import duffing

pytestmark = pytest.mark.slow

N_TASKS = 10_000 if os.environ.get("MAGPEND_LONG") == "1" else 150
KILOBYTES_PER_TASK = 10 if N_TASKS > 1000 else 40
"""What a process may grow by; over few tasks, what it takes in once weighs more."""
HANDLES = 4

AXES = f"frequency_hz = {{ start = 0.15, stop = 0.25, num = {N_TASKS} }}"
SPEC = duffing(AXES, 'kind = "grid"\nx = 0.5\nv = 0.1', execution="trajectories_per_task = 1")


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
    runs.run(write_spec(SPEC), tmp_path / "run", **where, echo=lambda line: None)
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
