"""Times taken in turn, and solvers that race: error and cost of each setting."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magpend_core import run_branches
from magpend_core.engine.system import System

ERRORS = (1e-4, 1e-6, 1e-8)
"""Median errors at which solvers are compared."""

HEAD = f"  {'us per period, ratio':<20}" + "".join(f"{f'error {e:.0e}':>19}" for e in ERRORS)

Runner = Callable[[np.ndarray, int], np.ndarray]
"""From initial states (n, n_states) and a number of periods to the states after them."""


def least(
    functions: Mapping[Any, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.thread_time
) -> dict[Any, tuple[float, Any]]:
    """Return the least time [s] and the result of each function; they take turns, after one call that compiles."""
    found = {name: (math.inf, function()) for name, function in functions.items()}

    def one_round() -> None:
        for name, function in functions.items():
            started = clock()
            result = function()
            found[name] = min(found[name], (clock() - started, result), key=lambda pair: pair[0])

    for i_round in range(rounds):
        deeper(one_round, i_round)
    return found


def deeper(function: Callable[[], None], depth: int) -> None:
    """Call a function from `depth` more frames down the C stack.

    Compiled code spills vectors of 512 bits there, and where these straddle cache lines heyoka runs a quarter
    slower, magpend up to a tenth. The place is random for each process, so each round starts from another depth.
    """
    if depth == 0:
        function()
    else:
        next(map(lambda _: deeper(function, depth - 1), (0,)))


def lanes(system: System, packed: np.ndarray, frequency: float, tolerance: float, on_steps: Any = None) -> Runner:
    """Runner of the engine."""

    def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
        n = len(initial)
        found = run_branches(
            np.tile(packed, (n, 1, 1)),
            np.full((n, 1), frequency),
            initial,
            n_transient=n_periods - 1,
            n_keep=1,
            rtol=tolerance,
            atol=tolerance,
            system=system,
            max_steps_per_period=1_000_000,
        )
        if on_steps is not None:
            on_steps(found)
        return found.section[:, 0, 0]

    return runner


def decades(first: float, last: float, per_decade: int) -> list[float]:
    """Return powers of ten from ``10**-first`` down to ``10**-last``."""
    n = round((last - first) * per_decade)
    return [10.0 ** -(first + i / per_decade) for i in range(n + 1)]


def scaled_error(states: np.ndarray, reference: np.ndarray, is_angle: Any, scales: Any) -> np.ndarray:
    """Return the largest scaled difference of each state, angles compared modulo one turn."""
    difference = states - reference
    turned = np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi
    return np.max(np.abs(np.where(is_angle, turned, difference)) / scales, axis=-1)


@dataclass(frozen=True)
class Contestant:
    """A solver: its settings, and how many trajectories over how many periods it is timed on."""

    name: str
    settings: dict[str, Runner]
    n: int
    periods: int


@dataclass
class Curve:
    """What a solver reaches: median error and CPU time [us] per period and trajectory of each setting."""

    name: str
    setting: list[str] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)

    def front(self) -> tuple[np.ndarray, np.ndarray]:
        """Return errors, falling, and costs of the points that no other point beats in both."""
        order = np.argsort(self.cost)
        error, cost = np.array(self.error)[order], np.array(self.cost)[order]
        error = np.where(np.isfinite(error), error, np.inf)
        keep = error < np.minimum.accumulate(np.append(np.inf, error[:-1]))
        return error[keep], cost[keep]

    def cost_at(self, error: float) -> float:
        """Interpolate the cost [us] of a median error log-log; that of the cheapest where all settings are better."""
        errors, costs = self.front()
        if not len(errors) or error < errors[-1]:
            return math.nan
        return float(np.exp(np.interp(np.log(error), np.log(errors[::-1]), np.log(costs[::-1]))))


def race(
    contestants: Sequence[Contestant],
    initial: np.ndarray,
    error_of: Callable[[Runner], float],
    rounds: int,
    clock: Callable[[], float] = time.thread_time,
) -> list[Curve]:
    """Take the errors of all settings, which also compiles everything, then their least costs; all take turns."""
    errors = {(c.name, name): error_of(runner) for c in contestants for name, runner in c.settings.items()}
    runs = {
        (c.name, name): _timed(runner, initial[: c.n], c.periods)
        for c in contestants
        for name, runner in c.settings.items()
    }
    costs = {key: 1e6 * seconds for key, (seconds, _) in least(runs, rounds, clock).items()}
    return [
        Curve(
            c.name,
            list(c.settings),
            [errors[c.name, name] for name in c.settings],
            [costs[c.name, name] / (min(c.n, len(initial)) * c.periods) for name in c.settings],
        )
        for c in contestants
    ]


def _timed(runner: Runner, initial: np.ndarray, n_periods: int) -> Callable[[], np.ndarray]:
    return lambda: runner(initial, n_periods)


def ratios(curves: list[Curve]) -> Iterator[str]:
    """Yield a line for each solver: its cost over the first one's, at each error."""
    for curve in curves:
        cells = []
        for error in ERRORS:
            own, first = curve.cost_at(error), curves[0].cost_at(error)
            text = f"{own:9.2f} us" + (f" {own / first:6.2f}" if curve is not curves[0] else " " * 7)
            cells.append("-".rjust(19) if math.isnan(own) else text)
        yield f"  {curve.name:<20}" + "".join(cells)


def points(curves: list[Curve]) -> Iterator[str]:
    """Yield every measured point."""
    for curve in curves:
        for setting, error, cost in zip(curve.setting, curve.error, curve.cost, strict=True):
            yield f"    {curve.name:<20}{setting:<14}{error:>12.2e}{cost:>12.3f}"
