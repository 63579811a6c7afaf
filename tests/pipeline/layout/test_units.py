"""Units: what pint and cf-xarray read is what was meant, and what they cannot read is named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from magpend_core import load_model, model_names
from pipeline.layout.conventions import readable_unit, unit_remarks

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.slow

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


@pytest.fixture(scope="module")
def registries():
    pint = pytest.importorskip("pint")
    return pint.UnitRegistry(), pytest.importorskip("cf_xarray.units").units


def test_readable_unit__is_what_was_meant(registries):
    for text, meant in MEANT.items():
        for registry in registries:
            found = registry.Unit(readable_unit(text))
            assert found == registry.Unit(registry.UnitsContainer(meant)), (text, registry)
        assert readable_unit(readable_unit(text)) == readable_unit(text)


def test_readable_unit__of_all_models_that_ship(registries):
    registry, _ = registries
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
