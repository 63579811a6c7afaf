"""Orbits connected by continuation, and the ids that follow from it."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core import trajectory
from magpend_core.models import load_model
from magpend_core.orbits import polish_orbits
from magpend_core.sections import run_branches
from pipeline.analysis.attractors.matching.matching import BASES
from pipeline.analysis.branches import connecting, lockstep
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.connecting import Found, Link, connect, grouped
from pipeline.analysis.branches.problems import Family
from pipeline.layout.vocabulary import PERIODIC_ORBIT
from tests.pipeline.analysis.dense_sets import match

DUFFING = load_model("duffing")
FREQUENCY = 1.2 / (2.0 * np.pi)
# the orbit in one well doubles its period at 0.2656 and again at 0.2867
TWIN_WELL = DUFFING.load("twin-well", damping=0.3)
HARDENING = DUFFING.load("hardening")


def closed(parameters, frequency, state, period):
    """Section points of the orbit near a state, none if Newton's method fails."""
    system = parameters.model.system
    packed, f = parameters.pack()[None], np.array([frequency])
    found = polish_orbits(packed, f, np.array([state]), np.array([period]), system=system)
    assert found.converged[0]
    assert found.orbit_period[0] == period
    images = run_branches(
        packed[:, None], f[:, None], found.section, n_transient=0, n_keep=period, rtol=1e-12, atol=1e-12, system=system
    ).section[0, 0]
    return np.roll(images, 1, axis=0)


@pytest.fixture(scope="module")
def wells(cascade):
    """Orbits of one well by period and amplitude, taken from its branches."""
    _, branches = cascade

    def orbit(period, amplitude):
        branch = next(b for b in branches if b.family.period == period)
        near = min(branch.points, key=lambda p: abs(branch.family.values(p.u)[0] - amplitude))
        return closed(TWIN_WELL.replace(amplitude=amplitude), FREQUENCY, branch.family.state(near.u), period)

    return orbit


def other_well(amplitude, points):
    """The same motion in the other well: the mirror image, half a period later."""
    parameters = TWIN_WELL.replace(amplitude=amplitude)
    (end,) = trajectory(parameters, FREQUENCY, points[0], np.array([0.5 / FREQUENCY]))
    return closed(parameters, FREQUENCY, -end, len(points))


def line(*orbits, scale=0.1, free="amplitude", parameters=TWIN_WELL, frequency=FREQUENCY):
    """Orbits (place, value, points) along one parameter."""
    system, packed = parameters.model.system, parameters.pack()
    return [
        Found(n, place, Family(system, len(x), frequency, packed, (free,), (scale,)), x, value)
        for n, (place, value, x) in enumerate(orbits)
    ]


def test_connect__through_the_unstable_part(wells):
    """Single orbits of both wells, beyond the doubling unstable: each with its own well's."""
    orbits = []
    for place, value in enumerate((0.2, 0.3)):
        own = wells(1, value)
        orbits += [(place, value, own), (place, value, other_well(value, own))]
    (found,) = connect([line(*orbits)])
    assert sorted((x.first, x.second, x.n_doublings) for x in found.links) == [(0, 2, 0), (1, 3, 0)]
    assert found.up == {0: "linked", 1: "linked"}


def test_connect__doublings(wells):
    """From the orbit of period 4 down to that of period 2, and from there to the single one."""
    orbits = [(0, 0.26, wells(1, 0.26)), (1, 0.28, wells(2, 0.28)), (2, 0.29, wells(4, 0.29))]
    (found,) = connect([line(*orbits)])
    assert sorted((x.first, x.second, x.n_doublings) for x in found.links) == [(1, 0, 1), (2, 1, 1)]
    assert found.down == {1: "linked", 2: "linked"}


@pytest.fixture(scope="module")
def resonance(settled):
    """Orbits of a hardening spring, on the upper branch below the fold and on the lower one above."""
    low = settled(HARDENING, 0.15, [0.3, 0.0])
    high = settled(HARDENING, 0.3, low)
    return closed(HARDENING, 0.15, low, 1), closed(HARDENING, 0.3, high, 1)


def test_connect__beyond_a_fold_is_another_branch(resonance):
    low, high = resonance
    orbits = line((0, 0.15, low), (1, 0.3, high), scale=0.15, free="frequency", parameters=HARDENING)
    (found,) = connect([orbits])
    assert not found.links
    assert found.up == {0: "apart"}
    # cut short, the trace says nothing
    (found,) = connect([orbits], Settings(max_points=3))
    assert found.up == {0: "open"}


def test_connect__neighbours_take_no_walk(wells, monkeypatch):
    """Orbits near each other are held against each other's tangent: two evaluations at most for all."""
    calls = []
    evaluate = lockstep._evaluate
    monkeypatch.setattr(lockstep, "_evaluate", lambda *asked: calls.append(1) or evaluate(*asked))
    values = 0.2 + 0.002 * np.arange(6)
    (found,) = connect([line(*((i, v, wells(1, v)) for i, v in enumerate(values)))])
    assert found.links == [Link(i, i + 1) for i in range(5)]
    assert len(calls) <= 2


def test_connect__a_near_orbit_of_another_branch_is_none(wells):
    """Two orbits, of which the second is off the first one's tangent by more than a step allows for."""
    a, b = wells(1, 0.2), wells(1, 0.202)
    one, other = line((0, 0.2, a), (1, 0.202, b))
    point = lockstep.run_alone(connecting._tangent(one, connecting.CONNECT))
    assert connecting._leads_to(point, other) == 0
    (shifted,) = line((1, 0.202, b + 1e-2))
    assert connecting._leads_to(point, shifted) is None


def test_grouped__no_two_of_one_place_together():
    places = ["a", "b", "b", "c"]
    links = [Link(0, 1), Link(2, 0, 1), Link(2, 3)]
    group, used = grouped(places, links)
    assert group.tolist() == [0, 0, 2, 2]
    assert used == [Link(0, 1), Link(2, 3)]


# ---- ids ---------------------------------------------------------------------------------------


def appearances(axis, values, *points, model="duffing", parameters=TWIN_WELL, sides=None):
    """Dataset as of `identify`: per value a list of orbits."""
    rows = max(len(p) for p in points)
    n_states = parameters.model.system.n_states
    section = np.full((len(values), rows, 8, n_states), np.nan)
    period = np.zeros((len(values), rows), np.int32)
    for i, orbits in enumerate(points):
        for k, orbit in enumerate(orbits):
            section[i, k, : len(orbit)], period[i, k] = orbit, len(orbit)
    dims = (axis, "attractor")
    present = (period > 0).astype(np.int8)
    n_angles = len(parameters.model.angles)
    text = "\n".join(f"{n} = {v!r}" for n, v in parameters.items())
    ds = xr.Dataset(
        {
            "kind": (dims, PERIODIC_ORBIT * present),
            "is_polished": (dims, present),
            "orbit_period": (dims, period),
            "attractor_points": ((*dims, "point", "state"), section),
            "rotation": ((*dims, "angle"), np.zeros((*period.shape, n_angles))),
            "attractor_id": ((axis, "initial_condition"), np.where(present, np.arange(rows), -1).astype(np.int32)),
        },
        coords={axis: list(values)},
        attrs={"model": model, "parameters": text},
    )
    if sides is not None:
        ds["side"] = (dims, np.asarray(sides, np.int8))
    return ds if axis == "frequency" else ds.assign_coords(frequency=FREQUENCY)


def told(ds):
    """Id and basis of the attractors at each value."""
    ids = ds["attractor"].values
    return [[(int(i), BASES[b]) for i, b in zip(ids, basis, strict=True) if b] for basis in ds["match_basis"].values]


def test_match__ids_rest_on_followed_branches(wells):
    """However far apart: the unstable part of a branch and a doubling connect, distance never did."""
    ds = appearances("amplitude", [0.2, 0.28, 0.3], [wells(1, 0.2)], [wells(2, 0.28)], [wells(1, 0.3)])
    assert told(match(ds, threshold=1e-9)) == [[(0, "first_appearance")], [(0, "doubling")], [(0, "branch")]]
    assert match(ds, threshold=1e-9, connect=False).sizes["attractor"] == 3


@pytest.mark.slow
def test_match__coexisting_attractors_have_different_ids(wells):
    """The single orbit is listed beside the doubled one: the doubled one is another attractor then."""
    ds = appearances("amplitude", [0.26, 0.28], [wells(1, 0.26)], [wells(1, 0.28), wells(2, 0.28)])
    named = match(ds)
    assert told(named) == [[(0, "first_appearance")], [(0, "branch"), (1, "first_appearance")]]
    assert named["orbit_period"].values.tolist() == [[1, 0], [1, 2]]


def test_match__distance_does_not_overrule_a_fold(resonance):
    ds = appearances("frequency", [0.15, 0.3], *([x] for x in resonance), parameters=HARDENING)
    assert told(match(ds, threshold=10.0)) == [[(0, "first_appearance")], [(1, "first_appearance")]]
    assert told(match(ds, threshold=10.0, connect=False)) == [[(0, "first_appearance")], [(0, "distance")]]


RIGHT = {
    2.36: [[0.019654934855959906, 0.2044846549647774, -2.4241413580609077, 3.246013398715133]],
    2.46: [
        [-0.016203399766600908, 0.23457264851946077, -1.5135037492984205, 2.708073475235969],
        [0.052074141021559696, 0.13573149169405302, -3.010831505544555, 3.2088992011369446],
    ],
    2.52: [[0.022375994918196775, 0.20199041782206717, -2.174246902956021, 2.887164301857044]],
}
LEFT = {
    2.36: [[-0.05446501715455949, -0.13463572135597812, -2.432485069423176, 3.2992593656943976]],
    2.52: [[-0.0525061722282977, -0.14391116883755964, -2.1802136026000456, 2.947427560659119]],
}


@pytest.mark.slow
def test_match__one_sided_motions_through_the_chaotic_band():
    """Period 1 is unstable from 2.372 to 2.499 Hz on the right, from 2.386 to 2.506 on the left."""
    parameters = load_model("pendulum").load()
    points = [[RIGHT[f], LEFT[f]] if f in LEFT else [RIGHT[f]] for f in RIGHT]
    ds = appearances(
        "frequency", list(RIGHT), *points, model="pendulum", parameters=parameters, sides=[[2, 1], [2, 0], [2, 1]]
    )
    named = match(ds, threshold=1e-9)
    periods, sides = named["orbit_period"].values, named["side"].values
    assert sorted(zip(sides[0].tolist(), periods.T.tolist(), strict=True)) == [(1, [1, 0, 1]), (2, [1, 2, 1])]
