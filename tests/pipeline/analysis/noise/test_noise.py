"""Rates, exits and peaks on cells and densities that are known on paper."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_model
from magpend_core.status import Status
from pipeline.analysis.noise.declaration import EscapeOptions
from pipeline.analysis.noise.density import effective_number, find_density_peaks, silverman_bandwidth
from pipeline.analysis.noise.escapes import NO_FIT, constancy, fit_kramers, mean_and_spread, rate_interval
from pipeline.analysis.noise.exits import NOT_LEFT, PointCells, find_exits, labels_of, region_of
from pipeline.layout.vocabulary import model_attribute
from tests.core.flows import table


def cells_of(section: np.ndarray, status: list[int] | None = None, n_periods: list[int] | None = None) -> PointCells:
    n = len(section)
    codes = np.array([int(Status.BOUNDED)] * n if status is None else status)
    periods = np.array([section.shape[1]] * n if n_periods is None else n_periods)
    return PointCells({}, {}, section, codes, periods)


def test_find_exits__on_paper() -> None:
    codes = np.array(
        [
            [0, 0, 1, 0, 1],  # leaves at 2
            [0, 0, 0, 0, 0],  # stays
            [1, 0, 0, 0, 0],  # begins in the other set, and leaves that at 1
            [0, -1, -1, 1, 1],  # undecided on the way
            [-1, 0, 0, 1, 1],  # undecided at the begin: not counted
        ]
    )
    found = find_exits(codes, cells_of(np.zeros((5, 5, 1))), 0, 0, 1.0)
    assert found.counted.tolist() == [True, True, True, True, False]
    assert found.first_out.tolist()[:4] == [2, NOT_LEFT, 1, 3]
    assert found.end.tolist()[:4] == [1, NOT_LEFT, 0, 1]
    assert found.at_risk.tolist() == [2, 4, 1, 3, 0]
    codes = np.array([[0, 0, 1, 1, 1], [1, 1, 1, 1, 1], [1, 1, 1, 1, 1]])
    status = [int(Status.BOUNDED), int(Status.DIVERGED), int(Status.DIVERGED)]
    # after a transient of 10 periods, one diverged in the fourth counted period, one in the transient
    cells = cells_of(np.full((3, 5, 1), np.nan), status, [15, 15, 7])
    found = find_exits(codes, cells, 1, 10, 1.0)
    assert found.counted.tolist() == [True, True, False]
    assert found.first_out.tolist()[:2] == [1, 3]
    assert found.end.tolist()[:2] == [1, NOT_LEFT]
    assert found.at_risk.tolist() == [1, 3, 0]


def test_rate_interval__covers_the_rate() -> None:
    rng, rate, period, n_periods = np.random.default_rng(3), 0.02, 2.0, 40
    times = np.ceil(rng.exponential(1.0 / rate, (2000, 60)) / period)
    left = times <= n_periods
    at_risk = np.minimum(times, n_periods)
    found, low, high = rate_interval(left.sum(axis=1), at_risk.sum(axis=1), period, 0.9)
    covered = float(((low < rate) & (rate < high)).mean())
    assert 0.9 <= covered < 0.97  # exact for Poisson's numbers, conservative for these
    assert float(found.mean()) == pytest.approx(rate, rel=0.03)
    rate, low, high = rate_interval(np.array([0, 0]), np.array([100, 0]), 1.0, 0.95)
    assert rate[0] == low[0] == 0.0
    assert high[0] == pytest.approx(-np.log(0.025) / 100, rel=0.05)
    assert np.isnan([rate[1], low[1], high[1]]).all()
    assert constancy(50, 52, 1000, 1000) > 0.1
    assert constancy(80, 20, 1000, 1000) < 1e-4
    assert np.isnan(constancy(0, 0, 10, 10))


def test_fit_kramers__finds_the_slope_of_drawn_numbers() -> None:
    rng = np.random.default_rng(5)
    strength = np.array([0.0, 0.2, 0.25, 0.3, 0.35])
    rates = 0.3 * np.exp(-0.18 / np.maximum(strength, 1e-3) ** 2)
    risked, inside, slopes = np.full(5, 40_000), 0, []
    for _ in range(200):
        events = rng.binomial(risked, 1.0 - np.exp(-rates * 0.5))
        fit = fit_kramers(strength, events, risked, 0.5, 0.95)
        inside += fit.low < 0.18 < fit.high
        slopes.append(fit.slope)
    assert fit.n_points == 4  # without noise there is no rate
    assert 180 <= inside <= 200
    assert np.mean(slopes) == pytest.approx(0.18, rel=0.01)
    # a rate that grows like another power does not fit
    bent = rng.binomial(risked, 1.0 - np.exp(-0.5 * 0.3 * np.exp(-0.01 / np.maximum(strength, 0.05) ** 4)))
    assert fit_kramers(strength, bent, risked, 0.5, 0.95).misfit < 1e-3
    few = np.array([0.1, 0.2])
    assert np.isnan(fit_kramers(few, np.array([1, 9]), np.array([100, 100]), 1.0, 0.95).slope)
    assert fit_kramers(np.array([0.1, 0.2, 0.3]), np.array([0, 0, 9]), np.full(3, 100), 1.0, 0.95) == NO_FIT


def test_effective_number__of_an_autoregression() -> None:
    rng, rho = np.random.default_rng(1), 0.8
    x = np.zeros((50, 4000))
    x[:, 0] = rng.normal(size=50) / np.sqrt(1 - rho**2)
    for k in range(1, 4000):
        x[:, k] = rho * x[:, k - 1] + rng.normal(size=50)
    # (1 - rho)/(1 + rho) of all points
    assert effective_number(x) == pytest.approx(x.size / 9.0, rel=0.1)
    assert effective_number(np.ones((3, 4))) == 12.0
    values = np.random.default_rng(2).normal(0.0, 2.0, 100_000)
    assert silverman_bandwidth(values, 1e5) == pytest.approx(0.9 * 2.0 * 0.1, rel=0.02)
    points = np.array([[np.pi - 0.1, 1.0], [-np.pi + 0.1, 3.0]])
    mean, spread = mean_and_spread(points, np.array([True, False]))
    assert abs(mean[0]) == pytest.approx(np.pi)
    np.testing.assert_allclose(spread, [0.1, 1.0])
    assert mean[1] == 2.0


@pytest.mark.parametrize("on_circle", [False, True])
def test_find_density_peaks__counts_normal_peaks(on_circle: bool) -> None:
    x = np.linspace(-np.pi, np.pi, 400, endpoint=False)

    def bumps(*places: float) -> np.ndarray:
        return sum(np.exp(-0.5 * ((x - p) / 0.25) ** 2) for p in places)

    width = float(x[1] - x[0])
    for places in ([0.0], [-1.0, 1.2], [-2.0, 0.0, 2.0]):
        smoothed, bins = find_density_peaks(bumps(*places), width, 0.05, 0.05, on_circle)
        np.testing.assert_allclose(np.sort(x[bins]), places, atol=0.05)
        assert smoothed.sum() == pytest.approx(bumps(*places).sum(), rel=1e-3)
    # a bandwidth beyond their distance makes one of two
    assert len(find_density_peaks(bumps(-0.5, 0.5), width, 1.0, 0.05, on_circle)[1]) == 1


def test_find_density_peaks__across_the_cut_of_a_circle() -> None:
    x = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    density = np.exp(4.0 * np.cos(x - np.pi))
    assert len(find_density_peaks(density, float(x[1] - x[0]), 0.1, 0.05, True)[1]) == 1
    # on a line the two halves are two peaks, at the ends
    assert len(find_density_peaks(density, float(x[1] - x[0]), 0.1, 0.05, False)[1]) == 2


TABLE = table(
    "sides",
    {"th": "v", "v": "-a*sin(th) - v + 0*t"},
    {"a": 1.0},
    states={"th": {"on_circle": True, "unit": "rad"}, "v": {"scale": 2.0}},
    classifier={"meaning": "side", "words": {"left": "th < -0.5", "right": "th > 0.5"}},
)


def test_region_of__box_and_ball() -> None:
    model = load_model(TABLE)
    states = np.array([[-1.0, 0.0], [3.1, 0.0], [-3.1, 0.0], [0.0, 3.0]])
    first = np.tile(states[0], (4, 1))

    def inside(**options: object) -> list[bool]:
        return region_of(model, EscapeOptions(**options), first).contains(states, model.is_angle).tolist()

    assert inside(low={"th": -2.0}, high={"v": 2.0}) == [True, True, False, False]
    assert inside(low={"th": -4.0}) == [True] * 4  # the whole circle
    assert inside(radius=0.2, centre={"th": 3.14}) == [False, True, True, False]  # on the circle, whatever v is
    assert inside(radius=1.9) == [True, False, False, True]  # about the first section; v counts in units of 2
    model = load_model(TABLE)
    cube = xr.Dataset(attrs={"model": model_attribute(model), "parameters": "a = 1.0"})
    section = np.array([[[-1.0, 0.0], [3.1, 0.0], [-3.1, 0.0], [0.0, 3.0]]])
    assert model.classifier is not None
    found = labels_of(model, cube)(section, {"frequency": 1.0})[0]
    assert [model.classifier.words[c] if c >= 0 else "-" for c in found] == ["left", "right", "left", "-"]
