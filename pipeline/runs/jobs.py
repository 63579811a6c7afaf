"""Size the jobs of a batch system from the work of a run, and write the script of the job that coordinates it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.layout.plan import Plan, periods_per_cell
from pipeline.runs.estimate import estimate, wall_seconds, writing_seconds
from pipeline.runs.progress import size, whole
from pipeline.specification.clusters import (
    SYSTEMS,
    Cluster,
    bytes_of,
    clock,
    hours_and_minutes,
    refuse_breaks,
    seconds_of,
)

AIM_S = 1800.0
"""Time that a job is given enough cores for [s]: short enough to start soon, long enough to be worth a job."""

MOST_UNASKED = 16
"""Most cores of a job that are asked for unless they are given: nearly every node has them."""

START_BYTES, WORKER_BYTES, TASKS_HELD = 10**9, 5 * 10**8, 3
"""Memory of the coordinator and of a worker process [bytes]; a worker holds this many times the results of a task."""

SAFETY, EXTRA_S, STEP_S = 2.0, 600.0, 300
"""Wall time: this many times the estimate and these seconds more, rounded up to a multiple of the last [s]."""

LONG_S = 86400.0
"""Time of one job above which several jobs are proposed [s]."""


@dataclass(frozen=True)
class Work:
    """The work that a run still has to do, measured on this machine."""

    # cells of the run, and those that are not computed yet
    n_cells: int
    n_left: int
    # tasks of the run, and those that are not committed yet
    n_tasks: int
    n_tasks_left: int
    n_parallel: int  # most tasks that can run at a time
    periods: float  # most drive periods (returns of a flow) of the cells that are left, with those of their products
    seconds: float  # time of one core for all of it [s]
    how: str  # phrase on how it was measured
    # size of the cube and of a task's results, before compression [bytes]
    n_bytes: int
    task_bytes: int

    def wall(self, cores: int) -> float:
        """Estimate the time by the clock on a number of cores [s]."""
        return wall_seconds(self.seconds, max(self.n_tasks_left, 1), max(1, min(cores, self.n_parallel)))

    def lines(self) -> list[str]:
        """Return text lines on the cells, tasks and time."""
        left = "" if self.n_left == self.n_cells else f", {self.n_left} of them left"
        return [
            f"work: {self.n_cells} cells in {self.n_tasks} tasks{left}; at most {self.periods:.3g} periods; cube "
            f"{size(self.n_bytes)} before compression",
            f"time: about {whole(self.seconds)} of one core ({self.how})",
        ]


def measure(plan: Plan, done: Container[int]) -> Work:
    """Measure the work that a run still has to do, as ``magpend run --dry-run`` does."""
    left = [index for index in range(plan.n_tasks) if index not in done]
    n_left = sum(plan.cells_in(index) for index in left)
    seconds, how = 0.0, "nothing is left to compute"
    if left:
        found = estimate(plan)
        seconds = found.core_seconds * n_left / plan.n_cells + len(left) * writing_seconds(plan)
        how = found.how
    in_turn = 1 if plan.path is None else plan.task_grid[plan.path]
    return Work(
        n_cells=plan.n_cells,
        n_left=n_left,
        n_tasks=plan.n_tasks,
        n_tasks_left=len(left),
        n_parallel=max(1, min(len(left), plan.n_tasks // in_turn)),
        periods=n_left * sum(periods_per_cell(plan.spec)),
        seconds=seconds,
        how=how,
        n_bytes=plan.n_bytes,
        task_bytes=plan.n_bytes // plan.n_tasks,
    )


def complete(given: Mapping[str, Any], work: Work) -> tuple[dict[str, Any], dict[str, str]]:
    """Fill in the cores, the memory and the wall time of a job where they are not given.

    Parameters
    ----------
    given
        Values of the ``[cluster]`` table; they are not changed.
    work
        Work of the run.

    Returns
    -------
    table : dict
        The values, complete.
    reasons : dict of str
        Reason for each value that was filled in, by key.
    """
    table, reasons = dict(given), {}
    if "cores" not in table:
        table["cores"], reasons["cores"] = _cores(work, table)
    cores = table["cores"] if isinstance(table["cores"], int) else 1
    if "memory" not in table:
        each = WORKER_BYTES + TASKS_HELD * work.task_bytes
        table["memory"] = f"{(START_BYTES + cores * each) // 10**6} MB"
        reasons["memory"] = f"{size(START_BYTES)}, and {size(each)} for each core"
    if "walltime" not in table:
        jobs = table.get("max_jobs", 1)
        wall = work.wall(cores * (jobs if isinstance(jobs, int) else 1))
        wanted = math.ceil((SAFETY * wall + EXTRA_S) / STEP_S) * STEP_S
        table["walltime"] = clock(min(wanted, 9999 * 3600))
        reasons["walltime"] = f"{SAFETY:g} times the {whole(wall)}, and {whole(EXTRA_S)}"
    return table, reasons


def _cores(work: Work, table: Mapping[str, Any]) -> tuple[int, str]:
    if table.get("kind") == "sge" and not any("-pe" in str(line) for line in table.get("directives") or ()):
        return 1, "Grid Engine gives more only with the parallel environment of your site (docs/clusters.md)"
    cores, why = min(
        (max(1, math.ceil(work.seconds / AIM_S)), f"a job aims at {whole(AIM_S)} or less"),
        (work.n_parallel, "no more tasks can run at a time"),
        (MOST_UNASKED, "no more are asked for by themselves"),
        key=lambda bound: bound[0],
    )
    return cores, f"about {whole(work.wall(cores))} by the clock; {why}"


def remarks(cluster: Cluster, work: Work) -> list[str]:
    """Return warnings about a job that the work does not fit in."""
    n_cores, limit_s = cluster.cores * cluster.max_jobs, cluster.walltime_s
    wall = work.wall(n_cores)
    found = []
    if cluster.max_jobs == 1 and wall > limit_s:
        n_jobs = math.ceil(wall / limit_s)
        found.append(
            f"the work takes about {whole(wall)} on {n_cores} cores, and the job ends after {whole(limit_s)}: "
            f"send it about {n_jobs} times; each job continues where the last one stopped"
        )
    if cluster.max_jobs == 1 and wall > min(limit_s, LONG_S) and work.n_parallel > cluster.cores:
        jobs = min(math.ceil(wall / (limit_s / SAFETY)), work.n_parallel // cluster.cores + 1, 64)
        found.append(
            f"on several nodes it takes less: --job max_jobs={jobs} takes about "
            f"{whole(work.wall(jobs * cluster.cores))} (docs/clusters.md, more than one node)"
        )
    return found


def is_whole(cluster: Cluster) -> bool:
    """Return whether a single batch job both coordinates the run and does its work."""
    return cluster.max_jobs == 1


def resources(cluster: Cluster) -> tuple[int, int, int]:
    """Return the cores, the memory [bytes] and the wall time [s] of the job that coordinates a run."""
    if is_whole(cluster):
        return cluster.cores, cluster.memory_bytes, cluster.walltime_s
    time = cluster.coordinator_walltime
    return 1, bytes_of(cluster.coordinator_memory), cluster.walltime_s if time is None else seconds_of(time)


def coordinator_script(cluster: Cluster, name: str, log: str, folder: str, command: Sequence[str]) -> str:
    """Return the batch script of the job that coordinates a run.

    Parameters
    ----------
    cluster
        Description of a job.
    name
        Name of the job.
    log
        Path of the job's output, without the suffix that the batch system adds.
    folder
        Working directory of the command.
    command
        Words of the command.

    Raises
    ------
    SpecError
        If a name or a word has a line break or another control character.
    """
    refuse_breaks((name, log, folder, *command))
    system = SYSTEMS[cluster.kind]
    cores, memory, time_s = resources(cluster)
    values = {
        "name": name,
        "log": log,
        "queue": cluster.queue,
        "account": cluster.account,
        "cores": cores,
        "host": 1 if cores > 1 else None,
        "mebibytes": -(-memory // 2**20),
        "megabytes": -(-memory // 10**6),
        "clock": clock(time_s),
        "hours_and_minutes": hours_and_minutes(time_s),
    }
    # a job of one core gets no -pe (parallel environment)
    more = [line for line in cluster.directives if is_whole(cluster) or not line.strip().startswith("-pe")]
    lines = [
        "#!/usr/bin/env bash",
        *system.lines(values),
        *(f"{system.mark} {line}" for line in more),
        "",
        "set -eo pipefail",
        f"cd {shlex.quote(folder)}",
        *cluster.prologue,
        # exec: signals of the batch system reach the command, and its exit code is the job's
        f"exec {shlex.join(command)}",
    ]
    return "\n".join(lines) + "\n"
