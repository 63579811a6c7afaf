"""Smooth measured states and estimate their rates by local polynomials without phase shift. Estimate the noise of
states and rates.

A polynomial of low order is fitted by least squares to the samples of a window (Savitzky and Golay, Anal.
Chem. 36, 1964, 1627). In the middle of a stretch the window is centred, so the phase is not shifted. At the
ends of a stretch the last whole window is evaluated off its centre. A stretch ends where a piece ends, where
samples are not measured, and where the drive switches: the acceleration jumps there, and no polynomial can
follow a jump.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import model_of
from pipeline.rig.recordings.channels import runs
from pipeline.rig.recordings.mapping import DRIVE
from pipeline.specification.problems import SpecError


def smooth(
    ds: xr.Dataset,
    *,
    window_s: float | None = None,
    order: int = 3,
    edges_s: Sequence[float] | np.ndarray | None = None,
) -> xr.Dataset:
    """Smooth the measured quantities of a recording, and add the rates that are not measured.

    Parameters
    ----------
    ds
        A recording.
    window_s
        Length of the windows [s]. By default it is chosen for each quantity by leave-one-out cross-validation
        (the mean square of residual/(1 - leverage)) among windows that grow by a quarter. This balances noise
        against distortion if the noise of neighbouring samples is independent; otherwise state a window.
    order
        Order of the polynomials, 1 or more.
    edges_s
        Times at which the drive switches [s]; by default the jumps of ``drive``, if the recording has it.

    Returns
    -------
    Dataset
        Copy of `ds` with the measured quantities smoothed and the rates of the model's states added by name;
        NaN where nothing was measured, or where a stretch has no more than `order` samples. Attributes of the
        quantities: ``noise``, the standard deviation of a raw sample [SI units], from the residuals and the
        polynomials' degrees of freedom; ``noise_smoothed``, the standard deviation in the middle of a stretch
        after smoothing (for rates, too); ``window_s``.

    Raises
    ------
    SpecError
        If `order` or `window_s` is out of bounds.
    """
    step = 1.0 / float(ds.attrs["sampling_rate_hz"])
    width = _checked(window_s, order, step)
    edges = _switches(ds) if edges_s is None else np.asarray(edges_s, dtype=np.float64)
    rate_of = {s.name: s for s in model_of(ds).states if s.rate}
    result = ds.copy()
    for name in [str(n) for n in ds.data_vars if n != DRIVE]:
        fit = _fit(ds[name].values, _parts(ds, name, edges), width, order, step)
        result[name] = ds[name].copy(data=fit.values).assign_attrs(fit.attrs(order, step, 0))
        rate = rate_of[name].rate if name in rate_of else ""
        if rate and rate not in ds:
            state = model_of(ds).state(rate)
            about = {"units": state.unit, "long_name": state.meaning, **fit.attrs(order, step, 1)}
            result[rate] = (ds[name].dims, fit.rates, about)
    return result.assign_attrs(smoothing=f"local polynomials of order {order}")


def _least(order: int) -> int:
    """Return the least window length for polynomials of a given order, an odd number of samples."""
    return order + 2 + (order + 1) % 2


def _checked(window_s: float | None, order: int, step: float) -> int | None:
    problems = []
    if order < 1:
        problems.append(f"order = {order}: must be 1 or more, so that there is a rate.")
    width = None if window_s is None else 2 * round((window_s / step - 1.0) / 2.0) + 1
    if width is not None and width < order + 2:
        problems.append(
            f"window_s = {window_s!r}: holds {max(width, 0)} samples; polynomials of order {order} need at "
            f"least {_least(order)}, which is {_least(order) * step:.6g} s."
        )
    if problems:
        raise SpecError(problems)
    return width


def _switches(ds: xr.Dataset) -> np.ndarray:
    """Return the times at which the drive jumps from one of its levels to another [s].

    A drive that is switched off has three levels, so edges about one middle, as in `pipeline.rig.edges`, do
    not suffice.
    """
    quiet = 10.0  # least range of a drive whose switches are sought, in units of its change between samples
    # change of the drive, relative to its range, that counts as a switch, and its most samples
    least, n_samples = 0.4, 5
    if DRIVE not in ds:
        return np.empty(0)
    time, drive, piece = ds["time"].values, ds[DRIVE].values, ds["piece"].values
    known = drive[np.isfinite(drive)]
    if len(known) <= n_samples:
        return np.empty(0)
    low, high = np.quantile(known, (0.01, 0.99))
    noise = float(np.median(np.abs(np.diff(known))))
    if not high - low > quiet * noise:
        return np.empty(0)
    leap = np.abs(drive[n_samples:] - drive[:-n_samples]) > least * (high - low)
    step = np.abs(np.diff(drive))
    found = [i + int(np.argmax(step[i : k + n_samples - 1])) for i, k in runs(leap, piece[n_samples:])]
    return np.array([0.5 * (time[i] + time[i + 1]) for i in found])


def _parts(ds: xr.Dataset, name: str, edges: np.ndarray) -> np.ndarray:
    """Return start and end index, (n, 2), of each stretch without a gap, a missing value or a switch."""
    values, piece, time = ds[name].values, ds["piece"].values, ds["time"].values
    known = np.isfinite(values)
    number = piece + 0.0
    change = np.concatenate([[True], (number[1:] != number[:-1]) | (known[1:] != known[:-1])])
    if edges.size:
        change[np.unique(np.searchsorted(time, edges[(edges > time[0]) & (edges <= time[-1])]))] = True
    begins = np.flatnonzero(change)
    ends = np.append(begins[1:], len(values))
    kept = known[begins]
    return np.column_stack([begins[kept], ends[kept]])


class _Basis(NamedTuple):
    """Polynomials on a window, orthonormal over its samples, with their slopes."""

    values: np.ndarray  # (width, order + 1)
    slopes: np.ndarray  # per sample, (width, order + 1)
    leverage: np.ndarray  # weight of a sample in its own fitted value, (width,)


@lru_cache(64)
def _basis(width: int, order: int) -> _Basis:
    half = width // 2
    x = np.linspace(-1.0, 1.0, width)
    plain = np.polynomial.legendre.legvander(x, order)
    derived = np.stack([np.polynomial.Legendre.basis(k).deriv()(x) for k in range(order + 1)], axis=1)
    values, mixing = np.linalg.qr(plain)
    slopes = np.linalg.solve(mixing.T, derived.T).T / half
    return _Basis(values, slopes, (values**2).sum(axis=1))


class _Fit:
    """Smoothed values and rates of one quantity, with its noise and the window length."""

    def __init__(self, values: np.ndarray, rates: np.ndarray, noise: float, width: int, score: float) -> None:
        self.values, self.rates, self.noise, self.width, self.score = values, rates, noise, width, score

    def attrs(self, order: int, step: float, derivative: int) -> dict[str, Any]:
        gain = _gain(self.width, order, derivative, step)
        raw = {"noise": self.noise} if derivative == 0 else {}
        return {**raw, "noise_smoothed": self.noise * gain, "window_s": self.width * step}


def _gain(width: int, order: int, derivative: int, step: float) -> float:
    """Return the ratio of the noise of a smoothed value or rate in the middle of a window to that of a raw sample."""
    basis = _basis(width, order)
    rows = basis.slopes / step if derivative else basis.values
    return float(np.linalg.norm(rows[width // 2]))


def _fit(values: np.ndarray, parts: np.ndarray, width: int | None, order: int, step: float) -> _Fit:
    if width is None:
        width = _best_width(values, parts, order)
    return _smoothed(values, parts, width, order, step)


def _first_samples(parts: np.ndarray, count: int) -> np.ndarray:
    """Return the first stretches of a recording, cut so that together they have at most `count` samples."""
    if not len(parts):
        return parts
    lengths = np.diff(parts, axis=1).ravel()
    before = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    used = parts[before < count].copy()
    used[-1, 1] = min(used[-1, 1], used[-1, 0] + count - before[len(used) - 1])
    return used


def _best_width(values: np.ndarray, parts: np.ndarray, order: int) -> int:
    """Return the window length [samples] with the least error in leave-one-out cross-validation."""
    # ratio of successive windows that are tried, and ratio of a window's score to the least one above which no longer
    # window is tried
    growth, enough = 1.25, 1.5
    most = 200_000  # samples from which the window is chosen: the first of a longer recording
    first = _least(order)
    used = _first_samples(parts, most)
    if len(used):
        values, used = values[used[0, 0] : used[-1, 1]], used - used[0, 0]
    longest = int(np.diff(used, axis=1).max(initial=first))
    best, best_score, width = first, math.inf, first
    while width <= longest:
        score = _smoothed(values, used, width, order, 1.0).score
        if score < best_score:
            best, best_score = width, score
        if score > enough * best_score:
            break
        width = 2 * math.ceil((growth * width - 1.0) / 2.0) + 1
    return best


def _smoothed(values: np.ndarray, parts: np.ndarray, width: int, order: int, step: float) -> _Fit:
    """Smooth all stretches with one window length; stretches shorter than the window use a shorter one."""
    fitted, slopes, leverage = (np.full(len(values), np.nan) for _ in range(3))
    lengths = np.diff(parts, axis=1).ravel()
    own = np.minimum(width, lengths - 1 + lengths % 2)
    for w in np.unique(own).tolist():
        own_order = _order_of(w, width, order)
        if w > own_order:
            _fit_ends(values, parts[own == w], w, own_order, (fitted, slopes, leverage))
    _fit_middles(values, parts[own == width], width, order, (fitted, slopes, leverage))
    known = np.isfinite(fitted)
    residual, free = (values - fitted)[known], 1.0 - leverage[known]
    freedom = float(free.sum())
    noise = math.sqrt(float(residual @ residual) / freedom) if freedom > 0.5 else math.nan
    inner = free > 1e-9
    score = float(np.mean((residual[inner] / free[inner]) ** 2)) if inner.any() else math.inf
    return _Fit(fitted, slopes / step, noise, width, score)


def _order_of(own: int, width: int, order: int) -> int:
    """Return the polynomial order for a stretch shorter than the window: the shorter, the lower."""
    # lengths relative to the window; a stretch shorter than each has polynomials of one order less. On free swings of
    # the paper's pendulum with noise of 1 and 11 mrad this halves the error of the rates there.
    short = (0.7, 0.2)
    return max(order - sum(own < share * width for share in short), 1)


def _fit_ends(values: np.ndarray, parts: np.ndarray, width: int, order: int, out: tuple[np.ndarray, ...]) -> None:
    """Smooth samples within half a window of a stretch's ends by the polynomial of the outermost window."""
    basis, half = _basis(width, order), width // 2
    for begins, rows in ((parts[:, 0], slice(0, half + 1)), (parts[:, 1] - width, slice(half, width))):
        window = values[begins[:, None] + np.arange(width)]
        mean = window.mean(axis=1, keepdims=True)
        weights = (window - mean) @ basis.values
        places = begins[:, None] + np.arange(width)[rows]
        out[0][places] = mean + weights @ basis.values[rows].T
        out[1][places] = weights @ basis.slopes[rows].T
        out[2][places] = basis.leverage[rows]


def _fit_middles(values: np.ndarray, parts: np.ndarray, width: int, order: int, out: tuple[np.ndarray, ...]) -> None:
    """Smooth by convolution the samples that have half a window of samples on either side."""
    half = width // 2
    long = parts[np.diff(parts, axis=1).ravel() > width + 1]
    if not len(long):
        return
    change = np.zeros(len(values) + 1, dtype=np.int64)
    change[long[:, 0] + half + 1] += 1
    change[long[:, 1] - half - 1] -= 1
    is_middle = np.cumsum(change[:-1]) > 0
    known = np.isfinite(values)
    mean = float(values[known].mean())
    centred = np.where(known, values - mean, 0.0)  # windows in the middle contain known samples only
    basis = _basis(width, order)
    out[0][is_middle] = mean + _convolved(centred, basis.values @ basis.values[half])[is_middle]
    out[1][is_middle] = _convolved(centred, basis.values @ basis.slopes[half])[is_middle]
    out[2][is_middle] = basis.leverage[half]


def _convolved(y: np.ndarray, weights: np.ndarray) -> np.ndarray:
    from scipy.ndimage import correlate1d
    from scipy.signal import oaconvolve

    long = 63  # length above which windows are convolved by Fourier transforms [samples]
    if len(weights) <= long:
        return np.asarray(correlate1d(y, weights, mode="constant"))
    return np.asarray(oaconvolve(y, weights[::-1], mode="same"))
