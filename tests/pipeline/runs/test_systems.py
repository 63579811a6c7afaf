"""Batch systems found by their commands."""

from __future__ import annotations

import pytest

from pipeline.runs.batch_systems import find_systems


def kinds():
    return [system.kind for system in find_systems()]


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
