"""Figures of attractors: what is drawn, read back from pixels, artists and the data beside them."""

from __future__ import annotations

import itertools
import time
import tracemalloc

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb

from pipeline.analysis.sides import Side
from pipeline.plots import palette, plot_basins, plot_fractions, save_data, save_figure

STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]
PENDING, PERIODIC, BOUNDED, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED, INFERRED = range(8)


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
            "kind": (per, here.astype(np.int8)),
            "orbit_period": (per, here.astype(np.int32)),
            "n_cells": (per, counts),
            "share": (per, counts / flat.shape[-1]),
            "side": (per, np.where(here, Side.LEFT, 0).astype(np.int8)),
            "rotation": ((*per, "link"), np.where(here, 0.0, np.nan)[..., None] * np.ones(2)),
            "attractor_points": ((*per, "point", "state"), points),
        },
        coords={"state": STATES, "attractor": np.arange(n, dtype=np.int32), **coords},
        attrs={"parameters": "q = 1.5"},
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
    """4 x 4 cells, all different along both axes: 0 left, 1 right above, the rest unassigned."""
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


def legend_texts(fig):
    return [text.get_text() for legend in fig.legends for text in legend.get_texts()]


def legend_colours(fig):
    handles = [patch for legend in fig.legends for patch in legend.get_patches()]
    return dict(zip(legend_texts(fig), [to_rgb(p.get_facecolor()) for p in handles], strict=True))


def test_plot_basins__each_cell_has_the_colour_of_its_legend(grid):
    fig = plot_basins(grid)
    picture, legend = colours_of(fig), legend_colours(fig)
    assert list(legend) == [
        "A: period 1, left, 50.0 %", "B: period 1, left, 25.0 %", "undecided, 6.2 %", "diverged, 6.2 %",
        "step limit, 6.2 %", "pending, 6.2 %",
    ]  # fmt: skip
    expected = np.empty((4, 4, 3))
    expected[:], expected[2:, 2:] = legend["A: period 1, left, 50.0 %"], legend["B: period 1, left, 25.0 %"]
    for cell, name in {
        (3, 0): "diverged",
        (3, 1): "pending",
        (2, 0): "step limit",
        (2, 1): "undecided",
    }.items():
        expected[cell] = legend[f"{name}, 6.2 %"]
    assert np.abs(picture - expected).max() < 0.003


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


def test_plot_basins__inferred_cells(grid):
    """They have their basin's colour, took no time, and are undecided if they belong to nothing."""
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
    fig = plot_basins(more, at={"frequency": 2.39})
    np.testing.assert_array_equal(
        fig.data["attractor_id"].transpose(*GRID), more["attractor_id"].isel(frequency=1)
    )
    assert "$f$ = 2.4 Hz" in [t.get_text() for t in fig.axes[0].texts]


def test_plot_basins__sample_is_no_grid(grid):
    sample = grid.stack(initial_condition=GRID).drop_vars([*GRID, "initial_condition"])
    with pytest.raises(ValueError, match=r'lie along: initial_condition; .* kind = "grid"'):
        plot_basins(sample)


def test_plot_basins__third_start_axis_must_be_chosen(grid):
    more = xr.concat([grid, grid], "psi1_dot_0").assign_coords(psi1_dot_0=[0.0, 1.0])
    more["kind"] = grid["kind"]
    for name in ("n_cells", "share", "orbit_period", "side", "rotation"):
        more[name] = grid[name]
    with pytest.raises(ValueError, match=r"3 of the initial states are left.*such as psi1_dot_0=0"):
        plot_basins(more)
    assert plot_basins(more, at={"psi1_dot_0": 1.0}).axes[0].get_xlabel().startswith(r"$\psi_1")
    assert r"\dot{\psi}_2" not in plot_basins(more, at={"psi2_0": 0.2}).axes[0].get_xlabel()
    assert plot_basins(more, at={"psi2_0": 0.2}).axes[0].get_ylabel() == r"$\dot{\psi}_1(0)$ [rad/s]"


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
    assert took < 10.0  # about 1.5 s, other jobs and the tracing of memory aside
    assert peak < 6e8


def test_cast_of__most_cells_have_own_colours_and_selection_changes_none():
    ids = np.repeat(np.arange(30), np.r_[np.full(10, 5), np.full(10, 30), np.full(10, 2)])
    ds = make_attractors(ids, ("initial_condition",), {})
    cast = palette.cast_of(ds)
    assert set(cast.main) == {*range(10, 20), 0, 1}
    own = [cast.colours[i] for i in cast.main]
    assert len(set(own)) == 12
    assert {cast.colours[i] for i in range(30) if i not in cast.main} == {palette.OTHERS}
    part = ds.copy(deep=True)
    part["kind"][5:] = 0
    assert palette.cast_of(ds, part).colours == cast.colours
    assert palette.cast_of(ds, part).names[20] == "U: absent"
    assert [palette.letter(i) for i in (0, 25, 26, 51, 52, 701, 702)] == [
        "A",
        "Z",
        "AA",
        "AZ",
        "BA",
        "ZZ",
        "AAA",
    ]


def test_describe__periods_sides_turns():
    ds = make_attractors([[0, 0], [0, 0], [0, 0]], ("frequency", "initial_condition"), {}).isel(attractor=0)
    ds["orbit_period"][:] = [1, 2, 0]
    ds["side"][:] = [Side.LEFT, Side.STRADDLING, Side.STRADDLING]
    assert palette.describe(ds) == "period 1, 2 or not periodic, left/straddling"
    ds["side"][:] = Side.ROTATING
    ds["rotation"][:] = [0.0, -0.5]
    assert palette.describe(ds).endswith("rotating, (0, \N{MINUS SIGN}0.5)")
    ds["rotation"][0] = [0.0, 1.0]
    assert palette.describe(ds).endswith("rotating")


# Machado, Oliveira & Fernandes, IEEE TVCG 15 (2009) 1291, severity 1; rows act on linear RGB
VISION = {
    "normal": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "protanopia": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900],
    ],
}  # fmt: skip


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
    assert len(set(colours)) == 12 + 1 + 4
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
    assert band(fig, "undecided") == [[2.15, 2.25, 0.8, 1.0]]
    assert band(fig, "diverged") == [[2.05, 2.15, 0.8, 0.9]]
    assert band(fig, "pending") == [[2.05, 2.15, 0.9, 1.0]]
    assert legend_texts(fig) == ["pending", "diverged", "undecided", "A: period 1, left", "B: period 1, left"]
    (area,) = [a for a in fig.axes[0].collections if a.get_gid() == "band:A"]
    assert to_rgb(area.get_facecolor()[0]) == legend_colours(fig)["A: period 1, left"]
    assert fig.axes[0].get_xlabel() == "drive frequency [Hz]"
    assert fig.data["fraction"].sel(outcome="A").values.tolist() == [0.5, 0.4, 0.0]
    assert fig.data["fraction"].sum("outcome").values == pytest.approx(1.0)


def test_plot_fractions__more_attractors_than_colours():
    ids = np.tile(np.arange(15), (2, 1))
    fig = plot_fractions(make_attractors(ids, ("q", "initial_condition"), {"q": [1.0, 1.1]}))
    assert len(legend_texts(fig)) == 13
    assert legend_texts(fig)[0] == "3 others"
    assert band(fig, "3 others") == [[0.95, 1.15, 0.8, 1.0]]


def test_plot_fractions__other_parameters_must_be_chosen(sweep):
    with pytest.raises(ValueError, match="this run sweeps none"):
        plot_fractions(sweep.isel(frequency=0))
    more = xr.concat([sweep, sweep], "q").assign_coords(q=[1.4, 1.5])
    with pytest.raises(ValueError, match=r"2 are left of q, frequency; .* such as q=1\.4"):
        plot_fractions(more)
    assert "q = 1.5" in plot_fractions(more, at={"q": 1.5}).axes[0].texts[-1].get_text()
