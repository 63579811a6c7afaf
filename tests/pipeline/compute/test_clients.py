"""Schedulers and workers as processes of their own, on loopback: they come, go, differ and see other "
"files."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess

import pytest

from pipeline.compute import clients
from pipeline.compute.addresses import SchedulerError
from pipeline.compute.clients import Where, connected
from pipeline.compute.jobqueue import settings
from pipeline.runs.progress import Progress
from pipeline.runs.run import run
from pipeline.specification.clusters import SYSTEMS, load_cluster

SPEC = """
kind = "sweep"
title = "small Duffing sweep"
model = "duffing"
[axes]
frequency_hz = { start = 0.15, stop = 0.25, num = 12 }
[initial_conditions]
kind = "random"
n = 16
seed = 1
x = [-1, 1]
v = [-1, 1]
[integration]
rtol = 1e-9
atol = 1e-9
n_transient = 500
n_keep = 4
[execution]
trajectories_per_task = 16
"""
PATIENCE_S = 90.0


def silent(line):
    pass


# ---- coming and going ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_workers__come_and_go(tmp_path, write_spec, scheduler_file, worker, bytes_of, monkeypatch):
    """None is there at first; the first one is killed in the middle, after another has come."""
    path = write_spec(SPEC)
    run(path, tmp_path / "alone", workers=0, echo=silent)
    lines, kept, done = [], [], []

    def echo(line):
        lines.append(line)
        if "no workers yet" in line:
            kept.append(worker())

    def add(self, cells):
        added(self, cells)
        done.append(cells)
        if len(done) >= 2 and len(kept) == 1:
            kept.append(worker())
        if len(done) >= 4 and kept[0].poll() is None:
            os.killpg(kept[0].pid, signal.SIGKILL)
            kept[0].wait()

    added = Progress.add
    monkeypatch.setattr(Progress, "add", add)
    assert run(path, tmp_path / "out", scheduler=str(scheduler_file), echo=echo).complete
    (said,) = [line for line in lines if "no workers yet" in line]
    assert f"(from {scheduler_file}): no workers yet; waiting up to 00:10:00" in said
    assert kept[0].poll() == -signal.SIGKILL
    assert bytes_of(tmp_path / "out") == bytes_of(tmp_path / "alone")


@pytest.mark.slow
def test_workers__none(main, write_spec, scheduler_file, monkeypatch):
    monkeypatch.setenv("MAGPEND_WAIT_FOR_WORKERS", "00:00:01")
    code, _, errors = main("run", write_spec(SPEC), "--out", "out", "--scheduler", scheduler_file)
    assert code == 4
    assert "no workers yet; waiting up to 00:00:01" in errors
    assert "no worker came within 00:00:01, so nothing was computed; start workers" in errors
    assert "Traceback" not in errors
    monkeypatch.setenv("MAGPEND_WAIT_FOR_WORKERS", "soon")
    code, _, errors = main("run", write_spec(SPEC), "--out", "out", "--scheduler", scheduler_file)
    assert "MAGPEND_WAIT_FOR_WORKERS = 'soon': must be hours, minutes and seconds" in errors


# ---- other programs, other files -----------------------------------------------------------------------


def refusal(scheduler_file, n_workers, **where):
    """What is said when so many workers are there."""
    from distributed import Client

    with Client(scheduler_file=str(scheduler_file), set_as_default=False) as client:
        client.wait_for_workers(n_workers, timeout=PATIENCE_S)
    with pytest.raises(SchedulerError) as refused, connected(Where(str(scheduler_file), **where), silent):
        pass
    text = str(refused.value)
    assert "\n" not in text
    return text


@pytest.mark.slow
def test_workers__other_versions(tmp_path, environment, scheduler_file, worker):
    """One has another numba, and one no magpend at all."""
    (tmp_path / "other" / "numba-0.0.1.dist-info").mkdir(parents=True)
    (tmp_path / "other" / "numba-0.0.1.dist-info" / "METADATA").write_text("Name: numba\nVersion: 0.0.1\n")
    worker(PYTHONPATH=os.pathsep.join([str(tmp_path / "other"), environment["PYTHONPATH"]]))
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "pipeline.py").touch()  # a module, so that nothing is found in it
    worker(PYTHONPATH=str(tmp_path / "none"))
    text = refusal(scheduler_file, 2)
    assert "2 of 2 workers have other programs than this process: tcp://127.0.0.1:" in text
    assert f"numba 0.0.1, here {clients.installation()['numba']}" in text
    assert "has no magpend, or one of another version" in text
    assert "Install the same versions everywhere" in text


def test_late_worker__other_versions():
    """One that comes later, when nobody asks it any more, refuses its tasks itself."""
    task = clients.Fitting(lambda index: {"task": index})
    assert task(3) == {"task": 3}
    other = clients.Fitting(task.task, {**clients.installation(), "magpend's kernel": "another"})
    with pytest.raises(clients.MisfitError, match=r"this worker has other programs .*magpend's kernel"):
        other(3)


MOUNTS = {
    "mount -t tmpfs none {}": "does not see it (No such file or directory)",
    "mount --bind {0} {0} && mount -o remount,ro,bind {0}": "cannot write to it (Read-only file system)",
}


@pytest.mark.slow
def test_workers__other_files(tmp_path, scheduler_file, worker):
    """One sees an empty folder by the same name, one may only read: disks are mounted for them alone."""
    out = tmp_path / "out"
    out.mkdir()
    for mount in MOUNTS:
        before = ("unshare", "--mount", "--", "sh", "-c", f'{mount.format(out)} && exec "$@"', "sh")
        able = shutil.which("unshare") and subprocess.run([*before, "true"], capture_output=True, check=False)
        if not able or able.returncode:
            pytest.skip("file systems cannot be mounted for one process here (root is needed)")
        worker(before=before)
    text = refusal(scheduler_file, 2, place=str(out))
    assert f"2 of 2 workers cannot use {out}: tcp://127.0.0.1:" in text
    assert all(words in text for words in MOUNTS.values())
    assert "choose, with --out, a folder of a file system that all of them see" in text
    assert not list((out / "commits").iterdir())


@pytest.mark.slow
def test_sees(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "_LATE_S", 0.3)
    place, key = str(tmp_path), "commits/.probe.tmp"
    assert clients.sees(place, key, "token") == "does not see it (No such file or directory)"
    (tmp_path / "commits").mkdir()
    (tmp_path / key).write_text("another")
    assert clients.sees(place, key, "token") == "sees another one by that name"
    (tmp_path / key).write_text("token")
    assert clients.sees(place, key, "token") == ""
    assert [path.name for path in (tmp_path / "commits").iterdir()] == [".probe.tmp"]


# ---- scripts of worker jobs ----------------------------------------------------------------------------

CLUSTER = """
[cluster]
kind = "KIND"
queue = "short"
account = "p-42"
cores = 4
memory = "8 GB"
walltime = "04:00:00"
prologue = ["module load python/3.12"]
directives = ["-pe smp 4"]
interface = "ib0"
scratch = "$TMPDIR"
python = "/opt/python"
"""
HEADS = {
    "slurm": (
        "#SBATCH -p short",
        "#SBATCH -A p-42",
        "#SBATCH --cpus-per-task=4",
        "#SBATCH --mem=8G",
        "#SBATCH -t 04:00:00",
        "#SBATCH -pe smp 4",
    ),
    "pbs": (
        "#PBS -q short",
        "#PBS -A p-42",
        "#PBS -l select=1:ncpus=4:mem=7630MB",
        "#PBS -l walltime=04:00:00",
        "#PBS -pe smp 4",
    ),
    "sge": ("#$ -q short", "#$ -P p-42", "#$ -l h_rt=04:00:00", "#$ -pe smp 4"),
    "lsf": ("#BSUB -q short", '#BSUB -P "p-42"', "#BSUB -n 4", "#BSUB -M 8000", "#BSUB -W 04:00"),
}


@pytest.mark.parametrize("kind", HEADS)
def test_worker_script(tmp_path, kind):
    dask_jobqueue = pytest.importorskip("dask_jobqueue")
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER.replace("KIND", kind))
    job = getattr(dask_jobqueue, SYSTEMS[kind].jobqueue).job_cls
    options = settings(load_cluster(path), tmp_path / "logs")
    script = job("tls://SCHEDULER:PORT", name="NAME", **options).job_script()
    assert script.startswith("#!")
    for line in HEADS[kind]:
        assert line in script.splitlines(), script
    command = next(line for line in script.splitlines() if line.startswith("/opt/python"))
    # one process for each core, which leave before the job ends
    for words in (
        "-m distributed.cli.dask_worker tls://SCHEDULER:PORT",
        "--nthreads 1",
        "--nworkers 4",
        "--memory-limit 1.86GiB",
        "--local-directory $TMPDIR",
        "--interface ib0",
        "--lifetime 13200s",
        "--lifetime-stagger 300s",
    ):
        assert words in command
    assert script.index("export NUMBA_NUM_THREADS=1") < script.index("module load python/3.12")
    assert script.index("module load python/3.12") < script.index("/opt/python")


def test_settings__leave_the_rest_to_the_site(tmp_path):
    path = tmp_path / "cluster.toml"
    path.write_text('[cluster]\nkind = "lsf"\ncores = 1\nmemory = "1 GB"\nwalltime = "00:00:30"\n')
    found = settings(load_cluster(path), tmp_path)
    assert "queue" not in found
    assert found["walltime"] == "00:01"
