"""The model as heyoka expressions, and a batch integrator over them that returns sections.

The equations are those of the pendulum's `equations`, written again: they share no code with it. What
differs is forced by heyoka, and costs it nothing:

* All parameters but the drive's frequency are numbers, so that heyoka can fold them.
* ``|v|`` is a `select`: the square root of a square has no Taylor series at v = 0.
* heyoka has no rounding function, so the magnet's angles are not brought back to one turn. The
  trajectories of the benchmark do not rotate.
* The bearing loads are unrolled as `load_sweeps` sweeps of the fixed point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import heyoka as hy
import numpy as np

TWO_OVER_PI = 2.0 / math.pi


@dataclass(frozen=True)
class HeyokaSettings:
    """How heyoka compiles and runs.

    Attributes
    ----------
    batch : int
        Trajectories integrated at once, one per vector element.
    fast_math : bool
        Let LLVM reassociate.
    avx512 : bool
        heyoka's ``force_avx512``: registers of 512 bits instead of 256.
    absolute : str
        Form of ``|v|``: ``"relu"``, ``"select"`` or ``"sqrt"`` (undefined at v = 0).
    load_sweeps : int
        Sweeps of the fixed point of the bearing loads.
    high_accuracy : bool
        heyoka's compensated summation.
    compact : bool
        heyoka's ``compact_mode``: shorter code that compiles faster and runs slower.
    dense : bool
        Sections from the Taylor polynomials (``propagate_grid``) instead of steps that end there.
    """

    batch: int = 8
    fast_math: bool = True
    avx512: bool = True
    absolute: str = "select"
    load_sweeps: int = 3
    high_accuracy: bool = False
    compact: bool = False
    dense: bool = False


def _absolute(v: Any, form: str) -> Any:
    if form == "relu":
        return hy.relu(v) + hy.relu(-v)
    if form == "select":
        return hy.select(hy.lt(v, 0.0), -v, v)
    return hy.sqrt(v * v)


def _stribeck(v: Any, p: dict[str, float], form: str) -> Any:
    """Factor of the dry friction (Eq. 7-8)."""
    decay = (1.0 - p["mu0"]) * hy.exp(-p["c0"] * _absolute(v, form)) + p["mu0"]
    return TWO_OVER_PI * hy.atan(p["eps"] * v) * decay


def _drive(p: dict[str, float]) -> Any:
    """Square wave with the measured duty cycle (Eq. 12-15); par[0] is the angular frequency."""
    phase = (math.pi - 2.0 * math.pi * p["duty_cycle"]) / 2.0
    wave = hy.sin(hy.par[0] * hy.time + phase) - math.sin(phase)
    return (TWO_OVER_PI * p["q"]) * hy.atan(p["eps_drive"] * wave)


def _magnet_moment(psi1: Any, psi_rel: Any, p: dict[str, float]) -> Any:
    """Torque of the magnets about joint 1 (Eq. 18-19)."""
    bumps = []
    for i in "12":
        across = (psi_rel + p[f"beta{i}"]) / p[f"gamma{i}"]
        along = (psi1 + p[f"p{i}"] * psi_rel + p[f"r{i}"]) / p[f"c{i}"]
        bumps.append(0.5 * p[f"alpha{i}"] * hy.exp(-(across**2.0) - along**2.0))
    middle = -0.5 * (p["p1"] + p["p2"]) * psi_rel - 0.5 * (p["r1"] + p["r2"])
    step = TWO_OVER_PI * hy.atan(p["eps_mag"] * (psi1 - middle))
    return (bumps[0] - bumps[1]) * step + (bumps[0] + bumps[1])


def _torques(psi1: Any, psi2: Any, trig: Any, p: dict[str, float]) -> tuple[Any, Any]:
    """Generalised torques of the magnet force (Eq. 20)."""
    s1, c1, s2, c2 = trig
    dx = p["l1"] * s1 + p["l2"] * s2
    dy = p["h"] - p["l1"] * c1 - p["l2"] * c2
    fx = _magnet_moment(psi1, psi2 - psi1, p) / p["h"]
    slope = dy * dx / (dx**2.0 + p["delta"] ** 2)
    return p["l1"] * (fx * (c1 + slope * s1)), p["l2"] * (fx * (c2 + slope * s2))


def accelerations(p: dict[str, float], load_sweeps: int, form: str) -> tuple[list[Any], list[Any]]:
    """State variables and the expressions of the two accelerations (Eq. 1-11)."""
    psi1, psi2, w1, w2 = states = hy.make_vars("psi1", "psi2", "psi1_dot", "psi2_dot")
    s1, c1, s2, _ = trig = hy.sin(psi1), hy.cos(psi1), hy.sin(psi2), hy.cos(psi2)
    s12, c12 = hy.sin(psi1 - psi2), hy.cos(psi1 - psi2)
    w1w1, w2w2, v2 = w1**2.0, w2**2.0, w2 - w1
    m2e2, m2l1 = p["m2"] * p["e2"], p["m2"] * p["l1"]
    b1_inertia = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] * m2l1
    b2_inertia = p["J2"] + p["e2"] * m2e2
    n12_inertia = m2e2 * p["l1"]
    q1, q2 = _torques(psi1, psi2, trig, p)
    g1, g2 = _stribeck(w1, p, form), _stribeck(v2, p, form)
    # the sweeps start from the loads of the hanging pendulum
    weight1, weight2 = (p["m1"] + p["m2"]) * p["g"], p["m2"] * p["g"]
    r2 = (p["T2"] + p["mu"] * weight2) * g2 + p["c"] * v2
    b1 = _drive(p) + q1 - n12_inertia * s12 * w2w2 - (p["m1"] * p["e1"] + m2l1) * p["g"] * s1
    b1 = b1 - (p["T1"] + p["mu"] * weight1) * g1 - 2.0 * p["c"] * w1 + r2
    b2 = q2 + n12_inertia * s12 * w1w1 - m2e2 * p["g"] * s2 - r2
    n12 = n12_inertia * c12
    per_det = 1.0 / (b1_inertia * b2_inertia - n12**2.0)
    free = [(b2_inertia * b1 - n12 * b2) * per_det, (b1_inertia * b2 - n12 * b1) * per_det]
    u1, u2 = p["mu"] * per_det * g1, p["mu"] * per_det * g2
    # the force on joint 2 in the frame of link 1, along and across it, without accelerations
    along = p["m2"] * p["g"] * c1 + m2l1 * w1w1 + m2e2 * w2w2 * c12
    across = p["m2"] * p["g"] * s1 + m2e2 * w2w2 * s12
    along1 = along + p["m1"] * p["g"] * c1 + p["m1"] * p["e1"] * w1w1
    across1 = across + p["m1"] * p["g"] * s1
    a1, a2 = free
    for _ in range(load_sweeps):
        da, dx = m2e2 * s12 * a2, m2e2 * c12 * a2
        load1 = hy.sqrt((along1 - da) ** 2.0 + (across1 + (p["m1"] * p["e1"] + m2l1) * a1 + dx) ** 2.0)
        load2 = hy.sqrt((along - da) ** 2.0 + (across + m2l1 * a1 + dx) ** 2.0)
        x1, x2 = u1 * (load1 - weight1), u2 * (load2 - weight2)
        a1 = free[0] + b2_inertia * (x2 - x1) + n12 * x2
        a2 = free[1] + n12 * (x1 - x2) - b1_inertia * x2
    return list(states), [a1, a2]


def evaluate_accelerations(
    p: dict[str, float], t: np.ndarray, states: np.ndarray, frequency_hz: np.ndarray, settings: HeyokaSettings
) -> np.ndarray:
    """Accelerations (n, 2) [rad/s2] from heyoka's compiled expressions, for checking them."""
    variables, expressions = accelerations(p, settings.load_sweeps, settings.absolute)
    function = hy.cfunc(expressions, variables)
    omega = 2.0 * math.pi * np.ascontiguousarray(frequency_hz)[None, :]
    return function(inputs=np.ascontiguousarray(states.T), pars=omega, time=np.ascontiguousarray(t)).T


class HeyokaSections:
    """One compiled batch integrator, used again for every batch of trajectories."""

    def __init__(self, p: dict[str, float], tolerance: float, settings: HeyokaSettings) -> None:
        states, (a1, a2) = accelerations(p, settings.load_sweeps, settings.absolute)
        right = [states[2], states[3], a1, a2]
        self.settings = settings
        self.integrator = hy.taylor_adaptive_batch(
            list(zip(states, right, strict=True)),
            np.zeros((4, settings.batch)),
            tol=tolerance,
            compact_mode=settings.compact,
            high_accuracy=settings.high_accuracy,
            fast_math=settings.fast_math,
            force_avx512=settings.avx512,
        )

    def __call__(self, frequency_hz: np.ndarray, initial_states: np.ndarray, n_periods: int) -> np.ndarray:
        """Sections (n, n_periods, 4); n must be a multiple of the batch."""
        n, batch = len(initial_states), self.settings.batch
        if n % batch:
            raise ValueError(f"{n} trajectories are no multiple of heyoka's batch of {batch}")
        section = np.empty((n, n_periods, 4))
        for first in range(0, n, batch):
            rows = slice(first, first + batch)
            section[rows] = self._batch(frequency_hz[rows], initial_states[rows], n_periods)
        return section

    def _batch(self, frequency_hz: np.ndarray, initial_states: np.ndarray, n_periods: int) -> np.ndarray:
        ta = self.integrator
        ta.set_time(0.0)
        ta.state[:] = initial_states.T
        ta.pars[0] = 2.0 * math.pi * frequency_hz
        times = np.arange(n_periods + 1)[:, None] / frequency_hz
        if self.settings.dense:
            return np.ascontiguousarray(ta.propagate_grid(times)[1][1:].transpose(2, 0, 1))
        section = np.empty((len(initial_states), n_periods, 4))
        for i in range(n_periods):
            ta.propagate_until(times[i + 1])
            section[:, i] = ta.state.T
        return section
