"""Manifolds of saddles of maps of the plane, which are straight lines, graphs, or those of Henon's map."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.manifolds.growing import (
    Manifold,
    Resolution,
    Saddle,
    _preimages,
    stable_manifold,
    unstable_manifold,
)

STABLE, UNSTABLE = 0.25, 3.0


@dataclass(frozen=True, eq=False)
class MapSaddle(Saddle):
    """A saddle of a map of the plane in place of a section map: the map and its derivative are given."""

    step: object = None
    slope: object = None
    count: list[int] = field(default_factory=list)

    def images(self, states: np.ndarray, n_periods: int) -> tuple[np.ndarray, np.ndarray]:
        self.count.append(n_periods)
        derivative = np.broadcast_to(np.eye(2), (len(states), 2, 2))
        for _ in range(n_periods):
            derivative = self.slope(states) @ derivative
            states = self.step(states)
        return states, derivative


def saddle_of(step, slope, state, *, scales=(1.0, 1.0), angles=(False, False), period=1) -> MapSaddle:
    state = np.array(state, float)
    monodromy = np.eye(2)
    for _ in range(period):
        monodromy = slope(state[None])[0] @ monodromy
        state = step(state[None])[0]
    system = SimpleNamespace(scales=scales, is_angle=np.array(angles), n_states=2, section=None)
    return MapSaddle(system, 1.0, np.zeros(0), state, period, monodromy, step, slope)


def linear(matrix, **more) -> MapSaddle:
    matrix = np.array(matrix)
    return saddle_of(lambda x: x @ matrix.T, lambda x: np.broadcast_to(matrix, (len(x), 2, 2)), [0.0, 0.0], **more)


def bent(turned: bool = False) -> MapSaddle:
    """Return the saddle of (x, y) -> (3 x, y/4 + x^2), or of this map with its states exchanged.

    Along x the unstable manifold is y = c x^2 with 9 c = c/4 + 1; the stable one is x = 0.
    """

    def step(s):
        x, y = s.T[::-1] if turned else s.T
        both = np.stack([UNSTABLE * x, STABLE * y + x**2], axis=-1)
        return both[:, ::-1] if turned else both

    def slope(s):
        x = s[:, 1 if turned else 0]
        found = np.zeros((len(s), 2, 2))
        a, b = (1, 0) if turned else (0, 1)
        found[:, a, a], found[:, b, b], found[:, b, a] = UNSTABLE, STABLE, 2.0 * x
        return found

    return saddle_of(step, slope, [0.0, 0.0])


BEND = 1.0 / (UNSTABLE**2 - STABLE)


def henon() -> MapSaddle:
    """Return the saddle of x' = 1 - 1.4 x^2 + y, y' = .3 x, inside of its attractor."""
    x = (-0.7 + np.sqrt(0.49 + 5.6)) / 2.8

    def slope(s):
        found = np.zeros((len(s), 2, 2))
        found[:, 0, 0], found[:, 0, 1], found[:, 1, 0] = -2.8 * s[:, 0], 1.0, 0.3
        return found

    return saddle_of(
        lambda s: np.stack([1.0 - 1.4 * s[:, 0] ** 2 + s[:, 1], 0.3 * s[:, 0]], axis=-1), slope, [x, 0.3 * x]
    )


def chords(curve: Manifold, scales=(1.0, 1.0)) -> np.ndarray:
    return np.linalg.norm(np.diff(curve.points, axis=0) / scales, axis=1)


def test_direction__are_eigenvectors_in_units_of_the_scales() -> None:
    matrix = np.array([[2.0, 6.0], [0.0, 0.5]])
    saddle = linear(matrix, scales=(3.0, 0.5))
    value, vector = saddle.direction(stable=True)
    assert value == 0.5
    np.testing.assert_allclose(matrix @ (vector * saddle.scales), 0.5 * vector * saddle.scales, atol=1e-14)
    assert np.linalg.norm(vector) == pytest.approx(1.0)
    assert saddle.direction(stable=False)[0] == 2.0


@pytest.mark.parametrize(
    ("matrix", "stable", "words"),
    [
        ([[0.5, 0.0], [0.0, 0.25]], False, "0 unstable directions"),
        ([[2.0, 0.0], [0.0, 3.0]], False, "2 unstable directions"),
        ([[2.0, 0.0], [0.0, 0.0]], True, "0 stable directions"),  # a superstable direction has no preimages
        ([[0.0, -0.5], [0.5, 0.0]], True, "2 stable directions"),
    ],
)
def test_direction__refuses_what_is_no_curve(matrix, stable, words) -> None:
    with pytest.raises(ValueError, match=words):
        linear(matrix).direction(stable)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_unstable_manifold__of_a_bent_map_is_a_parabola(side) -> None:
    curve = unstable_manifold(bent(), side, Resolution(chord=0.02, length=3.0))
    x, y = curve.points.T
    np.testing.assert_allclose(y, BEND * x**2, atol=2e-10)  # the first segment, of 1e-5, is straight
    assert (np.diff(np.abs(x)) > 0.0).all()
    assert len({*np.sign(x)}) == 1
    assert chords(curve).max() <= 0.02
    assert chords(curve).sum() == pytest.approx(3.0, abs=0.021)
    assert curve.end == "length"


def test_unstable_manifold__sides_are_mirror_images() -> None:
    one, other = (unstable_manifold(bent(), side, Resolution(chord=0.05, length=1.0)) for side in (1.0, -1.0))
    np.testing.assert_allclose(one.points * [-1.0, 1.0], other.points, atol=1e-12)


def test_unstable_manifold__time_counts_generations() -> None:
    """A place on the linear manifold grows by the multiplier in each generation, from 1e-5 on."""
    curve = unstable_manifold(linear([[UNSTABLE, 0.0], [0.0, STABLE]]), 1.0, Resolution(chord=0.1, length=2.0))
    np.testing.assert_allclose(np.abs(curve.points[:, 0]), 1e-5 * UNSTABLE**curve.time, rtol=1e-9)
    assert (np.diff(curve.time) > 0.0).all()


def test_unstable_manifold__of_henon_spans_its_attractor() -> None:
    """Henon (Commun. Math. Phys. 50, 69, 1976): the attractor spans x from -1.2847 to 1.2730, and is the closure."""
    saddle = henon()
    curves = [unstable_manifold(saddle, side, Resolution(chord=0.03, length=4.0)) for side in (1.0, -1.0)]
    x, y = np.concatenate([curve.points for curve in curves]).T
    assert x.min() == pytest.approx(-1.2847, abs=2e-3)
    assert x.max() == pytest.approx(1.2730, abs=2e-3)
    assert y.max() == pytest.approx(0.3 * 1.2730, abs=2e-3)
    # the multiplier is below -1, so two iterates are one generation, and lead along the same side
    curve = curves[0]
    early = curve.points[: len(curve.points) // 4]
    images, _ = saddle.images(early[::10], 2)
    assert max(np.linalg.norm(curve.points - image, axis=1).min() for image in images) < 0.015


def test_manifold__of_a_negative_multiplier_keeps_its_side() -> None:
    saddle = linear([[-UNSTABLE, 0.0], [0.0, STABLE]])
    curve = unstable_manifold(saddle, 1.0, Resolution(chord=0.1, length=1.0))
    assert len({*np.sign(curve.points[:, 0])}) == 1
    assert set(saddle.count) == {2}
    np.testing.assert_allclose(np.abs(curve.points[:, 0]), 1e-5 * 9.0**curve.time, rtol=1e-9)


def test_manifold__of_an_orbit_of_period_two_maps_over_both_periods() -> None:
    """The map (x, y) -> (-3 x, y/4) takes x = 0 to itself; twice taken it is a saddle with the multiplier 9."""
    saddle = linear([[-UNSTABLE, 0.0], [0.0, STABLE]], period=2)
    assert saddle.direction(stable=False)[0] == pytest.approx(9.0)
    curve = unstable_manifold(saddle, -1.0, Resolution(chord=0.1, length=1.0))
    assert set(saddle.count) == {2}
    np.testing.assert_allclose(np.abs(curve.points[:, 0]), 1e-5 * 9.0**curve.time, rtol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_stable_manifold__of_a_bent_map_is_straight(turned) -> None:
    curve = stable_manifold(bent(turned), 1.0, Resolution(chord=0.05, length=2.0))
    along, across = curve.points.T if turned else curve.points.T[::-1]
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(along), 1e-5 * STABLE**-curve.time, rtol=1e-6)
    assert chords(curve).sum() == pytest.approx(2.0, abs=0.11)
    assert curve.stable


def test_stable_manifold__of_henon_comes_to_the_saddle() -> None:
    saddle = henon()
    curve = stable_manifold(saddle, 1.0, Resolution(chord=0.05, length=2.0))
    far = curve.points[-1]
    assert np.linalg.norm(far - saddle.state) > 0.5
    steps = 1 + int(np.ceil(curve.time[-1]))
    # the saddle's unstable multiplier, -1.92, blows rounding of the point up in each iterate
    there, _ = saddle.images(far[None], steps)
    assert np.linalg.norm(there[0] - saddle.state) < 1e-4


def test_manifold__ends_where_points_are_too_many_or_too_few() -> None:
    saddle = linear([[UNSTABLE, 0.0], [0.0, STABLE]])
    curve = unstable_manifold(saddle, 1.0, Resolution(chord=0.01, length=50.0, most=100))
    assert curve.end == "most"
    assert len(curve.points) == 100
    slow = linear([[1.05, 0.0], [0.0, STABLE]])
    curve = unstable_manifold(slow, 1.0, Resolution(chord=0.1, length=1.0))
    assert curve.end == "generations"
    assert np.abs(curve.points[-1, 0]) == pytest.approx(1e-5 * 1.05**Resolution.most_generations, rel=1e-9)


def test_manifold__ends_where_the_map_does() -> None:
    saddle = linear([[UNSTABLE, 0.0], [0.0, STABLE]])
    whole = saddle.step

    def torn(s):
        return np.where(np.abs(whole(s)[:, :1]) < 0.5, whole(s), np.nan)

    object.__setattr__(saddle, "step", torn)
    curve = unstable_manifold(saddle, 1.0, Resolution(chord=0.01, length=2.0))
    assert curve.end == "lost"
    assert np.isfinite(curve.points).all()
    assert 0.4 < np.abs(curve.points[-1, 0]) < 0.5


def test_manifold__on_a_circle_goes_around() -> None:
    """On the torus the lengths of Arnold's cat are those of the plane: golden mean squared per generation."""
    cat = np.array([[2.0, 1.0], [1.0, 1.0]])

    def step(s):
        return (s @ cat.T + np.pi) % (2.0 * np.pi) - np.pi

    saddle = saddle_of(step, lambda s: np.broadcast_to(cat, (len(s), 2, 2)), [0.0, 0.0], angles=(True, True))
    curve = unstable_manifold(saddle, 1.0, Resolution(chord=0.2, length=8.0))
    assert np.abs(curve.points).max() <= np.pi
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    turns = np.unwrap(curve.points, axis=0)
    np.testing.assert_allclose(turns[:, 0], golden * turns[:, 1], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1e-5 * golden ** (2.0 * curve.time), rtol=1e-6)


def test_unstable_manifold__chords_count_in_scales() -> None:
    scales = (10.0, 0.1)
    curve = unstable_manifold(linear([[UNSTABLE, 0.0], [0.0, STABLE]], scales=scales), 1.0, Resolution(0.1, 2.0))
    assert chords(curve, scales).max() <= 0.1
    assert np.abs(curve.points[-1, 0]) == pytest.approx(20.0, rel=0.1)


def test_preimages__by_newton_and_nan_where_the_map_ends() -> None:
    """(x, y) -> (e^x + y, y/2) has one preimage of (c, d), x = log(c - 2 d); torn where x > 1.05."""

    def slope(s):
        found = np.zeros((len(s), 2, 2))
        found[:, 0, 0], found[:, 0, 1], found[:, 1, 1] = np.exp(s[:, 0]), 1.0, 0.5
        return found

    def step(s):
        whole = np.stack([np.exp(s[:, 0]) + s[:, 1], 0.5 * s[:, 1]], axis=-1)
        return np.where(s[:, :1] <= 1.05, whole, np.nan)

    saddle = saddle_of(step, slope, [1.0, 0.0])
    points = np.array([[2.0, 0.0], [2.0, 0.5], [3.0, 0.0], [np.nan, 0.0], [3.0, 0.0]])
    guesses = np.array([[1.0, 0.0], [-1.0, 0.3], [1.0, 0.0], [1.0, 0.0], [np.nan, 0.0]])
    found = _preimages(saddle, points, guesses, 1)
    expected = [[np.log(2.0), 0.0], [0.0, 1.0], [np.nan] * 2, [np.nan] * 2, [np.nan] * 2]
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_preimages__none_where_the_map_folds() -> None:
    """(x, y) -> (x^2 + y, y/2) reaches (c, 0) from x = +-sqrt(c) alone: from nowhere at c < 0."""

    def slope(s):
        found = np.zeros((len(s), 2, 2))
        found[:, 0, 0], found[:, 0, 1], found[:, 1, 1] = 2.0 * s[:, 0], 1.0, 0.5
        return found

    saddle = saddle_of(lambda s: np.stack([s[:, 0] ** 2 + s[:, 1], 0.5 * s[:, 1]], axis=-1), slope, [1.0, 0.0])
    found = _preimages(saddle, np.array([[-1.0, 0.0], [4.0, 0.0]]), np.array([[0.0, -0.8], [1.0, 0.0]]), 1)
    np.testing.assert_allclose(found, [[np.nan] * 2, [2.0, 0.0]], atol=1e-8)
