"""Send a run to the batch system of a cluster, for ``magpend submit``."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.compute.jobqueue import jobs_folder
from pipeline.layout.domains import check_starts
from pipeline.layout.plan import make_plan
from pipeline.layout.writing import write_atomically
from pipeline.runs.batch import WORDS, coordinator_script, is_whole
from pipeline.runs.run import identity_here
from pipeline.runs.workflows import default_directory, find_spec
from pipeline.specification.clusters import Cluster, load_cluster
from pipeline.specification.parsing import load_spec
from pipeline.specification.problems import SpecError
from pipeline.store.commits import read_commits
from pipeline.store.errors import LockedError
from pipeline.store.places import open_files
from pipeline.store.setup import check

CLUSTER_FILE = "MAGPEND_CLUSTER"
SCRIPT, SENT = "job.sh", "job.json"
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
    folder : Path
        Folder of its jobs: script, job number, and logs.
    cluster : Cluster
        Description of a job.
    script : str
        The batch script.
    complete : bool
        Whether there is nothing left to compute.
    job : str, optional
        Job number, after sending.
    """

    name: str
    folder: Path
    cluster: Cluster
    script: str
    complete: bool
    job: str | None = None

    def lines(self) -> list[str]:
        """Return text lines with the commands that watch, cancel and continue the job."""
        words = WORDS[self.cluster.kind]
        return [
            f"sent: job {self.job}",
            f"follow: magpend status {shlex.quote(self.name)}; {words.follow} {self.job}; "
            f"tail -F {self.folder}/coordinator*",
            f"cancel: {words.cancel} {self.job}",
            "after a cancel, or if time ran out: give this command again to continue",
        ]


def prepare(
    spec: str | Path, out: str | Path | None, cluster_file: str | Path | None, *, smoke: bool = False
) -> Submission:
    """Make the batch script for a run, without creating files or sending anything.

    Parameters
    ----------
    spec, out, smoke
        See `run.run`.
    cluster_file
        File with the ``[cluster]`` table; by default ``MAGPEND_CLUSTER`` in the environment.

    Raises
    ------
    SpecError
        If one of the files is not valid, or a batch system would not accept a path.
    RefusedError, DamagedError, UnreadableError
        If the run cannot be done in the directory.
    """
    path = find_spec(spec)
    parsed = load_spec(path, smoke=smoke)
    file = cluster_file or os.environ.get(CLUSTER_FILE)
    if not file:
        raise SpecError(
            f"a job is not described; write a file with a [cluster] table and give --cluster FILE, or set "
            f"{CLUSTER_FILE}; docs/clusters.md has an example."
        )
    cluster = load_cluster(file)
    files = open_files(out if out is not None else default_directory(path, smoke))
    folder = jobs_folder(files.place)
    if _AWKWARD.search(str(folder)):
        raise SpecError(
            f"{folder}: batch systems do not accept this path for a job's output; give an --out with only letters, "
            "digits, and . _ - + , : = @."
        )
    check_starts(parsed)
    plan = make_plan(parsed)
    info = check(files, identity_here(parsed, plan))
    complete = info is not None and len(read_commits(info, plan)) == plan.n_tasks
    command = _command(cluster, Path(file), path, files.place, smoke)
    name = f"magpend-{re.sub(r'[^A-Za-z0-9_.-]', '-', folder.stem)}"
    script = coordinator_script(cluster, name, f"{folder}/coordinator", str(Path.cwd()), command)
    return Submission(files.name, folder, cluster, script, complete)


def _command(cluster: Cluster, file: Path, spec: Path, place: str, smoke: bool) -> list[str]:
    where = ["--scheduler", "local", "--workers", str(cluster.cores)]
    if not is_whole(cluster):
        where = ["--scheduler", cluster.kind, "--cluster", str(file.absolute())]
    python = cluster.python or sys.executable
    return [
        python,
        "-m",
        "pipeline.cli.main",
        "run",
        str(spec.absolute()),
        "--out",
        place,
        *where,
        *(["--smoke"] if smoke else []),
    ]


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
    words = WORDS[kind]
    if not shutil.which(words.send[0]):
        raise SpecError(
            f"{kind}: there is no command {words.send[0]!r} here; use a machine that sends "
            "jobs, such as the login node, or use --dry-run to see the script."
        )
    _refuse_second(submission)
    submission.folder.mkdir(parents=True, exist_ok=True)
    script = submission.folder / SCRIPT
    write_atomically(script, submission.script)
    by_name, as_input = ([], submission.script) if kind == "lsf" else ([str(script)], None)
    done = _ask([*words.send, *by_name], as_input)
    job = words.job(done.stdout) if done.returncode == 0 else None
    if job is None:
        said = " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
        raise SubmitError(f"{words.send[0]} did not take the job: {said}. The script is {script}.")
    write_atomically(submission.folder / SENT, json.dumps({"kind": kind, "job": job}) + "\n")
    return Submission(
        submission.name, submission.folder, submission.cluster, submission.script, submission.complete, job
    )


def _refuse_second(submission: Submission) -> None:
    """Raise LockedError if an earlier batch job of the same run is still waiting or running."""
    try:
        sent = json.loads((submission.folder / SENT).read_text("utf-8"))
        kind, job = sent["kind"], sent["job"]
        words = WORDS[kind]
    except (OSError, ValueError, TypeError, KeyError):
        return  # no job was sent, or its note is lost; then the run's lock prevents a second computation
    if not (isinstance(job, str) and words.job(f"<{job}>")) or not shutil.which(words.ask[0]):
        return
    done = _ask([*words.ask, job])
    state = done.stdout.strip()
    if done.returncode == 0 and state and not re.fullmatch(words.over, state):
        named = f" ({state})" if "\n" not in state else ""
        raise LockedError(
            f"{submission.name}: job {job} of this run exists already{named}; wait for it "
            f"({words.follow} {job}) or cancel it ({words.cancel} {job})."
        )


def _ask(command: Sequence[str], text: str | None = None) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(list(command), input=text, capture_output=True, text=True, timeout=_ANSWER_S, check=False)
    except subprocess.TimeoutExpired:
        raise SubmitError(f"{command[0]}: no answer within {_ANSWER_S:.0f} s; try again.") from None
