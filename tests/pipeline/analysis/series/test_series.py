"""Time series of known dynamics: closed forms, published exponents and dimensions, and noise that is not decided."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

import magpend
from pipeline.analysis.series.analysis import series_table
from pipeline.analysis.series.embedding import Series, false_neighbours, first_minimum, mutual_information
from pipeline.analysis.series.recurrence import RecurrenceSettings, _measures
from pipeline.analysis.series.surrogates import closed_stretch, surrogate


def series(values, step):
    return xr.Dataset({"x": ("time", values, {"units": "m"})}, {"time": np.arange(len(values)) * step})


def flow(rates, n, step, seed, skip, parts=10):
    """First state of a trajectory by the classical Runge-Kutta method; in plain floats, which give the same chaos on
    every machine.
    """
    y, h, found = np.random.default_rng(seed).uniform(0.5, 1.5, 3).tolist(), step / parts, []
    for k in range(parts * (round(skip / step) + n)):
        if k >= parts * round(skip / step) and k % parts == 0:
            found.append(y[0])
        a = rates(y)
        b = rates([u + 0.5 * h * v for u, v in zip(y, a, strict=True)])
        c = rates([u + 0.5 * h * v for u, v in zip(y, b, strict=True)])
        d = rates([u + h * v for u, v in zip(y, c, strict=True)])
        y = [u + h * (p + 2.0 * (q + r) + s) / 6.0 for u, p, q, r, s in zip(y, a, b, c, d, strict=True)]
    return np.array(found)


def rossler(n, step=0.2, seed=0):
    """Largest exponent 0.0714, correlation dimension 2.0, mean period 5.86."""
    return flow(lambda y: [-y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - 5.7)], n, step, seed, 200.0)


def lorenz(n, step=0.03, seed=0):
    """Largest exponent 0.9056, correlation dimension 2.05."""
    rates = lambda y: [10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]]  # noqa: E731
    return flow(rates, n, step, seed, 20.0)


def orbit(n, step=0.1, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * step + rng.uniform(0.0, 6.0)
    x = np.cos(t) + 0.3 * np.cos(2.0 * t + 1.0)
    return x + noise * x.std() * rng.normal(size=n)


def torus(n, step=0.1234567, seed=0):
    a, b = np.random.default_rng(seed).uniform(0.0, 6.0, 2)
    t = np.arange(n) * step
    slow = 0.5 * (np.sqrt(5.0) - 1.0) * t + b
    return np.cos(t + a) * (1.0 + 0.4 * np.cos(slow)) + 0.6 * np.sin(slow)


def noise(n, seed=0, poles=(1.0, -0.95)):
    return lfilter([1.0], poles, np.random.default_rng(seed).normal(size=n + 500))[500:]


def one(ds, name):
    return tuple(float(ds.sel(quantity=name)[key]) for key in ("low", "value", "high"))


def reason(ds, name):
    return str(ds.sel(quantity=name)["reason"].item())


def test_mutual_information__of_gaussian_values_has_its_closed_form():
    """-log(1 - r^2)/2, of which 16 bins of equal shares lose a little."""
    found = mutual_information(Series.of([noise(200_000, poles=(1.0, -0.8))], 1.0), 6)
    exact = -0.5 * np.log(1.0 - 0.8 ** (2.0 * np.arange(1, 7)))
    np.testing.assert_allclose(found[1:], exact, rtol=0.08, atol=1e-3)
    assert found[0] == pytest.approx(np.log(16.0), rel=1e-3)
    assert first_minimum(found) is None


def test_first_minimum__of_a_sine_is_near_a_quarter_of_its_period():
    t = np.arange(20_000) * 2.0 * np.pi / 41.3
    x = np.cos(t) + 0.02 * np.random.default_rng(1).normal(size=len(t))
    assert first_minimum(mutual_information(Series.of([x], 1.0), 40)) in range(9, 13)


def test_false_neighbours__of_a_torus_vanish_with_four_delays_and_of_white_noise_never():
    shares = false_neighbours(Series.of([torus(4000)], 1.0), 14, 60)
    assert shares[1] > 0.1
    assert (shares[3:5] < 0.01).all()
    assert (false_neighbours(Series.of([noise(4000, poles=(1.0,))], 1.0), 1, 10)[1:] > 0.02).all()


def test_surrogate__has_the_values_and_the_spectrum_of_the_series():
    x = closed_stretch(np.exp(0.5 * noise(3000) / 3.2))
    y = surrogate(x, np.random.default_rng(2))
    np.testing.assert_array_equal(np.sort(x), np.sort(y))
    own, other = (np.abs(np.fft.rfft(v - v.mean())) for v in (x, y))
    assert np.abs(own - other).sum() < 0.03 * own.sum()
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.3


def test_measures__of_a_small_matrix_are_those_counted_by_hand():
    matrix = np.eye(6, dtype=bool)
    for i, j in ((0, 2), (1, 3), (2, 4), (0, 4), (1, 4), (0, 5)):
        matrix[i, j] = matrix[j, i] = True
    found = _measures(matrix, 1, 0.5, RecurrenceSettings())
    # diagonals: 3 in a row at lag 2; single ones at lags 3, 4, 5
    assert found["determinism"] == pytest.approx(3 / 6)
    assert found["mean_line"] == pytest.approx(3 * 0.5)
    assert found["line_entropy"] == 0.0
    # columns 0 to 5 hold the rows {2, 4, 5}, {3, 4}, {0, 4}, {1}, {0, 1, 2}, {0}
    assert found["laminarity"] == pytest.approx((2 + 2 + 3) / 12)


@pytest.mark.slow
def test_series_of__roessler_and_lorenz_have_their_published_numbers():
    found = magpend.series_of(series(rossler(5000), 0.2))
    assert found.attrs["motion"] == "chaotic"
    for name, exact in (("exponent", 0.0714), ("correlation_dimension", 2.0), ("period", 5.861)):
        low, _, high = one(found, name)
        assert low - 0.002 * exact <= exact <= high + 0.002 * exact, name
    assert one(found, "embedding_dimension")[1] == 3.0
    assert one(found, "exponent")[0] > 0.0
    found = magpend.series_of(series(lorenz(5000), 0.03))
    assert found.attrs["motion"] == "chaotic"
    for name, exact in (("exponent", 0.9056), ("correlation_dimension", 2.05)):
        low, _, high = one(found, name)
        assert low <= exact <= high, name


@pytest.mark.slow
def test_series_of__a_noisy_orbit_and_a_torus_are_not_chaotic():
    found = magpend.series_of(series(orbit(3000, noise=0.1), 0.1))
    low, _, high = one(found, "period")
    assert low <= 2.0 * np.pi <= high
    assert high - low < 0.03
    assert found.attrs["motion"] == "periodic"
    found = magpend.series_of(series(torus(5000), 0.1234567))
    assert found.attrs["motion"] == "regular"
    low, value, high = one(found, "exponent")
    assert low < 0.0 < high
    assert abs(value) < 0.002
    # a quantity that is not there has no number, and says why
    assert np.isnan(one(found, "cycle")[1])
    assert reason(found, "cycle") == "maxima do not repeat"


@pytest.mark.slow
@pytest.mark.parametrize("poles", [(1.0, -0.95), (1.0, -1.98 * np.cos(0.2), 0.9801)])
def test_series_of__linear_noise_is_not_decided(poles):
    found = magpend.series_of(series(noise(3000, poles=poles), 1.0))
    assert found.attrs["motion"] == "not decided"
    assert reason(found, "exponent")
    assert reason(found, "correlation_dimension")
    rows = {row["quantity"]: row for row in series_table(found).rows}
    assert not rows["exponent"]["decided"]
    assert one(found, "surrogate_rank")[1] > 0.0


@pytest.mark.slow
def test_series_of__a_decaying_swing_is_not_stationary():
    t = np.arange(3000) * 0.05
    found = magpend.series_of(series(np.exp(-0.02 * t) * np.cos(2.0 * t), 0.05))
    assert found.attrs["motion"] == "not decided"
    assert "size drifts" in reason(found, "exponent")
    low, _, high = one(found, "period")
    assert low - 1e-4 <= np.pi <= high + 1e-4


@pytest.mark.slow
def test_series_of__a_cycle_of_three_maxima_has_the_period_of_the_whole():
    t = np.arange(4000) * 0.05
    found = magpend.series_of(series(np.sin(t) + 0.8 * np.sin(3.0 * t + 0.5), 0.05))
    assert one(found, "cycle")[1] == 3
    low, _, high = one(found, "period")
    assert low - 1e-4 <= 2.0 * np.pi <= high + 1e-4


def henon_map(n):
    x = np.zeros(n + 2)
    for i in range(2, n + 2):
        x[i] = 1.0 - 1.4 * x[i - 1] ** 2 + 0.3 * x[i - 2]
    return x[2:]


def test_series_of__refuses_the_iterates_of_a_map_in_words():
    ds = series(henon_map(300), 1.0).assign_attrs(model="henon")
    with pytest.raises(ValueError, match=r"one value per iterate of the map henon.*analyse chaos"):
        magpend.series_of(ds)


@pytest.mark.slow
def test_series_of__a_series_without_a_course_between_its_samples_says_so():
    """One value per return, under no model: a missing quantity is NaN and says why, and the quantities are the same."""
    found = magpend.series_of(series(henon_map(600), 1.0))
    smooth = magpend.series_of(series(np.sin(0.3 * np.arange(600)), 1.0))
    assert found["quantity"].values.tolist() == smooth["quantity"].values.tolist()
    for name in ("delay", "period", "period_scatter", "cycle", "exponent"):
        assert np.isnan(one(found, name)[1])
        assert "samples to an oscillation, fewer than 6: one value per iterate or return, or noise" in reason(
            found, name
        )
    assert one(smooth, "cycle")[1] == 1
    assert reason(smooth, "cycle") == ""


def test_series_of__refuses_what_it_cannot_measure():
    with pytest.raises(ValueError, match="no 200 samples"):
        magpend.series_of(series(np.arange(100.0), 1.0))
    with pytest.raises(ValueError, match="constant"):
        magpend.series_of(series(np.ones(300), 1.0))
    with pytest.raises(ValueError, match="'y' is not there"):
        magpend.series_of(series(np.arange(300.0), 1.0), "y")
