"""The main job on real input: the shipped quickstart, its cube, its figure."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pipeline
from magpend_core import Status
from magpend_core.engine import lanes
from magpend_core.models.pendulum.sides import Side
from pipeline.results.sides import classify
from pipeline.specification.files import shipped_workflows
from tests.programs import ROOT, program

# see tests/core/data/README.md for where these points come from
ORBITS = json.loads((Path(__file__).parent / "core" / "data" / "orbits.json").read_text("utf-8"))


def magpend(*arguments, **environment):
    """Run the command as a user does, in a process of its own."""
    code = "import sys; from pipeline.cli.main import main; sys.argv[0] = 'magpend'; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
        env={**os.environ, **environment},
    )


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """The run of README's main job: a copy of the one in this checkout if the same code made it, or a new one."""
    folder = tmp_path_factory.mktemp("quickstart") / "run"
    made = ROOT / "runs" / "quickstart"
    if made.is_dir():
        shutil.copytree(made, folder)
        # other code, or damage, is refused; what is missing is computed
        if magpend("run", "quickstart", "--out", folder, "--plot").returncode != 0:
            shutil.rmtree(folder)
    if not folder.exists():
        done = magpend("run", "quickstart", "--out", folder, "--plot")
        assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def ds(directory):
    with pipeline.open_run(directory) as opened:
        yield opened.load()


@pytest.mark.slow
def test_quickstart__complete(directory, ds):
    assert (directory / "figures" / "bifurcation_psi1.png").stat().st_size > 20_000
    assert set(np.unique(ds.status)) <= {Status.PERIODIC, Status.BOUNDED}
    assert ds.sizes["branch"] >= 2 * 8
    assert set(ds.direction.values) == {"up", "down"}


@pytest.mark.slow
def test_quickstart__the_docs_show_this_run(directory):
    """The README's picture is what its command draws. An older kernel's differs in 7 % of its pixels."""
    made = directory / "figures" / "bifurcation_psi1.png"
    stale = program("docs/run_tutorials.py").is_stale(ROOT / "docs" / "quickstart.png", made)
    assert not stale, "docs/quickstart.png is stale; make it with: magpend run quickstart --plot"


@pytest.mark.slow
def test_quickstart__left_orbit_at_2p2_hz(ds):
    """Some walk lies on the left orbit; what is left of its transient is below 1e-6.

    Left is stable over a wider range (2.0565 to 2.3861 Hz) than right (2.0883 to 2.3722 Hz): it is what
    captures a walk that comes out of chaos on either side.
    """
    orbit = next(o for o in ORBITS if o["frequency_hz"] == 2.2 and o["section"][0] < 0.0)
    here = ds.sel(frequency=2.2, method="nearest")
    last = here.section.isel(period_index=-1)
    distance = np.abs(last - np.array(orbit["section"])).max("state")
    on_orbit = distance < 1e-5
    assert on_orbit.any()
    assert (here.orbit_period.where(on_orbit, drop=True) == 1).all()


@pytest.mark.parametrize("frequency", [2.6, 2.9])
def test_quickstart__both_sides(ds, frequency):
    here = ds.sel(frequency=[frequency], method="nearest")
    closed = (here.orbit_period == 1).values.ravel()
    sides = classify(here).values.ravel()[closed]
    assert {int(Side.LEFT), int(Side.RIGHT)} == set(sides.tolist())


def test_quickstart__period_1_band(ds):
    """Between the chaotic bands, an unbroken stretch over 0.2 Hz and more of period 1 in all branches."""
    between = ds.sel(frequency=slice(2.03, 2.42))
    all_closed = (between.orbit_period == 1).all("branch").values
    broken = np.concatenate([[-1], np.flatnonzero(~all_closed), [all_closed.size]])
    longest = np.diff(broken).max() - 1
    assert longest * np.diff(ds.frequency.values).mean() > 0.2
    assert not all_closed[0]
    assert not all_closed[-1]


def test_quickstart__chaos_period_2_and_period_1(ds):
    most = 0.5
    for frequency in (2.03, 2.40):
        assert (ds.orbit_period.sel(frequency=frequency, method="nearest") > 0).mean() < most
    assert (ds.orbit_period.sel(frequency=2.48, method="nearest") == 2).mean() > most
    window = ds.orbit_period.sel(frequency=slice(2.599, 2.951))
    assert ((window == 1).mean("branch") > most).all()


@pytest.mark.slow
def test_plot__without_kernel(directory, tmp_path, command, monkeypatch):
    """The figure comes from the cube alone: with a kernel that raises, it is the other process's file."""

    def broken(*_):
        raise AssertionError("the kernel was called")

    # what every engine is had from, whoever has imported `integrate` or `engine_of` by then
    monkeypatch.setattr(lanes, "_engine_of", broken)
    with pytest.raises(AssertionError, match="the kernel was called"):
        command(tmp_path, "run", "quickstart", "--smoke", "--out", "other", "--workers", "0")
    plotted = tmp_path / "again.png"
    command(tmp_path, "plot", "bifurcation", directory, "--out", plotted)
    assert plotted.read_bytes() == (directory / "figures" / "bifurcation_psi1.png").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] if "/" in name else []) for name in shipped_workflows()]
)
def test_workflow__smoke(name, tmp_path, command):
    command(tmp_path, "run", name, "--smoke", "--out", name, "--workers", "0")
    with pipeline.open_run(tmp_path / name) as opened:
        assert (opened.status != Status.PENDING).all()
