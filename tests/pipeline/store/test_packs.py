"""Packs of commit records: same bytes whatever happens on the way, no record lost with another's line."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from pipeline import open_run
from pipeline.compute import task
from pipeline.runs.mending import sound_commits
from pipeline.runs.run import run
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.store import commits as store_commits
from pipeline.store import packing, records
from pipeline.store.commits import read_commits, sweep
from pipeline.store.errors import DamagedError
from pipeline.store.keys import Owners, keys_of
from pipeline.store.packing import Packer, pack_block, withdraw
from pipeline.store.records import block_of_pack, marker_key, pack_key
from pipeline.store.run import Run


@pytest.fixture(autouse=True)
def pairs(monkeypatch):
    """Two tasks a pack: of the five tasks one stays alone."""
    for module in (records, store_commits, packing):
        monkeypatch.setattr(module, "BLOCK", 2)


def silent(line):
    pass


def names_in(made):
    return sorted(f.name for f in (made.info.directory / "commits").iterdir())


def go_on(made):
    """What a run does with a directory: compare, sweep, compute what is missing, pack."""
    found = sound_commits(made.info, made.plan, silent)
    packer = Packer(made.info, made.plan, found)
    missing = [i for i in range(made.plan.n_tasks) if i not in found]
    for index in missing:
        made.commit(index)
        packer.add(index)
    return missing


@pytest.fixture
def packed(made, bytes_of):
    """A finished run, and its bytes."""
    assert go_on(made) == [0, 1, 2, 3, 4]
    made.before = bytes_of(made.info.directory)
    return made


PACKED = ["000000-000001.jsonl", "000002-000003.jsonl", "000004.json"]


def test_packs__hold_whole_blocks(packed):
    assert names_in(packed) == PACKED
    found = read_commits(packed.info, packed.plan)
    assert list(found) == list(range(5))
    assert len(found) == 5
    assert [found[i].task for i in range(5)] == list(range(5))
    assert 5 not in found
    with pytest.raises(KeyError):
        found[5]
    assert sorted(found[3].objects) == sorted(keys_of(packed.plan, 3))
    assert state(packed.info.directory).cells == {"bounded": packed.plan.n_cells}
    assert verify_run(packed.info.directory).sound
    ds = open_run(packed.info.directory)
    for name, values in packed.values(3).items():
        assert np.array_equal(ds[name].values[packed.plan.task(3)], values)


def test_packs__do_not_change_what_a_run_is(made):
    for index in range(5):
        made.commit(index)
    alone = Run.open(made.info.directory)
    digest, cells = alone.digest, alone.commits.cells()
    go_on(made)
    together = Run.open(made.info.directory)
    assert names_in(made) == PACKED
    assert (together.digest, together.commits.cells()) == (digest, cells)
    assert pickle.loads(pickle.dumps(together.commits))[1] == together.commits[1]


@pytest.mark.parametrize("order", [(4, 3, 2, 1, 0), (2, 0, 3, 1, 4)])
def test_packs__same_bytes_in_any_order(packed, bytes_of, order):
    withdraw(packed.info, [f"{i:06d}.json" for i in range(5)])
    assert names_in(packed) == []
    packer = Packer(packed.info, packed.plan, read_commits(packed.info, packed.plan))
    for index in order:
        packed.commit(index)
        packer.add(index)
    assert bytes_of(packed.info.directory) == packed.before


class CrashError(Exception):
    """Stands for a power cut."""


@pytest.mark.parametrize("step", ["write", "remove"])
def test_pack_block__crash_between_steps(made, monkeypatch, bytes_of, step):
    for index in range(5):
        made.commit(index)
    files = type(made.info.files)
    original = getattr(files, step)

    def crash(self, first, *rest):
        if step == "remove":  # some are gone
            original(self, list(first)[:1])
        raise CrashError

    with monkeypatch.context() as patch:
        patch.setattr(files, step, crash)
        with pytest.raises(CrashError):
            pack_block(made.info, made.plan, 0)
    assert len(read_commits(made.info, made.plan)) == 5
    assert verify_run(made.info.directory).n_committed == 5
    assert go_on(made) == []
    assert names_in(made) == PACKED
    assert verify_run(made.info.directory).sound


def test_withdraw__leaves_the_others_of_a_pack(packed, bytes_of):
    withdraw(packed.info, ["000001.json"])
    assert names_in(packed) == PACKED
    assert set(read_commits(packed.info, packed.plan)) == {0, 2, 3, 4}
    assert state(packed.info.directory).n_committed == packed.plan.n_cells - packed.plan.cells_in(1)
    assert verify_run(packed.info.directory).n_committed == 4
    packed.commit(1)
    assert names_in(packed) == sorted([*PACKED, "000001.json"])
    assert set(read_commits(packed.info, packed.plan)) == set(range(5))
    assert go_on(packed) == []
    assert bytes_of(packed.info.directory) == packed.before


def test_damaged_pack__loses_only_the_damaged_record(packed, bytes_of):
    path = packed.info.directory / pack_key(0)
    whole = path.read_bytes()
    first_line = whole.index(b"\n")
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, first_line, 6), *rng.integers(first_line, len(whole), 14)]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        found = verify_run(packed.info.directory)
        assert not found.sound
        assert set(range(2, 5)) <= set(read_commits(packed.info, packed.plan))
        missing = go_on(packed)
        assert len(missing) <= 1
        assert bytes_of(packed.info.directory) == packed.before


@pytest.mark.parametrize("change", [lambda p: p.unlink(), lambda p: p.write_bytes(b""), lambda p: p.write_bytes(b"x")])
def test_damaged_pack__lost_altogether(packed, bytes_of, change):
    change(packed.info.directory / pack_key(1))
    assert set(read_commits(packed.info, packed.plan)) == {0, 1, 4}
    assert go_on(packed) == [2, 3]
    assert bytes_of(packed.info.directory) == packed.before


def test_swapped_packs__vouch_for_nothing(packed, bytes_of):
    first, second = (packed.info.directory / pack_key(block) for block in (0, 1))
    a, b = first.read_bytes(), second.read_bytes()
    first.write_bytes(b)
    second.write_bytes(a)
    assert set(read_commits(packed.info, packed.plan)) == {4}
    assert go_on(packed) == [0, 1, 2, 3]
    assert bytes_of(packed.info.directory) == packed.before


def test_chunk_of_a_packed_task__is_never_read_as_fill(packed, bytes_of):
    """What is missing shows when it is read; `status` looks at the records alone."""
    run = Run.open(packed.info.directory)
    key = next(key for key in keys_of(packed.plan, 2) if key.startswith("section"))
    (packed.info.directory / "cube.zarr" / key).unlink()
    for opened in (run, Run.open(packed.info.directory)):
        with pytest.raises(DamagedError, match=rf"{key}: is missing"):
            opened.cube().section.values  # noqa: B018
    assert list(verify_run(packed.info.directory).damaged) == ["000002.json"]
    assert go_on(packed) == [2]
    assert bytes_of(packed.info.directory) == packed.before


def test_write_task__late_and_twice_changes_nothing(packed, bytes_of):
    for index in (0, 3, 4):
        packed.commit(index)
    assert bytes_of(packed.info.directory) == packed.before


def test_read_commits__while_records_move_into_a_pack(made, monkeypatch):
    """A reader that has listed the single ones reads them in their pack."""
    for index in range(5):
        made.commit(index)
    files = type(made.info.files)
    original = files.read_each
    moved = []

    def read_each(self, keys):
        keys = list(keys)
        if not moved:
            moved.append(True)
            pack_block(made.info, made.plan, 0)
        return original(self, keys)

    monkeypatch.setattr(files, "read_each", read_each)
    assert len(read_commits(made.info, made.plan)) == 5
    assert moved


def test_sweep__keeps_packs_and_removes_what_they_replace(packed):
    (packed.info.directory / marker_key(0)).write_text("left over")
    found = read_commits(packed.info, packed.plan)
    assert sweep(packed.info, packed.plan, found) == 1
    assert names_in(packed) == PACKED


def test_names__of_packs():
    assert block_of_pack("000002-000003.jsonl") == 1
    for name in ("000001-000002.jsonl", "000002.json", "2-3.jsonl", "x-y.jsonl", ".000002-000003.jsonl.a.tmp"):
        assert block_of_pack(name) is None


def test_owners__keys_lead_back(made):
    owners = Owners(made.plan)
    for index in range(made.plan.n_tasks):
        for key in keys_of(made.plan, index):
            assert owners.task(key) == index
    no_chunks = ["zarr.json", "status/zarr.json", "x/c.0", "frequency/c.0", "status/d.0.0.0.0"]
    for key in [*no_chunks, *(f"status/c.{w}" for w in ("9.9.9.9", "00.0.0.0", "0", "0.0.0.-1"))]:
        assert owners.task(key) is None, key


def test_run__packs_as_it_goes_and_mends_one_task(write_spec, tmp_path, bytes_of, monkeypatch):
    """With the kernel: damage of equal size in a packed run costs one task, and leaves the very bytes."""
    axis = "frequency_hz = { start = 0.15, stop = 0.25, num = 5 }"
    grid = '[initial_conditions]\nkind = "grid"\nx = 0.5\nv = 0.1'
    short = "rtol = 1e-6\natol = 1e-6\nn_transient = 2\nn_keep = 3"
    one = "[execution]\ntrajectories_per_task = 1"
    spec = write_spec(f'kind = "sweep"\nmodel = "duffing"\n[axes]\n{axis}\n{grid}\n[integration]\n{short}\n{one}')
    directory, said = tmp_path / "run", []
    assert run(spec, directory, workers=0, echo=silent).complete
    assert sorted(f.name for f in (directory / "commits").iterdir()) == PACKED
    before = bytes_of(directory)
    (chunk,) = (directory / "cube.zarr/n_steps").glob("c.2*")
    chunk.write_bytes(bytes(len(chunk.read_bytes())))
    original, computed = task.compute, []
    monkeypatch.setattr(task, "compute", lambda *a: computed.append(a) or original(*a))
    assert run(spec, directory, workers=0, echo=said.append).complete
    assert len(computed) == 1
    assert f"n_steps/{chunk.name}: its content has changed: computed again" in said
    assert bytes_of(directory) == before
    monkeypatch.setenv("MAGPEND_VERIFY", "0")
    chunk.write_bytes(bytes(len(chunk.read_bytes())))
    said.clear()
    assert run(spec, directory, workers=0, echo=said.append).complete
    assert "nothing to do" in said[-1]
