"""Batch scripts of coordinators, as text, and what is refused before one is sent."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys

import pytest

from pipeline.runs.batch import WORDS, coordinator_script
from pipeline.runs.run import run
from pipeline.runs.submit import prepare
from pipeline.runs.workflows import find_spec
from pipeline.specification.clusters import load_cluster
from pipeline.specification.problems import SpecError

CLUSTER = """
[cluster]
kind = "KIND"
queue = "short"
account = "p-42"
cores = 4
memory = "8 GB"
walltime = "04:00:00"
prologue = ["module load python/3.12"]
directives = ["-pe smp 4", "--exclusive"]
coordinator_walltime = "48:00:00"
"""
SMALL = """
kind = "sweep"
model = "duffing"
[parameters]
frequency_hz = 0.2
[initial_conditions]
kind = "list"
points = [[0.5, 0.0]]
[integration]
n_transient = 1
n_keep = 1
"""
WHOLE = {
    "slurm": """
#SBATCH --job-name=magpend-out
#SBATCH --output=/logs/coordinator-%j.out
#SBATCH --partition=short
#SBATCH --account=p-42
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=4
#SBATCH --mem=7630M
#SBATCH --time=04:00:00
#SBATCH -pe smp 4
#SBATCH --exclusive
""",
    "pbs": """
#PBS -N magpend-out
#PBS -o /logs/coordinator.out
#PBS -j oe
#PBS -V
#PBS -q short
#PBS -A p-42
#PBS -l select=1:ncpus=4:mem=7630mb
#PBS -l walltime=04:00:00
#PBS -pe smp 4
#PBS --exclusive
""",
    "sge": """
#$ -N magpend-out
#$ -o /logs/coordinator.out
#$ -j y
#$ -V
#$ -S /bin/bash
#$ -q short
#$ -P p-42
#$ -l h_rt=04:00:00
#$ -pe smp 4
#$ --exclusive
""",
    "lsf": """
#BSUB -J magpend-out
#BSUB -o /logs/coordinator-%J.out
#BSUB -q short
#BSUB -P "p-42"
#BSUB -n 4
#BSUB -R "span[hosts=1]"
#BSUB -M 8000
#BSUB -W 04:00
#BSUB -pe smp 4
#BSUB --exclusive
""",
}
BODY = """
set -eo pipefail
cd '/my folder'
module load python/3.12
exec magpend run 'a b.toml'
"""


@pytest.fixture
def cluster(tmp_path):
    def write(kind, more=""):
        path = tmp_path / f"{kind}.toml"
        path.write_text(CLUSTER.replace("KIND", kind) + more)
        return path

    return write


def script(path):
    command = ["magpend", "run", "a b.toml"]
    return coordinator_script(load_cluster(path), "magpend-out", "/logs/coordinator", "/my folder", command)


@pytest.mark.parametrize("kind", WHOLE)
def test_script__one_job_holds_all(cluster, kind):
    assert script(cluster(kind)) == "#!/usr/bin/env bash" + WHOLE[kind] + BODY


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("slurm", ("#SBATCH --cpus-per-task=1", "#SBATCH --mem=3815M", "#SBATCH --time=48:00:00")),
        ("pbs", ("#PBS -l select=1:ncpus=1:mem=3815mb", "#PBS -l walltime=48:00:00")),
        ("sge", ("#$ -l h_rt=48:00:00",)),
        ("lsf", ("#BSUB -n 1", "#BSUB -M 4000", "#BSUB -W 48:00")),
    ],
)
def test_script__coordinator_of_other_jobs(cluster, kind, lines):
    """It needs one core, whatever the others need, and lives longer."""
    found = script(cluster(kind, "max_jobs = 8\n"))
    assert set(lines) <= set(found.splitlines())
    assert "-pe smp" not in found
    assert "--exclusive" in found


@pytest.mark.parametrize("kind", WHOLE)
def test_script__is_bash(cluster, kind):
    done = subprocess.run(["bash", "-n"], input=script(cluster(kind)), text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("kind", "said", "job"),
    [
        ("slurm", "17\n", "17"),
        ("slurm", "17;north\n", "17"),
        ("pbs", "1234.pbs-server\n", "1234.pbs-server"),
        ("sge", "99\n", "99"),
        ("lsf", "Job <506> is submitted to queue <short>.\n", "506"),
        ("lsf", "Request aborted by esub.\n", None),
    ],
)
def test_words__number_of_a_job(kind, said, job):
    assert WORDS[kind].job(said) == job


# ---- the command ---------------------------------------------------------------------------------------


def test_submit__dry_run(main, tmp_path, write_spec, sweep_text, cluster):
    path = write_spec(sweep_text)
    code, out, _ = main("submit", path, "--cluster", cluster("slurm"), "--out", "out", "--smoke", "--dry-run")
    assert code == 2  # it has no [smoke]
    code, out, _ = main("submit", path, "--cluster", cluster("slurm"), "--out", "out", "--dry-run")
    assert code == 0
    words = shlex.split(out.splitlines()[-1])
    assert words == [
        "exec",
        sys.executable,
        "-m",
        "pipeline.cli.main",
        "run",
        str(path),
        "--out",
        str(tmp_path / "out"),
        "--scheduler",
        "local",
        "--workers",
        "4",
    ]
    several = cluster("pbs", "max_jobs = 3\n")
    code, out, _ = main("submit", path, "--cluster", several, "--out", "out", "--dry-run")
    assert shlex.split(out.splitlines()[-1])[-4:] == ["--scheduler", "pbs", "--cluster", str(several)]
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.jobs").exists()


def test_submit__refusals(main, tmp_path, write_spec, sweep_text, cluster, monkeypatch):
    path = write_spec(sweep_text)
    monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)
    assert main("submit", path)[0] == 2
    monkeypatch.setenv("MAGPEND_CLUSTER", str(cluster("slurm")))
    code, _, errors = main("submit", path, "--out", tmp_path / "my run")
    assert code == 2
    assert "batch systems do not accept this path" in errors
    monkeypatch.setenv("PATH", str(tmp_path))
    code, _, errors = main("submit", path, "--out", "out")
    assert code == 2
    assert "slurm: there is no command 'sbatch' here" in errors
    assert not (tmp_path / "out.jobs").exists()


def test_submit__what_the_batch_system_says(main, tmp_path, write_spec, sweep_text, cluster, monkeypatch):
    """A command that refuses, one that says nothing, and a job that is there already."""
    path, commands = write_spec(sweep_text), tmp_path / "bin"
    commands.mkdir()
    monkeypatch.setenv("PATH", f"{commands}:/usr/bin:/bin")

    def command(name, text):
        (commands / name).write_text(f"#!/bin/sh\n{text}\n")
        (commands / name).chmod(0o755)

    words = ("submit", path, "--cluster", cluster("slurm"), "--out", "out")
    command("sbatch", "echo 'error: invalid account' >&2; exit 1")
    code, _, errors = main(*words)
    assert code == 4
    assert "sbatch did not take the job: error: invalid account. The script is" in errors
    command("sbatch", "true")
    assert "sbatch did not take the job: exit code 0" in main(*words)[2]
    command("sbatch", "echo 7")
    command("squeue", "echo PENDING")
    assert main(*words)[0] == 0
    assert json.loads((tmp_path / "out.jobs" / "job.json").read_text()) == {"kind": "slurm", "job": "7"}
    code, _, errors = main(*words)
    assert code == 3
    assert "job 7 of this run exists already (PENDING)" in errors
    command("squeue", "exit 1")
    assert main(*words)[0] == 0
    (tmp_path / "out.jobs" / "job.json").write_text('{"kind": "slurm", "job": "--help; rm"}')
    assert main(*words)[0] == 0


def test_submit__nothing_to_send(main, tmp_path, write_spec, cluster):
    path = write_spec(SMALL)
    run(path, tmp_path / "out", workers=0, echo=lambda line: None)
    code, out, _ = main("submit", path, "--cluster", cluster("slurm"), "--out", "out")
    assert (code, out) == (0, "out is complete; nothing to send.\n")


def test_templates__are_in_order():
    """The files that ship are read as they are, one for each batch system."""
    folder = find_spec("quickstart").parent / "clusters"
    files = sorted(folder.glob("*.toml"))
    assert [load_cluster(file).kind for file in files] == [file.stem for file in files]
    assert {file.stem for file in files} == set(WORDS)


def test_prepare__no_cluster_file(write_spec, sweep_text, monkeypatch):
    monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)
    with pytest.raises(SpecError, match="a job is not described"):
        prepare(write_spec(sweep_text), None, None)
