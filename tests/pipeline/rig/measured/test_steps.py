"""Sweeps cut into stretches of one frequency, or into windows."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.edges import Edges
from pipeline.rig.measured.steps import constant_spans, cut
from pipeline.specification.problems import SpecError

DUTY = 0.4927


def edges_for(frequencies, n_periods, jitter=0.0, seed=0, resolution=0.0):
    """Edges of a drive in steps; the last edge of a step is the first of the next."""
    lengths = np.repeat(1 / np.asarray(frequencies, np.float64), n_periods)
    rising = np.concatenate([[0.0], np.cumsum(lengths)])
    rng = np.random.default_rng(seed)
    falling = rising[:-1] + DUTY * lengths + rng.normal(0, jitter, lengths.size)
    rising = rising + rng.normal(0, jitter, rising.size)
    if resolution:
        rising, falling = (np.round(t / resolution) * resolution for t in (rising, falling))
    return Edges(rising, falling, resolution)


@pytest.mark.parametrize("resolution", [0.0, 1e-3])
def test_constant_spans__steps_of_ten_millihertz_are_found_to_an_edge(resolution):
    f = np.arange(2.0, 2.5, 0.01)
    spans = constant_spans(edges_for(f, 60, 1e-4, resolution=resolution))
    assert len(spans) == len(f)
    np.testing.assert_allclose([a for a, _ in spans], 60 * np.arange(len(f)), atol=1)
    np.testing.assert_allclose([b for _, b in spans], 60 * np.arange(1, len(f) + 1), atol=1)


def test_constant_spans__a_gap_ends_a_stretch_and_jitter_does_not():
    for seed in range(20):
        assert constant_spans(edges_for([2.2], 300, 1e-3, seed)) == [(0, 300)]
    edges = edges_for([2.2], 100)
    rising = np.delete(edges.rising, np.s_[50:60])
    assert constant_spans(Edges(rising, edges.falling)) == [(0, 49), (50, 90)]


def test_constant_spans__a_step_of_one_millihertz_is_found():
    """0.2 ms a period among 0.1 ms of jitter: found after some edges, and then placed."""
    spans = constant_spans(edges_for([2.2, 2.201], 80, 1e-4))
    assert len(spans) == 2
    assert abs(spans[0][1] - 80) <= 6


def test_cut__frequencies_are_within_their_errors_and_directions_told():
    f = [2.0, 2.02, 2.04, 2.02, 2.0]
    found = cut(edges_for(f, 80, 2e-4), transient=20, window=0)
    z = [(s.timing.frequency_hz - x) / s.timing.frequency_error_hz for s, x in zip(found, f, strict=True)]
    assert np.abs(z).max() < 4
    assert [s.direction for s in found] == [1, 1, 1, -1, -1]
    assert [s.edges.rising.size for s in found] == pytest.approx([61] * 5, abs=1)
    assert found[0].timing.duty_cycle == pytest.approx(DUTY, abs=3e-4)
    (alone,) = cut(edges_for([2.2], 100))
    assert alone.direction == 0


def test_cut__instants_of_sampling_lie_on_the_line():
    """A line through edges known to a sample is nearer the true ones than the edges are."""
    seen = edges_for([2.237], 100, resolution=1e-3)
    true = edges_for([2.237], 100)
    (found,) = cut(seen, transient=0)
    off = found.edges.rising - true.rising
    assert np.abs(seen.rising - true.rising).max() > 4e-4
    assert np.abs(off).max() < 1.5e-4
    assert found.instant_error_s < 1e-4


def test_cut__edges_that_truly_jitter_stay_where_they_are():
    seen = edges_for([2.237], 100, 2e-3, resolution=1e-3)
    (found,) = cut(seen, transient=0)
    np.testing.assert_array_equal(found.edges.rising, seen.rising)


@pytest.mark.parametrize("window", [None, 30])
def test_cut__a_slow_sweep_is_cut_into_windows_of_their_middle_frequency(window):
    rate, n = 1e-3, np.arange(1001)  # phase 2 t + rate t^2 / 2 = n
    rising = (np.sqrt(4 + 2 * rate * n) - 2) / rate
    found = cut(Edges(rising, rising[:-1] + DUTY * np.diff(rising)), window=window)
    size = window or 40
    assert len(found) == 1000 // size
    for k, s in enumerate(found):
        middle = rising[k * size : (k + 1) * size + 1].mean()
        # of 40 periods with a constant rate: the middle in number is not quite the middle in time
        assert s.timing.frequency_hz == pytest.approx(2 + rate * middle, abs=2e-5)
        assert s.direction == 1
        assert s.timing.jitter_s < 1e-4
        assert s.timing.duty_cycle == pytest.approx(DUTY, abs=2e-3)


def test_cut__stretches_too_short_for_the_transient_say_so():
    with pytest.raises(SpecError, match=r"longest stretch of one frequency has 60 periods.*lower transient"):
        cut(edges_for([2.0, 2.1, 2.2], 60, 1e-5), transient=100, window=0)


@pytest.mark.parametrize(
    ("options", "says"),
    [({"transient": -1}, "transient = -1: must be at least 0"), ({"window": 3}, "window = 3: must be 0 or at least 8")],
)
def test_cut__numbers_out_of_bounds_are_refused(options, says):
    with pytest.raises(SpecError, match=says):
        cut(edges_for([2.0], 60), **options)


def test_cut__a_few_edges_are_no_sweep():
    with pytest.raises(SpecError, match="5 rising edges"):
        cut(edges_for([2.0], 4))
