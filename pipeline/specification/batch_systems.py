"""Describe the batch systems as data: their job files, and the commands that send, ask for, list and cancel jobs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class BatchSystem:
    """A batch system.

    Attributes
    ----------
    title : str
        Its name, for messages.
    mark : str
        Begin of the lines of a job file that are for the batch system.
    head : str
        Lines of a job file, without the mark, with ``{fields}``, see `lines`.
    send : tuple of str
        Command that reads a job file, by its name or from its standard input, and prints the job's number.
    ask : tuple of str
        Command that prints the state of a job whose number is appended, while the job exists.
    follow, cancel : str
        Commands for users, to which the job's number is appended.
    queues : str
        Command that lists queues and their limits.
    jobqueue : str
        Class of dask-jobqueue.
    accounts : str
        Command that lists a user's accounts, or where they stand.
    over : str
        Regular expression of final states.
    number : str
        Regular expression of the job's number in the output of `send`.
    log : str
        Suffix of the path of a job's output; ``{job}`` is the job's number.
    """

    title: str
    mark: str
    head: str
    send: tuple[str, ...]
    ask: tuple[str, ...]
    follow: str
    cancel: str
    queues: str
    jobqueue: str
    accounts: str = "your site's pages"
    over: str = r"(?!)"
    number: str = r"(?P<job>\d+)"
    log: str = ".out"

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
