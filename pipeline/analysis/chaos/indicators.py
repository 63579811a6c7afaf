"""Chaos indicators from what a cube holds: the 0-1 test, Kaplan-Yorke and correlation dimension.

    ds = pipeline.open_run(directory)
    zero_one_test(ds)                                     # per cell
    correlation_dimension(ds.sel(frequency=2.4), pool=["initial_condition"])
    kaplan_yorke_dimension(spectra)                       # of Lyapunov exponents

Nothing is integrated. All is said of the stroboscopic section: a closed orbit is a few points there, of
dimension 0, a quasi-periodic motion a curve, of dimension 1. The flow's attractor has one dimension
more.

A cell that is not computed to the end (failed, pending) has NaN everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import fft

from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.status import Status
from pipeline.analysis.sets import Geometry
from pipeline.products.lyapunov import LyapunovFlag

Floats = npt.NDArray[np.float64]

PENDULUM = Geometry.of(PENDULUM_FITTED)

FLOOR = 1e-6
"""Scaled distance below which sections are one point: the closure tolerance of a run."""

BUDGET = 64 * 2**20
"""Bytes that a step of the 0-1 test holds at once."""


def _computed(ds: xr.Dataset, geometry: Geometry) -> xr.DataArray:
    """Sections, NaN in the cells that were not computed to the end.

    Raises
    ------
    ValueError
        If there are no sections, or their states are not those of the geometry.
    """
    if "section" not in ds:
        raise ValueError("The dataset has no section; give the dataset of pipeline.open_run.")
    section = ds["section"]
    if section.sizes["state"] != len(geometry.scales):
        raise ValueError(
            f"section has {section.sizes['state']} states, the geometry {len(geometry.scales)}: give the "
            "geometry of the system that was integrated"
        )
    if "status" not in ds:
        return section
    return section.where(ds["status"].isin((Status.PERIODIC, Status.BOUNDED, Status.INFERRED)))


# ---- 0-1 test ----------------------------------------------------------------------------------

SHORTEST = 200
"""Fewest sections for the 0-1 test: lags reach a tenth of them, and ten lags call a period of 3 chaotic."""


def zero_one_test(
    ds: xr.Dataset,
    *,
    state: str | None = None,
    n_frequencies: int = 100,
    stride: int = 1,
    seed: int = 0,
    geometry: Geometry = PENDULUM,
) -> xr.Dataset:
    """0-1 test for chaos on the sections of each cell: near 0 regular, near 1 chaotic.

    The sections' observable phi(1), ..., phi(N), its mean taken off, drives a walk in the plane,
    ``z_c(n) = sum over j <= n of phi(j) exp(i c j)``. It stays bounded if the motion is regular and
    diffuses if it is chaotic. K_c is the correlation of the mean square displacement
    ``D_c(n) = mean over j of |z_c(j + n) - z_c(j)|**2`` with n for n up to N/10, and K its median over
    random c in (pi/5, 4 pi/5) (Gottwald and Melbourne, SIAM J. Appl. Dyn. Syst. 8, 129, 2009, the
    correlation method). They subtract from the displacement the oscillating term
    ``mean(phi)**2 (1 - cos n c)/(1 - cos c)``; of an observable without mean it is 0.

    Parameters
    ----------
    ds
        Cube with `section` (and `status`), all sections loaded at once.
    state
        Observable: a state, an angle by its sine and cosine along which it varies most. None: the
        combination of all scaled states that varies most (their first principal component).
    n_frequencies
        Number of c, 10 or more.
    stride
        Use every so many-th section; against oversampling, see below.
    seed
        Of the c, which are the same for all cells.
    geometry
        Of the states; by default the pendulum's.

    Returns
    -------
    Dataset
        On the dims of the cells: `zero_one`, the median K; `zero_one_stderr`, the error of the median
        from the choice of the c (half the distance of the order statistics half a standard deviation
        of the rank to either side); `zero_one_low`, `zero_one_high`, quartiles of K_c;
        `zero_one_half`, K from the later half of the sections (NaN if they are too few): where it
        differs, the series is too short to tell; `oversampling`, the range of the observable over its
        mean step.

    Raises
    ------
    ValueError
        If there are too few sections, or an option is out of bounds.

    Notes
    -----
    * A few hundred sections tell closed orbits from strong chaos. Weak or intermittent chaos and orbits
      of long period need thousands; there K lies between 0 and 1, and `zero_one_half` is lower or higher.
    * A signal sampled too often looks regular: K of a flow sampled at short times tends to 0 for chaos,
      too. Sections are taken once per drive period, which is coarse unless the drive is fast against the
      motion. `oversampling` above 10 says so; `stride` is the remedy.
    * Some c resonate with a regular motion and have K_c = 1. The median does not see them unless they
      are half of all.
    * Sections that lie within 1e-6 of each other are one point, K = 0: the test would find the noise
      of the integration. A transient that has not died out counts as part of the motion.
    """
    section = _computed(ds, geometry).isel(period_index=slice(None, None, _at_least("stride", stride, 1)))
    n_frequencies = _at_least("n_frequencies", n_frequencies, 10)
    n = section.sizes["period_index"]
    if n < SHORTEST:
        raise ValueError(
            f"{n} sections (with stride {stride}) are too few for the 0-1 test, which needs {SHORTEST}: "
            "raise n_keep, to some hundreds if possible"
        )
    cells = [d for d in section.dims if d not in ("period_index", "state")]
    values = section.transpose(*cells, "period_index", "state").values
    shape = values.shape[:-2]
    flat = values.reshape(-1, n, values.shape[-1])
    c = np.random.default_rng(seed).uniform(0.2 * np.pi, 0.8 * np.pi, n_frequencies)
    phi = _observable(flat, None if state is None else _number(ds, state), geometry)
    measures = np.full((6, len(phi)), np.nan)
    step = max(1, BUDGET // (16 * n * n_frequencies))
    for begin in range(0, len(phi), step):
        rows = slice(begin, begin + step)
        measures[:, rows] = _zero_one(phi[rows], c)
    table = {
        "zero_one": "0-1 test, median over frequencies",
        "zero_one_stderr": "standard error of the median from the choice of the frequencies",
        "zero_one_low": "0-1 test, lower quartile over frequencies",
        "zero_one_high": "0-1 test, upper quartile over frequencies",
        "zero_one_half": "0-1 test of the later half of the sections",
        "oversampling": "range of the observable over its mean step",
    }
    variables = {
        name: (cells, values.reshape(shape), {"units": "1", "long_name": text})
        for (name, text), values in zip(table.items(), measures, strict=True)
    }
    about = {"zero_one_state": state or "first principal component", "n_frequencies": n_frequencies}
    return _with_coords(ds, cells, variables).assign_attrs(
        about | {"stride": stride, "seed": seed, "n_sections": n, "references": _GOTTWALD}
    )


_GOTTWALD = "Gottwald and Melbourne, SIAM J. Appl. Dyn. Syst. 8, 129 (2009)"


def _at_least(name: str, value: int, least: int) -> int:
    if value < least:
        raise ValueError(f"{name} is {value}, below {least}: give {least} or more")
    return int(value)


def _number(ds: xr.Dataset, state: str) -> int:
    names = [str(s) for s in ds["state"].values]
    if state not in names:
        raise ValueError(f"state is {state!r}, which is none of {names}: name one of them")
    return names.index(state)


def _with_coords(ds: xr.Dataset, dims: Sequence[object], variables: Mapping[str, Any]) -> xr.Dataset:
    coords = {name: c for name, c in ds.coords.items() if set(c.dims) <= set(dims)}
    return xr.Dataset(variables, coords=coords)


def _observable(section: Floats, state: int | None, geometry: Geometry) -> Floats:
    """One number per section, shape (cell, n), without mean; 0 where the sections are one point."""
    columns = range(section.shape[-1]) if state is None else [state]
    lines = []
    for i in columns:
        x, scale = section[..., i], geometry.scales[i]
        # an angle on its circle in the plane: no jump where it passes pi
        lines += [np.cos(x) / scale, np.sin(x) / scale] if geometry.is_angle[i] else [x / scale]
    points = np.stack(lines, axis=-1)
    points = points - points.mean(axis=1, keepdims=True)
    known = np.isfinite(points).all(axis=(1, 2))
    phi = np.full(section.shape[:2], np.nan)
    covariance = np.einsum("cni,cnj->cij", points[known], points[known])
    phi[known] = np.einsum("cni,ci->cn", points[known], np.linalg.eigh(covariance)[1][..., -1])
    phi[known & (np.abs(points).max(axis=(1, 2)) < FLOOR)] = 0.0
    return np.asarray(phi - phi.mean(axis=1, keepdims=True))


def _zero_one(phi: Floats, c: Floats) -> Floats:
    """Rows of the measures of `zero_one_test`, for each observable (cell, n)."""
    n = phi.shape[1]
    k = np.sort(_growth(phi, c), axis=1)
    half = np.full(len(phi), np.nan)
    if n // 2 >= SHORTEST:
        later = phi[:, n - n // 2 :]
        half = np.median(_growth(later - later.mean(axis=1, keepdims=True), c), axis=1)
    away = 0.5 * np.sqrt(len(c))
    ranks = np.clip(np.round((len(c) - 1) / 2 + np.array([-away, away])).astype(int), 0, len(c) - 1)
    low, high = np.percentile(k, [25.0, 75.0], axis=1)
    step = np.abs(np.diff(phi, axis=1)).mean(axis=1)
    extent = phi.max(axis=1) - phi.min(axis=1)
    over = np.divide(extent, step, out=np.where(np.isnan(step), np.nan, 0.0), where=step > 0.0)
    error = 0.5 * (k[:, ranks[1]] - k[:, ranks[0]])
    return np.stack([np.median(k, axis=1), error, low, high, half, over])


def _growth(phi: Floats, c: Floats) -> Floats:
    """K_c of each observable and frequency, shape (cell, c); 0 where the observable is 0."""
    n = phi.shape[1]
    n_cut = n // 10
    walk = np.cumsum(phi[:, None, :] * np.exp(1j * c[:, None] * np.arange(1, n + 1)), axis=-1)
    moved = _displacement(walk, n_cut)
    moved -= moved.mean(axis=-1, keepdims=True)
    lags = np.arange(n_cut) - 0.5 * (n_cut - 1)
    size = np.sqrt((moved**2).sum(axis=-1) * (lags**2).sum())
    empty = np.where(np.isnan(size), np.nan, 0.0)
    return np.asarray(np.divide(moved @ lags, size, out=empty, where=size > 0.0))


def _displacement(walk: npt.NDArray[np.complex128], n_cut: int) -> Floats:
    """Mean of ``|z(j + lag) - z(j)|**2`` over the first n - n_cut j, for lags 1 to `n_cut` (last axis).

    The square is multiplied out: sums of squares, and a correlation by Fourier transform.
    """
    n = walk.shape[-1]
    length = fft.next_fast_len(n)  # j + lag never goes beyond n
    base = walk[..., : n - n_cut]
    cross = fft.ifft(fft.fft(walk, length) * np.conj(fft.fft(base, length)))[..., 1 : n_cut + 1].real
    size = walk.real**2 + walk.imag**2
    total = np.cumsum(size, axis=-1)
    first = total[..., n - n_cut - 1, None]
    shifted = total[..., n - n_cut :] - total[..., :n_cut]
    return np.asarray((first + shifted - 2.0 * cross) / (n - n_cut))


# ---- Kaplan-Yorke dimension --------------------------------------------------------------------


def kaplan_yorke_dimension(
    ds: xr.Dataset, *, name: str = "lyapunov", dim: str = "exponent", zero: float = 0.0
) -> xr.Dataset:
    """Kaplan-Yorke dimension from Lyapunov spectra.

    With the exponents in falling order and j the largest number whose sum S_j is not negative,
    ``D = j + S_j/|l_(j+1)|``: conjectured to be the information dimension of the attractor (Kaplan and
    Yorke, Lect. Notes Math. 730, 204, 1979; Frederickson, Kaplan, Yorke and Yorke, J. Differ. Equ. 49,
    185, 1983). 0 if all exponents are negative; their number n if their sum is not negative.

    Parameters
    ----------
    ds
        Has `name` on `dim`, in any order and unit: exponents of the section, without the zero along
        the flow. If there are fewer than the dim `state` has entries, the spectrum is known in part. If
        it has their errors ``<name>_stderr`` and the flags ``<name>_flag`` of a cube, they are used.
    name, dim
        Of the exponents.
    zero
        Exponents of at most this modulus count as 0. The dimension jumps from 0 to 1 where the largest
        exponent changes its sign: on a quasi-periodic motion it is 0 but for an error.

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
    n = rates.shape[-1]
    sums = np.cumsum(rates, axis=-1)
    # sums rise and then fall, and start at 0: those before the first negative one are not
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
    unknown = np.isnan(rates).any(axis=-1) | ((j == n) & (n < ds.sizes.get("state", n)))
    dims = exponents.dims[:-1]
    if f"{name}_flag" in ds:
        unknown |= ds[f"{name}_flag"].transpose(*dims).values != LyapunovFlag.GOOD
    variables: dict[str, Any] = {}
    for key, values, text in (
        ("kaplan_yorke_dimension", dimension, "Kaplan-Yorke dimension of the section"),
        ("kaplan_yorke_dimension_stderr", error, "standard error of the Kaplan-Yorke dimension"),
    ):
        variables[key] = (dims, np.where(unknown, np.nan, values), {"units": "1", "long_name": text})
    references = "Kaplan and Yorke, Lect. Notes Math. 730, 204 (1979)"
    return _with_coords(ds, dims, variables).assign_attrs(zero=zero, references=references)


# ---- correlation dimension ---------------------------------------------------------------------

PER_OCTAVE = 4
"""Radii per factor of two."""
N_OCTAVES = 20
"""Radii reach from the largest distance down by this many factors of two."""
MOST_PAIRS = 0.05
"""Share of the pairs closer than the radius at which the fit ends."""
LEAST_OCTAVES = 2
"""Shortest range that is fitted."""
LEAST_NEIGHBOURS = 10
"""Points around a point, on average, where the fit begins."""
N_PARTS = 10
"""Parts of the points that the standard error comes from."""


def correlation_dimension(
    ds: xr.Dataset,
    *,
    pool: Sequence[str] = (),
    theiler: int = 1,
    n_max: int = 10_000,
    floor: float = FLOOR,
    geometry: Geometry = PENDULUM,
) -> xr.Dataset:
    """Correlation dimension of the sections of each cell, with the curve and the range of the fit.

    The correlation sum C(r) is the share of the pairs of points closer than r; the dimension is the
    slope of log C against log r (Grassberger and Procaccia, Phys. Rev. Lett. 50, 346 and Physica D 9,
    189, 1983). Pairs at most `theiler` sections apart in time are left out (Theiler, Phys. Rev. A 34,
    2427, 1986). Distances are the largest scaled difference of a component, angles on their circle.

    The range of the fit is a rule, not a choice: from the least radius within which a point has ten
    others on average, at least `floor`, to that within which lies a twentieth of all pairs. Above it the
    edge of the set bends the curve; below it so do the few returns of a quasi-periodic motion. If this
    is less than two octaves there is no fit: N points do for a dimension of ``log2(N/200)/2`` or less.
    The slope is that of the straight line of least squares through the radii in the range, four per
    octave.

    Parameters
    ----------
    ds
        Cube with `section` (and `status`).
    pool
        Dims whose cells are taken together, as points of one set: cells on the same attractor. That
        they are is not validated. Cells that were not computed are left out.
    theiler
        Theiler window [sections]; 0 leaves out a point's pair with itself alone. Larger where
        sections follow each other closely.
    n_max
        Most points of a set. The last sections of each cell are used, of evenly chosen cells if
        there are more cells than points. Time grows with its square at the largest radii, memory in
        proportion.
    floor
        Scaled distance that is not resolved. A set no larger is a point.
    geometry
        Of the states; by default the pendulum's.

    Returns
    -------
    Dataset
        On the dims of the cells that are not pooled: `correlation_dimension`;
        `correlation_dimension_stderr`, its sampling error, by the jackknife: slopes without each tenth of
        the points (of successive sections, or of cells, where some are pooled);
        `correlation_dimension_spread`, the slope of the lower half of the range minus that of the upper
        half: where it is not small against the range of answers that matter, the curve is not straight
        and its slope no dimension; `fit_low`, `fit_high`, the radii of the range; `n_points`;
        `largest_resolved`, ``2 log N/log(extent/fit_low)``, the bound of Eckmann and Ruelle (Physica D
        56, 185, 1992): a result near it says only that the points are too few. And, with `radius`:
        `log_radius` and `log_correlation_sum`, natural logarithms, NaN where no pair is closer. The
        dimension is 0 where a twentieth of the pairs lies within `floor` (closed orbits), NaN where there
        is no range.

    Raises
    ------
    ValueError
        If a dim to pool is none of the cells', or an option is out of bounds.

    Notes
    -----
    Sets of points wave about their straight line (that of the Henon map by 0.07 in the local slope), so
    that two digits are what a fit over some octaves gives. A rotation close to a resonance fills its
    curve slowly, and has a dimension between 0 and 1 until it has.
    """
    section = _computed(ds, geometry)
    cells = [d for d in section.dims if d not in ("period_index", "state")]
    if missing := [d for d in pool if d not in cells]:
        raise ValueError(f"pool {missing} are not dims of the cells, {cells}: name some of those")
    _at_least("theiler", theiler, 0)
    _at_least("n_max", n_max, 100)
    if not floor > 0.0:
        raise ValueError(f"floor is {floor}, not above 0: give the distance that is not resolved")
    kept = [d for d in cells if d not in pool]
    ordered = section.transpose(*kept, *pool, "period_index", "state")
    shape = tuple(section.sizes[d] for d in kept)
    found = {}
    for index in np.ndindex(*shape):
        values = ordered[index].values
        values = values.reshape(-1, *values.shape[-2:])
        known = values[np.isfinite(values).all(axis=(1, 2))]
        found[index] = _dimension_of(_sample(known, n_max), theiler, floor, geometry)
    return _curves(ds, kept, shape, found).assign_attrs(
        pool=" ".join(map(str, pool)), theiler=theiler, floor=floor, n_max=n_max,
        references="Grassberger and Procaccia, Physica D 9, 189 (1983); Theiler, Phys. Rev. A 34 (1986)",
    )  # fmt: skip


@dataclass(frozen=True)
class _Curve:
    """Correlation sum of one set, and what was read from it."""

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
    """At most `n_max` points: the last sections of each cell, of evenly chosen cells."""
    m = len(section)
    if m > n_max:
        section = section[np.linspace(0, m - 1, n_max).round().astype(int)]
    return section[:, -max(1, n_max // max(m, 1)) :]


def _dimension_of(section: Floats, theiler: int, floor: float, geometry: Geometry) -> _Curve:
    """Correlation dimension of the points of some cells, shape (cell, n, state)."""
    n_radii = N_OCTAVES * PER_OCTAVE + 1
    nothing = _Curve(np.full(n_radii, np.nan), np.full(n_radii, np.nan))
    n_points = section.shape[0] * section.shape[1]
    if n_points < N_PARTS:
        return nothing
    points = section.reshape(n_points, -1)
    extent = _extent(points, geometry)
    if extent <= floor:
        return _Curve(nothing.log_radius, nothing.log_sum, n_points, 0.0, 0.0, 0.0)
    radii = extent * 2.0 ** (-np.arange(n_radii)[::-1] / PER_OCTAVE)
    pairs = _Pairs.of(section, radii, theiler, geometry)
    x, y = np.log(radii), _logarithm(pairs.all / pairs.total)
    share = pairs.all / pairs.total
    if share[np.searchsorted(radii, floor)] > MOST_PAIRS:
        return _Curve(x, y, n_points, 0.0, 0.0, 0.0)
    enough = pairs.all >= LEAST_NEIGHBOURS * n_points
    fit = np.flatnonzero(enough & (radii >= floor) & (share <= MOST_PAIRS))
    if len(fit) < LEAST_OCTAVES * PER_OCTAVE + 1:
        return _Curve(x, y, n_points)
    middle = len(fit) // 2
    spread = _slope(x, y, fit[: middle + 1]) - _slope(x, y, fit[middle:])
    without = [_slope(x, _logarithm(pairs.without(i)), fit) for i in range(N_PARTS)]
    stderr = np.sqrt((N_PARTS - 1) * np.var(without))
    largest = 2.0 * np.log(n_points) / np.log(extent / radii[fit[0]])
    ends = float(radii[fit[0]]), float(radii[fit[-1]])
    return _Curve(x, y, n_points, _slope(x, y, fit), float(stderr), spread, *ends, float(largest))


def _extent(points: Floats, geometry: Geometry) -> float:
    """Largest distance of a component, at most half of its circle."""
    extent = 0.0
    for i, length in enumerate(geometry.circumference):
        x = geometry.scaled(points)[:, i]
        if length > 0.0:
            # the arc that holds all points ends where the widest gap begins
            x = np.sort(x)
            gap = np.diff(x, append=x[0] + length).max()
            extent = max(extent, min(length - gap, 0.5 * length))
        else:
            extent = max(extent, float(np.ptp(x)))
    return float(extent)


@dataclass(frozen=True)
class _Pairs:
    """Ordered pairs of points closer than each radius, those close in time left out.

    Attributes
    ----------
    by_part : ndarray of int64, (part, radius)
        With their first point in the part.
    within : ndarray of int64, (part, radius)
        With both.
    total : int
        Pairs at any distance.
    """

    by_part: npt.NDArray[np.int64]
    within: npt.NDArray[np.int64]
    total: int

    @classmethod
    def of(cls, section: Floats, radii: Floats, theiler: int, geometry: Geometry) -> _Pairs:
        """Pairs among the points of some cells, shape (cell, n, state)."""
        m, n, _ = section.shape
        points = section.reshape(m * n, -1)
        everything = geometry.tree(points)
        number = np.arange(m * n) * N_PARTS // (m * n)
        by_part, within = (np.empty((N_PARTS, len(radii)), np.int64) for _ in range(2))
        for i in range(N_PARTS):
            own = geometry.tree(points[number == i])
            # a point is not its own neighbour
            by_part[i] = own.count_neighbors(everything, radii, p=np.inf) - own.n
            within[i] = own.count_neighbors(own, radii, p=np.inf) - own.n
        part, total = number.reshape(m, n), m * n * (m * n - 1)
        for lag in range(1, min(theiler, n - 1) + 1):
            near = geometry.distance(section[:, lag:], section[:, :-lag])
            total -= 2 * near.size
            for first, second in ((part[:, lag:], part[:, :-lag]), (part[:, :-lag], part[:, lag:])):
                for i in range(N_PARTS):
                    by_part[i] -= np.searchsorted(np.sort(near[first == i]), radii, side="right")
                    both = (first == i) & (second == i)
                    within[i] -= np.searchsorted(np.sort(near[both]), radii, side="right")
        return cls(by_part, within, total)

    @property
    def all(self) -> npt.NDArray[np.int64]:
        """Of all points."""
        return np.asarray(self.by_part.sum(axis=0))

    def without(self, part: int) -> npt.NDArray[np.int64]:
        """Of the points that are not in a part."""
        return np.asarray(self.all - 2 * self.by_part[part] + self.within[part])


def _logarithm(values: npt.NDArray[Any]) -> Floats:
    return np.asarray(np.log(values, out=np.full(values.shape, np.nan), where=np.asarray(values > 0)))


def _slope(x: Floats, y: Floats, rows: npt.NDArray[np.int64]) -> float:
    """Slope of the straight line of least squares through some rows, those without a pair left out."""
    rows = rows[np.isfinite(y[rows])]
    x, y = x[rows] - x[rows].mean(), y[rows] - y[rows[0]]  # a flat curve has the slope 0 exactly
    return float((x * y).sum() / (x * x).sum())


_CURVE = {
    "correlation_dimension": ("dimension", "correlation dimension of the section"),
    "correlation_dimension_stderr": ("stderr", "sampling error of the correlation dimension"),
    "correlation_dimension_spread": ("spread", "slope of the lower half of the range minus the upper"),
    "fit_low": ("fit_low", "least radius of the fit, scaled"),
    "fit_high": ("fit_high", "largest radius of the fit, scaled"),
    "n_points": ("n_points", "points of the set"),
    "largest_resolved": ("largest_resolved", "largest dimension that so many points can show"),
    "log_radius": ("log_radius", "natural logarithm of the scaled radius"),
    "log_correlation_sum": ("log_sum", "natural logarithm of the correlation sum"),
}  # fmt: skip


def _curves(
    ds: xr.Dataset, dims: Sequence[object], shape: tuple[int, ...], found: dict[tuple[int, ...], _Curve]
) -> xr.Dataset:
    variables: dict[str, Any] = {}
    for name, (field, text) in _CURVE.items():
        rows = np.array([getattr(found[index], field) for index in np.ndindex(*shape)])
        own = ("radius",) if rows.ndim > 1 else ()
        about = {"units": "1", "long_name": text}
        variables[name] = ((*dims, *own), rows.reshape((*shape, *rows.shape[1:])), about)
    return _with_coords(ds, dims, variables)
