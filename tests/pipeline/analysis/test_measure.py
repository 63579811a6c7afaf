"""Attractors of a system in any units and from any zero: affine twins have the same sets, counts and eigenvalues."""

import numpy as np
import pytest

from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.runs.derive import derive
from pipeline.runs.run import run
from tests.pipeline.factories import silent

WELLS = {
    "name": "wells-from-any-zero",
    "states": {"x": {}, "y": {}},
    "parameters": {"unit": 1.0, "zero": 0.0},
    "define": {"u": "(x - zero)/unit", "w": "y/unit + 3"},
    "equations": {"x": "unit*(u - u**3 + w)", "y": "-0.5*unit*w"},
}
"""x and y rest at zero +- unit and -3 unit, with the eigenvalues -2 and -0.5 per second."""


def rows_of(unit, zero, folder):
    data = {
        "kind": "sweep",
        "model": WELLS,
        "parameters": {"overrides": {"unit": unit, "zero": zero}},
        "section": {"of": "x", "value": zero + 2.0 * unit, "longest": 20.0},
        "initial_conditions": {
            "kind": "grid",
            "x": {"start": zero - 1.5 * unit, "stop": zero + 1.4 * unit, "num": 12},
            "y": -3.0 * unit,
        },
        "integration": {"n_transient": 20, "n_keep": 4},
    }
    run(data, folder / "run", workers=0, echo=silent)
    return attractors_table(derive(folder / "run", "attractors")).rows


TWINS = [(1.0, 0.0), (3e-4, 0.3), (1e-9, -1e-6), (300.0, -3e5), (1e6, 1e9)]


@pytest.mark.parametrize(("unit", "zero"), [(0.03, 0.3), *(pytest.param(*t, marks=pytest.mark.slow) for t in TWINS)])
def test_attractors__of_affine_twins(unit, zero, tmp_path):
    rows = rows_of(unit, zero, tmp_path)
    expected = [("equilibrium", "attracts", 6)] * 2
    assert [(row["kind"], row["stability"], row["n_cells"]) for row in rows] == expected
    places = sorted((row["section_x"] - zero) / unit for row in rows)
    np.testing.assert_allclose(places, [-1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose([row["eigenvalue_real"] for row in rows], -0.5, rtol=1e-6)
