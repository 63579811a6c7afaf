"""The specification that ships, on the recording of a real double pendulum that ships with it."""

from __future__ import annotations

import pytest

from pipeline.rig.identify import identification
from pipeline.rig.identify import validation as checking
from pipeline.specification.files import find_spec, shipped_identifications, shipped_workflows

RECORDING = "recordings/multiarm/multiarm_free_swings.mat"

# least squares with tanh Coulomb friction in both joints, from the recording's own notes [rad]
REACHED_BEFORE = {"psi1": 2.29e-3, "psi2": 3.68e-3}


@pytest.fixture(scope="module")
def multiarm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("multiarm") / "out"
    return folder, identification.identify("multiarm", folder, figures=False, echo=lambda _: None)


def test_shipped_identifications__are_no_runs():
    assert "multiarm" in shipped_identifications()
    assert not set(shipped_identifications()) & set(shipped_workflows())


@pytest.mark.slow
def test_identify__multiarm(multiarm):
    """Less than a quarter of what was reached before, in both angles, from first guesses 30 % off."""
    _, result = multiarm
    for channel, before in REACHED_BEFORE.items():
        assert result["rms"][channel] < 0.25 * before
    assert len(result["pieces"]) == 26
    assert result["covariance"]["estimator"] == "pieces"
    assert result["values"]["l1"] == pytest.approx(0.172719, rel=0.01)
    assert result["values"]["e1"] == pytest.approx(0.108565, rel=0.01)


@pytest.mark.slow
def test_check__multiarm_on_its_own_recording(multiarm):
    """Whole pieces and refitted starts give the fit's own root mean squares."""
    folder, result = multiarm
    recording = find_spec("multiarm").parent / RECORDING
    found = checking.check(folder, recording)
    assert found["rms"] == pytest.approx(result["rms"], rel=1e-4)
