"""What stored Lyapunov exponents say: per period, how sure, chaos or not, and whether it lasts.

Works on the variables of ``[products] lyapunov``; integrates nothing.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import xarray as xr

_PERIODIC = 1  # of magpend_core.status, which would bring the compiler with it

GOOD = 1
"""Value of `lyapunov_flag` without objection (see `pipeline.schema.LyapunovFlag`)."""

UNRESOLVED, FAILED = 3, 4


class Motion(IntEnum):
    """What the exponents of a cell say of its motion."""

    UNKNOWN = 0
    REGULAR = 1
    UNDECIDED = 2
    CHAOTIC = 3
    HYPERCHAOTIC = 4


def summarise(ds: xr.Dataset, *, n_sigma: float = 3.0, least: float = 0.005) -> xr.Dataset:
    """Return what the exponents of a cube say, cell by cell.

    Parameters
    ----------
    ds
        Cube with `lyapunov`, `lyapunov_stderr`, `lyapunov_blocks`, `divergence`, `lyapunov_flag`, and
        the coordinate `frequency` [Hz].
    n_sigma
        Standard errors by which an exponent must differ from 0 to count as positive or negative.
    least
        Least modulus [1/s] that counts as different from 0; a slow bifurcation is below it.

    Returns
    -------
    Dataset
        With the cell dims of the cube:

        ``lyapunov_per_period`` (exponent), ``lyapunov_per_period_stderr`` (exponent)
            Exponents per drive period, lambda/f [1].
        ``lyapunov_running`` (block, exponent)
            Mean over the blocks up to this one [1/s]: the convergence history.
        ``motion``
            Codes of `Motion`: chaotic if the largest exponent is positive, hyperchaotic if the second
            is too, regular if the largest is negative (or the orbit closed), undecided in between. A
            continuous quasi-periodic motion, whose largest exponent of the section map is 0, is undecided.
        ``drift``
            Largest exponent of the later half of the blocks minus that of the earlier [1/s], and
            ``drift_sigma``, the same in standard errors: a transient that ends within the blocks shows as a
            large negative value, chaos that lasts stays within a few.
        ``audit``
            Sum of a whole spectrum minus the divergence [1/s]; NaN for a part.

    Raises
    ------
    ValueError
        If the cube has no exponents.
    """
    if "lyapunov" not in ds:
        raise ValueError(
            "the cube has no Lyapunov exponents; run it with [products] lyapunov = {} in its specification"
        )
    rate, error = ds["lyapunov"], ds["lyapunov_stderr"]
    frequency = ds["frequency"] if "frequency" in ds.coords else xr.DataArray(float(ds.attrs["frequency_hz"]))
    result = xr.Dataset(
        {
            "lyapunov_per_period": (rate / frequency).transpose(*rate.dims),
            "lyapunov_per_period_stderr": (error / frequency).transpose(*rate.dims),
            "lyapunov_running": _running(ds["lyapunov_blocks"]),
            "motion": _motion(ds, n_sigma, least),
            **_drift(ds["lyapunov_blocks"]),
            "audit": _audit(ds),
        }
    )
    return result.assign_attrs(ds.attrs)


def _running(blocks: xr.DataArray) -> xr.DataArray:
    count = xr.DataArray(np.arange(1, blocks.sizes["block"] + 1), dims="block")
    mean = (blocks.cumsum("block") / count).transpose(*blocks.dims)
    return mean.assign_attrs(units="1/s", long_name="mean growth rate up to this block")


def _motion(ds: xr.Dataset, n_sigma: float, least: float) -> xr.DataArray:
    margin = np.maximum(n_sigma * ds["lyapunov_stderr"], least)
    rate = ds["lyapunov"]
    sign = (rate > margin).astype(np.int8) - (rate < -margin).astype(np.int8)
    first = sign.isel(exponent=0, drop=True)
    motion = xr.full_like(ds["lyapunov_flag"], Motion.UNDECIDED)
    closed = (ds["status"] == _PERIODIC) | (ds["orbit_period"] > 0)
    motion = motion.where(~((first < 0) | closed), np.int8(Motion.REGULAR))
    motion = motion.where(~((first > 0) & ~closed), np.int8(Motion.CHAOTIC))
    if ds.sizes["exponent"] > 1:
        second = sign.isel(exponent=1, drop=True)
        resolved = ds["lyapunov_flag"] != UNRESOLVED
        hyper = (first > 0) & (second > 0) & resolved & ~closed
        motion = motion.where(~hyper, np.int8(Motion.HYPERCHAOTIC))
    known = (ds["lyapunov_flag"] >= GOOD) & (ds["lyapunov_flag"] != FAILED)
    motion = motion.where(known, np.int8(Motion.UNKNOWN))
    return motion.assign_attrs(
        units="1",
        long_name="kind of motion by its exponents",
        flag_values=np.array(list(Motion), np.int8),
        flag_meanings=" ".join(m.name.lower() for m in Motion),
    )


def _drift(blocks: xr.DataArray) -> dict[str, xr.DataArray]:
    first = blocks.isel(exponent=0, drop=True)
    half = first.sizes["block"] // 2
    early, late = first.isel(block=slice(half)), first.isel(block=slice(-half, None))
    drift = late.mean("block") - early.mean("block")
    drift = drift.assign_attrs(units="1/s", long_name="largest exponent, later minus earlier half")
    if half < 2:
        return {"drift": drift, "drift_sigma": xr.full_like(drift, np.nan)}
    error = np.sqrt((late.var("block", ddof=1) + early.var("block", ddof=1)) / half)
    sigma = (drift / error).assign_attrs(units="1", long_name="drift in standard errors")
    return {"drift": drift, "drift_sigma": sigma}


def _audit(ds: xr.Dataset) -> xr.DataArray:
    total = ds["lyapunov_blocks"].mean("block").sum("exponent", skipna=False) - ds["divergence"]
    if ds.sizes["exponent"] < ds.sizes["state"]:
        total = xr.full_like(total, np.nan)
    return total.assign_attrs(units="1/s", long_name="sum of the exponents minus the divergence")
