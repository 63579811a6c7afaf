"""The local stage: least squares over the unknowns and the pieces' starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.identify.objective import Evaluation, evaluate
from pipeline.rig.identify.problem import Problem

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Relative change of the unknowns, and a tenth of that of the cost, at which a fit has converged."""

MAX_EVALUATIONS = 100

DENSE_COLUMNS = 600
"""Above it the Jacobian is taken as sparse, and its steps are solved for by iteration."""


@dataclass(frozen=True)
class Fit:
    """Outcome of a local stage.

    Attributes
    ----------
    theta : ndarray, (n_free,)
    starts : ndarray, (n_piece, n_states)
    cost : float
        Half the sum of squares in units of the noise.
    converged : bool
    message : str
    n_evaluations : int
    residuals, rows, jacobian
        See `Evaluation`.
    """

    theta: Array
    starts: Array
    cost: float
    converged: bool
    message: str
    n_evaluations: int
    residuals: tuple[Array, ...]
    rows: Array
    jacobian: Array

    @property
    def rms(self) -> Array:
        """Root mean square of each channel's residuals over all pieces [SI]."""
        return np.asarray(np.sqrt(np.nanmean(np.concatenate(self.residuals) ** 2, axis=0)))


class _Unknowns:
    """Unknowns and starts as one scaled vector, and the last evaluation of it."""

    def __init__(self, problem: Problem, starts: Array, with_starts: bool, echo: Echo | None) -> None:
        self.problem, self.starts, self.with_starts, self.echo = problem, starts, with_starts, echo
        self.n_free, self.count, self.best = len(problem.free), 0, np.inf
        self.sizes = np.array([f.size for f in problem.free])
        if with_starts:
            self.sizes = np.append(self.sizes, np.tile(problem.model.scales, len(starts)))
        self._key = b""
        self._last: Evaluation | None = None

    def split(self, x: Array) -> tuple[Array, Array]:
        """Unknowns and starts of a scaled vector."""
        full = x * self.sizes
        if not self.with_starts:
            return full, self.starts
        return full[: self.n_free], full[self.n_free :].reshape(self.starts.shape)

    def at(self, x: Array) -> Evaluation:
        """Evaluate, or recall the last evaluation."""
        key = x.tobytes()
        if self._last is None or key != self._key:
            theta, starts = self.split(x)
            self._last = evaluate(self.problem, theta[None], starts[None], slopes=True)[0]
            self._key = key
            self.count += 1
            if self._last.cost < self.best:
                self.best = self._last.cost
                if self.echo is not None:
                    self.echo(theta, self.best)
        return self._last

    def rows(self, x: Array) -> Array:
        return self.at(x).rows

    def jacobian(self, x: Array) -> Array:
        jacobian = self.at(x).jacobian
        return np.asarray(jacobian[:, : len(self.sizes)] * self.sizes)


Echo = Callable[[Array, float], None]


class _Ending(NamedTuple):
    max_evaluations: int
    tolerance: float


def fit_local(
    problem: Problem,
    theta0: Array,
    *,
    starts: Array | None = None,
    fixed: Mapping[str, float] | None = None,
    free_starts: bool = True,
    max_evaluations: int = MAX_EVALUATIONS,
    tolerance: float = TOLERANCE,
    echo: Echo | None = None,
) -> Fit:
    """Least squares from a first guess (`scipy.optimize.least_squares`, trust region with bounds).

    Parameters
    ----------
    problem
    theta0
        First guess of the unknowns, (n_free,); brought into the bounds.
    starts
        First guess of the pieces' starts, (n_piece, n_states); by default the problem's.
    fixed
        Unknowns that are held at a value, by name: the fit is over the others, `Fit.theta` has all.
    free_starts
        Whether the starts are fitted, too.
    max_evaluations
        Limit; beyond it a fit has not converged.
    tolerance
        Relative change of the unknowns, and a tenth of that of the cost, at which it has.
    echo
        Called with the unknowns and the cost whenever the cost has become less.

    Returns
    -------
    Fit

    Notes
    -----
    A robust loss counts residuals in units of their own scale, which a first fit of least squares gives.
    """
    if fixed:
        return _fit_others(problem, theta0, starts, fixed, free_starts, _Ending(max_evaluations, tolerance))
    ending = _Ending(max_evaluations, tolerance)
    first = problem.starts if starts is None else starts
    plain = replace(problem, loss="linear") if problem.loss != "linear" else problem
    fit = _solve(plain, theta0, first, free_starts, ending, echo)
    if problem.loss == "linear":
        return fit
    z = np.concatenate(fit.residuals) / problem.noise
    scale = 1.4826 * float(np.nanmedian(np.abs(z)))
    scaled = replace(problem, loss_scale=max(scale, 1.0))
    robust = _solve(scaled, fit.theta, fit.starts, free_starts, ending, echo)
    return replace(robust, n_evaluations=fit.n_evaluations + robust.n_evaluations)


def _solve(
    problem: Problem, theta0: Array, starts: Array, free_starts: bool, ending: _Ending, echo: Echo | None
) -> Fit:
    from scipy.optimize import least_squares
    from scipy.sparse import csr_array
    from threadpoolctl import threadpool_limits

    unknowns = _Unknowns(problem, starts, free_starts, echo)
    sizes, n_free = unknowns.sizes, len(problem.free)
    theta0 = np.clip(theta0, problem.lower, problem.upper)
    full = np.append(theta0, starts.ravel()) if free_starts else np.array(theta0)
    lower, upper = np.full(len(sizes), -np.inf), np.full(len(sizes), np.inf)
    lower[:n_free], upper[:n_free] = problem.lower, problem.upper
    if not len(sizes):
        return _outcome(unknowns, full, True, "nothing to fit")
    sparse = len(sizes) > DENSE_COLUMNS
    # the matrices are small: more threads would wait for each other
    with threadpool_limits(1):
        found = least_squares(
            unknowns.rows, full / sizes,
            jac=(lambda x: csr_array(unknowns.jacobian(x))) if sparse else unknowns.jacobian,
            bounds=(lower / sizes, upper / sizes), method="trf", x_scale="jac", xtol=ending.tolerance,
            ftol=0.1 * ending.tolerance, gtol=None,
            tr_solver="lsmr" if sparse else "exact", max_nfev=ending.max_evaluations,
        )  # fmt: skip
    return _outcome(unknowns, found.x, found.status > 0, found.message)


def _outcome(unknowns: _Unknowns, x: Array, ended: bool, message: str) -> Fit:
    evaluation = unknowns.at(x)
    theta, starts = unknowns.split(x)
    failed = evaluation.failed
    if failed:
        message = f"the trajectories of {failed} of {len(starts)} pieces diverge"
    return Fit(
        theta, starts, evaluation.cost, ended and not failed, message, unknowns.count, evaluation.residuals,
        evaluation.rows, evaluation.jacobian,
    )  # fmt: skip


def _fit_others(
    problem: Problem, theta0: Array, starts: Array | None, fixed: Mapping[str, float], free_starts: bool,
    ending: _Ending,
) -> Fit:  # fmt: skip
    """Fit with some unknowns held; the outcome speaks of all again."""
    held = np.array([name in fixed for name in problem.names], bool)
    part = fit_local(
        problem.without(fixed), np.asarray(theta0)[~held], starts=starts, free_starts=free_starts,
        max_evaluations=ending.max_evaluations, tolerance=ending.tolerance,
    )  # fmt: skip
    theta = np.array([fixed.get(name, 0.0) for name in problem.names])
    theta[~held] = part.theta
    whole = evaluate(problem, theta[None], part.starts[None], slopes=True)[0]
    return replace(
        part,
        theta=theta,
        cost=whole.cost,
        residuals=whole.residuals,
        rows=whole.rows,
        jacobian=whole.jacobian,
    )
