"""Each method of a time series by itself: maps and sines whose numbers stand on paper or are counted by brute force."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from pipeline.analysis.series.analysis import (
    Result,
    _drift,
    _leaps,
    _surrogate_result,
    _unless,
    _zero_one_result,
    series_table,
)
from pipeline.analysis.series.correlation import CorrelationSettings, _below, _plateau, correlation_sums
from pipeline.analysis.series.divergence import DivergenceSettings, _range, divergence
from pipeline.analysis.series.embedding import (
    Embedding,
    Series,
    false_neighbours,
    first_minimum,
    mutual_information,
    slope,
    spread,
)
from pipeline.analysis.series.recurrence import recurrence
from pipeline.analysis.series.returns import returns_of
from pipeline.analysis.series.surrogates import closed_stretch, prediction_error, repeats_by_chance
from tests.pipeline.analysis.maps import henon

TURN = 2.0 * np.pi


def one_piece(values: np.ndarray, step: float = 1.0) -> Series:
    return Series.of([values], step)


def logistic(n: int) -> np.ndarray:
    x = np.empty(n)
    x[0] = 0.3
    for i in range(1, n):
        x[i] = 4.0 * x[i - 1] * (1.0 - x[i - 1])
    return x


def test_series__pieces_are_never_joined() -> None:
    both = Series.of([np.arange(5.0), np.arange(10.0, 17.0)], 0.5)
    assert both.starts(3).tolist() == [0, 1, 5, 6, 7, 8]
    assert both.starts(7).tolist() == []
    halved = both.averaged(2)
    assert halved.values.tolist() == [0.5, 2.5, 10.5, 12.5, 14.5]
    assert [len(p) for p in halved.pieces()] == [2, 3]
    assert halved.step == 1.0


def test_neighbours__are_those_of_brute_force() -> None:
    x = np.random.default_rng(0).normal(size=300)
    embedding = Embedding(one_piece(x), 2, 3, 5)
    first, nearest, distance = embedding.neighbours(40, 4, 2)
    starts = np.arange(300 - 4 - 4)
    vectors = np.stack([x[starts + 2 * k] for k in range(3)], axis=1)
    for i, near, apart in zip(first, nearest, distance, strict=True):
        sizes = np.linalg.norm(vectors - vectors[i], axis=1)
        sizes[np.abs(starts - i) <= 5] = np.inf
        assert sorted(near) == sorted(np.argsort(sizes)[:2])
        np.testing.assert_allclose(np.sort(apart), np.sort(sizes)[:2], rtol=1e-12)
    assert len(Embedding(one_piece(x[:20]), 2, 3, 5).neighbours(40, 4, 2)[0]) == 0


def test_mutual_information__of_the_doubling_map() -> None:
    """Of 16 equal bins each goes to two: log 16 - log 2. Pairs are pieces of two samples each, so no lag is longer."""
    x = (np.arange(4000) + 0.37) / 4000.0
    pairs = Series.of([np.array([v, 2.0 * v % 1.0]) for v in x], 1.0)
    found = mutual_information(pairs, 5)
    assert len(found) == 2
    assert found[1] == pytest.approx(np.log(8.0), rel=5e-3)


def test_mutual_information__of_independent_values_is_none() -> None:
    """The bias of 15 x 15 free counts, 225/(2 n), is taken off."""
    found = mutual_information(one_piece(np.random.default_rng(1).uniform(size=4000)), 3)
    assert np.abs(found[1:]).max() < 0.008
    assert 225.0 / 8000.0 > 0.025


@pytest.mark.parametrize(
    ("information", "lag"),
    [
        ([2.0, 1.0, 0.5, 0.7, 0.9, 1.0, 1.1], 2),
        ([2.0, 1.0, 0.5, 0.7, 0.4, 0.6, 0.8, 0.9, 1.0], 4),  # a lower one is within four lags
        ([2.0, 1.0, 0.5, 0.7, 0.9, 1.0], None),  # the end is too near
        ([2.0, 1.0, 0.01, 0.7, 0.9, 1.0, 1.1], None),  # nothing is left
        ([2.0, 1.9, 1.8, 1.7, 1.6, 1.5, 1.4, 1.3], None),  # only falls
    ],
)
def test_first_minimum__of_short_lists(information, lag) -> None:
    assert first_minimum(np.array(information)) == lag


def test_false_neighbours__of_henons_map_vanish_with_two_delays() -> None:
    """Kennel, Brown and Abarbanel (1992): the map is of second order in x."""
    shares = false_neighbours(one_piece(henon(1, 2000)[0, :, 0]), 1, 5, 500)
    assert shares[0] > 0.2
    assert shares[1] < 0.01
    assert shares[2] < 0.01
    assert np.isnan(shares[3:]).all()  # two that suffice are enough


def test_slope_and_spread__of_even_points() -> None:
    assert slope(np.arange(5.0), 3.0 - 2.0 * np.arange(5.0)) == pytest.approx(-2.0)
    assert spread(np.arange(10, 110), 4).tolist() == [10, 43, 76, 109]
    assert spread(np.arange(3), 10).tolist() == [0, 1, 2]


def test_below__counts_as_brute_force() -> None:
    apart = np.random.default_rng(0).uniform(1e-4, 1.2, 500)
    radii = 2.0 ** (-np.arange(49)[::-1] / 4.0)
    np.testing.assert_array_equal(_below(apart, 49, CorrelationSettings()), (apart[:, None] <= radii).sum(axis=0))


def test_plateau__is_the_longest_range_of_one_slope() -> None:
    """Sums of slope 1.5 between a steeper beginning and a flat end."""
    x = np.log(2.0) * np.arange(40) / 4.0
    bends = np.interp(x, [0.0, x[10], x[30], x[-1]], [0.0, 3.0 * x[10], 3.0 * x[10] + 1.5 * (x[30] - x[10]), 8.0])
    found = _plateau(x, np.stack([bends] * 3), np.arange(40), CorrelationSettings())
    assert 8 <= found[0] <= 11
    assert 29 <= found[-1] <= 33
    assert _plateau(x, np.stack([x**3] * 3), np.arange(40), CorrelationSettings()) is None


def test_correlation_sums__of_henons_map_have_its_dimension() -> None:
    """Grassberger and Procaccia (1983) give 1.21 to 1.25."""
    found = correlation_sums(Embedding(one_piece(henon(1, 3000)[0, :, 0]), 1, 2, 5), True)
    assert found.low < 1.22 < found.high
    assert found.value == pytest.approx(1.22, abs=0.15)  # of 3000 points


def test_correlation_sums__of_noise_and_of_short_series_are_not_decided() -> None:
    noise = np.random.default_rng(3).uniform(size=2500)
    assert np.isnan(correlation_sums(Embedding(one_piece(noise), 1, 2, 5), True).value)
    assert "too few vectors" in correlation_sums(Embedding(one_piece(noise[:150]), 1, 2, 5), True).reason


def test_range__of_growth_between_a_dip_and_saturation() -> None:
    time = np.linspace(0.0, 20.0, 200)
    curve = np.minimum(-6.0 + 0.4 * np.maximum(time - 2.0, 0.0), -1.5)
    start, end = _range(time, curve, 0, 1.0, -1.7, DivergenceSettings())
    assert slope(time[start : end + 1], curve[start : end + 1]) == pytest.approx(
        0.4, rel=0.15
    )  # halves may differ by .3
    assert end - start > 90
    assert _range(time, 0.01 * time, 0, 1.0, 5.0, DivergenceSettings()) is None  # grows by .2 in all


def test_divergence__neighbours_in_a_cycle_do_not_part() -> None:
    t = np.arange(3000) * TURN / 30.0
    x = np.cos(t) + 0.3 * np.cos(2.0 * t + 1.0) + 1e-6 * np.random.default_rng(0).normal(size=3000)
    found = divergence(Embedding(one_piece(x, 0.1), 6, 3, 30), 30, True)
    assert not found.grows
    assert found.reason == ""
    assert abs(found.value) < 0.02
    short = divergence(Embedding(one_piece(x[:150], 0.1), 6, 3, 30), 30, True)
    assert short.reason == "too few vectors that can be followed"


def test_returns_of__a_cycle_of_two_maxima() -> None:
    """Maxima of two heights alternate, 2 pi apart by pairs; their heights are those of the function."""
    t = np.arange(6000) * 0.02
    found = returns_of(one_piece(np.cos(t) + 0.8 * np.cos(2.0 * t), 0.02), 40)
    assert found.in_cycle == 2
    assert found.mean == pytest.approx(np.pi, rel=1e-4)
    assert found.low <= np.pi + 1e-4
    assert found.high >= np.pi - 1e-4
    # cos + .8 cos 2: 1.8 at 0, and -.2 at pi
    np.testing.assert_allclose(sorted({*np.round(found.height, 2)}), [-0.2, 1.8], atol=0.02)
    assert found.reason == ""


def test_returns_of__few_and_irregular_ones_are_no_period() -> None:
    t = np.arange(1000) * 0.1
    assert returns_of(one_piece(np.cos(0.3 * t), 0.1), 20).reason == "3 returns, fewer than 12"
    steps = np.random.default_rng(4).exponential(1.0, 400)
    course = np.interp(np.arange(0.0, 300.0, 0.1), np.cumsum(steps), np.resize([0.0, 1.0], 400))
    irregular = returns_of(one_piece(course, 0.1), 5)
    assert irregular.in_cycle == 0
    assert "times between maxima scatter" in irregular.reason


def test_recurrence__of_a_cycle_is_made_of_diagonals() -> None:
    x = np.sin(np.arange(1000) * TURN / 40.0)
    found = recurrence(Embedding(one_piece(x, 0.1), 10, 2, 40))
    assert found.measures["determinism"] > 0.99
    # vectors a period apart recur exactly, and one in twenty pairs does
    assert found.matrix[np.arange(300), np.arange(300) + 40 * (2 if found.time[1] < 0.15 else 1)].all()
    apart = np.triu_indices(len(found.matrix), 41)
    assert found.matrix[apart].mean() == pytest.approx(0.05, abs=0.01)
    assert recurrence(Embedding(one_piece(x[:100]), 10, 2, 40)) is None


def test_prediction_error__of_a_rule_and_of_chance() -> None:
    """Of independent values the mean of 4 neighbours has the error sqrt(1 + 1/4) of the standard deviation."""
    assert prediction_error(logistic(600), 1, 1, 2, 1) < 0.1
    noise = np.random.default_rng(5).normal(size=2000)
    assert prediction_error(noise, 1, 2, 2, 1) == pytest.approx(np.sqrt(1.25), abs=0.08)
    assert np.isnan(prediction_error(noise[:8], 1, 2, 2, 1))


def test_repeats_by_chance__tells_a_rule_from_noise() -> None:
    assert not repeats_by_chance(logistic(120))
    assert repeats_by_chance(np.random.default_rng(6).normal(size=120))


def test_closed_stretch__ends_as_it_begins() -> None:
    x = np.sin(TURN * np.arange(1037) / 100.0)
    cut = closed_stretch(x)
    assert len(cut) in (900, 1000)
    # the next sample would be the first one again
    assert abs(2.0 * cut[-1] - cut[-2] - cut[0]) < 0.01
    assert abs(2.0 * x[-1] - x[-2] - x[0]) > 0.6


@pytest.mark.parametrize("n", [3.0, 5.5, 8.0, 25.0])
def test_leaps__counts_the_samples_of_a_sine(n) -> None:
    words = _leaps(one_piece(np.sin(TURN * np.arange(4000) / n)))
    assert words == "" if n > 6.0 else words.startswith(f"{n:.1f} samples to an oscillation")


def test_drift__of_level_and_size() -> None:
    t = np.arange(4000) * 0.05
    swing = np.sin(3.0 * t)
    assert _drift(one_piece(swing)) == ""
    assert "its level drifts" in _drift(one_piece(swing + 0.01 * t))
    assert "its size drifts" in _drift(one_piece(swing * np.exp(-0.01 * t)))
    # a step and back is no trend
    assert _drift(one_piece(swing + 0.5 * (np.abs(t - 100.0) < 30.0))) == ""


def test_zero_one_result__of_order_chaos_and_drift() -> None:
    order = _zero_one_result(np.cos(np.sqrt(2.0) * np.arange(3000)), 1, "")
    assert order.value < 0.1
    chaos = _zero_one_result(logistic(3000), 1, "")
    assert chaos.value > 0.9
    assert np.isnan(_zero_one_result(logistic(3000), 1, "drifts").value)
    assert "99 samples two delays apart" in _zero_one_result(logistic(199), 1, "").reason


def test_surrogate_result__is_the_share_that_is_no_worse() -> None:
    found = _surrogate_result((0.5, np.linspace(0.4, 1.16, 39)))
    assert found.value == pytest.approx(6 / 39)  # .40, .42, ... .50
    assert found.low < found.value < found.high
    assert _surrogate_result((np.nan, np.zeros(39))).reason == "too few vectors to predict"


def test_series_table__a_value_with_a_reason_is_not_decided() -> None:
    kept = Result("exponent", "1/s", 0.5, 0.4, 0.6)
    results = [kept, _unless("too short", Result("zero_one", "1", 0.5, 0.4, 0.6))]
    columns = {n: ("quantity", [getattr(r, n) for r in results]) for n in Result._fields[1:]}
    attrs = {"channel": "x", "motion": "not decided", "motion_reason": "too short", "unit": "m"}
    rows = series_table(xr.Dataset(columns, {"quantity": [r.name for r in results]}, attrs)).rows
    assert [row["decided"] for row in rows[:2]] == [True, False]
    assert np.isnan(rows[1]["value"])


def test_noise_of_an_autoregression__is_predicted_by_its_memory() -> None:
    """The best linear prediction of x' = .95 x + e two steps on has the error sqrt(1 - .95^4), of neighbours more."""
    x = lfilter([1.0], [1.0, -0.95], np.random.default_rng(7).normal(size=2500))[500:]
    error = prediction_error(x, 1, 1, 5, 2)
    best = np.sqrt(1.0 - 0.95**4)
    assert best < error < 1.3 * best
