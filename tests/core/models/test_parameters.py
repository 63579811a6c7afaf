import math
import pickle

import numpy as np
import pytest

from magpend_core import ParameterError, load_preset, preset_names, preset_provenance
from magpend_core.models.pendulum.systems import PENDULUM_DIPOLE, PENDULUM_FITTED

TABLE_1 = {
    "g": 9.812,
    "l1": 0.174,
    "m1": 4.275,
    "m2": 1.365,
    "e1": 64.175e-3,
    "e2": 88.292e-3,
    "J1": 45.381e-3,
    "J2": 14.308e-3,
    "T1": 86.004e-3,
    "T2": 18.824e-3,
    "c": 0.759e-3,
    "mu": 0.461e-3,
    "mu0": 0.631,
    "c0": 13.447,
    "eps": 1000.0,
    "duty_cycle": 0.4927,
}
CALIBRATED = {
    "q": 1.543,
    "eps_drive": 54.84,
    "alpha1": 1.1306,
    "alpha2": -1.1306,
    "beta1": 0.0,
    "beta2": 0.0,
    "gamma1": 0.3143,
    "gamma2": 0.3143,
    "p1": 0.5870,
    "p2": 0.5870,
    "r1": -0.05745,
    "r2": 0.05745,
    "c1": 0.05338,
    "c2": 0.05338,
    "eps_mag": 96.85,
    "l2": 0.1788,
    "h": 0.3742,
    "delta": 3.265e-3,
}


def problems_of(**overrides):
    with pytest.raises(ParameterError) as caught:
        load_preset(**overrides)
    assert str(caught.value) == "\n".join(caught.value.problems)
    return caught.value.problems


def test_load_preset__has_the_values_of_table_1_and_of_the_calibration(preset):
    assert preset.as_dict() == TABLE_1 | CALIBRATED
    changed = load_preset(q=1.6, l1=0.2, alpha2=-2, mu=np.float32(0.0)).as_dict()
    expected = preset.as_dict() | {"q": 1.6, "l1": 0.2, "alpha2": -2.0, "mu": 0.0}
    assert changed == expected
    assert all(type(v) is float for v in changed.values())
    origin = preset_provenance()
    assert set(origin) == set(preset.names)
    assert {n for n, text in origin.items() if text == "calibrated"} == set(CALIBRATED)
    assert all(origin[n].startswith("paper") for n in TABLE_1)


def test_preset_names__list_what_ships_and_an_unknown_one_is_refused():
    with pytest.raises(ParameterError, match="did you mean wojna2018"):
        load_preset("wojna2019")
    with pytest.raises(ParameterError, match="known presets: wojna2018"):
        load_preset("zzz")
    assert preset_names() == ("wojna2018",)


@pytest.mark.parametrize(
    ("name", "value", "parts"),
    [
        ("duty_cicle", 0.5, ["'duty_cicle'", "did you mean duty_cycle"]),
        ("xyzzy", 0.5, ["'xyzzy'", "known names: g, l1"]),
        ("m1", -1.0, ["m1 = -1.0", "greater than 0"]),
        ("m2", 0.0, ["m2 = 0.0", "greater than 0"]),
        ("T1", -1e-9, ["T1 = -1e-09", "0 or greater"]),
        ("duty_cycle", 0.0, ["duty_cycle = 0.0", "between 0 and 1"]),
        ("duty_cycle", 1.2, ["duty_cycle = 1.2", "between 0 and 1"]),
        ("q", math.nan, ["q = nan", "not finite"]),
        ("alpha1", math.inf, ["alpha1 = inf", "not finite"]),
        ("q", "1.5", ["q = '1.5'", "not a number"]),
        ("q", True, ["q = True", "not a number"]),
        ("pole1", 1.0, ["'pole1'", "is not a parameter"]),
    ],
)
def test_load_preset__names_value_and_bound_of_a_bad_override(name, value, parts):
    (problem,) = problems_of(**{name: value})
    for part in parts:
        assert part in problem


def test_load_preset__reports_all_problems_at_once():
    problems = problems_of(masss=1.0, m1=-1.0, m2=0.0, q=math.nan, duty_cycle=1.0, eps_mag=-3.0, c1="x")
    found = {p.split(" ")[0].strip("'") for p in problems}
    assert found == {"masss", "m1", "m2", "q", "duty_cycle", "eps_mag", "c1"}
    assert len(problems) == 7


def test_parameters__are_replaced_and_pickled_whole(preset):
    before = preset.as_dict()
    assert preset.replace(q=0.0)["q"] == 0.0
    assert preset.as_dict() == before
    with pytest.raises(TypeError, match="item assignment"):
        preset["q"] = 0.0
    again = pickle.loads(pickle.dumps(preset.replace(q=1.7)))
    assert again == preset.replace(q=1.7)
    assert again.model is preset.model


@pytest.mark.parametrize("h", [0.3528, 0.1])
def test_parameters__dipoles_must_not_meet(preset, dipoles, h):
    # l1 + l2 = 0.3528 m
    with pytest.raises(ParameterError, match=f"h = {h}.*greater than l1"):
        dipoles.replace(h=h)
    assert dipoles.replace(h=0.3529)["h"] == 0.3529
    # the fitted torque has no such bound
    assert preset.replace(h=h)["h"] == h


def test_pack__has_the_order_of_the_systems(preset, dipoles):
    for parameters, system in ((preset, PENDULUM_FITTED), (dipoles, PENDULUM_DIPOLE)):
        packed = parameters.pack()
        assert packed.dtype == np.float64
        assert parameters.names == system.parameter_names
        assert dict(zip(parameters.names, packed, strict=True)) == parameters.as_dict()
    assert preset.names[:18] == dipoles.names[:18] == tuple(TABLE_1) + ("q", "eps_drive")
    parameters = preset.model.parameters
    assert tuple(p.name for p in parameters) == preset.names
    assert all(p.meaning and p.unit and p.bound for p in parameters)
    m1 = preset.model.parameter("m1")
    assert (m1.unit, m1.meaning, m1.bound) == ("kg", "mass of link 1", "greater than 0")
