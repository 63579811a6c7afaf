"""What analyses of maps cost, from small ones to a million cells: time, memory, disk.

Run it alone on a machine that does nothing else::

    python tests/bench/analysis_scaling.py [--cells 10000 100000 1000000] [--workers 2] [--scheduler threads]

Each size is a map of the Duffing oscillator with 20 starts at each parameter point. It is computed by ``magpend run``
and analysed by ``magpend analyse attractors`` with the given workers. A line is printed for each size: cells, parameter
points, sets (rows of the result) and ids; processor time of the run and of the analysis [s], their ratio, and the
analysis' time per cell [us]; largest memory of all processes of the analysis together [MB], sampled (proportional set
size); bytes of the cube and of the results [MB].
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from pipeline.runs.derive import stored

SPEC = """
kind = "sweep"
model = "duffing"
[parameters]
preset = "twin-well-periodic"
[axes]
frequency_hz = {{ start = 0.12, stop = 0.2, num = {columns} }}
amplitude = {{ start = 0.1, stop = 0.5, num = {rows} }}
[initial_conditions]
kind = "random"
n = {starts}
seed = 1
x = [-1.5, 1.5]
v = [-1.0, 1.0]
[integration]
n_transient = 200
n_keep = 32
"""
STARTS = 20
EVERY_S = 0.5
"""Time between two samples of the memory [s]."""


def measured(*words: str) -> tuple[float, float, float]:
    """Run ``magpend`` with some words; return processor time [s], wall time [s] and largest memory [MB]."""
    before, began, most = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), 0.0
    command = [sys.executable, "-m", "pipeline.cli.main", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            most = max(most, memory(process.pid))
            time.sleep(EVERY_S)
        if process.returncode:
            sys.exit(process.stderr.read() if process.stderr else "")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, time.perf_counter() - began, most / 1e6


def memory(pid: int) -> float:
    """Return the proportional set size of a process and its children [bytes]."""
    total = 0.0
    with contextlib.suppress(psutil.Error):
        for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += process.memory_full_info().pss
    return total


def size_of(folder: Path) -> float:
    """Return the bytes of all files below a folder [MB]."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def main() -> None:
    """Print a line of the table for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--workers", default="2")
    parser.add_argument("--scheduler", default="processes")
    parser.add_argument("--keep", type=Path, help="folder in which the runs stay")
    options = parser.parse_args()
    where = ("--workers", options.workers, "--scheduler", options.scheduler)
    names = ("cells", "points", "sets", "ids", "run s", "analysis s", "ratio", "us/cell", "wall s", "MB", "cube MB")
    print(*(f"{name:>10}" for name in (*names, "results MB")))
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(exist_ok=True)
        for n in options.cells:
            columns = max(1, round((n / STARTS) ** 0.5))
            rows = max(1, round(n / STARTS / columns))
            spec, run = folder / f"{n}.toml", folder / f"run-{n}"
            spec.write_text(SPEC.format(columns=columns, rows=rows, starts=STARTS))
            computed, _, _ = measured("run", str(spec), "--out", str(run), "--workers", options.workers)
            spent, wall, most = measured("analyse", "attractors", str(run), *where)
            found = stored(run, "attractors")
            assert found is not None
            cells = columns * rows * STARTS
            numbers = (cells, columns * rows, found.sizes["set"], int(found.attrs["n_ids"]), computed, spent)
            more = (spent / computed, 1e6 * spent / cells, wall, most, size_of(run / "cube.zarr"))
            words = [f"{x:10d}" if isinstance(x, int) else f"{x:10.2f}" for x in (*numbers, *more)]
            print(*words, f"{size_of(run / 'derived'):10.2f}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONPATH", str(Path(__file__).parents[2]))
    main()
