"""Measure how often the states of a time series recur: the recurrence matrix and its lines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.analysis.series.embedding import Embedding, Floats

RATE = 0.05
"""Share of the pairs of vectors that count as recurrent."""

MOST_VECTORS = 1200
"""Most vectors in a row of the matrix."""

SHORTEST = 2
"""Shortest line that counts."""

N_PARTS = 4
"""Parts along the diagonal, from whose scatter intervals are taken."""


@dataclass(frozen=True)
class Recurrence:
    """A recurrence matrix, and the measures of its lines over the whole and over parts of it."""

    matrix: npt.NDArray[np.bool_]
    time: Floats  # of the rows [s]
    measures: dict[str, float]
    parts: dict[str, list[float]]


def recurrence(embedding: Embedding) -> Recurrence | None:
    """Return the recurrence matrix of the first vectors of a series, with its measures; None if they are too few.

    Vectors recur if they are closer than a radius (largest difference of a coordinate), which is chosen such that
    `RATE` of the pairs outside of the Theiler window do. Measures as Marwan, Romano, Thiel and Kurths (Phys. Rep.
    438, 237, 2007, eqs. 45 to 57): ``determinism`` and ``laminarity``, the shares of recurrences on diagonal and
    vertical lines of at least `SHORTEST` vectors, ``mean_line`` of the diagonals [s], and the ``entropy`` of their
    lengths [nats].
    """
    starts = embedding.series.starts(embedding.span)
    stride = max(1, min(len(starts) // MOST_VECTORS, embedding.delay // 2))
    starts = starts[::stride][:MOST_VECTORS]
    window = embedding.theiler // stride
    if len(starts) < 4 * N_PARTS * (window + 1):
        return None
    vectors = embedding.vectors(starts)
    apart = np.zeros((len(starts), len(starts)))
    for column in vectors.T:
        np.maximum(apart, np.abs(column[:, None] - column), out=apart)
    radius = float(np.quantile(apart[np.triu_indices(len(starts), window + 1)], RATE))
    matrix = apart <= radius
    step = stride * embedding.series.step
    ends = np.linspace(0, len(matrix), N_PARTS + 1).astype(int)
    parts = [_measures(matrix[a:b, a:b], window, step) for a, b in pairwise(ends)]
    time = (starts - starts[0]) * embedding.series.step
    by_name = {name: [part[name] for part in parts] for name in parts[0]}
    return Recurrence(matrix, time, _measures(matrix, window, step), by_name)


def _measures(matrix: npt.NDArray[np.bool_], window: int, step: float) -> dict[str, float]:
    n = len(matrix)
    diagonal = _lengths([matrix.diagonal(k) for k in range(window + 1, n)])
    clean = matrix & (np.abs(np.subtract.outer(np.arange(n), np.arange(n))) > window)
    vertical = _lengths(list(clean.T))
    long = diagonal[diagonal >= SHORTEST]
    counts = np.bincount(long)[SHORTEST:] if len(long) else np.zeros(1)
    share = counts[counts > 0] / max(counts.sum(), 1)
    return {
        "determinism": float(long.sum() / max(diagonal.sum(), 1)),
        "laminarity": float(vertical[vertical >= SHORTEST].sum() / max(vertical.sum(), 1)),
        "mean_line": float(long.mean() * step) if len(long) else 0.0,
        "line_entropy": float(-(share * np.log(share)).sum()),
    }


def _lengths(lines: list[npt.NDArray[np.bool_]]) -> npt.NDArray[np.int64]:
    """Return the lengths of the runs of True in some lines."""
    joined = np.concatenate([[False], *(np.append(line, False) for line in lines)])
    edges = np.flatnonzero(np.diff(joined))
    return np.asarray(edges[1::2] - edges[::2])
