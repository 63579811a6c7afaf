"""Attractors matched over runs for draws of the parameters, on sets whose identity is known."""

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.attractors import matching
from pipeline.layout.vocabulary import model_attribute
from tests.pipeline.analysis.dense_sets import rows_of

PERIODIC = 2


def match_across(runs, **options):
    """Common ids of the attractors of runs, whose sets are on the dim ``attractor``."""
    return matching.match_across([rows_of(run) for run in runs], **options)


def run_of(*sets):
    """Attractors over four parameter points; each is (place of its points, first point, last point, period)."""
    shape = (4, len(sets))
    kind, period, share = np.zeros(shape, np.int8), np.zeros(shape, int), np.zeros(shape)
    points = np.full((*shape, 2, 2), np.nan)
    for k, (x, first, last, p) in enumerate(sets):
        for i in range(first, last + 1):
            kind[i, k], period[i, k], share[i, k] = PERIODIC, p, 0.4
            points[i, k, :p] = [[x + 0.05 * i, j] for j in range(p)]
    return xr.Dataset(
        {
            "kind": (("frequency", "attractor"), kind),
            "orbit_period": (("frequency", "attractor"), period),
            "share": (("frequency", "attractor"), share),
            "attractor_points": (("frequency", "attractor", "point", "state"), points),
        },
        attrs={"model": model_attribute(load_model("duffing"))},
    )


def test_match_across__follows_attractors_whatever_their_order():
    best = run_of((0.0, 0, 3, 1), (1.0, 0, 3, 1))
    # the first one has moved towards the second, and the order is another
    found = match_across([best, run_of((1.1, 0, 3, 1), (0.2, 0, 3, 1)), run_of((0.1, 2, 3, 1))])
    assert [ids.tolist() for ids in found] == [[0, 1], [1, 0], [0]]
    best = run_of((0.0, 0, 3, 1))
    found = match_across([best, run_of((0.0, 0, 3, 1), (2.0, 1, 2, 1)), run_of((2.1, 0, 1, 1), (0.0, 0, 3, 1))])
    assert [ids.tolist() for ids in found] == [[0], [0, 1], [1, 0]]
    found = match_across([run_of((0.0, 0, 3, 1)), run_of((0.05, 0, 3, 1), (0.1, 0, 3, 1))])
    assert sorted(found[1].tolist()) == [0, 1]
    assert found[1][0] == 0
    run = run_of((0.0, 0, 3, 1), (1.0, 0, 3, 1))
    run["share"][:, 0] = 0.0
    assert match_across([run])[0].tolist() == [-1, 0]


@pytest.mark.parametrize(("other", "expected"), [((0.0, 0, 3, 2), 0), ((0.5, 0, 3, 1), 1)])
def test_match_across__a_doubled_orbit_is_the_same_and_a_far_one_is_not(other, expected):
    # periods 1 and 2 are of one cascade; the doubled orbit's mean distance is half of that of its second point
    found = match_across([run_of((0.0, 0, 3, 1)), run_of(other)], threshold=0.55 if other[3] == 2 else 0.3)
    assert found[1].tolist() == [expected]
