"""Figures 6 to 9 carry what they draw."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_model
from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.plots.style import Frame
from pipeline.rig.magnet.figures import FIGURES, write_figures

from .conftest import TRUE


@pytest.fixture
def outcome(fitted):
    return fitted.outcome


@pytest.fixture(scope="module")
def figures(fitted):
    return {name: draw(fitted.outcome, Frame(85.0)) for name, draw in FIGURES.items()}


@pytest.mark.slow
def test_draw_curves__data_are_readings_and_bumps(outcome, figures):
    data = figures["fig6"].data
    assert data.sizes == {"reading": 5 * 42, "curve": 10, "fine": 241}
    assert set(np.unique(data["curve_locked"].round(9))) == {-32.0, -16.0, 0.0, 16.0, 32.0}
    fit = next(f for f in outcome.curves if f.curve.locked == 0.0 and f.curve.side == 0)
    row = data.sel(curve=(data["curve_locked"] == 0.0) & (data["curve_side"] == 0)).squeeze()
    expected = laws.bump(np.radians(row["fine_angle"]), *fit.values.values())
    np.testing.assert_allclose(row["bump"], expected, atol=1e-12)


@pytest.mark.slow
def test_draw_numbers__the_joint_law_is_that_of_the_readings(figures):
    data = figures["fig7"].data
    locked = np.radians(data["fine_locked"].values)
    expected = TRUE["alpha2"] * np.exp(-(((locked + TRUE["beta2"]) / TRUE["gamma2"]) ** 2))
    np.testing.assert_allclose(data["A_joint"][1], expected, rtol=1e-7)
    np.testing.assert_allclose(data["b_joint"][0], TRUE["p1"] * locked + TRUE["r1"], atol=1e-9)
    assert data.sizes["curve"] == 18


@pytest.mark.slow
def test_draw_map__is_the_models_torque(figures):
    data = figures["fig8"].data
    p = load_model("pendulum").load(**TRUE)
    angle, locked = np.radians(data["fine_angle"].values), np.radians(data["fine_locked"].values)
    np.testing.assert_allclose(data["torque_map"], laws.magnet_moment(angle, locked[:, None], p), atol=1e-8)
    line = laws.transition(TRUE)
    np.testing.assert_allclose(data["transition"], np.degrees(line.slope * locked + line.offset), atol=1e-6)


@pytest.mark.slow
def test_draw_comparison__what_is_left_over_is_readings_less_models(outcome, figures):
    data = figures["fig9"].data
    assert np.abs(data["left_by_fit"]).max() < 1e-8
    p = {**outcome.measured.parameters, **outcome.dipoles.values}
    computed = laws.dipole_moment(np.radians(data["angle"].values), np.radians(data["locked"].values), p)
    np.testing.assert_allclose(data["torque"] - data["left_by_dipoles"], computed, atol=1e-12)


@pytest.mark.slow
def test_figures__say_that_readings_are_synthetic_and_their_data_lie_beside_them(outcome, figures, tmp_path):
    for figure in figures.values():
        assert "SYNTHETIC" in " ".join(t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text")))
        assert figure.data.attrs["synthetic"] == 1
    written = write_figures(outcome, tmp_path)
    assert [path.name for path in written[:2]] == ["fig6.png", "fig6.nc"]
    with xr.open_dataset(tmp_path / "fig9.nc", engine="scipy") as ds:
        assert ds.attrs["file"] == "readings.csv"
        assert ds.attrs["title"].startswith("SYNTHETIC")
