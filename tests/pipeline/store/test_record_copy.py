"""The copy of commit records: one request instead of many, and no word against the records themselves."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from pipeline import open_run
from pipeline.runs.mending import sound_commits
from pipeline.runs.verify import describe, verify_run
from pipeline.store.commits import read_commits, scan
from pipeline.store.declared import METADATA
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import RECORD_COPY
from pipeline.store.packing import withdraw
from pipeline.store.places import open_files
from pipeline.store.record_copy import copied_records, copy_text, write_copy
from pipeline.store.run import Run
from pipeline.store.runfile import write_run
from pipeline.store.setup import check
from pipeline.store.skeleton import entries_of, skeleton_files, write_skeleton
from tests.pipeline.store.s3 import BUCKET, KEY_ID, SECRET, Server

PLACE = f"s3://{BUCKET}/runs/copy"


def silent(line):
    pass


@pytest.fixture
def whole(made):
    """A complete run in a folder, with the copy of its records."""
    for index in range(made.plan.n_tasks):
        made.commit(index)
    write_copy(made.info, made.plan, read_commits(made.info, made.plan))
    made.path = made.info.directory / RECORD_COPY
    return made


def sizes_in(made):
    return {f.name: f.stat().st_size for f in (made.info.directory / "commits").iterdir()}


def test_write_copy__has_the_lines_of_the_records(whole):
    lines = whole.path.read_bytes().splitlines(keepends=True)
    assert b"".join(lines[:-1]) == b"".join(f.read_bytes() for f in sorted((whole.path.parent / "commits").iterdir()))
    assert json.loads(lines[-1])["records"] == whole.plan.n_tasks
    assert copied_records(whole.info, sizes_in(whole)) == dict(read_commits(whole.info, whole.plan))


def test_write_copy__of_an_incomplete_run_is_removed(whole):
    (whole.info.directory / "commits/000001.json").unlink()
    write_copy(whole.info, whole.plan, read_commits(whole.info, whole.plan))
    assert not whole.path.exists()


def test_copied_records__count_only_with_the_records_file(whole):
    sizes = sizes_in(whole)
    del sizes["000001.json"]
    sizes["000002.json"] += 1
    assert set(copied_records(whole.info, sizes)) == {0, 3, 4}


@pytest.mark.parametrize("way", ["flip", "cut", "empty", "of another run"])
def test_copied_records__damaged_copy_has_none(whole, way):
    content = bytearray(whole.path.read_bytes())
    if way == "flip":
        content[40] ^= 1
    other = copy_text({0: read_commits(whole.info, whole.plan)[0]}, "0" * 32)
    whole.path.write_bytes({"flip": content, "cut": content[:-9], "empty": b"", "of another run": other}[way])
    assert not copied_records(whole.info, sizes_in(whole))
    found = verify_run(whole.info.directory)
    assert not found.sound
    assert "  damaged: records.jsonl: differs from the commit records" in describe(found, "run", repaired=False)
    assert verify_run(whole.info.directory, repair=True).copies
    assert not whole.path.exists()
    assert verify_run(whole.info.directory).sound


def test_withdraw__removes_the_copy_first(whole, monkeypatch):
    class CrashError(Exception):
        pass

    def crash(self, keys):
        raise CrashError

    real, removed = type(whole.info.files).remove, []

    def remove(self, keys):
        keys = list(keys)
        removed.extend(keys)
        if keys != [RECORD_COPY]:
            raise CrashError
        real(self, keys)

    monkeypatch.setattr(type(whole.info.files), "remove", remove)
    with pytest.raises(CrashError):
        withdraw(whole.info, ["000001.json"])
    assert removed == [RECORD_COPY, "000001.json"]
    assert not whole.path.exists()


def test_copy__is_not_read_where_each_file_is_at_hand(whole):
    """In a folder, and by commands that write, the records themselves are read."""
    (whole.info.directory / "commits/000001.json").write_bytes(b"{}")
    assert set(read_commits(whole.info, whole.plan)) == {0, 2, 3, 4}
    assert set(scan(whole.info, whole.plan)[0]) == {0, 2, 3, 4}
    assert set(sound_commits(whole.info, whole.plan, silent)) == {0, 2, 3, 4}


def test_check__file_of_that_name_by_somebody_else_stays(made, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / RECORD_COPY).write_text('{"mine": 1}\n')
    with pytest.raises(RefusedError, match=r"has a records\.jsonl that no run has left"):
        check(tmp_path / "data", made.identity)


# ---- metadata of the group ---------------------------------------------------------------------


def remade(made, change, **options):
    """The run with other files of the set-up, and a run.json whose digests fit them."""
    contents = skeleton_files(made.spec, made.plan, made.info.identity, made.info.spec_text, made.info.title, **options)
    group = json.loads(contents[METADATA])
    change(group)
    contents = {**contents, METADATA: json.dumps(group).encode()}
    write_skeleton(made.info.files, contents, contents)
    return write_run(made.info.files, made.spec, made.info.identity, made.info.spec_text, entries_of(contents))


def test_group__metadata_that_disagree_are_damage(whole):
    remade(whole, lambda group: group["consolidated_metadata"]["metadata"]["status"]["attributes"].update(units="K"))
    problem = r"zarr\.json: its metadata of status are not those of status/zarr\.json"
    with pytest.raises(DamagedError, match=problem):
        open_run(whole.info.directory)
    assert verify_run(whole.info.directory).skeleton == [problem.replace("\\", "")]


def test_group__of_an_earlier_version_opens_as_before(whole):
    now = open_run(whole.info.directory).load().drop_attrs(deep=False)
    remade(whole, lambda group: group.pop("consolidated_metadata"), described=False)
    assert "axis" not in json.loads((whole.info.directory / "cube.zarr/frequency/zarr.json").read_bytes())["attributes"]
    assert verify_run(whole.info.directory).sound
    assert open_run(whole.info.directory).load().drop_attrs(deep=False).identical(now)
    # damaged, its metadata are written again as they were
    (whole.info.directory / "cube.zarr/frequency/zarr.json").unlink()
    found = verify_run(whole.info.directory, repair=True)
    assert (found.skeleton, found.rebuilt) == ([], ["frequency/zarr.json: missing"])


# ---- over a network ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("moto", reason="needs moto[s3], flask and flask-cors")
    pytest.importorskip("obstore")
    found = Server()
    yield found
    found.close()


@pytest.fixture
def remote(whole, server, monkeypatch):
    """The same run in an object store."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", KEY_ID)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    files, here = open_files(PLACE), whole.info.files
    files.remove(files.everything())
    for key in here.everything():
        if key.rpartition("/")[2] != "lock":
            files.write(key, here.read(key))
    server.reset()
    return files


def keys_asked(server):
    """Keys of the objects that were read; empty texts are listings."""
    found = [path.partition("/runs/copy/")[2] for _, path, _ in server.requests]
    server.reset()
    return found


def test_open_run__requests_do_not_grow_with_the_tasks(remote, server, whole):
    ds = open_run(PLACE)
    asked = keys_asked(server)
    coordinates = [f"cube.zarr/{key}" for key in whole.info.skeleton if not key.endswith("zarr.json")]
    listings = ["", ""]
    assert sorted(asked) == sorted([*listings, "run.json", "records.jsonl", "cube.zarr/zarr.json", *coordinates])
    assert ds.load().identical(open_run(whole.info.directory).load())
    server.reset()
    # without the copy, a request for each record
    remote.remove([RECORD_COPY])
    server.reset()
    open_run(PLACE)
    assert len(keys_asked(server)) == len(asked) + whole.plan.n_tasks


def test_open_run__record_that_is_gone_is_pending(remote, whole):
    remote.remove(["commits/000001.json"])
    run = Run.open(PLACE)
    assert set(run.commits) == {0, 2, 3, 4}
    assert (run.cube().status.values[whole.plan.task(1)] == 0).all()


def test_open_run__record_that_is_damaged_is_found_by_verify(remote):
    content = bytearray(remote.read("commits/000001.json"))
    content[50] ^= 1
    remote.write("commits/000001.json", bytes(content))
    assert len(Run.open(PLACE).commits) == 5  # the copy has the record as it was written, with its own checksum
    found = verify_run(PLACE, repair=True)
    assert list(found.damaged) == ["000001.json"]
    assert not remote.is_there(RECORD_COPY)
    assert set(Run.open(PLACE).commits) == {0, 2, 3, 4}


def test_open_run__group_that_was_changed_is_refused(remote):
    content = remote.read("cube.zarr/zarr.json").replace(b'"units": "s"', b'"units": "h"')
    remote.write("cube.zarr/zarr.json", content)
    with pytest.raises(DamagedError, match=r"zarr\.json: its content has changed"):
        open_run(PLACE)


def test_docs__example_of_the_object_store(remote, server, monkeypatch):
    text = (Path(__file__).parents[3] / "docs/object-stores.md").read_text("utf-8")
    (block,) = re.findall(r"<!-- tested -->\n```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    names = {}
    exec(block.replace("runs/sweep", "runs/copy"), names)
    assert names["ds"].sizes == names["plain"].sizes == names["lazy"].sizes
    assert names["plain"].section.load().equals(names["ds"].section.load())


def test_open_zarr__asks_for_the_group_and_the_indexes(remote, server, whole):
    """What xarray does alone: one request for all metadata, and one for each index unless they are left out."""
    import xarray as xr
    from zarr.storage import ObjectStore

    store = ObjectStore(remote.below("cube.zarr").store, read_only=True)
    ds = xr.open_zarr(store, consolidated=True, zarr_format=3, create_default_indexes=False)
    assert keys_asked(server) == ["cube.zarr/zarr.json"]
    assert set(ds.variables) == set(open_run(whole.info.directory).variables)
    indexed = xr.open_zarr(store, consolidated=True, zarr_format=3)
    server.reset()
    assert indexed.status.dims == ds.status.dims
    indexes = [f"cube.zarr/{name}/c.0" for name in indexed.xindexes]
    xr.open_zarr(store, consolidated=True, zarr_format=3)
    assert sorted(keys_asked(server)) == sorted(["cube.zarr/zarr.json", *indexes])
