"""Describe batch systems with their commands and job files, and the table ``[cluster]`` of a TOML file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError, problems_of, unknown_key
from pipeline.specification.tables import Table


@dataclass(frozen=True)
class BatchSystem:
    """A batch system."""

    title: str  # its name, for messages
    mark: str  # begin of the lines of a job file that are for the batch system
    head: str  # lines of a job file, without the mark, with ``{fields}``, see `lines`
    # command that reads a job file, by its name or from its standard input, and prints the job's number
    send: tuple[str, ...]
    ask: tuple[str, ...]  # command that prints the state of a job whose number is appended, while the job exists
    # commands for users, to which the job's number is appended
    follow: str
    cancel: str
    queues: str  # command that lists queues and their limits
    jobqueue: str  # class of dask-jobqueue
    accounts: str = "your site's pages"  # command that lists a user's accounts, or where they stand
    over: str = r"(?!)"  # regular expression of final states
    number: str = r"(?P<job>\d+)"  # regular expression of the job's number in the output of `send`
    log: str = ".out"  # suffix of the path of a job's output; ``{job}`` is the job's number

    def lines(self, values: Mapping[str, object]) -> list[str]:
        """Return the filled lines of a job file; a line with a field that is None is left out."""
        given = {name: value for name, value in values.items() if value is not None}
        heads = self.head.strip().splitlines()
        return [
            f"{self.mark} {line.format_map(given)}" for line in heads if set(re.findall(r"{(\w+)", line)) <= set(given)
        ]

    def job(self, output: str) -> str | None:
        """Find the number of the job in the output of the submit command; None if it has none."""
        match = re.search(self.number, output)
        return match["job"] if match else None


def _pbs(title: str, resources: str, ask: tuple[str, ...], over: str = r"(?!)") -> BatchSystem:
    return BatchSystem(
        title=title,
        mark="#PBS",
        head=f"""
-N {{name:.15}}
-o {{log}}.out
-j oe
-r y
-V
-q {{queue}}
-A {{account}}
-l {resources}
-l walltime={{clock}}
""",
        send=("qsub",),
        ask=ask,
        follow="qstat",
        cancel="qdel",
        queues="qstat -Q",
        jobqueue="PBSCluster",
        over=over,
        number=r"(?P<job>\d+[\w.\[\]-]*)",
    )


TORQUE_RESOURCES = "nodes=1:ppn={cores},mem={mebibytes}mb"

SYSTEMS = {
    "slurm": BatchSystem(
        title="SLURM",
        mark="#SBATCH",
        head="""
--job-name={name}
--output={log}-%j.out
--open-mode=append
--requeue
--partition={queue}
--account={account}
--nodes=1
--ntasks=1
--cpus-per-task={cores}
--mem={mebibytes}M
--time={clock}
""",
        send=("sbatch", "--parsable"),
        ask=("squeue", "-h", "-o", "%T", "-j"),
        follow="squeue -j",
        cancel="scancel",
        queues="sinfo -s",
        accounts="sacctmgr show associations user=$USER format=account,partition,qos",
        jobqueue="SLURMCluster",
        log="-{job}.out",
    ),
    "pbs": _pbs("PBS", "select=1:ncpus={cores}:mem={mebibytes}mb", ("qstat",)),
    # Torque lists a job for some time after its end, with the state C
    "torque": _pbs("Torque", TORQUE_RESOURCES, ("qstat", "-f"), r"(?s).*job_state = C\b.*"),
    # cores: set by the parallel environment among the directives; memory: its resource differs by site
    "sge": BatchSystem(
        title="Grid Engine",
        mark="#$",
        head="""
-N {name}
-o {log}.out
-j y
-r y
-V
-S /bin/bash
-q {queue}
-P {account}
-l h_rt={clock}
""",
        send=("qsub", "-terse"),
        ask=("qstat", "-j"),
        follow="qstat -j",
        cancel="qdel",
        queues="qconf -sql",
        accounts="qconf -sprjl",
        jobqueue="SGECluster",
    ),
    "lsf": BatchSystem(
        title="LSF",
        mark="#BSUB",
        head="""
-J {name}
-o {log}-%J.out
-r
-q {queue}
-P "{account}"
-n {cores}
-R "span[hosts={host}]"
-M {megabytes}
-W {hours_and_minutes}
""",
        send=("bsub",),
        ask=("bjobs", "-noheader", "-o", "stat"),
        follow="bjobs",
        cancel="bkill",
        queues="bqueues",
        jobqueue="LSFCluster",
        over=r"DONE|EXIT",
        number=r"<(?P<job>\d+)>",
        log="-{job}.out",
    ),
}


QUEUES = tuple(SYSTEMS)

_TIME = re.compile(r"(\d{1,4}):([0-5]\d):([0-5]\d)")
_MEMORY = re.compile(r"(\d+(?:\.\d+)?) ?([kMGT]i?)B")
_UNITS = {"k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "ki": 2**10, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
_LEAST_MARGIN_S, _MOST_MARGIN_S = 30, 900

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")

Lines = Annotated[tuple[str, ...], Field(strict=False)]


def seconds_of(time: str) -> int:
    """Convert a time such as ``04:00:00`` to seconds; raise `ValueError` for any other text."""
    match = _TIME.fullmatch(time)
    if match is None or not any(map(int, match.groups())):
        raise ValueError(f"{time!r}: must be hours, minutes and seconds above zero, such as '04:00:00'.")
    hours, minutes, seconds = map(int, match.groups())
    return 3600 * hours + 60 * minutes + seconds


def refuse_breaks(texts: Iterable[str]) -> None:
    """Raise `SpecError` for control characters: a line break would add a line to a job file."""
    for text in texts:
        if _CONTROL.search(text):
            raise SpecError(f"{text!r}: has line breaks or control characters, which no job file may have; rename it.")


def bytes_of(memory: str) -> int:
    """Convert a size such as ``16 GB`` to bytes; raise `ValueError` for any other text."""
    match = _MEMORY.fullmatch(memory)
    if match is None or not float(match[1]):
        raise ValueError(f"{memory!r}: must be a number and kB, MB, GB or TB, such as '16 GB'.")
    return int(float(match[1]) * _UNITS[match[2]])


def clock(seconds: int) -> str:
    """Format seconds as ``HH:MM:SS``, which `seconds_of` reads."""
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def hours_and_minutes(seconds: int) -> str:
    """Format a time in seconds as ``HH:MM`` for the batch system LSF: rounded down, but at least one minute."""
    minutes = max(1, seconds // 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


class Cluster(Table):
    """The ``[cluster]`` table: resources of a batch job that runs worker processes, and the number of such jobs."""

    kind: Literal["slurm", "pbs", "torque", "sge", "lsf"] = Field(description="Batch system.")
    queue: str | None = Field(None, description="Queue or partition.")
    account: str | None = Field(None, description="Account or project that is charged.")
    cores: int = Field(ge=1, le=4096, description="Cores of a job; each runs one worker process.")
    memory: str = Field(description="Memory of a job, such as '16 GB'.")
    walltime: str = Field(description="Time after which the batch system ends a job, such as '04:00:00'.")
    lifetime: str | None = Field(
        None, description="Time after which workers leave; by default shortly before the walltime."
    )
    lifetime_stagger: str | None = Field(
        None, description="Spread of the times at which workers leave, so that they do not leave at once."
    )
    min_jobs: int = Field(1, ge=1, le=10_000, description="Jobs that are always kept.")
    max_jobs: int = Field(1, ge=1, le=10_000, description="Most jobs at a time.")
    coordinator_memory: str = Field(
        "4 GB", description="Memory of the coordinator, the job that sends tasks to several other jobs."
    )
    coordinator_walltime: str | None = Field(
        None, description="Time of the coordinator's job; by default the walltime of the others."
    )
    wait: str = Field("24:00:00", description="Longest time to wait for the first worker.")
    prologue: Lines = Field((), description="Shell lines before the workers start, such as 'module load python'.")
    directives: Lines = Field((), description="More lines for the batch system, such as '--constraint=avx512'.")
    interface: str | None = Field(None, description="Network interface, such as 'ib0'.")
    scratch: str | None = Field(None, description="Folder on a node's local disk, such as '$TMPDIR'.")
    python: str | None = Field(None, description="Python on the nodes; by default the Python that runs this command.")

    @field_validator("walltime", "lifetime", "lifetime_stagger", "coordinator_walltime", "wait")
    @classmethod
    def _time(cls, value: str | None) -> str | None:
        if value is not None:
            seconds_of(value)
        return value

    @field_validator("memory", "coordinator_memory")
    @classmethod
    def _size(cls, value: str) -> str:
        bytes_of(value)
        return value

    @field_validator("queue", "account", "interface", "scratch", "python", "prologue", "directives")
    @classmethod
    def _one_line(cls, value: Any) -> Any:
        for text in (value,) if isinstance(value, str) else value or ():
            if not text.strip() or not text.isprintable():
                raise ValueError(f"{text!r}: must be one line of text, and not empty.")
        return value

    @field_validator("queue", "account", "interface", "python")
    @classmethod
    def _one_word(cls, value: str | None) -> str | None:
        if value is not None and re.search(r"[\s'\"`;|&<>()]", value):
            raise ValueError(f"{value!r}: must be one word, without blanks, quotes or signs of the shell.")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Cluster:
        problems = []
        if self.min_jobs > self.max_jobs:
            problems.append(f"min_jobs = {self.min_jobs}: must be at most max_jobs = {self.max_jobs}.")
        if self.kind == "sge" and self.cores > 1 and not any("-pe" in line for line in self.directives):
            problems.append(
                "directives: with cores above 1, Grid Engine wants a parallel environment; "
                f"add its line, such as '-pe smp {self.cores}' (its name is your site's: qconf -spl)."
            )
        if self.lifetime_s + self.stagger_s >= self.walltime_s:
            problems.append(
                f"lifetime = {clock(self.lifetime_s)!r} with lifetime_stagger = {clock(self.stagger_s)!r}: "
                f"must end before walltime = {self.walltime!r}; leave both out to have them chosen."
            )
        if problems:
            raise ValueError("\n".join(problems))
        return self

    @property
    def walltime_s(self) -> int:
        """Time after which the batch system ends a job (walltime) [s]."""
        return seconds_of(self.walltime)

    @property
    def margin_s(self) -> int:
        """Default time between the stop of the last worker and the end of its batch job [s]."""
        tenth = self.walltime_s // 10
        return max(1, min(max(tenth, _LEAST_MARGIN_S), _MOST_MARGIN_S, self.walltime_s // 2))

    @property
    def lifetime_s(self) -> int:
        """Time after which a worker stops by itself [s]."""
        if self.lifetime is not None:
            return seconds_of(self.lifetime)
        return max(1, self.walltime_s - self.margin_s - self.stagger_s)

    @property
    def stagger_s(self) -> int:
        """Length of the time interval over which the stop times of the workers are spread [s]."""
        if self.lifetime_stagger is not None:
            return seconds_of(self.lifetime_stagger)
        return self.margin_s // 3

    @property
    def memory_bytes(self) -> int:
        """Memory of a job [bytes]."""
        return bytes_of(self.memory)

    @property
    def wait_s(self) -> int:
        """Longest time to wait for the first worker [s]."""
        return seconds_of(self.wait)


def load_cluster(path: str | Path) -> Cluster:
    """Read and validate a TOML file with a ``[cluster]`` table.

    Raises
    ------
    SpecError
        If the file is not valid; the message lists all problems.
    """
    table, problems = read_table(path)
    return cluster_of(table, f"{path}: ", problems)


def read_table(path: str | Path) -> tuple[dict[str, Any], list[str]]:
    """Read the ``[cluster]`` table of a TOML file without validating its values, and list what else is in the file.

    Returns
    -------
    table : dict
        The table.
    problems : list of str
        A sentence for each other table, which is an error.

    Raises
    ------
    SpecError
        If the file cannot be read, or has no such table.
    """
    tables = read_toml(path)
    if not isinstance(tables.get("cluster"), dict):
        raise SpecError(f"{path}: has no table [cluster]; docs/clusters.md has an example.")
    problems = [f"{path}: {unknown_key(name, name, ['cluster'])}" for name in tables if name != "cluster"]
    return tables["cluster"], problems


def cluster_of(table: Mapping[str, Any], source: str = "", problems: Sequence[str] = ()) -> Cluster:
    """Validate a ``[cluster]`` table.

    Parameters
    ----------
    table
        Values by key.
    source
        Beginning of each message, such as the file's name.
    problems
        Problems that were found before; they are raised together with those of the table.

    Raises
    ------
    SpecError
        If the table is not valid; the message lists all problems.
    """
    try:
        found = Cluster.model_validate(table)
    except ValidationError as error:
        lines = "\n".join(problems_of(error, Cluster, "cluster")).splitlines()
        raise SpecError([*problems, *(f"{source}{line.removeprefix('cluster: ')}" for line in lines)]) from None
    if problems:
        raise SpecError(problems)
    return found
