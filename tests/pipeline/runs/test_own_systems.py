"""Runs of systems of one's own, from the specification to tables and figures; and runs of strangers."""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import Status
from magpend_core.engine import jit
from magpend_core.models import imported
from pipeline import open_run
from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.chaos.analysis import chaos_table
from pipeline.layout.identity import digest_of
from pipeline.layout.vocabulary import model_of, parameters_of
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive, shown_table
from pipeline.specification.problems import SpecError
from pipeline.store.runfile import read_run
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.factories import finished, quietly


@pytest.fixture
def text_spec(own, write_spec, tmp_path):
    """A specification whose model is a file beside it."""
    (tmp_path / "shared.toml").write_text(own.text)
    return write_spec(own.spec('model = "shared.toml"'))


def rewritten(directory: Path, change) -> None:
    """Change run.json as a stranger can who makes its digest fit."""
    path = directory / "run.json"
    data = unseal(path.read_bytes())
    change(data["spec"])
    change(data["identity"]["spec"])
    data["digest"] = digest_of(data["identity"])
    path.write_text(seal(json.dumps(data)))


@pytest.fixture(scope="module")
def finished_text(own, tmp_path_factory):
    """A finished run of a model in a text."""
    folder = tmp_path_factory.mktemp("text")
    (folder / "shared.toml").write_text(own.text)
    return finished(folder, own.spec('model = "shared.toml"'))


@pytest.fixture
def stored(finished_text, tmp_path):
    """A copy of it."""
    return shutil.copytree(finished_text, tmp_path / "run")


@pytest.mark.slow
def test_run__text_is_integrated_as_it_is_written(finished_text):
    """Against scipy's DOP853 of the same equations, from another hand."""
    ds = open_run(finished_text)
    f, d, amplitude = float(ds.frequency), 0.08, 0.2

    def rhs(t, y):
        return [y[1], amplitude * np.cos(2 * np.pi * f * t) - d * y[1] - y[0] ** 3]

    cell = ds.isel(x_0=1, v_0=2)
    start = [float(cell.x_0), float(cell.v_0)]
    times = (20 + 1 + np.arange(4)) / f
    found = solve_ivp(rhs, (0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-12).y.T
    assert cell.section.values == pytest.approx(found, abs=2e-5)


def test_run__workers_take_text_from_the_compile_cache(finished_text, text_spec, tmp_path, bytes_of):
    system = model_of(open_run(finished_text)).system.name
    # other tests compile beside this one
    mine = re.compile(rf"lanes\.advance_{system}_[0-9a-f]+_record-.*\.nbc")
    before = {p for p in jit.CACHE_FOLDER.rglob("*") if mine.fullmatch(p.name)}
    quietly(text_spec, tmp_path / "two", workers=1)
    assert before
    assert {p for p in jit.CACHE_FOLDER.rglob("*") if mine.fullmatch(p.name)} == before
    assert bytes_of(finished_text) == bytes_of(tmp_path / "two")


@pytest.mark.parametrize(
    "text", ["__import__('pathlib').Path('pwned').write_text('x')", "(lambda: x)()", "(" * 5000 + "x" + ")" * 5000]
)
def test_open_run__stranger_s_text_is_one_error(stored, tmp_path, main, text):
    def change(spec):
        spec["model"]["equations"]["v"] = text

    rewritten(stored, change)
    for call in (("status",), ("plot", "basins"), ("analyse", "attractors"), ("verify",)):
        started = time.perf_counter()
        code, _, said = main(*call, tmp_path / "run")
        assert time.perf_counter() - started < 120
        assert code == 5
        assert "model.equations.v" in said
        assert "Traceback" not in said
    assert not (tmp_path / "pwned").exists()


@pytest.mark.slow
def test_open_run__stranger_s_object_is_never_imported(own, stored, tmp_path, main, monkeypatch):
    """The module lies in the current folder and on the path; opening and drawing leave it alone."""
    trace = own.write_module(tmp_path, "trap")
    monkeypatch.syspath_prepend(str(tmp_path))
    table = read_run(stored).spec["model"]
    described = {
        "python": "trap:MINE",
        "digest": "0123456789abcdef",
        "name": "mine",
        "title": "",
        "section": "",
        "angle_dim": "angle",
        "autonomous": False,
        "states": {n: {"unit": "m", "meaning": n} for n in table["states"]},
        "parameters": {"d": {"unit": "1", "meaning": "d"}, "A": {"unit": "1", "meaning": "A"}},
        "quantities": {},
        "presets": {"default": {"values": {"d": 0.08, "A": 0.2}}},
    }

    def change(spec):
        spec["model"] = described

    rewritten(stored, change)
    assert main("status", stored)[0] == 0
    assert main("verify", stored)[0] == 5  # the commits are another run's
    code, out, said = main("plot", "section", stored)
    assert code == 0, said
    assert "section" in out
    code, _, said = main("analyse", "attractors", stored)
    assert code == 2
    assert "--import-object trap:MINE" in said
    for form in ("trap:MINE", "shared.toml"):  # a name where a run keeps a whole
        rewritten(stored, lambda spec, form=form: spec.update(model=form))
        assert main("status", stored)[0] == 5
    assert not trace.exists()
    assert "trap" not in sys.modules
    code, _, said = main("status", stored, "--import-object", "trap:MINE")
    assert trace.exists()  # a person has named it
    sys.modules.pop("trap", None)


@pytest.mark.slow
def test_run__object_reaches_workers_and_is_held_to_its_digest(own, tmp_path, magpend, main, monkeypatch):
    """The module lies beside the specification alone; the run is made from elsewhere."""
    project, elsewhere = tmp_path / "project", tmp_path / "elsewhere"
    trace = own.write_module(project, "mine")
    elsewhere.mkdir()
    (project / "spec.toml").write_text(own.spec('model = "mine:MINE"'))
    done = magpend("run", project / "spec.toml", "--out", "run", "--workers", 1, cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    ds = open_run(elsewhere / "run")
    cell, f = ds.isel(x_0=1, v_0=2), float(ds.frequency)
    found = solve_ivp(
        lambda t, y: [y[1], np.cos(2 * np.pi * f * t) - 0.1 * y[1] - y[0]],
        (0, 24 / f),
        [float(cell.x_0), float(cell.v_0)],
        "DOP853",
        (21 + np.arange(4)) / f,
        rtol=1e-12,
        atol=1e-12,
    ).y.T
    assert cell.section.values == pytest.approx(found, abs=2e-5)
    named = "--import-object", "mine:MINE"
    trace.unlink()
    assert main("analyse", "attractors", elsewhere / "run")[0] == 2
    assert not trace.exists()
    monkeypatch.syspath_prepend(project)
    code, out, err = main("analyse", "attractors", elsewhere / "run", *named, "--json")
    assert code == 0, err
    assert [row["orbit_period"] for row in json.loads(out)] == [1]
    # as another process sees it, in which the object has changed
    module = project / "mine.py"
    module.write_text(module.read_text().replace("- y[0]", "- 1.1 * y[0]"))
    sys.modules.pop("mine")
    monkeypatch.setattr(imported, "_imported", {})
    code, _, said = main("run", project / "spec.toml", "--out", elsewhere / "run")
    assert code == 2
    assert "model_digest" in said
    assert main("analyse", "attractors", elsewhere / "run", *named, "--json")[0] == 0  # what was kept needs no object
    assert main("analyse", "settling", elsewhere / "run", *named)[0] == 0  # and neither does what follows from it
    code, _, said = main("analyse", "attractors", elsewhere / "run", *named, "--budget", "2")
    assert code == 2  # a longer extension integrates
    assert "restore the code" in said
    sys.modules.pop("mine")


# ---- parameters at which equations have no value ---------------------------------------------------------

RATE = "v/d*(1 + log(e))*(1 + sqrt(s)) + where(g > 0, v/g, v)"
"""One system for all cases, which compiles once."""


def probe(axis, values, rate=RATE, **parameters):
    return {
        "kind": "sweep",
        "axes": {axis: {"values": values}},
        "model": {
            "name": "probe",
            "states": {"x": {}, "v": {}},
            "parameters": {"d": 2.0, "e": 1.0, "s": 0.0, "g": 1.0, **parameters},
            "equations": {"x": "v", "v": f"cos(2*pi*f*t) - ({rate}) - x"},
        },
        "parameters": {"frequency_hz": 0.2},
        "initial_conditions": {"kind": "list", "points": [[0.1, 0.0]]},
        "integration": {"n_transient": 1, "n_keep": 2, "rtol": 1e-5, "atol": 1e-5},
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "values", "lost"),
    [
        ("d", [0.0, 0.5, 1.0], [0]),
        ("d", [-1.0, 0.0, 1.0], [1]),
        ("e", [0.0, 0.5, 1.0], [0]),
        ("s", [-1.0, 0.0, 1.0], [0]),
    ],
)
def test_run__an_axis_that_touches_a_pole_gives_cells_with_a_status(tmp_path, axis, values, lost):
    quietly(probe(axis, values), tmp_path / "run")
    ds = open_run(tmp_path / "run")
    ended = np.isin(ds.status.values.ravel(), [Status.STEP_UNDERFLOW, Status.DIVERGED])
    assert np.flatnonzero(ended).tolist() == lost
    assert np.isfinite(ds.section.values.reshape(3, -1)[~ended]).all()


def test_run__a_guard_without_a_state_is_one(tmp_path):
    """A rate that has no value at g = 0, behind a condition that says so: it is that at g = 1."""
    quietly(probe("g", [0.0, 1.0]), tmp_path / "run")
    guarded, plain = open_run(tmp_path / "run").section.values
    np.testing.assert_array_equal(guarded, plain)


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ("v/e", "v/e: division by 0 at e = 0, in every state"),
        ("where(x < 9, v, log(e))", "log(e): logarithm of 0 at e = 0, in every state"),
        ("where(x < 9, v, 10**400)", "10**400: too large a number, in every state"),
    ],
)
def test_run__refuses_parts_without_a_value(tmp_path, rate, words):
    with pytest.raises(SpecError) as caught:
        quietly(probe("d", [1.0, 2.0], f"{rate} + 0*(d + e + s + g)", e=0.0), tmp_path / "run")
    assert f"model.equations.v: {words}" in str(caught.value)
    assert not (tmp_path / "run").exists()


# ---- flows seen at crossings, from the specification to tables and figures -------------------------------

FLOW = """
kind = "sweep"
title = "two attractors of a flow"

[model]
name = "normal_form"  # tests/core/flows.py has it, too: it compiles once
states = { x = {}, y = {} }
parameters = { mu = -0.1, omega = 2.0, cubic = 1.0, quintic = -1.0 }
define = { s = "x**2 + y**2", g = "mu + cubic*s + quintic*s**2" }
equations = { x = "g*x - omega*y", y = "omega*x + g*y" }

[section]
of = "y"
value = 0.3
longest = 20.0

[axes]
mu = { values = [-0.2, -0.1, 0.1] }

[initial_conditions]
kind = "grid"
x = { start = -0.9, stop = 0.9, num = 6 }
y = { start = -1.05, stop = 0.95, num = 6 }

[integration]
rtol = 1e-9
atol = 1e-9
n_transient = 150
n_keep = 12

[products]
lyapunov = { n_transient = 20, n_periods = 64, n_blocks = 4 }
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("flow"), FLOW)


@pytest.mark.slow
def test_run__cube(directory):
    """Returns of the cycle take pi seconds; what rests is left where it rests."""
    ds = open_run(directory)
    assert "frequency" not in ds.coords
    model = model_of(ds)
    assert model.crossing.value == 0.3
    assert parameters_of(ds)["section_value"] == 0.3
    status = ds["status"].values
    assert set(np.unique(status)) == {Status.PERIODIC, Status.NO_RETURN}
    closed = status == Status.PERIODIC
    np.testing.assert_allclose(ds["return_time"].values[closed], np.pi, atol=1e-6)
    np.testing.assert_allclose(ds["section"].sel(state="y").values[closed], 0.3, atol=1e-12)
    assert np.isnan(ds["return_time"].values[~closed]).all()
    assert np.abs(ds["rest_state"].values[~closed]).max() < 0.3
    assert np.isnan(ds["rest_state"].values[closed]).all()
    assert ds["return_time"].attrs["units"] == "s"
    # exponents per second: 0 along the flow, -2 s (2 s - 1) across it, of the cycle's squared radius s
    for mu in (-0.2, -0.1, 0.1):
        s = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * mu))
        own = ds["lyapunov"].sel(mu=mu).values[ds["status"].sel(mu=mu).values == Status.PERIODIC]
        np.testing.assert_allclose(own, np.tile([0.0, 2.0 * s * (1.0 - 2.0 * s)], (len(own), 1)), atol=1e-5)


@pytest.mark.slow
def test_derive__attractors_chaos_and_branches(directory):
    attractors = dense(derive(directory, "attractors"), points=True)
    table = attractors_table(rows_of(attractors))
    rests = [row for row in table.rows if row["kind"] == "equilibrium"]
    cycles = [row for row in table.rows if row["kind"] == "periodic_orbit"]
    assert {row["mu"] for row in rests} == {-0.2, -0.1}
    assert {row["mu"] for row in cycles} == {-0.2, -0.1, 0.1}
    for row in cycles:
        assert row["period_s"] == pytest.approx(np.pi, rel=1e-9)
        assert row["orbit_period"] == 1
    for row in rests:
        assert row["eigenvalue_real"] == pytest.approx(row["mu"], abs=1e-9)
    assert sum(row["n_cells"] for row in table.rows) == attractors["status"].size
    assert "seconds" in table.lines[2]
    chaos = chaos_table(derive(directory, "chaos"))
    assert {row["nature"] for row in chaos.rows} == {"regular"}
    assert {row["exponents_from"] for row in chaos.rows} == {"multipliers", "eigenvalues"}
    assert not any("drive" in line for line in chaos.lines)
    branches = shown_table("branches", derive(directory, "branches", {"low": -0.3, "high": 0.1}))
    # the cycles leave the Hopf point on another section than the run's, and are found on both only once
    assert [row["type"] for row in branches.rows] == ["fold", "hopf"]
    assert [row["mu"] for row in branches.rows] == pytest.approx([-0.25, 0.0], abs=1e-8)
    assert branches.rows[1]["normal_form"] == pytest.approx(1.0, rel=1e-6)
    assert any("equilibrium" in line for line in branches.lines)
