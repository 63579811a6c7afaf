"""Words and names of flows in cubes, tables and figures."""

from __future__ import annotations

import xarray as xr

from magpend_core import load_model
from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.layout.period_names import once, period_of, section_name
from pipeline.layout.vocabulary import frequency_of, model_attribute, model_of, section_attributes, told_by
from pipeline.plots.section import section_pair
from tests.core.flows import ROSSLER, VAN_DER_POL, flow


def test_period_of__each_way_to_look():
    whole = flow(VAN_DER_POL)
    seen = sectioned(whole, Crossing("v", 0.5, "down"))
    assert period_of(load_model()) == "drive period"
    assert period_of(whole) == "strobe period"
    assert period_of(seen) == "return"
    assert once(seen) == "crossing of v = 0.5 going down"
    assert once(load_model()) == "once per drive period"
    assert section_name(load_model()) == "stroboscopic section"
    assert section_name(seen) == "Poincar\u00e9 section"


def test_model_of__section():
    """A dataset tells its section by its attributes, and so does what is derived from it."""
    seen = sectioned(flow(ROSSLER), Crossing("x", 1.5, "down", 40.0))
    attrs = {"model": model_attribute(seen), **section_attributes(seen.crossing), "rtol": 1e-8}
    found = model_of(xr.Dataset(attrs=attrs))
    assert found is seen
    assert model_of(xr.Dataset(attrs=told_by(attrs))) is seen
    assert "rtol" not in told_by(attrs)
    assert frequency_of(found, {"frequency": 3.0}) == 1.0 / 40.0
    assert frequency_of(load_model(), {"frequency": 3.0}) == 3.0


def test_section_pair__leaves_the_crossing_state_out():
    assert section_pair(sectioned(flow(ROSSLER), Crossing("x"))) == ("y", "z")
    assert section_pair(sectioned(flow(ROSSLER), Crossing("y"))) == ("x", "z")
    assert section_pair(sectioned(flow(ROSSLER), Crossing("y")), "z") == ("z", "x")
    # in a plane one state is left: it is drawn over the other
    assert section_pair(sectioned(flow(VAN_DER_POL), Crossing("v"))) == ("x", "v")
    assert section_pair(load_model())[0] == load_model().portraits[0][0]
