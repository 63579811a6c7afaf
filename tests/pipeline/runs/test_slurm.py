"""A run sent to a real SLURM: followed, cancelled mid-way, gone on with, and the same bytes as without it."""

from __future__ import annotations

import json
import re
import subprocess
import tempfile
from pathlib import Path

import pytest

from pipeline.runs.status import state
from tests.pipeline.factories import duffing, quietly, wait_for
from tests.pipeline.runs import slurm

SQUARE = "x = {{ start = -1, stop = 1, num = {n} }}\nv = {{ start = -1, stop = 1, num = {n} }}"
SPEC = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 12 }",
    f'kind = "grid"\n{SQUARE.format(n=8)}',
    n_transient=2000,
    n_keep=4,
    tolerance=1e-9,
    execution="trajectories_per_task = 64",
)
ONE_JOB = """
[cluster]
kind = "slurm"
queue = "short"
cores = 2
memory = "1 GB"
walltime = "00:10:00"
"""
SEVERAL_JOBS = """
[cluster]
kind = "slurm"
cores = 1
memory = "1 GB"
walltime = "00:10:00"
max_jobs = 2
coordinator_memory = "1 GB"
interface = "lo"
prologue = ["export PROLOGUE=read"]
directives = ["--nice=1"]
"""
pytestmark = pytest.mark.slow


@pytest.fixture
def shell(environment, monkeypatch):
    """A SLURM that runs, and commands of a shell in which it can be used."""
    if reason := slurm.why_not():
        pytest.skip(reason)
    # the name of munge's socket has at most 108 letters, which pytest's own folder can use up
    with tempfile.TemporaryDirectory(prefix="slurm-") as folder, slurm.running(Path(folder)) as variables:
        for name, value in {**environment, **variables}.items():
            monkeypatch.setenv(name, value)
        monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)

        def call(*words):
            return subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout

        yield call


@pytest.fixture
def magpend(main):
    def call(*words, code=0):
        found, out, errors = main(*words)
        assert found == code, errors
        return out + errors

    return call


def is_run(directory):
    return (directory / "run.json").is_file()


@pytest.mark.parametrize(
    ("kind", "cores"), [("torque", "NumCPUs=2 NumTasks=2"), ("pbs", "MinCPUsNode=2 MinMemoryNode=1908M")]
)
def test_pbs__slurm_reads_the_job_file(tmp_path, shell, magpend, kind, cores):
    """SLURM understands lines of PBS, too: it is another reader of what is written for PBS and Torque."""
    (tmp_path / "mine.toml").write_text(SPEC)
    values = [word for change in ("cores=2", "account=p-1", "queue=short") for word in ("--job", change)]
    magpend("submit", "mine.toml", "--cluster", kind, *values, "--write", "job.sh")
    job = shell("sbatch", "--parsable", "--hold", "job.sh").strip()
    told = " ".join(shell("scontrol", "show", "job", job).split())
    log = f"{tmp_path}/runs/mine.jobs/coordinator.out"
    for words in ("JobName=magpend-mine", "Account=p-1", "Requeue=1", "TimeLimit=00:15:00", "Partition=short", cores):
        assert f"{words} " in told
    assert f"StdOut={log} " in told
    assert f"StdErr={log} " in told


def test_submit__follow_cancel_and_go_on(tmp_path, shell, magpend, bytes_of):
    for name, text in (("spec", SPEC), ("one", ONE_JOB), ("several", SEVERAL_JOBS)):
        (tmp_path / f"{name}.toml").write_text(text)
    quietly(tmp_path / "spec.toml", tmp_path / "laptop")
    out, logs = tmp_path / "out", tmp_path / "out.jobs"

    # one job holds all; it is cancelled when some tasks are committed and some are not
    said = magpend("submit", "spec.toml", "--cluster", "one.toml", "--out", "out")
    job = json.loads((logs / "job.json").read_text())["job"]
    assert f"sent: job {job}" in said
    assert f"magpend status out; squeue -j {job}; tail -F {logs}/coordinator*" in said
    assert job in shell("squeue", "-h", "-o", "%i")
    refused = magpend("submit", "spec.toml", "--cluster", "one.toml", "--out", "out", code=3)
    assert f"job {job} of this run exists already" in refused
    wait_for(lambda: is_run(out) and len(state(out).commits) >= 2)
    shell("scancel", job)
    wait_for(lambda: not shell("squeue", "-h"))
    assert "incomplete" in magpend("status", "out")
    assert "Stopped. Committed results" in (logs / f"coordinator-{job}.out").read_text()
    assert 2 <= len(state(out).commits) < 12

    # gone on with by a coordinator in a job, with workers in jobs of their own
    explained = magpend("submit", "spec.toml", "--cluster", "several.toml", "--out", "out", "--dry-run", "--quiet")
    said = magpend("submit", "spec.toml", "--cluster", "several.toml", "--out", "out")
    job = json.loads((logs / "job.json").read_text())["job"]
    wait_for(lambda: "magpend-worker" in shell("squeue", "-h", "-o", "%j"))
    worker = shell("squeue", "-h", "-n", "magpend-worker", "-o", "%i").split()[0]
    sent = shell("scontrol", "write", "batch_script", worker, "-")
    wait_for(lambda: not shell("squeue", "-h", "-j", job))
    # the dry run has printed the workers' job but for address, number and folder of keys
    foreseen = explained.partition("a job of workers")[2].partition("\n")[2].strip().splitlines()
    pattern = "\n".join(map(re.escape, foreseen)).replace("COORDINATOR:PORT", r"\S+").replace("NUMBER", r"\d+")
    pattern = pattern.replace(r"OF\-THIS\-RUN", r"\w+")
    assert re.fullmatch(pattern, sent.strip()), (pattern, sent)
    told = (logs / f"coordinator-{job}.out").read_text()
    assert "Traceback" not in told
    assert "cells done before" in told
    assert "workers come in slurm jobs" in told
    assert 1 <= len(list(logs.glob("magpend-worker-*.out"))) <= 2
    assert bytes_of(out) == bytes_of(tmp_path / "laptop")
    assert "complete; nothing to send" in magpend("submit", "spec.toml", "--cluster", "one.toml", "--out", "out")

    # nothing is left: no job, no keys
    wait_for(lambda: not shell("squeue", "-h"))
    assert not list(logs.glob(".keys-*"))
