"""Analyse which parameters the data determine, and whether they contradict the stated frequency of a known drive.

A profile likelihood is the growth of the cost when one parameter is fixed away from its estimate. The growth is scaled
by the covariance, autocorrelated residuals included. On a quadratic criterion the profile's interval therefore equals
the interval of the standard error. On any other criterion the profile's interval is the better one (Raue et al.,
Bioinformatics 25, 2009, 1923).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import DETUNING, Free, Problem
from pipeline.rig.identify.statistics import Covariance, covariance_of, linearise, loss_scale_of


@dataclass(frozen=True)
class Direction:
    """Direction in parameter space, in units of typical sizes, with its singular value and standard error."""

    # norm of the change of all residuals, in standard deviations of the noise, for a step of one size. Priors do not
    # count.
    singular_value: float
    error: float  # standard error along the direction, relative to the sizes; infinite if the data do not determine it
    vector: np.ndarray  # (n_free,) unit vector

    @property
    def is_loose(self) -> bool:
        """Whether the standard error along the direction is so large that the data do not determine it."""
        loose = 0.5  # standard error, relative to the parameters' sizes, above which the direction is not determined
        return self.error > loose


def sizes_of(
    theta: np.ndarray, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, sensed: np.ndarray
) -> np.ndarray:
    """Return a typical size of each parameter, (n_free,): the larger of estimate and start; if both are 0, the width of
    the bounds, or 1.

    `sensed` is the size of the measured quantity for parameters that are its offset and may be 0, and NaN for others.
    """
    size = np.maximum(np.abs(theta), np.abs(start))
    width = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return np.where(np.isfinite(sensed), sensed, np.where(size > 0, size, width))


def directions_of(information: np.ndarray, scale: np.ndarray, inflation: float) -> list[Direction]:
    """Return the eigenvectors of the information matrix of the data alone as directions, the best determined one first.

    The matrix is scaled by the parameters' sizes, see `sizes_of`; `inflation` is a factor on standard errors, see
    `Covariance`.
    """
    zero = 1e-6  # ratio to the largest singular value below which one counts as zero
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    found = []
    for value, vector in zip(singular, vectors.T[::-1], strict=True):
        sign = np.sign(vector[np.argmax(np.abs(vector))]) or 1.0
        never = value <= zero * singular[0]
        error = np.inf if never else inflation / value
        found.append(Direction(float(value), float(error), vector * sign))
    return found


def invisible(information: np.ndarray, names: Sequence[str]) -> list[str]:
    """Return the names of the parameters that the residuals do not depend on."""
    own = np.diag(information)
    return [name for name, value in zip(names, own, strict=True) if not value > 0.0]


def warnings_of(
    names: Sequence[str],
    directions: Sequence[Direction],
    covariance: Covariance,
    prior_sd: np.ndarray,
    at_bound: Sequence[str],
) -> list[str]:
    """Return warnings on parameters and combinations that the data do not determine, and on estimates at a bound or set
    by a prior.

    `directions` come from the data alone, `covariance` includes priors; `prior_sd` is NaN without a prior, and
    `at_bound` has ``lower``, ``upper`` or an empty text for each parameter.
    """
    by_prior = 0.9  # ratio of standard error to the prior's above which an estimate rests on its prior alone
    found = [_loose(names, d, prior_sd) for d in directions if d.is_loose]
    errors = covariance.errors
    for i, name in enumerate(names):
        if at_bound[i]:
            found.append(
                f"{name} ended at its {at_bound[i]} bound: its interval says little, and the model may lack "
                "what would have moved it further. Widen the bound if it may be passed, and look at the "
                "residuals."
            )
        if np.isfinite(prior_sd[i]) and errors[i] > by_prior * prior_sd[i]:
            found.append(
                f"{name} is as its prior says: the recordings add nothing (standard error {errors[i]:.3g}, "
                f"that of the prior {prior_sd[i]:.3g})."
            )
    return found + _alike(names, covariance.correlations)


def _loose(names: Sequence[str], direction: Direction, prior_sd: np.ndarray) -> str:
    least = 0.15  # component, relative to the largest, from which on a parameter is named in a direction
    weight = direction.vector / np.abs(direction.vector).max()
    order = np.argsort(-np.abs(weight), kind="stable")
    shown = [int(i) for i in order if abs(weight[i]) >= least]
    known = np.isfinite(direction.error)
    share = f"standard error {_percent(direction.error)} of its size"
    error = share if known else "the fit is the same for any value"
    held = [names[i] for i in shown if np.isfinite(prior_sd[i])]
    remedy = (
        f"Here the prior of {_and(held)} decides."
        if held
        else "Fix one of them, tie them, or give one a prior."
        if len(shown) > 1
        else "Fix it, give it a prior, or add a recording in which it matters."
    )
    if len(shown) == 1:
        return f"the data do not determine {names[shown[0]]} ({error}). {remedy}"
    changes = _and([f"{names[i]} {10 * weight[i]:+.2g} %" for i in shown])
    if known:
        words = f"together {changes} hardly change the fit (standard error {_percent(direction.error)})"
    else:
        words = f"together {changes} leave the fit as it is"
    return (
        f"the data do not determine {_and([names[i] for i in shown])} apart, only combinations of them: "
        f"{words}. {remedy}"
    )


def _alike(names: Sequence[str], correlations: np.ndarray) -> list[str]:
    alike = 0.99  # correlation above which two estimates are reported as known better together than apart
    pairs = [
        (i, j)
        for i in range(len(names))
        for j in range(i)
        if np.isfinite(correlations[i, j]) and abs(correlations[i, j]) > alike
    ]
    return [
        f"{names[j]} and {names[i]} are known better together than apart: their correlation is "
        f"{correlations[i, j]:+.4f}."
        for i, j in pairs
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share < 100 else f"{share:.2g} times"


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


# ---- profile likelihoods ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Profile:
    """Profile likelihood of one parameter: scaled increase of the cost off the estimate, and its 95 % interval."""

    name: str
    values: np.ndarray  # (n,) rising, in the parameter's unit; the estimate is among them
    # (n,) twice the growth of the cost over the best fit, scaled so that it is 1 at one standard error on a quadratic
    # criterion. NaN where a fit did not converge.
    growth: np.ndarray
    # 95 % interval; infinite where the profile does not rise far enough within the bounds
    interval: tuple[float, float]

    @property
    def lowest(self) -> float:
        """Least increase of the cost along the profile; negative if it found a better fit than the search."""
        return float(np.nanmin(self.growth))


@dataclass(frozen=True)
class Curvature:
    """Quadratic approximation of the cost along one parameter near its estimate, and the scales of its profile."""

    error: float  # standard error; infinite if it is not known
    plain: float  # standard error for independent residuals as large as the noise
    critical: float  # half width of the interval in standard errors
    size: float
    others: np.ndarray  # (n_free,) derivative of the optimum of all parameters by this one
    starts: np.ndarray  # (n_piece, n_states) derivative of the optimum of the starts by this parameter


def profile(problem: Problem, best: Fit, name: str, about: Curvature, fit_local: Callable[..., Fit]) -> Profile:
    """Compute the profile likelihood of a parameter: at each value, all other unknowns are fitted again."""
    # distances at which the profile is computed on either side, in half widths of the interval
    steps = (0.4, 0.8, 1.2, 1.6)
    tolerances = (1e-9, 1e-6)  # smallest and largest tolerance of the fits, see `pipeline.rig.identify.local.fit_local`
    unknown = 0.1  # half width that is tried if the standard error is unknown, relative to the parameter's size
    index = [f.name for f in problem.free].index(name)
    free = problem.free[index]
    estimate = float(best.theta[index])
    known = np.isfinite(about.error) and about.error > 0
    half = about.critical * about.error if known else unknown * about.size
    unit = (about.error / about.plain) ** 2 if known else 1.0
    # so that the cost is accurate to a hundredth of its growth at one standard error
    tolerance = float(np.clip(0.05 * unit / max(best.cost, 1e-300), *tolerances))
    found = {estimate: 0.0}
    for side in (-1.0, 1.0):
        theta, starts, at = best.theta, best.starts, estimate
        for step in steps:
            value = float(np.clip(estimate + side * step * half, free.lower, free.upper))
            if value in found:
                break
            theta = theta + (value - at) * about.others
            starts = starts + (value - at) * about.starts
            fit = fit_local(problem, theta, starts=starts, fixed={name: value}, tolerance=tolerance)
            found[value] = 2.0 * (fit.cost - best.cost) / unit if fit.converged else np.nan
            theta, starts, at = fit.theta, fit.starts, value
    values = np.array(sorted(found))
    growth = np.array([found[float(v)] for v in values])
    return Profile(name, values, growth, interval_of(values, growth, estimate, about.critical))


def following(information: np.ndarray, index: int) -> np.ndarray:
    """Return the change of all optimal parameters, (n_free,), per unit change of one that is held fixed."""
    others = np.delete(np.arange(len(information)), index)
    moves = np.ones(len(information))
    both = information[np.ix_(others, others)]
    # scaled, so that small columns are not taken for singular ones
    size = np.sqrt(np.maximum(np.diag(both), 1e-300))
    inverse = np.linalg.pinv(both / np.outer(size, size), rcond=1e-10, hermitian=True)
    moves[others] = -(inverse @ (information[others, index] / size)) / size
    return moves


def interval_of(values: np.ndarray, growth: np.ndarray, estimate: float, critical: float) -> tuple[float, float]:
    """Return where the root of a parameter's profile likelihood reaches `critical` standard errors."""
    ends: list[Any] = []
    for side in (-1.0, 1.0):
        own = np.isfinite(growth) & (side * (values - estimate) >= 0)
        order = np.argsort(np.abs(values[own] - estimate))
        x, root = values[own][order], np.sqrt(np.maximum(growth[own][order], 0.0))
        over = np.flatnonzero(root >= critical)
        if not over.size:
            ends.append(side * np.inf)
            continue
        k = int(over[0])
        share = (critical - root[k - 1]) / (root[k] - root[k - 1])
        ends.append(float(x[k - 1] + share * (x[k] - x[k - 1])))
    return ends[0], ends[1]


# ---- frequency of a known drive ----------------------------------------------------------------


AGREES, OFF, OPEN = "agrees", "off", "not decided"


@dataclass(frozen=True)
class DriveFrequency:
    """Estimate of the frequency of a recording's known drive."""

    recording: int
    # frequency as stated and as estimated, and the standard error of the latter [Hz]
    frequency_hz: float
    estimate_hz: float
    error_hz: float
    verdict: str  # ``agrees``, ``off`` or ``not decided``

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data."""
        return asdict(self)

    @property
    def warning(self) -> str:
        """Sentence about a frequency that the data contradict or cannot judge; empty for one that they confirm."""
        where = f"recordings[{self.recording}].frequency_hz = {self.frequency_hz:.8g}"
        if self.verdict == OPEN:
            return (
                f"{where}: the fit cannot tell whether the drive has this frequency (standard error "
                f"{self.error_hz:.2g} Hz; the fit misses much of the motion, or the drive has little effect). A "
                "frequency that is far off looks like this: check it, and the recording's sampling rate."
            )
        if self.verdict == AGREES:
            return ""
        apart = abs(self.estimate_hz - self.frequency_hz) / self.error_hz
        return (
            f"{where}: the data contradict it, and all estimates suffer; they give about {self.estimate_hz:.8g} Hz, "
            f"{apart:.2g} standard errors ({self.error_hz:.2g} Hz) away. Correct it, or the recording's sampling rate, "
            "and identify again."
        )


def estimate_frequencies(problem: Problem, fit: Fit, scale: np.ndarray) -> list[DriveFrequency]:
    """Estimate the frequencies of the drives whose phases were fitted or stated, one Gauss-Newton step from the fit.

    A detuning of each known drive is a further unknown, which gives an estimate with its standard error (a score test:
    Rao, Math. Proc. Camb. Philos. Soc. 44, 1948, 50). `scale` are the unknowns' sizes.
    """
    # distance from the stated frequency, in half widths of the 95 % interval, that is reported: four standard errors or
    # more
    far = 2.0
    # half width of the interval, in drive periods over the recording, above which a step from the fit decides nothing
    vague_periods = 0.1
    # root mean square of the residuals, relative to the spread of a channel, above which the fit misses so much of the
    # motion that a step from it decides nothing: several periods off, the cost hardly depends on the frequency
    misses = 0.2
    stated = {p.recording: p.known_hz for p in problem.pieces if p.known_hz}
    if not stated:
        return []
    # a size turns the drive by one period from the start of a recording to its end
    sizes = [
        1.0 / max(p.begin_s + float(p.time[-1]) for p in problem.pieces if p.recording == recording)
        for recording in stated
    ]
    added = [Free(f"{DETUNING}.{r}", 0.0, unit="Hz", typical=s) for r, s in zip(stated, sizes, strict=True)]
    wider = replace(problem, free=(*problem.free, *added), slopes="differences", loss_scale=loss_scale_of(problem, fit))
    theta, scales = np.append(fit.theta, np.zeros(len(added))), np.append(scale, sizes)
    whole = evaluate(wider, theta[None], fit.starts[None], slopes=True)[0]
    there = replace(fit, theta=theta, rows=whole.rows, jacobian=whole.jacobian)
    linear = linearise(wider, there)
    # at the optimum the gradient by all other unknowns is 0
    gradient = (whole.jacobian.T @ whole.rows)[: len(theta)]
    gradient[: len(fit.theta)] = 0.0
    information = linear.information * np.outer(scales, scales)
    step = -scales * np.linalg.lstsq(information, scales * gradient, rcond=1e-12)[0]
    moved = tuple(r + s @ step for r, s in zip(linear.residuals, linear.slopes, strict=True))
    covariance = covariance_of(replace(linear, residuals=moved), scales)
    found = []
    for i, (recording, known) in enumerate(stated.items(), len(fit.theta)):
        moved_hz, error = float(step[i]), float(covariance.errors[i])
        half = covariance.critical * error
        vague = not half < vague_periods * scales[i] or _missed(problem, fit, recording) > misses
        verdict = OFF if abs(moved_hz) > far * half else OPEN if vague else AGREES
        found.append(DriveFrequency(recording, known, known + moved_hz, error, verdict))
    return found


def _missed(problem: Problem, fit: Fit, recording: int) -> float:
    """Return the residuals' largest root mean square of a channel in a recording, relative to the channel's spread."""
    own = [k for k, p in enumerate(problem.pieces) if p.recording == recording]
    left = np.nanmean(np.concatenate([fit.residuals[k] for k in own]) ** 2, axis=0)
    spread = np.nanvar(np.concatenate([problem.pieces[k].measured for k in own]), axis=0)
    return float(np.sqrt(np.max(left / np.maximum(spread, 1e-300))))
