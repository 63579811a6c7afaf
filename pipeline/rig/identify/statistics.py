"""Estimate the errors of a fit: covariance with the initial states eliminated, intervals, autocorrelation of residuals.

Everything is in units of the noise that the fit was weighted with. Let J = (A, B) be the slopes of the
residuals by the parameters and by the starts, ``H = J'J`` and ``X = H_ss^-1 H_sp``. With the starts
eliminated, the slopes by the parameters are ``A - B X``, and their information is the Schur complement ``S =
H_pp - H_ps X``.

Residuals of a real rig are autocorrelated, since the model's error oscillates with the motion. If they were
taken as independent, intervals would be too narrow by the square root of the number of residuals per
independent one. If residuals are found to be autocorrelated, the variance of the scores is estimated from the
scores:

- with at least 8 independent pieces, over pieces by the delete-one jackknife (Bell & McCaffrey,
  Survey Methodology 28, 2002, 169, "CR3"; one step from the optimum, exact for a linear model), with
  Student's t for one degree of freedom less than their number;
- otherwise along time after Newey & West (Econometrica 55, 1987, 703), with critical values for a bandwidth
that
  is a fixed fraction of the sample (Kiefer & Vogelsang, Econometric Theory 21, 2005, 1130, Table 1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import signal, stats

from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.orbit_residuals import OrbitRows, orbit_rows
from pipeline.rig.identify.problem import Problem

LEVEL = 0.95


Estimator = Literal["white", "pieces", "newey-west", "orbits"]


@dataclass(frozen=True)
class Linearised:
    """Residuals and their derivatives at a fit's optimum, with the initial states eliminated, in units of the noise."""

    information: np.ndarray  # (n_free, n_free) information from data, priors and continuity
    prior: np.ndarray  # (n_free,) information of the priors, 1/sd^2; 0 where there is none
    residuals: tuple[np.ndarray, ...]  # (n, n_channels) residuals by piece; NaN where nothing was measured
    # (n, n_channels, n_free) slopes of the residuals by the parameters, by piece, with the starts eliminated
    slopes: tuple[np.ndarray, ...]
    groups: tuple[int, ...]  # the independent stretch that each piece belongs to
    n_starts: int  # number of fitted components of starts
    loss: str = "linear"  # name of the loss in `scipy.optimize.least_squares`
    loss_scale: float = 1.0  # residual above which a robust loss grows slower than the square
    # (n_piece, n_states, n_free) derivative of the optimum of the starts by the parameters
    following: np.ndarray | None = None
    # (n_orbit_residuals, n_free) slopes of the residuals of measured orbits, in standard deviations
    orbits: np.ndarray | None = None
    orbit_residuals: np.ndarray | None = None  # (n_orbit_residuals,) their residuals

    @property
    def stated(self) -> np.ndarray:
        """Information matrix, (n_free, n_free), of priors and measured orbits, whose errors are stated."""
        own = np.diag(self.prior).astype(float)
        return own if self.orbits is None else own + self.orbits.T @ self.orbits

    @property
    def n_samples(self) -> int:
        """Number of measured values in all pieces."""
        return int(sum(np.isfinite(r).sum() for r in self.residuals))

    @property
    def n_fitted(self) -> int:
        """Number of fitted values: parameters without a prior, and components of the initial states."""
        return int((self.prior == 0).sum()) + self.n_starts


@dataclass(frozen=True)
class Covariance:
    """Covariance of the estimates, with the method that gave it and the half width of 95 % intervals."""

    matrix: np.ndarray  # (n_free, n_free) NaN in rows and columns of parameters that are not determined
    estimator: Estimator
    why: str  # a sentence that gives the reason for the method
    critical: float  # half width of a 95 % interval in standard errors
    degrees: float  # degrees of freedom of Student's t
    inflation: float  # ratio of the standard errors to those of independent residuals as large as the noise

    @property
    def errors(self) -> np.ndarray:
        """Standard errors (n_free,); infinite for parameters that are not determined."""
        variance = np.diag(self.matrix)
        return np.where(np.isnan(variance), np.inf, np.sqrt(np.abs(variance)))

    @property
    def correlations(self) -> np.ndarray:
        """Correlation matrix (n_free, n_free); NaN for parameters that are not determined."""
        errors = np.sqrt(np.abs(np.diag(self.matrix)))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.clip(self.matrix / np.outer(errors, errors), -1.0, 1.0))


def eliminate_starts(jacobian: np.ndarray, n_free: int) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate the initial states from a least-squares problem whose Jacobian has the parameters' columns first.

    Return the information matrix of the parameters, the Schur complement of the starts' block of ``jacobian.T @
    jacobian``, and the matrix X of the module, (n_starts, n_free): minus the derivative of the starts' optimum by the
    parameters.
    """
    own, starts = jacobian[:, :n_free], jacobian[:, n_free:]
    # lstsq does not square the condition number, and gives 0 for undetermined starts
    following = np.linalg.lstsq(starts, own, rcond=None)[0]
    left = own - starts @ following
    return left.T @ left, following


def pooled_autocorrelation(residuals: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Return the autocorrelation of one channel's residuals over all pieces; see `pooled_pairs`."""
    return pooled_pairs(residuals, most)[0]


def pooled_pairs(residuals: Sequence[np.ndarray], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the autocorrelation (mean not subtracted) of one channel's residuals by piece, and the number of pairs, at
    each lag.

    The lags are 0 to `most`; the autocorrelation is NaN where no piece is long enough.
    """
    products, pairs = np.zeros(most + 1), np.zeros(most + 1)
    for r in residuals:
        there = np.isfinite(r)
        n = min(len(r), most + 1)
        for sums, values in ((products, np.where(there, r, 0.0)), (pairs, there.astype(float))):
            full = signal.correlate(values, values, method="auto")
            sums[:n] += full[len(r) - 1 : len(r) - 1 + n]
    pairs = np.rint(pairs)
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = products / pairs
        return np.asarray(covariance / covariance[0]), pairs


def is_autocorrelated(residuals: Sequence[np.ndarray]) -> bool:
    """Return whether residuals, (n, n_channels) by piece, are autocorrelated: a Ljung-Box test over all pieces."""
    level = 0.01  # probability that white residuals are taken for autocorrelated ones
    most = 20  # lags in the test
    n_channels = residuals[0].shape[1]
    shortest = min(len(r) for r in residuals)
    lags = max(1, min(most, shortest // 5))
    for c in range(n_channels):
        own = [r[:, c] for r in residuals]
        rho, pairs = pooled_pairs(own, lags)
        portmanteau = float(np.nansum(pairs[1:] * rho[1:] ** 2))
        if stats.chi2.sf(portmanteau, lags) < level / n_channels:
            return True
    return False


def memory_of(rho: np.ndarray, n: int) -> tuple[int, float]:
    """Return the lag at which `n` residuals have lost their correlation, and the number of residuals per independent
    one.

    From the lag on, the autocorrelation stays within the band of white noise for a while; the number is ``1 + 2 sum
    rho`` up to it, at least 1.
    """
    band = stats.norm.ppf(0.5 + LEVEL / 2) / np.sqrt(max(n, 1))
    outside = np.abs(np.nan_to_num(rho)) > 2.0 * band
    outside[0] = True
    quiet = max(3, len(rho) // 20)
    inside = np.flatnonzero(np.convolve(outside, np.ones(quiet), "full")[quiet - 1 : len(rho)] == 0)
    lag = int(inside[0]) if inside.size else len(rho) - 1
    return max(lag, 1), max(1.0, 1.0 + 2.0 * float(np.nansum(rho[1 : lag + 1])))


def n_effective(residuals: Sequence[np.ndarray]) -> list[float]:
    """Return the effective number of independent residuals of each channel, given their autocorrelation."""
    if not residuals:
        return []
    most = max(1, max(len(r) for r in residuals) // 3)
    found = []
    for c in range(residuals[0].shape[1]):
        own = [r[:, c] for r in residuals]
        n = sum(int(np.isfinite(r).sum()) for r in own)
        found.append(n / memory_of(pooled_autocorrelation(own, most), n)[1])
    return found


def robust_weights(residuals: np.ndarray, loss: str) -> tuple[np.ndarray, np.ndarray]:
    """Return, for a robust loss of `scipy.optimize.least_squares`, the derivative of half the loss divided by the
    residual, and the second derivative of half the loss, at least 0.
    """
    z = residuals**2
    if loss == "linear":
        return np.ones_like(z), np.ones_like(z)
    if loss == "soft_l1":
        return (1 + z) ** -0.5, (1 + z) ** -1.5
    if loss == "cauchy":
        return 1 / (1 + z), np.maximum(1 - z, 0.0) / (1 + z) ** 2
    inner = z <= 1
    return np.where(inner, 1.0, 1 / np.sqrt(np.maximum(z, 1.0))), inner.astype(float)


@dataclass(frozen=True)
class _Scores:
    """Gradients of the cost by the parameters at each sample time, and information matrices, by piece."""

    scores: list[np.ndarray]
    information: list[np.ndarray]
    by_channel: list[np.ndarray]


def _scores(fit: Linearised) -> _Scores:
    scores, information, by_channel = [], [], []
    for r, slopes in zip(fit.residuals, fit.slopes, strict=True):
        there = np.isfinite(r)
        known = np.where(there, r, 0.0)
        weight, bend = robust_weights(known / fit.loss_scale, fit.loss)
        own = np.where(there[..., None], slopes, 0.0)
        scores.append(np.einsum("tc,tcp->tp", weight * known, own))
        each = np.einsum("tcp,tc,tcq->cpq", own, bend, own)
        by_channel.append(each)
        information.append(each.sum(0))
    return _Scores(scores, information, by_channel)


def covariance_of(fit: Linearised, scale: np.ndarray, estimator: Estimator | None = None) -> Covariance:
    """Estimate the covariance of the fitted parameters, with allowance for autocorrelated residuals.

    `scale` is the size of each parameter, (n_free,), to detect singular directions. By default the residuals choose the
    estimator, see the module.
    """
    fewest = 8  # pieces whose scatter gives a variance
    if not fit.residuals:
        return _of_orbits(fit, scale)
    parts = _scores(fit)
    n_groups = len(set(fit.groups))
    correlated = is_autocorrelated(fit.residuals)
    if estimator is None:
        asked = correlated or fit.loss != "linear"
        estimator = "white" if not asked else "pieces" if n_groups >= fewest else "newey-west"
    reason = (
        "the residuals are autocorrelated"
        if correlated
        else "the loss is robust"
        if fit.loss != "linear"
        else "the residuals are not found to be autocorrelated"
    )
    if estimator == "white":
        matrix, degrees, critical = _white(fit, parts, scale)
        why = f"{reason}: each residual counts, with the variance of its channel"
    elif estimator == "pieces":
        matrix, degrees, critical = _pieces(fit, parts, scale)
        why = f"{reason}: the {n_groups} pieces count, by the delete-one jackknife"
    else:
        matrix, degrees, critical, bandwidth = _newey_west(fit, parts, scale)
        why = f"{reason}, and there are {n_groups} pieces: Newey-West with {bandwidth} lags"
    known = np.flatnonzero(np.isfinite(np.diag(matrix)))
    both = np.ix_(known, known)
    trace = float(np.trace(matrix[both] @ fit.information[both])) if known.size else 1.0
    inflation = float(np.sqrt(max(trace, 0.0) / max(known.size, 1)))
    return Covariance(matrix, estimator, why, critical, degrees, inflation)


def _of_orbits(fit: Linearised, scale: np.ndarray) -> Covariance:
    """Return the covariance of a fit to orbits alone, increased if the residuals exceed their stated errors."""
    assert fit.orbit_residuals is not None
    residuals, n_free = fit.orbit_residuals, len(fit.prior)
    degrees = len(residuals) + int((fit.prior > 0.0).sum()) - n_free
    ratio = float(residuals @ residuals) / degrees if degrees > 0 else 1.0
    inflation = math.sqrt(max(ratio, 1.0))
    inverse, lost = _inverse(fit.information, scale)
    why = "measured orbits count with their stated errors"
    if inflation > 1.0:
        why += f", raised by a factor of {inflation:.2g} to the scatter of the residuals"
    return Covariance(
        _without(inverse * inflation**2, lost), "orbits", why, _t(max(degrees, 1)), float(max(degrees, 1)), inflation
    )


def root_of(matrix: np.ndarray) -> np.ndarray:
    """Return a factor that turns rows of white noise into rows with a covariance, ``noise @ root``.

    It is the symmetric root of the correlations, times the standard deviations: the same on all processors, whatever
    signs LAPACK gives the eigenvectors.
    """
    scale = np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T * scale)


def _inverse(information: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pseudo-inverse of the information matrix, and a mask of the parameters that are not determined."""
    # ratio to the largest eigenvalue of the scaled information below which a direction is not determined
    singular = 1e-12
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    good = values > singular * max(float(values.max(initial=0.0)), 1e-300)
    inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T
    lost = (np.abs(vectors[:, ~good]) > 1e-3).any(axis=1)
    return inverse * np.outer(scale, scale), lost


def _sandwich(fit: Linearised, meat: np.ndarray, scale: np.ndarray) -> np.ndarray:
    inverse, lost = _inverse(fit.information, scale)
    return _without(inverse @ meat @ inverse, lost)


def _without(matrix: np.ndarray, lost: np.ndarray) -> np.ndarray:
    result = matrix.copy()
    result[lost, :] = np.nan
    result[:, lost] = np.nan
    return result


def _t(degrees: float) -> float:
    return float(stats.t.ppf(0.5 + LEVEL / 2, degrees))


def _white(fit: Linearised, parts: _Scores, scale: np.ndarray) -> tuple[np.ndarray, float, float]:
    degrees = max(fit.n_samples - fit.n_fitted, 1)
    share = degrees / fit.n_samples
    stacked = np.concatenate(fit.residuals)
    weight, _ = robust_weights(np.nan_to_num(stacked) / fit.loss_scale, fit.loss)
    counts = np.isfinite(stacked).sum(0)
    variance = np.nansum((weight * stacked) ** 2, axis=0) / np.maximum(counts, 1) / share
    data = np.sum(parts.by_channel, axis=0)
    meat = np.einsum("c,cpq->pq", variance, data)
    # priors and continuity enter with their stated variance
    meat = meat + (fit.information - data.sum(0))
    return _sandwich(fit, meat, scale), float(degrees), _t(degrees)


def _pieces(fit: Linearised, parts: _Scores, scale: np.ndarray) -> tuple[np.ndarray, float, float]:
    names = sorted(set(fit.groups))
    n = len(names)
    moves = []
    for name in names:
        own = [i for i, g in enumerate(fit.groups) if g == name]
        score = np.sum([parts.scores[i].sum(0) for i in own], axis=0)
        left = fit.information - np.sum([parts.information[i] for i in own], axis=0)
        moves.append(_inverse(left, scale)[0] @ score)
    about = np.array(moves) - np.mean(moves, axis=0)
    matrix = (n - 1) / n * about.T @ about
    inverse, lost = _inverse(fit.information, scale)
    matrix = matrix + inverse @ fit.stated @ inverse
    return _without(matrix, lost), float(n - 1), _t(n - 1)


def _newey_west(fit: Linearised, parts: _Scores, scale: np.ndarray) -> tuple[np.ndarray, float, float, int]:
    n = fit.n_samples // fit.residuals[0].shape[1]
    longest = max(len(r) for r in fit.residuals)
    memory = 1
    for c in range(fit.residuals[0].shape[1]):
        own = [r[:, c] for r in fit.residuals]
        memory = max(memory, memory_of(pooled_autocorrelation(own, max(1, longest // 3)), n)[0])
    bandwidth = max(1, min(2 * memory, longest // 3))
    meat = fit.stated
    for s in parts.scores:
        meat = meat + _bartlett(s, min(bandwidth, len(s) - 1))
    degrees = max(min(n_effective(fit.residuals)) - fit.n_fitted / len(fit.groups), 2.0)
    b = bandwidth / max(n, 1)
    critical = 1.9600 + 2.9694 * b + 0.4160 * b**2 - 0.5324 * b**3
    share = max(fit.n_samples - fit.n_fitted, 1) / fit.n_samples
    return _sandwich(fit, meat / share, scale), degrees, max(critical, _t(degrees)), bandwidth


def _bartlett(scores: np.ndarray, bandwidth: int) -> np.ndarray:
    """Return the Newey-West sum of the scores' autocovariances, with Bartlett weights up to lag `bandwidth`."""
    n, p = scores.shape
    window = 1.0 - np.abs(np.arange(-bandwidth, bandwidth + 1)) / (bandwidth + 1)
    smoothed = np.stack(
        [signal.convolve(scores[:, i], window, "full")[bandwidth : bandwidth + n] for i in range(p)], axis=1
    )
    meat = scores.T @ smoothed
    return np.asarray((meat + meat.T) / 2)


# ---- linearisation of a fit ------------------------------------------------------------------------


def linearise(problem: Problem, fit: Fit) -> Linearised:
    """Return the residuals at a fit's optimum and their derivatives by the parameters, with the initial states
    eliminated.

    The fit's own slopes are compressed piece by piece. Statistics of autocorrelated residuals need them along
    time.
    """
    n_free, n_states = len(problem.free), len(problem.model.states)
    scale = loss_scale_of(problem, fit)
    full = sample_slopes(problem, fit) if problem.pieces else []
    joined = problem.continuity is not None
    follow = eliminate_starts(fit.jacobian, n_free)[1] if joined else None
    slopes, following = [], []
    for k, own in enumerate(full):
        flat = own.reshape(-1, own.shape[-1])
        # free starts are eliminated piece by piece here: the fit's one-sided differences are less exact
        moves = eliminate_starts(flat, n_free)[1] if follow is None else follow[k * n_states : (k + 1) * n_states]
        slopes.append(own[..., :n_free] - own[..., n_free:] @ moves)
        following.append(-moves)
    prior = np.array([f.prior_sd**-2 if f.has_prior else 0.0 for f in problem.free])
    residuals = tuple(r / problem.noise for r in fit.residuals)
    of_orbits = _at_orbits(problem, fit)
    information = _information(problem, fit, slopes, residuals, prior, scale)
    if of_orbits is not None and not joined:
        information = information + of_orbits.jacobian.T @ of_orbits.jacobian
    return Linearised(
        information,
        prior,
        residuals,
        tuple(slopes),
        groups_of(problem),
        fit.starts.size,
        problem.loss,
        scale,
        np.array(following),
        None if of_orbits is None else of_orbits.jacobian,
        None if of_orbits is None else of_orbits.rows,
    )


def _at_orbits(problem: Problem, fit: Fit) -> OrbitRows | None:
    if not problem.orbits:
        return None
    return orbit_rows(problem.with_orbits(fit.known), fit.theta[None], slopes=True)[0]


def _information(
    problem: Problem,
    fit: Fit,
    slopes: list[np.ndarray],
    residuals: tuple[np.ndarray, ...],
    prior: np.ndarray,
    scale: float,
) -> np.ndarray:
    """Return the unknowns' information matrix: a sum over samples, or of the Jacobian for coupled pieces."""
    if problem.continuity is not None:
        return eliminate_starts(fit.jacobian, len(problem.free))[0]
    total = np.diag(prior)
    for r, own in zip(residuals, slopes, strict=True):
        there = np.isfinite(r)
        bend = np.where(there, robust_weights(np.where(there, r, 0.0) / scale, problem.loss)[1], 0.0)
        known = np.where(there[..., None], own, 0.0)
        total = total + np.einsum("tcp,tc,tcq->pq", known, bend, known)
    return total


def loss_scale_of(problem: Problem, fit: Fit) -> float:
    """Return the residual, in units of the noise, above which a robust loss grows slower than the square."""
    mad = 1.4826  # ratio of the standard deviation of Gaussian noise to its median absolute value
    if problem.loss == "linear":
        return 1.0
    z = np.concatenate(fit.residuals) / problem.noise
    return max(mad * float(np.nanmedian(np.abs(z))), 1.0)


def groups_of(problem: Problem) -> tuple[int, ...]:
    """Return the group of each piece: consecutive pieces tied by a continuity weight form one."""
    found: list[int] = []
    for k, piece in enumerate(problem.pieces):
        joined = problem.continuity is not None and 0 <= piece.follows < k
        found.append(found[piece.follows] if joined else k)
    return tuple(found)


def sample_slopes(problem: Problem, fit: Fit) -> list[np.ndarray]:
    """Return, for each piece, the derivatives of the residuals at each sample by the unknowns and by the piece's
    initial state, in units of the noise.

    They are central differences from one call of the engine. The starts of all pieces are changed at once,
    since no piece depends on another's start. At a bound the differences are one-sided.
    """
    share = 1e-4  # step of the central differences in units of the sizes; their error is about its square
    rtol = 1e-10  # tolerance of the integration under the differences; a slope's noise is this over `share`
    n_free, scales = len(problem.free), problem.model.scales
    thetas, starts, widths = [], [], []
    for i, free in enumerate(problem.free):
        h = share * max(abs(float(fit.theta[i])), free.size)
        ends = np.clip(fit.theta[i] + h * np.array([1.0, -1.0]), free.lower, free.upper)
        for end in ends:
            theta = fit.theta.copy()
            theta[i] = end
            thetas.append(theta)
            starts.append(fit.starts)
        widths.append(float(ends[0] - ends[1]))
    for s, scale in enumerate(scales):
        for sign in (1.0, -1.0):
            moved = fit.starts.copy()
            moved[:, s] += sign * share * scale
            thetas.append(fit.theta)
            starts.append(moved)
        widths.append(2 * share * scale)
    exact = replace(problem, rtol=min(problem.rtol, rtol), continuity=None, orbits=())
    found = evaluate(exact, np.array(thetas), np.array(starts), slopes=False)
    slopes = []
    for k in range(len(problem.pieces)):
        own = [
            (found[2 * j].residuals[k] - found[2 * j + 1].residuals[k]) / (widths[j] * problem.noise)
            for j in range(n_free + len(scales))
        ]
        slopes.append(np.nan_to_num(np.stack(own, axis=-1)))
    return slopes
