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


@pytest.fixture
def cluster():
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        processes=False,
        host="127.0.0.1",
        protocol="tcp",
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    ) as found:
        yield found


def refusal(address):
    """What is said, and that it is said soon."""
    started = time.monotonic()
    with pytest.raises((SpecError, SchedulerError)) as refused:
        ask(read_address(address, "--scheduler"))
    assert time.monotonic() - started < SECONDS
    text = str(refused.value)
    assert "\n" not in text
    return text


def test_ask__no_such_host():
    assert "there is no host 'nosuch.invalid'" in refusal("tcp://nosuch.invalid:8786")


def test_ask__unreachable_host():
    """An address that networks keep free for examples: whatever the way there does, it is refused in time."""
    assert "tcp://192.0.2.1:8786: " in refusal("tcp://192.0.2.1:8786")


def test_ask__wrong_port():
    with closed_port() as port:
        assert f"tcp://127.0.0.1:{port}: nothing listens there" in refusal(f"127.0.0.1:{port}")


@pytest.mark.slow
def test_ask__web_server(monkeypatch):
    assert addresses.ANSWER_S <= 5
    monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
    with web_server() as port:
        assert "is another kind of server" in refusal(f"tcp://127.0.0.1:{port}")


@pytest.mark.slow
def test_ask__mute(monkeypatch):
    monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
    with mute_server() as port:
        assert "or a scheduler that hangs" in refusal(f"tcp://127.0.0.1:{port}")


@pytest.mark.slow
def test_ask__a_scheduler_and_what_is_beside_it(cluster, monkeypatch):
    ask(read_address(cluster.scheduler_address, "--scheduler"))
    monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
    (worker,) = cluster.workers.values()
    assert "is the address of a worker" in refusal(worker.address)
    dashboard = f"tcp://127.0.0.1:{cluster.scheduler.http_server.port}"
    assert "is another kind of server" in refusal(dashboard)


def test_ask__tls_without_keys():
    with mute_server() as port:
        text = refusal(f"tls://127.0.0.1:{port}")
    assert "TLS needs the scheduler's authority" in text
    assert "DASK_DISTRIBUTED__COMM__TLS__CA_FILE" in text


def test_ask__plain_where_tls_is_spoken(tmp_path, monkeypatch):
    import dask
    from distributed import LocalCluster, Security

    security = Security.temporary()
    with LocalCluster(
        n_workers=0,
        processes=False,
        host="127.0.0.1",
        protocol="tls",
        security=security,
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        silence_logs=60,
    ) as cluster:
        settings = {}
        for name, key in (("CA_FILE", "ca_file"), ("CLIENT__CERT", "cert"), ("CLIENT__KEY", "key")):
            file = tmp_path / key
            file.write_text(security.get_tls_config_for_role("client")[key])
            variable = f"DASK_DISTRIBUTED__COMM__TLS__{name}"
            settings[f"distributed.comm.tls.{name.lower().replace('__', '.')}"] = str(file)
            monkeypatch.setenv(variable, str(file))
        with dask.config.set(settings):
            ask(read_address(cluster.scheduler_address, "--scheduler"))
            assert "for tls://" in refusal(cluster.scheduler_address.replace("tls", "tcp"))


@pytest.mark.parametrize(
    "address",
    [
        "tcp://",
        "tcp://host",
        "host",
        "tcp://host:port",
        "tcp://host:0",
        "tcp://host:70000",
        "tcp://a:1:2",
        "tcp://ho st:1",
        "slurmm",
        "tcp:/host:1",
    ],
)
def test_read_address__malformed(address):
    assert f"{address!r} is no address of a scheduler; give tcp://HOST:PORT" in refusal(address)


@pytest.mark.parametrize("address", ["http://host:8787", "https://host:1", "ssh://host:22", "inproc://1:2"])
def test_read_address__wrong_scheme(address):
    assert f"{address!r}: must begin with tcp:// or tls://." in refusal(address)


def test_read_address__forms():
    assert read_address("host:8786", "--scheduler").url == "tcp://host:8786"
    assert read_address("TLS://host:8786/", "--scheduler").url == "tls://host:8786"
    assert read_address("tcp://[::1]:8786", "--scheduler").host == "[::1]"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read (No such file or directory)"),
        ("", "is no scheduler file"),
        ("[1]", "is no scheduler file"),
        ("{}", "is no scheduler file"),
        ('{"address": 3}', "its 'address' must be a text"),
        ('{"address": "other.json"}', "its 'address' must be a text"),
        ('{"address": "tcp://host"}', "is no address of a scheduler"),
        ("\udcff", "is no scheduler file"),
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


def test_where__jobs_need_a_file(tmp_path, monkeypatch):
    monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)
    with pytest.raises(SpecError, match="set MAGPEND_CLUSTER"):
        Where("slurm").resolved()
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER)
    with pytest.raises(SpecError, match="describes jobs of slurm"):
        Where("pbs", path).resolved()
    with pytest.raises(SpecError, match="and --scheduler threads asks for none"):
        Where("threads", path).resolved()


def test_where__no_batch_system_here(tmp_path, monkeypatch):
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SpecError, match="slurm: there is no command 'sbatch' here"):
        Where(None, path).resolved()
    monkeypatch.setenv("MAGPEND_CLUSTER", str(path))
    with pytest.raises(SpecError, match="slurm: there is no command 'sbatch' here"):
        Where("slurm").resolved()


def test_where__dashboard_without_its_package_or_a_scheduler(tmp_path, monkeypatch):
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    monkeypatch.setattr(clients, "check_means", lambda cluster: None)
    with pytest.raises(SpecError, match=r"needs bokeh.*pip install '\.\[dashboard\]'"):
        Where("slurm", path, dashboard=True).resolved()
    for place in ("threads", "processes", "none"):
        with pytest.raises(SpecError, match="--dashboard: shows a dask scheduler, and there is none"):
            Where(place, dashboard=True).resolved()


def test_run__wrong_address(main, tmp_path, write_spec, sweep_text):
    """Words that cannot be an address create nothing; a scheduler that is not there ends with its code."""
    path = write_spec(sweep_text)
    code, _, errors = main("run", path, "--out", tmp_path / "out", "--scheduler", "tcp://host")
    assert code == 2
    assert "is no address" in errors
    assert not (tmp_path / "out").exists()
    with closed_port() as port:
        code, _, errors = main("run", path, "--out", tmp_path / "out", "--scheduler", f"tcp://127.0.0.1:{port}")
    assert code == 4
    assert "nothing listens there" in errors
    assert "Traceback" not in errors
