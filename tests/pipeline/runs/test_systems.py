"""Batch systems found by their commands, their answers, and their refusals."""

from __future__ import annotations

import pytest

from pipeline.runs.refusals import remedy
from pipeline.runs.sites import Queue, Site, ask_site, pbs_site, slurm_seconds, slurm_site
from pipeline.runs.systems import find_systems


def kinds():
    return [system.kind for system in find_systems()]


# ---- commands ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "kind"),
    [
        ("pbs_version = 20.0.1", "pbs"),
        ("pbs_version = 2020.1.0.20200711141213", "pbs"),
        ("Version: 6.1.2\nCommit: 661e092552de43a785c15d39a3634a541d86898e", "torque"),
        ("version: 2.4.16", "torque"),
        ("something else", "pbs"),
    ],
)
def test_find_systems__qsub_has_several_makers(command_of, version, kind):
    command_of("qsub", "true")
    command_of("qstat", f"echo '{version}' >&2")
    assert kinds() == [kind]


def test_find_systems__several_and_the_qsub_of_slurm_is_none_of_them(command_of):
    """Debian's slurm-wlm-torque has a qsub in Perl, which calls sbatch; that of Grid Engine has qconf beside it."""
    assert find_systems() == []
    path = command_of("sbatch", "true")
    command_of("qsub", "# This file is part of Slurm, a resource management program.", "#! /usr/bin/perl -w")
    (found,) = find_systems()
    assert (found.kind, found.command, found.named) == ("slurm", path, f"SLURM ({path})")
    command_of("qstat", "exit 1")
    for name in ("bsub", "qsub", "qconf"):
        command_of(name, "true")
    assert kinds() == ["slurm", "lsf", "sge"]


# ---- queues and nodes ----------------------------------------------------------------------------------

SINFO = """\
debug*|up|30:00|2|32|128000
debug*|up|30:00|1|64|256000+
long|up|7-00:00:00|10|128|512000
open|up|infinite|4|48|190000
old|down|1:00:00|4|8|16000
"""


def test_slurm_site():
    site = slurm_site(SINFO)
    assert site.default == "debug"
    assert [queue.name for queue in site.queues] == ["debug", "long", "open"]
    debug, long, open_ = site.queues
    assert debug == site.queue(None) == Queue("debug", 1800, 2, 32, 128000 * 2**20)
    assert long.limit_s == 7 * 86400
    assert open_.limit_s is None
    assert open_.described == "open (no time limit, 4 nodes of 48 cores, 199.2 GB)"
    assert site.queue("none") is None
    assert slurm_site("").queues == ()
    assert slurm_site("nonsense\n|||||\n") == Site("slurm")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30:00", 1800), ("1:02:03", 3723), ("2-00:00:00", 172800), ("infinite", None), ("n/a", None), ("", None)],
)
def test_slurm_seconds(text, seconds):
    assert slurm_seconds(text) == seconds


SERVER = """\
Server: head
    server_state = Active
    default_queue = workq
    resources_default.ncpus = 1
"""
QUEUES = """\
Queue: workq
    queue_type = Execution
    total_jobs = 0
    resources_max.walltime = 48:00:00
    resources_default.walltime = 01:00:00
    acl_users = alice,bob,charlie,dave,erin,frank,grace,heidi,ivan,judy,mallory,
\toscar,peggy
    enabled = True
    started = True

Queue: closed
    queue_type = Execution
    enabled = False
    started = True
"""
NODES = """\
n001
     Mom = n001.site
     ntype = PBS
     state = free
     pcpus = 48
     resources_available.arch = linux
     resources_available.mem = 196396032kb
     resources_available.ncpus = 32

n002
     state = job-busy
     resources_available.mem = 196396032kb
     resources_available.ncpus = 32

n005
     state = offline
     resources_available.mem = 527685384kb
     resources_available.ncpus = 128

n006
     state = state-unknown,down
     resources_available.mem = 527685384kb
     resources_available.ncpus = 128

n004
     state = free
     resources_available.mem = 64gb
     resources_available.ncpus = 8
"""
TORQUE_NODES = """\
node1
     state = free
     power_state = Running
     np = 16
     ntype = cluster
     status = opsys=linux,uname=Linux node1,availmem=65000000kb,physmem=65789012kb,ncpus=16,loadave=0.00
     mom_service_port = 15002
"""


def test_pbs_site__openpbs_and_torque():
    site = pbs_site("pbs", SERVER, QUEUES, NODES)
    assert site.default == "workq"
    assert site.queues == (Queue("workq", 48 * 3600, 2, 32, 196396032 * 1024),)
    assert site.queue(None).described == "workq (at most 48 h, 2 nodes of 32 cores, 201.1 GB)"
    site = pbs_site("torque", SERVER.replace("workq", "batch"), "Queue: batch\n    enabled = True\n", TORQUE_NODES)
    assert site.queue(None) == Queue("batch", None, 1, 16, 65789012 * 1024)
    assert pbs_site("pbs", "", "", "") == Site("pbs")


def test_ask_site__asks_the_commands(command_of):
    command_of("sinfo", "echo 'short*|up|1:00:00|1|4|8000'")
    assert ask_site("slurm").queue(None).cores == 4
    command_of("sinfo", "exit 1")
    assert ask_site("slurm").silent == "sinfo"
    command_of("qstat", f"case \"$1\" in -B) echo '{SERVER}';; *) echo '{QUEUES}';; esac")
    command_of("pbsnodes", f"echo '{NODES}'")
    assert ask_site("pbs") == pbs_site("pbs", SERVER, QUEUES, NODES)
    assert ask_site("lsf") == Site("lsf")


# ---- refusals ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "said", "words"),
    [
        ("slurm", "Invalid account or account/partition combination specified", "--job account=NAME; sacctmgr show"),
        ("slurm", "Requested time limit is invalid (missing or exceeds some limit)", "--job walltime="),
        ("slurm", "Invalid feature specification", "directives in the file of --cluster"),
        (
            "slurm",
            "Job violates accounting/QOS policy (job submit limit, user's size and/or time limits)",
            "wait until",
        ),
        ("slurm", "the moon is full", ""),
        ("pbs", "qsub: Unknown queue", "--job queue=NAME; qstat -Q lists them"),
        ("torque", "Job exceeds queue resource limits MSG=cannot satisfy queue max walltime requirement", "walltime="),
        ("sge", "Unable to run job: unknown project", "--job account=NAME; qconf -sprjl"),
        ("lsf", "nix: No such queue. Job not submitted.", "--job queue=NAME; bqueues"),
    ],
)
def test_remedy__names_the_key(kind, said, words):
    assert words in remedy(kind, said)
    assert bool(words) == bool(remedy(kind, said))
