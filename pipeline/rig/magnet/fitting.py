"""Fit measured torque curves: each curve alone, laws over the locked angle, all readings jointly, and point dipoles.

See Wojna et al., J. Sound Vib. 430 (2018), section 3, Eq. 16-19. Standard errors come from the residuals'
variance. If the law is wrong, residuals of neighbouring readings are correlated and these errors are too
small. The joint fit therefore also has errors from a jackknife over whole curves. They hold for any
correlation within a curve.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.rig.magnet.measurement import Curve, Measurement

# ---- least squares ---------------------------------------------------------------------------------

_EPS = np.finfo(np.float64).eps
MAX_EVALUATIONS = 4000


@dataclass(frozen=True)
class Solution:
    """Result of a converged least-squares fit: estimates, standard errors, Jacobian and residuals."""

    x: np.ndarray  # estimates, (n_free,)
    errors: np.ndarray  # standard errors, (n_free,)
    jacobian: np.ndarray  # derivatives of the residuals, (n, n_free)
    residuals: np.ndarray  # measured minus computed (n,)

    @property
    def correlation(self) -> np.ndarray:
        """Correlation matrix of the estimates, for readings with equal noise."""
        normal = _inverse(self.jacobian)
        size = np.sqrt(np.diag(normal))
        return np.asarray(normal / size[:, None] / size)


@dataclass(frozen=True)
class Quality:
    """Quality of a fit: R squared, and root mean square of the residuals."""

    r2: float  # 1 - residual over total sum of squares about the mean
    rms: float  # root mean square of the residuals [N m]

    @classmethod
    def of(cls, measured: np.ndarray, residuals: np.ndarray) -> Quality:
        """Compute the quality of a fit from the readings and their residuals."""
        total = float(((measured - measured.mean()) ** 2).sum())
        left = float(residuals @ residuals)
        return cls(1.0 - left / total if total > 0.0 else math.nan, math.sqrt(left / len(residuals)))


def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    start: Sequence[float],
    what: str,
) -> Solution:
    """Solve a nonlinear least-squares problem by the Levenberg-Marquardt method, with tolerances at the level of
    rounding errors.

    `slopes` are the derivatives of the residuals, (n, n_free); `what` names the fit in messages. Raise
    `ArithmeticError` if it does not converge, or the readings do not determine all free parameters.
    """
    with np.errstate(all="ignore"):
        found = least_squares(
            residuals,
            start,
            slopes,
            method="lm",
            x_scale="jac",
            ftol=4 * _EPS,
            xtol=4 * _EPS,
            gtol=4 * _EPS,
            max_nfev=MAX_EVALUATIONS,
        )
        finite = bool(np.isfinite(found.x).all() and np.isfinite(found.fun).all())
        if found.status < 1 or not finite:
            raise ArithmeticError(f"{what}: the fit did not converge ({found.message}), so there is no result.")
        jacobian = slopes(found.x)
        variance = found.fun @ found.fun / max(len(found.fun) - len(found.x), 1)
        try:
            errors = np.sqrt(np.diag(_inverse(jacobian)) * variance)
        except np.linalg.LinAlgError:
            errors = np.full(len(found.x), np.nan)
    if not np.isfinite(errors).all():
        raise ArithmeticError(f"{what}: the readings do not determine all fitted parameters, so there is no result.")
    return Solution(found.x, errors, jacobian, found.fun)


def _inverse(jacobian: np.ndarray) -> np.ndarray:
    """Return the inverse of ``J.T @ J``; the columns of ``J`` are scaled to equal size for accuracy."""
    size = np.linalg.norm(jacobian, axis=0)
    _, s, right = np.linalg.svd(jacobian / size, full_matrices=False)
    if not s[-1] > len(jacobian) * _EPS * s[0]:
        raise np.linalg.LinAlgError
    half = right.T / s / size[:, None]
    return np.asarray(half @ half.T)


def errors_by_cluster(found: Solution, clusters: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard errors of fitted parameters by a jackknife over clusters of rows, within which residuals may
    correlate.

    This is the jackknife over clusters about the fit to all readings (CR3): each cluster is left out in turn, to first
    order. Unlike the plain sandwich, its errors are not too small with few clusters: MacKinnon, Nielsen & Webb, J.
    Econometrics 232 (2023) 272-299. All are NaN if one cluster alone determines some parameter.
    """
    normal = _inverse(found.jacobian)
    squares = np.zeros(len(found.x))
    for rows in clusters:
        own = found.jacobian[rows]
        rest = np.eye(len(rows)) - own @ normal @ own.T
        if np.linalg.cond(rest) > 1.0 / (len(found.jacobian) * _EPS):
            return np.full(len(found.x), np.nan)
        squares += (normal @ own.T @ np.linalg.solve(rest, found.residuals[rows])) ** 2
    return np.asarray(np.sqrt(squares * (len(clusters) - 1) / len(clusters)))


@dataclass(frozen=True)
class CurveFit:
    """Fit of one Gaussian bump to one torque curve (Wojna et al. 2018, Eq. 17), with standard errors and quality."""

    curve: Curve
    # by ``A`` [N m], ``b``, ``c`` [rad]
    values: dict[str, float]
    errors: dict[str, float]
    quality: Quality


@dataclass(frozen=True)
class Laws:
    """Fitted height, position and width of the bumps as functions of the locked angle (Wojna et al. 2018, Eq. 18)."""

    # by the names of `laws.FITTED`, without the steepness
    values: dict[str, float]
    errors: dict[str, float]
    r2: dict[str, float]  # R squared of height and position by side, ``A1`` ... ``b2``. The width is constant.


@dataclass(frozen=True)
class JointFit:
    """Joint fit to all readings (Wojna et al. 2018, Eq. 18-19), with standard errors and correlations."""

    free: tuple[str, ...]
    values: dict[str, float]  # all of `laws.FITTED`
    # standard errors of `free`: from the residuals' variance, and from a jackknife over whole curves. The latter are
    # NaN if one curve alone determines a parameter.
    errors: dict[str, float]
    errors_by_curve: dict[str, float]
    correlation: np.ndarray
    quality: Quality
    residuals: np.ndarray  # measured minus computed [N m]
    neighbours: float  # correlation of the residuals of neighbouring readings of a curve; 0 for white noise
    # for each parameter that the readings hardly determine, the one with which it correlates most
    undetermined: dict[str, str]


@dataclass(frozen=True)
class DipoleFit:
    """Fit of two point dipoles to the readings (Wojna et al. 2018, Eq. 16)."""

    # ``pole1`` and ``pole2``, which are equal since only their product matters, and the place ``h`` [m]
    values: dict[str, float]
    quality: Quality
    residuals: np.ndarray  # measured minus computed [N m]


# ---- one curve -----------------------------------------------------------------------------------


def fit_curve(angle: np.ndarray, torque: np.ndarray, curve: Curve) -> CurveFit:
    """Fit a Gaussian bump (Wojna et al. 2018, Eq. 17) to the readings [rad], [N m] of one torque curve.

    Raise `ArithmeticError` if the fit does not converge, or finds no peak among the readings.
    """
    what = f"curve {curve}"
    peak = int(np.argmax(torque if curve.side == 0 else -torque))
    order = np.argsort(angle)
    area = float(np.trapezoid(torque[order], angle[order]))
    width = abs(area) / (math.sqrt(math.pi) * max(abs(torque[peak]), 1e-300)) or np.ptp(angle)
    start = (torque[peak], -angle[peak], min(width, float(np.ptp(angle))))
    found = solve(lambda x: torque - laws.bump(angle, *x), lambda x: -laws.bump_slopes(angle, *x), start, what)
    height, position, width = found.x[0], found.x[1], abs(found.x[2])
    within = angle.min() <= -position <= angle.max()
    if not within or (height > 0.0) != (curve.side == 0):
        raise ArithmeticError(
            f"{what}: the fit finds no peak of the expected sign among the readings; check side and sign, "
            "read on both sides of the peak, or leave the curve out."
        )
    names = (laws.HEIGHT, laws.POSITION, laws.WIDTH)
    values = dict(zip(names, (float(height), float(position), float(width)), strict=True))
    errors = dict(zip(names, map(float, found.errors), strict=True))
    return CurveFit(curve, values, errors, Quality.of(torque, found.residuals))


def fit_curves(measured: Measurement) -> tuple[CurveFit, ...]:
    """Fit a bump to each torque curve separately; raise `ArithmeticError` with all curves whose fits fail."""
    found, problems = [], []
    for curve in measured.curves:
        try:
            found.append(fit_curve(measured.angle[curve.rows], measured.torque[curve.rows], curve))
        except ArithmeticError as error:
            problems.append(str(error))
    if problems:
        raise ArithmeticError("\n".join(problems))
    return tuple(found)


# ---- over the locked angle -----------------------------------------------------------------------


def fit_laws(curves: Sequence[CurveFit]) -> Laws:
    """Fit the bumps' height by a Gaussian, their position by a line and their width by a constant, over the locked
    angle (Wojna et al. 2018, Eq. 18).

    Each value is weighted by its standard error. The laws' own errors come from the scatter about them.
    """
    values: dict[str, float] = {}
    errors: dict[str, float] = {}
    r2: dict[str, float] = {}
    for i, side in enumerate(laws.SIDES, 1):
        own = [fit for fit in curves if laws.SIDES[fit.curve.side] == side]
        locked = np.array([fit.curve.locked for fit in own])
        for key, names, law in (
            (laws.HEIGHT, ("alpha", "beta", "gamma"), _gaussian),
            (laws.POSITION, ("p", "r"), _line),
            (laws.WIDTH, ("c",), _constant),
        ):
            y = np.array([fit.values[key] for fit in own])
            error = np.array([fit.errors[key] for fit in own])
            found, computed = law(locked, y, _weights(error), f"{key} of the {side} side")
            values |= {f"{n}{i}": float(v) for n, v in zip(names, found.x, strict=True)}
            errors |= {f"{n}{i}": float(e) for n, e in zip(names, found.errors, strict=True)}
            if len(names) > 1:
                r2[f"{key}{i}"] = Quality.of(y, y - computed).r2
        values[f"gamma{i}"] = abs(values[f"gamma{i}"])
    return Laws(values, errors, r2)


def _weights(errors: np.ndarray) -> np.ndarray:
    """Return weights inversely proportional to standard errors, which are raised to at least 1e-3 of the largest."""
    largest = float(errors.max())
    return np.ones(len(errors)) if largest == 0.0 else largest / np.maximum(errors, 1e-3 * largest)


Law = tuple[Solution, np.ndarray]


def _gaussian(x: np.ndarray, y: np.ndarray, weight: np.ndarray, what: str) -> Law:
    top = int(np.abs(y).argmax())
    start = (y[top], -x[top], max(np.ptp(x), 1e-3))
    found = solve(
        lambda v: weight * (y - laws.bump(x, *v)), lambda v: -weight[:, None] * laws.bump_slopes(x, *v), start, what
    )
    return found, laws.bump(x, *found.x)


def _linear(columns: np.ndarray, y: np.ndarray, weight: np.ndarray, what: str) -> Law:
    scaled = weight[:, None] * columns
    start = np.linalg.lstsq(scaled, weight * y, rcond=None)[0]
    found = solve(lambda v: weight * y - scaled @ v, lambda v: -scaled, start, what)
    return found, columns @ found.x


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray, what: str) -> Law:
    return _linear(np.stack([x, np.ones_like(x)], axis=-1), y, weight, what)


def _constant(x: np.ndarray, y: np.ndarray, weight: np.ndarray, what: str) -> Law:
    return _linear(np.ones((len(x), 1)), y, weight, what)


# ---- all at once ---------------------------------------------------------------------------------


def fit_jointly(measured: Measurement, start: Mapping[str, float], hold: Mapping[str, float] | None = None) -> JointFit:
    """Fit the law of the torque (Wojna et al. 2018, Eq. 18-19) to all readings at once, with the parameters of `hold`
    kept.

    Several first guesses of the steepness are tried besides `start`. Raise `ArithmeticError` if none leads to a result.
    """
    guesses = (30.0, 10.0, 100.0, 300.0)  # first guesses of the steepness of the change between the bumps [1/rad]
    held = dict(hold or {})
    free = tuple(name for name in laws.FITTED if name not in held)
    columns = [laws.FITTED.index(name) for name in free]

    def named(x: np.ndarray) -> dict[str, float]:
        return {**held, **dict(zip(free, map(float, x), strict=True))}

    def residuals(x: np.ndarray) -> np.ndarray:
        left: np.ndarray = measured.torque - laws.magnet_moment(measured.angle, measured.locked, named(x))
        return left

    def slopes(x: np.ndarray) -> np.ndarray:
        return np.asarray(-laws.moment_slopes(measured.angle, measured.locked, named(x))[:, columns])

    best: Solution | None = None
    problem = ArithmeticError()
    for steepness in guesses if "eps_mag" in free else guesses[:1]:
        first = {**start, "eps_mag": steepness}
        try:
            found = solve(residuals, slopes, [first[n] for n in free], "joint fit")
        except ArithmeticError as error:
            problem = error
            continue
        if best is None or found.residuals @ found.residuals < best.residuals @ best.residuals:
            best = found
    if best is None or named(best.x)["eps_mag"] <= 0.0:
        raise (
            problem
            if best is None
            else ArithmeticError(
                "joint fit: the fitted change between the bumps is backwards (eps_mag < 0), so there is no result."
            )
        )
    return _judged(measured, best, free, _upright(named(best.x)))


def _upright(values: dict[str, float]) -> dict[str, float]:
    """Make the fitted widths positive; their sign is arbitrary, since the law contains only their squares."""
    return {n: abs(v) if n.startswith(("gamma", "c")) else v for n, v in values.items()}


def _judged(measured: Measurement, found: Solution, free: tuple[str, ...], values: dict[str, float]) -> JointFit:
    large = 0.5  # ratio of standard error to the parameter's scale above which it is not determined
    errors = dict(zip(free, map(float, found.errors), strict=True))
    correlation = found.correlation
    clusters = [curve.rows for curve in measured.curves]
    by_curve = dict(zip(free, map(float, errors_by_cluster(found, clusters)), strict=True))
    doubtful = [n for n in free if np.fmax(errors[n], by_curve[n]) > large * _scale(n, values)]
    off = np.abs(correlation) * [name not in doubtful for name in free]
    return JointFit(
        free,
        values,
        errors,
        by_curve,
        correlation,
        Quality.of(measured.torque, found.residuals),
        found.residuals,
        _neighbours(measured, found.residuals),
        {n: free[int(off[free.index(n)].argmax())] for n in doubtful},
    )


def _scale(name: str, values: Mapping[str, float]) -> float:
    """Return the scale of a parameter: the change that changes the torque substantially."""
    if name == "eps_mag":
        return values[name]
    kind, i = name[:-1], name[-1]
    gamma, c = values[f"gamma{i}"], values[f"c{i}"]
    return {"alpha": abs(values[name]), "beta": gamma, "gamma": gamma, "p": c / gamma, "r": c, "c": c}[kind]


def _neighbours(measured: Measurement, residuals: np.ndarray) -> float:
    """Return the correlation between the residuals of successive readings on a torque curve, over all curves."""
    products = squares = 0.0
    for curve in measured.curves:
        own = residuals[curve.rows[np.argsort(measured.angle[curve.rows])]]
        products += float(own[1:] @ own[:-1])
        squares += float(0.5 * (own[1:] @ own[1:] + own[:-1] @ own[:-1]))
    return products / squares if squares > 0.0 else 0.0


# ---- point dipoles -------------------------------------------------------------------------------


def fit_dipoles(measured: Measurement, *, place: bool = False) -> DipoleFit:
    """Fit the strength of two point dipoles (Wojna et al. 2018, Eq. 16), and with `place` the position of the fixed
    dipole as well.

    The torque is linear in the strength. The place is sought below the end of the stretched pendulum. Raise
    `ArithmeticError` if no strength of repelling dipoles fits.
    """
    farthest = 3.0  # largest distance at which the fixed dipole is sought, in lengths of the stretched pendulum
    p: dict[str, Any] = {**measured.parameters, "pole1": 1.0, "pole2": 1.0}

    def at(h: float) -> tuple[float, np.ndarray]:
        unit = laws.dipole_moment(measured.angle, measured.locked, {**p, "h": h})
        strength = float(unit @ measured.torque / (unit @ unit))
        return strength, measured.torque - strength * unit

    h = float(p["h"])
    if place:
        reach = laws.reach(p)
        # the sum of squares has several minima over the place: scan a grid, then descend
        grid = reach * np.geomspace(1.001, farthest, 400)
        best = int(np.argmin([(r := at(float(g))[1]) @ r for g in grid]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda g: (r := at(g)[1]) @ r, bounds=(low, high), method="bounded", options={"xatol": 1e-9 * reach}
        )
        h = float(found.x)
    strength, residuals = at(h)
    if not (np.isfinite(residuals).all() and strength > 0.0):
        raise ArithmeticError("point dipoles: no strength of repelling dipoles fits the readings.")
    pole = math.sqrt(strength)
    values = {"pole1": pole, "pole2": pole, "h": h}
    return DipoleFit(values, Quality.of(measured.torque, residuals), residuals)


# ---- everything ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """The fits of all laws to a measurement of the magnets' torque."""

    measured: Measurement
    curves: tuple[CurveFit, ...]
    laws: Laws
    joint: JointFit  # joint fit with the parameters held that the header names
    unheld: JointFit | None  # joint fit with nothing held; None if the header holds nothing, or if this fit fails
    # fits with the fixed dipole at the fixed magnet, and at its best place
    dipoles: DipoleFit
    placed_dipoles: DipoleFit


def fit_measurement(measured: Measurement) -> Outcome:
    """Run all fits of a measurement: each curve alone, laws over the locked angle, all readings jointly, point dipoles.

    Raises
    ------
    ArithmeticError
        If a fit fails.
    """
    curves = fit_curves(measured)
    over = fit_laws(curves)
    hold = {name: measured.parameters[name] for name in measured.header.hold}
    joint = fit_jointly(measured, over.values, hold)
    unheld = None
    if hold:
        with contextlib.suppress(ArithmeticError):  # only for comparison with the requested fit
            unheld = fit_jointly(measured, over.values)
    dipoles, placed = fit_dipoles(measured), fit_dipoles(measured, place=True)
    return Outcome(measured, curves, over, joint, unheld, dipoles, placed)
