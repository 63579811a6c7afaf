"""Write the results of a task as chunks of the result cube, then the commit record that proves them complete."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import WrapperStore

from pipeline.layout.plan import Plan
from pipeline.layout.writing import writing
from pipeline.store.commits import is_packed
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import COMMITS, CUBE, RUN_FILE, Files, entry_of, problems_of
from pipeline.store.keys import chunk_keys
from pipeline.store.records import marker_key, record_text
from pipeline.store.runfile import RunInfo


def write_task(info: RunInfo, index: int, values: Mapping[str, np.ndarray], counts: Mapping[str, int]) -> None:
    """Write the results of a task, then the commit record that proves them complete.

    Arrays have the shape of the task's block followed by the variable's own dims; `counts` has the number of cells by
    status name.

    Raise `ValueError` if an array has another shape or dtype than the store, or a block cuts a chunk, `DamagedError` if
    the metadata of a variable have changed since the set-up, and `RefusedError` if the run directory was removed
    meanwhile.
    """
    info.files.refuse_links(CUBE, *(f"{CUBE}/{v.name}" for v in info.plan.variables), COMMITS)
    cube = info.files.below(CUBE)
    _require_metadata(info)
    objects: dict[str, dict[str, Any]] = {}
    for v in info.plan.variables:
        objects |= write_block(cube, info.plan, index, v.name, values[v.name])
    cube.sync(objects)  # the chunks are durable before their record exists
    _require_written(cube, objects)
    # the record holds no time and no host name: its bytes do not depend on who computes the task
    record = {"digest": info.digest, "task": index, "status": dict(counts), "objects": objects}
    # check for a removed run, but not in an object store: there a run is no folder, and the check costs a request
    if info.files.local is not None and not info.files.is_there(RUN_FILE):
        cube.remove(objects)
        raise RefusedError(f"{info.name}: was removed while it was computed; give the command again.")
    # if another worker has computed the same task, the record (with equal bytes) may already be in a pack
    if not is_packed(info, index):
        # `write_once` is atomic (temporary name, sync, rename, sync of the folder): no partial record can appear
        info.files.write_once(marker_key(index), record_text(record).encode())


def _require_metadata(info: RunInfo) -> None:
    """Raise `DamagedError` if the metadata of a variable have changed: with them, chunks would be encoded wrongly."""
    own = {key: info.skeleton[key] for key in (f"{v.name}/zarr.json" for v in info.plan.variables)}
    problems = problems_of(info.files.below(CUBE), own)
    if problems:
        raise DamagedError(
            f"{info.name}/{CUBE}/{problems[0]}. Give the command that made the run again: it is rebuilt."
        )


def _require_written(cube: Files, objects: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise `DamagedError` if chunks do not read back as the bytes that were handed to the store; remove them."""
    problems = problems_of(cube, objects)
    if problems:
        cube.remove(objects)
        raise DamagedError(
            f"{cube.name}/{problems[0]} while it was written: memory, disk or network is at fault. Its task is not "
            "committed; check them, then give the same command again."
        )


class _Noted(WrapperStore[Store]):
    """A zarr store that notes the size and sha256 of what it is given to write, by key."""

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self.entries: dict[str, dict[str, Any]] = {}

    async def set(self, key: str, value: Buffer) -> None:
        """Note the content of a key, then write it."""
        self.entries[key] = entry_of(value.to_bytes())
        await super().set(key, value)


def write_block(cube: Files, plan: Plan, index: int, name: str, values: np.ndarray) -> dict[str, dict[str, Any]]:
    """Write the values of one variable for the cells of a task as chunks; return size and sha256 of each by key.

    These are of the bytes that were handed to the store, so that reading back can reveal bytes changed on the way.
    """
    store = _Noted(cube.zarr(read_only=False))
    array = zarr.open_array(store, path=name, mode="r+", zarr_format=3)
    # without this setting, which zarr does not store, a block of fill values would write no file
    array = array.with_config({"write_empty_chunks": True})
    block = plan.task(index)
    own = array.shape[len(block) :]
    region = (*block, *(slice(0, n) for n in own))
    expected = tuple(s.stop - s.start for s in region)
    if values.shape != expected or values.dtype != array.dtype:
        raise ValueError(f"{name}: {values.dtype} {values.shape} where the store has {array.dtype} {expected}.")
    keys = chunk_keys(name, region, array.chunks, array.shape)
    cube.refuse_links(*keys)
    with writing(f"{cube.name}/{name}"):
        array[region] = values
    return {key: store.entries[key] for key in keys}
