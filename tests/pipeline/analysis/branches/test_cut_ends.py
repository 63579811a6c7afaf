"""Ends at which branches and curves are cut off, and what was not followed, are said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.crossing import Crossing
from magpend_core.models import load_model
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import _no_equilibria, curves_table
from pipeline.analysis.branches.arclength import Point, Settings, crawls
from pipeline.analysis.branches.bifurcations import Bifurcation, Watch
from pipeline.analysis.branches.codimension_two import SpecialPoint
from pipeline.analysis.branches.completeness import cut_words
from pipeline.analysis.branches.curves import Curve, curves_dataset, not_followed
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, _doubling_at, explore
from pipeline.analysis.branches.following import leads_nowhere
from pipeline.analysis.branches.kinds import DOUBLING
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.lockstep import run_alone, within
from pipeline.analysis.branches.problems import STEEP, Family, Value, _steep_step
from pipeline.layout.vocabulary import model_attribute, section_attributes
from tests.core.flows import model_of


def test_cut_words():
    """Figures say how many branches were cut off, and where they got stuck."""
    flags = {"flag_meanings": "bound closed max_points stuck", "flag_values": np.arange(4, dtype=np.int8)}
    ends = {"first_end": [0, 3, 1], "last_end": [0, 2, 1]}
    ds = xr.Dataset(
        {name: ("branch", np.array(codes, np.int8), flags) for name, codes in ends.items()}
        | {"parameter": (("branch", "point"), [[0.0, 1.0], [0.25, 0.75], [0.5, 0.5]]), "n_points": ("branch", [2] * 3)}
    )
    assert cut_words(ds) == "ends: 1 stuck (0.25), 1 after too many points (0.75), 2 at a bound"
    assert cut_words(ds, [2]) == ""


def test_branches_table__of_cycles_alone_names_how_to_begin_at_equilibria():
    """A flow whose cells all end on one cycle has no branch of equilibria, and so no Hopf point."""
    model = sectioned(load_model("lorenz"), Crossing("z", 20.0))
    of_flow = {"model": model_attribute(model), **section_attributes(model.crossing)}
    driven = {"model": model_attribute(load_model("duffing"))}
    for period, attrs, n in ((1, of_flow, 1), (0, of_flow, 0), (1, driven, 0)):
        ds = xr.Dataset({"orbit_period": ("branch", [period]), "value": ("bifurcation", np.zeros(0))}, attrs=attrs)
        told = [line for line in _no_equilibria(ds) if "--all-equilibria finds all in a box, --start follows" in line]
        assert len(told) == n


def test_not_followed():
    """What springs from a point of codimension two and has no curve there is said; ends have their reasons in words."""
    system = SimpleNamespace(n_states=1, state_names=("x",), scales=(1.0,), is_angle=np.array([False]))
    family = Family(system, 1, 1.0, np.zeros(2), ("p", "q"), (1.0, 1.0))
    value = Value(np.zeros(2), np.zeros((2, 3)), np.zeros((1, 1)), np.eye(1))
    points = [Point(np.array([0.0, p, p**2]), np.zeros(3), value, 0) for p in (0.0, 0.5, 1.0)]
    places = zip(("r2", "chenciner"), points[1:], strict=True)
    special = [SpecialPoint(kind, family, at, np.full(2, 1e-9)) for kind, at in places]
    ds = curves_dataset([Curve(family, "neimark_sacker", points, ("bound", "stuck"), 0, special)], "p", "q")
    assert not_followed(ds) == [
        "r2 at p = 0.5, q = 0.25: not followed from there: period doubling of period 1, neimark sacker of period 2",
        "chenciner at p = 1, q = 1: not followed from there: folds of tori",
    ]
    assert any("ends: Newton's method finds no next point" in line for line in curves_table(ds).lines)
    for end in ("max_points", "budget"):
        ds = curves_dataset([Curve(family, "neimark_sacker", points, ("bound", end), 0, [])], "p", "q")
        assert any(
            "a run at other values of the second parameter shows more" in line for line in curves_table(ds).lines
        )


def test_crawls():
    """Steps of 1e-7 lead nowhere; those that grow again do."""

    def points(steps):
        return [SimpleNamespace(u=np.array([x, 0.0])) for x in np.cumsum(steps)]

    assert crawls(points([0.01] * 5 + [1e-7] * 25))
    assert not crawls(points([0.01] * 5 + [1e-7] * 15))
    assert not crawls(points(1e-7 * 1.5 ** np.arange(30)))


@pytest.mark.parametrize(("is_flow", "slope", "many"), [(True, 1e3, 20), (True, 1.0, 100), (False, 1e3, 100)])
def test_leads_nowhere(is_flow, slope, many):
    """A branch that crawls ends: soon where its cycles may be cut, later where nothing leads on."""
    family = Family(SimpleNamespace(section=(0, 1) if is_flow else None), 1, 1.0, np.zeros(1), ("p",), (1.0,))

    def points(n):
        value = SimpleNamespace(derivative=np.array([[0.0, slope]]), seconds=1.0)
        return [SimpleNamespace(u=np.array([x, 0.0]), value=value) for x in np.append(-0.1, 1e-7 * np.arange(n))]

    assert leads_nowhere(family, points(many + 1))
    assert not leads_nowhere(family, points(many - 1))


def test_steep_step():
    """Where the image moves much with the parameter, as near a canard, its slope is taken over a shorter step."""
    still = np.diag([1e-3, 1e-4])

    def step(slope):
        return _steep_step(still, np.column_stack([still - np.eye(2), [slope, 0.0]]))

    assert step(0.9 * STEEP) is None
    for slope in (1e4, 1e7):
        np.testing.assert_allclose(step(slope), [0.0, 0.0, 1e-5 / slope], rtol=1e-12)


def test_within():
    """A computation ends with its result, or with None after as many queries as it may ask."""

    def asks(n):
        for k in range(n):
            assert (yield k) == -k
        return "all"

    def run(computation):
        try:
            query = next(computation)
            while True:
                query = computation.send(-query)
        except StopIteration as end:
            return end.value

    assert run(within(5, asks(5))) == "all"
    assert run(within(4, asks(5))) is None
    assert run(within(0, asks(0))) == "all"


def doubled(equations, low, high, **parameters):
    """Branches of a map from its fixed point 0 at `low`, and what is said on their ends."""
    model = model_of(equations, parameters, kind="map")
    family = Family(model.system, 1, 1.0, model.load().pack(), ("e",), (1.0,))
    branches = explore([Start(family, np.array([0.0]), low)], Scope(low, high, 2))
    return branches, str(dataset_of(branches, "e", model.load()).attrs["left_out"]).splitlines()


@pytest.mark.slow
def test_explore__says_that_a_doubled_branch_is_stuck_where_it_begins():
    """The orbits +-x of period 2 have x = sqrt(e), and the map jumps at x = 3e-7."""
    (parent,), left_out = doubled({"x": "-(1 + e)*x + x**3 + where(x**2 < 9e-14, 0, 1)"}, -0.01, 0.3, e=0.0)
    (doubling,) = parent.bifurcations
    assert (doubling.kind, doubling.child) == ("period_doubling", None)
    (line,) = [line for line in left_out if "period 2" in line]
    assert line.startswith("the branch of period 2 that leaves branch 0 at e = ")
    assert "Newton's method found no next orbit" in line


@pytest.mark.slow
def test_explore__keeps_a_doubled_branch_that_soon_leaves_the_interval():
    """The orbits +-x of period 2 have x = sqrt(e), which is 9e-4 on the bound, less than a first step."""
    (parent, child), left_out = doubled({"x": "-(1 + e)*x + x**3"}, -0.01, 8.1e-7, e=0.0)
    (doubling,) = parent.bifurcations
    assert doubling.child is child
    assert child.origin is doubling
    assert (len(child.points), child.ends, child.bifurcations) == (2, ("start", "bound"), [])
    # a residual of 1e-10 is 6e-8 of e, and 3e-5 of x
    assert abs(child.family.state(child.points[-1].u)[0]) == pytest.approx(9e-4, abs=3e-5)
    assert left_out[1:] == ["branches 0, 1 beyond e = 8.1e-07, a bound of the interval"]


def two_turns(value, first, second, multiplier=0.5):
    """An orbit of period 2 of a map, beside the value of the parameter."""
    images = np.array([[second], [first]])
    own = Value(np.zeros(1), np.zeros((1, 2)), images, np.array([[multiplier]]))
    return Point(np.array([first, value]), np.array([0.0, 1.0]), own, 0)


def test_doubling_at__compares_whole_orbits():
    """The branch ends beside the second orbit; a section point of the first one is nearer, the other is far away."""
    system = SimpleNamespace(n_states=1, state_names=("x",), scales=(1.0,), is_angle=np.array([False]))
    system.parameter_names, family = (), Family(system, 2, 1.0, np.zeros(0), ("p",), (1.0,))
    orbits = two_turns(0.5, 1.0, 0.2), two_turns(0.5, 1.002, 3.0)
    doublings = [Bifurcation(DOUBLING, point, 0.0, 0, 1, True, after=0) for point in orbits]
    single = SimpleNamespace(family=family, bifurcations=doublings)
    images = np.array([[2.99], [1.0008], [3.01], [1.0]])
    points = [
        Point(np.array([first, 0.5]), np.zeros(2), Value(np.zeros(1), np.zeros((1, 2)), images, np.eye(1)), 0)
        for first in (1.1, 1.0)
    ]
    ended = SimpleNamespace(family=replace(family, period=4), points=points)
    assert _doubling_at([single], ended, 1) is doublings[1]


def test_watch__takes_a_shorter_step_where_a_doubling_lies_before_an_orbit_of_half_the_period():
    a, b = two_turns(0.0, 1.0, 1.1, multiplier=-2.0), two_turns(0.1, 1.1, 1.0)
    assert run_alone(Watch(None, Settings(), halves=lambda *_: True).between(a, b)) is False
