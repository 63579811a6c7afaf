"""Compute an analysis in blocks, on the same threads, processes and dask workers as a run.

A block is a block of parameter points, or some of the parts that an analysis declares as independent of each other
(curves, motions). Each block is stored as it ends, in ``derived/NAME-KEY.blocks/``, until the whole result is. So an
analysis that was stopped goes on. Blocks do not depend on workers, and the result does not depend on blocks.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.threads import number_of_threads, using_threads
from magpend_core.models import import_object
from magpend_core.models.imported import origin
from magpend_core.models.model import Model
from magpend_core.precision import Precision
from pipeline.compute import clients, execute
from pipeline.compute.clients import Where
from pipeline.compute.threads import writing_results
from pipeline.layout.vocabulary import split_dims
from pipeline.products.product import Analysis, Options, function_of
from pipeline.products.registry import ANALYSES
from pipeline.products.reporting import report, unheard
from pipeline.results.ragged import isel, joined, stacked
from pipeline.results.run import OpenRun
from pipeline.runs.stopping import stoppable
from pipeline.runs.versions import current, key_of
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import DERIVED, Files
from pipeline.store.products import BLOCKS, read_block, write_block

WANTED = 64
"""Number of blocks of parts that is aimed at."""

WANTED_OF_POINTS, FEWEST_CELLS, MOST_CELLS = 8, 1024, 8192
"""Number of blocks of parameter points that is aimed at, and the fewest and most cells of a block of several points.
Each block calls the engine anew, so many small ones cost more.
"""

WORTH_PROCESSES = 20.0
"""CPU time of the work that is left from which processes are started for it [s]; a start costs each about 2 s."""

Block = Any
"""Slices of parameter points by dim, or a list of parts."""
PlacedRun = Any
"""Run with the place of its computation: `pipeline.runs.derive.AnalysedRun`."""


@dataclass(frozen=True)
class Part:
    """A run of which only a block of parameter points is analysed, see `pipeline.results.run.OpenRun`."""

    run: OpenRun
    block: Mapping[str, slice]
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

    def branch_options(self, parameter: str) -> Any:
        """Return the options of the run's branches along a parameter."""
        return self.run.branch_options(parameter)


def computed_at_once(run: PlacedRun, analysis: Analysis, options: Options) -> xr.Dataset:
    """Compute the whole result of an analysis in the calling thread."""
    given = [function_of(analysis.parts)(run, options)] if analysis.parts else []
    result: xr.Dataset = function_of(analysis.compute)(run, options, *given)
    return result


def divided(run: PlacedRun, analysis: Analysis, options: Options) -> list[Block]:
    """Divide the parameter points of an analysis, or its parts, into blocks."""
    if not analysis.parts:
        return blocks_of(run)
    parts = function_of(analysis.parts)(run, options)
    n = max(analysis.together, -(-len(parts) // WANTED))
    return [parts[first : first + n] for first in range(0, len(parts), n)]


def blocks_of(run: PlacedRun) -> list[Mapping[str, slice]]:
    """Divide the parameter points of a run into blocks, in the C order of the points; align them with the tasks."""
    cells = run.cube()["status"]
    dims, starts = split_dims(cells)
    n_starts = int(np.prod([cells.sizes[d] for d in starts]))
    left = max(1, int(np.clip(cells.size // WANTED_OF_POINTS, FEWEST_CELLS, MOST_CELLS)) // n_starts)
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
        Analysis with `by_point` or `parts`, and its complete options.

    Raises
    ------
    TaskFailedError, SchedulerError
        As `pipeline.compute.execute.run_tasks`. Blocks that have ended stay.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. Blocks that have ended stay.
    """
    blocks = divided(run, analysis, options)
    n = len(blocks)
    if n <= 1:
        return computed_at_once(run, analysis, options)
    for other in analysis.builds_on if analysis.by_point else ():  # once, before workers ask for it
        run.derive(other)
    chosen = run.where or Where()
    where = replace(_in_processes(chosen), place=run.info.files.place)
    clients.reach(where)
    key = key_of(current(run, analysis.name, options.plain()), analysis, options)
    task = partial(
        compute_block, type(run).of, run.info.files.place, run.digest, options, key, blocks, origin=origin(run.model)
    )
    missing = [k for k in range(n) if not _is_there(run.info.files, key, k, n)]
    done, what = n - len(missing), f"{analysis.name}, blocks{' of parameter points' if analysis.by_point else ''}"
    if done:
        run.echo(f"{analysis.name}: {done} of {n} blocks done before")
    report(what, done, n)
    with stoppable(run.name):
        if where.scheduler != chosen.scheduler:  # no place was chosen
            missing = _begun_here(task, missing, what, n)
        results = execute.run_tasks(task, missing, workers=run.workers, scheduler=where, echo=run.echo)
        with contextlib.closing(results):
            for k, _ in enumerate(results, n - len(missing) + 1):
                report(what, k, n)
    found = [read_block(run.info.files, _name(key, k, n)) for k in range(n)]
    if analysis.parts:
        return stacked(found, analysis.rows)
    cells = run.cube()["status"]
    return joined(found, blocks, {d: cells.sizes[d] for d in split_dims(cells)[0]})


def _begun_here(task: Callable[..., Any], missing: list[int], what: str, n: int) -> list[int]:
    """Compute blocks in the calling thread, and return those that are left once they are worth processes.

    They share rows among threads of the engine, as an analysis without blocks does.
    """
    compiling = 10.0  # CPU time of the first block that may be the compiler's [s]
    while missing:
        started = time.process_time()
        task(missing[0], threads=None)
        missing = missing[1:]
        report(what, n - len(missing), n)
        if (time.process_time() - started - compiling) * len(missing) > WORTH_PROCESSES:
            break
        compiling = 0.0
    return missing


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
    threads: int | None = 1,
    origin: tuple[str, str] | None = None,
) -> dict[str, Any]:
    """Compute and store one block; a task of `pipeline.compute.execute.run_tasks`.

    `threads` is the number of threads of the engine; None takes that of the context.
    """
    if origin is not None:
        import_object(*origin)
    run, known = _opened(opened, directory, digest)
    analysis = ANALYSES[key["derived_product"]]
    if key_of(current(run, analysis.name, options.plain()), analysis, options) != key:
        raise RefusedError(
            f"{directory}: this worker's magpend would not compute the same {analysis.name}; install the same version "
            "everywhere."
        )
    given = (
        (Part(run, {}, known), options, blocks[index]) if analysis.parts else (Part(run, blocks[index], known), options)
    )
    with unheard(), using_threads(threads or number_of_threads()), Precision.of(run.cube().attrs).used():
        result: xr.Dataset = function_of(analysis.compute)(*given)
    with writing_results():
        write_block(run.info.files, _name(key, index, len(blocks)), result.assign_attrs(key))
    return {"block": index}


@lru_cache(maxsize=4)
def _opened(opened: Callable[[str], PlacedRun], directory: str, digest: str) -> tuple[PlacedRun, dict[str, xr.Dataset]]:
    """Open a run once per process for each state of its cells; return it with the results that it has derived."""
    return opened(directory), {}


def _name(key: Mapping[str, str], index: int, n: int) -> str:
    """Return the path of one of `n` blocks: another number of blocks divides the points otherwise."""
    return f"{DERIVED}/{key['derived_product']}-{key['derived_key'][:8]}{BLOCKS}/{index:06d}-of-{n}.npz"


def _is_there(files: Files, key: Mapping[str, str], index: int, n: int) -> bool:
    try:
        attrs = read_block(files, _name(key, index, n)).attrs
    except (FileNotFoundError, DamagedError):
        return False
    return all(attrs.get(name) == value for name, value in key.items())
