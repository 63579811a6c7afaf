"""Define the equations for periodic orbits and for their bifurcations, in scaled unknowns.

Every problem is ``F(u) = 0`` with one unknown more than equations, so that its solutions are curves. A
problem says which trajectories it needs at some `u`, and turns their ends into `F` and its derivative;
the trajectories of many problems run in one call of the engine (see `lockstep`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from magpend_core.engine.system import System
from magpend_core.models.model import Model
from magpend_core.orbits import wrap_angles
from magpend_core.plain_rates import plain_rates
from magpend_core.poincare import Section
from magpend_core.pointwise import rates_packed
from pipeline.layout.vocabulary import FREQUENCY_DIM

FREQUENCY = FREQUENCY_DIM
"""Name of the drive frequency as a free parameter: that of its axis in a cube."""

PARAMETER_STEP = 1e-6
"""Step of central differences by a parameter, in units of its scale.

Neighbouring trajectories take the same steps, so that differences of the map are smooth down to 1e-14:
from 1e-4 to 1e-7 the differences by the frequency agree to 1e-8.
"""

ONE_SIDED_STEP = 1e-7
"""Step of one-sided differences of an orbit by a parameter: its slope needs seven digits for Newton's method."""

STEEP, STEEPEST, SHORTER = 1e2, 10.0, 1e-2
"""Norm of a scaled monodromy matrix, or of the slope by the parameter, above which the map bends over less than this
step; the largest change of a state per unit of the parameter for which the step is then taken along the branch, where
the orbit's image moves no more than its start; and the share of the step that is taken else. Where the slope is large,
as near canards, the step is no longer than one that moves the image by the first norm times the step.
"""

STATE_STEP = 1e-6
"""Step of central differences of the monodromy matrix, in units of the system's scales."""

SMALL_GAP, SMALL_RESIDUAL = 1e-9, 1e-8
"""Largest gap between the periods of an orbit whose residual is small: its multipliers are wanted to nine digits.

Every tolerance of Newton's method on orbits is below `SMALL_RESIDUAL`, so this holds for all that are found.
"""

FAR_GAP, GAP_SHARE = 1e-3, 1e-2
"""Far from the solution: the largest gap, and the largest square of it in units of the residual."""

WIDEST_GAP, MOST_TRIES = 0.05, 6
"""Gap, and number of tries, beyond which an orbit is integrated as a whole."""


@dataclass(frozen=True, eq=False)
class Ends:
    """End points of integrated trajectories, with their derivatives and durations."""

    starts: np.ndarray  # (m, n_states): start states of the trajectories
    images: np.ndarray  # (m, period, n_states): sections after 1, 2, ... drive periods or returns.
    monodromy: np.ndarray  # (m, n_states, n_states): derivative of the last image by the start
    times: np.ndarray  # (m, period): duration of each drive period or return [s]


@dataclass(frozen=True, eq=False)
class Rows:
    """Trajectories to integrate: start states (m, n_states), frequencies (m,) [Hz] and packed parameters (m, k)."""

    states: np.ndarray
    frequency_hz: np.ndarray
    parameters: np.ndarray
    period: int


@dataclass(frozen=True, eq=False)
class Value:
    """Value of a problem's equations F at the unknowns `u`: residual (m,), derivative (m, m + 1), and data of the
    orbit.

    `images` are the orbit's sections, `monodromy` its monodromy matrix, `seconds` its period [s]. For an
    equilibrium (`is_rest`) they are its state, the Jacobian [1/s] and NaN. `graded` are multipliers with more digits
    than the matrix holds, if they are known.
    """

    residual: np.ndarray
    derivative: np.ndarray
    images: np.ndarray
    monodromy: np.ndarray
    seconds: float = np.nan
    is_rest: bool = False
    graded: np.ndarray | None = None

    @cached_property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers, or the eigenvalues of an equilibrium [1/s], in no order."""
        return np.linalg.eigvals(self.monodromy) if self.graded is None else self.graded

    @property
    def is_graded(self) -> bool:
        """Whether the multipliers have more digits than the monodromy matrix holds."""
        return self.graded is not None

    @property
    def is_finite(self) -> bool:
        """Whether all numbers of the residual and the derivative are finite."""
        return bool(np.isfinite(self.residual).all() and np.isfinite(self.derivative).all())


class Problem(Protocol):
    """Equations ``F(u) = 0`` with one more unknown than equations, whose solutions form a curve."""

    @property
    def size(self) -> int:
        """Number of unknowns of the equations."""

    @property
    def system(self) -> System:
        """System whose trajectories are integrated."""

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories to integrate in order to evaluate the equations at `u`."""

    def value(self, u: np.ndarray, ends: Ends) -> Value | None:
        """Compute the equations' value and derivative from the integrated trajectories; None if more trajectories are
        needed.
        """


@dataclass(frozen=True, eq=False)
class Family:
    """Periodic orbits of one period, or equilibria, of a system with one or two free parameters."""

    system: System
    period: int  # in drive periods or returns; 0 for equilibria
    frequency_hz: float  # used unless it is free
    parameters: np.ndarray  # packed vector; entries that are free do not matter
    free: tuple[str, ...]  # names of the free parameters
    scales: tuple[float, ...]  # change of each free parameter that counts as 1

    @property
    def unit(self) -> np.ndarray:
        """Scales of the unknowns: those of the states, then those of the free parameters."""
        return np.array([*self.system.scales, *self.scales])

    def unknowns(self, state: np.ndarray, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Scale a section point and the values of the free parameters; return them as one vector of unknowns."""
        return np.asarray(np.concatenate([state, values]) / self.unit)

    def state(self, u: np.ndarray) -> np.ndarray:
        """Return the section point that the unknowns `u` stand for, in the units of the states, with wrapped angles."""
        n = self.system.n_states
        return wrap_angles(np.asarray(u[:n] * np.asarray(self.system.scales)), self.system)

    def values(self, u: np.ndarray) -> np.ndarray:
        """Return the values of the free parameters that the unknowns `u` stand for: the last ones."""
        return np.asarray(u[len(u) - len(self.scales) :] * np.asarray(self.scales))

    def rows(self, many: np.ndarray) -> Rows:
        """Return the trajectories to integrate over one period of the orbit, one for each vector of unknowns in
        `many`.
        """
        n, first = self.system.n_states, many.shape[1] - len(self.free)
        frequency = np.full(len(many), self.frequency_hz)
        packed = np.tile(self.parameters, (len(many), 1))
        for i, (name, scale) in enumerate(zip(self.free, self.scales, strict=True)):
            column = many[:, first + i] * scale
            if name == FREQUENCY:
                frequency = column
            else:
                packed[:, self.system.parameter_names.index(name)] = column
        return Rows(many[:, :n] * np.asarray(self.system.scales), frequency, packed, self.period)

    def crossing_speeds(self, many: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the speeds across the section at its points (m,), positive in its direction, and the rates of the
        states (m, n_states), both scaled [1/s].
        """
        section, rows = Section(self.system), self.rows(many)
        rates = rates_packed(self.system, rows.states, rows.parameters, rows.frequency_hz)
        rates = rates / np.asarray(self.system.scales)
        normals, _ = section.scaled_normals(rows.states, rows.parameters)
        return section.sign * (normals * rates).sum(axis=1), rates

    def mismatch(self, u: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Compute the scaled difference between the unknowns' section point and its image after one period, with
        wrapped angles.
        """
        scales = np.asarray(self.system.scales)
        start = u[: self.system.n_states] * scales
        return np.asarray(wrap_angles(image - start, self.system) / scales)

    def scaled(self, monodromy: np.ndarray) -> np.ndarray:
        """Convert a monodromy matrix to scaled states."""
        scales = np.asarray(self.system.scales)
        return np.asarray(monodromy * scales / scales[:, None])


@dataclass(frozen=True, eq=False)
class _Segments:
    """Scaled section points (period, n_states) of an orbit, with their derivatives with respect to the unknowns."""

    u: np.ndarray
    points: np.ndarray
    slopes: np.ndarray

    def at(self, u: np.ndarray) -> np.ndarray:
        return np.asarray(self.points + self.slopes @ (u - self.u))


class FamilyProblem:
    """Base of the equations for orbits of one family: the unknowns are the states and the free parameters."""

    n_free: ClassVar[int] = 1
    family: Family

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.family.system.n_states + self.n_free

    @property
    def system(self) -> System:
        """System of the family."""
        return self.family.system


@dataclass(eq=False)
class OrbitProblem(FamilyProblem):
    """Equations for periodic orbits along one free parameter: fixed points of the p-fold stroboscopic or return map.

    An orbit of several periods is evaluated by multiple shooting: all its periods are integrated side by side,
    on lanes that would be idle, from the section points that the last evaluation predicts. Where these miss
    the images of the periods before by too much, they are put there and integrated again (see
    `_is_joined`). A problem serves one computation: it remembers the last orbit.
    """

    family: Family
    _known: _Segments | None = field(default=None, init=False, repr=False)
    _tries: int = field(default=0, init=False, repr=False)
    _beside: np.ndarray | None = field(default=None, init=False, repr=False)  # step to the other orbit, if steep

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories to integrate: the orbit, whole or period by period, also at a slightly changed
        parameter.
        """
        step = np.zeros(self.size)
        step[-1] = ONE_SIDED_STEP
        if self._known is None:
            return self.family.rows(np.stack([u, u + (step if self._beside is None else self._beside)]))
        points = self._known.at(u)
        own = np.column_stack([points, np.full(len(points), u[-1])])
        return replace(self.family.rows(np.concatenate([own, own + step])), period=1)

    def value(self, u: np.ndarray, ends: Ends) -> Value | None:
        """Compute the mismatch of the orbit after one period, and its derivative; None if more trajectories are
        needed.
        """
        is_whole = ends.images.shape[1] == self.family.period
        return self._of_whole(u, ends) if is_whole else self._of_segments(u, ends)

    def _of_whole(self, u: np.ndarray, ends: Ends) -> Value | None:
        n = self.size - 1
        last = [self.family.mismatch(u, image) for image in ends.images[:, -1]]
        monodromy, change = self.family.scaled(ends.monodromy[0]), _wrapped(last[1] - last[0], self.family)
        if self._beside is None:
            slope = change / ONE_SIDED_STEP
        else:
            slope = (change - monodromy @ self._beside[:-1]) / self._beside[-1]
        derivative = np.column_stack([monodromy - np.eye(n), slope])
        found = Value(last[0], derivative, ends.images[0], ends.monodromy[0], float(ends.times[0].sum()))
        if self.family.period == 1 or not found.is_finite or self._tries == MOST_TRIES:
            self._tries = 0
            self._beside = _steep_step(monodromy, derivative) if self.family.period == 1 else None
            return found
        points = np.concatenate([u[None, :n], ends.images[0, :-1] / np.asarray(self.system.scales)])
        self._known = _Segments(u, points, np.zeros((len(points), n, n + 1)))
        return None

    def _of_segments(self, u: np.ndarray, ends: Ends) -> Value | None:
        """Compute the mismatch of the orbit and its derivative from separately integrated periods; None if the gaps
        between them are too wide.
        """
        n, scales = self.size - 1, np.asarray(self.system.scales)
        starts = np.split(ends.starts / scales, 2)[0]
        images, beside = np.split(ends.images[:, 0], 2)
        slopes = _wrapped((beside - images) / scales, self.family) / ONE_SIDED_STEP
        here, by_u, gap = u[:n], np.eye(n, n + 1), 0.0
        points, by_unknowns = [here], [by_u]
        for start, image, monodromy, slope in zip(starts, images, ends.monodromy, slopes, strict=False):
            away, one = _wrapped(here - start, self.family), self.family.scaled(monodromy)
            gap = max(gap, float(np.abs(away).max()))
            here, by_u = image / scales + one @ away, one @ by_u
            by_u[:, -1] += slope
            points.append(here)
            by_unknowns.append(by_u)
        derivative = by_u - np.eye(n, n + 1)
        product = by_u[:, :n] * scales[:, None] / scales
        found = Value(
            _wrapped(here - u[:n], self.family),
            derivative,
            wrap_angles(np.array(points[1:]) * scales, self.system),
            product,
            float(ends.times[: len(starts), 0].sum()),
        )
        self._tries += 1
        self._known = _Segments(u, np.array(points[:-1]), np.array(by_unknowns[:-1]))
        residual = float(np.abs(found.residual).max())
        if found.is_finite and _is_joined(gap, residual):
            self._tries = 0
            return found
        if not found.is_finite or gap > WIDEST_GAP or self._tries >= MOST_TRIES:
            self._known, self._tries = None, MOST_TRIES  # as a whole, this once
        return None


def _steep_step(monodromy: np.ndarray, derivative: np.ndarray) -> np.ndarray | None:
    """Return the step to the orbit that gives the slope by the parameter next, if the monodromy matrix or the slope is
    large.
    """
    if not np.isfinite(derivative).all():
        return None
    step, by_parameter = ONE_SIDED_STEP, float(np.linalg.norm(derivative[:, -1]))
    if np.linalg.norm(monodromy) > STEEP:
        tangent = np.linalg.svd(derivative)[2][-1]
        if np.abs(tangent).max() <= STEEPEST * abs(tangent[-1]):
            return np.asarray(step * tangent / tangent[-1])
        step *= SHORTER
    elif by_parameter <= STEEP:
        return None
    return np.append(np.zeros(len(monodromy)), min(step, ONE_SIDED_STEP * STEEP / by_parameter))


def _is_joined(gap: float, residual: float) -> bool:
    """Return whether the gaps between separately integrated periods are small enough for Newton's next step.

    F errs by the square of the gap, the derivative by the gap. Far from the solution Newton's method needs
    neither to be exact.
    """
    if residual <= SMALL_RESIDUAL:
        return gap <= SMALL_GAP
    return gap <= FAR_GAP and gap * gap <= GAP_SHARE * residual


def _wrapped(difference: np.ndarray, family: Family) -> np.ndarray:
    scales = np.asarray(family.system.scales)
    return np.asarray(wrap_angles(difference * scales, family.system) / scales)


def fold_test(monodromy: np.ndarray) -> Any:
    """Compute det(M - 1) of the monodromy matrix M, which is zero where a multiplier is +1 (fold)."""
    return np.linalg.det(monodromy - np.eye(monodromy.shape[-1]))


def doubling_test(monodromy: np.ndarray) -> Any:
    """Compute det(M + 1) of the monodromy matrix M, which changes sign where a real multiplier passes -1 (period
    doubling).
    """
    return np.linalg.det(monodromy + np.eye(monodromy.shape[-1]))


def torus_test(monodromy: np.ndarray) -> Any:
    """Compute the test function of `torus_product` from the monodromy matrix M."""
    return torus_product(np.linalg.eigvals(monodromy))


def torus_product(multipliers: np.ndarray) -> Any:
    """Compute the product of ``mu_i * mu_j - 1`` over all pairs of multipliers; it is zero at a torus bifurcation.

    The determinant of the bialternate product of M with itself, minus 1 (Kuznetsov, Elements of Applied
    Bifurcation Theory, 3rd ed., 2004, Sect. 10.2.2).
    """
    i, j = np.triu_indices(multipliers.shape[-1], 1)
    return np.prod(multipliers[..., i] * multipliers[..., j] - 1.0, axis=-1).real


TESTS: dict[str, Callable[[np.ndarray], Any]] = {
    "fold": fold_test,
    "period_doubling": doubling_test,
    "neimark_sacker": torus_test,
}
"""Functions of the monodromy matrix, or of a stack of them, that vanish at a bifurcation, by its name."""


@dataclass(frozen=True, eq=False)
class BifurcationProblem(FamilyProblem):
    """Equations for orbits at a bifurcation, with two free parameters: the orbit closes, and a test function is
    zero.
    """

    n_free = 2
    family: Family
    kind: str

    @property
    def _steps(self) -> np.ndarray:
        n = self.family.system.n_states
        return np.array([STATE_STEP] * n + [PARAMETER_STEP] * 2)

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories to integrate: the orbit, and two displaced ones for each unknown, for central
        differences.
        """
        shifts = np.diag(self._steps)
        return self.family.rows(np.concatenate([u[None], u + shifts, u - shifts]))

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the mismatch of the orbit after its period and the bifurcation's test function, with their
        derivatives.
        """
        n, size = self.family.system.n_states, self.size
        tests, finite = np.full(len(ends.monodromy), np.nan), np.isfinite(ends.monodromy).all(axis=(1, 2))
        tests[finite] = TESTS[self.kind](ends.monodromy[finite])
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


@dataclass(eq=False)
class EquilibriumProblem(FamilyProblem):
    """Equations for the equilibria of a flow along one free parameter. Their value needs no integration."""

    family: Family
    _unit: float = field(default=0.0, init=False, repr=False)

    def rows(self, u: np.ndarray) -> Rows:
        """Return an empty set of trajectories: equilibria need no integration."""
        return self.family.rows(u[None][:0])

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the scaled rates at a state, and their derivatives with respect to the state and the parameter."""
        step = np.zeros(self.size)
        step[-1] = PARAMETER_STEP
        rows = self.family.rows(np.stack([u, u + step, u - step]))
        rates, (jacobian, *_) = plain_rates(self.system, rows.states, rows.parameters)
        rates /= np.asarray(self.system.scales)
        unit = self._unit_of(jacobian)
        # the places differ in the parameter alone
        slope = (rates[1] - rates[2]) / (2.0 * PARAMETER_STEP)
        derivative = np.column_stack([self.family.scaled(jacobian), slope]) * unit
        return Value(rates[0] * unit, derivative, rows.states[:1], jacobian, is_rest=True)

    def _unit_of(self, jacobian: np.ndarray) -> float:
        """Return the time [s] that makes the rates dimensionless: the inverse of the Jacobian's norm at the first
        call.
        """
        if not self._unit:
            norm = float(np.linalg.norm(self.family.scaled(jacobian)))
            self._unit = 1.0 / norm if norm > 0.0 and np.isfinite(norm) else 1.0
        return self._unit


class FollowedProblem(Problem, Protocol):
    """Equations of the orbits of a family, whose solutions are a branch."""

    @property
    def family(self) -> Family:
        """Family of the orbits."""


OneParameter = OrbitProblem | EquilibriumProblem
"""The problems with one free parameter, whose solutions are branches."""


def hopf_test(values: np.ndarray) -> float:
    """Compute the product of the normalised sums of all pairs of eigenvalues; it is zero at a Hopf point."""
    i, j = np.triu_indices(len(values), 1)
    sums, sizes = values[i] + values[j], np.abs(values[i]) + np.abs(values[j])
    return float(np.prod(sums / np.where(sizes > 0.0, sizes, 1.0)).real)


def state_units(model: Model | None) -> str:
    """Return the units of the states, separated by commas; "1" if there is no model."""
    return ", ".join(model.state_units) if model is not None else "1"
