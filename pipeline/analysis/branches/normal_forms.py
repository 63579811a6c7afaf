"""Compute the normal form coefficients of located bifurcations, which decide what leaves them.

The coefficients need the second and third derivatives B and C of the section map (of the rates, for equilibria)
along the critical eigenvectors. They are differences of its exact first derivative A at neighbours of the orbit.
With A q = mu q, A^T p = conj(mu) p, |q| = 1, <p, q> = 1, all in scaled states (Kuznetsov, Elements of Applied
Bifurcation Theory, 3rd ed., 2004, Sects. 5.4 and 9.1; for Hopf points Eq. 5.62):

=============== ====================================================================================
fold            <p, B(q, q)> / 2; it vanishes at a cusp
period doubling <p, C(q, q, q) - 3 B(q, (A - 1)^-1 B(q, q))> / 6; positive: supercritical
Neimark-Sacker  Re(conj(mu) <p, C(q, q, q') + 2 B(q, (1 - A)^-1 B(q, q')) + B(q', (mu^2 - A)^-1 B(q, q))>) / 2;
                negative: supercritical
pitchfork       <p, C(q, q, q) - 3 B(q, (A - 1)^+ B(q, q))> / 6; negative: supercritical
transcritical   <p, B(q, q)> / 2, which is 0 at a pitchfork
Hopf point      Re <p, C(q, q, q') - 2 B(q, A^-1 B(q, q')) + B(q', (2 i w - A)^-1 B(q, q))> / (2 w), the first
                Lyapunov coefficient [1/s]; negative: supercritical
=============== ====================================================================================

q' is the conjugate of q, and ^+ the inverse on the complement of q. Each coefficient is computed with steps of
many sizes. The one that changes least from size to size is taken; the change is its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core.orbits import section_map
from magpend_core.pointwise import jacobian_at
from pipeline.analysis.branches.bifurcations import (
    BRANCHING,
    CONTRADICTORY,
    DOUBLING,
    FOLD,
    HOPF,
    PITCHFORK,
    TORUS,
    TRANSCRITICAL,
    Bifurcation,
)
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.tolerances import BRANCH_RTOL

STEPS = 0.125 * 2.0 ** -np.arange(13.0)
"""Sizes of the steps in units of the system's scales. The largest fit smooth maps, the smallest maps that are
strongly bent over one period."""

SAME = 1e-5
"""Relative size of a quadratic coefficient below which a branch point is a pitchfork."""


@dataclass(frozen=True, eq=False)
class Bend:
    """First and second derivatives (n, n) of the matrix A along a direction, one of each per size of the step."""

    first: np.ndarray
    second: np.ndarray


def judge(bifurcations: Sequence[tuple[Family, Bifurcation]]) -> None:
    """Set the coefficient, its error and the criticality of bifurcations, and tell branch points apart, in place."""
    cases = [_Case(family, one) for family, one in bifurcations]
    neighbours = [case.neighbours() for case in cases]
    matrices = _matrices(cases, neighbours)
    for case, found in zip(cases, matrices, strict=True):
        case.judge(found)


def _matrices(cases: Sequence[_Case], neighbours: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the derivatives of the map, or Jacobians, at neighbours of each bifurcation, in scaled states."""
    found: dict[int, np.ndarray] = {}
    by_system: dict[str, list[int]] = {}
    for i, case in enumerate(cases):
        if case.family.period:
            by_system.setdefault(case.family.system.label, []).append(i)
        else:
            rows = case.family.rows(neighbours[i])
            found[i] = jacobian_at(case.family.system, rows.states, rows.parameters[0])
    for chosen in by_system.values():
        rows = [cases[i].family.rows(neighbours[i]) for i in chosen]
        derivatives = section_map(
            np.concatenate([r.parameters for r in rows]),
            np.concatenate([r.frequency_hz for r in rows]),
            np.concatenate([r.states for r in rows]),
            np.concatenate([np.full(len(r.states), r.period) for r in rows]),
            rtol=BRANCH_RTOL,
            system=cases[chosen[0]].family.system,
        ).derivatives
        bounds = np.cumsum([len(r.states) for r in rows])[:-1]
        found |= zip(chosen, np.split(derivatives, bounds), strict=True)
    return [np.array([case.family.scaled(one) for one in found[i]]) for i, case in enumerate(cases)]


class _Case:
    """A bifurcation with its critical eigenvectors."""

    def __init__(self, family: Family, one: Bifurcation) -> None:
        self.family, self.one = family, one
        self.matrix = family.scaled(one.point.value.monodromy)
        self.critical, self.q, self.p = critical_vectors(self.matrix, one.kind)

    def neighbours(self) -> np.ndarray:
        """Return the scaled unknowns of the orbit's neighbours along the eigenvector's real and imaginary parts."""
        n = len(self.q)
        parts = [self.q.real, self.q.imag] if self.one.kind in (TORUS, HOPF) else [self.q.real]
        shifts = np.concatenate([np.outer(sign * STEPS, part) for part in parts for sign in (1.0, -1.0)])
        return np.asarray(self.one.point.u + np.pad(shifts, ((0, 0), (0, len(self.one.point.u) - n))))

    def judge(self, matrices: np.ndarray) -> None:
        """Set what the bifurcation's coefficient tells, in place."""
        parts = np.split(matrices, len(matrices) // (2 * len(STEPS)))
        bends = [_bend(self.matrix, *np.split(part, 2)) for part in parts]
        one = self.one
        if one.kind == BRANCHING:
            self._tell_branch_point(bends)
            return
        one.coefficient, one.coefficient_error = _settled(self._coefficients(FORMS[one.kind], bends))
        side = _SUPERCRITICAL.get(one.kind)
        if side is None or not abs(one.coefficient) > one.coefficient_error:
            return
        found = "supercritical" if one.coefficient * side > 0.0 else "subcritical"
        one.criticality = CONTRADICTORY if one.criticality not in ("", found) else found

    def _coefficients(self, form: Form, bends: Sequence[Bend]) -> np.ndarray:
        """Compute a coefficient with each size of the step."""
        return np.array(
            [form(self, [Bend(bend.first[k], bend.second[k]) for bend in bends]) for k in range(len(bends[0].first))]
        )

    def _tell_branch_point(self, bends: Sequence[Bend]) -> None:
        one = self.one
        square, error = _settled(self._coefficients(_quadratic, bends))
        size, _ = _settled(self._coefficients(_size, bends))
        if not np.isfinite(square + size):
            return
        if abs(square) > max(SAME * size, 3.0 * error):
            one.kind, one.coefficient, one.coefficient_error = TRANSCRITICAL, square, error
        elif error <= SAME * size:
            one.kind = PITCHFORK
            one.coefficient, one.coefficient_error = _settled(self._coefficients(_cubic, bends))
            if abs(one.coefficient) > one.coefficient_error:
                one.criticality = "supercritical" if one.coefficient < 0.0 else "subcritical"


def critical_vectors(matrix: np.ndarray, kind: str) -> tuple[complex, np.ndarray, np.ndarray]:
    """Return the critical multiplier or eigenvalue of a matrix, its eigenvector q and the adjoint p, <p, q> = 1."""
    values, vectors = np.linalg.eig(matrix)
    upper = np.where(values.imag > 0.0, 0.0, np.inf)
    away = {
        TORUS: np.abs(np.abs(values) - 1.0) + upper,
        HOPF: np.abs(values.real) + upper,
        DOUBLING: np.abs(values + 1.0),
    }.get(kind, np.abs(values - 1.0))
    k = int(np.argmin(away))
    left_values, left = np.linalg.eig(matrix.T)
    q, p = vectors[:, k], left[:, int(np.argmin(np.abs(left_values - values[k].conj())))]
    if kind not in (TORUS, HOPF):
        q, p = q.real.astype(complex), p.real.astype(complex)
    q = q / np.linalg.norm(q)
    return complex(values[k]), q, p / np.vdot(p, q).conj()


def _bend(middle: np.ndarray, ahead: np.ndarray, behind: np.ndarray) -> Bend:
    """Compute derivatives of fourth order from matrices at steps `STEPS` ahead and behind."""
    h = STEPS[1:, None, None]  # each size needs the next larger one as well
    odd, even = ahead - behind, ahead + behind
    first = (8.0 * odd[1:] - odd[:-1]) / (12.0 * h)
    second = (16.0 * even[1:] - even[:-1] - 30.0 * middle) / (12.0 * h * h)
    return Bend(first, second)


def _settled(values: np.ndarray) -> tuple[float, float]:
    """Return the value that differs least from those of the next sizes, and the larger difference."""
    changes = np.abs(np.diff(values))
    errors = np.maximum(changes[:-1], changes[1:])
    if np.isnan(errors).all():
        return np.nan, np.nan
    k = int(np.nanargmin(errors))
    return float(values[k + 1]), float(errors[k])


# ---- coefficients ------------------------------------------------------------------------------

Form = Callable[[_Case, Sequence[Bend]], float]


def _quadratic(case: _Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    return float(0.5 * np.vdot(case.p, bend.first @ case.q).real)


def _size(case: _Case, bends: Sequence[Bend]) -> float:
    """Compute how large the quadratic coefficient could be."""
    (bend,) = bends
    return float(0.5 * np.linalg.norm(case.p) * np.linalg.norm(bend.first, 2))


def _doubling(case: _Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    inner = np.linalg.solve(case.matrix - np.eye(len(case.q)), bend.first @ case.q)
    return float(np.vdot(case.p, bend.second @ case.q - 3.0 * bend.first @ inner).real / 6.0)


def _cubic(case: _Case, bends: Sequence[Bend]) -> float:
    (bend,) = bends
    n = len(case.q)
    bordered = np.block([[case.matrix - np.eye(n), case.q[:, None]], [case.p.conj()[None], np.zeros((1, 1))]])
    inner = np.linalg.solve(bordered, np.append(bend.first @ case.q, 0.0))[:n]
    return float(np.vdot(case.p, bend.second @ case.q - 3.0 * bend.first @ inner).real / 6.0)


def _complex_parts(case: _Case, bends: Sequence[Bend]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrices of B(q, .) and B(q', .), and C(q, q, q')."""
    real, imag = bends
    along, against = real.first + 1j * imag.first, real.first - 1j * imag.first
    return along, against, (real.second + imag.second) @ case.q


def _torus(case: _Case, bends: Sequence[Bend]) -> float:
    along, against, third = _complex_parts(case, bends)
    one, mu, q = np.eye(len(case.q)), case.critical, case.q
    mean = np.linalg.solve(one - case.matrix, along @ q.conj())
    double = np.linalg.solve(mu * mu * one - case.matrix, along @ q)
    total = third + 2.0 * along @ mean + against @ double
    return float((np.conj(mu) * np.vdot(case.p, total)).real / 2.0)


def _hopf(case: _Case, bends: Sequence[Bend]) -> float:
    along, against, third = _complex_parts(case, bends)
    one, omega, q = np.eye(len(case.q)), case.critical.imag, case.q
    mean = np.linalg.solve(case.matrix.astype(complex), along @ q.conj())
    double = np.linalg.solve(2j * omega * one - case.matrix, along @ q)
    total = third - 2.0 * along @ mean + against @ double
    return float(np.vdot(case.p, total).real / (2.0 * omega))


FORMS: dict[str, Form] = {FOLD: _quadratic, DOUBLING: _doubling, TORUS: _torus, HOPF: _hopf}

_SUPERCRITICAL = {DOUBLING: 1.0, TORUS: -1.0, HOPF: -1.0}
"""Sign of the coefficient at a supercritical bifurcation."""
