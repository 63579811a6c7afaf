"""MAT-files: numbers to the bit, names that MATLAB takes, dims and attributes."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat

from pipeline.results import matlab
from pipeline.specification.problems import SpecError


def loaded(ds, **options):
    return loadmat(io.BytesIO(matlab.matlab_bytes(ds)), **options)


NUMBERS = {
    "double": np.array([[0.1, np.nan, -0.0], [np.inf, 5e-324, 1 / 3]]),
    "single": np.array([0.1, np.nan], np.float32),
    "code": np.array([-1, 0, 127], np.int8),
    "count": np.array([2**31 - 1, -(2**31)], np.int32),
    "long": np.array([2**62 + 1], np.int64),
    "complex": np.array([1 + 2j, np.nan * 1j]),
    "four": np.arange(2 * 3 * 4 * 5.0).reshape(2, 3, 4, 5),
    "trailing": np.arange(6.0).reshape(2, 3, 1),
    "scalar": np.array(2.5),
    "nothing": np.zeros((0, 3)),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_matlab__numbers_keep_type_shape_and_bits(name):
    values = NUMBERS[name]
    dims = [f"{name}_{k}" for k in range(values.ndim)]
    found = loaded(xr.Dataset({name: (dims, values)}))[name]
    assert found.dtype == values.dtype
    assert found.reshape(values.shape).tobytes() == values.tobytes()
    if values.ndim == 1:
        assert found.shape == (len(values), 1)  # a column
    elif values.ndim > 1:
        assert found.shape == values.shape
    about = loaded(xr.Dataset({name: (dims, values)}), simplify_cells=True)["about"]["variables"][name]
    assert np.atleast_1d(about["dims"]).tolist() == dims


def test_matlab__coordinates_texts_truth_values_and_attributes():
    attrs = {"units": "m/s", "long_name": "rate of ψ", "flag_values": np.array([0, 1], np.int8), "list": [1.5, 2]}
    ds = xr.Dataset(
        {"rate": (("frequency", "state"), np.eye(2), attrs), "closed": ("frequency", [True, False])},
        {"frequency": [2.0, 3.0], "state": ["psi1", "ω"]},
        {"title": "a run", "options": {"max period": 3}, "words": ["up", "down"]},
    )
    found = loaded(ds, simplify_cells=True)
    assert found["state"].tolist() == ["psi1", "ω"]
    assert found["frequency"].tolist() == [2.0, 3.0]
    assert found["closed"].tolist() == [1, 0]
    about = found["about"]["variables"]
    assert about["rate"]["dims"].tolist() == ["frequency", "state"]
    assert (about["frequency"]["coordinate"], about["rate"]["coordinate"]) == (1, 0)
    own = about["rate"]["attributes"]
    assert (own["units"], own["long_name"]) == ("m/s", "rate of ψ")
    assert own["flag_values"].dtype == np.int8
    assert own["list"].tolist() == [1.5, 2.0]
    whole = found["about"]["attributes"]
    assert whole["title"] == "a run"
    assert whole["words"].tolist() == ["up", "down"]
    assert whole["options"] == {"max_period": 3, "names": {"max_period": "max period"}}


LONG = "bifurcation_multiplier_of_the_second_harmonic_of_the_third_state_real"


def test_matlab__names_that_matlab_forbids_are_changed_and_kept():
    names = ["about", "end", "2nd", "_x", "x y", "x.y", LONG, f"{LONG}_imag", "ok"]
    ds = xr.Dataset({name: ((), float(k)) for k, name in enumerate(names)})
    found = loaded(ds, simplify_cells=True)
    about = found["about"]["variables"]
    assert {one["name"]: found[own] for own, one in about.items()} == {n: float(k) for k, n in enumerate(names)}
    assert {"about_2", "end_", "x2nd", "x_x", "x_y", "x_y_2", "ok", LONG[:63], f"{LONG[:61]}_2"} == set(about)


@given(st.lists(st.text(min_size=1, max_size=80), unique=True, max_size=30))
def test_legal_names__are_legal_and_distinct(names):
    found = matlab.legal_names(names)
    assert list(found) == names
    assert len(set(found.values())) == len(names)
    for own in found.values():
        assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", own)
        assert own not in matlab._KEYWORDS


def test_matlab__depends_on_the_dataset_alone_and_names_magpend():
    ds = xr.Dataset({"x": ("k", [1.0, 2.0])})
    content = matlab.matlab_bytes(ds)
    assert content == matlab.matlab_bytes(ds)
    assert content.startswith(b"MATLAB 5.0 MAT-file, written by magpend ")
    assert len(content[: matlab.DESCRIPTION_BYTES].rstrip()) < matlab.DESCRIPTION_BYTES


def test_matlab__a_variable_that_is_too_large_is_refused_before_it_is_read():
    large = np.broadcast_to(0.0, (2**28,))  # without memory
    with pytest.raises(SpecError, match=r"large: has 2,147,483,648 bytes.*at most 2,147,483,647.*\.nc"):
        matlab.matlab_bytes(xr.Dataset({"large": ("k", large)}))
