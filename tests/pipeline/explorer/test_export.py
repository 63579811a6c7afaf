"""Copies of a run: what they hold is what the cube holds, what they leave out they say."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import re

import numpy as np
import pytest

from pipeline.explorer.copies import export as folder_module
from pipeline.explorer.copies import orbits as copied_orbits
from pipeline.explorer.copies.content import Column, fit, levels
from pipeline.explorer.copies.export import RESERVE, export_folder, export_page
from pipeline.explorer.copies.orbits import ALIKE, NEAREST, NONE, SAME_ATTRACTOR, choose
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.explored import ExploredRun
from pipeline.store.errors import RefusedError
from pipeline.store.run import RunDirectory

HOSTILE = '</script><script>alert(1)</script><!-- \\" onload=alert(1) &lt;b'


def _data(content: bytes):
    """What an object holds, as the page reads it."""
    arrays, attrs = unpack_arrays(gzip.decompress(content))
    for name, place in attrs.pop("apart").items():
        planes = np.ascontiguousarray(arrays[name].T)
        arrays[name] = planes.view(np.dtype(place["dtype"]).newbyteorder("<")).reshape(place["shape"])
    return arrays, attrs


def _objects(path):
    """Objects of data by name in a page."""
    found = re.findall(
        r'<script type="application/octet-stream;base64" id="data-([^"]+)">([^<]*)</script>', path.read_text("utf-8")
    )
    return {name: base64.b64decode(content) for name, content in found}


def _about(objects):
    content = json.loads(gzip.decompress(objects["view"]))
    return content["view"], content["about"]


@pytest.fixture
def run(made):
    """All of the small sweep but its last task."""
    for index in range(made.plan.n_tasks - 1):
        made.commit(index)
    return RunDirectory.open(made.info.directory)


@pytest.mark.slow
def test_export_page__has_the_cubes_numbers(run, tmp_path):
    written = export_page(run, tmp_path / "copy.html", most_orbits=0)
    assert written.size == (tmp_path / "copy.html").stat().st_size
    objects = _objects(tmp_path / "copy.html")
    view, about = _about(objects)
    cube = run.cube()
    status = cube["status"].values.ravel()
    assert [d["name"] for d in about["dims"]] == list(run.plan.dims)
    for i, state in enumerate(run.model.state_names):
        arrays, _ = _data(objects[about["columns"][state]])
        section = cube["section"].values[..., i].reshape(run.plan.n_cells, -1)
        np.testing.assert_array_equal(arrays["count"], np.where(status == 2, section.shape[1], 0))
        np.testing.assert_array_equal(arrays["y"], section[status == 2].ravel())
    cells, _ = _data(objects["cells"])
    np.testing.assert_array_equal(cells["status"], status)
    assert {f"colour_{c['name']}" for c in view["colours"]} == set(cells) - {"status"}
    # the run is not complete
    sentence = f"{run.plan.cells_in(run.plan.n_tasks - 1)} of {run.plan.n_cells} cells were not computed"
    assert any(sentence in s for s in written.sentences)
    assert sentence in about["notice"]
    assert "Nothing is computed here" in about["notice"]


@pytest.mark.slow
def test_export_page__leaves_out_what_does_not_fit_and_says_what(run, tmp_path):
    whole = export_page(run, tmp_path / "whole.html", most_orbits=0)
    assert not any("left out" in s or "rounded" in s for s in whole.sentences)
    objects = _objects(tmp_path / "whole.html")
    columns = 4 / 3 * sum(len(v) for k, v in objects.items() if k.startswith("column"))
    # random numbers do not shrink: half the room holds them in half the bits, a fifth not all of them
    for share, rounded, thinned_too in ((0.7, True, False), (0.3, True, True)):
        most = round(whole.size - (1 - share) * columns) + RESERVE
        written = export_page(run, tmp_path / "less.html", most_orbits=0, most_bytes=most, force=True)
        assert written.size <= most
        assert any("right to 6e-8" in s for s in written.sentences) == rounded
        objects = _objects(tmp_path / "less.html")
        _, about = _about(objects)
        arrays, _ = _data(objects[about["columns"]["psi1"]])
        assert arrays["y"].dtype == np.float32
        total = int((run.cube()["status"].values == 2).sum()) * 3
        assert (len(arrays["y"]) < total) == thinned_too
        told = f"this copy has {len(arrays['y']):,} of {total:,} points"
        assert (told in about["notice"]) == thinned_too
    with pytest.raises(RefusedError, match="--folder OUT"):
        export_page(run, tmp_path / "none.html", most_orbits=0, most_bytes=10_000)
    assert not (tmp_path / "none.html").exists()


def test_fit__gives_numbers_that_are_those_of_what_it_keeps():
    rng = np.random.default_rng(1)
    count = rng.integers(0, 50, 400).astype(np.uint32)
    period = rng.integers(0, 3, 400)
    columns = {name: Column(count, rng.normal(size=int(count.sum()))) for name in "ab"}
    whole = fit(columns, period, 1e9)
    assert (whole.kept, whole.level.dtype, whole.sentences()) == (int(count.sum()), "float64", [])
    for most in (60_000, 40_000, 20_000):
        found = fit(columns, period, most)
        assert sum(map(len, found.objects.values())) <= most
        arrays, _ = _data(found.objects["a"])
        assert found.kept == len(arrays["y"]) == int(arrays["count"].sum())
        assert found.closed == int(((count > 0) & (period > 0)).sum())
        assert found.kept == found.total or f"{found.kept:,} of {found.total:,} points" in found.sentences()[-1]
        first, here = np.cumsum(count) - count, np.cumsum(arrays["count"]) - arrays["count"]
        last = count > 0
        np.testing.assert_array_equal(
            arrays["y"][(here + arrays["count"] - 1)[last]],
            columns["a"].y[(first + count - 1)[last]].astype(np.float32),
        )
    assert fit(columns, period, 100) is None
    assert [level.each for level in levels(5)][:5] == [0, 0, 1, 2, 3]


def test_choose__an_orbit_for_each_attractor_else_the_nearest(run):
    explored = ExploredRun.open(run)
    shape = run.plan.shape
    frequency = np.indices(shape)[0].ravel()
    count = np.full(run.plan.n_cells, 3)
    count[0] = 0
    attractor = (np.arange(run.plan.n_cells) % 2).astype(np.uint16)
    layers = {"status": np.full(count.shape, 2, np.int8), "orbit_period": np.zeros(count.shape, np.int16)}
    layers["colour_attractor"] = attractor
    chosen = choose(explored, layers, count, 1000)
    assert chosen.groups == len(chosen.cells) == 5 * 2 * 2
    assert chosen.orbit[0] == NONE
    assert set(chosen.how[1:]) == {SAME_ATTRACTOR}
    np.testing.assert_array_equal(attractor[chosen.cells[chosen.orbit[1:]]], attractor[1:])
    np.testing.assert_array_equal(frequency[chosen.cells[chosen.orbit[1:]]], frequency[1:])

    fewer = choose(explored, layers, count, 6)
    assert len(fewer.cells) <= 6
    assert fewer.groups == 20
    there = np.flatnonzero(fewer.how == SAME_ATTRACTOR)
    np.testing.assert_array_equal(frequency[fewer.cells[fewer.orbit[there]]], frequency[there])
    assert set(fewer.how[1:]) == {SAME_ATTRACTOR, NEAREST}
    # the nearest is one of the same attractor
    np.testing.assert_array_equal(attractor[fewer.cells[fewer.orbit[1:]]], attractor[1:])

    del layers["colour_attractor"]
    assert set(choose(explored, layers, count, 1000).how[1:]) == {ALIKE}
    none = choose(explored, layers, count, 0)
    assert (len(none.cells), set(none.orbit)) == (0, {NONE})


@pytest.mark.slow
def test_export_page__an_orbit_that_fails_is_told_where_it_is_asked_for(run, tmp_path, monkeypatch):
    asked = []

    def orbit(_, cell, point):
        asked.append(cell)
        raise ArithmeticError("the trajectory ends early")

    monkeypatch.setattr(copied_orbits, "orbit", orbit)
    written = export_page(run, tmp_path / "copy.html", most_orbits=3)
    assert written.orbits == 3
    _, attrs = _data(_objects(tmp_path / "copy.html")["orbits-0"])
    assert {entry["failed"] for entry in attrs.values()} == {"the trajectory ends early"}
    assert {entry["cell"] for entry in attrs.values()} <= set(asked)


@pytest.mark.slow
def test_export_folder__lists_every_object_and_pins_the_list(run, tmp_path):
    written = export_folder(run, tmp_path / "site", most_orbits=0)
    site = tmp_path / "site"
    files = {p.relative_to(site).as_posix(): p.read_bytes() for p in site.rglob("*") if p.is_file()}
    assert written.size == sum(map(len, files.values()))
    page, listed = files.pop("index.html"), files.pop("objects.json")
    assert b"zarrita" in files.pop("LICENSES.txt")
    assert f'data-objects="{hashlib.sha256(listed).hexdigest()}"' in page.decode()
    assert {k: (v["size"], v["sha256"]) for k, v in json.loads(listed).items()} == {
        k: (len(content), hashlib.sha256(content).hexdigest()) for k, content in files.items()
    }
    _, about = _about({"view": files["data/view.bin"]})
    assert about["columns"]["psi2_dot"] == {"variable": "section", "own": [None, 3]}
    assert not any(p.name.startswith(".") for p in tmp_path.iterdir())


def _parsed(text):
    """Title, identifiers of scripts and all tags of a page."""
    title = html.unescape(re.search(r"<title>(.*?)</title>", text, re.DOTALL)[1])
    return title, re.findall(r'<script[^>]* id="([^"]+)"', text), re.findall(r"<([a-z]\w*)", text)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["page", "folder"])
def test_export__a_hostile_title_stays_text(run, tmp_path, kind, monkeypatch):
    plain = tmp_path / "plain.html"
    export_page(run, plain, most_orbits=0)
    monkeypatch.setitem(run.info.__dict__, "title", HOSTILE)
    if kind == "page":
        path = tmp_path / "copy.html"
        export_page(run, path, most_orbits=0)
    else:
        path = export_folder(run, tmp_path / "site", most_orbits=0).path / "index.html"
    text = path.read_text("utf-8")
    assert "<script>alert" not in text
    title, scripts, tags = _parsed(text)
    assert title == f"{HOSTILE} - magpend"
    if kind == "page":
        assert (scripts, tags) == _parsed(plain.read_text("utf-8"))[1:]


@pytest.mark.slow
def test_export__what_is_there_is_not_overwritten(run, tmp_path):
    page = tmp_path / "copy.html"
    page.write_text("mine")
    with pytest.raises(RefusedError, match="exists already"):
        export_page(run, page, most_orbits=0)
    assert page.read_text() == "mine"
    export_page(run, page, most_orbits=0, force=True)
    assert page.read_bytes().startswith(b"<!doctype html>")
    with pytest.raises(RefusedError, match="no such folder"):
        export_page(run, tmp_path / "absent" / "copy.html", most_orbits=0)
    with pytest.raises(RefusedError, match="is a folder"):
        export_page(run, tmp_path, most_orbits=0, force=True)

    site = tmp_path / "site"
    export_folder(run, site, most_orbits=0)
    with pytest.raises(RefusedError, match="exists already"):
        export_folder(run, site, most_orbits=0)
    export_folder(run, site, most_orbits=0, force=True)
    (site / "thesis.tex").write_text("mine")
    with pytest.raises(RefusedError, match="not a folder that magpend export has made"):
        export_folder(run, site, most_orbits=0, force=True)
    assert (site / "thesis.tex").read_text() == "mine"


@pytest.mark.slow
def test_export_folder__that_fails_leaves_what_was_there(run, tmp_path, monkeypatch):
    site = tmp_path / "site"
    export_folder(run, site, most_orbits=0)
    before = (site / "objects.json").read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folder_module, "write_cube", fail)
    with pytest.raises(OSError, match="No space"):
        export_folder(run, site, most_orbits=0, force=True)
    assert (site / "objects.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.slow
def test_export__command(main, run, tmp_path):
    code, out, err = main("export", run.directory, "--orbits", 0)
    assert code == 0, err
    assert "page: run.html" in out
    assert "cells were not computed" in err
    assert (tmp_path / "run.html").stat().st_size < 20e6
    assert main("export", run.directory, "--orbits", 0)[0] == 0  # its own page is written again
    assert main("export", run.directory, "--out", "a.html", "--folder", "b")[0] == 2
    code, _, err = main("export", run.directory, "--out", "site")
    assert (code, "--out site: the suffix must be .html. For a folder of files give --folder site." in err) == (2, True)
    (tmp_path / "folder.html").mkdir()
    for place in ("folder.html", "absent/a.html"):
        code, _, err = main("export", run.directory, "--out", place)
        assert (code, f"--out {place}: must be a file in a folder that exists." in err) == (2, True)
    code, out, err = main("export", run.directory, "--folder", "site", "--orbits", 0)
    assert code == 0, err
    assert "site/index.html" in out
