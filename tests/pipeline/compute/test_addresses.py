"""Addresses of schedulers: each wrong one is refused within seconds, in a sentence that says what it is."""

from __future__ import annotations

import contextlib
import http.server
import json
import socket
import sys
import threading
import time

import pytest

from pipeline.compute import addresses, clients
from pipeline.compute.addresses import Address, SchedulerError, ask, read_address
from pipeline.compute.clients import Where
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import LOOPBACK

SECONDS = 60.0
"""Within which each is refused: 5 s of silence, and a machine that is busy."""


@contextlib.contextmanager
def web_server():
    class Silent(http.server.BaseHTTPRequestHandler):
        def log_message(self, *words):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Silent)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextlib.contextmanager
def mute_server():
    """Accepts and says nothing, as a stopped process does."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


@contextlib.contextmanager
def closed_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]


def refusal(address):
    """What is said, and that it is said soon."""
    started = time.monotonic()
    with pytest.raises((SpecError, SchedulerError)) as refused:
        ask(read_address(address, "--scheduler"))
    assert time.monotonic() - started < SECONDS
    text = str(refused.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("tcp://nosuch.invalid:8786", "there is no host 'nosuch.invalid'"),
        # an address that networks keep free for examples: whatever the way there does, it is refused in time
        ("tcp://192.0.2.1:8786", "tcp://192.0.2.1:8786: "),
        *((a, f"{a!r} is no address of a scheduler; give tcp://HOST:PORT") for a in ("tcp://", "host", "tcp:/host:1")),
        *((a, "is no address") for a in ("tcp://host:port", "tcp://host:0", "tcp://host:70000", "tcp://a:1:2")),
        *((a, f"{a!r}: must begin with tcp:// or tls://.") for a in ("http://host:8787", "inproc://1:2")),
    ],
)
def test_ask__nobody_can_be_asked(address, words):
    assert words in refusal(address)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "there", "words"),
    [
        ("", closed_port, "nothing listens there"),
        ("tcp://", web_server, "is another kind of server"),
        ("tcp://", mute_server, "or a scheduler that hangs"),
        ("tls://", mute_server, "TLS needs the scheduler's authority"),
    ],
)
def test_ask__something_else_is_there(monkeypatch, scheme, there, words):
    assert addresses.ANSWER_S <= 5
    monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
    with there() as port:
        assert words in refusal(f"{scheme}127.0.0.1:{port}")


@pytest.mark.slow
def test_ask__a_scheduler_and_what_is_beside_it(monkeypatch):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, processes=False, protocol="tcp", **LOOPBACK) as cluster:
        ask(read_address(cluster.scheduler_address, "--scheduler"))
        monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
        (worker,) = cluster.workers.values()
        assert "is the address of a worker" in refusal(worker.address)
        dashboard = f"tcp://127.0.0.1:{cluster.scheduler.http_server.port}"
        assert "is another kind of server" in refusal(dashboard)


def test_ask__plain_where_tls_is_spoken(tmp_path, monkeypatch):
    import dask
    from distributed import LocalCluster, Security

    security = Security.temporary()
    options = {"n_workers": 0, "processes": False, "protocol": "tls", "security": security, "silence_logs": 60}
    with LocalCluster(**options, **LOOPBACK) as cluster:
        settings = {}
        for name, key in (("CA_FILE", "ca_file"), ("CLIENT__CERT", "cert"), ("CLIENT__KEY", "key")):
            file = tmp_path / key
            file.write_text(security.get_tls_config_for_role("client")[key])
            settings[f"distributed.comm.tls.{name.lower().replace('__', '.')}"] = str(file)
            monkeypatch.setenv(f"DASK_DISTRIBUTED__COMM__TLS__{name}", str(file))
        with dask.config.set(settings):
            ask(read_address(cluster.scheduler_address, "--scheduler"))
            assert "for tls://" in refusal(cluster.scheduler_address.replace("tls", "tcp"))


def test_read_address__forms():
    assert read_address("host:8786", "--scheduler").url == "tcp://host:8786"
    assert read_address("TLS://host:8786/", "--scheduler").url == "tls://host:8786"
    assert read_address("tcp://[::1]:8786", "--scheduler").host == "[::1]"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read (No such file or directory)"),
        ("", "is no scheduler file"),
        ("{}", "is no scheduler file"),
        ("\udcff", "is no scheduler file"),
        ('{"address": 3}', "its 'address' must be a text"),
        ('{"address": "other.json"}', "its 'address' must be a text"),
        ('{"address": "tcp://host"}', "is no address of a scheduler"),
    ],
)
def test_read_address__bad_file(tmp_path, content, words):
    path = tmp_path / "scheduler.json"
    if content is not None:
        path.write_text(content, "utf-8", errors="surrogateescape")
    assert words in refusal(str(path))


def test_ask__stale_file(tmp_path):
    path = tmp_path / "scheduler.json"
    with closed_port() as port:
        path.write_text(json.dumps({"type": "Scheduler", "address": f"tcp://127.0.0.1:{port}"}))
        assert f"(from {path}): nothing listens there" in refusal(str(path))


# ---- what people say, together -------------------------------------------------------------------------

CLUSTER = '[cluster]\nkind = "slurm"\ncores = 2\nmemory = "4 GB"\nwalltime = "01:00:00"\n'


def test_where__default_and_environment(monkeypatch):
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    assert Where().resolved() == "threads"
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://host:1")
    assert Where().resolved() == Address("tcp", "host", 1, "DASK_SCHEDULER_ADDRESS")
    for place in ("threads", "processes", "none"):
        assert Where(place).resolved() == place
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "nonsense")
    with pytest.raises(SpecError, match="DASK_SCHEDULER_ADDRESS: 'nonsense' is no address"):
        Where().resolved()


@pytest.mark.parametrize(
    ("place", "has_file", "dashboard", "words"),
    [
        ("slurm", False, False, "set MAGPEND_CLUSTER"),
        ("pbs", True, False, "describes jobs of slurm"),
        ("threads", True, False, "and --scheduler threads asks for none"),
        (None, True, False, "slurm: there is no command 'sbatch' here"),
        ("slurm", True, True, r"needs bokeh.*pip install '\.\[dashboard\]'"),
        ("threads", False, True, "--dashboard: shows a dask scheduler, and there is none"),
    ],
)
def test_where__what_does_not_go_together(tmp_path, monkeypatch, place, has_file, dashboard, words):
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER)
    monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    if dashboard:
        monkeypatch.setitem(sys.modules, "bokeh", None)
        monkeypatch.setattr(clients, "check_means", lambda cluster: None)
    with pytest.raises(SpecError, match=words):
        Where(place, path if has_file else None, dashboard=dashboard).resolved()
    if words.startswith("slurm:"):
        monkeypatch.setenv("MAGPEND_CLUSTER", str(path))
        with pytest.raises(SpecError, match=words):
            Where("slurm").resolved()


def test_run__wrong_address(main, tmp_path, write_spec, sweep_text):
    """Words that cannot be an address create nothing; a scheduler that is not there ends with its code."""
    words = ("run", write_spec(sweep_text), "--out", tmp_path / "out", "--scheduler")
    code, _, errors = main(*words, "tcp://host")
    assert code == 2
    assert "is no address" in errors
    assert not (tmp_path / "out").exists()
    with closed_port() as port:
        code, _, errors = main(*words, f"tcp://127.0.0.1:{port}")
    assert code == 4
    assert "nothing listens there" in errors
    assert "Traceback" not in errors
