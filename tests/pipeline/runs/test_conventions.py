"""Opened cubes and results are read by cf-xarray and pint-xarray, and exported as NetCDF."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import magpend
from pipeline.layout.conventions import CONVENTIONS
from tests.pipeline.factories import duffing, finished

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.slow

WALK = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 6 }",
    'kind = "list"\npoints = [[-1.0, 0.0], [1.0, 0.5]]',
    kind="continuation",
    n_transient=40,
    n_keep=8,
    more='[continuation]\npath = "frequency_hz"\ndirection = "both"',
)


@pytest.fixture(scope="module", autouse=True)
def _readers():
    pytest.importorskip("cf_xarray")
    pytest.importorskip("pint_xarray")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A finished continuation."""
    return finished(tmp_path_factory.mktemp("conventions"), WALK)


def readable(ds, path):
    """A dataset that both packages read without errors, and that is the same after it was a NetCDF file."""
    quantities = ds.pint.quantify()
    for name, variable in ds.variables.items():
        unit = quantities[name].pint.units
        assert (unit is None) == ("units" not in variable.attrs), name
        assert variable.attrs["long_name"], name
        if "flag_values" in variable.attrs:
            codes = variable.attrs["flag_values"]
            assert len(codes) == len(variable.attrs["flag_meanings"].split()), name
            assert codes.dtype == variable.dtype, name
        for other in variable.attrs.get("ancillary_variables", "").split():
            assert set(ds[other].dims) <= {*variable.dims}, name
    assert quantities.pint.dequantify().sizes == ds.sizes
    assert ds.attrs["Conventions"] == CONVENTIONS
    ds.to_netcdf(path)
    with xr.open_dataset(path) as again:
        assert again.cf.axes == ds.cf.axes
        assert np.array_equal(again.status, ds.status)
    return quantities


def test_open_run__sweep_is_described(made, tmp_path):
    for index in range(made.plan.n_tasks):
        made.commit(index)
    ds = magpend.open_run(made.info.directory)
    assert ds.cf.axes == {"X": ["frequency"], "Y": ["q"], "Z": ["psi1_0"]}
    assert ds.cf.standard_names == {"status_flag": ["status"]}
    assert (ds.status.cf == "bounded").all()
    assert "status" in ds.cf["section"].coords  # an ancillary variable
    quantities = readable(ds.load(), tmp_path / "cube.nc")
    assert str(quantities.frequency.pint.to("1/min").pint.units) == "1 / minute"
    assert np.allclose(quantities.psi1_0.pint.to("degree").pint.magnitude, np.degrees(ds.psi1_0))
    # plainly opened, the file has the same
    plain = xr.open_zarr(made.info.directory / "cube.zarr")
    assert plain.cf.axes == ds.cf.axes
    plain.pint.quantify()


def test_docs__example_of_the_cube(walk, monkeypatch):
    text = (ROOT / "docs/reference/cube.md").read_text("utf-8")
    (block,) = re.findall(r"<!-- tested -->\n```python\n(.*?)```", text, re.DOTALL)
    assert "runs/quickstart" in block
    names = {}
    exec(block.replace("runs/quickstart", str(walk)), names)
    assert names["period"].pint.magnitude[0] == pytest.approx(1e3 / 0.15)
    assert int(names["periodic"].notnull().any(["period_index", "state"]).sum()) == int((names["ds"].status == 1).sum())
