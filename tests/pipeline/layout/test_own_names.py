"""Swept parameters under the names that the specification gives them."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.branches.declaration import BRANCH_COLUMNS, CURVE_COLUMNS
from pipeline.layout.own_words import RATE, in_own_words, with_own_names, with_plain_names
from pipeline.layout.vocabulary import model_attribute

HERTZ = np.array([[0.5, 0.25], [0.125, np.nan]])
ABOUT = {"model": model_attribute(load_model("duffing"))}


def branches(parameter: str, **attrs: str) -> xr.Dataset:
    unit = {"units": "Hz", "long_name": "value of the parameter"}
    return xr.Dataset(
        {
            "parameter": (("branch", "point"), HERTZ, unit),
            "value": ("bifurcation", [0.25], {**unit, "long_name": "parameter value of the bifurcation"}),
            "kind": ("bifurcation", [1]),
        },
        attrs={**ABOUT, "parameter": parameter, **attrs},
    )


def test_with_own_names__of_a_parameter() -> None:
    found = with_own_names(branches("F"), BRANCH_COLUMNS)
    assert set(found.coords) == {"F", "bifurcation_F"}
    assert set(found.data_vars) == {"kind"}
    xr.testing.assert_identical(with_plain_names(found), branches("F"))


@pytest.mark.parametrize(
    ("word", "column", "factor", "power"), [("omega", "omega", 2 * np.pi, 1), ("period", "drive_period", 1, -1)]
)
def test_with_own_names__of_the_drive(word: str, column: str, factor: float, power: int) -> None:
    ds = branches("frequency", **{RATE: word})
    found = with_own_names(ds, BRANCH_COLUMNS)
    assert set(found.coords) == {"frequency", column, "bifurcation_frequency", f"bifurcation_{column}"}
    np.testing.assert_allclose(found[column], factor * HERTZ**power, rtol=1e-14)
    np.testing.assert_allclose(found[f"bifurcation_{column}"], [factor * 0.25**power], rtol=1e-14)
    assert found[column].attrs["units"] == {"omega": "rad/s", "period": "s"}[word]
    xr.testing.assert_identical(with_plain_names(found), ds)
    # tables and figures show the word alone, from either form
    xr.testing.assert_identical(in_own_words(found), in_own_words(ds))
    assert in_own_words(found)["parameter"].attrs["units"] == found[column].attrs["units"]


@pytest.mark.parametrize("name", ["kind", "value", "point", "residual"])
def test_with_own_names__of_a_parameter_that_has_the_name_of_a_column(name: str) -> None:
    found = with_own_names(branches(name), BRANCH_COLUMNS)
    assert set(found.coords) == {f"parameter_{name}", f"bifurcation_{name}"}
    xr.testing.assert_identical(with_plain_names(found), branches(name))


def test_with_own_names__of_a_plane_and_of_a_cube() -> None:
    plane = xr.Dataset({name: ("special", [1.0]) for name in ("special_first", "special_second")})
    plane.attrs = {**ABOUT, "first_parameter": "frequency", "second_parameter": "amplitude"}
    found = with_own_names(plane, CURVE_COLUMNS)
    assert set(found.coords) == {"special_frequency", "special_amplitude"}
    cube = xr.Dataset({"status": ("frequency", [1])}, {"frequency": [0.5]}, {**ABOUT, RATE: "omega"})
    found = with_own_names(cube)
    assert found["omega"].dims == ("frequency",)
    assert found["omega"].values.tolist() == [3.14159265358979]
    # a part of the cube has its part of it
    assert float(found.isel(frequency=0)["omega"]) == 3.14159265358979
