"""Schedulers and workers as processes of their own: they come, go, differ, see other files, or are none."""

from __future__ import annotations

import contextlib
import http.server
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from pipeline.compute import addresses, clients
from pipeline.compute.addresses import Address, SchedulerError, ask, read_address
from pipeline.compute.clients import Where, connected
from pipeline.compute.jobqueue import settings
from pipeline.runs.progress import Progress
from pipeline.runs.run import run
from pipeline.specification.clusters import SYSTEMS, load_cluster
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import LOOPBACK, duffing, quietly, silent

SPEC = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 12 }",
    'kind = "random"\nn = 16\nseed = 1\nx = [-1, 1]\nv = [-1, 1]',
    n_transient=500,
    n_keep=4,
    tolerance=1e-9,
    execution="trajectories_per_task = 16",
)
PATIENCE_S = 90.0


# ---- coming and going ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_workers__come_and_go(tmp_path, write_spec, scheduler_file, worker, bytes_of, monkeypatch):
    """None is there at first; the first one is killed in the middle, after another has come."""
    path = write_spec(SPEC)
    quietly(path, tmp_path / "alone")
    lines, kept, done = [], [], []

    def echo(line):
        lines.append(line)
        if "no workers yet" in line:
            kept.append(worker())

    def add(self, cells):
        added(self, cells)
        done.append(cells)
        if len(done) >= 2 and len(kept) == 1:
            kept.append(worker())
        if len(done) >= 4 and kept[0].poll() is None:
            os.killpg(kept[0].pid, signal.SIGKILL)
            kept[0].wait()

    added = Progress.add
    monkeypatch.setattr(Progress, "add", add)
    assert run(path, tmp_path / "out", scheduler=str(scheduler_file), echo=echo).complete
    (said,) = [line for line in lines if "no workers yet" in line]
    assert f"(from {scheduler_file}): no workers yet; waiting up to 00:10:00" in said
    assert kept[0].poll() == -signal.SIGKILL
    assert bytes_of(tmp_path / "out") == bytes_of(tmp_path / "alone")


@pytest.mark.slow
def test_workers__none(main, write_spec, scheduler_file, monkeypatch):
    monkeypatch.setenv("MAGPEND_WAIT_FOR_WORKERS", "00:00:01")
    code, _, errors = main("run", write_spec(SPEC), "--out", "out", "--scheduler", scheduler_file)
    assert code == 4
    assert "no workers yet; waiting up to 00:00:01" in errors
    assert "no worker came within 00:00:01, so nothing was computed; start workers" in errors
    assert "Traceback" not in errors
    monkeypatch.setenv("MAGPEND_WAIT_FOR_WORKERS", "soon")
    code, _, errors = main("run", write_spec(SPEC), "--out", "out", "--scheduler", scheduler_file)
    assert "MAGPEND_WAIT_FOR_WORKERS = 'soon': must be hours, minutes and seconds" in errors


# ---- other programs, other files -----------------------------------------------------------------------


def refusal(scheduler_file, n_workers, **where):
    """What is said when so many workers are there."""
    from distributed import Client

    with Client(scheduler_file=str(scheduler_file), set_as_default=False) as client:
        client.wait_for_workers(n_workers, timeout=PATIENCE_S)
    with pytest.raises(SchedulerError) as refused, connected(Where(str(scheduler_file), **where), silent):
        pass
    text = str(refused.value)
    assert "\n" not in text
    return text


@pytest.mark.slow
def test_workers__other_versions(tmp_path, environment, scheduler_file, worker):
    """One has another numba, and one no magpend at all."""
    (tmp_path / "other" / "numba-0.0.1.dist-info").mkdir(parents=True)
    (tmp_path / "other" / "numba-0.0.1.dist-info" / "METADATA").write_text("Name: numba\nVersion: 0.0.1\n")
    worker(PYTHONPATH=os.pathsep.join([str(tmp_path / "other"), environment["PYTHONPATH"]]))
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "pipeline.py").touch()  # a module, so that nothing is found in it
    worker(PYTHONPATH=str(tmp_path / "none"))
    text = refusal(scheduler_file, 2)
    assert "2 of 2 workers have other programs than this process: tcp://127.0.0.1:" in text
    assert f"numba 0.0.1, here {clients.installation()['numba']}" in text
    assert "has no magpend, or one of another version" in text
    assert "Install the same versions everywhere" in text


def test_late_worker__other_versions():
    """One that comes later, when nobody asks it any more, refuses its tasks itself."""
    task = clients.Fitting(lambda index: {"task": index})
    assert task(3) == {"task": 3}
    other = clients.Fitting(task.task, {**clients.installation(), "magpend's kernel": "another"})
    with pytest.raises(clients.MisfitError, match=r"this worker has other programs .*magpend's kernel"):
        other(3)


MOUNTS = {
    "mount -t tmpfs none {}": "does not see it (No such file or directory)",
    "mount --bind {0} {0} && mount -o remount,ro,bind {0}": "cannot write to it (Read-only file system)",
}


@pytest.mark.slow
def test_workers__other_files(tmp_path, scheduler_file, worker):
    """One sees an empty folder by the same name, one may only read: disks are mounted for them alone."""
    out = tmp_path / "out"
    out.mkdir()
    for mount in MOUNTS:
        before = ("unshare", "--mount", "--", "sh", "-c", f'{mount.format(out)} && exec "$@"', "sh")
        able = shutil.which("unshare") and subprocess.run([*before, "true"], capture_output=True, check=False)
        if not able or able.returncode:
            pytest.skip("file systems cannot be mounted for one process here (root is needed)")
        worker(before=before)
    text = refusal(scheduler_file, 2, place=str(out))
    assert f"2 of 2 workers cannot use {out}: tcp://127.0.0.1:" in text
    assert all(words in text for words in MOUNTS.values())
    assert "choose, with --out, a folder of a file system that all of them see" in text
    assert not list((out / "commits").iterdir())


@pytest.mark.slow
def test_sees(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "_LATE_S", 0.3)
    place, key = str(tmp_path), "commits/.probe.tmp"
    assert clients.sees(place, key, "token") == "does not see it (No such file or directory)"
    (tmp_path / "commits").mkdir()
    (tmp_path / key).write_text("another")
    assert clients.sees(place, key, "token") == "sees another one by that name"
    (tmp_path / key).write_text("token")
    assert clients.sees(place, key, "token") == ""
    assert [path.name for path in (tmp_path / "commits").iterdir()] == [".probe.tmp"]


# ---- scripts of worker jobs ----------------------------------------------------------------------------

CLUSTER = """
[cluster]
kind = "KIND"
queue = "short"
account = "p-42"
cores = 4
memory = "8 GB"
walltime = "04:00:00"
prologue = ["module load python/3.12"]
directives = ["-pe smp 4"]
interface = "ib0"
scratch = "$TMPDIR"
python = "/opt/python"
"""


@pytest.mark.parametrize("kind", ["slurm", "pbs", "sge", "lsf"])
def test_worker_script(tmp_path, kind):
    dask_jobqueue = pytest.importorskip("dask_jobqueue")
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER.replace("KIND", kind))
    job = getattr(dask_jobqueue, SYSTEMS[kind].jobqueue).job_cls
    options = settings(load_cluster(path), tmp_path / "logs")
    script = job("tls://SCHEDULER:PORT", name="NAME", **options).job_script()
    assert script.startswith("#!")
    for words in ("-p short" if kind == "slurm" else "-q short", "p-42", *(["-pe smp 4"] if kind == "sge" else [])):
        assert words in script
    command = next(line for line in script.splitlines() if line.startswith("/opt/python"))
    # one process for each core, which leave before the job ends
    for words in (
        "-m distributed.cli.dask_worker tls://SCHEDULER:PORT",
        "--nthreads 1",
        "--nworkers 4",
        "--memory-limit 1.86GiB",
        "--local-directory $TMPDIR",
        "--interface ib0",
        "--lifetime 13200s",
        "--lifetime-stagger 300s",
    ):
        assert words in command
    assert script.index("export NUMBA_NUM_THREADS=1") < script.index("module load python/3.12")
    assert script.index("module load python/3.12") < script.index("/opt/python")


# ---- addresses: each wrong one is refused within seconds -------------------------------------------------

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


def refused_by(address):
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
    assert words in refused_by(address)


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
        assert words in refused_by(f"{scheme}127.0.0.1:{port}")


@pytest.mark.slow
def test_ask__a_scheduler_and_what_is_beside_it(monkeypatch):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, processes=False, protocol="tcp", **LOOPBACK) as cluster:
        ask(read_address(cluster.scheduler_address, "--scheduler"))
        monkeypatch.setattr(addresses, "ANSWER_S", 0.5)
        (worker,) = cluster.workers.values()
        assert "is the address of a worker" in refused_by(worker.address)
        dashboard = f"tcp://127.0.0.1:{cluster.scheduler.http_server.port}"
        assert "is another kind of server" in refused_by(dashboard)


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
            assert "for tls://" in refused_by(cluster.scheduler_address.replace("tls", "tcp"))


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
    assert words in refused_by(str(path))


def test_ask__stale_file(tmp_path):
    path = tmp_path / "scheduler.json"
    with closed_port() as port:
        path.write_text(json.dumps({"type": "Scheduler", "address": f"tcp://127.0.0.1:{port}"}))
        assert f"(from {path}): nothing listens there" in refused_by(str(path))


# ---- what people say, together -------------------------------------------------------------------------

JOBS = '[cluster]\nkind = "slurm"\ncores = 2\nmemory = "4 GB"\nwalltime = "01:00:00"\n'


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
    path.write_text(JOBS)
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
