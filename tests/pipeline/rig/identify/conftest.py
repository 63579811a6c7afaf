"""A problem with a closed form: pieces of ring-downs of a linear oscillator, each with a free start.

    x(t) = exp(-d t) (x0 cos(w t) + (v0 + d x0)/w sin(w t))

Parameters d and w.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from pipeline.rig.identify.statistics import Linearised, eliminate_starts

TRUTH = np.array([0.4, 6.0])
RATE_HZ = 50.0


def motion(t, d, w, x0, v0):
    return np.exp(-d * t) * (x0 * np.cos(w * t) + (v0 + d * x0) / w * np.sin(w * t))


def slopes(t, values):
    """(..., 4) of d(motion)/d(d, w, x0, v0), for times (...)."""
    d, w, x0, v0 = values
    decay, cos, sin = np.exp(-d * t), np.cos(w * t), np.sin(w * t)
    b = (v0 + d * x0) / w
    by_d = x0 / w * sin - t * (x0 * cos + b * sin)
    by_w = b * (t * cos - sin / w) - x0 * t * sin
    return decay[..., None] * np.stack([by_d, by_w, cos + d / w * sin, sin / w], axis=-1)


@dataclass
class Fitted:
    theta: np.ndarray
    starts: np.ndarray
    residuals: list[np.ndarray]
    jacobian: np.ndarray
    linear: Linearised


def fit(times, measured, *, noise=1.0, prior=None) -> Fitted:
    """Gauss-Newton from the truth; measured NaN is not measured; residuals in units of the noise."""
    theta = TRUTH.copy()
    starts = np.array([[m[0] if np.isfinite(m[0]) else 1.0, 0.0] for m in measured])
    mean, sd = prior or (theta, np.full(2, np.inf))
    for k in range(7):
        step, starts = gauss_newton(times, measured, theta, starts, noise, (mean, sd))
        theta = theta + (step if k else 0.0)  # starts first: rates are far off
        if k and np.abs(step).max() < 1e-10:
            break
    jacobian, residuals = linearise(times, measured, theta, starts, noise)
    information, following = eliminate_starts(
        np.vstack([jacobian, np.hstack([np.diag(1 / sd), np.zeros((2, starts.size))])]), 2
    )
    reduced, row = [], 0
    for r in residuals:
        own = jacobian[row : row + len(r)]
        reduced.append((own[:, :2] - own[:, 2:] @ following)[:, None, :])
        row += len(r)
    linear = Linearised(
        information,
        1 / sd**2,
        tuple(r[:, None] for r in residuals),
        tuple(reduced),
        tuple(range(len(times))),
        starts.size,
    )
    return Fitted(theta, starts, residuals, jacobian, linear)


def gauss_newton(times, measured, theta, starts, noise, prior):
    """Step of the parameters, and the new starts; piece by piece, as a start moves its own piece alone."""
    mean, sd = prior
    own, residuals = each_piece(times, measured, theta, starts, noise)
    q, r = np.linalg.qr(own[:, :, 2:])
    across = q.transpose(0, 2, 1)
    y = np.nan_to_num(residuals)[:, :, None]
    rates = own[:, :, :2]
    rest = (rates - q @ (across @ rates)).reshape(-1, 2)
    normal = np.diag(1 / sd**2) + rest.T @ rest
    step = np.linalg.solve(normal, (mean - theta) / sd**2 - rest.T @ y.ravel())
    moves = -np.linalg.solve(r, across @ (y + rates @ step[:, None]))
    return step, starts + moves[:, :, 0]


def each_piece(times, measured, theta, starts, noise):
    """Slopes (n_pieces, n, 4) by the parameters and each piece's own start, and residuals (n_pieces, n)."""
    t, y = np.array(times), np.array(measured)
    values = (*theta, starts[:, :1], starts[:, 1:])
    own = -slopes(t, values) / noise
    own[~np.isfinite(y)] = 0.0
    return own, (y - motion(t, *values)) / noise


def linearise(times, measured, theta, starts, noise):
    """The whole Jacobian, and the residuals of each piece."""
    own, residuals = each_piece(times, measured, theta, starts, noise)
    n_pieces, n, _ = own.shape
    whole = np.zeros((n_pieces, n, 2 + starts.size))
    whole[:, :, :2] = own[:, :, :2]
    for k in range(n_pieces):
        whole[k, :, 2 + 2 * k : 4 + 2 * k] = own[k, :, 2:]
    return whole.reshape(n_pieces * n, -1), list(residuals)


def record(rng, *, n_pieces=10, n=120, noise=0.01, memory=0.0, bits=None, dead_band=False):
    """Times and measured angles of pieces of ring-downs from random starts.

    `memory` is the lag-1 correlation of the noise; `bits` quantise +-pi; a dead band has no values.
    """
    times, measured = [], []
    for _ in range(n_pieces):
        t = np.arange(n) / RATE_HZ
        x = motion(t, *TRUTH, rng.uniform(0.5, 1.0), rng.uniform(-3.0, 3.0))
        white = rng.normal(size=n + 200) * noise
        x = x + lfilter([np.sqrt(1 - memory**2)], [1, -memory], white)[200:]
        if bits is not None:
            least = 2 * np.pi / 2**bits
            x = np.round(x / least) * least
        if dead_band:
            x = np.where((x > 0.2) & (x < 0.3), np.nan, x)
        times.append(t)
        measured.append(x)
    return times, measured


@pytest.fixture(scope="session")
def ringdown():
    return SimpleNamespace(TRUTH=TRUTH, motion=motion, slopes=slopes, fit=fit, linearise=linearise, record=record)
