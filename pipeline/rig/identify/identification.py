"""Run an identification from its specification, or continue one that was stopped."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.sampling import Drive
from pipeline.layout.writing import write_netcdf
from pipeline.products.reporting import report, track
from pipeline.rig.identify import directory as store
from pipeline.rig.identify import identifiability, reports
from pipeline.rig.identify.build import Built, build, read_all
from pipeline.rig.identify.directory import Outcomes, Source
from pipeline.rig.identify.drifts import drift_warnings
from pipeline.rig.identify.identifiability import Curvature, Profile, estimate_frequencies, following, profile
from pipeline.rig.identify.judgement import judge, judge_fit
from pipeline.rig.identify.local import Fit, fit_local
from pipeline.rig.identify.measured_orbits import judge_orbits, read_orbits
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import ZERO, Problem
from pipeline.rig.identify.search import Kept, search
from pipeline.rig.identify.specification import IdentificationSpec, load_identification
from pipeline.rig.identify.statistics import (
    Covariance,
    Linearised,
    covariance_of,
    linearise,
    loss_scale_of,
    n_effective,
)
from pipeline.runs.stopping import stoppable
from pipeline.specification.files import default_directory, find_spec
from pipeline.specification.problems import SpecError
from pipeline.store.files import FIGURES, local_path
from pipeline.store.local import make_folder, refuse_links, writer_lock

Echo = Callable[[str], None]


class NotConvergedError(ArithmeticError):
    """Error of an identification in which no local fit converged."""


def identify(
    spec: str | Path, out: str | Path | None = None, *, figures: bool = True, echo: Echo = print
) -> dict[str, Any]:
    """Identify the parameters that a specification names, or complete an identification that was stopped.

    Parameters
    ----------
    spec
        Path of a TOML file, or the name of a shipped workflow.
    out
        Directory; by default ``runs/<name>``.
    figures
        Whether to draw.
    echo
        Function that prints a line.

    Returns
    -------
    dict
        Content of ``result.json``.

    Raises
    ------
    SpecError, RefusedError, LockedError
        Before anything is computed; `SpecError` also after the first evaluation, for a parameter that the
        data cannot see.
    NotConvergedError
        If no start converged. The outcomes stay, a result is not written.
    InterruptedRunError
        After Ctrl-C or SIGTERM. The outcomes stay.
    """
    path = find_spec(spec)
    parsed = load_identification(path)
    folder = directory_of(spec, out)
    sources, tables = store.sources_of(parsed), read_orbits(parsed)
    if store.check(folder, store.identity_of(parsed, sources, tables)) is not None and store.is_complete(folder):
        echo(f"{folder} is complete; nothing to do.")
        return store.read_result(folder)
    built = build(parsed, read_all(parsed), tables)
    for i, said in enumerate(built.findings):
        for line in said:
            echo(f"{parsed.recordings[i].file}: {line}")
    refuse_invisible(built.problem)
    with writer_lock(folder):
        info = store.establish(folder, parsed, sources, path.read_text("utf-8"), tables)
        outcomes = Outcomes(folder / store.OUTCOMES)
        with stoppable(folder):
            found = find(parsed, built, outcomes, echo)
        if outcomes.recalled:
            echo(f"{outcomes.recalled} outcomes were there before")
        return _write(folder, parsed, built, found, sources, info.digest, figures)


def directory_of(spec: str | Path, out: str | Path | None) -> Path:
    """Return the directory of an identification: `out`, or ``runs/<name>``."""
    return local_path(out) if out is not None else default_directory(find_spec(spec), False)


def _write(
    folder: Path,
    spec: IdentificationSpec,
    built: Built,
    found: reports.Finding,
    sources: list[Source],
    digest: str,
    figures: bool,
) -> dict[str, Any]:
    reports.write_values(folder / store.PRESET, spec, found, sources)
    residuals = reports.residuals_of(spec, found)
    if built.simulated:
        residuals = residuals.assign_attrs(simulated=1)
    write_netcdf(folder / store.RESIDUALS, residuals)
    result = reports.result_of(spec, found, sources, digest, built.findings)
    files = [store.PRESET, store.RESIDUALS]
    for i, one in enumerate(found.orbits):
        files.append(store.ORBITS.format(i))
        write_netcdf(folder / files[-1], one)
    if figures:
        from pipeline.rig.identify.figures import draw_all

        report("drawing", 0, 0)
        refuse_links(folder / FIGURES)
        make_folder(folder / FIGURES)
        branches = [(one, *table.branches(found.values)) for table, one in zip(built.tables, found.orbits, strict=True)]
        files += [f"{FIGURES}/{name}" for name in draw_all(folder / FIGURES, residuals, result, branches)]
    store.write_result(folder, result, files)
    return store.read_result(folder)


def refuse_invisible(problem: Problem) -> None:
    """Evaluate once; raise `SpecError` if residuals do not depend on some unknowns, or trajectories diverge."""
    first = evaluate(problem, problem.start[None], problem.starts[None], slopes=True)[0]
    if _is_driven(problem):
        raise SpecError(
            'recordings: drive = "none", but the model is driven with these parameters; set the amplitude of '
            "its drive to 0 under [parameters]."
        )
    if first.failed:
        raise SpecError(
            f"identify: at the start, {first.failed} trajectories of pieces or measured orbits are lost; give "
            "starts that are nearer."
        )
    columns = first.jacobian[:, : len(problem.free)]
    n_priors = sum(f.has_prior for f in problem.free)
    data = columns[: len(columns) - n_priors]
    names = identifiability.invisible(data.T @ data, problem.names)
    if names:
        raise SpecError(
            [
                f"identify.{name}: the data do not depend on it at all, at the start; fix it under "
                "[parameters], give others values with which it matters, or add a recording in which it does."
                for name in names
            ]
        )


def _is_driven(problem: Problem) -> bool:
    """Return whether the model's own drive acts on a piece without a recorded one, as its period then matters."""
    # difference of two trajectories, relative to the measured spread, that exceeds the error of integration
    error = 1e-3
    if not problem.pieces or problem.pieces[0].drive is not None:
        return False
    piece = problem.pieces[0]
    motions = []
    for share in (0.37, 0.61):
        duration = share * float(piece.time[-1])
        drive = Drive(np.full(math.ceil(1 / share), duration))
        one = replace(problem, pieces=(replace(piece, drive=drive, follows=-1),), continuity=None)
        found = evaluate(one, problem.start[None], piece.start[None, None], slopes=False)[0]
        motions.append(found.residuals[0])
    spread = np.nanstd(piece.measured, axis=0)
    return bool((np.nanmax(np.abs(motions[0] - motions[1]), axis=0) > error * spread).any())


def find(spec: IdentificationSpec, built: Built, outcomes: Outcomes, echo: Echo) -> reports.Finding:
    """Search for the best fit, test it on the held-out pieces, and compute errors, profiles and warnings."""
    problem, table = built.problem, spec.search
    keep = Kept(outcomes)
    fits = search(
        problem,
        n_starts=table.n_starts,
        seed=table.seed,
        spread=table.spread,
        method=table.method,
        n_samples=table.n_samples,
        keep=keep,
        tell=echo,
    )
    best = fits[0]
    if not best.converged:
        raise NotConvergedError(
            f"none of {len(fits)} starts converged (the best: {best.message}, cost {best.cost:.6g}), "
            "so there is no result. Give starts that are nearer, shorter pieces (piece_s), more starts "
            "(search.n_starts) or narrower bounds."
        )
    report("how sure it is", 0, 0)
    problem = problem.with_orbits(best.known)
    linear = linearise(problem, best)
    scale = _sizes(problem, best)
    covariance = covariance_of(linear, scale)
    directions = identifiability.directions_of(linear.information - np.diag(linear.prior), scale, covariance.inflation)
    held = None
    if built.held_out:
        held, fit = judge(problem, problem.values(best.theta), reports.beside_of(problem, best), built.held_out)
        require_starts(fit, "held-out pieces")
    at_bound = _at_bound(problem, best, scale)
    judged = [judge_orbits(table, problem.values(best.theta)) for table in built.tables]
    found = reports.Finding(
        problem,
        keep.fits,
        best,
        covariance,
        directions,
        judge_fit(problem, best),
        held,
        dict(zip(problem.channels, n_effective(linear.residuals), strict=True)),
        at_bound,
        judged,
        frequencies=estimate_frequencies(problem, best, scale),
    )
    profiles = _profiles(found, linear, scale, outcomes) if table.profiles else {}
    return replace(found, profiles=profiles, warnings=_warnings(found, profiles))


def require_starts(fit: Fit, what: str) -> None:
    """Raise `NotConvergedError` unless the fit of the initial states of the pieces converged."""
    if not fit.converged:
        raise NotConvergedError(
            f"the starts of the {what} did not converge ({fit.message}), so there is nothing to judge by."
        )


def _sizes(problem: Problem, best: Fit) -> np.ndarray:
    spread = {}
    if problem.pieces:
        measured = np.concatenate([p.measured for p in problem.pieces])
        spread = dict(zip(problem.channels, np.nanstd(measured, axis=0), strict=True))
    sensed = [
        spread[f.name.split(".")[1]] if f.name.startswith(f"{ZERO}.") and np.isnan(f.typical) else f.typical
        for f in problem.free
    ]
    return identifiability.sizes_of(best.theta, problem.start, problem.lower, problem.upper, np.array(sensed))


def _at_bound(problem: Problem, best: Fit, scale: np.ndarray) -> list[str]:
    share = 1e-4  # distance to a bound, relative to a parameter's size, below which an estimate lies on it
    found = []
    for value, low, high, size in zip(best.theta, problem.lower, problem.upper, scale, strict=True):
        near = share * size
        found.append("lower" if value - low <= near else "upper" if high - value <= near else "")
    return found


def _warnings(found: reports.Finding, profiles: Mapping[str, Profile]) -> list[str]:
    problem = found.problem
    sd = np.array([f.prior_sd for f in problem.free])
    lines = identifiability.warnings_of(problem.names, found.directions, found.covariance, sd, found.at_bound)
    lines += [w for f in found.frequencies if (w := f.warning)]
    lines += drift_warnings(problem, found.best.residuals)
    lines += [
        f"the profile of {name} passes a better fit than the best; raise search.n_starts."
        for name, p in profiles.items()
        if p.lowest < -0.1
    ]
    if found.n_same < len(found.starts) / 2:
        lines.append(
            f"only {found.n_same} of {len(found.starts)} starts reached the best optimum: there may be a "
            "better one; raise search.n_starts, or cut pieces (piece_s)."
        )
    return lines


def _profiles(found: reports.Finding, linear: Linearised, scale: np.ndarray, outcomes: Outcomes) -> dict[str, Profile]:
    problem, best = found.problem, found.best
    if problem.loss != "linear":
        problem = replace(problem, loss_scale=loss_scale_of(problem, best))
        again = evaluate(problem, best.theta[None], best.starts[None], slopes=False)[0]
        best = replace(best, cost=again.cost)
    plain = _plain_errors(linear, scale)
    covariance: Covariance = found.covariance
    profiles = {}
    for i, name in track(list(enumerate(problem.names)), "profiles"):
        kept = outcomes.recall(f"profile-{name}", partial(_unpack_profile, name))
        if kept is None:
            moves = following(linear.information, i)
            starts = np.zeros_like(best.starts) if linear.following is None else linear.following @ moves
            error, size = float(covariance.errors[i]), float(scale[i])
            about = Curvature(error, float(plain[i]), covariance.critical, size, moves, starts)
            kept = profile(problem, best, name, about, fit_local)
            interval = np.array(kept.interval)
            outcomes.store(f"profile-{name}", {"values": kept.values, "growth": kept.growth, "interval": interval})
        profiles[name] = kept
    return profiles


def _unpack_profile(name: str, data: Mapping[str, np.ndarray]) -> Profile:
    low, high = (float(v) for v in data["interval"])
    return Profile(name, data["values"], data["growth"], (low, high))


def _plain_errors(linear: Linearised, scale: np.ndarray) -> np.ndarray:
    """Return the standard errors of the estimates if residuals were independent and had the assumed noise."""
    inverse = np.linalg.pinv(linear.information * np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(np.sqrt(np.diag(inverse)) * scale)
