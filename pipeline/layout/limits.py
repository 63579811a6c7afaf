"""Refuse runs that are too large before anything is computed or created."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path

import numpy as np

from pipeline.layout.plan import MOST_TASKS, Plan
from pipeline.specification.problems import SpecError

MOST_BRANCHES = 10_000_000
"""Most branches of a continuation. The cube keeps the initial state of each as coordinates."""

MOST_CHUNK_BYTES = 2**31 - 1 - 16
"""Most bytes that blosc can compress in one piece."""

FILE_BYTES = 4096
"""Most bytes that a file takes on a disk besides its content."""

GO_ON = "MAGPEND_SPACE"
"""Environment variable; ``0`` lets a run begin although the disk may be too small for it."""


def check_plan(plan: Plan) -> None:
    """Refuse a plan with too many tasks or branches, or with chunks that cannot be written.

    Raises
    ------
    SpecError
        If there is a problem; the message lists all of them.
    """
    problems = _task_problems(plan) + _chunk_problems(plan)
    if plan.path is not None and plan.shape[-1] > MOST_BRANCHES:
        problems.append(
            f"initial_conditions: {plan.shape[-1]} branches; the limit is {MOST_BRANCHES}: begin from fewer "
            'states, or set kind = "sweep".'
        )
    if problems:
        raise SpecError(problems)


def _task_problems(plan: Plan) -> list[str]:
    if plan.n_tasks <= MOST_TASKS:
        return []
    cells = math.prod(plan.block)
    wanted = math.ceil(cells / plan.n_points * plan.n_tasks / MOST_TASKS) if plan.path is None else 0
    more = f"set execution.trajectories_per_task to {2 * wanted} or more" if wanted else "let tasks take more"
    return [
        f"execution: {plan.n_cells} cells in tasks of {cells} are {plan.n_tasks} tasks; the limit is "
        f"{MOST_TASKS}: {more}, or use fewer cells."
    ]


def _chunk_problems(plan: Plan) -> list[str]:
    problems = []
    for variable in plan.variables:
        chunk = plan.chunks(variable)
        n_bytes = math.prod(chunk) * np.dtype(variable.dtype).itemsize
        if n_bytes <= MOST_CHUNK_BYTES:
            continue
        cells = math.prod(chunk[: len(plan.shape)])
        fitting = MOST_CHUNK_BYTES * cells // n_bytes
        remedy = f"set execution.trajectories_per_task to {fitting} or less" if fitting else "keep less"
        problems.append(
            f"{variable.name}: {cells} cells of a task take {in_words(n_bytes)} in one piece; "
            f"the limit of compression is {in_words(MOST_CHUNK_BYTES)}; {remedy}, or lower "
            "integration.n_keep."
        )
    return problems


def check_space(plan: Plan, folder: Path | None, n_cells: int | None = None) -> None:
    """Refuse a run for which the disk may be too small.

    Parameters
    ----------
    plan
        Plan of the run.
    folder
        The run directory, which need not exist; None where the free space is unknown, as in an object
        store.
    n_cells
        Number of cells that are still to be computed; by default all.

    Raises
    ------
    SpecError
        If bytes or files may be lacking, unless `GO_ON` is ``0``. The message states what is needed and what
        is free.

    Notes
    -----
    The compressed size of cells is not known beforehand. The check uses an upper bound: the uncompressed size
    and `FILE_BYTES` per file.
    """
    if folder is None or os.environ.get(GO_ON) == "0":
        return
    share = 1.0 if n_cells is None else n_cells / plan.n_cells
    n_files = math.ceil(share * plan.n_tasks * (len(plan.variables) + 1))
    needed = math.ceil(share * plan.n_bytes) + n_files * FILE_BYTES
    place = _nearest(folder)
    free, files = shutil.disk_usage(place).free, _free_files(place)
    lacking = []
    if needed > free:
        lacking.append(f"up to {in_words(needed)} (its cells before compression), and there are {in_words(free)}")
    if files is not None and n_files > files:
        lacking.append(f"{n_files} files, and there is room for {files}")
    if lacking:
        raise SpecError(
            f"{folder}: the run needs {' and '.join(lacking)}; make room, give another --out, ask for less "
            f"(cells, integration.n_keep), or set {GO_ON}=0 to go on as far as there is room."
        )


def _nearest(folder: Path) -> Path:
    absolute = folder.absolute()
    return next(place for place in (absolute, *absolute.parents) if place.exists())


def _free_files(place: Path) -> int | None:
    if not hasattr(os, "statvfs"):
        return None
    found = os.statvfs(place)
    return found.f_favail if found.f_files else None


def in_words(n_bytes: float) -> str:
    """Format a number of bytes with a unit, such as ``1.5 GB``."""
    units = ["bytes", "kB", "MB", "GB", "TB", "PB"]
    while n_bytes >= 1000 and len(units) > 1:
        n_bytes /= 1000
        units.pop(0)
    return f"{n_bytes:.3g} {units[0]}"
