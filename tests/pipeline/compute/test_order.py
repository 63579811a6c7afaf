"""Which task comes next."""

from __future__ import annotations

import time

import pytest

from pipeline.compute import order as ordering
from pipeline.compute.execute import run_tasks
from pipeline.compute.order import Order, TaskFailedError


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


def test_in_process__order_failures_and_second_try():
    tried = []

    def task(index):
        tried.append(index)
        if index == 5 or (index == 2 and tried.count(2) == 1):
            raise ValueError(f"no\n{index}")
        return {"task": index}

    found = []
    results = run_tasks(task, range(8), after=in_steps_of(4), workers=0)
    with pytest.raises(TaskFailedError, match=r"^task 5: ValueError: no 5; 2 tasks that come after were"):
        found.extend(result["task"] for result in results)
    assert tried == [0, 4, 1, 5, 2, 5, 2, 3]
    assert found == [0, 4, 1, 2, 3]
