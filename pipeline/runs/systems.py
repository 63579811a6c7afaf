"""Find the batch systems of this machine by their commands on the PATH, and ask them questions."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.specification.batch_systems import SYSTEMS

LOOKED_FOR = "sbatch (SLURM), bsub (LSF), qsub (PBS, Torque, Grid Engine)"
ANSWER_S = 20.0
"""Longest time for a batch system to answer a question [s]."""

_WRAPPER = re.compile(rb"\bSlurm\b|\bSLURM\b")
_PBS, _TORQUE = re.compile(r"pbs_version\s*="), re.compile(r"^\s*version:\s*\d", re.I | re.M)
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class System:
    """Batch system of this machine.

    Attributes
    ----------
    kind : str
        Its name in a ``[cluster]`` table.
    command : str
        Path of the command that submits a batch script.
    """

    kind: str
    command: str

    @property
    def named(self) -> str:
        """Name and command, for messages."""
        return f"{SYSTEMS[self.kind].title} ({self.command})"


def find_systems() -> list[System]:
    """Return the batch systems whose commands are on the PATH.

    Several systems have a command ``qsub``. Grid Engine is recognized by ``qconf`` or by SGE_ROOT in the
    environment, OpenPBS and Torque by the version that ``qstat --version`` prints. A ``qsub`` that is a script
    of SLURM (Debian's package slurm-wlm-torque) is no further system.
    """
    found = [
        System(kind, path) for kind, name in (("slurm", "sbatch"), ("lsf", "bsub")) if (path := shutil.which(name))
    ]
    qsub = shutil.which("qsub")
    if qsub and not _is_script_of_slurm(qsub):
        found.append(System(_kind_of_qsub(), qsub))
    return found


def _is_script_of_slurm(path: str) -> bool:
    try:
        with Path(path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    return head.startswith(b"#!") and bool(_WRAPPER.search(head))


def _kind_of_qsub() -> str:
    if shutil.which("qconf") or os.environ.get("SGE_ROOT"):
        return "sge"
    said = answer(["qstat", "--version"]) or ""
    return "torque" if _TORQUE.search(said) and not _PBS.search(said) else "pbs"


def answer(command: Sequence[str]) -> str | None:
    """Return the output of a command, both its streams; None if it fails, does not answer in time, or is not there."""
    try:
        done = subprocess.run(
            list(command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=ANSWER_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
