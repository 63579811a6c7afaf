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

import psutil
import pytest
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

from pipeline.explorer import answers, html, server
from pipeline.explorer.answers import ANSWERS
from pipeline.explorer.security import Guard, Rate, content_policy, new_token
from pipeline.explorer.server import listening
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.conftest import Client


@pytest.fixture
def made_run(made):
    """A finished run of made-up numbers."""
    for task in range(made.plan.n_tasks):
        made.commit(task)
    return made.info.directory


def sentence(answer):
    return json.loads(answer.body)["error"]


# ---- what is answered


@pytest.mark.slow
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


@pytest.mark.parametrize("path", ["/api/view", "/api/orbit?cell=0&point=0", "/api/table", "/", "/api/zoom", "/ws"])
def test_api__is_refused_without_the_token(client, path):
    for given in ("", "wrong", "token wrong"):
        answer = client.ask(path, token=False, headers={"Authorization": given} if given else {})
        assert answer.code == 403
        assert client.guard.token.encode() not in answer.body
        assert b"token" in answer.body or path == "/ws"


def test_api__takes_the_token_as_an_argument(client):
    assert client.ask(f"/api/view?token={client.guard.token}", token=False).code == 200
    assert client.ask(f"/api/view?token={client.guard.token[:-1]}", token=False).code == 403
    assert client.ask("/api/view?token=%ff%fe", token=False).code in (400, 403)


FOREIGN = {
    "Host": ("evil.example", "evil.example:8888", "127.0.0.1"),
    "Origin": ("http://evil.example", "null", "http://127.0.0.1:1"),
    "Sec-Fetch-Site": ("cross-site", "same-site"),
}


@pytest.mark.parametrize("path", ["/api/view", "/static/explorer.js", "/ws"])
def test_api__refuses_other_pages_and_names(client, path):
    """With the right token, too: a name that points here, or a page of another port, is no reason."""
    for name, values in FOREIGN.items():
        for value in values:
            assert client.ask(path, headers={name: value}).code == 403, (name, value)
    own = {"Origin": f"http://127.0.0.1:{client.port}", "Sec-Fetch-Site": "same-origin"}
    assert client.ask("/api/view", headers=own).code == 200
    named = {"Host": f"localhost:{client.port}", "Origin": f"http://localhost:{client.port}"}
    assert client.ask("/api/view", headers=named).code == 200


@pytest.mark.parametrize(("path", "code", "said"), [("/api/views", 404, "no such page"), ("/api/zoom", 405, "POST")])
def test_api__what_is_not_there(client, path, code, said):
    answer = client.ask(path)
    assert answer.code == code
    assert said in sentence(answer)


def test_static__serves_its_own_files_alone(client):
    up = (
        "../server.py",
        "%2e%2e/server.py",
        "..%2fserver.py",
        "/etc/passwd",
        "explorer.css.map",
        "",
        "LICENSES.txt%00.js",
    )
    for path in (*(f"/static/{name}" for name in up), "/run.json", "/cube.zarr/zarr.json"):
        answer = client.raw(
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\nConnection: close\r\n\r\n".encode()
        )
        assert re.match(rb"HTTP/1\.1 (404|400|403) ", answer), path
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
    # a title stays text
    text = html.served_html("</title><script>alert(1)</script>", "abc")
    assert "<script>alert" not in text
    assert "&lt;script&gt;" in text


def test_api__strangers_use_up_nothing_of_those_with_the_token(client, monkeypatch):
    monkeypatch.setattr(client.service, "rate", Rate(0.001, 3))
    monkeypatch.setattr(client.service, "files", Rate(0.001, 1))
    monkeypatch.setattr(client.service, "strangers", Rate(0.001, 2))
    wrong = {"Authorization": "token wrong"}
    codes = [client.ask("/api/view", token=False, headers=wrong).code for _ in range(3)]
    assert codes == [403, 403, 429]
    assert client.ask("/static/explorer.css", token=False).code == 200
    assert [client.ask("/api/view").code for _ in range(4)] == [200, 200, 200, 429]


def test_first_answers__what_fails_is_logged(client, monkeypatch, caplog):
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
        patched.setattr(client.service.answering, "waiting", answers.THREADS + answers.MOST_WAITING)
        assert client.ask("/api/view").code == 429
    assert client.ask("/api/view").code == 200
    head = (
        f"POST /api/zoom HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\n"
        f"Content-Length: {server.MOST_BODY + 1}\r\nAuthorization: token {client.guard.token}\r\n\r\n"
    )
    assert b" 200 " not in client.raw(head.encode())


def test_api__what_integrates_waits_for_what_it_needs(client, monkeypatch):
    """Others are answered meanwhile: they do not wait in the threads that read."""

    compiled = Future()
    monkeypatch.setattr(client.service.answering, "compiled", compiled)
    found = []
    orbits = [
        threading.Thread(target=lambda: found.append(client.ask("/api/orbit?cell=99999&point=0").code))
        for _ in range(answers.THREADS + 1)
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


@pytest.mark.slow
def test_api__damage_is_said_and_nothing_is_shown(made_run):
    section = made_run / "cube.zarr" / "section"
    for file in section.rglob("*"):
        if file.is_file() and file.name != "zarr.json":
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 1
            file.write_bytes(bytes(content))
    client = Client(RunDirectory.open(made_run))
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


# ---- the parts


def test_security__tokens_and_policy():
    """Whole tokens are compared, new ones are long, and the policy names this port alone."""
    guard = Guard("abc", 1)
    assert guard.knows("abc")
    assert not any(map(guard.knows, ("", "ab", "abcd", "ABC", "äbc", "abc\x00")))
    assert "abc" not in repr(guard)
    tokens = {new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 43  # 32 bytes
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
    monkeypatch.setattr(server.webbrowser, "open", lambda address: (opened.append(address), done.set()))
    with server.browser() as open_address:
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


@pytest.mark.slow
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
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", port), timeout=5).close()  # on Linux all of 127/8 is this machine's
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(120) == 130
    said = process.stderr.read()
    assert "stopped" in said
    assert list(Path(environment["TMPDIR"]).glob("magpend-explore-*")) == []
    assert "so far" not in said.partition("Ctrl-C ends the server")[2]
    assert {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in made_run.rglob("*")} == before


@pytest.mark.slow
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
