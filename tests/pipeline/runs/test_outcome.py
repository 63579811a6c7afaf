"""What a finished run says of its cells: an oscillator that gains energy above a = 0, and diverges there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.layout.vocabulary import DIVERGED
from pipeline.runs.outcome import outcomes_of, warning
from pipeline.store.run import Run

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


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """The command's folder, its exit code, its output and its notes."""
    import contextlib
    import io
    import sys

    from pipeline.cli.main import main

    folder = tmp_path_factory.mktemp("outcome")
    (folder / "spec.toml").write_text(AMPLIFIED, "utf-8")
    out, err, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["magpend", "run", "spec.toml", "--workers", "0", "--plot"])
        patch.setattr(sys, "stderr", err)
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return folder, code, out.getvalue(), err.getvalue()


def test_run__ends_with_its_cells_by_status(ended):
    """The amplitude exceeds 1e6 within 43 periods (900 rad) where e^(a t/2) does: for a = 0.3 and above."""
    folder, code, out, err = ended
    assert code == 0, err
    at_end = 43 / 0.3
    gains = np.linspace(-0.5, 0.5, 11)
    gone = [a for a in gains if 0.1 * math.exp(a / 2 * at_end) > 1e8]
    stay = [a for a in gains if math.exp(a / 2 * at_end) < 1e5]
    found = {o.status: o for o in outcomes_of(Run.open(folder / "runs" / "spec"))}
    ((name, low, high, unit),) = found[DIVERGED].where
    assert (name, unit) == ("a", "1/s")
    assert max(stay) < low <= min(gone)
    assert high == 0.5
    assert sum(o.n_cells for o in found.values()) == 22
    assert f"{found[DIVERGED].n_cells:>10d}" in out
    assert f"a = {low:g} to 0.5 1/s" in out
    assert f"magpend zoom runs/spec --axis a={low:g}:0.5 --out closer.toml" in out


def test_run__warns_of_cells_that_were_lost(ended):
    *_, err = ended
    assert "warning: " in err
    assert "cells (27.3 %) diverged or failed" in err
    assert "a state left the bounds" in err


def test_warning__nothing_is_said_of_a_run_that_lost_none(made):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    assert warning(Run.open(made.info.files)) == ""


def test_run__plot_with_exponents_draws_both(ended):
    """The run of one axis with exponents was refused its diagram before it was computed."""
    _, _, out, _ = ended
    assert out.splitlines()[-3:] == [
        "figure: runs/spec/figures/lyapunov_x.png",
        "data: runs/spec/figures/lyapunov_x.nc",
        "left out: all exponents but the largest. See: magpend plot lyapunov runs/spec --spectrum",
    ]


def test_zoom__of_the_lost_cells_is_a_command_that_works(ended, main):
    folder, _, out, _ = ended
    line = next(line for line in out.splitlines() if "magpend zoom" in line)
    words = line.partition("magpend ")[2].split()
    words = [str(folder / w) if w in ("runs/spec", "closer.toml") else w for w in words]
    code, _, err = main(*words)
    assert code == 0, err
    assert "start = 0.3" in (folder / "closer.toml").read_text("utf-8").replace("0.30000000000000004", "0.3")
