"""The recording of a real double pendulum that ships: what its README says is what is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.rig.recordings import findings_of, read_recording

FOLDER = Path(__file__).parents[4] / "workflows" / "recordings" / "multiarm"


@pytest.fixture(scope="module")
def recording():
    return read_recording(FOLDER / "multiarm_free_swings.mat", FOLDER / "multiarm_free_swings.toml")


def test_read_recording__cells_of_the_real_pendulum_are_pieces(recording):
    pieces, counts = np.unique(recording["piece"], return_counts=True)
    assert pieces.tolist() == list(range(26))
    assert (counts == 2667).all()
    assert recording.attrs["sampling_rate_hz"] == 1000.0
    assert findings_of(recording) == []


def test_read_recording__real_pendulum_swings_down_from_hanging(recording):
    """Zero is hanging down: the amplitudes of link 2 fall from 1.8 to less than 0.4 rad, about zero."""
    tops = recording["psi2"].groupby(recording["piece"]).map(lambda a: np.abs(a).max()).values
    assert tops[0] == pytest.approx(1.78, abs=0.005)
    assert tops[-1] == pytest.approx(0.34, abs=0.005)
    assert abs(float(recording["psi2"].mean())) < 0.02


def test_read_recording__pieces_of_the_real_pendulum_follow_on(recording):
    """Each piece begins a sample after the end of the one before, and continues it."""
    time, psi1 = recording["time"].values, recording["psi1"].values
    np.testing.assert_allclose(np.diff(time), 1e-3, rtol=1e-9)
    assert np.abs(np.diff(psi1)).max() < 0.012  # 12 rad/s, the fastest swing
