"""One bit that flips on the way to the disk, or later, is noticed before a wrong number is returned."""

from __future__ import annotations

import hashlib
import json

import google_crc32c
import numpy as np
import pytest
import xarray as xr
from zarr.storage import LocalStore

from pipeline import open_run
from pipeline.store import products
from pipeline.store.commits import marker_key, read_commits
from pipeline.store.errors import DamagedError
from pipeline.store.stored_json import seal, unseal


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
    assert not read_commits(made.info, made.plan)
    assert not list((made.info.directory / "cube.zarr/section").glob("c*"))
    made.commit(0)
    assert (open_run(made.info.directory).section.isel(frequency=0, q=0) == made.values(0)["section"][0, 0]).all()


@pytest.mark.parametrize("checks", [True, False])
def test_open_run__a_record_that_vouches_for_a_flipped_bit(made, checks):
    """Records of earlier versions hold the digests of what was read back; the chunk's own checksum is of what was
    written.
    """
    for index in range(made.plan.n_tasks):
        made.commit(index)
    path = made.info.directory / marker_key(0)
    record = unseal(path.read_bytes())
    key = next(key for key in record["objects"] if key.startswith("section/"))
    chunk = made.info.directory / "cube.zarr" / key
    chunk.write_bytes(content := flipped(chunk.read_bytes()))
    record["objects"][key] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    path.write_bytes(seal(json.dumps(record, sort_keys=True)).encode())
    assert google_crc32c.value(content[:-4]) != int.from_bytes(content[-4:], "little")
    with pytest.raises(DamagedError, match="its content has changed"):
        open_run(made.info.directory, check=checks).section.load()


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
