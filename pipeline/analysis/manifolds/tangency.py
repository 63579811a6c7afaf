"""Locate the first homoclinic tangency of a saddle along a parameter, for section maps with two states.

Over one generation of the unstable manifold, the signed distance of its points from the stable manifold is computed.
All of them lie on one side as long as the manifolds do not touch. The least distance, with the sign that it has
before, changes its sign at the tangency, which is located by Brent's method.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, minimize_scalar

from pipeline.analysis.manifolds.growing import Manifold, Resolution, Saddle, stable_manifold, unstable_manifold

FINE = Resolution(chord=0.01, length=6.0)
"""Resolution at which splines through the points are accurate to 1e-8 of the scales."""


def first_tangency(
    saddle_at: Callable[[float], Saddle],
    low: float,
    high: float,
    sides: tuple[float, float],
    resolution: Resolution = FINE,
    tolerance: float = 1e-8,
) -> float:
    """Locate the parameter value at which a side of the unstable manifold first touches one of the stable manifold.

    Parameters
    ----------
    saddle_at
        Returns the saddle orbit at a value of the parameter.
    low, high
        Values between which the manifolds begin to touch, in either order of sides.
    sides
        Sides of the unstable and of the stable manifold: 1 or -1, by the sign of the eigenvectors' first component.
    resolution
        Resolution of both manifolds; they must be long enough to meet.
    tolerance
        Absolute tolerance of the value.

    Raises
    ------
    ValueError
        If the section map has not two states, or the manifolds are apart, or cross, at both values.
    """
    ends = {value: gap(saddle_at(value), sides, resolution) for value in (low, high)}
    apart = [value for value in (low, high) if ends[value][0] * ends[value][1] > 0.0]
    if len(apart) != 1:
        state = "are apart" if apart else "cross"
        raise ValueError(
            f"the manifolds {state} at both {low:g} and {high:g}; the first tangency lies between a value at which "
            "they are apart and one at which they cross."
        )
    sign = float(np.sign(ends[apart[0]][0]))

    def least(value: float) -> float:
        smallest, largest = ends[value] if value in ends else gap(saddle_at(value), sides, resolution)
        return smallest if sign > 0.0 else -largest

    return float(brentq(least, low, high, xtol=tolerance))


def gap(saddle: Saddle, sides: tuple[float, float], resolution: Resolution = FINE) -> tuple[float, float]:
    """Compute the least and largest signed distance of a stretch of the unstable manifold from the stable manifold.

    Both have one sign if the manifolds are apart, and two if they cross.
    """
    if len(saddle.scales) != 2:
        raise ValueError(f"the section map has {len(saddle.scales)} states; tangencies are located for two.")
    unstable = unstable_manifold(saddle, _oriented(saddle, sides[0], False), resolution)
    stable = stable_manifold(saddle, _oriented(saddle, sides[1], True), resolution)
    return _extremes(unstable, stable, saddle)


def _oriented(saddle: Saddle, side: float, stable: bool) -> float:
    """Return the sign for a saddle's eigenvector such that side 1 points to larger values of the first state."""
    _, vector = saddle.direction(stable)
    return side * float(np.sign(vector[0]))


def _extremes(unstable: Manifold, stable: Manifold, saddle: Saddle) -> tuple[float, float]:
    curve, target = _Line(unstable.points / saddle.scales), _Line(stable.points / saddle.scales)
    away = np.linalg.norm((unstable.points - saddle.state) / saddle.scales, axis=1)
    far = _first_maximum(away)
    domain = np.flatnonzero(np.abs(unstable.time - unstable.time[far]) <= 0.5)
    distances = np.array([target.signed_distance(point) for point in curve.points[domain]])

    def at(place: float) -> float:
        return target.signed_distance(curve.spline(place))

    found = []
    for sign in (1.0, -1.0):
        k = int(np.argmin(sign * distances))
        low, high = curve.places[domain[max(k - 1, 0)]], curve.places[domain[min(k + 1, len(domain) - 1)]]
        best = minimize_scalar(lambda place, sign=sign: sign * at(place), bounds=(low, high), method="bounded")
        found.append(sign * min(float(best.fun), float(sign * distances[k])))
    return found[0], found[1]


def _first_maximum(values: np.ndarray) -> int:
    """Return the index of the first maximum of the distances from the saddle, where the unstable manifold first turns
    back.
    """
    falling = np.flatnonzero(np.diff(values) < 0.0)
    if not len(falling):
        raise ValueError("the unstable manifold does not turn back; it needs a greater length.")
    return int(falling[0])


class _Line:
    """A cubic spline through points (n, 2), as a function of the length along their chords."""

    def __init__(self, points: np.ndarray) -> None:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept = np.concatenate([[True], steps > 0.0])
        self.points = points
        self.places = np.concatenate([[0.0], np.cumsum(steps)])
        self.spline = CubicSpline(self.places[kept], points[kept])
        self.slope = self.spline.derivative()

    def signed_distance(self, point: np.ndarray) -> float:
        """Return the distance of a point from the spline, positive on the left of its direction."""
        k = int(np.argmin(((self.points - point) ** 2).sum(axis=1)))
        place = self.places[k]
        for _ in range(20):
            tangent = self.slope(place)
            step = float((point - self.spline(place)) @ tangent / (tangent @ tangent))
            place = float(np.clip(place + step, self.places[0], self.places[-1]))
            if abs(step) < 1e-12:
                break
        away, tangent = point - self.spline(place), self.slope(place)
        return float((tangent[0] * away[1] - tangent[1] * away[0]) / np.linalg.norm(tangent))
