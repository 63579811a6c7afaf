"""Cores, memory and time of a job, by the work and the nodes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipeline.runs.sites import Queue, Site
from pipeline.runs.sizing import Work, complete, remarks
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
SITE = Site(
    "slurm",
    (Queue("short", int(HOUR), 4, 32, 64 * 10**9), Queue("long", None, 1, 16, 16 * 10**9, endless=True)),
    "short",
)


def sized(work=WORK, site=SITE, **given):
    table, reasons = complete({"kind": "slurm", **given}, work, site)
    return cluster_of(table), reasons


def test_complete__enough_cores_for_half_an_hour():
    """Ten hours of one core are half an hour of 20; twice that and ten minutes would be above the limit of an hour."""
    found, reasons = sized()
    assert found.cores == 20
    assert reasons["cores"].startswith("about 30 min")
    assert found.memory_bytes == 10**9 + 20 * (5 * 10**8 + 1_500_000)
    assert found.walltime == "01:00:00"
    assert "the longest time of short" in reasons["walltime"]


def test_complete__time_is_twice_the_estimate():
    found, _ = sized(queue="long")
    assert found.cores == 16
    wall = WORK.wall(16)
    assert wall == pytest.approx(10 * HOUR / 16, rel=0.01)
    assert 2 * wall + 600 <= seconds_of(found.walltime) < 2 * wall + 600 + 300


@pytest.mark.parametrize(
    ("change", "cores", "why"),
    [
        ({"seconds": 5.0}, 1, "a job aims at 30 min or less"),
        ({"seconds": 1000 * HOUR}, 32, "no node of short has more"),
        ({"n_parallel": 7}, 7, "no more tasks can run at a time"),
        ({"task_bytes": 10**9}, 18, "no node of short has more"),
    ],
)
def test_complete__the_least_bound_decides(change, cores, why):
    found, reasons = sized(replace(WORK, **change))
    assert found.cores == cores
    assert why in reasons["cores"]
    assert found.memory_bytes <= 64 * 10**9


def test_complete__nodes_that_are_not_known():
    found, reasons = sized(site=Site("slurm"))
    assert found.cores == 16
    assert "if the nodes are not known" in reasons["cores"]
    table, _ = complete({"kind": "sge"}, WORK, Site("sge"))
    assert table["cores"] == 1
    table, _ = complete({"kind": "sge", "directives": ["-pe smp 16"]}, WORK, Site("sge"))
    assert table["cores"] == 16


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
        (
            {"walltime": "02:00:00", "cores": 40, "memory": "80 GB"},
            [
                "walltime is 2 h, above the longest time of partition short, 60 min",
                "cores is 40, above the cores of most nodes of partition short, 32",
                "memory is 80.0 GB, above the memory of most nodes of partition short, 64.0 GB",
            ],
        ),
    ],
)
def test_remarks(given, said):
    found = remarks(sized(**given)[0], WORK, SITE)
    assert len(found) == len(said)
    assert all(words in line for words, line in zip(said, found, strict=True)), found


def test_remarks__a_queue_that_is_not_listed():
    said = remarks(sized(queue="shrot")[0], WORK, SITE)[0]
    assert "queue 'shrot': SLURM lists no such partition, but short, long" in said
