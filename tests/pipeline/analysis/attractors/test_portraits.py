"""Portraits: full motions on attractors, and the path of the moving magnet."""

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_preset
from pipeline.analysis.attractors.portraits import portraits
from pipeline.layout.vocabulary import ABSENT, ATTRACTS, BOUNDED_SET, PERIODIC_ORBIT
from tests.pipeline.analysis.cubes import ORBITS, STATES, attributes_of


@pytest.fixture(scope="module")
def attractors():
    """The two reference orbits at 2.2 Hz; nothing at 2.3 Hz; the left one as a bounded set, too."""
    points = np.full((2, 3, 2, 4), np.nan)
    points[1, :2, 0] = [orbit["section"] for orbit in ORBITS[:2]]
    points[1, 2] = ORBITS[1]["section"]
    kind = np.array([[ABSENT] * 3, [PERIODIC_ORBIT, PERIODIC_ORBIT, BOUNDED_SET]], np.int8)
    there = (kind != ABSENT).astype(np.int8)
    per = ("frequency", "attractor")
    return xr.Dataset(
        {
            "attractor_id": (("frequency", "initial_condition"), np.zeros((2, 2), np.int32)),
            "kind": (per, kind),
            "orbit_period": (per, np.array([[0, 0, 0], [1, 1, 0]], np.int32)),
            "stability": (per, there * np.int8(ATTRACTS)),
            "n_cells": (per, there.astype(np.int64)),
            "share": (per, there / 3.0),
            "side": (per, there),
            "attractor_points": ((*per, "point", "state"), points),
        },
        coords={"frequency": [2.0, 2.2], "state": STATES, "attractor": [0, 1, 2]},
        attrs={"parameters": attributes_of(load_preset())["parameters"]},
    )


@pytest.mark.slow
def test_portraits__closed_orbits_close(attractors):
    found = portraits(attractors, at={"frequency": 2.2}, parameters=load_preset(), n_periods=3)
    assert found["attractor"].values.tolist() == [0, 1, 2]
    orbit = found["orbit"].values
    assert orbit.shape == (3, 3 * 256 + 1, 4)
    for i in range(2):
        assert np.isfinite(orbit[i, :257]).all()
        assert np.isnan(orbit[i, 257:]).all()
        # the reference orbits are known to 1e-9 and attract
        assert np.abs(orbit[i, 256] - ORBITS[i]["section"]).max() < 1e-6
    # the set is followed over three periods, each the left orbit's
    assert np.abs(orbit[2, 256:513] - orbit[1, :257]).max() < 1e-5
    assert found["time"].values[0, 256] == pytest.approx(1 / 2.2)
    assert portraits(attractors, at={"frequency": 2.0}, parameters=load_preset()).sizes["attractor"] == 0


def test_portraits__velocities_are_those_of_the_angles(attractors):
    found = portraits(attractors, at={"frequency": 2.2}, parameters=load_preset(), n_samples=2000, n_periods=1)
    orbit, time = found["orbit"].values[0, :2001], found["time"].values[0, :2001]
    rate = np.gradient(orbit[:, :2], time, axis=0)[1:-1]
    assert np.abs(rate - orbit[1:-1, 2:]).max() < 2e-2
    p = load_preset()
    found = portraits(attractors, at={"frequency": 2.2}, parameters=p, n_periods=1)
    assert found["fixed"].sel(fixed_place="fixed magnet", axis="y") == -p["h"]
    x = found["points"].sel(place="magnet", axis="x").values
    # the reference orbits are one-sided: right, left
    assert (x[0] > 0).all()
    assert (x[1] < 0).all()
    assert found["points"].attrs["units"] == "m"
    with pytest.raises(ValueError, match=r"frequency_hz \(2 values\)"):
        portraits(attractors)
    with pytest.raises(ValueError, match="n_samples = 0"):
        portraits(attractors, at={"frequency": 2.2}, n_samples=0)
    with pytest.raises(ValueError, match="no coordinate 'frequency'"):
        portraits(attractors.isel(frequency=1, drop=True))
