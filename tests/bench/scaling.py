"""How runs scale with workers, and how many workers one coordinator keeps busy.

Run it alone on a machine that does nothing else::

    python tests/bench/scaling.py [--seconds 30] [--workers 1000] [--task-seconds 20]

*Strong scaling*: the same sweep with one worker and with two, from the first result to the last. *Weak
scaling*: two workers with twice the cells against one with the cells once.

*Ceiling*: a real scheduler, a real client and the window of `magpend run`, with simulated workers: threads
of dask `Worker` objects inside this very process, whose tasks sleep for a known time. Scheduler, client and
the workers' bookkeeping share one interpreter here, so real workers leave the coordinator more room than
this. Printed are the share of time in which the threads were busy, and the processor time per task: it
bounds the tasks per second, and so the workers that tasks of a given length keep busy.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.compute.limits import Limits
from pipeline.compute.order import Order
from pipeline.compute.window import Window
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


def wall_s(folder: Path, n: int, per_task: int, workers: int) -> float:
    """Seconds from the first result of a run to its last, for all of its tasks but the first ones."""
    path = folder / f"spec-{n}.toml"
    path.write_text(SPEC.format(n=n, per_task=per_task))
    directory = folder / f"run-{n}-{workers}"
    runs.run(path, directory, workers=workers, echo=lambda line: None)
    at = [json.loads(line)["at_s"] for line in (directory / "timings.jsonl").read_text().splitlines()]
    # the first result of each worker holds the start of its process
    return (at[-1] - at[workers - 1]) * len(at) / (len(at) - workers)


def scaling(seconds: float, folder: Path) -> dict[str, float]:
    """Return wall times [s] and speed-ups of sweeps of about `seconds` on one core."""
    n = max(2, round(seconds * STARTS_PER_SECOND))
    per_task = max(1, n // 2)
    one, two = (wall_s(folder, n, per_task, workers) for workers in (1, 2))
    twice = wall_s(folder, 2 * n, per_task, 2)
    return {
        "1 worker [s]": one,
        "2 workers [s]": two,
        "strong speed-up": one / two,
        "2 workers, twice the cells [s]": twice,
        "weak speed-up": 2 * one / twice,
    }


def asleep(seconds: float, index: int) -> dict[str, Any]:
    """A task of known length."""
    time.sleep(seconds)
    return {"task": index}


def ceiling(workers: int, task_seconds: float, rounds: int) -> dict[str, float]:
    """Return how busy simulated workers are, and what a task costs."""
    from distributed import Client, LocalCluster

    per_object = min(THREADS, workers)
    settings = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    with (
        LocalCluster(
            n_workers=workers // per_object, threads_per_worker=per_object, processes=False,
            scheduler_kwargs=settings, silence_logs=50,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):  # fmt: skip
        n = rounds * workers
        started, used = time.perf_counter(), time.process_time()
        task = partial(asleep, task_seconds)
        window = Window(client, task, Order(range(n)), seconds=lambda index: task_seconds)
        done = sum(1 for _ in window.results())
        took, used = time.perf_counter() - started, time.process_time() - used
    assert done == n
    cpu_s = used / n
    return {
        "tasks": n,
        "busy": n * task_seconds / (took * workers),
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
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        tables = {"scaling": scaling(given.seconds, Path(folder))} if given.seconds else {}
    tables["ceiling"] = ceiling(given.workers, given.task_seconds, given.rounds)
    for name, table in tables.items():
        print(name)
        for key, value in table.items():
            print(f"  {key:35s} {value:10.3f}")


if __name__ == "__main__":
    main()
