"""Estimate the correlation dimension of a time series from the slope of its correlation sums."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.analysis.series.embedding import N_BLOCKS, Embedding, Floats, slope, spread
from pipeline.results.intervals import half_width


@dataclass(frozen=True)
class CorrelationSettings:
    """Numbers of the correlation sums and of the fit of the dimension."""

    # largest radius [standard deviations], radii per factor of two, and factors of two from it to the least
    largest: float = 4.0
    per_octave: int = 4
    n_octaves: int = 12
    # vectors whose pairs are counted, and vectors that they are paired with: more reach smaller radii, and take longer
    n_references: int = 2400
    n_points: int = 12_000
    # pairs at the least radius of a fit of a motion that mixes, and share of all pairs at its largest
    fewest_pairs: int = 400
    most_of_mixing: float = 0.01
    # the same of others: samples of its own pass and other passes within the radius of a sample; share of all pairs.
    # The passes of a quasi-periodic motion are apart by equal steps, and so are its samples. Correlation sums have
    # stairs where only few are near.
    fewest_samples: float = 3.0
    fewest_passes: float = 4.0
    most_of_others: float = 0.08
    least_octaves: float = 2.0  # shortest range of a fit; a shorter one gives a dimension more often, and a worse one
    # largest relative change of the slope from one half of a range to the other, and with the embedding dimension
    flat: float = 0.1


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


def correlation_sums(embedding: Embedding, mixes: bool, settings: CorrelationSettings = CorrelationSettings()) -> Sums:
    """Count the pairs of vectors closer than radii, and fit the slope where it is a plateau.

    Grassberger and Procaccia (Physica D 9, 189, 1983), with the largest difference of a coordinate as distance and
    without pairs close in time (Theiler, Phys. Rev. A 34, 2427, 1986). The range of the fit is the longest in which the
    slopes of both halves, and those for the embedding and two delays more, agree within `flat`. It lies between the
    radius below which pairs are too few and the one beyond which the edges of the set bend the curve. The interval is
    that of Student from slopes of `N_BLOCKS` stretches, widened by these differences. In a motion that mixes neighbours
    part, so that the distances of passes are random.
    """
    dimensions = tuple(range(embedding.dimension, embedding.dimension + 3))
    counts, near, n_pairs = _counts(embedding, dimensions, settings)
    radius = (
        2.0 ** (-np.arange(settings.n_octaves * settings.per_octave + 1)[::-1] / settings.per_octave) * settings.largest
    )
    pairs = counts.sum(axis=1)
    share = pairs / max(n_pairs, 1)
    plain = Sums(dimensions, radius, share)
    if mixes:
        enough = (pairs >= settings.fewest_pairs) & (share <= settings.most_of_mixing)
    else:
        # the pairs of one pass include each sample with itself
        enough = (
            (near >= settings.fewest_samples * near[:, :1])
            & (pairs >= settings.fewest_passes * near)
            & (share <= settings.most_of_others)
        )
    places = np.flatnonzero(enough.all(axis=0))
    if len(places) <= settings.least_octaves * settings.per_octave:
        return replace(plain, reason="too few vectors: no two octaves of radii between pairs and edges")
    x = np.log(radius)
    with np.errstate(divide="ignore"):
        logs, by_block = np.log(share), np.log(counts[1])
    chosen = _plateau(x, logs, places, settings)
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


def _counts(
    embedding: Embedding, dimensions: tuple[int, ...], settings: CorrelationSettings
) -> tuple[Counts, Counts, int]:
    """Count pairs closer than each radius, shape (embedding, block, radius), those of one pass, and all pairs."""
    n_radii = settings.n_octaves * settings.per_octave + 1
    counts = np.zeros((len(dimensions), N_BLOCKS, n_radii), np.int64)
    near = np.zeros((len(dimensions), n_radii), np.int64)
    widest = Embedding(embedding.series, embedding.delay, dimensions[-1], embedding.theiler)
    starts = widest.series.starts(widest.span)
    if len(starts) < 100:
        return counts, near, 0
    starts = starts[:: max(1, -(-len(starts) // settings.n_points))]
    references = spread(starts, settings.n_references)
    scale = float(embedding.series.values.std()) * settings.largest
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
                    counts[row, block] += _below(apart[kept], n_radii, settings)
                    near[row] += _below(apart[~kept], n_radii, settings)
    return counts, near, n_pairs


def _below(apart: Floats, n_radii: int, settings: CorrelationSettings) -> Counts:
    """Count the distances below each radius; the largest radius is 1."""
    level = settings.per_octave * np.log2(np.maximum(apart, 1e-12)) + n_radii - 1
    bins = np.clip(np.ceil(level), 0, n_radii).astype(np.int64)
    return np.asarray(np.cumsum(np.bincount(bins, minlength=n_radii + 1)[:n_radii]))


def _slopes(x: Floats, logs: Floats, places: np.ndarray) -> tuple[list[float], float]:
    """Return the slope for each embedding, and the largest difference of slopes with it and along the radii."""
    half = len(places) // 2
    parts = places, places[: half + 1], places[half:]
    slopes, early, late = ([slope(x[part], one[part]) for one in logs] for part in parts)
    return slopes, max(float(np.ptp(slopes)), *(abs(a - b) for a, b in zip(early, late, strict=True)))


def _plateau(x: Floats, logs: Floats, places: np.ndarray, settings: CorrelationSettings) -> np.ndarray | None:
    """Return the longest range of radii in which the slopes agree; the one with the least radii of equally long."""
    least = int(settings.least_octaves * settings.per_octave) + 1
    for length in range(len(places), least - 1, -1):
        for begin in range(len(places) - length + 1):
            some = places[begin : begin + length]
            slopes, bend = _slopes(x, logs, some)
            if bend <= settings.flat * float(np.mean(slopes)):
                return some
    return None
