"""From a specification to a plan: cells, tasks, chunks, bytes, time. Pure: nothing is created.

A task computes a block of cells and owns whole chunks of every variable. The layout follows from the
specification alone, never from the number of workers, so that a run can be resumed anywhere and its
files are the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.layout.cells import CellMap
from pipeline.layout.limits import MOST_TASKS
from pipeline.layout.schema import sizes_of, variables_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.products.variable import Variable
from pipeline.spec.drives import TORQUE
from pipeline.spec.parsing import Spec
from pipeline.spec.tables import FREQUENCY

MICROSECONDS_PER_PERIOD, MICROSECONDS_PER_SECOND = 9.0, 21.5
"""Rule of thumb for one trajectory on one core at rtol 1e-8: a period of length T takes
9 us + 21.5 us T/s (measured between 0.1 and 3 Hz on AVX-512, good to 20 %)."""

MICROSECONDS_PER_INTERVAL = 0.9
"""Time that a trajectory takes more for each interval of a recorded torque."""

RTOL_OF_RULE = 1e-8
ROOT = 6
"""The time grows with the sixth root of 1/rtol."""

LEAST_LATTICE = 64
"""Tiles of a refined grid have about this many cells of the first lattice, where 64 MB hold them.

A boundary is followed within a tile, not from one to the next: small tiles overlook more.
"""

LANES = 16
"""Trajectories per task come in multiples of this, so that the kernel's lanes are full."""

WANTED_TASKS = 32
LEAST_SECONDS, MOST_SECONDS = 2.0, 20.0
CHUNK_BYTES = 8_000_000
TASK_BYTES = 64_000_000


@dataclass(frozen=True)
class Plan:
    """What a run will do.

    Attributes
    ----------
    kind : str
    dims, shape : tuple
        Cell dims of the cube.
    path : int or None
        The dim that branches walk; None in a sweep.
    block : tuple of int
        Cells of a task, per dim.
    variables : tuple of Variable
        Variables of the cube.
    sizes : dict
        Sizes of the dims that are not cell dims.
    seconds_per_cell : float
        Estimated time on one core [s].
    is_recorded : bool
        Whether the drive is a recording.
    """

    kind: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    path: int | None
    block: tuple[int, ...]
    variables: tuple[Variable, ...]
    sizes: Mapping[str, int]
    seconds_per_cell: float
    is_recorded: bool = False

    @property
    def n_cells(self) -> int:
        """Cells of the cube."""
        return math.prod(self.shape)

    @property
    def n_points(self) -> int:
        """Points per branch; 1 in a sweep."""
        return 1 if self.path is None else self.shape[self.path]

    @property
    def n_tasks(self) -> int:
        """Tasks of the run."""
        return math.prod(self.task_grid)

    @property
    def task_grid(self) -> tuple[int, ...]:
        """Tasks along each dim."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block, strict=True))

    @property
    def n_bytes(self) -> int:
        """Size of the cube before compression [bytes]."""
        return self.n_cells * sum(v.itemsize(self.sizes) for v in self.variables)

    @property
    def core_seconds(self) -> float:
        """Estimated time on one core [s]."""
        return self.n_cells * self.seconds_per_cell

    def task(self, index: int) -> tuple[slice, ...]:
        """Return the block of cells of a task."""
        if not 0 <= index < self.n_tasks:
            raise IndexError(f"task {index} does not exist; there are {self.n_tasks}.")
        starts = []
        for n_blocks in reversed(self.task_grid):
            index, place = divmod(index, n_blocks)
            starts.append(place)
        places = zip(reversed(starts), self.block, self.shape, strict=True)
        return tuple(slice(p * b, min((p + 1) * b, n)) for p, b, n in places)

    def tasks(self) -> Iterator[tuple[slice, ...]]:
        """Return the blocks of all tasks in order."""
        return (self.task(i) for i in range(self.n_tasks))

    def cells_in(self, index: int) -> int:
        """Cells of a task."""
        return math.prod(s.stop - s.start for s in self.task(index))

    def chunks(self, variable: Variable) -> tuple[int, ...]:
        """Chunk shape of a variable: the task's block, cut along the path where it is too large."""
        sizes = self.sizes
        chunk = list(self.block)
        if self.path is not None:
            n_points = chunk[self.path]
            per_point = math.prod(chunk) // n_points * variable.itemsize(sizes)
            most = max(1, CHUNK_BYTES // per_point)
            # as few chunks as can be, about equal: a chunk that is rounded up stays within the most
            chunk[self.path] = -(-n_points // -(-n_points // most))
        return (*chunk, *(sizes[d] for d in variable.own_dims))


def make_plan(spec: Spec) -> Plan:
    """Lay out a run.

    Tasks take a thirty-second part of the run each, but between 2 and 20 s of one core's time by
    the rule of thumb, and at most 8 MB in a sweep; always whole multiples of 16 trajectories unless
    ``execution.trajectories_per_task`` says otherwise. In a refined grid they are tiles: one parameter
    point, about as many cells along each grid dim, multiples of the stride.
    """
    cells = CellMap(spec)
    seconds = _seconds_per_cell(spec)
    n_points = 1 if cells.path is None else cells.shape[cells.path]
    wanted = spec.execution.trajectories_per_task or _trajectories(
        spec, math.prod(cells.shape), n_points, seconds
    )
    if spec.refine is None:
        block = _block(cells.shape, cells.path, wanted)
    else:
        grid = cells.shape[len(spec.axes) :]
        if spec.execution.trajectories_per_task is None:
            most = TASK_BYTES // _bytes_per_cell(spec)
            wanted = max(wanted, min(LEAST_LATTICE * spec.refine ** len(grid), most))
        block = (*(1 for _ in spec.axes), *_tile(grid, spec.refine, wanted))
    return Plan(
        spec.kind, cells.dims, cells.shape, cells.path, block, variables_of(spec.model, spec.products),
        sizes_of(spec.model, spec.products, spec.integration.n_keep), seconds, spec.recorded is not None,
    )  # fmt: skip


def seconds_per_period(frequency_hz: np.ndarray, rtol: float) -> np.ndarray:
    """Time of a drive period of one trajectory on one core by the rule of thumb [s]."""
    microseconds = MICROSECONDS_PER_PERIOD + MICROSECONDS_PER_SECOND / np.asarray(frequency_hz)
    return np.asarray(microseconds * 1e-6 * (RTOL_OF_RULE / rtol) ** (1 / ROOT))


def mean_seconds_per_period(spec: Spec) -> float:
    """`seconds_per_period`, in the mean over the run's frequencies [s]."""
    frequency = spec.axes[FREQUENCY].array() if FREQUENCY in spec.axes else spec.frequency_hz
    return float(np.mean(seconds_per_period(np.asarray(frequency), spec.integration.rtol)))


def periods_per_cell(spec: Spec) -> tuple[float, float]:
    """Most drive periods of a cell's sections, and those of its products in units of their time."""
    products = sum(CELL_PRODUCTS[name].cost(options) for name, options in spec.products.items())
    return float(spec.integration.n_transient + spec.integration.n_keep), float(products)


def _seconds_per_cell(spec: Spec) -> float:
    """Mean time of a cell [s]."""
    periods = sum(periods_per_cell(spec))
    seconds = periods * mean_seconds_per_period(spec)
    if spec.recorded is not None and spec.recorded.kind == TORQUE:
        per_period = spec.recorded.n_intervals / spec.recorded.n_periods
        seconds += periods * per_period * MICROSECONDS_PER_INTERVAL * 1e-6
    return seconds


def _trajectories(spec: Spec, n_cells: int, n_points: int, seconds_per_cell: float) -> int:
    """Trajectories per task."""
    wanted_seconds = min(max(n_cells * seconds_per_cell / WANTED_TASKS, LEAST_SECONDS), MOST_SECONDS)
    per_cell = _bytes_per_cell(spec)
    limit = CHUNK_BYTES if n_points == 1 else TASK_BYTES
    n = min(wanted_seconds / (seconds_per_cell * n_points), limit / (per_cell * n_points))
    # blocks are filled dim by dim, which can take twice as many
    n = max(n, 2 * n_cells / n_points / MOST_TASKS)
    return max(1, round(n / LANES)) * LANES


def _bytes_per_cell(spec: Spec) -> int:
    """Bytes of a cell's variables, uncompressed."""
    sizes = sizes_of(spec.model, spec.products, spec.integration.n_keep)
    return sum(v.itemsize(sizes) for v in variables_of(spec.model, spec.products))


def _block(shape: tuple[int, ...], path: int | None, wanted: int) -> tuple[int, ...]:
    """Fill a block from the last dim on; the path's dim is taken whole."""
    block = [1] * len(shape)
    for i in reversed(range(len(shape))):
        if i == path:
            block[i] = shape[i]
        else:
            block[i] = min(shape[i], max(wanted, 1))
            wanted //= block[i]
    return tuple(block)


def _tile(shape: tuple[int, ...], stride: int, wanted: int) -> tuple[int, ...]:
    """Sides of a tile of at most `wanted` cells, if that is possible: multiples of the stride or whole axes.

    The least side that can grows first; then the tiles along an axis are made about equal.
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
