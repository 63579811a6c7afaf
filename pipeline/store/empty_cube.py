"""Make the files of an empty result cube: the metadata of all variables, and the coordinates.

Their bytes follow from the plan and the identity alone, so that a damaged file can be rebuilt.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import zarr
from zarr.storage import MemoryStore

from pipeline.layout.cells import Coordinate, coordinates, further_coordinates
from pipeline.layout.conventions import CONVENTIONS, Described, conventional_attributes
from pipeline.layout.identity import digest_of
from pipeline.layout.plan import Plan
from pipeline.layout.vocabulary import model_attribute
from pipeline.store.arrays import create_array, write_whole
from pipeline.store.declared import METADATA


def skeleton_files(plan: Plan, identity: Mapping[str, Any], *, described: bool = True) -> dict[str, bytes]:
    """Return the contents of all files of an empty result cube (metadata and coordinates) by key, those of the group
    first.

    Unless `described`, variables lack the attributes of `pipeline.layout.conventions`, as in cubes of earlier versions.
    """
    attrs = {
        "kind": plan.spec.kind,
        "model": model_attribute(plan.spec.model),
        "Conventions": CONVENTIONS,
        "title": plan.spec.title,
        "spec": plan.text,
        "digest": digest_of(identity),
    }
    found = [*coordinates(plan.spec), *further_coordinates(plan.spec)]
    data: dict[str, Any] = {}
    store = MemoryStore(data)
    names = " ".join(sorted(c.name for c in found if c.dims != (c.name,)))
    group = zarr.create_group(store, zarr_format=3, attributes={**attrs, "coordinates": names})
    texts = _attributes(plan, found, described)
    for variable in plan.variables:
        create_array(
            group,
            variable.name,
            (*plan.dims, *variable.own_dims),
            (*plan.shape, *plan.chunks(variable)[len(plan.shape) :]),
            plan.chunks(variable),
            variable.dtype,
            variable.fill,
            texts[variable.name],
        )
    for coordinate in found:
        write_whole(group, coordinate.name, coordinate.dims, np.asarray(coordinate.values), texts[coordinate.name])
    with warnings.catch_warnings():
        # readers without this key ignore it; with it xarray opens the cube without a warning
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(store)
    keys = sorted(data, key=lambda key: (key != METADATA, key))
    return {key: data[key].to_bytes() for key in keys}


def _attributes(plan: Plan, found: Iterable[Coordinate], described: bool) -> dict[str, dict[str, Any]]:
    """Return the attributes of all variables and coordinates of the result cube, by name."""
    entries = {
        v.name: Described((*plan.dims, *v.own_dims), np.dtype(v.dtype), v.attributes()) for v in plan.variables
    } | {c.name: Described(c.dims, np.asarray(c.values).dtype, c.attrs) for c in found}
    return conventional_attributes(entries) if described else {n: dict(entry.attrs) for n, entry in entries.items()}
