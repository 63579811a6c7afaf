"""Translate the refusals of batch systems into the key of ``[cluster]`` that removes the cause."""

from __future__ import annotations

import re

_LISTS = {
    "slurm": ("sacctmgr show associations user=$USER format=account,partition,qos", "sinfo -s"),
    "pbs": ("your site's pages", "qstat -Q"),
    "torque": ("your site's pages", "qstat -Q"),
    "sge": ("qconf -sprjl", "qconf -sql"),
    "lsf": ("your site's pages", "bqueues"),
}
"""For each batch system, the commands that list a user's accounts and the queues."""

_ACCOUNT = "account", "set the account that pays: --job account=NAME; {accounts} lists yours"
_QUEUE = "queue", "set the queue or partition: --job queue=NAME; {queues} lists them"
_TIME = "walltime", "ask for a time that the queue allows: --job walltime=HH:MM:SS; {queues} lists the limits"
_SIZE = "cores", "ask for what one node has: --job cores=N --job memory='N GB'; {queues} lists the queues"
_LESS = "walltime", "ask for less: --job walltime=HH:MM:SS, --job cores=N or --job memory='N GB'; {queues} lists limits"

_REMEDIES = [
    (r"invalid account|account/partition combination|unknown account|account .*(not|in)valid|must specify.*account"
     r"|no account|unknown project|project .*does not exist|-A .*required|invalid project", *_ACCOUNT),
    (r"invalid qos|qos .*not", "directives", "name a quality of service of yours: --job 'directives=[\"--qos=NAME\"]'; "
     "{accounts} lists them"),
    (r"time limit is invalid|requested time limit|max walltime|walltime.*(limit|exceed)|RUNLIMIT|h_rt", *_TIME),
    (r"invalid partition|no partition specified|unknown queue|\bqueue\b.*\b(not|no such)\b|no such queue"
     r"|queue is not enabled", *_QUEUE),
    (r"node configuration is not available|cpu count per node|memory specification|more processors requested"
     r"|too many (cpus|processors)|MEMLIMIT|cannot run in.*resources", *_SIZE),
    (r"resource limits|cannot satisfy", *_LESS),
    (r"invalid feature|invalid constraint|invalid generic resource|unknown resource|invalid -l|parallel environment",
     "directives", "correct the extra lines for the batch system: directives in the file of --cluster, or "
     "--job 'directives=[\"...\"]'"),
    (r"job submit limit|accounting/qos policy|maximum number of jobs|would exceed.*limit", "",
     "you have as many jobs as your site allows; wait until one ends, or ask for less"),
    (r"unable to contact|cannot connect|connection refused|communication|no route to host|not responding", "",
     "the batch system does not answer; try again later, or tell its administrators"),
    (r"bad uid|cannot be run as root|root user", "", "this site takes no jobs of this user; send it as yourself"),
]  # fmt: skip
"""Pattern of a refusal, the key of ``[cluster]`` that helps (or none), and what to do."""


def remedy(kind: str, said: str) -> str:
    """Return a sentence with the remedy for a refusal of a batch system; empty if the refusal is not known.

    Parameters
    ----------
    kind
        The batch system.
    said
        Text that its submit command printed.
    """
    for pattern, key, advice in _REMEDIES:
        if re.search(pattern, said, re.IGNORECASE):
            accounts, queues = _LISTS[kind]
            text = advice.format(accounts=accounts, queues=queues)
            kept = f" (or {key} = ... in the file of --cluster)" if key and key != "directives" else ""
            return f"{text[0].upper()}{text[1:]}{kept}."
    return ""
