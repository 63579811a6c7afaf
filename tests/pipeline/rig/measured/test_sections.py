"""Sections of recordings: local polynomials with a kink at the edge."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.edges import Edges
from pipeline.rig.measured.sections import find_sections
from pipeline.specification.problems import SpecError

STATES = ("psi1", "psi2", "psi1_dot", "psi2_dot")


def recording_of(time, piece=None, **channels):
    piece = np.zeros(time.size, np.int64) if piece is None else piece
    return xr.Dataset(
        {name: ("sample", values) for name, values in channels.items()},
        coords={"time": ("sample", time), "piece": ("sample", piece)},
        attrs={"model": "pendulum", "file": "rig.tdms"},
    )


def bent(time, at):
    """A cubic whose acceleration and jerk jump at an instant; 0.3 and -1.7 are value and slope there."""
    x = time - at
    return 0.3 - 1.7 * x + np.where(x < 0, 4.0 * x**2 - 9.0 * x**3, -25.0 * x**2 + 40.0 * x**3)


def test_find_sections__cubics_with_a_kink_are_exact():
    time = np.arange(1000) / 1000
    ds = recording_of(time, psi1=bent(time, 0.5003), psi2=bent(time, 0.5003) + time)
    found = find_sections(ds, Edges(np.array([0.5003]), np.array([0.2, 0.8])))
    assert tuple(found["state"].values) == STATES
    # the second channel is the first plus the time
    np.testing.assert_allclose(found["section"].values[0], [0.3, 0.8003, -1.7, -0.7], atol=1e-11)


def test_find_sections__a_measured_rate_may_bend_at_the_edge():
    time = np.arange(1000) / 1000
    rate = np.where(time < 0.5, 2.0 + 3.0 * (time - 0.5), 2.0 - 8.0 * (time - 0.5))
    angle = np.where(
        time < 0.5, 2.0 * (time - 0.5) + 1.5 * (time - 0.5) ** 2, 2.0 * (time - 0.5) - 4 * (time - 0.5) ** 2
    )
    ds = recording_of(time, psi1=angle, psi1_dot=rate)
    found = find_sections(ds, Edges(np.array([0.5]), np.array([])))
    assert tuple(found["state"].values) == ("psi1", "psi1_dot")
    np.testing.assert_allclose(found["section"].values[0], [0.0, 2.0], atol=1e-12)


def test_find_sections__its_noise_is_the_scatter():
    """Over 400 edges z scores against the truth have mean 0 and spread 1, and a sample's noise is found."""
    rng, time = np.random.default_rng(1), np.arange(80_000) / 1000
    at = 0.1 + 0.2 * np.arange(399) + rng.uniform(0, 1e-3, 399)
    middle = np.round((time - 0.1) / 0.2).astype(int).clip(0, 398)
    clean = bent(time, at[middle])
    ds = recording_of(time, psi1=clean + rng.normal(0, 2e-3, time.size))
    found = find_sections(ds, Edges(at, at[:-1] + 0.1))
    z = (found["section"].values - [0.3, -1.7]) / found["section_noise"].values
    # 399 draws tell a spread to 3.5 %, a mean to 5 %
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.12)
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=0.15)
    assert '"psi1": 0.00' in found.attrs["noise"]
    assert float(found.attrs["noise"].split(":")[1].rstrip("}")) == pytest.approx(2e-3, rel=0.02)


def test_find_sections__edges_at_gaps_and_ends_are_left_out():
    time = np.concatenate([np.arange(500), np.arange(510, 1000)]) / 1000
    piece = (time > 0.505).astype(np.int64)
    ds = recording_of(time, piece, psi1=np.sin(time))
    found = find_sections(ds, Edges(np.array([0.001, 0.25, 0.503, 0.75, 0.999]), np.array([])))
    np.testing.assert_array_equal(found["number"].values, [1, 3])
    np.testing.assert_allclose(found["section"].values[:, 0], np.sin([0.25, 0.75]), atol=1e-7)


def test_find_sections__a_window_ends_at_the_next_edge():
    """A second kink 20 ms away would spoil a window of 80 ms."""
    time = np.arange(1000) / 1000
    x = bent(time, 0.5) + 300.0 * np.clip(time - 0.52, 0, None) ** 2
    found = find_sections(recording_of(time, psi1=x), Edges(np.array([0.5]), np.array([0.52])), window_s=0.08)
    np.testing.assert_allclose(found["section"].values[0], [0.3, -1.7], atol=1e-10)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"window_s": 0.003}, r"window_s = 0\.003: must be at least 0\.012"),
        ({"order": 1}, "order = 1: must be at least 2"),
    ],
)
def test_find_sections__a_window_that_cannot_hold_it_is_refused(change, says):
    time = np.arange(1000) / 1000
    with pytest.raises(SpecError, match=says):
        find_sections(recording_of(time, psi1=time), Edges(np.array([0.5]), np.array([])), **change)


def test_find_sections__without_states_or_edges_it_says_what_to_do():
    time = np.arange(1000) / 1000
    with pytest.raises(SpecError, match=r"rig\.tdms: none of the states of pendulum"):
        find_sections(recording_of(time, drive=time), Edges(np.array([0.5]), np.array([])))
    with pytest.raises(SpecError, match="no rising edge of the drive has samples"):
        find_sections(recording_of(time, psi1=time), Edges(np.array([2.0]), np.array([])))
