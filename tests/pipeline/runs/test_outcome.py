"""What a finished run says of its cells: an oscillator that gains energy above a = 0, and diverges there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.layout.vocabulary import DIVERGED
from pipeline.runs.outcome import outcomes_of, warning
from pipeline.store.run import RunDirectory

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
    code, out, err = main("run", "spec.toml", "--workers", 0, "--plot")
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
    assert f"{found[DIVERGED].n_cells:>10d}" in out
    assert f"a = {low:g} to 0.5 1/s" in out
    assert "warning: " in err
    assert "cells (27.3 %) diverged or failed" in err
    assert "a state left the bounds" in err
    # the run of one axis with exponents was refused its diagram before it was computed
    assert out.splitlines()[-3:] == [
        "figure: runs/spec/figures/lyapunov_x.png",
        "data: runs/spec/figures/lyapunov_x.nc",
        "left out: all exponents but the largest. See: magpend plot lyapunov runs/spec --spectrum",
    ]
    # the command that it names works
    (line,) = [line for line in out.splitlines() if "magpend zoom" in line]
    assert f"magpend zoom runs/spec --axis a={low:g}:0.5 --out closer.toml" in line
    code, _, err = main(*line.partition("magpend ")[2].split())
    assert code == 0, err
    assert "start = 0.3" in (tmp_path / "closer.toml").read_text("utf-8").replace("0.30000000000000004", "0.3")


def test_warning__nothing_is_said_of_a_run_that_lost_none(made):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    assert warning(RunDirectory.open(made.info.files)) == ""
