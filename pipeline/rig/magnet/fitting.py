"""Fits of torque curves: each by itself, their numbers over the locked angle, all at once, and point dipoles.

Wojna et al., J. Sound Vib. 430 (2018), section 3, Eq. 16-19. Standard errors come from the residuals'
variance. Where the law and not noise is what is missing, residuals of neighbouring readings are alike, and
such errors are too small; so the joint fit also has errors from the scatter of whole curves (a jackknife over
them), which hold whatever the residuals within a curve are like.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.rig.magnet.measurement import Curve, Measurement
from pipeline.rig.magnet.solving import Quality, Solution, errors_by_cluster, solve

STEEPNESS = (30.0, 10.0, 100.0, 300.0)
"""Where the joint fit begins to look for the steepness of the change between the bumps [1/rad]."""

LARGE_ERROR = 0.5
"""Standard error over the parameter's own scale from which it counts as not determined."""

FARTHEST_DIPOLES = 3.0
"""Farthest fixed dipole that is looked for, in lengths of the stretched pendulum."""


@dataclass(frozen=True)
class CurveFit:
    """A bump through one curve (Eq. 17).

    Attributes
    ----------
    curve : Curve
    values, errors : dict
        By ``A`` [N m], ``b``, ``c`` [rad].
    quality : Quality
    """

    curve: Curve
    values: dict[str, float]
    errors: dict[str, float]
    quality: Quality


@dataclass(frozen=True)
class Laws:
    """The curves' numbers over the locked angle, by parameter of Eq. 18.

    Attributes
    ----------
    values, errors : dict
        By the names of `laws.FITTED` but for the steepness.
    r2 : dict
        Of the height and the position by side, ``A1`` ... ``b2``; the width is constant.
    """

    values: dict[str, float]
    errors: dict[str, float]
    r2: dict[str, float]


@dataclass(frozen=True)
class JointFit:
    """All readings at once (Eq. 18-19).

    Attributes
    ----------
    free : tuple of str
        Parameters that were fitted.
    values : dict
        All of `laws.FITTED`.
    errors, errors_by_curve : dict
        Standard errors of `free`: from the residuals' variance, and from the scatter of whole curves; the
        latter are NaN if one curve alone determines a parameter.
    correlation : ndarray
        Of `free`.
    quality : Quality
    residuals : ndarray
        Measured minus computed [N m].
    neighbours : float
        Correlation of the residuals of neighbouring readings of a curve; 0 for noise.
    undetermined : dict
        For each parameter that the readings hardly determine, the one with which it correlates most.
    """

    free: tuple[str, ...]
    values: dict[str, float]
    errors: dict[str, float]
    errors_by_curve: dict[str, float]
    correlation: np.ndarray
    quality: Quality
    residuals: np.ndarray
    neighbours: float
    undetermined: dict[str, str]


@dataclass(frozen=True)
class DipoleFit:
    """Point dipoles (Eq. 16) at their best.

    Attributes
    ----------
    values : dict
        ``pole1``, ``pole2`` (alike, for their product is what counts) and the place ``h``.
    quality : Quality
    residuals : ndarray
        Measured minus computed [N m].
    """

    values: dict[str, float]
    quality: Quality
    residuals: np.ndarray


# ---- one curve -----------------------------------------------------------------------------------


def fit_curve(angle: np.ndarray, torque: np.ndarray, curve: Curve) -> CurveFit:
    """Fit Eq. 17 to one curve.

    Parameters
    ----------
    angle, torque
        Its readings [rad], [N m].
    curve
        Which it is.

    Raises
    ------
    ArithmeticError
        If the fit does not converge, or finds no peak among the readings.
    """
    what = f"curve {curve}"
    peak = int(np.argmax(torque if curve.side == 0 else -torque))
    order = np.argsort(angle)
    area = float(np.trapezoid(torque[order], angle[order]))
    width = abs(area) / (math.sqrt(math.pi) * max(abs(torque[peak]), 1e-300)) or np.ptp(angle)
    start = (torque[peak], -angle[peak], min(width, float(np.ptp(angle))))
    found = solve(
        lambda x: torque - laws.bump(angle, *x), lambda x: -laws.bump_slopes(angle, *x), start, what
    )
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
    """Fit every curve by itself.

    Raises
    ------
    ArithmeticError
        Naming all curves whose fit is no result.
    """
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
    """Fit height, position and width over the locked angle: a Gaussian, a line, a constant (Eq. 18).

    Each number weighs by its standard error; the laws' own errors come from the scatter about them.

    Raises
    ------
    ArithmeticError
        If the Gaussian does not converge.
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
    """Weights by standard errors; those of rounding alone say nothing of a curve's worth."""
    largest = float(errors.max())
    return np.ones(len(errors)) if largest == 0.0 else largest / np.maximum(errors, 1e-3 * largest)


Law = tuple[Solution, np.ndarray]


def _gaussian(x: np.ndarray, y: np.ndarray, weight: np.ndarray, what: str) -> Law:
    top = int(np.abs(y).argmax())
    start = (y[top], -x[top], max(np.ptp(x), 1e-3))
    found = solve(
        lambda v: weight * (y - laws.bump(x, *v)), lambda v: -weight[:, None] * laws.bump_slopes(x, *v),
        start, what,
    )  # fmt: skip
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


def fit_jointly(
    measured: Measurement, start: Mapping[str, float], hold: Mapping[str, float] | None = None
) -> JointFit:
    """Fit Eq. 18-19 to all readings at once.

    Parameters
    ----------
    measured
        The readings.
    start
        First guess by name; the steepness is looked for from several values.
    hold
        Parameters that stay as they are, by name.

    Raises
    ------
    ArithmeticError
        If no start leads to a result.
    """
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
    for steepness in STEEPNESS if "eps_mag" in free else STEEPNESS[:1]:
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
                "joint fit: the change between the bumps came out backwards (eps_mag < 0); it is no result."
            )
        )
    return _judged(measured, best, free, _upright(named(best.x)))


def _upright(values: dict[str, float]) -> dict[str, float]:
    """Widths count squared; give them positive."""
    return {n: abs(v) if n.startswith(("gamma", "c")) else v for n, v in values.items()}


def _judged(
    measured: Measurement, found: Solution, free: tuple[str, ...], values: dict[str, float]
) -> JointFit:
    errors = dict(zip(free, map(float, found.errors), strict=True))
    correlation = found.correlation
    clusters = [curve.rows for curve in measured.curves]
    by_curve = dict(zip(free, map(float, errors_by_cluster(found, clusters)), strict=True))
    doubtful = [n for n in free if np.fmax(errors[n], by_curve[n]) > LARGE_ERROR * _scale(n, values)]
    off = np.abs(correlation) * [name not in doubtful for name in free]
    return JointFit(
        free, values, errors, by_curve, correlation, Quality.of(measured.torque, found.residuals),
        found.residuals, _neighbours(measured, found.residuals),
        {n: free[int(off[free.index(n)].argmax())] for n in doubtful},
    )  # fmt: skip


def _scale(name: str, values: Mapping[str, float]) -> float:
    """Size of a change of a parameter that changes the torque all over."""
    if name == "eps_mag":
        return values[name]
    kind, i = name[:-1], name[-1]
    gamma, c = values[f"gamma{i}"], values[f"c{i}"]
    return {"alpha": abs(values[name]), "beta": gamma, "gamma": gamma, "p": c / gamma, "r": c, "c": c}[kind]


def _neighbours(measured: Measurement, residuals: np.ndarray) -> float:
    """Correlation of residuals of neighbouring readings, over all curves."""
    products = squares = 0.0
    for curve in measured.curves:
        own = residuals[curve.rows[np.argsort(measured.angle[curve.rows])]]
        products += float(own[1:] @ own[:-1])
        squares += float(0.5 * (own[1:] @ own[1:] + own[:-1] @ own[:-1]))
    return products / squares if squares > 0.0 else 0.0


# ---- point dipoles -------------------------------------------------------------------------------


def fit_dipoles(measured: Measurement, *, place: bool = False) -> DipoleFit:
    """Fit the strength of point dipoles (Eq. 16), and with `place` also where the fixed one stands.

    The torque is linear in the strength; the place is looked for below the stretched pendulum's end.

    Raises
    ------
    ArithmeticError
        If the readings have no such torque.
    """
    p: dict[str, Any] = {**measured.parameters, "pole1": 1.0, "pole2": 1.0}

    def at(h: float) -> tuple[float, np.ndarray]:
        unit = laws.dipole_moment(measured.angle, measured.locked, {**p, "h": h})
        strength = float(unit @ measured.torque / (unit @ unit))
        return strength, measured.torque - strength * unit

    h = float(p["h"])
    if place:
        reach = laws.reach(p)
        # the sum of squares has several valleys over the place: survey, then descend
        grid = reach * np.geomspace(1.001, FARTHEST_DIPOLES, 400)
        best = int(np.argmin([(r := at(float(g))[1]) @ r for g in grid]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda g: (r := at(g)[1]) @ r, bounds=(low, high), method="bounded",
            options={"xatol": 1e-9 * reach},
        )  # fmt: skip
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
    """All that is fitted to a measurement.

    Attributes
    ----------
    measured : Measurement
    curves : tuple of CurveFit
    laws : Laws
    joint : JointFit
        With what the header holds.
    unheld : JointFit or None
        With nothing held, where something was; None also if that is no result.
    dipoles, placed_dipoles : DipoleFit
        With the fixed dipole where the fixed magnet is, and where it fits best.
    """

    measured: Measurement
    curves: tuple[CurveFit, ...]
    laws: Laws
    joint: JointFit
    unheld: JointFit | None
    dipoles: DipoleFit
    placed_dipoles: DipoleFit


def fit_measurement(measured: Measurement) -> Outcome:
    """Fit curves one by one, their numbers over the locked angle, all readings at once, and point dipoles.

    Raises
    ------
    ArithmeticError
        If a fit is no result.
    """
    curves = fit_curves(measured)
    over = fit_laws(curves)
    hold = {name: measured.parameters[name] for name in measured.header.hold}
    joint = fit_jointly(measured, over.values, hold)
    unheld = None
    if hold:
        with contextlib.suppress(ArithmeticError):  # a fit beside the one that was asked for
            unheld = fit_jointly(measured, over.values)
    dipoles, placed = fit_dipoles(measured), fit_dipoles(measured, place=True)
    return Outcome(measured, curves, over, joint, unheld, dipoles, placed)
