"""Tasks: their order; threads and processes of this machine, and dask's workers, that fail, die, stop and hang."""

from __future__ import annotations

import asyncio
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import psutil
import pytest

from pipeline.compute import dispatch
from pipeline.compute import order as ordering
from pipeline.compute.addresses import SchedulerError
from pipeline.compute.dispatch import Limits
from pipeline.compute.execute import run_tasks
from pipeline.compute.order import Order, TaskFailedError
from pipeline.compute.processes import Processes
from pipeline.compute.threads import in_threads, writing_results
from pipeline.runs import blocks
from pipeline.runs.derive import AnalysedRun, derive
from tests.pipeline.factories import wait_for
from tests.pipeline.runs.test_blocks import MAP as BLOCKS


@pytest.mark.slow
@pytest.mark.parametrize("place", ["none", "threads", "processes", "dask"])
def test_run_tasks__order_failures_and_a_second_try(faulty, tmp_path, scheduler, place):
    task = partial(faulty.raising, str(tmp_path), poison=(5,), unlucky=(2,))
    found, where = [], scheduler() if place == "dask" else place
    results = run_tasks(task, range(12), after=lambda i: i - 1 if i % 4 else None, workers=2, scheduler=where)
    with pytest.raises(TaskFailedError, match=r"^task 5: .*RuntimeError: out of luck; 2 tasks that come after"):
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 1, 2, 3, 4, 8, 9, 10, 11]
    assert all(found.index(i) > found.index(i - 1) for i in found if i % 4)
    assert faulty.tries(tmp_path) == {0: 1, 1: 1, 2: 2, 3: 1, 4: 1, 5: 2, 8: 1, 9: 1, 10: 1, 11: 1}


def test_threads__two_at_a_time_and_failed_ones_alone():
    running, most, alone = set(), [], []
    both = threading.Barrier(2, timeout=60)

    def task(index):
        running.add(index)
        most.append(len(running))
        try:
            if not alone or index != 3:
                both.wait()  # there are eight: each has another beside it at its first try
            if index == 3:
                alone.append(len(running))
                raise ValueError("no")
        finally:
            running.discard(index)
        return {"task": index}

    with pytest.raises(TaskFailedError, match=r"^task 3: ValueError: no"):
        list(run_tasks(task, range(8), workers=2))
    assert max(most) == 2
    assert len(alone) == 2
    assert alone[1] == 1


@pytest.mark.parametrize("n_started", range(5))
def test_threads__that_do_not_start_are_an_error_and_no_wait(monkeypatch, n_started):
    """The system refuses a thread (``ulimit -u``): the run must not wait for what nobody computes."""
    start, left, ended, begin = threading.Thread.start, [n_started], [], threading.Event()

    def refused(thread):
        left[0] -= 1
        if left[0] < 0:
            raise RuntimeError("can't start new thread")
        start(thread)

    def work():
        assert begin.wait(60)
        try:
            ended.extend(run_tasks(lambda index: {"task": index}, range(4), workers=3))
        except SchedulerError as error:
            ended.append(error)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    monkeypatch.setattr(threading.Thread, "start", refused)
    begin.set()
    worker.join(20)
    assert "3 threads could not be started here (RuntimeError: can't start new thread)" in str(ended[-1])
    assert "--workers; 0 needs no thread" in str(ended[-1])


# ---- the end of a run, with tasks still running --------------------------------------------------------


def test_threads__tasks_that_go_on_after_the_end_write_nothing():
    """As after an interrupt in a notebook: the kernel goes on, and the directory belongs to others."""
    free, begun, tried, written = threading.Event(), threading.Event(), threading.Event(), []
    number = itertools.count()

    def task(index):
        if next(number):
            begun.set()
            free.wait(60)
            try:
                with writing_results():
                    written.append(index)
            finally:
                tried.set()
        return {"task": index}

    results = in_threads(task, range(9), None, Order(range(9)), 2)
    next(results)
    assert begun.wait(60)
    results.close()
    free.set()
    assert tried.wait(60)
    time.sleep(0.1)
    assert written == []


@pytest.mark.slow
def test_threads__end_waits_for_what_is_being_written():
    begun, written, number = threading.Event(), [], itertools.count()

    def task(index):
        if next(number):
            with writing_results():
                begun.set()
                time.sleep(0.3)
                written.append(index)
        return {"task": index}

    results = in_threads(task, [1, 0], None, Order([1, 0]), 2)
    next(results)
    assert begun.wait(60)
    results.close()
    assert len(written) == 1


# ---- processes -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_processes__poison_kills_them_and_the_others_finish(faulty, tmp_path):
    task = partial(faulty.deadly, str(tmp_path), poison=(3,), unlucky=(1,))
    found, before = [], set(psutil.Process().children())
    results = run_tasks(task, range(8), workers=2, scheduler="processes")
    with pytest.raises(TaskFailedError, match=r"^task 3: ProcessError: its process died \(out of memory, or killed\)"):
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 1, 2, 4, 5, 6, 7]
    assert faulty.tries(tmp_path)[3] == 2
    assert set(psutil.Process().children()) == before


@pytest.fixture
def asleep(faulty, tmp_path):
    """A process in the middle of a task of ten minutes."""
    processes = Processes(partial(faulty.slow, str(tmp_path), seconds=600))

    def call():
        with pytest.raises(Exception, match="its process died"):
            processes(0)

    thread = threading.Thread(target=call)
    thread.start()
    wait_for(lambda: faulty.tries(tmp_path))
    yield processes, processes._started[0]
    processes.close()
    thread.join()


@pytest.mark.slow
def test_processes__end_with_the_process_that_started_them(asleep):
    """Its end of the pipe closes with it, however it ended."""
    _, child = asleep
    child.stdin.close()
    assert child.wait(60) == 0


@pytest.mark.slow
def test_processes__are_not_waited_for(asleep):
    processes, child = asleep
    assert os.getpgid(child.pid) != os.getpgid(0)  # the terminal sends Ctrl-C to this group alone
    processes.close()
    assert child.returncode == -signal.SIGKILL
    with pytest.raises(Exception, match="the run has ended"):
        processes(1)


@pytest.mark.slow
def test_run_tasks__loads_no_distributed(environment):
    code = (
        "import sys; from pipeline.compute.execute import run_tasks; "
        "assert len(list(run_tasks(lambda i: {'task': i}, range(3), workers=2))) == 3; "
        "assert 'distributed' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


# ---- which task comes next -------------------------------------------------------------------------------


def drained(order):
    found = []
    while (index := order.take()) is not None:
        found.append(index)
        order.done(index)
    return found


def in_steps_of(n):
    return lambda i: i - 1 if i % n else None


def test_order__long_chains_first_and_never_before_their_predecessor():
    order = Order(range(12), in_steps_of(4))
    assert [order.take() for _ in range(4)] == [0, 4, 8, None]
    order.done(4)
    assert order.take() == 5
    found = drained(Order([0, 5, 6, 7, 10, 11], in_steps_of(4)))  # 4, 8 and 9 are done already
    assert found == [5, 6, 10, 0, 7, 11]


def test_order__circle():
    with pytest.raises(ValueError, match="3 tasks wait for one another"):
        Order(range(3), lambda i: (i + 1) % 3)


@pytest.mark.slow
def test_order__many_tasks():
    started = time.process_time()
    found = drained(Order(range(100_000), in_steps_of(100)))
    assert time.process_time() - started < 60  # each task alone by a search through all: an hour
    assert sorted(found) == list(range(100_000))


def test_order__failed_ones_again_at_the_end():
    order = Order(range(4), in_steps_of(2))
    assert [order.take(), order.take()] == [0, 2]
    order.failed(0, "bad")
    order.done(2)
    assert [order.take(), order.take()] == [3, None]
    order.done(3)
    assert [order.take_failed(), order.take_failed()] == [0, None]
    order.failed(0, "worse")
    assert order.take_failed() is None
    with pytest.raises(TaskFailedError, match=r"^task 0: worse; 1 tasks that come after were not begun"):
        order.close()
    order.done(0)
    assert order.take() == 1
    order.done(1)
    order.close()


def test_order__gives_up_where_all_fail():
    order = Order(range(100))
    for index in range(ordering.MOST_IN_A_ROW - 1):
        order.failed(index, "full")
    with pytest.raises(TaskFailedError, match=r"task 0: full.* Given up: so many tasks fail"):
        order.failed(99, "full")


def test_order__gives_up_where_many_fail():
    order = Order(range(1000))
    for index in range(0, 2 * ordering.MOST_FAILED - 2, 2):
        order.failed(index, "bad")
        order.done(index + 1)
    with pytest.raises(TaskFailedError, match="and 54 more tasks"):
        order.failed(999, "bad")


# ---- workers of dask -------------------------------------------------------------------------------------


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
    monkeypatch.setattr(Limits, "limit_s", limit)
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
def test_workers__scheduler_dies(faulty, processes, scheduler_file, worker, tmp_path, capfd):
    """A scheduler that is killed: an error in one sentence, soon, and none of dask's own beside it."""
    (tmp_path / "log").mkdir()
    worker()
    results = run_tasks(partial(faulty.slow, str(tmp_path / "log")), range(1000), scheduler=str(scheduler_file))
    next(results)
    capfd.readouterr()
    processes.started[0].kill()
    with pytest.raises(SchedulerError, match=r"is gone\. Committed results stay"):
        list(results)
    assert "Traceback" not in capfd.readouterr().err


def test_limits__learn_from_what_finished():
    found = Limits(lambda i: 20.0)
    assert found.limit_s(0, 1) == 200
    assert found.limit_s(0, 2) == 400
    found.finished(0, 100.0)
    found.finished(1, 10.0)
    assert found.limit_s(2, 1) == 1000
    assert Limits(lambda i: 0.1).limit_s(0, 1) == dispatch.LEAST_S
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
