"""The trajectories that the benchmarks integrate, and the error and the cost of a run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import magpend_core

SCALES = np.array([1.0, 1.0, 10.0, 10.0])
"""Size of each state that counts as an error of 1 [rad, rad, rad/s, rad/s]."""

Runner = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""From frequencies [Hz] (n,), initial states (n, 4) and periods to sections (n, periods, 4)."""


@dataclass(frozen=True)
class Problem:
    """Trajectories with common parameters, and where they truly are after a few periods.

    Attributes
    ----------
    parameters : magpend_core.Parameters
    frequency_hz : ndarray, (n,)
    initial_states : ndarray, (n, 4)
        At the drive's rising edge [rad, rad/s].
    reference : ndarray, (m, error_period, 4)
        True sections of the first m trajectories, m <= n.
    uncertainty : float
        Largest scaled difference of the reference from a second solver's solution.
    """

    parameters: magpend_core.Parameters
    frequency_hz: np.ndarray
    initial_states: np.ndarray
    reference: np.ndarray
    uncertainty: float


@dataclass
class Curve:
    """What a solver reaches at each tolerance: one line of a work-precision diagram.

    Attributes
    ----------
    name : str
    setting : list of str
        Tolerance and whatever else tells the points apart.
    error : list of float
        Median over the trajectories of the scaled error at the section.
    cost : list of float
        CPU time [us] per period and trajectory.
    """

    name: str
    setting: list[str] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)

    def front(self) -> tuple[np.ndarray, np.ndarray]:
        """Errors, falling, and costs of the points that no other point beats in both."""
        order = np.argsort(self.cost)
        error, cost = np.array(self.error)[order], np.array(self.cost)[order]
        keep = np.isfinite(error) & (error < np.minimum.accumulate(np.append(np.inf, error[:-1])))
        return error[keep], cost[keep]

    def cost_at(self, error: float) -> float:
        """Cost [us] of a median error, interpolated log-log; NaN if the points do not enclose it."""
        errors, costs = self.front()
        if not len(errors) or not errors[-1] <= error <= errors[0]:
            return math.nan
        return float(np.exp(np.interp(np.log(error), np.log(errors[::-1]), np.log(costs[::-1]))))


def draw_states(n: int, seed: int) -> np.ndarray:
    """Seeded initial states (n, 4) in a box about the hanging position; no link rotates from there."""
    box = np.array([0.3, 0.3, 1.0, 1.0])
    return np.random.default_rng(seed).uniform(-box, box, (n, 4))


def scaled_error(states: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest scaled difference of each state, angles compared modulo one turn."""
    difference = states - reference
    difference[..., :2] = np.remainder(difference[..., :2] + np.pi, 2.0 * np.pi) - np.pi
    return np.max(np.abs(difference) / SCALES, axis=-1)


def median_error(runner: Runner, problem: Problem, n: int) -> float:
    """Median over `n` trajectories of the scaled error at the last section of the reference."""
    n = min(n, len(problem.reference))
    reference = problem.reference[:n]
    section = runner(problem.frequency_hz[:n], problem.initial_states[:n], reference.shape[1])
    return float(np.median(scaled_error(section[:, -1], reference[:, -1])))


def cpu_time(runner: Runner, problem: Problem, n: int, n_periods: int) -> float:
    """CPU time of this thread [us] per period and trajectory of one run."""
    frequency_hz, initial_states = problem.frequency_hz[:n], problem.initial_states[:n]
    start = time.thread_time()
    runner(frequency_hz, initial_states, n_periods)
    return 1e6 * (time.thread_time() - start) / (n * n_periods)
