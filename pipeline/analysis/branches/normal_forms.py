"""Compute normal form coefficients of bifurcations; their signs show whether the bifurcating orbits are stable.

Of orbits the coefficients need the second and third derivatives B and C of the section map along the critical
eigenvectors. They are differences of its exact first derivative A at neighbours of the orbit. With A q = mu q,
A^T p = conj(mu) p, <p, q> = 1, all in scaled states (Kuznetsov, Elements of Applied Bifurcation Theory, 3rd ed., 2004,
Sects. 5.4 and 9.1):

=============== ====================================================================================
fold            <p, B(q, q)> / 2; it vanishes at a cusp
period doubling <p, C(q, q, q) - 3 B(q, (A - 1)^-1 B(q, q))> / 6; positive: supercritical
Neimark-Sacker  Re(conj(mu) <p, C(q, q, q') + 2 B(q, (1 - A)^-1 B(q, q')) + B(q', (mu^2 - A)^-1 B(q, q))>) / 2;
                negative: supercritical
pitchfork       <p, C(q, q, q) - 3 B(q, (A - 1)^+ B(q, q))> / 6; negative: supercritical
transcritical   <p, B(q, q)> / 2, which is 0 at a pitchfork
=============== ====================================================================================

q' is the conjugate of q, and ^+ the inverse on the complement of q. Each coefficient is computed with |q| = 1 at the
section point, and with steps of many sizes. The one that changes least from size to size is taken; the change is its
error. Then q gets the norm of `critical_motion`, which does not depend on the section. Quadratic coefficients have no
sign, since q has none. Those of equilibria are coefficients of the flow on the centre manifold (`center_manifold`), of
a Hopf point the first Lyapunov coefficient; negative: supercritical.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core.engine.system import System
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.bifurcations import CONTRADICTORY, Bifurcation
from pipeline.analysis.branches.center_manifold import Rest, lyapunov, normal_form, null_vectors, solved
from pipeline.analysis.branches.critical_motion import Critical, mean_squares
from pipeline.analysis.branches.kinds import BRANCHING, DOUBLING, FOLD, HOPF, PITCHFORK, TORUS, TRANSCRITICAL
from pipeline.analysis.branches.lockstep import integrated
from pipeline.analysis.branches.problems import Ends, Family, Rows, Value
from pipeline.products.reporting import track

STEPS = 0.125 * 2.0 ** -np.arange(13.0)
"""Sizes of the steps in units of the system's scales. The largest fit smooth maps, the smallest maps that are
strongly bent over one period."""


@dataclass(frozen=True, eq=False)
class Bend:
    """First and second derivatives (n, n) of the monodromy matrix or Jacobian along one direction."""

    first: np.ndarray
    second: np.ndarray


class Case:
    """An orbit or equilibrium at a bifurcation: its monodromy matrix or Jacobian, and the critical eigenvectors.

    Parameters
    ----------
    family, kind, u
        Family of the orbit, kind of bifurcation, and scaled unknowns.
    monodromy
        Derivative of the section map, or the Jacobian [1/s].
    steps
        Sizes of the steps, each half of the one before.
    towards
        Eigenvector to whose side the critical one is turned; by default it has any sign.
    """

    def __init__(
        self,
        family: Family,
        kind: str,
        u: np.ndarray,
        monodromy: np.ndarray,
        steps: np.ndarray = STEPS,
        towards: np.ndarray | None = None,
    ) -> None:
        self.family, self.kind, self.u, self.steps = family, kind, u, steps
        self.matrix = family.scaled(monodromy)
        self.critical, self.q, self.p = critical_vectors(self.matrix, kind)
        if towards is not None and np.vdot(towards, self.q).real < 0.0:
            self.q, self.p = -self.q, -self.p

    def neighbours(self) -> np.ndarray:
        """Return scaled unknowns displaced along the critical eigenvector to both sides, as points for finite
        differences.
        """
        parts = [self.q.real, self.q.imag] if self.kind == TORUS else [self.q.real]
        shifts = np.concatenate([np.outer(sign * self.steps, part) for part in parts for sign in (1.0, -1.0)])
        return np.asarray(self.u + np.pad(shifts, ((0, 0), (0, len(self.u) - len(self.q)))))

    def coefficients(self, form: Form, neighbours: np.ndarray) -> np.ndarray:
        """Compute a normal form coefficient by finite differences, for each step size except the largest.

        `neighbours` are the derivatives of the map at `self.neighbours()`, unscaled.
        """
        scaled = np.array([self.family.scaled(one) for one in neighbours])
        parts = np.split(scaled, len(scaled) // (2 * len(self.steps)))
        halves = [np.split(part, 2) for part in parts]
        bends = [_bend(self.matrix, ahead, behind, self.steps) for ahead, behind in halves]
        return np.array([form(self, [one[k] for one in bends]) for k in range(len(self.steps) - 1)])


def judge(bifurcations: Sequence[tuple[Family, Bifurcation]]) -> None:
    """Compute the normal form coefficients of bifurcations. Store in them their criticality and the kinds of branch
    points.
    """
    for family, one in bifurcations:
        if not family.period:
            _judge_rest(family, one)
    ones = [(family, one) for family, one in bifurcations if family.period]
    cases = [Case(family, one.kind, one.point.u, one.point.value.monodromy) for family, one in ones]
    told = track(list(zip(ones, cases, _matrices(cases), strict=True)), "computing normal forms")
    for (_, one), case, matrices in told:
        if one.kind == BRANCHING:
            forms = (settled(case.coefficients(form, matrices)) for form in (_quadratic, _cubic, _size))
            (square, error, _), (cubic, cubic_error, _), (size, *_) = forms
            _tell_branch_point(one, (square, error), (cubic, cubic_error), size)
        else:
            one.coefficient, one.coefficient_error, _ = settled(case.coefficients(FORMS[one.kind], matrices))
            _judge_sign(one)
        _normalise(one, case)
    for _, one in bifurcations:
        if one.kind in (FOLD, TRANSCRITICAL):
            one.coefficient = abs(one.coefficient)


def _normalise(one: Bifurcation, case: Case) -> None:
    """Convert the coefficient at an orbit to an eigenvector of unit norm round the orbit."""
    means, errors = mean_squares(
        Critical(
            case.family.system,
            case.family.rows(np.concatenate([case.u[None], case.neighbours()])),
            case.steps,
            one.point.value.seconds,
        )
    )
    mean, error, k = settled(means)
    degree = 1 if one.kind in (FOLD, TRANSCRITICAL) else 2
    size = float(np.sqrt(mean)) ** degree
    relative = 0.5 * degree * (error + errors[k]) / mean
    one.coefficient_error = (one.coefficient_error + abs(one.coefficient) * relative) / size
    one.coefficient /= size


def _judge_rest(family: Family, one: Bifurcation) -> None:
    """Compute the coefficients at an equilibrium by power series, whose error is that of rounding."""
    rest = Rest(family, one.point.u, one.point.value.monodromy)
    one.coefficient_error = 0.0
    if one.kind == HOPF:
        (one.coefficient,) = lyapunov(rest, one.critical_multiplier.imag)
        _judge_sign(one)
        return
    found = normal_form(rest, [0j], 3)
    square, cubic = (found[0, (degree,)].real for degree in (2, 3))
    if one.kind == FOLD:
        one.coefficient = square
        return
    right, left = null_vectors(rest.matrix)
    bends = [rest.second(right, along).real for along in np.eye(len(right))]
    size = 0.5 * float(np.linalg.norm(bends) / max(abs(left @ right), np.finfo(float).tiny))
    _tell_branch_point(one, (square, 0.0), (cubic, 0.0), size)


def _judge_sign(one: Bifurcation) -> None:
    """Add to the criticality, which the branches may have told, what the sign of the coefficient says."""
    side = _SUPERCRITICAL.get(one.kind)
    if side is not None and abs(one.coefficient) > one.coefficient_error:
        found = "supercritical" if one.coefficient * side > 0.0 else "subcritical"
        one.criticality = CONTRADICTORY if one.criticality not in ("", found) else found


def _tell_branch_point(one: Bifurcation, square: tuple[float, float], cubic: tuple[float, float], size: float) -> None:
    """Call a branch point transcritical if its quadratic coefficient is not 0, a pitchfork if it is certainly small
    beside its bound `size`, and leave it open otherwise. Both coefficients come with their errors.
    """
    # least relative size of the quadratic coefficient at a transcritical point; largest, with its error, at a pitchfork
    same, nearly = 1e-5, 1e-3
    by_arms, one.criticality = one.criticality, ""
    if not np.isfinite(square[0] + size):
        return
    # from where the point was located to where it is: two branches cross, so the residual grows as its square
    away = max(Settings.bracket, float(np.sqrt(one.point.residual)))
    error = square[1] + 3.0 * float(np.nan_to_num(abs(cubic[0]))) * away
    if abs(square[0]) > max(same * size, 3.0 * error):
        one.kind, one.coefficient, one.coefficient_error = TRANSCRITICAL, square[0], error
    elif abs(square[0]) + error <= nearly * size or by_arms:
        one.kind, one.criticality = PITCHFORK, by_arms
        one.coefficient, one.coefficient_error = cubic
        _judge_sign(one)


def _matrices(cases: Sequence[Case]) -> list[np.ndarray]:
    """Compute, for each bifurcation, the monodromy matrices at states near the orbit."""
    found: dict[int, np.ndarray] = {}
    by_system: dict[str, list[int]] = {}
    for i, case in enumerate(cases):
        by_system.setdefault(case.family.system.label, []).append(i)
    for chosen in by_system.values():
        ends = integrated([cases[i].family.rows(cases[i].neighbours()) for i in chosen], cases[chosen[0]].family.system)
        found |= {i: one.monodromy for i, one in zip(chosen, ends, strict=True)}
    return [found[i] for i in range(len(cases))]


@dataclass(frozen=True, eq=False)
class CoefficientProblem:
    """Request for the trajectories from which a normal form coefficient is computed. No equations are solved.

    The residual of its value has the coefficient for each size of the step but the largest.
    """

    case: Case

    @property
    def size(self) -> int:
        """Number of unknowns: the states and the free parameters."""
        return len(self.case.u)

    @property
    def system(self) -> System:
        """System whose trajectories are integrated."""
        return self.case.family.system

    def rows(self, u: np.ndarray) -> Rows:
        """Return the trajectories to integrate for finite differences: they start at states beside the orbit."""
        return self.case.family.rows(self.case.neighbours())

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the normal form coefficient for each step size except the largest, from the integrated
        trajectories.
        """
        found = self.case.coefficients(FORMS[self.case.kind], ends.monodromy)
        return Value(found, np.zeros((len(found), self.size)), ends.images[0], ends.monodromy[0])


def critical_vectors(matrix: np.ndarray, kind: str) -> tuple[complex, np.ndarray, np.ndarray]:
    """Return the critical multiplier of a matrix, its eigenvector q, and the adjoint eigenvector p with <p, q> = 1."""
    values, vectors = np.linalg.eig(matrix)
    upper = np.where(values.imag > 0.0, 0.0, np.inf)
    away = {TORUS: np.abs(np.abs(values) - 1.0) + upper, DOUBLING: np.abs(values + 1.0)}.get(kind, np.abs(values - 1.0))
    k = int(np.argmin(away))
    left_values, left = np.linalg.eig(matrix.T)
    q, p = vectors[:, k], left[:, int(np.argmin(np.abs(left_values - values[k].conj())))]
    if kind != TORUS:
        q, p = q.real.astype(complex), p.real.astype(complex)
    q = q / np.linalg.norm(q)
    with np.errstate(divide="ignore", invalid="ignore"):  # at R1 and R2 p is normal to q
        return complex(values[k]), q, p / np.vdot(p, q).conj()


def _bend(middle: np.ndarray, ahead: np.ndarray, behind: np.ndarray, steps: np.ndarray) -> list[Bend]:
    """Compute first and second derivatives of a matrix along a direction, by differences of fourth order, for each step
    size.
    """
    h = steps[1:, None, None]
    odd, even = ahead - behind, ahead + behind
    first = (8.0 * odd[1:] - odd[:-1]) / (12.0 * h)
    second = (16.0 * even[1:] - even[:-1] - 30.0 * middle) / (12.0 * h * h)
    return [Bend(*pair) for pair in zip(first, second, strict=True)]


def settled(values: np.ndarray) -> tuple[float, float, int]:
    """Choose the value of a coefficient that depends least on the step size. Return it with its error and its index."""
    changes = np.abs(np.diff(values))
    errors = np.maximum(changes[:-1], changes[1:])
    if np.isnan(errors).all():
        return np.nan, np.nan, -1
    k = int(np.nanargmin(errors))
    return float(values[k + 1]), float(errors[k]), k + 1


# ---- coefficients ------------------------------------------------------------------------------

Form = Callable[[Case, Sequence[Bend]], float]
"""Computes a coefficient from the derivatives along the real and, if it is complex, imaginary part of q."""


def _quadratic(case: Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    return float(0.5 * np.vdot(case.p, bend.first @ case.q).real)


def _size(case: Case, bends: Sequence[Bend]) -> float:
    """Compute an upper bound of the quadratic normal form coefficient, as the scale by which to judge whether it is
    small.
    """
    (bend,) = bends
    return float(0.5 * np.linalg.norm(case.p) * np.linalg.norm(bend.first))


def _doubling(case: Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    inner = solved(case.matrix - np.eye(len(case.q)), bend.first @ case.q)
    return float(np.vdot(case.p, bend.second @ case.q - 3.0 * bend.first @ inner).real / 6.0)


def _cubic(case: Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    n = len(case.q)
    bordered = np.block([[case.matrix - np.eye(n), case.q[:, None]], [case.p.conj()[None], np.zeros((1, 1))]])
    inner = solved(bordered, np.append(bend.first @ case.q, 0.0))[:n]
    return float(np.vdot(case.p, bend.second @ case.q - 3.0 * bend.first @ inner).real / 6.0)


def _torus(case: Case, bends: Sequence[Bend]) -> float:
    real, imag = bends
    along, against = real.first + 1j * imag.first, real.first - 1j * imag.first  # B(q, .), B(conj(q), .)
    third = (real.second + imag.second) @ case.q
    one, mu, q = np.eye(len(case.q)), case.critical, case.q
    mean = solved(one - case.matrix, along @ q.conj())
    double = solved(mu * mu * one - case.matrix, along @ q)
    total = third + 2.0 * along @ mean + against @ double
    return float((np.conj(mu) * np.vdot(case.p, total)).real / 2.0)


FORMS: dict[str, Form] = {FOLD: _quadratic, DOUBLING: _doubling, TORUS: _torus}

_SUPERCRITICAL = {DOUBLING: 1.0, TORUS: -1.0, HOPF: -1.0, PITCHFORK: -1.0}
"""Sign of the coefficient at a supercritical bifurcation."""
