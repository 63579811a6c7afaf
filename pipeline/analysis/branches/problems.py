"""Define the equations for orbits and for their bifurcations, in scaled unknowns.

Every problem is ``F(u) = 0`` with one unknown more than equations, so that its solutions are curves. A
problem says which trajectories it needs at some `u`, and turns their ends into `F` and its derivative;
the trajectories of many problems run in one call of the engine (see `lockstep`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import wrap_angles
from pipeline.layout.vocabulary import FREQUENCY_DIM

FREQUENCY = FREQUENCY_DIM
"""Name of the drive frequency as a free parameter: that of its axis in a cube."""

PARAMETER_STEP = 1e-6
"""Step of central differences by a parameter, in units of its scale.

Neighbouring trajectories take the same steps, so that differences of the map are smooth down to 1e-14:
from 1e-4 to 1e-7 the differences by the frequency agree to 1e-8.
"""

STATE_STEP = 1e-6
"""Step of central differences of the monodromy matrix, in units of the system's scales."""


@dataclass(frozen=True, eq=False)
class Ends:
    """The ends of the trajectories that a problem requested.

    Attributes
    ----------
    images : ndarray, (m, period, n_states)
        Sections after 1, 2, ... drive periods or returns.
    monodromy : ndarray, (m, n_states, n_states)
        Derivative of the last image by the start.
    times : ndarray, (m, period)
        How long each took [s].
    """

    images: np.ndarray
    monodromy: np.ndarray
    times: np.ndarray


@dataclass(frozen=True, eq=False)
class Rows:
    """Requested trajectories: starts (m, n_states), frequencies (m,) [Hz], packed parameters (m, k)."""

    states: np.ndarray
    frequency_hz: np.ndarray
    parameters: np.ndarray
    period: int


@dataclass(frozen=True, eq=False)
class Value:
    """The value of a problem at `u`: F (m,), its derivative (m, m + 1), and the orbit's data.

    `images` are the orbit's sections, `monodromy` its monodromy matrix, `seconds` its period [s].
    """

    residual: np.ndarray
    derivative: np.ndarray
    images: np.ndarray
    monodromy: np.ndarray
    seconds: float = np.nan

    @property
    def is_finite(self) -> bool:
        """Whether all trajectories arrived."""
        return bool(np.isfinite(self.residual).all() and np.isfinite(self.derivative).all())


class Problem(Protocol):
    """``F(u) = 0`` in one unknown more than equations."""

    @property
    def size(self) -> int:
        """Number of unknowns."""

    @property
    def system(self) -> System:
        """What is integrated."""

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories that the value at `u` needs."""

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute F and its derivative from the trajectories' ends."""


@dataclass(frozen=True, eq=False)
class Family:
    """Orbits of one period with some parameters free.

    Attributes
    ----------
    system : System
    period : int
        In drive periods or returns.
    frequency_hz : float
        Used unless it is free.
    parameters : ndarray
        Packed vector; entries that are free do not matter.
    free : tuple of str
        Names of the free parameters.
    scales : tuple of float
        Change of each free parameter that counts as 1.
    """

    system: System
    period: int
    frequency_hz: float
    parameters: np.ndarray
    free: tuple[str, ...]
    scales: tuple[float, ...]

    @property
    def unit(self) -> np.ndarray:
        """Unit of each unknown: of the states, then of the free parameters."""
        return np.array([*self.system.scales, *self.scales])

    def unknowns(self, state: np.ndarray, values: Sequence[float]) -> np.ndarray:
        """Return the scaled unknowns of a section point and of values of the free parameters."""
        return np.asarray(np.concatenate([state, values]) / self.unit)

    def state(self, u: np.ndarray) -> np.ndarray:
        """Return the section point [the states' units], angles wrapped."""
        n = self.system.n_states
        return wrap_angles(np.asarray(u[:n] * np.asarray(self.system.scales)), self.system)

    def values(self, u: np.ndarray) -> np.ndarray:
        """Return the values of the free parameters."""
        return np.asarray(u[self.system.n_states :] * np.asarray(self.scales))

    def rows(self, many: np.ndarray) -> Rows:
        """Return the trajectories of one period from many unknowns (m, size)."""
        n = self.system.n_states
        frequency = np.full(len(many), self.frequency_hz)
        packed = np.tile(self.parameters, (len(many), 1))
        for i, (name, scale) in enumerate(zip(self.free, self.scales, strict=True)):
            column = many[:, n + i] * scale
            if name == FREQUENCY:
                frequency = column
            else:
                packed[:, self.system.parameter_names.index(name)] = column
        return Rows(many[:, :n] * np.asarray(self.system.scales), frequency, packed, self.period)

    def mismatch(self, u: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Compute the scaled difference between the image and the point, angles on their circle."""
        scales = np.asarray(self.system.scales)
        start = u[: self.system.n_states] * scales
        return np.asarray(wrap_angles(image - start, self.system) / scales)

    def scaled(self, monodromy: np.ndarray) -> np.ndarray:
        """Return the monodromy matrix in scaled states."""
        scales = np.asarray(self.system.scales)
        return np.asarray(monodromy * scales / scales[:, None])


@dataclass(frozen=True, eq=False)
class OrbitProblem:
    """Fixed points of the p-fold stroboscopic or return map, with one free parameter."""

    family: Family

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.family.system.n_states + 1

    @property
    def system(self) -> System:
        """What is integrated."""
        return self.family.system

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories of the orbit and of its two neighbours in the parameter."""
        step = np.zeros(self.size)
        step[-1] = PARAMETER_STEP
        return self.family.rows(np.stack([u, u + step, u - step]))

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the mismatch after the period, and its derivative."""
        n = self.size - 1
        last = [self.family.mismatch(u, image) for image in ends.images[:, -1]]
        slope = _wrapped(last[1] - last[2], self.family) / (2.0 * PARAMETER_STEP)
        matrix = self.family.scaled(ends.monodromy[0]) - np.eye(n)
        derivative = np.column_stack([matrix, slope])
        return Value(last[0], derivative, ends.images[0], ends.monodromy[0], float(ends.times[0].sum()))


def _wrapped(difference: np.ndarray, family: Family) -> np.ndarray:
    scales = np.asarray(family.system.scales)
    return np.asarray(wrap_angles(difference * scales, family.system) / scales)


def fold_test(monodromy: np.ndarray) -> float:
    """Compute det(M - 1), which vanishes where a multiplier is +1."""
    return float(np.linalg.det(monodromy - np.eye(len(monodromy))))


def doubling_test(monodromy: np.ndarray) -> float:
    """Compute det(M + 1), which changes sign where a real multiplier passes -1."""
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def torus_test(monodromy: np.ndarray) -> float:
    """Compute the product of mu_i mu_j - 1 over pairs, zero where two multipliers have the product 1.

    The determinant of the bialternate product of M with itself, minus 1 (Kuznetsov, Elements of Applied
    Bifurcation Theory, 3rd ed., 2004, Sect. 10.2.2).
    """
    multipliers = np.linalg.eigvals(monodromy)
    pairs = [multipliers[i] * multipliers[j] - 1.0 for i, j in combinations(range(len(multipliers)), 2)]
    return float(np.prod(pairs).real)


TESTS: dict[str, Callable[[np.ndarray], float]] = {
    "fold": fold_test,
    "period_doubling": doubling_test,
    "neimark_sacker": torus_test,
}
"""Functions of the monodromy matrix that vanish at a bifurcation, by its name."""


@dataclass(frozen=True, eq=False)
class BifurcationProblem:
    """Orbits at a bifurcation, with two free parameters: the orbit's equations and ``test = 0``."""

    family: Family
    kind: str

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.family.system.n_states + 2

    @property
    def system(self) -> System:
        """What is integrated."""
        return self.family.system

    @property
    def _steps(self) -> np.ndarray:
        n = self.family.system.n_states
        return np.array([STATE_STEP] * n + [PARAMETER_STEP] * 2)

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories of the orbit and of two neighbours in every unknown."""
        shifts = np.diag(self._steps)
        return self.family.rows(np.concatenate([u[None], u + shifts, u - shifts]))

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the mismatch and the test function, with their derivative."""
        n, size = self.family.system.n_states, self.size
        test = TESTS[self.kind]
        tests = np.array([test(m) if np.isfinite(m).all() else np.nan for m in ends.monodromy])
        mismatch = np.array([self.family.mismatch(u, image) for image in ends.images[:, -1]])
        up, down = slice(1 + n, 1 + size), slice(1 + size + n, None)
        slopes = np.array([_wrapped(a - b, self.family) for a, b in zip(mismatch[up], mismatch[down], strict=True)])
        matrix = np.column_stack([self.family.scaled(ends.monodromy[0]) - np.eye(n), slopes.T / (2.0 * PARAMETER_STEP)])
        gradient = (tests[1 : 1 + size] - tests[1 + size :]) / (2.0 * self._steps)
        return Value(
            np.append(mismatch[0], tests[0]),
            np.vstack([matrix, gradient]),
            ends.images[0],
            ends.monodromy[0],
            float(ends.times[0].sum()),
        )
