"""What a dry run says of the time, and what it measures for it."""

from __future__ import annotations

import tempfile
import time
import tomllib
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.compute import integrate as branches
from pipeline.compute import task
from pipeline.compute.task import warm_up
from pipeline.layout.cells import CellMap
from pipeline.layout.plan import make_plan
from pipeline.runs import estimate as estimates
from pipeline.runs.estimate import estimate, mean_with_tail, writing_seconds
from pipeline.runs.preview import describe_plan
from pipeline.specification.spec import Spec
from pipeline.store import commits
from tests.pipeline.factories import duffing, quietly

sections = import_module("magpend_core.sections")  # `magpend_core.sections` is a function

CLOSING = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 5 }",
    'kind = "random"\nn = 64\nx = [-1, 1]\nv = [-1, 1]',
    n_transient=400,
    n_keep=16,
).replace("n_keep = 16", "n_keep = 16\nstop_when_closed = true\nclosure_tolerance = 1e-2")


def read(text):
    spec = Spec.parse(tomllib.loads(text))
    return spec, make_plan(spec)


def test_mean_with_tail():
    """All have ended; some have, exponentially; none has."""
    assert mean_with_tail(np.array([3.0, 5.0]), 10, 1000) == 4.0
    assert mean_with_tail(np.array([10.0, 10.0]), 10, 10) == 10.0
    periods = np.random.default_rng(0).exponential(800, 20_000)
    for most in (2_000, 100_000):
        seen = mean_with_tail(np.minimum(periods, 1000), 1000, most)
        assert seen == pytest.approx(np.minimum(periods, most).mean(), rel=0.03)
    assert mean_with_tail(np.full(8, 100.0), 100, 5000) == 5000


def test_estimate__within_a_factor_of_what_it_takes(monkeypatch):
    """On a machine of which the clock goes on by what the rule of thumb says: no other time counts."""
    spec, plan = read(CLOSING)
    warm_up(spec)
    clock, original = [0.0], branches.integrate

    def integrate(spec, inputs):
        values = original(spec, inputs)
        a_period = spec.motion.seconds_per_period(inputs.frequency_hz)
        clock[0] += float((a_period * values["n_periods"]).sum())
        return values

    cells = CellMap(spec)
    for block in plan.tasks():
        task.compute(spec, cells, block, integrate=integrate)
    true, clock[0] = clock[0], 0.0
    monkeypatch.setattr(branches, "integrate", integrate)
    monkeypatch.setattr(estimates, "time", SimpleNamespace(process_time=lambda: clock[0]))
    found = estimate(spec, plan)
    assert true / 1.5 < found.core_seconds < 1.5 * true
    assert "until it has closed" in found.how
    assert plan.core_seconds > found.core_seconds


@pytest.mark.slow
def test_writing_seconds__takes_the_time_of_writing_and_leaves_nothing(sweep_text, tmp_path, monkeypatch):
    spec, plan = read(sweep_text)
    written, original = [], commits.write_task

    def slow(info, plan, index, *rest):
        written.append(index)
        time.sleep(0.2)
        original(info, plan, index, *rest)

    monkeypatch.setattr(commits, "write_task", slow)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert writing_seconds(spec, plan) >= 0.2
    assert len(written) <= 3
    assert list(tmp_path.iterdir()) == []
    # many cells are not tried: by the rule
    monkeypatch.setattr(estimates, "MOST_WRITTEN_CELLS", plan.n_cells - 1)
    assert writing_seconds(spec, plan) == pytest.approx((len(plan.variables) + 1) * estimates.FILE_S)


@pytest.mark.slow
def test_describe_plan__says_what_the_time_rests_on_and_what_is_left(write_spec, sweep_text, tmp_path):
    path = write_spec(sweep_text)
    first, *_, last = describe_plan(path, tmp_path / "run")
    assert first == "small sweep"
    assert "measured: 24 of its cells" in last
    assert not (tmp_path / "run").exists()
    quietly(path, tmp_path / "run")
    assert list(describe_plan(path, tmp_path / "run"))[-1] == "time: nothing is left to compute"


@pytest.mark.parametrize("stops", [True, False])
def test_estimate__compiles_no_kernel_that_the_run_does_not_need(monkeypatch, stops):
    asked = []
    original = sections.run_branches

    def run_branches(*arguments, **options):
        asked.append((options["stop_when_closed"], options.get("quantities")))
        return original(*arguments, **options)

    monkeypatch.setattr(sections, "run_branches", run_branches)
    text = CLOSING if stops else CLOSING.replace("= true", "= false")
    estimate(*read(text))
    assert set(asked) == {(stops, None)}
    assert len(asked) > 3
