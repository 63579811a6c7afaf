"""Sample the posterior of an identification by an ensemble of walkers, and judge whether the chain has converged.

The moves are the affine-invariant stretch moves of Goodman and Weare (Commun. Appl. Math. Comput. Sci. 5, 2010, 65), by
the library emcee (Foreman-Mackey and others, Publ. Astron. Soc. Pac. 125, 2013, 306). Each half of the walkers is one
call of the engine. The chain is stored block by block with the state of its random numbers, so that a sampling that was
stopped goes on to the same numbers, and a finished one can be made longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pipeline.layout.identity import digest_of
from pipeline.products.reporting import report
from pipeline.rig.identify.directory import OUTCOMES, Outcomes, read_info
from pipeline.rig.identify.log_posterior import LogPosterior
from pipeline.rig.identify.statistics import root_of
from pipeline.specification.problems import SpecError, import_extra

Array = NDArray[np.float64]

BLOCK = 20
"""Steps of the chain between two files."""

LONG = 50.0
"""Autocorrelation times that a chain must be long: the error of their estimate is then about 10 % (Sokal)."""

ALIKE = 1.05
"""Split R-hat up to which the halves of the chain agree. An ensemble that is `LONG` has about 1.02."""

CHAINS = 1
"""Number of the results of chains, see `magpend_core.versions`."""

LEAST_ACCEPTED = 0.1
"""Least share of accepted moves; with fewer, the walkers hardly move."""

BURN_IN = 5.0
"""Autocorrelation times that are left out at the beginning, at most half of the chain."""

SHRINK = 0.5
"""Factor on the Gaussian of the first walkers' positions while too few of them have a density."""


@dataclass(frozen=True)
class Chain:
    """Positions of all walkers at all steps of a chain, with its convergence figures.

    Attributes
    ----------
    values : ndarray, (step, walker, n_free)
        Unknowns [SI], without the first steps.
    log_density : ndarray, (step, walker)
    accepted : float
        Share of accepted moves.
    n_discarded : int
        Steps that were left out at the beginning.
    time : ndarray, (n_free,)
        Integrated autocorrelation time of each unknown [steps].
    rhat : ndarray, (n_free,)
        Split R-hat of each unknown: 1 if the halves of all walkers agree.
    reasons : tuple of str
        Reasons why the chain has not converged; empty if it has.
    lost : float
        Share of the proposed parameters within the bounds for which a measured orbit or a trajectory was lost.
    """

    values: Array
    log_density: Array
    accepted: float
    n_discarded: int
    time: Array
    rhat: Array
    reasons: tuple[str, ...]
    lost: float = 0.0

    @property
    def n_effective(self) -> Array:
        """Number of independent draws that each unknown's values are worth."""
        return np.asarray(self.values.shape[0] * self.values.shape[1] / np.maximum(self.time, 1.0))


def require_emcee() -> None:
    """Raise `SpecError` if the library emcee is missing."""
    import_extra("emcee", "mcmc", "--mcmc")


def sample_posterior(
    directory: str | Path,
    density: LogPosterior,
    covariance: Array,
    *,
    n_walkers: int,
    most_steps: int,
    seed: int,
    echo: Callable[[str], None],
) -> Chain:
    """Sample a posterior density until the chain has converged, or until it has its most steps.

    Parameters
    ----------
    directory
        Directory of the identification, which keeps the chain under ``outcomes``.
    density
        Logarithm of the density.
    covariance
        Covariance of the estimates, (n_free, n_free), from which the walkers start.
    n_walkers
        Number of walkers, at least twice the number of unknowns, and even.
    most_steps
        Number of steps after which the chain ends in any case.
    seed
        Seed of the walkers and of their moves.
    echo
        Function that prints a line.

    Returns
    -------
    Chain

    Raises
    ------
    SpecError
        For too few walkers, without emcee, and if no walker finds a place with a density.
    """
    require_emcee()
    n_free = len(density.problem.free)
    if n_walkers < 2 * n_free or n_walkers % 2:
        raise SpecError(
            [f"--walkers = {n_walkers}: must be even and at least {2 * n_free}, twice the number of unknowns."]
        )
    store = _Blocks(directory, seed, n_walkers)
    found: list[dict[str, Array]] = []
    chain: Chain | None = None
    while chain is None or (chain.reasons and BLOCK * len(found) < most_steps):
        block = store.recall(len(found))
        if block is None:
            start = found[-1] if found else _first(density, covariance, n_walkers, seed)
            block = _advance(density, start, BLOCK * len(found), most_steps)
            store.keep(len(found), block)
        found.append(block)
        chain = judged(
            np.concatenate([b["values"] for b in found]),
            np.concatenate([b["log_density"] for b in found]),
            float(np.sum([b["accepted"].sum() for b in found]) / (n_walkers * BLOCK * len(found))),
        )
    if store.n_recalled:
        echo(f"{BLOCK * store.n_recalled} steps of the chain were there before")
    n_inside, n_lost = np.sum([block["counts"] for block in found], axis=0)
    return replace(chain, lost=float(n_lost / max(n_inside, 1)))


class _Blocks:
    """Stored blocks of one chain; its key is everything that decides its numbers."""

    def __init__(self, directory: str | Path, seed: int, n_walkers: int) -> None:
        info = read_info(directory)
        key = {"digest": info.digest, "version": CHAINS, "seed": seed, "walkers": n_walkers, "block": BLOCK}
        self._outcomes = Outcomes(info.directory / OUTCOMES)
        self._name = f"chain-{digest_of(key)[:8]}"
        self.n_recalled = 0

    def recall(self, number: int) -> dict[str, Array] | None:
        """Return a stored block, or None if it is missing or damaged."""
        found = self._outcomes.recall(f"{self._name}-{number:05d}", _unpacked)
        self.n_recalled += found is not None
        return found

    def keep(self, number: int, block: Mapping[str, Array]) -> None:
        """Store a block."""
        self._outcomes.store(f"{self._name}-{number:05d}", block)


_FIELDS = ("values", "log_density", "accepted", "counts", "keys", "places")


def _unpacked(data: Mapping[str, np.ndarray]) -> dict[str, Array]:
    return {name: np.asarray(data[name]) for name in _FIELDS}


def _first(density: LogPosterior, covariance: Array, n_walkers: int, seed: int) -> dict[str, Array]:
    """Return the start of a chain: walkers drawn from the Gaussian of the estimates where there is a density.

    The Gaussian shrinks while fewer than a quarter of its draws have one.
    """
    best, random = density.best.theta, np.random.default_rng(seed)
    root = root_of(covariance)
    factor = 1.0
    for _ in range(12):
        drawn = best + factor * (random.standard_normal((4 * n_walkers, len(best))) @ root)
        inside = ((drawn >= density.problem.lower) & (drawn <= density.problem.upper)).all(axis=1)
        if inside.sum() >= n_walkers:
            own = drawn[inside]
            heights = density(own)
            there = np.flatnonzero(np.isfinite(heights))[:n_walkers]
            if len(there) == n_walkers:
                keys, places = _packed(np.random.RandomState(seed).get_state())
                return {"values": own[there][None], "log_density": heights[there][None], "keys": keys, "places": places}
        factor *= SHRINK
    raise SpecError(
        [
            "--mcmc: almost no parameters beside the best ones have all measured orbits and lie within the bounds; "
            "widen the bounds, or hold out the orbits close to folds."
        ]
    )


def _advance(density: LogPosterior, start: Mapping[str, Array], done: int, most_steps: int) -> dict[str, Array]:
    """Return the next block of a chain, from the last walkers of the block before."""
    import emcee

    n_walkers, n_free = start["values"].shape[1:]
    before = np.array([density.n_inside, density.n_lost])
    sampler = emcee.EnsembleSampler(n_walkers, n_free, density, vectorize=True)
    # emcee's own wrapper prints a traceback if a signal ends the command
    sampler.log_prob_fn = density
    state = emcee.State(
        start["values"][-1], log_prob=start["log_density"][-1], random_state=_unpacked_random(start), copy=True
    )
    for i, moved in enumerate(sampler.sample(state, iterations=BLOCK, skip_initial_state_check=True)):
        report("steps of the chain", done + i + 1, most_steps)
        state = moved
    keys, places = _packed(state.random_state)
    return {
        "values": sampler.get_chain(),
        "log_density": sampler.get_log_prob(),
        "accepted": np.asarray(sampler.backend.accepted, dtype=np.float64),
        "counts": np.array([density.n_inside, density.n_lost]) - before,
        "keys": keys,
        "places": places,
    }


def _packed(state: Any) -> tuple[Array, Array]:
    """Return a state of Mersenne Twister as two arrays."""
    _, keys, position, has_gauss, cached = state
    return np.asarray(keys), np.array([position, has_gauss, cached], dtype=np.float64)


def _unpacked_random(block: Mapping[str, Array]) -> tuple[str, Array, int, int, float]:
    position, has_gauss, cached = block["places"]
    return "MT19937", np.asarray(block["keys"], np.uint32), int(position), int(has_gauss), float(cached)


# ---- convergence -------------------------------------------------------------------------------


def judged(values: Array, log_density: Array, accepted: float) -> Chain:
    """Leave out the first steps of a chain, and compute its convergence figures.

    Parameters
    ----------
    values
        All positions, (step, walker, n_free).
    log_density
        Their log densities, (step, walker).
    accepted
        Share of accepted moves.
    """
    n = len(values)
    rough = BURN_IN * float(np.max(autocorrelation_time(values[n // 2 :])))
    discarded = n // 2 if not rough < n // 2 else math.ceil(rough)
    kept = values[discarded:]
    time, rhat = autocorrelation_time(kept), split_rhat(kept)
    longest, worst = float(np.max(time)), float(np.max(rhat))
    reasons = []
    # negated, so that NaN counts as not converged
    if not len(kept) >= LONG * longest:
        reasons.append(f"{len(kept)} steps are {len(kept) / longest:.3g} autocorrelation times, fewer than {LONG:g}")
    if not worst <= ALIKE:
        reasons.append(f"the halves of the chain differ: split R-hat is {worst:.3f}, above {ALIKE:g}")
    if not accepted >= LEAST_ACCEPTED:
        reasons.append(f"only {100.0 * accepted:.2g} % of the moves were accepted")
    return Chain(kept, log_density[discarded:], accepted, discarded, time, rhat, tuple(reasons))


def autocorrelation_time(values: Array) -> Array:
    """Return the integrated autocorrelation time of each unknown, (n_free,) [steps], averaged over the walkers.

    It is infinite where no value changed.
    """
    from emcee.autocorr import integrated_time

    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.asarray(integrated_time(values, tol=0, quiet=True))
    return np.where(np.isfinite(found) & (found > 0.0), found, np.inf)


def split_rhat(values: Array) -> Array:
    """Return the split R-hat of each unknown, (n_free,), with the halves of each walker as chains.

    Gelman and others, Bayesian Data Analysis, third edition, 2013, equation 11.4.
    """
    n = len(values) // 2
    if n < 2:
        return np.full(values.shape[2], np.inf)
    halves = np.concatenate([values[:n], values[-n:]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = n * halves.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(((n - 1) / n * within + between / n) / within))


def figures_of(chain: Chain, names: Sequence[str]) -> xr.Dataset:
    """Return the convergence figures of a chain, as they are stored with its draws."""
    return xr.Dataset(
        {
            "autocorrelation_time": ("unknown", chain.time, {"units": "1", "long_name": "steps"}),
            "n_effective": ("unknown", chain.n_effective, {"units": "1"}),
            "split_rhat": ("unknown", chain.rhat, {"units": "1"}),
        },
        coords={"unknown": list(names)},
        attrs={
            "method": "mcmc",
            "n_walkers": chain.values.shape[1],
            "n_kept": chain.values.shape[0],
            "n_discarded": chain.n_discarded,
            "accepted": chain.accepted,
            "lost": chain.lost,
            "converged": int(not chain.reasons),
            "not_converged_because": "; ".join(chain.reasons),
        },
    )
