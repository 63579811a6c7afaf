"""The copy of commit records: one request instead of many, and no word against the records themselves."""

from __future__ import annotations

import json

import pytest

from pipeline import open_run
from pipeline.runs.run import sound_commits
from pipeline.runs.verify import verify_run
from pipeline.store.arrays import METADATA
from pipeline.store.commits import read_commits, scan, withdraw
from pipeline.store.errors import DamagedError
from pipeline.store.files import RECORD_COPY
from pipeline.store.record_copy import copied_records, write_copy
from pipeline.store.runfile import write_run
from pipeline.store.skeleton import entries_of, skeleton_files, write_skeleton
from tests.pipeline.factories import silent


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


@pytest.mark.slow
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
