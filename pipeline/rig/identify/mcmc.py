"""Sample the posterior density of an identification by an ensemble of walkers, and judge if the chain has converged.

    log p(theta) = -(chi^2_pieces / k^2 + chi^2_stated) / (2 s^2)   within the bounds, minus infinity outside

`chi^2_pieces` is that of the recordings' samples, with the initial state of each piece fitted for each theta (profile
likelihood). `chi^2_stated` is that of measured orbits, measured bifurcations and priors, which state their errors.

Residuals of recordings are autocorrelated, so their samples say less than as many independent ones would. `k^2` scales
their likelihood down, so that its curvature agrees on average with the covariance of the fit (the magnitude adjustment
of Ribatet, Cooley and Davison, Stat. Sinica 22, 2012, 813, equation 3.1). `s` is the factor by which a fit to orbits
alone raises stated errors to the scatter of the residuals.

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

from magpend_core.models import load_model
from magpend_core.models.model import Parameters
from pipeline.analysis.branches.carrying import OrbitData
from pipeline.layout.identity import digest_of
from pipeline.products.reporting import report
from pipeline.rig.identify import directory as store
from pipeline.rig.identify.build import build, read_all
from pipeline.rig.identify.directory import OUTCOMES, Info, Outcomes, read_info, stored_tables
from pipeline.rig.identify.local import Fit, fit_many_starts
from pipeline.rig.identify.measured_orbits import MeasuredTable, read_orbits
from pipeline.rig.identify.orbit_residuals import LOST, orbit_rows
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.search import unpack_fit
from pipeline.rig.identify.specification import load_identification
from pipeline.rig.identify.statistics import Linearised, linearise, loss_scale_of, root_of
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError, import_extra
from pipeline.store.errors import DamagedError

# ---- density ---------------------------------------------------------------------------------------

Array = NDArray[np.float64]

ORBITS_ALONE = "orbits"
"""Estimator of the covariance of a fit without recordings."""


@dataclass
class LogPosterior:
    """Logarithm of the posterior density of the unknowns, up to a constant; it counts what it could not evaluate."""

    problem: Problem  # problem at the best fit; Newton's method for measured orbits starts from the orbits there
    best: Fit
    # (n_piece, n_states, n_free) derivative of the best initial states of the pieces by the unknowns, for first guesses
    moves: Array
    # factors on the chi^2 of the pieces and on that of orbits and priors: ``1/k^2`` and ``1/s^2`` of the module
    pieces: float
    stated: float
    # number of sets of unknowns within the bounds, and of those for which a measured orbit or a trajectory was lost
    n_inside: int = 0
    n_lost: int = 0

    def __call__(self, thetas: Array) -> Array:
        """Return the log density of each row of unknowns; minus infinity outside bounds or where orbits are lost."""
        found = np.full(len(thetas), -np.inf)
        problem = self.problem
        inside = np.flatnonzero(((thetas >= problem.lower) & (thetas <= problem.upper)).all(axis=1))
        if not len(inside):
            return found
        own = thetas[inside]
        chi2, lost = self.stated * self._priors(own), np.zeros(len(own), bool)
        if problem.orbits:
            rows = orbit_rows(problem, own, slopes=False)
            chi2 = chi2 + self.stated * np.array([one.rows @ one.rows for one in rows])
            lost |= np.array([one.lost > 0 for one in rows])
        if problem.pieces:
            costs, failed = self._pieces(own)
            chi2, lost = chi2 + 2.0 * self.pieces * costs, lost | failed
        self.n_inside += len(own)
        self.n_lost += int(lost.sum())
        found[inside] = np.where(lost, -np.inf, -0.5 * chi2)
        return found

    def _priors(self, thetas: Array) -> Array:
        total = np.zeros(len(thetas))
        for i, free in enumerate(self.problem.free):
            if free.has_prior:
                total = total + ((thetas[:, i] - free.prior_mean) / free.prior_sd) ** 2
        return total

    def _pieces(self, thetas: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return half the chi^2 of the pieces with their initial states fitted, and where a trajectory diverged."""
        guesses = self.best.starts + np.einsum("psf,mf->mps", self.moves, thetas - self.best.theta)
        fitted = fit_many_starts(self.problem, thetas, guesses)
        # a trajectory that diverges has residuals of `LOST`
        return fitted.costs.sum(axis=1), np.asarray((fitted.costs > 0.1 * LOST**2).any(axis=1))


def log_posterior(directory: str | Path, spec: str | Path | None, result: Mapping[str, Any]) -> LogPosterior:
    """Restore the problem of a finished identification, and return the logarithm of its posterior density.

    The specification is needed if recordings were fitted, since the directory does not keep these. Raise `SpecError` if
    it is missing, or its fit has a price on gaps, and `RefusedError` if it is that of another identification.
    """
    info = store.read_info(directory)
    fit = _best(info, result)
    tables = stored_tables(directory)
    problem = _with_recordings(info, spec) if result["recordings"] else _without_recordings(info, result)
    if problem.continuity is not None:
        raise SpecError('--mcmc: the fit has a price on gaps (fit.continuity); identify with continuity = "free".')
    fitted = [table for table in tables if table.fitted]
    orbits = tuple(_orbit_data(table, known) for table, known in zip(fitted, fit.known, strict=True))
    problem = replace(problem, orbits=orbits, loss_scale=1.0)
    if problem.loss != "linear":
        problem = replace(problem, loss_scale=loss_scale_of(problem, fit))
    if orbits:
        # with slopes, so that Newton's method starts from extrapolated orbits
        problem = replace(problem, orbits=orbit_rows(problem, fit.theta[None], slopes=True)[0].tables)
    linear = linearise(problem, fit)
    moves = np.zeros((0, len(problem.model.states), len(problem.free)))
    if problem.pieces and linear.following is not None:
        moves = linear.following.reshape(len(problem.pieces), -1, len(problem.free))
    return LogPosterior(problem, fit, moves, *_factors(linear, result))


def _factors(linear: Linearised, result: Mapping[str, Any]) -> tuple[float, float]:
    """Return the factors on the chi^2 of the pieces and on that of data with stated errors.

    With V the covariance of the fit, S_p the information of the pieces and S_o the other one, ``1/k^2`` solves
    ``trace V (S_p / k^2 + S_o) = n_free``, which holds exactly where V is the inverse of the sum.
    """
    about = result["covariance"]
    if about["estimator"] == ORBITS_ALONE:
        return 0.0, float(about["inflation"]) ** -2
    matrix = np.array(about["matrix"], dtype=float)
    known = np.flatnonzero(np.isfinite(np.diag(matrix)))
    both = np.ix_(known, known)
    own = float(np.trace(matrix[both] @ (linear.information - linear.stated)[both]))
    stated = float(np.trace(matrix[both] @ linear.stated[both]))
    return max(len(known) - stated, 0.0) / own if own > 0.0 else 0.0, 1.0


def _best(info: Info, result: Mapping[str, Any]) -> Fit:
    """Return the best fit, from the outcomes that the directory keeps."""
    starts = [one for one in result["starts"] if one["converged"]]
    number = min(starts, key=lambda one: float(one["cost"]))["number"]
    fit = Outcomes(info.directory / OUTCOMES).recall(f"start-{number:04d}", unpack_fit)
    if fit is None:
        raise DamagedError(f"{info.directory}: the outcome of its best fit is missing; identify again.")
    return fit


def _with_recordings(info: Info, spec: str | Path | None) -> Problem:
    if spec is None:
        raise SpecError(
            "--spec: missing; recordings were fitted, which the directory does not keep: give the specification of "
            "this identification."
        )
    parsed = load_identification(find_spec(spec))
    store.check(info.directory, store.identity_of(parsed, store.sources_of(parsed), read_orbits(parsed)))
    return build(parsed, read_all(parsed)).problem


def _without_recordings(info: Info, result: Mapping[str, Any]) -> Problem:
    """Return the problem of a fit to measured orbits, from what the directory keeps."""
    tables = info.identity["spec"]
    model = load_model(result["model"])
    free = []
    for name in result["names"]:
        own = tables["identify"][name]
        parameter, prior = model.parameter(name), own.get("prior")
        low, high = (float(v) for v in own["bounds"])
        mean, sd = (prior["mean"], prior["sd"]) if prior else (math.nan, math.nan)
        free.append(Free(name, own["start"], low, high, parameter.unit, parameter.meaning, mean, sd))
    values = Parameters(model, tables["values"])
    return Problem(model, values, tuple(free), (), (), np.zeros(0), tied=_tied(tables))


def _tied(tables: Mapping[str, Any]) -> dict[str, tuple[float, str]]:
    return {name: (float(factor), other) for name, (factor, other) in tables["tied"].items()}


def _orbit_data(table: MeasuredTable, known: Any) -> OrbitData:
    return OrbitData(table.along, table.state, table.fitted, known, table.settings)


# ---- chain -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChainSettings:
    """Numbers of a chain and of the verdict on it."""

    block: int = 20  # steps of the chain between two files; more lose more work when a chain is stopped
    # autocorrelation times that a chain must be long: the error of their estimate is then about 10 % (Sokal); more err
    # less, and take longer
    long: float = 50.0
    # split R-hat up to which the halves of the chain agree; an ensemble that is `long` has about 1.02
    alike: float = 1.05
    least_accepted: float = 0.1  # least share of accepted moves; with fewer, the walkers hardly move
    burn_in: float = 5.0  # autocorrelation times that are left out at the beginning, at most half of the chain


CHAINS = 1
"""Number of the results of chains, see `magpend_core.versions`."""


@dataclass(frozen=True)
class Chain:
    """Positions of all walkers at all steps of a chain, with its convergence figures."""

    values: Array  # (step, walker, n_free) unknowns [SI], without the first steps
    log_density: Array  # (step, walker)
    accepted: float
    n_discarded: int  # steps that were left out at the beginning
    time: Array  # (n_free,) integrated autocorrelation time of each unknown [steps]
    rhat: Array  # (n_free,) split R-hat of each unknown: 1 if the halves of all walkers agree
    reasons: tuple[str, ...]  # reasons why the chain has not converged; empty if it has
    # share of the proposed parameters within the bounds for which a measured orbit or a trajectory was lost
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
    settings: ChainSettings = ChainSettings(),
) -> Chain:
    """Sample a posterior density until the chain has converged, or until it has `most_steps`.

    The directory keeps the chain under ``outcomes``. The walkers start from the covariance of the estimates; their
    number is even, and at least twice that of unknowns. Raise `SpecError` for too few walkers, without emcee, and if no
    walker finds a density.
    """
    require_emcee()
    n_free = len(density.problem.free)
    if n_walkers < 2 * n_free or n_walkers % 2:
        raise SpecError(
            f"--walkers = {n_walkers}: must be even and at least {2 * n_free}, twice the number of unknowns."
        )
    store = _Blocks(directory, seed, n_walkers, settings=settings)
    found: list[dict[str, Array]] = []
    chain: Chain | None = None
    while chain is None or (chain.reasons and settings.block * len(found) < most_steps):
        block = store.recall(len(found))
        if block is None:
            start = found[-1] if found else _first(density, covariance, n_walkers, seed)
            block = _advance(density, start, settings.block * len(found), most_steps, settings)
            store.keep(len(found), block)
        found.append(block)
        chain = judged(
            np.concatenate([b["values"] for b in found]),
            np.concatenate([b["log_density"] for b in found]),
            float(np.sum([b["accepted"].sum() for b in found]) / (n_walkers * settings.block * len(found))),
            settings,
        )
    if store.n_recalled:
        echo(f"{settings.block * store.n_recalled} steps of the chain were there before")
    n_inside, n_lost = np.sum([block["counts"] for block in found], axis=0)
    return replace(chain, lost=float(n_lost / max(n_inside, 1)))


class _Blocks:
    """Stored blocks of one chain; its key is everything that decides its numbers."""

    def __init__(self, directory: str | Path, seed: int, n_walkers: int, settings: ChainSettings) -> None:
        self.settings = settings
        info = read_info(directory)
        key = {
            "digest": info.digest,
            "version": CHAINS,
            "seed": seed,
            "walkers": n_walkers,
            "block": self.settings.block,
        }
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
    shrink = 0.5  # factor on the Gaussian of the first walkers' positions while too few of them have a density
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
        factor *= shrink
    raise SpecError(
        "--mcmc: almost no parameters beside the best ones have all measured orbits and lie within the bounds; "
        "widen the bounds, or hold out the orbits close to folds."
    )


def _advance(
    density: LogPosterior, start: Mapping[str, Array], done: int, most_steps: int, settings: ChainSettings
) -> dict[str, Array]:
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
    for i, moved in enumerate(sampler.sample(state, iterations=settings.block, skip_initial_state_check=True)):
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


def judged(values: Array, log_density: Array, accepted: float, settings: ChainSettings = ChainSettings()) -> Chain:
    """Leave out the first steps of a chain, and compute its convergence figures.

    Positions have the shape (step, walker, n_free), log densities (step, walker); `accepted` is the share of accepted
    moves.
    """
    n = len(values)
    rough = settings.burn_in * float(np.max(autocorrelation_time(values[n // 2 :])))
    discarded = n // 2 if not rough < n // 2 else math.ceil(rough)
    kept = values[discarded:]
    time, rhat = autocorrelation_time(kept), split_rhat(kept)
    longest, worst = float(np.max(time)), float(np.max(rhat))
    reasons = []
    # negated, so that NaN counts as not converged
    if not len(kept) >= settings.long * longest:
        reasons.append(
            f"{len(kept)} steps are {len(kept) / longest:.3g} autocorrelation times, fewer than {settings.long:g}"
        )
    if not worst <= settings.alike:
        reasons.append(f"the halves of the chain differ: split R-hat is {worst:.3f}, above {settings.alike:g}")
    if not accepted >= settings.least_accepted:
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
