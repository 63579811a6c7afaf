"""Compute indicators of chaos: Lyapunov exponents, Kaplan-Yorke dimension and the 0-1 test.

    ds = pipeline.open_run(directory)
    cells = chaotic_cells(ds)               # cell by cell; integrates nothing
    found = chaos(ds, attractors)           # and per attractor, see `per_attractor`

A mean over cells describes an attractor only if all these cells are on it. So means are taken per attractor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.dimensions import kaplan_yorke_dimension
from pipeline.analysis.chaos.lyapunov import Motion, is_closed, motion_attrs, summarise
from pipeline.analysis.chaos.per_attractor import chaos_per_attractor
from pipeline.analysis.chaos.zero_one import SHORTEST, zero_one_test
from pipeline.products.chaos import ChaosOptions


def chaos(ds: xr.Dataset, attractors: xr.Dataset, options: ChaosOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the indicators of chaos for each cell (trajectory) and for each attractor.

    Parameters
    ----------
    ds
        Cube with `section` and `status`, and optionally the variables of the product `lyapunov`.
    attractors
        Result of `identify` or `match` for the cube.
    options
        By default the defaults of `ChaosOptions`.
    changes
        Fields of `ChaosOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        In memory: the variables of `chaotic_cells`, the cells' `attractor_id`, and those of
        `pipeline.analysis.chaos.per_attractor`.

    Raises
    ------
    ValueError
        If an option is out of bounds, the cube has neither exponents nor enough sections and orbits are not
        polished, or `attractors` belong to another cube.
    """
    options = options or ChaosOptions(**changes)
    if attractors["attractor_id"].sizes != ds["status"].sizes:
        raise ValueError("attractors and ds have other cells; give what identify made of this cube.")
    if len(missing := reasons(ds, options.stride)) == 2 and not attractors.attrs.get("identify_polish", 1):
        raise ValueError("nothing to compute. " + ". ".join(missing))
    cells = chaotic_cells(ds, options)
    cells["attractor_id"] = attractors["attractor_id"].transpose(*cells["motion"].dims)
    found = chaos_per_attractor(ds, cells, attractors, options)
    return found.assign_attrs(cells.attrs)


def chaotic_cells(ds: xr.Dataset, options: ChaosOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the indicators of chaos for each cell (trajectory): Lyapunov exponents, dimension, 0-1 test.

    Parameters
    ----------
    ds, options, changes
        Cube and options, see `chaos`.

    Returns
    -------
    Dataset
        In memory, on the dims of the cells: `status`, `motion`, `contradicts`, `is_transient` and, as far as
        the cube allows,

        ``lyapunov``, ``lyapunov_stderr`` (exponent) [1/s], ``lyapunov_per_period``,
        ``lyapunov_per_period_stderr`` (exponent) [1], ``lyapunov_flag``, ``drift`` [1/s], ``drift_sigma``,
        ``audit`` [1/s]
            As in the cube and in `summarise`.
        ``kaplan_yorke_dimension``, ``kaplan_yorke_dimension_stderr``
            Dimension of the section and its standard error, see `kaplan_yorke_dimension`.
        ``zero_one``, ``zero_one_stderr``, ``zero_one_half``, ``zero_one_low``, ``zero_one_high``,
        ``oversampling``
            See `zero_one_test`.

        The attribute ``not_computed`` has a line for each indicator that the cube does not allow.

    Raises
    ------
    ValueError
        If an option is out of bounds.
    """
    options = options or ChaosOptions(**changes)
    missing = reasons(ds, options.stride)
    cells = _of_exponents(ds, options) if "lyapunov" in ds else _without_exponents(ds)
    if not any(reason.startswith("0-1") for reason in missing):
        found = zero_one_test(ds, n_frequencies=options.n_frequencies, stride=options.stride, seed=options.seed)
        cells = cells.assign(found.data_vars)
    cells = cells.assign(status=ds["status"]).drop_attrs(deep=False).load()
    coords = {name: c for name, c in ds.coords.items() if set(c.dims) <= set(cells["motion"].dims)}
    return cells.assign_coords(coords).assign_attrs(
        ds.attrs, chaos_n_sigma=options.n_sigma, chaos_least=options.least, not_computed="\n".join(missing)
    )


def reasons(ds: xr.Dataset, stride: int = 1) -> list[str]:
    """Return the reasons why Lyapunov exponents or the 0-1 test cannot be computed from a result cube, one sentence
    each.
    """
    found = []
    if "lyapunov" not in ds:
        found.append(
            "Lyapunov exponents of what does not close: the cube has none; run it with [products] "
            "lyapunov = {} in its specification"
        )
    n = -(-ds.sizes["period_index"] // stride)
    if n < SHORTEST:
        every = f" at every {stride}th period" if stride > 1 else ""
        found.append(f"0-1 test: {n} sections{every}, and it needs {SHORTEST}; raise n_keep")
    return found


def _of_exponents(ds: xr.Dataset, options: ChaosOptions) -> xr.Dataset:
    summary = summarise(ds, n_sigma=options.n_sigma, least=options.least).drop_vars("lyapunov_running")
    own = ds[["lyapunov", "lyapunov_stderr", "lyapunov_flag"]]
    dimension = kaplan_yorke_dimension(ds, flow="return_time" in ds)
    return own.assign(summary.data_vars).assign(dimension.data_vars)


def _without_exponents(ds: xr.Dataset) -> xr.Dataset:
    closed = is_closed(ds)
    motion = xr.full_like(closed, Motion.UNKNOWN, dtype=np.int8)
    motion = motion.where(~closed, np.int8(Motion.REGULAR)).assign_attrs(motion_attrs())
    return xr.Dataset(
        {
            "motion": motion,
            "contradicts": xr.zeros_like(motion, np.int8).drop_attrs(),
            "is_transient": xr.full_like(motion, -1).drop_attrs(),
        }
    )
