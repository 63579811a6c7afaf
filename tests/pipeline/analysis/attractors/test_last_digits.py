"""Ids, letters and orders are the same whatever the last digits of polished orbits are."""

from dataclasses import replace

import numpy as np
import pytest

from magpend_core.models.model import Mirror
from pipeline.analysis.attractors import features, matching
from pipeline.analysis.attractors.finding import closed_orbits
from pipeline.analysis.attractors.finding.closed_orbits import distinct, raw_orbit
from pipeline.results.sets import Geometry, order_by_points
from tests.core.test_ordering import noisy

GEOMETRY = Geometry((True, False), (1.0, 10.0))
SEEDS = range(100)

# an orbit that turns over at pi, two mirror images, two that begin alike, one at the edge of a rounding grid
SETS = [
    np.array([[np.pi, 0.0], [0.5, 1.0]]),
    np.array([[0.3, 2.0]]),
    np.array([[0.3, -2.0]]),
    np.array([[-1.0, 5.0], [1.0, 5.0]]),
    np.array([[-1.0, 5.0], [1.0, 7.0]]),
    np.array([[-1.0, 5.0], [1.0, 5.0], [2.0, 5.0]]),
    np.array([[0.5e-6, 1.0]]),
    np.array([[0.5e-6, 0.0]]),
]


def shaken(seed):
    # an angle of pi falls to -pi
    found = [noisy(points, seed * len(SETS) + i) for i, points in enumerate(SETS)]
    return [np.column_stack([np.angle(np.exp(1j * p[:, 0])), p[:, 1]]) for p in found]


def test_order_by_points__last_digits():
    plain = order_by_points(SETS, GEOMETRY)
    assert plain == [3, 4, 5, 7, 6, 2, 1, 0]
    assert all(order_by_points(shaken(seed), GEOMETRY) == plain for seed in SEEDS)


def test_raw_orbit__begins_at_the_same_point():
    # two points with one first coordinate
    points = np.array([[2.0, 1.0], [0.5e-6, 3.0], [0.5e-6, 2.0], [np.pi, 0.0]])
    for seed in SEEDS:
        found = raw_orbit(noisy(points, seed), GEOMETRY).points
        assert found == pytest.approx(np.roll(points, -2, axis=0), abs=1e-9)


def test_distinct__last_digits():
    orbits = [raw_orbit(points, GEOMETRY) for points in SETS]
    exact = [replace(one, residual=1e-11, multipliers=np.zeros(2, complex)) for one in orbits]
    plain = distinct(exact, GEOMETRY)
    assert [one.period for one in plain] == sorted(len(points) for points in SETS)
    rng = np.random.default_rng(0)
    for seed in SEEDS:
        other = [replace(one, points=noisy(one.points, seed)) for one in exact for _ in range(2)]
        found = distinct([other[i] for i in rng.permutation(len(other))], GEOMETRY)
        assert [len(one.points) for one in found] == [len(one.points) for one in plain]
        for one, own in zip(found, plain, strict=True):
            assert GEOMETRY.distance(one.points, own.points).max() < 1e-9


def test_assign__mirror_images_are_equally_near():
    def seen(number, *points):
        return matching.Seen(number, 2, 1, 0, np.array(points), np.zeros(1))

    class Known:
        def may_be_one(self, axis, a, b):
            return True

    rule = matching.Rule(0.3, Geometry((False,), (1.0,)), frozenset(), Known())
    before = {0: [(0, seen(0, [0.0]))]}
    for seed in SEEDS:
        # one set before, two mirror images beside it after a pitchfork
        low, high = noisy(np.array([[-0.1], [0.1]]), seed)
        given = matching._assign([seen(1, low), seen(2, high)], before, rule, lambda one, identity: True)
        assert given == [0, None]


def test_pair_mirrors__partners_that_are_equally_near():
    line = Geometry((False,), (1.0,))
    for seed in SEEDS:
        places = noisy(np.array([[[-0.1]], [[0.1]], [[0.0]]]), seed)
        found = [features.Features(p, 2, 1, np.zeros(0), 0, p[0], p[0]) for p in places]
        found[2].image = places[2]
        found.pop(2)
        found[0].image = noisy(np.zeros((1, 1)), seed)
        features.pair_mirrors(found, Mirror((-1,), 0.0), 0.5, line)
        assert found[0].mirror_partner == 0


@pytest.mark.slow
def test_identified__with_other_last_digits(monkeypatch, tmp_path):
    import magpend
    from pipeline.runs.derive import derive

    spec = magpend.Spec("sweep", "duffing").with_parameters(preset="twin-well", frequency_hz=1.2 / (2.0 * np.pi))
    spec = spec.with_axis("amplitude", 0.2, 0.35, 4).with_start_random(n=8, seed=1, x=(-1.5, 1.5), v=(-1.0, 1.0))
    spec = spec.with_integration(n_transient=300, n_keep=16)
    run = magpend.run(spec, tmp_path / "run", workers=0)
    plain = derive(run.directory, "attractors", workers=0)
    whole = closed_orbits.polish_orbits
    for seed in range(3):

        def polish(*rows, seed=seed, **options):
            found = whole(*rows, **options)
            size = 1e-12 if options.get("least_period", True) else 1e-9
            return replace(
                found, points=noisy(found.points, seed, size), derivative=noisy(found.derivative, seed + 7, 1e-12)
            )

        monkeypatch.setattr(closed_orbits, "polish_orbits", polish)
        other = magpend.run(spec, tmp_path / f"run{seed}", workers=0)
        found = derive(other.directory, "attractors", workers=0)
        for name in ("attractor_id", "attractor", "kind", "orbit_period", "stability", "match_basis"):
            np.testing.assert_array_equal(found[name].values, plain[name].values)
