"""Batch scripts of coordinators, as text, and what is refused before one is sent."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys

import pytest

from pipeline.runs.jobs import coordinator_script
from pipeline.specification.clusters import SYSTEMS, load_cluster
from pipeline.specification.files import find_spec
from tests.pipeline.factories import duffing, quietly

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
SMALL = duffing("frequency_hz = { values = [0.2] }", 'kind = "list"\npoints = [[0.5, 0.0]]', n_transient=1, n_keep=1)
WHOLE = {
    "slurm": """
#SBATCH --job-name=magpend-out
#SBATCH --output=/logs/coordinator-%j.out
#SBATCH --open-mode=append
#SBATCH --requeue
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
#PBS -r y
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
#$ -r y
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
#BSUB -r
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
WHOLE["torque"] = WHOLE["pbs"].replace("select=1:ncpus=4:mem", "nodes=1:ppn=4,mem")
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
    found = script(cluster(kind))
    assert found == "#!/usr/bin/env bash" + WHOLE[kind] + BODY
    done = subprocess.run(["bash", "-n"], input=found, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("slurm", ("#SBATCH --cpus-per-task=1", "#SBATCH --mem=3815M", "#SBATCH --time=48:00:00")),
        ("pbs", ("#PBS -l select=1:ncpus=1:mem=3815mb", "#PBS -l walltime=48:00:00")),
        ("torque", ("#PBS -l nodes=1:ppn=1,mem=3815mb", "#PBS -l walltime=48:00:00")),
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


@pytest.mark.parametrize(
    ("kind", "said", "job"),
    [
        ("slurm", "17;north\n", "17"),
        ("pbs", "1234.pbs-server\n", "1234.pbs-server"),
        ("sge", "99\n", "99"),
        ("lsf", "Job <506> is submitted to queue <short>.\n", "506"),
        ("lsf", "Request aborted by esub.\n", None),
    ],
)
def test_batch_system__number_of_a_job(kind, said, job):
    assert SYSTEMS[kind].job(said) == job


# ---- the command ---------------------------------------------------------------------------------------


def job_file(out):
    """The first job file of a dry run."""
    return out.split("\n---- ")[1].partition("\n")[2].rstrip("\n")


def test_submit__dry_run(main, tmp_path, write_spec, cluster):
    path, table = write_spec(SMALL), cluster("slurm")
    words = ("submit", path, "--cluster", table, "--out", "out", "--dry-run")
    code, out, _ = main(*words)
    assert code == 0
    program = ["exec", sys.executable, "-m", "pipeline.cli.main"]
    here = ["run", str(path), "--out", str(tmp_path / "out"), "--scheduler", "threads", "--workers", "4"]
    assert shlex.split(job_file(out).splitlines()[-1]) == program + here
    for line in (
        "work: 1 cells in 1 tasks; at most 2 periods; cube ",
        f"batch system: SLURM (given by {table})",
        "jobs: 1 job of 4 cores, 8.0 GB, at most 4 h",
        "cores = 4: from",
        f"log: {tmp_path / 'out.jobs'}/coordinator-JOB.out",
        "follow: magpend status out; squeue -j JOB; tail -F",
        "cancel: scancel JOB",
    ):
        assert line in out
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.jobs").exists()


def test_submit__dry_run_with_workers(main, tmp_path, write_spec, cluster):
    """Job files of coordinator and workers are printed; with changes, also the table that the coordinator reads."""
    path, several = write_spec(SMALL), cluster("pbs", "max_jobs = 3\n")
    words = ("submit", path, "--cluster", several, "--out", "out", "--dry-run")
    code, out, _ = main(*words)
    assert code == 0
    assert shlex.split(job_file(out).splitlines()[-1])[-4:] == ["--scheduler", "pbs", "--cluster", str(several)]
    assert "it sends 1 to 3 jobs of workers, each of 4 cores, 8.0 GB, at most 4 h" in out
    assert "#PBS -l select=1:ncpus=4:mem=7630MB" in out
    assert "dask_worker tls://COORDINATOR:PORT" in out
    assert "cluster.toml" not in out
    code, out, _ = main(*words, "--job", "walltime=02:00:00", "--job", "max_jobs=2", "--json")
    found = json.loads(out)
    table = tmp_path / "out.jobs" / "cluster.toml"
    assert shlex.split(found["jobs"][0]["script"].splitlines()[-1])[-1] == str(table)
    assert [job["role"] for job in found["jobs"]] == ["coordinator", "workers"]
    assert found["jobs"][0]["walltime_s"] == 48 * 3600
    assert found["jobs"][1]["walltime_s"] == 2 * 3600
    assert found["reasons"]["walltime"] == "from --job"
    assert found["cells"] == found["cells_left"] == 1
    assert found["sent"] is None
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix != ".toml") == []


def test_submit__needs_no_file(main, tmp_path, write_spec, command_of):
    """The batch system that is here and the measured work are enough; the dry run shows its own list of queues."""
    path = write_spec(SMALL)
    command_of("sbatch", "echo 7")
    command_of("sinfo", "echo 'PARTITION AVAIL TIMELIMIT'; echo 'short* up 1:00:00'")
    code, out, _ = main("submit", path, "--out", "out", "--dry-run")
    assert code == 0
    assert f"batch system: SLURM ({tmp_path}/bin/sbatch is here; looked for sbatch (SLURM), bsub (LSF), qsub" in out
    assert "queue: the default of SLURM; 'sinfo -s' lists:\n  PARTITION AVAIL TIMELIMIT\n  short* up 1:00:00\n" in out
    assert "jobs: 1 job of 1 core, 1.5 GB, at most 15 min" in out
    assert "--partition" not in job_file(out)
    code, out, _ = main(
        "submit", path, "--out", "out", "--job", "queue=long", "--job", "cores=99", "--job", "account=p-1"
    )
    assert code == 0
    assert "sent: job 7 to SLURM; 1 job of 99 cores" in out
    lines = (tmp_path / "out.jobs" / "job.sh").read_text().splitlines()
    assert {"#SBATCH --partition=long", "#SBATCH --account=p-1", "#SBATCH --cpus-per-task=99"} <= set(lines)
    # a file may leave sizes out
    (tmp_path / "mine.toml").write_text('[cluster]\naccount = "p-9"\n')
    command_of("sinfo", "exit 1")
    code, out, errors = main("submit", path, "--cluster", "mine.toml", "--out", "other", "--dry-run")
    assert code == 0, errors
    assert "#SBATCH --account=p-9" in job_file(out)
    assert "'sinfo -s', which lists queues and their limits, gave no answer here" in out


def test_submit__writes_a_job_file(main, tmp_path, write_spec, command_of):
    """Also for a system that is not here; an own file is replaced, another is not."""
    words = ("submit", write_spec(SMALL), "--out", "out", "--cluster", "pbs", "--write")
    code, out, errors = main(*words, "job.sh")
    assert code == 0, errors
    assert "written: job.sh, for PBS: 1 job of 1 core" in out
    assert "send it: qsub job.sh" in out
    text = (tmp_path / "job.sh").read_text()
    assert "#PBS -l select=1:ncpus=1:mem=1431mb" in text
    assert (tmp_path / "out.jobs").is_dir()  # PBS puts no log into a folder that is not there
    assert main(*words, "job.sh")[0] == 0
    (tmp_path / "notes.txt").write_text("mine")
    assert main(*words, "notes.txt")[0] == 2
    assert main(*words, "job.sh", "--dry-run")[0] == 2


def test_submit__no_batch_system_or_several(main, tmp_path, write_spec, cluster, command_of, monkeypatch):
    path = write_spec(SMALL)

    def refused(*words):
        code, _, errors = main("submit", path, *words)
        assert code == 2
        return errors

    assert f"magpend submit {path} --out o --cluster slurm --write job.sh" in refused("--out", "o", "--dry-run")
    for words in (("--cluster", "slurm"), ()):
        assert "SLURM: there is no command 'sbatch' here" in refused("--out", "o", *words)
        monkeypatch.setenv("MAGPEND_CLUSTER", str(cluster("slurm")))
    assert "batch systems do not accept this path" in refused("--out", tmp_path / "my run")
    monkeypatch.delenv("MAGPEND_CLUSTER")
    assert not (tmp_path / "o.jobs").exists()
    command_of("sbatch", "echo 1")
    command_of("qsub", "echo 2.head")
    command_of("qstat", 'case "$*" in *--version) echo "pbs_version = 20.0.1";; *) exit 1;; esac')
    assert f"magpend submit {path} --cluster slurm, or magpend submit {path} --cluster pbs." in refused()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--cluster", "slurmm"], "slurmm: is neither a file with a [cluster] table nor a batch system"),
        (["--cluster", "slurm", "--job", "partition=x"], "--job partition=x: unknown key"),
        (["--cluster", "slurm", "--job", "cores"], "--job cores: must be KEY=VALUE"),
        (["--cluster", "sge", "--job", "cores=4"], "Grid Engine wants a parallel environment"),
    ],
)
def test_submit__wrong_words(main, write_spec, words, said):
    code, _, errors = main("submit", write_spec(SMALL), *words)
    assert code == 2
    assert said in errors


@pytest.mark.slow
def test_submit__what_the_batch_system_says(main, tmp_path, write_spec, cluster, command_of):
    """A command that refuses, one that says nothing, and a job that is there already."""
    words = ("submit", write_spec(SMALL), "--cluster", cluster("slurm"), "--out", "out")
    command_of("sbatch", "echo 'error: invalid account' >&2; exit 1")
    code, _, errors = main(*words)
    assert code == 4
    assert "sbatch did not take the job: error: invalid account.\nChange what it names by --job KEY=VALUE" in errors
    assert "'sinfo -s' lists queues and their limits, sacctmgr show associations" in errors
    assert f"The script is {tmp_path / 'out.jobs' / 'job.sh'}." in errors
    command_of("sbatch", "true")
    assert "sbatch did not take the job: exit code 0" in main(*words)[2]
    command_of("sbatch", "echo 7")
    command_of("squeue", "echo PENDING")
    assert main(*words)[0] == 0
    assert json.loads((tmp_path / "out.jobs" / "job.json").read_text()) == {"kind": "slurm", "job": "7"}
    code, _, errors = main(*words)
    assert code == 3
    assert "job 7 of this run exists already (PENDING)" in errors
    command_of("squeue", "exit 1")
    assert main(*words)[0] == 0
    (tmp_path / "out.jobs" / "job.json").write_text('{"kind": "slurm", "job": "--help; rm"}')
    assert main(*words)[0] == 0


@pytest.mark.slow
def test_submit__torque_lists_a_job_that_has_ended(main, tmp_path, write_spec, command_of):
    words = ("submit", write_spec(SMALL), "--cluster", "torque", "--out", "out")
    command_of("qsub", "echo 12.head")
    assert main(*words)[0] == 0
    command_of("qstat", "echo 'Job Id: 12.head'; echo '    job_state = R'")
    assert main(*words)[0] == 3
    command_of("qstat", "echo 'Job Id: 12.head'; echo '    job_state = C'; echo '    exit_status = 0'")
    assert main(*words)[0] == 0


def test_submit__nothing_to_send(main, tmp_path, write_spec, cluster):
    path = write_spec(SMALL)
    quietly(path, tmp_path / "out")
    words = ("submit", path, "--cluster", cluster("slurm"), "--out", "out")
    assert main(*words)[:2] == (0, "out is complete; nothing to send.\n")
    assert "out is complete; nothing would be sent." in main(*words, "--dry-run")[1]


def test_templates__are_in_order():
    """The files that ship are read as they are, one for each batch system."""
    folder = find_spec("quickstart").parent / "clusters"
    files = sorted(folder.glob("*.toml"))
    assert [load_cluster(file).kind for file in files] == [file.stem for file in files]
    assert {file.stem for file in files} == set(SYSTEMS)
