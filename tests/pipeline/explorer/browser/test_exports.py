"""Copies of a run in a real browser: a file by itself, and a folder behind a plain web server."""

from __future__ import annotations

import csv
import functools
import http.server
import json
import shutil
import threading

import numpy as np
import pytest

from pipeline.explorer.copies.export import export_folder, export_page
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.diagram import diagram
from pipeline.explorer.data.tables import table
from pipeline.store.run import RunDirectory

pytestmark = pytest.mark.slow


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def hosted():
    """Serve a folder as any static host would; gives its address."""
    servers = []

    def serve(folder):
        handler = functools.partial(_Quiet, directory=str(folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}/index.html"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def copies(looked_at, tmp_path_factory):
    """The small run in both forms, with its orbits."""
    folder = tmp_path_factory.mktemp("copies")
    run = RunDirectory.open(looked_at)
    written = export_page(run, folder / "copy.html")
    assert written.orbits > 0
    export_folder(run, folder / "site")
    return folder


def _drawn(opened):
    opened.page.locator(".facts-line", has_text="points").wait_for()
    return opened.page


def _asked(page, name, *arguments):
    """What the page's source answers: attributes, and arrays as lists."""
    return page.evaluate(
        """async ([name, arguments_]) => {
          const { attrs, arrays } = await window.magpend.source[name](...arguments_);
          const lists = Object.entries(arrays).map(([k, v]) => [k, Array.from(v)]);
          return { attrs, arrays: Object.fromEntries(lists) };
        }""",
        [name, list(arguments)],
    )


def _compare(page, run):
    """Every diagram of a copy is what the server would send."""
    view = page.evaluate("window.magpend.source.view()")
    for axis in view["axes"]:
        others = {a["name"]: len(a["values"]) - 1 for a in view["axes"] if a is not axis}
        for vertical in view["verticals"]:
            query = {"x": axis["name"], "y": vertical["name"], "at": others}
            arrays, attrs = unpack_arrays(diagram(run, axis["name"], vertical["name"], others))
            found = _asked(page, "diagram", query)
            assert set(found["arrays"]) == set(arrays)
            for name, values in arrays.items():
                np.testing.assert_array_equal(np.array(found["arrays"][name]), values, err_msg=f"{query} {name}")
            assert {k: found["attrs"][k] for k in ("x", "y", "unit", "at")} == {
                k: attrs[k] for k in ("x", "y", "unit", "at")
            }


def _rows(text):
    lines = [line for line in text.splitlines() if not line.startswith("# note")]
    comments = [line for line in lines if line.startswith("#")]
    return comments, list(csv.reader(line for line in lines if not line.startswith("#")))


def _compare_tables(page, run, queries):
    """What the browser writes as CSV is what magpend writes."""
    for kind, query in queries.items():
        text = page.evaluate(
            "([kind, query]) => window.magpend.source.table(kind, query, 'csv').then((blob) => blob.text())",
            [kind, query],
        )
        told, (heads, *rows) = _rows(text)
        told_too, (heads_too, *rows_too) = _rows(table(run, kind, query).decode())
        assert heads == heads_too
        assert rows, kind
        if kind == "orbit":  # a copy in one file keeps fewer instants
            rows, rows_too = rows[:1], rows_too[:1]
        else:
            assert len(rows) == len(rows_too)
            assert [line.split(":")[0] for line in told] == [line.split(":")[0] for line in told_too]
        for row, row_too in zip(rows, rows_too, strict=True):
            for value, value_too in zip(row, row_too, strict=True):
                # an orbit has the digits that a copy keeps
                assert value == value_too or float(value) == pytest.approx(float(value_too), rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("form", ["file", "folder"])
def test_copy__shows_the_diagram_and_an_orbit(visit, copies, hosted, looked_at, form):
    address = (copies / "copy.html").as_uri() if form == "file" else hosted(copies / "site")
    opened = visit(address)
    page = _drawn(opened)
    run = RunDirectory.open(looked_at)
    _compare(page, run)
    notes = page.locator(".notes").inner_text()
    assert "live integration is off" in notes
    assert ("compared with its sha256" in notes) == (form == "folder")
    # the title is text
    assert page.locator("h1").inner_text() == run.info.title
    assert page.title().startswith(run.info.title)

    box = page.locator("canvas").first.bounding_box()
    cell = run.plan.n_cells // 2
    page.evaluate(f"window.magpend.state.set({{selected: {{cell: {cell}, point: 2}}}})")
    page.locator(".facts", has_text="2.25").first.wait_for()
    orbit = _asked(page, "orbit", {"cell": cell, "point": 2})
    section = run.cube()["section"].values.reshape(run.plan.n_cells, -1, 4)[cell]
    np.testing.assert_array_equal(np.array(orbit["arrays"]["section"]).reshape(-1, 4), section)
    # the stored orbit passes where the cell's own sections lie
    states = np.array(orbit["arrays"]["states"]).reshape(-1, 4)
    assert np.abs(states[0] - section[-1]).max() < 1e-3
    assert orbit["attrs"]["cell"] == cell
    assert "integrated" in orbit["attrs"]["note"]
    assert page.locator(".panels").inner_text().count(orbit["attrs"]["note"]) == 1
    assert box["width"] > 300
    last = {"at": {"frequency": 4}}
    stored = {"cell": orbit["attrs"]["stored"], "point": section.shape[0] - 1}
    _compare_tables(
        page, run, {"attractors": last, "plane": last, "curves": {"x": "frequency", "at": {}}, "orbit": stored}
    )
    # a click selects, and the address keeps it
    page.evaluate("window.magpend.state.set({selected: null})")
    page.wait_for_timeout(1000)
    before = page.url
    for share in (0.5, 0.45, 0.4, 0.35, 0.55, 0.6):  # somewhere near a point
        page.mouse.click(box["x"] + 0.52 * box["width"], box["y"] + share * box["height"])
        page.wait_for_timeout(1000)  # the nearest point is found in a worker, and the address follows
        if selected := page.evaluate("window.magpend.state.get().selected"):
            break
    assert selected is not None
    page.wait_for_url(lambda address: address != before)
    page.locator(".facts").first.wait_for()
    again = visit(page.url)
    assert _drawn(again).evaluate("window.magpend.state.get().selected") == selected
    assert opened.complaints + again.complaints == []
    assert opened.outside == []


def test_folder__says_which_chunk_is_damaged(visit, copies, hosted, tmp_path):
    shutil.copytree(copies / "site", tmp_path / "site")
    chunk = next((tmp_path / "site" / "cube.zarr" / "section").glob("c.*.0"))
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(bytes(content))
    page = visit(hosted(tmp_path / "site")).page
    banner = page.locator(".banner")
    banner.filter(has_text="is damaged").wait_for()
    assert f"cube.zarr/section/{chunk.name}" in banner.inner_text()
    assert "sha256" in banner.inner_text()
    # another state's column is whole
    page.evaluate("window.magpend.state.set({y: 'psi2'})")
    page.locator(".facts-line", has_text="points").wait_for()


def test_folder__an_edited_list_of_digests_is_noticed(visit, copies, hosted, tmp_path):
    shutil.copytree(copies / "site", tmp_path / "site")
    listed = tmp_path / "site" / "objects.json"
    entries = json.loads(listed.read_text())
    entries["data/view.bin"]["sha256"] = "0" * 64
    listed.write_text(json.dumps(entries))
    page = visit(hosted(tmp_path / "site")).page
    page.locator(".banner", has_text="objects.json is damaged").wait_for()


def test_file__of_which_an_object_is_damaged_says_so(visit, copies, tmp_path):
    text = (copies / "copy.html").read_text("utf-8")
    place = text.index('id="data-column-0">') + 600
    (tmp_path / "copy.html").write_text(
        f"{text[:place]}{'A' if text[place] != 'A' else 'B'}{text[place + 1 :]}", "utf-8"
    )
    page = visit((tmp_path / "copy.html").as_uri()).page
    page.locator(".banner", has_text="damaged").wait_for()


@pytest.mark.parametrize("form", ["file", "folder"])
def test_copy__of_two_axes_shows_each(visit, made, hosted, tmp_path, form):
    """Numbers that nothing has integrated, with cells that are not committed."""
    for index in range(made.plan.n_tasks - 1):
        made.commit(index)
    run = RunDirectory.open(made.info.directory)
    quantities = [run.model.quantities[0].name]
    if form == "file":
        export_page(run, tmp_path / "copy.html", most_orbits=0, quantities=quantities)
        opened = visit((tmp_path / "copy.html").as_uri())
    else:
        export_folder(run, tmp_path / "site", most_orbits=0, quantities=quantities)
        opened = visit(hosted(tmp_path / "site"))
    page = _drawn(opened)
    _compare(page, run)
    assert "cells were not computed" in page.locator(".notes").inner_text()
    _compare_tables(page, run, {"diagram": {"x": "q", "y": "psi1", "at": {"frequency": 1}}})
    assert opened.complaints == []
