"""Sets of maps that preserve volume, and trajectories that grow: no set, and no chaos."""

from types import SimpleNamespace

import numpy as np
import pytest

from magpend_core import load_model
from magpend_core.crossing import Crossing
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.sectioned import sectioned
from magpend_core.orbits import section_map
from pipeline.analysis.attractors.extension.bounded_sets import _is_in_family
from pipeline.analysis.attractors.extension.conservative import _split, conservative_sets
from pipeline.analysis.attractors.extension.courses import COURSE_GROWS
from pipeline.analysis.attractors.extension.growth import Escape
from pipeline.analysis.attractors.finding.points import Point, Slab
from pipeline.analysis.attractors.finding.requests import Settings
from pipeline.analysis.attractors.labelling import _preserve_volume
from pipeline.layout.vocabulary import BOUNDED_SET, CHAOTIC_SET, NEUTRAL
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.maps import N_KEEP, MapPoint, drive, settle

PLANE = Geometry((False, False), (1.0, 1.0))
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def linear(matrix):
    """A linear map of the plane, and its derivative."""
    return lambda x: x @ matrix.T, lambda x: np.broadcast_to(matrix, (len(x), 2, 2))


def rotation(turns, factor=1.0):
    c, s = np.cos(TWO_PI * turns), np.sin(TWO_PI * turns)
    return factor * np.array([[c, -s], [s, c]])


def standard(k):
    """The standard map on the torus, and its derivative."""

    def step(x):
        p = x[:, 1] + k * np.sin(x[:, 0])
        return np.mod(np.stack([x[:, 0] + p, p], axis=1), TWO_PI)

    def slope(x):
        kick, one = k * np.cos(x[:, 0]), np.ones(len(x))
        return np.stack([np.stack([1.0 + kick, one], axis=1), np.stack([kick, one], axis=1)], axis=1)

    return step, slope


def neutral_sets(step, slope, starts, is_angle=False, budget=1.0):
    point = MapPoint(step, slope, np.array(starts))
    geometry = Geometry((is_angle,) * 2, (1.0, 1.0))
    settings = Settings(1e-8, 1e-8, 100, 1e-5, 4, 1e-10, N_KEEP, None, "", geometry)
    return drive(conservative_sets(point, settings, budget, 24), point)


def test_extend__growth_without_recurrence_is_no_set():
    """An unstable focus: small distances grow, and so does the distance from where the cells began."""
    growing = settle(MapPoint(*linear(rotation(GOLDEN, 1.01)), np.array([[1.0, 0.0], [0.0, 0.5]])), budget=1.0)
    assert not growing.sets
    assert [course.end for course in growing.courses] == [COURSE_GROWS, COURSE_GROWS]
    for course in growing.courses:
        assert Escape.of(course.extension, PLANE).rate == pytest.approx(np.log(1.01), rel=0.05)
    # it decays as slowly, or goes round: no growth
    for factor in (0.99, 1.0):
        found = settle(MapPoint(*linear(rotation(GOLDEN, factor)), np.array([[1.0, 0.0]])), budget=1.0)
        assert all(course.end != COURSE_GROWS for course in found.courses)


@pytest.mark.parametrize("drift", [0.0, 1e-5, 1e-3])
def test_escape__slow_drift_along_a_curve_is_no_growth(drift):
    """Rotation near 0 and near 1/3 creeps along the circle; a random walk and a way to a distant point slow down."""
    for turns in (drift, 1 / 3 + drift):
        angle = TWO_PI * turns * np.arange(1024)
        assert Escape.of(np.stack([np.cos(angle), np.sin(angle)], axis=1), PLANE) is None
    n = np.arange(1024.0)
    assert Escape.of(np.stack([50.0 * (1.0 - np.exp(-n / 400.0)), 0.0 * n], axis=1), PLANE) is None
    assert Escape.of(np.stack([np.sqrt(n), 0.0 * n], axis=1), PLANE) is None
    # an angle that turns stays on its circle
    assert Escape.of(np.stack([n, 0.0 * n], axis=1), Geometry((True, False), (1.0, 1.0))) is None
    assert Escape.of(np.stack([0.0 * n, n], axis=1), PLANE).factor == pytest.approx(959.5 / 63.5)


def test_conservative_sets__resonance_without_damping_grows():
    """x'' = -x + cos(t) at its period: x stays, v grows by pi each time."""
    step = lambda x: x + [0.0, np.pi]  # noqa: E731
    sets, courses = neutral_sets(step, linear(np.eye(2))[1], [[0.0, 0.0], [1.0, -1.0]])
    assert [course.end for course in courses] == [COURSE_GROWS, COURSE_GROWS]
    # off resonance, x'' = -x + cos(2 t), the cells turn about a centre and stay
    sets, courses = neutral_sets(*linear(rotation(GOLDEN)), [[0.3, 0.0], [1.0, -1.0]])
    assert not any(course.end == COURSE_GROWS for course in courses)
    assert [(one.kind, one.stability, one.cells.tolist()) for one in sets] == [(BOUNDED_SET, NEUTRAL, [0, 1])]


def test_conservative_sets__islands_are_not_the_chaotic_sea():
    """Standard map at K = 1.5: starts about the elliptic fixed point (pi, 0) and near the saddle at 0."""
    starts = [[np.pi + 0.3, 0.0], [0.1, 0.1], [np.pi - 0.6, 0.0], [0.2, 0.0], [6.0, 0.2]]
    sets, _ = neutral_sets(*standard(1.5), starts, is_angle=True)
    found = {one.kind: one for one in sets}
    assert len(sets) == 2
    assert {one.stability for one in sets} == {NEUTRAL}
    assert found[CHAOTIC_SET].cells.tolist() == [1, 3, 4]
    assert found[BOUNDED_SET].cells.tolist() == [0, 2]
    # the exponents are those of each set's own cells
    assert abs(found[BOUNDED_SET].growth.rate) < 0.02
    assert found[CHAOTIC_SET].growth.rate == pytest.approx(exponent(1.5, [0.1, 0.1]), rel=0.25)
    # nothing integrated, nothing shown
    (one,), courses = neutral_sets(*standard(1.5), starts, is_angle=True, budget=0.0)
    assert (one.kind, one.cells.tolist(), courses) == (BOUNDED_SET, [0, 1, 2, 3, 4], [])


def exponent(k, start, n=20_000):
    """Largest exponent of the standard map by the growth of one tangent."""
    (x, p), tangent, total = start, np.array([1.0, 0.0]), 0.0
    for _ in range(n):
        kick = k * np.cos(x)
        tangent = np.array([[1.0 + kick, 1.0], [kick, 1.0]]) @ tangent
        size = np.hypot(*tangent)
        total, tangent = total + np.log(size), tangent / size
        p = np.mod(p + k * np.sin(x), TWO_PI)
        x = np.mod(x + p, TWO_PI)
    return total / n


@pytest.mark.parametrize(("offset", "size"), [(0.0, 1.0), (1000.0, 1e-6), (-3.0, 1e9)])
def test_split__a_constant_quantity_keeps_cells_apart(offset, size):
    """Whatever its zero and its unit; one that varies along cells keeps none apart."""
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 16))
    energy = np.array([50.0, 5.225, 0.07016, 5.225])[:, None] + 1e-9 * drawn
    assert _split(np.zeros(4, int), offset + size * energy).tolist() == [2, 1, 0, 1]
    assert _split(np.array([0, 0, 0, 1]), offset + size * energy).tolist() == [2, 1, 0, 3]
    assert _split(np.zeros(4, int), energy + 40.0 * drawn).tolist() == [0] * 4
    assert _split(np.zeros(4, int), np.full((4, 16), offset)).tolist() == [0] * 4


def test_preserve_volume__not_asked_of_a_flow_with_one_state():
    """On a circle without equilibria all starts are on one orbit: there is no volume beside it."""
    slab = Slab({(): None})
    dynamics, geometry = SimpleNamespace(can_rest=True), Geometry((True,), (1.0,))
    assert _preserve_volume(slab, SimpleNamespace(dynamics=dynamics, geometry=geometry)).tolist() == [False]


@pytest.mark.parametrize("can_rest", [False, True])
def test_is_in_family__an_orbit_with_a_zero_exponent_is_no_torus(can_rest):
    """Rounding scatters section points about an orbit beside which a parameter that is a state is neutral."""
    settings = SimpleNamespace(geometry=PLANE, closure=1e-5, longest=32)
    point = SimpleNamespace(n_neutral=0, can_rest=can_rest)
    scattered = 1e-7 * np.random.default_rng(0).normal(size=(500, 2))
    turns = TWO_PI * GOLDEN * np.arange(500)
    assert _is_in_family(scattered, 2, point, settings)
    assert not _is_in_family(np.stack([np.cos(turns), np.sin(turns)], axis=1), 2, point, settings)
    assert not _is_in_family(scattered, 0, point, settings)


@pytest.mark.parametrize("of", ["z", "z + 0.4*x - y", "z - 0.02*x*y"])
def test_volumes_of__the_divergence_over_a_return(of):
    """Lorenz's flow shrinks volumes by exp(-(sigma + 1 + beta) t), whatever the section and its speeds."""
    parameters = sectioned(load_model("lorenz"), Crossing(of, 27.0, longest=50.0)).load()
    system, packed = parameters.model.system, parameters.pack()
    hertz, starts = np.full(6, 0.02), np.random.default_rng(2).uniform(-9.0, 9.0, (6, 3)) + [0.0, 0.0, 25.0]
    before = section_map(np.tile(packed, (6, 1)), hertz, starts, 3, system=system).images[:, -1]
    found = section_map(np.tile(packed, (6, 1)), hertz, before, 1, system=system)
    point, short = SimpleNamespace(integrates=system, packed=packed), found.times[:, 0] < 0.8
    volumes = Point.volumes(point, found.derivatives, before, found.images[:, 0])
    known = -(10.0 + 1.0 + 8.0 / 3.0) * found.times[:, 0]
    assert short.sum() > 3
    np.testing.assert_allclose(volumes[short], known[short], rtol=1e-5)
