"""How runs scale with threads, and how many dask workers one coordinator keeps busy.

Run it alone on a machine that does nothing else::

    python tests/bench/scaling.py [--seconds 30] [--workers 1000] [--task-seconds 20]

*Strong scaling*: the same sweep with one thread and with two, from the first result to the last. *Weak
scaling*: two threads with twice the cells against one with the cells once. The sweep is computed by two
processes, too: they share no interpreter, so the ratio says what sharing it costs.

*Ceiling*: a real scheduler, a real client and the window of `magpend run` in this process, and simulated
workers in another: threads of dask `Worker` objects whose tasks sleep for a known time. All of them share an
interpreter there, which a cluster's workers do not. Printed are the share of time in which the threads were
busy, from the first start to the last end, and between the ramps, which is from when each has had a task to
when the last task starts; and the coordinator's processor time per task, which bounds the tasks per second,
and so the workers that tasks of a given length keep busy.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client, LocalCluster, Worker

from pipeline.compute.dispatch import Limits, Window
from pipeline.compute.order import Order
from pipeline.runs import run as runs

SPEC = """
kind = "sweep"
model = "duffing"
[axes]
frequency_hz = {{ start = 0.15, stop = 0.25, num = 32 }}
[initial_conditions]
kind = "random"
n = {n}
x = [-1, 1]
[integration]
n_transient = 2000
n_keep = 16
[execution]
trajectories_per_task = {per_task}
"""

STARTS_PER_SECOND = 4
"""Starts of all 32 frequencies that one core integrates in a second, about."""

THREADS = 50
"""Simulated workers per `Worker` object."""


def wall_s(folder: Path, n: int, per_task: int, workers: int, scheduler: str = "threads") -> float:
    """Seconds from the first result of a run to its last, for all of its tasks but the first ones."""
    path = folder / f"spec-{n}.toml"
    path.write_text(SPEC.format(n=n, per_task=per_task))
    directory = folder / f"run-{n}-{workers}-{scheduler}"
    runs.run(path, directory, workers=workers, scheduler=scheduler, echo=lambda line: None)
    at = [json.loads(line)["at_s"] for line in (directory / "timings.jsonl").read_text().splitlines()]
    # the first result of each process holds its start
    return (at[-1] - at[workers - 1]) * len(at) / (len(at) - workers)


def scaling(seconds: float, folder: Path) -> dict[str, float]:
    """Return wall times [s] and speed-ups of sweeps of about `seconds` on one core."""
    n = max(2, round(seconds * STARTS_PER_SECOND))
    per_task = max(1, n // 2)
    one, two = (wall_s(folder, n, per_task, workers) for workers in (1, 2))
    twice = wall_s(folder, 2 * n, per_task, 2)
    processes = wall_s(folder, n, per_task, 2, "processes")
    return {
        "1 thread [s]": one,
        "2 threads [s]": two,
        "2 processes [s]": processes,
        "strong speed-up": one / two,
        "time of threads over processes": two / processes,
        "2 threads, twice the cells [s]": twice,
        "weak speed-up": 2 * one / twice,
    }


def asleep(seconds: float, index: int) -> dict[str, Any]:
    """A task of known length; tells when it slept."""
    begin = time.time()
    time.sleep(seconds)
    return {"task": index, "begin": begin, "end": time.time()}


async def serve(address: str, objects: int, threads: int) -> None:
    """Be so many workers until the scheduler ends."""
    workers = [Worker(address, nthreads=threads, host="127.0.0.1", dashboard=False) for _ in range(objects)]
    await asyncio.gather(*workers)
    await asyncio.gather(*(worker.finished() for worker in workers))


def busy(slept: list[dict[str, Any]], workers: int) -> tuple[float, float]:
    """Shares of time in which workers were busy: in all, and without ramps."""
    begins, ends = sorted(x["begin"] for x in slept), [x["end"] for x in slept]
    low, high = begins[workers - 1], begins[-1]
    inside = sum(max(0.0, min(x["end"], high) - max(x["begin"], low)) for x in slept)
    in_all = sum(x["end"] - x["begin"] for x in slept) / (workers * (max(ends) - begins[0]))
    return in_all, inside / (workers * (high - low)) if high > low else in_all


def ceiling(workers: int, task_seconds: float, rounds: int) -> dict[str, float]:
    """Return how busy simulated workers are, and what a task costs."""
    threads = min(THREADS, workers)
    settings = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    with (
        LocalCluster(n_workers=0, host="127.0.0.1", scheduler_kwargs=settings, silence_logs=50) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        command = [sys.executable, __file__, "--serve", cluster.scheduler_address, str(workers // threads)]
        simulated = subprocess.Popen([*command, str(threads)], stderr=subprocess.DEVNULL)
        try:
            client.wait_for_workers(workers // threads, timeout=60)
            n = rounds * workers
            used = time.process_time()
            task = partial(asleep, task_seconds)
            window = Window(client, task, Order(range(n)), seconds=lambda index: task_seconds)
            slept = list(window.results())
            used = time.process_time() - used
        finally:
            simulated.terminate()
            simulated.wait()
    assert len(slept) == n
    in_all, between = busy(slept, workers)
    cpu_s = used / n
    return {
        "tasks": n,
        "busy": in_all,
        "busy between the ramps": between,
        "processor time per task [ms]": 1e3 * cpu_s,
        "tasks per second at most": 1 / cpu_s,
        "shortest task for 95 % busy [s]": 0.95 * workers * cpu_s,
        "time limit of a task [s]": Limits(lambda index: task_seconds).limit_s(0, 1),
    }


def main(arguments: list[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--workers", type=int, default=1000)
    parser.add_argument("--task-seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--serve", nargs=3, help=argparse.SUPPRESS, metavar=("ADDRESS", "OBJECTS", "THREADS"))
    given = parser.parse_args(arguments)
    if given.serve:
        address, *numbers = given.serve
        asyncio.run(serve(address, *map(int, numbers)))
        return
    with tempfile.TemporaryDirectory() as folder:
        tables = {"scaling": scaling(given.seconds, Path(folder))} if given.seconds else {}
    tables["ceiling"] = ceiling(given.workers, given.task_seconds, given.rounds)
    for name, table in tables.items():
        print(name)
        for key, value in table.items():
            print(f"  {key:35s} {value:10.3f}")


if __name__ == "__main__":
    main()
