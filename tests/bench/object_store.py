"""What an object store costs beside a folder: seconds and requests of everything that touches a run.

Run it alone on a machine that does nothing else::

    python tests/bench/object_store.py [--tasks 40] [--latency-ms 30]

The store is an S3 server on loopback (moto, which takes some milliseconds of a core for each request) that
waits a while before each answer, as a network would. The numbers of the cells are made up: no kernel runs.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SPEC = """
kind = "sweep"
model = "duffing"
[axes]
frequency_hz = {{ start = 0.1, stop = 0.9, num = {n} }}
[initial_conditions]
kind = "grid"
x = {{ start = -1.0, stop = 1.0, num = 32 }}
v = {{ start = -1.0, stop = 1.0, num = 32 }}
[execution]
trajectories_per_task = 1024
"""


class Delayed:
    """Harm that is none but a wait before each answer."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __call__(self, method: str, path: str, n: int) -> None:
        time.sleep(self.seconds)


def measure(place: str, text: str, n_requests: Callable[[], int]) -> list[tuple[str, float, float]]:
    """Return what is done, the seconds that it took, and the requests that it made."""
    from pipeline import open_run
    from pipeline.layout.identity import identity_of
    from pipeline.layout.plan import make_plan
    from pipeline.runs.status import state
    from pipeline.runs.verify import verify_run
    from pipeline.specification.parsing import parse_spec
    from pipeline.store.commits import read_commits, write_task
    from pipeline.store.record_copy import write_copy
    from pipeline.store.setup import create

    spec = parse_spec(tomllib.loads(text))
    plan = make_plan(spec)
    rng = np.random.default_rng(0)
    block = plan.task(0)
    shape = tuple(s.stop - s.start for s in block)
    values = {
        v.name: rng.uniform(1, 5, (*shape, *(plan.sizes[d] for d in v.own_dims))).astype(v.dtype)
        for v in plan.variables
    }
    rows: list[tuple[str, float, float]] = []

    def timed(name: str, what: Callable[[], Any], n: int = 1) -> Any:
        before, started = n_requests(), time.perf_counter()
        result = what()
        rows.append((name, (time.perf_counter() - started) / n, (n_requests() - before) / n))
        return result

    info = timed("set up", lambda: create(place, spec, plan, identity_of(spec, plan, "bench"), text))

    def commit() -> None:
        for index in range(plan.n_tasks):
            write_task(info, plan, index, values, {"bounded": plan.cells_in(index)})

    timed(f"commit a task of {sum(v.nbytes for v in values.values()) / 1e3:.0f} kB", commit, plan.n_tasks)
    timed("copy the records", lambda: write_copy(info, plan, read_commits(info, plan)))
    timed(f"status of {plan.n_tasks} tasks", lambda: state(place))
    ds = timed("open", lambda: open_run(place))
    timed("load a variable", ds["section"].load)
    timed("verify", lambda: verify_run(place))
    return rows


def table(n_tasks: int, latency_s: float, folder: Path) -> list[str]:
    """Measure both, and return the lines to print."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tests.pipeline.store.s3 import BUCKET, KEY_ID, SECRET, Server

    server = Server()
    os.environ |= {
        "AWS_ENDPOINT_URL": server.url,
        "AWS_ACCESS_KEY_ID": KEY_ID,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
    }
    text = SPEC.format(n=n_tasks)
    try:
        measure(str(folder / "warm"), SPEC.format(n=2), lambda: 0)  # imports
        here = measure(str(folder / "run"), text, lambda: 0)
        near = measure(f"s3://{BUCKET}/near", text, lambda: len(server.requests))
        server.harm = Delayed(latency_s)
        far = measure(f"s3://{BUCKET}/far", text, lambda: len(server.requests))
    finally:
        server.close()
    lines = [f"{'':32s} {'folder':>10s} {'loopback':>10s} {f'{1e3 * latency_s:g} ms':>10s} {'requests':>10s}"]
    for (name, a, _), (_, b, _), (_, c, n) in zip(here, near, far, strict=True):
        lines.append(f"{name:32s} {a:8.3f} s {b:8.3f} s {c:8.3f} s {n:10.1f}")
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", type=int, default=40)
    parser.add_argument("--latency-ms", type=float, default=30.0)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        print("\n".join(table(given.tasks, given.latency_ms / 1e3, Path(folder))))


if __name__ == "__main__":
    main()
