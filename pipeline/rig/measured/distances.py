"""Distances between sets of section points: Wasserstein-1, and what of it is noise.

Wasserstein-1 of two sets of equally many points is the mean way of the cheapest pairing, found by
`scipy.optimize.linear_sum_assignment` (a shortest augmenting path: Crouse, IEEE Trans. Aerosp. Electron.
Syst. 52, 2016, p. 1679). Of unequal numbers it is the cheapest transport, a linear programme that
`scipy.optimize.linprog` solves by HiGHS (Huangfu and Hall, Math. Prog. Comp. 10, 2018, p. 119). The way
between two states is the largest difference of a component in units of the model's scales, angles on their
circle, as everywhere in `pipeline.analysis`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment, linprog
from scipy.sparse import eye_array, kron, vstack

from pipeline.analysis.sets import Geometry

Floats = npt.NDArray[np.float64]

_DRAWS = 8
"""Samples whose distances are averaged."""


def wasserstein(a: Floats, b: Floats, geometry: Geometry) -> float:
    """Wasserstein-1 between two sets of section points.

    Parameters
    ----------
    a, b
        Shapes (m, state) and (n, state). Every point of a set has the same weight.
    geometry
        Scales and circles of the states.

    Returns
    -------
    float
        In units of the scales.
    """
    ways = geometry.distance(a[:, None], b[None])
    if len(a) != len(b):
        return _transport(ways)
    rows, columns = linear_sum_assignment(ways)
    return float(ways[rows, columns].mean())


def _transport(ways: Floats) -> float:
    """Mean way of the cheapest transport between points of equal weights in each of two sets."""
    m, n = ways.shape
    if min(m, n) == 1:
        return float(ways.mean())
    leaving, coming = kron(eye_array(m), np.ones((1, n))), kron(np.ones((1, m)), eye_array(n))
    # the last of the sums follows from the others
    sums = vstack([leaving, coming]).tocsr()[:-1]
    totals = np.concatenate([np.full(m, 1.0 / m), np.full(n, 1.0 / n)])[:-1]
    found = linprog(ways.ravel(), A_eq=sums, b_eq=totals, method="highs")
    if not found.success:
        raise ArithmeticError(f"the distance of {m} from {n} section points: {found.message}")
    return float(found.fun)


@dataclass(frozen=True)
class Candidate:
    """An attractor of the model at one frequency.

    Attributes
    ----------
    attractor : int
        Its id.
    orbit_period : int
        0 for a set that does not close.
    side : int
        Code of the model's classifier.
    points : ndarray
        (n, state): all points of a closed orbit, or a sample of a set that does not close.
    """

    attractor: int
    orbit_period: int
    side: int
    points: Floats


@dataclass(frozen=True)
class Cloud:
    """Sections of one step.

    Attributes
    ----------
    points, noise : ndarray
        (n, state): states, and the standard deviation of each.
    orbit_period : int
        0 for none.
    """

    points: Floats
    noise: Floats
    orbit_period: int

    @property
    def cycle(self) -> int:
        """Sections after which a closed motion repeats; 1 for one that does not."""
        return max(self.orbit_period, 1)

    @property
    def size(self) -> int:
        """Sections of a half, whole cycles if there is room for any.

        The halves of a motion that closes after k sections would otherwise hold its points in unequal
        numbers, which costs a way from one point of the orbit to another.
        """
        half = len(self.points) // 2
        return half // self.cycle * self.cycle or half

    def halves(self) -> tuple[Floats, Floats]:
        """First and second half."""
        return self.points[-2 * self.size : -self.size], self.points[-self.size :]

    def shuffled(self, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Two halves of cycles drawn at random."""
        both = self.points[-2 * self.size :]
        length = self.cycle if self.size % self.cycle == 0 else 1
        cycles = both.reshape(-1, length, both.shape[-1])
        order = rng.permutation(len(cycles))
        one, two = np.array_split(cycles[order], 2)
        return one.reshape(-1, both.shape[-1]), two.reshape(-1, both.shape[-1])


def cloud_of(points: Floats, noise: Floats, orbit_period: int) -> Cloud:
    """Return the sections of a step; a cycle of which one is missing (NaN) is left out as a whole."""
    known = np.asarray(np.isfinite(points).all(axis=1), np.bool_)
    last = int(np.flatnonzero(known)[-1]) + 1
    cycle = max(orbit_period, 1)
    if last >= cycle:
        n = last // cycle * cycle
        whole = np.repeat(known[:n].reshape(-1, cycle).all(axis=1), cycle)
        known = np.concatenate([whole, np.zeros(known.size - n, np.bool_)]) if whole.any() else known
    return Cloud(points[known], _scatter(points, noise, orbit_period)[known], orbit_period)


def _scatter(points: Floats, noise: Floats, orbit_period: int) -> Floats:
    """Noise of sections, or how far a closed motion is seen to scatter: its drive may jitter."""
    k = orbit_period
    if not k or len(points) <= 2 * k:
        return noise
    second = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    seen = np.sqrt(np.nanmean(second**2, axis=0) / 6)
    return np.asarray(np.maximum(noise, seen))


def floor_of(cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Wasserstein-1 between the halves of one recording: what noise, and being a sample, amount to.

    The mean over halves drawn at random, or that of the first and second half if that is more: then the
    recording itself drifted.
    """
    drawn = [wasserstein(*cloud.shuffled(rng), geometry) for _ in range(_DRAWS)]
    return max(float(np.mean(drawn)), wasserstein(*cloud.halves(), geometry))


def distance_to(candidate: Candidate, cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Mean Wasserstein-1 of the halves of a recording from an attractor.

    Parameters
    ----------
    candidate
        The attractor. As many of its points as a half has are drawn, and blurred by the noise of the
        sections, several times, so that a model that is right is as far away as the halves are from each
        other.
    cloud
        The recording's sections.
    geometry
        Scales and circles of the states.
    rng
        Draws the samples.
    """
    parts, blur = cloud.halves(), np.median(cloud.noise, axis=0)
    ways = []
    for _ in range(_DRAWS // len(parts)):
        for part in parts:
            drawn = _drawn(candidate, len(part), rng)
            ways.append(wasserstein(part, drawn + rng.normal(0.0, 1.0, drawn.shape) * blur, geometry))
    return float(np.mean(ways))


def _drawn(candidate: Candidate, size: int, rng: np.random.Generator) -> Floats:
    """At least `size` points of an attractor: of a closed orbit whole turns, so that all weigh alike."""
    points = candidate.points
    if candidate.orbit_period:
        return np.tile(points, (max(1, -(-size // len(points))), 1))
    return np.asarray(points[rng.choice(len(points), size, replace=len(points) < size)])


def geometry_of(names: Sequence[str], model_names: Sequence[str], whole: Geometry) -> Geometry:
    """Geometry of those states that a recording knows."""
    at = [list(model_names).index(n) for n in names]
    return Geometry(tuple(whole.is_angle[i] for i in at), tuple(whole.scales[i] for i in at))
