"""Define the equations for equilibria of flows along a parameter, and the normal form of their Hopf points.

The first Lyapunov coefficient of a Hopf point decides whether the cycles that leave it are stable
(supercritical, negative) or not. With A q = i w q, A^T p = -i w p, <p, q> = 1, and the second and third
derivatives B and C of the rates (Kuznetsov, Elements of Applied Bifurcation Theory, 3rd ed., 2004, Eq. 5.62)

    c = Re(<p, C(q, q, q')> - 2 <p, B(q, A^-1 B(q, q'))> + <p, B(q', (2 i w - A)^-1 B(q, q))>) / (2 w)

where q' is the conjugate of q. B and C are differences of the analytic Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from magpend_core.engine.system import System
from magpend_core.pointwise import jacobian_at, rates_at
from pipeline.analysis.branches.problems import PARAMETER_STEP, Ends, Family, OrbitProblem, Rows, Value

JACOBIAN_STEP = 1e-3
"""Step of differences of the Jacobian, in units of the system's scales: both truncation and rounding errors of
the third derivatives stay below 1e-6 of the largest."""

LEAST_COEFFICIENT = 1e-6
"""Relative size below which the first Lyapunov coefficient is not told from 0."""


@dataclass(eq=False)
class EquilibriumProblem:
    """Equilibria of a flow, with one free parameter. Nothing is integrated."""

    family: Family
    _unit: float = field(default=0.0, init=False, repr=False)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.family.system.n_states + 1

    @property
    def system(self) -> System:
        """System whose rates vanish."""
        return self.family.system

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectory."""
        return self.family.rows(u[None][:0])

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the scaled rates and their derivative."""
        step = np.zeros(self.size)
        step[-1] = PARAMETER_STEP
        rows, scales = self.family.rows(np.stack([u, u + step, u - step])), np.asarray(self.system.scales)
        rates = [rates_at(self.system, rows.states[:1], p)[0] / scales for p in rows.parameters]
        jacobian = jacobian_at(self.system, rows.states[:1], rows.parameters[0])[0]
        slope = (rates[1] - rates[2]) / (2.0 * PARAMETER_STEP)
        unit = self._unit_of(jacobian)
        derivative = np.column_stack([self.family.scaled(jacobian), slope]) * unit
        return Value(rates[0] * unit, derivative, rows.states[:1], jacobian, is_rest=True)

    def _unit_of(self, jacobian: np.ndarray) -> float:
        """Return the unit of time [s], which the first evaluation chooses: the inverse of the Jacobian's norm."""
        if not self._unit:
            norm = float(np.linalg.norm(self.family.scaled(jacobian)))
            self._unit = 1.0 / norm if norm > 0.0 and np.isfinite(norm) else 1.0
        return self._unit


OneParameter = OrbitProblem | EquilibriumProblem
"""The problems with one free parameter, whose solutions are branches."""


def hopf_test(jacobian: np.ndarray) -> float:
    """Compute the product of the sums of two eigenvalues, each divided by their moduli; zero at a Hopf point."""
    values = np.linalg.eigvals(jacobian)
    i, j = np.triu_indices(len(values), 1)
    sums, sizes = values[i] + values[j], np.abs(values[i]) + np.abs(values[j])
    return float(np.prod(sums / np.where(sizes > 0.0, sizes, 1.0)).real)


def first_lyapunov(family: Family, u: np.ndarray) -> tuple[float, float]:
    """Compute the first Lyapunov coefficient of a Hopf point, and its error from two step sizes.

    Parameters
    ----------
    family
        Of the equilibria.
    u
        Unknowns of the Hopf point.

    Returns
    -------
    coefficient, error : float
        In scaled states, for |q| = 1 [1/s].
    """
    coarse, fine = (_coefficient(family, u, step) for step in (JACOBIAN_STEP, 0.5 * JACOBIAN_STEP))
    return fine, abs(fine - coarse)


def _coefficient(family: Family, u: np.ndarray, step: float) -> float:
    rows, scales = family.rows(u[None]), np.asarray(family.system.scales)
    state, packed = rows.states[0], rows.parameters[0]

    def jacobian(away: np.ndarray) -> np.ndarray:
        return family.scaled(jacobian_at(family.system, (state + away * scales)[None], packed)[0])

    matrix = jacobian(np.zeros(len(state)))
    values, vectors = np.linalg.eig(matrix)
    k = int(np.argmin(np.abs(values.real) + 1e300 * (values.imag <= 0.0)))
    omega, q = float(values[k].imag), vectors[:, k]
    left_values, left = np.linalg.eig(matrix.T)
    p = left[:, int(np.argmin(np.abs(left_values - values[k].conj())))]
    p = p / np.vdot(p, q).conj()

    def second(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """B(a, b) of complex vectors, linear in both."""
        parts = [_directed(jacobian, one, step) @ b for one in (a.real, a.imag)]
        return np.asarray(parts[0] + 1j * parts[1])

    def third(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """C(a, b, c) of complex vectors, linear in all, from C(v, v, .) by polarisation."""
        total = np.zeros(len(q), complex)
        for x, fx in ((a.real, 1.0), (a.imag, 1j)):
            for y, fy in ((b.real, 1.0), (b.imag, 1j)):
                mixed = _curved(jacobian, x + y, step) - _curved(jacobian, x - y, step)
                total += fx * fy * 0.25 * (mixed @ c)
        return total

    bar = q.conj()
    inner = np.linalg.solve(matrix.astype(complex), second(q, bar))
    outer = np.linalg.solve(2j * omega * np.eye(len(q)) - matrix, second(q, q))
    total = third(q, q, bar) - 2.0 * second(q, inner) + second(bar, outer)
    return float(np.vdot(p, total).real / (2.0 * omega))


Jacobian = Callable[[np.ndarray], np.ndarray]
"""From a scaled distance from the equilibrium to the scaled Jacobian there."""


def _directed(jacobian: Jacobian, v: np.ndarray, step: float) -> np.ndarray:
    """First derivative of the Jacobian along `v`."""
    size = float(np.abs(v).max())
    if size == 0.0:
        return np.zeros((len(v), len(v)))
    h = step / size
    return np.asarray((jacobian(h * v) - jacobian(-h * v)) / (2.0 * h))


def _curved(jacobian: Jacobian, v: np.ndarray, step: float) -> np.ndarray:
    """Second derivative of the Jacobian along `v`."""
    size = float(np.abs(v).max())
    if size == 0.0:
        return np.zeros((len(v), len(v)))
    h = step / size
    zero = jacobian(0.0 * v)
    return np.asarray((jacobian(h * v) - 2.0 * zero + jacobian(-h * v)) / (h * h))
