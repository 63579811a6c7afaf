"""Send a run to the batch system of a cluster, for ``magpend submit``."""

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

from pipeline.compute.jobqueue import jobs_folder, worker_script
from pipeline.layout.domains import check_starts
from pipeline.layout.plan import make_plan
from pipeline.layout.writing import write_atomically
from pipeline.runs.batch import coordinator_script, is_whole
from pipeline.runs.choosing import Choice, choose, no_command
from pipeline.runs.derive import analyses_in
from pipeline.runs.noise import check_steps
from pipeline.runs.run import identity_here
from pipeline.runs.scaling import in_scales
from pipeline.runs.sizing import Work, complete, measure
from pipeline.runs.workflows import default_directory, find_spec
from pipeline.specification.batch_systems import SYSTEMS
from pipeline.specification.clusters import Cluster, cluster_of
from pipeline.specification.inputs import toml_of
from pipeline.specification.parsing import load_spec
from pipeline.specification.problems import SpecError
from pipeline.store.commits import read_commits
from pipeline.store.errors import LockedError
from pipeline.store.local import open_files
from pipeline.store.setup import check

SCRIPT, SENT, TABLE = "job.sh", "job.json", "cluster.toml"
_ANSWER_S = 60.0
_AWKWARD = re.compile(r"[^\w./+,:=@-]")
"""Characters that batch systems refuse or misread in the path of a log."""


class SubmitError(Exception):
    """Raised if the batch system did not accept a job; the message quotes its answer."""


@dataclass(frozen=True)
class Submission:
    """Batch job of a run: its script, its folder and, once it is sent, its number.

    Attributes
    ----------
    name : str
        The run directory, as it was given.
    title : str
        Title of the specification.
    retry : str
        Words after ``magpend submit`` that give the same run again.
    folder : Path
        Folder of its jobs: script, job number, and logs.
    choice : Choice
        Batch system, and the given values.
    cluster : Cluster
        Description of a job.
    reasons : dict of str
        Reason for each value of the job that was not given, by key.
    work : Work
        Work that the run still has to do.
    script : str
        The batch script.
    worker : str, optional
        Batch script of the jobs of workers, if the run has such jobs.
    complete : bool
        Whether there is nothing left to compute.
    job : str, optional
        Job number, after sending.
    """

    name: str
    title: str
    retry: str
    folder: Path
    choice: Choice
    cluster: Cluster
    reasons: dict[str, str]
    work: Work
    script: str
    worker: str | None
    complete: bool
    job: str | None = None

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
        return f"[cluster]\n{toml_of({'kind': self.cluster.kind, **values})}"


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
    parsed = load_spec(path, smoke=smoke)
    analyses_in(analyse)
    more = [*(["--smoke"] if smoke else []), *(["--analyse", analyse] if analyse else [])]
    retry = shlex.join([str(spec), *(["--out", str(out)] if out else []), *more])
    choice = choose(cluster, changes, retry)
    files = open_files(out if out is not None else default_directory(path, smoke))
    folder = jobs_folder(files.place)
    if _AWKWARD.search(str(folder)):
        raise SpecError(
            f"{folder}: batch systems do not accept this path for a job's output; give an --out with only letters, "
            "digits, and . _ - + , : = @."
        )
    check_starts(parsed)
    parsed = in_scales(parsed, files)
    check_steps(parsed)
    plan = make_plan(parsed)
    info = check(files, identity_here(parsed, plan))
    done = read_commits(info, plan) if info is not None else {}
    work = measure(parsed, plan, done)
    table, reasons = complete(choice.table, work)
    described = cluster_of(table)
    file = choice.file or folder / TABLE
    name = f"magpend-{re.sub(r'[^A-Za-z0-9_.-]', '-', folder.stem)}"
    command = _command(described, file, path, files.place, more)
    return Submission(
        name=files.name,
        title=parsed.title,
        retry=retry,
        folder=folder,
        choice=choice,
        cluster=described,
        reasons=reasons,
        work=work,
        script=coordinator_script(described, name, f"{folder}/coordinator", str(Path.cwd()), command),
        worker=None if is_whole(described) else worker_script(described, folder),
        complete=info is not None and len(done) == plan.n_tasks,
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
        return subprocess.run(list(command), input=text, capture_output=True, text=True, timeout=_ANSWER_S, check=False)
    except subprocess.TimeoutExpired:
        raise SubmitError(f"{command[0]}: no answer within {_ANSWER_S:.0f} s; try again.") from None
