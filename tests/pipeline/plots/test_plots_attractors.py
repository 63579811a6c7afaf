"""Figures of attractors: what is drawn, read back from pixels, artists and the data beside them."""

from __future__ import annotations

import itertools
import time
import tracemalloc

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.status import Status
from pipeline.analysis.attractors.matching.hysteresis import hysteresis
from pipeline.analysis.basins.numbers import basin_fractions
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.codimension_two import SpecialPoint
from pipeline.analysis.branches.curves import Curve
from pipeline.analysis.branches.curves_dataset import curves_dataset
from pipeline.analysis.branches.problems import Family, Value
from pipeline.analysis.branches.table import curves_table
from pipeline.analysis.outcomes import outcomes
from pipeline.layout import vocabulary
from pipeline.layout.attractor_letters import letter
from pipeline.layout.vocabulary import ATTRACTS, PERIODIC_ORBIT
from pipeline.plots import (
    palette,
    plot_basins,
    plot_coexisting,
    plot_curves,
    plot_fractions,
    plot_gallery,
    plot_regimes,
    save_data,
    save_figure,
    style,
)

VALUES = load_model("pendulum").load().as_dict()
PARAMETERS = "\n".join(f"{k} = {v!r}" for k, v in VALUES.items())
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]
PENDING, PERIODIC, BOUNDED, DIVERGED = Status.PENDING, Status.PERIODIC, Status.BOUNDED, Status.DIVERGED
STEP_LIMIT, INFERRED = Status.STEP_LIMIT, Status.INFERRED


def make_attractors(ids, dims, coords, n=None, status=None):
    """Dataset of the form of `match`, from the ids of the cells."""
    ids = np.asarray(ids, np.int32)
    n = int(ids.max()) + 1 if n is None else n
    outer = [d for d in dims if not (d == "initial_condition" or d == "branch" or d.endswith("_0"))]
    shape = tuple(ids.shape[dims.index(d)] for d in outer)
    flat = np.moveaxis(ids, [dims.index(d) for d in outer], range(len(outer))).reshape(*shape, -1)
    counts = np.stack([(flat == i).sum(axis=-1) for i in range(n)], axis=-1)
    here = counts > 0
    per = (*outer, "attractor")
    points = np.full((*shape, n, 3, 4), np.nan)
    points[here, 0] = 0.1 * (1.0 + np.nonzero(here)[-1])[:, None]
    ds = xr.Dataset(
        {
            "attractor_id": (dims, ids),
            "status": (dims, np.where(ids >= 0, PERIODIC, BOUNDED).astype(np.int8)),
            "decision": (dims, (ids >= 0).astype(np.int8)),
            "kind": (per, np.where(here, PERIODIC_ORBIT, 0).astype(np.int8)),
            "stability": (per, np.where(here, ATTRACTS, 0).astype(np.int8)),
            "orbit_period": (per, here.astype(np.int32)),
            "n_cells": (per, counts),
            "share": (per, counts / flat.shape[-1]),
            "side": (per, np.where(here, Side.LEFT, 0).astype(np.int8)),
            "rotation": ((*per, "link"), np.where(here, 0.0, np.nan)[..., None] * np.ones(2)),
            "attractor_points": ((*per, "point", "state"), points),
        },
        coords={"state": STATES, "attractor": np.arange(n, dtype=np.int32), **coords},
        attrs={"parameters": PARAMETERS},
    )
    return ds if status is None else ds.assign(status=(dims, status))


def grid_coords(n1, n2):
    """Cell centres between -1 and 1."""

    def axis(name, n):
        return (name, -1.0 + (np.arange(n) + 0.5) * 2.0 / n, {"units": "rad"})

    return {"psi1_0": axis("psi1_0", n1), "psi2_0": axis("psi2_0", n2)}


GRID = ("psi1_0", "psi2_0")


@pytest.fixture
def grid():
    """4 x 4 cells, all different along both axes: 0 left, 1 right above, the rest on no attractor."""
    ids = np.zeros((4, 4), np.int32)
    ids[2:, 2:] = 1
    ids[3, 0], ids[3, 1], ids[2, 0], ids[2, 1] = -1, -1, -1, -1
    status = np.where(ids >= 0, PERIODIC, BOUNDED).astype(np.int8)
    status[3, 0], status[3, 1], status[2, 0] = DIVERGED, PENDING, STEP_LIMIT
    return make_attractors(ids, GRID, grid_coords(4, 4), status=status)


def colours_of(fig):
    """RGB of the image's cells, shape (psi1, psi2, 3)."""
    (image,) = [im for ax in fig.axes for im in ax.get_images() if im.get_gid() == "basins"]
    return np.swapaxes(image.get_array() / 255.0, 0, 1)


def caption_of(fig):
    """The line above the axes, unfolded."""
    return " ".join(fig.axes[0].get_title(loc="left").split())


def legend_texts(fig):
    """Texts of the legend, unfolded."""
    texts = [text.get_text() for legend in fig.legends for text in legend.get_texts()]
    return [" ".join(text.split()) for text in texts]


def legend_colours(fig):
    handles = [patch for legend in fig.legends for patch in legend.get_patches()]
    return dict(zip(legend_texts(fig), [to_rgb(p.get_facecolor()) for p in handles], strict=True))


def test_plot_basins__each_cell_has_the_colour_of_its_legend(grid):
    fig = plot_basins(grid)
    picture, legend = colours_of(fig), legend_colours(fig)
    assert list(legend) == [
        "A: period 1, left, 61.5 %",
        "B: period 1, left, 30.8 %",
        "not settled, 1 cell",
        "diverged, 7.7 %",
        "failed, 1 cell",
        "pending, 1 cell",
    ]
    expected = np.empty((4, 4, 3))
    expected[:], expected[2:, 2:] = legend["A: period 1, left, 61.5 %"], legend["B: period 1, left, 30.8 %"]
    for cell, name in {(3, 0): "diverged", (3, 1): "pending", (2, 0): "failed", (2, 1): "not settled"}.items():
        expected[cell] = legend[f"{name}, {'7.7 %' if name == 'diverged' else '1 cell'}"]
    assert np.abs(picture - expected).max() < 0.003


def test_plot_basins__the_denominator_of_the_table(grid):
    """Legend and table count the cells that end on attractors or diverge, and the figure says so."""
    ids = outcomes(grid)
    table = basin_fractions(ids, dims=[d for d in ids.dims if d in GRID], unfinished=(-1,)).squeeze()
    fig = plot_basins(grid)
    for i, name in enumerate("AB"):
        share = 100 * float(table["fraction"].sel(label=i))
        assert any(text.startswith(f"{name}: ") and text.endswith(f"{share:.1f} %") for text in legend_texts(fig))
    assert "shares of the 13 of 16 cells that end on attractors or diverge" in caption_of(fig)


def test_plot_basins__pixels_of_the_file_lie_where_the_axes_say(grid, tmp_path):
    """The pixel under each cell's centre, found through the axes, has the cell's colour."""
    fig = plot_basins(grid, degrees=True)
    pixels = matplotlib.image.imread(save_figure(fig, tmp_path / "a.png"))
    picture, ax = colours_of(fig), fig.axes[0]
    for i, j in itertools.product(range(4), repeat=2):
        # a quarter of a cell off the centre, where no letter stands
        centre = np.rad2deg([grid["psi1_0"].values[i] + 0.2, grid["psi2_0"].values[j] - 0.2])
        x, y = ax.transData.transform(centre)
        assert np.abs(pixels[int(pixels.shape[0] - y), int(x), :3] - picture[i, j]).max() < 0.01, (i, j)


def test_plot_basins__extent_and_aspect(grid):
    """The image ends at the outer edges of the cells, and a degree is as long along both axes."""
    fig = plot_basins(grid, degrees=True)
    ax = fig.axes[0]
    limit = np.rad2deg(1.0)
    assert ax.get_xlim() == pytest.approx((-limit, limit))
    assert ax.get_ylim() == pytest.approx((-limit, limit))
    assert ax.get_aspect() == 1.0
    assert (ax.get_xlabel(), ax.get_ylabel()) == (r"$\psi_1(0)$ [deg]", r"$\psi_2(0)$ [deg]")
    assert plot_basins(grid).axes[0].get_xlim() == pytest.approx((-1.0, 1.0))
    wide = grid.assign_coords(psi1_0=grid["psi1_0"] * 2)
    assert plot_basins(wide).axes[0].get_aspect() == "auto"


def test_plot_basins__shading_by_time(grid):
    """Slower is darker, in the same hue; cells without a closed orbit are not shaded."""
    periods = xr.full_like(grid["attractor_id"], 100)
    periods[1, :] = 1000
    plain, shaded = colours_of(plot_basins(grid)), colours_of(plot_basins(grid, n_periods=periods))
    assert np.allclose(shaded[0], plain[0], atol=0.003)
    ratio = shaded[1] / plain[1]
    assert (ratio[plain[1] > 0.1] < 0.5).all()
    assert np.ptp(ratio[plain[1] > 0.2]) < 0.03
    assert np.allclose(shaded[2:, :2], plain[2:, :2])
    fig = plot_basins(grid, n_periods=periods)
    assert [ax.get_xlabel() for ax in fig.axes if ax.get_gid() == "time"] == ["drive periods to converge"]
    assert fig.data["n_periods"].transpose(*GRID).values.tolist() == periods.values.tolist()


def test_plot_basins__cells_on_what_does_not_attract_are_grey(grid):
    """They are no basin: B's cells have the name of what B is, and A keeps its colour."""
    plain = colours_of(plot_basins(grid))
    grid["stability"][1] = vocabulary.TRANSIENT
    fig = plot_basins(grid)
    assert legend_texts(fig)[:2] == ["A: period 1, left, 88.9 %", "not settled, 1 cell"]
    assert "on a transient set, 4 cells" in legend_texts(fig)
    picture = colours_of(fig)
    assert np.abs(picture[2:, 2:] - to_rgb(palette.GREYS["on a transient set"])).max() < 0.003
    assert np.allclose(picture[:2], plain[:2])
    assert fig.data["outcome"].transpose(*GRID).values[2:, 2:].tolist() == [[-1, -1], [-1, -1]]
    assert not [text for text in fig.axes[0].texts if text.get_text() == "B"]


def test_plot_basins__inferred_cells(grid):
    """They have their basin's colour, took no time, and are not settled if they belong to nothing."""
    inferred = grid.copy(deep=True)
    inferred["status"][1, :2] = INFERRED
    inferred["status"][2, 1] = INFERRED
    assert legend_texts(plot_basins(inferred)) == legend_texts(plot_basins(grid))
    plain = colours_of(plot_basins(inferred))
    assert (plain == colours_of(plot_basins(grid))).all()
    periods = xr.full_like(grid["attractor_id"], 100)
    periods[1, 2:] = 1000
    periods[1, :2] = 0
    shaded = colours_of(plot_basins(inferred, n_periods=periods))
    assert (shaded[1, :2] == plain[1, :2]).all()
    # not the zeros set the bright end of the scale
    assert np.allclose(shaded[0], plain[0], atol=0.003)


def test_plot_basins__selection(grid):
    more = xr.concat([grid, grid.assign(attractor_id=1 - grid["attractor_id"].clip(0))], "frequency")
    more = more.assign_coords(frequency=("frequency", [2.2, 2.4], {"units": "Hz"}))
    with pytest.raises(ValueError, match=r"frequency \(2 values\).*such as frequency=2\.4"):
        plot_basins(more)
    with pytest.raises(ValueError, match="unknown axis 'q'"):
        plot_basins(more, at={"q": 1.0})
    with pytest.raises(ValueError, match=r"frequency = 3 lies off its axis, which runs from 2\.2 to 2\.4"):
        plot_basins(more, at={"frequency": 3.0})
    fig = plot_basins(more, at={"frequency": 2.4})
    np.testing.assert_array_equal(fig.data["attractor_id"].transpose(*GRID), more["attractor_id"].isel(frequency=1))
    assert caption_of(fig) == "$f$ = 2.4 Hz"


def test_plot_basins__sample_is_no_grid(grid):
    sample = grid.stack(initial_condition=GRID).drop_vars([*GRID, "initial_condition"])
    with pytest.raises(ValueError, match=r'lie along: initial_condition; .* kind = "grid"'):
        plot_basins(sample)


def test_plot_basins__third_start_axis_must_be_chosen(grid):
    more = xr.concat([grid, grid], "psi1_dot_0").assign_coords(psi1_dot_0=[0.0, 1.0])
    more["kind"] = grid["kind"]
    for name in ("stability", "n_cells", "share", "orbit_period", "side", "rotation"):
        more[name] = grid[name]
    with pytest.raises(ValueError, match=r"3 of the initial states are left.*such as psi1_dot_0=0"):
        plot_basins(more)
    assert plot_basins(more, at={"psi1_dot_0": 1.0}).axes[0].get_xlabel().startswith(r"$\psi_1")
    assert r"\dot{\psi}_2" not in plot_basins(more, at={"psi2_0": 0.25}).axes[0].get_xlabel()
    assert plot_basins(more, at={"psi2_0": 0.25}).axes[0].get_ylabel() == r"$\dot{\psi}_1(0)$ [rad/s]"


def test_plot_basins__data_beside_the_figure(grid, tmp_path):
    path = save_data(plot_basins(grid), tmp_path / "a.png")
    assert path == tmp_path / "a.nc"
    with xr.open_dataset(path, engine="scipy") as stored:
        np.testing.assert_array_equal(stored["attractor_id"].transpose(*GRID), grid["attractor_id"])
        np.testing.assert_array_equal(stored["status"].transpose(*GRID), grid["status"])
        assert stored["share"].values.tolist() == [0.5, 0.25]
        assert stored["name"].values.astype(str).tolist() == ["A: period 1, left", "B: period 1, left"]


def test_plot_basins__four_million_cells(tmp_path):
    n = 2000
    x = np.arange(n)
    ids = (x[:, None] ** 2 // n + x[None, :] * 3) % 20
    ds = make_attractors(ids, GRID, grid_coords(n, n))
    tracemalloc.start()
    started = time.process_time()
    save_figure(plot_basins(ds), tmp_path / "a.png")
    took = time.process_time() - started
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert took < 120.0  # about 1.5 s; a loop over cells in Python takes far longer
    assert peak < 6e8


def test_cast_of__most_cells_have_own_colours_and_selection_changes_none():
    ids = np.repeat(np.arange(30), np.r_[np.full(10, 5), np.full(10, 30), np.full(10, 2)])
    ds = make_attractors(ids, ("initial_condition",), {})
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
    assert [letter(i) for i in (0, 25, 26, 51, 52, 701, 702)] == ["A", "Z", "AA", "AZ", "BA", "ZZ", "AAA"]


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


def band(fig, name):
    """Corners of a band's rectangles: (left, right, low, high) each."""
    (area,) = [a for a in fig.axes[0].collections if a.get_gid() == f"band:{name}"]
    boxes = [path.get_extents() for path in area.get_paths()]
    return [[round(float(v), 9) for v in (b.x0, b.x1, b.y0, b.y1)] for b in boxes]


def test_plot_fractions__bands_are_stacked_and_what_is_not_decided_is_on_top(sweep):
    fig = plot_fractions(sweep)
    assert band(fig, "B") == [[1.95, 2.05, 0, 0.5], [2.05, 2.15, 0, 0.4], [2.15, 2.25, 0, 0.8]]
    assert band(fig, "A") == [[1.95, 2.05, 0.5, 1.0], [2.05, 2.15, 0.4, 0.8]]
    assert band(fig, "not settled") == [[2.15, 2.25, 0.8, 1.0]]
    assert band(fig, "diverged") == [[2.05, 2.15, 0.8, 0.9]]
    assert band(fig, "pending") == [[2.05, 2.15, 0.9, 1.0]]
    assert legend_texts(fig) == [
        "pending",
        "diverged",
        "not settled",
        "A: period 1, left",
        "B: period 1, left",
        "95 % interval of an edge",
    ]
    (area,) = [a for a in fig.axes[0].collections if a.get_gid() == "band:A"]
    assert to_rgb(area.get_facecolor()[0]) == legend_patches(fig)["A: period 1, left"]
    assert fig.axes[0].get_xlabel() == "drive frequency [Hz]"
    assert fig.data["fraction"].sel(outcome="A").values.tolist() == [0.5, 0.4, 0.0]
    assert fig.data["fraction"].sum("outcome").values == pytest.approx(1.0)


def test_plot_fractions__more_attractors_than_colours():
    ids = np.tile(np.arange(15), (2, 1))
    fig = plot_fractions(make_attractors(ids, ("q", "initial_condition"), {"q": [1.0, 1.1]}))
    assert len(legend_patches(fig)) == 13
    assert legend_texts(fig)[0] == "3 others"
    assert band(fig, "3 others") == [[0.95, 1.15, 0.8, 1.0]]


def test_plot_fractions__other_parameters_must_be_chosen(sweep):
    with pytest.raises(ValueError, match="this run sweeps none"):
        plot_fractions(sweep.isel(frequency=0))
    more = xr.concat([sweep, sweep], "q").assign_coords(q=[1.4, 1.5])
    with pytest.raises(ValueError, match=r"2 are left of q, frequency; .* such as q=1\.4"):
        plot_fractions(more)
    assert "q = 1.5" in caption_of(plot_fractions(more, at={"q": 1.5}))


def offsets(fig, gid):
    """Points and diameters [pt] of a scatter, in rising order."""
    (points,) = [c for c in fig.axes[0].collections if c.get_gid() == gid]
    where, area = np.asarray(points.get_offsets()), points.get_sizes()
    order = np.lexsort(where.T[::-1])
    return where[order], np.sqrt(np.broadcast_to(area, len(where))[order])


def test_plot_coexisting__points_and_weights(sweep):
    """Points are where the attractors are; the larger the basin fraction per point, the larger."""
    fig = plot_coexisting(sweep, degrees=True)
    where, diameter = offsets(fig, "points:A")
    np.testing.assert_allclose(where, [[2.0, np.rad2deg(0.1)], [2.1, np.rad2deg(0.1)]])
    assert diameter[0] > diameter[1]
    both, of_b = offsets(fig, "points:B")
    assert both[:, 0].tolist() == [2.0, 2.1, 2.2]
    assert of_b.argsort().tolist() == [1, 0, 2]
    assert fig.axes[0].get_ylabel() == r"$\psi_1$ [deg]"
    # two points share out the fraction of one
    sweep["attractor_points"][0, 0, 1] = 0.3
    halves = offsets(plot_coexisting(sweep), "points:A")[1]
    least, growth = 1.1**2, 5.0**2
    np.testing.assert_allclose(halves**2, [least + growth * 0.25, least + growth * 0.25, least + growth * 0.4])


def test_plot_coexisting__angles_on_the_circle_and_unknown_state(sweep):
    sweep["attractor_points"][:] = sweep["attractor_points"] + 2 * np.pi
    where, _ = offsets(plot_coexisting(sweep), "points:B")
    np.testing.assert_allclose(where[:, 1], 0.2)
    where, _ = offsets(plot_coexisting(sweep, state="psi1_dot"), "points:B")
    np.testing.assert_allclose(where[:, 1], 0.2 + 2 * np.pi)
    with pytest.raises(ValueError, match="unknown state 'psi3'"):
        plot_coexisting(sweep, state="psi3")


def test_plot_coexisting__sets_that_do_not_attract_are_small_and_grey(sweep):
    """B attracts at the first frequency only; there it has its colour, elsewhere the grey of what it is."""
    sweep["stability"][1:, 1] = [vocabulary.NOT_SETTLED, vocabulary.UNSTABLE]
    sweep["share"][1:, 1] = 0.0
    fig = plot_coexisting(sweep)
    np.testing.assert_allclose(offsets(fig, "points:B")[0], [[2.0, 0.2]])
    lines = {line.get_gid(): line for line in fig.axes[0].get_lines()}
    assert {gid: line.get_xdata().tolist() for gid, line in lines.items()} == {
        "points:not settled": [2.1],
        "points:unstable": [2.2],
    }
    assert lines["points:unstable"].get_color() == palette.GREY_OF[vocabulary.UNSTABLE]
    assert legend_texts(fig)[:4] == [
        "A: period 1, left",
        "B: period 1, left, unstable or not settled in parts",
        "not settled",
        "unstable",
    ]


@pytest.fixture
def walk():
    """Up and down over 5 frequencies: up leaves A after the third, down comes back to it at the second."""
    ids = np.array([[0, 0], [0, 0], [0, 1], [1, 1], [1, 1]], np.int32)
    coords = {
        "frequency": ("frequency", [2.0, 2.1, 2.2, 2.3, 2.4], {"units": "Hz"}),
        "direction": ("branch", ["up", "down"]),
    }
    return make_attractors(ids, ("frequency", "branch"), coords)


def test_plot_coexisting__directions_and_loops(walk):
    fig = plot_coexisting(walk, hysteresis=hysteresis(walk, walk))
    lines = {line.get_gid(): line for line in fig.axes[0].get_lines()}
    assert {gid: np.round(line.get_xdata(), 9).tolist() for gid, line in lines.items()} == {
        "points:up:A": [2.0, 2.1, 2.2],
        "points:down:A": [2.0, 2.1],
        "points:up:B": [2.3, 2.4],
        "points:down:B": [2.2, 2.3, 2.4],
    }
    up, down = lines["points:up:A"], lines["points:down:A"]
    assert up.get_markersize() < down.get_markersize()
    assert up.get_zorder() > down.get_zorder()
    (span,) = [patch for patch in fig.axes[0].patches if patch.get_gid() == "loop"]
    box = span.get_extents().transformed(fig.axes[0].transData.inverted())
    assert (box.x0, box.x1) == pytest.approx((2.15, 2.25))
    assert legend_texts(fig)[-3:] == ["up", "down", "up and down differ"]
    assert fig.data["present"].sel(direction="up", attractor=0).values.tolist() == [1, 1, 1, 0, 0]
    assert legend_texts(plot_coexisting(walk))[-2:] == ["up", "down"]


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


def regime_names(fig):
    """Name of each point of the map, (frequency, second parameter), through colour and legend."""
    (mesh,) = [c for c in fig.axes[0].collections if c.get_gid() == "regimes"]
    colours = mesh.to_rgba(mesh.get_array())[..., :3]
    names = {tuple(np.round(c, 3)): name for name, c in legend_patches(fig).items()}
    return [[names[tuple(np.round(c, 3))] for c in row] for row in np.swapaxes(colours, 0, 1)]


def legend_patches(fig):
    patches = [h for legend in fig.legends for h in legend.get_patches()]
    return {" ".join(h.get_label().split()): to_rgb(h.get_facecolor()) for h in patches}


def test_plot_regimes__each_point_has_its_regime(map_of_two):
    fig = plot_regimes(map_of_two)
    assert regime_names(fig) == [["1", "1 + 2", "2"], ["1", "1", "none"]]
    # the most frequent first, then by name; what has no attractor last
    assert legend_texts(fig)[:4] == ["1", "1 + 2", "2", "none"]
    assert fig.axes[0].get_xlabel() == "drive frequency [Hz]"
    assert fig.axes[0].get_ylabel() == "amplitude [N m]"
    assert fig.axes[0].get_xlim() == pytest.approx((1.9, 2.3))
    assert fig.axes[0].get_ylim() == pytest.approx((0.75, 2.25))
    (crosses,) = [line for line in fig.axes[0].get_lines() if line.get_gid() == "without"]
    assert sorted(map(tuple, crosses.get_xydata())) == [(2.0, 2.0), (2.2, 2.0)]
    assert regime_names(plot_regimes(map_of_two, show="attractors"))[0] == ["A", "A + B", "B"]
    assert regime_names(plot_regimes(map_of_two, show="number")) == [["1", "2", "1"], ["1", "1", "0"]]
    assert fig.data["n_attractors"].transpose("frequency", "q").values.tolist() == [[1, 2, 1], [1, 1, 0]]


def test_attractor_figures__say_how_many_cells_are_left_out_and_why(map_of_two, sweep):
    """Which cells a map of regimes does not count, and a diagram does not show, stood nowhere."""
    map_of_two["status"][0, 2, 0] = Status.DIVERGED
    map_of_two["attractor_id"][0, 2, 0] = -1
    total = map_of_two["attractor_id"].size
    others = palette.other_cells(map_of_two)
    n = total - sum(int(which.sum()) for which in others.values())
    told = caption_of(plot_regimes(map_of_two))
    assert f"{n} of {total} cells end on attractors; 1 diverged" in told
    told = caption_of(plot_coexisting(sweep))
    assert "26 of 30 cells end on attractors; 1 diverged, 2 not settled, 1 pending" in told
    settled = sweep.isel(frequency=[0])
    assert "cells end on attractors" not in caption_of(plot_coexisting(settled))


@pytest.fixture
def curves_of_two():
    """A fold along q, and a cusp on it."""
    family = Family(PENDULUM_FITTED, 1, 2.0, np.zeros(1), ("q", "frequency"), (1.0, 1.0))
    value = Value(np.zeros(5), np.zeros((5, 6)), np.zeros((1, 4)), np.eye(4))
    points = [Point(np.array([0.0, 0.0, 0.0, 0.0, q, 2.0 + 0.1 * q]), np.zeros(6), value, 0) for q in (1.0, 1.5, 2.0)]
    cusp = SpecialPoint("cusp", family, points[1], np.array([1e-9, 1e-9]))
    return curves_dataset([Curve(family, "fold", points, ("bound", "stuck"), 0, [cusp])], "q", "frequency")


def test_plot_regimes__curves_over_the_map(map_of_two, curves_of_two):
    """Lines have the map's axes, whichever parameter was followed first; another plane is refused."""
    fig = plot_regimes(map_of_two, curves=curves_of_two)
    (line,) = [one for one in fig.axes[0].lines if one.get_gid() == "curve:0"]
    np.testing.assert_allclose(line.get_xdata(), [2.1, 2.15, 2.2])
    np.testing.assert_allclose(line.get_ydata(), [1.0, 1.5, 2.0])
    assert [text.get_text() for text in fig.axes[0].texts] == ["CP"]
    assert "solid: fold" in caption_of(fig)
    np.testing.assert_allclose(fig.data["special_first_curves"], [1.5])
    with pytest.raises(ValueError, match="plane of q and damping"):
        plot_regimes(map_of_two, curves=curves_of_two.assign_attrs(second_parameter="damping"))


def test_plot_curves__names_points_of_codimension_two(curves_of_two):
    fig = plot_curves(curves_of_two)
    assert [text.get_text() for text in fig.axes[0].texts if text.get_text()] == ["CP"]
    table = curves_table(curves_of_two)
    assert table.rows[0] == {
        "type": "cusp",
        "q": 1.5,
        "frequency_hz": 2.15,
        "period": 1,
        "error": pytest.approx(1e-8),
        "curve": 0,
    }
    assert table.lines[1].endswith("; ends: stuck")


def test_plot_regimes__only_what_attracts_is_counted(map_of_two):
    map_of_two["stability"][0, 1, 1] = vocabulary.NOT_SETTLED
    fig = plot_regimes(map_of_two)
    assert regime_names(fig) == [["1", "1", "2"], ["1", "1", "none"]]
    assert fig.data["n_attractors"].sel(frequency=2.0, q=1.5) == 1
    assert fig.data["share_without"].sel(frequency=2.0, q=1.5) == 0.5


def test_plot_regimes__not_periodic_and_one_parameter(map_of_two, sweep):
    map_of_two["orbit_period"][0, 1, 1] = 0
    map_of_two["kind"][0, 1, 1] = vocabulary.CHAOTIC_SET
    assert regime_names(plot_regimes(map_of_two))[0][1] == "1 + not periodic"
    with pytest.raises(ValueError, match="two swept parameters, and 1 are left of frequency"):
        plot_regimes(sweep)
    with pytest.raises(ValueError, match="Did you mean 'periods'"):
        plot_regimes(map_of_two, show="period")


def make_portraits(n, turning=()):
    """Circles of different size; those named turn over once with link 2."""
    time = np.linspace(0.0, 1.0, 50)
    phase = 2 * np.pi * time
    orbit = np.empty((n, 50, 4))
    for i in range(n):
        size = 0.1 * (i + 1)
        orbit[i] = np.column_stack([size * np.cos(phase)] * 2 + [size * np.sin(phase)] * 2)
        if i in turning:
            orbit[i, :, 1] = phase
    return xr.Dataset(
        {
            "orbit": (("attractor", "sample", "state"), orbit),
            "attractor_points": (("attractor", "point", "state"), orbit[:, :1]),
            "share": ("attractor", 1.0 / (1.0 + np.arange(n)) / 10),
            "stability": ("attractor", np.full(n, ATTRACTS, np.int8)),
        },
        coords={"attractor": np.arange(n), "state": STATES, "frequency": 2.2},
    )


def test_plot_gallery__orbits_sections_and_paths():
    attractors = make_attractors(np.arange(3), ("initial_condition",), {})
    drawn = make_portraits(3, turning=(2,))
    fig = plot_gallery(attractors, drawn)
    lines = {line.get_gid(): line for ax in fig.axes for line in ax.get_lines()}
    for i, mark in enumerate("AB"):
        orbit = drawn["orbit"].values[i]
        np.testing.assert_allclose(lines[f"orbit:{mark}:psi1"].get_xydata(), orbit[:, [0, 2]])
        np.testing.assert_allclose(lines[f"orbit:{mark}:psi2"].get_xydata(), orbit[:, [1, 3]])
        np.testing.assert_allclose(lines[f"section:{mark}:psi2"].get_xydata(), orbit[:1, [1, 3]])
        path = load_model("pendulum").drawing.points(orbit, VALUES)["magnet"]
        np.testing.assert_allclose(lines[f"path:{mark}"].get_xydata(), path)
        assert to_rgb(lines[f"path:{mark}"].get_color()) == to_rgb(palette.cast_of(attractors).colours[i])
    # on the circle, broken where it passes pi
    angle = lines["orbit:C:psi2"].get_xdata()
    assert np.nanmin(angle) >= -np.pi
    assert np.nanmax(angle) <= np.pi
    assert np.isnan(angle).sum() == 1
    magnets = [line for ax in fig.axes for line in ax.get_lines() if line.get_gid() == "fixed:fixed magnet"]
    assert [m.get_xydata().tolist() for m in magnets] == [[[0.0, -VALUES["h"]]]] * 3
    titles = [t.get_text().replace("\N{NO-BREAK SPACE}", " ") for ax in fig.axes for t in ax.texts]
    assert titles[0] == "A: period 1, left, share 10.0 %"


def test_plot_gallery__scale_of_the_path_is_equal_and_holds_it():
    fig = plot_gallery(make_attractors(np.arange(2), ("initial_condition",), {}), make_portraits(2))
    for ax in fig.axes:
        path = [line for line in ax.get_lines() if str(line.get_gid()).startswith("path")]
        if path:
            box = ax.get_window_extent()
            (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
            assert (right - left) / box.width == pytest.approx((top - bottom) / box.height)
            x, y = path[0].get_xydata().T
            assert left < x.min() < x.max() < right
            assert bottom < min(y.min(), -VALUES["h"]) < y.max() < top


def test_plot_gallery__largest_shares_are_drawn():
    attractors = make_attractors(np.arange(11), ("initial_condition",), {})
    portraits = make_portraits(11)
    portraits["share"][0] = 0.0
    fig = plot_gallery(attractors, portraits)
    assert fig.data["attractor"].values.tolist() == list(range(1, 9))
    assert any("3 more sets" in t.get_text() for t in fig.texts)
    with pytest.raises(ValueError, match="no attractor at this parameter point"):
        plot_gallery(attractors, portraits.isel(attractor=[]))


def test_plot_gallery__says_what_it_leaves_out():
    """Of six cells two end on the attractors, three diverged and one was not reached."""
    attractors = make_attractors(np.array([0, 1, -1, -1, -1, -1]), ("initial_condition",), {})
    attractors["status"][2:] = [vocabulary.DIVERGED] * 3 + [vocabulary.UNREACHED]
    fig = plot_gallery(attractors, make_portraits(2))
    head = " ".join(fig.texts[0].get_text().split())
    assert head.endswith("2 of 6 cells end on attractors; 3 diverged, 1 unreached")


def texts_of(fig):
    """Texts with their bounding boxes [pixels], labels of the ticks in view included."""
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    found = list(fig.texts)
    for ax in fig.axes:
        found += [*ax.texts, ax.xaxis.label, ax.yaxis.label]
        for axis in (ax.xaxis, ax.yaxis):
            low, high = axis.get_view_interval()
            ticks = zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
            found += [label for place, label in ticks if low <= place <= high]
    return [(t, t.get_window_extent(canvas.get_renderer())) for t in found if t.get_text()]


@pytest.mark.parametrize("width", [85.0, 178.0])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_plot_gallery__no_label_covers_a_panel_or_another_label(n, width):
    """Labels of paths, which have many digits, covered each other and the panel on the left."""
    portraits = make_portraits(n)
    portraits["orbit"] = 0.05 * portraits["orbit"] + 0.2
    attractors = make_attractors(np.arange(n), ("initial_condition",), {})
    fig = plot_gallery(attractors, portraits, frame=style.Frame(width))
    texts, places = texts_of(fig), [ax.get_window_extent() for ax in fig.axes]
    for text, box in texts:
        assert not any(box.padded(-2).overlaps(p.padded(-2)) for p in places), text.get_text()
        assert 0.0 <= box.x0 < box.x1 <= fig.bbox.x1, text.get_text()
    for k, (text, box) in enumerate(texts):
        for other, place in texts[:k]:
            assert not box.padded(-2).overlaps(place.padded(-2)), (text.get_text(), other.get_text())


def test_plot_gallery__sets_that_do_not_attract_are_grey_and_have_no_share():
    attractors, portraits = make_attractors(np.arange(2), ("initial_condition",), {}), make_portraits(2)
    for ds in (attractors, portraits):
        ds["stability"][1] = vocabulary.UNSTABLE
    fig = plot_gallery(attractors, portraits)
    titles = [t.get_text().replace("\N{NO-BREAK SPACE}", " ") for ax in fig.axes for t in ax.texts]
    assert [t for t in titles if t] == ["A: period 1, left, share 10.0 %", "B: period 1, left, unstable"]
    (line,) = [line for ax in fig.axes for line in ax.get_lines() if line.get_gid() == "orbit:B:psi1"]
    assert to_rgb(line.get_color()) == to_rgb(palette.GREY_OF[vocabulary.UNSTABLE])


def in_canvas(fig):
    """Whether legends and texts lie within the figure."""
    fig.draw_without_rendering()
    boxes = [legend.get_window_extent() for legend in fig.legends]
    boxes += [t.get_window_extent() for ax in fig.axes for t in ax.texts if t.get_text()]
    width, height = fig.get_size_inches() * fig.dpi
    return all(b.x0 >= 0 and b.y0 >= 0 and b.x1 <= width and b.y1 <= height for b in boxes)


def test_legends__fit_into_the_figure_beside_the_axes():
    """Twenty attractors with the longest names."""
    ids = np.tile(np.arange(20), (3, 1))
    ds = make_attractors(ids, ("frequency", "initial_condition"), {"frequency": [2.0, 2.1, 2.2]})
    ds["orbit_period"][:] = np.array([11, 13, 0])[:, None]
    ds["kind"][:] = np.array([PERIODIC_ORBIT, PERIODIC_ORBIT, vocabulary.BOUNDED_SET])[:, None]
    ds["side"][:] = np.array([Side.LEFT, Side.RIGHT, Side.STRADDLING])[:, None]
    for fig in (plot_fractions(ds), plot_coexisting(ds)):
        assert in_canvas(fig)
        assert fig.legends[0].get_window_extent().x0 > fig.axes[0].get_window_extent().x1
    square = make_attractors(np.arange(16).reshape(4, 4), GRID, grid_coords(4, 4))
    square["orbit_period"][:] = 16
    square["side"][:] = Side.STRADDLING
    assert in_canvas(plot_basins(square, n_periods=xr.ones_like(square["attractor_id"])))


def test_save_data__every_figure(sweep, walk, map_of_two, tmp_path):
    figures = [
        plot_fractions(sweep),
        plot_coexisting(sweep),
        plot_coexisting(walk),
        plot_regimes(map_of_two),
        plot_gallery(sweep, make_portraits(2).assign_coords(frequency=2.1)),
    ]
    for fig in figures:
        with xr.open_dataset(save_data(fig, tmp_path / "a.svg"), engine="scipy") as stored:
            assert set(stored.data_vars) == set(fig.data.data_vars)
            for name in fig.data.data_vars:
                np.testing.assert_allclose(stored[name], fig.data[name])


def test_vocabulary__codes_are_those_of_the_kernel():
    for status in Status:
        assert getattr(vocabulary, status.name) == status


def test_greys__every_cell_without_an_attractor_has_one():
    """Whatever became of a cell, and on whatever set that does not attract it is."""
    status = np.array([*Status, PERIODIC, PERIODIC, BOUNDED, BOUNDED], np.int8)
    ids = np.array([*np.full(len(Status), -1), 0, 1, 2, 3], np.int32)
    ds = make_attractors(ids, ("initial_condition",), {}, status=status)
    ds["stability"][:] = [vocabulary.NOT_SETTLED, vocabulary.TRANSIENT, vocabulary.UNSTABLE, vocabulary.NEUTRAL]
    found = palette.other_cells(ds)
    assert found.keys() == palette.GREYS.keys()
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


def bars(fig, name):
    """Position, low and high of the bars at the upper edge of a band."""
    found = [a for a in fig.axes[0].collections if a.get_gid() == f"interval:{name}"]
    return [[round(float(v), 9) for v in (s[0][0], s[0][1], s[1][1])] for s in found[-1].get_segments()]


def test_plot_fractions__intervals(sweep):
    fig = plot_fractions(sweep)
    # Wilson's score interval, by its own equation: |p - k/n| = z sqrt(p (1 - p) / n) at both ends
    for outcome, k in (("A", [5, 4, 0]), ("B", [5, 4, 8]), ("not settled", [0, 0, 2])):
        one = fig.data.sel(outcome=outcome)
        for end in ("low", "high"):
            p, share = one[end].values, np.array(k) / 10
            inner = (p > 0) & (p < 1)
            assert np.abs(p - share)[inner] == pytest.approx(1.959964 * np.sqrt(p * (1 - p) / 10)[inner])
        assert (one["low"] <= one["fraction"]).all()
        assert (one["fraction"] <= one["high"]).all()
    b = fig.data.sel(outcome="B")
    # five bands: the bars of the lowest stand at a fifth of the columns, which are 0.1 Hz wide
    expected = np.column_stack([[1.97, 2.07, 2.17], b["low"], b["high"]])
    assert bars(fig, "B") == pytest.approx(expected)
    # the edge above A is none at the first frequency, where A reaches the top, nor at the last
    assert [x for x, *_ in bars(fig, "A")] == [2.09]
    caption = caption_of(fig)
    assert "states" in caption
    # five of ten cells have the widest interval
    assert caption.endswith(f"±{float(0.5 - b['low'][0]):.2g}")
    many = sweep.isel(frequency=np.tile(np.arange(3), 7)).assign_coords(frequency=2.0 + 0.1 * np.arange(21))
    assert not [a for a in plot_fractions(many).axes[0].collections if "interval" in a.get_gid()]


def test_plot_fractions__branches_are_no_sample(walk):
    fig = plot_fractions(walk)
    assert fig.axes[0].get_ylabel() == "share of the branches"
    assert "low" not in fig.data
    assert "branches each" in caption_of(fig)


def test_plot_regimes__shares_and_what_may_be_missing(map_of_two):
    fig = plot_regimes(map_of_two)
    here = fig.data.sel(frequency=2.0, q=1.5)
    assert here["share"].values.tolist() == [0.5, 0.5]
    within = (fig.data["low"] <= fig.data["share"]) & (fig.data["share"] <= fig.data["high"])
    assert (within == (fig.data["share"] > 0)).all()
    unseen = fig.data["unseen_high"].transpose("frequency", "q").values
    # (1 - p)^n = 0.05 with n decided cells; nothing is known where none is
    assert unseen[:, :2] == pytest.approx(1 - 0.05 ** (1 / 4))
    assert unseen[:, 2].tolist() == pytest.approx([1 - 0.05 ** (1 / 3), 1.0])
    assert "basins below 52.7" in caption_of(fig)
