"""States below `atol` that come back: found from a run's last sections, with the logarithm of the state."""

import json

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from magpend_core.status import Status
from pipeline.layout.small_states import one_sided, small_states
from tests.core.flows import table
from tests.pipeline.analysis.cubes import attributes_of

# periods and least prey integrated in logarithms with DOP853
PREY = table("rosenzweig", {"x": "x*(1 - x/K) - x*y/(1 + x)", "y": "y*(.8*x/(1 + x) - .3)"}, {"K": 15.0})
DECAY = table("decay", {"x": "-x", "v": "v - v**3 + 0*x"}, {"K": 1.0})


def found_in(text, start, *, atol=1e-8, **changes):
    """Small states of one cell that has closed on an orbit of about 100 s, with its last section."""
    parameters = load_model(text).load(**changes)
    found = {
        "section": (("initial_condition", "period_index", "state"), np.array(start)[None, None]),
        "status": ("initial_condition", [int(Status.PERIODIC)]),
        "orbit_period": ("initial_condition", [1]),
        "return_time": (("initial_condition", "period_index"), [[100.0]]),
    }
    own = {**attributes_of(parameters), "model": json.dumps(parameters.model.reference), "atol": atol}
    ds = xr.Dataset(found, coords={"state": list(parameters.model.state_names)}, attrs=own)
    return small_states(parameters, lambda: ds)


def test_one_sided__states_whose_rate_vanishes_with_them():
    assert one_sided(load_model(PREY), {"K": 15.0}).tolist() == [True, True]
    pushed = table("pushed", {"x": "x*(1 - x) + m*cos(phase)", "y": "-y"}, {"m": 0.1})
    assert one_sided(load_model(pushed), {"m": 0.1}).tolist() == [False, True]
    circle = table("circle", {"a": "sin(a)"}, {"m": 0.1}, states={"a": {"on_circle": True}})
    assert one_sided(load_model(circle), {"m": 0.1}).tolist() == [False]


@pytest.mark.parametrize(("capacity", "start", "least"), [(15.0, 3.016e-5, 4.3e-15), (25.0, 6.018e-9, 9.3e-25)])
def test_small_states__a_population_that_almost_dies_out(capacity, start, least):
    found = found_in(PREY, [0.6, start], K=capacity)
    assert found[0].startswith("warning: x falls to ")
    assert float(found[0].split()[4].rstrip(",")) == pytest.approx(least, rel=0.2)
    assert "give an atol below" in found[0]
    assert "log(x)" in found[0]
    assert found_in(PREY, [0.6, start], K=capacity, atol=1e-30) == []


def test_small_states__nothing_to_say():
    # at K = 5 the prey stays above 8e-4; a state that dies out does not come back
    assert found_in(PREY, [0.6, 0.07926], K=5.0) == []
    assert found_in(DECAY, [1.0, 0.5]) == []


def test_small_states__opens_no_cube_where_no_state_keeps_its_sign():
    def closed():
        raise AssertionError("the cube is opened")

    pushed = table("pushed", {"x": "x*(1 - x) + m*cos(phase)"}, {"m": 0.1})
    assert small_states(load_model(pushed).load(), closed) == []
    assert small_states(load_model("double-pendulum").load(), closed) == []
