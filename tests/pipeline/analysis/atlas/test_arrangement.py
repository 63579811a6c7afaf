"""Regions between lines, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.analysis.atlas.arrangement import arranged

TOLERANCE = 1e-4
X = np.linspace(-0.1, 1.1, 401)
UPRIGHT = np.array([[0.5, -0.1], [0.5, 1.1]])


def cut(*lines, tolerance=TOLERANCE):
    return arranged(lines, [tolerance] * len(lines))


def areas(chart):
    return [region.area for region in chart.regions]


def borders(chart):
    return {(border.regions, border.line) for border in chart.borders}


def circle(radius, x=0.5, y=0.5, n=2001):
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    line = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    line[-1] = line[0]
    return line


def parabola(curvature, least=0.3):
    return np.stack([X, least + curvature * (X - 0.5) ** 2], axis=1)


def fold(side, shift=0.0):
    """A branch of 4 a^3 + 27 b^2 = 0, from beyond the square to the cusp at (0.9, 0.5)."""
    a = -np.linspace(1.3, 0.0, 2001)
    return np.stack([0.9 + 0.8 * a, 0.5 + shift + side * np.sqrt(-4.0 * a**3 / 27.0)], axis=1)


def wedge():
    """The area between both branches: that of 2 sqrt(-4 a^3 / 27) over x from 0 to 0.9, less what leaves the square."""
    a = -np.linspace(0.0, 0.9 / 0.8, 200_001)
    return np.trapezoid(np.minimum(2.0 * np.sqrt(-4.0 * a**3 / 27.0), 1.0), -0.8 * a)


def assert_tiles(chart):
    assert sum(areas(chart)) == pytest.approx(1.0, abs=1e-9)
    assert areas(chart) == sorted(areas(chart), reverse=True)
    labels = np.array([region.label for region in chart.regions])
    assert chart.region_of(labels).tolist() == list(range(len(labels)))
    assert all(0 <= one < other < len(labels) for one, other in (border.regions for border in chart.borders))


def test_arranged__without_lines_is_the_square():
    chart = cut()
    assert areas(chart) == [1.0]
    assert chart.borders == chart.dangling == ()
    np.testing.assert_allclose(chart.regions[0].label, 0.5, atol=0.01)
    assert chart.region_of(np.array([[0.1, 0.9], [0.0, 0.0], [1.1, 0.5]])).tolist() == [0, 0, -1]


def test_arranged__by_a_straight_line():
    chart = cut(np.array([[-0.5, 0.2], [1.5, 0.4]]))
    assert areas(chart) == pytest.approx([0.7, 0.3], abs=1e-10)
    (border,) = chart.borders
    assert (border.regions, border.line) == ((0, 1), 0)
    assert border.length == pytest.approx(np.hypot(1.0, 0.1), abs=1e-10)
    assert border.middle == pytest.approx((0.5, 0.3), abs=1e-10)
    assert chart.region_of(np.array([[0.5, 0.31], [0.5, 0.29], [0.0, 0.26]])).tolist() == [0, 1, 0]


def test_arranged__gives_the_surroundings_of_an_isola_a_hole():
    chart = cut(circle(0.3))
    polygon = 0.5 * 2000 * 0.09 * np.sin(2.0 * np.pi / 2000)
    assert areas(chart) == pytest.approx([1.0 - polygon, polygon], abs=1e-10)
    assert polygon == pytest.approx(np.pi * 0.09, rel=1e-5)
    assert [len(region.rings) for region in chart.regions] == [2, 1]
    assert all((ring[0] == ring[-1]).all() for region in chart.regions for ring in region.rings)
    np.testing.assert_allclose(chart.regions[1].label, 0.5, atol=0.02)
    assert borders(chart) == {((0, 1), 0)}


def test_arranged__closes_an_isola_whose_ends_meet_within_the_tolerance():
    chart = cut(circle(0.3, n=801)[:-1])  # the gap is 2.4e-3
    assert len(chart.regions) == 1
    assert chart.dangling == (0,)
    open_ends = circle(0.3)
    open_ends[-1] += [1e-5, -2e-5]
    chart = cut(open_ends)
    assert areas(chart) == pytest.approx([1.0 - np.pi * 0.09, np.pi * 0.09], abs=1e-5)
    assert chart.dangling == ()


def test_arranged__drops_an_isola_smaller_than_the_tolerance():
    chart = cut(UPRIGHT, circle(0.9e-4, x=0.2, n=61))
    assert areas(chart) == pytest.approx([0.5, 0.5], abs=1e-10)
    assert (chart.n_slivers, chart.dangling) == (1, ())
    assert len(cut(UPRIGHT, circle(1.2e-4, x=0.2, n=61)).regions) == 3


@pytest.mark.parametrize("shift", [0.0, 1e-5, -1e-5], ids=["meet", "gap", "cross"])
def test_arranged__keeps_the_wedge_of_a_cusp(shift):
    """Two branches that meet in the cusp, that miss each other there, and that cross before it."""
    chart = cut(fold(1.0, shift), fold(-1.0))
    assert areas(chart) == pytest.approx([1.0 - wedge(), wedge()], abs=2e-5)
    assert borders(chart) == {((0, 1), 0), ((0, 1), 1)}
    assert chart.dangling == ()


def test_arranged__keeps_the_wedge_of_a_cusp_in_one_line():
    chart = cut(np.concatenate([fold(1.0), fold(-1.0)[::-1]]))
    assert areas(chart) == pytest.approx([1.0 - wedge(), wedge()], abs=1e-5)
    assert borders(chart) == {((0, 1), 0)}
    assert chart.dangling == ()


@pytest.mark.parametrize("shift", [0.0, 1e-5, -1e-5], ids=["touch", "cross", "gap"])
def test_arranged__parts_what_two_tangent_lines_part(shift):
    """Parabolas that touch at their minimum, within the tolerance: the two regions between them stay two."""
    chart = cut(parabola(2.0), parabola(1.0, 0.3 + shift))
    between = 0.5**3 / 3.0
    assert areas(chart) == pytest.approx([0.7 - 4.0 * between, 0.3 + 2.0 * between, between, between], abs=2e-5)
    assert {((0, 2), 0), ((0, 3), 0), ((1, 2), 1), ((1, 3), 1)} <= borders(chart)


def test_arranged__keeps_a_lens_that_is_thicker_than_the_tolerance():
    chart = cut(parabola(2.0), parabola(1.0, 0.301))
    lens = 4.0 / 3.0 * 0.001**1.5
    assert areas(chart)[4] == pytest.approx(lens, rel=0.01)
    assert {((0, 4), 1), ((1, 4), 0)} <= borders(chart)
    chart = cut(parabola(2.0), parabola(1.0, 0.299))
    assert len(chart.regions) == 3
    assert chart.n_slivers == 0


@pytest.mark.parametrize("miss", [0.0, 1e-5])
def test_arranged__by_three_lines_through_a_point(miss):
    lines = [[[-0.1, -0.1], [1.1, 1.1]], [[-0.1, 1.1], [1.1, -0.1]], [[0.5 + miss, -0.1], [0.5 + miss, 1.1]]]
    chart = cut(*map(np.array, lines))
    assert areas(chart) == pytest.approx([0.25, 0.25, *[0.125] * 4], abs=1e-5)
    assert len(chart.borders) == 6
    assert {border.line for border in chart.borders} == {0, 1, 2}


@pytest.mark.parametrize("end", [0.5 - 1e-5, 0.5, 0.5 + 1e-5], ids=["before", "on", "beyond"])
def test_arranged__joins_an_end_to_the_line_it_nearly_reaches(end):
    chart = cut(UPRIGHT, np.array([[-0.1, 0.4], [0.3, 0.4], [end, 0.4]]))
    assert areas(chart) == pytest.approx([0.5, 0.3, 0.2], abs=1e-9)
    assert borders(chart) == {((0, 1), 0), ((0, 2), 0), ((1, 2), 1)}
    assert (chart.dangling, chart.n_slivers) == ((), 0)


@pytest.mark.parametrize("end", [0.499, 0.8])
def test_arranged__names_a_line_that_ends_inside_a_region(end):
    chart = cut(UPRIGHT, np.array([[-0.1, 0.4], [end, 0.4]]))
    assert chart.dangling == (1,)
    assert len(chart.regions) == (3 if end > 0.5 else 2)


def test_arranged__joins_an_end_to_the_nearest_line_of_a_channel():
    """An uncertain line ends in a channel of certain ones, nearer to the first: the channel is not cut."""
    other = UPRIGHT + [0.01, 0.0]
    chart = arranged([UPRIGHT, other, np.array([[-0.1, 0.4], [0.497, 0.4]])], [1e-5, 1e-5, 1e-2])
    assert sorted(areas(chart)) == pytest.approx([0.01, 0.2, 0.3, 0.49], abs=1e-9)
    chart = arranged([UPRIGHT, other, np.array([[-0.1, 0.4], [0.503, 0.4]])], [1e-5, 1e-5, 1e-2])
    assert sorted(areas(chart)) == pytest.approx([0.01, 0.2, 0.3, 0.49], abs=1e-9)


def test_arranged__joins_all_lines_that_end_at_a_point():
    rng = np.random.default_rng(1)
    angles = np.arange(6) * np.pi / 3.0 + 0.1
    ends = 0.5 + rng.uniform(-4e-5, 4e-5, (6, 2))
    chart = cut(*(np.array([end, [0.5 + np.cos(a), 0.5 + np.sin(a)]]) for end, a in zip(ends, angles, strict=True)))
    assert (len(chart.regions), chart.dangling) == (6, ())
    assert len(chart.borders) == 6


@pytest.mark.parametrize("wave", [0.0, 1e-5], ids=["beside", "crossing"])
def test_arranged__lists_the_border_for_each_copy_of_a_line(wave):
    y = 0.5 + wave * np.sin(300.0 * X)
    chart = cut(np.stack([X, y], axis=1), np.stack([X, 1.0 - y - 1e-6], axis=1))
    assert areas(chart) == pytest.approx([0.5, 0.5], abs=1e-5)
    assert borders(chart) == {((0, 1), 0), ((0, 1), 1)}
    assert all(border.length == pytest.approx(1.0, abs=1e-4) for border in chart.borders)
    assert chart.n_slivers > 0
    assert chart.dangling == ()


def test_arranged__lists_the_border_for_each_of_two_equal_lines():
    chart = cut(UPRIGHT, UPRIGHT[::-1], tolerance=0.0)
    assert borders(chart) == {((0, 1), 0), ((0, 1), 1)}
    assert chart.n_slivers == 0


def test_arranged__takes_a_copy_of_a_part_for_that_part():
    part = np.stack([np.full(300, 0.5 + 1e-5), np.linspace(0.2, 0.6, 300)], axis=1)
    chart = cut(UPRIGHT, part)
    assert (len(chart.regions), chart.dangling) == (2, ())
    assert {border.line: round(border.length, 3) for border in chart.borders} == {0: 1.0, 1: 0.4}


def test_arranged__merges_by_the_tolerances_of_the_lines_of_a_face():
    strip = [UPRIGHT, UPRIGHT + [5e-4, 0.0]]
    assert len(arranged(strip, [1e-4, 1e-4]).regions) == 3
    assert len(arranged(strip, [1e-5, 6e-4]).regions) == 2
    assert len(arranged(strip, [1e-5, 4e-4]).regions) == 3
    # the tolerance of a third line does not matter
    assert len(arranged([*strip, UPRIGHT + [0.3, 0.0]], [1e-4, 1e-4, 1e-2]).regions) == 4


def test_arranged__takes_pieces_of_a_line_that_leaves_the_square():
    chart = cut(np.array([[-0.5, 0.2], [3.0, 0.2], [3.0, 0.7], [-9.0, 0.7]]))
    assert areas(chart) == pytest.approx([0.5, 0.3, 0.2], abs=1e-10)
    assert cut(np.array([[2.0, 0.2], [3.0, 0.2]])).regions[0].area == 1.0


def test_arranged__follows_a_line_through_itself():
    t = np.linspace(0.0, 2.0 * np.pi, 2001)[:-1]
    eight = np.stack([0.5 + 0.4 * np.sin(t), 0.5 + 0.2 * np.sin(2.0 * t)], axis=1)
    chart = cut(np.concatenate([eight, eight[:1]]))
    loop = 0.08 * 4.0 / 3.0  # of Gerono's lemniscate
    assert areas(chart) == pytest.approx([1.0 - 2.0 * loop, loop, loop], abs=1e-5)


@st.composite
def lines(draw):
    seed, n = draw(st.integers(0, 2**32 - 1)), draw(st.integers(1, 12))
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    drawn = [rng.uniform(-0.3, 1.3, 2) + t * rng.uniform(-2, 2, 2) + t**2 * rng.uniform(-2, 2, 2) for _ in range(n)]
    copies = [line + rng.uniform(-1e-5, 1e-5, line.shape) for line in drawn[: draw(st.integers(0, 3))]]
    return drawn + copies


@given(lines(), st.sampled_from([0.0, 1e-6, 1e-4, 1e-2]))
def test_arranged__tiles_the_square(drawn, tolerance):
    chart = cut(*drawn, tolerance=tolerance)
    assert_tiles(chart)
    for border in chart.borders:
        x, y = border.middle
        steps = 1e-7 * np.array([[1.0, 0.3], [-0.3, 1.0], [-1.0, -0.3], [0.3, -1.0]])
        assert set(chart.region_of(np.array([x, y]) + steps)) == set(border.regions)


@given(lines(), st.randoms(use_true_random=False))
def test_arranged__does_not_depend_on_order(drawn, random):
    order = list(range(len(drawn)))
    random.shuffle(order)
    one, other = cut(*drawn), cut(*(drawn[k][:: random.choice([1, -1])] for k in order))
    assert areas(one) == areas(other)
    for mine, its in zip(one.regions, other.regions, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(mine.rings, its.rings, strict=True))
    assert borders(one) == {(regions, order[line]) for regions, line in borders(other)}
    assert (one.n_slivers, set(one.dangling)) == (other.n_slivers, {order[k] for k in other.dangling})
