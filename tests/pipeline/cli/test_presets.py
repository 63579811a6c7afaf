"""Presets in files on the command line."""

from __future__ import annotations

import pytest
import xarray as xr

from magpend_core.models.preset_writing import write_preset


@pytest.fixture
def rig(tmp_path):
    values = {"damping": 0.2, "linear": -1.0, "cubic": 1.0, "amplitude": 0.3}
    return write_preset(
        tmp_path / "rig.toml", "duffing", values, dict.fromkeys(values, "fit of 3 swings"), "a bent beam"
    )


def test_presets__shows_a_file_with_its_own_model(main, rig):
    code, out, _ = main("presets", str(rig))
    assert code == 0
    assert out.startswith("preset rig: a bent beam")
    assert "damping    0.2" in out
    assert "fit of 3 swings" in out


def test_simulate__takes_a_file_and_says_where_the_values_come_from(main, rig, tmp_path):
    series = tmp_path / "x.nc"
    words = ("--model", "duffing", "--preset", str(rig), "--set", "amplitude=0.25", "--periods", "1")
    code, _, err = main("simulate", *words, "--out", str(series), "--no-figure")
    assert code == 0, err
    with xr.open_dataset(series, engine="scipy") as ds:
        assert "damping = 0.2" in ds.attrs["parameters"]
        assert ds.attrs["preset"] == "rig"
        assert "damping: fit of 3 swings" in ds.attrs["sources"]
        assert "amplitude: given" in ds.attrs["sources"]


def test_simulate__refuses_the_file_of_another_model(main, rig):
    code, _, err = main("simulate", "--preset", str(rig))
    assert code == 2
    assert "is of model 'duffing'" in err
