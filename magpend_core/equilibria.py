"""Find equilibria of flows by Newton's method, with the eigenvalues of the Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.engine.system import System
from magpend_core.pointwise import jacobian_at, rates_at

TOLERANCE = 1e-10
"""Scaled length of a Newton step at which an equilibrium counts as found."""

TRUST = 0.5
"""Longest Newton step in units of the system's scales."""

RATE_LEFT, RATE_ROUNDING = 1e-8, 1e-14
"""Largest rate that may be left at an equilibrium, relative to the rate at the guess; and the rounding error of a rate,
in units of the state's scale and of the Jacobian's norm.
"""

AT_REST = 1e-5
"""Scaled length of a Newton step up to which the rates themselves vanish at an equilibrium."""


@dataclass(frozen=True, eq=False)
class Equilibria:
    """Equilibria found near given states, one per row, with their eigenvalues.

    Attributes
    ----------
    states : ndarray, (n, n_states)
        The last iterate.
    eigenvalues : ndarray of complex, (n, n_states)
        Of the Jacobian [1/s], by falling real part: their real parts are the Lyapunov exponents.
    residual : ndarray, (n,)
        Scaled length of the Newton step from there: the distance from the equilibrium to first order.
    converged : ndarray of bool, (n,)
        Whether that is within the tolerance, and every rate vanishes: a steady rotation is no equilibrium.
    jacobians : ndarray, (n, n_states, n_states)
        At these states [1/s per unit of the states].
    """

    states: np.ndarray
    eigenvalues: np.ndarray
    residual: np.ndarray
    converged: np.ndarray
    jacobians: np.ndarray

    @property
    def is_stable(self) -> np.ndarray:
        """Whether all eigenvalues of each equilibrium have negative real parts."""
        return np.asarray(self.eigenvalues.real.max(axis=1) < 0.0)


def newton_steps(
    system: System, states: np.ndarray, packed: np.ndarray, met: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Newton step towards an equilibrium, and the Jacobian, at each of several states.

    Parameters
    ----------
    system
        Without a drive.
    states
        Finite ones, shape (n, n_states).
    packed
        Parameters, shape (n_parameters,).
    met
        Largest rates that were met on the way to each state, of its shape; raised here to the rates of `states`.

    Returns
    -------
    steps : ndarray, (n, n_states)
        In the least-squares sense where the Jacobian is singular.
    jacobians : ndarray, (n, n_states, n_states)
    vanishes : ndarray of bool, (n,)
        Whether the step removes every rate, to first order. It does not where an angle turns and the equations do not
        depend on it: the Jacobian is singular there, and a short step proves nothing.
    """
    rates, jacobians = rates_at(system, states, packed), jacobian_at(system, states, packed)
    good = np.isfinite(rates).all(axis=1) & np.isfinite(jacobians).all(axis=(1, 2))
    steps, vanishes = np.full(states.shape, np.nan), np.zeros(len(states), bool)
    own, scales, sizes = jacobians[good], np.asarray(system.scales), np.asarray(system.sizes)
    inverse = np.linalg.pinv(own * sizes / sizes[:, None], rcond=1e-14)
    steps[good] = -np.einsum("nij,nj->ni", inverse, rates[good] / sizes) * sizes
    left = np.abs(rates[good] + np.einsum("nij,nj->ni", own, steps[good]))
    if met is None:
        met = np.zeros(states.shape)
    met[good] = np.maximum(met[good], np.abs(rates[good]))
    norms = np.abs(own * scales / scales[:, None]).max(axis=(1, 2), initial=0.0)
    allowed = np.maximum(RATE_LEFT * met[good], RATE_ROUNDING * max(1.0, system.farthest) * norms[:, None] * scales)
    vanishes[good] = (left <= allowed).all(axis=1)
    return steps, jacobians, vanishes


def find_equilibria(system: System, states: np.ndarray, packed: np.ndarray, *, max_iterations: int = 30) -> Equilibria:
    """Find the equilibria near given states by Newton's method.

    Parameters
    ----------
    system
        Without a drive, with a Jacobian.
    states
        Guesses, shape (n, n_states).
    packed
        Parameters of all, shape (n_parameters,).
    max_iterations
        Limit on the steps.
    """
    found = np.array(states, np.float64)
    scales = np.asarray(system.scales)
    residual = np.full(len(found), np.nan)
    jacobians = np.full((len(found), system.n_states, system.n_states), np.nan)
    met, vanishes = np.zeros(found.shape), np.zeros(len(found), bool)
    rows = np.flatnonzero(np.isfinite(found).all(axis=1))
    for _ in range(max_iterations + 1):
        if not len(rows):
            break
        fastest = met[rows]
        steps, jacobians[rows], vanishes[rows] = newton_steps(system, found[rows], packed, fastest)
        met[rows] = fastest
        residual[rows] = np.abs(steps / scales).max(axis=1)
        going = residual[rows] > 0.01 * TOLERANCE
        rows, steps, lengths = rows[going], steps[going], residual[rows[going]]
        found[rows] += steps * np.minimum(1.0, TRUST / lengths)[:, None]
    converged = (residual <= TOLERANCE) & vanishes
    eigenvalues = np.full((len(found), system.n_states), np.nan, np.complex128)
    for row in np.flatnonzero(converged):
        values = np.linalg.eigvals(jacobians[row])
        eigenvalues[row] = values[np.lexsort((values.imag, -values.real))]
    return Equilibria(found, eigenvalues, residual, converged, jacobians)


def can_hold(system: System) -> bool:
    """Return whether states of a system can slide on a switch, or rest on the surface of an impact."""
    return any(system.slides) or any(system.sticks)


def is_held(system: System, state: np.ndarray, packed: np.ndarray) -> bool:
    """Return whether an equilibrium (n_states,) is one at which a switch or a contact holds the state: the rates do not
    vanish there, but those along the surface do.
    """
    if not can_hold(system):
        return False
    steps, _, vanishes = newton_steps(system, state[None], packed)
    return not (vanishes[0] and np.abs(steps[0] / np.asarray(system.scales)).max() <= AT_REST)
