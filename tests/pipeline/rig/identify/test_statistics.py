"""Covariance and intervals against closed forms, brute force, and their own coverage."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.identify import statistics as st

SCALE = np.array([0.4, 6.0])


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.mark.parametrize("undetermined", [False, True])
def test_eliminate_starts__is_the_block_of_the_inverse(rng, undetermined):
    jacobian = kept = rng.normal(size=(40, 9))
    if undetermined:  # a start that no sample sees
        jacobian[:, 5] = 0.0
        kept = np.delete(jacobian, 5, axis=1)
    information, _ = st.eliminate_starts(jacobian, 3)
    block = np.linalg.inv(kept.T @ kept)[:3, :3]
    np.testing.assert_allclose(np.linalg.inv(information), block, rtol=1e-10)


def test_covariance_of__white_is_the_textbook_formula(ringdown, rng):
    found = ringdown.fit(*ringdown.record(rng), noise=0.02)
    covariance = st.covariance_of(found.linear, SCALE, "white")
    j, r = found.jacobian, np.concatenate(found.residuals)
    variance = r @ r / (len(r) - j.shape[1])
    textbook = variance * np.linalg.inv(j.T @ j)[:2, :2]
    np.testing.assert_allclose(covariance.matrix, textbook, rtol=1e-8)
    assert covariance.degrees == len(r) - j.shape[1]
    assert covariance.inflation == pytest.approx(np.sqrt(variance))


def test_covariance_of__pieces_is_the_jackknife_by_refits(ringdown, rng):
    """One step from the optimum against whole refits without a piece; equal but for curvature."""
    times, measured = ringdown.record(rng, noise=1e-4)
    found = ringdown.fit(times, measured)
    matrix = st.covariance_of(found.linear, SCALE, "pieces").matrix
    left = []
    for k in range(len(times)):
        kept = [i for i in range(len(times)) if i != k]
        left.append(ringdown.fit([times[i] for i in kept], [measured[i] for i in kept]).theta)
    n = len(times)
    about = np.array(left) - np.mean(left, axis=0)
    # noise of 1e-4 rad on motions of 1 rad: curvature enters at about that share
    np.testing.assert_allclose(matrix, (n - 1) / n * about.T @ about, rtol=2e-3)


def test_covariance_of__newey_west_is_the_double_sum(rng):
    scores = rng.normal(size=(30, 2))
    weight = np.maximum(1 - np.abs(np.subtract.outer(np.arange(30), np.arange(30))) / 5, 0.0)
    np.testing.assert_allclose(st._bartlett(scores, 4), scores.T @ weight @ scores, rtol=1e-10)


@pytest.mark.parametrize("estimator", ["white", "pieces"])
def test_covariance_of__a_prior_counts_as_it_says(ringdown, rng, estimator):
    """A prior far better than the data is what is left; one far worse changes nothing."""
    times, measured = ringdown.record(rng)
    sure = ringdown.fit(times, measured, noise=0.01, prior=(ringdown.TRUTH, np.array([1e-6, np.inf])))
    errors = st.covariance_of(sure.linear, SCALE, estimator).errors
    assert errors[0] == pytest.approx(1e-6, rel=1e-3)
    plain = ringdown.fit(times, measured, noise=0.01)
    vague = ringdown.fit(times, measured, noise=0.01, prior=(ringdown.TRUTH, np.array([1e3, 1e3])))
    np.testing.assert_allclose(
        st.covariance_of(vague.linear, SCALE, estimator).errors,
        st.covariance_of(plain.linear, SCALE, estimator).errors,
        rtol=1e-2,  # two degrees of freedom of a thousand
    )


def test_covariance_of__what_is_not_determined_is_infinite():
    """Two parameters of which the data see the sum alone, beside one that they see."""
    rng = np.random.default_rng(1)
    slope = rng.normal(size=(100, 2))
    slopes = np.stack([slope[:, 0], slope[:, 0], slope[:, 1]], axis=1)[:, None, :]
    fit = st.Linearised(
        np.einsum("tcp,tcq->pq", slopes, slopes), np.zeros(3), (rng.normal(size=(100, 1)),), (slopes,), (0,), 0
    )
    covariance = st.covariance_of(fit, np.ones(3))
    assert np.isinf(covariance.errors[:2]).all()
    assert 0.05 < covariance.errors[2] < 0.2
    assert np.isnan(covariance.correlations[0]).all()


@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_robust_weights__are_derivatives_of_the_loss(loss):
    rho = {
        "soft_l1": lambda z: 2 * (np.sqrt(1 + z) - 1),
        "huber": lambda z: np.where(z <= 1, z, 2 * np.sqrt(z) - 1),
        "cauchy": np.log1p,
    }[loss]
    r, h = np.array([0.1, 0.5, 0.9, 1.5, 3.0]), 1e-5
    psi = lambda x: (rho((x + h) ** 2) - rho((x - h) ** 2)) / (4 * h)  # noqa: E731
    weight, slope = st.robust_weights(r, loss)
    np.testing.assert_allclose(weight * r, psi(r), rtol=1e-6)
    inner = r < 1 if loss == "cauchy" else np.ones(5, bool)
    np.testing.assert_allclose(slope[inner], ((psi(r + h) - psi(r - h)) / (2 * h))[inner], atol=1e-4)


@pytest.mark.parametrize("memory", [0.5, 0.9])
def test_n_effective__of_autoregressive_noise(ringdown, memory, rng):
    """n (1 - a)/(1 + a) of noise with the lag-1 correlation a."""
    _, noise = ringdown.record(rng, n_pieces=20, n=4000, noise=1.0, memory=memory)
    # the motions decay within a hundred samples of 4000
    (found,) = st.n_effective([m[1000:, None] for m in noise])
    assert found == pytest.approx(20 * 3000 * (1 - memory) / (1 + memory), rel=0.15)


@pytest.mark.slow
def test_is_autocorrelated__white_and_not(rng):
    taken = [st.is_autocorrelated([rng.normal(size=(300, 2)) for _ in range(5)]) for _ in range(400)]
    assert sum(taken) <= 10  # 4 of 400 at the level of 1 %; 10 or more in 1 of 100
    walk = [np.cumsum(rng.normal(size=(300, 2)), axis=0) for _ in range(5)]
    assert st.is_autocorrelated(walk)


def test_pooled_autocorrelation__leaves_out_what_was_not_measured(rng):
    r = np.sin(np.arange(400.0))
    holes = r.copy()
    holes[rng.choice(400, 100, replace=False)] = np.nan
    np.testing.assert_allclose(
        st.pooled_autocorrelation([holes], 10),
        np.cos(np.arange(11.0)),
        atol=0.03,  # 300 of 400 samples
    )


def coverage(ringdown, seeds: int, *estimators, **rig) -> tuple[np.ndarray, list[set[str]]]:
    """Share of seeds whose interval holds the truth, by estimator and parameter; and what was chosen."""
    inside, chosen = np.zeros((len(estimators), 2)), [set() for _ in estimators]
    for seed in range(seeds):
        found = ringdown.fit(*ringdown.record(np.random.default_rng(seed), **rig), noise=0.01)
        for i, estimator in enumerate(estimators):
            covariance = st.covariance_of(found.linear, SCALE, estimator)
            chosen[i].add(covariance.estimator)
            inside[i] += np.abs(found.theta - ringdown.TRUTH) <= covariance.critical * covariance.errors
    return inside / seeds, chosen


@pytest.mark.slow
def test_coverage__white_noise_quantised_with_a_dead_band(ringdown):
    (share,), _ = coverage(ringdown, 200, None, noise=0.002, bits=12, dead_band=True)
    assert ((share >= 0.92) & (share <= 0.98)).all(), share


@pytest.mark.slow
@pytest.mark.parametrize(("n_pieces", "n"), [(16, 120), (2, 1500)])
def test_coverage__autocorrelated_noise(ringdown, n_pieces, n):
    """Where residuals remember, intervals of independent ones are far too narrow; ours are not."""
    rig = {"n_pieces": n_pieces, "n": n, "memory": 0.9}
    (plain, share), (_, chosen) = coverage(ringdown, 100, "white", None, **rig)
    assert chosen == {"pieces" if n_pieces > 2 else "newey-west"}
    assert (share >= 0.9).all(), share
    assert (plain < 0.9).any(), plain
