"""Compute all cells of a specification, and store them in a run directory."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models.imported import origin
from pipeline.layout.conventions import unit_remarks
from pipeline.layout.evaluation import check_starts
from pipeline.layout.extents import size_remarks, with_sizes
from pipeline.layout.plan import Plan, check_space, make_plan
from pipeline.runs.noise import check_steps, warn_of_steps
from pipeline.runs.progress import Progress, duration
from pipeline.runs.stopping import InterruptedRunError, stoppable
from pipeline.specification.spec import Spec
from pipeline.specification.starts import start_remarks
from pipeline.store.checking import require_all, sound_commits
from pipeline.store.commits import Packer, log_timing
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import Files
from pipeline.store.objects import open_files
from pipeline.store.record_copy import remove_copy, write_copy
from pipeline.store.records import Records
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import RunInfo, is_run, read_run
from pipeline.store.setup import check, establish

if TYPE_CHECKING:
    from pipeline.compute.clients import Where

__all__ = ["InterruptedRunError", "carry_out", "run"]

Echo = Callable[[str], None]
Sources = Sequence[tuple[str, str]]
"""Directories and digests of runs whose cells are reused."""


def run(
    spec: str | Path | Mapping[str, Any] | Spec,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    dashboard: bool = False,
    smoke: bool = False,
    echo: Echo = print,
) -> RunDirectory:
    """Compute the tasks of a specification that its run directory lacks, and open the finished run.

    Damaged ``run.json``, metadata or coordinates are rebuilt from the specification. Committed cells that fit
    their records stay.

    Parameters
    ----------
    spec
        Path of a TOML file, or the name of a shipped workflow; or a specification as TOML text or as a table,
        with files relative to the current folder.
    out
        Run directory; by default ``runs/<name>``. For a text or a table the name is its model's with a
        digest.
    workers
        See `execute.run_tasks`.
    scheduler, cluster, dashboard
        See `clients.Where`.
    smoke
        Whether to apply the specification's ``[smoke]`` table.
    echo
        Function that prints a line.

    Returns
    -------
    RunDirectory
        The finished run.

    Raises
    ------
    SpecError, RefusedError, LockedError
        If the specification is wrong, or the directory cannot be used; before anything is created or changed.
    addresses.SchedulerError
        If a scheduler or its workers cannot be used, or are lost. Committed tasks stay.
    UnreadableError
        If a file of the directory exists and cannot be read; nothing is removed.
    execute.TaskFailedError
        If tasks failed twice. All others are committed.
    IncompleteError
        If all tasks returned and not all are committed.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. Committed tasks stay.
    """
    from pipeline.compute.clients import Where

    parsed = Spec.read(spec, smoke=smoke)
    files = open_files(out if out is not None else parsed.directory)
    where = Where(scheduler, Path(cluster) if cluster is not None else None, dashboard, files.place)
    where.resolved()
    plan = prepare(parsed, files)
    for remark in (*plan.spec.model.flow.remarks, *unit_remarks(plan.spec.model)):
        echo(f"warning: {remark}")
    for line in size_remarks(plan.spec):
        echo(line)
    carry_out(plan, files, workers=workers, where=where, echo=echo)
    finished = RunDirectory.open(files)
    warn_of_steps(finished, echo)
    return finished


def prepare(spec: Spec, files: Files) -> Plan:
    """Check what a specification computes, and plan it with the sizes of its states.

    The sizes are those that the run in the directory keeps, if there is one.

    Raises
    ------
    SpecError
        If the equations have no value at the starts, if steps of noise are too long, or if the run is too large.
    """
    check_starts(spec)
    try:
        kept = read_run(files).parsed_spec() if is_run(files) else None
    except (DamagedError, RefusedError, OSError):
        kept = None
    plan = make_plan(with_sizes(spec, kept), spec.text)
    check_steps(plan)
    return plan


def carry_out(
    plan: Plan, files: Files, *, workers: int | None, where: Where, echo: Echo, sources: Sources = ()
) -> None:
    """Compute the missing tasks of a plan in a run directory, which is created if it does not exist.

    Parameters
    ----------
    plan
        Plan of the run.
    files
        Files of the run directory.
    workers, echo
        See `run`.
    where
        Scheduler that computes the tasks.
    sources
        Runs whose cells are reused, see `pipeline.runs.extend`.

    Raises
    ------
    Exception
        See `run`.
    """
    from pipeline.compute import clients

    if check(files, plan.identity) is None:
        check_space(plan, files.local)
        clients.reach(where)  # before anything is created
        _compile(plan, echo)
    with stoppable(files.name), files.lock() as alone:
        is_alone = alone is not False
        info = establish(files, plan, echo, alone=is_alone)
        commits = sound_commits(info, echo, alone=is_alone)
        _complete(info, commits, workers, where, echo, sources)


def _complete(info: RunInfo, commits: Records, workers: int | None, where: Where, echo: Echo, sources: Sources) -> None:
    """Compute all tasks of a run that are not committed."""
    from pipeline.compute import clients, execute, task

    plan, packer = info.plan, Packer(info, commits)
    missing = [i for i in range(plan.n_tasks) if i not in commits]
    if not missing:
        write_copy(info, commits)
        echo(f"{info.name} is complete; nothing to do.")
        return
    remove_copy(info)
    before = plan.n_cells - sum(plan.cells_in(i) for i in missing)
    check_space(plan, info.files.local, plan.n_cells - before)
    echo(f"{plan.n_cells} cells in {plan.n_tasks} tasks" + (f", {before} cells done before" if before else ""))
    for line in start_remarks(plan.spec.initial_conditions):
        echo(line)
    clients.reach(where)
    _compile(plan, echo)
    job = partial(task.run_task, info.files.place, info.digest, origin=origin(plan.spec.model))
    if sources:
        job = partial(job, sources=tuple(sources))
    started = time.perf_counter()
    cores = max(1, min(workers or 1 if workers is not None else execute.default_workers(), len(missing)))
    expected_s = plan.core_seconds / cores * (1 - before / plan.n_cells)
    terminal = sys.stdout.isatty()
    with Progress(plan.n_cells, before, terminal=terminal, echo=echo, expected_s=expected_s) as progress:
        results = execute.run_tasks(
            job,
            missing,
            after=None if plan.path is None else plan.predecessor,
            seconds=plan.seconds,
            workers=workers,
            scheduler=where,
            echo=echo,
        )
        # closed at once, also by an error or a signal: only then may others use the directory
        with contextlib.closing(results):
            for result in results:
                log_timing(info, {**result, "at_s": round(time.perf_counter() - started, 4)})
                packer.add(result["task"])
                progress.add(result["cells"])
    require_all(info, echo)


def _compile(plan: Plan, echo: Echo) -> None:
    """Compile what a run needs, which also checks its model; do nothing for what is compiled already."""
    from pipeline.compute import task

    seconds = task.warm_up(plan)
    if seconds > 1:
        echo(f"kernel compiled in {duration(seconds)}")
