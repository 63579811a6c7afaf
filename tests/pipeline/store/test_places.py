"""Places that no run may take, disks that fail, set-ups that stopped: nothing is lost without a word."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.compute import execute, task
from pipeline.runs.verify import describe, verify_run
from pipeline.store import commits, local
from pipeline.store.commits import marker_key, read_commits, sweep
from pipeline.store.errors import IncompleteError, RefusedError, UnreadableError
from pipeline.store.files import RECORD_COPY
from pipeline.store.run import RunDirectory
from pipeline.store.setup import check, establish
from pipeline.store.skeleton import skeleton_files
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.factories import duffing, finished, quietly, silent

SPEC = duffing(execution="trajectories_per_task = 2", tolerance=1e-5)


def everything(directory):
    """Content of all files below a folder."""
    files = [f for f in directory.rglob("*") if f.is_file() and f.name != "lock"]
    return {f.relative_to(directory).as_posix(): f.read_bytes() for f in files}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("places")
    finished(folder, SPEC)
    return folder


@pytest.fixture
def place(sound, tmp_path):
    """A copy of a finished run, beside its specification."""
    shutil.copytree(sound, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


@pytest.fixture
def whole(made):
    """A run directory whose tasks are all committed."""
    for index in range(made.plan.n_tasks):
        made.commit(index)
    return made


def establish_again(made, echo=silent):
    return establish(made.info.directory, made.spec, made.plan, made.identity, made.info.spec_text, echo)


# ---- places that no run may take ---------------------------------------------------------------


@pytest.mark.parametrize("below", ["cube.zarr/new", "commits/new", "new", "cube.zarr", "derived/a/b"])
def test_run__refuses_a_place_inside_of_another_run(place, below):
    before = everything(place)
    with pytest.raises(RefusedError, match=r"lies inside of the run directory .*; give another --out"):
        quietly(place.with_name("spec.toml"), place / below)
    assert everything(place) == before


FOREIGN = {
    "thesis.tex": ("x", "is not empty and no run directory"),
    "lock.json": ('{"packages": {}}', "has a lock.json that no run has left"),
    "lock.json of nothing": ("", "has a lock.json that no run has left"),
    "timings.jsonl": ('{"name": "somebody"}\n', "has a timings.jsonl that no run has left"),
    "timings.jsonl of numbers": ("1 2 3\n", "has a timings.jsonl that no run has left"),
    RECORD_COPY: ('{"mine": 1}\n', rf"has a {RECORD_COPY} that no run has left"),
    "cube.zarr/zarr.json": ('{"attributes": {"digest": "of mine"}}', "digest of mine"),
    "cube.zarr/zarr.json of nothing": ("{}", "and nothing in it shows that this run"),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_check__a_folder_with_a_file_of_somebody_else_stays(made, tmp_path, what):
    text, words = FOREIGN[what]
    path = tmp_path / "theirs" / what.partition(" of ")[0]
    path.parent.mkdir(parents=True)
    assert check(tmp_path / "theirs", made.identity) is None
    path.write_text(text)
    with pytest.raises(RefusedError, match=f"(?s){words}.*[Gg]ive another --out"):
        check(tmp_path / "theirs", made.identity)
    assert [f.read_text() for f in (tmp_path / "theirs").rglob("*") if f.is_file()] == [text]
    with pytest.raises(RefusedError, match="is a file"):
        check(path, made.identity)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RefusedError, match="is a link that leads nowhere; remove it, or give another --out"):
        check(link, made.identity)


def test_check__another_run_stays_and_the_difference_is_named(whole):
    directory, other = whole.info.directory, {**whole.identity, "versions": {"engine": 1000}}
    assert check(directory, whole.identity) == whole.info
    with pytest.raises(RefusedError, match=r"versions.engine: \d+ in the directory, 1000 now"):
        check(directory, other)
    (directory / "run.json").unlink()
    with pytest.raises(RefusedError, match="what another run has left"):
        check(directory, other)
    assert check(directory, whole.identity) is None


# ---- disks that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE])
def test_read__an_unreadable_record_stops_and_removes_nothing(place, monkeypatch, number):
    before, original = everything(place), local.open_plain

    def open_plain(path, mode, **options):
        if path.name == "000001.json":
            raise OSError(number, os.strerror(number), str(path))
        return original(path, mode, **options)

    monkeypatch.setattr(local, "open_plain", open_plain)
    for use in (RunDirectory.open, verify_run, lambda d: quietly(place.with_name("spec.toml"), d)):
        with pytest.raises(UnreadableError, match=r"000001\.json: cannot be read .* Nothing was removed"):
            use(place)
    assert everything(place) == before


def test_scan__commits_that_never_stay_the_same_stop(place, monkeypatch):
    """Somebody packs and unpacks for ever: reading ends all the same."""
    opened, calls = RunDirectory.open(place), []

    def names(folder):
        calls.append(folder)
        return ["000000-000999.jsonl"] if len(calls) % 2 else []

    monkeypatch.setattr(commits, "_names", names)
    with pytest.raises(UnreadableError, match="changes while it is read"):
        commits.scan(opened.info, opened.plan)


def fail_at(monkeypatch, name, kind):
    """Let calls of the system fail without a path, as `write` and `fsync` do; returns the calls that did."""
    original, failed = getattr(os, kind), []

    def call(first, *arguments, **options):
        target = os.readlink(f"/proc/self/fd/{first}") if isinstance(first, int) else str(first)
        if name in target:
            failed.append(target)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(first, *arguments, **options)

    monkeypatch.setattr(os, kind, call)
    return failed


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc to name open files")
@pytest.mark.parametrize(
    "command",
    [
        ("plot", "bifurcation", "run"),
        ("plot", "bifurcation", "run", "--out", "figure.pdf"),
        ("analyse", "attractors", "run", "--csv", "table.csv", "--no-polish", "--no-extend"),
        ("report", "run", "--out", "page.html", "--only-stored"),
    ],
)
def test_commands__name_what_could_not_be_written(place, main, monkeypatch, command):
    fail_at(monkeypatch, str(place.parent), "fsync")
    code, _, said = main(*command)
    assert code == 4, said
    assert "cannot be written (No space left on device); make room on its disk" in said
    assert "[Errno" not in said


@pytest.mark.parametrize("moment", ["before writing", "while writing"])
def test_run__removed_while_it_goes_on_ends_and_can_be_made_again(sound, tmp_path, monkeypatch, bytes_of, moment):
    (tmp_path / "spec.toml").write_text(SPEC)
    write_task, write_block, done = task.write_task, commits.write_block, []

    def writing_task(info, plan, index, *rest):
        done.append(index)
        if len(done) == 2 and moment == "before writing":
            shutil.rmtree(tmp_path / "run")
        write_task(info, plan, index, *rest)

    def writing_block(cube, *rest):
        if len(done) == 2 and moment == "while writing" and (tmp_path / "run").exists():
            shutil.rmtree(tmp_path / "run")
            # as zarr would make it, had it opened the array before
            (tmp_path / "run/cube.zarr/section").mkdir(parents=True)
        return write_block(cube, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(task, "write_task", writing_task)
        patch.setattr(commits, "write_block", writing_block)
        with pytest.raises(Exception, match=r"removed|gone|missing|damaged|not found|No such|fail"):
            quietly(tmp_path / "spec.toml", tmp_path / "run")
    assert quietly(tmp_path / "spec.toml", tmp_path / "run").complete
    assert bytes_of(tmp_path / "run") == bytes_of(sound / "run")


def test_run__ends_only_if_every_task_is_committed_here(place, main, monkeypatch):
    """Workers that wrote elsewhere, and a record that vanished."""
    original = execute.run_tasks

    def elsewhere(job, indices, **options):
        yield from ({"task": i, "cells": 1} for i in indices)

    def losing(job, indices, **options):
        yield from original(job, indices, **options)
        (place.with_name("losing") / marker_key(2)).unlink()

    for function, words in (
        (elsewhere, "4 of 4 tasks were computed but are not committed here"),
        (losing, "1 of 4 .*the first is 2"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(execute, "run_tasks", function)
            with pytest.raises(IncompleteError, match=words):
                quietly(place.with_name("spec.toml"), place.with_name(function.__name__))
    with monkeypatch.context() as patch:
        patch.setattr(execute, "run_tasks", elsewhere)
        assert main("run", "spec.toml", "--out", "losing", "--workers", 0)[0] == 4
    assert quietly(place.with_name("spec.toml"), place.with_name("losing")).complete


# ---- setting up, sweeping, rebuilding ------------------------------------------------------------


def test_sweep__removes_and_names_what_no_record_vouches_for_and_nothing_else(whole, tmp_path):
    """A chunk without its record, a file of a crash, and links: not what they lead to."""
    directory, said = whole.info.directory, []
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").write_text("x")
    for name in ("derived/kept.txt", "figures/kept.txt"):
        (directory / name).parent.mkdir()
        (directory / name).write_text("x")
    before = everything(directory)
    (directory / "cube.zarr/section/c.0.0.abc.partial").write_bytes(b"x")
    (directory / "cube.zarr/status/c.link").symlink_to(outside / "kept")
    (directory / "cube.zarr/status/folder").symlink_to(outside)
    leftovers = ["section/c.0.0.abc.partial", "status/c.link", "status/folder"]
    assert verify_run(directory).leftovers == leftovers
    found = read_commits(whole.info, whole.plan)
    assert sweep(whole.info, whole.plan, found, said.append) == 3
    assert "removed 3 files that no commit record vouches for: cube.zarr/" in said[0]
    assert everything(directory) == before
    assert (outside / "kept").read_text() == "x"
    (directory / marker_key(1)).write_text("{")
    chunk = next((directory / "cube.zarr/section").glob("c.0.*"))
    chunk.unlink()
    commits_left = read_commits(whole.info, whole.plan)
    assert set(commits_left) == set(range(whole.plan.n_tasks)) - {0, 1}
    assert sweep(whole.info, whole.plan, commits_left) > 0
    assert sweep(whole.info, whole.plan, commits_left) == 0


@pytest.mark.slow
def test_rebuild__files_worded_by_another_version(whole):
    """Where the metadata come out otherwise, repair leaves them; a run writes them and their digests anew."""
    directory = whole.info.directory
    data = unseal((directory / "run.json").read_bytes())
    data["skeleton"]["q/zarr.json"] = {"size": 1, "sha256": "0" * 64}
    (directory / "run.json").write_text(seal(json.dumps(data)))
    found = verify_run(directory, repair=True)
    assert found.skeleton == ["q/zarr.json: its content has changed"]
    assert "another version" in describe(found, directory, repaired=True)[-1]
    establish_again(whole)
    assert verify_run(directory).sound
    assert len(RunDirectory.open(directory).commits) == whole.plan.n_tasks


def test_skeleton_files__hold_nothing_of_this_machine_or_moment(made):
    one, same, other = (
        skeleton_files(made.spec, made.plan, made.identity, text, "title") for text in ("text", "text", "other")
    )
    assert one == same
    assert {key for key in other if other[key] != one[key]} == {"zarr.json"}


# ---- other readers -----------------------------------------------------------------------------
