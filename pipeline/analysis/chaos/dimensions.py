"""Compute the Kaplan-Yorke dimension and the correlation dimension of attractors, in the section.

On the section a closed orbit is a few points, of dimension 0, and a quasi-periodic motion is a curve, of
dimension 1. The attractor of the flow has one dimension more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.analysis.chaos.section_samples import Floats, at_least, computed, geometry_of, with_coords
from pipeline.products.lyapunov import LyapunovFlag
from pipeline.products.reporting import track
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import SAME_POINT


def kaplan_yorke_dimension(
    ds: xr.Dataset, *, name: str = "lyapunov", dim: str = "exponent", zero: float = 0.0, flow: bool = False
) -> xr.Dataset:
    """Compute the Kaplan-Yorke dimension from spectra of Lyapunov exponents.

    With the exponents in falling order and j the largest number whose sum S_j is not negative,
    ``D = j + S_j/|l_(j+1)|``: conjectured to be the information dimension of the attractor (Kaplan and
    Yorke, Lect. Notes Math. 730, 204, 1979; Frederickson, Kaplan, Yorke and Yorke, J. Differ. Equ. 49,
    185, 1983). 0 if all exponents are negative; their number n if their sum is not negative.

    Parameters
    ----------
    ds
        Dataset with `name` on `dim`, in any order and unit: exponents of the section, without the zero along
        the flow. With fewer exponents than entries of the dim `state`, the spectrum is known in part. Errors
        ``<name>_stderr`` and flags ``<name>_flag`` are used if present.
    name, dim
        Variable and dim of the exponents.
    zero
        Largest modulus of an exponent that counts as 0. The dimension jumps from 0 to 1 where the largest
        exponent changes sign; on a quasi-periodic motion this exponent is 0 within its error.
    flow
        Whether the exponents are those of a flow. Then the one nearest to 0 is left out, and the dimension is
        that of a section across the flow, one less than that of the attractor.

    Returns
    -------
    Dataset
        On the other dims: `kaplan_yorke_dimension` and `kaplan_yorke_dimension_stderr`, the errors of
        the exponents carried over to first order as if they were independent, for fixed j; NaN without
        them. NaN, too, where a spectrum known in part does not reach a negative sum, an exponent is
        NaN, or the flag is not `LyapunovFlag.GOOD`.

    Raises
    ------
    ValueError
        If the exponents are missing or `zero` is negative.
    """
    if name not in ds or dim not in ds[name].dims:
        raise ValueError(f"The dataset has no {name} on the dim {dim}: give the spectra, or their names.")
    if not zero >= 0.0:
        raise ValueError(f"zero is {zero}, below 0: give the modulus below which an exponent counts as 0")
    exponents = ds[name].transpose(..., dim)
    stderr = ds.get(f"{name}_stderr", xr.full_like(exponents, np.nan)).transpose(*exponents.dims)
    order = np.argsort(-exponents.values, axis=-1)
    rates = np.take_along_axis(exponents.values.astype(np.float64), order, axis=-1)
    rates = np.where(np.abs(rates) <= zero, 0.0, rates)
    errors = np.take_along_axis(stderr.values, order, axis=-1)
    if flow:
        rates, errors = (_without_zero(values, rates) for values in (rates, errors))
    n = rates.shape[-1]
    sums = np.cumsum(rates, axis=-1)
    # sums start at 0, rise and then fall: all sums before the first negative one are at least 0
    j = np.where((sums < 0.0).any(axis=-1), (sums < 0.0).argmax(axis=-1), n)
    below = np.minimum(j, n - 1)[..., None]
    rate = -np.take_along_axis(rates, below, axis=-1)[..., 0]
    reached = np.take_along_axis(sums, np.maximum(j - 1, 0)[..., None], axis=-1)[..., 0]
    inside = (j > 0) & (j < n)
    safe = np.where(inside, rate, 1.0)
    dimension = j + np.where(inside, reached / safe, 0.0)
    weight = np.where(np.arange(n) < j[..., None], 1.0, 0.0)
    np.put_along_axis(weight, below, np.where(inside, reached / safe, 0.0)[..., None], axis=-1)
    used = np.where(weight != 0.0, weight * errors, 0.0)
    error = np.where(inside, np.sqrt((used**2).sum(axis=-1)) / safe, 0.0)
    error = np.where(np.isnan(errors).any(axis=-1), np.nan, error)
    unknown = np.isnan(rates).any(axis=-1) | ((j == n) & (n + flow < ds.sizes.get("state", n)))
    dims = exponents.dims[:-1]
    if f"{name}_flag" in ds:
        unknown |= ds[f"{name}_flag"].transpose(*dims).values != LyapunovFlag.GOOD
    variables: dict[str, Any] = {}
    for key, values in (("", dimension), ("_stderr", error)):
        variables[f"kaplan_yorke_dimension{key}"] = (dims, np.where(unknown, np.nan, values))
    references = "Kaplan and Yorke, Lect. Notes Math. 730, 204 (1979)"
    return with_coords(ds, dims, variables).assign_attrs(zero=zero, references=references)


def _without_zero(values: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Drop the exponent of the flow direction from `values`: the one whose rate is nearest to 0, on the last axis."""
    nearest = np.argmin(np.abs(np.nan_to_num(rates, nan=np.inf)), axis=-1)
    kept = np.arange(rates.shape[-1]) != nearest[..., None]
    return np.asarray(values[kept].reshape(*rates.shape[:-1], rates.shape[-1] - 1))


@dataclass(frozen=True)
class DimensionSettings:
    """Numbers of the correlation sums and of the range of the fit."""

    per_octave: int = 4  # number of radii per factor of two
    n_octaves: int = 20  # number of factors of two from the largest radius to the smallest
    most_pairs: float = 0.05  # share of pairs closer than the radius, at the upper end of the fit
    least_octaves: int = 2  # shortest range of a fit [octaves]
    least_neighbours: int = 10  # mean number of neighbours within the radius, at the lower end of the fit
    n_parts: int = 10  # number of parts of the points for the jackknife; more know the error better, and take longer


def correlation_dimension(
    ds: xr.Dataset,
    *,
    pool: Sequence[str] = (),
    theiler: int = 1,
    n_max: int = 10_000,
    floor: float = SAME_POINT,
    geometry: Geometry | None = None,
) -> xr.Dataset:
    """Compute the correlation dimension of each cell's section points, with the correlation sum and the range of radii
    that was fitted.

    The correlation sum C(r) is the share of pairs of points closer than r; the dimension is the
    slope of log C against log r (Grassberger and Procaccia, Phys. Rev. Lett. 50, 346 and Physica D 9,
    189, 1983). Pairs at most `theiler` sections apart in time are left out (Theiler, Phys. Rev. A 34,
    2427, 1986). Distances are the largest scaled difference of a component, angles on their circle.

    A fixed rule sets the range of the fit. It begins at the least radius, at least `floor`, within which a
    point has ten neighbours on average, and ends where a twentieth of all pairs is closer. Above the range
    the edge of the set bends the curve; below it the few returns of a quasi-periodic motion do. Without two
    octaves there is no fit: N points suffice for a dimension of at most ``log2(N/200)/2``. The slope is a
    least-squares fit through the radii in the range, four per octave.

    Parameters
    ----------
    ds
        Cube with `section` (and `status`).
    pool
        Dims whose cells are pooled as points of one set. They should be on one attractor; this is not
        validated. Cells that were not computed are left out.
    theiler
        Theiler window [sections]; 0 leaves out a point's pair with itself alone. Larger where
        sections follow each other closely.
    n_max
        Most points of a set. The last sections of each cell are used, of evenly chosen cells if
        there are more cells than points. Time grows with its square at the largest radii, memory in
        proportion.
    floor
        Scaled distance that is not resolved. A smaller set counts as a point.
    geometry
        Geometry of the states, by default from the cube's model.

    Returns
    -------
    Dataset
        On the cell dims that are not pooled: `correlation_dimension`;
        `correlation_dimension_stderr`, its sampling error, by the jackknife: slopes without each tenth of
        the points (of successive sections, or of pooled cells);
        `correlation_dimension_spread`, the slope of the lower half of the range minus that of the upper
        half: if it is not small against the precision that you need, the curve is not straight and its
        slope is no dimension; `fit_low`, `fit_high`, the radii of the range; `n_points`;
        `largest_resolved`, ``2 log N/log(extent/fit_low)``, the bound of Eckmann and Ruelle (Physica D
        56, 185, 1992): a result near it says only that the points are too few. And, with `radius`:
        `log_radius` and `log_correlation_sum`, natural logarithms, NaN where no pair is closer. The
        dimension is 0 where a twentieth of the pairs lies within `floor` (closed orbits), NaN where there
        is no range.

    Raises
    ------
    ValueError
        If `pool` has a dim that the cells lack, or an option is out of bounds.

    Notes
    -----
    Correlation sums oscillate about their straight line (for the Henon map by 0.07 in the local slope), so
    a fit over some octaves gives two digits. A rotation close to a resonance fills its curve slowly; until
    then its dimension lies between 0 and 1.
    """
    geometry = geometry_of(ds, geometry)
    section = computed(ds, geometry)
    cells = [d for d in section.dims if d not in ("period_index", "state")]
    if missing := [d for d in pool if d not in cells]:
        raise ValueError(f"pool {missing} are not dims of the cells, {cells}: name some of those")
    at_least("theiler", theiler, 0)
    at_least("n_max", n_max, 100)
    if not floor > 0.0:
        raise ValueError(f"floor is {floor}, not above 0: give the distance that is not resolved")
    kept = [d for d in cells if d not in pool]
    ordered = section.transpose(*kept, *pool, "period_index", "state")
    shape = tuple(section.sizes[d] for d in kept)
    found = {}
    for index in track(list(np.ndindex(*shape)), "correlation sums"):
        values = ordered[index].values
        values = values.reshape(-1, *values.shape[-2:])
        known = values[np.isfinite(values).all(axis=(1, 2))]
        found[index] = _dimension_of(_sample(known, n_max), theiler, floor, geometry)
    return _curves(ds, kept, shape, found).assign_attrs(
        pool=" ".join(map(str, pool)),
        theiler=theiler,
        floor=floor,
        n_max=n_max,
        references="Grassberger and Procaccia, Physica D 9, 189 (1983); Theiler, Phys. Rev. A 34 (1986)",
    )


@dataclass(frozen=True)
class _Curve:
    """Correlation sum of one set of points, with the fitted dimension and the range of radii of the fit."""

    log_radius: Floats
    log_sum: Floats
    n_points: int = 0
    dimension: float = np.nan
    stderr: float = np.nan
    spread: float = np.nan
    fit_low: float = np.nan
    fit_high: float = np.nan
    largest_resolved: float = np.nan


def _sample(section: Floats, n_max: int) -> Floats:
    """Choose at most `n_max` section points: the last ones of cells that are spread evenly over the sample."""
    m = len(section)
    if m > n_max:
        section = section[np.linspace(0, m - 1, n_max).round().astype(int)]
    return section[:, -max(1, n_max // max(m, 1)) :]


def _dimension_of(
    section: Floats, theiler: int, floor: float, geometry: Geometry, settings: DimensionSettings = DimensionSettings()
) -> _Curve:
    """Compute the correlation dimension of the section points of some cells together, shape (cell, n, state)."""
    n_radii = settings.n_octaves * settings.per_octave + 1
    nothing = _Curve(np.full(n_radii, np.nan), np.full(n_radii, np.nan))
    n_points = section.shape[0] * section.shape[1]
    if n_points < settings.n_parts:
        return nothing
    points = section.reshape(n_points, -1)
    extent = _extent(points, geometry)
    if extent <= floor:
        return _Curve(nothing.log_radius, nothing.log_sum, n_points, 0.0, 0.0, 0.0)
    radii = extent * 2.0 ** (-np.arange(n_radii)[::-1] / settings.per_octave)
    pairs = _Pairs.of(section, radii, theiler, geometry, settings.n_parts)
    x, y = np.log(radii), _logarithm(pairs.all / pairs.total)
    share = pairs.all / pairs.total
    if share[np.searchsorted(radii, floor)] > settings.most_pairs:
        return _Curve(x, y, n_points, 0.0, 0.0, 0.0)
    enough = pairs.all >= settings.least_neighbours * n_points
    fit = np.flatnonzero(enough & (radii >= floor) & (share <= settings.most_pairs))
    if len(fit) < settings.least_octaves * settings.per_octave + 1:
        return _Curve(x, y, n_points)
    middle = len(fit) // 2
    spread = _slope(x, y, fit[: middle + 1]) - _slope(x, y, fit[middle:])
    without = [_slope(x, _logarithm(pairs.without(i)), fit) for i in range(settings.n_parts)]
    stderr = np.sqrt((settings.n_parts - 1) * np.var(without))
    largest = 2.0 * np.log(n_points) / np.log(extent / radii[fit[0]])
    ends = float(radii[fit[0]]), float(radii[fit[-1]])
    return _Curve(x, y, n_points, _slope(x, y, fit), float(stderr), spread, *ends, float(largest))


def _extent(points: Floats, geometry: Geometry) -> float:
    """Return the largest extent of the points along any state [scaled]."""
    extent = 0.0
    for i, length in enumerate(geometry.circumference):
        x = geometry.scaled(points)[:, i]
        if length > 0.0:
            # the arc that holds all points is the circle without the widest gap
            x = np.sort(x)
            gap = np.diff(x, append=x[0] + length).max()
            extent = max(extent, min(length - gap, 0.5 * length))
        else:
            extent = max(extent, float(np.ptp(x)))
    return float(extent)


@dataclass(frozen=True)
class _Pairs:
    """Numbers of ordered pairs of points that are closer than each radius. Pairs close in time are left out.

    `by_part` (part, radius) counts the pairs whose first point is in a part of the sample, `within` those whose points
    are both in it; `total` counts the pairs at any distance.
    """

    by_part: npt.NDArray[np.int64]
    within: npt.NDArray[np.int64]
    total: int

    @classmethod
    def of(cls, section: Floats, radii: Floats, theiler: int, geometry: Geometry, n_parts: int) -> _Pairs:
        """Count the pairs of section points closer than each radius, among some cells, shape (cell, n, state)."""
        m, n, _ = section.shape
        points = section.reshape(m * n, -1)
        everything = geometry.tree(points)
        number = np.arange(m * n) * n_parts // (m * n)
        by_part, within = (np.empty((n_parts, len(radii)), np.int64) for _ in range(2))
        for i in range(n_parts):
            own = geometry.tree(points[number == i])
            # a point is not its own neighbour
            by_part[i] = own.count_neighbors(everything, radii, p=np.inf) - own.n
            within[i] = own.count_neighbors(own, radii, p=np.inf) - own.n
        part, total = number.reshape(m, n), m * n * (m * n - 1)
        for lag in range(1, min(theiler, n - 1) + 1):
            near = geometry.distance(section[:, lag:], section[:, :-lag])
            total -= 2 * near.size
            for first, second in ((part[:, lag:], part[:, :-lag]), (part[:, :-lag], part[:, lag:])):
                for i in range(n_parts):
                    by_part[i] -= np.searchsorted(np.sort(near[first == i]), radii, side="right")
                    both = (first == i) & (second == i)
                    within[i] -= np.searchsorted(np.sort(near[both]), radii, side="right")
        return cls(by_part, within, total)

    @property
    def all(self) -> npt.NDArray[np.int64]:
        return np.asarray(self.by_part.sum(axis=0))

    def without(self, part: int) -> npt.NDArray[np.int64]:
        """Return the number of pairs closer than each radius if one part of the sample is left out, shape (radius,)."""
        return np.asarray(self.all - 2 * self.by_part[part] + self.within[part])


def _logarithm(values: npt.NDArray[Any]) -> Floats:
    return np.asarray(np.log(values, out=np.full(values.shape, np.nan), where=np.asarray(values > 0)))


def _slope(x: Floats, y: Floats, rows: npt.NDArray[np.int64]) -> float:
    """Fit the slope of y over x by least squares at some radii; radii within which there is no pair of points are left
    out.
    """
    rows = rows[np.isfinite(y[rows])]
    x, y = x[rows] - x[rows].mean(), y[rows] - y[rows[0]]  # a flat curve has the slope 0 exactly
    return float((x * y).sum() / (x * x).sum())


_CURVE = {
    "correlation_dimension": "dimension",
    "correlation_dimension_stderr": "stderr",
    "correlation_dimension_spread": "spread",
    "log_correlation_sum": "log_sum",
    **{name: name for name in ("fit_low", "fit_high", "n_points", "largest_resolved", "log_radius")},
}
"""Fields of a curve by the name of their variable."""


def _curves(
    ds: xr.Dataset, dims: Sequence[object], shape: tuple[int, ...], found: dict[tuple[int, ...], _Curve]
) -> xr.Dataset:
    variables: dict[str, Any] = {}
    for name, field in _CURVE.items():
        rows = np.array([getattr(found[index], field) for index in np.ndindex(*shape)])
        own = ("radius",) if rows.ndim > 1 else ()
        variables[name] = ((*dims, *own), rows.reshape((*shape, *rows.shape[1:])))
    return with_coords(ds, dims, variables)
