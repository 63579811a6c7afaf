"""Compute one task of a run: integrate a block of cells, and commit the results to the store.

A task is named by the run directory, the run's digest and its index; it reads the rest from
``run.json``. Its result is a small dict; the numbers go straight to the store.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from magpend_core import Status
from magpend_core.engine.threads import using_threads
from magpend_core.models import import_object
from pipeline.compute.integrate import WALKED, Integrate, going_on, integrate
from pipeline.compute.refinement import infer
from pipeline.compute.threads import writing_results
from pipeline.layout.identity import differences, numbered
from pipeline.layout.plan import Plan
from pipeline.motion.steady import Inputs
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.store.errors import RefusedError
from pipeline.store.reading import read_cells
from pipeline.store.runfile import RunInfo, read_run
from pipeline.store.tasks import write_task

_PREPARING = threading.Lock()
"""Lock for reading a run and those that it copies from: the first of its threads reads them for all."""


@lru_cache(maxsize=4)
def _prepare(directory: str, digest: str, origin: tuple[str, str] | None) -> RunInfo:
    """Read the run of a task, once per process; raise `RefusedError` if this worker would compute other results."""
    if origin is not None:
        import_object(*origin)
    info = read_run(directory)
    different = differences(numbered(info.identity), info.plan.identity)
    if digest != info.digest or different:
        why = "; ".join(different) or "another run was begun in the directory"
        raise RefusedError(
            f"{directory}: this worker's magpend would not compute the same run ({why}); "
            "install the same version everywhere."
        )
    return info


def compute(
    plan: Plan,
    block: tuple[slice, ...],
    before: Mapping[str, np.ndarray] | None = None,
    integrate: Integrate = integrate,
) -> dict[str, np.ndarray]:
    """Compute all variables of a block of cells, and return them in the block's shape.

    `before` has variables of the last computed cells of branches that began in an earlier block.
    """
    spec, cells = plan.spec, plan.cells
    inputs = cells.inputs(block)
    if before is not None:
        inputs = going_on(inputs, before)
    if spec.refine is None:
        values = integrate(spec, inputs)
    else:
        tile = tuple(s.stop - s.start for s in block[len(spec.axes) :])
        values = infer(
            tile,
            spec.refine,
            lambda rows: {k: v[:, 0] for k, v in integrate(spec, inputs.take(rows)).items()},
            closure_tolerance=spec.integration.closure_tolerance,
            system=spec.model.system.plain,
        )
        values = {name: array[:, None] for name, array in values.items()}
    return {name: cells.outputs(block, array) for name, array in values.items()}


def run_task(
    directory: str,
    digest: str,
    index: int,
    *,
    origin: tuple[str, str] | None = None,
    sources: tuple[tuple[str, str], ...] = (),
) -> dict[str, Any]:
    """Compute one task of a run, and commit its results to the store.

    `origin` is the place and folder of a model given as a Python object, as named by the user who began the run;
    `sources` are directories and digests of runs from which cells are copied, see `compute.reuse`. Return task, cells,
    cells by status, and the seconds taken by the kernel and by writing; with `sources` how many cells were taken.
    """
    with _PREPARING:
        info = _prepare(directory, digest, origin)
    plan, started = info.plan, time.perf_counter()
    taken: list[int] = []
    how = _taking(info, sources, plan.task(index), taken)
    with using_threads(1):  # the tasks keep the cores busy
        values = compute(plan, plan.task(index), **_left(info, index), **how)
    computed = time.perf_counter()
    codes, numbers = np.unique(values["status"], return_counts=True)
    counts = {Status(int(c)).name.lower(): int(n) for c, n in zip(codes, numbers, strict=True)}
    with writing_results():
        write_task(info, index, values, counts)
    return {
        "task": index,
        "cells": plan.cells_in(index),
        "status": counts,
        "kernel_s": round(computed - started, 4),
        "write_s": round(time.perf_counter() - computed, 4),
        **({"reused": sum(taken)} if sources else {}),
    }


def run_numbered(jobs: Sequence[Callable[[int], dict[str, Any]]], firsts: Sequence[int], number: int) -> dict[str, Any]:
    """Compute one task of several runs whose tasks have one numbering; the result's ``run`` is the index of its run.

    `jobs` compute a task of each run, see `run_task`; `firsts` are the numbers of the runs' first tasks.
    """
    k = bisect_right(firsts, number) - 1
    return {**jobs[k](number - firsts[k]), "run": k}


def _left(info: RunInfo, index: int) -> dict[str, Any]:
    """Read the states in which the preceding task, if there is one, left the branches of this task."""
    plan = info.plan
    predecessor = plan.predecessor(index)
    if predecessor is None:
        return {}
    names = [v.name for v in plan.variables if v.name in WALKED]
    region = plan.cells.last_cells(plan.task(predecessor))
    return {"before": read_cells(info, predecessor, region, names)}


def _taking(
    info: RunInfo, sources: tuple[tuple[str, str], ...], block: tuple[slice, ...], taken: list[int]
) -> dict[str, Any]:
    """Return, if there are `sources`, a function ``integrate`` for `compute` that copies cells from them."""
    if not sources:
        return {}
    from pipeline.compute.reuse import pool_of

    with _PREPARING:
        pool = pool_of(info.files.place, info.digest, sources)
    return {"integrate": pool.integrator(block, taken)}


def warm_up(plan: Plan) -> float:
    """Compile the functions that a run needs into the compile cache; return the time that this took [s].

    It is compiled once, before threads or workers need it: what they will do is done here for a single cell over no
    more than a few periods.
    """
    started, spec, cells = time.perf_counter(), plan.spec, plan.cells
    short = Inputs(spec.values.pack().reshape(1, 1, -1), np.ones((1, 1)), np.zeros((1, len(spec.model.states))))
    if spec.section is not None:  # products go on from cells that return, so from one that may
        short = cells.inputs(tuple(slice(0, 1) if i != cells.path else slice(0, n) for i, n in enumerate(cells.shape)))
        short = Inputs(short.parameters[:1, :1], short.frequency_hz[:1, :1], short.initial_states[:1])
    integration = spec.integration.model_copy(update={"n_transient": 0, "n_keep": 1})
    products = {name: CELL_PRODUCTS[name].shortest(options) for name, options in spec.products.items()}
    integrate(spec.replace(integration=integration, products=products), short)
    return time.perf_counter() - started
