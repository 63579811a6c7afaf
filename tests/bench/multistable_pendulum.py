"""Basin fractions of a pendulum with constant torque, as other programs publish their times for it.

    python tests/bench/multistable_pendulum.py

prints what 1e5 random starts of ::

    th'' = -0.1 th' + torque - sin(th),   torque = 0.5

over 1000 time units at rtol 1e-8 and atol 1e-6 take from drawing the starts to fractions of rest and rotation with
their intervals. It is the first case of bSTAB (Stender and Hoffmann, Nonlinear Dyn. 107, 1451, 2022), with starts in
[asin(0.5) - pi, asin(0.5) + pi] x [-10, 10].

The system is autonomous, so that its "drive period" is a matter of choice: the time between two looks at the state.
Two threads share the work; the kernels hold no lock. Times are wall-clock times, with the CPU time of all threads
beside them: where other work runs on the machine, half of the latter is the better guide.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from magpend_core import run_branches
from magpend_core.models.text import read_model
from magpend_core.status import Status
from pipeline.analysis.basins.numbers import basin_fractions

GOAL = 12.0  # s, on two cores

PUBLISHED = {"Julia, 24 threads, integration only": 12.4, "pyBasin": 63.0, "pynamicalsys": 116.0, "bSTAB": 309.0}
"""Seconds that others report for the same starts, on laptops with 24 cores."""

UNDECIDED, REST, ROTATION = -1, 0, 1
TORQUE, SPEED = 0.5, 10.0
PENDULUM = {
    "name": "pendulum-with-torque",
    "states": {"th": {"on_circle": True}, "th_dot": {}},
    "parameters": {"damping": 0.1, "torque": TORQUE},
    "equations": {"th": "th_dot", "th_dot": "torque - damping*th_dot - sin(th)"},
}
CHUNK = 4096
"""Starts per call of the engine: enough to keep its lanes full, few enough to share among threads."""

CLOSURE = 1e-3
"""Distance between sections at which a start counts as at rest; the tolerance leaves 1e-6 or so."""

SECTION_TIME = 100.0
"""Time between sections: few sections, no time lost at them."""


def draw_starts(n: int, seed: int) -> np.ndarray:
    """Return seeded starts (n, 2) in the box of the published case."""
    rest = np.arcsin(TORQUE)
    return np.random.default_rng(seed).uniform((rest - np.pi, -SPEED), (rest + np.pi, SPEED), (n, 2))


def labels_of(starts: np.ndarray, duration: float, threads: int) -> tuple[np.ndarray, int]:
    """Return labels and attempted steps: rotation if the angle turns between the last two sections, rest if closed."""
    model = read_model(PENDULUM)
    packed = model.load().pack()

    def run(first: int) -> tuple[np.ndarray, int]:
        rows = starts[first : first + CHUNK]
        found = run_branches(
            np.tile(packed, (len(rows), 1, 1)),
            np.full((len(rows), 1), 1.0 / SECTION_TIME),
            rows,
            n_transient=round(duration / SECTION_TIME) - 2,
            n_keep=2,
            rtol=1e-8,
            atol=1e-6,
            closure_tolerance=CLOSURE,
            max_orbit_period=1,
            system=model.system,
        )
        label = np.where(found.status[:, 0] == Status.PERIODIC, REST, UNDECIDED)
        label[found.turns[:, 0, 0] != 0] = ROTATION
        return label, int(found.n_steps.sum() + found.n_rejected.sum())

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(run, range(0, len(starts), CHUNK)))
    return np.concatenate([label for label, _ in parts]), sum(n for _, n in parts)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the times, the fractions and the published times."""
    parser = argparse.ArgumentParser(description="Basin fractions of a pendulum with constant torque.")
    parser.add_argument("--starts", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=1000.0, help="time units")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3, help="the best counts")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    alone, _ = labels_of(draw_starts(50, options.seed), options.duration, 1)
    compiling, best = time.perf_counter() - begin, np.inf
    for _ in range(options.rounds):
        cpu, begin = time.process_time(), time.perf_counter()
        label, attempts = labels_of(draw_starts(options.starts, options.seed), options.duration, options.threads)
        fractions = basin_fractions(label, ids=(REST, ROTATION), method="clopper-pearson")
        seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
        best = min(best, seconds)
        print(f"{seconds:.2f} s, CPU {cpu:.2f} s, {attempts / len(label):.0f} attempts each")
    if options.starts >= 50:
        assert label[:50].tolist() == alone.tolist(), "threads change labels"
    for code, name in ((REST, "rest"), (ROTATION, "rotation")):
        row = fractions.sel(label=code)
        print(f"  {name:10s} {row.fraction:.4f}  [{row.low:.4f}, {row.high:.4f}]")
    print(f"  undecided  {int(fractions.n_unfinished)} starts")
    print(f"best {best:.2f} s on {os.cpu_count()} cores, goal {GOAL:g} s; with compiling {best + compiling:.1f} s")
    print("published: " + ", ".join(f"{name} {seconds:g} s" for name, seconds in PUBLISHED.items()))


if __name__ == "__main__":
    main()
