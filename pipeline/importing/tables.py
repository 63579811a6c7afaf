"""Read tables of numbers that a model interpolates linearly."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import RefusedError

MOST_CORNER_POINTS = 200


def interpolation(path: Path) -> Tree:
    """Return the polygon through the points of a table of XPPAUT as an expression of ``t``.

    The file has the number of points, the first and the last argument, and the values. Beyond its ends the polygon
    goes on straight, as XPPAUT's does.

    Raises
    ------
    RefusedError
        If there is no such table.
    """
    try:
        words = path.read_text("utf-8", errors="replace").split()
    except OSError as error:
        raise RefusedError(f"{path.name}: cannot be read ({error.strerror or error})") from None
    try:
        count, (low, high) = int(words[0]), map(float, words[1:3])
        values = np.array([float(word) for word in words[3 : 3 + max(count, 0)]])
    except (ValueError, IndexError):
        raise RefusedError(f"{path.name}: must have the number of points, two ends and the values") from None
    if not 2 <= count <= MOST_CORNER_POINTS or len(values) != count or not high > low:
        raise RefusedError(f"{path.name}: must have 2 to {MOST_CORNER_POINTS} values between two ends that rise")
    if not (np.isfinite(values).all() and np.isfinite([low, high]).all() and np.abs(values).max() < 1e300):
        raise RefusedError(f"{path.name}: has a value that is not finite")
    step = (high - low) / (count - 1)
    slopes = np.diff(values) / step
    beyond = _plus(Tree("name", 1, "t"), -low)
    terms = [_number(values[0]), _times(slopes[0], beyond)]
    for i, change in enumerate(np.diff(slopes), 1):
        if change != 0.0:
            after = _plus(Tree("name", 1, "t"), -(low + i * step))
            terms.append(_times(change, Tree("call", 1, "max", (after, _number(0.0)))))
    return Tree("sum", 1, "", tuple(terms))


def _number(value: float) -> Tree:
    whole = Tree("number", 1, abs(float(value)))
    return Tree("negative", 1, "", (whole,)) if value < 0.0 else whole


def _plus(tree: Tree, value: float) -> Tree:
    return tree if value == 0.0 else Tree("sum", 1, "", (tree, _number(value)))


def _times(value: float, tree: Tree) -> Tree:
    whole = Tree("product", 1, "", (Tree("number", 1, abs(float(value))), tree))
    return Tree("negative", 1, "", (whole,)) if value < 0.0 else whole
