"""Figures of trajectories, and how any figure becomes a file."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from magpend_core.models import load_model
from pipeline.plots import labels, plot_trajectory, save_figure

STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]
PARAMETERS = "\n".join(f"{k} = {v!r}" for k, v in load_model("pendulum").load().as_dict().items())


def make_trajectory(n=401, frequency=2.0):
    time = np.linspace(0.0, 2.0, n)
    phase = 2 * np.pi * frequency * time
    return xr.Dataset(
        {
            "psi1": ("time", 0.1 * np.cos(phase)),
            "psi2": ("time", 0.2 * np.sin(phase)),
            "psi1_dot": ("time", -0.1 * 2 * np.pi * frequency * np.sin(phase)),
            "psi2_dot": ("time", 0.2 * 2 * np.pi * frequency * np.cos(phase)),
        },
        coords={"time": time},
        attrs={"frequency_hz": frequency},
    )


def lines(fig):
    return {line.get_gid(): line.get_xydata() for ax in fig.axes for line in ax.get_lines()}


def test_plot_trajectory__series_portraits_and_sections():
    ds = make_trajectory()
    found = lines(plot_trajectory(ds))
    for state in STATES:
        np.testing.assert_array_equal(found[f"series:{state}"], np.column_stack([ds["time"], ds[state]]))
    np.testing.assert_array_equal(found["orbit:psi2"], np.column_stack([ds["psi2"], ds["psi2_dot"]]))
    np.testing.assert_allclose(found["section:psi1"], [[0.1, 0.0]] * 5, atol=1e-12)
    assert "series:torque" not in found


def test_plot_trajectory__torque_panel():
    ds = make_trajectory()
    fig = plot_trajectory(ds.assign(torque=("time", np.sign(ds["psi1"].values), {"units": "N m"})))
    np.testing.assert_array_equal(lines(fig)["series:torque"][:, 1], np.sign(ds["psi1"]))
    assert "torque [N m]" in [ax.get_ylabel() for ax in fig.axes]


def test_plot_trajectory__labels_stay_off_the_series():
    """The path of a small motion has ticks of many digits, known only once its scale is."""
    ds = make_trajectory()
    for state in STATES:
        ds[state] = 0.02 * ds[state] + (0.1 if state in ("psi1", "psi2") else 0.0)
    fig = plot_trajectory(ds.assign_attrs(parameters=PARAMETERS))
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    path = fig.axes[-1]
    label = path.yaxis.label.get_window_extent(canvas.get_renderer())
    (last,) = (ax for ax in fig.axes if ax.get_xlabel() == "time [s]")
    assert label.x0 > last.get_window_extent().x1


def test_plot_trajectory__given_section_times():
    ds = make_trajectory().assign_coords(section_times=("section", [0.125, 0.625, 9.0]))
    found = lines(plot_trajectory(ds))
    np.testing.assert_allclose(found["section:psi2"], [[0.2, 0.0]] * 2, atol=1e-12)
    bare = lines(plot_trajectory(make_trajectory().drop_attrs()))
    assert "section:psi1" not in bare


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


# ---------------------------------------------------------------- files


@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_save_figure__same_bytes_each_time(tmp_path, suffix, start, monkeypatch):
    salt = matplotlib.rcParams["svg.hashsalt"]
    ds = make_trajectory()
    first = save_figure(plot_trajectory(ds), tmp_path / f"a{suffix}")
    monkeypatch.setattr("time.time", lambda: 2e9)
    second = save_figure(plot_trajectory(ds), str(tmp_path / f"b{suffix.upper()}"))
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes().startswith(start)
    assert matplotlib.rcParams["svg.hashsalt"] == salt
    for stamp in (b"CreationDate", b"dc:date"):
        assert stamp not in first.read_bytes()


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.png.txt"])
def test_save_figure__unknown_suffix(tmp_path, name):
    with pytest.raises(ValueError, match=r"is not one of \.png, \.pdf, \.svg"):
        save_figure(Figure(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_save_figure__width(tmp_path):
    data = save_figure(plot_trajectory(make_trajectory()), tmp_path / "a.png").read_bytes()
    assert int.from_bytes(data[16:20], "big") == 1401


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (np.pi, "π"),
        (-np.pi / 2, "\N{MINUS SIGN}π/2"),
        (0.75 * np.pi, "3π/4"),
        (np.pi / 8, "π/8"),
        (4 * np.pi, "4π"),
    ],
)
def test_pi_fraction(value, text):
    assert labels.pi_fraction(value) == text
