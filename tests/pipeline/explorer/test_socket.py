"""The live connection as a page sees it: who may connect, what is answered, and that nothing ends the server."""

from __future__ import annotations

import asyncio
import json

import pytest
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application
from tornado.websocket import WebSocketClosedError, websocket_connect

from pipeline.explorer import socket as sockets
from pipeline.explorer.arrays import unpack_arrays
from pipeline.explorer.live import LiveRun
from pipeline.explorer.messages import MOST_BYTES
from pipeline.runs.run import run
from pipeline.store.run import Run

SPEC = """
kind = "sweep"
model = "duffing5"
[parameters]
frequency_hz = 0.15915494309189535
[initial_conditions]
kind = "grid"
x = { start = -0.9375, stop = 0.9375, num = 4 }
v = 0.1
[integration]
rtol = 1e-7
atol = 1e-7
n_transient = 120
n_keep = 12
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("socket")
    (folder / "spec.toml").write_text(SPEC)
    run(folder / "spec.toml", folder / "run", workers=0, echo=lambda _: None)
    return folder / "run"


@pytest.fixture
def talk(directory):
    """Run a conversation with a server on loopback."""

    def begin(conversation):
        async def whole():
            live = LiveRun(Run.open(directory))
            routes = sockets.socket_routes(live, lambda handler: handler.get_argument("token", "") == "right")
            (listening,) = bind_sockets(0, "127.0.0.1")
            server = HTTPServer(Application(routes, log_function=lambda handler: None))
            server.add_sockets([listening])
            address = f"ws://127.0.0.1:{listening.getsockname()[1]}/ws"
            try:
                await asyncio.wait_for(conversation(address, routes[0][2]["others"]), 120.0)
            finally:
                server.stop()
                await server.close_all_connections()
                live.close()

        asyncio.run(whole())

    return begin


async def answer_to(connection, number, *kinds):
    """The first answer to a message of one of some kinds; all before it are dropped."""
    while True:
        told = await connection.read_message()
        assert told is not None, "the connection was closed"
        told = unpack_arrays(told)[1] if isinstance(told, bytes) else json.loads(told)
        if told["id"] == number and told["kind"] in kinds:
            return told


START = {"id": 7, "do": "start", "state": {"x": 0.3, "v": 0.1}}


def test_socket__a_start_from_end_to_end(talk):
    async def conversation(address, others):
        page = await websocket_connect(f"{address}?token=right")
        await page.write_message(json.dumps(START))
        path = await answer_to(page, 7, "path")
        assert path["kind"] == "path"
        end = await answer_to(page, 7, "done", "error")
        assert (end["kind"], end["status"]) == ("done", "periodic")
        page.close()
        while others:  # the server notices that the page has gone
            await asyncio.sleep(0.01)

    talk(conversation)


@pytest.mark.parametrize(
    ("query", "headers"),
    [
        ("", {}),
        ("?token=wrong", {}),
        ("?token=right", {"Origin": "http://evil.example"}),
        ("?token=right", {"Origin": "null"}),
    ],
)
def test_socket__refuses_strangers_before_they_are_connected(talk, query, headers):
    async def conversation(address, others):
        with pytest.raises(HTTPClientError) as caught:
            await websocket_connect(HTTPRequest(address + query, headers=headers))
        assert caught.value.code == 403
        assert not others

    talk(conversation)


def test_socket__outlives_hostile_messages(talk):
    async def conversation(address, others):
        page = await websocket_connect(f"{address}?token=right")
        for text in ("", "{", "[" * 60_000, '{"id": 1, "do": "delete"}'):
            await page.write_message(text)
            assert "error" in await answer_to(page, 1 if "delete" in text else None, "error")
        await page.write_message(b"\x00\xff", binary=True)
        assert await answer_to(page, None, "error")
        # what is far too long ends that page's connection, and no other
        other = await websocket_connect(f"{address}?token=right")
        await page.write_message("x" * (MOST_BYTES + 100))
        with pytest.raises((AssertionError, WebSocketClosedError)):
            while True:
                await answer_to(page, 999, "done")
        await other.write_message(json.dumps(START))
        assert (await answer_to(other, 7, "done", "error"))["kind"] == "done"

    talk(conversation)


def test_socket__bounds_rate_and_number_of_pages(talk, monkeypatch):
    monkeypatch.setattr(sockets, "MOST_CONNECTIONS", 2)

    async def conversation(address, others):
        pages = [await websocket_connect(f"{address}?token=right") for _ in range(2)]
        while len(others) < 2:
            await asyncio.sleep(0.01)
        with pytest.raises(HTTPClientError) as caught:
            await websocket_connect(f"{address}?token=right")
        assert caught.value.code == 503
        for i in range(300):
            await pages[0].write_message(json.dumps({"id": i, "do": "cancel", "job": 0}))
        while "too many" not in (await answer_to(pages[0], None, "error"))["error"]:
            pass
        await pages[1].write_message(json.dumps(START))
        assert (await answer_to(pages[1], 7, "done", "error"))["kind"] == "done"

    talk(conversation)


def test_socket__a_page_that_leaves_cancels_its_jobs(talk):
    async def conversation(address, others):
        page = await websocket_connect(f"{address}?token=right")
        plane = {"plane": ["x", "v"], "ranges": [[-1, 1], [-1, 1]], "resolution": 512}
        await page.write_message(json.dumps({"id": 1, "do": "slice", **plane}))
        await answer_to(page, 1, "slice")
        (handler,) = others
        page.close()
        while others:
            await asyncio.sleep(0.01)
        await asyncio.to_thread(handler._session.join, 10.0)
        assert all(desk._thread is None for desk in handler._session._desks.values())

    talk(conversation)
