"""The live connection as a page sees it: who may connect, what is answered, that nothing ends the server."""

from __future__ import annotations

import asyncio
import json

import pytest
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application
from tornado.websocket import websocket_connect

from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.messages import MOST_BYTES
from pipeline.explorer.serving import socket as sockets
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


class Pages:
    """Opens connections to a server, and closes them at the end."""

    def __init__(self, port, others):
        self._port, self.others, self._opened = port, others, []

    async def open(self):
        page = await websocket_connect(f"ws://127.0.0.1:{self._port}/ws?token=right")
        self._opened.append((page, page.protocol.stream))
        return page

    async def refusal(self, query="?token=right", **headers):
        """Status with which a connection is refused."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
        own = {
            "Host": f"127.0.0.1:{self._port}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version": "13",
            **headers,
        }
        lines = [f"GET /ws{query} HTTP/1.1", *(f"{k}: {v}" for k, v in own.items()), "", ""]
        writer.write("\r\n".join(lines).encode())
        status = await reader.readline()
        writer.close()
        await writer.wait_closed()
        return int(status.split()[1])

    async def close(self):
        for page, stream in self._opened:
            page.close()
            stream.close()
        await asyncio.sleep(0.05)  # the last callbacks close what is left


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
            pages = Pages(listening.getsockname()[1], routes[0][2]["others"])
            try:
                await asyncio.wait_for(conversation(pages), 120.0)
            finally:
                await pages.close()
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
    async def conversation(pages):
        page = await pages.open()
        await page.write_message(json.dumps(START))
        path = await answer_to(page, 7, "path")
        assert path["kind"] == "path"
        end = await answer_to(page, 7, "done", "error")
        assert (end["kind"], end["status"]) == ("done", "periodic")
        page.close()
        while pages.others:  # the server notices that the page has gone
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
    async def conversation(pages):
        assert await pages.refusal(query, **headers) == 403
        assert not pages.others

    talk(conversation)


def test_socket__outlives_hostile_messages(talk):
    async def conversation(pages):
        page = await pages.open()
        for text in ("", "{", "[" * 60_000, '{"id": 1, "do": "delete"}'):
            await page.write_message(text)
            assert "error" in await answer_to(page, 1 if "delete" in text else None, "error")
        await page.write_message(b"\x00\xff", binary=True)
        assert await answer_to(page, None, "error")
        # what is far too long ends that page's connection, and no other
        other = await pages.open()
        await page.write_message("x" * (MOST_BYTES + 100))
        while await page.read_message() is not None:
            pass
        await other.write_message(json.dumps(START))
        assert (await answer_to(other, 7, "done", "error"))["kind"] == "done"

    talk(conversation)


def test_socket__bounds_rate_and_number_of_pages(talk, monkeypatch):
    monkeypatch.setattr(sockets, "MOST_CONNECTIONS", 2)
    monkeypatch.setattr(sockets, "MOST_PER_SECOND", 1.0)

    async def conversation(pages):
        first, second = await pages.open(), await pages.open()
        while len(pages.others) < 2:
            await asyncio.sleep(0.01)
        assert await pages.refusal() == 503
        for i in range(300):
            await first.write_message(json.dumps({"id": i, "do": "cancel", "job": 0}))
        # the last is answered by its number, as one too many
        assert "too many" in (await answer_to(first, 299, "done", "error"))["error"]
        await second.write_message(json.dumps(START))
        assert (await answer_to(second, 7, "done", "error"))["kind"] == "done"

    talk(conversation)


def test_socket__a_page_that_leaves_cancels_its_jobs(talk):
    async def conversation(pages):
        page = await pages.open()
        plane = {"plane": ["x", "v"], "ranges": [[-1, 1], [-1, 1]], "resolution": 512}
        await page.write_message(json.dumps({"id": 1, "do": "slice", **plane}))
        await answer_to(page, 1, "slice")
        (handler,) = pages.others
        page.close()
        while pages.others:
            await asyncio.sleep(0.01)
        await asyncio.to_thread(handler._session.join, 10.0)
        assert all(desk._thread is None for desk in handler._session._desks.values())

    talk(conversation)
