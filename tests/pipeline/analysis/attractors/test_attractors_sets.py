"""Distances on circles, boxes, and when a cell counts as on its way to an orbit."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, raw_orbit
from pipeline.analysis.attractors.finding.spirals import near_closed
from pipeline.layout.vocabulary import APPROACHING, CERTAIN, CLOSED, UNDECIDED
from pipeline.results.sets import Geometry, groups, hashes, mean_distance, nearest_distances

GEOMETRY = Geometry((True, True, False, False), (1.0, 1.0, 10.0, 10.0))
PLANE = Geometry((True, False), (1.0, 10.0))


def test_distance__circle_and_scales():
    a, b = np.array([np.pi - 0.1, 0.0, 1.0, 0.0]), np.array([-np.pi + 0.1, 0.0, -1.0, 0.0])
    assert GEOMETRY.difference(a, b) == pytest.approx([-0.2, 0, 0.2, 0])
    assert GEOMETRY.distance(a, b) == pytest.approx(0.2)
    assert GEOMETRY.distance(a, b + [0, 0, 0, 30]) == pytest.approx(3.0)
    assert nearest_distances(a[None], b[None], GEOMETRY) == pytest.approx([0.2])
    few, many = np.zeros((1, 2)), np.array([[0.0, 0.0], [0.0, 4.0]])
    assert mean_distance(few, many, PLANE) == mean_distance(many, few, PLANE) == pytest.approx(0.2)


def test_tree__any_number_of_turns():
    points = np.array([[-1e-17, 0.0], [2 * np.pi, 0.0], [7.0, 5.0], [-20.0, -5.0]])
    scaled = PLANE.scaled(points)
    assert (scaled[:, 0] >= 0).all()
    assert (scaled[:, 0] < 2 * np.pi).all()
    distance, _ = PLANE.tree(points).query(PLANE.scaled(points + [2 * np.pi, 0.0]), p=np.inf)
    assert distance == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("side", [0.1, 1e-4, 0.7])
def test_boxes__close_points_touch_on_the_circle_too(side):
    rng = np.random.default_rng(0)
    angle = np.concatenate([[np.pi, -np.pi + 1e-9, 0.0, -1e-9], rng.uniform(-np.pi, np.pi, 200)])
    points = np.stack([angle, 10 * rng.normal(size=angle.size)], axis=1)
    moved = points + side * rng.uniform(-1, 1, points.shape) * [1, 10]
    for a, b in zip(PLANE.boxes(points, side), PLANE.boxes(moved, side), strict=True):
        both = np.unique([a, b], axis=0)
        assert len(both) == 1 or len(PLANE.box_pairs(both, side, np.zeros((2, 1)))) == 1


def test_hashes__of_the_row_alone():
    rows = np.random.default_rng(1).normal(size=(1000, 4))
    assert len(np.unique(hashes(rows))) == 1000
    assert np.array_equal(hashes(rows[::-1]), hashes(rows)[::-1])
    assert hashes(np.array([[0.0, 1.0]])) == hashes(np.array([[-0.0, 1.0]]))
    assert hashes(np.array([[0.0, 1.0]])) != hashes(np.array([[1.0, 0.0]]))


def test_groups__connected():
    assert groups(5, np.array([[0, 3], [3, 4]])).tolist() == [0, 1, 2, 0, 0]
    assert len(set(groups(3, np.zeros((0, 2), int)))) == 3
    points = np.array([[0.3, 1.0], [-0.2, 0.0], [0.1, 3.0]])
    for shift in range(3):
        found = raw_orbit(np.roll(points, shift, axis=0), PLANE)
        assert np.array_equal(found.points, [[-0.2, 0.0], [0.1, 3.0], [0.3, 1.0]])


# ---- spirals: a map d' = M d + error, with M turning and shrinking by 0.95 ----------------------

SHRINK = 0.95
TURN = 0.7


def spiral(start, error=0.0, n=32):
    """Sections of a cell on its way to the orbit beside psi = pi; `error` turns less of it inwards."""
    c, s = np.cos(TURN), np.sin(TURN)
    d = np.array([start, 0.0])
    states = []
    for _ in range(n):
        states.append(d)
        d = (SHRINK + error) * np.array([c * d[0] - s * d[1], s * d[0] + c * d[1]])
    section = np.array(states) * [1, 10] + [np.pi, 2.0]
    section[:, 0] -= 2 * np.pi * np.ceil((section[:, 0] - np.pi) / (2 * np.pi))
    return section


def stable_orbit():
    c, s = SHRINK * np.cos(TURN), SHRINK * np.sin(TURN)
    derivative = np.array([[c, -s / 10], [10 * s, c]])
    multipliers = np.linalg.eigvals(derivative)
    return Orbit(np.array([[np.pi, 2.0]]), multipliers, 1e-12, derivative)


def decision_of(*sections, status=2, period=0, orbit=None):
    n = len(sections)
    block = Block(slice(0, n), np.stack(sections), np.full(n, status), np.full(n, period), np.zeros((n, 1), int))
    label, decision = decide(block, [orbit or stable_orbit()], 1e-4, PLANE)
    assert ((label >= 0) == (decision != UNDECIDED)).all()
    return decision.tolist()


def test_decide__of_spirals_neighbours_and_closed_cells():
    """The bounds are half and twice of 1 - 0.95."""
    cells = [spiral(0.2), spiral(0.2, 0.02), spiral(0.2, 0.04), spiral(0.2, 0.05), spiral(0.2, -0.2)]
    assert decision_of(*cells) == [CERTAIN, CERTAIN, APPROACHING, UNDECIDED, UNDECIDED]
    # Another orbit at a distance of 0.1, and one beyond the reach
    other = np.tile([np.pi - 0.1, 2.0], (32, 1))
    assert decision_of(other) == [UNDECIDED]
    assert decision_of(other, status=1, period=1) == [UNDECIDED]
    assert decision_of(spiral(3.0)) == [UNDECIDED]
    on, off = (np.tile([np.pi + d - 2 * np.pi, 2.0], (32, 1)) for d in (5e-5, 2e-4))
    assert decision_of(on, off, status=1, period=1) == [CLOSED, UNDECIDED]
    orbit = stable_orbit()
    unstable = Orbit(orbit.points, orbit.multipliers / SHRINK * 1.01, 1e-12, orbit.derivative)
    assert decision_of(spiral(0.2), orbit=unstable) == [UNDECIDED]


def test_decide__points_together_as_each_alone():
    """The orbits of one parameter point are none of another's, and an orbit of two points has two phases."""
    once = stable_orbit()
    twice = Orbit(once.points + [[0.0, 0.0], [0.5, 1.0]], once.multipliers, 1e-12, once.derivative)
    far = Orbit(once.points + [-1.0, 3.0], 1.5 * once.multipliers, 1e-12, once.derivative)
    orbits = [[once], [], [far, twice], [far]]
    alternating = np.tile(twice.points, (16, 1))
    cells = [np.tile(once.points, (32, 1)), np.tile(far.points, (32, 1)), alternating, alternating[::-1], spiral(0.2)]
    n, periods = len(cells), np.array([1, 1, 2, 2, 0])
    alone = Block(slice(0, n), np.stack(cells), np.where(periods, 1, 2), periods, np.zeros((n, 1), int))
    each = [decide(alone, own, 1e-4, PLANE) for own in orbits]
    assert [label.tolist() for label, _ in each] == [[0, -1, -1, 0, 0], [-1] * 5, [1, 0, 1, 1, -1], [-1, 0, -1, -1, -1]]
    # the cells of the points in turn
    owner = np.tile(np.arange(4), n)
    together = replace(alone.take(np.repeat(np.arange(n), 4)), owners=owner)
    label, decision = decide(together, [x for own in orbits for x in own], 1e-4, PLANE, np.array([0, 2, 2, 3]))
    for k, first in enumerate([0, 1, 1, 3]):
        own = label[owner == k]
        assert np.where(own < 0, -1, own - first).tolist() == each[k][0].tolist()
        assert decision[owner == k].tolist() == each[k][1].tolist()


def test_near_closed__finds_the_period_of_a_spiral():
    sections = np.stack([spiral(0.05), spiral(0.01), np.random.default_rng(0).normal(size=(32, 2))])
    found = near_closed(sections, 4, PLANE)
    assert set(found.period) == {1}
    assert len(found.key) >= 1
    alternating = sections[:1].copy()
    alternating[:, ::2, 0] += 0.5
    assert near_closed(alternating, 4, PLANE).period.tolist() == [2]
