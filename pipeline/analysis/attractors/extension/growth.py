"""Classify a non-periodic set as chaotic, as a torus or as neither, by the growth of small distances.

The derivatives of the section map along extended cells give the exponents per section (Eckmann and
Ruelle, Rev. Mod. Phys. 57, 617, 1985, sec. V). These exponents exclude the phase of the drive, and the
direction of the flow if sections are crossings. A flow sampled at equal times has one exponent that is
always 0.

* A *chaotic set* has a largest exponent above 0 by three standard errors, and distances that grew by at least
  exp(`GROWN`). The second condition excludes a shear, in which distances grow linearly with time.
* A *torus* has a largest exponent of 0 by weighted Birkhoff averages, which converge faster than any power
  there (Das, Saiki, Sander and Yorke, Nonlinearity 30, 4111, 2017), and a section on closed curves.
* A trajectory *grows* if it goes ever farther from where it began, and no more slowly: it recurs nowhere, so there is
  no set on which it stays, and the growth of small distances shows no chaos.
* A flow *preserves volume* if the mean logarithm of the change of a volume is 0. Then nothing attracts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from magpend_core.stretching import stretched
from pipeline.layout.vocabulary import BOUNDED_SET, CHAOTIC_SET, TORUS
from pipeline.results.sets import Geometry

N_SIGMA = 3.0
"""Half width of an exponent's interval in standard errors; `_mean` widens it if blocks are few."""

GROWN = 5.0
"""Least logarithm of the growth of a small distance over a cell's extension that shows chaos."""


ZERO = 1e-4
"""Largest modulus of an exponent that counts as 0 on a torus [per section]."""


Rates = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Escape:
    """Growth of a trajectory that never returns near an earlier point."""

    factor: float  # its distance from where it began, in its last window over that in its first
    rate: float  # relative growth of this distance at the end [per section]
    length: int  # number of sections

    @classmethod
    def of(cls, path: np.ndarray, geometry: Geometry) -> Escape | None:
        """Return how section points (n, state) grow; None if they do not, or come to lie no farther than others do."""
        # windows of the trajectory, the least ratio of its late to its early gains, and the factor by which it must
        # pass the unit of distances and the size of its first window
        n_windows, least_ratio, beyond = 8, 0.9, 2.0
        straight = ~np.asarray(geometry.is_angle)
        if len(path) < 4 * n_windows or not straight.any():
            return None
        scales = np.asarray(geometry.scales)[straight]

        def away(window: np.ndarray, origin: np.ndarray) -> float:
            return float(np.abs(window[:, straight] / scales - origin).max())

        # the last window alone rules out most
        first, last = path[: -(-len(path) // n_windows)], path[-(len(path) // n_windows) :]
        origin = (first[:, straight] / scales).mean(axis=0)
        if away(last, origin) < beyond * max(1.0, away(first, origin)):
            return None
        windows = np.array_split(path, n_windows)
        size = np.array([away(window, origin) for window in windows])
        gained, half = np.diff(size), n_windows // 2
        keeps_on = gained.min() > 0.0 and gained[half:].mean() >= least_ratio * gained[:half].mean()
        if not keeps_on:
            return None
        rate = float(np.log(size[-1] / size[-2])) / len(windows[-1])
        return cls(float(size[-1] / max(size[0], 1e-300)), rate, len(path))


@dataclass(frozen=True)
class Growth:
    """Lyapunov exponents of the section map on a set, per iteration of this map."""

    # largest exponent that is not 0 by construction, and its interval
    rate: float
    low: float
    high: float
    weighted: float  # weighted Birkhoff average of this exponent, from the cell with the largest modulus
    weighted_error: float  # largest difference between the averages of the two halves of a cell
    # mean change of the logarithm of a volume along the flow, and its standard error (`_mean`)
    volume: float
    volume_error: float
    length: int  # number of sections of each cell
    # number of exponents that are 0 within their interval, those that are 0 by construction included; -1 unless all
    # others are negative beyond doubt
    n_zero: int

    @property
    def is_chaotic(self) -> bool:
        """Whether small distances grow: the confidence interval of the exponent is above 0, and the total growth is
        large enough.
        """
        return bool(self.low > 0.0 and self.rate * self.length >= GROWN)

    @property
    def is_clear(self) -> bool:
        """Whether the set is chaotic and volumes change, both by far more than an integration at a loose tolerance can
        err.
        """
        # smallest modulus of an exponent and of a change of volumes that an integration at a loose tolerance shows
        clear = 1e-2
        return bool(self.is_chaotic and self.low > clear and abs(self.volume) > clear)

    @property
    def contracts(self) -> bool:
        """Whether small distances shrink, so that the trajectories still converge to a periodic orbit."""
        shown = self.weighted < -max(ZERO, 3.0 * self.weighted_error)
        return bool(shown or (self.high < 0.0 and self.rate * self.length <= -GROWN))

    @property
    def is_zero(self) -> bool:
        """Whether the largest Lyapunov exponent, as a weighted average, is 0 within the tolerance `ZERO`."""
        return bool(abs(self.weighted) <= ZERO and self.weighted_error <= 3.0 * ZERO)

    @property
    def may_be_torus(self) -> bool:
        """Whether volumes shrink, and small distances neither grow nor shrink beyond doubt."""
        return not (self.is_chaotic or self.contracts or self.may_preserve_volume)

    @property
    def may_preserve_volume(self) -> bool:
        """Whether no change of volumes is seen beyond doubt, so that the set need not attract."""
        return bool(abs(self.volume) <= N_SIGMA * self.volume_error)

    @property
    def preserves_volume(self) -> bool:
        """Whether the section map preserves phase volume: the mean logarithm of the volume's change is 0 within its
        error.
        """
        # largest mean change of a volume's logarithm [per section] that counts as 0; and the largest error at which an
        # interval around 0 counts as 0
        no_change, largest_error = 1e-6, 1e-3
        near = self.may_preserve_volume and self.volume_error <= largest_error
        return bool(near or abs(self.volume) <= no_change)


def growth_of(derivatives: np.ndarray, n_known: int, volumes: np.ndarray) -> Growth:
    """Compute the Lyapunov exponents of the section map from the map's derivatives along some trajectories.

    Parameters
    ----------
    derivatives
        Derivatives at consecutive sections, shape (cell, section, state, state).
    n_known
        Number of exponents that are 0 by construction: 1 for a flow sampled at equal times.
    volumes
        Logarithm of the change of a volume per section, shape (cell, section); see `volumes_of`.
    """
    gone = -660.0  # logarithm of the growth of a direction or a volume that shrinks to zero
    sizes, volumes = stretched(derivatives), np.maximum(volumes, gone)
    steps = np.log(sizes, out=np.full(sizes.shape, gone), where=sizes > 1e-286)
    n = steps.shape[1]
    # drop the first quarter, in which the basis aligns with the growing directions
    steps = steps[:, n // 4 :]
    n = steps.shape[1]
    order = np.argsort(-steps.mean(axis=(0, 1)), kind="stable")
    # leave out the `n_known` exponents nearest to 0: they are 0 by construction
    known = np.argsort(np.abs(steps[..., order].mean(axis=(0, 1))), kind="stable")[:n_known]
    first = np.delete(steps[..., order], known, axis=-1)[..., 0]
    rate, error = _mean(first)
    volume, volume_error = _mean(volumes)
    whole = _weighted(first)
    halves = np.stack([_weighted(first[:, : n // 2]), _weighted(first[:, n // 2 :])])
    return Growth(
        rate,
        rate - N_SIGMA * error,
        rate + N_SIGMA * error,
        float(whole[np.abs(whole).argmax()]),
        float(np.abs(halves[0] - halves[1]).max()),
        volume,
        volume_error,
        n,
        _n_zero(steps),
    )


def _n_zero(steps: np.ndarray) -> int:
    """Count the exponents that are 0 within their interval, from logarithms of growth (cell, section, state).

    Return -1 if one of the others is not negative beyond doubt.
    """
    n, n_zero = steps.shape[1], 0
    # a shear grows in proportion to time
    most = 2.0 + np.log(n)
    for own in np.moveaxis(steps, -1, 0):
        rate, error = _mean(own)
        if abs(rate) <= N_SIGMA * error + ZERO and abs(rate) * n <= most:
            n_zero += 1
        elif rate + N_SIGMA * error >= 0.0 or rate * n > -GROWN:
            return -1
    return n_zero


def _mean(values: np.ndarray) -> tuple[float, float]:
    """Compute the mean of values (cell, section), and its standard error from the means of blocks.

    The error of few blocks is itself uncertain. Student's distribution widens it, so that `N_SIGMA` errors
    keep the confidence that they have for a normal distribution.
    """
    per_cell, least = 4, 16  # blocks per cell, and least number of blocks in total
    n_cells, n_sections = values.shape
    n_blocks = min(max(per_cell, -(-least // n_cells)), n_sections)
    each = n_sections // n_blocks
    blocks = values[:, : each * n_blocks].reshape(n_cells, n_blocks, each).mean(axis=2).ravel()
    wider = stdtrit(len(blocks) - 1, ndtr(N_SIGMA)) / N_SIGMA
    return float(values.mean()), float(wider * blocks.std(ddof=1) / np.sqrt(len(blocks)))


def volumes_of(
    derivatives: np.ndarray, before: np.ndarray, after: np.ndarray, normals: Sequence[np.ndarray] | None, flow: Rates
) -> np.ndarray:
    """Compute the logarithm of the factor by which the flow changes a phase volume over one period or return, shape
    (n,).

    On a section of crossings the map's change of areas differs from the flow's change of volumes by the ratio
    of the crossing speeds.

    Parameters
    ----------
    derivatives
        Derivatives of the section map, shape (n, state, state).
    before, after
        Points and their images, shape (n, state).
    normals
        Normals of the section of crossings before and after, shape (n, state); None if sections are at equal times.
    flow
        Function that returns the rates at states (n, state).
    """
    if normals is None:
        return _log_areas(derivatives)
    first, last = (n / np.sqrt((n**2).sum(axis=1, keepdims=True)) for n in normals)
    # vectors along the section as they are, and the normal before to the normal after
    along = derivatives - np.einsum("nij,nj,nk->nik", derivatives, first, first)
    areas = _log_areas(along + last[:, :, None] * first[:, None, :])
    speeds = np.abs(np.stack([(first * flow(before)).sum(axis=1), (last * flow(after)).sum(axis=1)]))
    return np.asarray(areas + np.log(speeds[1] / speeds[0]))


def _log_areas(derivatives: np.ndarray) -> np.ndarray:
    """Return the logarithms of the determinants' moduli; NaN where a derivative is not known."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.slogdet(derivatives)[1])


def _weighted(values: np.ndarray) -> np.ndarray:
    t = (np.arange(values.shape[1]) + 1.0) / (values.shape[1] + 1.0)
    weight = np.exp(-1.0 / (t * (1.0 - t)))
    return np.asarray(values @ (weight / weight.sum()))


def on_closed_curves(points: np.ndarray, geometry: Geometry) -> bool:
    """Return whether section points lie on closed curves.

    The nearest neighbours of nearly every point must lie on a line, with some on either side of the point.

    Parameters
    ----------
    points
        Section points, shape (n, state).
    geometry
        Geometry of the states.
    """
    # neighbours tested for a line, their largest relative scatter about it, and the least share of points
    neighbours, scatter, least = 10, 0.2, 0.95
    if len(points) < 8 * neighbours:
        return False
    _, near = geometry.tree(points).query(geometry.scaled(points), k=neighbours + 1, p=np.inf)
    away = geometry.difference(points[near[:, 1:]], points[:, None])
    _, size, directions = np.linalg.svd(away, full_matrices=False)
    second = size[:, 1] if size.shape[1] > 1 else np.zeros(len(size))
    along = np.einsum("nks,ns->nk", away, directions[:, 0])
    two_sided = (along.max(axis=1) > 0.0) & (along.min(axis=1) < 0.0)
    thin = second <= scatter * np.maximum(size[:, 0], 1e-300)
    return bool((thin & two_sided).mean() >= least)


def kind_of(growth: Growth, points: np.ndarray, geometry: Geometry) -> int:
    """Decide from Lyapunov exponents and section points (n, state) whether a set is chaotic, a torus or another bounded
    set.
    """
    if growth.is_chaotic:
        return CHAOTIC_SET
    if growth.is_zero and on_closed_curves(points, geometry):
        return TORUS
    return BOUNDED_SET
