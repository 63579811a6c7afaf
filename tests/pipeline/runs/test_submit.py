"""Batch jobs: their scripts as text, their sizes, the batch systems that are here, and what is refused."""

from __future__ import annotations

import itertools
import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.compute.jobqueue import settings
from pipeline.runs.batch_systems import find_systems
from pipeline.runs.jobs import Work, complete, coordinator_script, remarks
from pipeline.runs.submit import prepare
from pipeline.specification.clusters import QUEUES, SYSTEMS, cluster_of, load_cluster, seconds_of
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError
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
SLURM = """#!/usr/bin/env bash
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
"""
# lines of a job that holds all, and of a coordinator of other jobs: one core, whatever they need, and a longer life
LINES = {
    "slurm": ("--cpus-per-task=4; --mem=7630M", "--cpus-per-task=1; --mem=3815M; --time=48:00:00"),
    "pbs": ("-N magpend-out; -q short; -l select=1:ncpus=4:mem=7630mb", "-l select=1:ncpus=1:mem=3815mb"),
    "torque": ("-q short; -A p-42; -l nodes=1:ppn=4,mem=7630mb", "-l nodes=1:ppn=1,mem=3815mb; -l walltime=48:00:00"),
    "sge": ("-q short; -P p-42; -l h_rt=04:00:00; -o /logs/coordinator.out", "-l h_rt=48:00:00"),
    "lsf": ('-q short; -P "p-42"; -n 4; -R "span[hosts=1]"; -M 8000; -W 04:00', "-n 1; -M 4000; -W 48:00"),
}
MARK = {"slurm": "#SBATCH", "pbs": "#PBS", "torque": "#PBS", "sge": "#$", "lsf": "#BSUB"}
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


@pytest.mark.parametrize("kind", LINES)
def test_script__one_job_holds_all_or_coordinates_others(cluster, kind):
    one, other = script(cluster(kind)), script(cluster(kind, "max_jobs = 8\n"))
    for found, lines in zip((one, other), LINES[kind], strict=True):
        assert {f"{MARK[kind]} {words}" for words in lines.split("; ")} <= set(found.splitlines())
        assert found.endswith(BODY)
        assert "--exclusive" in found
    assert "-pe smp" in one
    assert "-pe smp" not in other
    assert one == SLURM + BODY or kind != "slurm"
    done = subprocess.run(["bash", "-n"], input=one, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


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
    several = cluster("pbs", "max_jobs = 3\n")
    words = ("submit", write_spec(SMALL), "--cluster", several, "--out", "out", "--dry-run")
    code, out, _ = main(*words)
    assert code == 0
    assert shlex.split(job_file(out).splitlines()[-1])[-4:] == ["--scheduler", "pbs", "--cluster", str(several)]
    assert "it sends 1 to 3 jobs of workers, each of 4 cores, 8.0 GB, at most 4 h" in out
    assert "dask_worker tls://COORDINATOR:PORT" in out
    assert "cluster.toml" not in out
    found = json.loads(main(*words, "--job", "walltime=02:00:00", "--job", "max_jobs=2", "--json")[1])
    table = tmp_path / "out.jobs" / "cluster.toml"
    assert shlex.split(found["jobs"][0]["script"].splitlines()[-1])[-1] == str(table)
    assert [(job["role"], job["walltime_s"]) for job in found["jobs"]] == [("coordinator", 172800), ("workers", 7200)]
    assert found["reasons"]["walltime"] == "from --job"
    assert (found["cells"], found["cells_left"], found["sent"]) == (1, 1, None)
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix != ".toml") == []


def test_submit__needs_no_file(main, tmp_path, write_spec, command_of):
    """The batch system that is here and the measured work are enough; the dry run shows its own list of queues."""
    words = ("submit", write_spec(SMALL), "--out", "out")
    command_of("sbatch", "echo 7")
    command_of("sinfo", "echo 'PARTITION AVAIL TIMELIMIT'; echo 'short* up 1:00:00'")
    code, out, _ = main(*words, "--dry-run")
    assert code == 0
    for line in (
        f"batch system: SLURM ({tmp_path}/bin/sbatch is here; looked for sbatch (SLURM), bsub (LSF), qsub",
        "queue: the default of SLURM; 'sinfo -s' lists:\n  PARTITION AVAIL TIMELIMIT\n  short* up 1:00:00\n",
        "jobs: 1 job of 1 core, 1.5 GB, at most 15 min",
    ):
        assert line in out
    assert "--partition" not in job_file(out)
    # a file may leave sizes out
    (tmp_path / "mine.toml").write_text('[cluster]\naccount = "p-9"\n')
    command_of("sinfo", "exit 1")
    code, out, errors = main(*words, "--cluster", "mine.toml", "--job", "queue=long", "--job", "cores=99")
    assert code == 0, errors
    assert "sent: job 7 to SLURM; 1 job of 99 cores" in out
    lines = (tmp_path / "out.jobs" / "job.sh").read_text().splitlines()
    assert {"#SBATCH --partition=long", "#SBATCH --account=p-9", "#SBATCH --cpus-per-task=99"} <= set(lines)


def test_submit__writes_a_job_file(main, tmp_path, write_spec, command_of):
    """Also for a system that is not here; an own file is replaced, another is not."""
    words = ("submit", write_spec(SMALL), "--out", "out", "--cluster", "pbs", "--write")
    code, out, errors = main(*words, "job.sh")
    assert code == 0, errors
    assert "send it: qsub job.sh" in out
    assert "#PBS -l select=1:ncpus=1:mem=1431mb" in (tmp_path / "job.sh").read_text()
    assert (tmp_path / "out.jobs").is_dir()  # PBS puts no log into a folder that is not there
    (tmp_path / "notes.txt").write_text("mine")
    for code, more in ((0, ["job.sh"]), (2, ["notes.txt"]), (2, ["job.sh", "--dry-run"])):
        assert main(*words, *more)[0] == code


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
    assert f"The script is {tmp_path / 'out.jobs' / 'job.sh'}." in errors
    command_of("sbatch", "true")
    assert "sbatch did not take the job: exit code 0" in main(*words)[2]
    command_of("sbatch", "echo 7")
    command_of("squeue", "echo PENDING")
    assert main(*words)[0] == 0
    job = tmp_path / "out.jobs" / "job.json"
    assert json.loads(job.read_text()) == {"kind": "slurm", "job": "7"}
    code, _, errors = main(*words)
    assert code == 3
    assert "job 7 of this run exists already (PENDING)" in errors
    command_of("squeue", "exit 1")
    assert main(*words)[0] == 0
    job.write_text('{"kind": "slurm", "job": "--help; rm"}')
    assert main(*words)[0] == 0
    # Torque lists a job that has ended
    words = ("submit", tmp_path / "spec.toml", "--cluster", "torque", "--out", "other")
    command_of("qsub", "echo 12.head")
    for code, state in ((0, ""), (3, "job_state = R"), (0, "job_state = C'; echo '    exit_status = 0")):
        command_of("qstat", f"echo 'Job Id: 12.head'; echo '    {state}'")
        assert main(*words)[0] == code


def test_submit__nothing_to_send(main, tmp_path, write_spec, cluster):
    words = ("submit", write_spec(SMALL), "--cluster", cluster("slurm"), "--out", "out")
    quietly(tmp_path / "spec.toml", tmp_path / "out")
    assert main(*words)[:2] == (0, "out is complete; nothing to send.\n")
    assert "out is complete; nothing would be sent." in main(*words, "--dry-run")[1]


def test_templates__are_in_order():
    """The files that ship are read as they are, one for each batch system."""
    folder = find_spec("quickstart").parent / "clusters"
    files = sorted(folder.glob("*.toml"))
    assert [load_cluster(file).kind for file in files] == [file.stem for file in files]
    assert {file.stem for file in files} == set(SYSTEMS)


MARKS = ["#SBATCH --uid=0", "#PBS -l walltime=99:00:00", "#$ -l h_rt=99:00:00", "#BSUB -W 99:00"]


@pytest.mark.parametrize("kind", QUEUES)
def test_scripts__no_name_puts_a_line_of_its_own_into_them(kind, tmp_path, write_spec, monkeypatch):
    cluster = cluster_of({"kind": kind, "cores": 1, "memory": "1 GB", "walltime": "01:00:00"})
    names = ["magpend-a", "/logs/coordinator", "/home/me", "/home/me/a.toml"]
    assert coordinator_script(cluster, *names[:3], ["run", names[3]])
    assert settings(cluster, Path("/logs"))
    for mark, control, place in itertools.product(MARKS, "\n\r\x00\x1b\u2028", range(4)):
        words = [*names[:place], f"a{control}{mark}", *names[place + 1 :]]
        with pytest.raises(SpecError, match="line breaks"):
            coordinator_script(cluster, *words[:3], ["run", words[3]])
    with pytest.raises(SpecError, match="line breaks"):
        settings(cluster, Path(f"/logs/a\n{MARKS[0]}"))
    # also of the folder in which it is sent
    monkeypatch.setenv("PATH", str(tmp_path))  # no batch system of this machine is asked
    spec, place = write_spec(SMALL), tmp_path / f"a\n{MARKS[1]}"
    place.mkdir()
    monkeypatch.chdir(place)
    with pytest.raises(SpecError, match="line breaks"):
        prepare(spec, tmp_path / "out", "pbs", ["walltime=01:00:00", "cores=1", "memory=1 GB"])
    assert not (tmp_path / "out.jobs").exists()


# ---- cores, memory and time by the work ------------------------------------------------------------------

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
    wall = WORK.wall(16)
    assert wall == pytest.approx(10 * HOUR / 16, rel=0.01)
    # twice the estimate
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


def test_remarks():
    assert remarks(sized()[0], WORK) == []
    often, nodes = remarks(sized(cores=4, walltime="01:00:00")[0], WORK)
    assert "2 h 30 min on 4 cores, and the job ends after 60 min: send it about 3 times" in often
    assert "--job max_jobs=5" in nodes


# ---- batch systems found by their commands ---------------------------------------------------------------


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
