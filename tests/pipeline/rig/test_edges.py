"""Edges of a drive: instants, frequency with an honest error, jitter and duty cycle."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.edges import Edges, edges_of, find_edges
from pipeline.specification.problems import SpecError

DUTY = 0.4927


def square(time, frequency_hz=2.2, duty=DUTY, start_s=0.1):
    """A hard-switched signal, high for the share `duty` of each period."""
    return np.where(((time - start_s) * frequency_hz) % 1 < duty, 1.0, -1.0)


def drive_of(edges_up, edges_down, time):
    """A signal that rises and falls at given instants."""
    return np.searchsorted(edges_up, time, side="right") - np.searchsorted(edges_down, time, side="right") - 0.5


def test_find_edges__a_hard_square_wave_is_found_within_half_a_sample():
    time = np.arange(20_000) / 1000
    edges = find_edges(time, square(time))
    true = 0.1 + np.arange(edges.rising.size) / 2.2
    assert edges.rising.size == 44
    np.testing.assert_allclose(edges.rising, true, atol=0.5e-3 + 1e-9)
    assert edges.resolution_s == pytest.approx(1e-3)


def test_find_edges__a_linear_flank_is_found_exactly():
    time = np.arange(0.0, 4.0, 0.01)
    flank = np.clip(((time % 1) - 0.503) / 0.05, 0, 1) - np.clip(((time % 1) - 0.853) / 0.05, 0, 1)
    edges = find_edges(time, 3.0 + 2.0 * flank)
    np.testing.assert_allclose(edges.rising, np.arange(4) + 0.503 + 0.025, atol=1e-12)
    np.testing.assert_allclose(edges.falling, np.arange(4) + 0.853 + 0.025, atol=1e-12)
    assert edges.resolution_s == 0.0


def test_find_edges__noise_makes_no_edges():
    time = np.arange(60_000) / 1000
    noisy = square(time) + np.random.default_rng(1).normal(0, 0.2, time.size)
    assert find_edges(time, noisy).rising.size == find_edges(time, square(time)).rising.size


def test_find_edges__a_noisy_sine_crosses_its_middle_once_per_flank():
    time = np.arange(30_000) / 1000
    noisy = np.sin(2 * np.pi * 1.3 * time + 0.5) + np.random.default_rng(2).normal(0, 0.05, time.size)
    edges = find_edges(time, noisy)
    true = (np.arange(1, edges.rising.size + 1) - 0.5 / (2 * np.pi)) / 1.3
    assert edges.rising.size == 39
    # noise over slope is 6 ms; first and last crossing average some of it away
    np.testing.assert_allclose(edges.rising, true, atol=0.02)


def test_find_edges__an_edge_inside_a_gap_is_left_out():
    time = np.arange(20_000) / 1000
    kept = (time < 5.0) | (time > 5.2)  # the edge at 0.1 + 11/2.2 = 5.1 s lies in it
    edges = find_edges(time[kept], square(time)[kept])
    assert edges.rising.size == 43
    assert not ((edges.rising > 5.0) & (edges.rising < 5.2)).any()


@pytest.mark.parametrize(
    ("time", "drive", "says"),
    [
        (np.arange(4.0), np.zeros(3), "equally many"),
        (np.arange(4.0), np.array([0, 1, np.nan, 0]), "1 values are not finite"),
        (np.array([0.0, 2.0, 1.0]), np.zeros(3), "does not rise"),
        (np.zeros(1), np.zeros(1), "longer window"),
        *(
            (np.arange(5000.0), 1.5 + noise * np.random.default_rng(3).normal(size=5000), 'no edges.*drive = "none"')
            for noise in (0.0, 1e-3)
        ),
    ],
)
def test_find_edges__bad_input_is_refused(time, drive, says):
    with pytest.raises(SpecError, match=says):
        find_edges(time, drive)


@pytest.mark.parametrize("hysteresis", [0.0, 2.0, -1.0])
def test_find_edges__a_band_outside_the_levels_is_refused(hysteresis):
    time = np.arange(5000) / 1000
    with pytest.raises(SpecError, match="hysteresis"):
        find_edges(time, square(time), hysteresis=hysteresis)


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [2e-3, 1e-4, 0.0])
def test_frequency__errors_hold_over_many_recordings(jitter):
    """Monte Carlo: over recordings with a known jitter, the z scores have spread 1."""
    rng, time = np.random.default_rng(4), np.arange(30_000) / 1000
    z, jitters = [], []
    for _ in range(200):
        n, f, duty = np.arange(-1, 70), rng.uniform(2.2, 2.3), rng.uniform(0.48, 0.5)
        start = rng.uniform(0, 1 / f)
        up = start + n / f + rng.normal(0, jitter, n.size)
        down = start + (n + duty) / f + rng.normal(0, jitter, n.size)
        timing = find_edges(time, drive_of(up, down, time)).frequency()
        off = timing.frequency_hz - f, timing.duty_cycle - duty
        z.append([off[0] / timing.frequency_error_hz, off[1] / timing.duty_cycle_error])
        jitters.append(timing.jitter_s)
    # 200 draws tell a spread to 5 %; a duty cycle of which nothing is random is judged cautiously
    assert np.std(z, axis=0)[0] == pytest.approx(1.0, abs=0.2)
    assert 0.5 < np.std(z, axis=0)[1] < 1.2
    np.testing.assert_allclose(np.mean(z, axis=0), 0.0, atol=0.25)
    assert np.mean(jitters) == pytest.approx(np.hypot(jitter, 1e-3 / np.sqrt(12)), rel=0.03)


def test_frequency__what_sampling_hides_is_in_the_error():
    """At 2 Hz and 1 kHz each edge falls on the same place in a sample: no scatter, no certainty."""
    time = np.arange(20_000) / 1000
    for start in (0.1002, 0.1003, 0.1009):
        timing = find_edges(time, square(time, 2.0, DUTY + 0.0004, start)).frequency()
        assert timing.jitter_s < 1e-9
        assert timing.duty_cycle == pytest.approx(DUTY + 0.0004, abs=3 * timing.duty_cycle_error)
        assert timing.frequency_hz == pytest.approx(2.0, abs=3 * timing.frequency_error_hz)
        assert timing.frequency_error_hz > 1e-6


def test_common_error__is_that_of_a_sample_where_all_edges_share_their_place():
    """0.29 ms where sampling always hides the same; next to none where edges fall anywhere in a sample."""
    time = np.arange(40_000) / 1000
    shared, spread = (find_edges(time, square(time, f, start_s=0.1003)) for f in (2.5, 2.237))
    assert shared.common_error(shared.rising, 0.0) == pytest.approx(1e-3 / np.sqrt(12), rel=0.02)
    n = np.arange(spread.rising.size)
    assert spread.common_error(0.1003 + n / 2.237, 1e-3 / np.sqrt(12)) < 5e-5


def test_frequency__a_missing_edge_is_counted():
    rising = np.delete(0.3 + np.arange(50) / 2.5, 20)
    timing = Edges(rising, rising + 0.2).frequency()
    assert timing.frequency_hz == pytest.approx(2.5, rel=1e-12)
    assert timing.n_periods == 49
    assert timing.duty_cycle == pytest.approx(0.5, rel=1e-12)
    # far from time zero nothing cancels
    assert Edges(rising + 1e6, rising + 1e6 + 0.2).frequency().frequency_hz == pytest.approx(2.5, rel=1e-9)


def test_frequency__too_few_edges_or_no_period_are_refused():
    with pytest.raises(SpecError, match="2 rising edges"):
        Edges(np.array([0.0, 1.0]), np.array([0.5])).frequency()
    with pytest.raises(SpecError, match="not periodic"):
        Edges(np.sort(np.random.default_rng(5).uniform(0, 40, 60)), np.array([])).frequency()


def test_edges_of__pieces_are_not_joined():
    time = np.concatenate([np.arange(5000) / 1000, 7.31 + np.arange(5000) / 1000])
    ds = xr.Dataset(
        {"drive": ("sample", square(time))}, {"time": ("sample", time), "piece": ("sample", np.repeat([0, 1], 5000))}
    )
    edges = edges_of(ds)
    assert not ((edges.rising > 4.999) & (edges.rising < 7.31)).any()
    assert edges.frequency().frequency_hz == pytest.approx(2.2, rel=1e-4)
    with pytest.raises(SpecError, match=r"free\.tdms: no drive channel.*\[drive\]"):
        edges_of(ds.drop_vars("drive").assign_attrs(file="free.tdms"))
