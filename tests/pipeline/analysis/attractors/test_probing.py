"""Trajectories beside degenerate orbits and equilibria, on flows whose course is known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from magpend_core.status import Status
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.analysis.attractors.finding.probing import probe_orbit
from pipeline.analysis.attractors.finding.requests import LEG
from pipeline.results.sets import Geometry

PLANE = Geometry((False, False), (1.0, 1.0))


def probed(point: np.ndarray, derivative: np.ndarray, flow: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> float:
    """Distance from which an orbit is approached; ``flow(states, times)`` returns the states (n, time, state)."""
    orbit = Orbit(point[None], np.linalg.eigvals(derivative) + 0j, 1e-12, derivative)
    work, answer = probe_orbit(orbit, PLANE), None
    try:
        while True:
            leg = work.send(answer)
            section = flow(leg.state, np.arange(1.0, LEG + 1.0))
            n = len(section)
            answer = SimpleNamespace(
                status=np.full(n, Status.BOUNDED), state=section[:, -1], section=section, step=np.ones(n)
            )
    except StopIteration as end:
        return float(end.value)


def on_circle(states: np.ndarray, times: np.ndarray) -> np.ndarray:
    """th' = 1 - cos th on the unit circle: cot(th/2) falls with the time."""
    half = np.arctan2(states[:, 1], states[:, 0]) / 2.0
    cot = np.cos(half) / np.sin(half)
    angle = 2.0 * np.arctan2(1.0, cot[:, None] - times)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def by_power(power: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """x' = -x^power, y' = -y."""

    def flow(states: np.ndarray, times: np.ndarray) -> np.ndarray:
        x, y = states[:, 0, None], states[:, 1, None]
        base = 1.0 + (power - 1) * x ** (power - 1) * times
        return np.stack([x / base ** (1.0 / (power - 1)), y * np.exp(-times)], axis=-1)

    return flow


def test_probe_orbit__approached_on_both_sides() -> None:
    found = probed(np.zeros(2), np.diag([1.0, np.exp(-1.0)]), by_power(3))
    assert found == pytest.approx(0.5)


def test_probe_orbit__what_leaves_and_comes_back_around_a_circle_does_not_approach() -> None:
    """The saddle node at (1, 0): trajectories of one side leave it, and return from the other within a leg."""
    assert probed(np.array([1.0, 0.0]), np.diag([0.1, 1.0]), on_circle) == 0.0
