"""Extend a run to a wider specification: copy the cells that are computed, and integrate the others.

A cell's numbers depend on its inputs alone, bit for bit. A wider run therefore has the same bytes whether it
begins from nothing or reuses the cells of other runs, which is faster. It is an ordinary run with its own
digest, written by the same protocol.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.layout.evaluation import check_starts
from pipeline.layout.extents import with_sizes
from pipeline.layout.identity import canonical, digest_of
from pipeline.layout.matching import NOWHERE, Finder, apart, way_of
from pipeline.layout.own_words import dims_in_own_words
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.writing import sync_folder
from pipeline.runs.preview import time_line
from pipeline.runs.progress import size
from pipeline.runs.run import Echo, carry_out
from pipeline.runs.status import State, state
from pipeline.runs.zoom import Widening, derived_toml, widened
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.errors import RefusedError
from pipeline.store.files import EXTENDED, TIMINGS, Files
from pipeline.store.objects import open_files
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import is_run


@dataclass(frozen=True)
class Extension:
    """Plan of a wider run, with the earlier runs from which it copies cells."""

    plan: Plan  # plan of the wider run
    runs: tuple[RunDirectory, ...]  # runs whose cells are reused
    counts: tuple[int, ...]  # number of reused cells of each
    notes: tuple[str, ...]  # remarks on runs that are incomplete or have no suitable cells

    @property
    def reused(self) -> int:
        """Number of cells that are copied from earlier runs."""
        return sum(self.counts)

    @property
    def digest(self) -> str:
        """Digest of everything that decides the numbers and the layout of the wider run."""
        return digest_of(self.plan.identity)

    @property
    def share(self) -> float:
        """Fraction of the wider run's integration that is left when cells are copied."""
        counts = zip(self.runs, self.counts, strict=True)
        left = self.plan.n_cells - self.reused + sum(count * self._more(run) for run, count in counts)
        return left / self.plan.n_cells

    def _more(self, run: RunDirectory) -> float:
        """Return the fraction of a cell's periods that must still be integrated after it is copied."""
        integration = self.plan.spec.integration
        n_more = integration.n_keep - run.spec.integration.n_keep
        return n_more / (integration.n_transient + integration.n_keep)

    def lines(self) -> Iterator[str]:
        """Yield text lines on how many cells are copied, and how many are left to compute."""
        yield from self.notes
        n = self.plan.n_cells
        for run, count in zip(self.runs, self.counts, strict=True):
            how = "continue from their last section in" if self._more(run) else "are reused from"
            yield f"{count} of {n} cells {how} {run.name}"
        bound = "at most " if self.plan.spec.refine is not None else ""
        yield f"{bound}{n - self.reused} cells are left to integrate"


def plan_extension(
    sources: Sequence[str | Path], spec: str | Path | None = None, widening: Widening | None = None
) -> Extension:
    """Plan a wider run that copies cells of earlier runs; no file is changed.

    Parameters
    ----------
    sources
        Run directories, complete or not. The first one is widened.
    spec
        The wider specification: a TOML file, or the name of a shipped workflow.
    widening
        Changes of the first run's own specification, or of `spec` if that is given.

    Raises
    ------
    SpecError
        If there is no wider specification, or it is not valid.
    RefusedError
        If no cell can be reused; the message lists the reasons.
    """
    runs = [RunDirectory.open(source) for source in sources]
    wide, text = _wide(runs[0], spec, widening or Widening())
    check_starts(wide)
    plan = make_plan(wide, text)
    fit, notes = fitting(runs, plan)
    counts = _census(plan, fit)
    if not sum(counts):
        reasons = notes + [line for run in fit for line in _strangers(run, plan)]
        raise RefusedError(
            "no cell can be reused, so a new run is as quick (magpend run SPEC --out NEW). "
            "Differences:\n  " + "\n  ".join(reasons)
        )
    return Extension(plan, tuple(fit), tuple(counts), tuple(notes))


def _wide(run: RunDirectory, spec: str | Path | None, widening: Widening) -> tuple[Spec, str]:
    """Return the specification of the wider run, as an object and as text."""
    if spec is None and not widening:
        raise SpecError("extend: nothing to change; give a wider SPEC, or an option such as --axis NAME=LOW:HIGH:NUM.")
    if spec is not None:
        path = find_spec(spec)
        parsed = with_sizes(Spec.read(path), run.spec).keeping_method(run.spec)
        if not widening:
            return parsed, path.read_text("utf-8")
        wide, origin = widened(parsed, widening), f"specification {path.name}"
    else:
        wide = widened(run.spec, widening)
        origin = f"run {Path(run.info.files.place).name}, digest {run.info.digest}"
    return wide, derived_toml("Extended", origin, wide)


def fitting(runs: Sequence[RunDirectory], plan: Plan) -> tuple[list[RunDirectory], list[str]]:
    """Select the earlier runs whose cells can be copied, with notes on the others."""
    from pipeline.compute.reuse import obstacles

    fit, notes = [], []
    for run in runs:
        lines = obstacles(run, plan)
        if lines:
            notes.append(f"{run.name}: none of its cells can be reused ({'; '.join(lines)})")
            continue
        fit.append(run)
        if not run.complete:
            some = f"only its {run.n_committed} of {run.plan.n_cells} committed cells are reused"
            notes.append(f"{run.name}: is not complete; {some}")
    return fit, notes


def _census(plan: Plan, runs: Sequence[RunDirectory]) -> list[int]:
    from pipeline.compute.reuse import Pool

    pool, counts = Pool(plan, runs), [0] * len(runs)
    for block in plan.tasks() if runs else ():
        for i, n in enumerate(pool.count(block)):
            counts[i] += n
    return counts


def _strangers(run: RunDirectory, plan: Plan) -> list[str]:
    """Return why none of the cells of an earlier run can be copied, although its settings fit."""
    if not run.commits:
        return [f"{run.name}: it has no committed cells"]
    return [f"{run.name}: {line}" for line in apart(run.plan.cells, plan.cells)]


def describe_extension(extension: Extension, *, workers: int | None = None) -> Iterator[str]:
    """Yield the text lines of a dry run: size, copied and remaining cells, and the estimated time."""
    plan, spec = extension.plan, extension.plan.spec
    if spec.title:
        yield spec.title
    dims = ", ".join(f"{d} {n}" for d, n in zip(dims_in_own_words(plan.dims, spec.rate), plan.shape, strict=True))
    yield f"{spec.kind}: {plan.n_cells} cells ({dims or 'one cell'}) in {plan.n_tasks} tasks"
    yield from extension.lines()
    yield f"cube: {size(plan.n_bytes)} before compression"
    yield time_line(plan, extension.share, plan.n_tasks, workers)


def extend(
    source: str | Path,
    spec: str | Path | None = None,
    out: str | Path | None = None,
    *,
    also: Sequence[str | Path] = (),
    axes: Mapping[str, Mapping[str, Any]] | None = None,
    starts: int | None = None,
    keep: int | None = None,
    products: Mapping[str, Mapping[str, Any]] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    dashboard: bool = False,
    echo: Echo = print,
) -> State:
    """Compute a wider run, in a new directory or in place of the old run; computed cells are copied.

    The result has the same bytes as a run of the wider specification from nothing. If it is killed at any
    moment, the same call continues. The runs whose cells are reused are only read; damaged cells are
    integrated again.

    Parameters
    ----------
    source
        Run directory, complete or not.
    spec
        The wider specification: a TOML file, or the name of a shipped workflow. By default the run's own,
        with the following changes.
    out
        Directory of the wider run. By default the complete wider run replaces `source`, and the old one is
        renamed to ``SOURCE.before``.
    also
        Other run directories with cells to reuse, such as another half that was computed elsewhere.
    axes
        New ranges by ``frequency_hz``, parameter, or state of a grid:
        ``{"frequency_hz": {"start": 2.0, "stop": 3.0, "num": 201}}``.
    starts
        Number of random initial states.
    keep
        Kept sections.
    products
        Additional products, with their options: ``{"lyapunov": {}}``.
    workers, scheduler, cluster, dashboard, echo
        See `pipeline.runs.run.run`.

    Returns
    -------
    State
        State of the wider run.

    Raises
    ------
    SpecError, RefusedError
        If no cell can be reused, or if cells would be lost; before anything is created.
    Exception
        See `pipeline.runs.run.run`.
    """
    from pipeline.compute.clients import Where

    widening = Widening(axes or {}, starts, keep, products or {})
    first = open_files(source)
    in_place = out is None or open_files(out).place == first.place
    built = open_files(extending_folder(_folder(first)) if in_place else str(out))
    where = Where(scheduler, Path(cluster) if cluster is not None else None, dashboard, built.place)
    where.resolved()
    how: dict[str, Any] = {"workers": workers, "where": where, "echo": echo}
    if in_place:
        finish_exchange(_folder(first), echo)
    extension = plan_extension((source, *also), spec, widening)
    if not in_place:
        return _build(extension, built, **how)
    old = RunDirectory.open(first)
    if extension.digest == old.info.digest:
        return _as_it_is(old, echo)
    _refuse_loss(old, extension.plan)
    with first.lock():
        _build(extension, built, **how)
        exchange(_folder(first), _folder(built), echo)
    return state(first)


def _build(extension: Extension, files: Files, *, echo: Echo, **how: Any) -> State:
    for line in extension.lines():
        echo(line)
    sources = [(run.info.files.place, run.info.digest) for run in extension.runs]
    carry_out(extension.plan, files, echo=echo, sources=sources, **how)
    echo(f"{_record(extension, files)} of {extension.plan.n_cells} cells were reused")
    return state(files)


def _record(extension: Extension, files: Files) -> int:
    """Write the file of runs from which cells were copied; return the number of cells copied.

    It is below the planned number if a source turned out to be damaged.
    """
    taken: dict[int, int] = {}
    with contextlib.suppress(FileNotFoundError):
        for line in files.read(TIMINGS).decode().splitlines():
            entry = json.loads(line)
            taken[entry["task"]] = entry.get("reused", 0)
    runs = zip(extension.runs, extension.counts, strict=True)
    content = {
        "sources": [
            {"directory": run.info.files.place, "digest": run.info.digest, "cells": count} for run, count in runs
        ],
        "cells": extension.plan.n_cells,
        "reused": (reused := sum(taken.values())),
    }
    files.write(EXTENDED, canonical(content).encode())
    return reused


# ---- in place ----------------------------------------------------------------------------------


def _folder(files: Files) -> Path:
    if files.local is None:
        raise RefusedError(f"{files.name}: is not a folder on this machine, so it cannot be replaced; give --out.")
    return files.local


def extending_folder(directory: Path) -> Path:
    """Return the folder ``NAME.extending`` in which the wider run is computed, before it replaces the old run."""
    real = directory.resolve()
    return real.with_name(f"{real.name}.extending")


def folder_aside(directory: Path) -> Path:
    """Return a path ``NAME.before...`` that does not exist yet, to which the old run is renamed."""
    real = directory.resolve()
    names = (real.with_name(f"{real.name}.before{i}") for i in ("", *(f".{n}" for n in range(2, 10_000))))
    return next(name for name in names if not name.exists())


def _as_it_is(run: RunDirectory, echo: Echo) -> State:
    if not run.complete:
        raise RefusedError(
            f"{run.name}: this is its own specification, and the run is not complete; complete it with: "
            f"magpend run SPEC --out {run.name}"
        )
    echo(f"{run.name} has all these cells already; nothing to do.")
    return state(run)


def _refuse_loss(run: RunDirectory, plan: Plan) -> None:
    """Raise RefusedError if the wider run lacks cells or products of the run that it would replace."""
    cells, finder, lost = run.plan.cells, Finder(plan.cells), 0
    for index in run.commits:
        block = run.plan.task(index)
        lost += int((finder.find(cells.inputs(block), way_of(cells, block)) == NOWHERE).sum())
    absent = [name for name in run.spec.products if name not in plan.spec.products]
    what = [f"{lost} of its cells"] if lost else []
    what += [f"its product {name}" for name in absent]
    if what:
        raise RefusedError(
            f"{run.name}: {' and '.join(what)} would be lost, because the wider run replaces this "
            "run and lacks them; give another directory with --out, or a specification that includes them."
        )


def exchange(directory: Path, built: Path, echo: Echo) -> None:
    """Replace a run directory by the finished wider run; the old run is renamed and stays."""
    real, aside = directory.resolve(), folder_aside(directory)
    real.rename(aside)
    sync_folder(real.parent)
    built.rename(real)
    sync_folder(real.parent)
    echo(f"the old run is in {aside}; remove it when you no longer need it")


def finish_exchange(directory: Path, echo: Echo) -> None:
    """Finish an interrupted replacement: give the wider run the name of the old run."""
    built = extending_folder(directory)
    if directory.exists() or not is_run(open_files(built)):
        return
    if not state(built).complete:
        raise RefusedError(f"{directory}: is missing, and {built} is not complete; restore one of them.")
    built.rename(directory)
    sync_folder(directory.parent)
    echo(f"{directory}: the complete extension has replaced it")
