"""Cores, memory and time of a job, by the work."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipeline.runs.jobs import Work, complete, remarks
from pipeline.specification.clusters import cluster_of, seconds_of

HOUR = 3600.0
WORK = Work(
    n_cells=100_000,
    n_left=100_000,
    n_tasks=2000,
    n_tasks_left=2000,
    n_parallel=2000,
    periods=1e7,
    seconds=10 * HOUR,
    how="measured",
    n_bytes=10**9,
    task_bytes=500_000,
)


def sized(work=WORK, **given):
    table, reasons = complete({"kind": "slurm", **given}, work)
    return cluster_of(table), reasons


def test_complete__what_is_asked_for():
    """Ten hours of one core would be half an hour of 20; more than 16 cores are not asked for by themselves."""
    found, reasons = sized()
    assert found.cores == 16
    assert "no more are asked for" in reasons["cores"]
    assert found.memory_bytes == 10**9 + 16 * (5 * 10**8 + 1_500_000)


def test_complete__time_is_twice_the_estimate():
    found, _ = sized()
    wall = WORK.wall(16)
    assert wall == pytest.approx(10 * HOUR / 16, rel=0.01)
    assert 2 * wall + 600 <= seconds_of(found.walltime) < 2 * wall + 600 + 300


@pytest.mark.parametrize(
    ("change", "cores", "why"),
    [
        ({"seconds": 5.0}, 1, "a job aims at 30 min or less"),
        ({"seconds": 5 * HOUR}, 10, "a job aims at 30 min or less"),
        ({"n_parallel": 7}, 7, "no more tasks can run at a time"),
    ],
)
def test_complete__the_least_bound_decides(change, cores, why):
    found, reasons = sized(replace(WORK, **change))
    assert found.cores == cores
    assert why in reasons["cores"]


def test_complete__grid_engine_needs_a_parallel_environment():
    assert complete({"kind": "sge"}, WORK)[0]["cores"] == 1
    assert complete({"kind": "sge", "directives": ["-pe smp 16"]}, WORK)[0]["cores"] == 16


def test_complete__what_is_given_stays():
    found, reasons = sized(cores=2, memory="3 GB", walltime="00:05:00")
    assert (found.cores, found.memory, found.walltime, reasons) == (2, "3 GB", "00:05:00", {})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, []),
        (
            {"cores": 4, "walltime": "01:00:00"},
            ["2 h 30 min on 4 cores, and the job ends after 60 min: send it about 3 times", "--job max_jobs=5"],
        ),
    ],
)
def test_remarks(given, said):
    found = remarks(sized(**given)[0], WORK)
    assert len(found) == len(said)
    assert all(words in line for words, line in zip(said, found, strict=True)), found
