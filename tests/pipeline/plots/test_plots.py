"""Figures: what is drawn, read back from the figures themselves."""

from __future__ import annotations

import sys
import threading

import matplotlib
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from magpend_core.models import load_model
from pipeline.plots import (
    labels,
    pixels,
    plot_bifurcation,
    plot_trajectory,
    points,
    save_figure,
    style,
)

SYMBOLS = {s.name: f"${s.symbol}$" for s in load_model("pendulum").states}
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]
PARAMETERS = "\n".join(f"{k} = {v!r}" for k, v in load_model("pendulum").load().as_dict().items())
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
        attrs={"parameters": PARAMETERS},
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


def legend_labels(fig):
    return [text.get_text() for legend in fig.legends for text in legend.get_texts()]


def gids(fig):
    return {artist.get_gid() for artist in fig.findobj() if artist.get_gid()}


def test_status_codes_are_those_of_the_kernel():
    from magpend_core.status import Status

    assert {Status.PERIODIC, Status.BOUNDED, Status.INFERRED} == set(points.DRAWN)
    absent = [code for codes in points.ABSENT.values() for code in codes]
    assert sorted([*points.DRAWN, *absent]) == sorted(Status)
    assert points.ABSENT["pending"] == (Status.PENDING,)
    assert points.ABSENT["not reached"] == (Status.UNREACHED,)


def test_plot_bifurcation__each_class_has_its_points():
    ds = make_cube()
    found = drawn(plot_bifurcation(ds))
    assert sorted(found) == sorted(KINDS)
    for branch, kind in enumerate(KINDS):
        np.testing.assert_allclose(found[kind], expected(ds, branch))


def test_plot_bifurcation__colours_and_legend():
    fig = plot_bifurcation(make_cube())
    colours = {line.get_gid(): to_rgb(line.get_color()) for line in fig.axes[0].get_lines()}
    assert colours["points:up:left"] == to_rgb(style.BLUE)
    assert colours["points:up:right"] == to_rgb(style.VERMILLION)
    assert colours["points:down:rotating"] == style.tinted(style.PURPLE, pixels.TINT)
    assert legend_labels(fig) == ["left", "right", "straddling", "rotating", "up", "down"]


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


def test_plot_bifurcation__side_by_side():
    ds = make_cube()
    fig = plot_bifurcation(ds, layout="side")
    assert sorted(drawn(fig, 0)) == ["up:left", "up:right"]
    assert sorted(drawn(fig, 1)) == ["down:rotating", "down:straddling"]
    assert fig.axes[0].get_ylim() == fig.axes[1].get_ylim()
    assert [ax.texts[-1].get_text() for ax in fig.axes] == ["up", "down"]
    assert not {"up", "down"} & set(legend_labels(fig))


@pytest.mark.parametrize("status", [PENDING, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED])
@pytest.mark.parametrize("stale", [False, True])
def test_plot_bifurcation__absent_cells_are_not_drawn_but_shown(status, stale):
    ds = set_status(make_cube(), 1, 2, status)
    if stale:
        ds["section"][1, 2] = 2.5
    fig = plot_bifurcation(ds)
    assert fig.axes[0].get_ylim()[1] < 1.5
    want = expected(set_status(ds, 1, 2, status), 1)
    assert len(want) == 12
    np.testing.assert_allclose(drawn(fig)["up:right"], want)
    name = {PENDING: "pending", UNREACHED: "not reached"}.get(status, "failed")
    assert name in legend_labels(fig)
    (path,) = next(a for a in fig.findobj() if a.get_gid() == f"absent:{name}").get_paths()
    low, high = path.get_extents().min, path.get_extents().max
    np.testing.assert_allclose([low, high], [[2.15, 0.0], [2.25, 0.25]], atol=1e-12)
    assert "blank" not in gids(fig)


def test_plot_bifurcation__complete_cube_has_no_strip():
    fig = plot_bifurcation(make_cube())
    assert len(fig.axes) == 1
    assert not {gid for gid in gids(fig) if gid.startswith("absent")}


def test_plot_bifurcation__blank_where_no_cell_is_left():
    ds = make_cube()
    for branch in range(4):
        ds = set_status(ds, branch, 4, PENDING)
    fig = plot_bifurcation(ds)
    blank = next(a for a in fig.findobj() if a.get_gid() == "blank")
    xs = np.concatenate([path.vertices[:, 0] for path in blank.get_paths()])
    assert (xs.min(), xs.max()) == pytest.approx((2.35, 2.45))


def test_plot_bifurcation__empty_cube_says_so():
    ds = make_cube()
    ds["status"][:] = PENDING
    ds["section"][:] = np.nan
    fig = plot_bifurcation(ds)
    assert [t.get_text() for t in fig.axes[0].texts] == ["nothing to draw yet: all 20 cells are pending"]
    ds["status"][0] = DIVERGED
    fig = plot_bifurcation(ds, layout="side")
    assert fig.axes[0].texts[0].get_text() == "nothing to draw: of 20 cells, 15 pending, 5 failed"


def test_plot_bifurcation__sweep_pools_initial_conditions():
    ds = make_cube().drop_vars("direction").rename(branch="initial_condition")
    found = drawn(plot_bifurcation(ds))
    assert sorted(found) == ["left", "right", "rotating", "straddling"]
    np.testing.assert_allclose(found["left"], expected(ds, 0))
    grid = ds.isel(initial_condition=[0, 1]).rename(initial_condition="psi1_0")
    grid = xr.concat([grid, grid], "psi2_0").transpose("frequency", "psi1_0", "psi2_0", ...)
    assert sorted(drawn(plot_bifurcation(grid))) == ["left", "right"]


def test_plot_bifurcation__other_parameter():
    ds = make_cube().rename(frequency="q").assign_attrs(frequency_hz=2.2)
    ds["q"].attrs = {"long_name": "drive amplitude", "units": "N m"}
    fig = plot_bifurcation(ds.assign_coords(q=ds["q"].assign_attrs(ds["q"].attrs)))
    assert fig.axes[0].get_xlabel() == "drive amplitude [N m]"


def test_plot_bifurcation__falling_parameter():
    ds = make_cube().isel(frequency=slice(None, None, -1))
    fig = plot_bifurcation(ds)
    assert fig.axes[0].get_xlim() == pytest.approx((1.95, 2.45))
    np.testing.assert_allclose(drawn(fig)["up:left"], expected(ds, 0))


def test_plot_bifurcation__two_parameters_are_refused():
    ds = xr.concat([make_cube(), make_cube()], xr.DataArray([1.0, 1.5], dims="q", name="q"))
    with pytest.raises(ValueError, match=r"frequency.*such as --at q=1"):
        plot_bifurcation(ds.transpose("branch", "frequency", "q", ...))
    plot_bifurcation(ds.sel(q=1.5))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": "psi"}, r"unknown state 'psi'\. Did you mean 'psi2'\? Allowed: psi1, psi2, psi1_dot"),
        ({"state": "energy"}, r"unknown state 'energy'\. Allowed: psi1"),
        (
            {"layout": "overlap"},
            r"unknown layout 'overlap'\. Did you mean 'overlay'\? Allowed: overlay, side",
        ),
    ],
)
def test_plot_bifurcation__unknown_names(options, message):
    with pytest.raises(ValueError, match=message):
        plot_bifurcation(make_cube(), **options)


def test_plot_bifurcation__side_by_side_needs_both_directions():
    with pytest.raises(ValueError, match="this cube has up only; use layout 'overlay'"):
        plot_bifurcation(make_cube().isel(branch=[0, 1]), layout="side")


@pytest.mark.parametrize("chunks", [{"branch": 1}, {"branch": 3, "frequency": 2}])
@pytest.mark.parametrize("block_values", [1, 50, 10**6])
def test_plot_bifurcation__blocks_do_not_matter(chunks, block_values, monkeypatch):
    ds = set_status(make_cube(), 3, 1, DIVERGED)
    want = drawn(plot_bifurcation(ds))
    monkeypatch.setattr(points, "BLOCK_VALUES", block_values)
    found = drawn(plot_bifurcation(ds.chunk(chunks)))
    assert sorted(found) == sorted(want)
    for kind in want:
        np.testing.assert_array_equal(found[kind], want[kind])


def test_plot_bifurcation__blocks_are_bounded_and_tile_the_cube(monkeypatch):
    monkeypatch.setattr(points, "BLOCK_VALUES", 60)
    section = make_cube(7).chunk(branch=2)["section"]
    seen = np.zeros((4, 7), int)
    for selection in points.selections(section):
        part = section.isel(selection)
        assert part.size <= 60
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


def test_plot_bifurcation__image_has_the_same_points(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = set_status(make_cube(), 1, 2, PENDING)
    fig = plot_bifurcation(ds, layout="side")
    assert not drawn(fig)
    for axes, branch, colour in [(0, 0, style.BLUE), (0, 1, style.VERMILLION), (2, 2, style.GREEN)]:
        for x, y in expected(ds, branch):
            assert_ink(pixel(fig, x, y, axes), colour)
    inked = (image_of(fig)[0] < 255).any(-1)
    columns = np.flatnonzero(inked.any(0)) / inked.shape[1]
    assert inked.mean() < 0.01
    assert columns.min() > 0.09
    np.testing.assert_array_equal(pixel(fig, 2.2, 0.12), 1.0)
    assert (pixel(fig, 2.1, 0.11) < 1).any()


def test_plot_bifurcation__image_shows_up_over_down(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = make_cube().isel(branch=[0, 0], period_index=[0])
    ds["direction"] = ("branch", ["up", "down"])
    ds["section"][1, 3, :, :2] -= 0.02
    fig = plot_bifurcation(ds)
    tint = style.tinted(style.BLUE, pixels.TINT)
    np.testing.assert_allclose(pixel(fig, 2.1, -0.11), to_rgb(style.BLUE), atol=0.01)
    np.testing.assert_allclose(pixel(fig, 2.3, -0.13), to_rgb(style.BLUE), atol=0.01)
    np.testing.assert_allclose(pixel(fig, 2.3, -0.15), tint, atol=0.01)


def test_plot_bifurcation__fuller_pixels_are_darker(monkeypatch):
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    ds = make_cube(n_keep=40).isel(branch=[1])
    ds["section"][:, :, :30, :2] = 0.2
    ds["section"][:, :, 30:, :2] = 0.1 + 0.05 * (np.arange(10) % 2)[:, None]
    fig = plot_bifurcation(ds)
    full, single = pixel(fig, 2.1, 0.2), pixel(fig, 2.1, 0.15)
    np.testing.assert_allclose(full, to_rgb(style.VERMILLION), atol=0.01)
    assert single[2] > full[2] + 0.1
    assert_ink(single, style.VERMILLION)


def test_plots__integrate_nothing_and_import_no_kernel(monkeypatch):
    import magpend_core

    def refuse(*args, **options):
        raise AssertionError("the kernel was called")

    for name in ("run_branches", "sections", "trajectory"):
        if hasattr(magpend_core, name):
            monkeypatch.setattr(magpend_core, name, refuse)
    plot_bifurcation(make_cube())
    plot_trajectory(make_trajectory())


def test_plots__import_neither_kernels_nor_executor():
    import subprocess

    code = (
        "import sys, pipeline.plots; "
        "print([m for m in ('numba', 'zarr', 'dask', 'distributed', 'matplotlib.pyplot', "
        "'pipeline.compute.execute', 'pipeline.store.run') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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
        attrs={"parameters": PARAMETERS},
    ).assign_coords(direction=("branch", ["up", "down"] * (n_branches // 2)))
    tracemalloc.start()
    fig = plot_bifurcation(ds)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert image_of(fig)[0].ndim == 3
    # 64 MB of sections; blocks of 32 MB with their labels, then counts and picture of 13 and 40 MB
    assert peak < 300e6


def test_plot_bifurcation__same_in_threads():
    ds = make_cube()
    results = [None] * 4

    def work(i):
        results[i] = drawn(plot_bifurcation(ds))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for found in results:
        assert sorted(found) == sorted(KINDS)


# ---------------------------------------------------------------- trajectories


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
    ds = set_status(make_cube(), 0, 0, PENDING)
    first = save_figure(plot_bifurcation(ds), tmp_path / f"a{suffix}")
    monkeypatch.setattr("time.time", lambda: 2e9)
    second = save_figure(plot_bifurcation(ds), str(tmp_path / f"b{suffix.upper()}"))
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
    data = save_figure(plot_bifurcation(make_cube()), tmp_path / "a.png").read_bytes()
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
