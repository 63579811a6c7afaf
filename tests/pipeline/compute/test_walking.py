"""Walks cut into tasks: the same numbers for every cell, wherever they are cut."""

from __future__ import annotations

import os
import tomllib

import numpy as np
import pytest

from magpend_core import Status
from pipeline import open_run
from pipeline.layout.plan import make_plan
from pipeline.specification.spec import Spec
from pipeline.store.commits import marker_key
from tests.pipeline.factories import duffing, quietly

VAN_DER_POL = """
kind = "continuation"
model = "van-der-pol"
[section]
of = "v"
direction = "down"
longest = 12.0
[axes]
mu = { start = 3.0, stop = 8.0, num = 6 }
[continuation]
path = "mu"
direction = "both"
[initial_conditions]
kind = "random"
n = 3
seed = 2
x = [0.2, 3.0]
v = [-3.0, 3.0]
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 3
n_keep = 2
[execution]
"""

FREQUENCIES = "frequency_hz = { start = 0.06, stop = 0.26, num = 7 }"


def walk(axes=FREQUENCIES, path="frequency_hz", direction="both", n=4, more="", **options):
    return duffing(
        axes,
        f'kind = "random"\nn = {n}\nseed = 1\nx = [-1.5, 1.5]\nv = [-1.0, 1.0]',
        kind="continuation",
        more=f'[continuation]\npath = "{path}"\ndirection = "{direction}"\n{more}',
        **{"n_transient": 12, "n_keep": 5, **options},
    )


def cut_at(text, cut):
    """The same walks in tasks of four branches and `cut` points."""
    table = "" if cut is None else f"points_per_task = {cut}\n"
    return text.replace("[execution]\n", f"[execution]\ntrajectories_per_task = 4\n{table}")


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    """Nothing waits for the disk: what is on it after a power cut is tested elsewhere."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)


def cut_run(write_spec, folder, text, cut):
    """Run a specification with tasks of `cut` points; returns the cube in memory and the plan."""
    found = quietly(write_spec(cut_at(text, cut), f"cut{cut}.toml"), folder / f"run{cut}")
    return open_run(folder / f"run{cut}").load(), found.plan


def assert_same_whatever_the_cut(write_spec, folder, text, cuts=(1, 3, None)):
    """Run a specification in several cuts and compare; returns the cube."""
    (one, plan), *others = [cut_run(write_spec, folder, text, cut) for cut in cuts]
    n_points = plan.n_points
    for (other, its_plan), cut in zip(others, cuts[1:], strict=True):
        groups = plan.n_tasks // n_points
        assert its_plan.n_tasks == groups * -(-n_points // (cut or n_points))
        for name in one.data_vars:
            assert one[name].values.tobytes() == other[name].values.tobytes(), (name, cut)
    return one


@pytest.mark.slow
def test_walk__plain_both_ways(write_spec, tmp_path):
    ds = assert_same_whatever_the_cut(write_spec, tmp_path, walk())
    assert np.isfinite(ds.section).all()
    assert (ds.step_size > 0).all()
    # a walk is no sweep: what was found depends on the way
    assert (ds.section[:, :4].values != ds.section[:, 4:].values).any()


@pytest.mark.slow
def test_walk__along_another_dim(write_spec, tmp_path):
    axes = "frequency_hz = { values = [0.1, 0.2] }\namplitude = { start = 0.2, stop = 0.5, num = 5 }"
    ds = assert_same_whatever_the_cut(write_spec, tmp_path, walk(axes, "amplitude"), (1, 2, None))
    assert ds.section.dims[:3] == ("frequency", "amplitude", "branch")


@pytest.mark.slow
def test_walk__stops_when_closed(write_spec, tmp_path):
    text = walk(n_transient=200).replace("n_keep", "stop_when_closed = true\nclosure_tolerance = 1e-2\nn_keep")
    ds = assert_same_whatever_the_cut(write_spec, tmp_path, text)
    assert len(np.unique(ds.n_periods)) > 2


@pytest.mark.slow
def test_walk__ends_with_a_cell_that_fails(write_spec, tmp_path):
    # the lower the frequency the more steps to a period: downwards all fail on the way, upwards at once
    lyapunov = "lyapunov = { n_transient = 2, n_periods = 4, n_blocks = 2 }"
    text = walk(more=f'[products]\n{lyapunov}\nextremes.quantities = ["energy"]')
    text = text.replace("n_keep", "max_steps_per_period = 40\nn_keep")
    ds = assert_same_whatever_the_cut(write_spec, tmp_path, text)
    status = ds.status.values
    assert {Status.STEP_LIMIT, Status.UNREACHED} < set(status.ravel())
    down = status[::-1, 4:]
    failed = (down == Status.STEP_LIMIT).argmax(axis=0)
    assert (failed > 1).any()
    for branch, first in enumerate(failed):
        assert (down[:first, branch] < Status.DIVERGED).all()
        assert (down[first + 1 :, branch] == Status.UNREACHED).all()
    lost = status >= Status.DIVERGED
    assert np.isnan(ds.section.values[lost]).all()
    assert np.isnan(ds.step_size.values[lost]).all()
    assert np.isnan(ds.lyapunov.values[lost]).all()
    assert np.isfinite(ds.lyapunov.values[~lost]).all()
    assert np.isnan(ds.extremes.values[lost]).all()
    assert (ds.n_steps.values[status == Status.UNREACHED] == 0).all()


@pytest.mark.slow
def test_walk__goes_on_from_where_it_does_not_return(write_spec, tmp_path):
    ds = assert_same_whatever_the_cut(write_spec, tmp_path, VAN_DER_POL, (1, 4, None))
    status, down = ds.status.values, 3
    assert (status[-1, down:] == Status.NO_RETURN).all()
    assert (status[0, down:] < Status.DIVERGED).all()
    left = status == Status.NO_RETURN
    assert np.isfinite(ds.rest_state.values[left]).all()
    # each cell is left in a place of its own, not where the walk ends
    assert len(np.unique(ds.rest_state.values[left], axis=0)) == left.sum()
    assert np.isnan(ds.rest_state.values[~left]).all()


@pytest.mark.slow
def test_walk__a_task_in_its_middle_is_lost(write_spec, tmp_path, bytes_of):
    path, directory = write_spec(cut_at(walk(), 3)), tmp_path / "run"
    plan = quietly(path, directory).plan
    before = bytes_of(directory)
    middle = next(i for i in range(plan.n_tasks) if plan.depth(i) == 1)
    (directory / marker_key(middle)).unlink()
    assert quietly(path, directory).complete
    assert bytes_of(directory) == before


def test_walk__needs_the_task_before(write_spec, tmp_path):
    from pipeline.compute.task import run_task
    from pipeline.store.errors import IncompleteError
    from pipeline.store.runfile import read_run

    path, directory = write_spec(cut_at(walk(), 3)), tmp_path / "run"
    plan = quietly(path, directory).plan
    last = max(range(plan.n_tasks), key=plan.depth)
    before = plan.predecessor(last)
    (directory / marker_key(before)).unlink()
    with pytest.raises(IncompleteError, match=f"task {before}, from which another goes on, is not committed"):
        run_task(str(directory), read_run(directory).digest, last)


# ---- plans -------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["up", "down", "both"])
@pytest.mark.parametrize("axes", [FREQUENCIES, f"amplitude = {{ values = [0.2, 0.3] }}\n{FREQUENCIES}"])
@pytest.mark.parametrize("cut", [1, 2, 3, 7])
def test_predecessor__walks_from_end_to_end(direction, axes, cut):
    plan = make_plan(Spec.parse(tomllib.loads(cut_at(walk(axes, direction=direction), cut))))
    path, n_chains = plan.path, 0
    for index in range(plan.n_tasks):
        block, before = plan.task(index), plan.predecessor(index)
        down = direction == "down" or (direction == "both" and block[-1].start >= 4)
        assert plan.walks_down(index) == down
        if before is None:
            n_chains += 1
            assert plan.depth(index) == 0
            assert block[path].stop == 7 if down else block[path].start == 0
            continue
        assert plan.depth(index) == plan.depth(before) + 1
        other = plan.task(before)
        assert all(a == b for i, (a, b) in enumerate(zip(block, other, strict=True)) if i != path)
        assert other[path].start == block[path].stop if down else other[path].stop == block[path].start
    assert n_chains * -(-7 // cut) == plan.n_tasks


SEEDS = [1, 2, 7, 16, 17, 24, 32, 37, 48, 100, 101, 640]


@pytest.mark.parametrize("n", SEEDS)
def test_make_plan__directions_apart(n):
    plan = make_plan(Spec.parse(tomllib.loads(walk(n=n))))
    for index in range(plan.n_tasks):
        branches = plan.task(index)[-1]
        assert branches.stop <= n or branches.start >= n
    assert n % plan.block[-1] == 0
    assert plan.block[-1] >= min(n, 8)


@pytest.mark.parametrize("axis", ["start = 0.1, stop = 3.0, num = 581", "start = 0.01, stop = 0.2, num = 40"])
@pytest.mark.parametrize(("n", "n_keep"), [(16, 100), (32, 3000), (640, 100), (5, 20)])
def test_make_plan__tasks_of_some_seconds(axis, n, n_keep):
    text = walk(f"frequency_hz = {{ {axis} }}", n=n, n_keep=n_keep, n_transient=300)
    plan = make_plan(Spec.parse(tomllib.loads(text)))
    seconds = [plan.seconds(index) for index in range(plan.n_tasks)]
    # a single point of so many branches may take longer
    assert max(seconds) <= 20 or plan.block[0] == 1
    assert sum(seconds) == pytest.approx(plan.core_seconds)
    assert np.mean(seconds) > 1 or max(seconds) > 9 or plan.block[0] in (1, plan.n_points)
    for variable in plan.variables:
        chunk = plan.chunks(variable)
        assert plan.block[0] % chunk[0] == plan.block[1] % chunk[1] == 0
