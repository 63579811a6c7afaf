"""Runs with the kernel: same bytes whatever happens on the way."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import threading
import time
import tomllib

import numpy as np
import psutil
import pytest

from magpend_core import load_preset, run_branches
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline import open_run
from pipeline.cli.console import Exit
from pipeline.compute import task
from pipeline.compute.execute import TaskFailedError
from pipeline.layout import identity
from pipeline.layout.identity import digest_of
from pipeline.runs.preview import describe_plan
from pipeline.runs.progress import Progress
from pipeline.runs.run import InterruptedRunError, run
from pipeline.runs.status import state
from pipeline.specification.spec import Spec
from pipeline.store.commits import marker_key
from pipeline.store.errors import RefusedError
from pipeline.store.files import entry_of
from pipeline.store.runfile import read_run
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.conftest import SWEEP, WALK
from tests.pipeline.factories import FOLD, LOOPBACK, WELL, duffing, edges, n_committed, quietly, silent, wait_for

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
RECORDED = """
kind = "sweep"
[drive]
file = "drive.csv"
[axes]
q = { values = [0.6, 1.6] }
[initial_conditions]
kind = "list"
points_deg = [[10, -20, 0, 0], [20, -20, 0, 0]]
[integration]
n_transient = 6
n_keep = 4
[execution]
trajectories_per_task = 1
"""
MANY_SWEEP = f'kind = "sweep"\n{MANY}\n{EIGHT}'
HALF = MANY.replace("n = 64", "n = 32")  # both ways, as many cells as the sweep
MANY_WALK = f'kind = "continuation"\n{HALF}\n[continuation]\ndirection = "both"\n{EIGHT}\npoints_per_task = 1'


@pytest.mark.slow
def test_run__walk_is_what_the_kernel_says(write_spec, walk_text, tmp_path):
    quietly(write_spec(walk_text), tmp_path / "run")
    ds = open_run(tmp_path / "run")
    assert ds.section.dims == ("frequency", "branch", "period_index", "state")
    assert ds.direction.values.tolist() == ["up"] * 5 + ["down"] * 5
    assert ds.attrs["path"] == "frequency"
    spec = Spec.parse(tomllib.loads(walk_text)).by_method("dopri5")
    path = spec.axes["frequency_hz"].array()
    starts = np.column_stack([ds[f"{s}_0"] for s in ("psi1", "psi2", "psi1_dot", "psi2_dot")])
    frequency = np.array([path] * 5 + [path[::-1]] * 5)
    packed = np.broadcast_to(load_preset().pack(), (10, 6, len(load_preset().names)))
    expected = run_branches(packed, frequency, starts, system=PENDULUM_FITTED, **spec.integration.model_dump())
    for name in ("section", "turns", "status", "orbit_period", "n_steps"):
        found = ds[name].transpose("branch", "frequency", ...).values
        wanted = getattr(expected, name).copy()
        wanted[5:] = wanted[5:, ::-1]
        assert np.array_equal(found, wanted, equal_nan=True), name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sweep", "walk", "drift", "noise", "recorded"])
def test_run__same_bytes_everywhere_and_where_it_was_stopped(kind, write_spec, tmp_path, bytes_of, monkeypatch):
    kinds = {"sweep": SWEEP, "walk": WALK, "drift": DRIFT, "noise": NOISE, "recorded": RECORDED}
    path, found = write_spec(kinds[kind]), []
    (tmp_path / "drive.csv").write_text(edges(12, 2.2, jitter=0.01), "utf-8")
    for workers, scheduler in [(0, None), (1, "threads"), (3, "threads"), (2, "processes")]:
        if scheduler != "processes" or kind in ("walk", "recorded"):
            directory = tmp_path / f"{scheduler}{workers}"
            assert run(path, directory, workers=workers, scheduler=scheduler, echo=silent).complete
            found.append(bytes_of(directory))
    original, calls = task.write_task, []

    def stop(*arguments):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(arguments)
        original(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(task, "write_task", stop)
        with pytest.raises(InterruptedRunError, match="the same command continues") as caught:
            quietly(path, tmp_path / "stopped")
    assert caught.value.signal_number == signal.SIGINT
    assert len(state(tmp_path / "stopped").commits) == 2
    assert quietly(path, tmp_path / "stopped").complete
    found.append(bytes_of(tmp_path / "stopped"))
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
        quietly(write_spec(text), tmp_path / f"run{n}")
    one, other = open_run(tmp_path / "run24").load(), open_run(tmp_path / "run7").load()
    assert one.drop_attrs(deep=False).identical(other.drop_attrs(deep=False))


def counted(monkeypatch, fail_at=None):
    """Count the tasks computed in this process; let one of them fail, whenever it is tried."""
    calls = []
    original = task.compute

    def compute(plan, block):
        calls.append(block)
        if fail_at is not None and block == calls[min(fail_at, len(calls)) - 1] and len(calls) >= fail_at:
            raise RuntimeError("out of luck")
        return original(plan, block)

    monkeypatch.setattr(task, "compute", compute)
    return calls


def test_run__again_does_nothing(write_spec, sweep_text, tmp_path, monkeypatch, bytes_of):
    path, lines = write_spec(sweep_text), []
    quietly(path, tmp_path / "run")
    before = bytes_of(tmp_path / "run")
    calls = counted(monkeypatch)
    run(path, tmp_path / "run", workers=0, echo=lines.append)
    assert calls == []
    assert "nothing to do" in lines[0]
    assert bytes_of(tmp_path / "run") == before


@pytest.mark.slow
def test_run__failed_task_then_only_the_rest(write_spec, sweep_text, tmp_path, monkeypatch, bytes_of):
    path = write_spec(sweep_text)
    quietly(path, tmp_path / "whole")
    n_tasks = state(tmp_path / "whole").plan.n_tasks
    with monkeypatch.context() as patch:
        tried = counted(patch, fail_at=3)
        with pytest.raises(TaskFailedError, match="task 2: RuntimeError: out of luck"):
            quietly(path, tmp_path / "run")
    assert len(tried) == n_tasks + 1
    assert tried[2] == tried[-1]
    assert set(state(tmp_path / "run").commits) == set(range(n_tasks)) - {2}
    for leftover in ("cube.zarr/section/c.2.0.0.0.0.abc.partial", "cube.zarr/status/c.2.0.0.0", "commits/.2.tmp"):
        (tmp_path / "run" / leftover).write_bytes(b"left by a crash")
    calls = counted(monkeypatch)
    quietly(path, tmp_path / "run")
    assert len(calls) == 1
    assert bytes_of(tmp_path / "run") == bytes_of(tmp_path / "whole")


def test_run__changed_spec_or_other_kernel_is_refused(write_spec, sweep_text, tmp_path, bytes_of, monkeypatch):
    path = write_spec(sweep_text)
    quietly(path, tmp_path / "run")
    before = bytes_of(tmp_path / "run")
    changed = write_spec(sweep_text.replace("rtol = 1e-6", "rtol = 1e-5"), "changed.toml")
    for use in (lambda: quietly(changed, tmp_path / "run"), lambda: list(describe_plan(changed, tmp_path / "run"))):
        with pytest.raises(RefusedError, match=r"spec\.integration\.rtol: 1e-06 in the directory, 1e-05 now"):
            use()
    monkeypatch.setattr(identity, "ENGINE", 1000)
    with pytest.raises(RefusedError, match=r"versions.engine: \d+ in the directory, 1000 now"):
        quietly(path, tmp_path / "run")
    assert bytes_of(tmp_path / "run") == before
    # and by a worker
    task._prepare.cache_clear()
    with pytest.raises(RefusedError, match="would not compute the same run"):
        task.run_task(str(tmp_path / "run"), read_run(tmp_path / "run").digest, 0)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Both kinds of run, done at a stretch."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    for name, text in (("sweep", MANY_SWEEP), ("walk", MANY_WALK)):
        (folder / f"{name}.toml").write_text(text)
        quietly(folder / f"{name}.toml", folder / name)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "workers", "seed"), [("sweep", 2, 0), ("walk", 0, 3)])
def test_kill__resumed_run_has_the_same_bytes(uninterrupted, start, tmp_path, bytes_of, kind, workers, seed):
    rng = np.random.default_rng(seed)
    spec, directory = uninterrupted / f"{kind}.toml", tmp_path / "run"
    n_tasks = state(uninterrupted / kind).plan.n_tasks
    n_kills = 2 if (kind, workers) == ("sweep", 2) else 1
    for share in np.sort(rng.uniform(0, 0.8, n_kills)):
        process = start("run", spec, "--out", directory, "--workers", workers)
        wait_for(lambda least=int(share * n_tasks): n_committed(directory) >= least, process)
        time.sleep(rng.uniform(0, 0.05))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert not state(directory).complete
    assert quietly(spec, directory).complete
    assert bytes_of(directory) == bytes_of(uninterrupted / kind)


@pytest.mark.slow
def test_kill__of_processes_over_and_over_loses_nothing(uninterrupted, start, tmp_path, bytes_of):
    """A process dies with every third task that is committed; those that live and new ones do the rest."""
    rng = np.random.default_rng(4)
    spec, directory = uninterrupted / "sweep.toml", tmp_path / "run"
    process = start("run", spec, "--out", directory, "--workers", 2, "--scheduler", "processes")
    killed = 0
    for count in range(2, 14, 3):
        wait_for(lambda count=count: n_committed(directory) >= count, process)
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
def test_scheduler__existing_one(write_spec, sweep_text, tmp_path, bytes_of, monkeypatch):
    from distributed import LocalCluster

    path = write_spec(sweep_text)
    run(path, tmp_path / "alone", scheduler="none", echo=silent)
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", **LOOPBACK) as cluster:
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


# ---- a run that another version has begun ----------------------------------------------------------------


THREE = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 3 }",
    'kind = "list"\npoints = [[0.5, 0.0]]',
    n_transient=40,
    execution="trajectories_per_task = 1",
)


def made_by(directory, **changes):
    """Let another version have made a run: rewrite its identity, and the digest in all its files."""
    data = unseal((directory / "run.json").read_bytes())
    before = data["digest"]
    data["identity"] = {key: value for key, value in (data["identity"] | changes).items() if value is not None}
    after = data["digest"] = digest_of(data["identity"])
    group = directory / "cube.zarr/zarr.json"
    group.write_text(group.read_text().replace(before, after))
    content = group.read_bytes()
    data["skeleton"]["zarr.json"] = entry_of(content)
    (directory / "run.json").write_bytes(seal(json.dumps(data)).encode())
    for path in (directory / "commits").glob("*.json"):
        record = unseal(path.read_bytes())
        path.write_bytes(seal(json.dumps({**record, "digest": after}, sort_keys=True)).encode())
    (directory / "records.jsonl").unlink(missing_ok=True)


FIRST = {
    "kernel_version": "433ffff3fca2c718",
    "code": {
        "compute.integrate": "8d946736bc2d348c",
        "compute.task": "e9ce1f0744f9cc3c",
        "layout.cells": "8f83262db4988cca",
    },
}
"""Versions as runs had them when they were digests of source code."""


def begun_by(write_spec, tmp_path, **versions):
    """Return the specification and the directory of a run that code of other versions has begun, without its last task;
    and the bytes of that task.
    """
    spec, directory = write_spec(THREE), tmp_path / "begun"
    quietly(spec, directory)
    made_by(directory, **versions)
    last = directory / marker_key(2)
    content = last.read_bytes()
    last.unlink()
    return spec, directory, content


@pytest.mark.slow
def test_run__of_versions_that_were_digests_goes_on(write_spec, tmp_path):
    spec, directory, last = begun_by(write_spec, tmp_path, versions=None, **FIRST)
    before = (directory / "run.json").read_bytes()
    quietly(spec, directory)
    assert (directory / marker_key(2)).read_bytes() == last
    assert (directory / "run.json").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "versions",
    [
        {"versions": {"engine": 1000, "cells": 1}},
        {"versions": None, **FIRST, "kernel_version": "0123456789abcdef"},
        {"versions": None, **FIRST, "code": FIRST["code"] | {"compute.task": "0123456789abcdef"}},
    ],
)
def test_run__of_another_version(main, write_spec, tmp_path, versions):
    spec, directory, _ = begun_by(write_spec, tmp_path, **versions)
    code, _, err = main("run", spec, "--out", directory, "--workers", "0")
    assert code == Exit.REFUSED
    for words in ("another version of magpend", "finished cells stay", "status, analyse, plot", "--out ANOTHER"):
        assert words in err
    for command in (["status"], ["verify"], ["analyse", "attractors"], ["plot", "bifurcation"]):
        code, _, err = main(*command, directory)
        assert code == Exit.DONE, err
    assert main("run", spec, "--out", tmp_path / "anew", "--workers", "0")[0] == Exit.DONE
    assert (
        main("extend", directory, "--axis", "frequency_hz=0.15:0.35:5", "--out", tmp_path / "wide")[0] == Exit.REFUSED
    )
