"""Words and units in cubes, tables and figures: what pint and cf-xarray read is what was meant."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_model, model_names
from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.layout.conventions import conventional, readable_unit, unit_remarks
from pipeline.layout.vocabulary import frequency_of, model_attribute, model_of, section_attributes, told_by
from pipeline.plots.section import section_pair
from pipeline.specification.models import load_model as load_given
from tests.core.flows import ROSSLER, VAN_DER_POL, flow


def test_clock__each_way_to_look():
    whole = flow(VAN_DER_POL)
    seen = sectioned(whole, Crossing("v", 0.5, "down"))
    assert [m.clock.period for m in (load_model(), whole, seen)] == ["drive period", "strobe period", "return"]
    assert seen.clock.once == "crossing of v = 0.5 going down"
    assert seen.clock.section == "Poincar\u00e9 section"


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


def test_model_of__method():
    """What is computed of a stiff run, and of its results, is integrated by the run's method."""
    attrs = {"model": model_attribute(flow(VAN_DER_POL)), **section_attributes(Crossing("v"))}
    for own, method in (({}, "dopri5"), ({"method": "dop853"}, "dopri5"), ({"method": "rodas5p"}, "rodas5p")):
        assert model_of(xr.Dataset(attrs=told_by(attrs | own))).system.method == method
    assert "method" not in told_by({"method": "dop853"})


def test_section_pair__leaves_the_crossing_state_out():
    assert section_pair(sectioned(flow(ROSSLER), Crossing("x"))) == ("y", "z")
    assert section_pair(sectioned(flow(ROSSLER), Crossing("y"))) == ("x", "z")
    assert section_pair(sectioned(flow(ROSSLER), Crossing("y")), "z") == ("z", "x")
    # in a plane one state is left: it is drawn over the other
    assert section_pair(sectioned(flow(VAN_DER_POL), Crossing("v"))) == ("x", "v")
    assert section_pair(load_model())[0] == load_model().portraits[0][0]


def test_readable_unit__none():
    phrases = ["widgets", "drive periods", "length of the pendulum"]
    for text in [*phrases, "2 m", "m/", "(m", "m)", "m^", "1e-3 m", "$", "s^1.5"]:
        assert readable_unit(text) is None, text


def test_unit_remarks__name_what_nobody_reads():
    text = 'states = {x = {unit = "widgets"}, y = "1"}\nparameters = {a = {value = 1.0, unit = "widgets/s"}}\n'
    model = load_given(f'name = "odd"\n{text}equations = {{x = "-a*x", y = "-y"}}')
    (line,) = unit_remarks(model)
    assert line.startswith("units that other programs cannot read: 'widgets' of x; 'widgets/s' of a. ")


def test_conventional__axes_are_continuous():
    """A number of something, such as a period, is no axis, even with a unit."""
    counts, places = ("n", [1, 2], {"units": "1"}), ("force", [0.1, 0.2], {"units": "N"})
    ds = conventional(xr.Dataset({"a": (("n", "force"), np.zeros((2, 2)))}, {"n": counts, "force": places}))
    assert ds["force"].attrs["axis"] == "X"
    assert "axis" not in ds["n"].attrs


# ---- units -----------------------------------------------------------------------------------------------

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


@pytest.fixture(scope="module")
def registries():
    pint = pytest.importorskip("pint")
    return pint.UnitRegistry(), pytest.importorskip("cf_xarray.units").units


@pytest.mark.slow
def test_readable_unit__is_what_was_meant(registries):
    for text, meant in MEANT.items():
        for registry in registries:
            found = registry.Unit(readable_unit(text))
            assert found == registry.Unit(registry.UnitsContainer(meant)), (text, registry)
        assert readable_unit(readable_unit(text)) == readable_unit(text)


@pytest.mark.slow
def test_readable_unit__of_all_models_that_ship(registries):
    registry, _ = registries
    for name in model_names():
        model = load_model(name)
        assert unit_remarks(model) == [], name
        for entry in (*model.states, *model.parameters, *model.quantities):
            registry.Unit(readable_unit(entry.unit))


@pytest.mark.slow
def test_readable_unit__of_all_results():
    """Every unit that is written in the sources of the pipeline."""
    found = set()
    for path in {*(ROOT / "pipeline").rglob("*.py")} - {ROOT / "pipeline/layout/conventions.py"}:
        found |= set(re.findall(r'(?:"units": |\bunits=)"([^"]*)"', path.read_text("utf-8")))
    assert {"1/s", "N m", "see state_units"} <= found
    assert {text for text in found if readable_unit(text) is None} == {"see state_units"}
