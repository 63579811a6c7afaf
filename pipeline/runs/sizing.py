"""Choose cores, memory and time of a batch job from the work of a run and the nodes of a site, with the reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.layout.plan import Plan, periods_per_cell
from pipeline.runs.estimate import estimate, wall_seconds, writing_seconds
from pipeline.runs.progress import size, whole
from pipeline.runs.sites import Queue, Site
from pipeline.specification.clusters import TITLES, Cluster, clock
from pipeline.specification.parsing import Spec

AIM_S = 1800.0
"""Time that a job is given enough cores for [s]: short enough to start soon, long enough to be worth a job."""

MOST_UNASKED = 16
"""Most cores of a job if the nodes are not known."""

START_BYTES, WORKER_BYTES, TASKS_HELD = 10**9, 5 * 10**8, 3
"""Memory of the coordinator and of a worker process [bytes]; a worker holds this many times the results of a task."""

SAFETY, EXTRA_S, STEP_S = 2.0, 600.0, 300
"""Wall time: this many times the estimate and these seconds more, rounded up to a multiple of the last [s]."""

LONG_S = 86400.0
"""Time of one job above which several jobs are proposed [s]."""


@dataclass(frozen=True)
class Work:
    """The work that a run still has to do, measured on this machine.

    Attributes
    ----------
    n_cells, n_left : int
        Cells of the run, and those that are not computed yet.
    n_tasks, n_tasks_left : int
        Tasks of the run, and those that are not committed yet.
    n_parallel : int
        Most tasks that can run at a time.
    periods : float
        Most drive periods (returns of a flow) of the cells that are left, with those of their products.
    seconds : float
        Time of one core for all of it [s].
    how : str
        Phrase on how it was measured.
    n_bytes, task_bytes : int
        Size of the cube and of a task's results, before compression [bytes].
    """

    n_cells: int
    n_left: int
    n_tasks: int
    n_tasks_left: int
    n_parallel: int
    periods: float
    seconds: float
    how: str
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


def measure(spec: Spec, plan: Plan, done: Mapping[int, Any]) -> Work:
    """Measure the work that a run still has to do, as ``magpend run --dry-run`` does."""
    left = [index for index in range(plan.n_tasks) if index not in done]
    n_left = sum(plan.cells_in(index) for index in left)
    seconds, how = 0.0, "nothing is left to compute"
    if left:
        found = estimate(spec, plan)
        seconds = found.core_seconds * n_left / plan.n_cells + len(left) * writing_seconds(spec, plan)
        how = found.how
    in_turn = 1 if plan.path is None else plan.task_grid[plan.path]
    return Work(
        n_cells=plan.n_cells,
        n_left=n_left,
        n_tasks=plan.n_tasks,
        n_tasks_left=len(left),
        n_parallel=max(1, min(len(left), plan.n_tasks // in_turn)),
        periods=n_left * sum(periods_per_cell(spec)),
        seconds=seconds,
        how=how,
        n_bytes=plan.n_bytes,
        task_bytes=plan.n_bytes // plan.n_tasks,
    )


def complete(given: Mapping[str, Any], work: Work, site: Site) -> tuple[dict[str, Any], dict[str, str]]:
    """Fill in the cores, the memory and the wall time of a job where they are not given.

    Parameters
    ----------
    given
        Values of the ``[cluster]`` table; they are not changed.
    work
        Work of the run.
    site
        Queues of the batch system.

    Returns
    -------
    table : dict
        The values, complete.
    reasons : dict of str
        Reason for each value that was filled in, by key.
    """
    table, reasons = dict(given), {}
    name = given.get("queue")
    queue = site.queue(name if isinstance(name, str) else None) or Queue(str(name or "the default queue"))
    if "cores" not in table:
        table["cores"], reasons["cores"] = _cores(work, queue, site, table)
    cores = table["cores"] if isinstance(table["cores"], int) else 1
    if "memory" not in table:
        table["memory"], reasons["memory"] = _memory(work, queue, cores)
    if "walltime" not in table:
        jobs = table.get("max_jobs", 1)
        table["walltime"], reasons["walltime"] = _walltime(work, queue, cores * (jobs if isinstance(jobs, int) else 1))
    return table, reasons


def _cores(work: Work, queue: Queue, site: Site, table: Mapping[str, Any]) -> tuple[int, str]:
    wanted = max(1, math.ceil(work.seconds / AIM_S))
    if site.kind == "sge" and not any("-pe" in str(line) for line in table.get("directives") or ()):
        return 1, "Grid Engine gives more only with the parallel environment of your site (docs/clusters.md)"
    node = queue.cores or MOST_UNASKED
    if queue.memory is not None:
        node = min(node, max(1, (queue.memory - START_BYTES) // _worker_bytes(work)))
    most = f"no node of {queue.name} has more" if queue.cores else "no more are asked for if the nodes are not known"
    cores, why = min(
        (wanted, f"a job aims at {whole(AIM_S)} or less"),
        (work.n_parallel, "no more tasks can run at a time"),
        (node, most),
        key=lambda bound: bound[0],
    )
    return cores, f"about {whole(work.wall(cores))} by the clock; {why}"


def _worker_bytes(work: Work) -> int:
    return WORKER_BYTES + TASKS_HELD * work.task_bytes


def _memory(work: Work, queue: Queue, cores: int) -> tuple[str, str]:
    wanted = START_BYTES + cores * _worker_bytes(work)
    why = f"{size(START_BYTES)}, and {size(_worker_bytes(work))} for each core"
    if queue.memory is not None and wanted > queue.memory:
        wanted, why = queue.memory, f"all of a node of {queue.name}"
    return f"{max(1, wanted // 10**6)} MB", why


def _walltime(work: Work, queue: Queue, cores: int) -> tuple[str, str]:
    wall = work.wall(cores)
    wanted = math.ceil((SAFETY * wall + EXTRA_S) / STEP_S) * STEP_S
    why = f"{SAFETY:g} times the {whole(wall)}, and {whole(EXTRA_S)}"
    if queue.limit_s is not None and wanted > queue.limit_s:
        wanted, why = queue.limit_s, f"the longest time of {queue.name}; {why} would be more"
    return clock(min(wanted, 9999 * 3600)), why


def remarks(cluster: Cluster, work: Work, site: Site) -> list[str]:
    """Return warnings: a job that the work does not fit in, or that the queue may never start."""
    found = []
    queue = site.queue(cluster.queue)
    n_cores = cluster.cores * cluster.max_jobs
    wall = work.wall(n_cores)
    limit_s = cluster.walltime_s
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
    if site.queues and queue is None and cluster.queue is not None:
        names = ", ".join(one.name for one in site.queues[:12])
        found.append(f"queue {cluster.queue!r}: {TITLES[site.kind]} lists no such {site.word}, but {names}")
    if queue is not None:
        found += _too_much(cluster, queue, site)
    return found


def _too_much(cluster: Cluster, queue: Queue, site: Site) -> list[str]:
    """Return a warning for each value above the limit of the queue. Some sites never start such a job."""
    asked = [
        ("walltime", cluster.walltime_s, queue.limit_s, whole),
        ("cores", cluster.cores, queue.cores, "{:.0f}".format),
        ("memory", cluster.memory_bytes, queue.memory, size),
    ]
    most = {"walltime": "the longest time", "cores": "the cores of most nodes", "memory": "the memory of most nodes"}
    return [
        f"{key} is {show(value)}, above {most[key]} of {site.word} {queue.name}, {show(bound)}: "
        f"{TITLES[site.kind]} may refuse the job or never start it; lower it (--job {key}=...) or choose another "
        f"{site.word} (--job queue=...)"
        for key, value, bound, show in asked
        if bound is not None and value > bound
    ]
