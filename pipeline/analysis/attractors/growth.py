"""Kind of a set that does not close: chaotic, a torus, or neither, by the growth of small distances on it.

The derivatives of the section map along the extended cells give the exponents, per section (Eckmann and
Ruelle, Rev. Mod. Phys. 57, 617, 1985, sec. V). The direction of a flow is not among them where sections are
crossings, and neither is the phase of a drive; of a flow looked at in even times one exponent is always 0.

* A *chaotic set* has a largest exponent above 0 by three standard errors, and distances that grew by
  exp(`GROWN`) at least: a shear alone lets them grow with the time, too.
* A *torus* has a largest exponent of 0, by weighted Birkhoff averages, which converge faster than any power
  on it (Das, Saiki, Sander and Yorke, Nonlinearity 30, 4111, 2017), and a section on closed curves.
* A flow *preserves volume* if the logarithm of the change of a volume is 0 in the mean:
  then nothing attracts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from pipeline.analysis.sets import Geometry
from pipeline.layout.vocabulary import BOUNDED_SET, CHAOTIC_SET, TORUS

N_SIGMA = 3.0
"""Standard errors at either side of an exponent's interval, if they were known; see `_mean`."""

GROWN = 5.0
"""Least growth of a small distance over a cell's extension, as a logarithm, that shows chaos."""

N_BLOCKS, LEAST_BLOCKS = 4, 16
"""Blocks of each cell for the error of an exponent, and least number of all."""

ZERO = 1e-4
"""Largest modulus of an exponent that counts as 0 on a torus [per section]."""

NEIGHBOURS, THIN, ON_CURVE = 10, 0.2, 0.95
"""Neighbours that must lie on a line, their largest relative scatter about it, and the share of points."""

GONE = -660.0
"""Logarithm of the growth of a direction or a volume that vanishes, as at rest on a surface."""

Rates = Callable[[np.ndarray], np.ndarray]

LOST, LOST_ERROR = 1e-6, 1e-3
"""Largest mean change of the logarithm of a volume [per section] that counts as none; and the largest error
of a mean that is 0 within its interval."""


@dataclass(frozen=True)
class Growth:
    """Exponents of the section map on a set, per section.

    Attributes
    ----------
    rate, low, high : float
        Largest exponent that is not 0 by construction, and its interval.
    weighted : float
        Its weighted Birkhoff average; the cell of the largest modulus.
    weighted_error : float
        Difference of those of both halves of the cells, the largest.
    volume, volume_error : float
        Mean change of the logarithm of a volume along the flow, and a third of its interval's half.
    length : int
        Sections of each cell.
    """

    rate: float
    low: float
    high: float
    weighted: float
    weighted_error: float
    volume: float
    volume_error: float
    length: int

    @property
    def is_chaotic(self) -> bool:
        """Whether small distances grow, shown by the interval."""
        return bool(self.low > 0.0 and self.rate * self.length >= GROWN)

    @property
    def contracts(self) -> bool:
        """Whether small distances shrink: what is seen is still closing."""
        shown = self.weighted < -max(ZERO, 3.0 * self.weighted_error)
        return bool(shown or (self.high < 0.0 and self.rate * self.length <= -GROWN))

    @property
    def is_zero(self) -> bool:
        """Whether the exponent is 0 within its interval."""
        return bool(abs(self.weighted) <= ZERO and self.weighted_error <= 3.0 * ZERO)

    @property
    def preserves_volume(self) -> bool:
        """Whether volumes stay as they are."""
        near = abs(self.volume) <= N_SIGMA * self.volume_error and self.volume_error <= LOST_ERROR
        return bool(near or abs(self.volume) <= LOST)


def growth_of(derivatives: np.ndarray, n_known: int, volumes: np.ndarray) -> Growth:
    """Exponents of the section map from its derivatives along some cells.

    Parameters
    ----------
    derivatives
        Shape (cell, section, state, state), those of consecutive sections.
    n_known
        Exponents that are 0 by construction: 1 for a flow in even times.
    volumes
        Logarithm of the change of a volume over each, shape (cell, section); see `volumes_of`.
    """
    steps, volumes = _logarithms(derivatives), np.maximum(volumes, GONE)
    n = steps.shape[1]
    # the first quarter turns the basis into its directions
    steps = steps[:, n // 4 :]
    n = steps.shape[1]
    order = np.argsort(-steps.mean(axis=(0, 1)), kind="stable")
    # of those that are 0 by construction the ones nearest to 0 are left out
    known = np.argsort(np.abs(steps[..., order].mean(axis=(0, 1))), kind="stable")[:n_known]
    first = np.delete(steps[..., order], known, axis=-1)[..., 0]
    rate, error = _mean(first)
    volume, volume_error = _mean(volumes)
    whole = _weighted(first)
    halves = np.stack([_weighted(first[:, : n // 2]), _weighted(first[:, n // 2 :])])
    return Growth(
        rate, rate - N_SIGMA * error, rate + N_SIGMA * error, float(whole[np.abs(whole).argmax()]),
        float(np.abs(halves[0] - halves[1]).max()), volume, volume_error, n,
    )  # fmt: skip


def _mean(values: np.ndarray) -> tuple[float, float]:
    """Mean of values (cell, section), and the standard error by which `N_SIGMA` is a safe interval.

    An error that few blocks tell is itself uncertain: Student's distribution widens it.
    """
    n_cells, n_sections = values.shape
    n_blocks = min(max(N_BLOCKS, -(-LEAST_BLOCKS // n_cells)), n_sections)
    each = n_sections // n_blocks
    blocks = values[:, : each * n_blocks].reshape(n_cells, n_blocks, each).mean(axis=2).ravel()
    wider = stdtrit(len(blocks) - 1, ndtr(N_SIGMA)) / N_SIGMA
    return float(values.mean()), float(wider * blocks.std(ddof=1) / np.sqrt(len(blocks)))


def volumes_of(
    derivatives: np.ndarray, before: np.ndarray, after: np.ndarray, crossed: int | None, flow: Rates
) -> np.ndarray:
    """Logarithm of the change of a volume along the flow over a period or return.

    On a section by crossing the map changes areas by the flow's change of volume and the ratio of the speeds
    with which the section is crossed.

    Parameters
    ----------
    derivatives
        Of the section map, shape (n, state, state).
    before, after
        Points and their images, shape (n, state).
    crossed
        Number of the state that crosses; None at even times.
    flow
        Gives the rates at states (n, state).
    """
    if crossed is None:
        return np.asarray(np.linalg.slogdet(derivatives)[1])
    kept = [k for k in range(derivatives.shape[-1]) if k != crossed]
    areas = np.linalg.slogdet(derivatives[:, kept][:, :, kept])[1] if kept else np.zeros(len(before))
    speeds = np.abs(np.stack([flow(before)[:, crossed], flow(after)[:, crossed]]))
    return np.asarray(areas + np.log(speeds[1] / speeds[0]))


def _logarithms(derivatives: np.ndarray) -> np.ndarray:
    """Logarithms of the growth of each orthonormal direction at each section; `GONE` where one vanishes."""
    basis = np.broadcast_to(np.eye(derivatives.shape[-1]), derivatives[:, 0].shape)
    grown = np.empty(derivatives.shape[:-1])
    for i in range(derivatives.shape[1]):
        basis, r = np.linalg.qr(derivatives[:, i] @ basis)
        factor = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
        grown[:, i] = np.log(factor, out=np.full(factor.shape, GONE), where=factor > 1e-286)
    return grown


def _weighted(values: np.ndarray) -> np.ndarray:
    """Weighted Birkhoff average along the second axis."""
    t = (np.arange(values.shape[1]) + 1.0) / (values.shape[1] + 1.0)
    weight = np.exp(-1.0 / (t * (1.0 - t)))
    return np.asarray(values @ (weight / weight.sum()))


def on_closed_curves(points: np.ndarray, geometry: Geometry) -> bool:
    """Whether section points lie on closed curves.

    Nearly every point must find its nearest neighbours on a line, and some of them on either side.

    Parameters
    ----------
    points
        Shape (n, state).
    geometry
        Of the states.
    """
    if len(points) < 8 * NEIGHBOURS:
        return False
    _, near = geometry.tree(points).query(geometry.scaled(points), k=NEIGHBOURS + 1, p=np.inf)
    away = geometry.difference(points[near[:, 1:]], points[:, None])
    _, size, directions = np.linalg.svd(away, full_matrices=False)
    second = size[:, 1] if size.shape[1] > 1 else np.zeros(len(size))
    along = np.einsum("nks,ns->nk", away, directions[:, 0])
    two_sided = (along.max(axis=1) > 0.0) & (along.min(axis=1) < 0.0)
    thin = second <= THIN * np.maximum(size[:, 0], 1e-300)
    return bool((thin & two_sided).mean() >= ON_CURVE)


def kind_of(growth: Growth, points: np.ndarray, geometry: Geometry) -> int:
    """Kind of a set by its exponents and its section points (n, state)."""
    if growth.is_chaotic:
        return CHAOTIC_SET
    if growth.is_zero and on_closed_curves(points, geometry):
        return TORUS
    return BOUNDED_SET
