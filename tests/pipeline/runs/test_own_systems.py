"""Runs of systems of one's own, from the specification to the figure; and runs of strangers."""

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

from magpend_core.engine import jit
from magpend_core.models import imported
from pipeline import open_run
from pipeline.layout.identity import digest_of
from pipeline.layout.vocabulary import model_of
from pipeline.store.checksums import seal, unseal
from pipeline.store.runfile import read_run
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


def test_open_run__cube_names_its_model_in_words(finished_text, tmp_path):
    ds = open_run(finished_text)
    assert json.loads(ds.attrs["model"])["equations"]["v"] == "drive - d*v - x**3"
    assert model_of(ds).name == "shared" or model_of(ds).name == "duffing5"
    ds.to_netcdf(tmp_path / "cube.nc", engine="scipy")  # attributes that any format takes
    assert read_run(finished_text).spec["model"]["states"] == {"x": {"unit": "m"}, "v": {"unit": "m/s"}}


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
    assert "--import-model trap:MINE" in said
    for form in ("trap:MINE", "shared.toml"):  # a name where a run keeps a whole
        rewritten(stored, lambda spec, form=form: spec.update(model=form))
        assert main("status", stored)[0] == 5
    assert not trace.exists()
    assert "trap" not in sys.modules
    code, _, said = main("status", stored, "--import-model", "trap:MINE")
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
    named = "--import-model", "mine:MINE"
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
