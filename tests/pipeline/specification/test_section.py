"""Sections by crossing in a specification: what is read, and what is refused."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from pipeline.layout.cells import CellMap, coordinates
from pipeline.layout.evaluation import check_starts
from pipeline.layout.plan import make_plan
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from tests.core.flows import VAN_DER_POL

SPEC = {
    "kind": "sweep",
    "model": VAN_DER_POL,
    "section": {"of": "v", "value": 0.5, "direction": "down", "longest": 50.0},
    "axes": {"mu": {"values": [0.5, 1.0]}},
    "initial_conditions": {"kind": "list", "points": [[1.0, 0.0], [2.0, 0.0]]},
}


def problems(**changes):
    data = {k: v for k, v in {**copy.deepcopy(SPEC), **changes}.items() if v is not None}
    with pytest.raises(SpecError) as error:
        Spec.parse(data)
    return error.value.problems


def test_parse_spec__section():
    spec = Spec.parse(SPEC)
    assert spec.model.crossing.sentence == "v = 0.5 going down"
    assert spec.values.as_dict() == {"mu": 1.0, "section_value": 0.5}
    assert spec.frequency_hz == 1.0 / 50.0
    again = Spec.parse(spec.as_dict())
    assert again == spec
    assert again.model is spec.model
    assert pickle.loads(pickle.dumps(spec.values)) == spec.values
    default = Spec.parse({**SPEC, "section": {"of": "x"}}).section
    assert default.model_dump() == {"of": "x", "value": 0.0, "direction": "up", "longest": 100.0}


def test_parse_spec__section_of_an_expression():
    spec = Spec.parse({**SPEC, "section": {"of": "x + mu*v - 1", "longest": 50.0}})
    assert spec.model.crossing.sentence == "x + mu*v - 1 = 0 going up"
    assert spec.values.as_dict() == {"mu": 1.0, "section_value": 0.0}
    again = Spec.parse(spec.as_dict())
    assert again == spec
    assert again.model is spec.model
    assert pickle.loads(pickle.dumps(spec.values)) == spec.values
    assert spec.model.system.surface is not None


def test_cells__no_frequency():
    """The cube has no drive, the engine gets the longest wait and the level."""
    spec = Spec.parse(SPEC)
    names = [c.name for c in coordinates(spec)]
    assert "frequency" not in names
    plan = make_plan(spec)
    assert plan.dims == ("mu", "initial_condition")
    assert {"return_time", "rest_state"} <= {v.name for v in plan.variables}
    assert "returns" in next(v.long_name for v in plan.variables if v.name == "n_periods")
    inputs = CellMap(spec).inputs((slice(0, 2), slice(0, 2)))
    np.testing.assert_array_equal(inputs.frequency_hz, 0.02)
    np.testing.assert_array_equal(inputs.parameters[:, 0], [[0.5, 0.5], [0.5, 0.5], [1.0, 0.5], [1.0, 0.5]])


def test_identity__every_key_of_the_section():
    spec = Spec.parse(SPEC)
    for change in ({"of": "x"}, {"value": 0.4}, {"direction": "up"}, {"longest": 40.0}):
        other = Spec.parse({**SPEC, "section": {**SPEC["section"], **change}})
        assert make_plan(spec).identity != make_plan(other).identity, change


def test_parse_spec__swept_level():
    spec = Spec.parse({**SPEC, "axes": {"section_value": {"values": [-0.5, 0.5]}}})
    inputs = CellMap(spec).inputs((slice(0, 2), slice(0, 1)))
    np.testing.assert_array_equal(inputs.parameters[:, 0, 1], [-0.5, 0.5])


def test_parse_spec__neither_section_nor_frequency():
    (text,) = problems(section=None)
    assert text.startswith("section: missing; van_der_pol has no drive. Add [section]")
    assert "or parameters.frequency_hz" in text


def test_parse_spec__strobed_flow():
    data = {k: v for k, v in SPEC.items() if k != "section"} | {"parameters": {"frequency_hz": 0.15}}
    spec = Spec.parse(data)
    assert spec.section is None
    assert "frequency" in [c.name for c in coordinates(spec)]


FREQUENCY = "a section by crossing needs no frequency; drop one of the two."


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"section": {"of": "w"}}, "section.of = 'w': is not a state of van_der_pol; known states: x, v."),
        ({"section": {"of": "x + w"}}, "section.of: \"x + w\": unknown name 'w' at character 5; known names: x, v"),
        ({"section": {"of": "2*mu"}}, "section.of = '2*mu': names no state of van_der_pol, so nothing crosses"),
        ({"section": {"of": "x + 0*v - x"}}, "section.of = 'x + 0*v - x': is the same at all states"),
        ({"section": {"of": "x", "direction": "left"}}, "section.direction = 'left': must be 'up' or 'down'."),
        ({"section": {"of": "x", "longest": 0.0}}, "section.longest = 0.0: must be greater than 0.0."),
        ({"section": {"value": 0.0}}, "section.of: missing"),
        ({"section": 3}, "section = 3: must be a table; write [section]."),
        ({"parameters": {"frequency_hz": 1.0}}, f"parameters.frequency_hz: {FREQUENCY}"),
        ({"axes": {"frequency_hz": {"values": [1.0]}}}, f"axes.frequency_hz: {FREQUENCY}"),
        ({"model": "duffing", "axes": {"amplitude": {"values": [0.3]}}}, "section: duffing has a drive"),
    ],
)
def test_parse_spec__refused(changes, text):
    found = problems(**changes)
    assert any(p.startswith(text) for p in found), found


def test_check_starts__what_the_motion_keeps_at_the_parameters_of_the_run():
    """The energy of an oscillator is no section without damping, and is one where an axis has some."""
    model = {
        "name": "damped",
        "states": {"x": {}, "v": {}},
        "parameters": {"k": 2.0, "c": 0.0},
        "equations": {"x": "v", "v": "-k*x - c*v"},
        "quantities": {"energy": "k*x**2 + v**2"},
    }
    own = {**SPEC, "model": model, "section": {"of": "energy", "value": 1.0}, "axes": {"k": {"values": [1.0, 2.0]}}}
    with pytest.raises(SpecError, match="'energy': at the run's parameters it does not change along the motion"):
        check_starts(Spec.parse(own))
    check_starts(Spec.parse({**own, "axes": {"c": {"values": [0.0, 0.5]}}}))
    check_starts(Spec.parse({**own, "section": {"of": "energy - v", "value": 1.0}}))
