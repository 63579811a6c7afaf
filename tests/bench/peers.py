"""magpend's kernel beside other integrators, at equal achieved error.

Run from the repository's root::

    python tests/bench/peers.py                      # both drives, every peer that is installed
    python tests/bench/peers.py --eps-drive 1000 --error-period 10 --points

The same trajectories, from seeded initial states, are integrated by

* ``magpend``: `magpend_core.sections`;
* ``heyoka``: Taylor series in batches, compiled once per tolerance (`heyoka_model`);
* ``numbalsoda``: LSODA and DOP853 in C++ on a compiled right-hand side;
* ``scipy``: `solve_ivp` with DOP853 and RK45 on the same right-hand side.

Every solver is swept over its tolerance (rtol = atol). Its error is the median over the trajectories
of the scaled error at the section after ``--error-period`` periods, against a reference solution;
its cost is CPU time of one thread per period and trajectory, warm, the least of ``--rounds`` rounds.
A round runs all solvers in turn, so that a busy machine slows all alike. The table is read off each
solver's front of best points, by log-log interpolation at the errors 1e-4, 1e-6 and 1e-8.

The motion is not chaotic at the default 2.8 Hz, where it settles on period 1, but transients may
multiply errors: keep ``--error-period`` small. The slow peers are timed on fewer trajectories, and
scipy's errors are medians over these few.

All of it takes about three minutes of CPU time, most of them heyoka's and magpend's eight rounds.

heyoka and numbalsoda are the optional extra ``bench``; a missing one is reported and left out.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scalar_model
from problem import Curve, Problem, Runner, cpu_time, draw_states, median_error, scaled_error
from scalar_peers import numbalsoda_runner, scipy_runner, split_solution

import magpend_core

ERRORS = (1e-4, 1e-6, 1e-8)
"""Median errors at which the solvers are compared."""

CHECKED = 4  # trajectories on which the reference is compared with a second solver


@dataclass(frozen=True)
class Contestant:
    """A solver and how much of it a run can afford.

    Attributes
    ----------
    name : str
    settings : dict of str to Runner
        Runner of each point of the sweep.
    n : int
        Trajectories that are timed.
    n_periods : int
        Periods that are timed.
    rounds : int
    n_error : int
        Trajectories of which the median error is taken.
    """

    name: str
    settings: dict[str, Runner]
    n: int
    n_periods: int
    rounds: int
    n_error: int


def decades(first: float, last: float, per_decade: int = 1) -> list[float]:
    """Powers of ten from ``10**-first`` down to ``10**-last``."""
    n = round((last - first) * per_decade)
    return [10.0 ** -(first + i / per_decade) for i in range(n + 1)]


def magpend_lanes(parameters: magpend_core.Parameters, tolerance: float) -> Runner:
    """Runner of our kernel."""

    def runner(frequency_hz: np.ndarray, initial_states: np.ndarray, n_periods: int) -> np.ndarray:
        options = {"n_transient": 0, "n_keep": n_periods, "rtol": tolerance, "atol": tolerance}
        return magpend_core.sections(parameters, frequency_hz, initial_states, **options).section

    return runner


def reference_solution(
    parameters: magpend_core.Parameters, frequency_hz: np.ndarray, initial_states: np.ndarray, n_periods: int
) -> tuple[np.ndarray, float]:
    """Sections to be taken as true, and their largest difference from a second solver's.

    DOP853 of numbalsoda at a tolerance of 1e-13, compared on a few trajectories with DOP853 of scipy
    that starts anew at each switch of the drive. Without numbalsoda scipy alone serves, on 16
    trajectories, compared with itself at 1e-12. Both use `scalar_model`, which shares no code with
    the kernel.
    """

    def split(n: int, tolerance: float) -> np.ndarray:
        rows = zip(frequency_hz[:n].tolist(), initial_states[:n], strict=True)
        return np.array([split_solution(parameters, f, state, n_periods, tolerance) for f, state in rows])

    try:
        runner = numbalsoda_runner(parameters, "dop853")(1e-13)
        section, second = runner(frequency_hz, initial_states, n_periods), split(CHECKED, 1e-13)
    except ImportError:
        section, second = split(16, 1e-13), split(CHECKED, 1e-12)
    return section, float(np.max(scaled_error(section[:CHECKED], second)))


def build_problem(options: argparse.Namespace, eps_drive: float | None) -> Problem:
    """Draw the trajectories for one drive and solve them for reference."""
    overrides = {} if eps_drive is None else {"eps_drive": eps_drive}
    parameters = magpend_core.load_preset(**overrides)
    frequency_hz = np.full(options.trajectories, options.frequency)
    initial_states = draw_states(options.trajectories, options.seed)
    solution = reference_solution(parameters, frequency_hz, initial_states, options.error_period)
    return Problem(parameters, frequency_hz, initial_states, *solution)


def enter_magpend(problem: Problem, options: argparse.Namespace) -> Iterator[Contestant]:
    """Enter our kernel, swept over rtol = 1e-3 ... 1e-11."""
    settings = {f"{tol:.1e}": magpend_lanes(problem.parameters, tol) for tol in decades(3, 11, 2)}
    n = options.trajectories
    yield Contestant("magpend", settings, n, options.periods, options.rounds, n)


def enter_heyoka(problem: Problem, options: argparse.Namespace) -> Iterator[Contestant]:
    """Enter heyoka with each order and batch width; its front is the best of them.

    heyoka's tolerance sets the order, ``ceil(1 - log(tol)/2)``, and the step follows from the order
    alone: one tolerance per order is a full sweep.
    """
    from heyoka_model import HeyokaSections, HeyokaSettings

    settings = {}
    for batch, order in itertools.product(options.heyoka_batches, range(4, 13)):
        tol = 1.0001 * math.exp(-2.0 * (order - 1))
        setting = HeyokaSettings(
            batch=batch, fast_math=not options.heyoka_strict_math, load_sweeps=options.heyoka_sweeps
        )
        settings[f"{tol:.1e} batch {batch}"] = HeyokaSections(problem.parameters.as_dict(), tol, setting)
    n = min(options.trajectories, 64)
    yield Contestant("heyoka", settings, n, options.periods, options.rounds, options.trajectories)


def enter_numbalsoda(problem: Problem, options: argparse.Namespace) -> Iterator[Contestant]:
    """Enter LSODA and DOP853 in C++."""
    for method in ("lsoda", "dop853"):
        solver = numbalsoda_runner(problem.parameters, method)
        settings = {f"{tol:.1e}": solver(tol) for tol in decades(3, 12)}
        n = min(options.trajectories, 32)
        name = f"numbalsoda {method.upper()}"
        yield Contestant(name, settings, n, options.periods, min(options.rounds, 2), options.trajectories)


def enter_scipy(problem: Problem, options: argparse.Namespace) -> Iterator[Contestant]:
    """Enter scipy's `solve_ivp`, one trajectory after the other."""
    for method, last in (("DOP853", 10), ("RK45", 9)):
        solver = scipy_runner(problem.parameters, method)
        settings = {f"{tol:.1e}": solver(tol) for tol in decades(4, last)}
        n = min(options.trajectories, options.scipy_trajectories)
        yield Contestant(f"scipy {method}", settings, n, options.error_period, 1, n)


ENTRIES: dict[str, Callable[[Problem, argparse.Namespace], Iterator[Contestant]]] = {
    "magpend": enter_magpend,
    "heyoka": enter_heyoka,
    "numbalsoda": enter_numbalsoda,
    "scipy": enter_scipy,
}


def enter_all(problem: Problem, options: argparse.Namespace) -> list[Contestant]:
    """All solvers that were asked for and are installed."""
    contestants: list[Contestant] = []
    for name in options.peers:
        try:
            contestants += ENTRIES[name](problem, options)
        except ImportError as error:
            print(f"{name} is left out: {error} (it comes with the extra `bench`)")
    return contestants


def deeper(function: Callable[[], None], depth: int) -> None:
    """Call a function from `depth` more frames down the C stack."""
    if depth == 0:
        function()
    else:
        next(map(lambda _: deeper(function, depth - 1), (0,)))


def race(contestants: list[Contestant], problem: Problem) -> list[Curve]:
    """Errors of all points, which also warms everything up, then their costs, round by round.

    Each round starts from another depth of the stack. Compiled code spills vectors of 512 bits
    there, and where these straddle cache lines heyoka runs a quarter slower, magpend up to a tenth.
    The place is random for each process; the least cost over the rounds is that of a good place.
    """
    curves = []
    for c in contestants:
        errors = [median_error(runner, problem, c.n_error) for runner in c.settings.values()]
        curves.append(Curve(c.name, list(c.settings), errors, [math.inf] * len(errors)))
    for i_round in range(max(c.rounds for c in contestants)):
        deeper(lambda: time_all(contestants, curves, problem, i_round), i_round)  # noqa: B023
    return curves


def time_all(contestants: list[Contestant], curves: list[Curve], problem: Problem, i_round: int) -> None:
    """One round: lower the costs in `curves` where this round's are less."""
    for c, curve in zip(contestants, curves, strict=True):
        if i_round < c.rounds:
            costs = [cpu_time(runner, problem, c.n, c.n_periods) for runner in c.settings.values()]
            curve.cost = [min(pair) for pair in zip(curve.cost, costs, strict=True)]


def model_differences(parameters: magpend_core.Parameters, seed: int) -> dict[str, float]:
    """Largest relative difference of the accelerations of each peer's model from the kernel's."""
    rng = np.random.default_rng(seed)
    states = rng.uniform(-1.0, 1.0, (64, 4)) * (1.5, 1.5, 10.0, 10.0)
    t, frequency_hz = rng.uniform(0.0, 2.0, 64), rng.uniform(0.1, 3.0, 64)
    rows = zip(t, states, frequency_hz, strict=True)
    ours = np.array([magpend_core.accelerations(time, y, parameters, f) for time, y, f in rows])
    arguments = (parameters.as_dict(), t, states, frequency_hz)
    theirs = {"scalar model": scalar_model.evaluate_accelerations(*arguments)}
    try:
        from heyoka_model import HeyokaSettings, evaluate_accelerations

        for n in (3, 4):
            setting = HeyokaSettings(load_sweeps=n)
            theirs[f"heyoka's with {n} sweeps"] = evaluate_accelerations(*arguments, setting)
    except ImportError:
        pass
    scale = np.abs(ours).max(axis=1, keepdims=True)
    return {name: float(np.max(np.abs(a - ours) / scale)) for name, a in theirs.items()}


def check_models(parameters: magpend_core.Parameters, seed: int) -> str:
    """Say by how much the peers' models differ from the kernel's.

    Raises
    ------
    AssertionError
        If one differs by more than 1e-10: its timings would be of something else.
    """
    differences = model_differences(parameters, seed)
    for name, difference in differences.items():
        if not difference < 1e-10:
            raise AssertionError(f"{name} differs from the kernel by {difference:.1e}, more than 1e-10")
    parts = ", ".join(f"{name} {difference:.1e}" for name, difference in differences.items())
    return f"largest relative difference of accelerations from magpend's: {parts}"


def table(curves: list[Curve]) -> str:
    """Costs at the compared errors, with ratios to the first curve's."""
    head = "".join(f"{f'at {error:.0e}':>20}" for error in ERRORS)
    lines = [f"{'us per period':<20}{head}", f"{'':<20}" + f"{'(ratio)':>20}" * len(ERRORS)]
    for curve in curves:
        cells = []
        for error in ERRORS:
            cost, ours = curve.cost_at(error), curves[0].cost_at(error)
            ratio = f"({cost / ours:.2f})" if math.isfinite(ours) else "(-)"
            cells.append(f"{f'{cost:.3g}  {ratio}' if math.isfinite(cost) else '-':>20}")
        lines.append(f"{curve.name:<20}" + "".join(cells))
    return "\n".join(lines)


def points(curves: list[Curve]) -> str:
    """Every measured point."""
    lines = [f"{'solver':<20}{'setting':<18}{'median error':>14}{'us per period':>15}"]
    for curve in curves:
        for setting, error, cost in zip(curve.setting, curve.error, curve.cost, strict=True):
            lines.append(f"{curve.name:<20}{setting:<18}{error:>14.2e}{cost:>15.2f}")
    return "\n".join(lines)


def drive_steepness(text: str) -> float | None:
    """Value of ``--eps-drive``: a number, or None for the preset's."""
    return None if text == "preset" else float(text)


def parser() -> argparse.ArgumentParser:
    """Command line of the benchmark; the work-precision figure shares it."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--trajectories", type=int, default=256, help="a multiple of 8 (256)")
    p.add_argument("--periods", type=int, default=40, help="drive periods that are timed (40)")
    p.add_argument("--error-period", type=int, default=5, help="section at which errors are taken (5)")
    p.add_argument("--frequency", type=float, default=2.8, help="of the drive [Hz] (2.8)")
    p.add_argument(
        "--eps-drive",
        type=drive_steepness,
        nargs="+",
        default=[None, 1000.0],
        metavar="EPS",
        help="steepness of the drive's edges, or `preset` (both: preset 1000)",
    )
    p.add_argument("--seed", type=int, default=1, help="of the initial states (1)")
    p.add_argument("--rounds", type=int, default=8, help="timed rounds, of which the best counts (8)")
    p.add_argument("--peers", nargs="+", choices=list(ENTRIES), default=list(ENTRIES))
    p.add_argument("--heyoka-batches", type=int, nargs="+", default=[8, 4], help="batch widths (8 4)")
    p.add_argument("--heyoka-sweeps", type=int, default=3, help="sweeps for the bearing loads (3)")
    p.add_argument("--heyoka-strict-math", action="store_true", help="without fast_math")
    p.add_argument("--scipy-trajectories", type=int, default=8, help="trajectories for scipy (8)")
    p.add_argument("--points", action="store_true", help="print every measured point")
    return p


def checked_options(arguments: list[str] | None, p: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line and refuse what no solver could run."""
    options = p.parse_args(arguments)
    if options.trajectories < 8 or options.trajectories % 8:
        p.error(f"--trajectories {options.trajectories} must be a positive multiple of 8")
    if options.peers[0] != "magpend":
        options.peers = ["magpend", *(name for name in options.peers if name != "magpend")]
    return options


def describe(problem: Problem) -> str:
    """Heading of one drive's results."""
    m, n_periods = problem.reference.shape[:2]
    return (
        f"eps_drive = {problem.parameters['eps_drive']:g}, {problem.frequency_hz[0]:g} Hz, "
        f"{len(problem.frequency_hz)} trajectories, median error of {m} at section {n_periods} "
        f"(reference good to {problem.uncertainty:.0e})"
    )


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark and print its tables."""
    options = checked_options(arguments, parser())
    print(check_models(magpend_core.load_preset(), options.seed))
    for eps_drive in options.eps_drive:
        problem = build_problem(options, eps_drive)
        print(f"\n{describe(problem)}", flush=True)
        curves = race(enter_all(problem, options), problem)
        print(table(curves))
        if options.points:
            print(points(curves))


if __name__ == "__main__":
    main()
