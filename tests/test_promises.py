"""Each promise of README and docs, once and end to end, as a user meets it. Numbers come from elsewhere.

The runs are of Duffing oscillators, which compile in seconds; the main job alone is the pendulum's.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

import magpend
from magpend_core import Status

FREQUENCY = 1.0 / (2.0 * math.pi)
TWO_WELLS = f"""
kind = "sweep"
title = "two wells"
model = "duffing"
[parameters]
preset = "twin-well-periodic"
[axes]
frequency_hz = {{ values = [{FREQUENCY!r}] }}
[initial_conditions]
kind = "grid"
x = {{ start = -2.2, stop = 2.2, num = 12 }}
v = {{ start = -2.2, stop = 2.2, num = 12 }}
[integration]
rtol = 1e-8
atol = 1e-8
n_transient = 200
n_keep = 16
[products]
lyapunov = {{ n_transient = 100, n_periods = 200, n_blocks = 4 }}
[execution]
trajectories_per_task = 24
"""
# x'' = .2 cos t + x - x^3 - .15 x': DynamicalSystemsBase.jl, issue 139, and recomputed
WELLS = np.array([[-0.7790549287, 0.0274168155], [1.2100908241, 0.0552949542]])
MULTIPLIER = complex(-0.226806, 0.581567)

RESONANCE = """
kind = "continuation"
title = "bent resonance"
model = "duffing"
[parameters]
preset = "hardening"
[axes]
frequency_hz = { start = 0.16, stop = 0.30, num = 15 }
[continuation]
direction = "both"
[initial_conditions]
kind = "list"
points = [[0.0, 0.0]]
[integration]
rtol = 1e-8
atol = 1e-8
n_transient = 60
n_keep = 12
"""


def silent(line):
    """Print nothing."""


def start(folder, *words):
    """Start the command in a process of its own, as a shell does."""
    code = "import sys; from pipeline.cli.entry import main; sys.argv[0] = 'magpend'; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], cwd=folder, stderr=subprocess.PIPE, text=True
    )


def refused(folder, *words):
    """Return the exit code of a command and what it wrote to the standard error."""
    process = start(folder, *words)
    _, err = process.communicate(timeout=300)
    return process.returncode, err


def bytes_of(run):
    return {
        f.relative_to(run): f.read_bytes()
        for top in ("cube.zarr", "commits")
        for f in (run / top).rglob("*")
        if f.is_file()
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the finished run ``wells``, computed through Python."""
    path = tmp_path_factory.mktemp("promises")
    (path / "wells.toml").write_text(TWO_WELLS)
    (path / "resonance.toml").write_text(RESONANCE)
    magpend.run(path / "wells.toml", out=path / "wells", workers=0, echo=silent)
    return path


def test_main_job__draws_the_pendulums_diagram(tmp_path):
    assert refused(tmp_path, "run", "quickstart", "--smoke", "--plot")[0] == 0
    (figure,) = tmp_path.glob("runs/*/figures/bifurcation_psi1.png")
    assert figure.stat().st_size > 20_000
    (cube,) = tmp_path.glob("runs/*/cube.zarr")
    with xr.open_zarr(cube, consolidated=False) as ds:
        assert set(np.unique(ds.status)) <= {Status.PERIODIC, Status.BOUNDED}
        assert ds.sizes["branch"] == 2 * 2


def test_run__killed_and_continued_has_the_same_bytes(tmp_path):
    (tmp_path / "long.toml").write_text(TWO_WELLS.replace("n_transient = 200", "n_transient = 12000"))
    process = start(tmp_path, "run", "long.toml", "--out", "killed", "--workers", "1")
    commits = tmp_path / "killed" / "commits"
    while not any(commits.glob("*.json")):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)
    process.kill()
    process.communicate()
    with magpend.open_run(tmp_path / "killed", check=False) as part:
        n_pending = int((part.status == Status.PENDING).sum())
    assert 0 < n_pending < 12 * 12
    magpend.run(tmp_path / "long.toml", out=tmp_path / "killed", echo=silent)
    magpend.run(tmp_path / "long.toml", out=tmp_path / "whole", workers=0, echo=silent)
    assert bytes_of(tmp_path / "killed") == bytes_of(tmp_path / "whole")


def test_attractors__are_the_two_published_ones_with_their_basins(folder, command):
    found = json.loads(command(folder, "analyse", "attractors", "wells", "--json")[0])
    assert [row["kind"] for row in found] == ["periodic_orbit"] * 2
    assert [row["stability"] for row in found] == ["attracts"] * 2
    for row in found:
        assert row["orbit_period"] == 1
        assert row["multiplier_modulus"] == pytest.approx(abs(MULTIPLIER), abs=2e-6)
    with magpend.open_run(folder / "wells") as ds:
        last = ds.section.isel(period_index=-1).values.reshape(-1, 2)
    assert (np.abs(last[:, None] - WELLS).max(axis=-1).min(axis=1) < 1e-6).all()
    for row, published in zip(
        json.loads(command(folder, "analyse", "basins", "wells", "--json")[0]), (0.498, 0.502), strict=True
    ):
        assert row["low"] < published < row["high"]


def test_exponents__agree_with_multipliers_and_damping(folder):
    with magpend.open_run(folder / "wells") as ds:
        exponents = ds.lyapunov.values.reshape(-1, 2)
    np.testing.assert_allclose(exponents.sum(axis=1), -0.15, atol=1e-6)  # a hundred times the run's tolerance
    np.testing.assert_allclose(np.median(exponents, axis=0), math.log(abs(MULTIPLIER)) * FREQUENCY, atol=1e-4)


def hardening(t, y, f):
    """Return the rates of the preset's oscillator and of the four entries of its fundamental matrix."""
    x, v, a, b, c, d = y
    k = 1.0 + 1.5 * x * x
    force = 0.3 * math.cos(2.0 * math.pi * f * t)
    return v, force - 0.1 * v - x - 0.5 * x**3, c, d, -k * a - 0.1 * c, -k * b - 0.1 * d


def test_branches__have_the_orbits_and_folds_of_another_integrator(folder):
    magpend.run(folder / "resonance.toml", out=folder / "resonance", workers=0, echo=silent)
    found = magpend.branches(folder / "resonance", max_period=1)
    folds = found.isel(bifurcation=found.of_branch == 0)
    assert folds.sizes["bifurcation"] == 2
    for f, state in zip(folds.value.values, folds.bifurcation_section.values[:, 0], strict=True):
        start = (*state, 1.0, 0.0, 0.0, 1.0)
        end = solve_ivp(hardening, (0.0, 1.0 / f), start, "DOP853", args=(f,), rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end[:2], state, atol=1e-8)
        assert np.linalg.eigvals(end[2:].reshape(2, 2)).real.max() == pytest.approx(1.0, abs=1e-5)


def test_own_system__as_text_has_the_response_of_the_closed_form(tmp_path):
    model = magpend.model("x'' = -c*x' - k*x + F*cos(2*pi*f*t)", name="linear", c=0.2, k=2.0, F=1.0)
    done = magpend.sections(model.load(), [FREQUENCY], [[0.0, 0.0]], n_transient=300, n_keep=1, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(done.section[0, 0], (0.9615384615, 0.1923076923), atol=1e-7)


def test_bad_specification__is_refused_with_all_its_problems(tmp_path):
    (tmp_path / "bad.toml").write_text(TWO_WELLS.replace("num = 12", "num = 0").replace("rtol", "rtoll"))
    code, err = refused(tmp_path, "run", "bad.toml")
    assert code == 2
    for key in ("initial_conditions.x.num", "initial_conditions.v.num", "rtoll"):
        assert key in err
    assert [f.name for f in tmp_path.iterdir()] == ["bad.toml"]


def test_damage__is_named_and_repaired_to_the_same_bytes(folder, tmp_path):
    shutil.copytree(folder / "wells", tmp_path / "run")
    chunk = max((tmp_path / "run" / "cube.zarr" / "section").rglob("*"), key=lambda f: f.stat().st_size * f.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    code, err = refused(tmp_path, "verify", "run")
    assert code == 5, err
    magpend.run(folder / "wells.toml", out=tmp_path / "run", workers=0, echo=silent)
    assert bytes_of(tmp_path / "run") == bytes_of(folder / "wells")


def test_cluster__of_two_workers_computes_the_same_bytes(folder, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
        magpend.run(folder / "wells.toml", out=tmp_path / "run", scheduler=cluster.scheduler_address, echo=silent)
    assert bytes_of(tmp_path / "run") == bytes_of(folder / "wells")


def test_python__opens_analyses_and_draws_a_run(folder):
    import matplotlib as mpl

    mpl.use("agg")
    run = magpend.Run.open(folder / "wells")
    assert set(run.cube().dims) >= {"x_0", "v_0", "period_index", "state"}
    assert len(run.table("attractors")) == 2
    axes = run.plot.bifurcation(state="v")
    assert axes.get_xlabel() or axes.get_ylabel()
