"""Compute an analysis in blocks of parameter points, on the same threads, processes and dask workers as a run.

Each block is stored as it ends, in ``derived/NAME-KEY.blocks``, until the whole result is. So an analysis that was
stopped goes on. Blocks follow from the specification alone, and the result does not depend on them.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.analysis.ragged import isel
from pipeline.analysis.run import Run
from pipeline.compute import clients, execute
from pipeline.compute.clients import Where
from pipeline.compute.threads import Task
from pipeline.layout.vocabulary import split_dims
from pipeline.products.reporting import report
from pipeline.runs.stopping import stoppable
from pipeline.specification.parsing import Spec
from pipeline.store.errors import DamagedError
from pipeline.store.files import Files
from pipeline.store.products import open_product, read_product_attrs
from pipeline.store.run import Run as StoredRun

if TYPE_CHECKING:
    from pipeline.runs.derive import AnalysedRun

WANTED, FEWEST_CELLS, MOST_CELLS = 64, 1024, 16_384
"""Number of blocks that is aimed at, and the fewest and most cells of a block of several points."""

Block = Mapping[str, slice]


@dataclass(frozen=True)
class Part:
    """A run of which only a block of parameter points is analysed, see `pipeline.analysis.run.Run`."""

    run: Run
    block: Block
    known: dict[str, xr.Dataset] = field(default_factory=dict)

    @property
    def spec(self) -> Spec:
        """Specification of the whole run."""
        return self.run.spec

    @property
    def model(self) -> Model:
        """Dynamical model of the run."""
        return self.run.model

    @property
    def echo(self) -> Callable[[str], None]:
        """Function that prints a line."""
        return self.run.echo

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the cells of the block."""
        return self.run.cube(chunks).isel(self.block)

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of another analysis at the points of the block."""
        key = f"{name} {json.dumps(options, sort_keys=True)}"
        if key not in self.known:  # a large result is read once for all blocks of a process
            self.known[key] = self.run.derive(name, **options)
        return isel(self.known[key], self.block)


def blocks_of(run: StoredRun) -> list[Block]:
    """Divide the parameter points of a run into blocks, in the C order of the points; align them with the tasks."""
    cells = run.cube()["status"]
    dims, starts = split_dims(cells)
    n_starts = int(np.prod([cells.sizes[d] for d in starts]))
    left = max(1, int(np.clip(cells.size // WANTED, FEWEST_CELLS, MOST_CELLS)) // n_starts)
    lengths: dict[str, int] = {}
    for dim in reversed(dims):
        n, task = cells.sizes[dim], run.plan.block[run.plan.dims.index(dim)]
        lengths[dim] = min(n, left - left % task if task < left < n else left)
        left = max(1, left // n)
    slices = [
        [slice(a, min(a + lengths[d], cells.sizes[d])) for a in range(0, cells.sizes[d], lengths[d])] for d in dims
    ]
    return [dict(zip(dims, own, strict=True)) for own in itertools.product(*slices)]


def compute_missing(
    task: Task, n: int, folder: Files, key: Mapping[str, str], name: str, run: AnalysedRun
) -> list[xr.Dataset]:
    """Compute the blocks of an analysis that are not stored, and return all.

    Parameters
    ----------
    task
        Function that computes and stores the block with a given number; importable in other processes.
    n
        Number of blocks.
    folder
        Where blocks are stored.
    key
        Attributes of a sound block.
    name
        Name of the analysis.
    run
        The run, with workers, scheduler and echo.

    Raises
    ------
    TaskFailedError, SchedulerError
        As `pipeline.compute.execute.run_tasks`. Blocks that have ended stay.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. Blocks that have ended stay.
    """
    where = replace(_in_processes(run.where or Where()), place=run.info.files.place)
    clients.reach(where)
    missing = [k for k in range(n) if not _is_there(folder.below(name_of(k)), key)]
    done, what = n - len(missing), f"{name}, blocks of parameter points"
    if done:
        run.echo(f"{name}: {done} of {n} blocks done before")
    with stoppable(run.name):
        results = execute.run_tasks(task, missing, workers=run.workers, scheduler=where, echo=run.echo)
        with contextlib.closing(results):
            report(what, done, n)
            for k, _ in enumerate(results, done + 1):
                report(what, k, n)
    return [open_product(folder.below(name_of(k))) for k in range(n)]


def _in_processes(where: Where) -> Where:
    """Return processes if no place was chosen: most of an analysis' time is Python's, which threads cannot share."""
    is_chosen = where.scheduler or where.resolved() != clients.THREADS
    return where if is_chosen else replace(where, scheduler=clients.PROCESSES)


def name_of(index: int) -> str:
    """Return the name of a block."""
    return f"{index:06d}.zarr"


def _is_there(part: Files, key: Mapping[str, str]) -> bool:
    try:
        attrs = read_product_attrs(part)
    except (FileNotFoundError, DamagedError):
        return False
    return all(attrs.get(name) == value for name, value in key.items())
