"""Escapes and densities of noisy cells that are drawn by hand: tables, exits, paths, moments and refusals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.noise.declaration import DensityOptions, EscapeOptions
from pipeline.analysis.noise.density import _edges, density, density_table, find_density_peaks
from pipeline.analysis.noise.escapes import (
    _fill_paths,
    escapes,
    escapes_table,
    finish_escapes,
    mean_and_spread,
    needs_set,
    rate_interval,
    strength_dim,
)
from pipeline.analysis.noise.exits import cells_at_points, region_of
from pipeline.layout.vocabulary import model_attribute
from tests.core.flows import model_of

WELLS = model_of(
    {"x": "v", "v": "x - x**3 - 0.1*v + 0*t"},
    {"A": 0.1},
    classifier={"meaning": "well", "words": {"left": "x < -0.5", "right": "x > 0.5"}},
)
LONG = 40
"""Sections of a cell."""


def cube_of(x: np.ndarray, *, strengths: list[float] | None = None, status: np.ndarray | None = None) -> xr.Dataset:
    """Return a cube of cells (strength, cell, section) of the two wells, at 2 Hz."""
    strengths = [0.1 * (k + 1) for k in range(len(x))] if strengths is None else strengths
    over = ("noise_v", "realization")
    section = np.stack([x, np.zeros_like(x)], axis=-1)
    codes = np.full(x.shape[:2], int(Status.BOUNDED), np.int8) if status is None else status
    return xr.Dataset(
        {
            "section": ((*over, "period_index", "state"), section),
            "status": (over, codes),
            "n_periods": (over, np.full(x.shape[:2], x.shape[2])),
        },
        coords={"noise_v": strengths, "frequency": 2.0, "state": ["x", "v"]},
        attrs={"model": model_attribute(WELLS), "parameters": "A = 0.1"},
    )


def run_of(cube: xr.Dataset, model=WELLS, n_keep: int = LONG) -> SimpleNamespace:
    """Return as much of a run as escapes by sections and densities ask for."""
    spec = SimpleNamespace(integration=SimpleNamespace(n_transient=0, n_keep=n_keep))
    return SimpleNamespace(cube=lambda: cube, model=model, spec=spec)


def leaving(rates: list[float], n: int = 4000, seed: int = 0) -> np.ndarray:
    """Return cells that begin in the left well and leave it for good, with a probability in each period."""
    rng = np.random.default_rng(seed)
    first = np.stack([rng.geometric(rate, n) for rate in rates])
    return np.where(np.arange(LONG) < first[..., None], -1.0, 1.0)


def test_escapes__of_cells_that_leave_at_a_constant_rate() -> None:
    """In half a second 1 - exp(-k/2) of the cells leave, so k = -2 log(1 - p)."""
    p = [0.01, 0.04]
    x = leaving(p, n=1500)
    ds = escapes(run_of(cube_of(x)), EscapeOptions(confidence=0.999)).isel(set=1)
    exact = -2.0 * np.log1p(-np.array(p))
    assert (ds["rate_low"].values < exact).all()
    assert (exact < ds["rate_high"].values).all()
    # counted by hand: those that leave, and the half seconds at whose begin a cell is there
    left, stays = (x[:, :, -1] > 0.0).sum(axis=1), np.minimum((x < 0.0).sum(axis=2), LONG - 1).sum(axis=1)
    np.testing.assert_array_equal(ds["n_left"], left)
    np.testing.assert_array_equal(ds["at_risk"], stays)
    np.testing.assert_allclose(ds["rate"], -2.0 * np.log1p(-left / stays))
    assert (ds["constant_p"] > 0.01).all()
    np.testing.assert_array_equal(ds["interval"], 0.5)
    np.testing.assert_array_equal(ds["n_to"].isel(to=2), left)
    np.testing.assert_allclose(ds["exit_mean"].sel(state="x"), 1.0)


def test_escapes__a_record_that_only_begins_to_leave_is_not_constant() -> None:
    x = -np.ones((1, 200, LONG))
    x[0, :60, 30:] = 1.0  # sixty leave late, none early
    ds = escapes(run_of(cube_of(x)), EscapeOptions())
    # of the 60 * 30 + 140 * 39 intervals at risk 200 * 19 are in the first half
    assert ds["constant_p"].isel(set=1).item() == pytest.approx((3460 / 7260) ** 60)
    table = escapes_table(finish_escapes(None, ds, EscapeOptions()))
    assert any("differs from that late in it" in line for line in table.lines)


def test_escapes__sections_that_are_skipped_do_not_count() -> None:
    x = -np.ones((1, 3, LONG))
    x[0, 0, 5:] = 1.0  # has left before the tenth section
    x[0, 1, 20:] = 1.0
    ds = escapes(run_of(cube_of(x)), EscapeOptions(skip=10))
    assert ds["n_cells"].values.tolist() == [[0, 2, 1, 0]]  # the last set is between the two
    assert ds["at_risk"].values.tolist() == [[0, 10 + 29, 29, 0]]


def test_fill_paths__are_means_before_the_exit() -> None:
    """Both cells rise by 1 in each section; at the lag -j they are at their exit less j."""
    section = np.stack([np.arange(12.0), np.arange(12.0) + 2.0], axis=0)[..., None]
    tables = {name: np.full((1, 5, 1), np.nan) for name in ("path_mean", "path_std")} | {
        "path_n": np.zeros((1, 5), int)
    }
    model = SimpleNamespace(is_angle=[False])
    _fill_paths(tables, (0,), section, np.array([10, 2]), 4, model)
    # of the second cell, which left at its third section, two sections before it are not in the record
    assert tables["path_n"][0].tolist() == [1, 1, 2, 2, 2]
    np.testing.assert_allclose(tables["path_mean"][0, :, 0], [6.0, 7.0, 5.0, 6.0, 7.0])
    np.testing.assert_allclose(tables["path_std"][0, :, 0], [0.0, 0.0, 3.0, 3.0, 3.0])


def test_finish_escapes__fits_kramers_law_over_strengths() -> None:
    """Of rates k exp(-b/s^2): the slope b, which is twice the barrier, and log k."""
    strengths, b, k = [0.0, 0.3, 0.35, 0.4, 0.45], 0.4, 1.5
    rates = [k * np.exp(-b / s**2) if s else 0.0 for s in strengths]
    x = leaving([-np.expm1(-r / 2.0) or 1e-300 for r in rates], n=6000)
    x[0] = -1.0
    run = run_of(cube_of(x, strengths=strengths))
    ds = finish_escapes(run, escapes(run, EscapeOptions()), EscapeOptions())
    assert ds["set"].values.tolist() == [1]  # no cell begins on the right
    one = ds.isel(set=0)
    assert float(one["barrier_low"]) < b < float(one["barrier_high"])
    assert float(one["log_factor"]) == pytest.approx(np.log(k), abs=0.3)
    assert int(one["n_fitted"]) == 4
    assert float(one["misfit_p"]) > 0.01


def test_strength_dim__is_the_one_axis_of_a_strength() -> None:
    assert strength_dim(["frequency", "noise_v"]) == "noise_v"
    assert strength_dim(["noise_x", "noise_v"]) is None
    assert strength_dim(["frequency"]) is None


def test_rate_interval__of_none_and_of_all() -> None:
    """Without an event the upper end is that of Poisson's law, -log(tail); it is infinite if no interval is without."""
    rate, low, high = rate_interval(np.array([0, 5]), np.array([10**7, 5]), np.array(0.5), 0.9)
    assert high[0] == pytest.approx(-np.log(0.05) / 10**7 / 0.5, rel=1e-6)
    assert rate[1] == high[1] == np.inf
    assert 0.0 < low[1] < np.inf


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"low": {"y": 0.0}}, "low: 'y' is not a state; states: x, v"),
        ({"low": {"x": 0.0}, "radius": 1.0}, "keep one"),
        ({"centre": {"x": 0.0}}, "centre is given without radius"),
        ({"low": {"x": 1.0}, "high": {"x": 1.0}}, "the box is empty"),
        ({"skip": LONG - 1}, f"leaves less than two of {LONG} sections"),
    ],
)
def test_needs_set__refuses(options, words) -> None:
    run = run_of(cube_of(-np.ones((1, 2, LONG))))
    needs_set(run, EscapeOptions())
    with pytest.raises(ValueError, match=words):
        needs_set(run, EscapeOptions(**options))


def test_needs_set__without_classifier_a_region_must_be_given() -> None:
    run = run_of(cube_of(-np.ones((1, 2, LONG))), model_of({"x": "-x"}))
    with pytest.raises(ValueError, match="has no classifier of motions"):
        needs_set(run, EscapeOptions())
    needs_set(run, EscapeOptions(radius=1.0))


def test_region_of__a_ball_counts_the_named_states_alone() -> None:
    model = model_of({"x": "v", "v": "-x"}, states={"v": {"scale": 10.0}})
    first = np.zeros((3, 2))
    region = region_of(model, EscapeOptions(radius=0.5, centre={"v": 20.0}), first)
    states = np.array([[99.0, 24.0], [0.0, 26.0], [0.0, 15.5]])
    assert region.contains(states, model.is_angle).tolist() == [True, False, True]


def test_cells_at_points__in_the_order_of_the_axes() -> None:
    x = np.arange(2 * 3 * LONG, dtype=float).reshape(2, 3, LONG)
    points = list(cells_at_points(cube_of(x).transpose("realization", "state", "noise_v", "period_index")))
    assert [p.values for p in points] == [{"noise_v": 0.1}, {"noise_v": 0.2}]
    np.testing.assert_array_equal(points[1].section[..., 0], x[1])


def test_mean_and_spread__of_angles_do_not_depend_on_the_cut() -> None:
    rng = np.random.default_rng(0)
    angle = 0.2 * rng.normal(size=(2000, 1))
    for turned in (0.0, 2.0, np.pi):
        shifted = (angle + turned + np.pi) % (2.0 * np.pi) - np.pi
        mean, spread = mean_and_spread(shifted, np.array([True]))
        assert np.angle(np.exp(1j * (mean[0] - turned))) == pytest.approx(0.0, abs=0.01)
        assert spread[0] == pytest.approx(0.2, rel=0.05)


def test_density__moments_of_known_laws() -> None:
    """A normal law has the excess kurtosis 0 and no skewness; an exponential one 6 and 2."""
    rng = np.random.default_rng(2)
    x = np.stack([rng.normal(1.0, 0.5, (400, LONG)), rng.exponential(1.0, (400, LONG))])
    ds = density(run_of(cube_of(x)), DensityOptions(bins=100))
    np.testing.assert_allclose(ds["variance"], [0.25, 1.0], rtol=0.05)
    np.testing.assert_allclose(ds["skewness"], [0.0, 2.0], atol=0.2)
    np.testing.assert_allclose(ds["kurtosis"], [0.0, 6.0], atol=1.2)
    np.testing.assert_allclose(ds["mean"].sel(state="x"), [1.0, 1.0], atol=0.03)
    np.testing.assert_allclose(ds["n_effective"], 400 * LONG, rtol=0.1)
    width = float(ds["value"][1] - ds["value"][0])
    np.testing.assert_allclose(ds["density"].sum("value") * width, 1.0, rtol=1e-12)
    assert ds["n_peaks"].values.tolist() == [1, 1]
    assert float(ds["peak"][0, 0]) == pytest.approx(1.0, abs=0.1)
    assert [row["n_points"] for row in density_table(ds).rows] == [400 * LONG] * 2


def test_density__leaves_out_what_diverged_and_what_is_skipped() -> None:
    x = np.zeros((1, 4, LONG))
    x[0, 0] = 50.0
    x[0, :, 0] = -9.0
    status = np.array([[Status.DIVERGED, *[Status.BOUNDED] * 3]], np.int8)
    run = run_of(cube_of(x, status=status))
    ds = density(run, DensityOptions(skip=1))
    assert ds["n_points"].item() == 3 * (LONG - 1)
    assert ds["mean"].sel(state="x").item() == 0.0
    assert float(ds["value"].max()) < 1.0
    with pytest.raises(ValueError, match=f"skip = {LONG} leaves none"):
        density(run, DensityOptions(skip=LONG))
    with pytest.raises(ValueError, match="state 'y' is not one of x, v"):
        density(run, DensityOptions(state="y"))


def test_edges__of_an_angle_are_those_of_the_circle() -> None:
    cube = cube_of(np.zeros((1, 2, LONG)))
    np.testing.assert_allclose(_edges(cube, DensityOptions(bins=10), 0, True)[[0, -1]], [-np.pi, np.pi])
    gone = cube_of(np.zeros((1, 2, LONG)), status=np.full((1, 2), Status.DIVERGED, np.int8))
    with pytest.raises(ValueError, match="no cell has section points"):
        _edges(gone, DensityOptions(), 0, False)


def test_find_density_peaks__prominence_decides_on_shoulders() -> None:
    """Two normal bumps of heights 1 and .3 with a valley of .2 between: the lower stands .1 above it."""
    density_ = np.interp(np.arange(300), [0, 60, 140, 200, 299], [0.0, 1.0, 0.2, 0.3, 0.0])
    for prominence, n in ((0.05, 2), (0.15, 1)):
        _, bins = find_density_peaks(density_, 1.0, 1.0, prominence, False)
        assert len(bins) == n
        assert abs(bins[0] - 60) <= 2
