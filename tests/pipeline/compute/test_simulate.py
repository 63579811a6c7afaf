"""One trajectory to a series on disk."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_preset, trajectory
from pipeline.compute.simulate import simulate, write_series
from pipeline.specification.problems import SpecError

START = (0.2, 0.1, 0.0, 0.0)


@pytest.fixture(scope="module")
def series():
    return simulate(2.2, START, overrides={"q": 1.5}, n_transient=1, n_periods=2, samples_per_period=20)


def test_simulate__is_the_cores_trajectory(series):
    expected = trajectory(load_preset(q=1.5), 2.2, np.array(START), series.time.values)
    assert len(series.time) == 41
    assert series.time.values[0] == 1 / 2.2
    assert (series.psi1.values == expected[:, 0]).all()
    assert (series.psi2_dot.values == expected[:, 3]).all()
    # the high state lasts for duty_cycle = 0.4927 of a period
    assert (series.drive_torque.values[1:9] > 0).all()
    assert (series.drive_torque.values[11:19] < 0).all()
    assert all(series[name].attrs["units"] for name in (*series.data_vars, "time"))


def test_write_series__csv_and_netcdf_read_back(series, tmp_path):
    table = np.genfromtxt(write_series(series, tmp_path / "a.csv"), delimiter=",", names=True)
    states = ("psi1_rad", "psi2_rad", "psi1_dot_rad_per_s", "psi2_dot_rad_per_s")
    assert table.dtype.names[:7] == ("time_s", *states, "energy_J", "power_in_W")
    assert len(table.dtype.names) == 1 + len(series.data_vars)
    assert (table["psi1_rad"] == series.psi1.values).all()
    with xr.open_dataset(write_series(series, tmp_path / "a.nc"), engine="scipy") as read:
        assert read.attrs["frequency_hz"] == 2.2
        assert (read.psi2.values == series.psi2.values).all()


def test_simulate__all_problems_at_once():
    with pytest.raises(SpecError) as caught:
        simulate(
            float("nan"),
            (float("inf"), 0, 0, 0),
            overrides={"qq": 1},
            n_transient=-1,
            n_periods=0,
            samples_per_period=0,
            rtol=float("nan"),
            atol=-1,
        )
    starts = ("frequency_hz", "rtol", "atol", "psi1", "n_transient", "n_periods", "samples", "'qq'")
    assert len(caught.value.problems) == len(starts)
    for start in starts:
        assert any(p.startswith(start) for p in caught.value.problems)


@pytest.mark.parametrize(
    ("name", "value"), [("rtol", 1.0), ("rtol", 1e-14), ("atol", 1.0), ("atol", 0.0), ("n_transient", 10**9)]
)
def test_simulate__has_the_bounds_of_specifications(name, value):
    from pydantic import ValidationError

    from pipeline.specification.tables import Integration

    with pytest.raises(ValidationError):
        Integration(**{name: value})
    with pytest.raises(SpecError, match=f"{name} = "):
        simulate(2.2, (0.1, 0.0, 0.0, 0.0), **{name: value})
