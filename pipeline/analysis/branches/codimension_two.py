"""Detect points of codimension two on bifurcation curves by test functions, and locate them in both parameters.

M is the monodromy matrix, P its characteristic polynomial, and kappa half the sum of the pair of multipliers with
product 1. "Others" are the multipliers besides the critical ones (Kuznetsov, Elements of Applied Bifurcation
Theory, 3rd ed., 2004, Ch. 9; Kuznetsov and Meijer, SIAM J. Sci. Comput. 26, 2005, 1932).

============================ ========================= =======================================================
point                        on curves of              test function
============================ ========================= =======================================================
``cusp``                     folds                     the normal form coefficient
``generalised_doubling``     doublings                 the same
``chenciner``                Neimark-Sacker points     the same
``r1``                       folds; Neimark-Sacker     P'(1); kappa - 1
``r2``                       doublings; Neimark-Sacker P'(-1); kappa + 1
``r3``, ``r4``               Neimark-Sacker points     kappa + 1/2; kappa
``fold_flip``                folds; doublings          det(M + 1); det(M - 1)
``fold_neimark_sacker``      folds; Neimark-Sacker     product of mu_i mu_j - 1 of others; of mu - 1 of others
``doubling_neimark_sacker``  doublings; Neimark-Sacker the same; product of mu + 1 of others
``double_neimark_sacker``    Neimark-Sacker points     product of mu_i mu_j - 1 of others
============================ ========================= =======================================================

On a Neimark-Sacker curve the pair may also pass -1 (or 1) and stay on the circle: M - (-1) vanishes on the plane
of the pair, as where a flow is seen at even times. There kappa touches -1, and the rotation in the plane changes
its direction instead: ``turn`` in `_torus_tests`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np

from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.bifurcations import Tested, find_root
from pipeline.analysis.branches.kinds import DOUBLING, FOLD, TORUS
from pipeline.analysis.branches.lockstep import Query, Steps
from pipeline.analysis.branches.normal_forms import STEPS, Case, CoefficientProblem, settled
from pipeline.analysis.branches.problems import BifurcationProblem, Family

CUSP, GENERALISED, CHENCINER = "cusp", "generalised_doubling", "chenciner"
R1, R2, R3, R4 = "r1", "r2", "r3", "r4"
FOLD_FLIP, FOLD_TORUS = "fold_flip", "fold_neimark_sacker"
DOUBLING_TORUS, DOUBLE_TORUS = "doubling_neimark_sacker", "double_neimark_sacker"
OF_EQUILIBRIA = BT, GENERALISED_HOPF, ZERO_HOPF, DOUBLE_HOPF, DEGENERATE = (
    *("bogdanov_takens", "generalised_hopf", "zero_hopf", "double_hopf", "degenerate_pitchfork"),
)
"""Points of codimension two on curves of equilibria, beside the cusp (see `equilibrium_curves`)."""

OF_LOOPS = NEUTRAL, NONCENTRAL = "neutral_saddle", "saddle_node_homoclinic"
"""Points of codimension two on curves of homoclinic orbits, beside Bogdanov-Takens (see `homoclinic_curves`)."""

POINT_KINDS = (
    *(CUSP, GENERALISED, CHENCINER, R1, R2, R3, R4, FOLD_FLIP, FOLD_TORUS, DOUBLING_TORUS, DOUBLE_TORUS),
    *(*OF_EQUILIBRIA, *OF_LOOPS),
)

TURN = "turn"
"""Test function of a pair that passes 1 or -1 and stays on the circle; the point is an R1 or R2."""

OF_COEFFICIENT = {FOLD: CUSP, DOUBLING: GENERALISED, TORUS: CHENCINER}
"""The point at which the normal form coefficient of each bifurcation vanishes."""


@dataclass(frozen=True, eq=False)
class SpecialPoint:
    """A located point of codimension two, such as a cusp, with its orbit, both parameter values and their errors."""

    kind: str  # one of `POINT_KINDS`
    family: Family  # family of the orbit
    point: Point  # the orbit at the point
    # (2,): distance of the values of both parameters between which the test function changes its sign
    bracket: np.ndarray
    curve: int = -1  # number of the curve on which it was located
    coefficients: Mapping[str, float] = field(default_factory=dict)  # of the normal form, at equilibria

    @property
    def values(self) -> np.ndarray:
        """Values of both parameters at this point of codimension two."""
        return self.family.values(self.point.u)


@dataclass(eq=False)
class Detector:
    """Detector of points of codimension two along a bifurcation curve; it stores the located points.

    `settings` are tried in turn for locating one. `n_missed` counts sign changes that none of them leads to.

    Eigenvectors and planes of the pair are turned to those at the point before, so that test functions with
    a sign of theirs are continuous.
    """

    problem: BifurcationProblem
    settings: Sequence[Settings]
    found: list[SpecialPoint] = field(default_factory=list)
    n_missed: int = 0
    _level: int | None = None
    _last: tuple[Point, _Frame, dict[str, float]] | None = None

    def between(self, a: Point, b: Point) -> Steps[bool]:
        """Locate the points of codimension two between two successive points of a bifurcation curve; always accept the
        step.
        """
        if self._last is None or self._last[0] is not a:
            first = yield from self._tests(a, None)
            self._last = a, *first
        _, frame, before = self._last
        turned, after = yield from self._tests(b, frame)
        for kind, value in before.items():
            ends = (a, value), (b, after[kind])
            if value * after[kind] < 0.0 and (yield from self._is_certain(kind, ends, frame)):
                yield from self._locate(kind, *ends, frame)
        self._last = b, turned, after
        return True

    def _tests(self, point: Point, frame: _Frame | None) -> Steps[tuple[_Frame, dict[str, float]]]:
        family, kind = self.problem.family, self.problem.kind
        case = Case(family, kind, point.u, point.value.monodromy, STEPS, frame.vector if frame else None)
        turned = _Frame.of(case, frame)
        values = _matrix_tests(kind, case.matrix, turned)
        values[OF_COEFFICIENT[kind]] = yield from self._coefficient(case)
        return turned, values

    def _coefficient(self, case: Case) -> Steps[float]:
        """Compute the normal form coefficient at a point of the curve by finite differences."""
        if case.kind == TORUS and case.critical.imag == 0.0:  # beyond R1 or R2
            return float("nan")
        if self._level is None:
            value = yield Query(CoefficientProblem(case), case.u)
            _, _, self._level = settled(value.residual)
        if self._level < 0:
            return float("nan")
        for level in range(self._level, len(STEPS) - 1):
            case.steps = STEPS[level : level + 2]
            if _crosses_beside(case):
                value = yield Query(CoefficientProblem(case), case.u)
                return float(value.residual[0])
        return float("nan")

    def _is_certain(self, kind: str, ends: Sequence[Tested], frame: _Frame) -> Steps[bool]:
        """Return whether the signs of a test function are known at points of a curve. At a fold of limit cycles its
        coefficient is compared with the residual, both in units of the cycle's size: where the cycle shrinks to an
        equilibrium the coefficient vanishes, and any point nearby is a fold within the residual.
        """
        least = 10.0  # coefficient in units of the residual: less moves the fold by a third of the cycle's size
        family = self.problem.family
        if kind != CUSP or not family.period or family.system.section is None:
            return True
        for point, value in ends:
            for settings in self.settings:
                fine = yield from correct(self.problem, point.u, point.tangent, settings)
                if fine is not None:
                    break
            else:
                return False
            again = yield from self._test(kind, frame, fine)
            _, rates = family.crossing_speeds(fine.u[None])
            size = float(np.abs(rates).max()) * fine.value.seconds / (2.0 * np.pi)
            residual = settings.tolerance * max(1.0, 1.0 / size)
            if not again * np.sign(value) * size > least * residual:
                return False
        return True

    def _locate(self, kind: str, a: Tested, b: Tested, frame: _Frame) -> Steps[None]:
        """Locate and store the point of codimension two where a test function vanishes between two points of a curve;
        count failures.
        """
        # a sign change is a zero if the test function falls below this share of its values on both sides; else it jumps
        vanishes = 1e-3
        ends = None
        for settings in self.settings:
            ends = yield from find_root(self.problem, a, b, partial(self._test, kind, frame), settings)
            if ends is not None:
                break
        if ends is None:
            self.n_missed += 1
            return
        (low, at_low), (high, at_high) = ends
        if not min(abs(at_low), abs(at_high)) <= vanishes * max(abs(a[1]), abs(b[1])):
            return
        nearest = low if abs(at_low) <= abs(at_high) else high
        bracket = np.abs(self.problem.family.values(high.u) - self.problem.family.values(low.u))
        one = self._named(SpecialPoint(kind, self.problem.family, nearest, bracket))
        if one is not None and not any(_is_same(one, other) for other in self.found):
            self.found.append(one)

    def _test(self, kind: str, frame: _Frame, point: Point) -> Steps[float]:
        """Compute one test function at a point near that of a frame."""
        if kind == OF_COEFFICIENT[self.problem.kind]:
            _, values = yield from self._tests(point, frame)
            return values[kind]
        case = Case(self.problem.family, self.problem.kind, point.u, point.value.monodromy)
        return _matrix_tests(self.problem.kind, case.matrix, _Frame.of(case, frame))[kind]

    def _named(self, one: SpecialPoint) -> SpecialPoint | None:
        """Return a located zero of a test function with its final kind; None if it is no point of codimension two."""
        on_axis = 1e-6  # largest distance of kappa from 1 or -1 where a pair passes that multiplier
        if one.kind != TURN:
            return one
        cosine = _cosine(np.linalg.eigvals(one.point.value.monodromy))
        return replace(one, kind=R1 if cosine > 0.0 else R2) if abs(cosine) >= 1.0 - on_axis else None


def _crosses_beside(case: Case) -> bool:
    """Return whether states beside an orbit cross the section about as fast as the orbit. Near or beyond the
    equilibrium to which a limit cycle shrinks they do not: differences over it are no derivatives of the return map.
    """
    slowest = 0.25  # speed across the section, in units of the orbit's
    if case.family.system.section is None:
        return True
    own, *beside = case.family.crossing_speeds(np.concatenate([case.u[None], case.neighbours()]))[0]
    return bool(min(beside) > slowest * own)


def _is_same(one: SpecialPoint, other: SpecialPoint) -> bool:
    return one.kind == other.kind and bool(np.abs(one.point.u - other.point.u).max() < 1e-5)


# ---- test functions ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Frame:
    """Critical eigenvector at a point of a bifurcation curve and, for a complex pair, a basis of its plane."""

    vector: np.ndarray
    plane: np.ndarray | None

    @classmethod
    def of(cls, case: Case, before: _Frame | None) -> _Frame:
        """Compute the critical eigenvector and plane at a point of a curve. The basis of the plane is turned as near as
        possible to `before`.
        """
        if case.kind != TORUS:
            return cls(case.q, None)
        values, vectors = np.linalg.eig(case.matrix)
        i, j = _pair(values)
        both = np.concatenate([vectors[:, [i, j]].real, vectors[:, [i, j]].imag], axis=1)
        plane = np.linalg.svd(both)[0][:, :2]
        if before is not None and before.plane is not None:
            left, _, right = np.linalg.svd(plane.T @ before.plane)
            plane = plane @ left @ right
        return cls(case.q, plane)


def _matrix_tests(kind: str, matrix: np.ndarray, frame: _Frame) -> dict[str, float]:
    """Compute the test functions for codimension two that follow from the monodromy matrix."""
    if kind == TORUS:
        return _torus_tests(matrix, frame)
    critical = 1.0 if kind == FOLD else -1.0
    values = np.linalg.eigvals(matrix)
    others = np.delete(values, int(np.argmin(np.abs(values - critical))))
    names = {FOLD: (R1, FOLD_TORUS), DOUBLING: (R2, DOUBLING_TORUS)}[kind]
    return {
        names[0]: _slope(matrix, critical),
        names[1]: _pairs(others),
        FOLD_FLIP: float(np.linalg.det(matrix + critical * np.eye(len(matrix)))),
    }


def _torus_tests(matrix: np.ndarray, frame: _Frame) -> dict[str, float]:
    values = np.linalg.eigvals(matrix)
    others, cosine = np.delete(values, _pair(values)), _cosine(values)
    assert frame.plane is not None
    inside = frame.plane.T @ matrix @ frame.plane
    return {
        R1: cosine - 1.0,
        R2: cosine + 1.0,
        R3: cosine + 0.5,
        R4: cosine,
        TURN: float(inside[1, 0] - inside[0, 1]),
        FOLD_TORUS: float(np.prod(others - 1.0).real),
        DOUBLING_TORUS: float(np.prod(others + 1.0).real),
        DOUBLE_TORUS: _pairs(others),
    }


def _slope(matrix: np.ndarray, at: float) -> float:
    return float(np.polyval(np.polyder(np.poly(matrix)), at).real)


def _pairs(values: np.ndarray) -> float:
    """Compute the product of ``mu_i * mu_j - 1`` over all pairs of multipliers; it vanishes at a Neimark-Sacker
    bifurcation.
    """
    return float(np.prod([a * b - 1.0 for a, b in combinations(values, 2)]).real)


def _pair(values: np.ndarray) -> list[int]:
    """Return the indices of the two multipliers whose product is nearest to 1."""
    i, j = np.triu_indices(len(values), 1)
    k = int(np.argmin(np.abs(values[i] * values[j] - 1.0)))
    return [int(i[k]), int(j[k])]


def _cosine(values: np.ndarray) -> float:
    """Return the cosine of the angle of a Neimark-Sacker pair: half the sum of the two multipliers with product 1."""
    return float(0.5 * values[_pair(values)].sum().real)


def merged(points: Mapping[int, list[SpecialPoint]]) -> list[SpecialPoint]:
    """Collect the points of codimension two of several curves without duplicates; `points` has those of each curve
    number.

    A Chenciner point at a strong resonance is dropped, and a cusp at a degenerate pitchfork, where folds go on to their
    mirror image: the coefficient that vanishes there has no meaning at it.
    """
    found: list[SpecialPoint] = []
    strong = [one for ones in points.values() for one in ones if one.kind in (R1, R2, R3, R4)]
    pitchforks = [one for ones in points.values() for one in ones if one.kind == DEGENERATE]
    for number, ones in points.items():
        for one in ones:
            beside = {CHENCINER: strong, CUSP: pitchforks}.get(one.kind, [])
            is_resonance = any(_is_same_orbit(one, other) for other in beside)
            if not is_resonance and not any(one.kind == other.kind and _is_same_orbit(one, other) for other in found):
                found.append(replace(one, curve=number))
    return found


def _is_same_orbit(one: SpecialPoint, other: SpecialPoint) -> bool:
    """Return whether two located points of codimension two are the same orbit at the same parameter values."""
    # largest distances of one point located on two curves: in the parameters, and in the state, which is steep at some
    # of these points
    same_point, same_state = 1e-5, 1e-2
    if one.family.period != other.family.period:
        return False
    if np.abs(one.point.u[-2:] - other.point.u[-2:]).max() > same_point:
        return False
    return any(np.abs(one.family.mismatch(one.point.u, x)).max() < same_state for x in other.point.value.images)
