"""Predict points of a solution curve by polynomials through known points, of the order that fits best.

The polynomials are in the coordinate along a direction, in which the curve is a smooth function as long as it turns
little. Those through values and tangents err less where the curve bends; those through values alone err less where it
is nearly straight, as tangents are known to seven digits alone.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray

MOST_PREDICTING = 8
"""Most points of a curve through which a polynomial leads."""

TANGENT_ERROR = 1e-6
"""Error of a prediction by tangents, whose parts by the parameter are one-sided differences, per length of the step."""

SAME_WAY = 0.8
"""Least cosine of the angle between the direction and the tangent at a point through which the polynomial leads."""


def predict(u: Array, tangents: Array, direction: Array, at: float, more: Array) -> tuple[Array, Array]:
    """Return the point of a curve at a coordinate along a direction.

    Parameters
    ----------
    u, tangents
        Points and unit tangents, shape (point, unknown), no point twice.
    direction
        Unit vector, near to the last tangent.
    at
        Coordinate along the direction, from the last point.
    more
        Further smooth functions along the curve, shape (point, function).

    Returns
    -------
    u, more : ndarray
        Values at the coordinate.
    """
    s, speeds = (u - u[-1]) @ direction, tangents @ direction
    near = np.argsort(np.abs(s - at), kind="stable")
    near = near[speeds[near] > SAME_WAY][:MOST_PREDICTING]
    if not len(near):  # no smooth function there
        return u[-1] + at * direction, more[-1]
    s, u, slopes = s[near], u[near], tangents[near] / speeds[near, None]
    straight, error = _summed(_terms(at, s, u))
    bent, other = _summed(_terms(at, s[:4], u[:4], slopes[:4]))
    found = bent if other + TANGENT_ERROR * float(np.abs(at - s).min()) < error else straight
    return found, _summed(_terms(at, s, more[near]))[0]


def _terms(at: float, s: Array, values: Array, slopes: Array | None = None) -> Array:
    """Return the terms of Newton's form of the polynomial through values, and slopes if they are given."""
    if slopes is None:
        nodes, table = s, values
    else:
        nodes, table = np.repeat(s, 2), np.repeat(values, 2, axis=0)
    terms, factor = [table[0]], 1.0
    for j in range(1, len(nodes)):
        with np.errstate(invalid="ignore", divide="ignore"):
            table = np.diff(table, axis=0) / (nodes[j:] - nodes[:-j])[:, None]
        if slopes is not None and j == 1:
            table[::2] = slopes
        factor *= at - nodes[j - 1]
        terms.append(factor * table[0])
    return np.array(terms)


def _summed(terms: Array) -> tuple[Array, float]:
    """Return the sum of terms up to the two least in a row, and their size: beyond, errors of the points show."""
    sizes = np.abs(terms[1:]).max(axis=1, initial=0.0)
    if not len(sizes):
        return np.asarray(terms[0]), np.inf
    pairs = np.maximum(sizes[1:], sizes[:-1]) if len(sizes) > 1 else sizes
    least = int(np.argmin(pairs))
    return np.asarray(terms[: least + 3].sum(axis=0)), float(pairs[least])
