"""Figures of trajectories, and how any figure becomes a file."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.plots import Frame, labels, plot_trajectory, save_figure
from tests.pipeline.plots.made_up import DUFFING, PENDULUM, STATES, VALUES, legend_texts


def make_trajectory(n=401, frequency=2.0):
    time = np.linspace(0.0, 2.0, n)
    phase = 2 * np.pi * frequency * time
    values = (0.1 * np.cos(phase), 0.2 * np.sin(phase), -0.1 * np.sin(phase), 0.2 * np.cos(phase))
    factors = (1.0, 1.0, 2 * np.pi * frequency, 2 * np.pi * frequency)
    states = {name: ("time", f * v) for name, f, v in zip(STATES, factors, values, strict=True)}
    return xr.Dataset(states, coords={"time": time}, attrs={"frequency_hz": frequency})


def lines(fig):
    return {line.get_gid(): line.get_xydata() for ax in fig.axes for line in ax.get_lines()}


@pytest.mark.slow
def test_plot_trajectory__series_portraits_sections_and_torque():
    ds = make_trajectory()
    found = lines(plot_trajectory(ds))
    for state in STATES:
        np.testing.assert_array_equal(found[f"series:{state}"], np.column_stack([ds["time"], ds[state]]))
    np.testing.assert_array_equal(found["orbit:psi2"], np.column_stack([ds["psi2"], ds["psi2_dot"]]))
    np.testing.assert_allclose(found["section:psi1"], [[0.1, 0.0]] * 5, atol=1e-12)
    assert "series:torque" not in found
    fig = plot_trajectory(ds.assign(torque=("time", np.sign(ds["psi1"].values), {"units": "N m"})))
    np.testing.assert_array_equal(lines(fig)["series:torque"][:, 1], np.sign(ds["psi1"]))
    assert "torque [N m]" in [ax.get_ylabel() for ax in fig.axes]


@pytest.mark.slow
def test_plot_trajectory__panel_per_unit_and_no_path_without_a_drawing():
    ds = make_trajectory()[["psi1", "psi2"]].rename(psi1="x", psi2="v").assign_attrs(DUFFING)
    ds["energy"] = ("time", np.ones(401), {"units": "J/kg"})
    figure = plot_trajectory(ds)
    assert [ax.get_ylabel() for ax in figure.axes] == ["$x$ [m]", r"$\dot{x}$ [m/s]", "$E$ [J/kg]", r"$\dot{x}$ [m/s]"]
    assert "path" not in figure.data


@pytest.mark.slow
@pytest.mark.parametrize("width", [85.0, 178.0])
def test_plot_trajectory__path_of_the_magnet(width):
    ds = make_trajectory().assign_attrs(PENDULUM)
    figure = plot_trajectory(ds, frame=Frame(width))
    want = load_model("pendulum").drawing.points(np.stack([ds[name].values for name in STATES], axis=-1), VALUES)
    np.testing.assert_allclose(lines(figure)["path"], want["magnet"])
    np.testing.assert_allclose(figure.data["path"], want["magnet"])
    assert "path of the magnet" in legend_texts(figure)
    (ax,) = (ax for ax in figure.axes if "path" in [line.get_gid() for line in ax.get_lines()])
    (left, right), (bottom, top), box = ax.get_xlim(), ax.get_ylim(), ax.get_window_extent()
    assert (right - left) / box.width == pytest.approx((top - bottom) / box.height)


@pytest.mark.slow
@pytest.mark.parametrize("wrapped", [False, True])
def test_plot_trajectory__rotation_is_drawn_on_the_circle(wrapped):
    ds = make_trajectory()
    turning = 7.0 * ds["time"].values
    shown = (turning + np.pi) % (2 * np.pi) - np.pi if wrapped else turning
    found = lines(plot_trajectory(ds.assign(psi2=("time", shown))))
    np.testing.assert_allclose(found["series:psi2"][:, 1], turning, atol=1e-12)
    angle = found["orbit:psi2"][:, 0]
    assert np.nanmax(np.abs(angle)) <= np.pi
    assert np.isnan(angle).sum() == 2
    assert np.nanmax(np.abs(np.diff(angle))) < 0.1
    assert np.abs(found["section:psi2"][:, 0]).max() <= np.pi


def test_plot_trajectory__missing_variables():
    with pytest.raises(ValueError, match="missing: psi2, psi1_dot"):
        plot_trajectory(make_trajectory().drop_vars(["psi2", "psi1_dot"]))
    with pytest.raises(ValueError, match="at least two points of time, and this one has 1"):
        plot_trajectory(make_trajectory().isel(time=[0]))


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_save_figure__same_bytes_each_time(tmp_path, suffix, start, monkeypatch):
    salt = matplotlib.rcParams["svg.hashsalt"]
    ds = make_trajectory()
    first = save_figure(plot_trajectory(ds), tmp_path / f"a{suffix}").read_bytes()
    monkeypatch.setattr("time.time", lambda: 2e9)
    second = save_figure(plot_trajectory(ds), str(tmp_path / f"b{suffix.upper()}")).read_bytes()
    assert first == second
    assert first.startswith(start)
    assert matplotlib.rcParams["svg.hashsalt"] == salt
    assert not [stamp for stamp in (b"CreationDate", b"dc:date") if stamp in first]
    assert suffix != ".png" or int.from_bytes(first[16:20], "big") == 1401  # the width


def test_pi_fraction():
    given = {"0": 0.0, "π": 1.0, "\N{MINUS SIGN}π/2": -0.5, "3π/4": 0.75, "π/8": 0.125, "4π": 4.0}
    assert [labels.pi_fraction(value * np.pi) for value in given.values()] == list(given)
