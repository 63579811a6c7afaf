"""Clean recordings of one swing in every format, and what breaks them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.rig.recordings.channels import Channel, Raw
from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.rig.recordings.reading import recording_of

RATE_HZ = 500.0
N = 2000


def swing(n=N, rate_hz=RATE_HZ):
    """Two angles of a swing [rad], smooth, without a flat place."""
    t = np.arange(n) / rate_hz
    return np.sin(3.1 * t) + 0.2 * np.cos(7.3 * t), 0.7 * np.cos(2.7 * t)


def channels_of(columns, *, step_s=1.0 / RATE_HZ, starts=None):
    """Raw channels by name from arrays by name."""
    starts = starts or {}
    return {n: Channel(n, np.asarray(v, float), "", starts.get(n, 0.0), step_s) for n, v in columns.items()}


def raw_of(*stretches, apart=False):
    """A file as a reader gives it."""
    return Raw(Path("made.tdms"), "tdms", "0" * 64, tuple(stretches), apart=apart)


def mapping_of(*, tables=None, second=None, **first):
    """A mapping of the channels a and b, with further keys of either, and further tables."""
    channels = {"psi1": {"channel": "a", **first}, "psi2": {"channel": "b", **(second or {})}}
    return parse_mapping({"model": "pendulum", "channels": channels, **(tables or {})})


def recorded(a=None, b=None, **more):
    """Dataset of the channels a and b, with further keys of the first one's mapping."""
    own_a, own_b = swing()
    a = own_a if a is None else a
    b = own_b[: len(a)] if b is None else b
    return recording_of(raw_of(channels_of({"a": a, "b": b})), mapping_of(**more))


def same(found, wanted):
    assert set(found.data_vars) == set(wanted.data_vars)
    for name in wanted.data_vars:
        np.testing.assert_array_equal(found[name], wanted[name])
        assert found[name].attrs == wanted[name].attrs
    np.testing.assert_array_equal(found["piece"], wanted["piece"])
    np.testing.assert_allclose(found["time"], wanted["time"], rtol=0, atol=1e-12)
    assert found.attrs["sampling_rate_hz"] == wanted.attrs["sampling_rate_hz"]


@pytest.fixture(scope="session")
def make():
    """What tests make recordings of."""
    return SimpleNamespace(
        swing=swing,
        channels=channels_of,
        raw=raw_of,
        mapping=mapping_of,
        recorded=recorded,
        same=same,
        time=np.arange(N) / RATE_HZ,
        rate_hz=RATE_HZ,
        step_s=1.0 / RATE_HZ,
        n=N,
    )
