"""Write the batch script of the job that coordinates a run."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from pipeline.specification.batch_systems import SYSTEMS
from pipeline.specification.clusters import Cluster, bytes_of, clock, hours_and_minutes, refuse_breaks, seconds_of


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
