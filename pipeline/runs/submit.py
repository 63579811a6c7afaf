"""Send a run to the batch system of a cluster, for ``magpend submit``, and explain what is sent."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.compute.jobqueue import jobs_folder, worker_script
from pipeline.layout.writing import write_atomically
from pipeline.runs.batch_systems import Choice, answer, choose, no_command
from pipeline.runs.derive import analyses_in
from pipeline.runs.jobs import Work, complete, coordinator_script, is_whole, measure, remarks, resources
from pipeline.runs.preview import preview
from pipeline.runs.progress import size, whole
from pipeline.specification.clusters import SYSTEMS, Cluster, cluster_of
from pipeline.specification.files import find_spec, specification_toml, toml_value
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.errors import LockedError
from pipeline.store.objects import open_files

SCRIPT, SENT, TABLE = "job.sh", "job.json", "cluster.toml"
_ANSWER_S = 60.0
_AWKWARD = re.compile(r"[^\w./+,:=@-]")
"""Characters that batch systems refuse or misread in the path of a log."""


class SubmitError(Exception):
    """Raised if the batch system did not accept a job; the message quotes its answer."""


@dataclass(frozen=True)
class Submission:
    """Batch job of a run: its script, its folder and, once it is sent, its number."""

    name: str  # the run directory, as it was given
    title: str  # title of the specification
    retry: str  # words after ``magpend submit`` that give the same run again
    folder: Path  # folder of its jobs: script, job number, and logs
    choice: Choice  # batch system, and the given values
    cluster: Cluster  # description of a job
    reasons: dict[str, str]  # reason for each value of the job that was not given, by key
    work: Work  # work that the run still has to do
    script: str  # the batch script
    worker: str | None  # batch script of the jobs of workers, if the run has such jobs
    complete: bool  # whether there is nothing left to compute
    job: str | None = None  # job number, after sending

    def log_of(self, job: str) -> str:
        """Return the path of the output of a job, by its number or a word for it."""
        return f"{self.folder}/coordinator{SYSTEMS[self.cluster.kind].log.format(job=job)}"

    @property
    def has_table(self) -> bool:
        """Whether the job reads its ``[cluster]`` table from a file that is written when it is sent."""
        return not is_whole(self.cluster) and self.choice.file is None

    def table(self) -> str:
        """Return the complete ``[cluster]`` table as TOML text."""
        values = self.cluster.model_dump(exclude_defaults=True)
        return f"[cluster]\n{specification_toml({'kind': self.cluster.kind, **values})}"


def prepare(
    spec: str | Path,
    out: str | Path | None,
    cluster: str | Path | None,
    changes: Sequence[str] = (),
    *,
    smoke: bool = False,
    analyse: str = "",
) -> Submission:
    """Make the batch script for a run, without creating files or sending anything.

    The time of the run is measured on this machine, for a second or two.

    Parameters
    ----------
    spec, out, smoke
        See `run.run`.
    cluster, changes
        See `choosing.choose`.
    analyse
        Analyses of the finished run, see `derive.analyses_in`.

    Raises
    ------
    SpecError
        If a file or a value is not valid, if there is not exactly one batch system to choose, or if a batch system
        would not accept a path.
    RefusedError, DamagedError, UnreadableError
        If the run cannot be done in the directory.
    """
    path = find_spec(spec)
    directory = out if out is not None else Spec.read(path, smoke=smoke).directory
    analyses_in(analyse)
    more = [*(["--smoke"] if smoke else []), *(["--analyse", analyse] if analyse else [])]
    retry = shlex.join([str(spec), *(["--out", str(out)] if out else []), *more])
    choice = choose(cluster, changes, retry)
    files = open_files(directory)
    folder = jobs_folder(files.place)
    if _AWKWARD.search(str(folder)):
        raise SpecError(
            f"{folder}: batch systems do not accept this path for a job's output; give an --out with only letters, "
            "digits, and . _ - + , : = @."
        )
    found = preview(path, directory, smoke=smoke)
    work = measure(found.decided, found.done)
    table, reasons = complete(choice.table, work)
    described = cluster_of(table)
    file = choice.file or folder / TABLE
    name = f"magpend-{re.sub(r'[^A-Za-z0-9_.-]', '-', folder.stem)}"
    command = _command(described, file, path, files.place, more)
    return Submission(
        name=files.name,
        title=found.spec.title,
        retry=retry,
        folder=folder,
        choice=choice,
        cluster=described,
        reasons=reasons,
        work=work,
        script=coordinator_script(described, name, f"{folder}/coordinator", str(Path.cwd()), command),
        worker=None if is_whole(described) else worker_script(described, folder),
        complete=found.exists and len(found.done) == found.n_tasks,
    )


def _command(cluster: Cluster, file: Path, spec: Path, place: str, more: Sequence[str]) -> list[str]:
    where = ["--scheduler", "threads", "--workers", str(cluster.cores)]
    if not is_whole(cluster):
        where = ["--scheduler", cluster.kind, "--cluster", str(file.absolute())]
    python = cluster.python or sys.executable
    return [python, "-m", "pipeline.cli.main", "run", str(spec.absolute()), "--out", place, *where, *more]


def write(submission: Submission, file: Path) -> None:
    """Write the job file of a submission to a file, and create the folder of its logs; send nothing."""
    _make_folder(submission)
    write_atomically(file, submission.script)


def send(submission: Submission) -> Submission:
    """Send a job to the batch system, and keep its script and its number beside the run directory.

    Raises
    ------
    LockedError
        If a job of this run is waiting or running already.
    SpecError
        If there is no such batch system here.
    SubmitError
        If the batch system does not accept the job.
    """
    kind = submission.cluster.kind
    system = SYSTEMS[kind]
    if not shutil.which(system.send[0]):
        raise SpecError(no_command(kind, system.send[0], f"{submission.retry} --cluster {kind}"))
    _refuse_second(submission)
    _make_folder(submission)
    script = submission.folder / SCRIPT
    write_atomically(script, submission.script)
    by_name, as_input = ([], submission.script) if kind == "lsf" else ([str(script)], None)
    done = _ask([*system.send, *by_name], as_input)
    job = system.job(done.stdout) if done.returncode == 0 else None
    if job is None:
        said = " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
        raise SubmitError(
            f"{system.send[0]} did not take the job: {said.rstrip('.')}.\n"
            f"Change what it names by --job KEY=VALUE, such as --job queue=NAME or --job walltime=HH:MM:SS: "
            f"'{system.queues}' lists queues and their limits, {system.accounts} your accounts.\n"
            f"The script is {script}."
        )
    write_atomically(submission.folder / SENT, json.dumps({"kind": kind, "job": job}) + "\n")
    return replace(submission, job=job)


def _make_folder(submission: Submission) -> None:
    submission.folder.mkdir(parents=True, exist_ok=True)
    if submission.has_table:
        write_atomically(submission.folder / TABLE, submission.table())


def _refuse_second(submission: Submission) -> None:
    """Raise LockedError if an earlier batch job of the same run is still waiting or running."""
    try:
        sent = json.loads((submission.folder / SENT).read_text("utf-8"))
        kind, job = sent["kind"], sent["job"]
        system = SYSTEMS[kind]
    except (OSError, ValueError, TypeError, KeyError):
        return  # no job was sent, or its note is lost; then the run's lock prevents a second computation
    if not (isinstance(job, str) and system.job(f"<{job}>")) or not shutil.which(system.ask[0]):
        return
    done = _ask([*system.ask, job])
    state = done.stdout.strip()
    if done.returncode == 0 and state and not re.fullmatch(system.over, state):
        named = f" ({state})" if "\n" not in state else ""
        raise LockedError(
            f"{submission.name}: job {job} of this run exists already{named}; wait for it "
            f"({system.follow} {job}) or cancel it ({system.cancel} {job})."
        )


def _ask(command: Sequence[str], text: str | None = None) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            list(command), input=text, capture_output=True, encoding="utf-8", timeout=_ANSWER_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise SubmitError(f"{command[0]}: no answer within {_ANSWER_S:.0f} s; try again.") from None


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
