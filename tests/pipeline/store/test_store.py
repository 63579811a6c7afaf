"""What a task writes, record and chunks, and records in packs: the same bytes whatever happens on the way."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from pipeline import open_run
from pipeline.layout.identity import digest_of, identity_of
from pipeline.layout.plan import make_plan
from pipeline.runs.run import sound_commits
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.specification.spec import Spec
from pipeline.store import commits, records
from pipeline.store.commits import Packer, marker_key, pack_block, read_commits, sweep, withdraw, write_task
from pipeline.store.errors import DamagedError
from pipeline.store.keys import Owners, keys_of
from pipeline.store.records import block_of_pack
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run
from pipeline.store.setup import create
from tests.pipeline.factories import silent

PACKED = ["000000-000001.jsonl", "000002-000003.jsonl", "000004.json"]


@pytest.fixture(autouse=True)
def pairs(monkeypatch):
    """Two tasks a pack: of the five tasks one stays alone."""
    for module in (records, commits):
        monkeypatch.setattr(module, "BLOCK", 2)


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
def whole(made):
    """All tasks committed, each with a record of its own."""
    for index in range(5):
        made.commit(index)
    return made


@pytest.fixture
def packed(made, bytes_of):
    """A finished run, and its bytes."""
    assert go_on(made) == [0, 1, 2, 3, 4]
    made.before = bytes_of(made.info.directory)
    return made


# ---- a task ------------------------------------------------------------------------------------


def test_write_task__reads_back_and_the_others_are_pending(made):
    """Also fill values leave files, which the record names."""
    made.commit(1)
    assert set(read_commits(made.info, made.plan)) == {1}
    marker = json.loads((made.info.directory / marker_key(1)).read_text())
    assert sorted({key.split("/")[0] for key in marker["objects"]}) == sorted(v.name for v in made.plan.variables)
    assert all((made.info.directory / "cube.zarr" / key).is_file() for key in marker["objects"])
    ds, values = open_run(made.info.directory), made.values(1)
    for variable in made.plan.variables:
        found = ds[variable.name].values
        assert np.array_equal(found[made.plan.task(1)], values[variable.name]), variable.name
        others = found[made.plan.task(0)]
        assert np.array_equal(others, np.full_like(others, variable.fill), equal_nan=True), variable.name


def test_write_task__refuses_wrong_shapes_cut_chunks_and_damaged_metadata(made):
    """Chunks that damaged metadata encode would be committed, and read as something else."""
    values = made.values(0)
    values["status"] = values["status"][..., :1]
    with pytest.raises(ValueError, match="status"):
        write_task(made.info, made.plan, 0, values, {})
    for cut in (slice(1, 4), slice(0, 3)):
        with pytest.raises(ValueError, match="cuts chunks"):
            commits.chunk_keys("x", (cut,), (4,), (8,))
    assert commits.chunk_keys("x", (slice(4, 7),), (4,), (7,)) == ["x/c.1"]
    path = made.info.directory / "cube.zarr/section/zarr.json"
    path.write_text(path.read_text().replace('"little"', '"big"'))
    with pytest.raises(DamagedError, match=r"section/zarr\.json: its content has changed"):
        made.commit(0)
    assert read_commits(made.info, made.plan) == {}


def test_create__axes_keep_the_order_of_the_file(tmp_path, write_spec):
    """The order of the axes is that of the cube's dims: what reads run.json must see it."""
    text = 'kind = "sweep"\n[axes]\n' + "".join(
        f"{name} = {{ values = [1.5, 1.6] }}\n" for name in ("q", "frequency_hz", "eps_drive")
    )
    spec = Spec.read(write_spec(f'{text}[initial_conditions]\nkind = "grid"\n'))
    identity = identity_of(spec, make_plan(spec))
    create(tmp_path / "run", spec, make_plan(spec), identity, text)
    again = Spec.parse(read_run(tmp_path / "run").spec)
    assert list(again.axes) == list(spec.axes) == ["q", "frequency_hz", "eps_drive"]
    assert digest_of(identity_of(again, make_plan(again))) == digest_of(identity)


# ---- packs -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_packs__hold_whole_blocks_and_do_not_change_what_a_run_is(whole):
    alone = RunDirectory.open(whole.info.directory)
    digest, cells, first = alone.digest, alone.commits.cells(), dict(alone.commits)
    assert go_on(whole) == []
    assert names_in(whole) == PACKED
    together = RunDirectory.open(whole.info.directory)
    assert (together.digest, together.commits.cells()) == (digest, cells)
    found = together.commits
    assert dict(found) == first
    assert (list(found), len(found), 5 in found) == ([0, 1, 2, 3, 4], 5, False)
    with pytest.raises(KeyError):
        found[5]
    assert sorted(found[3].objects) == sorted(keys_of(whole.plan, 3))
    assert pickle.loads(pickle.dumps(found))[1] == found[1]
    assert state(whole.info.directory).cells == {"bounded": whole.plan.n_cells}
    assert verify_run(whole.info.directory).sound
    ds = together.cube()
    for name, values in whole.values(3).items():
        assert np.array_equal(ds[name].values[whole.plan.task(3)], values)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(4, 3, 2, 1, 0), (2, 0, 3, 1, 4)])
def test_packs__same_bytes_in_any_order_late_and_twice(packed, bytes_of, order):
    withdraw(packed.info, [f"{i:06d}.json" for i in range(5)])
    assert names_in(packed) == []
    packer = Packer(packed.info, packed.plan, read_commits(packed.info, packed.plan))
    for index in order:
        packed.commit(index)
        packer.add(index)
        packed.commit(index)
    assert bytes_of(packed.info.directory) == packed.before


@pytest.mark.slow
def test_withdraw__leaves_the_others_of_a_pack(packed, bytes_of):
    withdraw(packed.info, ["000001.json"])
    assert names_in(packed) == PACKED
    assert set(read_commits(packed.info, packed.plan)) == {0, 2, 3, 4}
    assert state(packed.info.directory).n_committed == packed.plan.n_cells - packed.plan.cells_in(1)
    packed.commit(1)
    assert names_in(packed) == sorted([*PACKED, "000001.json"])
    assert set(read_commits(packed.info, packed.plan)) == set(range(5))
    assert go_on(packed) == []
    assert bytes_of(packed.info.directory) == packed.before


@pytest.mark.slow
def test_damaged_pack__loses_only_the_damaged_record(packed, bytes_of):
    """Any bit of a record costs that task alone, and of the last line none."""
    path = packed.info.directory / "commits" / PACKED[0]
    content = path.read_bytes()
    first_line = content.index(b"\n")
    rng = np.random.default_rng(0)
    for place in [*rng.integers(0, first_line, 4), *rng.integers(first_line, len(content), 8)]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        assert {2, 3, 4} <= set(read_commits(packed.info, packed.plan))
        assert len(go_on(packed)) <= 1
        assert bytes_of(packed.info.directory) == packed.before


def test_read_commits__while_records_move_into_a_pack(whole, monkeypatch):
    """A reader that has listed the single ones reads them in their pack."""
    files = type(whole.info.files)
    original, moved = files.read_each, []

    def read_each(self, keys):
        keys = list(keys)
        if not moved:
            moved.append(True)
            pack_block(whole.info, whole.plan, 0)
        return original(self, keys)

    monkeypatch.setattr(files, "read_each", read_each)
    assert len(read_commits(whole.info, whole.plan)) == 5
    assert moved


def test_sweep__keeps_packs_and_removes_what_they_replace(packed):
    (packed.info.directory / marker_key(0)).write_text("left over")
    assert sweep(packed.info, packed.plan, read_commits(packed.info, packed.plan)) == 1
    assert names_in(packed) == PACKED


def test_keys__of_packs_and_chunks_lead_back(made):
    assert block_of_pack("000002-000003.jsonl") == 1
    for name in ("000001-000002.jsonl", "000002.json", "2-3.jsonl", "x-y.jsonl", ".000002-000003.jsonl.a.tmp"):
        assert block_of_pack(name) is None
    owners = Owners(made.plan)
    for index in range(made.plan.n_tasks):
        assert {owners.task(key) for key in keys_of(made.plan, index)} == {index}
    no_chunks = ["zarr.json", "status/zarr.json", "x/c.0", "frequency/c.0", "status/d.0.0.0.0"]
    for key in [*no_chunks, *(f"status/c.{w}" for w in ("9.9.9.9", "00.0.0.0", "0", "0.0.0.-1"))]:
        assert owners.task(key) is None, key
