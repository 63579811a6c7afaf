"""What a task writes, records, their packs and copy, and what readers get: the same bytes whatever happens."""

from __future__ import annotations

import ast
import hashlib
import json
import pickle
import warnings
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import xarray as xr
from zarr.storage import LocalStore

from magpend_core import Status
from magpend_core.models import load_model
from pipeline import open_run
from pipeline.layout.identity import digest_of
from pipeline.layout.plan import make_plan
from pipeline.layout.schema import base_variables
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.specification.spec import Spec
from pipeline.store import commits, consolidate, products, reading, records, tasks
from pipeline.store.checking import sound_commits
from pipeline.store.commits import Packer, marker_key, pack_block, read_commits, scan, withdraw
from pipeline.store.declared import METADATA
from pipeline.store.empty_cube import skeleton_files
from pipeline.store.errors import DamagedError
from pipeline.store.files import RECORD_COPY
from pipeline.store.keys import keys_of
from pipeline.store.record_copy import copied_records, write_copy
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run, write_run
from pipeline.store.setup import create
from pipeline.store.skeleton import entries_of, write_skeleton
from pipeline.store.stored_json import seal, unseal
from pipeline.store.tasks import write_task
from pipeline.store.view import CommittedStore
from tests.pipeline.factories import contents, silent

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
    found = sound_commits(made.info, silent)
    packer = Packer(made.info, found)
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


# ---- a task ------------------------------------------------------------------------------------


def test_write_task__reads_back_and_the_others_are_pending(made):
    """Also fill values leave files, which the record names."""
    made.commit(1)
    assert set(read_commits(made.info)) == {1}
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
        write_task(made.info, 0, values, {})
    for cut in (slice(1, 4), slice(0, 3)):
        with pytest.raises(ValueError, match="cuts chunks"):
            tasks.chunk_keys("x", (cut,), (4,), (8,))
    assert tasks.chunk_keys("x", (slice(4, 7),), (4,), (7,)) == ["x/c.1"]
    path = made.info.directory / "cube.zarr/section/zarr.json"
    path.write_text(path.read_text().replace('"little"', '"big"'))
    with pytest.raises(DamagedError, match=r"section/zarr\.json: its content has changed"):
        made.commit(0)
    assert read_commits(made.info) == {}


def test_create__axes_keep_the_order_of_the_file(tmp_path, write_spec):
    """The order of the axes is that of the cube's dims: what reads run.json must see it."""
    text = 'kind = "sweep"\n[axes]\n' + "".join(
        f"{name} = {{ values = [1.5, 1.6] }}\n" for name in ("q", "frequency_hz", "eps_drive")
    )
    spec = Spec.read(write_spec(f'{text}[initial_conditions]\nkind = "grid"\n'))
    info = create(tmp_path / "run", make_plan(spec, text))
    again = Spec.parse(read_run(tmp_path / "run").spec)
    assert list(again.axes) == list(spec.axes) == ["q", "frequency_hz", "eps_drive"]
    assert digest_of(make_plan(again).identity) == info.digest


# ---- one bit that flips, on the way to the disk or later --------------------------------------------


def flipped(content: bytes, byte: int = -40) -> bytes:
    changed = bytearray(content)
    changed[byte] ^= 4
    return bytes(changed)


def test_write_task__a_bit_flips_while_a_chunk_is_written(made, monkeypatch):
    original = LocalStore.set

    async def harmed(self, key, value):
        if key.startswith("section/c"):
            value = type(value).from_bytes(flipped(value.to_bytes()))
        await original(self, key, value)

    with monkeypatch.context() as patch:
        patch.setattr(LocalStore, "set", harmed)
        with pytest.raises(DamagedError, match="while it was written"):
            made.commit(0)
    assert not read_commits(made.info)
    assert not list((made.info.directory / "cube.zarr/section").glob("c*"))
    made.commit(0)
    assert (open_run(made.info.directory).section.isel(frequency=0, q=0) == made.values(0)["section"][0, 0]).all()


@pytest.mark.parametrize("checks", [True, False])
def test_open_run__a_record_that_vouches_for_a_flipped_bit(whole, checks):
    """Records of earlier versions hold the digests of what was read back; the chunk's own checksum is of what was
    written.
    """
    path = whole.info.directory / marker_key(0)
    record = unseal(path.read_bytes())
    key = next(key for key in record["objects"] if key.startswith("section/"))
    chunk = whole.info.directory / "cube.zarr" / key
    chunk.write_bytes(content := flipped(chunk.read_bytes()))
    record["objects"][key] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    path.write_bytes(seal(json.dumps(record, sort_keys=True)).encode())
    assert google_crc32c.value(content[:-4]) != int.from_bytes(content[-4:], "little")
    with pytest.raises(DamagedError, match="its content has changed"):
        open_run(whole.info.directory, check=checks).section.load()


def test_write_product__a_bit_flips_while_it_is_written(tmp_path, monkeypatch):
    ds = xr.Dataset({"x": ("n", np.linspace(0.0, 1.0, 500))}, attrs={"kind": "test"})
    original = products.sync

    def harmed(files, top):
        chunk = next((top / "x").glob("c*"))
        chunk.write_bytes(flipped(chunk.read_bytes()))
        original(files, top)

    with monkeypatch.context() as patch:
        patch.setattr(products, "sync", harmed)
        with pytest.raises(DamagedError, match="its content has changed"):
            products.write_product(tmp_path / "x.zarr", ds)
    assert list(tmp_path.iterdir()) == []
    products.write_product(tmp_path / "x.zarr", ds)
    assert products.open_product(tmp_path / "x.zarr").identical(ds)


def test_open_product__reads_what_was_written_at_once_and_lazily(tmp_path, monkeypatch):
    """Arrays of all kinds, in several chunks whose last ones are cut short, a number alone, an empty one, labels."""
    monkeypatch.setattr(products, "_PRODUCT_CHUNK_BYTES", 200)
    rng = np.random.default_rng(0)
    ds = xr.Dataset(
        {
            "x": (("n", "k"), rng.normal(size=(13, 7)), {"units": "s"}),
            "whole": (("n",), rng.integers(-9, 9, 13)),
            "is_good": (("n",), rng.integers(0, 2, 13).astype(bool)),
            "code": (("k",), np.arange(7, dtype=np.int8)),
            "side": (("n",), np.array(["left", "right", "straddling"])[np.arange(13) % 3]),
            "total": ((), 2.5),
            "none": (("empty",), np.zeros(0)),
        },
        coords={"state": ("k", list("abcdefg")), "n": np.linspace(0.0, 1.0, 13)},
        attrs={"kind": "test", "level": 1.5},
    )
    products.write_product(tmp_path / "x.zarr", ds)
    assert len(list((tmp_path / "x.zarr/x").glob("c*"))) > 3
    found = products.open_product(tmp_path / "x.zarr")
    xr.testing.assert_identical(found, ds)
    assert {name: v.dtype for name, v in found.variables.items()} == {name: v.dtype for name, v in ds.variables.items()}
    xr.testing.assert_identical(products.open_product(tmp_path / "x.zarr", lazy=True), ds)


# ---- packs -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_packs__hold_whole_blocks_and_do_not_change_what_a_run_is(whole):
    alone = RunDirectory.open(whole.info.directory)
    digest, cells, first = alone.digest, alone.commits.cells(), dict(alone.commits)
    assert go_on(whole) == []
    assert names_in(whole) == PACKED
    together = RunDirectory.open(whole.info.directory)
    found = together.commits
    assert (together.digest, found.cells(), dict(found)) == (digest, cells, first)
    assert (list(found), len(found), 5 in found) == ([0, 1, 2, 3, 4], 5, False)
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
    packer = Packer(packed.info, read_commits(packed.info))
    for index in order:
        packed.commit(index)
        packer.add(index)
        packed.commit(index)
    assert bytes_of(packed.info.directory) == packed.before


def test_read_commits__while_records_move_into_a_pack(whole, monkeypatch):
    """A reader that has listed the single ones reads them in their pack."""
    files = type(whole.info.files)
    original, moved = files.read_each, []

    def read_each(self, keys):
        keys = list(keys)
        if not moved:
            moved.append(True)
            pack_block(whole.info, 0)
        return original(self, keys)

    monkeypatch.setattr(files, "read_each", read_each)
    assert len(read_commits(whole.info)) == 5
    assert moved


# ---- the copy of the records: one request instead of many ---------------------------------------------


@pytest.fixture
def copied(whole):
    """A complete run with the copy of its records, and the copy's path."""
    write_copy(whole.info, read_commits(whole.info))
    return whole, whole.info.directory / RECORD_COPY


def test_write_copy__has_the_lines_of_the_records_and_counts_only_with_them(copied):
    whole, path = copied
    lines, records = path.read_bytes().splitlines(keepends=True), sorted((path.parent / "commits").iterdir())
    assert lines[:-1] == [f.read_bytes() for f in records]
    assert json.loads(lines[-1])["records"] == whole.plan.n_tasks
    sizes = {f.name: f.stat().st_size for f in records}
    assert copied_records(whole.info, sizes) == dict(read_commits(whole.info))
    del sizes["000001.json"]
    sizes["000002.json"] += 1
    assert set(copied_records(whole.info, sizes)) == {0, 3, 4}
    # of an incomplete run there is none
    records[1].unlink()
    write_copy(whole.info, read_commits(whole.info))
    assert not path.exists()


def test_withdraw__removes_the_copy_first(copied, monkeypatch):
    whole, path = copied
    real, removed = type(whole.info.files).remove, []

    def remove(self, keys):
        removed.extend(keys := list(keys))
        if keys != [RECORD_COPY]:
            raise InterruptedError
        real(self, keys)

    monkeypatch.setattr(type(whole.info.files), "remove", remove)
    with pytest.raises(InterruptedError):
        withdraw(whole.info, ["000001.json"])
    assert removed == [RECORD_COPY, "000001.json"]
    assert not path.exists()


def test_copy__is_not_read_where_each_file_is_at_hand(copied):
    """In a folder, and by commands that write, the records themselves are read."""
    whole, path = copied
    (path.parent / "commits/000001.json").write_bytes(b"{}")
    for found in (scan(whole.info)[0], sound_commits(whole.info, silent)):
        assert set(found) == {0, 2, 3, 4}


# ---- metadata of the group ---------------------------------------------------------------------


def remade(made, change, **options):
    """The run with other files of the set-up, and a run.json whose digests fit them."""
    contents = skeleton_files(made.plan, made.info.identity, **options)
    group = json.loads(contents[METADATA])
    change(group)
    contents = {**contents, METADATA: json.dumps(group).encode()}
    write_skeleton(made.info.files, contents, contents)
    return write_run(made.info.files, made.plan, made.info.identity, entries_of(contents))


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


# ---- reading ---------------------------------------------------------------------------------------------

VARIABLES = base_variables(load_model())


@pytest.mark.slow
def test_open_run__explains_itself(made):
    made.commit(0)
    ds = open_run(made.info.directory)
    assert ds.section.dims == ("frequency", "q", "psi1_0", "psi2_0", "period_index", "state")
    assert list(ds.data_vars) == [v.name for v in VARIABLES]
    assert [ds[name].attrs["units"] for name in ("frequency", "q", "psi1_0")] == ["Hz", "N m", "rad"]
    assert ds.psi1_dot_0.item() == 0.1
    assert np.allclose(np.rad2deg(ds.psi1_0), [-30, 0, 30])
    assert ds.state.values.tolist() == ["psi1", "psi2", "psi1_dot", "psi2_dot"]
    meanings = dict(zip(ds.status.attrs["flag_values"], ds.status.attrs["flag_meanings"].split(), strict=True))
    assert meanings == {int(s): s.name.lower() for s in Status}
    kept = {"spec": made.info.spec_text, "title": "small sweep", "closure_tolerance": 1e-6, "n_transient": 2}
    assert ds.attrs.items() >= kept.items()
    assert "q = 1.543" in ds.attrs["parameters"]
    assert ds.section.sel(frequency=2.25, q=1.6, state="psi1").dims == ("psi1_0", "psi2_0", "period_index")


@pytest.mark.slow
def test_open_run__reads_no_chunk_before_it_is_used(whole, monkeypatch):
    asked = []
    original = CommittedStore.get

    async def get(self, key, *arguments, **options):
        asked.append(key)
        return await original(self, key, *arguments, **options)

    monkeypatch.setattr(CommittedStore, "get", get)
    names = tuple(f"{v.name}/c" for v in VARIABLES)
    for chunks in (None, {}):
        ds = open_run(whole.info.directory, chunks=chunks)
        ds.section.sel(frequency=2.25)
        assert not [key for key in asked if key.startswith(names)]
        ds.status.isel(frequency=0, q=0).values  # noqa: B018
        read = [key for key in asked if key.startswith(names)]
        assert read
        assert {key.split("/")[0] for key in read} == {"status"}
        assert len(set(read)) < whole.plan.n_tasks
        asked.clear()


def test_quick__builds_on_what_zarr_makes_public():
    """No module of `zarr.core`: what is there may change with any version."""
    tree = ast.parse(Path(reading.__file__).read_text("utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {name for name in modules if name and name.startswith("zarr.core")}


# ---- the cube rewritten for browsers: the same numbers, cut by columns -----------------------------------


def _open(folder):
    with warnings.catch_warnings():
        # what zarr says of gzip after shuffling, and of metadata in one file
        warnings.simplefilter("ignore")
        return xr.open_zarr(folder / "cube.zarr", mask_and_scale=False).load()


@pytest.mark.slow
def test_write_cube__has_the_cubes_numbers_and_pending_cells(made, tmp_path):
    for index in range(made.plan.n_tasks - 1):
        made.commit(index)
    run = RunDirectory.open(made.info.directory)
    layer = np.arange(made.plan.n_cells, dtype=np.uint16).reshape(made.plan.shape)
    consolidate.write_cube(
        run, tmp_path / "out", "frequency", {"colour": consolidate.Layer(layer, {"title": "of cells"})}
    )
    written, cube = _open(tmp_path / "out"), run.cube()
    assert set(written.variables) == {*cube.variables, "colour"}
    for name in cube.variables:
        np.testing.assert_array_equal(written[name].values, cube[name].values, err_msg=str(name))
        assert written[name].dims == cube[name].dims
    np.testing.assert_array_equal(written["colour"], layer)
    assert written.attrs["spec"] == cube.attrs["spec"]
    assert "host" in cube.attrs
    assert "host" not in written.attrs


def test_write_cube__lists_the_digest_of_every_file(made, tmp_path):
    made.commit(0)
    entries = consolidate.write_cube(RunDirectory.open(made.info.directory), tmp_path / "out", "q", {})
    files = contents(tmp_path / "out")
    assert {k: v["sha256"] for k, v in entries.items()} == {k: hashlib.sha256(c).hexdigest() for k, c in files.items()}
    assert "section" in json.loads(files["cube.zarr/zarr.json"])["consolidated_metadata"]["metadata"]


@pytest.mark.slow
@pytest.mark.parametrize(("along", "chunk"), [("frequency", (3, 1, 3, 4)), ("q", (1, 2, 3, 4)), (None, (1, 2, 3, 4))])
def test_write_cube__a_chunk_is_a_state_of_all_starts_at_some_values(whole, tmp_path, monkeypatch, along, chunk):
    """12 starts x 3 sections x 8 bytes a column; room for three of them."""
    monkeypatch.setattr(consolidate, "CHUNK_BYTES", 3 * 12 * 3 * 8)
    monkeypatch.setattr(consolidate, "SLAB_BYTES", 1)
    run = RunDirectory.open(whole.info.directory)
    consolidate.write_cube(run, tmp_path / "out", along, {})
    metadata = json.loads((tmp_path / "out" / "cube.zarr" / "section" / "zarr.json").read_text())
    assert run.plan.dims == ("frequency", "q", "psi1_0", "psi2_0")
    assert tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"]) == (*chunk, 3, 1)
    np.testing.assert_array_equal(_open(tmp_path / "out")["section"], run.cube()["section"])


def test_write_cube__refuses_a_damaged_source(whole, tmp_path):
    chunk = next((whole.info.directory / "cube.zarr" / "section").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(DamagedError, match="section"):
        consolidate.write_cube(RunDirectory.open(whole.info.directory), tmp_path / "out", "frequency", {})
