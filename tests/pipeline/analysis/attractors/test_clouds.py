"""Whether samples of section points show one set: chaotic maps, tori and orbits, on few and many points."""

import numpy as np
import pytest

from pipeline.analysis.attractors.extension.clouds import OTHER, SAME, Cloud, group, is_stationary, members, mixing
from pipeline.results.sets import Geometry

PLANE = Geometry((False, False), (1.0, 1.0))


def henon(n, seed, shift=0.0):
    x = np.random.default_rng(seed).uniform(-0.1, 0.1, 2)
    path = []
    for _ in range(100 + n):
        x = np.array([1.0 - 1.4 * x[0] ** 2 + x[1], 0.3 * x[0]])
        path.append(x + shift)
    return np.array(path[100:])


GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def circle(n, phase, alpha=GOLDEN, radius=1.0):
    angle = 2 * np.pi * (phase + alpha * np.arange(n))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("n", [128, 512, 2048])
def test_mixing__two_trajectories_on_one_chaotic_set(n):
    shares = [mixing(henon(n, i), henon(n, i + 50), PLANE) for i in range(20)]
    assert min(shares) >= SAME
    assert np.mean(shares) == pytest.approx(0.5, abs=0.1)


def test_mixing__of_circles_shifts_orbits_and_pieces():
    assert mixing(circle(512, 0.0), circle(512, 0.3), PLANE) >= SAME
    assert mixing(circle(512, 0.0), circle(512, 0.3, radius=1.1), PLANE) < OTHER
    assert mixing(henon(2048, 1), henon(2048, 2, shift=[0.0, 5.0]), PLANE) == 0.0
    # 0.01 against a width of 2.5: seen once the points are denser than that
    near = mixing(henon(4096, 1), henon(4096, 2, shift=[0.0, 0.01]), PLANE)
    assert near < mixing(henon(64, 1), henon(64, 2, shift=[0.0, 0.01]), PLANE)
    # Their distances are those of the closing, and say nothing below the closure tolerance
    orbit = np.tile(np.array([[0.0, 1.0], [2.0, 3.0]]), (40, 1))
    late, early = orbit + 1e-9, orbit + 1e-6
    assert mixing(late, early, PLANE, least=1e-5) == pytest.approx(0.5)
    assert mixing(late, orbit + 0.1, PLANE, least=1e-5) < OTHER
    # A chaotic set of two pieces: every second point of a sample lies in one of them

    def pieces(seed):
        path = henon(1024, seed)
        return path + 5.0 * (np.arange(1024) % 2)[:, None]

    assert mixing(pieces(1), pieces(2), PLANE) >= 0.4
    cloud = Cloud.of([pieces(3)], PLANE, 1e-5)
    assert cloud.spacing < 0.2


@pytest.mark.parametrize("enough", [OTHER, SAME])
@pytest.mark.parametrize("gap", [0.0, 0.003, 0.01, 0.02, 0.05, 0.2, 5.0])
def test_mixing__an_early_end_decides_alike(enough, gap):
    for seed in range(6):
        pair = henon(512, seed), henon(512, seed + 50, shift=[0.0, gap])
        whole, early = mixing(*pair, PLANE), mixing(*pair, PLANE, enough=enough)
        assert (early >= enough) == (whole >= enough)
        assert early <= whole
        assert early == whole or early >= enough


def test_group__a_cell_that_is_near_two_joins_them():
    number, is_sure = group([henon(512, 1), circle(512, 0.0) + 5.0, henon(512, 2)], PLANE)
    assert number.tolist() == [0, 1, 0]
    assert is_sure
    assert is_stationary(henon(512, 3), PLANE)
    assert is_stationary(circle(512, 0.0), PLANE)
    creeping = np.stack([1.0 / np.sqrt(np.arange(1, 513)), np.zeros(512)], axis=1)
    assert not is_stationary(creeping, PLANE)


@pytest.mark.parametrize("n_keep", [5, 20, 60])
def test_members__cells_with_few_points(n_keep):
    sets = [Cloud.of([henon(2048, i) for i in range(4)], PLANE, 1e-5), Cloud.of([circle(2048, 0.1) + 5.0], PLANE, 1e-5)]
    own = np.stack([henon(n_keep, 100 + i) for i in range(50)])
    assert (members(own, sets) == 0).mean() >= 0.96
    other = np.stack([circle(n_keep, 0.01 * i) + 5.0 for i in range(50)])
    assert (members(other, sets) == 1).all()
    assert (members(own + 2.0, sets) == -1).all()
