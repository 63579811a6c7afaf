"""Equations of folds, Hopf points and branch points of equilibria in two parameters, and the special points on them.

A is the Jacobian; p and q are its left and right singular vectors of the least singular value. "Others" are the
eigenvalues besides the critical ones (Kuznetsov, Elements of Applied Bifurcation Theory, 3rd ed., 2004, Ch. 8 and 10;
Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria, 2000).

============================ ========================= =======================================================
point                        on curves of              test function
============================ ========================= =======================================================
``cusp``                     folds, transcriticals     <p, B(q, q)>
``degenerate_pitchfork``     pitchforks                cubic coefficient, times <p, q>
``bogdanov_takens``          folds; branch points;     <p, q>; the same; kappa
                             Hopf points
``generalised_hopf``         Hopf points               the first Lyapunov coefficient
``zero_hopf``                folds, branch points;     product of l_i + l_j of others; of others
                             Hopf points
``double_hopf``              Hopf points               product of l_i + l_j of others
============================ ========================= =======================================================

A Hopf point is a pair of eigenvalues with the sum 0 and the product kappa, an unknown of its own. So the equations stay
regular where another pair is imaginary (double Hopf), and where kappa, the square of the frequency, passes 0
(Bogdanov-Takens); there the curve ends, since beyond it the pair is real. No test function is a difference quotient.
Points where two curves of branch points cross, or where the critical eigenvalue has no slope along the first parameter,
are not looked for.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from magpend_core.plain_rates import plain_rates
from pipeline.analysis.branches import center_manifold
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.center_manifold import Rest, lyapunov, null_vectors, solved
from pipeline.analysis.branches.codimension_two import (
    BT,
    CUSP,
    DEGENERATE,
    DOUBLE_HOPF,
    GENERALISED_HOPF,
    ZERO_HOPF,
    Detector,
    SpecialPoint,
)
from pipeline.analysis.branches.kinds import FOLD, HOPF, PITCHFORK, TRANSCRITICAL
from pipeline.analysis.branches.lockstep import Steps
from pipeline.analysis.branches.problems import (
    PARAMETER_STEP,
    STATE_STEP,
    Ends,
    Family,
    FamilyProblem,
    Rows,
    Value,
    hopf_test,
)

SINGULAR = 1e-6
"""Largest singular value of the dimensionless equations of a fold at a branch point, and its quadratic term at a
pitchfork."""


@dataclass(eq=False)
class EquilibriumCurve(FamilyProblem):
    """Equations for equilibria at a bifurcation, with two free parameters. Their value needs no integration.

    The unknowns are the states, one number more at Hopf points (kappa) and branch points (the imperfection beta, a
    constant added to the rates along p, which is 0 where the branch point persists), and the parameters.
    """

    family: Family
    kind: str
    unit: float = field(default=0.0, init=False, repr=False)

    @property
    def n_free(self) -> int:  # type: ignore[override]
        """Number of unknowns beside the states."""
        return 2 if self.kind == FOLD else 3

    def start(self, u: np.ndarray, omega: float | None = None) -> np.ndarray:
        """Return unknowns from those of states and parameters; a Hopf point has the angular frequency `omega` [rad/s],
        by default that of the pair nearest to the imaginary axis.
        """
        n = self.family.system.n_states
        if self.kind == FOLD:
            return np.concatenate([u[:n], u[-2:]])
        extra = 0.0
        if self.kind == HOPF:
            jacobian = self._rates(u[None])[1][0]
            values = np.linalg.eigvals(jacobian)
            upper = values[values.imag > 0.0]
            if omega is None and len(upper):
                omega = _nearest_pair(upper)
            extra = ((omega or 0.0) * self._unit_of(jacobian)) ** 2
        return np.concatenate([u[:n], [extra], u[-2:]])

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectories to integrate: the equations for equilibria need none."""
        return self.family.rows(u[None][:0])

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the scaled rates and the conditions of the bifurcation, and their derivatives by central
        differences.
        """
        n, size = self.family.system.n_states, self.size
        steps = np.array([STATE_STEP] * n + [PARAMETER_STEP] * (size - n))
        places = np.concatenate([u[None], u + np.diag(steps), u - np.diag(steps)])
        rates, jacobians = self._rates(places)
        if not (np.isfinite(rates[0]).all() and np.isfinite(jacobians[0]).all()):
            nothing = np.full((size - 1, size), np.nan)
            return Value(nothing[:, 0], nothing, self.family.state(u)[None], jacobians[0], is_rest=True)
        slopes = (rates[1 : 1 + size] - rates[1 + size :])[n:] / (2.0 * PARAMETER_STEP)
        matrices = self.family.scaled(jacobians) * self._unit_of(jacobians[0], slopes)
        found = self._equations(places, rates * self.unit, matrices)
        derivative = (found[1 : 1 + size] - found[1 + size :]).T / (2.0 * steps)
        derivative[:n, :n] = matrices[0]
        seconds = np.nan
        if self.kind == HOPF and u[n] > 0.0:
            seconds = float(2.0 * np.pi * self.unit / np.sqrt(u[n]))
        return Value(found[0], derivative, self.family.rows(u[None]).states, jacobians[0], seconds, is_rest=True)

    def _rates(self, many: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the scaled rates [1/s] and the Jacobians [1/s], not scaled, at several vectors of unknowns."""
        rows, system = self.family.rows(many), self.family.system
        rates, jacobians = plain_rates(system, rows.states, rows.parameters)
        return rates / np.asarray(system.scales), jacobians

    def _unit_of(self, jacobian: np.ndarray, slopes: np.ndarray = np.zeros(0)) -> float:
        """Return the time [s] that makes the rates dimensionless: the inverse of the Jacobian's norm at the first
        call. A Jacobian of one state vanishes at a fold, so that the slopes by the parameters count with it.
        """
        if not self.unit:
            size = float(np.linalg.norm(self.family.scaled(jacobian)))
            if len(jacobian) == 1:
                size = max(size, float(np.linalg.norm(slopes)))
            self.unit = 1.0 / (size or 1.0)
        return self.unit

    def _equations(self, places: np.ndarray, rates: np.ndarray, matrices: np.ndarray) -> np.ndarray:
        """Return the dimensionless equations at several vectors of unknowns, with the singular vectors of the first."""
        # step of the differences by the first parameter inside of the equations of a branch point, of fourth order
        inner = 1e-3
        n = self.family.system.n_states
        if self.kind == HOPF:
            pairs = np.array([pair_near(matrix, u[n]) for matrix, u in zip(matrices, places, strict=True)])
            return np.column_stack([rates, pairs[:, 0], pairs[:, 1] - places[:, n]])
        # of either sign where the singular value is 0 but for rounding, which would turn the imperfection's
        right, left = (v * np.copysign(1.0, v[np.argmax(np.abs(v))]) for v in null_vectors(matrices[0]))
        bordered, last = np.zeros((len(places), n + 1, n + 1)), np.append(np.zeros(n), 1.0)
        bordered[:, :n, :n], bordered[:, :n, n], bordered[:, n, :n] = matrices, left, right
        singular = solved(bordered, last)[:, -1:]
        if self.kind == FOLD:
            return np.hstack([rates, singular])
        shifts = np.zeros((4, self.size))
        shifts[:, n + 1] = inner * np.array([-2.0, -1.0, 1.0, 2.0])
        beside = self._rates((places[:, None] + shifts).reshape(-1, self.size))[0].reshape(len(places), 4, n)
        slopes = np.einsum("kfn,f->kn", beside * self.unit, [1.0, -8.0, 8.0, -1.0]) / (12.0 * inner)
        adjoint = solved(bordered.transpose(0, 2, 1), last)[:, :n]
        along = np.einsum("kn,kn->k", adjoint, slopes)
        return np.hstack([rates + places[:, n : n + 1] * left, singular, along[:, None]])


def pair_near(matrix: np.ndarray, kappa: float) -> tuple[float, float]:
    """Return sum and product of that pair of eigenvalues, complex or real, whose sum is nearest to 0 and whose product
    is nearest to kappa.
    """
    if not np.isfinite(matrix).all():
        return np.nan, np.nan
    values = np.linalg.eigvals(matrix)
    i, j = _pair_at(values, kappa)
    return float((values[i] + values[j]).real), float((values[i] * values[j]).real)


def _pair_at(values: np.ndarray, kappa: float) -> tuple[int, int]:
    i, j = np.triu_indices(len(values), 1)
    sums, products = values[i] + values[j], values[i] * values[j]
    away = np.abs(sums) ** 2 + np.abs(products - kappa)
    k = int(np.argmin(np.where(np.abs(sums.imag) <= 1e-12 * np.abs(values).max(), away, np.inf)))
    return int(i[k]), int(j[k])


# ---- points of codimension two -----------------------------------------------------------------


_Vectors = tuple[np.ndarray, np.ndarray]
"""Right and left null vector of a fold, turned as those at the point before."""


@dataclass(eq=False)
class EquilibriumDetector(Detector):
    """Detector of points of codimension two along a curve of bifurcations of equilibria; it stores the located points
    with the coefficients of their normal forms.
    """

    problem: EquilibriumCurve  # type: ignore[assignment]

    def _tests(self, point: Point, frame: _Vectors | None) -> Steps[tuple[_Vectors, dict[str, float]]]:  # type: ignore[override]
        rest, kind = self._rest(point), self.problem.kind
        right, left = null_vectors(rest.matrix)
        if frame is not None:
            right, left = (v * np.copysign(1.0, v @ w) for v, w in zip((right, left), frame, strict=True))
        if kind == HOPF:
            kappa = float(point.u[len(rest.matrix)])
            others = self._others(point)
            tests = {BT: kappa, ZERO_HOPF: float(np.prod(others * self.problem.unit).real), DOUBLE_HOPF: _pairs(others)}
            tests[GENERALISED_HOPF] = lyapunov(rest, _omega(point))[0] if kappa > 0.0 else np.nan
        else:
            values = np.linalg.eigvals(rest.matrix)
            others = np.delete(values, int(np.argmin(np.abs(values))))
            product = float(left @ right)
            tests = {BT: product, ZERO_HOPF: _pairs(others)}
            if kind == PITCHFORK:  # by symmetry B(q, q) has no part along p
                tests[DEGENERATE] = center_manifold.cusp(rest)["c"] * product
            else:
                tests[CUSP] = float(rest.second(right, right).real @ left)
        return (right, left), tests
        yield  # type: ignore[unreachable]  # a computation that asks for nothing

    def _test(self, kind: str, frame: _Vectors, point: Point) -> Steps[float]:  # type: ignore[override]
        _, values = yield from self._tests(point, frame)
        return values[kind]

    def _rest(self, point: Point) -> Rest:
        family = self.problem.family
        return Rest(family, point.u, point.value.monodromy)

    def _others(self, point: Point) -> np.ndarray:
        """Return the eigenvalues besides the pair of a Hopf point."""
        values = np.linalg.eigvals(point.value.monodromy)
        unit, kappa = self.problem.unit, float(point.u[len(values)])
        return np.delete(values, _pair_at(values * unit, kappa))

    def _named(self, one: SpecialPoint) -> SpecialPoint | None:
        """Return a located point with its coefficients; None if what meets is a neutral saddle."""
        least = 1e-5  # product <p, q>: below it a pitchfork is a double zero, where its cubic coefficient has a pole
        point, rest, is_hopf = one.point, self._rest(one.point), self.problem.kind == HOPF
        if one.kind == CUSP:
            found = partial(center_manifold.cusp, rest)
        elif one.kind == DEGENERATE:
            right, left = null_vectors(rest.matrix)
            if abs(left @ right) < least:
                return None
            found = partial(center_manifold.degenerate_pitchfork, rest)
        elif one.kind == BT:
            found = partial(center_manifold.bogdanov_takens, rest)
        elif one.kind == GENERALISED_HOPF:
            return replace(one, coefficients={"lyapunov2": lyapunov(rest, _omega(point), 5)[1]})
        else:
            values = self._others(point) if is_hopf else np.linalg.eigvals(point.value.monodromy)
            upper = values[values.imag > 0.0]
            if one.kind == ZERO_HOPF and is_hopf:
                found = partial(center_manifold.zero_hopf, rest, _omega(point))
            elif not len(upper) or np.abs(upper.real).min() > 1e-6 * np.abs(upper).max():
                return None
            elif (
                self.problem.kind == PITCHFORK
            ):  # by symmetry the quadratic terms are 0, to which coefficients are ratios
                return one
            else:
                omega = _nearest_pair(upper)
                pairs = sorted((_omega(point), omega)) if is_hopf else [omega]
                form = center_manifold.double_hopf if is_hopf else center_manifold.zero_hopf
                found = partial(form, rest, *pairs)
        return replace(one, coefficients=found())


def _omega(point: Point) -> float:
    return 2.0 * np.pi / point.value.seconds


def _nearest_pair(upper: np.ndarray) -> float:
    """Return the size of that eigenvalue of some which is nearest to the imaginary axis."""
    return float(np.abs(upper[np.argmin(np.abs(upper.real))]))


def _pairs(values: np.ndarray) -> float:
    return hopf_test(values) if len(values) > 1 else 1.0


def kind_of_zero(family: Family, u: np.ndarray, value: Value) -> str:
    """Return the kind of the curve through an equilibrium with an eigenvalue 0, from the value of the equations of a
    fold: these are singular at a branch point that persists in both parameters.
    """
    if not value.is_finite or np.linalg.svd(value.derivative, compute_uv=False)[-1] > SINGULAR:
        return FOLD
    rest = Rest(family, u, value.monodromy)
    right, left = null_vectors(rest.matrix)
    bend = abs(left @ rest.second(right, right).real) / float(np.linalg.norm(rest.matrix))
    return PITCHFORK if bend < SINGULAR else TRANSCRITICAL


def frequencies_at(one: SpecialPoint) -> list[float]:
    """Return the angular frequencies [rad/s] of the imaginary pairs at a point of codimension two of equilibria."""
    n_pairs = {GENERALISED_HOPF: 1, ZERO_HOPF: 1, DOUBLE_HOPF: 2}.get(one.kind, 0)
    values = np.linalg.eigvals(one.point.value.monodromy)
    upper = values[values.imag > 0.0]
    return [float(value) for value in upper[np.argsort(np.abs(upper.real))][:n_pairs].imag]
