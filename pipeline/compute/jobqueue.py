"""Workers from a batch system: each job holds some, and there are as many jobs as there is work for."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.compute.addresses import SchedulerError
from pipeline.spec.clusters import Cluster
from pipeline.spec.problems import SpecError

JOB_NAME = "magpend-worker"
_CLASSES = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "sge": "SGECluster", "lsf": "LSFCluster"}
_COMMANDS = {"slurm": "sbatch", "pbs": "qsub", "sge": "qsub", "lsf": "bsub"}
_THREADS = ("export NUMBA_NUM_THREADS=1", "export OMP_NUM_THREADS=1")
_MEANWHILE_S = 60


def check_means(cluster: Cluster) -> None:
    """Make sure that jobs can be sent from here.

    Raises
    ------
    SpecError
        Naming the extra that is not installed, or the command that is not found.
    """
    problems = []
    if not all(find_spec(name) for name in ("dask_jobqueue", "cryptography")):
        problems.append(
            f"{cluster.kind}: needs packages that are not installed; install them: pip install "
            "'magpend[cluster]'."
        )
    problems += missing_command(cluster)
    if problems:
        raise SpecError(problems)


def missing_command(cluster: Cluster) -> list[str]:
    """A sentence, if the batch system's command is not on this machine."""
    command = _COMMANDS[cluster.kind]
    if shutil.which(command):
        return []
    return [
        f"{cluster.kind}: there is no command {command!r} here; give the command on a machine that sends "
        "jobs, such as the login node."
    ]


def settings(cluster: Cluster, folder: Path) -> dict[str, Any]:
    """Keywords of the classes of dask-jobqueue.

    Parameters
    ----------
    cluster
        What a job is.
    folder
        Where the batch system puts what jobs say.
    """
    account = "account" if cluster.kind in ("slurm", "pbs") else "project"
    time = cluster.walltime if cluster.kind != "lsf" else _hours_and_minutes(cluster.walltime_s)
    found: dict[str, Any] = {
        "queue": cluster.queue,
        account: cluster.account,
        "cores": cluster.cores,
        "processes": cluster.cores,
        "memory": f"{cluster.memory_bytes}B",
        "walltime": time,
        "interface": cluster.interface,
        "local_directory": cluster.scratch,
        "python": cluster.python,
        "job_name": JOB_NAME,
        "log_directory": str(folder),
        "death_timeout": _MEANWHILE_S,
        "job_script_prologue": [*_THREADS, *cluster.prologue],
        "job_extra_directives": list(cluster.directives),
        "worker_extra_args": [
            "--lifetime", f"{cluster.lifetime_s}s", "--lifetime-stagger", f"{cluster.stagger_s}s",
        ],
    }  # fmt: skip
    if cluster.kind == "lsf":
        found["lsf_units"] = "mb"
    return {name: value for name, value in found.items() if value is not None}


def _hours_and_minutes(seconds: int) -> str:
    minutes = max(1, seconds // 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def worker_script(cluster: Cluster, folder: Path) -> str:
    """The batch script of a job that holds workers, as far as it is known before a scheduler runs."""
    import dask_jobqueue

    job = getattr(dask_jobqueue, _CLASSES[cluster.kind]).job_cls
    return str(job("tls://SCHEDULER:PORT", name="NAME", **settings(cluster, folder)).job_script())


@contextlib.contextmanager
def job_cluster(
    cluster: Cluster, folder: Path, *, dashboard: bool, echo: Callable[[str], None]
) -> Iterator[Any]:
    """Yield a cluster of jobs, which ends with the block.

    Scheduler and workers know each other by keys of this cluster's own, which lie in `folder`, readable by
    their owner alone, as long as it lives: other people on the network can neither read nor send anything.

    Raises
    ------
    SchedulerError
        If the scheduler cannot be started.
    """
    import dask_jobqueue

    folder.mkdir(parents=True, exist_ok=True)
    kind = getattr(dask_jobqueue, _CLASSES[cluster.kind])
    with tempfile.TemporaryDirectory(prefix=".keys-", dir=folder) as keys:
        options = {"dashboard": dashboard, "dashboard_address": "127.0.0.1:0"}
        try:
            jobs = kind(
                security=True,
                shared_temp_directory=keys,
                scheduler_options=options,
                silence_logs=50,
                **settings(cluster, folder.absolute()),
            )
        except (ValueError, OSError, RuntimeError) as error:
            raise SchedulerError(f"{cluster.kind}: no scheduler could be started here ({error}).") from None
        with jobs:
            if cluster.min_jobs == cluster.max_jobs:
                jobs.scale(jobs=cluster.max_jobs)
            else:
                jobs.adapt(minimum_jobs=cluster.min_jobs, maximum_jobs=cluster.max_jobs)
            echo(
                f"scheduler at {jobs.scheduler_address} in this process ({os.uname().nodename}); workers "
                f"come in {cluster.kind} jobs named {JOB_NAME}, up to {cluster.max_jobs} of {cluster.cores} "
                f"cores; what they say is in {folder}"
            )
            yield jobs
