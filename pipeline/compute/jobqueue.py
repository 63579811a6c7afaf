"""Start dask workers as jobs of a batch system, as many as the work needs."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.compute.addresses import SchedulerError
from pipeline.specification.clusters import SYSTEMS, TORQUE_RESOURCES, Cluster, hours_and_minutes, refuse_breaks
from pipeline.specification.problems import SpecError, import_extra

JOB_NAME = "magpend-worker"
_THREADS = ("export NUMBA_NUM_THREADS=1", "export OMP_NUM_THREADS=1")
_MEANWHILE_S = 60
_TARGET = "0.1 s"
"""Target duration of the tasks in flight: short, since only few tasks per worker are in flight."""


def check_means(cluster: Cluster) -> None:
    """Raise `SpecError` unless batch jobs can be submitted from this machine; it names the missing extra or command."""
    import_extra("dask_jobqueue", "cluster", cluster.kind)
    command = SYSTEMS[cluster.kind].send[0]
    if not shutil.which(command):
        raise SpecError(
            f"{cluster.kind}: there is no command {command!r} here; use a machine that "
            "sends jobs, such as the login node."
        )


def jobs_folder(place: str) -> Path:
    """Return the folder for a run's batch scripts and job logs, beside the run directory.

    For a run that is not in a local folder it lies in the working directory.
    """
    where = Path(place).absolute() if "://" not in place else Path.cwd() / place.rstrip("/").rpartition("/")[2]
    return where.with_name(f"{where.name}.jobs")


def settings(cluster: Cluster, folder: Path) -> dict[str, Any]:
    """Return the keyword arguments with which dask-jobqueue starts jobs on a cluster, with logs in `folder`."""
    refuse_breaks((str(folder), cluster.python or sys.executable))
    account = "project" if cluster.kind in ("sge", "lsf") else "account"
    time = cluster.walltime if cluster.kind != "lsf" else hours_and_minutes(cluster.walltime_s)
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
        "worker_extra_args": ["--lifetime", f"{cluster.lifetime_s}s", "--lifetime-stagger", f"{cluster.stagger_s}s"],
    }
    if cluster.kind == "lsf":
        found["lsf_units"] = "mb"
    if cluster.kind == "torque":  # `select` is PBS Professional's; Torque has nodes and ppn
        found["resource_spec"] = TORQUE_RESOURCES.format(
            cores=cluster.cores, mebibytes=-(-cluster.memory_bytes // 2**20)
        )
    return {name: value for name, value in found.items() if value is not None}


def worker_script(cluster: Cluster, folder: Path) -> str:
    """Return the batch script of a job of workers, as the coordinator will send it; create nothing.

    The scheduler's address and the folder of its keys are known only when the coordinator runs; words in capital
    letters stand for them.
    """
    dask_jobqueue = import_extra("dask_jobqueue", "cluster", cluster.kind)
    from distributed import Security

    kind = getattr(dask_jobqueue, SYSTEMS[cluster.kind].jobqueue).job_cls
    keys = f"{folder}/.keys-OF-THIS-RUN"
    # dask-jobqueue creates the folder of the logs when it writes a script
    with tempfile.TemporaryDirectory(prefix="magpend-script-") as logs:
        job = kind(
            scheduler="tls://COORDINATOR:PORT",
            name=f"{SYSTEMS[cluster.kind].jobqueue}-NUMBER",
            protocol="tls://",
            security=Security(  # type: ignore[no-untyped-call]
                require_encryption=True,
                tls_ca_file=f"{keys}/ca_file",
                tls_worker_cert=f"{keys}/cert",
                tls_worker_key=f"{keys}/key",
            ),
            **settings(cluster, Path(logs)),
        )
        return str(job.job_script()).replace(logs, str(folder))


def _keys(folder: Path) -> Any:
    """Write new TLS keys, shared by scheduler, workers and client, to a folder that the jobs can read."""
    from distributed import Security

    made = Security.temporary()  # type: ignore[no-untyped-call]
    files = {}
    for name, content in made.get_tls_config_for_role("worker").items():
        if content is not None and "\n" in content:
            files[name] = folder / name
            with os.fdopen(os.open(files[name], os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(content.encode())
    roles = {
        f"tls_{role}_{name}": str(files[name]) for role in ("scheduler", "worker", "client") for name in ("cert", "key")
    }
    return Security(  # type: ignore[no-untyped-call]
        require_encryption=True, tls_ca_file=str(files["ca_file"]), **roles
    )


@contextlib.contextmanager
def job_cluster(cluster: Cluster, folder: Path, *, dashboard: bool, echo: Callable[[str], None]) -> Iterator[Any]:
    """Start a dask cluster whose workers are batch jobs, and yield it; stop it at the end of the context.

    Scheduler and workers identify each other by keys made for this cluster. The keys lie in `folder`, readable by their
    owner alone, until the cluster ends. Others on the network can neither read nor send anything.
    """
    import dask_jobqueue

    folder.mkdir(parents=True, exist_ok=True)
    kind = getattr(dask_jobqueue, SYSTEMS[cluster.kind].jobqueue)
    with tempfile.TemporaryDirectory(prefix=".keys-", dir=folder) as keys:
        options = {"dashboard": dashboard, "dashboard_address": "127.0.0.1:0"}
        try:
            jobs = kind(
                security=_keys(Path(keys)),
                scheduler_options=options,
                silence_logs=50,
                **settings(cluster, folder.absolute()),
            )
        except (ValueError, OSError, RuntimeError) as error:
            raise SchedulerError(f"{cluster.kind}: no scheduler could be started here ({error}).") from None
        with jobs:
            # not `scale`: that would not replace workers that have left at the end of their lifetime; and
            # one job at least, as no task is submitted before the first worker was looked at
            jobs.adapt(minimum_jobs=cluster.min_jobs, maximum_jobs=cluster.max_jobs, target_duration=_TARGET)
            echo(
                f"scheduler at {jobs.scheduler_address} in this process ({platform.node()}); workers "
                f"come in {cluster.kind} jobs named {JOB_NAME}, up to {cluster.max_jobs} of {cluster.cores} "
                f"cores; what they say is in {folder}"
            )
            yield jobs
