"""Parameters at which equations have no value: bad input, or cells with a status."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core import Status
from pipeline import open_run
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import quietly

RATE = "v/d*(1 + log(e))*(1 + sqrt(s)) + where(g > 0, v/g, v)"
"""One system for all cases, which compiles once."""


def probe(axis, values, rate=RATE, **parameters):
    return {
        "kind": "sweep",
        "axes": {axis: {"values": values}},
        "model": {
            "name": "probe",
            "states": {"x": {}, "v": {}},
            "parameters": {"d": 2.0, "e": 1.0, "s": 0.0, "g": 1.0, **parameters},
            "equations": {"x": "v", "v": f"cos(2*pi*f*t) - ({rate}) - x"},
        },
        "parameters": {"frequency_hz": 0.2},
        "initial_conditions": {"kind": "list", "points": [[0.1, 0.0]]},
        "integration": {"n_transient": 1, "n_keep": 2, "rtol": 1e-5, "atol": 1e-5},
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "values", "lost"),
    [
        ("d", [0.0, 0.5, 1.0], [0]),
        ("d", [-1.0, 0.0, 1.0], [1]),
        ("e", [0.0, 0.5, 1.0], [0]),
        ("s", [-1.0, 0.0, 1.0], [0]),
    ],
)
def test_run__an_axis_that_touches_a_pole_gives_cells_with_a_status(tmp_path, axis, values, lost):
    quietly(probe(axis, values), tmp_path / "run")
    ds = open_run(tmp_path / "run")
    ended = np.isin(ds.status.values.ravel(), [Status.STEP_UNDERFLOW, Status.DIVERGED])
    assert np.flatnonzero(ended).tolist() == lost
    assert np.isfinite(ds.section.values.reshape(3, -1)[~ended]).all()


def test_run__a_guard_without_a_state_is_one(tmp_path):
    """A rate that has no value at g = 0, behind a condition that says so: it is that at g = 1."""
    quietly(probe("g", [0.0, 1.0]), tmp_path / "run")
    guarded, plain = open_run(tmp_path / "run").section.values
    np.testing.assert_array_equal(guarded, plain)


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ("v/e", "v/e: division by 0 at e = 0, in every state"),
        ("where(x < 9, v, log(e))", "log(e): logarithm of 0 at e = 0, in every state"),
        ("where(x < 9, v, 10**400)", "10**400: too large a number, in every state"),
    ],
)
def test_run__refuses_parts_without_a_value(tmp_path, rate, words):
    with pytest.raises(SpecError) as caught:
        quietly(probe("d", [1.0, 2.0], f"{rate} + 0*(d + e + s + g)", e=0.0), tmp_path / "run")
    assert f"model.equations.v: {words}" in str(caught.value)
    assert not (tmp_path / "run").exists()
