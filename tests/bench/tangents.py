"""What Lyapunov exponents cost on top of the trajectory.

Run it alone on a machine that does nothing else::

    python tests/bench/tangents.py [--trajectories 256] [--periods 480] [--frequency 2.4] [--rounds 5]
        [--exponents 1 2 4]

The same trajectories over the same periods, plain and with so many exponents, in turns and in one process;
CPU time, the least of the rounds. The targets are 2.5 times the plain trajectory for the largest exponent and
6 times for the spectrum.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np

from magpend_core import load_preset, lyapunov_exponents, run_branches

NUMBERS = (1, 2, 4)
TRANSIENT = 200
N_BLOCKS = 16


def variants(
    packed: np.ndarray, frequency: np.ndarray, states: np.ndarray, n_periods: int, numbers: Sequence[int]
) -> dict[str, Callable[[], object]]:
    """What is timed, by name: the plain trajectory and so many exponents, over `n_periods` drive periods."""

    def plain() -> object:
        return run_branches(
            packed[:, None], frequency[:, None], states, n_transient=n_periods - 1, n_keep=1, rtol=1e-8, atol=1e-8
        )

    def exponents(n: int) -> Callable[[], object]:
        return lambda: lyapunov_exponents(
            packed, frequency, states, n_exponents=n, n_transient=0, n_periods=n_periods, n_blocks=N_BLOCKS
        )

    names = {n: f"{n} exponent{'s' * (n > 1)}" for n in numbers}
    return {"plain": plain, **{names[n]: exponents(n) for n in numbers}}


def cpu_seconds(function: Callable[[], object]) -> float:
    """CPU time of one call [s]."""
    started = time.process_time()
    function()
    return time.process_time() - started


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=256)
    parser.add_argument("--periods", type=int, default=480, help=f"a multiple of {N_BLOCKS}")
    parser.add_argument("--frequency", type=float, default=2.4, help="drive frequency [Hz]")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--exponents", type=int, nargs="+", default=NUMBERS, help="how many (1 2 4)")
    options = parser.parse_args(arguments)
    n = options.trajectories
    packed = np.tile(load_preset().pack(), (n, 1))
    frequency = np.full(n, options.frequency)
    starts = np.zeros((n, 4))
    starts[:, :2] = np.random.default_rng(1).uniform(-0.3, 0.3, (n, 2))
    settled = run_branches(
        packed[:, None], frequency[:, None], starts, n_transient=TRANSIENT, n_keep=1, rtol=1e-8, atol=1e-8
    )
    cases = variants(packed, frequency, settled.section[:, 0, -1], options.periods, options.exponents)
    for function in cases.values():
        function()  # compiles
    times = {name: [] for name in cases}
    for _ in range(options.rounds):
        for name, function in cases.items():
            times[name].append(cpu_seconds(function))
    least = {name: min(values) for name, values in times.items()}
    print(f"{n} trajectories, {options.periods} periods at {options.frequency} Hz, tolerance 1e-8, one thread")
    print(f"{'':14s}{'us per period':>15s}{'ratio':>9s}")
    for name, seconds in least.items():
        per_period = 1e6 * seconds / (n * options.periods)
        print(f"{name:14s}{per_period:15.2f}{seconds / least['plain']:9.2f}")


if __name__ == "__main__":
    main()
