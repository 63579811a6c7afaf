"""Figures of any model: portraits and paths as it says, no angle where there is none, crowded maps."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import pipeline.plots
from pipeline.layout.vocabulary import letter
from pipeline.plots import Frame, plot_basins, plot_coexisting, plot_fractions, plot_gallery
from pipeline.plots.labels import with_unit
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import DUFFING, legend_texts, make_attractors, make_portraits, plot_regimes

CELLS = ("frequency", "initial_condition")


@pytest.mark.slow
def test_attractor_figures__without_angles_and_classifier():
    sweep = make_attractors([[0, 0, 1], [0, 1, 1]], CELLS, {"frequency": [0.1, 0.2]}, attrs=DUFFING)
    for figure in (plot_fractions(sweep), plot_coexisting(sweep)):
        assert {"A: period 1", "B: period 1"} <= set(legend_texts(figure))
    assert plot_coexisting(sweep).axes[0].get_ylabel() == "$x$ [m]"
    with pytest.raises(ValueError, match=r"x \[m\] is no angle; draw it without degrees"):
        plot_coexisting(sweep, degrees=True)
    grid = {"x_0": ("x_0", [-1.0, 1.0], {"units": "m"}), "v_0": ("v_0", [-1.0, 0.0, 1.0], {"units": "m/s"})}
    basins = plot_basins(make_attractors([[0, 0, 1], [0, 1, 1]], ("x_0", "v_0"), grid, attrs=DUFFING))
    assert (basins.axes[0].get_xlabel(), basins.axes[0].get_ylabel()) == ("$x(0)$ [m]", r"$\dot{x}(0)$ [m/s]")


@pytest.mark.parametrize("n", [1, 2])
def test_plot_gallery__portraits_that_the_model_names_and_no_path(n):
    found = make_attractors([list(range(n))], CELLS, {"frequency": [2.2]}, attrs=DUFFING)
    portraits = make_portraits(n, ("x", "v"))
    figure = plot_gallery(rows_of(found), portraits, frame=Frame(178.0))
    assert [ax.get_xlabel() for ax in figure.axes] == ["$x$ [m]"] * n
    assert [ax.get_ylabel() for ax in figure.axes] == [r"$\dot{x}$ [m/s]"] * n
    assert legend_texts(figure) == ["once per drive period"]
    # half of a figure of full width was empty if there was one panel
    assert figure.axes[0].get_position().width > 0.8 / n - 0.05
    with pytest.raises(ValueError, match="portraits of duffing have no angle"):
        plot_gallery(rows_of(found), portraits, degrees=True)


@pytest.mark.slow
def test_plot_regimes__more_regimes_than_colours_are_a_map_each():
    """Every subset of five attractors: 31 regimes."""
    masks = np.arange(1, 32)
    own = [[i for i in range(5) if mask >> i & 1] for mask in masks]
    ids = np.array([[np.resize(members, 10) for members in own]])
    coords = {"frequency": [0.2], "q": np.arange(31.0)}
    found = make_attractors(ids, ("frequency", "q", "initial_condition"), coords, attrs=DUFFING)
    found = found.isel(frequency=[0, 0]).assign_coords(frequency=[0.2, 0.3])
    figure = plot_regimes(found, show="attractors")
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_visible()]
    assert titles == [f"{letter(i)}: period 1" for i in range(5)]
    (mesh,) = [c for c in figure.axes[2].collections if c.get_gid() == "member:C"]
    shown = ~np.ma.getmaskarray(mesh.get_array()).reshape(31, 2)
    assert shown[:, 0].tolist() == [bool(m & 4) for m in masks]
    assert sorted(figure.data["member"].values) == list("ABCDE")


def test_with_unit__powers_are_raised():
    given = {"m/s2": "F [m/s²]", "1/(m2 s2)": "F [1/(m² s²)]", "1": "F", "N m": "F [N m]"}
    assert {unit: with_unit("F", unit) for unit in given} == given


def test_plots__know_no_model_by_name():
    """See also test_rooms, which looks for parts of a model in all rooms."""
    for path in Path(pipeline.plots.__file__).parent.glob("*.py"):
        assert not re.search(r"[\"'](pendulum|duffing)\b|\b(pendulum|duffing)\.", path.read_text("utf-8")), path.name
