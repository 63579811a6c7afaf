"""One task: a block of cells through the kernel into the store. The same function runs everywhere.

A task is named by the run directory, the run's digest and its index; it reads the rest from
``run.json``. Its result is a small dict; the numbers go straight to the store.
"""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core import Status, kernel_version, lyapunov_exponents, run_branches
from magpend_core.models.pendulum.systems import system_of
from pipeline.compute.refinement import infer
from pipeline.layout.cells import CellMap
from pipeline.layout.identity import digest_of, identity_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.schema import VARIABLES
from pipeline.products.lyapunov import exponents
from pipeline.spec.parsing import Spec, parse_spec
from pipeline.store.commits import write_task
from pipeline.store.errors import RefusedError
from pipeline.store.runfile import RunInfo, read_run


@lru_cache(maxsize=4)
def _prepare(directory: str, digest: str) -> tuple[RunInfo, Spec, Plan, CellMap]:
    """Read a run once per worker, and make sure that this installation would compute the same."""
    info = read_run(Path(directory))
    spec = parse_spec(info.spec)
    plan = make_plan(spec)
    if digest != info.digest or digest_of(identity_of(spec, plan, kernel_version())) != digest:
        raise RefusedError(
            f"{directory}: this worker's magpend would not compute the same run "
            f"(kernel {kernel_version()} here, {info.identity['kernel_version']} in the directory); "
            "install the same version everywhere."
        )
    return info, spec, plan, CellMap(spec)


def compute(spec: Spec, cells: CellMap, block: tuple[slice, ...]) -> dict[str, np.ndarray]:
    """Return all variables of a block of cells, in the block's shape."""
    inputs = cells.inputs(block)
    system = system_of(spec.parameters.load())
    integration = spec.integration.model_dump()

    def integrate(branches: Any) -> dict[str, np.ndarray]:
        result = run_branches(
            inputs.parameters[branches], inputs.frequency_hz[branches], inputs.initial_states[branches],
            system=system, **integration,
        )  # fmt: skip
        values = {v.name: np.asarray(getattr(result, v.name), dtype=v.dtype) for v in VARIABLES}
        if spec.products.lyapunov:
            frequency, parameters = inputs.frequency_hz[branches], inputs.parameters[branches]
            values |= exponents(parameters, frequency, result, spec, system)
        return values

    if spec.refine is None:
        values = integrate(slice(None))
    else:
        tile = tuple(s.stop - s.start for s in block[len(spec.axes) :])
        values = infer(
            tile, spec.refine, lambda branches: {k: v[:, 0] for k, v in integrate(branches).items()},
            closure_tolerance=spec.integration.closure_tolerance, system=system,
        )  # fmt: skip
        values = {name: array[:, None] for name, array in values.items()}
    return {name: cells.outputs(block, array) for name, array in values.items()}


def run_task(directory: str, digest: str, index: int) -> dict[str, Any]:
    """Compute a task and commit it.

    Returns
    -------
    dict
        Task, cells, cells by status, and the seconds taken by the kernel and by writing.
    """
    info, spec, plan, cells = _prepare(directory, digest)
    started = time.perf_counter()
    values = compute(spec, cells, plan.task(index))
    computed = time.perf_counter()
    codes, numbers = np.unique(values["status"], return_counts=True)
    counts = {Status(int(c)).name.lower(): int(n) for c, n in zip(codes, numbers, strict=True)}
    write_task(info, plan, index, values, counts)
    return {
        "task": index,
        "cells": plan.cells_in(index),
        "status": counts,
        "kernel_s": round(computed - started, 4),
        "write_s": round(time.perf_counter() - computed, 4),
    }


def warm_up(spec: Spec) -> float:
    """Compile the kernel that the run needs into the compile cache and return the seconds it took.

    One process compiles, so that workers find the machine code instead of each making it.
    """
    started = time.perf_counter()
    parameters = spec.parameters.load()
    packed, system = parameters.pack().reshape(1, 1, -1), system_of(parameters)
    options = {**spec.integration.model_dump(), "n_transient": 0, "n_keep": 1}
    run_branches(packed, np.full((1, 1), 2.0), np.zeros((1, 4)), system=system, **options)
    if spec.products.lyapunov:
        n_exponents, short = (
            spec.products.lyapunov.n_exponents,
            {"n_transient": 0, "n_periods": 2, "n_blocks": 2},
        )
        lyapunov_exponents(
            packed[0], np.full(1, 2.0), np.zeros((1, 4)), n_exponents=n_exponents, system=system, **short
        )
    return time.perf_counter() - started
