"""Fit the closed curve on which the section points of a torus lie, and its rotation number.

On a torus of two frequencies section points are ``x_n = X(n*rho)`` with a smooth function X of period 1. The rotation
number rho is a line of the points' spectrum; the Fourier series of X follows by least squares. The points of the later
half show whether the series of the earlier half holds: only then they are on the curve, however unevenly they fill it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.rotation import section_turns, weights
from pipeline.results.sets import Geometry

LEAST_FITTED, MOST_FITTED = 256, 2048
"""Fewest section points that are fitted, and most."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A closed curve that section points run round."""

    rotation: float  # turns per section, in [0, 1)
    points: np.ndarray  # (n, m): embedded points at equal steps of the phase
    error: float  # largest distance of a point of the later half from its place on the series of the earlier one

    @classmethod
    def fitted(cls, path: np.ndarray, geometry: Geometry) -> Curve | None:
        """Fit the curve of a trajectory's section points (n, state) in the order of time; None if there is none."""
        n_points = 8192  # of the curve, to which others are compared
        allowed = 1e-3  # largest error of a fitted curve, as a share of its extent
        x = _embedded(path[-MOST_FITTED:], geometry)
        if len(x) < LEAST_FITTED:
            return None
        n, extent = len(x), float(np.ptp(x, axis=0).max())
        for rotation in _candidates(x[: n // 2]):
            series = _Series.fitted(x[: n // 2], rotation)
            if series is None:
                continue
            error = float(np.abs(series.at(series.rotation * np.arange(n // 2, n)) - x[n // 2 :]).max())
            if error <= allowed * extent:
                return cls(series.rotation % 1.0, series.at(np.arange(n_points) / n_points), error)
        return None

    def holds(self, path: np.ndarray, geometry: Geometry) -> bool:
        """Return whether section points (n, state) lie on the curve and run round it at its rotation number."""
        same = 1e-4  # largest difference of the rotation numbers of two trajectories on one curve
        x = _embedded(path[-MOST_FITTED:], geometry)
        step = np.abs(np.diff(self.points, axis=0, append=self.points[:1])).max()
        away, near = cKDTree(self.points).query(x, p=np.inf)
        if not away.max() <= 3.0 * self.error + step:
            return False
        ahead = np.mod(np.diff(near / len(self.points)) - self.rotation + 0.5, 1.0) - 0.5
        return bool(abs(ahead @ weights(len(ahead))) <= same)


def _embedded(path: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return points (n, state) in units of the scales, and a point of the unit circle for each angle."""
    is_angle = np.asarray(geometry.is_angle)
    scaled, angles = path[:, ~is_angle] / np.asarray(geometry.scales)[~is_angle], path[:, is_angle]
    return np.concatenate([scaled, np.cos(angles), np.sin(angles)], axis=1)


def _candidates(x: np.ndarray) -> Iterator[float]:
    """Yield rotation numbers to try for points (n, m): turns about their mean, then their strongest frequencies."""
    # spectral lines that are tried as the rotation number, and the factor by which the spectrum is padded
    lines, padded = 4, 8
    for column in range(1, x.shape[1]):
        yield float(section_turns(x[None][..., [0, column]])[0] @ weights(len(x) - 1)) % 1.0
    n = len(x)
    weight, time = weights(n), np.arange(n)
    around = (x - weight @ x) * weight[:, None]
    power = (np.abs(np.fft.rfft(around, padded * n, axis=0)) ** 2).sum(axis=1)
    peaks = 1 + np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:]))

    def lost(frequency: float) -> float:
        return -float((np.abs(np.exp(-1j * TWO_PI * frequency * time) @ around) ** 2).sum())

    for peak in peaks[np.argsort(-power[peaks], kind="stable")][:lines].tolist():
        bounds = (peak - 1.0) / (padded * n), (peak + 1.0) / (padded * n)
        yield float(minimize_scalar(lost, bounds=bounds, method="bounded", options={"xatol": 1e-12}).x)


@dataclass(frozen=True, eq=False)
class _Series:
    """A Fourier series in the phase ``n*rotation``."""

    rotation: float
    coefficients: np.ndarray  # (2 K + 1, m)

    @classmethod
    def fitted(cls, x: np.ndarray, rotation: float) -> _Series | None:
        """Fit a series to points (n, m), and refine the rotation number; None if phases leave a wide gap."""
        # least eigenvalue of the normal equations, in units of their largest: phases that no point has leave it at 0
        ridge = 1e-13
        # fewest points per harmonic of the series, and fewest and most harmonics
        per_harmonic, least, largest = 8, 4, 64
        n_steps = 3  # gauss-Newton steps that refine the rotation number
        n = len(x)
        phases = np.sort(np.mod(rotation * np.arange(n), 1.0))
        gap = float(np.diff(phases, append=phases[0] + 1.0).max())
        # a gap between points shows no higher harmonic
        most = min(n // (2 * per_harmonic), largest, int(0.5 / gap))
        if most < least:
            return None
        time, k = np.arange(n), np.arange(-most, most + 1)
        for last in [False] * n_steps + [True]:
            waves = np.exp(1j * TWO_PI * rotation * np.outer(time, k))
            normal = waves.conj().T @ waves + ridge * n * np.eye(len(k))
            coefficients = np.linalg.solve(normal, waves.conj().T @ x)
            if last:
                break
            slope = (waves @ (1j * TWO_PI * k[:, None] * coefficients)).real * time[:, None]
            # what a change of the coefficients does is no change of the rotation number
            slope = slope - (waves @ np.linalg.solve(normal, waves.conj().T @ slope)).real
            off = x - (waves @ coefficients).real
            rotation += float((slope * off).sum() / max(float((slope**2).sum()), 1e-300))
        return cls(rotation, coefficients)

    def at(self, phase: np.ndarray) -> np.ndarray:
        """Return the points (n, m) at phases (n,), in turns."""
        most = len(self.coefficients) // 2
        return np.asarray((np.exp(1j * TWO_PI * np.outer(phase, np.arange(-most, most + 1))) @ self.coefficients).real)
