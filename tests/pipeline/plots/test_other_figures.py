"""Sections, extremes, branches, trajectories: their data, and figures of models without angles."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import xarray as xr

import pipeline.plots
from magpend_core.models import load_model
from pipeline.analysis.attractors.figure import plot_gallery
from pipeline.analysis.basins.figure import plot_basins
from pipeline.analysis.basins.fractions_figure import plot_coexisting, plot_fractions
from pipeline.analysis.branches.figure import plot_branches, plot_multipliers
from pipeline.layout.vocabulary import BOUNDED, CHAOTIC_SET, TRANSIENT
from pipeline.plots import Frame, labels, pixels, plot_bifurcation, plot_section, plot_trajectory, save_figure, style
from pipeline.plots.style import hold
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import (
    DUFFING,
    PENDULUM,
    STATES,
    VALUES,
    legend_texts,
    make_attractors,
    make_portraits,
    make_trajectory,
)

# ---- sections -----------------------------------------------------------------------------------


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


def same_numbers(found, wanted):
    np.testing.assert_array_equal(np.sort(np.ravel(found)), np.sort(np.ravel(wanted)))


def test_plot_section__all_points_of_one_parameter_point():
    ds = make_sections()
    figure = plot_section(ds)
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("$x$ [m]", r"$\dot{x}$ [m/s]")
    same_numbers(figure.data["x"], ds["section"][..., 0])
    same_numbers(plot_section(ds, states=("v", "x")).data["y"], ds["section"][..., 0])
    two = xr.concat([ds, make_sections(seed=4)], "frequency").assign_coords(frequency=[0.1, 0.2])
    same_numbers(plot_section(two, at={"frequency": 0.1}).data["x"], ds["section"][..., 0])
    with pytest.raises(ValueError, match=r"one parameter point, .*frequency_hz \(2 values\).*--at frequency_hz=0\.2"):
        plot_section(two)
    with pytest.raises(ValueError, match="neither x nor v is an angle"):
        plot_section(ds, degrees=True)
    with pytest.raises(ValueError, match="unknown state 'w'"):
        plot_section(ds, states=("x", "w"))


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
    # the layers of the attractor lie apart in the zoom: its pixels are finer than those of the whole
    assert np.diff(np.unique(zoom.data["x"])).min() < 0.2 * np.diff(np.unique(whole.data["x"])).min()


@pytest.mark.slow
def test_plot_section__points_by_attractor():
    ds = make_sections()
    ids = make_attractors([0, 1, 1, -1], ("initial_condition",), attrs=DUFFING, status=np.full(4, BOUNDED, np.int8))
    ids["kind"][:], ids["orbit_period"][:] = CHAOTIC_SET, 0
    ids["stability"][0] = TRANSIENT
    lines = {line.get_gid(): line for line in plot_section(ds, rows_of(ids)).axes[0].get_lines()}
    # what does not attract has no letter and no colour of its own
    assert set(lines) == {"points:on a transient set", "points:B: chaotic", "points:not settled"}
    same_numbers(lines["points:B: chaotic"].get_xdata(), ds["section"][1:3, :, 0])
    assert len({line.get_color() for line in lines.values()}) == 3


# ---- extremes -----------------------------------------------------------------------------------


def make_extremes():
    dims = ("frequency", "initial_condition", "period_index", "quantity", "extreme")
    return xr.Dataset(
        {
            "section": ((*dims[:3], "state"), np.zeros((5, 2, 3, 2))),
            "status": (dims[:2], np.full((5, 2), 1, np.int8)),
            "extremes": (dims, np.arange(5 * 2 * 3 * 2 * 3, dtype=float).reshape(5, 2, 3, 2, 3)),
        },
        coords={
            "frequency": ("frequency", np.linspace(0.1, 0.3, 5), {"units": "Hz"}),
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
    same_numbers(figure.data["y"], ds["extremes"].values[..., 0, column])
    assert figure.data["y"].attrs == {"units": "J/kg", "long_name": f"energy.{kind}"}


def test_plot_bifurcation__extremes_refused():
    ds = make_extremes()
    with pytest.raises(ValueError, match=r"must be NAME\.min, NAME\.max or NAME\.mean"):
        plot_bifurcation(ds, quantity="energy")
    with pytest.raises(ValueError, match="unknown quantity 'enrgy'"):
        plot_bifurcation(ds, quantity="enrgy.max")
    with pytest.raises(ValueError, match=r'run it with \[products\] extremes = \{ quantities = \["energy"\] \}'):
        plot_bifurcation(ds.drop_vars("extremes"), quantity="energy.max")


# ---- branches -----------------------------------------------------------------------------------


@pytest.fixture
def folded():
    """A branch that folds at 3 Hz: stable going there, unstable coming back; psi1 = +-sqrt(3 - f)."""
    psi = np.linspace(1.0, -1.0, 21) + 0.02
    section = np.zeros((1, len(psi), 1, 4))
    section[0, :, 0, 0] = psi
    multipliers = np.stack([1.0 - psi, 0.5 + 0 * psi, 0.2 + 0.1j + 0 * psi, 0.2 - 0.1j + 0 * psi], axis=1)[None]
    event = {"kind": 0, "value": 3.0, "of_branch": 0, "to_branch": -1, "after": int(np.flatnonzero(psi > 0)[-1])}
    event |= {"n_unstable_before": 0, "n_unstable_after": 1, "bifurcation_side": 2}
    return xr.Dataset(
        {
            "parameter": (("branch", "point"), (3.0 - psi**2)[None]),
            "section": (("branch", "point", "phase", "state"), section),
            "multiplier_real": (("branch", "point", "multiplier"), multipliers.real),
            "multiplier_imag": (("branch", "point", "multiplier"), multipliers.imag),
            "n_unstable": (("branch", "point"), (psi < 0)[None].astype(np.int8)),
            "n_points": ("branch", [len(psi)]),
            "orbit_period": ("branch", [1]),
            "origin": ("branch", [-1]),
            **{f"{end}_end": ("branch", [0], {"flag_meanings": "bound"}) for end in ("first", "last")},
            "bifurcation_section": (("bifurcation", "phase", "state"), np.zeros((1, 1, 4))),
            **{name: ("bifurcation", [value]) for name, value in event.items()},
            "critical_real": ("bifurcation", [1.0]),
            "critical_imag": ("bifurcation", [0.0]),
        },
        coords={"state": STATES},
        attrs={"parameter": "frequency_hz", "parameter_units": "Hz"},
    )


def branch_lines(figure):
    """Lines of branches by their style: not single markers."""
    return {line.get_linestyle(): line for line in figure.axes[0].lines if len(line.get_xdata()) > 1}


def test_plot_branches__solid_where_stable_and_dashed_where_not(folded):
    figure = plot_branches(folded)
    lines = branch_lines(figure)
    assert (np.asarray(lines["-"].get_ydata()) >= 0.0).all()
    assert (np.asarray(lines["--"].get_ydata()) <= 0.0).all()
    # both go up to the fold itself
    assert np.max(lines["-"].get_xdata()) == np.max(lines["--"].get_xdata()) == 3.0
    assert [text.get_text() for text in figure.axes[0].texts] == ["LP1"]
    assert "LP fold" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert not branch_lines(plot_branches(folded, max_period=0))
    with pytest.raises(ValueError, match="unknown state"):
        plot_branches(folded, state="psi3")
    (multipliers,) = plot_multipliers(folded).axes[0].collections
    assert len(multipliers.get_offsets()) == 84
    with pytest.raises(ValueError, match="branches 0 to 0"):
        plot_multipliers(folded, 1)
    # lines are cut where an angle wraps
    folded["section"][0, 10:, 0, 0] -= 2.0 * np.pi
    for line in branch_lines(plot_branches(folded)).values():
        assert np.nanmax(np.abs(np.diff(np.asarray(line.get_ydata(), float)))) < np.pi


# ---- trajectories -------------------------------------------------------------------------------


def lines(fig):
    return {line.get_gid(): line.get_xydata() for ax in fig.axes for line in ax.get_lines()}


@pytest.mark.slow
def test_plot_trajectory__series_sections_torque_and_path():
    ds = make_trajectory().assign_attrs(PENDULUM)
    torque = np.sign(ds["psi1"].values)
    fig = plot_trajectory(ds.assign(torque=("time", torque, {"units": "N m"})))
    found = lines(fig)
    for state in STATES:
        np.testing.assert_array_equal(found[f"series:{state}"], np.column_stack([ds["time"], ds[state]]))
    np.testing.assert_allclose(found["section:psi1"], [[0.1, 0.0]] * 5, atol=1e-12)
    np.testing.assert_array_equal(found["series:torque"][:, 1], torque)
    want = load_model("pendulum").drawing.points(np.stack([ds[name].values for name in STATES], axis=-1), VALUES)
    np.testing.assert_allclose(fig.data["path"], want["magnet"])
    for wrong, message in (
        (ds.drop_vars(["psi2", "psi1_dot"]), "missing: psi2, psi1_dot"),
        (ds.isel(time=[0]), "at least two points of time, and this one has 1"),
    ):
        with pytest.raises(ValueError, match=message):
            plot_trajectory(wrong)


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


# ---- any model, labels --------------------------------------------------------------------------


@pytest.mark.slow
def test_figures__of_a_model_without_angles_and_classifier():
    cells, coords = ("frequency", "initial_condition"), {"frequency": [0.1, 0.2]}
    sweep = make_attractors([[0, 0, 1], [0, 1, 1]], cells, coords, attrs=DUFFING)
    for figure in (plot_fractions(sweep), plot_coexisting(sweep)):
        assert {"A: period 1", "B: period 1"} <= set(legend_texts(figure))
    assert plot_coexisting(sweep).axes[0].get_ylabel() == "$x$ [m]"
    grid = {"x_0": ("x_0", [-1.0, 1.0], {"units": "m"}), "v_0": ("v_0", [-1.0, 0.0, 1.0], {"units": "m/s"})}
    basins = plot_basins(make_attractors([[0, 0, 1], [0, 1, 1]], ("x_0", "v_0"), grid, attrs=DUFFING))
    assert (basins.axes[0].get_xlabel(), basins.axes[0].get_ylabel()) == ("$x(0)$ [m]", r"$\dot{x}(0)$ [m/s]")
    one = rows_of(make_attractors([[0]], cells, {"frequency": [2.2]}, attrs=DUFFING))
    portraits = make_portraits(1, ("x", "v"))
    assert plot_gallery(one, portraits).axes[0].get_ylabel() == r"$\dot{x}$ [m/s]"
    series = make_trajectory()[["psi1", "psi2"]].rename(psi1="x", psi2="v").assign_attrs(DUFFING)
    series["energy"] = ("time", np.ones(series.sizes["time"]), {"units": "J/kg"})
    trajectory = plot_trajectory(series)
    assert [ax.get_ylabel() for ax in trajectory.axes][:3] == ["$x$ [m]", r"$\dot{x}$ [m/s]", "$E$ [J/kg]"]
    assert "path" not in trajectory.data
    with pytest.raises(ValueError, match=r"x \[m\] is no angle; draw it without degrees"):
        plot_coexisting(sweep, degrees=True)
    with pytest.raises(ValueError, match="portraits of duffing have no angle"):
        plot_gallery(one, portraits, degrees=True)


def test_plots__know_no_model_by_name():
    """See also test_rooms, which looks for parts of a model in all rooms."""
    for path in Path(pipeline.plots.__file__).parent.glob("*.py"):
        assert not re.search(r"[\"'](pendulum|duffing)\b|\b(pendulum|duffing)\.", path.read_text("utf-8")), path.name


def test_labels__units_and_fractions_of_pi():
    given = {"m/s2": "F [m/s²]", "1/(m2 s2)": "F [1/(m² s²)]", "1": "F", "N m": "F [N m]"}
    assert {unit: labels.with_unit("F", unit) for unit in given} == given
    given = {"0": 0.0, "π": 1.0, "\N{MINUS SIGN}π/2": -0.5, "3π/4": 0.75, "π/8": 0.125, "4π": 4.0}
    assert [labels.pi_fraction(value * math.pi) for value in given.values()] == list(given)


def test_hold__axes_hold_what_is_drawn_unless_the_user_gave_a_range():
    for frame, lows in ((style.WIDE, (-1.0, -3.0)), (replace(style.WIDE, ylim=(0.0, 1.0)), (-1.0, 0.0))):
        ax = style.new_figure(3.0, xr.Dataset(), frame).add_subplot()
        ax.set_xlim(0.0, 1.0)
        ax.set_ylim(0.0, 1.0)
        hold(ax, [np.array([-1.0, 0.5])], [np.array([np.nan, -3.0])])
        found = ax.get_xlim()[0], ax.get_ylim()[0]
        assert [a <= b for a, b in zip(found, lows, strict=True)] == [True, True]
        assert (found[1] == 0.0) == (frame.ylim is not None)
        assert ax.get_xlim()[1] == ax.get_ylim()[1] == 1.0
