"""Find the batch systems of this machine, choose one, and collect what is given about its jobs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.specification.clusters import QUEUES, SYSTEMS, Cluster, cluster_of, read_table
from pipeline.specification.problems import SpecError, unknown_key

LOOKED_FOR = "sbatch (SLURM), bsub (LSF), qsub (PBS, Torque, Grid Engine)"
QUESTION_S = 20.0
"""Longest time for a batch system to answer a question [s]."""

_WRAPPER = re.compile(rb"\bSlurm\b|\bSLURM\b")
_PBS, _TORQUE = re.compile(r"pbs_version\s*="), re.compile(r"^\s*version:\s*\d", re.I | re.M)
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class System:
    """Batch system of this machine."""

    kind: str  # its name in a ``[cluster]`` table
    command: str  # path of the command that submits a batch script

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
            encoding="utf-8",
            errors="replace",
            timeout=QUESTION_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


CLUSTER_FILE = "MAGPEND_CLUSTER"
_LONGEST = "9999:00:00"


@dataclass(frozen=True)
class Choice:
    """Batch system of a run, and the values of ``[cluster]`` that are given."""

    kind: str  # the batch system
    table: Mapping[str, Any]  # values of ``[cluster]`` that are given
    why: str  # phrase on how the batch system was chosen
    sources: Mapping[str, str] = field(default_factory=dict)  # source of each given value, by key
    file: Path | None = None  # file with the values, if nothing else changes them


def choose(cluster: str | Path | None, changes: Sequence[str], retry: str) -> Choice:
    """Choose the batch system, and collect the given values of ``[cluster]``.

    Parameters
    ----------
    cluster
        Name of a batch system, or a file with a ``[cluster]`` table; by default the value of MAGPEND_CLUSTER, else
        the batch system whose commands are on the PATH.
    changes
        Texts ``KEY=VALUE`` that replace values.
    retry
        The command, for messages: its words after ``magpend submit``.

    Raises
    ------
    SpecError
        If a value is not valid, or there is not exactly one batch system to choose; the message has the remedy.
    """
    given, named = cluster, "--cluster"
    if not given:
        given, named = os.environ.get(CLUSTER_FILE), CLUSTER_FILE
    table: dict[str, Any] = {}
    problems: list[str] = []
    source = ""
    file = None
    if given and str(given) not in QUEUES:
        _check_file(Path(given), named)
        file = Path(given)
        table, problems = read_table(file)
        source = f"{file}: "
    sources = {key: f"from {file}" for key in table}
    changed = _changes(changes)
    table = {**table, **changed}
    sources.update({key: "from --job" for key in changed})
    why = f"given by {file}" if file else f"given by {named}"
    if given and file is None:
        table["kind"] = str(given)
    elif "kind" not in table:
        system = _only(retry)
        table["kind"], why = system.kind, f"{system.command} is here; looked for {LOOKED_FOR}"
    _check(table, source, problems)
    whole = {name for name, info in Cluster.model_fields.items() if info.is_required()} <= set(table)
    return Choice(table["kind"], table, why, sources, file if whole and not changed else None)


def _check_file(file: Path, named: str) -> None:
    if not file.suffix and not file.exists():
        raise SpecError(
            f"{named} {file}: is neither a file with a [cluster] table nor a batch system; give FILE.toml, or "
            f"{', '.join(QUEUES[:-1])} or {QUEUES[-1]}."
        )


def _check(table: Mapping[str, Any], source: str, problems: Sequence[str]) -> None:
    """Raise SpecError if given values are wrong, before anything is measured."""
    cluster_of({"cores": 1, "memory": "1 GB", "walltime": _LONGEST, **table}, source, problems)


def _changes(texts: Sequence[str]) -> dict[str, Any]:
    """Parse texts ``KEY=VALUE``; raise a SpecError that lists all that are wrong."""
    found, problems = {}, []
    for text in texts:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not value:
            problems.append(f"--job {text}: must be KEY=VALUE, such as account=my-project or walltime=02:00:00.")
        elif key not in Cluster.model_fields:
            problems.append(unknown_key(f"--job {text}", key, Cluster.model_fields))
        else:
            found[key] = _value(key, value)
    if problems:
        raise SpecError(problems)
    return found


def _value(key: str, text: str) -> Any:
    """Convert the text of an option to the type of its key: a whole number, a list, or a text without quotes."""
    kind = str(Cluster.model_fields[key].annotation)
    if "int" not in kind and "tuple" not in kind:
        return text.strip("\"'")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    return [value] if "tuple" in kind and isinstance(value, str) else value


def _only(retry: str) -> System:
    """Return the only batch system of this machine; raise SpecError with the remedy if there are none or several."""
    found = find_systems()
    if len(found) == 1:
        return found[0]
    if found:
        raise SpecError(
            f"which batch system? There are {' and '.join(system.named for system in found)} here. Choose one: "
            + ", or ".join(f"magpend submit {retry} --cluster {system.kind}" for system in found)
            + "."
        )
    raise SpecError(
        f"there is no batch system here: none of the commands {LOOKED_FOR} is on the PATH. Instead,\n"
        "- log in to a machine of the cluster that has one of them, and give this command there; or\n"
        f"- compute on this machine, now: magpend run {retry}\n"
        f"- write the job file here and send it elsewhere: magpend submit {retry} --cluster slurm --write job.sh "
        f"(or {', '.join(QUEUES[1:])})\n"
        f"- use a dask scheduler that runs already, also on Kubernetes: magpend run {retry} "
        "--scheduler tcp://HOST:8786\n"
        "docs/clusters.md has all of these."
    )


def no_command(kind: str, name: str, retry: str) -> str:
    """Return the message for a batch system whose command is not on this machine."""
    return (
        f"{SYSTEMS[kind].title}: there is no command {name!r} here; give this command on a machine that sends jobs, "
        f"such as the login node, or write the job file: magpend submit {retry} --write job.sh"
    )
