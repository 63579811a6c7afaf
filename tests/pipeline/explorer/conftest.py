"""Runs that the explorer's tests look at, each computed once, and a server and a session that answer of them."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from tornado.httpclient import HTTPRequest
from tornado.httpserver import HTTPServer
from tornado.simple_httpclient import SimpleAsyncHTTPClient
from tornado.websocket import websocket_connect

from pipeline.explorer import server
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.session import LiveSession
from pipeline.explorer.security import Guard, Rate, new_token
from pipeline.explorer.server import Service, application, listening
from pipeline.runs.derive import derive
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.small_runs import LITTLE, bent_resonance, charted_plane, shocked_wells
from tests.pipeline.factories import finished

PATIENCE_S = 120.0
"""How long a test waits for what must come, on the busiest machine [s]."""


@pytest.fixture(scope="session")
def little(tmp_path_factory):
    """Directory of a run of four cells with its attractors."""
    directory = finished(tmp_path_factory.mktemp("little"), LITTLE)
    derive(directory, "attractors", {})
    return directory


@pytest.fixture(scope="session")
def wells(tmp_path_factory):
    """Directory of the run of two wells with critical shocks and an edge state."""
    return shocked_wells(tmp_path_factory.mktemp("wells"))


@pytest.fixture(scope="session")
def bent(tmp_path_factory):
    """Directories of a run along the frequency with curves, and of one over the plane."""
    return bent_resonance(tmp_path_factory.mktemp("bent-resonance"))


@pytest.fixture(scope="session")
def plane_with_atlas(tmp_path_factory):
    """Directory of a run over a plane with its atlas."""
    return charted_plane(tmp_path_factory.mktemp("plane-with-atlas"))


class Client:
    """A server in a thread of its own, and requests to it."""

    def __init__(self, run):
        self.socket = listening(0)
        self.port = self.socket.getsockname()[1]
        self.guard = Guard(new_token(), self.port)
        self.service = Service(run, self.guard)
        self.loop, self._opened = asyncio.new_event_loop(), []
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        assert self._ready.wait(PATIENCE_S)

    def _serve(self):
        asyncio.set_event_loop(self.loop)

        async def begin():
            served = self.web = application(self.service)
            routes = (rule.target_kwargs for rule in served.wildcard_router.rules)
            self.pages = next((given["others"] for given in routes if "others" in given), set())
            self.server = HTTPServer(served, **server.LIMITS)
            self.server.add_socket(self.socket)
            self._ready.set()

        self.loop.create_task(begin())
        self.loop.run_forever()

    def wait(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(PATIENCE_S)

    def ask(self, path, *, token=True, headers=None, method="GET", body=None):
        """Status, headers and body of an answer."""
        sent = {"Authorization": f"token {self.guard.token}"} if token else {}

        async def fetch():
            client = SimpleAsyncHTTPClient(force_instance=True)
            request = HTTPRequest(
                f"http://127.0.0.1:{self.port}{path}",
                method=method,
                headers={**sent, **(headers or {})},
                body=body,
                follow_redirects=False,
                allow_nonstandard_methods=True,
                request_timeout=60,
            )
            try:
                return await client.fetch(request, raise_error=False)
            finally:
                client.close()

        answer = self.wait(fetch())
        return SimpleNamespace(code=answer.code, headers=answer.headers, body=answer.body or b"")

    async def page(self):
        """Open the websocket as this server's own page does."""
        headers = {"Origin": f"http://127.0.0.1:{self.port}"}
        address = f"ws://127.0.0.1:{self.port}/ws?token={self.guard.token}"
        page = await websocket_connect(HTTPRequest(address, headers=headers))
        self._opened.append((page, page.protocol.stream))
        return page

    def talk(self, conversation):
        """Wait for a conversation by websockets, and close what it has opened."""

        async def leave():
            for page, stream in self._opened:
                page.close()
                stream.close()
            self._opened.clear()
            while self.pages:  # the server notices that the pages have gone
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.05)  # the last callbacks close what is left

        try:
            return self.wait(conversation)
        finally:
            self.wait(leave())

    def raw(self, text):
        """What comes back to bytes that no client would send."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as one:
            one.sendall(text)
            one.settimeout(60)
            found = b""
            while chunk := one.recv(65536):
                found += chunk
        return found

    def close(self):
        async def end():
            self.server.stop()
            await self.server.close_all_connections()
            self.loop.stop()

        asyncio.run_coroutine_threadsafe(end(), self.loop)
        self._thread.join(30)
        self.loop.close()
        self.service.answering.close()
        self.service.answering.pool.shutdown(wait=True)


@pytest.fixture(scope="module")
def client(little):
    """A server of the run of four cells, which answers as often as it is asked."""
    found = Client(RunDirectory.open(little))
    found.service.rate = found.service.strangers = found.service.files = Rate(1e6, 1_000_000)
    yield found
    found.close()


class Watcher:
    """A session, and what it has answered."""

    def __init__(self, live):
        self.answers, self._news = [], threading.Condition()
        self.session = LiveSession(live, self._take)
        self._next = 100

    def _take(self, answer):
        if isinstance(answer, bytes):
            arrays, attrs = unpack_arrays(answer)
            answer = {**attrs, "arrays": arrays}
        else:
            json.dumps(answer, allow_nan=False)
        with self._news:
            self.answers.append(answer)
            self._news.notify_all()

    def send(self, **message):
        self._next += 1
        self.session.receive(json.dumps({"id": self._next, **message}))
        return self._next

    def of(self, number):
        return [a for a in list(self.answers) if a["id"] == number]

    def wait(self, number, *kinds):
        """The first answer to a message of one of some kinds."""
        kinds = kinds or ("done", "error")

        def found():
            return next((a for a in self.of(number) if a["kind"] in kinds), None)

        with self._news:
            assert self._news.wait_for(found, PATIENCE_S), f"no answer: {self.of(number)}"
            return found()

    def ask(self, *kinds, **message):
        return self.wait(self.send(**message), *kinds)

    def sections(self, number):
        """All section points that were told of a start."""
        pieces = [a["arrays"]["section"] for a in self.of(number) if a["kind"] == "sections"]
        return np.concatenate(pieces) if pieces else None


@pytest.fixture
def watch():
    """Open sessions; they are closed at the end."""
    opened = []

    def begin(source):
        live = source if isinstance(source, LiveRun) else LiveRun(RunDirectory.open(source))
        watcher = Watcher(live)
        opened.append((watcher, live))
        return watcher

    yield begin
    for watcher, live in opened:
        watcher.session.close()
        watcher.session.join()
        live.close()
