"""A torus is one set, however unevenly its points fill the curve: maps of the circle that are known on paper."""

import numpy as np
import pytest

from magpend_core.engine.vecmath import TWO_PI
from pipeline.analysis.attractors.extension.curves import Curve
from pipeline.layout.vocabulary import ATTRACTS, NOT_SETTLED, TORUS
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.maps import MapPoint, settle

PLANE = Geometry((False, False), (1.0, 1.0))
TABLE = np.linspace(-0.6, 0.6, 4096)
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def angle_of(phase, uneven, q):
    """Angle [turns] of a phase that advances evenly: points crowd at q places of the circle."""
    return phase - uneven / (TWO_PI * q) * np.sin(TWO_PI * q * phase)


def phase_of(angle, uneven, q):
    """Invert `angle_of` (Kepler's equation) by a table and Newton's method."""
    phase = np.interp(angle, angle_of(TABLE, uneven, q), TABLE)
    for _ in range(3):
        phase -= (angle_of(phase, uneven, q) - angle) / (1.0 - uneven * np.cos(TWO_PI * q * phase))
    return phase


def circle_map(rotation, uneven, q, radii=(1.0,)):
    """A map of the plane whose invariant circles attract, conjugate to a rotation there; with its derivative."""

    def step(x):
        size, angle = np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0]) / TWO_PI
        nearest = np.array(radii)[np.abs(size[:, None] - radii).argmin(axis=1)]
        turned = TWO_PI * angle_of(phase_of(angle, uneven, q) + rotation, uneven, q)
        size = nearest + 0.3 * (size - nearest)
        return np.stack([size * np.cos(turned), size * np.sin(turned)], axis=1)

    def slope(x):
        found = np.empty((len(x), 2, 2))
        for k, aside in enumerate(1e-6 * np.eye(2)):
            found[:, :, k] = (step(x + aside) - step(x - aside)) / 2e-6
        return found

    return step, slope


def starts(n, low=0.8, high=1.2):
    draw = np.random.default_rng(3)
    size, angle = draw.uniform(low, high, n), TWO_PI * draw.uniform(size=n)
    return np.stack([size * np.cos(angle), size * np.sin(angle)], axis=1)


def section(n, rotation, uneven, q, begin=0.0, radius=1.0):
    angle = TWO_PI * angle_of(begin + rotation * np.arange(n), uneven, q)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("uneven", [0.0, 0.9])
@pytest.mark.parametrize(("near", "q"), [(1 / 2, 2), (1 / 3, 3), (1 / 4, 4), (2 / 5, 5), (GOLDEN, 1)])
def test_curve__rotation_and_membership(near, q, uneven):
    rotation = near + 3e-3 * (near != GOLDEN)
    curve = Curve.fitted(section(1024, rotation, uneven, q), PLANE)
    assert min(curve.rotation, 1.0 - curve.rotation) == pytest.approx(min(rotation, 1.0 - rotation), abs=1e-7)
    assert curve.holds(section(1024, rotation, uneven, q, begin=0.37), PLANE)
    # another curve, another rotation on the same curve, and points that only creep along it
    assert not curve.holds(section(1024, rotation, uneven, q, radius=1.01), PLANE)
    assert not curve.holds(section(1024, rotation + 1e-3, uneven, q), PLANE)
    assert Curve.fitted(section(1024, 1 / q + 1e-6, 0.0, q), PLANE) is None
    noise = np.random.default_rng(0).normal(size=(1024, 2))
    assert Curve.fitted(noise, PLANE) is None
    assert Curve.fitted(section(1024, rotation, uneven, q) + 0.01 * noise, PLANE) is None


@pytest.mark.parametrize(
    ("near", "q"), [(1 / 3, 3), *(pytest.param(p / q, q, marks=pytest.mark.slow) for p, q in ((1, 2), (1, 4), (2, 5)))]
)
def test_extend__a_torus_near_a_resonance_is_one_set(near, q):
    """512 sections of each of twelve trajectories fill its circle unevenly."""
    rotation = near + 0.0016 * 3 / q
    found = settle(MapPoint(*circle_map(rotation, 0.9, q), starts(12)), budget=1.0)
    (one,) = found.sets
    assert (one.kind, one.stability, one.dimension, len(one.cells)) == (TORUS, ATTRACTS, 2, 12)


def test_extend__two_tori_are_two():
    point = MapPoint(*circle_map(1 / 3 + 0.002, 0.5, 3, radii=(1.0, 2.0)), np.concatenate([starts(5), 2.0 * starts(4)]))
    found = settle(point, budget=1.0)
    assert sorted(sorted(one.cells.tolist()) for one in found.sets) == [[0, 1, 2, 3, 4], [5, 6, 7, 8]]
    assert {(one.kind, one.stability) for one in found.sets} == {(TORUS, ATTRACTS)}


@pytest.mark.slow
def test_extend__a_torus_that_is_not_filled_is_one_set_not_settled():
    """At a rotation of 1/3 + 1e-6 the sections creep along three short arcs."""
    found = settle(MapPoint(*circle_map(1 / 3 + 1e-6, 0.5, 3), starts(6)), budget=1.0)
    assert [one.stability for one in found.sets] == [NOT_SETTLED]
    assert sorted(found.sets[0].cells.tolist()) == [0, 1, 2, 3, 4, 5]
