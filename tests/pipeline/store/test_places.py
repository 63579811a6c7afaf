"""What lies where a run directory has something else, and places that no run may take."""

from __future__ import annotations

import errno
import json
import os
import shutil

import pytest

from pipeline.compute import task
from pipeline.runs.run import run
from pipeline.runs.verify import verify_run
from pipeline.store import commits
from pipeline.store.errors import RefusedError, UnreadableError

SPEC = """
kind = "sweep"
model = "duffing"
[axes]
frequency_hz = { start = 0.15, stop = 0.25, num = 4 }
[initial_conditions]
kind = "list"
points = [[0.1, 0.0], [1.0, 0.2]]
[integration]
rtol = 1e-5
atol = 1e-5
n_transient = 1
n_keep = 2
[execution]
trajectories_per_task = 2
"""


def silent(line):
    pass


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("places")
    (folder / "spec.toml").write_text(SPEC)
    run(folder / "spec.toml", folder / "run", workers=0, echo=silent)
    return folder


@pytest.fixture
def whole(finished, tmp_path):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


def files_of(directory):
    tops = (directory / "cube.zarr", directory / "commits")
    return {f.relative_to(directory): f.read_bytes() for top in tops for f in top.rglob("*") if f.is_file()}


# ---- folders for files, and files for folders --------------------------------------------------

ODD = [
    "commits/000001.json",
    "cube.zarr/section/c.1.0.0.0",
    "cube.zarr/zarr.json",
    "cube.zarr/section/zarr.json",
    "cube.zarr/frequency/zarr.json",
    "cube.zarr/section",
    "cube.zarr",
    "commits",
]


def misplace(path):
    """Put a folder with a file in the place of a file, or a file in that of a folder."""
    was_folder = path.is_dir()
    shutil.rmtree(path) if was_folder else path.unlink(missing_ok=True)
    if was_folder:
        path.write_text("somebody's")
    else:
        path.mkdir()
        (path / "theirs").write_text("somebody's")


@pytest.mark.parametrize("place", ODD)
def test_run__moves_aside_what_is_in_the_way(finished, whole, main, place):
    misplace(whole / place)
    assert main("status", "run")[0] in (0, 5)
    code, said, _ = main("verify", "run")
    assert code == 5
    assert f"{place}: is a folder where a file should be" in said
    code, _, said = main("run", "spec.toml", "--out", "run", "--workers", 0)
    assert code == 0, said
    assert f"{place}: is a folder where a file should be" in said
    assert files_of(whole) == files_of(finished / "run")
    (kept,) = [f for f in (whole / "aside").rglob("*") if f.is_file()]
    assert kept.read_text() == "somebody's"
    assert verify_run(whole).sound


def test_verify__repair_moves_a_pack_aside(whole):
    misplace(whole / "commits/000000-000999.jsonl")
    found = verify_run(whole, repair=True)
    assert found.odd == ["commits/000000-000999.jsonl"]
    assert verify_run(whole).sound


def test_scan__commits_that_never_stay_the_same_stop(whole, monkeypatch):
    """Somebody packs and unpacks for ever: reading ends all the same."""
    from pipeline.store.run import Run

    opened = Run.open(whole)
    calls = []

    def names(folder):
        calls.append(folder)
        return ["000000-000999.jsonl"] if len(calls) % 2 else []

    monkeypatch.setattr(commits, "_names", names)
    with pytest.raises(UnreadableError, match="changes while it is read"):
        commits.scan(opened.info, opened.plan)


# ---- places that no run may take ---------------------------------------------------------------


@pytest.mark.parametrize("below", ["cube.zarr/new", "commits/new", "new", "cube.zarr", "derived/a/b"])
def test_run__refuses_a_place_inside_of_another_run(finished, whole, below):
    before = files_of(whole)
    with pytest.raises(RefusedError, match=r"lies inside of the run directory .*; give another --out"):
        run(whole.parent / "spec.toml", whole / below, workers=0, echo=silent)
    assert files_of(whole) == before


def test_run__refuses_a_link_that_leads_nowhere(whole):
    place = whole.parent / "link"
    place.symlink_to(whole.parent / "nowhere")
    with pytest.raises(RefusedError, match="is a link that leads nowhere; remove it, or give another --out"):
        run(whole.parent / "spec.toml", place, workers=0, echo=silent)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lock.json", '{"packages": {}}'),
        ("lock.json", ""),
        ("timings.jsonl", '{"name": "somebody"}\n'),
        ("timings.jsonl", "1 2 3\n"),
    ],
)
def test_run__refuses_a_folder_with_a_file_of_somebody_else(tmp_path, name, text):
    (tmp_path / "spec.toml").write_text(SPEC)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).write_text(text)
    with pytest.raises(RefusedError, match=f"has a {name} that no run has left; give another --out"):
        run(tmp_path / "spec.toml", tmp_path / "run", workers=0, echo=silent)
    assert (tmp_path / "run" / name).read_text() == text


def test_run__takes_what_a_killed_one_has_left(tmp_path):
    """A lock's note, timings and empty folders are left if a run is killed, or removed while it goes on."""
    (tmp_path / "spec.toml").write_text(SPEC)
    (tmp_path / "run/cube.zarr/section").mkdir(parents=True)
    note = {"host": "here", "pid": 1, "since": "2026-01-01T00:00:00+00:00"}
    (tmp_path / "run/lock.json").write_text(json.dumps(note))
    (tmp_path / "run/timings.jsonl").write_text('{"task": 0, "cells": 2}\n')
    assert run(tmp_path / "spec.toml", tmp_path / "run", workers=0, echo=silent).complete


@pytest.mark.parametrize("moment", ["before writing", "while writing"])
def test_run__removed_while_it_goes_on_ends_and_can_be_made_again(finished, tmp_path, monkeypatch, moment):
    (tmp_path / "spec.toml").write_text(SPEC)
    original, done = task.write_task, []

    def write_task(info, plan, index, *rest):
        done.append(index)
        if len(done) == 2 and moment == "before writing":
            shutil.rmtree(tmp_path / "run")
        original(info, plan, index, *rest)

    block = commits.write_block

    def write_block(cube, *rest):
        if len(done) == 2 and moment == "while writing" and (tmp_path / "run").exists():
            shutil.rmtree(tmp_path / "run")
            # as zarr would make it, had it opened the array before
            (tmp_path / "run/cube.zarr/section").mkdir(parents=True)
        return block(cube, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(task, "write_task", write_task)
        patch.setattr(commits, "write_block", write_block)
        with pytest.raises(Exception, match=r"removed|gone|missing|damaged|not found|No such|fail"):
            run(tmp_path / "spec.toml", tmp_path / "run", workers=0, echo=silent)
    assert run(tmp_path / "spec.toml", tmp_path / "run", workers=0, echo=silent).complete
    assert files_of(tmp_path / "run") == files_of(finished / "run")


# ---- errors of writing -------------------------------------------------------------------------


def fail_at(monkeypatch, name, kind):
    """Let the n-th call of the system fail without a path, as `write` and `fsync` do."""
    original = getattr(os, kind)

    def call(first, *arguments, **options):
        target = os.readlink(f"/proc/self/fd/{first}") if isinstance(first, int) else str(first)
        if name in target:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(first, *arguments, **options)

    monkeypatch.setattr(os, kind, call)


@pytest.mark.parametrize("kind", ["fsync", "replace", "mkdir"])
@pytest.mark.parametrize("name", ["run.json", "cube.zarr", "commits", "section", "000001.json"])
def test_run__names_what_could_not_be_written(tmp_path, main, monkeypatch, name, kind):
    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("needs /proc to name open files")
    (tmp_path / "spec.toml").write_text(SPEC)
    fail_at(monkeypatch, name, kind)
    code, _, said = main("run", "spec.toml", "--out", "run", "--workers", 0)
    if code:  # else that call is not made there
        assert code == 4, said
        assert name in said
        assert "cannot be written (No space left on device); make room on its disk" in said


@pytest.mark.parametrize(
    "command",
    [
        ("plot", "bifurcation", "run"),
        ("plot", "bifurcation", "run", "--out", "figure.pdf"),
        ("analyse", "attractors", "run", "--csv", "table.csv", "--no-polish", "--no-extend"),
        ("report", "run", "--out", "page.html", "--only-stored"),
    ],
)
def test_commands__name_what_could_not_be_written(whole, main, monkeypatch, command):
    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("needs /proc to name open files")
    fail_at(monkeypatch, str(whole.parent), "fsync")
    code, _, said = main(*command)
    assert code == 4, said
    assert "cannot be written (No space left on device); make room on its disk" in said
    assert "[Errno" not in said
