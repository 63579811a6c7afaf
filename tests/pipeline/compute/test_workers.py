"""Workers that die, stop, hang and fail, with tasks made for it."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest
from distributed import Client, Nanny

from pipeline.compute import clients, dispatch, limits, local
from pipeline.compute.addresses import SchedulerError
from pipeline.compute.dispatch import Watch, Window
from pipeline.compute.execute import run_tasks
from pipeline.compute.limits import Limits
from pipeline.compute.local import local_cluster
from pipeline.compute.order import Order, TaskFailedError


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


def test_workers__poison_kills_them_and_the_others_finish(faulty, tmp_path, monkeypatch):
    """A worker that dies takes nothing along; who killed it is found out when it is tried alone."""
    monkeypatch.setattr(clients, "ALLOWED_FAILURES", 1)
    task = partial(faulty.deadly, str(tmp_path), poison=(3,), unlucky=(1,))
    found = []
    results = run_tasks(task, range(8), seconds=one_second, workers=2)
    with pytest.raises(TaskFailedError, match=r"^task 3: its worker died 2 times \(out of memory") as failed:
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 1, 2, 4, 5, 6, 7]
    assert list(failed.value.failed) == [3]
    assert 2 <= tries(tmp_path)[3] <= 4


def test_workers__one_that_dies_with_a_result_that_was_not_fetched_yet(faulty, tmp_path, monkeypatch):
    """The task is computed again: nobody takes the scheduler for gone."""
    outcome, states = dispatch._outcome, []

    async def late(client, future):
        if not states:
            states.append("finished")
            await wait_until(lambda: future.status == "finished")
            (holder,) = (await client.scheduler.who_has(keys=[future.key]))[future.key]
            os.kill((await client._run(os.getpid))[holder], signal.SIGKILL)
            await wait_until(lambda: future.status != "finished")
            states[0] = future.status
        return await outcome(client, future)

    async def wait_until(true):
        until = time.monotonic() + 120
        while not true() and time.monotonic() < until:
            await asyncio.sleep(0.01)

    monkeypatch.setattr(dispatch, "_outcome", late)
    task = partial(faulty.raising, str(tmp_path))
    found = [result["task"] for result in run_tasks(task, range(6), seconds=one_second, workers=2)]
    assert sorted(found) == list(range(6))
    assert states != ["finished"]


def test_workers__one_that_takes_all_memory_is_ended_before_the_machine_suffers(faulty, tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "ALLOWED_FAILURES", 0)  # each death is a worker to be started
    monkeypatch.setattr(local, "memory_per_worker", lambda n_workers: 900_000_000)
    task = partial(faulty.greedy, str(tmp_path), poison=(1,))
    found = []
    results = run_tasks(task, range(4), seconds=one_second, workers=1)
    with pytest.raises(TaskFailedError, match=r"^task 1: its worker died \(out of memory"):
        found.extend(result["task"] for result in results)
    assert sorted(found) == [0, 2, 3]


def test_workers__one_that_is_stopped(faulty, tmp_path, monkeypatch):
    """SIGSTOP: it falls silent, is restarted, and its task is done by another."""
    monkeypatch.setattr(dispatch, "SILENT_S", 6.0)  # a busy machine keeps a worker silent for seconds
    task = partial(faulty.hanging, str(tmp_path), number=signal.SIGSTOP, unlucky=(2,))
    lines = []
    results = run_tasks(task, range(6), seconds=one_second, workers=2, echo=lines.append)
    assert sorted(r["task"] for r in results) == list(range(6))
    assert any("a worker has not answered for 6 s" in line for line in lines)
    assert tries(tmp_path)[2] == 2


def test_workers__tasks_that_hang(faulty, tmp_path, monkeypatch):
    """A living worker that is busy for ever: the task is given up there and done elsewhere, or reported."""
    # tasks that do not hang have all the time that a busy machine takes for them
    hangs = {2: 1, 4: 100}
    limit = lambda self, index, tries: 1.5 if tries <= hangs.get(index, 0) else 600.0  # noqa: E731
    monkeypatch.setattr(limits.Limits, "limit_s", limit)
    task = partial(faulty.hanging, str(tmp_path), unlucky=(2,), poison=(4,))
    lines, found = [], []
    results = run_tasks(task, range(6), seconds=lambda i: 0.05, workers=2, echo=lines.append)
    with pytest.raises(TaskFailedError, match=r"^task 4: not done after \d+ s, far more than estimated"):
        found.extend(r["task"] for r in results)
    assert sorted(found) == [0, 1, 2, 3, 5]
    assert [line.split(":")[0] for line in lines if "far more" in line].count("task 4") == 3
    assert tries(tmp_path)[2] == 2


def test_workers__a_blocked_callback_of_another_client_holds_up_nobody(faulty, tmp_path):
    task = partial(faulty.raising, str(tmp_path))
    free = threading.Event()
    with local_cluster(1) as cluster, Client(cluster) as client:
        client.submit(abs, -1).add_done_callback(lambda future: free.wait())
        try:
            assert len(list(run_tasks(task, range(3), seconds=one_second, workers=1))) == 3
        finally:
            free.set()


def test_local_cluster__whose_workers_all_fail_to_start_tries_again(monkeypatch):
    instantiate, failed = Nanny.instantiate, []

    async def failing_once(self):
        if len(failed) < 2:
            failed.append(self)
            raise OSError("no process")
        return await instantiate(self)

    monkeypatch.setattr(Nanny, "instantiate", failing_once)
    with local_cluster(2) as cluster:
        assert len(failed) == 2
        assert cluster.scheduler.workers


def test_local_cluster__whose_workers_never_start_says_so(monkeypatch):
    async def failing(self):
        raise OSError("no process")

    monkeypatch.setattr(Nanny, "instantiate", failing)
    with pytest.raises(SchedulerError, match="ended as soon as they started, 3 times"), local_cluster(2):
        pass


def test_local_cluster__that_does_not_close_holds_up_nobody(monkeypatch):
    async def never(self):
        await asyncio.Event().wait()

    monkeypatch.setattr(local, "CLOSE_S", 0.5)
    with local_cluster(1) as cluster:
        (worker,) = (p for p in multiprocessing.active_children() if p.name.startswith("Dask Worker"))
        monkeypatch.setattr(type(cluster), "_close", never)
    worker.join(30)
    assert not worker.is_alive()


@contextlib.contextmanager
def dask_command(name, folder, *words):
    """A program of dask, in a process of its own."""
    words = ["--host", "127.0.0.1", "--scheduler-file", folder / "scheduler.json", *words]
    with subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{name}", *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_workers__scheduler_dies(faulty, tmp_path, monkeypatch):
    """A scheduler that is killed: an error in one sentence, soon."""
    (tmp_path / "log").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    nothing_shown = ("--no-dashboard", "--dashboard-address", "127.0.0.1:0")
    with (
        dask_command("scheduler", tmp_path, "--port", "0", *nothing_shown) as scheduler,
        dask_command("worker", tmp_path, "--no-nanny", "--nthreads", "1"),
    ):
        written = tmp_path / "scheduler.json"
        # the file is there before it is whole
        while not (written.exists() and written.read_text("utf-8").rstrip().endswith("}")):
            time.sleep(0.02)
        task = partial(faulty.slow, str(tmp_path / "log"))
        results = run_tasks(task, range(1000), scheduler=str(tmp_path / "scheduler.json"))
        next(results)
        scheduler.kill()
        with pytest.raises(SchedulerError, match=r"is gone\. Committed results stay"):
            list(results)


def test_local_cluster__refuses_who_has_no_key():
    """Another user on this machine can reach the ports and nothing behind them."""
    from distributed import Client, Security
    from distributed.comm.core import connect

    with local_cluster(1) as cluster:
        client = Client(cluster, set_as_default=False)
        with client:
            (worker,) = client.scheduler_info()["workers"]
            nanny = next(iter(cluster.workers.values())).address
            doors = [cluster.scheduler_address, worker, nanny]
            assert all(door.startswith("tls://127.0.0.1:") for door in doors)
            foreign = Security.temporary().get_connection_args("client")
            for door in doors:
                for address, keys in ((door.replace("tls", "tcp"), {}), (door, foreign)):
                    assert "Error" in client.sync(answer, connect, address, keys)
                own = cluster.security.get_connection_args("client")
                assert client.sync(answer, connect, door, own) in ("Scheduler", "Worker", "Nanny")
            for service in (cluster.scheduler.http_server,):
                for port in {s.getsockname()[1] for s in service._sockets.values()}:
                    assert pages(port) == [404, 404, 404]


def test_workers__memory_stays(faulty, tmp_path):
    """What dask keeps of every task in a worker is short; its defaults keep 3.6 kB of each of thousands."""
    from distributed import Client

    task = partial(faulty.fine, str(tmp_path))
    with local_cluster(1) as cluster, Client(cluster, set_as_default=False) as client:
        held = []
        for n in (50, 100):
            client.run(faulty.traced)
            assert len(list(Window(client, task, Order(range(n)), seconds=one_second).results())) == n
            held += client.run(faulty.traced).values()
    assert (held[1] - held[0]) / 100 < 1200


async def answer(connect, address, keys):
    """What a server of dask says who it is, or what came instead."""
    try:
        comm = await connect(address, timeout=10, **keys)
        await comm.write({"op": "identity", "reply": True})
        found = await comm.read()
        await comm.close()
    except Exception as error:
        return f"Error: {error!r}"
    return found["type"]


def pages(port):
    import http.client

    found = []
    for page in ("/info/main/workers.html", "/metrics", "/json/counts.json"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("GET", page)
        found.append(connection.getresponse().status)
        connection.close()
    return found


def test_limits__learn_from_what_finished():
    found = Limits(lambda i: 20.0)
    assert found.limit_s(0, 1) == 200
    assert found.limit_s(0, 2) == 400
    found.finished(0, 100.0)
    found.finished(1, 10.0)
    assert found.limit_s(2, 1) == 1000
    assert Limits(lambda i: 0.1).limit_s(0, 1) == limits.LEAST_S
    assert Limits(None).limit_s(0, 1) == float("inf")


def test_watch__who_falls_silent():
    now = [0.0]
    watch = Watch(lambda: now[0])
    silent = []
    for second in range(25):
        now[0] += 1
        a = {"nthreads": 1, "last_seen": second}
        silent += watch.look({"a": a, "b": {"nthreads": 2, "last_seen": min(second, 3)}})
        assert watch.n_threads == 3
    assert silent == ["b"]  # once: then it has twice as long
    assert watch.limit_s == 2 * limits.SILENT_S
    watch.forget("b")
    assert watch.look({"b": {"nthreads": 2, "last_seen": 3}}) == []


def test_watch__own_sleep_blames_nobody():
    now = [0.0]
    watch = Watch(lambda: now[0])
    worker = {"a": {"nthreads": 1, "last_seen": 1.0}}
    assert watch.look(worker) == []
    now[0] = 3600
    assert watch.look(worker) == []
    assert watch.now < 10
