"""The cube rewritten for browsers: the same numbers, cut by columns, every file's digest known."""

from __future__ import annotations

import hashlib
import json
import warnings

import numpy as np
import pytest
import xarray as xr

from pipeline.store import consolidate
from pipeline.store.errors import DamagedError
from pipeline.store.run import RunDirectory


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
    files = {
        p.relative_to(tmp_path / "out").as_posix(): p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()
    }
    assert {k: v["sha256"] for k, v in entries.items()} == {
        k: hashlib.sha256(content).hexdigest() for k, content in files.items()
    }
    group = json.loads(files["cube.zarr/zarr.json"])
    assert "section" in group["consolidated_metadata"]["metadata"]


@pytest.mark.slow
@pytest.mark.parametrize(("along", "chunk"), [("frequency", (3, 1, 3, 4)), ("q", (1, 2, 3, 4)), (None, (1, 2, 3, 4))])
def test_write_cube__a_chunk_is_a_state_of_all_starts_at_some_values(made, tmp_path, monkeypatch, along, chunk):
    """12 starts x 3 sections x 8 bytes a column; room for three of them."""
    monkeypatch.setattr(consolidate, "CHUNK_BYTES", 3 * 12 * 3 * 8)
    monkeypatch.setattr(consolidate, "SLAB_BYTES", 1)
    for index in range(made.plan.n_tasks):
        made.commit(index)
    run = RunDirectory.open(made.info.directory)
    consolidate.write_cube(run, tmp_path / "out", along, {})
    metadata = json.loads((tmp_path / "out" / "cube.zarr" / "section" / "zarr.json").read_text())
    assert run.plan.dims == ("frequency", "q", "psi1_0", "psi2_0")
    assert tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"]) == (*chunk, 3, 1)
    np.testing.assert_array_equal(_open(tmp_path / "out")["section"], run.cube()["section"])


def test_write_cube__refuses_a_damaged_source(made, tmp_path):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    chunk = next((made.info.directory / "cube.zarr" / "section").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(DamagedError, match="section"):
        consolidate.write_cube(RunDirectory.open(made.info.directory), tmp_path / "out", "frequency", {})
