"""Units: what pint and cf-xarray read is what was meant, and what they cannot read is named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from magpend_core import load_model, model_names
from pipeline.layout.units import readable_unit, shown_unit, unit_remarks
from pipeline.specification.inputs import load_model as load_given

pint = pytest.importorskip("pint")
ROOT = Path(__file__).parents[3]

# exponents of mass, length, time, angle by hand
MEANT = {
    "m/s2": {"meter": 1, "second": -2},
    "m/s^2": {"meter": 1, "second": -2},
    "kg m2": {"kilogram": 1, "meter": 2},
    "kg*m**2": {"kilogram": 1, "meter": 2},
    "1/(m2 s2)": {"meter": -2, "second": -2},
    "m s-1": {"meter": 1, "second": -1},
    "N·m": {"newton": 1, "meter": 1},
    "N m s/rad": {"newton": 1, "meter": 1, "second": 1, "radian": -1},
    "m/s/s": {"meter": 1, "second": -2},
    "rad/s": {"radian": 1, "second": -1},
    "mm": {"millimeter": 1},
    "min": {"minute": 1},
    "Pa s": {"pascal": 1, "second": 1},
    "T": {"tesla": 1},
    "deg": {"degree": 1},
    "%": {"percent": 1},
    "1": {},
    "": {},
    "cells": {},
    "nat": {},  # pint alone reads a nano-atmosphere
}


@pytest.mark.parametrize("text", MEANT)
def test_readable_unit__is_what_was_meant(text):
    from cf_xarray.units import units as cf_units

    for registry in (pint.UnitRegistry(), cf_units):
        found = registry.Unit(readable_unit(text))
        assert found == registry.Unit(registry.UnitsContainer(MEANT[text])), registry
    assert readable_unit(readable_unit(text)) == readable_unit(text)


@pytest.mark.parametrize(
    "text",
    ["widgets", "drive periods", "length of the pendulum", "2 m", "m/", "(m", "m)", "m^", "1e-3 m", "$", "s^1.5"],
)
def test_readable_unit__none(text):
    assert readable_unit(text) is None


def test_readable_unit__of_all_models_that_ship():
    registry = pint.UnitRegistry()
    for name in model_names():
        model = load_model(name)
        assert unit_remarks(model) == [], name
        for entry in (*model.states, *model.parameters, *model.quantities):
            registry.Unit(readable_unit(entry.unit))


def test_readable_unit__of_all_results():
    """Every unit that is written in the sources of the pipeline."""
    found = set()
    for path in {*(ROOT / "pipeline").rglob("*.py")} - {ROOT / "pipeline/layout/conventions.py"}:
        found |= set(re.findall(r'(?:"units": |\bunits=)"([^"]*)"', path.read_text("utf-8")))
    assert {"1/s", "N m", "see state_units"} <= found
    assert {text for text in found if readable_unit(text) is None} == {"see state_units"}


def test_unit_remarks__name_what_nobody_reads():
    text = 'states = {x = {unit = "widgets"}, y = "1"}\nparameters = {a = {value = 1.0, unit = "widgets/s"}}\n'
    model = load_given(f'name = "odd"\n{text}equations = {{x = "-a*x", y = "-y"}}')
    (line,) = unit_remarks(model)
    assert line.startswith("units that other programs cannot read: 'widgets' of x; 'widgets/s' of a. ")


def test_shown_unit__as_the_model_names_it():
    assert shown_unit({"units_as_given": "widgets"}) == "widgets"
    assert shown_unit({"units": "m"}) == "m"
    assert shown_unit({}, "Hz") == "Hz"
