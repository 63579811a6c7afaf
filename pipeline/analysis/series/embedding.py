"""Embed a time series in delay coordinates: delay by mutual information, dimension by false nearest neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


MOST_DIMENSIONS = 8
"""Largest embedding dimension that is tried."""

FEW_FALSE = 0.01
"""Share of false nearest neighbours from which on an embedding dimension suffices."""


N_BLOCKS = 8
"""Stretches of a series that are compared, and from whose scatter intervals are taken."""


@dataclass(frozen=True)
class Series:
    """Evenly sampled values of one quantity, in pieces that follow each other in one array."""

    values: Floats
    piece: Ints  # number of the piece of each value
    step: float  # sampling interval [s]

    @classmethod
    def of(cls, pieces: list[Floats], step: float) -> Series:
        """Join pieces of a series."""
        return cls(np.concatenate(pieces), np.repeat(np.arange(len(pieces)), [len(p) for p in pieces]), step)

    def pieces(self) -> list[Floats]:
        """Return the values of each piece."""
        return np.split(self.values, np.flatnonzero(np.diff(self.piece)) + 1)

    def averaged(self, stride: int) -> Series:
        """Replace each `stride` samples by their mean; a rest at the end of a piece is dropped."""
        whole = [p[: len(p) // stride * stride].reshape(-1, stride).mean(axis=1) for p in self.pieces()]
        return Series.of([p for p in whole if len(p)], self.step * stride)

    def starts(self, reach: int) -> Ints:
        """Return the samples from which a piece goes on for `reach` more."""
        n = len(self.values) - reach
        return np.flatnonzero(self.piece[: max(n, 0)] == self.piece[reach:]) if n > 0 else np.empty(0, np.int64)


@dataclass(frozen=True)
class Embedding:
    """Delay vectors (x(i), x(i + delay), ...) of a series, and the least distance in time of their neighbours."""

    series: Series
    delay: int  # [samples]
    dimension: int
    theiler: int  # neighbours are more than so many samples apart

    @property
    def span(self) -> int:
        """Samples from the first to the last coordinate of a vector."""
        return (self.dimension - 1) * self.delay

    def vectors(self, starts: Ints) -> Floats:
        """Return the vectors that begin at some samples, shape (vector, coordinate)."""
        return np.asarray(self.series.values[starts[:, None] + self.delay * np.arange(self.dimension)])

    def neighbours(self, n_references: int, ahead: int, n_nearest: int = 1) -> tuple[Ints, Ints, Floats]:
        """Return vectors, evenly spread over the series, with their nearest neighbours and the Euclidean distances.

        Vectors are given by their first samples, shapes (vector,) and (vector, n_nearest), and can be followed for
        `ahead` more samples in their pieces. Empty if there are too few.
        """
        at_once = 4_000_000  # most distances that are held at a time
        starts = self.series.starts(self.span + ahead)
        if len(starts) < 2 * self.theiler + 4 * n_nearest + 2:
            return np.empty(0, np.int64), np.empty((0, n_nearest), np.int64), np.empty((0, n_nearest))
        references = spread(starts, n_references)
        points = self.vectors(starts)
        size = (points**2).sum(axis=1)
        nearest, distance = [], []
        for part in np.array_split(references, max(1, len(references) * len(starts) // at_once)):
            own = self.vectors(part)
            square = size + (own**2).sum(axis=1)[:, None] - 2.0 * own @ points.T
            square[np.abs(part[:, None] - starts) <= self.theiler] = np.inf
            chosen = np.argpartition(square, n_nearest - 1, axis=1)[:, :n_nearest]
            nearest.append(starts[chosen])
            # the expanded square is not exact for close points
            distance.append(np.linalg.norm(points[chosen] - own[:, None], axis=-1))
        return references, np.concatenate(nearest), np.concatenate(distance)


def spread(starts: Ints, n: int) -> Ints:
    """Return at most `n` samples, evenly spread over some."""
    return np.asarray(starts[np.unique(np.linspace(0, len(starts) - 1, n).round().astype(int))])


def slope(x: Floats, y: Floats) -> float:
    """Return the slope of the straight line through points."""
    return float(np.polyfit(x, y, 1)[0])


def mutual_information(series: Series, n_lags: int) -> Floats:
    """Return the mutual information of values and values some samples later, for lags from 0 on [nats].

    From a histogram with 16 bins of equal shares on both sides, as Fraser and Swinney (Phys. Rev. A 33, 1134,
    1986), less the bias of its counts (Miller and Madow).
    """
    n_bins = 16  # bins of equal share on each side of the histogram
    ranks = np.empty(len(series.values), np.int64)
    ranks[np.argsort(series.values, kind="stable")] = np.arange(len(ranks))
    bins = ranks * n_bins // len(ranks)
    found = np.zeros(n_lags + 1)
    for lag in range(n_lags + 1):
        first = series.starts(lag)
        if len(first) < n_bins**2:
            return found[:lag]
        counts = np.bincount(bins[first] * n_bins + bins[first + lag], minlength=n_bins**2).reshape(n_bins, n_bins)
        share = counts / counts.sum()
        apart = share.sum(axis=1)[:, None] * share.sum(axis=0)
        there = share > 0.0
        bias = (there.sum() - 2 * n_bins + 1) / (2.0 * len(first))
        found[lag] = (share[there] * np.log(share[there] / apart[there])).sum() - bias
    return found


def first_minimum(information: Floats) -> int | None:
    """Return the lag of the first minimum of mutual information; None if it only falls, to nothing or to the end.

    A minimum is the least value from lag 0 to a third beyond its own lag, and at least four beyond.
    """
    for lag in range(1, len(information)):
        beyond = lag + max(4, lag // 3)
        if information[lag] < 0.02 or beyond >= len(information):
            return None
        if information[lag] == information[: beyond + 1].min():
            return lag
    return None


def false_neighbours(series: Series, delay: int, theiler: int, n_references: int = 1000) -> Floats:
    """Return the share of false nearest neighbours for the dimensions 1, 2, ..., `MOST_DIMENSIONS`.

    By both criteria of Kennel, Brown and Abarbanel (Phys. Rev. A 45, 3403, 1992, eqs. 4 and 6). Dimensions after the
    first two that suffice are NaN.
    """
    # a neighbour is false if one more coordinate parts it by so many times its distance, or standard deviations
    ratio, largest = 15.0, 2.0
    size = float(series.values.std())
    found = np.full(MOST_DIMENSIONS, np.nan)
    for dimension in range(1, MOST_DIMENSIONS + 1):
        embedding = Embedding(series, delay, dimension, theiler)
        first, nearest, distance = embedding.neighbours(n_references, delay)
        if not len(first):
            break
        ahead = dimension * delay
        more = np.abs(series.values[first + ahead] - series.values[nearest[:, 0] + ahead])
        near = np.maximum(distance[:, 0], 1e-9 * size)
        false = (more > ratio * near) | (np.hypot(more, near) > largest * size)
        # below a thousandth of the size a ratio compares rounding or noise
        found[dimension - 1] = false[(near > 1e-3 * size) | (more > 1e-2 * size)].sum() / len(false)
        if dimension > 1 and (found[dimension - 2 : dimension] < FEW_FALSE).all():
            break
    return found
