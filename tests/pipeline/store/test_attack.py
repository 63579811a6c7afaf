"""A finished run under attack: everything is found, nothing damaged is ever data, and a run mends it.

Every case damages a copy of one finished run in one way and place. `verify` must find it; a reader gets the
cells that were written, pending cells, or one sentence; running again gives back the very bytes, and computes
no task that was sound. ``MAGPEND_LONG=1`` draws more places of each kind, and mends after every one.
"""

from __future__ import annotations

import json
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from pipeline import open_run
from pipeline.compute import task
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.store.checksums import seal, unseal
from pipeline.store.errors import DamagedError, RefusedError, StoreError
from pipeline.store.products import write_product

LONG = os.environ.get("MAGPEND_LONG") == "1"
PLACES = 20 if LONG else 6

SPEC = """
kind = "sweep"
title = "small"
model = "duffing"
[axes]
frequency_hz = { start = 0.15, stop = 0.25, num = 4 }
[initial_conditions]
kind = "grid"
x = { start = -1.0, stop = 1.0, num = 4 }
v = 0.1
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 2
n_keep = 3
[execution]
trajectories_per_task = 4
"""


def silent(line):
    pass


def values_of(directory):
    """Every variable and coordinate as a reader gets them."""
    ds = open_run(directory)
    return {str(name): ds[name].values for name in ds.variables}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run with a product beside it, its bytes and its numbers."""
    folder = tmp_path_factory.mktemp("attack")
    (folder / "spec.toml").write_text(SPEC)
    run(folder / "spec.toml", folder / "run", workers=0, echo=silent)
    ds = xr.Dataset({"mean": ("place", np.arange(5.0))}, attrs={"derived_product": "mean"})
    write_product(folder / "run/derived/mean-12345678.zarr", ds)
    values = values_of(folder / "run")
    pending = {v.name: v.fill for v in state(folder / "run").plan.variables}
    return SimpleNamespace(folder=folder, run=folder / "run", values=values, pending=pending)


@pytest.fixture
def whole(finished, tmp_path):
    """A copy to damage."""

    def copy():
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        return shutil.copytree(finished.run, tmp_path / "run")

    return copy


# ---- ways to damage ----------------------------------------------------------------------------


def flip(path, rng):
    data = bytearray(path.read_bytes())
    place = int(rng.integers(8 * len(data)))
    data[place // 8] ^= 1 << (place % 8)
    path.write_bytes(data)


def truncate(path, rng):
    path.write_bytes(path.read_bytes()[: int(rng.integers(path.stat().st_size))])


def extend(path, rng):
    path.write_bytes(path.read_bytes() + rng.bytes(int(rng.integers(1, 40))))


def zero(path, rng):
    """A page of zeros where a file was, as some file systems leave after a power cut."""
    path.write_bytes(bytes(path.stat().st_size))


def delete(path, rng):
    path.unlink()


def garble(path, rng):
    path.write_bytes(rng.bytes(path.stat().st_size))


WAYS = {f.__name__: f for f in (flip, truncate, extend, zero, delete, garble)}


def chunks(directory):
    """Chunks of cells, which the records vouch for."""
    keys = [key for f in sorted(directory.glob("commits/*.json")) for key in unseal(f.read_bytes())["objects"]]
    return [directory / "cube.zarr" / key for key in keys]


def set_up(directory, *, metadata):
    """Files of the set-up: metadata, or coordinates' chunks."""
    cells = set(chunks(directory))
    files = sorted(f for f in (directory / "cube.zarr").rglob("*") if f.is_file() and f not in cells)
    return [f for f in files if (f.name == "zarr.json") == metadata]


TARGETS = {
    "chunk": chunks,
    "record": lambda d: sorted((d / "commits").iterdir()),
    "coordinate": lambda d: set_up(d, metadata=False),
    "metadata": lambda d: set_up(d, metadata=True),
    "run.json": lambda d: [d / "run.json"],
    "product": lambda d: sorted(f for f in (d / "derived").rglob("*") if f.is_file()),
}


def swap_two(paths, rng):
    """Exchange two files of one size that differ."""
    pairs = [
        (a, b)
        for i, a in enumerate(paths)
        for b in paths[:i]
        if a.stat().st_size == b.stat().st_size and a.read_bytes() != b.read_bytes()
    ]
    a, b = pairs[int(rng.integers(len(pairs)))]
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)


def swap_chunks(directory, rng):
    swap_two(chunks(directory), rng)


def swap_coordinates(directory, rng):
    swap_two(set_up(directory, metadata=False), rng)


def swap_records(directory, rng):
    swap_two(sorted((directory / "commits").iterdir()), rng)


def edit(path, change):
    """Edit JSON as a person would, who leaves the checksum as it was."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data, indent=1))


def edit_record(directory, rng):
    """Drop an object, or change a count, a size, a digest, the task."""

    def change(data):
        keys = sorted(data["objects"])
        key = keys[int(rng.integers(len(keys)))]
        changes = [
            lambda: data["objects"].pop(key),
            lambda: data["status"].update(bounded=1),
            lambda: data["status"].update(diverged=2),
            lambda: data["objects"][key].update(size=1),
            lambda: data["objects"][key].update(sha256="0" * 64),
            lambda: data.update(task=data["task"] + 1),
            lambda: data.update(objects={}),
            lambda: data.pop("status"),
        ]
        changes[int(rng.integers(len(changes)))]()

    records = sorted((directory / "commits").iterdir())
    edit(records[int(rng.integers(len(records)))], change)


def edit_run(directory, rng):
    """Change what the identity holds, and what it does not."""

    def change(data):
        changes = [
            lambda: data.update(title="another"),
            lambda: data.update(spec_text="kind = 'sweep'"),
            lambda: data["versions"].update(magpend="0.0.1"),
            lambda: data["provenance"].update(host="elsewhere"),
            lambda: data["skeleton"].pop("frequency/c.0"),
            lambda: data["skeleton"]["x_0/c.0"].update(sha256="0" * 64),
            lambda: data["spec"]["integration"].update(n_keep=4),
            lambda: data["identity"]["spec"]["integration"].update(n_keep=4),
            lambda: data["identity"].update(format=99),
            lambda: data["identity"].pop("format"),
            lambda: data.update(digest="0" * 32),
            lambda: data.pop("skeleton"),
            lambda: data.update(another=1),
            lambda: data.update(spec={}),
        ]
        changes[int(rng.integers(len(changes)))]()

    edit(directory / "run.json", change)


def edit_metadata(directory, rng):
    """Change what zarr believes: the fill value, the shape, an attribute, a codec."""

    def change(data):
        changes = [
            lambda: data.update(fill_value=1),
            lambda: data["shape"].__setitem__(0, 3),
            lambda: data["attributes"].update(units="K"),
            lambda: data["codecs"].pop(),
            lambda: data.update(dimension_names=None),
        ]
        changes[int(rng.integers(len(changes)))]()

    files = [f for f in set_up(directory, metadata=True) if f.parent.name != "cube.zarr"]
    edit(files[int(rng.integers(len(files)))], change)


def link_chunk(directory, rng):
    paths = chunks(directory)
    path = paths[int(rng.integers(len(paths)))]
    path.rename(directory.parent / "elsewhere")
    path.symlink_to(directory.parent / "elsewhere")


def foreign_file(directory, rng):
    """What nobody of this run has written, or what an earlier one has left."""
    names = [
        "cube.zarr/status/c.9.9",
        "cube.zarr/notes.txt",
        "cube.zarr/more/zarr.json",
        "commits/.3.tmp",
        "commits/000077.json",
        "commits/notes.txt",
    ]
    path = directory / names[int(rng.integers(len(names)))]
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(rng.bytes(30))


def record_of_another_run(directory, rng):
    path = sorted((directory / "commits").iterdir())[int(rng.integers(4))]
    path.write_text(seal(json.dumps({**unseal(path.read_bytes()), "digest": "0" * 32}, sort_keys=True)))


def drop_folder(directory, rng):
    """A whole array or all records gone."""
    folders = [*(f.parent for f in set_up(directory, metadata=True)), directory / "commits"]
    shutil.rmtree(folders[1 + int(rng.integers(len(folders) - 1))])


def in_one(target, way):
    """A function that damages one of some files."""

    def damage(directory, rng):
        paths = TARGETS[target](directory)
        WAYS[way](paths[int(rng.integers(len(paths)))], rng)

    return damage


KINDS = {f"{way} {target}": in_one(target, way) for target in TARGETS for way in WAYS} | {
    f.__name__.replace("_", " "): f
    for f in (
        swap_chunks,
        swap_coordinates,
        swap_records,
        edit_record,
        edit_run,
        edit_metadata,
        link_chunk,
        foreign_file,
        record_of_another_run,
        drop_folder,
    )
}


# ---- what must hold ----------------------------------------------------------------------------


def is_found(directory):
    """Whether `verify` says that something is not as it was written."""
    try:
        found = verify_run(directory)
    except (DamagedError, RefusedError):
        return True
    return not found.sound or bool(found.leftovers) or found.n_committed < found.n_tasks


def lies(directory, finished):
    """What a reader gets that is neither what was written nor pending."""
    try:
        found = values_of(directory)
    except StoreError:  # one sentence; anything else is a traceback, and fails the test
        return []
    wrong = []
    for name, written in finished.values.items():
        pending = np.full_like(written, finished.pending[name]) if name in finished.pending else written
        same = np.asarray(found[name] == written) | ((found[name] != found[name]) & (written != written))
        empty = np.asarray(found[name] == pending) | ((found[name] != found[name]) & (pending != pending))
        # a task is a frequency here: it is there as a whole or not at all
        rows = range(len(written)) if name in finished.pending else [...]
        if not all(same[row].all() or empty[row].all() for row in rows):
            wrong.append(name)
    return wrong


@pytest.mark.parametrize("kind", KINDS)
def test_damage__is_found_and_never_read(kind, whole, finished):
    for place in range(PLACES):
        directory = whole()
        KINDS[kind](directory, np.random.default_rng([sum(kind.encode()), place]))
        assert is_found(directory), place
        assert not lies(directory, finished), place


@pytest.mark.parametrize("kind", KINDS)
def test_damage__is_mended_by_running_again(kind, whole, finished, bytes_of, monkeypatch):
    before = bytes_of(finished.run)
    computed = []
    original = task.compute
    monkeypatch.setattr(task, "compute", lambda *a: computed.append(a) or original(*a))
    for place in range(PLACES if LONG else 1):
        directory = whole()
        computed.clear()
        KINDS[kind](directory, np.random.default_rng([sum(kind.encode()), place]))
        assert run(finished.folder / "spec.toml", directory, workers=0, echo=silent).complete
        assert bytes_of(directory) == before, place
        n_most = 4 if kind == "drop folder" else 2 if kind.startswith("swap") else 1
        needed = any(word in kind for word in ("chunk", "record", "folder"))
        assert len(computed) <= (n_most if needed else 0), place
        assert run(finished.folder / "spec.toml", directory, workers=0, echo=silent).complete
        assert is_found(directory) == kind.endswith("product"), place


def test_newer_format__is_refused_and_left_alone(whole, finished, bytes_of):
    directory = whole()
    data = unseal((directory / "run.json").read_bytes())
    data["identity"]["format"] += 1
    (directory / "run.json").write_text(seal(json.dumps(data)))
    before = bytes_of(directory)
    for use in (
        lambda: open_run(directory),
        lambda: verify_run(directory),
        lambda: state(directory),
        lambda: run(finished.folder / "spec.toml", directory, workers=0, echo=silent),
    ):
        with pytest.raises(RefusedError, match="format"):
            use()
    assert bytes_of(directory) == before
