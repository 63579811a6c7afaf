"""A finished run under damage, place by place: what `verify`, a reader, a repair and the same command make of it.

Every case damages copies of one finished run in one way and place. ``MAGPEND_LONG=1`` draws more places of each
kind, and repairs and mends after every one.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from pipeline import open_run
from pipeline.compute import task
from pipeline.layout.identity import digest_of
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import describe, verify_run
from pipeline.store import commits, products, records
from pipeline.store.errors import DamagedError, RefusedError, StoreError
from pipeline.store.objects import open_files
from pipeline.store.products import write_product
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.factories import contents, duffing, finished, quietly, silent

LONG = os.environ.get("MAGPEND_LONG") == "1"
PLACES = 20 if LONG else 4
GRID = 'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 5 }\nv = 0.1'
SPEC = duffing("frequency_hz = { start = 0.15, stop = 0.25, num = 5 }", GRID, execution="trajectories_per_task = 5")


def values_of(directory):
    """Every variable and coordinate as a reader gets them."""
    ds = open_run(directory)
    return {str(name): ds[name].values for name in ds.variables}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A finished run of two packs, a record of its own and the copy of that, with a product beside it."""
    folder, patch = tmp_path_factory.mktemp("damage"), pytest.MonkeyPatch()
    for module in (records, commits):
        patch.setattr(module, "BLOCK", 2)
    directory = finished(folder, SPEC)
    names = sorted(f.name for f in (directory / "commits").iterdir())
    assert names == ["000000-000001.jsonl", "000002-000003.jsonl", "000004.json"]
    ds = xr.Dataset({"mean": ("place", np.arange(5.0))}, attrs={"derived_product": "mean"})
    write_product(directory / "derived/mean-12345678.zarr", ds)
    pending = {v.name: v.fill for v in state(directory).plan.variables}
    yield SimpleNamespace(spec=folder / "spec.toml", run=directory, values=values_of(directory), pending=pending)
    patch.undo()


# ---- places ------------------------------------------------------------------------------------


def record_files(directory, suffix):
    return sorted((directory / "commits").glob(f"*{suffix}"))


def sealed_lines(path):
    """The records of a file, one or a pack, as lines with their checksums."""
    lines = path.read_bytes().splitlines(keepends=True)
    return lines[:-1] if path.suffix == ".jsonl" else lines


def chunks(directory):
    """Chunks of cells, which the records vouch for."""
    lines = [line for path in record_files(directory, "json*") for line in sealed_lines(path)]
    return [directory / "cube.zarr" / key for line in lines for key in unseal(line)["objects"]]


def set_up(directory, *, metadata):
    """Files of the set-up: metadata, or coordinates' chunks."""
    cells = set(chunks(directory))
    files = sorted(f for f in (directory / "cube.zarr").rglob("*") if f.is_file() and f not in cells)
    return [f for f in files if (f.name == "zarr.json") == metadata]


def folders(directory):
    cube = directory / "cube.zarr"
    return [cube, directory / "commits", *sorted(f for f in cube.iterdir() if f.is_dir())]


# files of a place, the part of verify's result that names their damage, and the most tasks that it can cost
TABLE = {
    "chunk": (chunks, "damaged", 1),
    "record": (lambda d: record_files(d, ".json"), "damaged", 1),
    "pack": (lambda d: record_files(d, ".jsonl"), "damaged", 2),
    "copy": (lambda d: [d / "records.jsonl"], "copies", 0),
    "coordinate": (lambda d: set_up(d, metadata=False), "skeleton", 0),
    "metadata": (lambda d: set_up(d, metadata=True), "skeleton", 0),
    "run.json": (lambda d: [d / "run.json"], "refused", 0),
    "product": (lambda d: sorted(f for f in (d / "derived").rglob("*") if f.is_file()), "derived", 0),
    "folder": (folders, "odd", 5),
}

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


def garble(path, rng):
    path.write_bytes(rng.bytes(path.stat().st_size))


def delete(path, rng):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def link(path, rng):
    """A link to the very content."""
    elsewhere = next(p for p in path.parents if p.name == "run").with_name("elsewhere")
    path.rename(elsewhere)
    path.symlink_to(elsewhere)


def misplace(path, rng):
    """A folder with a file in the place of a file, or a file in that of a folder."""
    was_folder = path.is_dir()
    delete(path, rng)
    if not was_folder:
        path.mkdir()
    (path if was_folder else path / "theirs").write_text("somebody's")


def swap(paths, rng):
    """Exchange two files of one size that differ."""
    same = [(a, b) for i, a in enumerate(paths) for b in paths[:i] if a.stat().st_size == b.stat().st_size]
    pairs = [(a, b) for a, b in same if a.read_bytes() != b.read_bytes()]
    a, b = pairs[int(rng.integers(len(pairs)))]
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)


def edit(path, rng, changes):
    """Edit JSON in one line of a file as a person would, who leaves the checksum as it was."""
    lines = path.read_bytes().splitlines(keepends=True) if path.suffix == ".jsonl" else [path.read_bytes()]
    i = int(rng.integers(max(len(lines) - 1, 1)))
    data = json.loads(lines[i])
    changes[int(rng.integers(len(changes)))](data)
    path.write_bytes(b"".join([*lines[:i], json.dumps(data).encode() + b"\n", *lines[i + 1 :]]))


def first_object(data):
    return data["objects"][min(data["objects"])]


RECORD_EDITS = [
    lambda d: d["objects"].pop(min(d["objects"])),
    lambda d: d["status"].update(bounded=1),
    lambda d: d["status"].update(diverged=2),
    lambda d: first_object(d).update(size=1),
    lambda d: first_object(d).update(sha256="0" * 64),
    lambda d: d.update(task=d["task"] + 1),
    lambda d: d.update(task=99),
    lambda d: d.update(objects={}),
    lambda d: d.pop("status"),
]
RUN_EDITS = [
    lambda d: d.update(title="another"),
    lambda d: d.update(spec_text="kind = 'sweep'"),
    lambda d: d["versions"].update(magpend="0.0.1"),
    lambda d: d["provenance"].update(host="elsewhere"),
    lambda d: d["skeleton"].pop("frequency/c.0"),
    lambda d: d["skeleton"]["x_0/c.0"].update(sha256="0" * 64),
    lambda d: d["spec"]["integration"].update(n_keep=4),
    lambda d: d["identity"]["spec"]["integration"].update(n_keep=4),
    lambda d: d["identity"].update(format=99),
    lambda d: d["identity"].pop("format"),
    lambda d: d.update(digest="0" * 32),
    lambda d: d.pop("skeleton"),
    lambda d: d.update(another=1),
    lambda d: d.update(spec={}),
]
METADATA_EDITS = [
    lambda d: d.update(fill_value=1),
    lambda d: d["shape"].__setitem__(0, 3),
    lambda d: d["attributes"].update(units="K"),
    lambda d: d["codecs"].pop(),
    lambda d: d.update(dimension_names=None),
]


def one_of(place, way):
    """A function that damages one of the files of a place."""

    def damage(directory, rng):
        paths = TABLE[place][0](directory)
        way(paths[int(rng.integers(len(paths)))], rng)

    return damage


def edits(place, changes):
    return one_of(place, lambda path, rng: edit(path, rng, changes))


def foreign_file(directory, rng):
    """What nobody of this run has written, or what an earlier one has left."""
    names = ["cube.zarr/status/c.9.9", "cube.zarr/notes.txt", "cube.zarr/more/zarr.json"]
    names += ["commits/.3.tmp", "commits/000077.json", "commits/notes.txt"]
    path = directory / names[int(rng.integers(len(names)))]
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(rng.bytes(30))


def record_of_another_run(directory, rng):
    (path,) = record_files(directory, ".json")
    path.write_text(seal(json.dumps({**unseal(path.read_bytes()), "digest": "0" * 32}, sort_keys=True)))


def run_file_and_chunk(directory, rng):
    """What is rebuilt is held against what there is."""
    (directory / "run.json").unlink()
    one_of("chunk", flip)(directory, rng)


FILE_WAYS = (flip, truncate, extend, zero, garble, delete, link, misplace)
UNTOUCHED = {("run.json", misplace), ("copy", misplace), ("copy", delete), ("copy", link), ("product", misplace)}
"""What lies in the place of these is not ours to move; a copy that is gone is no damage."""

CASES = {
    f"{way.__name__} {place}": (one_of(place, way), place)
    for place in TABLE
    for way in ((delete, misplace, link) if place == "folder" else FILE_WAYS)
    if (place, way) not in UNTOUCHED
} | {
    "swap chunks": (lambda d, rng: swap(chunks(d), rng), "chunk"),
    "swap coordinates": (lambda d, rng: swap(set_up(d, metadata=False), rng), "coordinate"),
    "swap packs": (lambda d, rng: swap(record_files(d, ".jsonl"), rng), "pack"),
    "edit record": (edits("record", RECORD_EDITS), "record"),
    "edit pack": (edits("pack", RECORD_EDITS), "pack"),
    "edit run.json": (edits("run.json", RUN_EDITS), "run.json"),
    "edit metadata": (
        lambda d, rng: edit(d / "cube.zarr" / ["section", "x_0"][rng.integers(2)] / "zarr.json", rng, METADATA_EDITS),
        "metadata",
    ),
    "foreign file": (foreign_file, "leftover"),
    "record of another run": (record_of_another_run, "record"),
    "run.json and a chunk": (run_file_and_chunk, "run.json"),
}
MOST_COMPUTED = {"flip pack": 1, "swap chunks": 2, "swap packs": 4, "run.json and a chunk": 1, "foreign file": 0}


# ---- what must hold ----------------------------------------------------------------------------


def verdict(directory):
    """Parts of verify's result that say something is not as it was written, or that it refuses to look."""
    try:
        found = verify_run(directory)
    except (DamagedError, RefusedError):
        return {"refused"}
    parts = {p for p in ("damaged", "copies", "skeleton", "derived", "odd", "leftovers") if getattr(found, p)}
    assert found.sound == (parts <= {"leftovers"})
    return parts | ({"missing"} if found.n_committed < found.n_tasks else set())


def wrong(directory, sound):
    """Names of what a reader gets that is neither what was written nor pending."""
    try:
        found = values_of(directory)
    except StoreError:  # one sentence; anything else is a traceback, and fails the test
        return []
    names = []
    for name, written in sound.values.items():
        pending = np.full_like(written, sound.pending[name]) if name in sound.pending else written
        same = np.asarray(found[name] == written) | ((found[name] != found[name]) & (written != written))
        empty = np.asarray(found[name] == pending) | ((found[name] != found[name]) & (pending != pending))
        # a task is a frequency here: it is there as a whole or not at all
        rows = range(len(written)) if name in sound.pending else [...]
        if not all(same[row].all() or empty[row].all() for row in rows):
            names.append(name)
    return names


def bytes_at(path):
    """What is at a path, file or folder."""
    return contents(path) if path.is_dir() else path.read_bytes() if path.exists() else None


@pytest.fixture
def whole(sound, tmp_path):
    """Copies to damage, one after the other in one place."""

    def copy():
        for path in (tmp_path / "run", tmp_path / "elsewhere"):
            if path.exists():
                delete(path, None)
        return shutil.copytree(sound.run, tmp_path / "run")

    return copy


@pytest.fixture
def computed(monkeypatch):
    """Blocks of the tasks that a run computes."""
    blocks, original = [], task.compute
    monkeypatch.setattr(task, "compute", lambda *a: blocks.append(a[-1]) or original(*a))
    return blocks


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_damage__is_found_never_read_repaired_and_mended(case, whole, sound, bytes_of, computed):
    damage, place = CASES[case]
    part = "odd" if case.startswith("misplace") else TABLE[place][1] if place in TABLE else "leftovers"
    # what is gone is missing, with its metadata if it was a folder; of a linked folder nothing is read
    expected = {part} | {"damaged": {"missing"}, "odd": {"missing", "skeleton", "refused"}}.get(part, set())
    for i in range(PLACES):
        rng = [sum(case.encode()), i]
        directory = whole()
        damage(directory, np.random.default_rng(rng))
        assert verdict(directory) & expected, (i, verdict(directory))
        assert not wrong(directory, sound), i
        with contextlib.suppress(StoreError):  # it looks at the records alone
            assert not state(directory).complete or place != "record", i
        if i and not LONG:
            continue
        repaired(directory, case, place, sound)
        directory = whole()
        damage(directory, np.random.default_rng(rng))
        mended(directory, case, place, sound, bytes_of, computed)


def repaired(directory, case, place, sound):
    """`verify --repair` leaves what is sound alone, and a directory in which nothing is damaged."""
    try:
        found = verify_run(directory, repair=True)
    except (DamagedError, RefusedError):
        assert place == "run.json" or case == "link folder"
        return
    said = "\n".join(describe(found, directory, repaired=True))
    assert ("withdrawn" in said) == bool(found.damaged)
    assert "another version" not in said
    assert not verdict(directory) - {"missing", "leftovers"}
    assert verify_run(directory).n_committed >= found.n_tasks - MOST_COMPUTED.get(case, TABLE.get(place, [0] * 3)[2])
    assert not wrong(directory, sound)


def mended(directory, case, place, sound, bytes_of, computed):
    """The same command gives the very bytes again, and computes no task that was sound."""
    computed.clear()
    elsewhere = directory.with_name("elsewhere")
    linked = bytes_at(elsewhere)
    refusal = None
    try:
        assert run(sound.spec, directory, workers=0, echo=silent).complete
    except RefusedError as error:
        refusal = str(error)
    assert bytes_at(elsewhere) == linked
    if refusal is not None:
        assert case.startswith("link") and "is a link" in refusal, refusal  # noqa: PT018
        return
    assert bytes_of(directory) == bytes_of(sound.run)
    assert len(computed) <= MOST_COMPUTED.get(case, TABLE.get(place, [0] * 3)[2])
    assert verdict(directory) == ({"derived"} if place == "product" else set())
    kept = [f.read_text() for f in (directory / "aside").rglob("*") if f.is_file()]
    assert kept == (["somebody's"] if case.startswith("misplace") else [])


@pytest.mark.parametrize("older", [False, True])
def test_another_format__is_refused_and_left_alone(whole, sound, bytes_of, older):
    directory = whole()
    path = directory / "run.json"
    if older:  # format 2 had no checksum
        data = json.loads(path.read_text().replace('"format": 3', '"format": 2'))
        del data["checksum"]
        path.write_text(json.dumps(data))
    else:
        data = unseal(path.read_bytes())
        data["identity"]["format"] += 1
        path.write_text(seal(json.dumps(data)))
    before = bytes_of(directory), path.read_bytes()
    for use in (open_run, verify_run, state, lambda d: quietly(sound.spec, d)):
        with pytest.raises(RefusedError, match="format"):
            use(directory)
    assert (bytes_of(directory), path.read_bytes()) == before


def test_run__mends_by_sizes_alone_if_asked(whole, sound, computed, monkeypatch):
    directory, said = whole(), []
    chunk = next(path for path in chunks(directory) if path.parent.name == "n_steps")
    zero(chunk, None)
    monkeypatch.setenv("MAGPEND_VERIFY", "0")
    assert run(sound.spec, directory, workers=0, echo=said.append).complete
    assert "nothing to do" in said[-1]
    monkeypatch.delenv("MAGPEND_VERIFY")
    assert run(sound.spec, directory, workers=0, echo=said.append).complete
    assert f"n_steps/{chunk.name}: its content has changed: computed again" in said
    assert len(computed) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["section", "n_steps"])
def test_flipped_bit__is_seen_by_readers_that_opened_before_and_by_zarr_alone(whole, name):
    """The record's digest, and the checksum in the chunk, for readers that know no records."""
    directory = whole()

    opened = RunDirectory.open(directory)
    chunk = next(path for path in chunks(directory) if path.parent.name == name)
    content = chunk.read_bytes()
    for i in range(20):
        chunk.write_bytes(content)
        flip(chunk, np.random.default_rng(i))
        with pytest.raises(DamagedError, match=rf"{name}/{chunk.name}: is not what was written"):
            opened.cube()[name].load()
        with pytest.raises(Exception, match=r"(?i)checksum|crc32c|is not what was written"):
            opened.cube(check=False)[name].load()
    chunk.unlink()
    with pytest.raises(DamagedError, match=rf"{name}/{chunk.name}: is missing"):
        opened.cube()[name].load()


# ---- values of other types, under checksums that fit -------------------------------------------------

FORGED = [7, "12", None, True, [1, "a"], {"a\0b": 1}, float("nan"), -(10**400), [[[]]] * 3]


def leaves(data, path=()):
    """Paths of all values below the top."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


def forged(path, at, value):
    """The content of a file with another value at a path of its JSON, or of its last line, and checksums that fit."""
    *body, last = path.read_bytes().splitlines(keepends=True)
    place = data = json.loads(last if path.suffix == ".jsonl" else path.read_bytes())
    for key in at[:-1]:
        place = place[key]
    place[at[-1]] = value
    if "derived" in path.parts:  # a result is sealed in its attributes
        if isinstance(own := data["attributes"], dict) and products.SEAL in own:
            own[products.SEAL] = products._seal(own, products._digests(open_files(path.parent)))
        return json.dumps(data).encode()
    data.pop("checksum", None)
    with contextlib.suppress(ValueError):  # an identity without a digest: NaN
        data.update(digest=digest_of(data["identity"]) if "identity" in data else data["digest"])
    before = b"".join(body) if path.suffix == ".jsonl" else b""
    return before + seal(json.dumps(data).replace('"NESTED"', "[" * 100_000 + "]" * 100_000), before).encode()


def seen(directory):
    """What commands see: the text of a refusal, or whether the run is sound."""
    try:
        state(directory)
        for product in (directory / "derived").iterdir():
            products.read_product_attrs(product)
        return verify_run(directory).sound
    except (DamagedError, RefusedError) as error:  # anything else is a traceback
        return str(error)


@pytest.mark.slow
@pytest.mark.parametrize(
    "key", ["run.json", "commits/000004.json", "commits/000000-000001.jsonl", "derived/mean-12345678.zarr/zarr.json"]
)
def test_forged__is_one_error_that_names_the_place_or_nothing_wrong_is_read(key, whole, sound):
    directory, found = whole(), []
    path = directory / key
    content = path.read_bytes()
    for at in leaves(json.loads(content.splitlines()[-1] if path.suffix == ".jsonl" else content)):
        for value in random.Random(repr(at)).sample(FORGED, 2):
            path.write_bytes(forged(path, at, value))
            found.append(seen(directory))
            assert found[-1] in (True, False) or str(directory) in found[-1]
            assert not wrong(directory, sound)
            path.write_bytes(content)
    assert len([one for one in found if one is not True]) > len(found) / 4


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        (("title",), 7, "title = 7"),
        (("skeleton", "zarr.json", "size"), "12", "skeleton.zarr.json.size = '12'"),
        (("skeleton", "a\0b"), {"size": 1, "sha256": "0" * 64}, "is not the path of a file"),
        (("spec", "axes"), float("nan"), "axes"),
        (("versions",), "NESTED", ""),
        (("versions", "magpend"), "1\x1b[31m", "versions.magpend"),
        (("spec", "integration", "n_keep"), 77, "its identity is of another specification: integration.n_keep"),
    ],
)
def test_forged_run_file__the_command_names_what_is_wrong(whole, main, key, value, named):
    directory = whole()
    path = directory / "run.json"
    path.write_bytes(forged(path, key, value))
    for command in ("status", "verify"):
        code, _, err = main(command, directory)
        assert code == 5
        assert f"{path}: " in err
        assert named in err


def test_forged_run_file__arrays_that_it_does_not_name(whole, sound, main, bytes_of):
    directory = whole()
    path = directory / "run.json"
    for key in ("section/zarr.json", "x_0/zarr.json", "x_0/c.0", "state/c.0"):
        data = unseal(path.read_bytes())
        del data["skeleton"][key]
        path.write_text(seal(json.dumps(data)))
        code, _, err = main("status", directory)
        assert code == 5
        assert f"{path}: damaged (skeleton has no {key})" in err
        assert run(sound.spec, directory, workers=0, echo=silent).complete
        assert bytes_of(directory) == bytes_of(sound.run)
        assert key in read_run(directory).skeleton
