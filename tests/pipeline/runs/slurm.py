"""A SLURM of one machine, started and stopped by a test: root and Debian's slurm-wlm and munge are needed.

All of it listens on loopback alone, and all its files are in one folder.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

COMMANDS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "sinfo")
SBIN = "/usr/sbin:/sbin"


def why_not() -> str:
    """Why there can be no SLURM here; empty if there can."""
    if os.geteuid() != 0:
        return "SLURM's daemons are started as root"
    path = f"{os.environ.get('PATH', '')}:{SBIN}"
    missing = [name for name in COMMANDS if not shutil.which(name, path=path)]
    return f"apt-get install slurm-wlm munge: there is no {', '.join(missing)}" if missing else ""


def free_port() -> int:
    with socket.socket() as chosen:
        chosen.bind(("127.0.0.1", 0))
        return int(chosen.getsockname()[1])


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


def _wait_for_node(environment: dict[str, str], folder: Path, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while True:
        state = subprocess.run(
            ["sinfo", "-h", "-o", "%T"], env=environment, check=False, capture_output=True, text=True, timeout=30
        ).stdout.strip()
        if state == "idle":
            return
        if time.monotonic() > deadline:
            log = (folder / "slurmctld.log").read_text() + (folder / "slurmd.log").read_text()
            raise AssertionError(f"the node is {state or 'not there'}:\n{log[-3000:]}")
        time.sleep(0.1)


def _stop(pid_file: Path, seconds: float) -> None:
    try:
        pid = int(pid_file.read_text())
        os.kill(pid, signal.SIGTERM)
    except (OSError, ValueError):
        return
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)
        if not Path(f"/proc/{pid}").exists():
            return
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
