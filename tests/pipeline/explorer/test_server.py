"""The explorer's server: who is answered, with what, and how it ends."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from tornado.httpclient import HTTPRequest
from tornado.httpserver import HTTPServer
from tornado.simple_httpclient import SimpleAsyncHTTPClient
from tornado.websocket import websocket_connect

from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.serving import answering, browser, page_html, server
from pipeline.explorer.serving.answers import ANSWERS
from pipeline.explorer.serving.security import Guard, Rate, content_policy, new_token
from pipeline.explorer.serving.server import Service, application, listening
from pipeline.layout.identity import identity_of
from pipeline.layout.plan import make_plan
from pipeline.specification.parsing import load_spec
from pipeline.specification.problems import SpecError
from pipeline.store.commits import write_task
from pipeline.store.run import Run
from pipeline.store.setup import create

# as in test_view.py, which computes it for most of what is read here
TITLE = "</title><script>alert(1)</script>"


class Client:
    """A server in a thread of its own, and requests to it."""

    def __init__(self, run):
        self.socket = listening(0)
        self.port = self.socket.getsockname()[1]
        self.guard = Guard(new_token(), self.port)
        self.service = Service(run, self.guard)
        self.loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        assert self._ready.wait(120)

    def _serve(self):
        asyncio.set_event_loop(self.loop)

        async def begin():
            self.server = HTTPServer(application(self.service), **server.LIMITS)
            self.server.add_socket(self.socket)
            self._ready.set()

        self.loop.create_task(begin())
        self.loop.run_forever()

    def wait(self, coroutine, timeout=120):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(timeout)

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


SWEEP = """
kind = "sweep"
title = "small sweep"
[axes]
frequency_hz = { start = 2.0, stop = 3.0, num = 5 }
q = { values = [1.5, 1.6] }
[initial_conditions]
kind = "grid"
psi1_deg = { start = -30, stop = 30, num = 3 }
psi2_deg = { start = -20, stop = 20, num = 4 }
[integration]
n_transient = 2
n_keep = 3
[execution]
trajectories_per_task = 60
"""


def finished(folder):
    """A finished run of made-up numbers: what is asked here is who is answered."""
    (folder / "spec.toml").write_text(SWEEP, "utf-8")
    spec = load_spec(folder / "spec.toml")
    plan = make_plan(spec)
    info = create(folder / "run", spec, plan, identity_of(spec, plan, "test-kernel"), SWEEP)
    rng = np.random.default_rng(1)
    for task in range(plan.n_tasks):
        shape = tuple(s.stop - s.start for s in plan.task(task))
        values = {
            v.name: rng.uniform(1, 5, (*shape, *(plan.sizes[d] for d in v.own_dims))).astype(v.dtype)
            for v in plan.variables
        }
        values["status"][...] = 2
        write_task(info, plan, task, values, {"bounded": plan.cells_in(task)})
    return info.directory


@pytest.fixture
def made_run(tmp_path):
    return finished(tmp_path)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    found = Client(Run.open(finished(tmp_path_factory.mktemp("served"))))
    found.service.rate = found.service.strangers = found.service.files = Rate(1e6, 1_000_000)
    yield found
    found.close()


def sentence(answer):
    return json.loads(answer.body)["error"]


# ---- what is answered


def test_api__answers_with_the_token(client):
    view = client.ask("/api/view")
    assert view.code == 200
    found = json.loads(view.body)
    assert found["title"] == "small sweep"
    diagram = client.ask("/api/diagram?x=frequency&y=psi1&at.q=1")
    assert diagram.code == 200
    arrays, attrs = unpack_arrays(diagram.body)
    assert attrs["at"] == {"q": 1}
    assert len(arrays["y"]) == 5 * 12 * 3
    download = client.ask("/api/table?view=diagram&format=csv&x=frequency&y=psi1&at.q=1")
    assert download.headers["Content-Disposition"] == 'attachment; filename="diagram.csv"'
    assert b"frequency [Hz]" in download.body


def test_api__every_answer_has_the_policy(client):
    """The page, an answer, a refusal and a place that is not there."""
    for path, token in (("/", False), ("/api/view", True), ("/api/view", False), ("/nowhere", True)):
        headers = client.ask(path, token=token).headers
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "script-src 'self';" in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["Cache-Control"] == "no-store"
        assert "Access-Control-Allow-Origin" not in headers
        assert "Set-Cookie" not in headers


@pytest.mark.parametrize(
    "path",
    [
        "/api/view",
        "/api/diagram?x=frequency&y=psi1&at.q=0",
        "/api/orbit?cell=0&point=0",
        "/api/table",
        "/",
        "/api/zoom",
    ],
)
@pytest.mark.parametrize("given", ["", "wrong", "token wrong"])
def test_api__is_refused_without_the_token(client, path, given):
    headers = {"Authorization": given} if given else {}
    answer = client.ask(path, token=False, headers=headers)
    assert answer.code == 403
    assert client.guard.token.encode() not in answer.body
    assert b"token" in answer.body


def test_api__takes_the_token_as_an_argument(client):
    assert client.ask(f"/api/view?token={client.guard.token}", token=False).code == 200
    assert client.ask(f"/api/view?token={client.guard.token[:-1]}", token=False).code == 403
    assert client.ask("/api/view?token=%ff%fe", token=False).code in (400, 403)


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:8888"},
        {"Host": "127.0.0.1"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
@pytest.mark.parametrize("path", ["/api/view", "/static/explorer.js", "/ws"])
def test_api__refuses_other_pages_and_names(client, path, headers):
    """With the right token, too: a name that points here, or a page of another port, is no reason."""
    answer = client.ask(path, headers=headers)
    assert answer.code == 403


def test_api__this_page_is_answered(client):
    own = {"Origin": f"http://127.0.0.1:{client.port}", "Sec-Fetch-Site": "same-origin"}
    assert client.ask("/api/view", headers=own).code == 200
    named = {"Host": f"localhost:{client.port}", "Origin": f"http://localhost:{client.port}"}
    assert client.ask("/api/view", headers=named).code == 200


@pytest.mark.parametrize(
    ("path", "code", "said"),
    [
        ("/api/diagram", 400, "x is missing"),
        ("/api/diagram?x=frequency&y=psi1&at.q=7", 400, "must be 0 to 1"),
        ("/api/diagram?x=frequency&y=psi1&at.q=-1", 400, "whole number"),
        ("/api/diagram?x=frequency&y=psi9&at.q=0", 400, "did you mean"),
        ("/api/orbit?cell=99999999&point=0", 400, "cells 0 to"),
        ("/api/orbit?cell=1e3&point=0", 400, "whole number"),
        ("/api/plane?at.q=0", 400, "at.frequency is missing"),
        ("/api/table?view=__class__&format=csv", 400, "unknown view"),
        ("/api/table?view=diagram&format=../x", 400, "unknown format"),
        ("/api/views", 404, "no such page"),
        ("/api/zoom", 405, "POST"),
    ],
)
def test_api__refuses_in_a_sentence(client, path, code, said):
    answer = client.ask(path)
    assert answer.code == code
    assert said in sentence(answer)
    assert "Traceback" not in sentence(answer)


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        "/static/..%2fserver.py",
        "/static//etc/passwd",
        "/static/explorer.css.map",
        "/static/",
        "/static/LICENSES.txt%00.js",
        "/run.json",
        "/cube.zarr/zarr.json",
    ],
)
def test_static__serves_its_own_files_alone(client, path):
    text = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\nConnection: close\r\n\r\n"
    answer = client.raw(text.encode())
    assert re.match(rb"HTTP/1\.1 (404|400|403) ", answer)
    assert b"root:" not in answer
    assert b"def serve" not in answer


def test_static__is_what_is_installed(client):
    for name, (content, kind) in server.static_files().items():
        answer = client.ask(f"/static/{name}", token=False)
        assert (answer.code, answer.body) == (200, content)
        assert answer.headers["Content-Type"] == kind
    assert {"explorer.js", "explorer.css"} <= server.static_files().keys()


def test_page__has_the_token_and_no_script_of_its_own(client):
    answer = client.ask(f"/?token={client.guard.token}", token=False)
    assert answer.code == 200
    text = answer.body.decode()
    assert f'data-token="{client.guard.token}"' in text
    assert not re.search(r"<script(?! src=\"static/explorer\.js\">)", text)
    assert "<style" not in text
    assert " on" not in re.sub(r">[^<]*<", "><", text)


def test_page__a_title_stays_text():
    text = page_html.page(TITLE, "abc")
    assert "<script>alert" not in text
    assert "&lt;script&gt;" in text


def test_zoom__takes_a_region_and_bounded_bodies(client):
    body = json.dumps({"x": [2.2, 2.6], "axes": ["frequency", "psi1"], "at": {"q": 0}})
    answer = client.ask("/api/zoom", method="POST", body=body)
    assert answer.code == 200
    assert "frequency_hz" in answer.body.decode()
    for bad in ("", "[]", '{"x": [2.6, 2.2]}', '{"x": [NaN, 1]}', '{"x": [1, 2], "more": 1}'):
        assert client.ask("/api/zoom", method="POST", body=bad).code == 400
    head = (
        f"POST /api/zoom HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\n"
        f"Content-Length: {server.MOST_BODY + 1}\r\nAuthorization: token {client.guard.token}\r\n\r\n"
    )
    assert b" 200 " not in client.raw(head.encode())


def test_api__strangers_use_up_nothing_of_those_with_the_token(client, monkeypatch):
    monkeypatch.setattr(client.service, "rate", Rate(0.001, 3))
    monkeypatch.setattr(client.service, "files", Rate(0.001, 1))
    monkeypatch.setattr(client.service, "strangers", Rate(0.001, 2))
    wrong = {"Authorization": "token wrong"}
    codes = [client.ask("/api/view", token=False, headers=wrong).code for _ in range(3)]
    assert codes == [403, 403, 429]
    assert client.ask("/static/explorer.css", token=False).code == 200
    assert [client.ask("/api/view").code for _ in range(4)] == [200, 200, 200, 429]


@pytest.mark.parametrize(
    "path",
    [
        "/api/view?at.nonsense=0",
        "/api/diagram?x=frequency&y=psi1&at.q=0&at.nonsense=0",
        "/api/curves?x=frequency&at.q=0&at.nonsense=0",
        "/api/attractors?at.frequency=0&at.q=0&at.nonsense=1",
        "/api/orbit?cell=0&point=0&at.nonsense=0",
        "/api/table?view=orbit&cell=0&point=0&at.nonsense=0",
    ],
)
def test_api__unknown_axes_are_refused(client, path):
    answer = client.ask(path)
    assert answer.code == 400
    assert "axis" in sentence(answer)
    assert "nonsense" in sentence(answer)


def test_zoom__unknown_axes_are_refused(client):
    body = json.dumps({"x": [2.2, 2.6], "axes": ["frequency", "psi1"], "at": {"q": 0, "nonsense": 1}})
    answer = client.ask("/api/zoom", method="POST", body=body)
    assert answer.code == 400
    assert "nonsense" in sentence(answer)


def test_first_answers__what_fails_is_logged(client, monkeypatch, caplog):
    from pipeline.explorer.serving import answers

    def fail(*arguments):
        raise ValueError("no picture today")

    monkeypatch.setattr(answers, "_diagram", fail)
    answers.first_answers(client.service.answering.run, None)
    assert "no picture today" in caplog.text


def test_api__is_bounded_in_rate_and_in_length(client, monkeypatch):
    monkeypatch.setattr(client.service, "rate", Rate(0.001, 3))
    codes = [client.ask("/static/explorer.css").code for _ in range(5)]
    assert codes == [200, 200, 200, 429, 429]
    monkeypatch.setattr(client.service, "rate", Rate(1000.0, 1000))
    answer = client.ask(f"/api/view?x={'a' * server.MOST_ADDRESS}")
    assert answer.code == 414
    with monkeypatch.context() as patched:
        patched.setattr(client.service.answering, "waiting", answering.THREADS + answering.MOST_WAITING)
        assert client.ask("/api/view").code == 429
    assert client.ask("/api/view").code == 200


def test_api__what_integrates_waits_for_what_it_needs(client, monkeypatch):
    """Others are answered meanwhile: they do not wait in the threads that read."""

    compiled = Future()
    monkeypatch.setattr(client.service.answering, "compiled", compiled)
    found = []
    orbits = [
        threading.Thread(target=lambda: found.append(client.ask("/api/orbit?cell=99999&point=0").code))
        for _ in range(answering.THREADS + 1)
    ]
    for one in orbits:
        one.start()
    until = time.monotonic() + 120
    while client.service.answering.waiting < len(orbits) and time.monotonic() < until:
        time.sleep(0.01)
    assert client.ask("/api/view").code == 200
    assert found == []
    compiled.set_result(None)
    for one in orbits:
        one.join(30)
    assert found == [400] * len(orbits)


def test_api__damage_is_said_and_nothing_is_shown(made_run):
    section = made_run / "cube.zarr" / "section"
    for file in section.rglob("*"):
        if file.is_file() and file.name != "zarr.json":
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 1
            file.write_bytes(bytes(content))
    client = Client(Run.open(made_run))
    try:
        answer = client.ask("/api/diagram?x=frequency&y=psi1&at.q=0")
    finally:
        client.close()
    assert answer.code == 500
    assert "magpend verify" in sentence(answer)


def test_api__an_unexpected_error_tells_nothing_of_the_inside(client, monkeypatch, caplog):
    def fails(*arguments):
        raise RuntimeError("/home/somebody/secret")

    answer = ANSWERS["view"]
    monkeypatch.setattr(type(answer), "give", property(lambda self: fails), raising=False)
    found = client.ask("/api/view")
    assert found.code == 500
    assert "secret" not in found.body.decode()


def test_socket__needs_the_token_and_this_origin(client):
    """The websocket is refused before it is one."""

    async def connect(query, headers):
        request = HTTPRequest(f"ws://127.0.0.1:{client.port}/ws{query}", headers=headers)
        connection = await websocket_connect(request)
        connection.close()
        return True

    own = {"Origin": f"http://127.0.0.1:{client.port}"}
    assert client.wait(connect(f"?token={client.guard.token}", own))
    for query, headers in (
        ("", own),
        ("?token=wrong", own),
        (f"?token={client.guard.token}", {"Origin": "http://evil.example"}),
    ):
        with pytest.raises(Exception, match="403"):
            client.wait(connect(query, headers))


# ---- the parts


def test_guard__compares_whole_tokens():
    guard = Guard("abc", 1)
    assert guard.knows("abc")
    for other in ("", "ab", "abcd", "ABC", "äbc", "abc\x00"):
        assert not guard.knows(other)
    assert "abc" not in repr(guard)


def test_new_token__is_long_and_new():
    tokens = {new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 43  # 32 bytes


def test_content_policy__names_this_port_alone():
    assert set(re.findall(r":(\d+)", content_policy(4711))) == {"4711"}


def test_listening__is_on_loopback_and_says_what_is_taken():
    one = listening(0)
    try:
        assert one.getsockname()[0] == "127.0.0.1"
        with pytest.raises(SpecError, match="is taken"):
            listening(one.getsockname()[1])
        with pytest.raises(SpecError, match="0 to 65535"):
            listening(70_000)
    finally:
        one.close()


def test_browser__is_told_a_file_for_this_user_alone(monkeypatch):
    """The address with its token is no argument of a process, and nothing is left behind."""
    opened, done = [], threading.Event()
    monkeypatch.setattr(browser.webbrowser, "open", lambda address: (opened.append(address), done.set()))
    with browser.browser() as open_address:
        open_address("http://127.0.0.1:1/?token=secret&b=\"'<")
        assert done.wait(120)
        assert opened[0].startswith("file://")
        assert "secret" not in opened[0]
        path = Path(opened[0].removeprefix("file://"))
        assert path.stat().st_mode & 0o077 == 0
        assert path.parent.stat().st_mode & 0o077 == 0
        assert "token=secret&amp;b=&quot;" in path.read_text("utf-8")
    assert not path.parent.exists()


# ---- the command


def test_explore__serves_until_it_is_stopped(made_run, start, environment, monkeypatch):
    """It prints the address, answers, changes nothing in the run, and ends with Ctrl-C as other commands."""
    before = {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in made_run.rglob("*")}
    monkeypatch.setitem(environment, "BROWSER", "true")  # a browser that ends at once
    process = start("explore", made_run)
    address = process.stdout.readline().strip()
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{43})", address)
    assert found, address
    port, token = int(found[1]), found[2]
    text = f"GET /api/view?token={token} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=60) as one:
        one.sendall(text.encode())
        answer = b""
        while chunk := one.recv(65536):
            answer += chunk
    assert answer.startswith(b"HTTP/1.1 200")
    assert b"small sweep" in answer
    with pytest.raises(OSError, match="refused"):  # on loopback of this version alone
        socket.create_connection((_other_address(), port), timeout=5).close()
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(120) == 130
    said = process.stderr.read()
    assert "stopped" in said
    assert list(Path(environment["TMPDIR"]).glob("magpend-explore-*")) == []
    assert "so far" not in said.partition("Ctrl-C ends the server")[2]
    assert {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in made_run.rglob("*")} == before


def test_explore__takes_a_region_that_it_runs_along(made_run, start):
    """What was begun for a page ends with the server, though it is in a group of its own."""
    process = start("explore", made_run, "--no-browser")
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{43})\n", process.stdout.readline())
    address = f"ws://127.0.0.1:{found[1]}/ws?token={found[2]}"
    origin = {"Origin": f"http://127.0.0.1:{found[1]}"}
    region = {"id": 1, "do": "run", "x": [2.1, 2.9], "y": None, "at": {"q": 0}}

    async def begin():
        connection = await websocket_connect(HTTPRequest(address, headers=origin))
        await connection.write_message(json.dumps(region))
        while True:
            answer = await connection.read_message()
            told = json.loads(answer) if isinstance(answer, str) else {}
            if told.get("id") == 1:
                assert told["kind"] == "progress", told
            children = [p for p in psutil.Process(process.pid).children() if "run" in p.cmdline()]
            if children:
                os.kill(process.pid, signal.SIGINT)
                while await connection.read_message() is not None:
                    pass
                connection.close()
                return children

    children = asyncio.run(asyncio.wait_for(begin(), 200))
    assert process.wait(120) == 130
    gone, alive = psutil.wait_procs(children, timeout=100)
    for child in alive:
        child.kill()
    assert not alive
    assert gone


def _other_address():
    """Another address of this machine: on Linux all of 127/8 is its own."""
    return "127.0.0.2"


def test_explore__refuses_what_is_no_run(tmp_path, main):
    code, _, errors = main("explore", tmp_path, "--no-browser")
    assert code == 2
    assert "no run directory" in errors


def test_explore__a_page_that_is_open_sees_new_cells(made, start):
    """A run in progress is looked at again whenever the page is loaded."""
    found = Client(Run.open(made.info.directory))
    try:
        assert json.loads(found.ask("/api/view").body)["cells"]["pending"] == made.plan.n_cells
        made.commit(0)
        view = json.loads(found.ask("/api/view").body)
        assert view["cells"]["pending"] == made.plan.n_cells - made.plan.cells_in(0)
        assert not view["complete"]
        assert found.ask("/api/diagram?x=frequency&y=psi1&at.q=0").code == 200
    finally:
        found.close()
