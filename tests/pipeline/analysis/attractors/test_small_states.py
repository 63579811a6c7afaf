"""Cycles that pass near 0 or take many steps a return: found, or left with a reason that says what helps."""

import pytest

import magpend
from magpend_core.crossing import Crossing
from pipeline.layout.vocabulary import EVIDENCE, NOT_SETTLED
from pipeline.runs.derive import derive
from tests.core.flows import VAN_DER_POL, table
from tests.pipeline.analysis.cubes import flow_cube, sweep
from tests.pipeline.analysis.dense_sets import identify

pytestmark = pytest.mark.slow

CRAWL = table("crawl", {"N": "0.8*N*(1 - N/K) - 2.5*N*P/(N + 1)", "P": "1.25*N*P/(N + 1) - 0.4*P"}, {"K": 15.0})
"""Predator and prey of Rosenzweig and MacArthur; the prey falls to 2.9e-16 on the cycle."""


def attractors(directory, model, section, starts, **integration):
    spec = sweep(model, starts, lengths=(30, 8), section={"direction": "up", "longest": 500.0, **section})
    spec["integration"] |= integration
    return derive(magpend.run(spec, directory, workers=0).directory, "attractors")


def test_identified__a_state_far_below_the_other(tmp_path):
    # period and multiplier integrated in logarithms with DOP853 at 1e-13
    found = attractors(tmp_path / "run", CRAWL, {"of": "N", "value": 2.0}, [[2.0, 1.0], [5.0, 3.0]], atol=1e-18)
    assert found["period_s"].values == pytest.approx([83.58265995], rel=1e-6)
    assert found["multiplier_real"].values[0, 0] == pytest.approx(1.67082e-7, rel=1e-3)
    assert (found["attractor_id"] == 0).all()


def test_identified__many_steps_a_return(tmp_path):
    stiff = table("stiff_van_der_pol", VAN_DER_POL["equations"], {"mu": 100.0})
    found = attractors(tmp_path / "run", stiff, {"of": "v", "value": 0.0}, [[2.0, 1.0], [0.1, 0.0]])
    assert found["period_s"].values == pytest.approx([162.83707], rel=1e-7)


def test_identified__says_how_the_search_ended(monkeypatch):
    crossing = Crossing("v", 0.0, "up", 50.0)
    cube = flow_cube(VAN_DER_POL, [[1.0, 0.0], [0.5, 0.0]], crossing=crossing)
    monkeypatch.setattr("magpend_core.precision.MOST_STEPS", 5)
    found = identify(cube.assign_attrs(max_steps_per_period=5), budget=0.0)
    assert found["stability"].values.ravel().tolist() == [NOT_SETTLED]
    assert EVIDENCE[int(found["evidence"].values.ravel()[0])] == "step_limit"
