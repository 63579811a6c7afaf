"""Evaluate the logarithm of an identification's posterior density for many sets of unknowns in common engine calls.

    log p(theta) = -(chi^2_pieces / k^2 + chi^2_stated) / (2 s^2)   within the bounds, minus infinity outside

`chi^2_pieces` is that of the recordings' samples, with the initial state of each piece fitted for each theta (profile
likelihood). `chi^2_stated` is that of measured orbits, measured bifurcations and priors, which state their errors.

Residuals of recordings are autocorrelated, so their samples say less than as many independent ones would. `k^2` scales
their likelihood down, so that its curvature agrees on average with the covariance of the fit (the magnitude adjustment
of Ribatet, Cooley and Davison, Stat. Sinica 22, 2012, 813, equation 3.1). `s` is the factor by which a fit to orbits
alone raises stated errors to the scatter of the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magpend_core.models import load_model
from magpend_core.models.model import Parameters
from pipeline.analysis.branches.carrying import OrbitData
from pipeline.rig.identify import directory as store
from pipeline.rig.identify.bands import stored_tables
from pipeline.rig.identify.build import build, read_all
from pipeline.rig.identify.directory import OUTCOMES, Info, Outcomes
from pipeline.rig.identify.first_guesses import fit_many_starts
from pipeline.rig.identify.identification import unpack_fit
from pipeline.rig.identify.linearise import linearise, loss_scale_of
from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.measured_orbits import MeasuredTable, read_orbits
from pipeline.rig.identify.objective import LOST
from pipeline.rig.identify.orbit_rows import orbit_rows
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.specification import load_identification
from pipeline.rig.identify.statistics import Linearised
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError
from pipeline.store.errors import DamagedError

Array = NDArray[np.float64]

ORBITS_ALONE = "orbits"
"""Estimator of the covariance of a fit without recordings."""


@dataclass
class LogPosterior:
    """Logarithm of the posterior density of the unknowns, up to a constant; it counts what it could not evaluate.

    Attributes
    ----------
    problem : Problem
        Problem at the best fit; Newton's method for measured orbits starts from the orbits there.
    best : Fit
    moves : ndarray, (n_piece, n_states, n_free)
        Derivative of the best initial states of the pieces by the unknowns, for first guesses.
    pieces, stated : float
        Factors on the chi^2 of the pieces and on that of orbits and priors: ``1/k^2`` and ``1/s^2`` of the module.
    n_inside, n_lost : int
        Number of sets of unknowns within the bounds, and of those for which a measured orbit or a trajectory was lost.
    """

    problem: Problem
    best: Fit
    moves: Array
    pieces: float
    stated: float
    n_inside: int = 0
    n_lost: int = 0

    def __call__(self, thetas: Array) -> Array:
        """Return the logarithm of the density of each row of unknowns; minus infinity outside the bounds, and where a
        measured orbit or a trajectory is lost.
        """
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

    Parameters
    ----------
    directory
        Directory of the identification.
    spec
        Its specification; needed if recordings were fitted, since the directory does not keep these.
    result
        Content of ``result.json``.

    Raises
    ------
    SpecError
        If the specification is missing, or its fit has a price on gaps (``continuity``).
    RefusedError
        If it is the specification of another identification.
    """
    info = store.read_info(directory)
    fit = _best(info, result)
    tables = stored_tables(directory)
    problem = _with_recordings(info, spec) if result["recordings"] else _without_recordings(info, result)
    if problem.continuity is not None:
        raise SpecError(['--mcmc: the fit has a price on gaps (fit.continuity); identify with continuity = "free".'])
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
            [
                "--spec: missing; recordings were fitted, which the directory does not keep: give the specification of "
                "this identification."
            ]
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
