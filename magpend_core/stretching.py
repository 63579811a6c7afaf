"""Measure how products of matrices stretch orthonormal directions: QR decompositions by Householder reflections."""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.engine.jit import inline, kernel


def stretched(matrices: np.ndarray) -> np.ndarray:
    """Return the factors by which matrices stretch orthonormal directions that the earlier matrices have turned.

    Parameters
    ----------
    matrices
        Matrices to apply one after another, shape (path, n, state, state).

    Returns
    -------
    ndarray, (path, n, state)
        Moduli of the diagonals of R, where ``Q R`` is the decomposition of a matrix times the Q before it (Eckmann and
        Ruelle, Rev. Mod. Phys. 57, 617, 1985, sec. V).
    """
    found = np.empty(matrices.shape[:-1])
    n = matrices.shape[-1]
    for path, own in zip(np.ascontiguousarray(matrices), found, strict=True):
        _stretched(path, np.eye(n), np.empty((n, n)), own)
    return found


@inline
def _reflect(vectors: Any, j: int, matrix: Any, column: int) -> None:
    """Reflect a column of a matrix along the vector of column `j`, whose entries above the diagonal do not count."""
    square, along = 0.0, 0.0
    for i in range(j, len(vectors)):
        square += vectors[i, j] * vectors[i, j]
        along += vectors[i, j] * matrix[i, column]
    if square > 0.0:
        for i in range(j, len(vectors)):
            matrix[i, column] -= 2.0 * along / square * vectors[i, j]


@kernel
def _stretched(path: Any, basis: Any, moved: Any, found: Any) -> None:
    """Write the factors of one path to `found`. Matrices `basis` (at first the identity) and `moved` are changed."""
    n = len(basis)
    for step in range(len(path)):
        for i in range(n):
            for j in range(n):
                total = 0.0
                for k in range(n):
                    total += path[step, i, k] * basis[k, j]
                moved[i, j] = total
        for j in range(n):
            size = 0.0
            for i in range(j, n):
                size += moved[i, j] * moved[i, j]
            size = np.sqrt(size)
            found[step, j] = size
            # the column becomes the vector of the reflection
            moved[j, j] += size if moved[j, j] >= 0.0 else -size
            for c in range(j + 1, n):
                _reflect(moved, j, moved, c)
        for c in range(n):
            for i in range(n):
                basis[i, c] = 1.0 if i == c else 0.0
            for j in range(n - 1, -1, -1):
                _reflect(moved, j, basis, c)
