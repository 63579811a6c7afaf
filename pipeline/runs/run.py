"""Compute all cells of a specification, and store them in a run directory."""

from __future__ import annotations

import contextlib
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from magpend_core.models.imported import origin
from pipeline.layout.conventions import unit_remarks
from pipeline.layout.evaluation import check_starts
from pipeline.layout.extents import size_remarks, with_sizes
from pipeline.layout.plan import Plan, check_space, make_plan
from pipeline.runs.methods import check_method, compile_kernel, decided
from pipeline.runs.noise import check_steps, warn_of_steps
from pipeline.runs.progress import Progress
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
    """Check what a specification computes, and plan it with the sizes of its states and its method.

    They are those that the run in the directory keeps, if there is one. Else the method may be undecided.

    Raises
    ------
    SpecError
        If the equations have no value at the starts, if steps of noise are too long, if the chosen method does not suit
        the system, or if the run is too large.
    """
    check_starts(spec)
    try:
        kept = read_run(files).parsed_spec() if is_run(files) else None
    except (DamagedError, RefusedError, OSError):
        kept = None
    plan = make_plan(with_sizes(spec, kept).keeping_method(kept), spec.text)
    check_steps(plan)
    check_method(plan.spec)
    return plan


class Work(NamedTuple):
    """A run to compute: its plan, the files of its directory, and runs whose cells are reused."""

    plan: Plan
    files: Files
    sources: Sources = ()


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
    carry_out_all([Work(plan, files, sources)], workers=workers, where=where, echo=echo)


def carry_out_all(works: Sequence[Work], *, workers: int | None, where: Where, echo: Echo) -> None:
    """Compute the missing tasks of several runs, as `carry_out` does for one; the workers share the tasks of all."""
    from pipeline.compute import clients

    for work in works:
        if work.plan.undecided:  # refuse a place where no run can be before cells are integrated for the decision
            check(work.files, work.plan.identity)
    works = [work._replace(plan=decided(work.plan, echo)) for work in works]
    new = [work for work in works if check(work.files, work.plan.identity) is None]
    for work in new:
        check_space(work.plan, work.files.local)
    if new:
        clients.reach(where)  # before anything is created
    for work in new:
        compile_kernel(work.plan, echo)
    with stoppable(works[0].files.name), contextlib.ExitStack() as locks:
        opened = []
        for work in works:
            is_alone = locks.enter_context(work.files.lock()) is not False
            info = establish(work.files, work.plan, echo, alone=is_alone)
            commits = sound_commits(info, echo, alone=is_alone)
            missing = [i for i in range(info.plan.n_tasks) if i not in commits]
            opened.append(_Opened(info, commits, missing, tuple(work.sources)))
        _complete(opened, workers, where, echo)


@dataclass(frozen=True)
class _Opened:
    """A run that is being computed, with the tasks that are committed and those that are missing."""

    info: RunInfo
    commits: Records
    missing: Sequence[int]
    sources: Sources

    @property
    def plan(self) -> Plan:
        return self.info.plan

    @property
    def n_left(self) -> int:
        """Number of cells that are not computed."""
        return sum(self.plan.cells_in(i) for i in self.missing)

    @property
    def job(self) -> Callable[[int], dict[str, Any]]:
        """Function that computes a task."""
        from pipeline.compute import task

        job = partial(task.run_task, self.info.files.place, self.info.digest, origin=origin(self.plan.spec.model))
        return partial(job, sources=self.sources) if self.sources else job


class _Tasks:
    """Tasks of several runs under one numbering: each run's follow on those of the run before it."""

    def __init__(self, runs: Sequence[_Opened]) -> None:
        self.runs = runs
        self.firsts = [0, *accumulate(run.plan.n_tasks for run in runs)][:-1]
        self.missing = [first + i for first, run in zip(self.firsts, runs, strict=True) for i in run.missing]

    @property
    def job(self) -> Callable[[int], dict[str, Any]]:
        """Function that computes a task, given by its number."""
        from pipeline.compute import task

        return partial(task.run_numbered, tuple(run.job for run in self.runs), tuple(self.firsts))

    def _plan(self, number: int) -> tuple[Plan, int]:
        """Return the plan of a task, and the number of the first task of this plan."""
        k = bisect_right(self.firsts, number) - 1
        return self.runs[k].plan, self.firsts[k]

    def predecessor(self, number: int) -> int | None:
        """Return the number of the task that a task continues, see `Plan.predecessor`."""
        plan, first = self._plan(number)
        before = plan.predecessor(number - first)
        return None if before is None else first + before

    def seconds(self, number: int) -> float:
        """Estimate the computing time of a task on one core [s]."""
        plan, first = self._plan(number)
        return plan.seconds(number - first)


def _complete(opened: Sequence[_Opened], workers: int | None, where: Where, echo: Echo) -> None:
    """Compute all tasks of some runs that are not committed."""
    from pipeline.compute import clients, execute

    # also of complete runs: a stop may have come between the last task and the packing of its block
    packed = [(run, Packer(run.info, run.commits)) for run in opened]
    for run in opened:
        if not run.missing:
            write_copy(run.info, run.commits)
            echo(f"{run.info.name} is complete; nothing to do.")
    runs, packers = [run for run in opened if run.missing], [packer for run, packer in packed if run.missing]
    if not runs:
        return
    for run in runs:
        remove_copy(run.info)
        check_space(run.plan, run.info.files.local, run.n_left)
    n_cells, n_tasks = sum(run.plan.n_cells for run in runs), sum(run.plan.n_tasks for run in runs)
    before = n_cells - sum(run.n_left for run in runs)
    echo(f"{n_cells} cells in {n_tasks} tasks" + (f", {before} cells done before" if before else ""))
    for line in start_remarks(runs[0].plan.spec.initial_conditions):
        echo(line)
    clients.reach(where)
    for run in runs:
        compile_kernel(run.plan, echo)
    tasks = _Tasks(runs)
    started = time.perf_counter()
    cores = max(1, min(workers or 1 if workers is not None else execute.default_workers(), len(tasks.missing)))
    expected_s = sum(run.plan.core_seconds * run.n_left / run.plan.n_cells for run in runs) / cores
    terminal = sys.stdout.isatty()
    with Progress(n_cells, before, terminal=terminal, echo=echo, expected_s=expected_s) as progress:
        results = execute.run_tasks(
            tasks.job,
            tasks.missing,
            after=None if all(run.plan.path is None for run in runs) else tasks.predecessor,
            seconds=tasks.seconds,
            workers=workers,
            scheduler=where,
            echo=echo,
        )
        # closed at once, also by an error or a signal: only then may others use the directory
        with contextlib.closing(results):
            for result in results:
                k = result.pop("run")
                log_timing(runs[k].info, {**result, "at_s": round(time.perf_counter() - started, 4)})
                packers[k].add(result["task"])
                progress.add(result["cells"])
    for run in runs:
        require_all(run.info, echo)
