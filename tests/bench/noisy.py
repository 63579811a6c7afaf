"""Speed of steps with noise beside the attempted steps of the deterministic engine, in one run.

    python tests/bench/noisy.py

prints nanoseconds per step and trajectory of both engines for the paper's pendulum and for the twin-well Duffing
oscillator, with noise on each velocity, and how many noisy steps are made in the time of an attempted step without
noise. The goal is at least a quarter of the deterministic engine's steps per second and core.

Times are CPU times of one thread, warm, variants in turn, the best of several rounds. Absolute times belong to the
machine; compare the ratios.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core import load_model, run_branches
from magpend_core.disturbance import Disturbance
from magpend_core.models.model import Model
from magpend_core.models.noisy import noisy
from magpend_core.noisy import noisy_sections

GOAL = 0.25
"""Least ratio of steps per second, with noise over without."""


@dataclass(frozen=True)
class Case:
    """A model with its drive, and the states whose equations have noise."""

    model: Model
    frequency_hz: float
    noisy_states: tuple[str, ...]
    strength: float


CASES = {
    "pendulum": Case(load_model("pendulum"), 2.8, ("psi1_dot", "psi2_dot"), 0.05),
    "duffing": Case(load_model("duffing"), 0.16, ("v",), 0.05),
}


def starts_of(case: Case, n: int) -> np.ndarray:
    """Starts within one scale of rest, shape (n, n_states)."""
    rng = np.random.default_rng(1)
    return rng.uniform(-1.0, 1.0, (n, len(case.model.states))) * np.array(case.model.scales)


def without_noise(case: Case, n: int, n_periods: int, steps: int) -> int:
    """Integrate with error control; return the attempted steps."""
    packed = np.broadcast_to(case.model.load().pack(), (n, 1, len(case.model.parameters)))
    hz = np.full((n, 1), case.frequency_hz)
    options = {"n_transient": n_periods - 1, "n_keep": 1, "rtol": 1e-6, "atol": 1e-6, "system": case.model.system}
    found = run_branches(packed, hz, starts_of(case, n), **options)
    return int(found.n_steps.sum() + found.n_rejected.sum())


def with_noise(case: Case, n: int, n_periods: int, steps: int) -> int:
    """Integrate with noise; return the steps."""
    model = noisy(case.model, Disturbance(tuple((name, case.strength) for name in case.noisy_states)))
    packed = np.tile(model.load().pack(), (n, 1))
    noisy_sections(
        packed,
        np.full(n, case.frequency_hz),
        starts_of(case, n),
        system=model.system,
        noise=model.noise,
        seed=0,
        steps_per_period=steps,
        n_transient=n_periods - 1,
        n_keep=1,
        checks_step=False,
    )
    return n * n_periods * steps


VARIANTS: dict[str, Callable[[Case, int, int, int], int]] = {"without noise": without_noise, "with noise": with_noise}


def nanoseconds(case: Case, n: int, n_periods: int, steps: int, rounds: int) -> dict[str, float]:
    """Time per step and trajectory of each variant [ns]."""
    best = dict.fromkeys(VARIANTS, np.inf)
    for variant in VARIANTS.values():
        variant(case, n, 1, steps)  # compiles
    for _ in range(rounds):
        for name, variant in VARIANTS.items():
            start = time.thread_time()
            made = variant(case, n, n_periods, steps)
            best[name] = min(best[name], 1e9 * (time.thread_time() - start) / made)
    return best


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Speed of steps with noise beside those without.")
    parser.add_argument("--trajectories", type=int, default=256)
    parser.add_argument("--periods", type=int, default=20)
    parser.add_argument("--steps", type=int, default=256, help="per period, with noise")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    arguments = parser.parse_args(sys.argv[1:] if argv is None else list(argv))
    for name in arguments.cases:
        size = arguments.trajectories, arguments.periods, arguments.steps
        found = nanoseconds(CASES[name], *size, arguments.rounds)
        texts = ", ".join(f"{variant} {ns:.1f} ns" for variant, ns in found.items())
        ratio = found["without noise"] / found["with noise"]
        print(f"{name}: {texts}; steps per second with noise over without: {ratio:.2f} (goal: {GOAL:g})")


if __name__ == "__main__":
    main()
