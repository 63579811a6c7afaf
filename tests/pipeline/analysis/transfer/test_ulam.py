"""Markov chains of boxes: walks, blocks and cycles whose spectra, committors and passage times stand on paper."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from pipeline.analysis.transfer.ulam import (
    OUTSIDE,
    Grid,
    chain_of,
    closed_classes,
    committors,
    conditioned,
    lasting,
    leading_eigenvalue,
    memberships,
    passage_times,
    slow_eigenvalues,
    stationary,
)


def chain_with(steps: dict[tuple[int, int], float]) -> csr_array:
    """Return the transition probabilities of a chain that is given by the weights of its steps."""
    before, after = np.array([*steps]).T
    return chain_of(before, after, np.array([*steps.values()])).p


def walk(n: int, up: float, *, ends: float = 1.0) -> csr_array:
    """Return the walk on 0 ... n that goes up with a probability, and stays at its ends with another one."""
    steps = {(i, i + 1): up for i in range(1, n)} | {(i, i - 1): 1.0 - up for i in range(1, n)}
    steps |= {(0, 0): ends, (n, n): ends}
    if ends < 1.0:
        steps |= {(0, 1): 1.0 - ends, (n, n - 1): 1.0 - ends}
    return chain_with(steps)


def test_grid__centres_lie_in_their_boxes() -> None:
    bins = np.array([3, 5, 4])
    grid = Grid(np.array([-1.0, 0.0, -np.pi]), np.array([2.0, 0.1, np.pi]), bins, np.array([False, False, True]))
    boxes = np.arange(60)
    np.testing.assert_array_equal(grid.box_of(grid.centres_of(boxes)), boxes)
    # the last state varies fastest; the first box has its centre half a width above the lower ends
    np.testing.assert_array_equal(grid.places_of(np.array([0, 1, 4, 20])), [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]])
    np.testing.assert_allclose(grid.centres_of(np.array([0]))[0], [-0.5, 0.01, -0.75 * np.pi])


def test_chain__paths_into_boxes_without_pairs_are_conditioned_away() -> None:
    # from 0 half of the pairs stay and half go to 1, from where every pair goes to 7, in which none begins
    chain = chain_of(np.array([0, 0, 1, 1]), np.array([0, 1, 7, 7]))
    assert chain.unknown == 0.5
    np.testing.assert_array_equal(chain.p.toarray(), [[1.0, 0.0], [0.0, 0.0]])
    # a pair that ends outside is a known end: the row lacks its share
    chain = chain_of(np.array([0, 0, 1, 1]), np.array([0, 1, 7, OUTSIDE]))
    np.testing.assert_allclose(chain.p.toarray(), [[0.5, 0.5], [0.0, 0.0]])
    assert chain.out.tolist() == [0.0, 1.0]


def test_chain_of__weights_count_as_repeated_pairs() -> None:
    before, after = np.array([4, 4, 2, 2, OUTSIDE]), np.array([4, 2, 4, OUTSIDE, 4])
    weighed = chain_of(before, after, np.array([3.0, 1.0, 2.0, 2.0, 9.0]))
    repeated = chain_of(np.repeat(before, [3, 1, 2, 2, 9]), np.repeat(after, [3, 1, 2, 2, 9]))
    assert weighed.boxes.tolist() == [2, 4]
    np.testing.assert_allclose(weighed.p.toarray(), repeated.p.toarray())
    np.testing.assert_allclose(weighed.p.toarray(), [[0.0, 0.5], [0.25, 0.75]])
    # a resample may leave all pairs of a box out: it stays in its place
    left_out = chain_of(before, after, np.array([1.0, 1.0, 0.0, 0.0, 0.0]))
    assert left_out.boxes.tolist() == [2, 4]
    np.testing.assert_allclose(left_out.p.toarray(), [[0.0, 0.0], [0.0, 1.0]])


def test_lasting__leaves_out_what_can_only_end() -> None:
    p = csr_array(np.array([[0.5, 0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0.0]]))
    assert lasting(p).tolist() == [0]
    assert lasting(csr_array(np.diag(np.ones(3), 1))).tolist() == []
    np.testing.assert_allclose(
        conditioned(csr_array(np.array([[0.1, 0.3], [0.0, 0.2]]))).toarray(), [[0.25, 0.75], [0, 1]]
    )


def test_closed_classes__of_a_chain_with_a_transient_cycle() -> None:
    # 0 and 1 form a cycle with a leak to 2; 2 and 3 form one without; 4 is closed alone
    p = chain_with({(0, 1): 1, (1, 0): 0.9, (1, 2): 0.1, (2, 3): 1, (3, 2): 1, (4, 4): 1})
    assert sorted(own.tolist() for own in closed_classes(p)) == [[2, 3], [4]]


def test_stationary__is_parrys_measure_of_the_golden_beta_map() -> None:
    """The map x -> beta x mod 1, beta = (1 + sqrt 5)/2, on [0, 1/beta) and [1/beta, 1): Parry, 1960."""
    beta = 0.5 * (1.0 + np.sqrt(5.0))
    p = chain_with({(0, 0): 1.0 / beta, (0, 1): 1.0 / beta**2, (1, 0): 1.0})
    long = beta**2 / (1.0 + beta**2)
    np.testing.assert_allclose(stationary(p), [long, 1.0 - long], rtol=1e-14)


@pytest.mark.parametrize("n", [7, 500])
def test_stationary__of_a_biased_walk_is_geometric(n: int) -> None:
    # detailed balance: pi_(i+1)/pi_i = up/(1 - up) inside; dense and sparse
    up = 0.48
    pi = stationary(walk(n, up, ends=0.5))
    np.testing.assert_allclose(pi[2:n] / pi[1 : n - 1], up / (1.0 - up), rtol=1e-9)
    assert pi[1] / pi[0] == pytest.approx(0.5 / (1.0 - up))
    assert pi.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("n", [5, 600])
def test_leading_eigenvalue__of_a_walk_with_absorbing_ends(n: int) -> None:
    """Of the fair walk on n places it is cos(pi/(n + 1)), by dense matrices and by Arnoldi's method."""
    p = csr_array(0.5 * (np.eye(n, k=1) + np.eye(n, k=-1)))
    assert leading_eigenvalue(p) == pytest.approx(np.cos(np.pi / (n + 1)), abs=1e-11)


@pytest.mark.parametrize("n", [12, 450])
def test_slow_eigenvalues__of_a_lazy_walk_on_a_ring(n: int) -> None:
    p = csr_array(0.5 * np.eye(n) + 0.25 * (np.roll(np.eye(n), 1, 0) + np.roll(np.eye(n), -1, 0)))
    values, vectors = slow_eigenvalues(p, 5)
    exact = 0.5 + 0.5 * np.cos(2.0 * np.pi * np.array([0, 1, 1, 2, 2]) / n)
    np.testing.assert_allclose(values.real, exact, atol=1e-10)
    np.testing.assert_allclose(p @ vectors, vectors * values, atol=1e-9)
    assert len(slow_eigenvalues(csr_array(np.eye(3)), 5)[0]) == 3  # as many as there are


def test_slow_eigenvalues__of_a_cycle_are_roots_of_unity() -> None:
    values, _ = slow_eigenvalues(chain_with({(0, 1): 1, (1, 2): 1, (2, 0): 1}), 3)
    np.testing.assert_allclose(values**3, 1.0, atol=1e-12)
    assert values[0] == pytest.approx(1.0)
    assert sorted(np.sign(values[1:].imag)) == [-1.0, 1.0]


@pytest.mark.parametrize("sizes", [(3, 5), (2, 4, 3)])
def test_memberships__of_weakly_coupled_blocks(sizes: tuple[int, ...]) -> None:
    own = np.repeat(np.arange(len(sizes)), sizes)
    rng = np.random.default_rng(0)
    weights = np.where(own[:, None] == own, 1.0 + rng.uniform(size=(len(own), len(own))), 1e-4)
    p = csr_array(weights / weights.sum(axis=1, keepdims=True))
    chi = memberships(*slow_eigenvalues(p, len(sizes)))
    np.testing.assert_allclose(chi.sum(axis=1), 1.0, atol=1e-12)
    assert np.abs(chi - np.round(chi)).max() < 1e-2  # of the order of the coupling over the gap
    groups = chi.argmax(axis=1)
    assert len({*zip(groups.tolist(), own.tolist(), strict=True)}) == len(sizes)


def test_committors__of_a_biased_walk_are_those_of_the_gambler() -> None:
    """With r = (1 - up)/up the chance to reach n before 0 is (1 - r^i)/(1 - r^n) (Feller, vol. 1, XIV.2)."""
    n, up = 9, 0.6
    r = (1.0 - up) / up
    found = committors(walk(n, up), [np.array([0]), np.array([n])])
    exact = (1.0 - r ** np.arange(n + 1)) / (1.0 - r**n)
    np.testing.assert_allclose(found, np.stack([1.0 - exact, exact], axis=1), atol=1e-12)


def test_committors__lack_what_leaves_and_what_reaches_no_core() -> None:
    # from 1 a quarter each goes to both cores 0 and 2, to 3 that is closed, and outside
    p = csr_array(np.array([[1, 0, 0, 0], [0.25, 0, 0.25, 0.25], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    found = committors(p, [np.array([0]), np.array([2])])
    np.testing.assert_allclose(found, [[1, 0], [0.25, 0.25], [0, 1], [0, 0]])


def test_passage_times__of_a_biased_walk_with_a_wall() -> None:
    """With a wall at 0, the mean time from i to i + 1 obeys t_i = 1 + (1 - up)(t_(i-1) + t_i), t_0 = 1/up."""
    n, up = 8, 0.7
    steps = {(i, i + 1): up for i in range(n)} | {(i, i - 1): 1.0 - up for i in range(1, n)}
    p = chain_with(steps | {(0, 0): 1.0 - up, (n, n): 1.0})
    one = [1.0 / up]
    for _ in range(1, n):
        one.append((1.0 + (1.0 - up) * one[-1]) / up)
    exact = np.append(np.cumsum(one[::-1])[::-1], 0.0)
    np.testing.assert_allclose(passage_times(p, np.array([n])), exact, rtol=1e-12)
    leaky = csr_array(p.toarray() * np.where(np.arange(n + 1) == 3, 0.99, 1.0)[:, None])
    assert np.isinf(passage_times(leaky, np.array([n]))[:8]).all()  # each of them may leave at 3
