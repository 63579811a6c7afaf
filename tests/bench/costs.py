"""What crossings, impacts, noise and exponents cost beside the plain engine.

Run it alone on a machine that does nothing else::

    python tests/bench/costs.py [events impacts noise exponents]

* **events**: sections by crossing beside the same flow looked at after fixed times. The shipped flows of two and
  three states have steps that cost next to nothing, so this is the most that events can cost: attempts per return, how
  many of them are there because of the crossing, CPU time of an attempt and of the whole over those of the strobe,
  and how far from the level the sections lie;
* **impacts**: the oscillator with a stop in its way and out of reach;
* **noise**: steps with noise on each velocity beside attempted steps without. The goal is at least a quarter of the
  steps per second;
* **exponents**: so many Lyapunov exponents beside the plain trajectory, over the same periods. The goals are 2.5
  times its time for the largest exponent and 6 times for all four.

CPU times of one thread, warm, variants in turn, the least of the rounds; compare the ratios.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
from racing import least

from magpend_core import Crossing, Parameters, Sections, load_model, lyapunov_exponents, run_branches
from magpend_core.disturbance import Disturbance
from magpend_core.models.noisy import noisy
from magpend_core.noisy import noisy_sections

TOLERANCES = (1e-5, 1e-8, 1e-11)
FLOWS = {
    "van-der-pol": Crossing("v", 0.0, "down", 50.0),
    "rossler": Crossing("y", 0.0, "down", 50.0),
    "lorenz": Crossing("z", 27.0, "up", 50.0),
}
NOISE_GOAL, N_STEPS, STRENGTH = 0.25, 256, 0.05
NOISY = {"pendulum": (2.8, ("psi1_dot", "psi2_dot")), "duffing": (0.16, ("v",))}
"""Drive frequency [Hz], and the states whose equations have noise."""

EXPONENTS, EXPONENTS_HZ, N_BLOCKS = (1, 2, 4), 2.4, 16


def attempts(result: Sections) -> float:
    """Attempted steps per cell."""
    return float((result.n_steps + result.n_rejected).mean())


def run(
    parameters: Parameters,
    frequency: float | None,
    starts: np.ndarray,
    n_periods: int,
    rtol: float,
    section: Crossing | None = None,
) -> Callable[[], Sections]:
    """Return a function that integrates over so many periods or returns."""
    n, half = len(starts), n_periods // 2
    packed = np.tile(parameters.pack(), (n, 1, 1))
    hertz = None if frequency is None else np.full((n, 1), frequency)
    options = {"n_transient": n_periods - half, "n_keep": half, "rtol": rtol, "atol": rtol, "section": section}
    return lambda: run_branches(packed, hertz, starts, system=parameters.model.system, **options)


def starts_of(parameters: Parameters, n: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.0, 2.0, (n, len(parameters.model.states)))


def events(n: int, n_periods: int, rounds: int) -> None:
    print("flow           rtol  attempts/return  for the crossing  CPU/attempt  CPU  off the level")
    for name, section in FLOWS.items():
        parameters = load_model(name).load()
        column, starts = parameters.model.system.state_names.index(section.of), starts_of(parameters, n)
        for rtol in TOLERANCES:
            crossed = run(parameters, None, starts, n_periods, rtol, section)
            # the same time: as long as the returns took, which differ a little from one another
            mean = float(np.nanmean(crossed().return_time))
            strobe = run(parameters, 1.0 / mean, starts, n_periods, rtol)
            (a, plain), (b, found) = least({"strobe": strobe, "crossed": crossed}, rounds).values()
            per_attempt = (b / attempts(found)) / (a / attempts(plain))
            off = np.nanmax(np.abs(found.section[..., column] - section.value))
            extra = (attempts(found) - attempts(plain)) / n_periods
            each = attempts(found) / n_periods
            print(f"{name:<13} {rtol:5.0e} {each:15.1f} {extra:17.2f} {per_attempt:12.2f} {b / a:5.2f} {off:10.1e}")


def impacts(n: int, n_periods: int, rounds: int) -> None:
    print("impact         rtol  attempts/period  without the stop    CPU/attempt  CPU")
    model = load_model("impact")
    for rtol in TOLERANCES:
        starts = starts_of(model.load(), n)
        runs = {gap: run(model.load(gap=gap), 0.16, starts, n_periods, rtol) for gap in (1e6, 1.0)}
        (a, plain), (b, found) = least(runs, rounds).values()
        per_attempt = (b / attempts(found)) / (a / attempts(plain))
        each, free = attempts(found) / n_periods, attempts(plain) / n_periods
        print(f"{'':<13} {rtol:5.0e} {each:15.1f} {free:17.1f} {per_attempt:14.2f} {b / a:5.2f}")


def noise(n: int, n_periods: int, rounds: int) -> None:
    for name, (frequency, states) in NOISY.items():
        parameters = load_model(name).load()
        model = noisy(parameters.model, Disturbance(tuple((state, STRENGTH) for state in states)))
        packed, hertz = np.tile(model.load().pack(), (n, 1)), np.full(n, frequency)
        starts = (starts_of(parameters, n) - 1.0) * np.array(parameters.model.scales)
        options = {"seed": 0, "n_transient": n_periods - 1, "n_keep": 1, "checks_step": False}

        def with_noise(model=model, packed=packed, hertz=hertz, starts=starts, options=options) -> object:
            return noisy_sections(
                packed, hertz, starts, system=model.system, noise=model.noise, steps_per_period=N_STEPS, **options
            )

        runs = {"without": run(parameters, frequency, starts, n_periods, 1e-6), "with": with_noise}
        (a, plain), (b, _) = least(runs, rounds).values()
        plain_ns, noisy_ns = 1e9 * a / (n * attempts(plain)), 1e9 * b / (n * n_periods * N_STEPS)
        print(f"{name}: without noise {plain_ns:.1f} ns, with noise {noisy_ns:.1f} ns a step; ", end="")
        print(f"steps per second with noise over without: {plain_ns / noisy_ns:.2f} (goal: {NOISE_GOAL:g})")


def exponents(n: int, n_periods: int, rounds: int) -> None:
    parameters = load_model("pendulum").load()
    starts = np.zeros((n, 4))
    starts[:, :2] = np.random.default_rng(1).uniform(-0.3, 0.3, (n, 2))
    settled = run(parameters, EXPONENTS_HZ, starts, 200, 1e-8)().section[:, 0, -1]
    packed, hertz = np.tile(parameters.pack(), (n, 1)), np.full(n, EXPONENTS_HZ)
    n_periods = -(-n_periods // N_BLOCKS) * N_BLOCKS
    options = {"n_transient": 0, "n_periods": n_periods, "n_blocks": N_BLOCKS}

    def some(number: int) -> Callable[[], object]:
        return lambda: lyapunov_exponents(
            packed, hertz, settled, n_exponents=number, system=parameters.model.system, **options
        )

    runs = {"plain": run(parameters, EXPONENTS_HZ, settled, n_periods, 1e-8), **{k: some(k) for k in EXPONENTS}}
    found = least(runs, rounds)
    print(f"{'exponents':14s}{'us per period':>15s}{'ratio':>9s}")
    for name, (seconds, _) in found.items():
        print(f"{name!s:14s}{1e6 * seconds / (n * n_periods):15.2f}{seconds / found['plain'][0]:9.2f}")


TABLES = {table.__name__: table for table in (events, impacts, noise, exponents)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"{', '.join(TABLES)}; all by default")
    parser.add_argument("--trajectories", type=int, default=256)
    parser.add_argument("--periods", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    for name in options.tables or TABLES:
        TABLES[name](options.trajectories, options.periods, options.rounds)
        print()


if __name__ == "__main__":
    main()
