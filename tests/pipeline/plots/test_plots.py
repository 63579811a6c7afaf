"""Bifurcation diagrams: the points, classes and absent cells in their data are those of the cube."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import xarray as xr

from magpend_core.status import Status
from pipeline.plots import pixels, plot_bifurcation, points
from tests.pipeline.plots.made_up import PENDULUM, STATES, legend_texts


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
            "status": (("branch", "frequency"), np.full((4, n_frequencies), Status.PERIODIC, np.int8)),
            "turns": (("branch", "frequency", "link"), turns),
        },
        coords={
            "frequency": ("frequency", frequency, {"units": "Hz"}),
            "state": STATES,
            "direction": ("branch", ["up", "up", "down", "down"]),
        },
        attrs=PENDULUM,
    )


KINDS = [(0, 1), (0, 2), (1, 3), (1, 4)]
"""Codes of direction and motion of the branches."""


def set_status(ds, branch, position, status):
    """Give a cell a status, and NaN sections as the store does."""
    ds = ds.copy(deep=True)
    ds["status"][branch, position] = status
    ds["section"][branch, position] = np.nan
    return ds


def drawn(fig):
    """Points by direction and motion: arrays of (frequency, value), sorted."""
    found = {}
    for *kind, x, y in zip(
        *(fig.data[name].values.tolist() for name in ("direction", "motion", "x", "y")), strict=True
    ):
        found.setdefault(tuple(kind), []).append((x, y))
    return {kind: np.array(sorted(pairs)) for kind, pairs in found.items()}


def expected(ds, branch, state=0):
    values = ds["section"].values[branch, :, :, state]
    pairs = [[f, v] for f, row in zip(ds["frequency"].values, values, strict=True) for v in row]
    return np.array(sorted(pair for pair in pairs if np.isfinite(pair[1])))


def test_status__each_code_is_drawn_or_absent():
    absent = [code for codes in points.ABSENT.values() for code in codes]
    assert {Status.PERIODIC, Status.BOUNDED, Status.INFERRED} == set(points.DRAWN)
    assert sorted([*points.DRAWN, *absent]) == sorted(Status)


@pytest.mark.slow
def test_plot_bifurcation__each_class_has_its_points():
    ds = make_cube()
    fig = plot_bifurcation(ds)
    found = drawn(fig)
    assert sorted(found) == KINDS
    for branch, kind in enumerate(KINDS):
        np.testing.assert_allclose(found[kind], expected(ds, branch))
    assert legend_texts(fig) == ["left", "right", "straddling", "rotating", "up", "down"]
    assert not [name for name in fig.data if name.startswith("absent")]
    side = plot_bifurcation(ds, layout="side")
    assert side.data.equals(fig.data)
    assert len(side.axes) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("state", "unit"), [("psi2", "deg"), ("psi1_dot", "deg/s")])
def test_plot_bifurcation__state_and_degrees(state, unit):
    ds = make_cube()
    want = expected(ds, 1, STATES.index(state))
    radians, degrees = plot_bifurcation(ds, state=state), plot_bifurcation(ds, state=state, degrees=True)
    np.testing.assert_allclose(drawn(radians)[0, 2], want)
    np.testing.assert_allclose(drawn(degrees)[0, 2], want * [1.0, 180.0 / np.pi])
    assert degrees.data["y"].attrs["units"] == unit
    assert degrees.axes[0].get_ylabel().endswith(f"[{unit}]")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("status", "name"),
    [
        (Status.PENDING, "pending"),
        (Status.DIVERGED, "diverged"),
        (Status.STEP_LIMIT, "failed"),
        (Status.STEP_UNDERFLOW, "failed"),
        (Status.UNREACHED, "not reached"),
    ],
)
def test_plot_bifurcation__absent_cells_are_counted_and_not_drawn(status, name):
    ds = set_status(make_cube(), 3, 2, status)
    ds["section"][3, 2] = 2.5  # left from before
    fig = plot_bifurcation(ds)
    np.testing.assert_allclose(drawn(fig)[1, 4], expected(set_status(ds, 3, 2, status), 3))
    assert fig.data[f"absent_{name.replace(' ', '_')}"].values.tolist() == [[0] * 5, [0, 0, 1, 0, 0]]
    assert f"{name}: 1 of 20 cells" in legend_texts(fig)


@pytest.mark.slow
def test_plot_bifurcation__says_why_it_is_empty():
    ds = make_cube()
    ds["status"][:] = Status.PENDING
    texts = [t.get_text() for t in plot_bifurcation(ds).axes[0].texts]
    assert texts == ["nothing to draw yet: all 20 cells are pending"]
    ds["status"][0] = Status.DIVERGED
    (text, *_) = plot_bifurcation(ds, layout="side").axes[0].texts
    assert text.get_text() == "nothing to draw: of 20 cells, 15 pending, 5 diverged"


def test_plot_bifurcation__sweep_pools_initial_conditions():
    ds = make_cube().drop_vars("direction").rename(branch="initial_condition")
    found = plot_bifurcation(ds).data
    left = np.sort(found["y"].values[found["motion"].values == 1])
    np.testing.assert_allclose(left, np.sort(expected(ds, 0)[:, 1]))
    grid = ds.isel(initial_condition=[0, 1]).rename(initial_condition="psi1_0")
    grid = xr.concat([grid, grid], "psi2_0").transpose("frequency", "psi1_0", "psi2_0", ...)
    assert set(plot_bifurcation(grid).data["motion"].values.tolist()) == {1, 2}


def test_plot_bifurcation__other_and_falling_parameter():
    ds = make_cube().rename(frequency="q").assign_attrs(frequency_hz=2.2).isel(q=slice(None, None, -1))
    ds["q"].attrs = {"long_name": "drive amplitude", "units": "N m"}
    fig = plot_bifurcation(ds)
    assert fig.axes[0].get_xlabel() == "drive amplitude [N m]"
    assert fig.axes[0].get_xlim() == pytest.approx((1.95, 2.45))
    np.testing.assert_allclose(drawn(fig)[0, 1], expected(ds.rename(q="frequency"), 0))


def test_plot_bifurcation__refusals():
    for options, message in (
        ({"state": "psi"}, r"unknown state 'psi'\. Did you mean 'psi2'\? Allowed: psi1, psi2, psi1_dot"),
        ({"layout": "overlap"}, "unknown layout 'overlap'"),
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
    ds = set_status(make_cube(), 3, 1, Status.DIVERGED)
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
    found = sorted(zip(where.round(6).tolist(), height.round(6).tolist(), strict=True))
    assert found == [(0, 0.5), (0, 0.6), (1, -0.5), (1, 0.5)]
    positions, values = np.meshgrid(np.arange(10), np.linspace(-1.0, 1.0, 2000))
    assert len(pixels.distinct(positions.ravel(), values.ravel(), (0.0, 9.0), (-1.0, 1.0))[0]) == 20_000


@pytest.mark.slow
def test_plot_bifurcation__pixels_count_the_same_points(monkeypatch):
    """An image of many points: each point lies in a pixel of its class, which is inked where the axes say."""
    ds = set_status(make_cube(), 1, 2, Status.PENDING)
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    fig = plot_bifurcation(ds)
    assert int(fig.data["count"].sum()) == 57
    found = drawn(fig)
    (image,) = fig.axes[0].get_images()
    picture, (left, right, low, high) = np.asarray(image.get_array()), image.get_extent()
    rows, columns, _ = picture.shape
    pixel = 2.0 * np.array([(right - left) / columns, (high - low) / rows])
    for branch, kind in enumerate(KINDS):
        for x, y in expected(ds, branch):
            assert (np.abs(found[kind] - [x, y]) <= pixel).all(axis=1).any()
            row, column = int((y - low) / (high - low) * rows), int((x - left) / (right - left) * columns)
            assert (picture[row, column] < 255).any()
    assert (picture < 255).any(-1).mean() < 0.01


@pytest.mark.slow
def test_plot_bifurcation__many_points_in_little_memory():
    n_branches, n_frequencies, n_keep = 40, 1000, 50
    rng = np.random.default_rng(5)
    section = rng.normal(0.0, 0.2, (1, n_frequencies, n_keep, 4)).astype(np.float64)
    section = np.broadcast_to(section, (n_branches, n_frequencies, n_keep, 4))
    ds = xr.Dataset(
        {
            "section": (("branch", "frequency", "period_index", "state"), section),
            "status": (("branch", "frequency"), np.full((n_branches, n_frequencies), Status.BOUNDED, np.int8)),
        },
        coords={"frequency": np.linspace(2, 3, n_frequencies), "state": STATES},
        attrs=PENDULUM,
    ).assign_coords(direction=("branch", ["up", "down"] * (n_branches // 2)))
    tracemalloc.start()
    fig = plot_bifurcation(ds)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert int(fig.data["count"].sum()) == section[..., 0].size
    # 64 MB of sections; blocks of 32 MB with their labels, then counts and picture of 13 and 40 MB
    assert peak < 300e6
