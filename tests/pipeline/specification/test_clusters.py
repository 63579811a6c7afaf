"""The ``[cluster]`` table: read as a whole, with times that fit each other."""

from __future__ import annotations

import pytest

from pipeline.specification.clusters import load_cluster
from pipeline.specification.problems import SpecError

WHOLE = """
[cluster]
kind = "slurm"
queue = "short"
account = "p-42"
cores = 16
memory = "32 GB"
walltime = "04:00:00"
min_jobs = 1
max_jobs = 8
prologue = ["module load python/3.12", "source $HOME/magpend/bin/activate"]
directives = ["--constraint=avx512"]
interface = "ib0"
scratch = "$TMPDIR"
"""


@pytest.fixture
def load(tmp_path):
    def read(text):
        path = tmp_path / "cluster.toml"
        path.write_text(text, "utf-8")
        return load_cluster(path)

    return read


def problems(load, text):
    with pytest.raises(SpecError) as refused:
        load(text)
    return refused.value.problems


@pytest.mark.parametrize("walltime", ["00:00:10", "00:01:00", "00:10:00", "01:00:00", "48:00:00"])
def test_cluster__workers_leave_before_their_job_ends(load, walltime):
    found = load(WHOLE.replace("04:00:00", walltime))
    assert (found.cores, found.memory_bytes, found.max_jobs) == (16, 32 * 10**9, 8)
    assert found.prologue[0] == "module load python/3.12"
    assert found.lifetime_s - found.stagger_s > 0
    margin = found.walltime_s - found.lifetime_s - found.stagger_s
    assert margin == min(max(found.walltime_s // 10, 30), 900, found.walltime_s // 2)
    found = load(WHOLE + 'lifetime = "03:00:00"\nlifetime_stagger = "00:10:00"\n')
    assert (found.lifetime_s, found.stagger_s) == (10800, 600)


def test_cluster__all_problems_at_once(load):
    wrong = [
        ("kind", '"slurmm"', "Did you mean 'slurm'?"),
        ("cores", "0", "must be at least 1"),
        ("memory", '"much"', "must be a number"),
        ("walltime", '"4h"', "must be hours"),
        ("max_jobs", "0", "must be"),
        ("partition", '"short"', "unknown key"),
        ("prologue", r'["two\nlines"]', "must be one line"),
        ("queue", '"a; rm -rf b"', "must be one word"),
    ]
    found = problems(load, "title = 'mine'\n[cluster]\n" + "\n".join(f"{key} = {value}" for key, value, _ in wrong))
    assert len(found) == 1 + len(wrong)
    for key, words in (("title", "unknown key"), *((f"cluster.{key}", words) for key, _, words in wrong)):
        assert any(p.startswith(key) and words in p for p in found), key


def test_cluster__what_does_not_fit_together(load):
    found = problems(load, WHOLE.replace("min_jobs = 1", 'min_jobs = 9\nlifetime = "04:00:00"'))
    assert len(found) == 2
    assert "min_jobs = 9: must be at most max_jobs = 8" in found[0]
    assert "must end before walltime = '04:00:00'" in found[1]
    text = WHOLE.replace("slurm", "sge")
    assert "such as '-pe smp 16'" in problems(load, text)[0]
    load(text.replace("--constraint=avx512", "-pe orte 16"))


def test_cluster__no_table(load, tmp_path):
    for text, words in (
        ("", "has no table [cluster]"),
        ("cluster = 3", "has no table [cluster]"),
        ("[cluster", "is not valid TOML"),
    ):
        assert words in problems(load, text)[0]
    with pytest.raises(SpecError, match="cannot be read"):
        load_cluster(tmp_path / "none.toml")
