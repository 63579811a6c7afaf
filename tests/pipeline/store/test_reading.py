"""An opened cube explains itself and reads nothing before it is asked."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from magpend_core import Status
from magpend_core.models import load_model
from pipeline import open_run
from pipeline.layout.schema import base_variables
from pipeline.store import parallel_reads
from pipeline.store.view import CommittedStore

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
    tree = ast.parse(Path(parallel_reads.__file__).read_text("utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {name for name in modules if name and name.startswith("zarr.core")}
