"""Join the stretches of a series across short gaps, where the series itself shows that interpolation is exact."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Settings:
    """Numbers by which short gaps are told from long ones."""

    error: float = 0.05
    """Largest error of the interpolation, as a share of the standard deviation. Its square bounds the power that
    interpolation adds to, or takes from, the filled part of the series."""
    off_grid: float = 0.1
    """Largest shift of the sampling grid across a gap [samples]: of a larger one the clock started anew."""
    n_trials: int = 200
    """Places at which known samples are left out and interpolated. More cost time, fewer judge by chance."""


@dataclass(frozen=True)
class Filled:
    """Stretches after short gaps were filled, and how much was filled."""

    pieces: list[Array]
    n_gaps: int  # gaps that were filled
    n_samples: int  # samples in them
    longest: int  # samples of the longest of them


def filled(pieces: list[Array], apart: Array, settings: Settings = Settings()) -> Filled:
    """Fill the short gaps between stretches of even samples.

    A gap is short if a cubic through the samples beside it meets known samples, left out over the same length, and if
    the values at its two ends differ by no more than known samples so far apart.

    Parameters
    ----------
    pieces
        Values of each stretch, in the order of time.
    apart
        Time from the last sample of a stretch to the first of the next [samples].
    settings
        Numbers by which short gaps are told from long ones.
    """
    joined, lengths = [pieces[0]], []
    fits = {n: _fit(pieces, n, settings) for n in {round(x) - 1 for x in apart if x > 0.0}}
    for (before, after), distance in zip(itertools.pairwise(pieces), apart.tolist(), strict=True):
        n = round(distance) - 1
        fit = fits.get(n) if abs(distance - n - 1) <= settings.off_grid else None
        if fit is None or not fit.suits(before, after):
            joined.append(after)
            continue
        joined[-1] = np.concatenate([joined[-1], fit.between(before, after), after])
        lengths.append(n)
    return Filled(joined, len(lengths), sum(lengths), max(lengths, default=0))


@dataclass(frozen=True)
class _Fit:
    """Interpolation over gaps of one length: weights of the samples beside a gap, and the largest step across it."""

    weights: Array  # (missing samples, samples beside the gap)
    most: float

    def suits(self, before: Array, after: Array) -> bool:
        half = self.weights.shape[1] // 2
        return min(len(before), len(after)) >= half and bool(abs(after[0] - before[-1]) <= self.most)

    def between(self, before: Array, after: Array) -> Array:
        half = self.weights.shape[1] // 2
        return np.asarray(self.weights @ np.concatenate([before[-half:], after[:half]]))


def _fit(pieces: list[Array], n: int, settings: Settings) -> _Fit | None:
    """Return the interpolation over `n` missing samples; None if it does not meet known ones."""
    values = np.concatenate(pieces)
    best, least = None, settings.error * float(values.std())
    for half in sorted({2, max(2, n)}):
        windows = [np.lib.stride_tricks.sliding_window_view(p, n + 2 * half) for p in pieces if len(p) >= n + 2 * half]
        if n < 1 or not windows:
            continue
        known = np.concatenate([w[:: max(1, len(windows) * len(w) // settings.n_trials)] for w in windows])
        weights = _weights(n, half)
        beside, inside = np.delete(known, np.s_[half : half + n], axis=1), known[:, half : half + n]
        error = float(np.sqrt(np.mean((beside @ weights.T - inside) ** 2)))
        if error <= least:
            most = max(float(np.abs(p[n + 1 :] - p[: -n - 1]).max()) for p in pieces if len(p) > n + 1)
            best, least = _Fit(weights, most), error
    return best


def _weights(n: int, half: int) -> Array:
    """Return the weights of a cubic fitted to `half` samples on each side of `n` missing ones, at these."""
    place = np.arange(n + 2 * half) - 0.5 * (n + 2 * half - 1)
    powers = np.vander(place / place[-1], 4)
    beside = np.delete(powers, np.s_[half : half + n], axis=0)
    return np.asarray(powers[half : half + n] @ np.linalg.pinv(beside))
