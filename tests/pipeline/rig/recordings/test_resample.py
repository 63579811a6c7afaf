"""Samples at irregular times: the error names the cause and a remedy, and the remedy helps."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.recordings import findings_of, recording_of
from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.specification.problems import SpecError


def swing_at(make, stamps, **more):
    """A slow swing that is sampled at given times."""
    mapping = parse_mapping(
        {
            "model": "pendulum",
            "time": {"channel": "t"},
            "channels": {"psi1": {"channel": "a"}, "psi2": {"channel": "b"}},
            **more,
        }
    )
    a, b = 0.3 * np.sin(2.0 * stamps), 0.2 * np.cos(1.5 * stamps)
    return recording_of(make.raw(make.channels({"t": stamps, "a": a, "b": b}, step_s=np.nan)), mapping)


@pytest.fixture
def irregular():
    return np.cumsum(np.random.default_rng(5).uniform(0.005, 0.035, 2000))


def test_recording__irregular_sampling_is_named(make, irregular):
    with pytest.raises(
        SpecError, match=r"irregular times, with steps of 5\.\d* to 34\.\d* ms.*resample = 5\d"
    ) as caught:
        swing_at(make, irregular)
    rate = float(str(caught.value).partition("resample = ")[2].partition(",")[0])
    ds = swing_at(make, irregular, resample=rate)
    assert int(ds["piece"].max()) == 0
    assert ds.attrs["sampling_rate_hz"] == pytest.approx(rate)
    assert not [f for f in findings_of(ds) if f.kind in ("gap", "jitter")]
    # linear interpolation over steps of at most 35 ms: at most h^2/8 max |a''| = 2e-4
    since = ds["time"].values + irregular[0]
    np.testing.assert_allclose(ds["psi1"], 0.3 * np.sin(2.0 * since), atol=2e-4)


def test_recording__gaps_of_even_sampling_are_not_irregular(make):
    stamps = np.arange(3000) * 0.01
    kept = np.random.default_rng(1).uniform(size=3000) > 0.1
    ds = swing_at(make, stamps[kept])
    assert int(ds["piece"].max()) > 100


def test_mapping__resample_needs_time_stamps():
    with pytest.raises(SpecError, match="resample: needs time stamps"):
        parse_mapping({"model": "pendulum", "resample": 50.0, "channels": {"psi1": {"channel": "a"}}})


def test_mapping__resample_cannot_bridge_a_jump():
    with pytest.raises(SpecError, match=r"channels\.psi1\.wraps"):
        parse_mapping(
            {
                "model": "pendulum",
                "resample": 50.0,
                "time": {"channel": "t"},
                "channels": {"psi1": {"channel": "a", "wraps": True}},
            }
        )
