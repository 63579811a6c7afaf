"""Compute Wasserstein-1 distances between sets of section points, and the noise floor of a measurement.

For two sets of equally many points, Wasserstein-1 is the mean distance in the cheapest pairing, found by
`scipy.optimize.linear_sum_assignment` (a shortest augmenting path: Crouse, IEEE Trans. Aerosp. Electron.
Syst. 52, 2016, p. 1679). For unequal numbers it is the cost of the cheapest transport, a linear programme
that `scipy.optimize.linprog` solves by HiGHS (Huangfu and Hall, Math. Prog. Comp. 10, 2018, p. 119). The
distance of two states is the largest difference of a component in units of the model's scales, with angles on
their circle, as everywhere in `pipeline.analysis`.
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
"""Number of samples whose distances are averaged."""


def wasserstein(a: Floats, b: Floats, geometry: Geometry) -> float:
    """Return the Wasserstein-1 distance between two sets of section points with equal weights.

    Parameters
    ----------
    a, b
        Points, shapes (m, state) and (n, state). Every point of a set has the same weight.
    geometry
        Scales and circles of the states.

    Returns
    -------
    float
        Distance in units of the scales.
    """
    ways = geometry.distance(a[:, None], b[None])
    if len(a) != len(b):
        return _transport(ways)
    rows, columns = linear_sum_assignment(ways)
    return float(ways[rows, columns].mean())


def _transport(ways: Floats) -> float:
    """Return the smallest mean transport distance between two sets of equally weighted points, given all pairwise
    distances.
    """
    m, n = ways.shape
    if min(m, n) == 1:
        return float(ways.mean())
    leaving, coming = kron(eye_array(m), np.ones((1, n))), kron(np.ones((1, m)), eye_array(n))
    # one constraint is dropped: it follows from the others
    sums = vstack([leaving, coming]).tocsr()[:-1]
    totals = np.concatenate([np.full(m, 1.0 / m), np.full(n, 1.0 / n)])[:-1]
    found = linprog(ways.ravel(), A_eq=sums, b_eq=totals, method="highs")
    if not found.success:
        raise ArithmeticError(f"the distance of {m} from {n} section points: {found.message}")
    return float(found.fun)


@dataclass(frozen=True)
class Candidate:
    """Attractor of the model at one frequency, with its section points."""

    attractor: int
    orbit_period: int  # period of the orbit; 0 for a set that does not close
    side: int  # code of the model's classifier
    points: Floats  # (n, state): all points of a closed orbit, or a sample of a set that does not close


@dataclass(frozen=True)
class Cloud:
    """Measured section points at one frequency step, with their noise."""

    # (n, state): states, and the standard deviation of each
    points: Floats
    noise: Floats
    orbit_period: int  # period of the orbit; 0 if it does not close

    @property
    def cycle(self) -> int:
        """Number of section points after which the motion repeats. It is 1 if the motion is aperiodic."""
        return max(self.orbit_period, 1)

    @property
    def size(self) -> int:
        """Number of section points in each half of the measurement. It is a whole number of cycles if the half is long
        enough.

        Otherwise the halves would hold the points of an orbit in unequal numbers, which adds a distance from
        one point of the orbit to another.
        """
        half = len(self.points) // 2
        return half // self.cycle * self.cycle or half

    def halves(self) -> tuple[Floats, Floats]:
        """Return the first and the second half of the section points."""
        return self.points[-2 * self.size : -self.size], self.points[-self.size :]

    def shuffled(self, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Divide the section points into two halves at random, in whole cycles of the orbit."""
        both = self.points[-2 * self.size :]
        length = self.cycle if self.size % self.cycle == 0 else 1
        cycles = both.reshape(-1, length, both.shape[-1])
        order = rng.permutation(len(cycles))
        one, two = np.array_split(cycles[order], 2)
        return one.reshape(-1, both.shape[-1]), two.reshape(-1, both.shape[-1])


def cloud_of(points: Floats, noise: Floats, orbit_period: int) -> Cloud:
    """Return the measured section points of one frequency step. Leave out cycles with a missing point (NaN)."""
    known = np.asarray(np.isfinite(points).all(axis=1), np.bool_)
    last = int(np.flatnonzero(known)[-1]) + 1
    cycle = max(orbit_period, 1)
    if last >= cycle:
        n = last // cycle * cycle
        whole = np.repeat(known[:n].reshape(-1, cycle).all(axis=1), cycle)
        known = np.concatenate([whole, np.zeros(known.size - n, np.bool_)]) if whole.any() else known
    return Cloud(points[known], _scatter(points, noise, orbit_period)[known], orbit_period)


def _scatter(points: Floats, noise: Floats, orbit_period: int) -> Floats:
    """Return the noise of section points, or the observed scatter of a periodic motion if that is larger."""
    k = orbit_period
    if not k or len(points) <= 2 * k:
        return noise
    second = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    seen = np.sqrt(np.nanmean(second**2, axis=0) / 6)
    return np.asarray(np.maximum(noise, seen))


def floor_of(cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Return the noise floor of a measurement: Wasserstein-1 distance between the halves of its section points.

    It is the mean over randomly drawn halves. If the first and the second half differ more, as in a recording
    that drifted, it is their distance.
    """
    drawn = [wasserstein(*cloud.shuffled(rng), geometry) for _ in range(_DRAWS)]
    return max(float(np.mean(drawn)), wasserstein(*cloud.halves(), geometry))


def distance_to(candidate: Candidate, cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Return the mean Wasserstein-1 distance between an attractor and the two halves of the measured section points.

    Parameters
    ----------
    candidate
        The attractor. For each half, as many of its points are drawn, and the noise of the sections is added.
        The distance from a correct model then equals that between the halves.
    cloud
        The recording's sections.
    geometry
        Scales and circles of the states.
    rng
        Generator of the samples.
    """
    parts, blur = cloud.halves(), np.median(cloud.noise, axis=0)
    ways = []
    for _ in range(_DRAWS // len(parts)):
        for part in parts:
            drawn = _drawn(candidate, len(part), rng)
            ways.append(wasserstein(part, drawn + rng.normal(0.0, 1.0, drawn.shape) * blur, geometry))
    return float(np.mean(ways))


def _drawn(candidate: Candidate, size: int, rng: np.random.Generator) -> Floats:
    """Return at least `size` section points of an attractor: random points of an aperiodic attractor, or whole
    repetitions of a periodic orbit.
    """
    points = candidate.points
    if candidate.orbit_period:
        return np.tile(points, (max(1, -(-size // len(points))), 1))
    return np.asarray(points[rng.choice(len(points), size, replace=len(points) < size)])


def geometry_of(names: Sequence[str], model_names: Sequence[str], whole: Geometry) -> Geometry:
    """Return the geometry for distances between section points: scale and angle flag of each recorded state."""
    at = [list(model_names).index(n) for n in names]
    return Geometry(tuple(whole.is_angle[i] for i in at), tuple(whole.scales[i] for i in at))
