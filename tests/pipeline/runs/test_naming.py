"""Axes, parameters and states by any of their spellings."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.branches.declaration import BranchOptions
from pipeline.layout.own_words import RATE
from pipeline.products.product import FigureOptions, StateOptions
from pipeline.results import selection
from pipeline.runs.naming import named, place
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory


@pytest.fixture
def run(made):
    return RunDirectory.open(made.info.directory)


@pytest.mark.slow
def test_place__every_spelling(run):
    for name, value, degrees, expected in (
        ("frequency", 2.5, False, ("frequency", 2.5)),
        ("frequency_hz", 2.5, True, ("frequency", 2.5)),
        ("q", 1.5, True, ("q", 1.5)),
        ("psi1_0", 0.1, False, ("psi1_0", 0.1)),
        ("psi1", 0.1, False, ("psi1_0", 0.1)),
        ("psi1", 30.0, True, ("psi1_0", math.radians(30.0))),
        ("psi2_deg", 30.0, False, ("psi2_0", math.radians(30.0))),
    ):
        assert place(run.cube(), name, value, degrees) == expected


def test_named__axes_parameters_and_states_of_the_run(run):
    options = named(run, StateOptions(at={"frequency_hz": 2.0, "psi1_deg": 10.0}))
    assert options.at == {"frequency": 2.0, "psi1_0": math.radians(10.0)}
    assert options.state == "psi1"
    assert named(run, BranchOptions(parameter="frequency")).parameter == "frequency_hz"
    assert named(run, FigureOptions()) == FigureOptions()


def test_named__names_the_nearest(run):
    for options, sentence in (
        (FigureOptions(at={"freqency": 1.0, "qq": 1.0}), r"(?s)'freqency'; did you mean frequency.*'qq'"),
        (FigureOptions(at={"duty_cycle": 0.5}), "unknown axis 'duty_cycle'; known: frequency_hz, q"),
        (StateOptions(state="psi3"), "unknown state 'psi3'; did you mean psi"),
        (BranchOptions(parameter="eps_drve"), "unknown parameter 'eps_drve'; did you mean eps_drive"),
    ):
        with pytest.raises(SpecError, match=sentence):
            named(run, options)


@pytest.mark.parametrize(
    ("rate", "wrong", "missing", "left_over"),
    [
        ("frequency_hz", "frequency_hz = 0.3 lies off its axis, which runs from 0.1 to 0.2", "known: freq", "=0.2"),
        (
            "omega",
            "omega = 1.884955592 lies off its axis, which runs from 0.6283185307 to 1.256637061",
            "known: omega",
            "=",
        ),
        ("period", "period = 3.333333333 lies off its axis, which runs from 5 to 10", "known: period", "=5"),
    ],
)
def test_selection__refuses_in_the_word_of_the_specification(rate, wrong, missing, left_over):
    axis = {"frequency": [0.1, 0.2]}
    status = xr.DataArray(np.zeros((2, 1)), dims=("frequency", "initial_condition"))
    ds = xr.Dataset({"status": status}, axis, {RATE: rate})
    for at, message in (({"frequency": 0.3}, wrong), ({"q": 1.0}, missing)):
        with pytest.raises(ValueError, match=message):
            selection.select_points(ds, at)
    with pytest.raises(
        ValueError, match=f"also has {rate} .2 values.: choose a value of each, such as --at {rate}{left_over}"
    ):
        selection.select_points(ds, None, purpose="one point is drawn")
