"""The same answers and the same live computation by each transport: the server's addresses, its socket, a notebook."""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import socket
import threading
import time
from urllib.parse import urlencode

import pytest

from pipeline.explorer import server as sockets
from pipeline.explorer.answers import ANSWERS, Answering
from pipeline.explorer.connection import MOST_PAGES, Connection
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.diagram import diagram
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import orbit
from pipeline.explorer.data.overlays import attractors
from pipeline.explorer.live.messages import MOST_BYTES
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.conftest import PATIENCE_S

REGION = {"x": [-0.9, 0.5], "axes": ["x_0", None]}
DIAGRAM = {"x": "frequency", "y": "x"}

ANSWERED = [
    ("view", {}, None),
    ("diagram", DIAGRAM, None),
    ("curves", {"x": "frequency"}, None),
    ("events", {"x": "frequency"}, None),
    ("branches", DIAGRAM, None),
    ("attractors", {}, None),
    ("disturbances", {}, None),
    ("orbit", {"cell": "1", "point": "4"}, None),
    ("plane", {}, None),
    ("parameter-plane", {}, None),
    ("table", {"view": "diagram", **DIAGRAM, "format": "csv"}, None),
    ("zoom", {}, REGION),
]
REFUSED = [
    ("diagram", {}, None, "x is missing"),
    ("diagram", {**DIAGRAM, "y": "y"}, None, "unknown vertical axis 'y'"),
    ("orbit", {"cell": "99", "point": "0"}, None, "cells 0 to"),
    ("orbit", {"cell": "1", "point": "12"}, None, "sections 0 to 11"),
    *(("orbit", {"cell": n, "point": "0"}, None, "whole number") for n in ("-1", "1.0", "", "٣", "1" * 20, "1e3")),
    ("event-orbit", {"x": "frequency", "event": "0"}, None, "no orbit is located there"),
    ("curve-orbit", {"curve": "0", "point": "0"}, None, "there are 0 curves"),
    ("table", {"view": "__class__"}, None, "unknown view"),
    ("table", {"view": "diagram", **DIAGRAM, "format": "../x"}, None, "unknown format"),
    ("table", {"view": "orbit"}, None, "cell is missing"),
    *(("zoom", {}, body, said) for body, said in (
        (None, "JSON"),
        ([], "object"),
        ({**REGION, "x": [2.6, 2.2]}, "empty"),
        ({"x": [float("nan"), 1]}, "x"),
        ({"x": [1, 2], "more": 1}, "more"),
        ({**REGION, "at": {"nonsense": 1}}, "unknown axis 'nonsense'"),
    )),
    # an axis that the run does not have, whatever is asked
    *((name, {**words, "at.nonsense": "0"}, None, "nonsense") for name, words, body in ANSWERED if body is None and (
        name not in ("branches", "disturbances", "parameter-plane")
    )),
]  # fmt: skip


class Notebook:
    """A connection of a widget, and what it sends."""

    def __init__(self, directory):
        self.sent = queue.Queue()
        self.answering = Answering(RunDirectory.open(directory))
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

    def close(self):
        self.connection.close()
        self.answering.close()


@pytest.fixture(scope="module")
def notebook(little):
    found = Notebook(little)
    yield found
    found.close()


@pytest.fixture
def ask(notebook, client):
    """Ask both for the same: they say it in the same bytes; returns status, content and file name."""

    def both(name, words, body):
        method = ANSWERS[name].method
        text = None if method == "GET" else "" if body is None else json.dumps(body)
        by_server = client.ask(f"/api/{name}?{urlencode(words)}", method=method, body=text)
        content, buffers = notebook.ask(name, words, text)
        assert content["status"] == by_server.code
        if by_server.code != 200:
            assert (content["error"], buffers) == (json.loads(by_server.body)["error"], [])
            return by_server.code, content["error"], None
        assert buffers == [by_server.body]
        assert content["kind"] == by_server.headers["Content-Type"]
        disposition = by_server.headers.get("Content-Disposition")
        assert disposition == (f'attachment; filename="{content["filename"]}"' if content["filename"] else None)
        return 200, by_server.body, content["filename"]

    return both


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words", "body"), ANSWERED, ids=lambda part: part if isinstance(part, str) else "")
def test_answers__are_the_same_bytes(ask, name, words, body):
    code, content, filename = ask(name, words, body)
    assert code == 200
    assert content
    assert (filename == "diagram.csv") == (name == "table")


@pytest.mark.parametrize(("name", "words", "body", "said"), REFUSED, ids=lambda part: str(part)[:30])
def test_answers__refuse_in_the_same_sentence(ask, name, words, body, said):
    code, sentence, _ = ask(name, words, body)
    assert code == 400
    assert said in sentence
    assert "Traceback" not in sentence


@pytest.mark.slow
def test_answers__are_those_of_the_run(ask, little):
    explored = ExploredRun.open(little)
    assert ask("diagram", DIAGRAM, None)[1] == diagram(explored, "frequency", "x", {})
    assert ask("attractors", {}, None)[1] == json.dumps(attractors(explored, {})).encode()
    assert ask("orbit", {"cell": "2", "point": "3"}, None)[1] == orbit(explored, 2, 3)


def test_answers__are_all_asked_for():
    assert {name for name, *_ in (*ANSWERED, *REFUSED)} == set(ANSWERS)


def test_connection__names_and_messages_that_do_not_exist(notebook):
    assert notebook.ask("nonsense", {})[0]["status"] == 404
    for nothing in (None, "text", {}, {"page": 7, "ask": "view"}, {"page": "one"}, {"page": "one", "live": 3}):
        notebook.connection.receive(nothing)
    notebook.tell("one", live="{")
    content, _ = notebook.answer("one", lambda content: "error" in str(content.get("live")))
    assert "error" in json.loads(content["live"])


# ---- live computation

START = json.dumps({"id": 7, "do": "start", "state": {"x": 0.3, "v": 0.1}})
LONG = json.dumps({"id": 1, "do": "slice", "plane": ["x", "v"], "ranges": [[-1, 1], [-1, 1]], "resolution": 512})


async def answer_to(page, number, *kinds):
    """The first answer to a message of one of some kinds, as it came and as read; all before it are dropped."""
    while True:
        came = await page.read_message()
        assert came is not None, "the connection was closed"
        told = unpack_arrays(came)[1] if isinstance(came, bytes) else json.loads(came)
        if told["id"] == number and told["kind"] in kinds:
            return came, told


async def until(true):
    while not true():
        await asyncio.sleep(0.01)


@pytest.mark.slow
def test_live__is_computed_alike(notebook, client):
    """The first part of the path comes in the same bytes, the end with the same words."""

    async def by_server():
        page = await client.page()
        await page.write_message(START)
        return await answer_to(page, 7, "path"), await answer_to(page, 7, "done", "error")

    (path, told), (end, ended) = client.talk(by_server())
    assert (told["kind"], ended["kind"], ended["status"]) == ("path", "done", "periodic")
    notebook.tell("two", open=True)
    notebook.tell("two", live=START)
    assert notebook.answer("two", lambda content: content.get("live") is True)[1] == [path]
    own = notebook.answer("two", lambda c: '"done"' in str(c.get("live")) and '"id": 7' in c["live"])[0]
    assert own["live"] == end
    # a page hears of its own jobs alone
    assert {content["page"] for content in notebook.dropped if "live" in content} <= {"one", "two"}
    assert not [c for c in notebook.dropped if c["page"] == "one" and '"id": 7' in str(c.get("live"))]


def test_socket__outlives_hostile_messages(client):
    async def conversation():
        page, other = await client.page(), await client.page()
        for text in ("", "{", "[" * 60_000, '{"id": 1, "do": "delete"}'):
            await page.write_message(text)
            assert "error" in (await answer_to(page, 1 if "delete" in text else None, "error"))[1]
        await page.write_message(b"\x00\xff", binary=True)
        assert await answer_to(page, None, "error")
        # what is far too long ends that page's connection, and no other
        await page.write_message("x" * (MOST_BYTES + 100))
        while await page.read_message() is not None:
            pass
        await other.write_message(START)
        assert (await answer_to(other, 7, "done", "error"))[1]["kind"] == "done"

    client.talk(conversation())


def test_socket__bounds_rate_and_number_of_pages(client, monkeypatch):
    monkeypatch.setattr(sockets, "MOST_CONNECTIONS", 2)
    monkeypatch.setattr(sockets, "MOST_PER_SECOND", 1.0)

    async def conversation():
        first, second = await client.page(), await client.page()
        await until(lambda: len(client.pages) == 2)
        assert (await asyncio.to_thread(client.ask, "/ws")).code == 503
        for i in range(300):
            await first.write_message(json.dumps({"id": i, "do": "cancel", "job": 0}))
        # the last is answered by its number, as one too many
        assert "too many" in (await answer_to(first, 299, "done", "error"))[1]["error"]
        await second.write_message(START)
        assert (await answer_to(second, 7, "done", "error"))[1]["kind"] == "done"

    client.talk(conversation())


def test_socket__refuses_axes_that_the_run_does_not_have(client):
    async def conversation():
        page = await client.page()
        region = {"do": "run", "x": [0.0, 1.0], "axes": None}
        for number, (key, value) in enumerate((("at", {"nonsense": 0}), ("axes", ["x_0", "nonsense"]))):
            await page.write_message(json.dumps({**region, key: value, "id": number}))
            assert "nonsense" in (await answer_to(page, number, "done", "error"))[1]["error"]

    client.talk(conversation())


def test_socket__a_page_that_answers_no_ping_is_left(client):
    """Half open: the page's process is suspended, or gone without a word."""
    client.web.settings["websocket_ping_interval"] = 0.2
    address = f"/ws?token={client.guard.token}"
    said = (
        f"GET {address} HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\nOrigin: http://127.0.0.1:{client.port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MTIz\r\n\r\n"
    )
    assert b"101 Switching" in client.raw(said.encode())  # which reads until the server closes
    client.talk(until(lambda: not client.pages))


def test_api__a_client_that_takes_no_answer_is_left(client, monkeypatch):
    monkeypatch.setattr(sockets, "MOST_SILENCE_S", 0.2)
    monkeypatch.setattr(client.service, "static", {"explorer.js": (bytes(2**26), "text/javascript")})
    said = f"GET /static/explorer.js HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", client.port), timeout=60) as one:
        one.sendall(said.encode())
        time.sleep(1.0)
        found = 0
        with contextlib.suppress(ConnectionError):
            while chunk := one.recv(2**20):
                found += len(chunk)
    assert 0 < found < 2**26


def test_socket__a_page_that_leaves_cancels_its_jobs(client):
    async def conversation():
        page = await client.page()
        await page.write_message(LONG)
        await answer_to(page, 1, "slice")
        (handler,) = client.pages
        page.close()
        await until(lambda: not client.pages)
        await asyncio.to_thread(handler._session.join, 10.0)
        assert all(desk._thread is None for desk in handler._session._desks.values())
        assert not any(t.name.startswith("magpend-desk") and t.is_alive() for t in threading.enumerate())

    client.talk(conversation())


@pytest.mark.slow
def test_connection__a_page_that_leaves_cancels_its_jobs(little):
    notebook = Notebook(little)
    notebook.tell("one", open=True)
    notebook.tell("one", live=LONG)
    notebook.answer("one", lambda content: content.get("live") is True)
    session = notebook.connection._sessions["one"]
    notebook.ask("diagram", DIAGRAM)
    kept = notebook.answering.run._opened
    assert kept["large"]
    notebook.tell("one", close=True)
    session.join(10.0)
    assert session.is_over
    # nobody looks any more, and the notebook keeps the widget: the diagram's points are dropped
    assert "large" not in kept
    assert not [key for key in kept if "diagram" in key and not key.startswith("lock")]
    # pages that the notebook forgot do not fill the memory
    for number in range(MOST_PAGES + 2):
        notebook.tell(f"page {number}", open=True)
    assert len(notebook.connection._sessions) == MOST_PAGES
    notebook.connection.close()
    assert not notebook.connection._sessions
    n_sent = notebook.sent.qsize()
    notebook.tell("one", id=1, ask="view", words={})
    assert notebook.sent.qsize() == n_sent
    notebook.close()
