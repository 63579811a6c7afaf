"""The commit protocol: what is not committed is never data, what is damaged is never read."""

from __future__ import annotations

import json
import multiprocessing
import shutil

import numpy as np
import pytest
import zarr

from magpend_core.models import load_model
from pipeline import open_run
from pipeline.layout.schema import base_variables
from pipeline.runs.verify import describe, verify_run
from pipeline.store import commits as store_commits
from pipeline.store import local
from pipeline.store.commits import marker_key, read_commits, sweep, write_task
from pipeline.store.errors import DamagedError, LockedError, RefusedError
from pipeline.store.local import LocalFiles, writer_lock
from pipeline.store.records import Records
from pipeline.store.run import Run
from pipeline.store.runfile import read_run
from pipeline.store.setup import check, create

VARIABLES = base_variables(load_model())

CUBE_WRITES = len(VARIABLES)


def read_all(directory):
    """Every variable as `open_run` shows it."""
    ds = open_run(directory)
    return {v.name: ds[v.name].values for v in VARIABLES}


def none_of(info):
    """No record at all."""
    return Records(info.files, info.digest, {})


def assert_pending(directory, plan, index):
    block, values = plan.task(index), read_all(directory)
    for variable in VARIABLES:
        found = values[variable.name][block]
        assert np.array_equal(found, np.full_like(found, variable.fill), equal_nan=True), variable.name


def assert_data(directory, made, index):
    found = read_all(directory)
    for name, values in made.values(index).items():
        assert np.array_equal(found[name][made.plan.task(index)], values), name


def test_create__schema_versus_store(made):
    group = zarr.open_group(made.info.directory / "cube.zarr", mode="r")
    for v in VARIABLES:
        array = group[v.name]
        assert str(array.dtype) == v.dtype
        assert array.metadata.dimension_names == (*made.plan.dims, *v.own_dims)
        assert array.chunks == made.plan.chunks(v)
        assert np.array_equal(array.fill_value, v.fill, equal_nan=True)
        assert array.attrs.get("units", "") == v.units
        codecs = array.metadata.to_dict()["codecs"]
        assert codecs[-1]["name"] == "crc32c"


def test_write_task__reads_back(made):
    made.commit(1)
    assert_data(made.info.directory, made, 1)
    assert_pending(made.info.directory, made.plan, 0)
    assert set(read_commits(made.info, made.plan)) == {1}


def test_write_task__fill_values_leave_files(made):
    made.commit(0)
    marker = json.loads((made.info.directory / marker_key(0)).read_text())
    assert sorted({key.split("/")[0] for key in marker["objects"]}) == sorted(v.name for v in VARIABLES)
    for key in marker["objects"]:
        assert (made.info.directory / "cube.zarr" / key).is_file()


def test_write_task__refuses_wrong_shapes_and_cut_chunks(made):
    values = made.values(0)
    values["status"] = values["status"][..., :1]
    with pytest.raises(ValueError, match="status"):
        write_task(made.info, made.plan, 0, values, {})
    with pytest.raises(ValueError, match="cuts chunks"):
        store_commits.chunk_keys("x", (slice(1, 4),), (4,), (8,))
    with pytest.raises(ValueError, match="cuts chunks"):
        store_commits.chunk_keys("x", (slice(0, 3),), (4,), (8,))
    assert store_commits.chunk_keys("x", (slice(4, 7),), (4,), (7,)) == ["x/c.1"]


class CrashError(Exception):
    """Stands for a power cut."""


def crash_at(monkeypatch, module, name, n):
    """Let the n-th call of a function that a module uses crash; return the list of calls."""
    calls = []
    original = getattr(module, name)

    def wrapped(*arguments, **options):
        calls.append(arguments)
        if len(calls) == n:
            raise CrashError
        return original(*arguments, **options)

    monkeypatch.setattr(module, name, wrapped)
    return calls


STEPS = [
    *((store_commits, "write_block", n) for n in range(1, CUBE_WRITES + 1)),
    (LocalFiles, "sync", 1),
    *((local, "sync_file", n) for n in (1, CUBE_WRITES)),
    (local, "sync_folder", 1),
    (LocalFiles, "read", 1),
    (LocalFiles, "read", CUBE_WRITES),
    (LocalFiles, "write_once", 1),
]


@pytest.mark.parametrize(("module", "name", "n"), STEPS)
def test_write_task__crash_between_steps_leaves_pending(made, monkeypatch, module, name, n):
    made.commit(1)
    with monkeypatch.context() as patch:
        crash_at(patch, module, name, n)
        with pytest.raises(CrashError):
            made.commit(0)
    assert_pending(made.info.directory, made.plan, 0)
    commits = read_commits(made.info, made.plan)
    assert set(commits) == {1}
    sweep(made.info, made.plan, commits)
    assert_data(made.info.directory, made, 1)
    made.commit(0)
    assert_data(made.info.directory, made, 0)


def test_write_task__crash_before_the_marker_is_renamed(made, monkeypatch):
    from pathlib import Path

    def crash(self, target):
        if target.parent.name == "commits":
            raise CrashError
        return original(self, target)

    original = Path.replace
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", crash)
        with pytest.raises(CrashError):
            made.commit(0)
    leftovers = list((made.info.directory / "commits").iterdir())
    assert len(leftovers) == 1
    assert_pending(made.info.directory, made.plan, 0)
    assert sweep(made.info, made.plan, none_of(made.info)) == 1 + CUBE_WRITES
    assert list((made.info.directory / "commits").iterdir()) == []


def test_write_task__order_of_syncs(made, monkeypatch):
    """Files, then folders, then the marker under a temporary name, then its folder."""
    import os

    log = []
    original = os.fsync

    def fsync(handle):
        path = os.readlink(f"/proc/self/fd/{handle}")
        log.append(os.path.relpath(path, made.info.directory))
        original(handle)

    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("needs /proc to name open files")
    monkeypatch.setattr(os, "fsync", fsync)
    made.commit(0)
    kinds = [
        "marker" if p.endswith(".tmp") else "commits" if p == "commits" else "file" if "/c" in p else "folder"
        for p in log
    ]
    order = [k for i, k in enumerate(kinds) if i == 0 or kinds[i - 1] != k]
    assert order == ["file", "folder", "marker", "commits"]
    assert kinds.count("file") == CUBE_WRITES
    assert {p for p, k in zip(log, kinds, strict=True) if k == "folder"} == {
        "cube.zarr",
        *(f"cube.zarr/{v.name}" for v in VARIABLES),
    }


def test_read__leftover_chunk_is_not_data(made):
    made.commit(0)
    (made.info.directory / marker_key(0)).unlink()
    assert_pending(made.info.directory, made.plan, 0)
    ds = open_run(made.info.directory, chunks={})
    assert (ds.status.compute() == 0).all()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: text.replace('"digest": "', '"digest": "0'),
        lambda text: text.replace('"task": 0', '"task": 1'),
        lambda text: text.replace('"task": 0', '"task": 99'),
        lambda text: text.replace('"objects"', '"object"'),
        lambda text: "[]",
        lambda text: text.replace('"size": ', '"size": 1'),
    ],
)
def test_read_commits__invalid_markers_do_not_count(made, change):
    made.commit(0)
    path = made.info.directory / marker_key(0)
    changed = change(path.read_text())
    assert changed != path.read_text()
    path.write_text(changed)
    assert read_commits(made.info, made.plan) == {}
    assert_pending(made.info.directory, made.plan, 0)


def test_read_commits__missing_or_short_chunk(made):
    made.commit(0)
    made.commit(1)
    objects = read_commits(made.info, made.plan)[0].objects
    chunk = made.info.directory / "cube.zarr" / next(k for k in objects if k.startswith("section"))
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-1])
    assert set(read_commits(made.info, made.plan)) == {1}
    chunk.unlink()
    assert set(read_commits(made.info, made.plan)) == {1}
    assert_pending(made.info.directory, made.plan, 0)


@pytest.mark.parametrize("name", [v.name for v in VARIABLES])
def test_flipped_bit__is_never_read_as_data(made, name):
    made.commit(0)
    key = next(k for k in read_commits(made.info, made.plan)[0].objects if k.startswith(f"{name}/"))
    chunk = made.info.directory / "cube.zarr" / key
    whole = chunk.read_bytes()
    run = Run.open(made.info.directory)
    for place in np.random.default_rng(0).integers(0, 8 * len(whole), 20):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << (place % 8)
        chunk.write_bytes(damaged)
        with pytest.raises(DamagedError, match=rf"{key}: is not what was written"):
            run.cube()[name].values  # noqa: B018
        with pytest.raises(Exception, match=r"(?i)checksum|crc32c|is not what was written"):
            run.cube(check=False)[name].values  # noqa: B018
    found = verify_run(made.info.directory)
    assert not found.sound
    assert list(found.damaged) == ["000000.json"]
    assert key in found.damaged["000000.json"]


def test_flipped_bit__repair_makes_it_pending(made):
    made.commit(0)
    made.commit(1)
    chunk = made.info.directory / "cube.zarr/status" / "c.0.0.0.0"
    data = bytearray(chunk.read_bytes())
    data[0] ^= 1
    chunk.write_bytes(data)
    found = verify_run(made.info.directory, repair=True)
    assert "withdrawn" in describe(found, "d", repaired=True)[-1]
    assert verify_run(made.info.directory).sound
    assert_pending(made.info.directory, made.plan, 0)
    assert_data(made.info.directory, made, 1)


def test_verify__metadata_and_leftovers(made):
    made.commit(0)
    (made.info.directory / "cube.zarr/status/c.9.9").write_bytes(b"x")
    assert verify_run(made.info.directory).leftovers == ["status/c.9.9"]
    assert verify_run(made.info.directory).sound
    metadata = made.info.directory / "cube.zarr/status/zarr.json"
    metadata.write_text(metadata.read_text().replace('"fill_value": 0', '"fill_value": 1'))
    found = verify_run(made.info.directory)
    assert found.skeleton == ["status/zarr.json: its content has changed"]
    assert not found.sound


def test_sweep__touches_nothing_else(made):
    made.commit(0)
    directory = made.info.directory
    for name in ("derived", "figures"):
        (directory / name).mkdir()
        (directory / name / "kept.txt").write_text("x")
    (directory / "cube.zarr/section/c.0.0.abc.partial").write_bytes(b"x")
    before = sorted(p for p in directory.rglob("*") if p.is_file() and not p.name.endswith("partial"))
    assert sweep(made.info, made.plan, read_commits(made.info, made.plan)) == 1
    assert sorted(p for p in directory.rglob("*") if p.is_file()) == before


def test_check__difference_key_by_key(made):
    assert check(made.info.directory, made.identity) == made.info
    other = {**made.identity, "kernel_version": "newer"}
    with pytest.raises(RefusedError, match="kernel_version: test-kernel in the directory, newer now"):
        check(made.info.directory, other)


def test_check__directories_that_are_not_empty_are_refused(made, tmp_path):
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    assert check(foreign, made.identity) is None
    (foreign / "thesis.tex").write_text("x")
    with pytest.raises(RefusedError, match=r"thesis\.tex"):
        check(foreign, made.identity)
    with pytest.raises(RefusedError, match="is a file"):
        check(foreign / "thesis.tex", made.identity)


def test_create__crash_during_set_up_starts_again(made, monkeypatch, tmp_path):
    directory = tmp_path / "again"
    with monkeypatch.context() as patch:
        crash_at(patch, LocalFiles, "write", 1 + len(made.info.skeleton))
        with pytest.raises(CrashError):
            create(directory, made.spec, made.plan, made.identity, "text")
    with pytest.raises(RefusedError, match="no run directory"):
        read_run(directory)
    assert check(directory, made.identity) is None
    create(directory, made.spec, made.plan, made.identity, "text")
    assert check(directory, made.identity) is not None


def test_read_run__damaged(made):
    path = made.info.directory / "run.json"
    for text in (path.read_text()[:-20], path.read_text().replace('"n_keep": 3', '"n_keep": 4')):
        path.write_text(text)
        with pytest.raises(DamagedError, match="rebuilt"):
            read_run(made.info.directory)


def _hold(directory, ready, done):
    with writer_lock(directory):
        ready.set()
        done.wait(30)


def test_writer_lock__another_process(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(tmp_path, ready, done))
    process.start()
    try:
        assert ready.wait(60)
        said = rf"another magpend run is writing here \(process {process.pid} on .+ since 20.+\)\. Wait"
        with pytest.raises(LockedError, match=said), writer_lock(tmp_path):
            pass
    finally:
        process.kill()
        process.join()
    with writer_lock(tmp_path):
        pass
    assert not (tmp_path / "lock.json").exists()


def test_same_bytes__whatever_the_order(made, tmp_path, bytes_of):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    first = bytes_of(made.info.directory)
    shutil.rmtree(made.info.directory)
    create(made.info.directory, made.spec, made.plan, made.identity, made.info.spec_text)
    for index in reversed(range(made.plan.n_tasks)):
        made.commit(index)
        made.commit(index)
    assert bytes_of(made.info.directory) == first


def test_create__axes_keep_the_order_of_the_file(tmp_path, write_spec):
    """The order of the axes is that of the cube's dims: what reads run.json must see it."""
    from pipeline.layout.identity import digest_of, identity_of
    from pipeline.layout.plan import make_plan
    from pipeline.specification.parsing import load_spec, parse_spec
    from pipeline.store.runfile import read_run
    from pipeline.store.setup import create

    text = 'kind = "sweep"\n[axes]\n' + "".join(
        f"{name} = {{ values = [1.5, 1.6] }}\n" for name in ("q", "frequency_hz", "eps_drive")
    )
    spec = load_spec(write_spec(f'{text}[initial_conditions]\nkind = "grid"\n'))
    identity = identity_of(spec, make_plan(spec), "k")
    create(tmp_path / "run", spec, make_plan(spec), identity, text)
    again = parse_spec(read_run(tmp_path / "run").spec)
    assert list(again.axes) == list(spec.axes) == ["q", "frequency_hz", "eps_drive"]
    assert digest_of(identity_of(again, make_plan(again), "k")) == digest_of(identity)


def test_write_task__refuses_damaged_metadata(made):
    """Chunks that were encoded by them would be committed, and read as something else."""
    path = made.info.directory / "cube.zarr/section/zarr.json"
    path.write_text(path.read_text().replace('"little"', '"big"'))
    with pytest.raises(DamagedError, match=r"section/zarr\.json: its content has changed"):
        made.commit(0)
    assert read_commits(made.info, made.plan) == {}
