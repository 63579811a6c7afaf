"""Write batch scripts for clusters; define how each batch system submits, queries and cancels a job."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.compute.jobqueue import torque_resources
from pipeline.specification.clusters import Cluster, bytes_of, clock, hours_and_minutes, refuse_breaks, seconds_of


@dataclass(frozen=True)
class Words:
    """Commands of a batch system that submit, query and cancel jobs, and patterns of their output.

    Attributes
    ----------
    send : tuple of str
        Command that reads a script, by its name or from its standard input, and prints the job's number.
    ask : tuple of str
        Command that prints the state of a job whose number is appended, while the job exists.
    follow, cancel : str
        Commands for users, to which the job's number is appended.
    over : str
        Regular expression of final states.
    number : str
        Regular expression of the job's number in the output of `send`.
    """

    send: tuple[str, ...]
    ask: tuple[str, ...]
    follow: str
    cancel: str
    over: str = r"(?!)"
    number: str = r"(?P<job>\d+)"

    def job(self, output: str) -> str | None:
        """Find the number of the job in the output of the submit command; None if it has none."""
        match = re.search(self.number, output)
        return match["job"] if match else None


WORDS = {
    "slurm": Words(("sbatch", "--parsable"), ("squeue", "-h", "-o", "%T", "-j"), "squeue -j", "scancel"),
    "pbs": Words(("qsub",), ("qstat",), "qstat", "qdel", number=r"(?P<job>\d+[\w.\[\]-]*)"),
    # Torque lists a job for some time after its end, with the state C
    "torque": Words(
        ("qsub",), ("qstat", "-f"), "qstat", "qdel", r"(?s).*job_state = C\b.*", r"(?P<job>\d+[\w.\[\]-]*)"
    ),
    "sge": Words(("qsub", "-terse"), ("qstat", "-j"), "qstat -j", "qdel"),
    "lsf": Words(("bsub",), ("bjobs", "-noheader", "-o", "stat"), "bjobs", "bkill", r"DONE|EXIT", r"<(?P<job>\d+)>"),
}


def is_whole(cluster: Cluster) -> bool:
    """Return whether a single batch job both coordinates the run and does its work."""
    return cluster.max_jobs == 1


def resources(cluster: Cluster) -> tuple[int, int, int]:
    """Return the cores, the memory [bytes] and the wall time [s] of the job that coordinates a run."""
    if is_whole(cluster):
        return cluster.cores, cluster.memory_bytes, cluster.walltime_s
    time = cluster.coordinator_walltime
    return 1, bytes_of(cluster.coordinator_memory), cluster.walltime_s if time is None else seconds_of(time)


def log_name(kind: str, log: str, job: str) -> str:
    """Return the path of a job's output.

    Parameters
    ----------
    kind
        The batch system.
    log
        Path without suffix, as for `coordinator_script`.
    job
        The job's number, or a word for it.
    """
    return f"{log}-{job}.out" if kind in ("slurm", "lsf") else f"{log}.out"


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
    cores, memory, time_s = resources(cluster)
    lines = [
        "#!/usr/bin/env bash",
        *_HEADS[cluster.kind](cluster, name, log, cores, memory, time_s),
        *(f"{_MARKS[cluster.kind]} {line}" for line in _directives(cluster)),
        "",
        "set -eo pipefail",
        f"cd {shlex.quote(folder)}",
        *cluster.prologue,
        # exec: signals of the batch system reach the command, and its exit code is the job's
        f"exec {shlex.join(command)}",
    ]
    return "\n".join(lines) + "\n"


def _slurm(cluster: Cluster, name: str, log: str, cores: int, memory: int, time_s: int) -> list[str]:
    return [
        f"#SBATCH --job-name={name}",
        f"#SBATCH --output={log}-%j.out",
        "#SBATCH --open-mode=append",
        "#SBATCH --requeue",
        *_given("#SBATCH --partition={}", cluster.queue),
        *_given("#SBATCH --account={}", cluster.account),
        "#SBATCH --nodes=1",
        "#SBATCH --ntasks=1",
        f"#SBATCH --cpus-per-task={cores}",
        f"#SBATCH --mem={_upwards(memory, 2**20)}M",
        f"#SBATCH --time={clock(time_s)}",
    ]


def _pbs(cluster: Cluster, name: str, log: str, cores: int, memory: int, time_s: int) -> list[str]:
    resources = f"select=1:ncpus={cores}:mem={_upwards(memory, 2**20)}mb"
    if cluster.kind == "torque":
        resources = torque_resources(cores, memory)
    return [
        f"#PBS -N {name[:15]}",
        f"#PBS -o {log}.out",
        "#PBS -j oe",
        "#PBS -r y",
        "#PBS -V",
        *_given("#PBS -q {}", cluster.queue),
        *_given("#PBS -A {}", cluster.account),
        f"#PBS -l {resources}",
        f"#PBS -l walltime={clock(time_s)}",
    ]


def _sge(cluster: Cluster, name: str, log: str, cores: int, memory: int, time_s: int) -> list[str]:
    # cores: set by the parallel environment among the directives; memory: its resource differs by site
    return [
        f"#$ -N {name}",
        f"#$ -o {log}.out",
        "#$ -j y",
        "#$ -r y",
        "#$ -V",
        "#$ -S /bin/bash",
        *_given("#$ -q {}", cluster.queue),
        *_given("#$ -P {}", cluster.account),
        f"#$ -l h_rt={clock(time_s)}",
    ]


def _lsf(cluster: Cluster, name: str, log: str, cores: int, memory: int, time_s: int) -> list[str]:
    return [
        f"#BSUB -J {name}",
        f"#BSUB -o {log}-%J.out",
        "#BSUB -r",
        *_given("#BSUB -q {}", cluster.queue),
        *_given('#BSUB -P "{}"', cluster.account),
        f"#BSUB -n {cores}",
        *(['#BSUB -R "span[hosts=1]"'] if cores > 1 else []),
        f"#BSUB -M {_upwards(memory, 10**6)}",
        f"#BSUB -W {hours_and_minutes(time_s)}",
    ]


_HEADS = {"slurm": _slurm, "pbs": _pbs, "torque": _pbs, "sge": _sge, "lsf": _lsf}
_MARKS = {"slurm": "#SBATCH", "pbs": "#PBS", "torque": "#PBS", "sge": "#$", "lsf": "#BSUB"}


def _directives(cluster: Cluster) -> list[str]:
    """Return the user's additional lines for batch scripts; a job of one core gets no ``-pe`` (parallel
    environment).
    """
    return [line for line in cluster.directives if is_whole(cluster) or not line.strip().startswith("-pe")]


def _given(line: str, value: str | None) -> list[str]:
    return [] if value is None else [line.format(value)]


def _upwards(number: int, unit: int) -> int:
    return -(-number // unit)
