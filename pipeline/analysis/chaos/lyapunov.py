"""Interpret the Lyapunov exponents of a run: class of motion, errors, chaotic transients, means over cells.

The functions read the variables of ``[products] lyapunov`` and integrate nothing. `spectrum_of_jacobians`
computes the exponents of any map from its Jacobians.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import hertz_of
from pipeline.layout.vocabulary import PERIODIC, model_of
from pipeline.products.lyapunov import LyapunovFlag

Floats = npt.NDArray[np.float64]

GOOD, UNRESOLVED, FAILED = LyapunovFlag.GOOD, LyapunovFlag.UNRESOLVED, LyapunovFlag.FAILED


class CellMotion(IntEnum):
    """Classes of a cell's motion, decided by its Lyapunov exponents."""

    UNKNOWN = 0
    REGULAR = 1
    UNDECIDED = 2
    CHAOTIC = 3
    HYPERCHAOTIC = 4


def check_exponents(ds: xr.Dataset) -> None:
    """Raise ValueError if a cube has no Lyapunov exponents."""
    if "lyapunov" not in ds:
        raise ValueError(
            "the cube has no Lyapunov exponents; run it with [products] lyapunov = {} in its specification"
        )


def summarise(ds: xr.Dataset, *, n_sigma: float = 3.0, least: float = 0.005) -> xr.Dataset:
    """Classify the motion of each cell by its Lyapunov exponents, and check the exponents for drift and consistency.

    Parameters
    ----------
    ds
        Cube with `lyapunov`, `lyapunov_stderr`, `lyapunov_blocks`, `divergence`, `lyapunov_flag`, and
        the coordinate `frequency` [Hz] or `return_time` [s].
    n_sigma
        Standard errors by which an exponent must differ from 0 to count as positive or negative.
    least
        Least modulus [1/s] that counts as different from 0; a slow bifurcation is below it.

    Returns
    -------
    Dataset
        Variables on the cell dims of the cube:

        ``lyapunov_per_period`` (exponent), ``lyapunov_per_period_stderr`` (exponent)
            Exponents per drive period, or per return in the mean [1].
        ``lyapunov_running`` (block, exponent)
            Mean over the blocks so far [1/s]: the convergence history.
        ``motion``
            Codes of `Motion`: chaotic if the largest exponent is positive, hyperchaotic if the second
            is too, regular if the largest is negative (or the orbit closed), undecided in between. A
            continuous quasi-periodic motion, whose largest exponent of the section map is 0, is undecided,
            and so is a cell that closed and yet has a positive exponent.
        ``contradicts``
            1 for a closed cell with a positive exponent: its sections closed within the run's tolerance, on
            an unstable orbit or by chance, and nearby trajectories leave it. Otherwise 0.
        ``is_transient``
            See `transients`.
        ``drift``
            Largest exponent of the later half of the blocks minus that of the earlier half [1/s], and
            ``drift_sigma``, the same in standard errors: large and negative for a transient that ends within
            the blocks, a few standard errors for lasting chaos.
        ``audit``
            Sum of a whole spectrum minus the divergence [1/s]; NaN for a part.

    Raises
    ------
    ValueError
        If the cube has no exponents.
    """
    check_exponents(ds)
    rate, error = ds["lyapunov"], ds["lyapunov_stderr"]
    seconds = period_seconds(ds)
    result = xr.Dataset(
        {
            "lyapunov_per_period": (rate * seconds).transpose(*rate.dims),
            "lyapunov_per_period_stderr": (error * seconds).transpose(*rate.dims),
            "lyapunov_running": _running(ds["lyapunov_blocks"]),
            **_motion(ds, n_sigma, least),
            "is_transient": transients(ds, n_sigma=n_sigma, least=least),
            **_drift(ds["lyapunov_blocks"]),
            "audit": _audit(ds),
        }
    )
    return result.assign_attrs(ds.attrs)


def period_seconds(ds: xr.Dataset) -> xr.DataArray:
    """Return the time between successive section points [s]: the drive period, each cell's mean return time, or 1 of
    a map.
    """
    if "return_time" in ds:
        return ds["return_time"].mean("period_index")
    frequency = hertz_of(ds)
    if frequency is None:
        frequency = xr.DataArray(float(model_of(ds).clock.hertz or ds.attrs["frequency_hz"]))
    return 1.0 / frequency


def rate_scale(ds: xr.Dataset, per: str) -> tuple[xr.DataArray, dict[str, str]]:
    """Return the factor to rates per ``s`` or ``period``, and the attributes of these; of a map per iteration."""
    clock = model_of(ds).clock
    if per == "s" and clock.is_continuous:
        return xr.DataArray(1.0), {"units": "1/s", "per": "unit time"}
    return period_seconds(ds), {"units": "1", "per": clock.period}


def _running(blocks: xr.DataArray) -> xr.DataArray:
    count = xr.DataArray(np.arange(1, blocks.sizes["block"] + 1), dims="block")
    mean = (blocks.cumsum("block") / count).transpose(*blocks.dims)
    return mean.assign_attrs(units="1/s", long_name="mean growth rate up to this block")


def is_closed(ds: xr.Dataset) -> xr.DataArray:
    """Return for each cell whether it is on a periodic orbit."""
    return (ds["status"] == PERIODIC) | (ds["orbit_period"] > 0)


def _motion(ds: xr.Dataset, n_sigma: float, least: float) -> dict[str, xr.DataArray]:
    margin = np.maximum(n_sigma * ds["lyapunov_stderr"], least)
    rate = ds["lyapunov"]
    sign = (rate > margin).astype(np.int8) - (rate < -margin).astype(np.int8)
    first = sign.isel(exponent=0, drop=True)
    closed = is_closed(ds)
    known = (ds["lyapunov_flag"] >= GOOD) & (ds["lyapunov_flag"] != FAILED)
    motion = xr.full_like(ds["lyapunov_flag"], CellMotion.UNDECIDED)
    motion = motion.where(~((first < 0) | (closed & (first <= 0))), np.int8(CellMotion.REGULAR))
    motion = motion.where(~((first > 0) & ~closed), np.int8(CellMotion.CHAOTIC))
    if ds.sizes["exponent"] > 1:
        second = sign.isel(exponent=1, drop=True)
        resolved = ds["lyapunov_flag"] != LyapunovFlag.UNRESOLVED
        hyper = (first > 0) & (second > 0) & resolved & ~closed
        motion = motion.where(~hyper, np.int8(CellMotion.HYPERCHAOTIC))
    motion = motion.where(known, np.int8(CellMotion.UNKNOWN))
    contradicts = (known & closed & (first > 0)).astype(np.int8)
    return {
        "motion": motion.assign_attrs(motion_attrs()),
        "contradicts": contradicts.assign_attrs(code_flags(["no", "yes"])),
    }


def motion_attrs() -> dict[str, Any]:
    """Return the xarray attributes of an array of `Motion` codes: unit, name, flag values and meanings."""
    return {
        "units": "1",
        "long_name": "kind of motion by its exponents",
        **code_flags([motion.name.lower() for motion in CellMotion]),
    }


def transients(ds: xr.Dataset, *, n_sigma: float, least: float) -> xr.DataArray:
    """Mark the cells whose chaos ended while their exponents were averaged: 1 yes, 0 no, -1 unknown.

    Returns
    -------
    DataArray of int8
        1 if the mean of the largest exponent is above `least` over the first quarter of the blocks, below
        ``-least`` over the last, and the two differ by `n_sigma` standard errors. 0 if not, or if the chaos
        ended in the last quarter or early in the first; -1 if unknown (fewer than 12 blocks, or no
        exponents).
    """
    fewest = 12  # blocks for detecting a transient: three in each quarter, so that quarters have errors
    known = (ds["lyapunov_flag"] >= GOOD) & (ds["lyapunov_flag"] != FAILED)
    attrs = {"flag_values": np.arange(-1, 2, dtype=np.int8), "flag_meanings": "unknown no yes"}
    if ds.sizes.get("block", 0) < fewest:
        return xr.full_like(known, -1, dtype=np.int8).assign_attrs(attrs)
    first, quarter = ds["lyapunov_blocks"].isel(exponent=0, drop=True), ds.sizes["block"] // 4
    early, late = first.isel(block=slice(quarter)), first.isel(block=slice(-quarter, None))
    before, after = early.mean("block"), late.mean("block")
    error = np.sqrt((early.var("block", ddof=1) + late.var("block", ddof=1)) / quarter)
    # the largest exponent of an orbit of a flow is 0, along the flow
    floor = least if "return_time" in ds else -least
    # use the common error: blocks of an orbit with complex multipliers oscillate widely
    ended = (before > least) & (after < floor) & (before - after > n_sigma * error)
    return ended.astype(np.int8).where(known, np.int8(-1)).assign_attrs(attrs)


def on_attractor(ds: xr.Dataset, *, n_sigma: float, least: float) -> xr.DataArray:
    """Return for each cell whether its largest Lyapunov exponent is that of its final motion, not of a chaotic
    transient.

    Their flag is good, or only the first exponent is resolved, and they are no transients.
    """
    resolved = ds["lyapunov_flag"].isin((GOOD, UNRESOLVED))
    return resolved & (transients(ds, n_sigma=n_sigma, least=least) != 1)


def _drift(blocks: xr.DataArray) -> dict[str, xr.DataArray]:
    first = blocks.isel(exponent=0, drop=True)
    half = first.sizes["block"] // 2
    early, late = first.isel(block=slice(half)), first.isel(block=slice(-half, None))
    drift = late.mean("block") - early.mean("block")
    if half < 2:
        return {"drift": drift, "drift_sigma": xr.full_like(drift, np.nan)}
    error = np.sqrt((late.var("block", ddof=1) + early.var("block", ddof=1)) / half)
    return {"drift": drift, "drift_sigma": drift / error}


def _audit(ds: xr.Dataset) -> xr.DataArray:
    # returns differ in length, and so do blocks
    means = ds["lyapunov"] if "return_time" in ds else ds["lyapunov_blocks"].mean("block")
    total = means.sum("exponent", skipna=False) - ds["divergence"]
    if ds.sizes["exponent"] < ds.sizes["state"]:
        total = xr.full_like(total, np.nan)
    return total


# ---- means over cells --------------------------------------------------------------------------


def pooled_mean(value: Floats, stderr: Floats, which: npt.NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Compute the mean over cells, its standard error, and how much the cells scatter beyond their own errors.

    The variance S**2 of m cells includes the squared errors s_i**2 of the cells. Let T**2 be S**2 -
    mean(s_i**2), or 0 if that is negative. The variance of the mean is ``(T**2 + mean(s_i**2))/m`` (Hedges
    and Olkin, Statistical Methods for Meta-Analysis, 1985, ch. 9). It follows the errors of the cells while
    they agree, and their scatter if that is larger. A single cell has its own error.

    Parameters
    ----------
    value, stderr
        Values and standard errors, cells on the last axis; values that are not finite are left out.
    which
        Mask of the cells that count, of the same shape or one that broadcasts.

    Returns
    -------
    tuple of ndarray
        Mean, standard error and standard deviation, without the last axis; NaN where no cell counts.
    """
    there = which & np.isfinite(value)
    m = there.sum(-1)
    mean = _over(np.where(there, value, 0.0).sum(-1), m)
    apart = np.where(there, value - np.expand_dims(mean, -1), 0.0)
    scatter = np.where(m > 1, _over((apart**2).sum(-1), m - 1), 0.0)
    within = _over((np.where(there, stderr, 0.0) ** 2).sum(-1), m)
    between = np.maximum(scatter - within, 0.0)
    return mean, np.sqrt(_over(between + within, m)), np.sqrt(between)


def _over(values: Any, counts: Any) -> Floats:
    empty = np.full(np.shape(values), np.nan)
    return np.asarray(np.divide(values, counts, out=empty, where=np.asarray(counts) > 0))


# ---- from Jacobians ----------------------------------------------------------------------------


@dataclass(frozen=True)
class JacobianSpectrum:
    """Lyapunov exponents of a map along its trajectories, per iteration of the map."""

    exponents: Floats  # (..., state): exponents in falling order
    stderr: Floats  # (..., state): standard errors by block means
    blocks: Floats  # (..., block, state): mean growth in each block, in the order of `exponents`


def spectrum_of_jacobians(jacobians: npt.ArrayLike, *, n_blocks: int = 16, n_transient: int = 0) -> JacobianSpectrum:
    """Compute the Lyapunov exponents of a map from its Jacobians along trajectories.

    A basis is carried along by the Jacobians and made orthonormal at each by QR; an exponent is the mean
    logarithm of the diagonal of R (Benettin, Galgani, Giorgilli and Strelcyn, Meccanica 15, 9 and 21,
    1980; Eckmann and Ruelle, Rev. Mod. Phys. 57, 617, 1985, sec. V). Divided by the time of an iterate they
    are exponents of the flow: for the stroboscopic map (`magpend_core.orbits.section_map`), times
    the frequency.

    Parameters
    ----------
    jacobians
        ``J[..., i, :, :]`` is the derivative of the map at point i; shape (..., n, state, state).
    n_blocks
        Blocks of equal length for the errors, 2 or more. They are right if a block is longer than the
        motion remembers.
    n_transient
        Number of first Jacobians that only align the basis and are not counted.

    Returns
    -------
    JacobianSpectrum
        Exponents, errors and blocks; -inf where a Jacobian is singular.

    Raises
    ------
    ValueError
        If the shape is wrong, a Jacobian is not finite, or the counted Jacobians do not fill a whole number
        of blocks.
    """
    given = np.asarray(jacobians, np.float64)
    if given.ndim < 3 or given.shape[-1] != given.shape[-2]:
        raise ValueError(f"jacobians have shape {given.shape}: give (..., n, state, state)")
    if not np.isfinite(given).all():
        raise ValueError("jacobians are not all finite: leave trajectories out that fail")
    if n_blocks < 2 or n_transient < 0:
        raise ValueError(f"n_blocks = {n_blocks}, n_transient = {n_transient}: give 2 or more, and 0 or more")
    n, size = given.shape[-3] - n_transient, given.shape[-1]
    if n < n_blocks or n % n_blocks:
        raise ValueError(
            f"{n} Jacobians after the transient are no whole number of each of {n_blocks} blocks: "
            f"give {max(n // n_blocks, 1) * n_blocks}, or other n_blocks"
        )
    basis = np.broadcast_to(np.eye(size), (*given.shape[:-3], size, size))
    growth = np.empty((*given.shape[:-3], n, size))
    for i in range(given.shape[-3]):
        basis, r = np.linalg.qr(given[..., i, :, :] @ basis)
        if i >= n_transient:
            factor = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
            growth[..., i - n_transient, :] = np.log(factor, out=np.full(factor.shape, -np.inf), where=factor > 0.0)
    blocks = growth.reshape(*growth.shape[:-2], n_blocks, n // n_blocks, size).mean(axis=-2)
    order = np.argsort(-blocks.mean(axis=-2), axis=-1, kind="stable")
    blocks = np.take_along_axis(blocks, order[..., None, :], axis=-1)
    with np.errstate(invalid="ignore"):  # -inf has no error
        stderr = blocks.std(axis=-2, ddof=1) / np.sqrt(n_blocks)
    return JacobianSpectrum(blocks.mean(axis=-2), stderr, blocks)
