"""Small specifications and quiet runs for tests of any room."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core import load_preset
from pipeline.runs.run import run

WELLS = 'kind = "list"\npoints = [[0.1, 0.0], [1.0, 0.2]]'
SQUARE = 'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 3 }\nv = { start = -1.0, stop = 1.0, num = 3 }'


# a double well with noise
WELL = """
kind = "sweep"
title = "double well with noise"

[model]
name = "well"
states = { x = { meaning = "position" } }
parameters = { a = 1.0 }
equations = { x = "a*x - x**3" }

[noise]
strengths = { x = 0.5 }
seed = 1
steps_per_period = 8

[parameters]
frequency_hz = 5.0

[axes]
noise_x = { values = [0.45, 0.55, 0.7] }
realization = { start = 0, stop = 199, step = 1 }

[initial_conditions]
kind = "list"
points = [[-1.0]]

[integration]
n_transient = 0
n_keep = 1000
"""

# a fold that moves: x + l = -1 is stable, 1 unstable
FOLD_LENGTH = 20.0
MODEL = {
    "name": "moving-fold",
    "states": {"x": {"escape": 1e6}},
    "parameters": {"l": 0.0},
    "equations": {"x": "(x + l)**2 - 1"},
}
FOLD = {
    "kind": "sweep",
    "title": "a fold that moves",
    "model": MODEL,
    "parameters": {"frequency_hz": 1.0},
    "drift": {"l": {"to": FOLD_LENGTH}},
    "axes": {"l_rate_per_s": {"values": [0.9, 1.0, 1.1, 1.3]}},
    "initial_conditions": {"kind": "list", "points": [[-1.0], [0.25]]},
    "integration": {"rtol": 1e-10, "atol": 1e-10, "n_transient": 0, "n_keep": 40},
}


LOOPBACK: dict[str, Any] = {
    "host": "127.0.0.1",
    "scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
}
"""Options of a dask cluster of a test."""


def silent(line: str) -> None:
    """Echo nothing."""


def duffing(
    axes: str = "frequency_hz = { start = 0.15, stop = 0.25, num = 4 }",
    starts: str = WELLS,
    *,
    kind: str = "sweep",
    n_transient: int = 2,
    n_keep: int = 3,
    tolerance: float = 1e-6,
    execution: str = "",
    more: str = "",
) -> str:
    """Return the specification of a small Duffing run, whose engine all tests share."""
    lines = (
        f'kind = "{kind}"\ntitle = "small"\nmodel = "duffing"\n[axes]\n{axes}\n[initial_conditions]\n{starts}',
        f"[integration]\nrtol = {tolerance}\natol = {tolerance}\nn_transient = {n_transient}\nn_keep = {n_keep}",
        f"[execution]\n{execution}\n{more}",
    )
    return "\n".join(lines)


def quietly(spec: Any, out: str | Path, **options: Any) -> Any:
    """Run a specification in this process without a word."""
    return run(spec, out, **{"workers": 0, "echo": silent, **options})


def finished(folder: Path, text: str) -> Path:
    """Write a specification into a folder, run it there, and return the run directory."""
    folder.mkdir(exist_ok=True)
    (folder / "spec.toml").write_text(text, "utf-8")
    quietly(folder / "spec.toml", folder / "run")
    return folder / "run"


def wait_for(true: Callable[[], Any], process: Any = None, seconds: float = 120.0) -> None:
    """Wait until something is true; fail when a process ends before."""
    end = time.monotonic() + seconds
    while not true():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)


def edges(n: int, hz: float, jitter: float = 0.0, start: float = 3.5) -> str:
    """Return the text of a drive file of measured edges, with the pendulum's own duty cycle."""
    rng = np.random.default_rng(0)
    rising = start + (np.arange(n + 1) + jitter * rng.standard_normal(n + 1)) / hz
    falling = rising[:-1] + load_preset().as_dict()["duty_cycle"] * np.diff(rising)
    rows = [f"{a!r},{b!r}" for a, b in zip(rising[:-1].tolist(), falling.tolist(), strict=True)]
    return "\n".join(["rising_s,falling_s", *rows, f"{float(rising[-1])!r},"]) + "\n"


def contents(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder, but for the lock of a run."""
    files = [f for f in sorted(folder.rglob("*")) if f.is_file() and f.name != "lock"]
    return {f.relative_to(folder).as_posix(): f.read_bytes() for f in files}


RESULT = ("cube.zarr/", "commits/")
"""Where all that a run has computed is."""


def result_of(directory: Path, tops: tuple[str, ...] = (*RESULT, "records.jsonl")) -> dict[str, bytes]:
    """Return all files of a run that must not depend on how it was run."""
    return {key: content for key, content in contents(directory).items() if key.startswith(tops)}


def n_committed(directory: Path) -> int:
    """Return how many tasks of a run have a record of their own."""
    return len(list(directory.glob("commits/*.json")))


def free_port() -> int:
    """Return a port of loopback on which nothing listens."""
    with socket.socket() as chosen:
        chosen.bind(("127.0.0.1", 0))
        return int(chosen.getsockname()[1])
