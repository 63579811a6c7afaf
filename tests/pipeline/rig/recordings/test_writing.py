"""Recordings that are written are read back to the same numbers."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.recordings import (
    findings_of,
    load_mapping,
    mapping_for,
    read_recording,
    recording_of,
    window,
    write_raw,
    write_recording,
)
from pipeline.specification.problems import SpecError


@pytest.fixture
def pieces(make):
    """Recording in two pieces, with a gap, samples that were not measured, and a drive."""
    a, b = make.swing()
    a[5:9] = np.nan
    stamps = make.time + 0.3 * (make.time > 2.0)
    drive = np.where(np.mod(make.time, 0.4) < 0.2, 1.5, -1.5)
    mapping = make.mapping(tables={"time": {"channel": "t"}, "drive": {"channel": "m", "kind": "torque"}})
    return recording_of(make.raw(make.channels({"t": stamps, "a": a, "b": b, "m": drive}, step_s=np.nan)), mapping)


@pytest.mark.slow  # needs nptdms
@pytest.mark.parametrize(
    ("suffix", "kind"), [*product((".csv", ".tdms"), ("whole", "simulated", "window")), (".csv", "pieces")]
)
def test_write_recording__is_read_back(tmp_path, make, pieces, suffix, kind):
    ds = pieces if kind == "pieces" else make.recorded()
    ds = ds.assign_attrs(simulated=1) if kind == "simulated" else ds
    ds = window(ds, (1.0, 2.0)) if kind == "window" else ds
    path = write_recording(ds, tmp_path / f"x{suffix}")
    mapping = tmp_path / "x.toml"
    mapping.write_text(mapping_for(ds, path).toml())
    found = read_recording(path, load_mapping(mapping))
    # time counts from the first sample of what is in the file
    make.same(found, ds.assign_coords(time=ds["time"] - ds["time"][0]))
    assert found.attrs.get("simulated") == ds.attrs.get("simulated")


def test_write_recording__netcdf_is_the_dataset(tmp_path, pieces):
    path = write_recording(pieces, tmp_path / "x.nc")
    with xr.open_dataset(path, engine="scipy") as found:
        np.testing.assert_array_equal(found["psi1"], pieces["psi1"])
        assert findings_of(found) == findings_of(pieces)


def test_write_recording__refuses_a_path_that_cannot_be_written(tmp_path, make):
    with pytest.raises(SpecError, match=r"suffix must be one of \.tdms, \.csv, \.nc"):
        write_recording(make.recorded(), tmp_path / "x.mat")
    with pytest.raises(SpecError, match="no such folder"):
        write_recording(make.recorded(), tmp_path / "none" / "x.csv")


def test_write_raw__csv_has_a_column_of_time(tmp_path, make):
    a, b = make.swing()
    path = write_raw(make.raw(make.channels({"a": a, "b": b})), tmp_path / "x.csv")
    mapping = make.mapping(tables={"time": {"channel": "time"}})
    np.testing.assert_array_equal(read_recording(path, mapping)["psi2"], b)
