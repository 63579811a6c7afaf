"""The model for one trajectory, compiled by numba with libm's functions, for the scalar peers.

Written apart from the pendulum's `equations`, so that the reference solution is independent of them.
The parameters are compile-time constants here; the angular frequency of the drive is an argument.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

TWO_OVER_PI = 2.0 / math.pi
LOAD_SWEEPS = 4
_OPTIONS = {"error_model": "numpy", "fastmath": True, "nogil": True}


def _drive(p: dict[str, float]) -> Any:
    """Driving torque [N m] (Eq. 12-15)."""
    phase = (math.pi - 2.0 * math.pi * p["duty_cycle"]) / 2.0
    offset, amplitude, eps_drive = -math.sin(phase), TWO_OVER_PI * p["q"], p["eps_drive"]

    @njit(**_OPTIONS)
    def drive(t: float, omega: float) -> float:
        return amplitude * math.atan(eps_drive * (math.sin(omega * t + phase) + offset))

    return drive


def _stribeck(p: dict[str, float]) -> Any:
    """Factor of the dry friction (Eq. 7-8)."""
    mu0, c0, eps = p["mu0"], p["c0"], p["eps"]

    @njit(**_OPTIONS)
    def stribeck(v: float) -> float:
        return TWO_OVER_PI * math.atan(eps * v) * ((1.0 - mu0) * math.exp(-c0 * abs(v)) + mu0)

    return stribeck


def _moment(p: dict[str, float]) -> Any:
    """Torque of the magnets about joint 1 [N m] (Eq. 18-19)."""
    alpha1, alpha2, beta1, beta2 = p["alpha1"], p["alpha2"], p["beta1"], p["beta2"]
    gamma1, gamma2, width1, width2 = 1.0 / p["gamma1"], 1.0 / p["gamma2"], 1.0 / p["c1"], 1.0 / p["c2"]
    p1, p2, r1, r2, eps_mag = p["p1"], p["p2"], p["r1"], p["r2"], p["eps_mag"]
    turn = 2.0 * math.pi

    @njit(**_OPTIONS)
    def moment(psi1: float, psi_rel: float) -> float:
        psi1 -= turn * math.floor(psi1 / turn + 0.5)
        psi_rel -= turn * math.floor(psi_rel / turn + 0.5)
        u1, v1 = (psi_rel + beta1) * gamma1, (psi1 + p1 * psi_rel + r1) * width1
        u2, v2 = (psi_rel + beta2) * gamma2, (psi1 + p2 * psi_rel + r2) * width2
        f1 = 0.5 * alpha1 * math.exp(-u1 * u1 - v1 * v1)
        f2 = 0.5 * alpha2 * math.exp(-u2 * u2 - v2 * v2)
        x = psi1 + 0.5 * (p1 + p2) * psi_rel + 0.5 * (r1 + r2)
        return (f1 - f2) * TWO_OVER_PI * math.atan(eps_mag * x) + f1 + f2

    return moment


def _torques(p: dict[str, float]) -> Any:
    """Generalised torques (Q1, Q2) [N m] of the magnet force (Eq. 20)."""
    l1, l2, h, delta = p["l1"], p["l2"], p["h"], p["delta"]
    moment = _moment(p)

    @njit(**_OPTIONS)
    def torques(psi1: float, psi2: float, s1: float, c1: float, s2: float, c2: float) -> Any:
        dx, dy = l1 * s1 + l2 * s2, h - l1 * c1 - l2 * c2
        fx = moment(psi1, psi2 - psi1) / h
        fy = fx * (dy * dx / (dx * dx + delta * delta))
        return l1 * (fx * c1 + fy * s1), l2 * (fx * c2 + fy * s2)

    return torques


def scalar_rhs(p: dict[str, float]) -> Any:
    """Compiled ``rhs(t, y, omega)`` -> time derivatives of the states as a tuple (Eq. 1-11)."""
    g, l1, m1, m2, e1, e2 = p["g"], p["l1"], p["m1"], p["m2"], p["e1"], p["e2"]
    J1, J2, T1, T2, c, mu = p["J1"], p["J2"], p["T1"], p["T2"], p["c"], p["mu"]
    B1, B2, N12 = J1 + e1 * e1 * m1 + l1 * l1 * m2, J2 + e2 * e2 * m2, m2 * e2 * l1
    m2e2, m2l1, m1e1 = m2 * e2, m2 * l1, m1 * e1
    weight1, weight2 = (m1 + m2) * g, m2 * g
    drive, stribeck, torques = _drive(p), _stribeck(p), _torques(p)

    @njit(**_OPTIONS)
    def rhs(t: float, y: Any, omega: float) -> Any:
        psi1, psi2, w1, w2 = y[0], y[1], y[2], y[3]
        s1, c1, s2, c2 = math.sin(psi1), math.cos(psi1), math.sin(psi2), math.cos(psi2)
        s12, c12 = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2
        v2 = w2 - w1
        q1, q2 = torques(psi1, psi2, s1, c1, s2, c2)
        g1, g2 = stribeck(w1), stribeck(v2)
        b1 = drive(t, omega) + q1 - N12 * s12 * w2 * w2 - (m1e1 + m2l1) * g * s1
        b1 -= T1 * g1 + 2.0 * c * w1 - T2 * g2 - c * v2
        b2 = q2 + N12 * s12 * w1 * w1 - m2e2 * g * s2 - T2 * g2 - c * v2
        n12 = N12 * c12
        per_det = 1.0 / (B1 * B2 - n12 * n12)
        along = m2 * g * c1 + m2l1 * w1 * w1 + m2e2 * w2 * w2 * c12
        across = m2 * g * s1 + m2e2 * w2 * w2 * s12
        along1, across1 = along + m1 * g * c1 + m1e1 * w1 * w1, across + m1 * g * s1
        load1, load2 = weight1, weight2
        a1, a2 = 0.0, 0.0
        for sweep in range(LOAD_SWEEPS + 1):
            r1, r2 = mu * load1 * g1, mu * load2 * g2
            a1 = (B2 * (b1 - r1 + r2) - n12 * (b2 - r2)) * per_det
            a2 = (B1 * (b2 - r2) - n12 * (b1 - r1 + r2)) * per_det
            if sweep < LOAD_SWEEPS:
                da, dx = m2e2 * s12 * a2, m2e2 * c12 * a2
                load1 = math.sqrt((along1 - da) ** 2 + (across1 + (m1e1 + m2l1) * a1 + dx) ** 2)
                load2 = math.sqrt((along - da) ** 2 + (across + m2l1 * a1 + dx) ** 2)
        return w1, w2, a1, a2

    return rhs


def evaluate_accelerations(
    p: dict[str, float], t: np.ndarray, states: np.ndarray, frequency_hz: np.ndarray
) -> np.ndarray:
    """Accelerations (n, 2) [rad/s2], for checking them."""
    rhs = scalar_rhs(p)
    rows = zip(t, states, 2.0 * math.pi * frequency_hz, strict=True)
    return np.array([rhs(float(time), state, float(omega))[2:] for time, state, omega in rows])
