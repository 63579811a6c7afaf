"""What a run of very many tasks costs to look at: opening, status, loading, verifying.

    python tests/bench/many_tasks.py 10000 [100000 ...]

The runs are made without the kernel: one cell a task, made-up numbers, whole files and true records.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr
from zarr.storage import MemoryStore

SPEC = """
kind = "sweep"
title = "many tasks"
model = "duffing"
[axes]
frequency_hz = {{ start = 0.15, stop = 0.25, num = {n} }}
[initial_conditions]
kind = "grid"
x = 0.1
v = 0.1
[integration]
n_transient = 2
n_keep = 3
[execution]
trajectories_per_task = 1
"""

N_DIFFERENT = 500
MOST_CHUNKS = 20_000
WHATS = ("nothing", "status", "open_run", "verify", "load", "load_unchecked")


def make(directory: Path, n_tasks: int, *, packed: bool = True, chunks: bool = True) -> None:
    """Make a finished run of one-cell tasks; without chunks it is good for what looks at records alone."""
    from magpend_core import kernel_version
    from pipeline.layout.identity import identity_of
    from pipeline.layout.plan import make_plan
    from pipeline.specification.parsing import load_spec
    from pipeline.store.files import entry_of
    from pipeline.store.keys import keys_of
    from pipeline.store.records import BLOCK, Commit, line_of, marker_key, pack_key, pack_text
    from pipeline.store.setup import create

    directory.mkdir(parents=True)
    path = directory.with_suffix(".toml")
    path.write_text(SPEC.format(n=n_tasks))
    spec = load_spec(path)
    plan = make_plan(spec)
    info = create(directory, spec, plan, identity_of(spec, plan, kernel_version()), path.read_text())
    contents = different_chunks(directory / "cube.zarr", plan)
    entries = [[entry_of(content) for content in task] for task in contents]
    commits: dict[int, Commit] = {}
    for index in range(n_tasks):
        keys = keys_of(plan, index)
        for key, content in zip(keys, contents[index % N_DIFFERENT] if chunks else (), strict=False):
            with open(f"{directory}/cube.zarr/{key}", "wb") as file:
                file.write(content)
        objects = dict(zip(keys, entries[index % N_DIFFERENT], strict=True))
        commits[index] = Commit(index, {"bounded": 1}, objects)
        if packed and len(commits) == BLOCK:
            text = pack_text(commits, info.digest, index // BLOCK)
            (directory / pack_key(index // BLOCK)).write_bytes(text)
            commits.clear()
    for index, commit in commits.items():
        (directory / marker_key(index)).write_bytes(line_of(commit, info.digest))


def different_chunks(cube: Path, plan) -> list[list[bytes]]:
    """Contents of all chunks of some tasks, by task."""
    rng = np.random.default_rng(0)
    found: list[list[bytes]] = [[] for _ in range(N_DIFFERENT)]
    for variable in plan.variables:
        written: dict = {}
        metadata = (cube / variable.name / "zarr.json").read_bytes()
        store = MemoryStore(written)
        store_key = zarr.core.buffer.default_buffer_prototype().buffer.from_bytes(metadata)
        written["zarr.json"] = store_key
        array = zarr.open_array(store, mode="r+").with_config({"write_empty_chunks": True})
        shape = (N_DIFFERENT, *array.shape[1:])
        numbers = rng.uniform(1, 5, shape).astype(array.dtype)
        if variable.name == "status":
            numbers[...] = 2
        array[:N_DIFFERENT] = numbers
        rest = ".".join("0" for _ in array.shape[1:])
        for i in range(N_DIFFERENT):
            found[i].append(written[f"c.{i}.{rest}" if rest else f"c.{i}"].to_bytes())
    return found


PROBE = """
import sys, time, resource
from pathlib import Path
from pipeline import open_run
from pipeline.runs.status import describe_state, state
from pipeline.runs.verify import verify_run
directory, what = sys.argv[1:]
started, cpu = time.perf_counter(), time.process_time()
if what == "status":
    found = state(directory); describe_state(found); assert found.complete
elif what == "open_run":
    open_run(directory)
elif what == "load":
    ds = open_run(directory).load(); assert (ds.status == 2).all()
elif what == "load_unchecked":
    open_run(directory, check=False).load()
elif what == "verify":
    assert verify_run(directory).sound
wall, cpu = time.perf_counter() - started, time.process_time() - cpu
print(f"{wall:.2f} {cpu:.2f} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}")
"""


def measure(directory: Path, what: str) -> str:
    """Seconds, without the imports, and the peak of memory of a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", PROBE, str(directory), what], capture_output=True, text=True, env=os.environ
    )
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    seconds, cpu, megabytes = done.stdout.split()
    return f"{seconds:>8s} s ({cpu:>6s} s of a core) {megabytes:>6s} MB"


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="many-"))
    try:
        for n in map(int, sys.argv[1:]):
            started = time.perf_counter()
            make(folder / f"run{n}", n, chunks=n <= MOST_CHUNKS)
            print(f"{n} tasks made in {time.perf_counter() - started:.1f} s", flush=True)
            for what in WHATS if n <= MOST_CHUNKS else WHATS[:3]:
                print(f"  {what:16s} {measure(folder / f'run{n}', what)}", flush=True)
            shutil.rmtree(folder / f"run{n}")
        print(f"peak here {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
