"""Explain what ``magpend submit`` sends: number and size of jobs with reasons, logs, results, and further commands."""

from __future__ import annotations

import shlex
from typing import Any

from pipeline.runs.batch import is_whole, resources
from pipeline.runs.progress import size, whole
from pipeline.runs.sizing import remarks
from pipeline.runs.submit import SCRIPT, TABLE, Submission
from pipeline.runs.systems import answer
from pipeline.specification.batch_systems import SYSTEMS
from pipeline.specification.toml import toml_value

NUMBER = "JOB"
"""Word for the number of a job that is not sent yet."""

_MOST_QUEUES = 20
_SIZES = ("cores", "memory", "walltime")


def explain(submission: Submission) -> list[str]:
    """Return the text lines of a dry run, with the job files."""
    cluster, work = submission.cluster, submission.work
    head = [submission.title] if submission.title else []
    if submission.complete:
        head.append(f"{submission.name} is complete; nothing would be sent.")
    lines = [
        *head,
        *work.lines(),
        f"batch system: {SYSTEMS[cluster.kind].title} ({submission.choice.why})",
        *_queues(submission),
        f"jobs: {_jobs(submission)}",
        *(f"  {key} = {toml_value(getattr(cluster, key))}: {_reason(submission, key)}" for key in _SIZES),
        *(f"  {key} = {toml_value(value)}: {_reason(submission, key)}" for key, value in _others(submission)),
        *(f"warning: {remark}" for remark in remarks(cluster, work)),
        *_places(submission),
        *_commands(submission),
        "change: --job KEY=VALUE, such as --job walltime=02:00:00 --job account=NAME; or a file with [cluster], given "
        "with --cluster FILE",
    ]
    file = submission.folder / SCRIPT
    lines += ["", f"---- {file}, sent with: {_send(submission, SCRIPT)}", *submission.script.splitlines()]
    if submission.worker is not None:
        title = "a job of workers, which the coordinator sends, up to"
        lines += ["", f"---- {title} {cluster.max_jobs} at a time", *submission.worker.splitlines()]
    if submission.has_table:
        lines += ["", f"---- {submission.folder / TABLE}, from which the coordinator reads this", *_table(submission)]
    return lines


def _table(submission: Submission) -> list[str]:
    return submission.table().splitlines()


def brief(submission: Submission) -> list[str]:
    """Return the text lines of a job that was sent."""
    cluster = submission.cluster
    warnings = remarks(cluster, submission.work)
    return [
        f"sent: job {submission.job} to {SYSTEMS[cluster.kind].title}; {_jobs(submission)}",
        f"work: about {whole(submission.work.seconds)} of one core, {_clock(submission)}",
        *(f"warning: {remark}" for remark in warnings),
        *_places(submission),
        *_commands(submission),
    ]


def written(submission: Submission, file: str) -> list[str]:
    """Return the text lines of a job file that was written."""
    return [
        f"written: {file}, for {SYSTEMS[submission.cluster.kind].title}: {_jobs(submission)}",
        f"send it: {_send(submission, file)}",
        *_places(submission),
        *_commands(submission),
    ]


def as_data(submission: Submission) -> dict[str, Any]:
    """Return a submission as JSON values: sizes in bytes and seconds, commands as texts."""
    cluster, work = submission.cluster, submission.work
    cores, memory, time_s = resources(cluster)
    words, job = SYSTEMS[cluster.kind], submission.job or NUMBER
    one = {"cores": cores, "memory_bytes": memory, "walltime_s": time_s, "script": submission.script}
    jobs = [{"role": "all" if is_whole(cluster) else "coordinator", "most": 1, **one}]
    if submission.worker is not None:
        sizes = {"cores": cluster.cores, "memory_bytes": cluster.memory_bytes, "walltime_s": cluster.walltime_s}
        jobs.append({"role": "workers", "most": cluster.max_jobs, **sizes, "script": submission.worker})
    return {
        "sent": submission.job,
        "complete": submission.complete,
        "batch_system": cluster.kind,
        "batch_system_reason": submission.choice.why,
        "queue": cluster.queue,
        "jobs": jobs,
        "reasons": {key: _reason(submission, key) for key in (*_SIZES, *dict(_others(submission)))},
        "cluster": cluster.model_dump(mode="json", exclude_none=True),
        "cells": work.n_cells,
        "cells_left": work.n_left,
        "tasks": work.n_tasks,
        "tasks_left": work.n_tasks_left,
        "periods_left": work.periods,
        "core_seconds": work.seconds,
        "wall_seconds": work.wall(cluster.cores * cluster.max_jobs),
        "warnings": remarks(cluster, work),
        "results": submission.name,
        "log": submission.log_of(job),
        "folder": str(submission.folder),
        "status": f"magpend status {shlex.quote(submission.name)}",
        "follow": f"{words.follow} {job}",
        "cancel": f"{words.cancel} {job}",
        "continue": f"magpend submit {submission.retry}",
    }


def _send(submission: Submission, file: str) -> str:
    """Return the command that sends a job file."""
    reads = ["<"] if submission.cluster.kind == "lsf" else []
    return " ".join([*SYSTEMS[submission.cluster.kind].send, *reads, shlex.quote(file)])


def _others(submission: Submission) -> list[tuple[str, Any]]:
    """Return the further values of ``[cluster]`` that are given."""
    return [(key, value) for key, value in submission.choice.table.items() if key not in (*_SIZES, "kind")]


def _reason(submission: Submission, key: str) -> str:
    return submission.reasons.get(key) or submission.choice.sources.get(key, "by default")


def _queues(submission: Submission) -> list[str]:
    """Return the queue of a job, and what the batch system itself says of its queues and their limits."""
    system = SYSTEMS[submission.cluster.kind]
    said = (answer(shlex.split(system.queues)) or "").rstrip().splitlines()[:_MOST_QUEUES]
    head = f"queue: {submission.cluster.queue or f'the default of {system.title}'}"
    if not said:
        return [f"{head}; '{system.queues}', which lists queues and their limits, gave no answer here"]
    return [f"{head}; '{system.queues}' lists:", *(f"  {line}" for line in said)]


def _jobs(submission: Submission) -> str:
    cluster = submission.cluster
    cores, memory, time_s = resources(cluster)
    one = _described(cores, memory, time_s)
    if is_whole(cluster):
        return f"1 job of {one}"
    workers = _described(cluster.cores, cluster.memory_bytes, cluster.walltime_s)
    number = f"{cluster.min_jobs} to {cluster.max_jobs}"
    return f"1 job that coordinates, of {one}; it sends {number} jobs of workers, each of {workers}"


def _described(cores: int, memory: int, time_s: int) -> str:
    return f"{cores} core{'s' if cores > 1 else ''}, {size(memory)}, at most {whole(time_s)}"


def _clock(submission: Submission) -> str:
    cores = submission.cluster.cores * submission.cluster.max_jobs
    return f"{whole(submission.work.wall(cores))} by the clock on {cores} core{'s' if cores > 1 else ''}"


def _places(submission: Submission) -> list[str]:
    job = submission.job or NUMBER
    log = submission.log_of(job)
    late = "; PBS writes it at the end of the job" if submission.cluster.kind in ("pbs", "torque") else ""
    workers = "" if submission.worker is None else f", and those of the workers in {submission.folder}"
    return [f"results: {submission.name}", f"log: {log}{workers}{late}"]


def _commands(submission: Submission) -> list[str]:
    words, job = SYSTEMS[submission.cluster.kind], submission.job or NUMBER
    name = shlex.quote(submission.name)
    return [
        f"follow: magpend status {name}; {words.follow} {job}; tail -F {submission.folder}/coordinator*",
        f"cancel: {words.cancel} {job}; what is computed stays",
        "continue: after a cancel, or at the end of its time, give the same command again; if its node fails, "
        f"{SYSTEMS[submission.cluster.kind].title} starts the job again",
    ]
