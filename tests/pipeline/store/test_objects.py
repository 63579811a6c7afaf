"""A run in an object store is the run in a folder, byte by byte, whatever the network does."""

from __future__ import annotations

import json
import os
import pickle
import platform
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr

from pipeline import open_run
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.runs.zoom import read_source
from pipeline.store import local, objects
from pipeline.store.commits import read_commits, sweep
from pipeline.store.errors import DamagedError, LockedError
from pipeline.store.files import RECORD_COPY
from pipeline.store.objects import open_files
from pipeline.store.products import open_product, products_in, remove_product, write_product
from pipeline.store.record_copy import write_copy
from pipeline.store.run import RunDirectory
from pipeline.store.setup import create, establish
from pipeline.store.tasks import write_task
from tests.pipeline.factories import SQUARE, duffing, quietly, silent
from tests.pipeline.store.s3 import BUCKET, KEY_ID, SECRET, Server, in_turn, once

pytestmark = pytest.mark.slow

PLACE = f"s3://{BUCKET}/runs/one"

DUFFING = duffing("frequency_hz = { start = 0.1, stop = 0.3, num = 6 }", SQUARE, execution="trajectories_per_task = 18")


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("moto", reason="needs moto[s3], flask and flask-cors")
    pytest.importorskip("obstore")
    found = Server()
    yield found
    found.close()


@pytest.fixture
def s3(server, monkeypatch):
    """The server with an empty bucket, and an environment that leads to it; waits are short."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", KEY_ID)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    monkeypatch.setattr(objects, "FIRST_WAIT_S", 0.01)
    monkeypatch.setattr(objects, "LONGEST_WAIT_S", 0.02)
    monkeypatch.setattr(objects, "REQUEST_S", 0.5)
    server.reset()
    files = open_files(f"s3://{BUCKET}")
    files.remove(files.everything())
    server.reset()
    return server


@pytest.fixture
def sweep_text(sweep_text):
    """With three tasks: each object that is put or read is a request, and most of what a test costs."""
    assert "num = 5 }" in sweep_text
    return sweep_text.replace("num = 5 }", "num = 3 }")


@pytest.fixture
def remote(made, s3):
    """The run of `made`, in the object store."""
    info = create(PLACE, made.plan)

    def commit(index):
        write_task(info, index, made.values(index), {"bounded": made.plan.cells_in(index)})

    return SimpleNamespace(info=info, commit=commit, plan=made.plan, spec=made.spec)


def stored(place=PLACE):
    """Cube and commits of a run, and the copy of the commits, as bytes."""
    files = open_files(place)
    contents = dict(files.read_each(files.everything()))
    return {k: v for k, v in contents.items() if k.startswith(("cube.zarr/", "commits/", "records.jsonl"))}


# ---- the same bytes ----------------------------------------------------------------------------


def test_run__same_bytes_as_in_a_folder(s3, write_spec, tmp_path, bytes_of):
    spec = write_spec(DUFFING)
    quietly(spec, tmp_path / "run")
    said = []
    found = run(spec, PLACE, workers=0, echo=said.append)
    assert found.complete
    assert found.name == PLACE
    assert stored() == bytes_of(tmp_path / "run")
    run(spec, PLACE, workers=0, echo=said.append)
    assert said[-1] == f"{PLACE} is complete; nothing to do."
    assert state(PLACE).complete
    assert verify_run(PLACE).sound
    assert len(open_files(PLACE).read("timings.jsonl").splitlines()) == found.plan.n_tasks
    there, here = open_run(PLACE), open_run(tmp_path / "run")
    assert there.load().drop_attrs(deep=False).identical(here.load().drop_attrs(deep=False))
    assert read_source(PLACE).origin.startswith(f"run {PLACE}, digest ")


def test_open_run__dask_reads_in_other_processes_by_the_url_alone(remote):
    for index in range(remote.plan.n_tasks):
        remote.commit(index)
    ds = open_run(PLACE, chunks={})
    sent = pickle.dumps(ds)
    assert SECRET.encode() not in sent
    assert KEY_ID.encode() not in sent
    assert pickle.loads(sent).load().identical(ds.load())


def test_write_task__few_requests(made, remote, s3):
    remote.commit(0)
    s3.reset()
    remote.commit(1)
    # metadata are compared, every chunk is put and read back, a pack is asked for and the marker put
    assert len(s3.requests) == 3 * len(made.plan.variables) + 2
    assert s3.requests[-1][:2] == ("PUT", f"/{BUCKET}/runs/one/commits/000001.json")


# ---- harm --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kinds", [("500", "503"), (None, "lost", "500")])
def test_run__same_bytes_whatever_the_network_does(whole, s3, bytes_of, kinds):
    made = whole
    s3.harm = in_turn(*kinds)
    info = establish(PLACE, made.plan, silent)
    for index in range(made.plan.n_tasks):
        write_task(info, index, made.values(index), {"bounded": made.plan.cells_in(index)})
    commits = read_commits(info)
    assert len(commits) == made.plan.n_tasks
    assert sweep(info, commits) == 0
    assert verify_run(PLACE).sound
    assert s3.harmed.total() - s3.harmed[None] > 30
    s3.reset()
    assert stored() == bytes_of(made.info.directory)


@pytest.mark.parametrize(
    ("part", "kind"),
    [
        *(("commits/000000.json", kind) for kind in ("lost", "late", "500", "409")),
        # a chunk is put without a condition, so that nothing can conflict with it
        *(("section/c.0", kind) for kind in ("lost", "late", "500")),
    ],
)
def test_write_task__an_answer_that_never_comes(remote, s3, part, kind):
    s3.harm = once(part, kind)
    remote.commit(0)
    assert s3.harmed[kind] == 1
    puts = [path for method, path, _ in s3.requests if method == "PUT" and part in path]
    assert len(puts) > 1 or (kind in ("lost", "late") and "commits" in part)
    assert set(read_commits(remote.info)) == {0}
    assert verify_run(PLACE).sound


def test_run__an_outage_is_one_line_and_the_same_command_goes_on(s3, write_spec, tmp_path, bytes_of):
    spec = write_spec(DUFFING)
    quietly(spec, tmp_path / "run")
    marker = f"/{BUCKET}/runs/one/commits/000001.json"
    down = []

    def harm(method, path, n):
        if (method, path) == ("PUT", marker):
            down.append(True)
        return "503" if down else None

    s3.harm = harm
    with pytest.raises(Exception, match=r"127\.0\.0\.1:\d+ answers 503 Harm; committed results stay") as caught:
        quietly(spec, PLACE)
    assert KEY_ID not in str(caught.value)
    s3.reset()
    objects.LEASE_S, before = 0.0, objects.LEASE_S  # nobody could take the lock away
    try:
        assert quietly(spec, PLACE).complete
    finally:
        objects.LEASE_S = before
    assert stored() == bytes_of(tmp_path / "run")


class CrashError(Exception):
    """Stands for a process that is killed."""


def test_write_task__killed_between_any_two_puts(made, remote, bytes_of, monkeypatch):
    for index in range(made.plan.n_tasks):
        made.commit(index)
        if index:
            remote.commit(index)
    real, left = objects._class_of_stores().set, [0]

    async def put(self, key, value):
        if not left[0]:
            raise CrashError
        left[0] -= 1
        await real(self, key, value)

    def never(self, key, content):
        raise CrashError

    for n in range(len(made.plan.variables) + 1):
        left[0] = n
        with monkeypatch.context() as patch:
            patch.setattr(objects._class_of_stores(), "set", put)
            patch.setattr(objects.ObjectFiles, "write_once", never)
            with pytest.raises(CrashError):
                remote.commit(0)
        commits = read_commits(remote.info)
        assert 0 not in commits
        assert sweep(remote.info, commits) == n
    remote.commit(0)
    assert stored() == bytes_of(made.info.directory)


# ---- damage ------------------------------------------------------------------------------------


def test_write_once__another_content_is_not_replaced(remote):
    files = remote.info.files
    files.write_once("commits/000000.json", b"one")
    files.write_once("commits/000000.json", b"one")
    with pytest.raises(DamagedError, match=r"000000\.json: is there with another content"):
        files.write_once("commits/000000.json", b"two")
    assert files.read("commits/000000.json") == b"one"


def test_write_product__the_seal_comes_last(remote, s3):
    # by their names, chunks of the second variable come after zarr.json
    data = {"mean": ("side", [1.0, 2.0]), "zone": ("side", [1, 2])}
    ds = xr.Dataset(data, {"side": ["left", "right"]}, {"derived_product": "mean"})
    place = remote.info.files.below("derived").below("mean-1.zarr")
    s3.reset()
    write_product(place, ds)
    puts = [path.partition("mean-1.zarr/")[2] for method, path, _ in s3.requests if method == "PUT"]
    assert puts[-1] == "zarr.json"
    assert open_product(place)["side"].values.tolist() == ["left", "right"]
    key = next(key for key in place.everything() if key.endswith("/c.0"))
    place.write(key, b"x" + place.read(key))
    with pytest.raises(DamagedError, match="its content has changed"):
        open_product(place)
    write_product(place, ds)
    assert open_product(place)["mean"].values.tolist() == [1.0, 2.0]
    assert [found.name for found in products_in(remote.info.files.below("derived"))] == [place.name]
    remove_product(place)
    with pytest.raises(FileNotFoundError):
        open_product(place)


# ---- the lock ----------------------------------------------------------------------------------


def held_by(remote, **changes):
    content = json.dumps({**local.holder(), **changes}).encode()
    remote.info.files.write("lock", content)
    return content


def test_lease__names_its_holder_and_ends_with_it(remote):
    files = remote.info.files
    with files.lock():
        with pytest.raises(LockedError, match=rf"process {os.getpid()} on {platform.node()} since 20"), files.lock():
            pass
        assert files.is_there("lock")
    assert not files.is_there("lock")


def test_lease__lapses_when_it_is_not_renewed_and_at_once_when_its_process_was_killed(remote, monkeypatch):
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    held_by(remote, pid=process.pid)
    with remote.info.files.lock():
        pass
    held_by(remote, host="elsewhere")
    with pytest.raises(LockedError, match=r"on elsewhere since .*lapses 150 s after"), remote.info.files.lock():
        pass
    monkeypatch.setattr(objects, "LEASE_S", -1.0)
    with remote.info.files.lock():
        pass


def test_lease__somebody_elses_is_left(remote, monkeypatch):
    monkeypatch.setattr(objects, "RENEW_S", 0.05)
    with remote.info.files.lock():
        theirs = held_by(remote, host="elsewhere")
        objects.threading.Event().wait(0.3)
    assert remote.info.files.read("lock") == theirs


def test_lease__lost_answers_do_not_lock_oneself_out(remote, s3):
    s3.harm = once("/lock", "lost")
    with remote.info.files.lock():
        assert s3.harmed["lost"] == 1
    assert not remote.info.files.is_there("lock")


# ---- what is refused ---------------------------------------------------------------------------


def test_main__refusals_are_one_line(s3, made, main, monkeypatch, tmp_path):
    def refused(words, *arguments, code=2):
        found, _, text = main(*arguments)
        assert found == code
        assert SECRET not in text
        assert KEY_ID not in text
        (line,) = text.strip().splitlines()
        assert words in line

    for words, place in (
        ("runs/none: no run directory", f"s3://{BUCKET}/runs/none"),
        ("there is no such bucket at 127.0.0.1", "s3://nobucket/run"),
        ("give a path, or s3://BUCKET/PREFIX", "s3:/measurements/run"),
        ("give a path, or s3://BUCKET/PREFIX", "gs://measurements/run"),
        ("must be s3://BUCKET/PREFIX", "s3://"),
        ("must be s3://BUCKET/PREFIX", f"s3://{BUCKET}/../run"),
        ("no user, password or query", f"s3://{KEY_ID}:{SECRET}@host/run"),
    ):
        refused(words, "status", place)
    refused("there is no such bucket at 127.0.0.1", "run", "spec.toml", "--out", "s3://nobucket/run")
    s3.harm = lambda method, path, n: "403"
    refused("refuses access (403 Harm); check AWS_ACCESS_KEY_ID", "status", PLACE)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "obstore", None)
        refused("pip install '.[s3]'", "status", PLACE)
    with monkeypatch.context() as patch:
        patch.delenv("AWS_ACCESS_KEY_ID")
        refused("there are no credentials; set AWS_ACCESS_KEY_ID", "status", PLACE)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{KEY_ID}:{SECRET}@127.0.0.1:1")
    refused("127.0.0.1:1 does not answer", "status", PLACE, code=4)
    assert not (tmp_path / "s3:").exists()


def test_place__never_becomes_a_path(s3, main, write_spec, tmp_path):
    write_spec(DUFFING)
    code, out, _ = main("run", "spec.toml", "--out", PLACE, "--workers", 0, "--quiet")
    assert code == 0
    assert f"cube: {PLACE}/cube.zarr" in out
    assert json.loads(main("status", PLACE, "--json")[1])[0]["directory"] == PLACE
    assert "figure: figures/one/bifurcation" in main("plot", "bifurcation", PLACE)[1]
    assert sorted(p.suffix for p in (tmp_path / "figures/one").iterdir()) == [".nc", ".png"]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith("s3")]


def test_run__credentials_are_nowhere(s3, write_spec, magpend, environment, tmp_path):
    """A process that opens the store itself; nothing written or said names a key."""
    write_spec(DUFFING)
    environment.update({name: value for name, value in os.environ.items() if name.startswith("AWS_")})
    words = ("--out", PLACE, "--scheduler", "processes", "--workers", 1)
    done = magpend("run", "spec.toml", *words, "--verbose", "--log", "run.log")
    assert done.returncode == 0, done.stderr
    assert state(PLACE).complete
    files = open_files(PLACE)
    texts = [done.stdout.encode(), done.stderr.encode(), *dict(files.read_each(files.everything())).values()]
    texts += [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert not [text for text in texts if SECRET.encode() in text or KEY_ID.encode() in text]
    assert any(KEY_ID in header for _, _, header in s3.requests)


# ---- the copy of the records -------------------------------------------------------------------


@pytest.fixture
def copied(whole, s3):
    """A complete run with the copy of its records, put into the object store file by file; returns its files."""
    write_copy(whole.info, read_commits(whole.info))
    files, here = open_files(PLACE), whole.info.files
    for key in here.everything():
        if key.rpartition("/")[2] != "lock":
            files.write(key, here.read(key))
    s3.reset()
    return files


def keys_asked(s3):
    """Keys of the objects that were read; empty texts are listings."""
    found = [path.partition("/runs/one/")[2] for _, path, _ in s3.requests]
    s3.reset()
    return found


def test_open_run__requests_do_not_grow_with_the_tasks(copied, s3, made):
    ds = open_run(PLACE)
    asked = keys_asked(s3)
    coordinates = [f"cube.zarr/{key}" for key in made.info.skeleton if not key.endswith("zarr.json")]
    listings = ["", ""]
    assert sorted(asked) == sorted([*listings, "run.json", "records.jsonl", "cube.zarr/zarr.json", *coordinates])
    assert ds.load().identical(open_run(made.info.directory).load())
    s3.reset()
    # without the copy, a request for each record
    copied.remove([RECORD_COPY])
    s3.reset()
    open_run(PLACE)
    assert len(keys_asked(s3)) == len(asked) + made.plan.n_tasks


def test_open_run__record_that_is_damaged_is_found_by_verify(copied, made):
    content = bytearray(copied.read("commits/000001.json"))
    content[50] ^= 1
    copied.write("commits/000001.json", bytes(content))
    assert (
        len(RunDirectory.open(PLACE).commits) == 3
    )  # the copy has the record as it was written, with its own checksum
    found = verify_run(PLACE, repair=True)
    assert list(found.damaged) == ["000001.json"]
    assert not copied.is_there(RECORD_COPY)
    run = RunDirectory.open(PLACE)
    assert set(run.commits) == {0, 2}
    assert (run.cube().status.values[made.plan.task(1)] == 0).all()


def test_docs__example_of_the_object_store(copied, s3, monkeypatch):
    text = (Path(__file__).parents[3] / "docs/object-stores.md").read_text("utf-8")
    (block,) = re.findall(r"<!-- tested -->\n```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    names = {}
    exec(block.replace("runs/sweep", "runs/one"), names)
    assert names["ds"].sizes == names["plain"].sizes == names["lazy"].sizes
    assert names["plain"].section.load().equals(names["ds"].section.load())
