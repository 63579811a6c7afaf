"""Speed of the lane engine beside a scalar twin, in one run.

    python tests/bench/kernel.py

prints, for the same trajectories: microseconds per attempted step, steps per period, the share of
rejected attempts and microseconds per period, of the engine with and without its step limiter, of a
scalar numba twin with the same control (`scalar_twin`) and of one with textbook control; the engine
over tolerances; engine and twin again for AVX2; and the CPU time that a fresh process compiles for.

Without the limiter the same tolerance is met with larger errors: each row has its median error after
a few periods beside it. `work_precision` compares at equal error.

Times are CPU times of one thread, warm, variants in turn, the best of several rounds. Absolute times
belong to the machine; compare the ratios.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import llvmlite.binding
import numba
import numpy as np
from problem import draw_states, scaled_error
from scalar_twin import LIMITED, TEXTBOOK, run_twin

import magpend_core
from magpend_core.engine.jit import source_digest

GOALS = {"AVX-512": 7.0, "AVX2": 4.0}
"""Least ratio of the scalar twin's time to the engine's."""

COMPILE_GOAL = 10.0  # s of CPU

AVX2 = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma", "MAGPEND_CACHE": "0"}
UNCACHED = {"MAGPEND_CACHE": "0"}

# tight and short, so that the step control's rounding is all that tells the two apart
AGREEMENT_TOLERANCE, AGREEMENT_PERIODS, AGREEMENT = 1e-10, 3, 1e-6

REFERENCE_TOLERANCE, ERROR_PERIODS = 1e-12, 5


@dataclass(frozen=True)
class Case:
    """What a variant integrates; `tolerance` is both rtol and atol."""

    parameters: magpend_core.Parameters
    frequency_hz: float
    initial: np.ndarray
    n_periods: int
    tolerance: float


@dataclass(frozen=True)
class Outcome:
    """Sections (n, kept, 4), and accepted and rejected attempts of all trajectories."""

    section: np.ndarray
    accepted: int
    rejected: int


@dataclass(frozen=True)
class Row:
    """Outcome of a timed variant.

    `error` is the median over the trajectories of the scaled error after `ERROR_PERIODS`, `seconds`
    the best round's CPU time.
    """

    name: str
    error: float
    seconds: float
    outcome: Outcome
    case: Case

    @property
    def attempts(self) -> int:
        return self.outcome.accepted + self.outcome.rejected

    @property
    def periods(self) -> int:
        return len(self.case.initial) * self.case.n_periods

    @property
    def us_per_period(self) -> float:
        return 1e6 * self.seconds / self.periods


Variant = Callable[[Case], Outcome]


def lanes(case: Case, n_keep: int = 1) -> Outcome:
    result = magpend_core.sections(
        case.parameters,
        case.frequency_hz,
        case.initial,
        n_transient=case.n_periods - n_keep,
        n_keep=n_keep,
        rtol=case.tolerance,
        atol=case.tolerance,
    )
    return Outcome(result.section, int(result.n_steps.sum()), int(result.n_rejected.sum()))


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


def lanes_without_limiter(case: Case) -> Outcome:
    with no_limiter():
        return lanes(case)


def twin(case: Case, control: str = LIMITED) -> Outcome:
    section, steps = run_twin(control, case.parameters, case.frequency_hz, case.initial, case.n_periods, case.tolerance)
    accepted, rejected = steps.sum(axis=0)
    return Outcome(section, int(accepted), int(rejected))


def textbook_twin(case: Case) -> Outcome:
    return twin(case, TEXTBOOK)


VARIANTS: dict[str, Variant] = {
    "lanes": lanes,
    "scalar twin": twin,
    "scalar twin, textbook control": textbook_twin,
    "lanes, no limiter": lanes_without_limiter,
}
SPEED_VARIANTS = {name: VARIANTS[name] for name in ("lanes", "scalar twin")}


def check_agreement(case: Case) -> float:
    """Largest difference between the engine's and the twin's sections over a short horizon.

    Raises
    ------
    AssertionError
        If it is larger than `AGREEMENT`.
    """
    short = replace(case, n_periods=AGREEMENT_PERIODS, tolerance=AGREEMENT_TOLERANCE)
    largest = float(np.max(scaled_error(lanes(short, n_keep=AGREEMENT_PERIODS).section, twin(short).section)))
    if not largest <= AGREEMENT:
        raise AssertionError(f"lanes and scalar twin differ by {largest:.2g}; expected {AGREEMENT:g} at most.")
    return largest


def reference_states(case: Case) -> np.ndarray:
    """States (n, 4) after `ERROR_PERIODS`, by the scalar twin."""
    return twin(replace(case, n_periods=ERROR_PERIODS, tolerance=REFERENCE_TOLERANCE)).section[:, -1]


def time_in_turn(runs: dict[str, tuple[Variant, Case]], rounds: int, reference: np.ndarray) -> list[Row]:
    """Run all, one after the other, `rounds` times; keep each one's best time."""
    errors = {}
    for name, (variant, case) in runs.items():  # compiles, too
        section = variant(replace(case, n_periods=ERROR_PERIODS)).section
        errors[name] = float(np.median(scaled_error(section[:, -1], reference)))
    best: dict[str, Row] = {}
    for _ in range(rounds):
        for name, (variant, case) in runs.items():
            start = time.thread_time()
            outcome = variant(case)
            seconds = time.thread_time() - start
            if name not in best or seconds < best[name].seconds:
                best[name] = Row(name, errors[name], seconds, outcome, case)
    return list(best.values())


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Print rows; the ratio is a row's time per period over the first row's."""
    width = max(len(row.name) for row in rows)
    print(f"\n{title}")
    print(f"{'':{width}}  us/attempt  steps/period  rejected  us/period   ratio    error")
    for row in rows:
        print(
            f"{row.name:{width}}  {1e6 * row.seconds / row.attempts:10.4f}"
            f"  {row.outcome.accepted / row.periods:12.1f}  {row.outcome.rejected / row.attempts:7.1%} "
            f"  {row.us_per_period:9.2f}  {row.us_per_period / rows[0].us_per_period:6.2f}  {row.error:7.1e}"
        )


def target() -> str:
    """Widest vector instructions that numba compiles for here."""
    if numba.config.CPU_FEATURES is None:
        features = llvmlite.binding.get_host_cpu_features()
        return "AVX-512" if features.get("avx512f") else "AVX2" if features.get("avx2") else "SSE"
    return "AVX-512" if "+avx512f" in numba.config.CPU_FEATURES else "AVX2"


def print_goal(rows: Sequence[Row]) -> None:
    """Print the scalar twin's time per attempt over the lanes', and the goal for this target."""
    per_attempt = {row.name: row.seconds / row.attempts for row in rows}
    ratio = per_attempt["scalar twin"] / per_attempt["lanes"]
    goal = GOALS.get(target())
    wanted = f" (goal: at least {goal:g})" if goal else ""
    print(f"scalar twin over lanes, per attempt, {target()}: {ratio:.2f}{wanted}")


def run_in_child(arguments: Sequence[str], environment: dict[str, str]) -> None:
    """Run this file in a process of its own, whose output joins ours."""
    sys.stdout.flush()
    subprocess.run([sys.executable, __file__, *arguments], env={**os.environ, **environment}, check=True)


def print_compile_time(case: Case) -> None:
    """Print what the first call of `run_branches` costs; meant for a process without compile cache."""
    loaded = time.process_time()
    one = case.initial[:1]
    packed = case.parameters.pack()[None, None]
    start = time.process_time()
    magpend_core.run_branches(
        packed, np.full((1, 1), case.frequency_hz), one, n_transient=1, n_keep=1, rtol=1e-6, atol=1e-6
    )
    seconds = time.process_time() - start
    print(
        f"\nfresh process without compile cache, CPU: imports {loaded:.1f} s, "
        f"first run_branches {seconds:.1f} s (goal: at most {COMPILE_GOAL:g} s)"
    )


def tolerance_runs(case: Case, tolerances: Sequence[float]) -> dict[str, tuple[Variant, Case]]:
    return {f"lanes, tolerance {x:.0e}": (lanes, replace(case, tolerance=x)) for x in tolerances}


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Speed of the lane engine beside a scalar twin.")
    parser.add_argument("--trajectories", type=int, default=256)
    parser.add_argument("--periods", type=int, default=40)
    parser.add_argument("--frequency", type=float, default=2.8, help="of the drive [Hz]")
    parser.add_argument("--tolerance", type=float, default=1e-6, help="rtol and atol")
    parser.add_argument("--eps-drive", type=float, help="steepness of the drive's edges; the preset's if not given")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--tolerances", type=float, nargs="*", default=[10.0**-k for k in range(4, 11)], help="of the second table"
    )
    parser.add_argument(
        "--part", choices=["all", "speed", "compile"], default="all", help="what to print; children use it"
    )
    return parser.parse_args(argv)


def case_of(arguments: argparse.Namespace) -> Case:
    steep = {} if arguments.eps_drive is None else {"eps_drive": arguments.eps_drive}
    return Case(
        parameters=magpend_core.load_preset(**steep),
        frequency_hz=arguments.frequency,
        initial=draw_states(arguments.trajectories, arguments.seed),
        n_periods=arguments.periods,
        tolerance=arguments.tolerance,
    )


def title_of(case: Case) -> str:
    return (
        f"{target()} ({numba.config.CPU_NAME or llvmlite.binding.get_host_cpu_name()}): "
        f"{len(case.initial)} trajectories, {case.n_periods} periods at {case.frequency_hz:g} Hz, "
        f"tolerance {case.tolerance:.0e}, eps_drive {case.parameters['eps_drive']:g}"
    )


def print_speed(case: Case, variants: dict[str, Variant], rounds: int, reference: np.ndarray) -> None:
    """Print the table of variants, the ratio that has a goal, and how well lanes and twin agree."""
    largest = check_agreement(case)
    rows = time_in_turn({name: (variant, case) for name, variant in variants.items()}, rounds, reference)
    print_table(title_of(case), rows)
    print_goal(rows)
    print(
        f"largest scaled difference of lanes and scalar twin over {AGREEMENT_PERIODS} periods "
        f"at tolerance {AGREEMENT_TOLERANCE:.0e}: {largest:.1e}"
    )


def print_all(case: Case, arguments: argparse.Namespace) -> None:
    """Print what this process can measure: the variants and the tolerances."""
    print(f"numba {numba.__version__}, kernel {source_digest()}; ratio: time per period over the first row's;")
    print(f"error: median over the trajectories after {ERROR_PERIODS} periods, rates in units of 10 rad/s")
    reference = reference_states(case)
    print_speed(case, VARIANTS, arguments.rounds, reference)
    if arguments.tolerances:
        rows = time_in_turn(tolerance_runs(case, arguments.tolerances), arguments.rounds, reference)
        print_table("over tolerances", rows)


def main(argv: Sequence[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else list(argv)
    arguments = parse(argv)
    case = case_of(arguments)
    if arguments.part == "compile":
        print_compile_time(case)
    elif arguments.part == "speed":
        print_speed(case, SPEED_VARIANTS, arguments.rounds, reference_states(case))
    else:
        print_all(case, arguments)
        if target() == "AVX-512":
            run_in_child([*argv, "--part", "speed"], AVX2)
        run_in_child([*argv, "--part", "compile"], UNCACHED)


if __name__ == "__main__":
    main()
