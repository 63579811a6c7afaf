"""Sampling of posteriors that are known: in closed form, or by quadrature of a closed form."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.identify.directory import read_result
from pipeline.rig.identify.identification import identify
from pipeline.rig.identify.mcmc import LogPosterior, _first, judged, log_posterior, sample_posterior, split_rhat
from pipeline.rig.identify.posterior import Sampling, kept_draws, posterior_table, sample_draws, write_posterior
from pipeline.specification.problems import SpecError
from pipeline.store.errors import RefusedError
from tests.pipeline.bautin import MODEL, SECTION, TRUTH, radius, write_orbits, write_toml
from tests.pipeline.factories import silent

pytestmark = pytest.mark.slow  # needs emcee

VALUES, SD, FREQUENCY_SD = (0.05, 0.1, 0.3), 0.1, 0.05
"""Parameter values of three stable cycles, and standard deviations so large that the posterior is far from Gaussian."""

BOUNDS = {"g": (0.3, 5.0), "h": (-1.0, 0.4), "w": (0.0, 100.0)}


def chi2_of(g, h, w):
    """Sum of squared residuals in standard deviations, from the closed form; NaN where a cycle does not exist."""
    amplitudes = sum(((radius(m) - radius(m, 1, g, h)) / SD) ** 2 for m in VALUES)
    return amplitudes + len(VALUES) * ((TRUTH["w"] - w) / (2 * math.pi) / FREQUENCY_SD) ** 2


@pytest.fixture(scope="module")
def cycles(tmp_path_factory):
    """An identification from three stable cycles without noise."""
    folder = tmp_path_factory.mktemp("cycles")
    write_orbits(folder / "cycles.csv", VALUES, sd=SD, frequency_sd=FREQUENCY_SD)
    data = {
        "kind": "identification",
        "model": MODEL,
        "identify": {name: {"start": TRUTH[name], "bounds": list(BOUNDS[name])} for name in TRUTH},
        "search": {"n_starts": 1, "profiles": False},
        "orbits": [{"file": "cycles.csv", "section": SECTION, "range": [-0.3, 0.5]}],
    }
    write_toml(folder / "fit.toml", data)
    identify(folder / "fit.toml", folder / "out", figures=False, echo=silent)
    return folder / "out"


def test_log_posterior__is_that_of_the_closed_form(cycles):
    density = log_posterior(cycles, None, read_result(cycles))
    thetas = np.array([[1.2, 0.05, 6.0], [2.0, -0.3, 6.3], [0.6, 0.2, 5.5], [6.0, 0.0, 6.0], [1.0, 0.35, 6.0]])
    names = [list(density.problem.names).index(name) for name in "ghw"]
    own = np.empty_like(thetas)
    own[:, names] = thetas
    found = density(own)
    np.testing.assert_allclose(found[:3], -0.5 * chi2_of(*thetas[:3].T), rtol=1e-6, atol=1e-9)
    # outside the bounds of g; and no cycle at 0.05, beyond the fold at h - 1/(4 g)
    assert np.isneginf(found[3:]).all()
    # each row depends on itself alone
    assert (density(own[1:2]) == found[1]).all()


class ClosedForm(LogPosterior):
    """The density from the closed form; `test_log_posterior__is_that_of_the_closed_form` compares the two."""

    def __call__(self, thetas):
        theta = dict(zip(self.problem.names, thetas.T, strict=True))
        found = -0.5 * chi2_of(*(theta[name] for name in "ghw"))
        inside = ((thetas >= self.problem.lower) & (thetas <= self.problem.upper)).all(axis=1)
        return np.where(inside & np.isfinite(found), found, -np.inf)


def by_quadrature():
    """Mean, covariance and skewness of g and h, and quantiles of g, from the closed form on a grid."""
    g, h = np.meshgrid(np.linspace(*BOUNDS["g"], 1201), np.linspace(*BOUNDS["h"], 1201), indexing="ij")
    weight = np.nan_to_num(np.exp(-0.5 * chi2_of(g, h, TRUTH["w"])))
    weight /= weight.sum()
    mean = np.array([(weight * v).sum() for v in (g, h)])
    about = [g - mean[0], h - mean[1]]
    covariance = np.array([[(weight * a * b).sum() for b in about] for a in about])
    skew = (weight * about[0] ** 3).sum() / covariance[0, 0] ** 1.5
    below = np.cumsum(weight.sum(axis=1))
    return mean, covariance, skew, np.interp([0.025, 0.5, 0.975], below, g[:, 0])


@pytest.fixture(scope="module")
def closed(cycles):
    """The density in closed form, with a chain of it that has converged."""
    result = read_result(cycles)
    density = ClosedForm(**vars(log_posterior(cycles, None, result)))
    return density, np.array(result["covariance"]["matrix"])


def chain_of(cycles, closed, seed, most_steps, echo=silent):
    density, covariance = closed
    return sample_posterior(cycles, density, covariance, n_walkers=32, most_steps=most_steps, seed=seed, echo=echo)


def test_sample_posterior__agrees_with_quadrature(cycles, closed):
    chain = chain_of(cycles, closed, 3, 6000)
    assert chain.reasons == ()
    mean, covariance, skew, quantiles = by_quadrature()
    # far from the Gaussian of its curvature
    assert skew > 0.5
    names = list(closed[0].problem.names)
    g, h, w = (chain.values[..., names.index(name)].ravel() for name in "ghw")
    n = float(chain.n_effective.min())
    assert n > 1000
    # four standard errors of a mean, and of a variance with twice the fourth moment of a Gaussian
    errors = 4 * np.sqrt(covariance.diagonal() / n)
    assert (np.abs([g.mean(), h.mean()] - mean) < errors).all()
    np.testing.assert_allclose(np.cov(g, h), covariance, rtol=4 * np.sqrt(5.0 / n))
    np.testing.assert_allclose(np.quantile(g, [0.025, 0.5, 0.975]), quantiles, atol=0.05 * np.ptp(quantiles))
    # the angular velocity is Gaussian: three frequencies, each with its error
    sd = 2 * math.pi * FREQUENCY_SD / math.sqrt(3)
    assert w.mean() == pytest.approx(TRUTH["w"], abs=4 * sd / math.sqrt(n))
    assert w.std() == pytest.approx(sd, rel=4 / math.sqrt(2 * n))
    assert abs(np.corrcoef(w, g)[0, 1]) < 4 / math.sqrt(n)


def test_sample_posterior__goes_on_to_the_same_bytes(cycles, closed):
    import emcee

    before = set((cycles / "outcomes").glob("chain-*.npz"))
    first = chain_of(cycles, closed, 4, 200)
    blocks = sorted(set((cycles / "outcomes").glob("chain-*.npz")) - before)
    assert len(blocks) == 10
    content = [path.read_bytes() for path in blocks]
    # as if killed after the third block, the fourth half written
    for path in blocks[3:]:
        path.unlink()
    blocks[3].write_bytes(content[3][:100])
    lines = []
    again = chain_of(cycles, closed, 4, 200, lines.append)
    assert (again.values == first.values).all()
    assert [path.read_bytes() for path in blocks] == content
    assert lines == ["60 steps of the chain were there before"]
    # one sampling of 200 steps without blocks
    start = _first(*closed, 32, 4)
    sampler = emcee.EnsembleSampler(32, 3, closed[0], vectorize=True)
    random = np.random.RandomState(4).get_state()
    sampler.run_mcmc(emcee.State(start["values"][0], log_prob=start["log_density"][0], random_state=random), 200)
    assert (sampler.get_chain()[-len(first.values) :] == first.values).all()
    longer = chain_of(cycles, closed, 4, 240)
    assert len(longer.values) + longer.n_discarded == 240
    other = chain_of(cycles, closed, 5, 40)
    assert not np.isin(other.values, first.values).any()


def test_sample_draws__not_converged_is_an_answer(cycles):
    drawn = sample_draws(cycles, 40, seed=5, sampling=Sampling(most_steps=20), echo=silent)
    assert drawn.attrs["converged"] == 0
    table = posterior_table(drawn)
    assert "NOT CONVERGED" in table.lines[-1]
    assert "fewer than 50" in table.lines[-1]
    assert not table.rows[0]["converged"]


def test_write_posterior__keeps_the_draws_for_runs(cycles):
    sampling = Sampling(most_steps=20)
    _, bifurcations, _ = write_posterior(cycles, 12, seed=5, sampling=sampling, figures=False, echo=silent)
    kept = kept_draws(cycles, 12)
    xr.testing.assert_equal(kept["value"], sample_draws(cycles, 12, 5, sampling, echo=silent)["value"])
    assert kept_draws(cycles, 10).sizes["draw"] == 10
    with pytest.raises(SpecError, match=r"-n = 13: .* has 12 draws"):
        kept_draws(cycles, 13)
    hopf = next(row for row in bifurcations.rows if row["kind"] == "hopf")
    h = kept["value"].sel(parameter="h").values
    assert (hopf["low"], hopf["high"]) == pytest.approx(tuple(np.quantile(h, [0.025, 0.975])), abs=1e-6)


def test_sample_draws__names_the_remedy(cycles, monkeypatch):
    with pytest.raises(SpecError, match=r"--walkers = 5: must be even and at least 6"):
        sample_draws(cycles, 20, sampling=Sampling(n_walkers=5), echo=silent)
    monkeypatch.setitem(sys.modules, "emcee", None)
    with pytest.raises(SpecError, match=r"pip install '\.\[mcmc\]'"):
        sample_draws(cycles, 20, echo=silent)


def test_judged__a_drifting_chain_has_not_converged():
    random = np.random.default_rng(1)
    white = random.standard_normal((400, 8, 2))
    assert judged(white, np.zeros((400, 8)), 0.5).reasons == ()
    assert judged(white, np.zeros((400, 8)), 0.5).n_effective == pytest.approx(3200, rel=0.2)
    assert "moves" in judged(white, np.zeros((400, 8)), 0.05).reasons[0]
    drift = white + np.linspace(0.0, 3.0, 400)[:, None, None]
    assert any("halves" in reason for reason in judged(drift, np.zeros((400, 8)), 0.5).reasons)
    stuck = np.ones((400, 8, 2))
    assert judged(stuck, np.zeros((400, 8)), 0.0).reasons


def test_judged__autocorrelation_time_of_an_autoregression():
    # x' = a x + e has the time (1 + a)/(1 - a) = 9, and R-hat beside 1
    random, a = np.random.default_rng(2), 0.8
    values = np.zeros((4000, 16, 1))
    for i in range(1, 4000):
        values[i] = a * values[i - 1] + random.standard_normal((16, 1))
    chain = judged(values, np.zeros((4000, 16)), 0.5)
    assert chain.time[0] == pytest.approx(9.0, rel=0.1)
    assert chain.reasons == ()
    assert split_rhat(values)[0] == pytest.approx(1.0, abs=0.01)
    assert split_rhat(values + np.arange(16)[:, None])[0] > 1.5


RAMP = """
name = "ramp"
[states.x]
scale = 1.0
[parameters.c]
value = 0.4
[equations]
x = "c"
"""


def test_log_posterior__of_recordings_is_the_gaussian_of_a_linear_model(tmp_path):
    """A ramp with a free start in each piece: the slope's error is that of linear regression."""
    random, n, noise, c = np.random.default_rng(5), 60, 0.03, 0.5
    rows, begin, square = [], 0.0, 0.0
    for k in range(3):
        t = 0.1 * np.arange(n)
        rows += [f"{begin + a:.3f},{k + c * a + noise * random.standard_normal():.9f}" for a in t]
        begin += t[-1] + 1.1
        square += ((t - t.mean()) ** 2).sum()
    (tmp_path / "ramp.csv").write_text("\n".join(["time,x", *rows]) + "\n")
    (tmp_path / "ramp.toml").write_text(RAMP)
    (tmp_path / "map.toml").write_text(
        'model = "ramp.toml"\ntime = { channel = "time" }\ndrive = "none"\n[channels.x]\nchannel = "x"\n'
    )
    (tmp_path / "fit.toml").write_text(
        'kind = "identification"\nmodel = "ramp.toml"\n[identify.c]\n[[recordings]]\nfile = "ramp.csv"\n'
        'mapping = "map.toml"\ndrive = "none"\n[search]\nn_starts = 1\nprofiles = false\n'
    )
    result = identify(tmp_path / "fit.toml", tmp_path / "out", figures=False, echo=silent)
    assert result["covariance"]["estimator"] == "white"
    # the scatter of the residuals, three starts and a slope fitted
    sd = result["rms"]["x"] * math.sqrt(3 * n / (3 * n - 4) / square)
    density = log_posterior(tmp_path / "out", tmp_path / "fit.toml", result)
    steps = np.array([-2.0, -0.5, 0.0, 1.0, 3.0])
    found = density(result["values"]["c"] + sd * steps[:, None])
    np.testing.assert_allclose(found - found[2], -0.5 * steps**2, atol=1e-5)
    drawn = sample_draws(tmp_path / "out", 20, 1, Sampling(most_steps=20, spec=tmp_path / "fit.toml"), echo=silent)
    assert (np.abs(drawn["value"].sel(parameter="c") - c) < 6 * sd).all()
    with pytest.raises(SpecError, match="--spec: missing"):
        sample_draws(tmp_path / "out", 20, echo=silent)
    text = (tmp_path / "fit.toml").read_text().replace("n_starts = 1", "n_starts = 2")
    (tmp_path / "other.toml").write_text(text)
    with pytest.raises(RefusedError, match="another identification"):
        sample_draws(tmp_path / "out", 20, sampling=Sampling(spec=tmp_path / "other.toml"), echo=silent)
