"""A SLURM of one machine, started and stopped by a test: root and Debian's slurm-wlm and munge are needed.

All of it listens on loopback alone, and all its files are in one folder.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil

from tests.pipeline.factories import free_port, wait_for

COMMANDS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "sinfo")
SBIN = "/usr/sbin:/sbin"


def why_not() -> str:
    """Why there can be no SLURM here; empty if there can."""
    if os.geteuid() != 0:
        return "SLURM's daemons are started as root"
    path = f"{os.environ.get('PATH', '')}:{SBIN}"
    missing = [name for name in COMMANDS if not shutil.which(name, path=path)]
    return f"apt-get install slurm-wlm munge: there is no {', '.join(missing)}" if missing else ""


CONFIG = """
ClusterName=magpend
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
CryptoType=crypto/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmUser=root
SlurmdUser=root
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
JobAcctGatherType=jobacct_gather/none
SchedulerParameters=batch_sched_delay=0,sched_interval=1
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ReturnToService=2
KillWait=5
MinJobAge=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=8000 State=UNKNOWN
PartitionName=short Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@contextlib.contextmanager
def running(folder: Path) -> Iterator[dict[str, str]]:
    """Start a SLURM and yield the variables by which its commands find it."""
    for name in ("state", "spool"):
        (folder / name).mkdir()
    host = socket.gethostname().partition(".")[0]
    conf = folder / "slurm.conf"
    conf.write_text(CONFIG.format(host=host, folder=folder, controller=free_port(), daemon=free_port()))
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(64))
    key.chmod(0o400)
    variables = {"SLURM_CONF": str(conf), "PATH": f"{os.environ.get('PATH', '')}:{SBIN}"}
    environment = {**os.environ, **variables}
    try:
        _call(
            environment,
            "munged",
            "--force",
            f"--key-file={key}",
            f"--socket={folder}/munge.socket",
            f"--pid-file={folder}/munged.pid",
            f"--log-file={folder}/munged.log",
            f"--seed-file={folder}/munged.seed",
        )
        _call(environment, "slurmctld", "-f", str(conf))
        _call(environment, "slurmd", "-f", str(conf))
        _wait_for_node(environment, folder)
        yield variables
    finally:
        subprocess.run(["scancel", "--full", "-u", "root"], env=environment, check=False, capture_output=True)
        # what the controller would save at its end, for seconds, is thrown away
        for name, seconds in (("slurmd", 15.0), ("slurmctld", 0.5), ("munged", 15.0)):
            _stop(folder / f"{name}.pid", seconds)


def _call(environment: dict[str, str], *command: str) -> None:
    done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, f"{command[0]}: {done.stdout}{done.stderr}"


def _wait_for_node(environment: dict[str, str], folder: Path) -> None:
    def is_idle() -> bool:
        done = subprocess.run(["sinfo", "-h", "-o", "%T"], env=environment, capture_output=True, text=True, timeout=30)
        return done.stdout.strip() == "idle"

    wait_for(is_idle, seconds=20.0)


def _stop(pid_file: Path, seconds: float) -> None:
    try:
        process = psutil.Process(int(pid_file.read_text()))
        process.terminate()
        process.wait(seconds)
    except psutil.TimeoutExpired:
        process.kill()
    except (OSError, ValueError, psutil.NoSuchProcess):
        return
