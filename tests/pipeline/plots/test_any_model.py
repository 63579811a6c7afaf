"""Figures of any model: portraits and paths as it says, no angle where there is none, crowded maps."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.text import Text

import pipeline.plots
from magpend_core.models import load_model
from pipeline.layout.attractor_letters import letter
from pipeline.layout.vocabulary import ATTRACTS, PERIODIC_ORBIT
from pipeline.plots import (
    Frame,
    pixels,
    plot_basins,
    plot_bifurcation,
    plot_branches,
    plot_coexisting,
    plot_fractions,
    plot_gallery,
    plot_regimes,
    plot_trajectory,
)
from pipeline.plots.labels import with_unit

DUFFING = "\n".join(f"{k} = {v!r}" for k, v in load_model("duffing").load().as_dict().items())
PENDULUM = "\n".join(f"{k} = {v!r}" for k, v in load_model("pendulum").load().as_dict().items())
ATTRS = {"model": "duffing", "parameters": DUFFING}


def make_attractors(ids, dims, coords):
    """Dataset of the form of `match` for a model of two states without angles and without a classifier."""
    ids = np.asarray(ids, np.int32)
    n = int(ids.max()) + 1
    outer = [d for d in dims if d != "initial_condition" and not d.endswith("_0")]
    flat = ids.reshape(*(ids.shape[dims.index(d)] for d in outer), -1)
    counts = np.stack([(flat == i).sum(axis=-1) for i in range(n)], axis=-1)
    per = (*outer, "attractor")
    points = np.where((counts > 0)[..., None, None], 0.1 * np.arange(1, n + 1)[:, None, None], np.nan)
    return xr.Dataset(
        {
            "attractor_id": (dims, ids),
            "status": (dims, np.ones(ids.shape, np.int8)),
            "decision": (dims, np.ones(ids.shape, np.int8)),
            "kind": (per, np.where(counts > 0, PERIODIC_ORBIT, 0).astype(np.int8)),
            "stability": (per, np.where(counts > 0, ATTRACTS, 0).astype(np.int8)),
            "orbit_period": (per, (counts > 0) * np.arange(1, n + 1, dtype=np.int32)),
            "n_cells": (per, counts),
            "share": (per, counts / flat.shape[-1]),
            "attractor_points": ((*per, "point", "state"), np.broadcast_to(points, (*counts.shape, 2, 2)).copy()),
        },
        coords={"state": ["x", "v"], "attractor": np.arange(n, dtype=np.int32), **coords},
        attrs=ATTRS,
    )


def test_attractor_figures__without_angles_and_classifier():
    sweep = make_attractors([[0, 0, 1], [0, 1, 1]], ("frequency", "initial_condition"), {"frequency": [0.1, 0.2]})
    for figure in (plot_fractions(sweep), plot_coexisting(sweep)):
        texts = [t.get_text() for t in figure.legends[0].get_texts()]
        assert {"A: period 1", "B: period 2"} <= set(texts)
    assert plot_coexisting(sweep).axes[0].get_ylabel() == "$x$ [m]"
    with pytest.raises(ValueError, match=r"x \[m\] is no angle; draw it without degrees"):
        plot_coexisting(sweep, degrees=True)
    grid = {"x_0": ("x_0", [-1.0, 1.0], {"units": "m"}), "v_0": ("v_0", [-1.0, 0.0, 1.0], {"units": "m/s"})}
    basins = plot_basins(make_attractors([[0, 0, 1], [0, 1, 1]], ("x_0", "v_0"), grid))
    assert (basins.axes[0].get_xlabel(), basins.axes[0].get_ylabel()) == ("$x(0)$ [m]", r"$\dot{x}(0)$ [m/s]")


def make_portraits(n):
    phase = np.linspace(0.0, 2.0 * np.pi, 60)
    orbit = np.stack([np.stack([np.cos(phase), np.sin(phase)], -1) * (i + 1) for i in range(n)])
    return xr.Dataset(
        {
            "orbit": (("attractor", "sample", "state"), orbit),
            "attractor_points": (("attractor", "point", "state"), orbit[:, :1]),
            "share": ("attractor", np.full(n, 1.0 / n)),
            "stability": ("attractor", np.full(n, ATTRACTS, np.int8)),
        },
        coords={"attractor": np.arange(n), "state": ["x", "v"], "frequency": 0.2},
    )


@pytest.mark.parametrize("width", [85.0, 178.0])
def test_plot_gallery__portraits_that_the_model_names_and_no_path(width):
    found = make_attractors([[0, 1]], ("frequency", "initial_condition"), {"frequency": [0.2]})
    figure = plot_gallery(found, make_portraits(2), frame=Frame(width))
    assert [ax.get_xlabel() for ax in figure.axes] == ["$x$ [m]"] * 2
    assert [ax.get_ylabel() for ax in figure.axes] == [r"$\dot{x}$ [m/s]"] * 2
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["once per drive period"]
    with pytest.raises(ValueError, match="portraits of duffing have no angle"):
        plot_gallery(found, make_portraits(2), degrees=True)


def test_plot_gallery__a_lone_panel_fills_its_figure():
    """Half of a figure of full width was empty."""
    found = make_attractors([[0]], ("frequency", "initial_condition"), {"frequency": [0.2]})
    (ax,) = plot_gallery(found, make_portraits(1)).axes
    box = ax.get_position()
    assert box.width > 0.8
    assert box.height > 0.6


def make_series(model, names, **attrs):
    time = np.linspace(0.0, 3.0, 301)
    values = {name: ("time", 0.1 * np.cos(2 * np.pi * time + i)) for i, name in enumerate(names)}
    return xr.Dataset(values, coords={"time": time}, attrs={"model": model, "frequency_hz": 1.0, **attrs})


def test_plot_trajectory__panel_per_unit_and_no_path_without_a_drawing():
    ds = make_series("duffing", ["x", "v"], parameters=DUFFING)
    ds["energy"] = ("time", np.ones(301), {"units": "J/kg"})
    figure = plot_trajectory(ds)
    assert [ax.get_ylabel() for ax in figure.axes] == ["$x$ [m]", r"$\dot{x}$ [m/s]", "$E$ [J/kg]", r"$\dot{x}$ [m/s]"]
    assert "path" not in figure.data


@pytest.mark.parametrize("width", [85.0, 178.0])
def test_plot_trajectory__path_of_the_magnet(width):
    ds = make_series("pendulum", load_model("pendulum").state_names, parameters=PENDULUM)
    figure = plot_trajectory(ds, frame=Frame(width))
    lines = {line.get_gid(): line for ax in figure.axes for line in ax.get_lines()}
    states = np.stack([ds[name].values for name in load_model("pendulum").state_names], axis=-1)
    values = load_model("pendulum").load().as_dict()
    want = load_model("pendulum").drawing.points(states, values)["magnet"]
    np.testing.assert_allclose(lines["path"].get_xydata(), want)
    np.testing.assert_allclose(figure.data["path"], want)
    assert "path of the magnet" in [t.get_text() for t in figure.legends[0].get_texts()]
    ax = lines["path"].axes
    (left, right), (bottom, top), box = ax.get_xlim(), ax.get_ylim(), ax.get_window_extent()
    assert (right - left) / box.width == pytest.approx((top - bottom) / box.height)


def test_plot_regimes__more_regimes_than_colours_are_a_map_each():
    """Every subset of five attractors: 31 regimes."""
    masks = np.arange(1, 32).reshape(1, 31)
    ids = np.zeros((1, 31, 10), int)
    for j, mask in enumerate(masks[0]):
        own = [i for i in range(5) if mask >> i & 1]
        ids[0, j] = np.resize(own, 10)
    coords = {"frequency": [0.2], "q": np.arange(31.0)}
    found = make_attractors(ids, ("frequency", "q", "initial_condition"), coords).isel(frequency=[0, 0])
    found = found.assign_coords(frequency=[0.2, 0.3])
    figure = plot_regimes(found, show="attractors")
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_visible()]
    assert titles == [f"{letter(i)}: period {i + 1}" for i in range(5)]
    assert "others" not in " ".join(titles)
    (mesh,) = [c for c in figure.axes[2].collections if c.get_gid() == "member:C"]
    shown = ~np.ma.getmaskarray(mesh.get_array()).reshape(31, 2)
    assert shown[:, 0].tolist() == [bool(m & 4) for m in masks[0]]
    assert sorted(figure.data["member"].values) == list("ABCDE")


def make_diagram(levels):
    """Forty points of two directions, on so many levels of equal numbers in each."""
    section = np.zeros((2, 20, 40, 2))
    for direction, n in enumerate(levels):
        section[direction, ..., 0] = np.resize(np.linspace(0.0, 0.5, n), 40)
    return xr.Dataset(
        {
            "section": (("branch", "frequency", "period_index", "state"), section),
            "status": (("branch", "frequency"), np.full((2, 20), 2, np.int8)),
        },
        coords={"frequency": np.linspace(0.1, 0.3, 20), "state": ["x", "v"], "direction": ("branch", ["up", "down"])},
        attrs=ATTRS,
    )


def test_plot_bifurcation__panels_share_one_scale_of_darkness(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    figure = plot_bifurcation(make_diagram((4, 20)), layout="side")
    darkest = [255 - int(np.asarray(ax.get_images()[0].get_array()).min()) for ax in figure.axes]
    # ten points on a spot are darker than two, also in another panel
    assert darkest[1] < darkest[0] - 10


def test_plot_branches__names_cover_no_line():
    """Two branches cross the parameter closely; the names of their folds stand where no line is."""
    n = 41
    psi = np.linspace(1.0, -1.0, n)
    parameter = np.stack([0.3 - 0.05 * psi**2, 0.3 - 0.05 * psi**2])
    section = np.zeros((2, n, 1, 2))
    section[:, :, 0, 0] = psi, psi + 0.1
    events = {
        "kind": [0, 0],
        "value": [0.3, 0.3],
        "of_branch": [0, 1],
        "after": [20, 20],
        "n_unstable_before": [0, 0],
        "n_unstable_after": [1, 1],
    }
    at = np.zeros((2, 1, 2))
    at[1, 0, 0] = 0.1
    ds = xr.Dataset(
        {
            "parameter": (("branch", "point"), parameter),
            "section": (("branch", "point", "phase", "state"), section),
            "n_unstable": (("branch", "point"), np.stack([(psi < 0)] * 2).astype(np.int8)),
            "n_points": ("branch", [n, n]),
            "orbit_period": ("branch", [1, 1]),
            "bifurcation_section": (("bifurcation", "phase", "state"), at),
            **{name: ("bifurcation", values) for name, values in events.items()},
        },
        coords={"state": ["x", "v"]},
        attrs={**ATTRS, "parameter": "frequency_hz", "parameter_units": "Hz"},
    )
    figure = plot_branches(ds)
    ax = figure.axes[0]
    names = [t for t in ax.texts if t.get_text() == "F1"]
    assert names
    for text in names:
        text.get_window_extent()  # finds its place; what it returns also holds the line that leads to it
        box = Text.get_window_extent(text)
        for line in ax.get_lines():
            x, y = ax.transData.transform(np.asarray(line.get_xydata())).T
            assert not ((x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)).any()


@pytest.mark.parametrize(
    ("unit", "label"), [("m/s2", "F [m/s²]"), ("1/(m2 s2)", "F [1/(m² s²)]"), ("1", "F"), ("N m", "F [N m]")]
)
def test_with_unit__powers_are_raised(unit, label):
    assert with_unit("F", unit) == label


def test_letter__same_as_in_tables():
    assert [letter(i) for i in (-1, 0, 25, 26)] == ["-", "A", "Z", "AA"]


def test_plots__know_no_model_by_name():
    """No state, link, arm length or preset of a model stands in the figures' code."""
    words = ("psi", "link", "l1", "l2", "magnet", "wojna", "pendulum", "duffing")
    for path in Path(pipeline.plots.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        found = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
        found |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
        found |= {
            n.value
            for n in ast.walk(tree)
            if isinstance(n, ast.Constant) and isinstance(n.value, str) and " " not in n.value
        }
        assert not [f for f in found if any(f == w or f.startswith(f"{w}1") for w in words)], path.name
