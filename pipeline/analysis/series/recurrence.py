"""Measure how often the states of a time series recur: the recurrence matrix and its lines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.analysis.series.embedding import Embedding, Floats


@dataclass(frozen=True)
class RecurrenceSettings:
    """Numbers of the recurrence matrix and of its lines."""

    rate: float = 0.05  # share of the pairs of vectors that count as recurrent; more makes longer lines
    most_vectors: int = 1200  # most vectors in a row of the matrix, whose size grows as their square
    shortest: int = 2  # shortest line that counts
    n_parts: int = 4  # parts along the diagonal, from whose scatter intervals are taken


@dataclass(frozen=True)
class Recurrence:
    """A recurrence matrix, and the measures of its lines over the whole and over parts of it."""

    matrix: npt.NDArray[np.bool_]
    time: Floats  # of the rows [s]
    measures: dict[str, float]
    parts: dict[str, list[float]]


def recurrence(embedding: Embedding, settings: RecurrenceSettings = RecurrenceSettings()) -> Recurrence | None:
    """Return the recurrence matrix of the first vectors of a series, with its measures; None if they are too few.

    Vectors recur if they are closer than a radius (largest difference of a coordinate), which is chosen such that
    `rate` of the pairs outside of the Theiler window do. Measures as Marwan, Romano, Thiel and Kurths (Phys. Rep.
    438, 237, 2007, eqs. 45 to 57): ``determinism`` and ``laminarity``, the shares of recurrences on diagonal and
    vertical lines of at least `shortest` vectors, ``mean_line`` of the diagonals [s], and the ``entropy`` of their
    lengths [nats].
    """
    starts = embedding.series.starts(embedding.span)
    stride = max(1, min(len(starts) // settings.most_vectors, embedding.delay // 2))
    starts = starts[::stride][: settings.most_vectors]
    window = embedding.theiler // stride
    if len(starts) < 4 * settings.n_parts * (window + 1):
        return None
    vectors = embedding.vectors(starts)
    apart = np.zeros((len(starts), len(starts)))
    for column in vectors.T:
        np.maximum(apart, np.abs(column[:, None] - column), out=apart)
    radius = float(np.quantile(apart[np.triu_indices(len(starts), window + 1)], settings.rate))
    matrix = apart <= radius
    step = stride * embedding.series.step
    ends = np.linspace(0, len(matrix), settings.n_parts + 1).astype(int)
    parts = [_measures(matrix[a:b, a:b], window, step, settings) for a, b in pairwise(ends)]
    time = (starts - starts[0]) * embedding.series.step
    by_name = {name: [part[name] for part in parts] for name in parts[0]}
    return Recurrence(matrix, time, _measures(matrix, window, step, settings), by_name)


def _measures(
    matrix: npt.NDArray[np.bool_], window: int, step: float, settings: RecurrenceSettings
) -> dict[str, float]:
    n = len(matrix)
    diagonal = _lengths([matrix.diagonal(k) for k in range(window + 1, n)])
    clean = matrix & (np.abs(np.subtract.outer(np.arange(n), np.arange(n))) > window)
    vertical = _lengths(list(clean.T))
    long = diagonal[diagonal >= settings.shortest]
    counts = np.bincount(long)[settings.shortest :] if len(long) else np.zeros(1)
    share = counts[counts > 0] / max(counts.sum(), 1)
    return {
        "determinism": float(long.sum() / max(diagonal.sum(), 1)),
        "laminarity": float(vertical[vertical >= settings.shortest].sum() / max(vertical.sum(), 1)),
        "mean_line": float(long.mean() * step) if len(long) else 0.0,
        "line_entropy": float(-(share * np.log(share)).sum()),
    }


def _lengths(lines: list[npt.NDArray[np.bool_]]) -> npt.NDArray[np.int64]:
    """Return the lengths of the runs of True in some lines."""
    joined = np.concatenate([[False], *(np.append(line, False) for line in lines)])
    edges = np.flatnonzero(np.diff(joined))
    return np.asarray(edges[1::2] - edges[::2])
