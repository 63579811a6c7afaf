"""A run in an object store is the run in a folder, byte by byte, whatever the network does."""

from __future__ import annotations

import json
import os
import pickle
import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest
import xarray as xr

from pipeline import open_run
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.runs.zoom import read_source
from pipeline.store import lease, objects
from pipeline.store.commits import read_commits, sweep, write_task
from pipeline.store.errors import DamagedError, LockedError, RefusedError
from pipeline.store.places import open_files
from pipeline.store.products import open_product, products_in, remove_product, write_product
from pipeline.store.setup import check, create, establish
from tests.pipeline.store.s3 import BUCKET, KEY_ID, SECRET, Server, in_turn, once

pytest.importorskip("moto", reason="needs moto[s3], flask and flask-cors")
pytest.importorskip("obstore")

PLACE = f"s3://{BUCKET}/runs/one"

DUFFING = """
kind = "sweep"
title = "small"
model = "duffing"
[axes]
frequency_hz = { start = 0.1, stop = 0.3, num = 6 }
[initial_conditions]
kind = "grid"
x = { start = -1.0, stop = 1.0, num = 2 }
v = { start = -1.0, stop = 1.0, num = 2 }
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 5
n_keep = 4
[execution]
trajectories_per_task = 8
"""


def silent(line):
    pass


@pytest.fixture(scope="module")
def server():
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
    info = create(PLACE, made.spec, made.plan, made.identity, made.info.spec_text)

    def commit(index):
        write_task(info, made.plan, index, made.values(index), {"bounded": made.plan.cells_in(index)})

    return SimpleNamespace(info=info, commit=commit, plan=made.plan, spec=made.spec, identity=made.identity)


@pytest.fixture
def whole(remote):
    for index in range(remote.plan.n_tasks):
        remote.commit(index)
    return remote


def stored(place=PLACE):
    """Cube and commits of a run, and the copy of the commits, as bytes."""
    files = open_files(place)
    contents = dict(files.read_each(files.everything()))
    return {k: v for k, v in contents.items() if k.startswith(("cube.zarr/", "commits/", "records.jsonl"))}


# ---- the same bytes ----------------------------------------------------------------------------


def test_run__same_bytes_as_in_a_folder(s3, write_spec, tmp_path, bytes_of):
    spec = write_spec(DUFFING)
    run(spec, tmp_path / "run", workers=0, echo=silent)
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


def test_open_run__dask_reads_in_other_processes_by_the_url_alone(whole):
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


def test_read_commits__pending_cells_are_not_data(remote):
    remote.commit(1)
    remote.info.files.below("commits").remove(["000001.json"])
    assert (open_run(PLACE).status == 0).all()
    commits = read_commits(remote.info, remote.plan)
    assert not commits
    assert sweep(remote.info, remote.plan, commits) > 0
    assert set(stored()) == {f"cube.zarr/{key}" for key in remote.info.skeleton}


# ---- harm --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kinds", [("503",), ("500", "503"), ("lost",), (None, "lost", "500")])
def test_run__same_bytes_whatever_the_network_does(made, s3, bytes_of, kinds):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    s3.harm = in_turn(*kinds)
    info = establish(PLACE, made.spec, made.plan, made.identity, made.info.spec_text, silent)
    for index in range(made.plan.n_tasks):
        write_task(info, made.plan, index, made.values(index), {"bounded": made.plan.cells_in(index)})
    commits = read_commits(info, made.plan)
    assert len(commits) == made.plan.n_tasks
    assert sweep(info, made.plan, commits) == 0
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
    assert set(read_commits(remote.info, remote.plan)) == {0}
    assert verify_run(PLACE).sound


def test_run__an_outage_is_one_line_and_the_same_command_goes_on(s3, write_spec, tmp_path, bytes_of):
    spec = write_spec(DUFFING)
    run(spec, tmp_path / "run", workers=0, echo=silent)
    marker = f"/{BUCKET}/runs/one/commits/000001.json"
    down = []

    def harm(method, path, n):
        if (method, path) == ("PUT", marker):
            down.append(True)
        return "503" if down else None

    s3.harm = harm
    with pytest.raises(Exception, match=r"127\.0\.0\.1:\d+ answers 503 Harm; committed results stay") as caught:
        run(spec, PLACE, workers=0, echo=silent)
    assert KEY_ID not in str(caught.value)
    s3.reset()
    lease.LEASE_S, before = 0.0, lease.LEASE_S  # nobody could take the lock away
    try:
        assert run(spec, PLACE, workers=0, echo=silent).complete
    finally:
        lease.LEASE_S = before
    assert stored() == bytes_of(tmp_path / "run")


class CrashError(Exception):
    """Stands for a process that is killed."""


def test_write_task__killed_between_any_two_puts(made, remote, bytes_of, monkeypatch):
    for index in range(made.plan.n_tasks):
        made.commit(index)
        if index:
            remote.commit(index)
    real, left = objects.RunStore.set, [0]

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
            patch.setattr(objects.RunStore, "set", put)
            patch.setattr(objects.ObjectFiles, "write_once", never)
            with pytest.raises(CrashError):
                remote.commit(0)
        commits = read_commits(remote.info, remote.plan)
        assert 0 not in commits
        assert sweep(remote.info, remote.plan, commits) == n
    remote.commit(0)
    assert stored() == bytes_of(made.info.directory)


# ---- damage ------------------------------------------------------------------------------------


def test_verify__finds_damage_and_repair_withdraws_it(whole, made):
    before = stored()
    files = whole.info.files
    key = next(iter(read_commits(whole.info, whole.plan)[1].objects))
    content = bytearray(files.read(f"cube.zarr/{key}"))
    content[-9] ^= 1
    files.write(f"cube.zarr/{key}", bytes(content))
    files.remove(["cube.zarr/q/zarr.json"])
    found = verify_run(PLACE)
    assert not found.sound
    assert key in str(found.damaged)
    assert found.skeleton == ["q/zarr.json: missing"]
    assert verify_run(PLACE, repair=True).rebuilt == found.skeleton
    commits = read_commits(whole.info, whole.plan)
    assert 1 not in commits
    sweep(whole.info, whole.plan, commits)
    whole.commit(1)
    assert stored() == before
    assert verify_run(PLACE).sound


def test_write_once__another_content_is_not_replaced(remote):
    files = remote.info.files
    files.write_once("commits/000000.json", b"one")
    files.write_once("commits/000000.json", b"one")
    with pytest.raises(DamagedError, match=r"000000\.json: is there with another content"):
        files.write_once("commits/000000.json", b"two")
    assert files.read("commits/000000.json") == b"one"


def test_check__another_run_or_foreign_objects(whole, s3):
    with pytest.raises(RefusedError, match="holds another run"):
        check(PLACE, {**whole.identity, "kernel_version": "newer"})
    whole.info.files.remove(["run.json"])
    with pytest.raises(RefusedError, match="what another run has left"):
        check(PLACE, {**whole.identity, "kernel_version": "newer"})
    assert check(PLACE, whole.identity) is None
    with pytest.raises(RefusedError, match=r"is not empty and no run directory \(one\)"):
        check(f"s3://{BUCKET}/runs", whole.identity)


def test_write_product__the_seal_comes_last(remote, s3):
    # by their names, chunks of the second variable come after zarr.json
    ds = xr.Dataset(
        {"mean": ("side", [1.0, 2.0]), "zone": ("side", [1, 2])},
        {"side": ["left", "right"]},
        {"derived_product": "mean"},
    )
    place = remote.info.files.below("derived").below("mean-1.zarr")
    s3.reset()
    write_product(place, ds)
    puts = [path.partition("mean-1.zarr/")[2] for method, path, _ in s3.requests if method == "PUT"]
    assert puts[-1] == "zarr.json"
    assert open_product(place).identical(open_product(place))
    assert open_product(place)["side"].values.tolist() == ["left", "right"]
    key = next(key for key in place.everything() if key.endswith("/c.0"))
    place.write(key, b"x" + place.read(key))
    with pytest.raises(DamagedError, match="its content has changed"):
        open_product(place)
    place.remove(["zarr.json"])
    with pytest.raises(DamagedError, match=r"no zarr\.json"):
        open_product(place)
    write_product(place, ds)
    assert open_product(place)["mean"].values.tolist() == [1.0, 2.0]
    assert [found.name for found in products_in(remote.info.files.below("derived"))] == [place.name]
    remove_product(place)
    with pytest.raises(FileNotFoundError):
        open_product(place)


# ---- the lock ----------------------------------------------------------------------------------


def held_by(remote, **changes):
    content = json.dumps({**lease.holder(), **changes}).encode()
    remote.info.files.write("lock", content)
    return content


def test_lease__names_its_holder_and_ends_with_it(remote):
    files = remote.info.files
    with files.lock():
        with pytest.raises(LockedError, match=rf"process {os.getpid()} on {platform.node()} since 20"), files.lock():
            pass
        assert files.is_there("lock")
    assert not files.is_there("lock")


def test_lease__of_a_process_that_was_killed_is_free_at_once(remote):
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    held_by(remote, pid=process.pid)
    with remote.info.files.lock():
        pass


def test_lease__lapses_when_it_is_not_renewed(remote, monkeypatch):
    held_by(remote, host="elsewhere")
    with pytest.raises(LockedError, match=r"on elsewhere since .*lapses 150 s after"), remote.info.files.lock():
        pass
    monkeypatch.setattr(lease, "LEASE_S", -1.0)
    with remote.info.files.lock():
        pass


def test_lease__somebody_elses_is_left(remote, monkeypatch):
    monkeypatch.setattr(lease, "RENEW_S", 0.05)
    with remote.info.files.lock():
        theirs = held_by(remote, host="elsewhere")
        lease.threading.Event().wait(0.3)
    assert remote.info.files.read("lock") == theirs


def test_lease__lost_answers_do_not_lock_oneself_out(remote, s3):
    s3.harm = once("/lock", "lost")
    with remote.info.files.lock():
        assert s3.harmed["lost"] == 1
    assert not remote.info.files.is_there("lock")


# ---- what is refused ---------------------------------------------------------------------------


def one_line(text):
    (line,) = text.strip().splitlines()
    return line


def test_main__refusals_are_one_line(s3, made, main, monkeypatch, tmp_path):
    def errors(*arguments, code=2):
        found, _, text = main(*arguments)
        assert found == code
        assert SECRET not in text
        assert KEY_ID not in text
        return one_line(text)

    assert "runs/none: no run directory" in errors("status", f"s3://{BUCKET}/runs/none")
    assert "there is no such bucket at 127.0.0.1" in errors("status", "s3://nobucket/run")
    assert "there is no such bucket at 127.0.0.1" in errors("run", "spec.toml", "--out", "s3://nobucket/run")
    assert "give a path, or s3://BUCKET/PREFIX" in errors("status", "s3:/measurements/run")
    assert "give a path, or s3://BUCKET/PREFIX" in errors("status", "gs://measurements/run")
    assert "must be s3://BUCKET/PREFIX" in errors("status", "s3://")
    assert "must be s3://BUCKET/PREFIX" in errors("status", f"s3://{BUCKET}/../run")
    assert "no user, password or query" in errors("status", f"s3://{KEY_ID}:{SECRET}@host/run")
    s3.harm = lambda method, path, n: "403"
    assert "refuses access (403 Harm); check AWS_ACCESS_KEY_ID" in errors("status", PLACE)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "obstore", None)
        assert "pip install '.[s3]'" in errors("status", PLACE)
    with monkeypatch.context() as patch:
        patch.delenv("AWS_ACCESS_KEY_ID")
        assert "there are no credentials; set AWS_ACCESS_KEY_ID" in errors("status", PLACE)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{KEY_ID}:{SECRET}@127.0.0.1:1")
    assert "127.0.0.1:1 does not answer" in errors("status", PLACE, code=4)
    assert not (tmp_path / "s3:").exists()


def test_place__never_becomes_a_path(s3, main, write_spec, monkeypatch, tmp_path):
    write_spec(DUFFING)
    code, out, _ = main("run", "spec.toml", "--out", PLACE, "--workers", 0, "--quiet")
    assert code == 0
    assert f"cube: {PLACE}/cube.zarr" in out
    assert f"magpend plot bifurcation {PLACE}" in out
    code, out, _ = main("status", PLACE, "--json")
    assert json.loads(out)[0]["directory"] == PLACE
    code, out, _ = main("plot", "bifurcation", PLACE)
    assert code == 0
    assert "figure: figures/one/bifurcation" in out
    assert sorted(p.suffix for p in (tmp_path / "figures/one").iterdir()) == [".nc", ".png"]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith("s3")]


def test_run__credentials_are_nowhere(s3, write_spec, magpend, environment, tmp_path):
    """A worker process that opens the store itself; nothing written or said names a key."""
    write_spec(DUFFING)
    environment.update({name: value for name, value in os.environ.items() if name.startswith("AWS_")})
    done = magpend("run", "spec.toml", "--out", PLACE, "--workers", 1, "--verbose", "--log", "run.log")
    assert done.returncode == 0, done.stderr
    assert state(PLACE).complete
    files = open_files(PLACE)
    texts = [done.stdout.encode(), done.stderr.encode(), *dict(files.read_each(files.everything())).values()]
    texts += [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert not [text for text in texts if SECRET.encode() in text or KEY_ID.encode() in text]
    assert any(KEY_ID in header for _, _, header in s3.requests)


def test_explorer__reads_a_run_there_as_in_a_folder(whole, made):
    from pipeline.explorer.data.diagram import diagram
    from pipeline.explorer.data.explored import ExploredRun
    from pipeline.explorer.data.view import describe_view

    for task in range(made.plan.n_tasks):
        made.commit(task)
    there, here = ExploredRun.of(PLACE), ExploredRun.of(made.info.directory)
    views = [describe_view(run, False) for run in (there, here)]
    assert views[0]["name"] == PLACE.rpartition("/")[2]
    assert "one" in views[0]["commands"]["attractors"]
    named = {"name": "", "commands": {}}
    assert views[0] | named == views[1] | named
    points = [diagram(run, "frequency", "psi1", {"q": 1}) for run in (there, here)]
    assert points[0] == points[1]
    assert there.refreshed() is there
