"""Runs with the kernel: same bytes whatever happens on the way."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
import time
import tomllib

import numpy as np
import psutil
import pytest

from magpend_core import load_preset, run_branches
from pipeline import open_run
from pipeline.compute import task
from pipeline.compute.execute import TaskFailedError
from pipeline.layout import identity
from pipeline.runs.preview import describe_plan
from pipeline.runs.progress import Progress
from pipeline.runs.run import InterruptedRunError, run
from pipeline.runs.status import state
from pipeline.specification.spec import Spec
from pipeline.store.errors import LockedError, RefusedError
from pipeline.store.runfile import read_run
from tests.pipeline.factories import FOLD, WELL, silent

MANY = """
[axes]
frequency_hz = { start = 2.0, stop = 2.5, num = 3 }
[initial_conditions]
kind = "random"
n = 64
psi1_deg = [-40, 40]
[integration]
n_transient = 100
n_keep = 4
"""
EIGHT = "[execution]\ntrajectories_per_task = 8"
DRIFT = Spec(**FOLD).with_integration(n_keep=8).with_execution(trajectories_per_task=2).toml()
NOISE = WELL.replace("[0.45, 0.55, 0.7]", "[0.45, 0.7]").replace("stop = 199", "stop = 7")
NOISE = NOISE.replace("n_transient = 0", "n_transient = 2").replace("n_keep = 1000", "n_keep = 8")
NOISE = f"{NOISE}\n[execution]\ntrajectories_per_task = 4"
MANY_SWEEP = f'kind = "sweep"\n{MANY}\n{EIGHT}'
HALF = MANY.replace("n = 64", "n = 32")  # both ways, as many cells as the sweep
MANY_WALK = f'kind = "continuation"\n{HALF}\n[continuation]\ndirection = "both"\n{EIGHT}\npoints_per_task = 1'


@pytest.mark.slow
def test_run__walk_is_what_the_kernel_says(write_spec, walk_text, tmp_path):
    run(write_spec(walk_text), tmp_path / "run", workers=0, echo=silent)
    ds = open_run(tmp_path / "run")
    assert ds.section.dims == ("frequency", "branch", "period_index", "state")
    assert ds.direction.values.tolist() == ["up"] * 5 + ["down"] * 5
    assert ds.attrs["path"] == "frequency"
    spec = Spec.parse(tomllib.loads(walk_text))
    path = spec.axes["frequency_hz"].array()
    starts = np.column_stack([ds[f"{s}_0"] for s in ("psi1", "psi2", "psi1_dot", "psi2_dot")])
    frequency = np.array([path] * 5 + [path[::-1]] * 5)
    packed = np.broadcast_to(load_preset().pack(), (10, 6, len(load_preset().names)))
    expected = run_branches(packed, frequency, starts, **spec.integration.model_dump())
    for name in ("section", "turns", "status", "orbit_period", "n_steps"):
        found = ds[name].transpose("branch", "frequency", ...).values
        wanted = getattr(expected, name).copy()
        wanted[5:] = wanted[5:, ::-1]
        assert np.array_equal(found, wanted, equal_nan=True), name


def test_run__sweep_is_what_the_kernel_says(write_spec, sweep_text, tmp_path):
    run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)
    ds = open_run(tmp_path / "run")
    cell = ds.isel(frequency=3, q=1, psi1_0=2, psi2_0=1)
    start = [float(cell[f"{s}_0"]) for s in ("psi1", "psi2", "psi1_dot", "psi2_dot")]
    packed = load_preset(q=1.6).pack().reshape(1, 1, -1)
    options = Spec.parse(tomllib.loads(sweep_text)).integration.model_dump()
    expected = run_branches(packed, np.array([[2.75]]), np.array([start]), **options)
    assert np.array_equal(cell.section.values, expected.section[0, 0])
    assert int(cell.n_steps) == expected.n_steps[0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sweep", "walk", "drift", "noise"])
def test_run__same_bytes_everywhere(write_spec, sweep_text, walk_text, tmp_path, bytes_of, kind):
    path = write_spec({"sweep": sweep_text, "walk": walk_text, "drift": DRIFT, "noise": NOISE}[kind])
    places = [(0, None), (1, "threads"), (2, "threads"), (3, "threads")]
    places += [(2, "processes")] if kind == "walk" else []
    found = []
    for workers, scheduler in places:
        directory = tmp_path / f"{scheduler}{workers}"
        assert run(path, directory, workers=workers, scheduler=scheduler, echo=silent).complete
        found.append(bytes_of(directory))
    assert all(other == found[0] for other in found[1:])
    assert sum(key.startswith("commits/") for key in found[0]) > 2


@pytest.mark.slow
def test_run__in_another_thread_and_inside_an_event_loop(write_spec, walk_text, tmp_path):
    path, done = write_spec(walk_text), []

    async def compute():
        done.append(run(path, tmp_path / "loop", workers=2, echo=silent).complete)

    def loop():
        asyncio.run(compute())
        done.append(run(path, tmp_path / "thread", workers=2, echo=silent).complete)

    thread = threading.Thread(target=loop)
    thread.start()
    thread.join()
    assert done == [True, True]


@pytest.mark.slow
def test_run__numbers_do_not_depend_on_the_tasks(write_spec, sweep_text, tmp_path):
    for n in (24, 7):
        text = sweep_text.replace("trajectories_per_task = 24", f"trajectories_per_task = {n}")
        run(write_spec(text), tmp_path / f"run{n}", workers=0, echo=silent)
    one, other = open_run(tmp_path / "run24").load(), open_run(tmp_path / "run7").load()
    assert one.drop_attrs(deep=False).identical(other.drop_attrs(deep=False))


def counted(monkeypatch, fail_at=None, error=None):
    """Count the tasks computed in this process; let one of them fail, whenever it is tried."""
    calls = []
    original = task.compute

    def compute(spec, cells, block):
        calls.append(block)
        if fail_at is not None and block == calls[min(fail_at, len(calls)) - 1] and len(calls) >= fail_at:
            raise error or RuntimeError("out of luck")
        return original(spec, cells, block)

    monkeypatch.setattr(task, "compute", compute)
    return calls


def test_run__again_does_nothing(write_spec, sweep_text, tmp_path, monkeypatch, bytes_of):
    path = write_spec(sweep_text)
    run(path, tmp_path / "run", workers=0, echo=silent)
    before = bytes_of(tmp_path / "run")
    calls = counted(monkeypatch)
    lines = []
    run(path, tmp_path / "run", workers=0, echo=lines.append)
    assert calls == []
    assert "nothing to do" in lines[0]
    assert bytes_of(tmp_path / "run") == before


@pytest.mark.slow
def test_run__failed_task_then_only_the_rest(write_spec, sweep_text, tmp_path, monkeypatch, bytes_of):
    path = write_spec(sweep_text)
    run(path, tmp_path / "whole", workers=0, echo=silent)
    n_tasks = state(tmp_path / "whole").plan.n_tasks
    with monkeypatch.context() as patch:
        tried = counted(patch, fail_at=3)
        with pytest.raises(TaskFailedError, match="task 2: RuntimeError: out of luck"):
            run(path, tmp_path / "run", workers=0, echo=silent)
    assert len(tried) == n_tasks + 1
    assert tried[2] == tried[-1]
    assert state(tmp_path / "run").done == set(range(n_tasks)) - {2}
    for leftover in ("cube.zarr/section/c.2.0.0.0.0.abc.partial", "cube.zarr/status/c.2.0.0.0", "commits/.2.tmp"):
        (tmp_path / "run" / leftover).write_bytes(b"left by a crash")
    calls = counted(monkeypatch)
    run(path, tmp_path / "run", workers=0, echo=silent)
    assert len(calls) == 1
    assert bytes_of(tmp_path / "run") == bytes_of(tmp_path / "whole")


def test_run__ctrl_c_in_process(write_spec, sweep_text, tmp_path, monkeypatch):
    counted(monkeypatch, fail_at=2, error=KeyboardInterrupt())
    with pytest.raises(InterruptedRunError, match="the same command continues") as caught:
        run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)
    assert caught.value.signal_number == signal.SIGINT
    assert state(tmp_path / "run").done == {0}


def test_run__changed_spec_is_refused(write_spec, sweep_text, tmp_path, bytes_of):
    run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)
    before = bytes_of(tmp_path / "run")
    changed = write_spec(sweep_text.replace("rtol = 1e-6", "rtol = 1e-5"), "changed.toml")
    for function in (
        lambda: run(changed, tmp_path / "run", workers=0),
        lambda: list(describe_plan(changed, tmp_path / "run")),
    ):
        with pytest.raises(RefusedError, match=r"spec\.integration\.rtol: 1e-06 in the directory, 1e-05 now"):
            function()
    assert bytes_of(tmp_path / "run") == before


def test_run__other_kernel_is_refused(write_spec, sweep_text, tmp_path, monkeypatch):
    path = write_spec(sweep_text)
    run(path, tmp_path / "run", workers=0, echo=silent)
    monkeypatch.setattr(identity, "ENGINE", 1000)
    with pytest.raises(RefusedError, match=r"versions.engine: \d+ in the directory, 1000 now"):
        run(path, tmp_path / "run", workers=0, echo=silent)


def test_task__other_kernel_on_a_worker_is_refused(write_spec, sweep_text, tmp_path, monkeypatch):
    run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)
    digest = read_run(tmp_path / "run").digest
    task._prepare.cache_clear()
    monkeypatch.setattr(identity, "ENGINE", 1000)
    with pytest.raises(RefusedError, match="would not compute the same run"):
        task.run_task(str(tmp_path / "run"), digest, 0)


def test_run__locked(write_spec, sweep_text, tmp_path):
    from filelock import FileLock

    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / "lock", is_singleton=False), pytest.raises(LockedError):
        run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)


def wait_for_commits(process, directory, n):
    """Wait until a running command has committed `n` tasks."""
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None:
        folder = directory / "commits"
        if folder.is_dir() and len(list(folder.glob("*.json"))) >= n:
            return
        time.sleep(0.002)
    raise AssertionError((process.poll(), process.communicate()))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Both kinds of run, done at a stretch."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    for name, text in (("sweep", MANY_SWEEP), ("walk", MANY_WALK)):
        (folder / f"{name}.toml").write_text(text)
        run(folder / f"{name}.toml", folder / name, workers=0, echo=silent)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "workers", "seed"), [("sweep", 2, 0), ("walk", 2, 1), ("sweep", 0, 2), ("walk", 0, 3)]
)
def test_kill__resumed_run_has_the_same_bytes(uninterrupted, start, tmp_path, bytes_of, kind, workers, seed):
    rng = np.random.default_rng(seed)
    spec, directory = uninterrupted / f"{kind}.toml", tmp_path / "run"
    n_tasks = state(uninterrupted / kind).plan.n_tasks
    n_kills = 2 if (kind, workers) == ("sweep", 2) else 1
    for share in np.sort(rng.uniform(0, 0.8, n_kills)):
        process = start("run", spec, "--out", directory, "--workers", workers)
        wait_for_commits(process, directory, int(share * n_tasks))
        time.sleep(rng.uniform(0, 0.05))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert not state(directory).complete
    assert run(spec, directory, workers=0, echo=silent).complete
    assert bytes_of(directory) == bytes_of(uninterrupted / kind)


@pytest.mark.slow
def test_kill__of_processes_over_and_over_loses_nothing(uninterrupted, start, tmp_path, bytes_of):
    """A process dies with every third task that is committed; those that live and new ones do the rest."""
    rng = np.random.default_rng(4)
    spec, directory = uninterrupted / "sweep.toml", tmp_path / "run"
    process = start("run", spec, "--out", directory, "--workers", 2, "--scheduler", "processes")
    killed = 0
    for count in range(2, 14, 3):
        wait_for_commits(process, directory, count)
        with contextlib.suppress(psutil.NoSuchProcess):
            found = psutil.Process(process.pid).children()
            found[rng.integers(len(found))].kill()
            killed += 1
    out, err = process.communicate(timeout=240)
    assert killed >= 3
    assert process.returncode == 0, (out, err)
    assert "Traceback" not in err
    assert state(directory).complete
    assert bytes_of(directory) == bytes_of(uninterrupted / "sweep")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal__stops_cleanly_and_resumes(uninterrupted, start, tmp_path, bytes_of, number, code):
    spec, directory = uninterrupted / "sweep.toml", tmp_path / "run"
    process = start("run", spec, "--out", directory, "--workers", 1)
    wait_for_commits(process, directory, 2)
    # a terminal sends Ctrl-C to the whole group
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    out, err = process.communicate(timeout=200)
    assert process.returncode == code, (out, err)
    assert "the same command continues" in err
    assert "Traceback" not in err
    assert not state(directory).complete
    assert run(spec, directory, workers=0, echo=silent).complete
    assert bytes_of(directory) == bytes_of(uninterrupted / "sweep")


@pytest.mark.slow
def test_scheduler__existing_one(write_spec, sweep_text, tmp_path, bytes_of, monkeypatch):
    from distributed import LocalCluster

    path = write_spec(sweep_text)
    run(path, tmp_path / "alone", scheduler="none", echo=silent)
    with LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        host="127.0.0.1",
        protocol="tcp",
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    ) as cluster:
        run(path, tmp_path / "address", scheduler=cluster.scheduler_address, echo=silent)
        monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", cluster.scheduler_address)
        run(path, tmp_path / "environment", echo=silent)
        assert cluster.scheduler_info["workers"]
    for name in ("address", "environment"):
        assert bytes_of(tmp_path / name) == bytes_of(tmp_path / "alone")


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_run__on_this_machine_listens_nowhere(write_spec, sweep_text, tmp_path, monkeypatch, scheduler):
    def look(self, cells):
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening.update(
            c.laddr for p in processes for c in p.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN
        )

    listening = set()
    look(None, 0)
    before = set(listening)
    monkeypatch.setattr(Progress, "add", look)
    run(write_spec(sweep_text), tmp_path / "run", workers=1, scheduler=scheduler, echo=silent)
    assert listening == before
