"""Speed of the engine on a cheap system: the double-well Duffing oscillator, beside a scalar loop.

    python tests/bench/cheap.py

prints, for the same starts, nanoseconds per attempted step and microseconds per start and period, of
the engine and of a plain compiled loop over the starts with the same pair and textbook step control,
whose cosine is libm's; and the engine again while it watches the energy in the last period and in
every period. A right-hand side of a few operations shows what the engine itself costs: stage sums,
step control, bookkeeping.

Times are CPU times of one thread, warm, variants in turn, the best of several rounds. Absolute times
belong to the machine; compare the ratios.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from magpend_core import run_branches
from magpend_core.engine.jit import OPTIONS
from magpend_core.engine.tableau import ERROR, N_STAGES, NODES, STAGES
from magpend_core.models.duffing.system import DUFFING

PARAMETERS = np.array([0.2, -1.0, 1.0, 0.3])
"""Damping, linear and cubic stiffness, amplitude: the twin-well preset."""

FREQUENCY = 1.0 / (2.0 * math.pi)  # Hz

# before chaos tells the two apart
AGREEMENT_PERIODS, AGREEMENT = 3, 1e-5


@dataclass(frozen=True)
class Outcome:
    """States (n, 2) after the last period, and all attempted steps."""

    final: np.ndarray
    attempts: int


@njit(**OPTIONS)
def _rates(t, x, v, p, omega):
    return v, p[3] * math.cos(omega * t) - p[0] * v - x * (p[1] + p[2] * (x * x))


@njit(**OPTIONS)
def _follow(x, v, p, omega, n_periods, tolerance):
    """Return state and attempted steps of one start after `n_periods`."""
    period = 2.0 * math.pi / omega
    kx, kv = np.empty(N_STAGES), np.empty(N_STAGES)
    h, attempts = 1e-3 * period, 0
    for _ in range(n_periods):
        t = 0.0
        kx[0], kv[0] = _rates(t, x, v, p, omega)
        while t < period:
            step = min(h, period - t)
            x_new, v_new = x, v
            for s in range(1, N_STAGES):
                dx, dv = 0.0, 0.0
                for j in range(s):
                    dx += STAGES[s, j] * kx[j]
                    dv += STAGES[s, j] * kv[j]
                x_new, v_new = x + step * dx, v + step * dv
                kx[s], kv[s] = _rates(t + NODES[s] * step, x_new, v_new, p, omega)
            ex, ev = 0.0, 0.0
            for j in range(N_STAGES):
                ex += ERROR[j] * kx[j]
                ev += ERROR[j] * kv[j]
            ex *= step / (tolerance + tolerance * max(abs(x), abs(x_new)))
            ev *= step / (tolerance + tolerance * max(abs(v), abs(v_new)))
            error = math.sqrt(0.5 * (ex * ex + ev * ev))
            attempts += 1
            if error <= 1.0:
                t = period if step == period - t else t + step
                x, v = x_new, v_new
                kx[0], kv[0] = kx[N_STAGES - 1], kv[N_STAGES - 1]
            if step == h or error > 1.0:
                h = step * min(5.0, max(0.2, 0.85 * max(error, 1e-10) ** -0.2))
    return x, v, attempts


@njit(**OPTIONS)
def _loop(starts, p, omega, n_periods, tolerance, final):
    attempts = 0
    for i in range(len(starts)):
        x, v, n = _follow(starts[i, 0], starts[i, 1], p, omega, n_periods, tolerance)
        final[i, 0], final[i, 1] = x, v
        attempts += n
    return attempts


def scalar(starts: np.ndarray, n_periods: int, tolerance: float) -> Outcome:
    final = np.empty_like(starts)
    attempts = _loop(starts, PARAMETERS, 2.0 * math.pi * FREQUENCY, n_periods, tolerance, final)
    return Outcome(final, attempts)


def lanes(
    starts: np.ndarray, n_periods: int, tolerance: float, n_keep: int = 1, quantities: Sequence[str] | None = None
) -> Outcome:
    n = len(starts)
    found = run_branches(
        np.broadcast_to(PARAMETERS, (n, 1, len(PARAMETERS))),
        np.full((n, 1), FREQUENCY),
        starts,
        n_transient=n_periods - n_keep,
        n_keep=n_keep,
        rtol=tolerance,
        atol=tolerance,
        system=DUFFING,
        quantities=quantities,
    )
    return Outcome(found.section[:, 0, -1], int(found.n_steps.sum() + found.n_rejected.sum()))


def watching_last(starts: np.ndarray, n_periods: int, tolerance: float) -> Outcome:
    return lanes(starts, n_periods, tolerance, 1, ["energy"])


def watching_all(starts: np.ndarray, n_periods: int, tolerance: float) -> Outcome:
    return lanes(starts, n_periods, tolerance, n_periods, ["energy"])


Variant = Callable[[np.ndarray, int, float], Outcome]
VARIANTS: dict[str, Variant] = {
    "lanes": lanes,
    "scalar loop": scalar,
    "lanes, energy in the last period": watching_last,
    "lanes, energy in every period": watching_all,
}


def check_agreement(starts: np.ndarray, tolerance: float) -> float:
    """Largest difference between the engine's and the loop's states over a short horizon.

    Raises
    ------
    AssertionError
        If it is larger than `AGREEMENT`, or if watching changes a state.
    """
    plain = lanes(starts, AGREEMENT_PERIODS, tolerance).final
    largest = float(np.max(abs(plain - scalar(starts, AGREEMENT_PERIODS, tolerance).final)))
    if not largest <= AGREEMENT:
        raise AssertionError(f"lanes and loop differ by {largest:.2g}; expected {AGREEMENT:g} at most.")
    if watching_all(starts, AGREEMENT_PERIODS, tolerance).final.tobytes() != plain.tobytes():
        raise AssertionError("watching the energy changes a state.")
    return largest


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Speed of the engine on a cheap system.")
    parser.add_argument("--trajectories", type=int, default=100_000)
    parser.add_argument("--periods", type=int, default=100)
    parser.add_argument("--tolerance", type=float, default=1e-8, help="rtol and atol")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    arguments = parse(sys.argv[1:] if argv is None else argv)
    starts = np.random.default_rng(arguments.seed).uniform(-2.0, 2.0, (arguments.trajectories, 2))
    largest = check_agreement(starts[:200], arguments.tolerance)
    best: dict[str, tuple[float, Outcome]] = {}
    for _ in range(arguments.rounds):
        for name, variant in VARIANTS.items():
            begin = time.thread_time()
            outcome = variant(starts, arguments.periods, arguments.tolerance)
            seconds = time.thread_time() - begin
            if name not in best or seconds < best[name][0]:
                best[name] = seconds, outcome
    n = arguments.trajectories * arguments.periods
    first = best["lanes"][0]
    print(
        f"Duffing, double well: {arguments.trajectories} starts, {arguments.periods} periods, tolerance "
        f"{arguments.tolerance:.0e}; ratio: time over the first row's"
    )
    width = max(map(len, best))
    print(f"{'':{width}}  ns/attempt  attempts/period  us/period  ratio")
    for name, (seconds, outcome) in best.items():
        print(
            f"{name:{width}}  {1e9 * seconds / outcome.attempts:10.1f}  {outcome.attempts / n:15.1f}"
            f"  {1e6 * seconds / n:9.3f}  {seconds / first:5.2f}"
        )
    print(f"largest difference of lanes and loop over {AGREEMENT_PERIODS} periods: {largest:.1e}")


if __name__ == "__main__":
    main()
