"""Attractors with their sets on the dim ``attractor``, as a test reads or builds them, and as rows."""

import numpy as np

from pipeline.analysis.attractors import attractors
from pipeline.results.ragged import N_IDS, N_POINTS, ROW_SIZE, SAMPLE, SET, TRANSITION, dense, is_ragged


def identify(*given, **options):
    """What `identify` finds, with its sets on the dim ``attractor``."""
    return dense(attractors.identify(*given, **options), points=True)


def match(found, **options):
    """What `match` makes of a result with its sets on the dim ``attractor``, in the same form."""
    return dense(attractors.match(rows_of(found), **options), points=True)


def rows_of(ds):
    """The same result with a row for each set at each parameter point."""
    if is_ragged(ds):
        return ds
    dims = [str(d) for d in ds["kind"].dims if d != "attractor"]
    there = ds["kind"].transpose(*dims, "attractor").values > 0
    variables = {ROW_SIZE: (dims, there.sum(axis=-1).astype(np.int32))}
    for name, array in ds.data_vars.items():
        if "attractor" in array.dims:
            own = array.transpose(*dims, "attractor", ...)
            rows = own.values[np.nonzero(there)]
            if name == "attractor_points":
                kept = [points[np.isfinite(points).all(axis=-1)] for points in rows]
                variables[N_POINTS] = (SET, np.array([len(points) for points in kept], np.int32))
                variables[name] = ((SAMPLE, "state"), np.concatenate(kept), array.attrs)
            elif name != "n_to":
                variables[name] = ((SET, *own.dims[len(dims) + 1 :]), rows, array.attrs)
    for name in ("from_set", "to", "n_to"):
        variables[name] = (TRANSITION, np.zeros(0, np.int64))
    rest = ds.drop_dims("attractor").assign(variables).assign_attrs({N_IDS: ds.sizes["attractor"]})
    return rest.assign_coords(attractor=(SET, np.nonzero(there)[-1].astype(np.int32)))
