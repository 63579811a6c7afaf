"""A pendulum with constant torque, th'' = -0.1 th' + torque - sin(th), and states whose outcome is certain.

The first case of bSTAB (Stender and Hoffmann, Nonlinear Dyn. 107, 1451, 2022).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI, sin

UNDECIDED, REST, ROTATION = -1, 0, 1

DAMPING, TORQUE = 0.1, 0.5

SPEED = 10.0
"""Largest initial speed."""

MARGIN = 1e-6
"""Distance from the unstable manifold, in speed, that counts as above it."""


@inline
def _constants(frequency, p, out):
    out[0] = p[0]
    out[1] = p[1]


@inline
def _no_forcing(t, c):
    return 0.0 * t


@inline
def _rhs(y, u, c):
    return y[1], c[1] - c[0] * y[1] - sin(y[0])


@inline
def _no_edges(frequency, p, times, half_widths, jumps):
    return


@inline
def _no_layers(y, dy, c):
    return ()


@inline
def _jacobian(y, u, c):
    zero = 0.0 * y[0]
    return zero, zero + 1.0, -sin(y[0] + 0.25 * TWO_PI), zero - c[0]


PENDULUM = System(
    name="pendulum_with_torque",
    state_names=("th", "th_dot"),
    is_angle=(True, False),
    scales=(1.0, 1.0),
    parameter_names=("damping", "torque"),
    n_constants=2,
    constants=_constants,
    forcing=_no_forcing,
    rhs=_rhs,
    n_edges=0,
    edges=_no_edges,
    layers=_no_layers,
    jacobian=_jacobian,
    escape=(1e6, 1e3),
    has_layers=False,
)


def draw_starts(n: int, seed: int) -> np.ndarray:
    """Seeded starts (n, 2) in the box of the published case."""
    rest = np.arcsin(TORQUE)
    return np.random.default_rng(seed).uniform((rest - np.pi, -SPEED), (rest + np.pi, SPEED), (n, 2))


@dataclass(frozen=True)
class Regions:
    """Two sets that are never left (see the text of this module).

    Attributes
    ----------
    saddle : float
        Angle of the saddle, the right end of the well.
    torque : float
    manifold : CubicSpline or None
        Speed on the unstable manifold over the angle from one saddle to the next; None if it does not
        come round.
    """

    saddle: float
    torque: float
    manifold: CubicSpline | None

    @classmethod
    def of(cls, torque: float) -> Regions:
        """Regions for a torque between 0 and 1."""
        saddle = np.pi - np.arcsin(torque)
        growth = -0.5 * DAMPING + np.sqrt(0.25 * DAMPING**2 - np.cos(saddle))
        step = 1e-6
        start = (saddle - TWO_PI + step, growth * step)

        def rates(t: float, y: np.ndarray) -> tuple[float, float]:
            return y[1], torque - DAMPING * y[1] - np.sin(y[0])

        def comes_round(t: float, y: np.ndarray) -> float:
            return float(y[0] - saddle)

        def turns_back(t: float, y: np.ndarray) -> float:
            return float(y[1])

        comes_round.terminal = turns_back.terminal = True  # type: ignore[attr-defined]
        found = solve_ivp(
            rates,
            (0.0, 1e3),
            start,
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
            max_step=0.02,
            events=(comes_round, turns_back),
        )
        round_it = len(found.t_events[0]) and found.y[1, -1] > MARGIN
        return cls(saddle, torque, CubicSpline(found.y[0], found.y[1]) if round_it else None)

    def certain(self, states: np.ndarray) -> np.ndarray:
        """Outcome of each state (n, 2) that is certain, else ``UNDECIDED``."""
        angle = self.saddle - np.mod(self.saddle - states[:, 0], TWO_PI)
        speed = states[:, 1]
        label = np.full(len(states), UNDECIDED)
        energy = 0.5 * speed * speed - np.cos(angle) - self.torque * angle
        label[energy < -np.cos(self.saddle) - self.torque * self.saddle] = REST
        if self.manifold is not None:
            label[speed > self.manifold(angle) + MARGIN] = ROTATION
        return label
