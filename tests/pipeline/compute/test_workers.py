"""Workers that die, stop, hang and fail, with tasks made for it."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest

from pipeline.compute.execute import run_tasks
from pipeline.compute.order import TaskFailedError


@pytest.fixture
def faulty(monkeypatch):
    """The tasks, from a folder that workers find."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import faulty

    yield faulty
    sys.modules.pop("faulty", None)


def in_steps_of(n):
    return lambda i: i - 1 if i % n else None


def one_second(index):
    return 1.0


def tries(folder):
    return {int(path.name): path.stat().st_size for path in folder.iterdir()}


def test_workers__order_failures_and_a_second_try(faulty, tmp_path):
    task = partial(faulty.raising, str(tmp_path), poison=(5,), unlucky=(2,))
    found = []
    results = run_tasks(task, range(12), after=in_steps_of(4), seconds=one_second, workers=2)
    with pytest.raises(TaskFailedError, match=r"^task 5: RuntimeError: out of luck; 2 tasks that come after"):
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 1, 2, 3, 4, 8, 9, 10, 11]
    assert all(found.index(i) > found.index(i - 1) for i in found if i % 4)
    assert tries(tmp_path) == {0: 1, 1: 1, 2: 2, 3: 1, 4: 1, 5: 2, 8: 1, 9: 1, 10: 1, 11: 1}
