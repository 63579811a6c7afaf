"""Dask workers that die, stop, hang and fail, with tasks made for it."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import threading
import time
from functools import partial

import pytest

from pipeline.compute import dispatch, limits
from pipeline.compute.addresses import SchedulerError
from pipeline.compute.execute import run_tasks
from pipeline.compute.limits import Limits
from pipeline.compute.order import TaskFailedError
from pipeline.runs import blocks
from pipeline.runs.derive import AnalysedRun, derive
from tests.pipeline.runs.test_blocks import MAP as BLOCKS


def one_second(index):
    return 1.0


@pytest.mark.slow
def test_workers__poison_kills_them_and_the_others_finish(faulty, scheduler, tmp_path):
    """A worker that dies takes nothing along; who killed it is found out when it is tried alone."""
    task = partial(faulty.deadly, str(tmp_path), poison=(3,), unlucky=(1,))
    found = []
    results = run_tasks(task, range(8), seconds=one_second, scheduler=scheduler(allowed_failures=1))
    with pytest.raises(TaskFailedError, match=r"^task 3: its worker died 2 times \(out of memory") as failed:
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 1, 2, 4, 5, 6, 7]
    assert list(failed.value.failed) == [3]
    assert 2 <= faulty.tries(tmp_path)[3] <= 4


@pytest.mark.slow
def test_workers__one_that_dies_with_a_result_that_was_not_fetched_yet(faulty, scheduler, tmp_path, monkeypatch):
    """The task is computed again: nobody takes the scheduler for gone."""
    outcome, states = dispatch._outcome, []

    async def late(client, future):
        if not states:
            states.append("finished")
            await reached(lambda: future.status == "finished")
            (holder,) = (await client.scheduler.who_has(keys=[future.key]))[future.key]
            os.kill((await client._run(os.getpid))[holder], signal.SIGKILL)
            await reached(lambda: future.status != "finished")
            states[0] = future.status
        return await outcome(client, future)

    async def reached(true):
        until = time.monotonic() + 120
        while not true() and time.monotonic() < until:
            await asyncio.sleep(0.01)

    monkeypatch.setattr(dispatch, "_outcome", late)
    task = partial(faulty.raising, str(tmp_path))
    found = [result["task"] for result in run_tasks(task, range(6), seconds=one_second, scheduler=scheduler())]
    assert sorted(found) == list(range(6))
    assert states != ["finished"]


@pytest.mark.slow
def test_workers__one_that_is_stopped(faulty, scheduler, tmp_path):
    """SIGSTOP: it falls silent, the scheduler restarts it, and its task is done by another."""
    task = partial(faulty.hanging, str(tmp_path), number=signal.SIGSTOP, unlucky=(2,))
    results = run_tasks(task, range(6), seconds=one_second, scheduler=scheduler(worker_ttl="6s"))
    assert sorted(r["task"] for r in results) == list(range(6))
    assert faulty.tries(tmp_path)[2] == 2


@pytest.mark.slow
def test_workers__tasks_that_hang(faulty, scheduler, tmp_path, monkeypatch):
    """A living worker that is busy for ever: the task is given up there and done elsewhere, or reported."""
    # tasks that do not hang have all the time that a busy machine takes for them
    hangs = {2: 1, 4: 100}
    limit = lambda self, index, tries: 1.5 if tries <= hangs.get(index, 0) else 600.0  # noqa: E731
    monkeypatch.setattr(limits.Limits, "limit_s", limit)
    task = partial(faulty.hanging, str(tmp_path), unlucky=(2,), poison=(4,))
    lines, found = [], []
    results = run_tasks(task, range(6), seconds=lambda i: 0.05, scheduler=scheduler(), echo=lines.append)
    with pytest.raises(TaskFailedError, match=r"^task 4: not done after \d+ s, far more than estimated"):
        found.extend(r["task"] for r in results)
    assert sorted(found) == [0, 1, 2, 3, 5]
    assert [line.split(":")[0] for line in lines if "far more" in line].count("task 4") == 3
    assert faulty.tries(tmp_path)[2] == 2


@pytest.mark.slow
def test_workers__a_blocked_callback_of_another_client_holds_up_nobody(faulty, scheduler, tmp_path):
    from distributed import Client

    task, address, free = partial(faulty.raising, str(tmp_path)), scheduler(1), threading.Event()
    with Client(address, set_as_default=False) as client:
        client.submit(abs, -1).add_done_callback(lambda future: free.wait())
        try:
            assert len(list(run_tasks(task, range(3), seconds=one_second, scheduler=address))) == 3
        finally:
            free.set()


@pytest.mark.slow
def test_workers__scheduler_dies(faulty, processes, scheduler_file, worker, tmp_path):
    """A scheduler that is killed: an error in one sentence, soon."""
    (tmp_path / "log").mkdir()
    worker()
    results = run_tasks(partial(faulty.slow, str(tmp_path / "log")), range(1000), scheduler=str(scheduler_file))
    next(results)
    processes.started[0].kill()
    with pytest.raises(SchedulerError, match=r"is gone\. Committed results stay"):
        list(results)


def test_limits__learn_from_what_finished():
    found = Limits(lambda i: 20.0)
    assert found.limit_s(0, 1) == 200
    assert found.limit_s(0, 2) == 400
    found.finished(0, 100.0)
    found.finished(1, 10.0)
    assert found.limit_s(2, 1) == 1000
    assert Limits(lambda i: 0.1).limit_s(0, 1) == limits.LEAST_S
    assert Limits(None).limit_s(0, 1) == float("inf")


@pytest.mark.slow
def test_workers__analyse_blocks_of_a_run_to_the_same_bytes(computed, scheduler, tmp_path, monkeypatch):
    whole = shutil.copytree(computed(BLOCKS), tmp_path / "whole")
    derive(whole, "attractors", workers=0)
    monkeypatch.setattr(blocks, "FEWEST_CELLS", 24)
    run = shutil.copytree(computed(BLOCKS), tmp_path / "run")
    assert len(blocks.blocks_of(AnalysedRun.of(run))) == 4
    derive(run, "attractors", scheduler=scheduler())
    for name in ("identified", "attractors"):
        own, other = (
            {p.relative_to(place): p.read_bytes() for p in place.rglob("*") if p.is_file()}
            for place in (next((one / "derived").glob(f"{name}-*.zarr")) for one in (run, whole))
        )
        assert own == other
