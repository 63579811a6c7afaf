"""Figures of an identification: what is drawn are the numbers."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.identify import figures


@pytest.fixture
def ds():
    """Two fitted pieces and one held out of one channel; the residual is a share of the rate, and noise."""
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(400)
    parts = []
    for number, held in ((0, 0), (2, 0), (1, 1)):
        x, rate = np.sin(3 * t + number), 3 * np.cos(3 * t + number)
        left = 0.002 * rate * (1 + held) + 1e-4 * rng.normal(size=400)
        parts.append(
            xr.Dataset(
                {"x_measured": ("sample", x + left, {"units": "m"}), "x_residual": ("sample", left, {"units": "m"})},
                coords={
                    "time": ("sample", t),
                    "recording": ("sample", np.zeros(400, np.int32)),
                    "piece": ("sample", np.full(400, number)),
                    "held_out": ("sample", np.full(400, held)),
                },
            )
        )
    return xr.concat(parts, "sample").assign_attrs(model="duffing", title="made up", channels="x")


RESULT = {
    "names": ["a", "zero.x"],
    "estimates": {
        "a": {"value": 2e-5, "error": 1e-6, "unit": "N m s"},
        "zero.x": {"value": 0.0, "error": None, "unit": "m"},
    },
    "profiles": {
        "a": {"values": [1e-5, 2e-5, 3e-5], "growth": [9.0, 0.0, None]},
        "zero.x": {"values": [-1.0, 0.0, 1.0], "growth": [0.0, 0.0, 0.0]},
    },
    "covariance": {"critical": 2.0},
    "correlations": {"a": {"a": 1.0, "zero.x": None}, "zero.x": {"a": None, "zero.x": None}},
}


def test_pieces_in__and_their_root_mean_squares(ds):
    found = figures.pieces_in(ds)
    assert [(s.number, s.held_out, s.samples) for s in found] == [
        (0, False, (0, 400)),
        (2, False, (400, 800)),
        (1, True, (800, 1200)),
    ]
    rms = figures.per_piece(ds, "x")
    assert rms["piece"].values.tolist() == [0, 1, 2]
    assert rms["held_out"].values.tolist() == [0, 1, 0]
    left = ds["x_residual"].values
    np.testing.assert_allclose(rms["rms"].values[1], np.sqrt(np.mean(left[800:] ** 2)))


def test_residual_views__mean_goes_with_the_rate(ds):
    """What a wrong friction leaves: the slope of the means in bins is that of the residuals."""
    views = figures.residual_views(ds, ["x"])
    slope = np.polyfit(views["x_rate"], views["x_mean"], 1)[0]
    assert slope == pytest.approx(0.002, rel=0.02)
    width = np.diff(views["x_edges"].values)
    assert float(np.sum(views["x_density"].values * width)) == pytest.approx(1.0, abs=1e-9)
    assert float(views["x_autocorrelation"][0]) == 1.0


@pytest.mark.slow
def test_draw_all__writes_figures_and_their_data(ds, tmp_path):
    files = figures.draw_all(tmp_path, ds, RESULT)
    assert sorted(files) == sorted(
        f"{name}.{suffix}" for name in ("fit", "residuals", "profiles", "correlations") for suffix in ("png", "nc")
    )
    with xr.open_dataset(tmp_path / "fit.nc", engine="scipy") as drawn:
        assert drawn.sizes["sample"] == 1200
    first = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    figures.draw_all(tmp_path, ds, RESULT)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == first
