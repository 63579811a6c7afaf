"""The widget of a notebook without a browser: its answers are the server's, and Python and the page select alike."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
from urllib.parse import urlencode

import numpy as np
import pytest
from tornado.websocket import websocket_connect

import magpend
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.notebook.connection import MOST_PAGES, Connection
from pipeline.explorer.notebook.showing import explorer
from pipeline.explorer.serving.answering import Answering
from pipeline.explorer.serving.answers import ANSWERS
from pipeline.runs.derive import derive
from pipeline.runs.run import run
from pipeline.specification.problems import SpecError
from pipeline.store.run import Run
from tests.pipeline.explorer.browser.notebooks import ROOT
from tests.pipeline.explorer.test_server import Client
from tests.pipeline.explorer.test_socket import SPEC

PATIENCE_S = 120.0

REQUESTS = [
    ("view", {}),
    ("diagram", {"x": "frequency", "y": "x"}),
    ("curves", {"x": "frequency"}),
    ("branches", {"x": "frequency", "y": "x"}),
    ("attractors", {}),
    ("disturbances", {}),
    ("orbit", {"cell": "1", "point": "4"}),
    ("plane", {}),
    ("parameter-plane", {}),
    ("curve-orbit", {"curve": "0", "point": "0"}),
    ("table", {"view": "diagram", "x": "frequency", "y": "x", "format": "csv"}),
    ("zoom", {}),
    # what is refused
    ("orbit", {"cell": "99", "point": "0"}),
    ("orbit", {"cell": "first", "point": "0"}),
    ("table", {"view": "nonsense"}),
    ("diagram", {"x": "frequency", "y": "x", "at.nonsense": "0"}),
]

BODY = json.dumps({"x": [-0.9, 0.5], "axes": ["x_0", None]})


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("widget")
    (folder / "spec.toml").write_text(SPEC)
    run(folder / "spec.toml", folder / "run", workers=0, echo=lambda _: None)
    derive(folder / "run", "attractors", {})
    return folder / "run"


class Pages:
    """A connection, and what it sends."""

    def __init__(self, directory):
        self.sent = queue.Queue()
        self.answering = Answering(Run.open(directory))
        self.connection = Connection(self.answering, lambda content, buffers: self.sent.put((content, buffers)))
        self.dropped = []

    def tell(self, page, **message):
        # as the notebook's messages are: what JSON can say
        self.connection.receive(json.loads(json.dumps({"page": page, **message})))

    def answer(self, page, wanted):
        """The next message to a page for which `wanted` is true."""
        while True:
            content, buffers = self.sent.get(timeout=PATIENCE_S)
            if content["page"] == page and wanted(content):
                return content, buffers
            self.dropped.append(content)

    def ask(self, name, words, body=None):
        self.tell("one", id=5, ask=name, words=words, body=body)
        return self.answer("one", lambda content: content.get("id") == 5)


@pytest.fixture(scope="module")
def pages(directory):
    found = Pages(directory)
    yield found
    found.connection.close()
    found.answering.close()


@pytest.fixture(scope="module")
def client(directory):
    found = Client(Run.open(directory))
    yield found
    found.close()


def test_requests__are_all_that_are_answered():
    assert {name for name, _ in REQUESTS} == set(ANSWERS)


@pytest.mark.parametrize(("name", "words"), REQUESTS, ids=lambda part: part if isinstance(part, str) else "")
def test_connection__answers_as_the_server_byte_for_byte(pages, client, name, words):
    posted = ANSWERS[name].method == "POST"
    query = f"?{urlencode(words)}" if words else ""
    by_server = client.ask(f"/api/{name}{query}", method="POST" if posted else "GET", body=BODY if posted else None)
    content, buffers = pages.ask(name, words, BODY if posted else None)
    assert content["status"] == by_server.code
    if by_server.code == 200:
        assert buffers == [by_server.body]
        assert content["kind"] == by_server.headers["Content-Type"]
        disposition = by_server.headers.get("Content-Disposition")
        assert disposition == (f'attachment; filename="{content["filename"]}"' if content["filename"] else None)
    else:
        assert (content["error"], buffers) == (json.loads(by_server.body)["error"], [])


def test_connection__names_and_messages_that_do_not_exist(pages):
    assert pages.ask("nonsense", {})[0]["status"] == 404
    for nothing in (None, "text", {}, {"page": 7, "ask": "view"}, {"page": "one"}, {"page": "one", "live": 3}):
        pages.connection.receive(nothing)
    pages.tell("one", live="{")
    content, _ = pages.answer("one", lambda content: "error" in str(content.get("live")))
    assert "error" in json.loads(content["live"])


def test_connection__computes_live_as_the_server(pages, client):
    """The first part of the path comes in the same bytes, the end with the same words."""
    start = json.dumps({"id": 7, "do": "start", "state": {"x": 0.3, "v": 0.1}})

    async def by_server():
        page = await websocket_connect(f"ws://127.0.0.1:{client.port}/ws?token={client.guard.token}")
        await page.write_message(start)
        parts = []
        while not parts or isinstance(parts[-1], bytes) or json.loads(parts[-1])["kind"] != "done":
            part = await page.read_message()
            if isinstance(part, bytes) or json.loads(part)["id"] == 7:
                parts.append(part)
        page.close()
        return parts

    parts = client.wait(by_server())
    pages.tell("two", open=True)
    pages.tell("two", live=start)
    _, (path,) = pages.answer("two", lambda content: content.get("live") is True)
    assert path == parts[0]
    assert unpack_arrays(path)[1]["kind"] == "path"
    content, _ = pages.answer(
        "two", lambda content: '"done"' in str(content.get("live")) and '"id": 7' in content["live"]
    )
    assert content["live"] == parts[-1]
    # a page hears of its own jobs alone
    assert {content["page"] for content in pages.dropped if "live" in content} <= {"one", "two"}
    assert not [c for c in pages.dropped if c["page"] == "one" and '"id": 7' in str(c.get("live"))]


def test_connection__a_page_that_leaves_cancels_its_jobs(directory):
    pages = Pages(directory)
    plane = {"plane": ["x", "v"], "ranges": [[-1, 1], [-1, 1]], "resolution": 512}
    pages.tell("one", open=True)
    pages.tell("one", live=json.dumps({"id": 1, "do": "slice", **plane}))
    pages.answer("one", lambda content: content.get("live") is True)
    session = pages.connection._sessions["one"]
    pages.ask("diagram", {"x": "frequency", "y": "x"})
    kept = pages.answering.run._opened
    assert kept["large"]
    pages.tell("one", close=True)
    session.join(10.0)
    assert session.is_over
    # nobody looks any more, and the notebook keeps the widget: the diagram's points are dropped
    assert "large" not in kept
    assert not [key for key in kept if "diagram" in key and not key.startswith("lock")]
    # pages that the notebook forgot do not fill the memory
    for number in range(MOST_PAGES + 2):
        pages.tell(f"page {number}", open=True)
    assert len(pages.connection._sessions) == MOST_PAGES
    pages.connection.close()
    assert not pages.connection._sessions
    n_sent = pages.sent.qsize()
    pages.tell("one", id=1, ask="view", words={})
    assert pages.sent.qsize() == n_sent
    pages.answering.close()


def test_widget__a_closed_comm_cancels_its_jobs(widget):
    """Marimo closes the comm of a cell that runs again before the page can say that it leaves."""
    plane = {"plane": ["x", "v"], "ranges": [[-1, 1], [-1, 1]], "resolution": 512}
    widget._connection.receive({"page": "one", "open": True})
    session = widget._connection._sessions["one"]
    widget.comm.close()
    widget._connection.receive({"page": "one", "live": json.dumps({"id": 1, "do": "slice", **plane})})
    session.join(PATIENCE_S)
    assert session.is_over


# ---- what is selected


@pytest.fixture
def widget(directory):
    found = explorer(directory)
    yield found
    found.close()


def test_selected__is_of_the_cube_and_shown_in_the_page(widget, directory):
    seen = []
    widget.observe(lambda change: seen.append(change["new"]), "selected")
    widget.selected = {"cell": 2}
    cube = Run.open(directory).cube().load()
    one = cube.isel(x_0=2)
    section = one["section"].transpose("period_index", "state").values
    found = widget.selected
    assert (found["cell"], found["point"]) == (2, len(section) - 1)
    assert found["state"] == {"x": section[-1, 0], "v": section[-1, 1]}
    assert found["start"] == {"x": float(one["x_0"]), "v": 0.1}
    assert found["period"] == int(one["orbit_period"])
    assert widget.view == "point=2,11"
    assert len(seen) == 1
    # the page selects, and keeps the rest of its view
    widget.view = "y=v&point=1,4"
    assert (widget.selected["cell"], widget.selected["point"]) == (1, 4)
    widget.selected = {"cell": 3, "point": 0}
    assert widget.view == "y=v&point=3,0"
    widget.selected = None
    assert (widget.view, len(seen)) == ("y=v", 4)
    # what the run does not have selects nothing
    widget.view = "point=99,0"
    assert widget.selected is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cell": 99}, "cell"),
        ({"cell": 1, "point": 12}, "sections 0 to 11"),
        ({"cell": "1"}, '{"cell": 12}'),
        ({}, "give it as"),
    ],
)
def test_selected__what_does_not_exist_is_refused(widget, given, said):
    widget.selected = {"cell": 1}
    with pytest.raises(Exception, match="selected") as caught:
        widget.selected = given
    assert said in str(caught.value)
    assert widget.selected["cell"] == 1


def test_orbit__closes_and_begins_at_the_selected_point(widget):
    assert widget.orbit() is None
    widget.selected = {"cell": 1, "point": 4}
    orbit, state = widget.orbit(), widget.selected["state"]
    assert (orbit["x"].values[0], orbit["v"].values[0]) == (state["x"], state["v"])
    # sections of the run are closed orbits to its tolerance
    np.testing.assert_allclose([orbit["x"][-1] - orbit["x"][0], orbit["v"][-1] - orbit["v"][0]], 0.0, atol=1e-4)
    seconds = widget.selected["period"] / widget.selected["frequency"]
    np.testing.assert_allclose(orbit["time"].values[-1], seconds, rtol=1e-12)


def test_explore__is_a_method_of_a_run(directory):
    found = magpend.Run.open(directory).explore(height=400)
    found.selected = {"cell": 1}
    assert (found.height, found.selected["cell"]) == (400, 1)
    found.close()


def test_explorer__says_what_is_missing(directory, monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "pipeline.explorer.notebook.widget", raising=False)
    with pytest.raises(SpecError, match=r"pip install 'magpend\[notebook\]'"):
        explorer(directory)
    with pytest.raises(SpecError, match="height = 100: must be 320 pixels or more"):
        explorer(directory, height=100)


def test_explorer__a_script_that_shows_nothing_starts_nothing(directory):
    """The widget of a script without a page ends with it, and says nothing."""
    code = f"from magpend import explorer; w = explorer({str(directory)!r}); w.selected = {{'cell': 1}}"
    paths = os.pathsep.join([str(ROOT), str(ROOT / "pipeline" / "face"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
        env={**os.environ, "PYTHONPATH": paths.rstrip(os.pathsep)},
    )
    assert (done.stdout, done.stderr) == ("", "")
