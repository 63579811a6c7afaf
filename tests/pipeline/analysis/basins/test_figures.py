"""Figures of attractors: the data beside them, their legends, colours and captions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb

from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.status import Status
from pipeline.analysis.attractors.figure import plot_gallery
from pipeline.analysis.attractors.hysteresis import find_hysteresis
from pipeline.analysis.basins.figure import plot_basins
from pipeline.analysis.basins.fractions_figure import plot_coexisting, plot_fractions
from pipeline.analysis.basins.regimes_figure import plot_curves
from pipeline.analysis.branches.analysis import curves_table
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.codimension_two import SpecialPoint
from pipeline.analysis.branches.curves import Curve, curves_dataset
from pipeline.analysis.branches.problems import Family, Value
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, CHAOTIC_SET, PERIODIC_ORBIT, TORUS, letter
from pipeline.plots import palette
from pipeline.results.ragged import dense
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import (
    VALUES,
    by_gid,
    caption_of,
    legend_texts,
    make_attractors,
    make_portraits,
    plot_regimes,
)

PENDING, PERIODIC, BOUNDED, DIVERGED = Status.PENDING, Status.PERIODIC, Status.BOUNDED, Status.DIVERGED
STEP_LIMIT, INFERRED = Status.STEP_LIMIT, Status.INFERRED


GRID = ("psi1_0", "psi2_0")


def grid_coords(n):
    """Cell centres between -1 and 1."""
    return {name: (name, -1.0 + (np.arange(n) + 0.5) * 2.0 / n, {"units": "rad"}) for name in GRID}


@pytest.fixture
def grid():
    """4 x 4 cells, all different along both axes: 0 left, 1 right above, the rest on no attractor."""
    ids = np.zeros((4, 4), np.int32)
    ids[2:, 2:] = 1
    ids[3, 0], ids[3, 1], ids[2, 0], ids[2, 1] = -1, -1, -1, -1
    status = np.where(ids >= 0, PERIODIC, BOUNDED).astype(np.int8)
    status[3, 0], status[3, 1], status[2, 0] = DIVERGED, PENDING, STEP_LIMIT
    return make_attractors(ids, GRID, grid_coords(4), status=status)


@pytest.mark.slow
def test_plot_basins__cells_outcomes_and_shares(grid):
    """The legend counts as the table does: all cells."""
    fig = plot_basins(grid, n_periods=xr.full_like(grid["attractor_id"], 100))
    assert legend_texts(fig) == [
        "A: period 1, left, 50.0 %",
        "B: period 1, left, 25.0 %",
        "not settled, 6.2 %",
        "diverged, 6.2 %",
        "failed, 6.2 %",
        "pending, 6.2 %",
    ]
    np.testing.assert_array_equal(fig.data["attractor_id"].transpose(*GRID), grid["attractor_id"])
    np.testing.assert_array_equal(fig.data["status"].transpose(*GRID), grid["status"])
    assert (fig.data["n_periods"] == 100).all()
    assert fig.data["share"].values.tolist() == [0.5, 0.25]
    # the image has the cells where its axes say: equal colours for equal outcomes, along both axes
    fig = plot_basins(grid, degrees=True)
    (image,) = [im for ax in fig.axes for im in ax.get_images() if im.get_gid() == "basins"]
    colours = np.swapaxes(np.asarray(image.get_array()), 0, 1).reshape(16, -1).tolist()
    became = [fig.data[name].transpose(*GRID).values.ravel().tolist() for name in ("outcome", "status")]
    for (one, first), (other, second) in itertools.combinations(
        zip(zip(*became, strict=True), colours, strict=True), 2
    ):
        assert (one == other) == (first == second)
    assert image.get_extent() == pytest.approx(np.rad2deg([-1.0, 1.0, -1.0, 1.0]))
    assert image.origin == "lower"


def test_plot_basins__selection_and_refusals(grid):
    more = xr.concat([grid, grid.assign(attractor_id=1 - grid["attractor_id"].clip(0))], "frequency")
    more = more.assign_coords(frequency=("frequency", [2.2, 2.4], {"units": "Hz"}))
    with pytest.raises(ValueError, match=r"frequency_hz \(2 values\).*such as frequency_hz=2\.4"):
        plot_basins(more)
    fig = plot_basins(more, at={"frequency": 2.4})
    np.testing.assert_array_equal(fig.data["attractor_id"].transpose(*GRID), more["attractor_id"].isel(frequency=1))
    assert caption_of(fig) == "$f$ = 2.4 Hz"
    sample = grid.stack(initial_condition=GRID).drop_vars([*GRID, "initial_condition"])
    with pytest.raises(ValueError, match=r'lie along: initial_condition; .* kind = "grid"'):
        plot_basins(sample)


def test_cast_of__most_cells_have_own_colours_and_selection_changes_none():
    ids = np.repeat(np.arange(30), np.r_[np.full(10, 5), np.full(10, 30), np.full(10, 2)])
    ds = make_attractors(ids, ("initial_condition",))
    cast = palette.cast_of(ds)
    assert set(cast.main) == {*range(10, 20), 0, 1}
    own = [cast.colours[i] for i in cast.main]
    assert len(set(own)) == 12
    assert {cast.colours[i] for i in range(30) if i not in cast.main} == {palette.OTHERS}
    # colours go to attractors, greys to what attracts nowhere
    other = ds.copy(deep=True)
    other["stability"][10] = vocabulary.NEUTRAL
    greyed = palette.cast_of(other)
    assert greyed.colours[10] == palette.GREYS["on a neutral set"]
    assert set(greyed.main) == {*range(11, 20), 0, 1, 2}
    part = ds.copy(deep=True)
    part["kind"][5:] = part["stability"][5:] = 0
    assert palette.cast_of(ds, part).colours == cast.colours
    assert palette.cast_of(ds, part).names[20] == "U: absent"
    assert [letter(i) for i in (-1, 0, 25, 26, 51, 52, 701, 702)] == ["-", "A", "Z", "AA", "AZ", "BA", "ZZ", "AAA"]


def test_describe__periods_sides_turns():
    ds = make_attractors([[0, 0], [0, 0], [0, 0]], ("frequency", "initial_condition"), {}).isel(attractor=0)
    ds["orbit_period"][:] = [1, 2, 0]
    ds["kind"][:] = [PERIODIC_ORBIT, PERIODIC_ORBIT, vocabulary.BOUNDED_SET]
    ds["side"][:] = [Side.LEFT, Side.STRADDLING, Side.STRADDLING]
    assert palette.describe(ds) == "period 1, 2 or not periodic, left or straddling"
    for kind, word in ((vocabulary.TORUS, "quasi-periodic"), (vocabulary.CHAOTIC_SET, "chaotic")):
        ds["kind"][2] = kind
        assert palette.describe(ds) == f"period 1, 2 or {word}, left or straddling"
    # of a set that does not attract it is said
    ds["stability"][2] = vocabulary.NOT_SETTLED
    assert palette.describe(ds).endswith(", left or straddling, not settled in parts")
    ds["stability"][:] = vocabulary.TRANSIENT
    assert palette.describe(ds).endswith(", left or straddling, transient")
    ds["stability"][:] = ATTRACTS
    ds["side"][:] = Side.ROTATING
    ds["rotation"][:] = [0.0, -0.5]
    assert palette.describe(ds).endswith("rotating, 0 and \N{MINUS SIGN}0.5 turns per drive period")
    ds["rotation"][0] = [0.0, 1.0]
    assert palette.describe(ds).endswith("rotating")


# Machado, Oliveira & Fernandes, IEEE TVCG 15 (2009) 1291, severity 1; rows act on linear RGB
VISION = {
    "normal": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(colour, vision):
    """CIELAB of a colour as seen, white point D65."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.asarray(VISION[vision]) @ linear, 0.0, 1.0)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = np.array(to_xyz) @ seen / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", VISION)
def test_palette__colours_can_be_told_apart(vision):
    colours = [*palette.COLOURS, palette.OTHERS, *palette.GREYS.values()]
    assert len(set(colours)) == 12 + 1 + len(palette.GREYS) == len(colours)
    for a, b in itertools.combinations(colours, 2):
        assert np.linalg.norm(lab(a, vision) - lab(b, vision)) > 11.0, (a, b)


@pytest.fixture
def sweep():
    """3 frequencies x 10 starts: A 5, 4, 0; B 5, 4, 8; at the second one diverged and one pending, ..."""
    ids = np.array([[0] * 5 + [1] * 5, [0] * 4 + [1] * 4 + [-1] * 2, [1] * 8 + [-1] * 2], np.int32)
    status = np.where(ids >= 0, PERIODIC, BOUNDED).astype(np.int8)
    status[1, 8:] = [DIVERGED, PENDING]
    coords = {"frequency": ("frequency", [2.0, 2.1, 2.2], {"units": "Hz"})}
    return make_attractors(ids, ("frequency", "initial_condition"), coords, status=status)


@pytest.mark.slow
def test_plot_fractions__shares_with_wilsons_intervals(sweep):
    fig = plot_fractions(sweep)
    names = ["A: period 1, left", "B: period 1, left", "not settled", "diverged", "pending", "95 % interval of an edge"]
    assert legend_texts(fig) == names
    counts = {"A": [5, 4, 0], "B": [5, 4, 8], "not settled": [0, 0, 2], "diverged": [0, 1, 0], "pending": [0, 1, 0]}
    for outcome, k in counts.items():
        one, share = fig.data.sel(outcome=outcome), np.array(k) / 10
        assert one["fraction"].values.tolist() == share.tolist()
        for end in ("low", "high"):
            # Wilson's score interval, by its own equation: |p - k/n| = z sqrt(p (1 - p) / n) at both ends
            p = one[end].values
            inner = (p > 0) & (p < 1)
            assert np.abs(p - share)[inner] == pytest.approx(1.959964 * np.sqrt(p * (1 - p) / 10)[inner])
        assert ((one["low"] <= one["fraction"]) & (one["fraction"] <= one["high"])).all()
    # five of ten cells have the widest interval
    assert caption_of(fig).endswith(f"±{float(0.5 - fig.data['low'].sel(outcome='B')[0]):.2g}")
    # more attractors than colours
    fig = plot_fractions(make_attractors([range(15)] * 2, ("q", "initial_condition"), {"q": [1.0, 1.1]}))
    assert legend_texts(fig)[-2:] == ["3 others", "95 % interval of an edge"]


@pytest.mark.slow
def test_plot_coexisting__values_in_degrees_and_on_the_circle(sweep):
    sweep["attractor_points"][:] = sweep["attractor_points"] + 2 * np.pi
    found = plot_coexisting(sweep, degrees=True).data["value"].isel(point=0)
    np.testing.assert_allclose(found.sel(attractor=1), np.rad2deg([0.2, 0.2, 0.2]))
    np.testing.assert_allclose(found.sel(attractor=0), np.rad2deg([0.1, 0.1, np.nan]))
    rates = plot_coexisting(sweep, state="psi1_dot").data["value"].isel(point=0, attractor=1)
    np.testing.assert_allclose(rates, 0.2 + 2 * np.pi)
    with pytest.raises(ValueError, match="unknown state 'psi3'"):
        plot_coexisting(sweep, state="psi3")


@pytest.fixture
def walk():
    """Up and down over 5 frequencies: up leaves A after the third, down comes back to it at the second."""
    ids = np.array([[0, 0], [0, 0], [0, 1], [1, 1], [1, 1]], np.int32)
    coords = {
        "frequency": ("frequency", [2.0, 2.1, 2.2, 2.3, 2.4], {"units": "Hz"}),
        "direction": ("branch", ["up", "down"]),
    }
    return make_attractors(ids, ("frequency", "branch"), coords)


@pytest.mark.slow
def test_figures_of_walks__directions_loops_and_no_sample(walk):
    fig = plot_coexisting(walk, hysteresis=find_hysteresis(walk, walk))
    assert legend_texts(fig)[-3:] == ["up", "down", "up and down differ"]
    present = fig.data["present"].sel(attractor=0)
    assert present.sel(direction="up").values.tolist() == [1, 1, 1, 0, 0]
    assert present.sel(direction="down").values.tolist() == [1, 1, 0, 0, 0]
    (span,) = [patch for patch in fig.axes[0].patches if patch.get_gid() == "loop"]
    box = span.get_extents().transformed(fig.axes[0].transData.inverted())
    assert (box.x0, box.x1) == pytest.approx((2.15, 2.25))
    fractions = plot_fractions(walk)
    assert fractions.axes[0].get_ylabel() == "share of the branches"
    assert "low" not in fractions.data


@pytest.fixture
def map_of_two():
    """2 frequencies x 3 amplitudes, 4 cells: A alone, A + B, B with a cell not settled, ..."""
    ids = np.array([[[0] * 4, [0, 0, 1, 1], [1, 1, 1, -1]], [[0] * 4, [0] * 4, [-1] * 4]], np.int32)
    coords = {
        "frequency": ("frequency", [2.0, 2.2], {"units": "Hz"}),
        "q": ("q", [1.0, 1.5, 2.0], {"units": "N m", "long_name": "amplitude"}),
    }
    ds = make_attractors(ids, ("frequency", "q", "initial_condition"), coords)
    ds["orbit_period"][..., 1] = 2 * (ds["kind"][..., 1] > 0)
    return ds


@pytest.mark.slow
@pytest.mark.parametrize("plot", [plot_fractions, plot_coexisting])
def test_legends__list_rising_periods_then_tori_chaos_and_others(plot):
    kinds, periods = [BOUNDED_SET, CHAOTIC_SET, TORUS, *[PERIODIC_ORBIT] * 3], [0, 0, 0, 12, 2, 1]
    ds = make_attractors(np.repeat(range(6), [6, 1, 5, 2, 4, 3])[None], ("q", "initial_condition"), {"q": [1.0]})
    ds["kind"][:], ds["orbit_period"][:] = kinds, periods
    words = [text.partition(": ")[2].partition(",")[0] for text in legend_texts(plot(ds))[:6]]
    assert words == ["period 1", "period 2", "period 12", "quasi-periodic", "chaotic", "not periodic"]


def regime_names(fig):
    """Name of each point of the map, (frequency, second parameter)."""
    return fig.data["label"].values[fig.data["regime"].transpose("frequency", "q").values].tolist()


@pytest.mark.slow
def test_plot_regimes__each_point_has_its_regime(map_of_two):
    fig = plot_regimes(map_of_two)
    assert regime_names(fig) == [["1", "1 + 2", "2"], ["1", "1", "none"]]
    # by rising periods; what has no attractor last
    assert legend_texts(fig)[:4] == ["1", "1 + 2", "2", "none"]
    assert (fig.axes[0].get_xlabel(), fig.axes[0].get_ylabel()) == ("drive frequency [Hz]", "amplitude [N m]")
    assert regime_names(plot_regimes(map_of_two, show="attractors"))[0] == ["A", "A + B", "B"]
    assert regime_names(plot_regimes(map_of_two, show="number")) == [["1", "2", "1"], ["1", "1", "0"]]
    assert fig.data["n_attractors"].transpose("frequency", "q").values.tolist() == [[1, 2, 1], [1, 1, 0]]
    here = dense(fig.data).sel(frequency=2.0, q=1.5)
    assert here["share"].values.tolist() == [0.5, 0.5]
    within = (fig.data["low"] <= fig.data["share"]) & (fig.data["share"] <= fig.data["high"])
    assert (within == (fig.data["share"] > 0)).all()
    unseen = fig.data["unseen_high"].transpose("frequency", "q").values
    # (1 - p)^n = 0.05 with n decided cells; nothing is known where none is
    assert unseen[:, :2] == pytest.approx(1 - 0.05 ** (1 / 4))
    assert unseen[:, 2].tolist() == pytest.approx([1 - 0.05 ** (1 / 3), 1.0])
    assert "basins below 52.7" in caption_of(fig)
    with pytest.raises(ValueError, match="Did you mean 'periods'"):
        plot_regimes(map_of_two, show="period")


@pytest.mark.slow
def test_plot_regimes__what_attracts_is_counted_and_chaos_is_named(map_of_two):
    map_of_two["orbit_period"][0, 1, 1], map_of_two["kind"][0, 1, 1] = 0, CHAOTIC_SET
    assert regime_names(plot_regimes(map_of_two))[0][1] == "1 + not periodic"
    map_of_two["stability"][0, 1, 1] = vocabulary.NOT_SETTLED
    fig = plot_regimes(map_of_two)
    assert regime_names(fig) == [["1", "1", "2"], ["1", "1", "none"]]
    assert fig.data["n_attractors"].sel(frequency=2.0, q=1.5) == 1
    assert fig.data["share_without"].sel(frequency=2.0, q=1.5) == 0.5


@pytest.mark.slow
def test_plot_regimes__more_regimes_than_colours_are_a_map_each():
    """Every subset of five attractors: 31 regimes."""
    masks = np.arange(1, 32)
    ids = np.array([[np.resize([i for i in range(5) if mask >> i & 1], 10) for mask in masks]])
    found = make_attractors(ids, ("frequency", "q", "initial_condition"), {"frequency": [0.2], "q": np.arange(31.0)})
    figure = plot_regimes(found.isel(frequency=[0, 0]).assign_coords(frequency=[0.2, 0.3]), show="attractors")
    titles = [ax.get_title(loc="left").partition(":")[0] for ax in figure.axes if ax.get_visible()]
    assert titles == sorted(figure.data["member"].values) == list("ABCDE")
    there = figure.data["share_of"].isel(frequency=0).sel(member="C").values > 0
    assert there.tolist() == [bool(mask & 4) for mask in masks]


@pytest.mark.slow
def test_attractor_figures__say_how_many_cells_are_left_out_and_why(map_of_two, sweep):
    """Which cells a map of regimes does not count, and a diagram or a gallery does not show, stood nowhere."""
    map_of_two["status"][0, 2, 0] = Status.DIVERGED
    map_of_two["attractor_id"][0, 2, 0] = -1
    n = 24 - sum(int(which.sum()) for which in palette.other_cells(map_of_two).values())
    assert f"{n} of 24 cells end on attractors; 1 diverged" in caption_of(plot_regimes(map_of_two))
    told = caption_of(plot_coexisting(sweep))
    assert "26 of 30 cells end on attractors; 1 diverged, 2 not settled, 1 pending" in told
    assert "cells end on attractors" not in caption_of(plot_coexisting(sweep.isel(frequency=[0])))
    attractors = make_attractors([0, 1, -1, -1, -1, -1], ("initial_condition",))
    attractors["status"][2:] = [vocabulary.DIVERGED] * 3 + [vocabulary.UNREACHED]
    head = " ".join(plot_gallery(rows_of(attractors), make_portraits(2)).texts[0].get_text().split())
    assert head.endswith("2 of 6 cells end on attractors; 3 diverged, 1 unreached")


@pytest.fixture
def curves_of_two():
    """A fold along q, and a cusp on it."""
    family = Family(PENDULUM_FITTED, 1, 2.0, np.zeros(1), ("q", "frequency"), (1.0, 1.0))
    value = Value(np.zeros(5), np.zeros((5, 6)), np.zeros((1, 4)), np.eye(4))
    points = [Point(np.array([0.0, 0.0, 0.0, 0.0, q, 2.0 + 0.1 * q]), np.zeros(6), value, 0) for q in (1.0, 1.5, 2.0)]
    cusp = SpecialPoint("cusp", family, points[1], np.array([1e-9, 1e-9]))
    return curves_dataset([Curve(family, "fold", points, ("bound", "stuck"), 0, [cusp])], "q", "frequency")


def test_curves__alone_in_a_table_and_over_the_map(map_of_two, curves_of_two):
    """Lines have the map's axes, whichever parameter was followed first; another plane is refused."""
    fig = plot_regimes(map_of_two, curves=curves_of_two)
    (line,) = [one for one in fig.axes[0].lines if one.get_gid() == "curve:0"]
    np.testing.assert_allclose(line.get_xydata(), [[2.1, 1.0], [2.15, 1.5], [2.2, 2.0]])
    assert [text.get_text() for text in fig.axes[0].texts] == ["CP"]
    assert "solid: LP fold" in caption_of(fig)
    np.testing.assert_allclose(fig.data["special_first_curves"], [1.5])
    with pytest.raises(ValueError, match="plane of q and damping"):
        plot_regimes(map_of_two, curves=curves_of_two.assign_attrs(second_parameter="damping"))
    ax = plot_curves(curves_of_two).axes[0]
    assert [text.get_text() for text in ax.texts if text.get_text()] == ["CP"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q", "drive frequency [Hz]")
    table = curves_table(curves_of_two)
    row = {"q": 1.5, "frequency_hz": 2.15, "period": 1, "error": pytest.approx(1e-8), "curve": 0}
    assert table.rows[0] == {"label": "CP", "type": "cusp", **row}
    assert table.lines[1].startswith("  0: LP fold, period 1")
    assert table.lines[1].endswith("; ends: Newton's method finds no next point")


@pytest.mark.slow
def test_plot_gallery__orbits_and_paths_of_the_largest_shares():
    attractors, portraits = make_attractors(range(11), ("initial_condition",)), make_portraits(11, turning=(2,))
    portraits["share"][0] = 0.0
    fig = plot_gallery(rows_of(attractors), portraits)
    assert fig.data["attractor"].values.tolist() == list(range(1, 9))
    assert any("3 more sets" in t.get_text() for t in fig.texts)
    lines, orbit = by_gid(fig), portraits["orbit"].values[1]
    np.testing.assert_allclose(lines["orbit:B:psi2"].get_xydata(), orbit[:, [1, 3]])
    np.testing.assert_allclose(lines["section:B:psi2"].get_xydata(), orbit[:1, [1, 3]])
    path = load_model("pendulum").drawing.points(orbit, VALUES)["magnet"]
    np.testing.assert_allclose(lines["path:B"].get_xydata(), path)
    # on the circle, broken where it passes pi
    angle = lines["orbit:C:psi2"].get_xdata()
    assert np.nanmax(np.abs(angle)) <= np.pi
    assert np.isnan(angle).sum() == 1
    with pytest.raises(ValueError, match="no attractor at this parameter point"):
        plot_gallery(rows_of(attractors), portraits.isel(attractor=[]))


def test_greys__every_cell_without_an_attractor_has_one():
    """Whatever became of a cell, and on whatever set that does not attract it is."""
    assert all(getattr(vocabulary, status.name) == status for status in Status)
    status = np.array([*Status, PERIODIC, PERIODIC, BOUNDED, BOUNDED, BOUNDED], np.int8)
    ids = np.array([*np.full(len(Status), -1), 0, 1, 2, 3, -1], np.int32)
    ds = make_attractors(ids, ("initial_condition",), status=status)
    ds["stability"][:] = [vocabulary.NOT_SETTLED, vocabulary.TRANSIENT, vocabulary.UNSTABLE, vocabulary.NEUTRAL]
    ds["decision"][-1] = vocabulary.GROWS
    found = palette.other_cells(ds)
    assert found.keys() == palette.GREYS.keys()
    assert found["growing"].tolist() == [False] * (len(ids) - 1) + [True]
    assert np.sum(list(found.values()), axis=0).tolist() == [1] * len(ids)
    for code, name in {
        Status.DIVERGED: "diverged",
        Status.PENDING: "pending",
        Status.NO_RETURN: "no return",
        Status.STEP_UNDERFLOW: "failed",
        Status.UNREACHED: "failed",
        Status.BOUNDED: "not settled",
    }.items():
        assert found[name][list(Status).index(code)], name
    on_sets = ["not settled", "on a transient set", "on an unstable orbit or equilibrium", "on a neutral set"]
    assert [bool(found[name][len(Status) + k]) for k, name in enumerate(on_sets)] == [True] * 4
