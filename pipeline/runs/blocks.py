"""Compute an analysis in blocks of parameter points, on the same threads, processes and dask workers as a run.

Each block is stored as it ends, in ``derived/NAME-KEY.blocks/``, until the whole result is. So an analysis that was
stopped goes on. Blocks follow from the specification alone, and the result does not depend on them.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.threads import using_threads
from magpend_core.models import import_model
from magpend_core.models.imported import origin
from magpend_core.models.model import Model
from magpend_core.precision import Precision
from pipeline.compute import clients, execute
from pipeline.compute.clients import Where
from pipeline.compute.threads import writing_results
from pipeline.layout.vocabulary import split_dims
from pipeline.products.product import Analysis, Options, function_of
from pipeline.products.registry import ANALYSES
from pipeline.products.reporting import report
from pipeline.results.ragged import isel, joined
from pipeline.results.run import OpenRun
from pipeline.runs.stopping import stoppable
from pipeline.runs.versions import current, key_of
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import DERIVED, Files
from pipeline.store.products import BLOCKS, read_block, write_block

WANTED, FEWEST_CELLS, MOST_CELLS = 64, 1024, 8192
"""Number of blocks that is aimed at, and the fewest and most cells of a block of several points."""

Block = Mapping[str, slice]
PlacedRun = Any
"""Run with the place of its computation: `pipeline.runs.derive.AnalysedRun`."""


@dataclass(frozen=True)
class Part:
    """A run of which only a block of parameter points is analysed, see `pipeline.results.run.OpenRun`."""

    run: OpenRun
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


def blocks_of(run: PlacedRun) -> list[Block]:
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


def in_blocks(run: PlacedRun, analysis: Analysis, options: Options) -> xr.Dataset:
    """Compute an analysis in blocks, or those that are left of them.

    Parameters
    ----------
    run
        The run, with the workers and the scheduler.
    analysis, options
        Analysis with `by_point`, and its complete options.

    Raises
    ------
    TaskFailedError, SchedulerError
        As `pipeline.compute.execute.run_tasks`. Blocks that have ended stay.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. Blocks that have ended stay.
    """
    blocks = blocks_of(run)
    n = len(blocks)
    if n == 1:
        result: xr.Dataset = function_of(analysis.compute)(run, options)
        return result
    for other in analysis.builds_on:  # once, before workers ask for it
        run.derive(other)
    where = replace(_in_processes(run.where or Where()), place=run.info.files.place)
    clients.reach(where)
    key = key_of(current(run, analysis.name, options.plain()), analysis, options)
    task = partial(
        compute_block, type(run).of, run.info.files.place, run.digest, options, key, blocks, origin=origin(run.model)
    )
    missing = [k for k in range(n) if not _is_there(run.info.files, key, k)]
    done, what = n - len(missing), f"{analysis.name}, blocks of parameter points"
    if done:
        run.echo(f"{analysis.name}: {done} of {n} blocks done before")
    with stoppable(run.name):
        results = execute.run_tasks(task, missing, workers=run.workers, scheduler=where, echo=run.echo)
        with contextlib.closing(results):
            report(what, done, n)
            for k, _ in enumerate(results, done + 1):
                report(what, k, n)
    cells = run.cube()["status"]
    sizes = {d: cells.sizes[d] for d in split_dims(cells)[0]}
    return joined([read_block(run.info.files, _name(key, k)) for k in range(n)], blocks, sizes)


def _in_processes(where: Where) -> Where:
    """Return processes if no place was chosen: most of an analysis' time is Python's, which threads cannot share."""
    is_chosen = where.scheduler or where.resolved() != clients.THREADS
    return where if is_chosen else replace(where, scheduler=clients.PROCESSES)


def compute_block(
    opened: Callable[[str], PlacedRun],
    directory: str,
    digest: str,
    options: Options,
    key: Mapping[str, str],
    blocks: Sequence[Block],
    index: int,
    *,
    origin: tuple[str, str] | None = None,
) -> dict[str, Any]:
    """Compute and store one block of parameter points; a task of `pipeline.compute.execute.run_tasks`."""
    if origin is not None:
        import_model(*origin)
    run, known = _opened(opened, directory, digest)
    analysis = ANALYSES[key["derived_product"]]
    if key_of(current(run, analysis.name, options.plain()), analysis, options) != key:
        raise RefusedError(
            f"{directory}: this worker's magpend would not compute the same {analysis.name}; install the same version "
            "everywhere."
        )
    with using_threads(1), Precision.of(run.cube().attrs).used():
        result: xr.Dataset = function_of(analysis.compute)(Part(run, blocks[index], known), options)
    with writing_results():
        write_block(run.info.files, _name(key, index), result.assign_attrs(key))
    return {"block": index}


@lru_cache(maxsize=4)
def _opened(opened: Callable[[str], PlacedRun], directory: str, digest: str) -> tuple[PlacedRun, dict[str, xr.Dataset]]:
    """Open a run once per process for each state of its cells; return it with the results that it has derived."""
    return opened(directory), {}


def _name(key: Mapping[str, str], index: int) -> str:
    return f"{DERIVED}/{key['derived_product']}-{key['derived_key'][:8]}{BLOCKS}/{index:06d}.npz"


def _is_there(files: Files, key: Mapping[str, str], index: int) -> bool:
    try:
        attrs = read_block(files, _name(key, index)).attrs
    except (FileNotFoundError, DamagedError):
        return False
    return all(attrs.get(name) == value for name, value in key.items())
