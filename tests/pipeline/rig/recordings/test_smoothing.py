"""Local polynomials: no lag, no edge smeared, and noise as large as it was made."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.rig.recordings import recording_of, smooth
from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.rig.recordings.smoothing import _smoothed, _switches
from pipeline.specification.problems import SpecError


def noisy(make, sigma, seed=0, n=20_000, rate_hz=1000.0):
    """Noisy swing with its true angles and rates."""
    t = np.arange(n) / rate_hz
    a, b = np.sin(6.0 * t) + 0.2 * np.cos(17.0 * t), 0.7 * np.cos(5.0 * t)
    rates = 6.0 * np.cos(6.0 * t) - 3.4 * np.sin(17.0 * t), -3.5 * np.sin(5.0 * t)
    rng = np.random.default_rng(seed)
    columns = {"a": a + sigma * rng.standard_normal(n), "b": b + sigma * rng.standard_normal(n)}
    raw = make.raw(make.channels(columns, step_s=1.0 / rate_hz))
    return recording_of(raw, make.mapping()), (a, b), rates


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1e-4, 1e-3, 1e-2])
def test_smooth__noise_is_that_which_was_added(make, sigma):
    """From the residuals with the polynomials' degrees of freedom, 20000 samples: error 0.5 per cent."""
    ds, _, _ = noisy(make, sigma)
    found = smooth(ds)
    for name in ("psi1", "psi2"):
        assert found[name].attrs["noise"] == pytest.approx(sigma, rel=0.02)


def test_smooth__what_is_left_of_the_noise_is_what_it_says(make):
    ds, angles, rates = noisy(make, 1e-3)
    found = smooth(ds)
    for name, true in zip(("psi1", "psi2", "psi1_dot", "psi2_dot"), (*angles, *rates), strict=True):
        error = (found[name].values - true)[500:-500]
        # a tenth to a third of it is distortion: that is where the two balance
        assert error.std() == pytest.approx(found[name].attrs["noise_smoothed"], rel=0.35)


@pytest.mark.slow
def test_smooth__chosen_window_is_near_the_best(make):
    """The error of angles at the chosen window is at most a fifth above that at the best of all windows."""
    ds, angles, _ = noisy(make, 1e-3, n=6000)
    error = {w: (smooth(ds, window_s=w)["psi1"].values - angles[0]).std() for w in np.arange(0.011, 0.2, 0.004)}
    chosen = (smooth(ds)["psi1"].values - angles[0]).std()
    assert chosen < 1.2 * min(error.values())


def driven(make, level):
    """Recording with a drive."""
    a, b = make.swing(len(level))
    mapping = make.mapping(tables={"drive": {"channel": "m", "kind": "signal"}})
    return recording_of(make.raw(make.channels({"a": a, "b": b, "m": level})), mapping)


@pytest.mark.parametrize("kind", ["sine", "none", "noise"])
def test_switches__none_where_the_drive_does_not_leap(make, kind):
    rng = np.random.default_rng(0)
    level = {
        "sine": 3.0 * np.sin(2 * np.pi * 3.0 * make.time) + 0.01 * rng.standard_normal(make.n),
        "none": np.full(make.n, 2.0),
        "noise": rng.standard_normal(make.n),
    }[kind]
    assert _switches(driven(make, level)).size == 0


def test_smooth__takes_edges_from_the_drive(make):
    """The acceleration leaps with the drive: without edges the rate is off there."""
    t = make.time
    level = np.where(np.mod(t, 0.5) < 0.25, 1.0, -1.0)
    rate = 4.0 * np.abs(np.mod(t, 0.5) - 0.25)
    angle = np.cumsum(rate) * make.step_s
    ds = driven(make, level)
    ds["psi1"] = ds["psi1"].copy(data=angle)
    found = smooth(ds, window_s=0.1)["psi1_dot"].values
    without = smooth(ds, window_s=0.1, edges_s=[])["psi1_dot"].values
    true = np.gradient(angle, make.step_s)
    corners = np.abs(np.mod(t + 0.125, 0.25) - 0.125) < 0.02
    assert np.abs(found - true)[corners][1:-1].max() < 0.01
    assert np.abs(without - true)[corners][1:-1].max() > 0.02


def test_smooth__spans_no_gap_and_no_piece(make):
    a, b = make.swing()
    broken = a.copy()
    broken[1000:] += 3.0
    broken[400:410] = np.nan
    halves = [make.channels({"a": broken[s], "b": b[s]}) for s in (slice(0, 1000), slice(1000, None))]
    recorded = recording_of(make.raw(*halves, apart=True), make.mapping())
    before = recorded.copy(deep=True)
    found = smooth(recorded, window_s=0.042)
    assert recorded.identical(before)
    assert np.flatnonzero(np.isnan(found["psi1"])).tolist() == list(range(400, 410))
    assert np.isnan(found["psi1_dot"]).sum() == 10
    known = np.isfinite(broken)
    np.testing.assert_allclose(found["psi1"].values[known], broken[known], atol=2e-5)


def test_smooth__stretches_shorter_than_the_window(make):
    """They have a window of their own; one or two samples are none."""
    a, _ = make.swing()
    a[20:1990] = np.nan
    a[[1993, 1996]] = np.nan
    found = smooth(make.recorded(a, a), window_s=0.1)
    assert np.isfinite(found["psi1"].values[:20]).all()
    assert np.isfinite(found["psi1_dot"].values[1990:1993]).all()
    assert np.isnan(found["psi1_dot"].values[1994:1996]).all()


def test_smooth__short_stretches_have_lower_order(make):
    """A third of the window: a cubic's rates there would be twice as far off."""
    ds, _, rates = noisy(make, 1e-3)
    edges = np.arange(1, 1000) * 0.021
    error = smooth(ds, window_s=0.061, edges_s=edges)["psi1_dot"].values - rates[0]
    cubic = smooth(ds, window_s=0.021, edges_s=edges)["psi1_dot"].values - rates[0]
    assert error.std() < 0.6 * cubic.std()


def test_smooth__measured_rates_are_kept(make):
    a, b = make.swing()
    mapping = parse_mapping({"model": "pendulum", "channels": {"psi1": {"channel": "a"}, "psi1_dot": {"channel": "b"}}})
    ds = recording_of(make.raw(make.channels({"a": a, "b": b})), mapping)
    found = smooth(ds, window_s=0.02)
    assert set(found.data_vars) == {"psi1", "psi1_dot"}
    np.testing.assert_allclose(found["psi1_dot"], b, atol=1e-5)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"order": 0}, "order = 0: must be 1 or more"),
        ({"window_s": 0.001}, r"window_s = 0\.001: holds 1 samples; .* at least 5, which is 0\.01 s"),
        ({"window_s": -1.0}, "window_s = -1"),
    ],
)
def test_smooth__refuses(make, more, sentence):
    with pytest.raises(SpecError, match=sentence):
        smooth(make.recorded(), **more)


@pytest.mark.parametrize("width", [5, 9, 63, 65, 201, 999])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_smoothed__is_scipys_savitzky_golay_filter(width, order):
    """Values and slopes up to both ends, of windows short and long, in stretches of several lengths."""
    from scipy.signal import savgol_filter

    y = np.random.default_rng(0).standard_normal(6000).cumsum() + 100.0
    parts = np.array([[0, 1500], [1500, 2501], [2510, 2510 + width], [4000, 4001 + width]])
    found = _smoothed(y, parts, width, order, 0.01)
    for begin, end in parts:
        own = min(width, (end - begin) - 1 + (end - begin) % 2)
        for derivative, mine in ((0, found.values), (1, found.rates)):
            wanted = savgol_filter(y[begin:end], own, order, deriv=derivative, delta=0.01, mode="interp")
            np.testing.assert_allclose(mine[begin:end], wanted, atol=1e-10 * np.abs(wanted).max())
    inside = np.zeros(6000, bool)
    for begin, end in parts:
        inside[begin:end] = True
    assert (np.isfinite(found.values) == inside).all()


@pytest.mark.parametrize(("width", "order"), [(5, 1), (9, 3), (15, 2), (23, 3)])
def test_smoothed__noise_and_score_are_those_of_the_operator(width, order):
    """Against the smoothing of unit vectors: degrees of freedom, and leave-one-out by leaving each out."""
    from scipy.signal import savgol_filter

    y = np.random.default_rng(1).standard_normal(24)
    operator = savgol_filter(np.eye(24), width, order, axis=0, mode="interp")
    found = _smoothed(y, np.array([[0, 24]]), width, order, 1.0)
    residual = y - operator @ y
    assert found.noise == pytest.approx(math.sqrt(residual @ residual / (24 - np.trace(operator))))
    errors = []
    for i in range(24):
        own = np.arange(width) + min(max(i - width // 2, 0), 24 - width)
        others = own[own != i]
        errors.append(y[i] - np.polyval(np.polyfit(others, y[others], order), i))
    assert found.score == pytest.approx(np.mean(np.square(errors)), rel=1e-9)
