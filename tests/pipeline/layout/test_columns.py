"""Columns: meanings and units that are declared once, and filled in for the model of a run."""

from __future__ import annotations

import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.layout.columns import described
from pipeline.products.column import OWN, STATES, Column, in_parts, only, over, with_parts
from pipeline.products.registry import ANALYSES

DUFFING = load_model("duffing")


def of(name, values=0.0, attrs=None, **told):
    """A dataset with one variable."""
    return xr.Dataset({name: ((), values, attrs or {})}, attrs=told)


def test_described__meaning_and_unit():
    ds = described(of("rate"), over("", "1/{time}", rate="growth per {period}"), DUFFING)
    assert ds["rate"].attrs == {"long_name": "growth per drive period", "units": "1/s"}


@pytest.mark.parametrize(
    ("parameter", "unit"), [("frequency", "Hz"), ("frequency_hz", "Hz"), ("amplitude", "m/s2"), ("damping", "1/s")]
)
def test_described__unit_of_the_parameter_that_an_attribute_names(parameter, unit):
    ds = described(of("value", along=parameter), over("", "{along}", value="value"), DUFFING)
    assert ds["value"].attrs["units"] == unit


def test_described__units_of_the_states_texts_without_one_and_what_the_analysis_knows():
    ds = xr.Dataset({"point": ("state", [0.0, 1.0]), "why": ((), "text"), "power": ((), 1.0, {"units": "m2"})})
    columns = over("state", STATES, point="point") + over("", why="reason") + over("", OWN, power="power")
    found = described(ds, columns, DUFFING)
    assert found["point"].attrs["units"] == "m, m/s"
    assert found["why"].attrs == {"long_name": "reason"}
    assert found["power"].attrs == {"long_name": "power", "units": "m2"}
    assert not ds["point"].attrs  # the given one stays as it is


def test_described__attributes_of_the_analysis_stay():
    ds = described(of("n", attrs={"flag_meanings": "a b", "units": "cells"}), over("", n="count"), DUFFING)
    assert ds["n"].attrs == {"flag_meanings": "a b", "units": "cells", "long_name": "count"}


def test_columns__are_written_in_groups():
    assert over("a b", "s", x="time") == (Column("x", "a b", "time", "s"),)
    assert [c.name for c in with_parts(over("", x="size"), "low", "high")] == ["x", "x_low", "x_high"]
    assert in_parts(over("", x="size"), "low")[0].text == "size, lower end of the interval"
    assert [c.name for c in only(over("", x="1", y="2", z="3"), "z x")] == ["z", "x"]


@pytest.mark.parametrize("name", ANALYSES)
def test_columns__of_each_analysis_have_one_declaration_and_plain_words(name):
    columns = ANALYSES[name].columns
    assert columns
    assert len({c.name for c in columns}) == len(columns)
    for column in columns:
        assert column.text[:1].islower() or column.text[:1].isdigit() or column.text.split()[0] in PROPER, column
        assert not column.text.endswith("."), column
        assert column.text.count("{") == column.text.count("}"), column


PROPER = ("Floquet", "Kaplan-Yorke", "Lyapunov", "R", "{periods}")
