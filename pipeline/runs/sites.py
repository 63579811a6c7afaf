"""Ask a batch system for its queues and nodes: the default queue, its time limit, cores and memory of its nodes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipeline.runs.progress import size, whole
from pipeline.runs.systems import answer
from pipeline.specification.clusters import TITLES

_BYTES = {"b": 1, "kb": 2**10, "mb": 2**20, "gb": 2**30, "tb": 2**40}
_PBS_MEMORY = re.compile(r"(\d+)([kmgt]?b)?", re.I)
_TORQUE_MEMORY = re.compile(r"physmem=(\d+)kb")
_SINFO = ("sinfo", "-h", "-e", "-o", "%P|%a|%l|%D|%c|%m")
_GONE = ("down", "offline", "unknown", "stale")


@dataclass(frozen=True)
class Queue:
    """Queue (partition) of a batch system, with the nodes that most of its jobs would get.

    Attributes
    ----------
    name : str
        Its name.
    limit_s : int, optional
        Longest time of a job [s]; None if there is none, or if it is not known.
    n_nodes, cores, memory : int, optional
        Number of nodes in its largest group of equal nodes; cores and memory [bytes] of each.
    endless : bool
        Whether the batch system has said that there is no longest time.
    """

    name: str
    limit_s: int | None = None
    n_nodes: int | None = None
    cores: int | None = None
    memory: int | None = None
    endless: bool = False

    @property
    def described(self) -> str:
        """Name, time limit and nodes, for messages."""
        limit = "no time limit" if self.endless else "time limit not known"
        if self.limit_s is not None:
            limit = f"at most {whole(self.limit_s)}"
        nodes = ""
        if self.cores is not None:
            number = f"{self.n_nodes} node{'' if self.n_nodes == 1 else 's'}" if self.n_nodes else "nodes"
            memory = f", {size(self.memory)}" if self.memory else ""
            nodes = f", {number} of {self.cores} cores{memory}"
        return f"{self.name} ({limit}{nodes})"


@dataclass(frozen=True)
class Site:
    """Queues of a batch system.

    Attributes
    ----------
    kind : str
        The batch system.
    queues : tuple of Queue
        Its queues that accept jobs; empty if they are not known.
    default : str, optional
        Name of the queue of jobs that name none.
    silent : str
        Command that gave no answer, or an answer without queues; else empty.
    """

    kind: str
    queues: tuple[Queue, ...] = ()
    default: str | None = None
    silent: str = ""

    def queue(self, name: str | None) -> Queue | None:
        """Return a queue by name, or the default queue for None; None if it is not known."""
        return next((queue for queue in self.queues if queue.name == (name or self.default)), None)

    @property
    def word(self) -> str:
        """Word of the batch system for a queue."""
        return "partition" if self.kind == "slurm" else "queue"


def ask_site(kind: str) -> Site:
    """Ask a batch system for its queues and nodes.

    SLURM, OpenPBS and Torque are asked. For others, and if there is no answer, the site has no queues.
    """
    if kind == "slurm":
        found = slurm_site(answer(_SINFO) or "")
    elif kind in ("pbs", "torque"):
        server, queues = answer(("qstat", "-B", "-f")), answer(("qstat", "-Q", "-f"))
        nodes = answer(("pbsnodes", "-a")) if queues else None
        found = pbs_site(kind, server or "", queues or "", nodes or "")
    else:
        return Site(kind)
    return found if found.queues else replace(found, silent="sinfo" if kind == "slurm" else "qstat -Q -f")


def slurm_site(text: str) -> Site:
    """Read the output of ``sinfo -h -e -o '%P|%a|%l|%D|%c|%m'``: a line for each group of equal nodes."""
    groups: dict[str, list[tuple[int, int, int]]] = {}
    limits: dict[str, str] = {}
    default = None
    for line in text.splitlines():
        words = [word.strip() for word in line.split("|")]
        if len(words) != 6 or words[1] != "up" or not words[0]:
            continue
        name = words[0].rstrip("*")
        default = name if words[0].endswith("*") else default
        limits[name] = words[2]
        numbers = [re.match(r"\d+", word) for word in words[3:]]
        if all(numbers):
            n_nodes, cores, megabytes = (int(number[0]) for number in numbers if number)
            groups.setdefault(name, []).append((n_nodes, cores, megabytes * 2**20))
    queues = []
    for name, limit in limits.items():
        n_nodes, cores, memory = max(groups.get(name, [(0, 0, 0)]))
        endless = limit in ("infinite", "UNLIMITED")
        queues.append(
            Queue(name, slurm_seconds(limit), n_nodes or None, cores or None, memory or None, endless=endless)
        )
    return Site("slurm", tuple(queues), default)


def slurm_seconds(text: str) -> int | None:
    """Convert a time of SLURM ([days-]hours:minutes:seconds, minutes:seconds) to seconds; None for any other text."""
    match = re.fullmatch(r"(?:(\d+)-)?(?:(\d+):)?(\d+):(\d+)", text)
    if match is None:
        return None
    days, hours, minutes, seconds = (int(part or 0) for part in match.groups())
    return ((days * 24 + hours) * 60 + minutes) * 60 + seconds


def pbs_site(kind: str, server: str, queues: str, nodes: str) -> Site:
    """Read the output of ``qstat -B -f``, ``qstat -Q -f`` and ``pbsnodes -a`` of OpenPBS or Torque."""
    default = next(
        (values["default_queue"] for _, values in _blocks(server, "Server") if "default_queue" in values), None
    )
    kinds = Counter(filter(None, (_node(values) for _, values in _blocks(nodes, ""))))
    n_nodes, (cores, memory) = max((n, node) for node, n in kinds.items()) if kinds else (None, (None, None))
    found = []
    for name, values in _blocks(queues, "Queue"):
        if "False" in (values.get("enabled"), values.get("started")):
            continue
        limit = values.get("resources_max.walltime")
        found.append(Queue(name, None if limit is None else slurm_seconds(limit), n_nodes, cores, memory or None))
    return Site(kind, tuple(found), default)


def _blocks(text: str, what: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield names and values of the objects that PBS prints: a line with a name, and indented lines ``key = value``.

    Parameters
    ----------
    text
        The output of a command.
    what
        Word before the name, such as ``Queue``; empty for nodes. Other objects are left out.
    """
    name, key = "", ""
    values: dict[str, str] = {}
    for line in text.splitlines():
        if line[:1].strip():
            if name:
                yield name, values
            word, _, rest = line.partition(":") if what else ("", "", line)
            name, values, key = rest.strip() if word == what else "", {}, ""
        elif line.startswith("\t") and key and " = " not in line:  # the rest of a long value
            values[key] += line.strip()
        elif " = " in line:
            key, _, value = (part.strip() for part in line.partition(" = "))
            values[key] = value
    if name:
        yield name, values


def _node(values: dict[str, str]) -> tuple[int, int] | None:
    """Return cores and memory [bytes] of a node; None for a node that takes no jobs."""
    if any(word in values.get("state", "") for word in _GONE):
        return None
    cores = next((values[k] for k in ("resources_available.ncpus", "np", "pcpus") if values.get(k, "").isdigit()), None)
    if cores is None:
        return None
    memory = _PBS_MEMORY.fullmatch(values.get("resources_available.mem", ""))
    if memory is not None:
        return int(cores), int(memory[1]) * _BYTES[(memory[2] or "b").lower()]
    physical = _TORQUE_MEMORY.search(values.get("status", ""))
    return int(cores), int(physical[1]) * 2**10 if physical else 0


def no_default(site: Site) -> str:
    """Return the message for a batch system without a default queue, with the queues to choose from."""
    listed = "; ".join(queue.described for queue in site.queues[:8])
    return (
        f'{TITLES[site.kind]} has no default {site.word}; choose one and give --job queue=NAME, or queue = "NAME" '
        f"in the file of --cluster: {listed}."
    )
