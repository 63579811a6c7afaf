"""Tipping probabilities from overlaps of basins: a toy case on paper, and basins known in closed form."""

import numpy as np
import pytest

from pipeline.analysis.tipping.overlaps import overlap_counts, overlaps_table
from pipeline.runs.derive import derive
from pipeline.specification.problems import SpecError
from tests.core.flows import table
from tests.pipeline.analysis.cubes import line, sweep

TWO_BASINS = table("two-basins", {"x": "(x - a)*(1 - x)*(1 + x)"}, {"a": 0.0})


def test_overlap_counts__of_the_toy_case_of_attractors_jl():
    """Attractors.jl, test/basins/tipping_points_tests.jl: a quarter of one basin, the rest another, cut in half."""
    before = np.ones((20, 20), int)
    before[:10, :10] = 0
    after = np.ones((20, 20), int)
    after[:, 10:] = 2
    first, last, counts = overlap_counts(before, after)
    probability = counts / counts.sum(axis=1, keepdims=True)
    assert (first.tolist(), last.tolist()) == ([0, 1], [1, 2])
    np.testing.assert_allclose(probability, [[1.0, 0.0], [1 / 3, 2 / 3]])
    _, _, counts = overlap_counts(np.array([0, 0, -1, -2]), np.array([0, -1, 0, -2]))
    np.testing.assert_array_equal(counts, [[1, 0], [0, 1]])


@pytest.mark.slow
def test_overlaps__of_basins_whose_boundary_is_known(computed):
    """x = -1 and x = 1 attract, and a lies between their basins: of the 40 starts above 0, 10 lie below 0.5."""
    starts, axes = {"kind": "grid", "x": line(-1.975, 1.975, 80)}, {"a": {"values": [0.0, 0.5]}}
    directory = computed(sweep(TWO_BASINS, starts, axes=axes, frequency_hz=1.0, lengths=(20, 20)))
    ds = derive(directory, "overlaps", {"parameter": "a", "before": 0.0, "after": 0.5})
    np.testing.assert_array_equal(ds["count"], [[40, 0], [10, 30]])
    np.testing.assert_allclose(ds["probability"], [[1.0, 0.0], [0.25, 0.75]])
    assert (ds["low"] <= ds["probability"]).all()
    assert (ds["probability"] <= ds["high"]).all()
    shown = overlaps_table(ds)
    assert len(shown.rows) == 4
    assert any("0.2500" in row for row in shown.lines)
    with pytest.raises(SpecError, match=r"a = 0\.7"):
        derive(directory, "overlaps", {"parameter": "a", "before": 0.0, "after": 0.7})
