"""Names and codes that analyses, tables and figures share. Imports no kernel, so that figures need none."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

GRID_DIMS = ("psi1_0", "psi2_0", "psi1_dot_0", "psi2_dot_0")
"""Dims of a grid of initial states."""

START_DIMS = ("initial_condition", *GRID_DIMS, "branch")
"""Dims of a cube that tell the cells of one parameter point apart."""

ABSENT, CLOSED_ORBIT, BOUNDED_SET = range(3)
"""Values of `kind`, see `pipeline.analysis.attractors.attractors`."""

PENDING, PERIODIC, BOUNDED, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED, INFERRED = range(8)
"""Values of `magpend_core.status.Status`, whose package brings the compiler with it."""

FAILED = (STEP_LIMIT, STEP_UNDERFLOW, UNREACHED)
"""What became of cells that could not be integrated to the end."""


def split_dims(cells: xr.DataArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the parameter dims and the start dims of an array over the cells."""
    dims = [str(dim) for dim in cells.dims]
    return tuple(d for d in dims if d not in START_DIMS), tuple(d for d in dims if d in START_DIMS)
