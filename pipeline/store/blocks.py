"""The cells of one committed task, compared with its record."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import zarr

from pipeline.store.run import Run
from pipeline.store.view import committed_view


def read_block(run: Run, index: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return variables of a committed task, in the shape of its block followed by their own dims.

    Raises
    ------
    DamagedError
        If a file is not what was written.
    KeyError
        If the task is not committed.
    """
    group: Any = zarr.open_group(committed_view(run.info, {index: run.commits[index]}, check=True), mode="r")
    return {name: np.asarray(group[name][run.plan.task(index)]) for name in names}
