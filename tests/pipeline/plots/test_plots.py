"""Figures: what is drawn, read back from the figures themselves."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb

from magpend_core.models import load_model
from pipeline.plots import pixels, plot_bifurcation, points, style
from tests.pipeline.plots.made_up import PENDULUM, STATES, by_gid, legend_texts

SYMBOLS = {s.name: f"${s.symbol}$" for s in load_model("pendulum").states}
PENDING, PERIODIC, BOUNDED, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED = range(7)


def make_cube(n_frequencies=5, n_keep=3):
    """Branches: up left, up right, down straddling, down rotating; values tell where they come from."""
    frequency = 2.0 + 0.1 * np.arange(n_frequencies)
    section = np.zeros((4, n_frequencies, n_keep, 4))
    i, k = np.meshgrid(np.arange(n_frequencies), np.arange(n_keep), indexing="ij")
    size = 0.1 + 0.01 * i + 0.001 * k
    section[0, ..., 0], section[0, ..., 1] = -size, -size
    section[1, ..., 0], section[1, ..., 1] = size, size
    section[2, ..., 0] = np.where(k % 2, 0.3 + size, -0.3 - size)
    section[2, ..., 1] = section[2, ..., 0]
    section[3, ..., 0] = 1.0 + size
    section[..., 2] = 10.0 * section[..., 0]
    turns = np.zeros((4, n_frequencies, 2), np.int32)
    turns[3, :, 1] = 2
    return xr.Dataset(
        {
            "section": (("branch", "frequency", "period_index", "state"), section),
            "status": (("branch", "frequency"), np.full((4, n_frequencies), PERIODIC, np.int8)),
            "turns": (("branch", "frequency", "link"), turns),
        },
        coords={
            "frequency": ("frequency", frequency, {"units": "Hz"}),
            "state": STATES,
            "direction": ("branch", ["up", "up", "down", "down"]),
        },
        attrs=PENDULUM,
    )


KINDS = ["up:left", "up:right", "down:straddling", "down:rotating"]


def set_status(ds, branch, position, status):
    """Give a cell a status, and NaN sections as the store does."""
    ds = ds.copy(deep=True)
    ds["status"][branch, position] = status
    ds["section"][branch, position] = np.nan
    return ds


def drawn(fig, axes=0):
    """Markers by class: arrays of (frequency, value), sorted."""
    found = {}
    for line in fig.axes[axes].get_lines():
        if str(line.get_gid()).startswith("points:"):
            found[line.get_gid().removeprefix("points:")] = np.array(sorted(line.get_xydata().tolist()))
    return found


def expected(ds, branch, state=0):
    values = ds["section"].values[branch, :, :, state]
    pairs = [[f, v] for f, row in zip(ds["frequency"].values, values, strict=True) for v in row]
    return np.array(sorted(pair for pair in pairs if np.isfinite(pair[1])))


def test_status_codes_are_those_of_the_kernel():
    from magpend_core.status import Status

    assert {Status.PERIODIC, Status.BOUNDED, Status.INFERRED} == set(points.DRAWN)
    absent = [code for codes in points.ABSENT.values() for code in codes]
    assert sorted([*points.DRAWN, *absent]) == sorted(Status)
    assert points.ABSENT["pending"] == (Status.PENDING,)
    assert points.ABSENT["not reached"] == (Status.UNREACHED,)


@pytest.mark.slow
def test_plot_bifurcation__each_class_has_its_points_and_colour():
    ds = make_cube()
    fig = plot_bifurcation(ds)
    found = drawn(fig)
    assert sorted(found) == sorted(KINDS)
    for branch, kind in enumerate(KINDS):
        np.testing.assert_allclose(found[kind], expected(ds, branch))
    lines = by_gid(fig)
    assert to_rgb(lines["points:up:left"].get_color()) == to_rgb(style.as_hex(style.BLUE))
    assert to_rgb(lines["points:up:right"].get_color()) == to_rgb(style.as_hex(style.VERMILLION))
    assert to_rgb(lines["points:down:rotating"].get_color()) == style.tinted(style.as_hex(style.PURPLE), pixels.TINT)
    assert legend_texts(fig) == ["left", "right", "straddling", "rotating", "up", "down"]
    # a complete cube has no strip of what is absent
    assert len(fig.axes) == 1
    assert not [gid for gid in lines if gid.startswith("absent")]


@pytest.mark.slow
@pytest.mark.parametrize("state", STATES)
def test_plot_bifurcation__state_and_degrees(state):
    ds = make_cube()
    column = STATES.index(state)
    radians, degrees = plot_bifurcation(ds, state=state), plot_bifurcation(ds, state=state, degrees=True)
    want = expected(ds, 1, column)
    if np.ptp(want[:, 1]) > 0:
        np.testing.assert_allclose(drawn(radians)["up:right"], want)
        np.testing.assert_allclose(drawn(degrees)["up:right"], want * [1.0, 180.0 / np.pi])
    unit = "/s]" if state.endswith("_dot") else "]"
    assert radians.axes[0].get_ylabel() == f"{SYMBOLS[state]} [rad{unit}"
    assert degrees.axes[0].get_ylabel() == f"{SYMBOLS[state]} [deg{unit}"
    assert radians.axes[0].get_xlabel() == "drive frequency [Hz]"


@pytest.mark.slow
def test_plot_bifurcation__side_by_side():
    ds = make_cube()
    fig = plot_bifurcation(ds, layout="side")
    assert sorted(drawn(fig, 0)) == ["up:left", "up:right"]
    assert sorted(drawn(fig, 1)) == ["down:rotating", "down:straddling"]
    assert fig.axes[0].get_ylim() == fig.axes[1].get_ylim()
    assert [ax.texts[-1].get_text() for ax in fig.axes] == ["up", "down"]
    assert not {"up", "down"} & set(legend_texts(fig))


@pytest.mark.slow
@pytest.mark.parametrize("status", [PENDING, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED])
def test_plot_bifurcation__absent_cells_are_not_drawn_but_shown(status):
    ds = set_status(make_cube(), 1, 2, status)
    ds["section"][1, 2] = 2.5  # left from before
    fig = plot_bifurcation(ds)
    assert fig.axes[0].get_ylim()[1] < 1.5
    want = expected(set_status(ds, 1, 2, status), 1)
    assert len(want) == 12
    np.testing.assert_allclose(drawn(fig)["up:right"], want)
    name = {PENDING: "pending", UNREACHED: "not reached", DIVERGED: "diverged"}.get(status, "failed")
    assert f"{name}: 1 of 20 cells" in legend_texts(fig)
    (path,) = by_gid(fig)[f"absent:{name}"].get_paths()
    low, high = path.get_extents().min, path.get_extents().max
    np.testing.assert_allclose([low, high], [[2.15, 0.0], [2.25, 0.25]], atol=1e-12)
    assert "blank" not in by_gid(fig)


@pytest.mark.slow
def test_plot_bifurcation__blank_where_no_cell_is_left():
    ds = make_cube()
    for branch in range(4):
        ds = set_status(ds, branch, 4, PENDING)
    xs = np.concatenate([path.vertices[:, 0] for path in by_gid(plot_bifurcation(ds))["blank"].get_paths()])
    assert (xs.min(), xs.max()) == pytest.approx((2.35, 2.45))
    ds["status"][:] = PENDING
    ds["section"][:] = np.nan
    texts = plot_bifurcation(ds).axes[0].texts
    assert [t.get_text() for t in texts] == ["nothing to draw yet: all 20 cells are pending"]
    ds["status"][0] = DIVERGED
    (text, *_) = plot_bifurcation(ds, layout="side").axes[0].texts
    assert text.get_text() == "nothing to draw: of 20 cells, 15 pending, 5 diverged"


def test_plot_bifurcation__sweep_pools_initial_conditions():
    ds = make_cube().drop_vars("direction").rename(branch="initial_condition")
    found = drawn(plot_bifurcation(ds))
    assert sorted(found) == ["left", "right", "rotating", "straddling"]
    np.testing.assert_allclose(found["left"], expected(ds, 0))
    grid = ds.isel(initial_condition=[0, 1]).rename(initial_condition="psi1_0")
    grid = xr.concat([grid, grid], "psi2_0").transpose("frequency", "psi1_0", "psi2_0", ...)
    assert sorted(drawn(plot_bifurcation(grid))) == ["left", "right"]


def test_plot_bifurcation__other_and_falling_parameter():
    ds = make_cube().rename(frequency="q").assign_attrs(frequency_hz=2.2).isel(q=slice(None, None, -1))
    ds["q"].attrs = {"long_name": "drive amplitude", "units": "N m"}
    fig = plot_bifurcation(ds)
    assert fig.axes[0].get_xlabel() == "drive amplitude [N m]"
    assert fig.axes[0].get_xlim() == pytest.approx((1.95, 2.45))
    np.testing.assert_allclose(drawn(fig)["up:left"], expected(ds.rename(q="frequency"), 0))


def test_plot_bifurcation__refusals():
    for options, message in (
        ({"state": "psi"}, r"unknown state 'psi'\. Did you mean 'psi2'\? Allowed: psi1, psi2, psi1_dot"),
        ({"layout": "overlap"}, r"unknown layout 'overlap'\. Did you mean 'overlay'\? Allowed: overlay, side"),
    ):
        with pytest.raises(ValueError, match=message):
            plot_bifurcation(make_cube(), **options)
    with pytest.raises(ValueError, match="this cube has up only; use layout 'overlay'"):
        plot_bifurcation(make_cube().isel(branch=[0, 1]), layout="side")
    ds = xr.concat([make_cube(), make_cube()], xr.DataArray([1.0, 1.5], dims="q", name="q"))
    with pytest.raises(ValueError, match=r"frequency.*such as --at q=1"):
        plot_bifurcation(ds.transpose("branch", "frequency", "q", ...))
    plot_bifurcation(ds.sel(q=1.5))


@pytest.mark.slow
@pytest.mark.parametrize(("chunks", "block_values"), [({"branch": 1}, 50), ({"branch": 3, "frequency": 2}, 1)])
def test_plot_bifurcation__blocks_do_not_matter(chunks, block_values, monkeypatch):
    ds = set_status(make_cube(), 3, 1, DIVERGED)
    want = drawn(plot_bifurcation(ds))
    monkeypatch.setattr(points, "BLOCK_VALUES", block_values)
    found = drawn(plot_bifurcation(ds.chunk(chunks)))
    assert sorted(found) == sorted(want)
    for kind in want:
        np.testing.assert_array_equal(found[kind], want[kind])
    # blocks are bounded, and tile the cube
    section, seen = make_cube(7).chunk(chunks)["section"], np.zeros((4, 7), int)
    for selection in points.selections(section):
        assert section.isel(selection).size <= max(block_values, 12)
        seen[selection["branch"], selection["frequency"]] += 1
    assert (seen == 1).all()


def test_distinct__leaves_one_of_equal_points():
    position = np.array([0.0, 0.0, 1e-9, 1.0, 1.0])
    value = np.array([0.5, 0.5 + 1e-9, 0.6, 0.5, -0.5])
    where, height = pixels.distinct(position, value, (0.0, 1.0), (-1.0, 1.0))
    assert sorted(zip(where.round(6).tolist(), height.round(6).tolist(), strict=True)) == [
        (0, 0.5),
        (0, 0.6),
        (1, -0.5),
        (1, 0.5),
    ]
    positions, values = np.meshgrid(np.arange(10), np.linspace(-1.0, 1.0, 2000))
    assert len(pixels.distinct(positions.ravel(), values.ravel(), (0.0, 9.0), (-1.0, 1.0))[0]) == 20_000


def image_of(fig, axes=0):
    (image,) = fig.axes[axes].get_images()
    return np.asarray(image.get_array()), image.get_extent()


def pixel(fig, x, y, axes=0):
    picture, (left, right, low, high) = image_of(fig, axes)
    row = int((y - low) / (high - low) * picture.shape[0])
    column = int((x - left) / (right - left) * picture.shape[1])
    return picture[row, column] / 255.0


def assert_ink(found, colour):
    """Check that a pixel has a colour, at least at half strength."""
    paper = 1.0 - np.array(to_rgb(colour))
    strength = (1.0 - found) @ paper / (paper @ paper)
    assert 0.49 < strength < 1.01
    np.testing.assert_allclose(1.0 - found, strength * paper, atol=0.01)


@pytest.mark.slow
def test_plot_bifurcation__image_has_the_same_points(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = set_status(make_cube(), 1, 2, PENDING)
    fig = plot_bifurcation(ds, layout="side")
    assert not drawn(fig)
    for axes, branch, colour in [
        (0, 0, style.as_hex(style.BLUE)),
        (0, 1, style.as_hex(style.VERMILLION)),
        (2, 2, style.as_hex(style.GREEN)),
    ]:
        for x, y in expected(ds, branch):
            assert_ink(pixel(fig, x, y, axes), colour)
    inked = (image_of(fig)[0] < 255).any(-1)
    columns = np.flatnonzero(inked.any(0)) / inked.shape[1]
    assert inked.mean() < 0.01
    assert columns.min() > 0.09
    np.testing.assert_array_equal(pixel(fig, 2.2, 0.12), 1.0)
    assert (pixel(fig, 2.1, 0.11) < 1).any()


@pytest.mark.slow
def test_plot_bifurcation__image_shows_up_over_down(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = make_cube().isel(branch=[0, 0], period_index=[0])
    ds["direction"] = ("branch", ["up", "down"])
    ds["section"][1, 3, :, :2] -= 0.02
    fig = plot_bifurcation(ds)
    tint = style.tinted(style.as_hex(style.BLUE), pixels.TINT)
    np.testing.assert_allclose(pixel(fig, 2.1, -0.11), to_rgb(style.as_hex(style.BLUE)), atol=0.01)
    np.testing.assert_allclose(pixel(fig, 2.3, -0.13), to_rgb(style.as_hex(style.BLUE)), atol=0.01)
    np.testing.assert_allclose(pixel(fig, 2.3, -0.15), tint, atol=0.01)


@pytest.mark.slow
def test_plot_bifurcation__fuller_pixels_are_darker_on_one_scale_of_all_panels(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = make_cube(n_keep=40).isel(branch=[1])
    ds["section"][:, :, :30, :2] = 0.2
    ds["section"][:, :, 30:, :2] = 0.1 + 0.05 * (np.arange(10) % 2)[:, None]
    fig = plot_bifurcation(ds)
    full, single = pixel(fig, 2.1, 0.2), pixel(fig, 2.1, 0.15)
    np.testing.assert_allclose(full, to_rgb(style.as_hex(style.VERMILLION)), atol=0.01)
    assert single[2] > full[2] + 0.1
    assert_ink(single, style.as_hex(style.VERMILLION))
    # forty points on four heights are darker than on twenty, also in another panel
    ds = ds.isel(branch=[0, 0]).assign_coords(direction=("branch", ["up", "down"]))
    for direction, n in enumerate((4, 20)):
        ds["section"][direction, ..., :2] = np.resize(np.linspace(0.1, 0.5, n), 40)[:, None]
    fig = plot_bifurcation(ds, layout="side")
    darkest = [255 - int(image_of(fig, axes)[0].min()) for axes, ax in enumerate(fig.axes) if ax.get_images()]
    assert darkest[1] < darkest[0] - 10


@pytest.mark.slow
def test_plot_bifurcation__many_points_in_little_memory():
    import tracemalloc

    n_branches, n_frequencies, n_keep = 40, 1000, 50
    rng = np.random.default_rng(5)
    section = rng.normal(0.0, 0.2, (1, n_frequencies, n_keep, 4)).astype(np.float64)
    section = np.broadcast_to(section, (n_branches, n_frequencies, n_keep, 4))
    ds = xr.Dataset(
        {
            "section": (("branch", "frequency", "period_index", "state"), section),
            "status": (("branch", "frequency"), np.full((n_branches, n_frequencies), BOUNDED, np.int8)),
        },
        coords={"frequency": np.linspace(2, 3, n_frequencies), "state": STATES},
        attrs=PENDULUM,
    ).assign_coords(direction=("branch", ["up", "down"] * (n_branches // 2)))
    tracemalloc.start()
    fig = plot_bifurcation(ds)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert image_of(fig)[0].ndim == 3
    # 64 MB of sections; blocks of 32 MB with their labels, then counts and picture of 13 and 40 MB
    assert peak < 300e6
