"""Sizes of the states from the starts and a short motion."""

import pytest

from pipeline.layout.evaluation import with_sizes
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
    assert kept.model.scales == kept.model.system.sizes == (1e-9, 1e-3)
    assert [s.escape for s in kept.model.states] == pytest.approx([1.0, 1e6])
    assert with_sizes(kept) is kept
    assert sizes(spec_of("well", 1e-7, 1e6), kept) == (1e-9, 1e-3)
    own = spec_of("well")
    assert with_sizes(own) is own
