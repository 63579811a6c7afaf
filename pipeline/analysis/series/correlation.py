"""Estimate the correlation dimension of a time series from the slope of its correlation sums."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.analysis.series.embedding import N_BLOCKS, Embedding, Floats, slope, spread
from pipeline.results.intervals import half_width

LARGEST, PER_OCTAVE, N_OCTAVES = 4.0, 4, 12
"""Largest radius [standard deviations], radii per factor of two, and factors of two from it to the least."""

N_REFERENCES, N_POINTS = 2400, 12_000
"""Vectors whose pairs are counted, and vectors that they are paired with."""

FEWEST_PAIRS, MOST_OF_MIXING = 400, 0.01
"""Pairs at the least radius of a fit of a motion that mixes, and share of all pairs at its largest."""

FEWEST_SAMPLES, FEWEST_PASSES, MOST_OF_OTHERS = 3.0, 4.0, 0.08
"""The same of others: samples of its own pass and other passes within the radius of a sample; share of all pairs.

The passes of a quasi-periodic motion are apart by equal steps, and so are its samples. Correlation sums have stairs
where only few are near.
"""

LEAST_OCTAVES = 2.0
"""Shortest range of a fit."""

FLAT = 0.1
"""Largest relative change of the slope from one half of a range to the other, and with the embedding dimension."""

Counts = np.ndarray


@dataclass(frozen=True)
class Sums:
    """Correlation sums for some embedding dimensions, and the dimension that follows."""

    dimensions: tuple[int, ...]
    radius: Floats  # in standard deviations
    share: Floats  # of pairs closer than the radius, shape (embedding, radius)
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    fit: tuple[float, float] = (np.nan, np.nan)
    reason: str = ""


def correlation_sums(embedding: Embedding, mixes: bool) -> Sums:
    """Count the pairs of vectors closer than radii, and fit the slope where it is a plateau.

    Grassberger and Procaccia (Physica D 9, 189, 1983), with the largest difference of a coordinate as distance and
    without pairs close in time (Theiler, Phys. Rev. A 34, 2427, 1986). The range of the fit is the longest in which the
    slopes of both halves, and those for the embedding and two delays more, agree within `FLAT`. It lies between the
    radius below which pairs are too few and the one beyond which the edges of the set bend the curve. The interval is
    that of Student from slopes of `N_BLOCKS` stretches, widened by these differences. In a motion that mixes neighbours
    part, so that the distances of passes are random.
    """
    dimensions = tuple(range(embedding.dimension, embedding.dimension + 3))
    counts, near, n_pairs = _counts(embedding, dimensions)
    radius = 2.0 ** (-np.arange(N_OCTAVES * PER_OCTAVE + 1)[::-1] / PER_OCTAVE) * LARGEST
    pairs = counts.sum(axis=1)
    share = pairs / max(n_pairs, 1)
    plain = Sums(dimensions, radius, share)
    if mixes:
        enough = (pairs >= FEWEST_PAIRS) & (share <= MOST_OF_MIXING)
    else:
        # the pairs of one pass include each sample with itself
        enough = (near >= FEWEST_SAMPLES * near[:, :1]) & (pairs >= FEWEST_PASSES * near) & (share <= MOST_OF_OTHERS)
    places = np.flatnonzero(enough.all(axis=0))
    if len(places) <= LEAST_OCTAVES * PER_OCTAVE:
        return replace(plain, reason="too few vectors: no two octaves of radii between pairs and edges")
    x = np.log(radius)
    with np.errstate(divide="ignore"):
        logs, by_block = np.log(share), np.log(counts[1])
    chosen = _plateau(x, logs, places)
    if chosen is None:
        told = ", ".join(f"{slope(x[places], one[places]):.2f}" for one in logs)
        return replace(plain, reason=f"no plateau: slopes {told} for {dimensions[0]} to {dimensions[-1]} delays")
    slopes, bend = _slopes(x, logs, chosen)
    blocks = [slope(x[chosen], one[chosen]) for one in by_block if np.isfinite(one[chosen]).all()]
    if len(blocks) < N_BLOCKS:
        return replace(plain, reason="a stretch of the series has no close pairs")
    value = float(np.mean(slopes))
    if value > 0.75 * dimensions[0] + 0.25:
        return replace(plain, reason=f"slopes near {value:.2f} fill the embedding: noise, or too few delays")
    half, fit = half_width(blocks) + bend, (float(radius[chosen[0]]), float(radius[chosen[-1]]))
    return replace(plain, value=value, low=value - half, high=value + half, fit=fit)


def _counts(embedding: Embedding, dimensions: tuple[int, ...]) -> tuple[Counts, Counts, int]:
    """Count pairs closer than each radius, shape (embedding, block, radius), those of one pass, and all pairs."""
    n_radii = N_OCTAVES * PER_OCTAVE + 1
    counts = np.zeros((len(dimensions), N_BLOCKS, n_radii), np.int64)
    near = np.zeros((len(dimensions), n_radii), np.int64)
    widest = Embedding(embedding.series, embedding.delay, dimensions[-1], embedding.theiler)
    starts = widest.series.starts(widest.span)
    if len(starts) < 100:
        return counts, near, 0
    starts = starts[:: max(1, -(-len(starts) // N_POINTS))]
    references = spread(starts, N_REFERENCES)
    scale = float(embedding.series.values.std()) * LARGEST
    points = widest.vectors(starts) / scale
    n_pairs = 0
    for block, part in enumerate(np.array_split(references, N_BLOCKS)):
        for some in np.array_split(part, max(1, len(part) * len(starts) // 1_000_000)):
            own = widest.vectors(some) / scale
            kept = np.abs(some[:, None] - starts) > embedding.theiler
            n_pairs += int(kept.sum())
            apart = np.zeros(kept.shape)
            for k in range(dimensions[-1]):
                np.maximum(apart, np.abs(own[:, k, None] - points[:, k]), out=apart)
                if k + 1 in dimensions:
                    row = dimensions.index(k + 1)
                    counts[row, block] += _below(apart[kept], n_radii)
                    near[row] += _below(apart[~kept], n_radii)
    return counts, near, n_pairs


def _below(apart: Floats, n_radii: int) -> Counts:
    """Count the distances below each radius; the largest radius is 1."""
    level = PER_OCTAVE * np.log2(np.maximum(apart, 1e-12)) + n_radii - 1
    bins = np.clip(np.ceil(level), 0, n_radii).astype(np.int64)
    return np.asarray(np.cumsum(np.bincount(bins, minlength=n_radii + 1)[:n_radii]))


def _slopes(x: Floats, logs: Floats, places: np.ndarray) -> tuple[list[float], float]:
    """Return the slope for each embedding, and the largest difference of slopes with it and along the radii."""
    half = len(places) // 2
    parts = places, places[: half + 1], places[half:]
    slopes, early, late = ([slope(x[part], one[part]) for one in logs] for part in parts)
    return slopes, max(float(np.ptp(slopes)), *(abs(a - b) for a, b in zip(early, late, strict=True)))


def _plateau(x: Floats, logs: Floats, places: np.ndarray) -> np.ndarray | None:
    """Return the longest range of radii in which the slopes agree; the one with the least radii of equally long."""
    least = int(LEAST_OCTAVES * PER_OCTAVE) + 1
    for length in range(len(places), least - 1, -1):
        for begin in range(len(places) - length + 1):
            some = places[begin : begin + length]
            slopes, bend = _slopes(x, logs, some)
            if bend <= FLAT * float(np.mean(slopes)):
                return some
    return None
