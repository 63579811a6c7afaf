"""Compute the correlation dimension of non-periodic attractors, and say why other sets have none."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.dimensions import correlation_dimension
from pipeline.analysis.chaos.per_attractor import pooled
from pipeline.analysis.chaos.section_samples import geometry_of
from pipeline.analysis.ragged import dense
from pipeline.analysis.selection import select_points
from pipeline.layout.attributes import code_flags
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, split_dims
from pipeline.products.chaos import DimensionOptions

REASONS = ("has_dimension", "absent", "closed", "does_not_attract", "too_few_points")
HAS_DIMENSION, ABSENT, CLOSED, NO_ATTRACTOR, TOO_FEW = range(len(REASONS))
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
        On the parameter dims and `attractor` (the attractors present in the selection): the variables of
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
    dims, starts = split_dims(part["status"])
    found = dense(attractors).sel({d: part[d].values for d in dims})
    present = (found["kind"] > 0).any([d for d in found["kind"].dims if d != "attractor"])
    found = found.isel(attractor=np.flatnonzero(present.values))
    section = part[["section", "status"]].load().assign_attrs(ds.attrs)
    ids = found["attractor_id"].transpose(*dims, *starts).values
    curves, reason = [], np.full(found["kind"].transpose(*dims, "attractor").shape, ABSENT, np.int8)
    kind = found["kind"].transpose(*dims, "attractor").values
    stability = found["stability"].transpose(*dims, "attractor").values
    for index in np.ndindex(*reason.shape):
        number = int(found["attractor"].values[index[-1]])
        stays = kind[index] in APERIODIC and stability[index] == ATTRACTS
        own = (ids[index[:-1]] == number).ravel() & stays
        point = section.isel(dict(zip(dims, index[:-1], strict=True)))
        curve = correlation_dimension(
            pooled(point, starts, own),
            pool=["cell"],
            theiler=options.theiler,
            n_max=options.n_max,
            floor=options.floor,
            geometry=geometry_of(ds),
        )
        curves.append(curve)
        reason[index] = _reason(int(kind[index]), stays, float(curve["correlation_dimension"]))
    return _dataset(found, curves, reason, dims).assign_attrs(
        {**ds.attrs, **{f"dimension_{k}": getattr(options, k) for k in ("theiler", "n_max", "floor")}}
    )


def _reason(kind: int, stays: bool, dimension: float) -> int:
    if kind not in APERIODIC:
        return CLOSED if kind else ABSENT
    if not stays:
        return NO_ATTRACTOR
    return HAS_DIMENSION if np.isfinite(dimension) else TOO_FEW


def _dataset(found: xr.Dataset, curves: list[xr.Dataset], reason: np.ndarray, dims: tuple[str, ...]) -> xr.Dataset:
    own = (*dims, "attractor")
    variables: dict[str, Any] = {}
    for name in curves[0].data_vars if curves else ():
        values = np.stack([one[name].values for one in curves])
        tail = tuple(map(str, curves[0][name].dims))
        variables[str(name)] = ((*own, *tail), values.reshape(*reason.shape, *values.shape[1:]), curves[0][name].attrs)
    about = {"units": "1", "long_name": "why there is no dimension", **code_flags(REASONS)}
    copied = ["n_cells", "share", "kind", "stability", "n_sampled", "n_left", "lifetime_low"]
    return found[copied].transpose(*own).assign(variables).assign(reason=(own, reason, about))
