"""Branches and bifurcations chosen by the values of the parameters that stay fixed along them."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.branches.levels import at_levels, bifurcations_at, levels_of_bifurcations, refuse_at
from pipeline.specification.problems import SpecError


def branches():
    """Four branches at two levels of F: the last springs from the third bifurcation, at the higher level."""
    return xr.Dataset(
        {
            "origin": ("branch", [-1, -1, -1, 2]),
            "of_branch": ("bifurcation", [0, 1, 1, 3]),
            "to_branch": ("bifurcation", [-1, -1, 3, 1]),
            "value": ("bifurcation", [0.5, 0.6, 0.7, 0.8]),
            "jump_bifurcation": ("jump", [0, 1, 3]),
        },
        {"F": ("branch", [1.0, 3.0, 1.0, 3.0], {"long_name": "value of F"})},
        {"parameter": "omega"},
    )


def test_at_levels__keeps_branches_bifurcations_and_jumps_of_the_level():
    part = at_levels(branches(), {"F": 3.0})
    assert part["F"].values.tolist() == [3.0, 3.0]
    assert part["value"].values.tolist() == [0.6, 0.7, 0.8]
    # indices count the branches and bifurcations that are left
    assert part["of_branch"].values.tolist() == [0, 0, 1]
    assert part["to_branch"].values.tolist() == [-1, 1, 0]
    assert part["origin"].values.tolist() == [-1, 1]
    assert part["jump_bifurcation"].values.tolist() == [0, 2]
    assert at_levels(branches(), {}).identical(branches())
    # an axis of one value is no level
    assert at_levels(branches(), {"damping": 0.1}).identical(branches())


def test_at_levels__refuses_a_value_without_branches_and_the_followed_parameter():
    with pytest.raises(SpecError, match=r"at F = 2: there is no branch; there are some at F = 1, 3"):
        at_levels(branches(), {"F": 2.0})
    with pytest.raises(SpecError, match=r"'omega'.*known: F.*axis of the figure"):
        at_levels(branches(), {"omega": 1.0})


def sensitivities():
    value = np.array([[0.1, 1.0, 2.0], [0.1, 3.0, 2.0], [0.1, 3.0, 2.0]])
    return xr.Dataset(
        {"parameter_value": (("bifurcation", "parameter"), value), "value": ("bifurcation", [5.0, 6.0, 7.0])},
        {"parameter": ["damping", "F", "frequency"]},
        {"parameter": "k"},
    )


def test_bifurcations_at__are_chosen_by_the_parameters_that_differ():
    ds = sensitivities()
    assert levels_of_bifurcations(ds) == [{"F": 1.0}, {"F": 3.0}, {"F": 3.0}]
    assert bifurcations_at(ds, {"F": 3.0})["value"].values.tolist() == [6.0, 7.0]
    with pytest.raises(SpecError, match="at F = 2: there is no bifurcation"):
        bifurcations_at(ds, {"F": 2.0})
    assert levels_of_bifurcations(ds.isel(bifurcation=[])) == []


def test_refuse_at__says_what_the_figure_does_with_all_values():
    refuse_at({}, "the figure curves", "it shows all")
    with pytest.raises(SpecError, match="at F = 3: the figure curves takes no values of axes; it shows all"):
        refuse_at({"F": 3.0}, "the figure curves", "it shows all")
