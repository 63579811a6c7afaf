"""Stroboscopic sections and their zooms; diagrams of extremes; both on a model without angles."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb

from pipeline.layout.vocabulary import BOUNDED, CHAOTIC_SET, TRANSIENT
from pipeline.plots import Frame, palette, pixels, plot_bifurcation, plot_section
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import DUFFING, make_attractors


def make_sections(n_cells=4, n_keep=50, seed=3):
    """Points of a Henon map in the states of the Duffing oscillator, the starts of one basin."""
    x = np.random.default_rng(seed).uniform(-0.1, 0.1, n_cells)
    y = np.zeros(n_cells)
    kept = np.empty((n_cells, n_keep, 2))
    for i in range(-100, n_keep):
        x, y = 1.0 - 1.4 * x * x + y, 0.3 * x
        if i >= 0:
            kept[:, i] = np.stack([x, y], axis=-1)
    return xr.Dataset(
        {
            "section": (("initial_condition", "period_index", "state"), kept),
            "status": (("initial_condition",), np.full(n_cells, 2, np.int8)),
        },
        coords={"state": ["x", "v"], "frequency": ((), 0.2, {"units": "Hz"})},
        attrs=DUFFING,
    )


def points_of(figure):
    return figure.data["x"].values, figure.data["y"].values


def test_plot_section__all_points_with_labels_and_fixed_values():
    ds = make_sections()
    figure = plot_section(ds)
    ax = figure.axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x$ [m]", r"$\dot{x}$ [m/s]")
    assert ax.get_title(loc="left") == "$f$ = 0.2\N{NO-BREAK SPACE}Hz"
    np.testing.assert_array_equal(np.sort(points_of(figure)[0]), np.sort(ds["section"][..., 0].values.ravel()))
    (line,) = ax.get_lines()
    np.testing.assert_array_equal(np.sort(line.get_ydata()), np.sort(figure.data["y"]))


@pytest.mark.slow
def test_plot_section__zoom_of_many_points_counts_them_anew():
    ds = make_sections(300, 1000)
    assert ds["section"].sizes["period_index"] * 300 > pixels.MARKER_LIMIT
    whole = plot_section(ds)
    zoom = plot_section(ds, frame=Frame(xlim=(0.5, 0.7), ylim=(0.15, 0.2)))
    assert int(whole.data["count"].sum()) == 300_000
    x, y = ds["section"].values.reshape(-1, 2).T
    inside = (x >= 0.5) & (x <= 0.7) & (y >= 0.15) & (y <= 0.2)
    assert int(zoom.data["count"].sum()) == inside.sum() > 0
    assert zoom.axes[0].get_xlim() == (0.5, 0.7)
    # the layers of the attractor lie apart in the zoom: its pixels are finer than those of the whole
    assert np.diff(np.unique(zoom.data["x"])).min() < 0.2 * np.diff(np.unique(whole.data["x"])).min()


@pytest.mark.slow
def test_plot_section__one_parameter_point():
    ds = xr.concat([make_sections(), make_sections(seed=4)], "frequency").assign_coords(frequency=[0.1, 0.2])
    with pytest.raises(ValueError, match=r"one parameter point, .*frequency \(2 values\).*--at frequency=0\.2"):
        plot_section(ds)
    np.testing.assert_array_equal(
        np.sort(points_of(plot_section(ds, at={"frequency": 0.1}))[0]),
        np.sort(points_of(plot_section(make_sections()))[0]),
    )


def test_plot_section__states_and_degrees():
    ds = make_sections()
    figure = plot_section(ds, states=("v", "x"))
    np.testing.assert_array_equal(np.sort(points_of(figure)[1]), np.sort(ds["section"][..., 0].values.ravel()))
    with pytest.raises(ValueError, match="neither x nor v is an angle"):
        plot_section(ds, degrees=True)
    with pytest.raises(ValueError, match=r"unknown state 'w'\. Allowed: x, v"):
        plot_section(ds, states=("x", "w"))


@pytest.mark.slow
def test_plot_section__colours_of_attractors():
    ds = make_sections()
    ids = make_attractors([0, 1, 1, -1], ("initial_condition",), attrs=DUFFING, status=np.full(4, BOUNDED, np.int8))
    ids["kind"][:], ids["orbit_period"][:] = CHAOTIC_SET, 0
    figure = plot_section(ds, rows_of(ids))
    lines = {line.get_gid(): line for line in figure.axes[0].get_lines()}
    assert set(lines) == {"points:A: chaotic", "points:B: chaotic", "points:not settled"}
    np.testing.assert_array_equal(np.sort(lines["points:A: chaotic"].get_xdata()), np.sort(ds["section"][0, :, 0]))
    colours = [to_rgb(line.get_color()) for line in lines.values()]
    assert len(set(colours)) == 3
    # what does not attract has no colour of its own
    ids["stability"][0] = TRANSIENT
    lines = {line.get_gid(): line for line in plot_section(ds, rows_of(ids)).axes[0].get_lines()}
    assert set(lines) == {"points:on a transient set", "points:B: chaotic", "points:not settled"}
    assert lines["points:on a transient set"].get_color() == to_rgb(palette.GREYS["on a transient set"])


def make_extremes():
    frequency = np.linspace(0.1, 0.3, 5)
    values = np.arange(5 * 2 * 3 * 2 * 3, dtype=float).reshape(5, 2, 3, 2, 3)
    dims = ("frequency", "initial_condition", "period_index", "quantity", "extreme")
    section = np.zeros((5, 2, 3, 2))
    return xr.Dataset(
        {
            "section": ((*dims[:3], "state"), section),
            "status": (dims[:2], np.full((5, 2), 1, np.int8)),
            "extremes": (dims, values),
        },
        coords={
            "frequency": ("frequency", frequency, {"units": "Hz"}),
            "state": ["x", "v"],
            "quantity": ["energy", "v"],
            "extreme": ["min", "max", "mean"],
        },
        attrs=DUFFING,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "word", "column"), [("min", "least", 0), ("mean", "mean", 2)])
def test_plot_bifurcation__extremes_of_a_quantity(kind, word, column):
    ds = make_extremes()
    figure = plot_bifurcation(ds, quantity=f"energy.{kind}")
    assert figure.axes[0].get_ylabel() == f"{word} $E$ [J/kg]"
    np.testing.assert_array_equal(
        np.sort(figure.data["y"].values), np.sort(ds["extremes"].values[..., 0, column].ravel())
    )
    assert figure.data["y"].attrs == {"units": "J/kg", "long_name": f"energy.{kind}"}
    rate = plot_bifurcation(ds, quantity=f"v.{kind}")
    assert rate.axes[0].get_ylabel() == rf"{word} $\dot{{x}}$ [m/s]"


def test_plot_bifurcation__extremes_refused():
    ds = make_extremes()
    with pytest.raises(ValueError, match=r"must be NAME\.min, NAME\.max or NAME\.mean"):
        plot_bifurcation(ds, quantity="energy")
    with pytest.raises(ValueError, match=r"unknown quantity 'enrgy'\. Did you mean 'energy'"):
        plot_bifurcation(ds, quantity="enrgy.max")
    with pytest.raises(ValueError, match=r'run it with \[products\] extremes = \{ quantities = \["energy"\] \}'):
        plot_bifurcation(ds.drop_vars("extremes"), quantity="energy.max")
