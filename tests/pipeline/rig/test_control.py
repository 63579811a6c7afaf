"""Control-based continuation on a virtual rig, against computed branches."""

from __future__ import annotations

import json

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.layout.vocabulary import parameters_of
from pipeline.rig.control import Controlled, load_control, orbits_csv, trace
from pipeline.rig.measured.branch import compare, read_branch
from pipeline.rig.measured.branch_computed import amplitudes
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import duffing, finished

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")

SWEEP = duffing(
    "amplitude = { start = 0.05, stop = 1.8, num = 8 }",
    'kind = "list"\npoints = [[0.0, 0.0], [1.8, 0.0]]',
    n_transient=200,
    n_keep=4,
    tolerance=1e-9,
    more='[parameters]\npreset = "hardening"\nfrequency_hz = 0.22',
)
CONTROL = """
model = "duffing"
preset = "hardening"
[control]
state = "x"
drive = "amplitude"
frequency_hz = 0.22
start = 0.3
stop = 2.1
num = 9
"""


@pytest.fixture(scope="module")
def computed(tmp_path_factory):
    """The S of the response over the drive's amplitude at .22 Hz."""
    found = AnalysedRun.of(finished(tmp_path_factory.mktemp("computed"), SWEEP))
    branches = found.derive("branches", parameter="amplitude")
    return found, branches, amplitudes(branches, parameters_of(found.cube()), "x")


def compared(computed, rig, targets, tmp_path):
    """Trace a branch and compare it, through its table, with the computed one."""
    orbits = trace(rig, targets)
    (tmp_path / "orbits.csv").write_text(orbits_csv(rig, orbits))
    found, branches, sizes = computed
    return orbits, compare(read_branch(tmp_path / "orbits.csv", found.model), branches, sizes)


@pytest.mark.slow
def test_trace__unstable_middle_branch(computed, tmp_path):
    """Without noise all orbits, the unstable ones too, are those of the model; control leaves one cosine."""
    (tmp_path / "rig.toml").write_text(CONTROL)
    orbits, found = compared(computed, *load_control(tmp_path / "rig.toml"), tmp_path)
    assert orbits.stable.count("no") >= 3
    assert orbits.stable.count("yes") >= 4
    assert set(orbits.stable[-2:]) == {"yes"}
    known = found["branch"].values >= 0
    assert known.all()
    error = np.abs(found["relative_error"].values)
    assert error.max() < 4e-3  # beside the fold, where the response is steep
    assert np.median(error) < 4e-4
    assert orbits.residue.max() < 1e-3


@pytest.mark.slow
def test_trace__with_noise(computed, tmp_path):
    """With noise of 2 mm in amplitudes of a metre orbits are right within per cents, and scatter."""
    rig = Controlled(load_model("duffing").load("hardening"), 0.22, "x", "amplitude", noise=2e-3, seed=3)
    orbits, found = compared(computed, rig, np.linspace(0.6, 1.8, 6), tmp_path)
    assert (orbits.amplitude_sd > 1e-4).all()
    near = found["branch"].values >= 0
    assert near.sum() >= 4
    assert np.abs(found["relative_error"].values[near]).max() < 0.03


@pytest.mark.slow
def test_trace__command(computed, tmp_path, command):
    """The command writes the table, and measured branch reads it."""
    (tmp_path / "rig.toml").write_text(CONTROL.replace("num = 9", "num = 4"))
    out, _ = command(tmp_path, "measured", "trace", "rig.toml", "--out", "orbits.csv")
    assert "4 orbits by the slope of the branch" in out
    table, _ = command(tmp_path, "measured", "branch", "orbits.csv", "--model", "duffing", "--json")
    first = json.loads(table)[0]
    size, omega = first["amplitude"], 2.0 * np.pi * 0.22  # harmonic balance
    balance = size * np.hypot(1.0 - omega**2 + 0.375 * size**2, 0.1 * omega)
    assert first["amplitude (parameter)"] == pytest.approx(balance, rel=0.02)
    rows = (tmp_path / "orbits.csv").read_text().splitlines()
    assert rows[0] == "amplitude,amplitude,amplitude_sd,frequency,stable,name"
    assert len(rows) == 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('state = "x"', 'state = "y"', "'y'"),
        ('drive = "amplitude"', 'drive = "amplitde"', "amplitde"),
        ('drive = "amplitude"', 'drive = "damping"', "does not act as amplitude times cos"),
        ("start = 0.3", "start = -0.3", "control.start = -0.3"),
        ('model = "duffing"', 'modl = "duffing"', "modl"),
    ],
)
def test_control__mistakes(tmp_path, old, new, message):
    (tmp_path / "rig.toml").write_text(CONTROL.replace(old, new))
    with pytest.raises(SpecError) as raised:
        trace(*load_control(tmp_path / "rig.toml"))
    assert message in str(raised.value)
