"""Bifurcations that are mirror images of each other, on toys and on flows whose sections the mirror moves."""

import numpy as np
import pytest

from magpend_core.crossing import Crossing
from magpend_core.models import load_model
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import branches_table, table_of
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.bifurcations import Bifurcation
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.images import images_of
from pipeline.analysis.branches.kinds import BRANCHING, FOLD, HOPF, PITCHFORK
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.levels import at_levels
from pipeline.analysis.branches.normal_forms import _tell_branch_point
from pipeline.analysis.branches.problems import Family, Value
from pipeline.analysis.branches.starting_orbits import family_of
from tests.core.flows import table

CUBIC = {
    "name": "cubic_map",
    "kind": "map",
    "states": {"x": {}},
    "parameters": {"r": 2.2},
    "equations": {"x": "r*x - x^3"},
    "mirror": {"signs": {"x": -1}},
}
CHUA = table(
    "chua",
    {"x": "a*(y - x**3 + 0.2*x)", "y": "x - y + z", "z": "-b*y"},
    {"a": 8.7, "b": 16.0},
    mirror={"signs": {"x": -1, "y": -1, "z": -1}},
)


def at_rest(kind, family, state, value, residual=0.0):
    """A bifurcation of an equilibrium that was located at a state."""
    n = len(state)
    found = Value(np.full(n, residual), np.eye(n, n + 1), np.array([state]), np.eye(n), is_rest=True)
    return Bifurcation(
        kind, Point(family.unknowns(np.array(state), [value]), np.eye(n + 1)[-1], found, 0), 0.0, 0, 1, True
    )


def test_images_of__equilibria():
    """Of (1, 0) and (-1, 0) in the mirror of the Duffing oscillator, at one value and of one kind; 0 is its own."""
    model = load_model("duffing")
    family = Family(model.system, 0, 1.0, model.load().pack(), ("amplitude",), (1.0,))
    places = [
        *((FOLD, 1.0, 0.3), (FOLD, -1.0, 0.3), (HOPF, 1.0, 0.3), (FOLD, -1.0, 0.4)),
        *((PITCHFORK, 0.0, 0.3), (FOLD, 1.0, 0.4), (HOPF, -1.1, 0.3)),
    ]
    located = [(family, at_rest(kind, family, [x, 0.0], value)) for kind, x, value in places]
    assert images_of(located, model).tolist() == [1, 0, -1, 5, -1, 3, -1]
    assert images_of(located, load_model("belt-stick")).tolist() == [-1] * len(places)


def test_tell_branch_point__a_pitchfork_that_is_located_to_the_root_of_its_residual():
    """Beside a pitchfork the quadratic coefficient is three times the cubic one, times the distance."""
    model = load_model("duffing")
    family = Family(model.system, 0, 1.0, model.load().pack(), ("amplitude",), (1.0,))
    for square, kind in ((4.6e-6, PITCHFORK), (0.1, "transcritical")):
        one = at_rest(BRANCHING, family, [0.0, 0.0], 0.3, residual=1.6e-12)
        one.criticality = "supercritical"
        _tell_branch_point(one, (square, 2e-10), (-0.6, 2e-9), 0.15)
        assert one.kind == kind


@pytest.mark.slow
def test_branches__of_an_odd_map():
    """x -> r x - x^3: the orbits beside 0 double at r = 2, and those of period 2 at sqrt(5), in two mirror images."""
    model = load_model(CUBIC)
    family = Family(model.system, 1, 1.0, model.load().pack(), ("r",), (1.0,))
    found = explore([Start(family, np.zeros(1), 0.6)], Scope(0.5, 2.25, 2, max_generations=2))
    ds = dataset_of(found, "r", model.load())
    image, coefficient = ds["image"].values, ds["normal_form"].values
    assert (image[image[image >= 0]] == np.flatnonzero(image >= 0)).all()
    np.testing.assert_allclose(
        coefficient[image >= 0], coefficient[image[image >= 0]], rtol=1e-7
    )  # they are located to 1e-8
    rows = branches_table(ds).rows
    assert [(row["type"], row["mirror_branch"] >= 0) for row in rows] == [
        *(("pitchfork", False), ("period_doubling", True), ("period_doubling", True))
    ]
    assert [row["r"] for row in rows] == pytest.approx([1.0, 2.0, np.sqrt(5.0)], abs=2e-7)
    assert [row["normal_form"] for row in rows] == pytest.approx([-1.0, 8.0, 32.0 * np.sqrt(5.0)], rel=1e-6)
    assert {rows[2]["branch"], rows[2]["mirror_branch"]} == set(np.flatnonzero(ds["orbit_period"].values == 2))
    assert len(table_of(ds)) == 5
    assert any("-> 2, and its mirror 1 -> 3" in line for line in branches_table(ds).lines)
    assert at_levels(ds, {}).equals(ds)


@pytest.mark.slow
def test_branches__of_a_flow_whose_section_is_not_its_own_mirror_image():
    """Chua's two cycles cross y = 0 upwards on one side each; both double at one place, with one coefficient."""
    parameters = sectioned(load_model(CHUA), Crossing("y", longest=60.0)).load()
    family = family_of(parameters.model.system, 1, parameters.model.crossing.frequency_hz, parameters.pack(), "a", 0.3)
    points = [0.09407, 0.0, 0.17422], [-0.52714, 0.0, 0.88306]  # by scipy's integration
    starts = [Start(family, np.array(point), 8.7) for point in points]
    ds = dataset_of(explore(starts, Scope(8.7, 8.9, 1, 1)), "a", parameters)
    (row,) = branches_table(ds).rows
    assert (row["type"], row["branch"], row["mirror_branch"]) == ("period_doubling", 0, 1)
    one, other = ds["normal_form"].values
    assert one == pytest.approx(other, rel=1e-6)
