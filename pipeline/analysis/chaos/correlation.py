"""Compute the correlation dimension of non-periodic attractors, and say why other sets have none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.dimensions import correlation_dimension
from pipeline.analysis.chaos.per_attractor import pooled
from pipeline.analysis.chaos.section_samples import geometry_of
from pipeline.analysis.ragged import N_IDS, ROW_SIZE, SET, dims_of, rows_at
from pipeline.analysis.selection import select_points
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, split_dims
from pipeline.products.chaos import DimensionOptions

REASONS = ("absent", "has_dimension", "closed", "does_not_attract", "too_few_points")
ABSENT, HAS_DIMENSION, CLOSED, NO_ATTRACTOR, TOO_FEW = range(len(REASONS))
"""Values of `reason`."""


def section_dimension(
    ds: xr.Dataset, attractors: xr.Dataset, options: DimensionOptions | None = None, **changes: Any
) -> xr.Dataset:
    """Compute the correlation dimension of each non-periodic attractor from the section points of its cells.

    A cell that is still closing and a chaotic transient fill no set, so the slope of their correlation sum is
    no dimension. Only sets that were shown to attract have a dimension.

    Parameters
    ----------
    ds
        Cube with `section`, `status` and `orbit_period`.
    attractors
        Result of `identify` or `match` for the cube.
    options
        By default the defaults of `DimensionOptions`; `at` selects values of swept parameters.
    changes
        Fields of `DimensionOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        Rows of sets, see `pipeline.analysis.ragged`: the variables of
        `pipeline.analysis.chaos.dimensions.correlation_dimension`; `n_cells`, `share`, `kind`; `reason`, the
        reason why there is no dimension (`REASONS`); `stability`, `n_sampled`, `n_left`, `lifetime_low` of
        `identify`.

    Raises
    ------
    ValueError
        If the cube lacks an axis or a value, an option is out of bounds, or `attractors` belong to another
        cube.
    """
    options = options or DimensionOptions(**changes)
    part = select_points(ds, options.at)
    whole = select_points(attractors, options.at)
    _, starts = split_dims(part["status"])
    found = whole[[ROW_SIZE, "n_cells", "share", "kind", "stability", "n_sampled", "n_left", "lifetime_low"]]
    ids = whole["attractor_id"].transpose(*dims_of(found), *starts).values
    section = part[["section", "status"]].load().assign_attrs(ds.attrs)
    kind, stability = found["kind"].values, found["stability"].values
    stays = np.isin(kind, APERIODIC) & (stability == ATTRACTS)

    def curve(index: tuple[int, ...], own: np.ndarray) -> xr.Dataset:
        point = section.isel(dict(zip(dims_of(found), index, strict=True)))
        return correlation_dimension(
            pooled(point, starts, own),
            pool=["cell"],
            theiler=options.theiler,
            n_max=options.n_max,
            floor=options.floor,
            geometry=geometry_of(ds),
        )

    nothing = curve((0,) * len(dims_of(found)), np.zeros(1, bool))
    curves = [nothing] * found.sizes[SET]
    for index, rows in rows_at(found).items():
        for row in rows:
            if stays[row]:
                curves[row] = curve(index, ids[index].ravel() == found["attractor"].values[row])
    about = {"units": "1", "long_name": "why there is no dimension", **code_flags(REASONS)}
    reason = [
        _reason(*one) for one in zip(kind, stays, (c["correlation_dimension"].item() for c in curves), strict=True)
    ]
    result = found.assign(_stacked(curves, nothing)).assign(reason=(SET, np.array(reason, np.int8), about))
    plain = {f"dimension_{k}": getattr(options, k) for k in ("theiler", "n_max", "floor")}
    return result.drop_attrs(deep=False).assign_attrs({**ds.attrs, **plain, N_IDS: found.attrs[N_IDS]})


def _reason(kind: int, stays: bool, dimension: float) -> int:
    if kind not in APERIODIC:
        return CLOSED
    if not stays:
        return NO_ATTRACTOR
    return HAS_DIMENSION if np.isfinite(dimension) else TOO_FEW


def _stacked(curves: Sequence[xr.Dataset], schema: xr.Dataset) -> dict[str, Any]:
    """Return the variables of some curves on the rows; there may be no row."""
    return {
        str(name): ((SET, *one.dims), np.stack([c[name].values for c in (schema, *curves)])[1:], one.attrs)
        for name, one in schema.data_vars.items()
    }
