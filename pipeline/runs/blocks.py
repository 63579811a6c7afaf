"""Compute an analysis in blocks of parameter points, on the same threads, processes and dask workers as a run.

Each block is stored as it ends, in ``derived/NAME-KEY.blocks``, until the whole result is. So an analysis that was
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
from pipeline.analysis.ragged import isel, joined
from pipeline.compute import clients, execute
from pipeline.compute.clients import Where
from pipeline.compute.threads import writing_results
from pipeline.layout.vocabulary import split_dims
from pipeline.products.product import Analysis, Options, function_of
from pipeline.products.registry import ANALYSES
from pipeline.products.reporting import report
from pipeline.runs.derive import AnalysedRun, key_of, refused
from pipeline.runs.stopping import stoppable
from pipeline.specification.parsing import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import Files
from pipeline.store.places import open_files
from pipeline.store.products import BLOCKS, open_product, read_product_attrs, remove_product, write_product

WANTED, FEWEST_CELLS, MOST_CELLS = 64, 1024, 16_384
"""Number of blocks that is aimed at, and the fewest and most cells of a block of several points."""

Block = Mapping[str, slice]


@dataclass(frozen=True)
class Part:
    """A run of which only a block of parameter points is analysed, see `pipeline.analysis.run.Run`."""

    run: AnalysedRun
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


def blocks_of(run: AnalysedRun) -> list[Block]:
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


def in_blocks(run: AnalysedRun, analysis: Analysis, options: Options, place: Files) -> xr.Dataset:
    """Compute an analysis in blocks, or what is left of them.

    Parameters
    ----------
    run
        The run, with the workers and the scheduler.
    analysis, options
        Analysis with `by_point`, and its complete options.
    place
        Place of the whole result, beside which its blocks lie.

    Raises
    ------
    TaskFailedError, SchedulerError
        As `pipeline.compute.execute.run_tasks`. Blocks that have ended stay.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. Blocks that have ended stay.
    """
    blocks = blocks_of(run)
    if len(blocks) == 1:
        result: xr.Dataset = function_of(analysis.compute)(run, options)
        return result
    for other in analysis.builds_on:  # once, before workers ask for it
        run.derive(other, **options.part(ANALYSES[other].options))
    where = replace(_in_processes(run.where), place=run.info.files.place)
    clients.reach(where)
    key = key_of(run, analysis, options)
    folder = _folder(place)
    task = partial(
        compute_block,
        run.info.files.place,
        run.digest,
        analysis.name,
        options.model_dump_json(),
        key,
        folder.place,
        blocks,
        origin=origin(run.model),
    )
    parts = [folder.below(_name(k)) for k in range(len(blocks))]
    missing = [k for k, part in enumerate(parts) if not _is_there(part, key)]
    done, what = len(blocks) - len(missing), f"{analysis.name}, blocks of parameter points"
    if done:
        run.echo(f"{analysis.name}: {done} of {len(blocks)} blocks done before")
    with stoppable(run.name):
        results = execute.run_tasks(task, missing, workers=run.workers, scheduler=where, echo=run.echo)
        with contextlib.closing(results):
            report(what, done, len(blocks))
            for n, _ in enumerate(results, done + 1):
                report(what, n, len(blocks))
    cells = run.cube()["status"]
    whole = joined([open_product(part) for part in parts], blocks, {d: cells.sizes[d] for d in split_dims(cells)[0]})
    return whole.drop_attrs(deep=False).assign_attrs({k: v for k, v in whole.attrs.items() if k not in key})


def _in_processes(where: Where) -> Where:
    """Return processes if no place was chosen: most of an analysis' time is Python's, which threads cannot share."""
    is_chosen = where.scheduler or where.resolved() != clients.THREADS
    return where if is_chosen else replace(where, scheduler=clients.PROCESSES)


def remove_blocks(place: Files) -> None:
    """Remove the blocks of a result, of which nothing is left to compute."""
    folder = _folder(place)
    with contextlib.suppress(FileNotFoundError):
        for name in folder.names():
            remove_product(folder.below(name))
        if folder.local is not None:
            folder.local.rmdir()


def compute_block(
    directory: str,
    digest: str,
    name: str,
    options: str,
    key: Mapping[str, str],
    folder: str,
    blocks: Sequence[Block],
    index: int,
    *,
    origin: tuple[str, str] | None = None,
) -> dict[str, Any]:
    """Compute and store one block of an analysis; a task of `pipeline.compute.execute.run_tasks`."""
    if origin is not None:
        import_model(*origin)
    run, known = _opened(directory, digest)
    analysis = ANALYSES[name]
    asked = analysis.options.model_validate_json(options)
    if key_of(run, analysis, asked) != key:
        raise RefusedError(
            f"{directory}: this worker's magpend would not compute the same {name}; install the same version "
            "everywhere."
        )
    with refused(directory), using_threads(1):
        result: xr.Dataset = function_of(analysis.compute)(Part(run, blocks[index], known), asked)
    with writing_results():
        write_product(open_files(folder).below(_name(index)), result.assign_attrs(key))
    return {"block": index}


@lru_cache(maxsize=4)
def _opened(directory: str, digest: str) -> tuple[AnalysedRun, dict[str, xr.Dataset]]:
    """Open a run once per process for each state of its cells; return it with the results that it has derived."""
    return AnalysedRun.of(directory), {}


def _folder(place: Files) -> Files:
    return open_files(place.place.removesuffix(".zarr") + BLOCKS)


def _name(index: int) -> str:
    return f"{index:06d}.zarr"


def _is_there(part: Files, key: Mapping[str, str]) -> bool:
    try:
        attrs = read_product_attrs(part)
    except (FileNotFoundError, DamagedError):
        return False
    return all(attrs.get(name) == value for name, value in key.items())
