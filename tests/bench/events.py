"""What events cost: sections by crossing beside the same flow looked at after fixed times, and impacts.

Run it alone on a machine that does nothing else::

    python tests/bench/events.py [--trajectories 512] [--periods 40] [--rounds 5] [--flows lorenz ...]

For shipped flows of two and three states, whose steps cost next to nothing, so that this is the most that
events can cost: attempts per return, how many of them are there because of the crossing, CPU time of an
attempt and of the whole over those of the strobe, and how far from the level the sections lie. For the
oscillator with a stop: attempts per drive period and CPU time, with the stop in its way and out of reach.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np

from magpend_core import Crossing, Parameters, Sections, load_model, run_branches

TOLERANCES = (1e-5, 1e-8, 1e-11)
FLOWS = {
    "van-der-pol": (Crossing("v", 0.0, "down", 50.0), 6.6633),
    "rossler": (Crossing("y", 0.0, "down", 50.0), 5.88),
    "lorenz": (Crossing("z", 27.0, "up", 50.0), 0.7512),
}
"""Section of each flow, and about how long a return takes [s]."""


def timed(functions: Sequence[Callable[[], Sections]], rounds: int) -> list[tuple[float, Sections]]:
    """Least CPU time [s] and result of each function; they take turns."""
    found = [(np.inf, function()) for function in functions]
    for _ in range(rounds):
        for i, function in enumerate(functions):
            started = time.process_time()
            result = function()
            found[i] = (min(found[i][0], time.process_time() - started), result)
    return found


def attempts(result: Sections) -> float:
    """Attempted steps per cell."""
    return float((result.n_steps + result.n_rejected).mean())


def runner(
    parameters: Parameters, frequency: float | None, section: Crossing | None, rtol: float, args: argparse.Namespace
) -> Callable[[], Sections]:
    """Return a function that integrates random starts over `args.periods` periods or returns."""
    system, n = parameters.model.system, args.trajectories
    starts = np.random.default_rng(1).uniform(-1.0, 1.0, (n, system.n_states)) + 1.0
    packed = np.tile(parameters.pack(), (n, 1, 1))
    hertz = None if frequency is None else np.full((n, 1), frequency)

    def run() -> Sections:
        return run_branches(
            packed,
            hertz,
            starts,
            n_transient=args.periods // 2,
            n_keep=args.periods // 2,
            rtol=rtol,
            atol=rtol,
            system=system,
            section=section,
        )

    return run


def print_crossings(args: argparse.Namespace) -> None:
    """Table of the flows."""
    print("flow           rtol  attempts/return  for the crossing  CPU/attempt  CPU  off the level")
    for name in args.flows:
        section, duration = FLOWS[name]
        parameters = load_model(name).load()
        column = parameters.model.system.state_names.index(section.of)
        for rtol in TOLERANCES:
            crossed = runner(parameters, None, section, rtol, args)
            # the same time: as long as the returns took, which differ a little from one another
            first = crossed()
            assert first.return_time is not None
            times = first.return_time
            mean = float(np.nanmean(times)) if np.isfinite(times).any() else duration
            (a, plain), (b, found) = timed([runner(parameters, 1.0 / mean, None, rtol, args), crossed], args.rounds)
            n = 2 * (args.periods // 2)
            per_attempt = (b / attempts(found)) / (a / attempts(plain))
            off = np.nanmax(np.abs(found.section[..., column] - section.value))
            extra = (attempts(found) - attempts(plain)) / n
            print(
                f"{name:<13} {rtol:5.0e} {attempts(found) / n:15.1f} {extra:17.2f} {per_attempt:12.2f}"
                f" {b / a:5.2f} {off:10.1e}"
            )


def print_impacts(args: argparse.Namespace) -> None:
    """Table of the oscillator with a stop."""
    print("impact         rtol  attempts/period  without the stop    CPU/attempt  CPU")
    model = load_model("impact")
    for rtol in TOLERANCES:
        runs = [runner(model.load(gap=gap), 0.16, None, rtol, args) for gap in (1e6, 1.0)]
        (a, plain), (b, found) = timed(runs, args.rounds)
        n = 2 * (args.periods // 2)
        per_attempt = (b / attempts(found)) / (a / attempts(plain))
        print(
            f"{'':<13} {rtol:5.0e} {attempts(found) / n:15.1f} {attempts(plain) / n:17.1f}"
            f" {per_attempt:14.2f} {b / a:5.2f}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=512)
    parser.add_argument("--periods", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--flows", nargs="+", choices=FLOWS, default=list(FLOWS))
    args = parser.parse_args(arguments)
    print_crossings(args)
    print()
    print_impacts(args)


if __name__ == "__main__":
    main()
