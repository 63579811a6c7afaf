"""Represent the equilibria and limit cycles on which the cells of a parameter point can end."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from pipeline.analysis.attractors.finding.stability import by_margin, largest_error
from pipeline.layout.vocabulary import ATTRACTS, NEUTRAL, UNSTABLE
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import RATE_ERROR, RATE_ROUNDING


@dataclass(frozen=True)
class Equilibrium:
    """An equilibrium of a flow: a state at which the rate of change is zero."""

    state: np.ndarray  # (state,)
    eigenvalues: np.ndarray  # complex, (state,): eigenvalues of the Jacobian [1/s], by falling real part
    residual: float  # scaled length of the last Newton step
    jacobian: np.ndarray  # (state, state): Jacobian in units of the scales [1/s]
    approached_within: float = 0.0  # scaled distance from which trajectories came nearer; 0 if not tried or not seen
    # order of magnitude of the flow's rates [1/s]; the Jacobian of a degenerate equilibrium may vanish
    rate: float = 1.0
    # (state,): if trajectories came nearer on one side only and left on the other: the scaled covector that is 1 on
    # the unit vector towards that side
    side: np.ndarray | None = None

    @cached_property
    def eigenvalue_error(self) -> float:
        """Estimated error of the largest real part of the eigenvalues [1/s]."""
        # the error of the state is its residual, or more if degenerate, and carries over to the Jacobian
        fastest = float(np.abs(self.jacobian).max(initial=self.rate))
        size = max(RATE_ERROR, 1e-4 * float(np.sqrt(self.residual))) * fastest
        # rounding moves a nearly degenerate equilibrium, and its eigenvalues with it; near a fold as a square root
        rounding = fastest * float(np.sqrt(RATE_ROUNDING))
        moved = rounding**2 / max(float(np.abs(self.eigenvalues).min()), rounding)
        return largest_error(self.jacobian, size, real=True) + moved

    @cached_property
    def stability(self) -> int:
        """Stability of the equilibrium, decided by the eigenvalues and their error or, if these do not decide, by
        nearby trajectories.
        """
        found = by_margin(float(self.eigenvalues.real[0]), 0.0, self.eigenvalue_error)
        if found != NEUTRAL or not self.approached_within:
            return found
        return ATTRACTS if self.side is None else UNSTABLE

    @property
    def is_stable(self) -> bool:
        """Whether the equilibrium is shown to attract."""
        return self.stability == ATTRACTS

    def draws(self, states: np.ndarray, geometry: Geometry) -> np.ndarray:
        """Return whether states (n, state) lie where trajectories came nearer to a degenerate equilibrium."""
        away = geometry.difference(states, self.state)
        distance = np.abs(away).max(axis=1, initial=0.0)
        near = distance <= self.approached_within
        return np.asarray(near if self.side is None else near & (away @ self.side >= 0.5 * distance))

    @cached_property
    def _norm(self) -> tuple[np.ndarray, float] | None:
        """Matrix S and rate such that |S x| decays as exp(-rate t) or faster along the linear flow; None if there is no
        such matrix.
        """
        rate = -0.5 * float(self.eigenvalues.real[0])
        shifted = self.jacobian + rate * np.eye(len(self.jacobian))
        try:
            weight = solve_continuous_lyapunov(shifted.T, -np.eye(len(shifted)))
            return np.linalg.cholesky(0.5 * (weight + weight.T)).T, rate
        except np.linalg.LinAlgError:
            return None

    def is_approached(self, section: np.ndarray, seconds: np.ndarray, noise: float, geometry: Geometry) -> np.ndarray:
        """Return for each trajectory whether it follows the linear flow towards the equilibrium, shape (n,).

        With A the Jacobian, t the time between two sections and r = exp(-rate t) the bound on the linear
        flow in its norm, let d be the distances and e = ``|d' - exp(A t) d|`` the error of the linear flow.
        A trajectory approaches if e is at most half of (1 - r)|d| over the younger half of the sections:
        closer to the equilibrium the error is smaller still.

        Parameters
        ----------
        section
            Sections, shape (n, k, state).
        seconds
            Time from the previous section to each, shape (n, k) [s].
        noise
            Scaled error of the sections.
        geometry
            Geometry of the states.
        """
        if self.approached_within or self._norm is None or section.shape[1] < 3:
            return np.zeros(len(section), bool)
        root, rate = self._norm
        half = section.shape[1] // 2
        away = geometry.difference(section[:, half:], self.state)
        times = seconds[:, half + 1 :]
        predicted = np.einsum("nkij,nkj->nki", self._flow(times), away[:, :-1])
        size = np.linalg.norm(away @ root.T, axis=-1)
        error = np.linalg.norm((away[:, 1:] - predicted) @ root.T, axis=-1)
        allowed = 0.5 * (1.0 - np.exp(-rate * times)) * size[:, :-1]
        known = noise * float(np.linalg.norm(root, 2)) * np.sqrt(len(root))
        return np.asarray((error <= allowed + known).all(axis=1) & (size[:, -1] <= size[:, 0] + known))

    def _flow(self, times: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eig(self.jacobian)
        if np.linalg.cond(vectors) > 1e8:  # nearly defective: the eigenvectors are no basis
            return np.asarray(expm(self.jacobian * times[..., None, None]))
        found = (vectors * np.exp(values * times[..., None])[..., None, :]) @ np.linalg.inv(vectors)
        return np.asarray(found.real)


@dataclass(frozen=True)
class Cycle:
    """A stable limit cycle of a flow, by one of its states, its period and its multipliers."""

    state: np.ndarray  # (state,): polished state at which the cycle crosses a level upwards
    crossed: int  # index of the state variable that crosses the level there
    seconds: float  # period [s]
    multipliers: np.ndarray  # complex, (state,): Floquet multipliers by falling modulus; the first is 1, along the flow
    residual: float  # residual of `polish_orbits`

    @property
    def error(self) -> float:
        """Estimated distance of the state from the true cycle, from the residual of Newton's method."""
        return position_error(self.residual, self.multipliers[1:])


def position_error(residual: float, multipliers: np.ndarray) -> float:
    """Estimate the distance of a polished point from the true orbit, from the residual of Newton's method."""
    return float(10.0 * residual / max(np.abs(1.0 - multipliers).min(initial=1.0), 1e-6))
