"""Whatever bytes a file has: it is read, or refused with one message."""

from __future__ import annotations

import random

import numpy as np
import pytest

from pipeline.rig.recordings import parse_mapping, recording_of
from pipeline.rig.recordings.reading import read_raw
from pipeline.rig.recordings.writing import write_raw
from pipeline.specification.problems import SpecError

from .lvm_files import lvm_segment, written_lvm


def damaged(data, rng):
    """Bytes that are cut, changed, or more than there were."""
    broken = bytearray(data)
    if rng.random() < 0.5:
        del broken[rng.randrange(len(broken) + 1) :]
    for _ in range(rng.randrange(5)):
        if broken:
            broken[rng.randrange(len(broken))] = rng.randrange(256)
    if rng.random() < 0.2:
        place = rng.randrange(len(broken) + 1)
        broken[place:place] = bytes(rng.randrange(256) for _ in range(rng.randrange(20)))
    return bytes(broken)


@pytest.mark.slow  # needs nptdms
@pytest.mark.parametrize("suffix", [".csv", ".lvm", ".tdms"])
def test_read_raw__damaged_files_are_read_or_refused(tmp_path, make, suffix):
    source, target = tmp_path / f"whole{suffix}", tmp_path / f"x{suffix}"
    if suffix == ".lvm":
        segment = lvm_segment([1.0, 1.5, 2.0, 1.0], [0.0] * 4, columns="One", time="12:00:00.25", step=0.01)
        written_lvm(source, [segment], decimal=",")
    else:
        write_raw(make.raw(make.channels({"a": np.arange(20.0), "b": np.ones(20)})), source)
    rng, outcomes = random.Random(7), []
    for _ in range(300):
        target.write_bytes(damaged(source.read_bytes(), rng))
        try:
            raw = read_raw(target)
            entry = {"channel": raw.names[-1], "unit": "V", "scale": 1.0}
            mapping = {"model": "pendulum", "sampling_rate_hz": 100.0, "channels": {"psi1": entry}}
            recording_of(raw, parse_mapping(mapping))
            outcomes.append("read")
        except SpecError:
            outcomes.append("refused")
    assert set(outcomes) == {"read", "refused"}


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.99])
def test_read_matlab__cut_files_are_refused(tmp_path, make, share):
    """Compressed, as MATLAB writes them: what is missing cannot be unpacked."""
    from scipy.io import savemat

    path = tmp_path / "x.mat"
    savemat(path, {"y": np.random.default_rng(0).standard_normal((2, 500))}, do_compression=True)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(SpecError, match=r"x\.mat: "):
        read_raw(path)
