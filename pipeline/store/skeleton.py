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
from pipeline.store.arrays import METADATA, consolidated_metadata, create_array, disagreements, write_whole
from pipeline.store.errors import DamagedError
from pipeline.store.files import CUBE, Files, compared, entry_of
from pipeline.store.runfile import RunInfo

MOST_KEPT = 1_000_000
"""Largest size in bytes of a file of the set-up whose content an opened run keeps, so that it is read once."""


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


def lacking(info: RunInfo) -> list[str]:
    """Return the keys of files of variables and coordinates that ``run.json`` should name, and does not."""
    spec = info.plan.spec
    found = [f"{v.name}/{METADATA}" for v in info.plan.variables]
    for coordinate in (*coordinates(spec), further_coordinates(spec)[0]):
        found += [f"{coordinate.name}/{end}" for end in (METADATA, ".".join(["c", *["0"] * len(coordinate.dims)]))]
    return [key for key in found if key not in info.skeleton]


def skeleton_keys(plan: Plan) -> list[str]:
    """Return the keys of the metadata files of all variables and coordinates of the result cube."""
    found = (*coordinates(plan.spec), *further_coordinates(plan.spec))
    names = [v.name for v in plan.variables] + [c.name for c in found]
    return [f"{name}/{METADATA}" for name in names]


def entries_of(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Return the size and sha256 of each file's content by key, for ``run.json``."""
    return {key: entry_of(content) for key, content in files.items()}


def write_skeleton(files: Files, contents: Mapping[str, bytes], keys: Iterable[str]) -> None:
    """Write some of the metadata and coordinate files of a result cube, each atomically, in the given order."""
    files.prepare(CUBE)
    written = [f"{CUBE}/{key}" for key in keys]
    for key in written:
        files.write(key, contents[key.removeprefix(f"{CUBE}/")])
    files.sync(written)


def skeleton_problems(info: RunInfo) -> list[str]:
    """Return a line for each metadata or coordinate file of the result cube that is missing or has changed.

    If none has, return a line for each array whose metadata differ from their copy in the group's file.
    """
    return _compare(info, info.skeleton)[1]


def _compare(info: RunInfo, keys: Iterable[str]) -> tuple[dict[str, bytes], list[str]]:
    """Compare files of the set-up with their digests; return the contents of small ones, and the problems of all."""
    chosen = {key: info.skeleton[key] for key in keys}
    folders = {key.partition("/")[0] for key in chosen if "/" in key}
    info.files.refuse_links(CUBE, *(f"{CUBE}/{folder}" for folder in folders))
    contents, problems = {}, []
    for key, content, problem in compared(info.files.below(CUBE), chosen):
        if problem:
            problems.append(problem)
        elif len(content) <= MOST_KEPT:
            contents[key] = content
    return contents, problems or disagreements(contents)


def check_skeleton(info: RunInfo) -> dict[str, bytes]:
    """Compare the cube's metadata and coordinates with their digests in ``run.json``; return the contents of the small
    files.

    In an object store, where each file is a request, the arrays' own metadata are not read if the group's file repeats
    them all: readers then use that file, whose digest is compared, and no other. Raise `DamagedError`, which names the
    files and the remedy, if a file is missing or has changed.
    """
    keys = list(info.skeleton)
    first = [key for key in keys if key == METADATA or not key.endswith(METADATA)]
    rest = [key for key in keys if key not in first]
    if info.files.local is not None:
        first, rest = keys, []
    contents, problems = _compare(info, first)
    copies = consolidated_metadata(contents.get(METADATA, b""))
    if any(key.rpartition("/")[0] not in copies for key in rest):
        own, others = _compare(info, rest)
        contents, problems = {**contents, **own}, problems + others
    if problems:
        more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
        raise DamagedError(
            f"{info.files.below(CUBE).name}: {'; '.join(problems[:3])}{more}. These files follow from the "
            f"specification: rebuild them with: magpend verify --repair {info.name}"
        )
    return contents
