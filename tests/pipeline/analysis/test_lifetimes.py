"""Lifetimes of bounded sets: a repeller with a known escape rate, the pendulum, intervals that cover."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.stats import chi2

from magpend_core import load_preset, sections
from pipeline.analysis.attractors.attractors import identify, match
from pipeline.analysis.attractors.following import LEG, ON_SET, follow
from pipeline.analysis.attractors.lifetimes import lifetime_interval, lifetimes
from pipeline.analysis.attractors.orbits import Orbit
from pipeline.analysis.sets import Geometry

ORBITS = json.loads((Path(__file__).parents[2] / "core" / "data" / "orbits.json").read_text("utf-8"))
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]


# ---- intervals ---------------------------------------------------------------------------------


def test_lifetime_interval__published_poisson_limits():
    """Garwood's 95 % limits of a Poisson mean: 1 seen, 0.0253 to 5.572; 10 seen, 4.795 to 18.39."""
    assert lifetime_interval(1, 100.0) == pytest.approx((100 / 5.572, 100 / 0.02532), rel=1e-3)
    assert lifetime_interval(10, 100.0) == pytest.approx((100 / 18.390, 100 / 4.795), rel=1e-3)
    low, high = lifetime_interval(0, 100.0)
    assert low == pytest.approx(100 / 2.9957, rel=1e-4)  # the rule of three
    assert high == np.inf
    with pytest.raises(ValueError, match="confidence"):
        lifetime_interval(1, 1.0, 1.0)


@pytest.mark.parametrize("lifetime", [0.2, 1.0, 4.0, 20.0, 200.0])
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_lifetime_interval__covers(lifetime, confidence):
    """Exponential lifetimes of 24 cells, looked at for a unit of time."""
    n = 4000
    lived = np.random.default_rng(7).exponential(lifetime, (n, 24))
    left, at_risk = (lived < 1.0).sum(axis=1), np.minimum(lived, 1.0).sum(axis=1)
    bounds = np.array([lifetime_interval(int(r), 1.0, confidence) for r in range(25)])[left]
    covered = (bounds[:, 0] * at_risk <= lifetime) & (lifetime <= bounds[:, 1] * at_risk)
    assert covered.mean() >= confidence - 3.0 * np.sqrt(confidence * (1.0 - confidence) / n)
    # and it is no wider than counts allow: none of many escapes seen is impossible
    if lifetime < 2.0:
        assert covered.mean() <= confidence + 0.04


# ---- a map whose repeller loses a known share at every step ---------------------------------------

SLOPE = 2.05
LINE = Geometry((False,), (1.0 / 0.3,))
"""Scaled so that what counts as near the fixed point at 2 is all beyond 1: the image of the hole."""


def tent(x):
    """Expand by `SLOPE` on [0, 1]; what leaves through the top is drawn to 2."""
    return np.where(x <= 1.0, SLOPE * np.minimum(x, 1.0 - x), 2.0 + 0.5 * (x - 2.0))


def test_follow__escape_rate_of_the_tent_map():
    """Of a uniform density 2/slope stays at every step, and stays uniform: mean lifetime s/(s - 2) = 41."""
    n, n_legs = 600, 8
    x = np.random.default_rng(3).uniform(0, 1, n)
    state = x.copy()

    def advance(rows):
        section = np.empty((len(rows), LEG, 1))
        for i in range(LEG):
            state[rows] = tent(state[rows])
            section[:, i, 0] = state[rows]
        return section, np.full(len(rows), 2), np.zeros(len(rows), int)

    def polish(owner, points, period):
        return [None] * len(owner)

    fixed = Orbit(np.array([[2.0]]), np.array([0.5 + 0j]), 1e-12, np.array([[0.5]]))
    ends = follow(x[:, None], np.zeros(n, int), [[fixed]], advance, polish, n_legs, 4, LINE)
    left = (ends.orbit == 0) & ~ends.is_leaving
    # each cell's own time, by iteration
    time, y = np.full(n, n_legs * LEG), x.copy()
    for i in range(n_legs * LEG):
        y = tent(y)
        time = np.where((y > 1.0) & (time == n_legs * LEG), i + 1, time)
    assert np.array_equal(ends.periods[left], time[left])
    assert left.mean() > 0.99
    assert (time[~left] > (n_legs - 1) * LEG).all()  # left too late to be told
    truth = SLOPE / (SLOPE - 2.0)
    low, high = lifetime_interval(int(left.sum()), float(ends.periods.sum()))
    assert low < truth < high
    assert high / low < 1.2


def test_follow__a_set_that_keeps_its_cells():
    """At slope 2 less a little the same map has a chaotic attractor, and nothing leaves."""
    state = np.random.default_rng(4).uniform(0.2, 0.8, 50)

    def advance(rows):
        section = np.empty((len(rows), LEG, 1))
        for i in range(LEG):
            state[rows] = 1.9 * np.minimum(state[rows], 1.0 - state[rows])
            section[:, i, 0] = state[rows]
        return section, np.full(len(rows), 2), np.zeros(len(rows), int)

    fixed = Orbit(np.array([[2.0]]), np.array([0.5 + 0j]), 1e-12, np.array([[0.5]]))
    ends = follow(state[:, None].copy(), np.zeros(50, int), [[fixed]], advance, lambda *a: [None] * len(a[0]),
                  3, 4, LINE)  # fmt: skip
    assert (ends.orbit == ON_SET).all()
    assert (ends.periods == 3 * LEG).all()


# ---- the pendulum ------------------------------------------------------------------------------


def cube(frequency, n_transient, n=36, n_keep=16):
    starts = np.zeros((n, 4))
    starts[:, :2] = np.random.default_rng(22).uniform(-1, 1, (n, 2))
    result = sections(load_preset(), frequency, starts, n_transient=n_transient, n_keep=n_keep)
    own = {"section": ("period_index", "state"), "turns": ("link",), "status": (), "orbit_period": ()}
    data = {name: (("initial_condition", *dims), getattr(result, name)) for name, dims in own.items()}
    return xr.Dataset(data, {"state": STATES, "link": STATES[:2], "frequency": frequency})


@pytest.fixture(scope="module")
def short():
    """At 2.2 Hz every motion ends on an orbit; after 20 periods few are there."""
    ds = cube(2.2, 20)
    found = identify(ds, parameters=load_preset())
    return ds, found, lifetimes(ds, found, parameters=load_preset(), n_sample=8)


def test_lifetimes__short_run_at_2p2_hz_is_all_transient(short):
    _, found, stay = short
    sets = found["kind"].values == 2
    assert sets.any()
    assert (stay["verdict"].values == np.where(sets, 2, 0)).all()
    assert stay["n_sampled"].values[sets].tolist() == np.minimum(found["n_cells"].values[sets], 8).tolist()
    assert not stay["n_sampled"].values[~sets].any()
    ended = stay["sample_destination"].values[sets]
    assert (stay["n_to"].values[sets].sum(axis=1) == (ended >= 0).sum(axis=1)).all()
    # nearly all reach an orbit, among them the two of period 1
    assert stay["n_to"].values.sum() > 0.8 * stay["n_sampled"].values.sum()
    n = found.sizes["attractor"]
    points = np.concatenate([found["attractor_points"].values[:, 0], stay["new_orbit_points"].values])
    reached = points[stay["n_to"].values.sum(axis=0) > 0]
    for orbit in ORBITS[:2]:
        assert np.abs(reached - orbit["section"]).max(axis=1).min() < 1e-8
    assert stay.sizes["destination"] == n + stay.sizes["new_orbit"]
    assert (stay["new_orbit_multiplier"].values < 1).all()


def test_lifetimes__a_sampled_cell_goes_where_it_is_said_to_go(short):
    ds, found, stay = short
    n = found.sizes["attractor"]
    row, column = np.argwhere((stay["sample_destination"].values >= 0) & (stay["sample_periods"].values > 0))[
        0
    ]
    cell = int(stay["sample_cell"][row, column])
    assert found["attractor_id"].values[cell] == row
    destination = int(stay["sample_destination"][row, column])
    if destination < n:
        point = found["attractor_points"].values[destination, 0]
        period = int(found["orbit_period"][destination])
    else:
        point = stay["new_orbit_points"].values[destination - n]
        period = int(stay["new_orbit_period"][destination - n])
    on = sections(load_preset(), 2.2, ds["section"].values[cell, -1:], n_transient=1500, n_keep=period)
    assert np.abs(on.section[0] - point).max(axis=1).min() < 1e-4  # slow spirals


def test_lifetimes__numbers_agree(short):
    stay = short[2]
    rows = stay["n_left"].values > 0
    assert rows.any()
    at_risk, left = stay["time_at_risk"].values[rows], stay["n_left"].values[rows]
    assert stay["mean_lifetime"].values[rows] == pytest.approx(at_risk / left)
    assert np.nansum(stay["sample_periods"].values, axis=1)[rows] == pytest.approx(at_risk)
    assert stay["lifetime_low"].values[rows] == pytest.approx(2 * at_risk / chi2.ppf(0.975, 2 * left + 2))
    assert stay["lifetime_high"].values[rows] == pytest.approx(2 * at_risk / chi2.ppf(0.025, 2 * left))


def test_lifetimes__order_and_blocks_of_cells_do_not_matter(short):
    ds, found, _ = short
    order = np.random.default_rng(2).permutation(36)
    few = {"parameters": load_preset(), "n_sample": 3, "n_periods": 256}
    stay = lifetimes(ds, found, **few)
    moved = lifetimes(ds.isel(initial_condition=order), found.isel(initial_condition=order), **few)
    blocks = lifetimes(ds, match(found), block_bytes=3000, **few)
    for name in set(stay.data_vars) - {"sample_cell"}:
        is_float = stay[name].dtype.kind == "f"
        assert np.array_equal(moved[name].values, stay[name].values, equal_nan=is_float), name
        assert np.array_equal(blocks[name].values, stay[name].values, equal_nan=is_float), name
    cells = stay["sample_cell"].values
    assert np.array_equal(order[moved["sample_cell"].values][cells >= 0], cells[cells >= 0])


def test_lifetimes__chaos_at_2p4_hz_stays():
    """The paper sees chaos near 2.4 Hz; no sampled cell leaves it."""
    ds = cube(2.4, 200, n=24)
    found = identify(ds, parameters=load_preset())
    stay = lifetimes(ds, found, parameters=load_preset(), n_sample=8, n_periods=256)
    rows = np.flatnonzero(found["n_cells"].values * (found["kind"].values == 2) >= 8)
    assert len(rows)
    for row in rows:
        assert stay["verdict"][row] == 1
        assert stay["lifetime_low"][row] == pytest.approx(8 * 256 / 2.9957, rel=1e-4)
        assert stay["lifetime_high"][row] == np.inf
        assert np.isnan(stay["mean_lifetime"][row])


def test_lifetimes__bad_input(short):
    ds, found, _ = short
    with pytest.raises(ValueError, match="n_sample"):
        lifetimes(ds, found, n_sample=0)
    with pytest.raises(ValueError, match="confidence"):
        lifetimes(ds, found, confidence=0.0)
    with pytest.raises(ValueError, match="other cells"):
        lifetimes(ds.isel(initial_condition=slice(3)), found)
    with pytest.raises(ValueError, match="attribute 'parameters'"):
        lifetimes(ds, found)
