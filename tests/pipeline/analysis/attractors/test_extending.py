"""Cells that are extended: maps whose attractors, repellers and lifetimes are known on paper."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.attractors import labelling
from pipeline.analysis.attractors.extension.extending import _Extension
from pipeline.analysis.attractors.extension.growth import growth_of, on_closed_curves
from pipeline.analysis.attractors.finding.points import Slab
from pipeline.analysis.attractors.finding.requests import Effort, Settings
from pipeline.analysis.attractors.labelling import _Ends, _label_courses, _preserve_volume, _representatives
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, CHAOTIC_SET, NEUTRAL, NOT_SETTLED, TORUS, TRANSIENT
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import ROUGH_SLOPE_RTOL, SLOPE_RTOL
from tests.pipeline.analysis.maps import FIXED, N_KEEP, MapPoint, henon, settle, slopes_of, tent

TENT_SLOPE = 2.05


def test_extend__escape_rate_of_the_tent_map():
    """Of a uniform density 2/slope stays at every step: the mean lifetime is s/(s - 2) = 41."""
    starts = np.random.default_rng(3).uniform(0, 1, (4000, 1))
    # scaled so that what counts as near the fixed point is all beyond 1: the image of the hole
    found = settle(MapPoint(*tent(TENT_SLOPE), starts), [FIXED], scale=1.0 / 0.3)
    (left,) = found.sets
    assert left.stability == TRANSIENT
    assert left.n_left > 500
    truth = TENT_SLOPE / (TENT_SLOPE - 2.0)
    # a cell is told after at least 8 of its sections: those that leave before are near their orbit
    assert left.time_at_risk / left.n_left == pytest.approx(truth + 8.0, rel=0.15)
    assert not any(course.goes_on for course in found.courses)


def test_extend__a_chaotic_attractor_stays():
    """At slope 1.9 the same map has one, with the exponent ln 1.9."""
    starts = np.random.default_rng(4).uniform(0.2, 0.8, (50, 1))
    found = settle(MapPoint(*tent(1.9), starts), [FIXED])
    (one,) = found.sets
    assert (one.kind, one.stability, one.n_left) == (CHAOTIC_SET, ATTRACTS, 0)
    assert one.growth.rate == pytest.approx(np.log(1.9), abs=1e-9)
    # the sample stayed for ten times the 20 sections that were seen
    assert min(course.length for course in found.courses) >= 200
    assert not found.ran_out
    starts = np.random.default_rng(4).uniform(0.2, 0.8, (50, 1))
    found = settle(MapPoint(*tent(1.9), starts), budget=0.0)
    assert found.spent == 0
    assert {(one.kind, one.stability) for one in found.sets} == {(BOUNDED_SET, NOT_SETTLED)}
    starts = np.random.default_rng(4).uniform(0.2, 0.8, (10, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        found = settle(MapPoint(lambda x: np.where(x < 3, x + 0.05, x**8), lambda x: x[:, :, None], starts))
    assert {course.end for course in found.courses} == {-3}


@pytest.mark.parametrize("slope", [1.9, TENT_SLOPE, 2.002])
def test_extend__legs_that_grow_end_alike(slope):
    """Several legs at once save requests, and change nothing else: with and without trajectories that leave."""

    def found(most_legs):
        point = MapPoint(*tent(slope), np.random.default_rng(3).uniform(0.0, 1.0, (200, 1)), seen=200)
        one = settle(point, [FIXED], scale=1.0 / 0.3, seen=200, budget=1.0, effort=Effort(most_legs=most_legs))
        courses = [(c.cell, c.end, c.periods, c.length, c.is_leaving, c.seconds) for c in one.courses]
        sets = [(s.kind, s.stability, s.n_left, s.time_at_risk, s.growth) for s in one.sets]
        return (one.spent, one.ran_out, courses, sets), point.n_legs

    whole, each = found(8), found(1)
    assert whole[0] == each[0]
    assert len(whole[1]) < len(each[1])


@pytest.mark.slow
def test_extend__two_chaotic_attractors_are_two():
    """Two tents side by side, with a gap that 20 sections do not resolve."""

    def step(x):
        base = np.floor(x / 1.01)
        y = x - 1.01 * base
        return 1.01 * base + np.clip(1.9 * np.minimum(y, 1.0 - y), 0.0, 1.0)

    starts = np.random.default_rng(5).uniform(0.3, 0.7, (40, 1)) + 1.01 * (np.arange(40) % 2)[:, None]
    found = settle(MapPoint(step, tent(1.9)[1], starts))
    assert [one.stability for one in found.sets] == [ATTRACTS, ATTRACTS]
    sides = [{int(cell) % 2 for cell in one.cells} for one in found.sets]
    assert sorted(map(sorted, sides)) == [[0], [1]]


def rotation(alpha, contraction):
    """A circle of radius 1 that is approached by a factor at each step, and a rotation along it."""

    def step(x):
        z = x[:, 0] + 1j * x[:, 1]
        z = z / np.abs(z) * (1.0 + contraction * (np.abs(z) - 1.0)) * np.exp(2j * np.pi * alpha)
        return np.stack([z.real, z.imag], axis=1)

    def derivative(x):
        angle = np.arctan2(x[:, 1], x[:, 0])
        radial = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        tangent = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        turned = angle + 2 * np.pi * alpha
        new_radial = np.stack([np.cos(turned), np.sin(turned)], axis=1)
        new_tangent = np.stack([-np.sin(turned), np.cos(turned)], axis=1)
        return contraction * new_radial[:, :, None] * radial[:, None] + new_tangent[:, :, None] * tangent[:, None]

    return step, derivative


GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def test_extend__a_torus_attracts():
    starts = np.random.default_rng(6).normal(size=(20, 2)) + 0.1
    found = settle(MapPoint(*rotation(GOLDEN, 0.5), starts))
    (one,) = found.sets
    assert (one.kind, one.stability) == (TORUS, ATTRACTS)
    assert abs(one.growth.weighted) < 1e-9
    starts = np.random.default_rng(6).normal(size=(4, 2))
    found = settle(MapPoint(*rotation(GOLDEN, 1.0), starts))
    # each cell keeps its own radius
    assert [one.stability for one in found.sets] == [NEUTRAL] * 4


@pytest.mark.slow
def test_extend__a_slow_spiral_is_not_settled():
    """Towards a point, by .9999 at each turn: it neither stays nor arrives in the time allowed."""

    def step(x):
        z = (x[:, 0] + 1j * x[:, 1]) * 0.9999 * np.exp(2j * np.pi * GOLDEN)
        return np.stack([z.real, z.imag], axis=1)

    def derivative(x):
        c, s = 0.9999 * np.cos(2 * np.pi * GOLDEN), 0.9999 * np.sin(2 * np.pi * GOLDEN)
        return np.broadcast_to(np.array([[c, -s], [s, c]]), (len(x), 2, 2))

    found = settle(MapPoint(step, derivative, np.array([[1.0, 0.0]])), budget=1.0)
    assert {one.stability for one in found.sets} == {NOT_SETTLED}


@pytest.mark.slow
def test_extend__slopes_are_refined_unless_chaos_is_plain():
    """The baker's map stretches by 2 and shrinks by 3; a rotation does neither."""

    def baker(z):
        right = z[:, 0] >= 0.5
        # bits that rounding takes from the left come back
        x = (2.0 * z[:, 0] + 1e-13 * z[:, 1]) % 1.0
        return np.stack([x, z[:, 1] / 3.0 + 0.6 * right], axis=1)

    starts = np.random.default_rng(4).uniform(0.1, 0.8, (50, 2))
    chaos = MapPoint(baker, lambda z: np.broadcast_to(np.diag([2.0, 1.0 / 3.0]), (len(z), 2, 2)), starts)
    (one,) = settle(chaos).sets
    assert (one.kind, one.stability) == (CHAOTIC_SET, ATTRACTS)
    assert one.growth.rate == pytest.approx(np.log(2.0))
    assert set(chaos.rtols) == {ROUGH_SLOPE_RTOL}
    turn = np.array([[np.cos(GOLDEN), -np.sin(GOLDEN)], [np.sin(GOLDEN), np.cos(GOLDEN)]])
    still = MapPoint(lambda z: z @ turn.T, lambda z: np.broadcast_to(turn, (len(z), 2, 2)), starts[:10])
    assert {found.stability for found in settle(still).sets} == {NEUTRAL}
    assert still.rtols[:2] == [ROUGH_SLOPE_RTOL, SLOPE_RTOL]


def test_preserve_volume__asks_few_states_first(monkeypatch):
    """A map that preserves areas at all states of a parameter point, at all but one, or at none."""
    starts = np.random.default_rng(5).uniform(0.0, 1.0, (3, 16, 2))
    slab = Slab({(i,): MapPoint(lambda z: z, None, own) for i, own in enumerate(starts)})
    slab.arrays, asked = {}, []

    def slopes(states, owner, points, settings, rtol):
        asked.append(np.bincount(owner, minlength=len(points)).tolist())
        found = np.tile(np.eye(2), (len(states), 1, 1))
        found[owner == 2] *= 0.999
        if len(asked) > 1:
            found[np.flatnonzero(owner == 1)[-1]] *= 0.99
        return states, found

    monkeypatch.setattr(labelling, "map_slopes", slopes)
    dynamics = SimpleNamespace(can_rest=False, integrates=SimpleNamespace(section=None))
    search = SimpleNamespace(dynamics=dynamics, geometry=Geometry((False,) * 2, (1.0,) * 2), settings=None)
    assert _preserve_volume(slab, search).tolist() == [True, False, False]
    assert asked == [[1, 1, 1], [15, 15, 0]]


def test_growth__exponents_of_the_henon_map():
    """0.419 and ln .3 in all (validated numbers of a = 1.4, b = .3)."""
    slopes = slopes_of(henon(8, 2048, n_transient=100))
    found = growth_of(slopes, 0, np.linalg.slogdet(slopes)[1])
    assert found.low < 0.4192 < found.high
    assert found.is_chaotic
    assert not found.preserves_volume
    assert found.volume == pytest.approx(np.log(0.3))
    # A ball that comes to rest forgets its start; nothing is divided by that
    slopes = np.zeros((2, 64, 2, 2))
    slopes[0, ::2] = [[0.5, 0.1], [0.0, 0.2]]
    with np.errstate(divide="ignore"):
        found = growth_of(slopes, 0, np.linalg.slogdet(slopes)[1])
    assert found.high < 0.0
    assert found.contracts
    assert not found.is_chaotic
    assert not found.preserves_volume


def test_on_closed_curves__curves_but_no_arcs_clouds_or_points():
    geometry, rng = Geometry((False, False), (1.0, 1.0)), np.random.default_rng(0)
    angle = 2 * np.pi * GOLDEN * np.arange(600)
    circle = np.stack([np.cos(angle), 0.3 * np.sin(angle)], axis=1)
    assert on_closed_curves(circle, geometry)
    assert not on_closed_curves(rng.uniform(-1, 1, (600, 2)), geometry)
    assert not on_closed_curves(circle * 0.999 ** np.arange(600)[:, None], geometry)
    # a doubled circle of a width that the points resolve
    assert not on_closed_curves(circle * (1.0 + 0.05 * rng.uniform(-1, 1, (600, 1))), geometry)


def calls_of(work, n):
    """Count the calls of functions that a piece of work on `n` cells of one point makes."""
    geometry = Geometry((False,), (1.0,))
    settings = Settings(1e-8, 1e-8, 100, 1e-5, 4, 1e-10, N_KEEP, None, "", geometry)
    point = MapPoint(lambda x: np.mod(3.1 * x, 1.0), None, np.random.default_rng(0).uniform(size=(n, 1)))
    extension, group = _Extension(point, [], settings, 1.0), np.arange(n) % 3
    courses = extension.sample(np.arange(n), 24)
    for course, cell in zip(courses, range(3), strict=False):
        course.cell, course.end = cell, cell
    search = SimpleNamespace(settings=settings, geometry=geometry)
    ends = _Ends(np.full(n, -1), np.zeros(n, np.int8), group, [], courses=courses)
    works = {
        "sample": lambda: extension.sample(np.arange(n), 24),
        "label": lambda: _label_courses(point, ends, search),
        "represent": lambda: _representatives(next(point.blocks()), group, {}, geometry),
    }
    found = []
    sys.setprofile(lambda frame, event, arg: found.append(event in ("call", "c_call")))
    try:
        works[work]()
    finally:
        sys.setprofile(None)
    return sum(found)


@pytest.mark.parametrize("work", ["sample", "label", "represent"])
def test_extend__calls_do_not_grow_with_cells(work):
    """All of a million cells may be on no known set."""
    assert calls_of(work, 4000) <= 1.2 * calls_of(work, 500)
