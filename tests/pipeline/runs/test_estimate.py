"""What a dry run says of the time, and what a run says of its progress and of its cells."""

from __future__ import annotations

import math
import tempfile
import time
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.compute import integrate as branches
from pipeline.compute import task
from pipeline.compute.task import warm_up
from pipeline.layout.plan import make_plan
from pipeline.layout.vocabulary import DIVERGED
from pipeline.runs import estimate as estimates
from pipeline.runs.estimate import estimate, mean_with_tail, writing_seconds
from pipeline.runs.progress import LINE_EVERY_S, Progress
from pipeline.runs.status import outcomes_of
from pipeline.specification.spec import Spec
from pipeline.store import tasks
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import duffing

NEVER = """
kind = "sweep"
model = { name = "spiral", states = { x = {}, y = {} }, equations = { x = "-x - y", y = "x - y" } }
section = { of = "x + y", value = 9.0, longest = 5.0 }
axes.section_value = { values = [9.0, 10.0] }
initial_conditions = { kind = "list", points = [[1.0, 0.0]] }
"""

CLOSING = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 5 }",
    'kind = "random"\nn = 64\nx = [-1, 1]\nv = [-1, 1]',
    n_transient=400,
    n_keep=16,
).replace("n_keep = 16", "n_keep = 16\nstop_when_closed = true\nclosure_tolerance = 1e-2")


def read(text):
    return make_plan(Spec.parse(tomllib.loads(text)))


def test_estimate__of_a_flow_that_does_not_return():
    assert 0.0 <= estimate(read(NEVER)).core_seconds < 10.0


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
    plan = read(CLOSING)
    warm_up(plan)
    clock, original = [0.0], branches.integrate

    def integrate(spec, inputs):
        values = original(spec, inputs)
        a_period = spec.motion.seconds_per_period(inputs.frequency_hz)
        clock[0] += float((a_period * values["n_periods"]).sum())
        return values

    for block in plan.tasks():
        task.compute(plan, block, integrate=integrate)
    true, clock[0] = clock[0], 0.0
    monkeypatch.setattr(branches, "integrate", integrate)
    monkeypatch.setattr(estimates, "time", SimpleNamespace(process_time=lambda: clock[0]))
    found = estimate(plan)
    assert true / 1.5 < found.core_seconds < 1.5 * true
    assert "until it has closed" in found.how
    assert plan.core_seconds > found.core_seconds


@pytest.mark.slow
def test_writing_seconds__takes_the_time_of_writing_and_leaves_nothing(sweep_text, tmp_path, monkeypatch):
    plan = read(sweep_text)
    original = tasks.write_task
    monkeypatch.setattr(tasks, "write_task", lambda *given: (time.sleep(0.2), original(*given)))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert writing_seconds(plan) >= 0.2
    assert list(tmp_path.iterdir()) == []
    # many cells are not tried: by the rule
    monkeypatch.setattr(estimates, "MOST_WRITTEN_CELLS", plan.n_cells - 1)
    assert writing_seconds(plan) == pytest.approx((len(plan.variables) + 1) * estimates.FILE_S)


# ---- progress --------------------------------------------------------------------------------------------


def test_progress__rate_and_time_left_count_this_session_only():
    now = [0.0]
    lines: list[str] = []
    with Progress(1000, 500, terminal=False, echo=lines.append, clock=lambda: now[0]) as progress:
        progress.add(10)
        assert lines == []
        now[0] = LINE_EVERY_S
        progress.add(90)
        assert lines == ["600/1000 cells (60 %), 10 cells/s, 40 s left"]
        progress.add(400)
    assert lines[-1].startswith("1000/1000 cells (100 %)")


# ---- how its cells ended ---------------------------------------------------------------------------------

AMPLIFIED = """
kind = "sweep"
[axes]
a = { start = -0.5, stop = 0.5, num = 11 }
[parameters]
frequency_hz = 0.3
[initial_conditions]
kind = "list"
points = [[0.1, 0.0], [0.2, 0.0]]
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 40
n_keep = 4
[products]
lyapunov = { n_exponents = 2 }
[model]
name = "amplified"
states = { x = { unit = "m", escape = 1e6 }, v = { unit = "m/s" } }
parameters = { a = { value = -0.2, unit = "1/s", meaning = "gain" } }
equations = { x = "v", v = "a*v - x + 0.1*cos(2*pi*f*t)" }
"""


@pytest.mark.slow
def test_run__says_how_its_cells_ended_and_what_to_do_next(main, tmp_path):
    """The amplitude exceeds 1e6 within 43 periods (900 rad) where e^(a t/2) does: for a = 0.3 and above."""
    (tmp_path / "spec.toml").write_text(AMPLIFIED, "utf-8")
    code, out, err = main("run", "spec.toml", "--workers", 0)
    assert code == 0, err
    at_end = 43 / 0.3
    gains = np.linspace(-0.5, 0.5, 11)
    gone = [a for a in gains if 0.1 * math.exp(a / 2 * at_end) > 1e8]
    stay = [a for a in gains if math.exp(a / 2 * at_end) < 1e5]
    found = {o.status: o for o in outcomes_of(RunDirectory.open(tmp_path / "runs" / "spec"))}
    ((name, low, high, unit),) = found[DIVERGED].where
    assert (name, high, unit) == ("a", 0.5, "1/s")
    assert max(stay) < low <= min(gone)
    assert sum(o.n_cells for o in found.values()) == 22
    assert f"a = {low:g} to 0.5 1/s" in out
    assert "cells (27.3 %) diverged or failed" in err
    assert "a state left the bounds" in err
    # the command that it names works
    (line,) = [line for line in out.splitlines() if "magpend zoom" in line]
    assert f"magpend zoom runs/spec --axis a={low:g}:0.5 --out closer.toml" in line
    code, _, err = main(*line.partition("magpend ")[2].split())
    assert code == 0, err
    assert "start = 0.3" in (tmp_path / "closer.toml").read_text("utf-8").replace("0.30000000000000004", "0.3")
