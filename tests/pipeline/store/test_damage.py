"""What damage, failing disks, links and foreign files do to a run: nothing is lost without a word."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from pipeline import open_run
from pipeline.compute import execute, task
from pipeline.runs.derive import prune
from pipeline.runs.preview import describe_plan
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import describe, verify_run
from pipeline.runs.zoom import read_source
from pipeline.store import local
from pipeline.store.checksums import seal, unseal
from pipeline.store.commits import marker_key, read_commits, sweep
from pipeline.store.errors import DamagedError, IncompleteError, RefusedError, UnreadableError
from pipeline.store.files import local_path
from pipeline.store.local import LocalFiles
from pipeline.store.records import Records
from pipeline.store.run import Run
from pipeline.store.setup import check, create, establish
from pipeline.store.skeleton import skeleton_files


def silent(line):
    pass


def everything(directory):
    """Content of all files below a folder."""
    return {
        f.relative_to(directory).as_posix(): f.read_bytes()
        for f in directory.rglob("*")
        if f.is_file() and f.name != "lock"
    }


def fail_reading(monkeypatch, part, number=errno.EIO):
    """Let reading of files fail whose path contains `part`."""
    original = local.open_plain

    def open_plain(path, mode, **options):
        if part in path.as_posix():
            raise OSError(number, os.strerror(number), str(path))
        return original(path, mode, **options)

    monkeypatch.setattr(local, "open_plain", open_plain)


def fail_listing(monkeypatch, name, number=errno.EACCES):
    """Let listing of a folder fail."""
    original = os.scandir

    def scandir(path="."):
        if Path(path).name == name:
            raise OSError(number, os.strerror(number), str(path))
        return original(path)

    monkeypatch.setattr(os, "scandir", scandir)


@pytest.fixture
def whole(made):
    """A run directory whose tasks are all committed."""
    for index in range(made.plan.n_tasks):
        made.commit(index)
    return made


def establish_again(made, echo=silent):
    return establish(made.info.directory, made.spec, made.plan, made.identity, made.info.spec_text, echo)


# ---- failing disks -----------------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE])
def test_read_commits__unreadable_record_stops(whole, monkeypatch, number):
    fail_reading(monkeypatch, "000001.json", number)
    with pytest.raises(UnreadableError, match=r"000001\.json: cannot be read .* Nothing was removed"):
        read_commits(whole.info, whole.plan)


@pytest.mark.parametrize("name", ["commits", "cube.zarr", "status"])
def test_read_commits__unreadable_folder_stops(whole, monkeypatch, name):
    fail_listing(monkeypatch, name)
    with pytest.raises(UnreadableError, match=f"{name}: cannot be read"):
        read_commits(whole.info, whole.plan)


def test_run__unreadable_record_removes_nothing(write_spec, sweep_text, tmp_path, monkeypatch):
    path = write_spec(sweep_text)
    run(path, tmp_path / "run", workers=0, echo=silent)
    before = everything(tmp_path / "run")
    with monkeypatch.context() as patch:
        fail_reading(patch, "000000.json")
        with pytest.raises(UnreadableError):
            run(path, tmp_path / "run", workers=0, echo=silent)
    assert everything(tmp_path / "run") == before


def test_sweep__says_what_it_removes(whole):
    (whole.info.directory / marker_key(1)).write_text("{")
    said = []
    commits = read_commits(whole.info, whole.plan, said.append)
    assert said == ["commits/000001.json: torn or damaged; it does not count"]
    n = sweep(whole.info, whole.plan, commits, said.append)
    assert f"removed {n} files that no commit record vouches for: cube.zarr/" in said[1]
    assert sweep(whole.info, whole.plan, commits, said.append) == 0
    assert len(said) == 2


def test_read_commits__names_a_missing_chunk(whole):
    chunk = next(f for f in (whole.info.directory / "cube.zarr/section").iterdir() if f.name != "zarr.json")
    chunk.unlink()
    said = []
    read_commits(whole.info, whole.plan, said.append)
    assert "is missing or has another size; it is computed again" in said[0]


# ---- foreign files and links -------------------------------------------------------------------


def test_check__foreign_cube_stays(made, tmp_path):
    directory = tmp_path / "thesis"
    zarr.create_group(zarr.storage.LocalStore(directory / "cube.zarr"), attributes={"digest": "of mine"})
    before = everything(directory)
    with pytest.raises(RefusedError, match=r"digest of mine.*Give another --out"):
        check(directory, made.identity)
    (directory / "cube.zarr/zarr.json").write_text("{}")
    with pytest.raises(RefusedError, match=r"has cube\.zarr, and nothing in it shows that this run"):
        check(directory, made.identity)
    assert set(everything(directory)) == set(before)


def test_check__records_of_another_run_stay(whole):
    (whole.info.directory / "run.json").unlink()
    other = {**whole.identity, "kernel_version": "newer"}
    with pytest.raises(RefusedError, match="what another run has left"):
        check(whole.info.directory, other)
    assert check(whole.info.directory, whole.identity) is None


def move_away(path, tmp_path):
    """Put a link in the place of something."""
    target = tmp_path / f"elsewhere-{path.name}"
    path.rename(target)
    path.symlink_to(target)
    return target


@pytest.mark.parametrize("name", ["commits", "cube.zarr", "cube.zarr/section"])
def test_run__links_are_not_followed(whole, tmp_path, name):
    target = move_away(whole.info.directory / name, tmp_path)
    before = everything(target)
    for use in (
        lambda: read_commits(whole.info, whole.plan),
        lambda: Run.open(whole.info.directory),
        lambda: establish_again(whole),
        lambda: whole.commit(0),
    ):
        with pytest.raises(RefusedError, match=f"{name}: is a link"):
            use()
    if name != "cube.zarr/section":
        with pytest.raises(RefusedError, match="is a link"):
            sweep(whole.info, whole.plan, Records(whole.info.files, whole.info.digest, {}))
    assert everything(target) == before


def test_sweep__removes_a_link_and_not_what_it_leads_to(whole, tmp_path):
    folder, file = tmp_path / "folder", tmp_path / "file"
    folder.mkdir()
    (folder / "kept").write_text("x")
    file.write_text("x")
    cube = whole.info.directory / "cube.zarr"
    (cube / "status/c.link").symlink_to(file)
    (cube / "status/folder").symlink_to(folder)
    assert verify_run(whole.info.directory).leftovers == ["status/c.link", "status/folder"]
    assert sweep(whole.info, whole.plan, read_commits(whole.info, whole.plan)) == 2
    assert (folder / "kept").read_text() == file.read_text() == "x"


def test_verify__a_linked_chunk_is_damaged(whole, tmp_path):
    chunk = next(f for f in (whole.info.directory / "cube.zarr/section").iterdir() if f.name != "zarr.json")
    move_away(chunk, tmp_path)
    (problem,) = verify_run(whole.info.directory).damaged.values()
    assert problem == f"section/{chunk.name}: is a link"


def test_prune__links_are_not_followed(whole, tmp_path):
    derived, outside = whole.info.directory / "derived", tmp_path / "outside"
    (outside / "x.zarr").mkdir(parents=True)
    (outside / "x.zarr/kept").write_text("x")
    derived.mkdir()
    (derived / "mean-1.zarr").symlink_to(outside / "x.zarr")
    prune(whole.info.directory)
    assert not (derived / "mean-1.zarr").is_symlink()
    derived.rmdir()
    derived.symlink_to(outside)
    with pytest.raises(RefusedError, match="derived: is a link"):
        prune(whole.info.directory)
    assert (outside / "x.zarr/kept").read_text() == "x"


@pytest.mark.parametrize("path", ["s3:/bucket/run", "https://host/run", "gs://b"])
def test_local_path__urls_are_refused(path, write_spec, sweep_text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = write_spec(sweep_text)
    before = sorted(tmp_path.iterdir())
    for use in (
        lambda: run(spec, path, workers=0, echo=silent),
        lambda: list(describe_plan(spec, path)),
        lambda: state(path),
        lambda: open_run(path),
        lambda: verify_run(path),
        lambda: read_source(path),
    ):
        with pytest.raises(RefusedError, match="no folder and no object store; give a path"):
            use()
    assert sorted(tmp_path.iterdir()) == before


def test_local_path__folders():
    for path in ("runs/x", "C:/runs", "/a/b:c/d", "a:b"):
        assert local_path(path) == Path(path)


# ---- what follows from the specification is made again -----------------------------------------


def damage_something(directory, what):
    path = directory / what
    if what.endswith("c.0"):
        data = bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(data)
    else:
        path.unlink()


SKELETON = ["cube.zarr/frequency/zarr.json", "cube.zarr/zarr.json", "cube.zarr/psi1_0/c.0"]


@pytest.mark.parametrize("what", SKELETON)
def test_open_run__damaged_skeleton_is_named(whole, what):
    damage_something(whole.info.directory, what)
    key = what.removeprefix("cube.zarr/")
    with pytest.raises(DamagedError, match=rf"{key}: .*magpend verify --repair") as caught:
        open_run(whole.info.directory)
    assert str(whole.info.directory) in str(caught.value)


@pytest.mark.parametrize("what", SKELETON)
@pytest.mark.parametrize("command", ["verify", "run"])
def test_rebuild__skeleton_has_the_same_bytes(whole, what, command):
    directory = whole.info.directory
    before, said = everything(directory), []
    damage_something(directory, what)
    if command == "verify":
        found = verify_run(directory, repair=True)
        assert found.sound
        said = describe(found, directory, repaired=True)
    else:
        establish_again(whole, said.append)
    assert any(what.removeprefix("cube.zarr/") in line and "rebuilt" in line for line in said)
    assert everything(directory) == before


@pytest.mark.parametrize("change", [lambda p: p.unlink(), lambda p: p.write_text(p.read_text()[:100])])
def test_rebuild__run_json(whole, change):
    directory = whole.info.directory
    before, said = everything(directory), []
    change(directory / "run.json")
    (directory / "cube.zarr/q/zarr.json").unlink()
    info = establish_again(whole, said.append)
    assert "rebuilt from the specification" in said[0]
    assert info.skeleton == whole.info.skeleton
    assert len(read_commits(info, whole.plan)) == whole.plan.n_tasks
    after = everything(directory)
    assert {k: v for k, v in after.items() if k != "run.json"} == {k: v for k, v in before.items() if k != "run.json"}


def test_rebuild__keeps_only_what_fits_its_record(whole):
    directory, said = whole.info.directory, []
    (directory / "run.json").unlink()
    chunk = next(iter(read_commits(whole.info, whole.plan)[1].objects))
    path = directory / "cube.zarr" / chunk
    data = bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)
    info = establish_again(whole, said.append)
    assert set(read_commits(info, whole.plan)) == set(range(whole.plan.n_tasks)) - {1}
    assert any(chunk in line and "computed again" in line for line in said)


def test_rebuild__files_worded_by_another_version(whole):
    """Where the metadata come out otherwise, repair leaves them; a run writes them and their digests anew."""
    directory = whole.info.directory
    data = unseal((directory / "run.json").read_bytes())
    metadata = directory / "cube.zarr/q/zarr.json"
    data["skeleton"]["q/zarr.json"] = {"size": 1, "sha256": "0" * 64}
    (directory / "run.json").write_text(seal(json.dumps(data)))
    found = verify_run(directory, repair=True)
    assert found.skeleton == ["q/zarr.json: its content has changed"]
    assert "another version" in describe(found, directory, repaired=True)[-1]
    establish_again(whole)
    assert verify_run(directory).sound
    assert metadata.is_file()
    assert len(Run.open(directory).commits) == whole.plan.n_tasks


def test_run__rebuilds_and_computes_nothing(write_spec, sweep_text, tmp_path, monkeypatch, bytes_of):
    path, directory = write_spec(sweep_text), tmp_path / "run"
    run(path, directory, workers=0, echo=silent)
    before = bytes_of(directory)
    (directory / "run.json").write_text("{")
    shutil.rmtree(directory / "cube.zarr/frequency")
    monkeypatch.setattr(task, "compute", None)
    assert run(path, directory, workers=0, echo=silent).complete
    assert bytes_of(directory) == before


def test_skeleton_files__same_bytes_again(made):
    arguments = (made.spec, made.plan, made.identity, "text", "title")
    assert skeleton_files(*arguments) == skeleton_files(*arguments)
    # sizes differ only in the text: nothing of this machine or moment is in it
    other = skeleton_files(made.spec, made.plan, made.identity, "other", "title")
    assert {key for key in other if other[key] != skeleton_files(*arguments)[key]} == {"zarr.json"}


def test_create__crash_anywhere_starts_again(made, tmp_path, monkeypatch):
    n_files = len(made.info.skeleton)
    for n in (0, 1, n_files // 2, n_files - 1):
        directory, calls = tmp_path / f"again{n}", []
        original = LocalFiles.write

        def crash(self, key, content, calls=calls, n=n, original=original):
            if len(calls) == n:
                raise KeyboardInterrupt
            calls.append(key)
            original(self, key, content)

        with monkeypatch.context() as patch:
            patch.setattr(LocalFiles, "write", crash)
            with pytest.raises(KeyboardInterrupt):
                create(directory, made.spec, made.plan, made.identity, "text")
        (directory / "cube.zarr/.zarr.json.abc.tmp").write_text("{")  # what a power cut leaves
        (directory / ".run.json.abc.tmp").write_text("{")
        assert check(directory, made.identity) is None
        info = establish(directory, made.spec, made.plan, made.identity, "text", silent)
        sweep(info, made.plan, Records(info.files, info.digest, {}))
        assert verify_run(directory).sound
        assert not list(directory.rglob("*.tmp"))


def test_read_run__another_format(whole):
    path = whole.info.directory / "run.json"
    older = json.loads(path.read_text().replace('"format": 3', '"format": 2'))
    del older["checksum"]  # format 2 had none
    path.write_text(json.dumps(older))
    before = everything(whole.info.directory)
    for use in (lambda: open_run(whole.info.directory), lambda: check(whole.info.directory, whole.identity)):
        with pytest.raises(RefusedError, match=r"format 2, and this magpend reads 3"):
            use()
    assert everything(whole.info.directory) == before


# ---- whether all is there ----------------------------------------------------------------------


def test_run__workers_that_wrote_elsewhere(write_spec, sweep_text, tmp_path, monkeypatch):
    def elsewhere(job, indices, **options):
        yield from ({"task": i, "cells": 1} for i in indices)

    monkeypatch.setattr(execute, "run_tasks", elsewhere)
    with pytest.raises(IncompleteError, match=r"5 of 5 tasks were computed but are not committed here"):
        run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)


def test_run__a_record_that_vanished(write_spec, sweep_text, tmp_path, monkeypatch):
    original = execute.run_tasks

    def losing(job, indices, **options):
        yield from original(job, indices, **options)
        (tmp_path / "run" / marker_key(2)).unlink()

    with monkeypatch.context() as patch:
        patch.setattr(execute, "run_tasks", losing)
        with pytest.raises(IncompleteError, match=r"1 of 5 .*the first is 2"):
            run(write_spec(sweep_text), tmp_path / "run", workers=0, echo=silent)
    assert run(tmp_path / "spec.toml", tmp_path / "run", workers=0, echo=silent).complete


def test_main__exit_codes(write_spec, sweep_text, main, monkeypatch):
    write_spec(sweep_text)
    with monkeypatch.context() as patch:
        patch.setattr(execute, "run_tasks", lambda job, indices, **options: iter(()))
        code, _, errors = main("run", "spec.toml", "--out", "run", "--workers", 0)
    assert (code, "not committed" in errors) == (4, True)
    code, _, errors = main("run", "spec.toml", "--out", "gs://bucket/run")
    assert (code, "no object store" in errors) == (2, True)
    Path("run/cube.zarr/frequency/zarr.json").unlink()
    assert main("status", "run")[0] == 5
    assert main("plot", "bifurcation", "run")[0] == 5


# ---- other readers -----------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_open_zarr__the_cube_explains_itself_to_plain_xarray(whole):
    with xr.open_zarr(whole.info.directory / "cube.zarr", chunks=None) as ds:
        assert ds["state"].values.tolist() == ["psi1", "psi2", "psi1_dot", "psi2_dot"]
        assert ds["state_units"].values.tolist() == ["rad", "rad", "rad/s", "rad/s"]
        assert ds["link"].values.tolist() == ["psi1", "psi2"]
        assert set(ds.data_vars) == {v.name for v in whole.plan.variables}
        assert "units" not in ds["section"].attrs
        assert {"psi1_dot_0", "psi2_dot_0", "frequency", "q"} <= set(ds.coords)


def test_to_netcdf__cube(whole, tmp_path):
    ds = open_run(whole.info.directory)
    ds.to_netcdf(tmp_path / "cube.nc", engine="scipy")
    with xr.open_dataset(tmp_path / "cube.nc", engine="scipy", decode_cf=False) as raw:
        assert raw.sizes["state"] == 4
    with xr.open_dataset(tmp_path / "cube.nc", engine="scipy") as found:
        assert np.array_equal(found["section"], ds["section"])
        assert found["state"].values.tolist() == ds["state"].values.tolist()
        assert found.attrs["spec"] == ds.attrs["spec"]


def test_open_run__says_what_made_it(whole):
    ds = open_run(whole.info.directory)
    for name in ("source", "created", "host"):
        assert ds.attrs[name]
    assert ds.attrs["created"] == whole.info.provenance["created"]
    assert "created" not in (whole.info.directory / "cube.zarr/zarr.json").read_text()
