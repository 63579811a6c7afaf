"""Apply the 0-1 test for chaos to the section points of each cell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import fft

from pipeline.analysis.chaos.section_samples import Floats, at_least, computed, geometry_of, with_coords
from pipeline.products.reporting import report
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import SAME_POINT

STEP_BYTES = 64 * 2**20
"""Most memory of a step of the 0-1 test [bytes]."""

FEWEST_SECTIONS = 200
"""Fewest sections for the 0-1 test: lags reach a tenth of them, and with ten lags period 3 looks chaotic."""


def zero_one_test(
    ds: xr.Dataset,
    *,
    state: str | None = None,
    n_frequencies: int = 100,
    stride: int = 1,
    seed: int = 0,
    geometry: Geometry | None = None,
) -> xr.Dataset:
    """Apply the 0-1 test for chaos to the section points of each cell; the result is near 0 for regular, near 1 for
    chaotic motion.

    An observable of the sections, phi(1), ..., phi(N) without its mean, drives a walk in the plane,
    ``z_c(n) = sum over j <= n of phi(j) exp(i c j)``. The walk stays bounded if the motion is regular, and
    diffuses if it is chaotic. K_c is the correlation of the mean square displacement
    ``D_c(n) = mean over j of |z_c(j + n) - z_c(j)|**2`` with n for n up to N/10, and K its median over
    random c in (pi/5, 4 pi/5) (Gottwald and Melbourne, SIAM J. Appl. Dyn. Syst. 8, 129, 2009, the
    correlation method). They subtract the oscillating term ``mean(phi)**2 (1 - cos n c)/(1 - cos c)`` from
    the displacement; it is 0 for an observable without mean.

    Parameters
    ----------
    ds
        Cube with `section` (and `status`), all sections loaded at once.
    state
        State to observe. For an angle, the observable is the combination of its sine and cosine that varies
        most. By default, the first principal component of all scaled states.
    n_frequencies
        Number of frequencies c, 10 or more.
    stride
        Use every `stride`-th section, against oversampling; see the notes.
    seed
        Seed of the frequencies c, which are the same for all cells.
    geometry
        Geometry of the states, by default from the cube's model.

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
    * A signal sampled too often looks regular: K of a flow sampled at short times tends to 0 even for chaos.
      Sections are taken once per drive period, which is coarse unless the drive is fast against the motion.
      `oversampling` above 10 indicates the problem; `stride` is the remedy.
    * Some frequencies c resonate with a regular motion and have K_c = 1. The median ignores them unless
      they are half of all.
    * Sections within 1e-6 of each other count as one point with K = 0: the test would measure the noise
      of the integration. A transient that has not died out counts as part of the motion.
    """
    geometry = geometry_of(ds, geometry)
    section = computed(ds, geometry).isel(period_index=slice(None, None, at_least("stride", stride, 1)))
    n_frequencies = at_least("n_frequencies", n_frequencies, 10)
    n = section.sizes["period_index"]
    if n < FEWEST_SECTIONS:
        raise ValueError(
            f"{n} sections (with stride {stride}) are too few for the 0-1 test, which needs {FEWEST_SECTIONS}: "
            "raise n_keep, to some hundreds if possible"
        )
    cells = [d for d in section.dims if d not in ("period_index", "state")]
    values = section.transpose(*cells, "period_index", "state").values
    shape = values.shape[:-2]
    flat = values.reshape(-1, n, values.shape[-1])
    c = np.random.default_rng(seed).uniform(0.2 * np.pi, 0.8 * np.pi, n_frequencies)
    phi = _observable(flat, None if state is None else _number(ds, state), geometry)
    measures = np.full((6, len(phi)), np.nan)
    step = max(1, STEP_BYTES // (16 * n * n_frequencies))
    for begin in range(0, len(phi), step):
        report("0-1 test", begin, len(phi))
        rows = slice(begin, begin + step)
        measures[:, rows] = _zero_one(phi[rows], c)
    names = ("zero_one", "zero_one_stderr", "zero_one_low", "zero_one_high", "zero_one_half", "oversampling")
    variables = {name: (cells, values.reshape(shape)) for name, values in zip(names, measures, strict=True)}
    about = {"zero_one_state": state or "first principal component", "n_frequencies": n_frequencies}
    return with_coords(ds, cells, variables).assign_attrs(
        about | {"stride": stride, "seed": seed, "n_sections": n, "references": _GOTTWALD}
    )


_GOTTWALD = "Gottwald and Melbourne, SIAM J. Appl. Dyn. Syst. 8, 129 (2009)"


def _number(ds: xr.Dataset, state: str) -> int:
    names = [str(s) for s in ds["state"].values]
    if state not in names:
        raise ValueError(f"state is {state!r}, which is none of {names}: name one of them")
    return names.index(state)


def _observable(section: Floats, state: int | None, geometry: Geometry) -> Floats:
    """Reduce the section points of each cell to the one number per point that the 0-1 test uses, shape (cell, n)."""
    columns = range(section.shape[-1]) if state is None else [state]
    lines = []
    for i in columns:
        x, scale = section[..., i], geometry.scales[i]
        # sine and cosine do not jump where an angle passes pi
        lines += [np.cos(x) / scale, np.sin(x) / scale] if geometry.is_angle[i] else [x / scale]
    points = np.stack(lines, axis=-1)
    points = points - points.mean(axis=1, keepdims=True)
    known = np.isfinite(points).all(axis=(1, 2))
    phi = np.full(section.shape[:2], np.nan)
    covariance = np.einsum("cni,cnj->cij", points[known], points[known])
    phi[known] = np.einsum("cni,ci->cn", points[known], np.linalg.eigh(covariance)[1][..., -1])
    phi[known & (np.abs(points).max(axis=(1, 2)) < SAME_POINT)] = 0.0
    return np.asarray(phi - phi.mean(axis=1, keepdims=True))


def _zero_one(phi: Floats, c: Floats) -> Floats:
    """Compute the measures of the 0-1 test for each cell: K, its error, its quartiles, K of the later half, extent per
    step.
    """
    n = phi.shape[1]
    k = np.sort(_growth(phi, c), axis=1)
    half = np.full(len(phi), np.nan)
    if n // 2 >= FEWEST_SECTIONS:
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
    """Compute the correlation K_c of the 0-1 test for each observable and each test frequency c, shape (cell, c)."""
    n = phi.shape[1]
    n_cut = n // 10
    turns: npt.NDArray[np.complex128] = np.exp(1j * c[:, None] * np.arange(1, n + 1))
    walk = np.cumsum(phi[:, None, :] * turns, axis=-1)
    moved = _displacement(walk, n_cut)
    moved -= moved.mean(axis=-1, keepdims=True)
    lags = np.arange(n_cut) - 0.5 * (n_cut - 1)
    size = np.sqrt((moved**2).sum(axis=-1) * (lags**2).sum())
    empty = np.where(np.isnan(size), np.nan, 0.0)
    return np.asarray(np.divide(moved @ lags, size, out=empty, where=size > 0.0))


def _displacement(walk: npt.NDArray[np.complex128], n_cut: int) -> Floats:
    """Compute the mean square displacement of a walk z in the complex plane, for each lag from 1 to `n_cut`.

    The lags are on the last axis. The expanded square gives sums of squares and a correlation, which is
    computed by Fourier transform.
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
