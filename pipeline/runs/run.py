"""Glue: a specification's file to a finished run directory."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models.imported import origin
from pipeline.layout.domains import check_starts
from pipeline.layout.identity import identity_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.products.reporting import report
from pipeline.runs.progress import Progress, duration
from pipeline.runs.status import State, state
from pipeline.runs.stopping import InterruptedRunError, stoppable
from pipeline.runs.workflows import default_directory, find_spec
from pipeline.spec.parsing import Spec, load_spec
from pipeline.store.commits import log_timing, read_commits, sweep
from pipeline.store.errors import IncompleteError
from pipeline.store.files import local_path, writer_lock
from pipeline.store.runfile import RunInfo
from pipeline.store.setup import check, establish

if TYPE_CHECKING:
    from pipeline.compute.clients import Where

__all__ = ["InterruptedRunError", "identity_here", "run"]

Echo = Callable[[str], None]


def run(
    spec: str | Path,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    dashboard: bool = False,
    smoke: bool = False,
    echo: Echo = print,
) -> State:
    """Run a specification, or what is missing of it.

    Where ``run.json``, metadata or coordinates of the directory are damaged, they are rebuilt from the
    specification, and committed cells that still fit their records stay.

    Parameters
    ----------
    spec
        Path of a TOML file, or the name of a shipped workflow.
    out
        Run directory; by default ``runs/<name>``.
    workers
        See `execute.run_tasks`.
    scheduler, cluster, dashboard
        See `clients.Where`.
    smoke
        Take the small size of the specification's ``[smoke]`` table.
    echo
        Prints a line.

    Returns
    -------
    State
        Of the finished run.

    Raises
    ------
    SpecError, RefusedError, LockedError
        Before anything is created or changed.
    addresses.SchedulerError
        If a scheduler or its workers cannot be used, or are lost; what was committed stays.
    UnreadableError
        If a file of the directory is there and cannot be read; nothing is removed.
    execute.TaskFailedError
        If tasks failed twice. All others are committed.
    IncompleteError
        If all tasks returned and not all are committed.
    InterruptedRunError
        After Ctrl-C, SIGTERM or SIGHUP. What was committed stays.
    """
    from pipeline.compute.clients import Where

    path = find_spec(spec)
    parsed = load_spec(path, smoke=smoke)
    directory = local_path(out) if out is not None else default_directory(path, smoke)
    where = Where(scheduler, Path(cluster) if cluster is not None else None, dashboard, directory)
    where.resolved()
    check_starts(parsed)
    plan = make_plan(parsed)
    identity = identity_here(parsed, plan)
    check(directory, identity)
    with stoppable(directory), writer_lock(directory):
        info = establish(directory, parsed, plan, identity, path.read_text("utf-8"), echo)
        _complete(info, parsed, plan, workers, where, echo)
    return state(directory)


def identity_here(spec: Spec, plan: Plan) -> dict[str, Any]:
    """What makes a run this one, with the numerical core that is installed here."""
    from magpend_core import kernel_version

    return identity_of(spec, plan, kernel_version())


def _complete(info: RunInfo, spec: Spec, plan: Plan, workers: int | None, where: Where, echo: Echo) -> None:
    """Compute all tasks without a valid commit record."""
    from pipeline.compute import clients, execute, task

    commits = read_commits(info, plan, echo)
    sweep(info, commits, echo)
    missing = [i for i in range(plan.n_tasks) if i not in commits]
    if not missing:
        echo(f"{info.directory} is complete; nothing to do.")
        return
    before = plan.n_cells - sum(plan.cells_in(i) for i in missing)
    echo(
        f"{plan.n_cells} cells in {plan.n_tasks} tasks" + (f", {before} cells done before" if before else "")
    )
    clients.reach(where)
    report("compiling the kernel", 0, 0)
    seconds = task.warm_up(spec)
    if seconds > 1:
        echo(f"kernel compiled in {duration(seconds)}")
    place = str(info.directory.absolute())
    job = partial(task.run_task, place, info.digest, origin=origin(spec.model))
    started = time.perf_counter()
    cores = max(1, min(workers or 1 if workers is not None else execute.default_workers(), len(missing)))
    expected_s = plan.core_seconds / cores * (1 - before / plan.n_cells)
    terminal = sys.stdout.isatty()
    with Progress(plan.n_cells, before, terminal=terminal, echo=echo, expected_s=expected_s) as progress:
        results = execute.run_tasks(
            job,
            missing,
            seconds=lambda i: plan.cells_in(i) * plan.seconds_per_cell,
            workers=workers,
            scheduler=where,
            echo=echo,
        )
        for result in results:
            log_timing(info.directory, {**result, "at_s": round(time.perf_counter() - started, 4)})
            progress.add(result["cells"])
    _require_all(info, plan)


def _require_all(info: RunInfo, plan: Plan) -> None:
    """Believe the commit records, not the workers."""
    problems: list[str] = []
    commits = read_commits(info, plan, problems.append)
    absent = [i for i in range(plan.n_tasks) if i not in commits]
    if absent:
        why = f" {problems[0]}." if problems else ""
        raise IncompleteError(
            f"{info.directory}: {len(absent)} of {plan.n_tasks} tasks were computed and are not committed "
            f"here (the first is {absent[0]}).{why} Every worker must see this very folder, by this path, "
            "and have room to write; then give the same command again: it computes these tasks alone."
        )
