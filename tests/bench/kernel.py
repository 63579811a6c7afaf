"""Speed of the lane engine beside a scalar loop, in one run.

    python tests/bench/kernel.py

prints, for the same trajectories of the paper's pendulum and of a twin-well Duffing oscillator: nanoseconds per
attempted step, attempts per period and microseconds per period, of the engine, of the engine without its step
limiter or while it watches the energy, and of a scalar numba loop with textbook control (`solvers.scalar_loop`). The
oscillator's right-hand side of a few operations shows what the engine itself costs. Then the engine over tolerances;
engine and loop again for AVX2; and the CPU time that a fresh process compiles for.

Without the limiter the same tolerance is met with larger errors: each row has its median error after a few periods
beside it. `peers` compares at equal error.

Times are CPU times of one thread, warm, variants in turn, the best of several rounds. Absolute times belong to the
machine; compare the ratios.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import solvers
from peers import CASES, Case, rhs_of, text_of
from racing import least, scaled_error

import magpend_core
from magpend_core.models.text import read_model

GOALS = {"AVX-512": 7.0, "AVX2": 4.0}
"""Least ratio of the scalar loop's time per attempt to the engine's, for the pendulum."""

COMPILE_GOAL = 10.0  # s of CPU
AVX2 = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma", "MAGPEND_CACHE": "0"}
UNCACHED = {"MAGPEND_CACHE": "0"}

# tight and short, so that the step control's rounding is all that tells the two apart
AGREEMENT_TOLERANCE, AGREEMENT_PERIODS, AGREEMENT = 1e-10, 3, 1e-6
REFERENCE_TOLERANCE, ERROR_PERIODS = 1e-12, 5

DUFFING = {
    "name": "duffing-text",
    "states": {"x": {"unit": "1"}, "v": {"unit": "1/s"}},
    "parameters": {"damping": 0.2, "linear": -1.0, "cubic": 1.0, "amplitude": 0.3},
    "equations": {"x": "v", "v": "amplitude*cos(2*pi*f*t) - damping*v - linear*x - cubic*x**3"},
}
SYSTEMS: dict[str, tuple[Case, Callable[[], Any]]] = {
    "pendulum": (CASES["pendulum"], lambda: text_of("pendulum")),
    "duffing": (Case(2.0 * math.pi, (-2.0, -2.0), (2.0, 2.0), 3), lambda: read_model(DUFFING)),
}


@dataclass(frozen=True)
class Work:
    """What a variant integrates; `tolerance` is both rtol and atol."""

    parameters: magpend_core.Parameters
    loop: Callable[[float], Any]
    frequency_hz: float
    initial: np.ndarray
    n_periods: int
    tolerance: float

    def error(self, states: np.ndarray, reference: np.ndarray) -> np.ndarray:
        model = self.parameters.model
        return scaled_error(states, reference, model.is_angle, model.scales)


Variant = Callable[[Work], tuple[np.ndarray, int]]
"""From work to the last states (n, n_states) and the attempted steps."""


def work_of(name: str, n: int, n_periods: int, tolerance: float) -> Work:
    """Read a system's text, and compile the scalar loop for it."""
    case, text = SYSTEMS[name][0], SYSTEMS[name][1]()
    loop = solvers.scalar_loop(rhs_of(text, case), len(case.low), case.period)
    changes = DUFFING["parameters"] if name == "duffing" else {}
    parameters = magpend_core.load_model(name).load(**changes)
    return Work(parameters, loop, 1.0 / case.period, case.starts(n), n_periods, tolerance)


def lanes(work: Work, n_watched: int = 0) -> tuple[np.ndarray, int]:
    """Integrate by the engine, which watches the energy in the last periods."""
    found = magpend_core.run_branches(
        np.tile(work.parameters.pack(), (len(work.initial), 1, 1)),
        np.full((len(work.initial), 1), work.frequency_hz),
        work.initial,
        n_transient=work.n_periods - max(n_watched, 1),
        n_keep=max(n_watched, 1),
        rtol=work.tolerance,
        atol=work.tolerance,
        system=work.parameters.model.system,
        quantities=["energy"] if n_watched else None,
    )
    return found.section[:, 0, -1], int(found.n_steps.sum() + found.n_rejected.sum())


@contextmanager
def no_limiter() -> Iterator[None]:
    """Let the engine's step limiter allow any step; what it computes for that stays."""
    module = importlib.import_module("magpend_core.engine.entry")
    slack = module.SLACK
    module.SLACK = 1e30
    try:
        yield
    finally:
        module.SLACK = slack


def without_limiter(work: Work) -> tuple[np.ndarray, int]:
    with no_limiter():
        return lanes(work)


def scalar(work: Work) -> tuple[np.ndarray, int]:
    runner = work.loop(work.tolerance)
    return runner(work.initial, work.n_periods), runner.attempts


FIRST, SECOND = "lanes", "scalar loop"
SPEED: dict[str, Variant] = {FIRST: lanes, SECOND: scalar}
VARIANTS: dict[str, Variant] = {
    **SPEED,
    "lanes, no limiter": without_limiter,
    "lanes, energy in the last period": lambda work: lanes(work, 1),
    "lanes, energy in every period": lambda work: lanes(work, work.n_periods),
}


def check_agreement(work: Work) -> float:
    """Return the largest difference between the engine's and the loop's states over a short horizon.

    Raises
    ------
    AssertionError
        If it is larger than `AGREEMENT`, or if watching changes a state.
    """
    short = replace(work, n_periods=AGREEMENT_PERIODS, tolerance=AGREEMENT_TOLERANCE)
    plain = lanes(short)[0]
    largest = float(np.max(work.error(plain, scalar(short)[0])))
    if not largest <= AGREEMENT:
        raise AssertionError(f"lanes and scalar loop differ by {largest:.2g}; expected {AGREEMENT:g} at most.")
    if lanes(short, AGREEMENT_PERIODS)[0].tobytes() != plain.tobytes():
        raise AssertionError("watching the energy changes a state.")
    return largest


def print_table(title: str, runs: Mapping[str, tuple[Variant, Work]], rounds: int) -> None:
    """Time all in turn; the ratio is a row's time per period over the first row's."""
    width = max(map(len, runs))
    print(f"\n{title}\n{'':{width}}  ns/attempt  attempts/period  us/period   ratio    error")
    found = least({name: lambda v=variant, w=work: v(w) for name, (variant, work) in runs.items()}, rounds)
    first = found[next(iter(runs))][0]
    for name, (seconds, (_, attempts)) in found.items():
        variant, work = runs[name]
        short = replace(work, n_periods=ERROR_PERIODS)
        error = np.median(work.error(variant(short)[0], scalar(replace(short, tolerance=REFERENCE_TOLERANCE))[0]))
        n = len(work.initial) * work.n_periods
        print(
            f"{name:{width}}  {1e9 * seconds / attempts:10.1f}  {attempts / n:15.1f}  {1e6 * seconds / n:9.3f}"
            f"  {seconds / first:6.2f}  {error:7.1e}"
        )
    if SECOND in found:
        per_attempt = [found[name][0] / found[name][1][1] for name in (FIRST, SECOND)]
        goal = f" (goal for the pendulum: {GOALS[target()]:g})" if target() in GOALS else ""
        print(f"scalar loop over lanes, per attempt, {target()}: {per_attempt[1] / per_attempt[0]:.2f}{goal}")


def target() -> str:
    """Widest vector instructions that numba compiles for here."""
    if numba.config.CPU_FEATURES is None:
        features = llvmlite.binding.get_host_cpu_features()
        return "AVX-512" if features.get("avx512f") else "AVX2" if features.get("avx2") else "SSE"
    return "AVX-512" if "+avx512f" in numba.config.CPU_FEATURES else "AVX2"


def print_compile_time() -> None:
    """Print what the first call of `run_branches` costs; meant for a process without compile cache."""
    loaded = time.process_time()
    parameters = magpend_core.load_preset()
    start, options = time.process_time(), {"n_transient": 1, "n_keep": 1, "rtol": 1e-6, "atol": 1e-6}
    options["system"] = parameters.model.system
    magpend_core.run_branches(parameters.pack()[None, None], np.full((1, 1), 2.8), np.zeros((1, 4)), **options)
    print(
        f"\nfresh process without compile cache, CPU: imports {loaded:.1f} s, "
        f"first run_branches {time.process_time() - start:.1f} s (goal: at most {COMPILE_GOAL:g} s)"
    )


def print_speed(name: str, work: Work, variants: Mapping[str, Variant], rounds: int) -> None:
    """Print the table of variants, and how well lanes and loop agree."""
    largest = check_agreement(work)
    cpu = numba.config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    title = f"{name}, {target()} ({cpu}): {len(work.initial)} trajectories, {work.n_periods} periods"
    print_table(f"{title}, tolerance {work.tolerance:.0e}", {k: (v, work) for k, v in variants.items()}, rounds)
    print(f"largest scaled difference of the two over {AGREEMENT_PERIODS} periods: {largest:.1e}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print; children measure a part of it with other settings of the compiler."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--trajectories", type=int, default=256)
    parser.add_argument("--periods", type=int, default=40)
    parser.add_argument("--tolerance", type=float, default=1e-6, help="rtol and atol")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--tolerances", type=float, nargs="*", default=[10.0**-k for k in range(4, 11)])
    parser.add_argument("--part", choices=["all", "here", "speed", "compile"], default="all", help="what to print")
    argv = sys.argv[1:] if argv is None else list(argv)
    options = parser.parse_args(argv)
    if options.part == "compile":
        return print_compile_time()
    for name in options.systems:
        work = work_of(name, options.trajectories, options.periods, options.tolerance)
        print_speed(name, work, SPEED if options.part == "speed" else VARIANTS, options.rounds)
        if options.part != "speed" and options.tolerances:
            runs = {f"lanes, {x:.0e}": (lanes, replace(work, tolerance=x)) for x in options.tolerances}
            print_table(f"{name}, over tolerances", runs, options.rounds)
    if options.part == "all":
        sys.stdout.flush()
        parts = [("speed", AVX2)] if target() == "AVX-512" else []
        for part, changes in (*parts, ("compile", UNCACHED)):
            subprocess.run([sys.executable, __file__, *argv, "--part", part], env={**os.environ, **changes}, check=True)
    return None


if __name__ == "__main__":
    main()
