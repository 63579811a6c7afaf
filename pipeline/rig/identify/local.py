"""Fit the unknowns and the initial states of the pieces by least squares, from one first guess."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.analysis.branches.carrying import Solution
from pipeline.rig.identify.objective import Evaluation, evaluate
from pipeline.rig.identify.problem import Problem

# ---- initial states --------------------------------------------------------------------------------

Array = NDArray[np.float64]


class Starts(NamedTuple):
    """Fitted initial states of the pieces, and whether each has converged."""

    starts: Array  # (n_piece, n_states)
    settled: NDArray[np.bool_]  # (n_piece,)


class ManyStarts(NamedTuple):
    """Fitted initial states of the pieces for many sets of unknowns, whether each has converged, and the costs."""

    starts: Array  # (member, piece, n_states)
    settled: NDArray[np.bool_]  # (member, piece)
    costs: Array  # (member, piece)


def fit_starts(problem: Problem, theta: Array, starts: Array) -> Starts:
    """Fit the initial state of each piece by least squares (Levenberg-Marquardt), with the unknown parameters fixed.

    The engine integrates all pieces together; each has its own damping. Gaps between stretches do not count. `starts`
    are first guesses, (n_piece, n_states); no fitted start is worse than its guess.
    """
    found = fit_many_starts(problem, theta[None], starts[None])
    return Starts(found.starts[0], found.settled[0])


def fit_many_starts(problem: Problem, thetas: Array, starts: Array) -> ManyStarts:
    """Fit the initial state of each piece, as `fit_starts`, for each row of unknowns in common calls of the engine.

    `starts` are first guesses, (member, piece, n_states). Each member depends on its own unknowns and guesses alone.
    """
    iterations = 40  # most iterations
    # damping: at first, its factors after a step that is better or worse, and the largest
    first, less, more, most = 1e-3, 0.1, 10.0, 1e12
    settled = 1e-10  # relative decrease of a piece's cost, predicted by its slopes, below which its start is found
    held = replace(problem, continuity=None, orbits=(), held=True)
    found = np.array(starts)
    damping = np.full(found.shape[:2], first)
    blocks = _blocks(held, thetas, found)
    moving = np.ones(found.shape[:2], bool)
    for _ in range(iterations):
        steps = np.zeros_like(found)
        for i, k in np.argwhere(moving):
            block = blocks[i][k]
            steps[i, k], gain = _step(block.jacobian, block.rows, damping[i, k])
            # below this gain, rounding decides and no step improves the start
            moving[i, k] = gain > settled * _cost(block) and damping[i, k] < most
        members, pieces = np.flatnonzero(moving.any(axis=1)), np.flatnonzero(moving.any(axis=0))
        if not len(members):
            break
        part = replace(held, pieces=tuple(held.pieces[k] for k in pieces))
        trial = found[np.ix_(members, pieces)] + steps[np.ix_(members, pieces)]
        for i, own, fitted in zip(members, trial, _blocks(part, thetas[members], trial), strict=True):
            for k, start, block in zip(pieces, own, fitted, strict=True):
                if not moving[i, k]:
                    continue
                better = _cost(block) < _cost(blocks[i][k])
                damping[i, k] *= less if better else more
                if better:
                    found[i, k], blocks[i][k] = start, block
    costs = np.array([[_cost(block) for block in row] for row in blocks]).reshape(moving.shape)
    return ManyStarts(found, ~moving, costs)


def choose_phases(problem: Problem, theta: Array) -> Array:
    """Return the unknowns with the phase of each known drive moved to the best of phases all round the circle."""
    n_phases = 12  # from which the best one is chosen
    if not problem.phases:
        return theta
    shifts = np.arange(n_phases) / n_phases
    thetas = np.tile(theta, (n_phases, 1))
    thetas[:, list(problem.phases.values())] += shifts[:, None]
    costs = fit_many_starts(problem, thetas, np.tile(problem.starts, (n_phases, 1, 1))).costs
    found = np.array(theta)
    for recording, i in problem.phases.items():
        own = [p.recording == recording for p in problem.pieces]
        found[i] += shifts[int(np.argmin(costs[:, own].sum(axis=1)))]
    return found


def block_rows(problem: Problem) -> list[slice]:
    """Return which rows of the compressed residual vector belong to each piece of the recordings, as slices."""
    n_own = len(problem.free) + len(problem.model.states)
    sizes = [min(int(np.isfinite(p.measured).sum()), n_own + 1) for p in problem.pieces]
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


class _Block(NamedTuple):
    """Residuals of one piece and their derivatives by its initial state, compressed by a QR decomposition."""

    jacobian: Array
    rows: Array


def _blocks(problem: Problem, thetas: Array, starts: Array) -> list[list[_Block]]:
    """Return the block of each piece for each row of unknowns."""
    n, n_free = len(problem.model.states), len(problem.free)
    return [
        [
            _Block(whole.jacobian[here, n_free + k * n : n_free + (k + 1) * n], whole.rows[here])
            for k, here in enumerate(block_rows(problem))
        ]
        for whole in evaluate(problem, thetas, starts, slopes=True)
    ]


def _cost(block: _Block) -> float:
    return float(0.5 * block.rows @ block.rows)


def _step(jacobian: Array, rows: Array, damping: float) -> tuple[Array, float]:
    """Return a damped Gauss-Newton step, and the decrease of the cost that an undamped step would give."""
    size = np.sqrt(damping) * np.linalg.norm(jacobian, axis=0)
    stacked = np.vstack([jacobian, np.diag(np.maximum(size, 1e-300))])
    right = np.concatenate([-rows, np.zeros(len(size))])
    within = np.linalg.qr(jacobian)[0].T @ rows
    return np.linalg.lstsq(stacked, right, rcond=None)[0], float(0.5 * within @ within)


def _own(problem: Problem, evaluation: Evaluation, k: int, here: slice) -> Array:
    """Return the Jacobian of one piece's residuals with respect to the initial state of that piece."""
    n, n_free = len(problem.model.states), len(problem.free)
    return evaluation.jacobian[here, n_free + k * n : n_free + (k + 1) * n]


def carry_starts(problem: Problem, evaluation: Evaluation, starts: Array, change: Array) -> Array:
    """Return the optimal initial states after a small change of the unknowns, by linearisation, (n_piece, n_states)."""
    found, n_free = np.array(starts), len(problem.free)
    for k, here in enumerate(block_rows(problem)):
        wanted = evaluation.rows[here] + evaluation.jacobian[here, :n_free] @ change
        found[k] -= np.linalg.lstsq(_own(problem, evaluation, k, here), wanted, rcond=None)[0]
    return found


def project_starts_out(problem: Problem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Return residuals (m,) and their derivatives (m, n_free), with the directions of the initial states projected out.

    The evaluation has slopes, at starts that are optimal for its unknowns; ``rows @ rows / 2`` is the cost.
    """
    n, n_free, last = len(problem.model.states), len(problem.free), 0
    rows, slopes = [], []
    for k, here in enumerate(block_rows(problem)):
        full: Array = np.linalg.qr(_own(problem, evaluation, k, here), mode="complete")[0]
        rest = full[:, n:].T
        rows.append(rest @ evaluation.rows[here])
        slopes.append(rest @ evaluation.jacobian[here, :n_free])
        last = here.stop
    rows.append(evaluation.rows[last:])
    slopes.append(evaluation.jacobian[last:, :n_free])
    return np.concatenate(rows), np.vstack(slopes)


# ---- all unknowns ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """Outcome of a local fit: estimates, cost, convergence and residuals."""

    theta: Array  # (n_free,) unknowns [SI]
    starts: Array  # (n_piece, n_states) starts of the pieces [SI]
    cost: float  # half the sum of squares in units of the noise
    converged: bool
    message: str
    n_evaluations: int
    residuals: tuple[Array, ...]
    rows: Array
    jacobian: Array
    known: tuple[Solution, ...] = ()  # computed counterparts of the measured orbits, one entry per table

    @property
    def rms(self) -> Array:
        """Root mean square of each channel's residuals over all pieces [SI]."""
        return np.asarray(np.sqrt(np.nanmean(np.concatenate(self.residuals) ** 2, axis=0)))


class _Search:
    """Residual function for `least_squares`. It stores its last and its best evaluation.

    The vector holds the unknowns in units of their sizes. With a weight on the gaps it also holds all starts.
    Without a weight each start depends on its own piece alone. It is then fitted for the unknowns of each
    point, and its directions are projected out of the rows (variable projection: Golub and Pereyra, SIAM J.
    Numer. Anal. 10, 1973, 413, in Kaufman's form).
    """

    def __init__(self, problem: Problem, starts: Array, echo: Echo | None) -> None:
        self.problem, self.starts, self.echo = problem, starts, echo
        self.joint = problem.continuity is not None
        self.n_free, self.count, self.best = len(problem.free), 0, np.inf
        self.sizes = np.array([f.size for f in problem.free])
        if self.joint:
            self.sizes = np.append(self.sizes, np.tile(problem.model.scales, len(starts)))
        self._key = b""
        self._last: _Point | None = None
        self._base: _Point | None = None

    def split(self, x: Array) -> tuple[Array, Array]:
        """Split a scaled vector into the unknowns and the initial states, by default their first guesses."""
        full = x * self.sizes
        if not self.joint:
            return full, self.starts
        return full[: self.n_free], full[self.n_free :].reshape(self.starts.shape)

    def at(self, x: Array) -> _Point:
        """Evaluate residuals and Jacobian at a scaled vector; reuse the last evaluation if it is the same."""
        key = x.tobytes()
        if self._last is None or key != self._key:
            theta, starts = self.split(x)
            if not self.joint:
                starts = self._starts_for(theta)
            evaluation = evaluate(self.problem, theta[None], starts[None], slopes=True)[0]
            rows, jacobian = evaluation.rows, evaluation.jacobian[:, : len(self.sizes)]
            if not self.joint:
                rows, jacobian = project_starts_out(self.problem, evaluation)
            self._last = _Point(theta, starts, evaluation, rows, jacobian * self.sizes)
            self._key = key
            self.count += 1
            if evaluation.cost < self.best:
                self.best, self._base = evaluation.cost, self._last
                # Newton's method for measured orbits starts from those of the best point so far
                self.problem = replace(self.problem, orbits=evaluation.orbits)
                if self.echo is not None:
                    self.echo(theta, self.best)
        return self._last

    def _starts_for(self, theta: Array) -> Array:
        """Return fitted initial states for given unknowns; the best evaluation so far gives their first guess."""
        base = self._base
        if base is None:
            return fit_starts(self.problem, theta, self.starts).starts
        guess = carry_starts(self.problem, base.evaluation, base.starts, theta - base.theta)
        return fit_starts(self.problem, theta, guess).starts


class _Point(NamedTuple):
    theta: Array
    starts: Array
    evaluation: Evaluation
    rows: Array
    jacobian: Array


Echo = Callable[[Array, float], None]


def fit_local(
    problem: Problem,
    theta0: Array,
    *,
    starts: Array | None = None,
    fixed: Mapping[str, float] | None = None,
    max_evaluations: int = 100,
    tolerance: float = 1e-9,
    echo: Echo | None = None,
) -> Fit:
    """Fit the unknowns and the initial states by least squares from a first guess (`scipy.optimize.least_squares`,
    trust region with bounds).

    Parameters
    ----------
    problem
        Least-squares problem of the identification.
    theta0
        First guess of the unknowns, (n_free,); clipped to the bounds.
    starts
        First guess of the pieces' starts, (n_piece, n_states); by default the problem's.
    fixed
        Unknowns that are held at a value, by name. The others are fitted; `Fit.theta` holds all.
    max_evaluations
        Largest number of evaluations; beyond it the fit has not converged.
    tolerance
        Relative change of the unknowns below which the fit has converged; for the cost it is a tenth of this.
    echo
        Called with the unknowns and the cost whenever the cost decreases.

    Returns
    -------
    Fit

    Notes
    -----
    A robust loss takes residuals in units of their scale, which a first least-squares fit gives.
    """
    ending = max_evaluations, tolerance
    if fixed:
        return _fit_others(problem, theta0, starts, fixed, ending)
    first = problem.starts if starts is None else starts
    plain = replace(problem, loss="linear") if problem.loss != "linear" else problem
    fit = _solve(plain, theta0, first, ending, echo)
    if problem.loss == "linear":
        return fit
    z = np.concatenate(fit.residuals) / problem.noise
    scale = 1.4826 * float(np.nanmedian(np.abs(z)))
    scaled = replace(problem, loss_scale=max(scale, 1.0))
    robust = _solve(scaled, fit.theta, fit.starts, ending, echo)
    return replace(robust, n_evaluations=fit.n_evaluations + robust.n_evaluations)


def _solve(problem: Problem, theta0: Array, starts: Array, ending: tuple[int, float], echo: Echo | None) -> Fit:
    from threadpoolctl import threadpool_limits

    walk = _Search(problem, starts, echo)
    theta0 = np.clip(theta0, problem.lower, problem.upper)
    full = np.append(theta0, starts.ravel()) if walk.joint else np.array(theta0)
    # the matrices are so small that more threads would wait for each other
    with threadpool_limits(1):
        if not len(full):
            return _starts_alone(walk)
        x, ended, message = _least_squares(walk, full / walk.sizes, ending)
        point = walk.at(x)
    return _outcome(point, walk.count, ended, message)


def _least_squares(walk: _Search, x: Array, ending: tuple[int, float]) -> tuple[Array, bool, str]:
    """Run `scipy.optimize.least_squares`; return its final point, whether it converged, and its message."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_array

    most_dense = 600  # columns above which the Jacobian is sparse and its steps are solved iteratively
    sizes, problem = walk.sizes, walk.problem
    lower, upper = np.full(len(sizes), -np.inf), np.full(len(sizes), np.inf)
    lower[: walk.n_free], upper[: walk.n_free] = problem.lower, problem.upper
    sparse = len(sizes) > most_dense
    found = least_squares(
        lambda x: walk.at(x).rows,
        x,
        jac=lambda x: csr_array(walk.at(x).jacobian) if sparse else walk.at(x).jacobian,
        bounds=(lower / sizes, upper / sizes),
        method="trf",
        x_scale="jac",
        xtol=ending[1],
        ftol=0.1 * ending[1],
        gtol=None,
        tr_solver="lsmr" if sparse else "exact",
        max_nfev=ending[0],
    )
    return found.x, bool(found.status > 0), found.message


def _starts_alone(walk: _Search) -> Fit:
    problem, nothing = walk.problem, np.zeros(0)
    starts, settled = fit_starts(problem, nothing, walk.starts)
    n = int(np.count_nonzero(~settled))
    ended = n == 0
    message = f"the starts of {n} of {len(starts)} pieces go on moving" if n else "all starts have settled"
    evaluation = evaluate(problem, nothing[None], starts[None], slopes=True)[0]
    point = _Point(nothing, starts, evaluation, evaluation.rows, evaluation.jacobian)
    return _outcome(point, 1, ended, message)


def _outcome(point: _Point, count: int, ended: bool, message: str) -> Fit:
    evaluation, failed = point.evaluation, point.evaluation.failed
    if failed:
        total = len(point.starts) + sum(len(table.data) for table in evaluation.orbits)
        message = f"{failed} of {total} trajectories and measured orbits are lost"
    return Fit(
        point.theta,
        point.starts,
        evaluation.cost,
        ended and not failed,
        message,
        count,
        evaluation.residuals,
        evaluation.rows,
        evaluation.jacobian,
        tuple(table.known for table in evaluation.orbits),
    )


def _fit_others(
    problem: Problem, theta0: Array, starts: Array | None, fixed: Mapping[str, float], ending: tuple[int, float]
) -> Fit:
    """Fit with some unknowns fixed at given values; the returned fit contains all unknowns."""
    held = np.array([name in fixed for name in problem.names], bool)
    part = fit_local(
        problem.without(fixed), np.asarray(theta0)[~held], starts=starts, max_evaluations=ending[0], tolerance=ending[1]
    )
    theta = np.array([fixed.get(name, 0.0) for name in problem.names])
    theta[~held] = part.theta
    whole = evaluate(problem.with_orbits(part.known), theta[None], part.starts[None], slopes=True)[0]
    return replace(
        part, theta=theta, cost=whole.cost, residuals=whole.residuals, rows=whole.rows, jacobian=whole.jacobian
    )
