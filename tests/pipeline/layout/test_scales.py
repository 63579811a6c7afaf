"""Sizes of the states from the starts and a short motion."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.layout.evaluation import check_starts
from pipeline.layout.extents import with_sizes
from pipeline.layout.small_states import one_sided
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec

TEXT = {
    "well": {"x": "v", "v": "w**2*x*(1 - (x/s)**2) - 0.1*w*v"},
    "cycle": {"x": "v", "v": "w*(1 - (x/s)**2)*v - w**2*x"},
    "rest": {"x": "v", "v": "-w**2*x - 0.1*w*v"},
    "ball": {"x": "v", "v": "-s*w**2"},
}


def spec_of(name, s=1.0, w=1.0, *, start=2.0, frequency=0.1, **state):
    model = {
        "name": name,
        "states": {"x": {"unit": "m", **state}, "v": "m/s"},
        "parameters": {"s": s, "w": w},
        "equations": {**TEXT[name], "v": f"{TEXT[name]['v']} + 0*cos(2*pi*f*t)"},
    }
    if name == "ball":
        model["impacts"] = [{"of": "x", "direction": "down", "set": {"v": "-0.9*v"}, "stick": True}]
    x = {"start": 0.1 * start * s, "stop": start * s, "num": 4}
    return Spec.parse(
        {
            "kind": "sweep",
            "model": model,
            "initial_conditions": {"kind": "grid", "x": x},
            "integration": {"n_transient": 20},
            "parameters": {"frequency_hz": frequency * w},
        }
    )


def sizes(spec, kept=None):
    return tuple(s.size for s in with_sizes(spec, kept).model.states)


@pytest.mark.parametrize("name", TEXT)
def test_with_sizes__in_any_units(name):
    assert sizes(spec_of(name)) == (1.0, 1.0)
    assert sizes(spec_of(name, 1e-9, 1e6)) in {(1e-9, 1e-3), (1e-9, 1e-4)}
    assert sizes(spec_of(name, 1e12, 1e-6)) in {(1e12, 1e6), (1e11, 1e5), (1e12, 1e5)}


def test_with_sizes__the_motion_counts_more_than_its_starts():
    assert sizes(spec_of("cycle", start=1e-3)) == (1.0, 1.0)
    assert sizes(spec_of("cycle", 1e-9, start=1e-3)) == (1e-9, 1e-9)


def test_with_sizes__what_a_specification_or_a_run_says():
    assert sizes(spec_of("well", 1e-9, 1e6, scale=1e-7))[0] == 1.0
    kept = with_sizes(spec_of("well", 1e-9, 1e6))
    assert kept.model.system.sizes == kept.model.system.units == (1e-9, 1e-3)
    assert [s.escape for s in kept.model.states] == pytest.approx([1.0, 1e6])
    assert with_sizes(kept) is kept
    assert sizes(spec_of("well", 1e-7, 1e6), kept) == (1e-9, 1e-3)


def measures(spec):
    return np.array([s.motion for s in with_sizes(spec).model.states])


@pytest.mark.parametrize("name", TEXT)
@pytest.mark.parametrize("length", [1e-9, 0.03, 300.0, 1e6])
def test_with_sizes__the_measure_follows_the_unit_without_a_dead_band(name, length):
    plain = measures(spec_of(name))
    np.testing.assert_allclose(measures(spec_of(name, length)), length * plain, rtol=1e-9)
    np.testing.assert_allclose(measures(spec_of(name, length, 10.0)), length * plain * [[1.0], [10.0]], rtol=1e-9)


def affine(unit, zero):
    """Two wells of depth 1/4 at zero - unit and zero + unit; one of twelve starts begins far out."""
    x = f"((x - {zero!r})/{unit!r})"
    return Spec.parse(
        {
            "kind": "sweep",
            "model": {
                "name": "affine",
                "states": {"x": {}, "v": {}},
                "equations": {"x": "v", "v": f"{unit!r}*({x} - {x}**3) - 0.5*v"},
            },
            "section": {"of": "x", "value": zero, "longest": 50.0},
            "initial_conditions": {
                "kind": "grid",
                "x": {"start": zero - 1.5 * unit, "stop": zero + 1.6 * unit, "num": 12},
            },
        }
    )


@pytest.mark.parametrize(("unit", "zero"), [(1.0, 1000.0), (1e-6, 1e-3), (300.0, -3e5)])
def test_with_sizes__the_measure_leaves_out_where_the_zero_is(unit, zero):
    plain = measures(affine(1.0, 0.0))
    moved = measures(affine(unit, zero)) - [[zero], [0.0]]
    np.testing.assert_allclose(moved, unit * plain, rtol=1e-6, atol=1e-6 * unit)


def test_with_sizes__wide_starts_do_not_hide_a_small_attractor():
    model = {"name": "small", "states": {"u": {}}, "equations": {"u": "u*(0.01 - u)*(u - 0.02)*1e4"}}
    points = [[0.001], [0.011], [0.019], [0.021], [5.0]]
    spec = {
        "kind": "sweep",
        "model": model,
        "section": {"of": "u", "value": 0.015, "longest": 100.0},
        "initial_conditions": {"kind": "list", "points": points},
    }
    ((low, high),) = measures(Spec.parse(spec))
    assert high - low == pytest.approx(0.1 * 5.0, rel=0.01)  # a tenth of the whole motion at most


def test_with_sizes__a_stiff_motion_counts_its_jumps():
    """Van der Pol's oscillator (mu = 1000) leaves 2 at a rate of 1/1500 1/s, while explicit steps are 1/1200 s."""
    spec = spec_of("cycle").as_dict()
    spec["model"] = {**spec["model"], "equations": {"x": "v", "v": "1e3*(1 - x**2)*v - x"}}
    spec["parameters"] = {"frequency_hz": 1e-2}
    spec["initial_conditions"] = {"kind": "list", "points": [[2.0, 0.0]]}
    (low, high), speed = measures(Spec.parse(spec))
    assert (low, high) == pytest.approx((-2.0, 2.0), abs=0.1)
    assert np.ptp(speed) > 1e3


@pytest.mark.parametrize(("given", "message"), [([1.0], "two numbers"), ([2.0, 1.0], "below the second")])
def test_motion_of_a_state__is_checked(given, message):
    with pytest.raises(SpecError, match=message):
        spec_of("well", motion=given)


def test_parameter__called_as_the_drives_frequency_is_the_parameter():
    """The motion, the domains of the starts and the signs of states have the parameter f, not the frequency 0.1 Hz."""
    found = []
    for name in ("f", "g"):
        spec = Spec.parse(
            {
                "kind": "sweep",
                "model": {
                    "name": "named",
                    "states": {"x": {}, "v": {}},
                    "parameters": {name: 3.0},
                    "equations": {"x": "v", "v": f"{name}*(1 - x**2)*v - x + 0*log({name} - 0.2)"},
                },
                "initial_conditions": {"kind": "grid", "x": {"start": 0.1, "stop": 2.0, "num": 4}},
                "integration": {"n_transient": 20},
                "parameters": {"frequency_hz": 0.1},
            }
        )
        check_starts(spec)
        found.append([s.motion for s in with_sizes(spec).model.states])
    assert found[0] == found[1]
    assert found[0][1][1] > 4.0
    one = {"name": "one", "states": {"x": {}}, "parameters": {"f": 0.3}, "equations": {"x": "f - 0.3 - x"}}
    assert one_sided(load_model(one), {"f": 0.3}).tolist() == [True]
