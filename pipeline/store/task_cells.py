"""Read results of one committed task, checked against its commit record, for tasks that start from them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import zarr

from pipeline.layout.plan import Plan
from pipeline.store.commits import read_commit
from pipeline.store.errors import IncompleteError
from pipeline.store.records import Commit
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import RunInfo
from pipeline.store.view import committed_view


def read_cells(
    info: RunInfo, plan: Plan, index: int, region: tuple[slice, ...], names: Iterable[str]
) -> dict[str, np.ndarray]:
    """Read variables of some cells of a committed task.

    Parameters
    ----------
    info, plan
        The run and its plan.
    index
        Index of the task.
    region
        Slices of the cell dims; they lie in the task's block.
    names
        Variables of the cube.

    Returns
    -------
    dict
        By variable, an array in the shape of `region` followed by the variable's own dims.

    Raises
    ------
    IncompleteError
        If the task is not committed here.
    UnreadableError
        If its record exists and cannot be read.
    DamagedError
        If the content of a chunk has changed since it was written.
    """
    commit = read_commit(info, plan, index)
    if commit is None:
        raise IncompleteError(
            f"{info.name}: task {index}, from which another goes on, is not committed here. Every "
            "worker must see this very folder, by this path; then give the same command again."
        )
    return _read(info, plan, index, commit, region, names)


def read_block(run: RunDirectory, index: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read variables of one committed task of an open run. The dims of the task's block of cells come first, then those
    of the variable.

    Raises
    ------
    DamagedError
        If the content of a chunk has changed since it was written.
    KeyError
        If the task is not committed.
    """
    return _read(run.info, run.plan, index, run.commits[index], run.plan.task(index), names)


def _read(
    info: RunInfo, plan: Plan, index: int, commit: Commit, region: tuple[slice, ...], names: Iterable[str]
) -> dict[str, np.ndarray]:
    view = committed_view(info, plan, {index: commit}, check=True)
    return {name: np.asarray(zarr.open_array(view, path=name, mode="r")[region]) for name in names}
