"""Threads and processes of this machine: tasks that fail, die, and go on after their run has ended."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import psutil
import pytest

from pipeline.compute.execute import run_tasks
from pipeline.compute.order import Order, TaskFailedError
from pipeline.compute.processes import Processes
from pipeline.compute.threads import in_threads, writing_results
from tests.pipeline.factories import wait_for


@pytest.mark.slow
@pytest.mark.parametrize("place", ["threads", "processes", "dask"])
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
