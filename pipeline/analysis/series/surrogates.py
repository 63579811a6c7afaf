"""Test a time series against surrogates: series of linear noise with the same spectrum and the same values."""

from __future__ import annotations

import numpy as np
from scipy import fft

from pipeline.analysis.series.embedding import Embedding, Floats, Series

N_SURROGATES = 39
"""Surrogates: the least of 40 errors is that of the series with a probability of 2.5 % by chance."""


def surrogate(values: Floats, generator: np.random.Generator) -> Floats:
    """Return a series of the same values in another order, with almost the same spectrum and random phases.

    Iterative amplitude-adjusted Fourier transform (Schreiber and Schmitz, Phys. Rev. Lett. 77, 635, 1996).
    """
    iterations = 60  # most iterations of a surrogate
    ordered = np.sort(values)
    size = np.abs(fft.rfft(values))
    found = generator.permutation(values)
    order = np.empty(0, np.int64)
    for _ in range(iterations):
        phases = np.exp(1j * np.angle(fft.rfft(found)))
        new = np.argsort(fft.irfft(size * phases, len(values)))
        if np.array_equal(new, order):
            break
        order = new
        found[order] = ordered
    return np.asarray(found)


def closed_stretch(values: Floats) -> Floats:
    """Return the longest stretch whose ends match in value and slope: a jump there adds power.

    Up to a tenth is cut off on each side.
    """
    most = 2048  # samples of a stretch that is compared with surrogates
    values = values[:most]
    slope = np.gradient(values)
    start = np.arange(max(1, len(values) // 10))
    end = len(values) - 1 - start
    misfit = ((values[start][:, None] - values[end]) / values.std()) ** 2
    misfit += ((slope[start][:, None] - slope[end]) / max(float(slope.std()), 1e-300)) ** 2
    begin, cut = map(int, np.unravel_index(int(misfit.argmin()), misfit.shape))
    stop = len(values) - 1 - cut
    # a transform of a length with large prime factors is slow
    return values[begin : begin + int(fft.prev_fast_len(stop - begin, real=True))]


def prediction_error(values: Floats, delay: int, dimension: int, theiler: int, ahead: int) -> float:
    """Return the error of predicting values from the futures of near vectors, as a share of the standard deviation.

    The prediction is the mean over the nearest vectors `ahead` samples after their last coordinate.
    """
    embedding = Embedding(Series.of([values], 1.0), delay, dimension, theiler)
    first, nearest, _ = embedding.neighbours(400, ahead, dimension + 2)
    if not len(first):
        return np.nan
    later = embedding.span + ahead
    predicted = values[nearest + later].mean(axis=1)
    return float(np.sqrt(np.mean((predicted - values[first + later]) ** 2)) / values.std())


def against_noise(
    values: Floats, delay: int, dimension: int, theiler: int, generator: np.random.Generator
) -> tuple[float, Floats]:
    """Return the prediction error of a series, and those of its surrogates."""
    stretch, settings = closed_stretch(values), (delay, dimension, theiler, 2 * delay)
    others = [prediction_error(surrogate(stretch, generator), *settings) for _ in range(N_SURROGATES)]
    return prediction_error(stretch, *settings), np.array(others)


def repeats_by_chance(values: Floats) -> bool:
    """Return whether a sequence is predicted no better than its shuffled copies: it has no memory that is seen."""
    generator, settings = np.random.default_rng(0), (1, 2, 0, 1)
    least = min(prediction_error(generator.permutation(values), *settings) for _ in range(99))
    return prediction_error(values, *settings) >= least
