"""Turn a run's specification into a plan: cells, tasks, chunks, bytes and time, without creating any file.

A task computes a block of cells and owns whole chunks of every variable. The layout follows from the
specification alone, never from the number of workers. A run can therefore be resumed anywhere, with the same
bytes in its files.

A branch of a continuation is computed by a sequence of tasks. Each begins where its predecessor ended. Upward
and downward branches are in different tasks.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.layout.cells import CellMap
from pipeline.layout.identity import identity_of
from pipeline.layout.schema import sizes_of, variables_of
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.products.product import Variable
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import AUTO, EXPLICIT, FREQUENCY

LEAST_LATTICE = 64
"""Cells of the first lattice in a tile of a refined grid, about, if 64 MB hold them.

A basin boundary is followed within a tile but not into the next one, so smaller tiles miss more of it.
"""

LANES_OF_TASK = 16
"""Tasks take multiples of this number of trajectories, so that the kernel's lanes are full."""

MOST_TASKS = 100_000
"""Most tasks of a run. Reading the records of more tasks would take longer than computing their cells."""

WANTED_TASKS = 32
LEAST_SECONDS, MOST_SECONDS = 2.0, 20.0
PLAN_CHUNK_BYTES = 8_000_000
TASK_BYTES = 64_000_000


@dataclass(frozen=True)
class Plan:
    """The plan of a run: its specification, cells, tasks and chunks, with estimates of size and time."""

    spec: Spec
    cells: CellMap = field(compare=False, repr=False)
    block: tuple[int, ...]  # cells of a task, per dim
    text: str = field(default="", compare=False, repr=False)  # TOML text of the specification
    # whether `pipeline.runs.methods` has still to decide the method; until then it is explicit
    undecided: bool = field(default=False, compare=False, repr=False)

    @property
    def dims(self) -> tuple[str, ...]:
        """Cell dims of the result cube."""
        return self.cells.dims

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the cell dims."""
        return self.cells.shape

    @property
    def path(self) -> int | None:
        """Index of the dim along which branches are continued. It is None in a sweep."""
        return self.cells.path

    @property
    def directions(self) -> tuple[str, ...]:
        """Directions in which branches are continued, each for an equal part of the branches; empty in a sweep."""
        return self.spec.continuation.directions if self.spec.continuation else ()

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """Variables of the result cube."""
        return variables_of(self.spec.model, self.spec.products)

    @cached_property
    def sizes(self) -> Mapping[str, int]:
        """Sizes of the dims that are not cell dims."""
        return sizes_of(self.spec.model, self.spec.products, self.spec.integration.n_keep)

    @cached_property
    def identity(self) -> dict[str, Any]:
        """All data that determine the numbers and the layout of the run."""
        return identity_of(self.spec, {v.name: self.chunks(v) for v in self.variables})

    @cached_property
    def seconds_per_cell(self) -> float:
        """Estimated time of a cell on one core [s]."""
        return sum(periods_per_cell(self.spec)) * mean_seconds_per_period(self.spec)

    @cached_property
    def seconds_at(self) -> np.ndarray | None:
        """Estimated time of a cell on one core at each swept frequency [s]; None if it is not swept."""
        if FREQUENCY not in self.spec.axes:
            return None
        frequency = self.spec.axes[FREQUENCY].array()
        return sum(periods_per_cell(self.spec)) * self.spec.motion.seconds_per_period(frequency)

    @property
    def n_cells(self) -> int:
        """Number of cells of the result cube."""
        return math.prod(self.shape)

    @property
    def n_points(self) -> int:
        """Number of parameter points per branch. It is 1 in a sweep."""
        return 1 if self.path is None else self.shape[self.path]

    @property
    def n_tasks(self) -> int:
        """Number of tasks of the run."""
        return math.prod(self.task_grid)

    @property
    def task_grid(self) -> tuple[int, ...]:
        """Number of tasks along each dim of the result cube."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block, strict=True))

    @property
    def n_bytes(self) -> int:
        """Size of the result cube before compression [bytes]."""
        return self.n_cells * self.bytes_per_cell

    @property
    def bytes_per_cell(self) -> int:
        """Size of all variables of a cell [bytes]."""
        return sum(v.itemsize(self.sizes) for v in self.variables)

    @property
    def core_seconds(self) -> float:
        """Estimated computing time of the run on one core [s]."""
        return self.n_cells * self.seconds_per_cell

    def seconds(self, index: int) -> float:
        """Estimate the computing time of a task on one core [s]."""
        seconds = self.seconds_per_cell
        if self.seconds_at is not None:
            seconds = float(self.seconds_at[self.task(index)[self.dims.index(FREQUENCY_DIM)]].mean())
        return seconds * self.cells_in(index)

    def task(self, index: int) -> tuple[slice, ...]:
        """Return the block of cells of a task, as slices of the result cube."""
        places = zip(self._place(index), self.block, self.shape, strict=True)
        return tuple(slice(p * b, min((p + 1) * b, n)) for p, b, n in places)

    def _place(self, index: int) -> tuple[int, ...]:
        """Return the indices of a task in the grid of tasks."""
        if not 0 <= index < self.n_tasks:
            raise IndexError(f"task {index} does not exist; there are {self.n_tasks}.")
        places = []
        for n_blocks in reversed(self.task_grid):
            index, place = divmod(index, n_blocks)
            places.append(place)
        return tuple(reversed(places))

    def walks_down(self, index: int) -> bool:
        """Return whether the branches of a task are continued towards falling parameter values."""
        if self.path is None or not self.directions:
            return False
        first = self._place(index)[-1] * self.block[-1]
        return self.directions[first * len(self.directions) // self.shape[-1]] == "down"

    def depth(self, index: int) -> int:
        """Return the number of tasks that compute earlier points of a task's branches. Return 0 in a sweep."""
        if self.path is None:
            return 0
        place = self._place(index)[self.path]
        return self.task_grid[self.path] - 1 - place if self.walks_down(index) else place

    def predecessor(self, index: int) -> int | None:
        """Return the index of the task whose last states a task continues from. Return None if the task's branches
        begin in the task itself.
        """
        if self.path is None or self.depth(index) == 0:
            return None
        stride = math.prod(self.task_grid[self.path + 1 :])
        return index + stride if self.walks_down(index) else index - stride

    def tasks(self) -> Iterator[tuple[slice, ...]]:
        """Return the blocks of cells of all tasks in order."""
        return (self.task(i) for i in range(self.n_tasks))

    def cells_in(self, index: int) -> int:
        """Return the number of cells of a task."""
        return math.prod(s.stop - s.start for s in self.task(index))

    def chunks(self, variable: Variable) -> tuple[int, ...]:
        """Return the chunk shape of a variable: a task's block of cells and the variable's own dims. A block that is
        too large is cut along the continuation dim.
        """
        sizes = self.sizes
        chunk = list(self.block)
        if self.path is not None:
            n_points = chunk[self.path]
            per_point = math.prod(chunk) // n_points * variable.itemsize(sizes)
            most = max(1, PLAN_CHUNK_BYTES // per_point)
            # as few chunks as possible; successive tasks share none
            apart = self.task_grid[self.path] > 1
            chunk[self.path] = _part(n_points, most) if apart else _share(n_points, most)
        return (*chunk, *(sizes[d] for d in variable.own_dims))


def make_plan(spec: Spec, text: str = "") -> Plan:
    """Plan a run: choose the block of cells per task, and estimate size and time.

    A task takes a thirty-second part of the run, but between 2 and 20 s of one core by the rule of thumb, and
    at most 8 MB in a sweep. It has a multiple of 16 trajectories, unless ``execution.trajectories_per_task``
    is given. In a refined grid a task is a tile: one parameter point, and about equally many cells along each
    grid dim, in multiples of the stride. In a continuation it is about 16 branches of one direction, over as
    many points as that time allows, at most 20 s.

    Parameters
    ----------
    spec
        Specification of the run.
    text
        TOML text of the specification, which the run keeps.

    Raises
    ------
    SpecError
        If there are too many tasks or branches, or chunks that cannot be written; the message lists all problems.
    """
    is_open = spec.integration.method == AUTO
    spec = spec.by_method(EXPLICIT) if is_open else spec
    has_steps = spec.model.clock.is_continuous and spec.noise is None
    draft = Plan(spec, CellMap(spec), (), text, is_open and has_steps)
    wanted = spec.execution.trajectories_per_task or _trajectories(draft)
    if spec.continuation is not None:
        block = _walk_block(draft, wanted)
    elif spec.refine is None:
        block = _block(draft.shape, None, wanted)
    else:
        grid = draft.shape[len(spec.axes) :]
        if spec.execution.trajectories_per_task is None:
            most = TASK_BYTES // draft.bytes_per_cell
            wanted = max(wanted, min(LEAST_LATTICE * spec.refine ** len(grid), most))
        block = (*(1 for _ in spec.axes), *_tile(grid, spec.refine, wanted))
    plan = replace(draft, block=block)
    _refuse_large(plan)
    return plan


def mean_seconds_per_period(spec: Spec) -> float:
    """Return the mean computing time per drive period over the run's frequencies [s]."""
    frequency = spec.axes[FREQUENCY].array() if FREQUENCY in spec.axes else spec.frequency_hz
    return float(np.mean(spec.motion.seconds_per_period(np.asarray(frequency))))


def periods_per_cell(spec: Spec) -> tuple[float, float]:
    """Return the largest number of drive periods that a cell is integrated for, and the cost of its products in drive
    periods.
    """
    products = sum(CELL_PRODUCTS[name].cost(options) for name, options in spec.products.items())
    return float(spec.integration.n_transient + spec.integration.n_keep), float(products)


def _trajectories(plan: Plan) -> int:
    per_branch = plan.bytes_per_cell * plan.n_points
    limit = PLAN_CHUNK_BYTES if plan.n_points == 1 else TASK_BYTES
    n = min(_wanted_seconds(plan.core_seconds) / (plan.seconds_per_cell * plan.n_points), limit / per_branch)
    # blocks are filled dim by dim, which can double the number of tasks
    n = max(n, 2 * plan.n_cells / plan.n_points / MOST_TASKS)
    return max(1, round(n / LANES_OF_TASK)) * LANES_OF_TASK


def _wanted_seconds(core_seconds: float) -> float:
    return min(max(core_seconds / WANTED_TASKS, LEAST_SECONDS), MOST_SECONDS)


def _walk_block(plan: Plan, wanted: int) -> tuple[int, ...]:
    """Return the block shape of a continuation's task. A task takes branches of one direction over a stretch of the
    parameter axis.
    """
    assert plan.path is not None
    n_points, seconds = plan.n_points, plan.seconds_per_cell
    largest = max(v.itemsize(plan.sizes) for v in plan.variables)
    n_seeds = plan.shape[-1] // len(plan.directions)
    if len(plan.directions) > 1:
        # any other number would put branches of both directions into one task
        n_seeds = _group(n_seeds, wanted, TASK_BYTES // plan.bytes_per_cell)
        wanted = max(wanted, n_seeds)
    block = list(_block((*plan.shape[:-1], n_seeds), plan.path, wanted))
    n_branches = math.prod(block) // n_points
    points = plan.spec.execution.points_per_task
    if points is None:
        by_time = _wanted_seconds(plan.core_seconds) / (n_branches * seconds)
        at_most = MOST_SECONDS / (n_branches * (seconds if plan.seconds_at is None else float(plan.seconds_at.max())))
        by_size = PLAN_CHUNK_BYTES / (n_branches * largest)
        points = _share(n_points, max(1, int(min(by_time, at_most, by_size))))
    block[plan.path] = min(points, n_points)
    return tuple(block)


def _group(n_seeds: int, wanted: int, most: int) -> int:
    """Return the number of initial states per task. It divides `n_seeds`, so that no task has branches of both
    directions.
    """
    divisors = [d for d in range(1, min(n_seeds, max(most, 1)) + 1) if n_seeds % d == 0]
    return min(divisors, key=lambda d: (max(d / wanted, wanted / d), -d))


def _share(n: int, most: int) -> int:
    """Return the part size for splitting `n` into the fewest, about equal parts of at most `most` each."""
    return -(-n // -(-n // most))


def _part(n: int, most: int) -> int:
    """Return the largest divisor of `n` that is at most `most`."""
    return n // next(k for k in range(-(-n // most), n + 1) if n % k == 0)


def _block(shape: tuple[int, ...], path: int | None, wanted: int) -> tuple[int, ...]:
    """Return the shape of a block of about `wanted` cells. It is filled from the last dim, and the continuation dim is
    taken whole.
    """
    block = [1] * len(shape)
    for i in reversed(range(len(shape))):
        if i == path:
            block[i] = shape[i]
        else:
            block[i] = min(shape[i], max(wanted, 1))
            wanted //= block[i]
    return tuple(block)


def _tile(shape: tuple[int, ...], stride: int, wanted: int) -> tuple[int, ...]:
    """Return the side lengths of a tile, which is a task's block of cells in a refined grid. Each side is a multiple of
    `stride`, and the tile has at most `wanted` cells if possible.

    A side may also be a whole axis. The shortest side that can grow is enlarged first. Then the tiles along
    an axis are made about equal.
    """
    sides = [min(stride, n) for n in shape]
    while growing := [i for i, n in enumerate(shape) if sides[i] < n]:
        least = min(growing, key=sides.__getitem__)
        larger = min(sides[least] + stride, shape[least])
        if math.prod(sides) // sides[least] * larger > wanted:
            break
        sides[least] = larger
    n_tiles = [max(1, (n + side // 2) // side) for n, side in zip(shape, sides, strict=True)]
    return tuple(min(n, -(-n // (k * stride)) * stride) for n, k in zip(shape, n_tiles, strict=True))


MOST_BRANCHES = 10_000_000
"""Most branches of a continuation. The cube keeps the initial state of each as coordinates."""

MOST_CHUNK_BYTES = 2**31 - 1 - 16
"""Most bytes that blosc can compress in one piece."""

FILE_BYTES = 4096
"""Most bytes that a file takes on a disk besides its content."""

GO_ON = "MAGPEND_SPACE"
"""Environment variable; ``0`` lets a run begin although the disk may be too small for it."""


def _refuse_large(plan: Plan) -> None:
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
