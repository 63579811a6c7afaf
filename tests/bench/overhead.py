"""What the store and the thread of a run cost on top of the kernel.

Run it alone on a machine that does nothing else::

    python tests/bench/overhead.py [--seconds 60]

A sweep with the default task size is computed twice in one run: without a store, task by task, then by
a thread into a run directory. The overhead is what the tasks took on the wall from the first to the last,
over the kernel's time without the store. Two runs of the same numbers differ by several per cent on a
busy machine, so the parts are printed as well: the kernel's time inside the run, the writing, and the rest.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from pipeline.compute import task
from pipeline.layout.cells import CellMap
from pipeline.layout.plan import make_plan
from pipeline.runs import run as runs
from pipeline.specification.parsing import load_spec

SPEC = """
kind = "sweep"
[axes]
frequency_hz = {{ start = 2.0, stop = 3.0, num = 16 }}
[initial_conditions]
kind = "random"
n = {n}
psi1_deg = [-57, 57]
psi2_deg = [-57, 57]
"""
SECONDS_PER_START = 0.1


def measure(seconds: float, folder: Path) -> dict[str, float]:
    """Return times [s] and shares of a sweep of about `seconds` on one core."""
    path = folder / "overhead.toml"
    path.write_text(SPEC.format(n=max(16, round(seconds / SECONDS_PER_START))))
    spec = load_spec(path)
    plan, cells = make_plan(spec), CellMap(spec)
    task.warm_up(spec)
    started = time.perf_counter()
    for block in plan.tasks():
        task.compute(spec, cells, block)
    kernel = time.perf_counter() - started

    runs.run(path, folder / "run", workers=1, echo=lambda line: None)
    lines = [json.loads(line) for line in (folder / "run" / "timings.jsonl").read_text().splitlines()]
    first = lines[0]
    whole = lines[-1]["at_s"] - first["at_s"]
    inside, writing = (sum(line[key] for line in lines[1:]) for key in ("kernel_s", "write_s"))
    return {
        "tasks": plan.n_tasks,
        "kernel without a store": kernel,
        "kernel in the run": inside + first["kernel_s"],
        "per cent, writing": 100 * writing / inside,
        "per cent, the rest": 100 * (whole - inside - writing) / inside,
        "per cent, both, over the kernel here": 100 * (whole / (kernel * (plan.n_tasks - 1) / plan.n_tasks) - 1),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="size of the sweep on one core")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as folder:
        for name, value in measure(seconds, Path(folder)).items():
            print(f"{name:40s} {value:8.2f}")


if __name__ == "__main__":
    main()
