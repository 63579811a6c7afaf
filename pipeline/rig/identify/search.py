"""Search globally: fit from many first guesses, first over short stretches of the recordings, then over longer ones.

Far from the true parameters a long piece is out of phase with its recording, and the cost is rugged. Short
stretches from smoothed states are not, so a guess is first fitted to those, then to longer ones, and to the
whole pieces with free starts at last (multiple shooting: Bezruchko et al., Chaos Solitons Fractals 29, 2006,
82).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.analysis.branches.carrying import Solution
from pipeline.products.reporting import report
from pipeline.rig.identify.directory import Outcomes
from pipeline.rig.identify.local import Echo, Fit, choose_phases, fit_local, fit_starts
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import Piece, Problem
from pipeline.specification.problems import import_extra

Array = NDArray[np.float64]


POPULATION = 32
"""Members that are integrated at the same time."""


class Kept:
    """Store of finished local fits; the key of a fit is the number of its first guess."""

    def __init__(self, outcomes: Outcomes) -> None:
        self._outcomes = outcomes
        self.fits: dict[int, Fit] = {}

    def recall(self, number: int) -> Fit | None:
        """Return the local fit that began at first guess `number`, or None if it is not stored."""
        fit = self._outcomes.recall(_name(number), unpack_fit)
        if fit is not None:
            self.fits[number] = fit
        return fit

    def store(self, number: int, fit: Fit) -> None:
        """Store the local fit that began at first guess `number`."""
        self._outcomes.store(_name(number), pack_fit(fit))
        self.fits[number] = fit


def _name(number: int) -> str:
    return f"start-{number:04d}"


_KNOWN = ("packed", "unknowns", "tangents")
"""Fields of a `Solution` that are stored."""


def pack_fit(fit: Fit) -> dict[str, np.ndarray]:
    """Return all fields of a fit as named arrays, to be stored in a file."""
    lengths = np.array([len(r) for r in fit.residuals], np.int64)
    known = {f"orbits-{i}-{name}": getattr(own, name) for i, own in enumerate(fit.known) for name in _KNOWN}
    return {
        **known,
        "theta": fit.theta,
        "starts": fit.starts,
        "rows": fit.rows,
        "jacobian": fit.jacobian,
        "residuals": np.concatenate(fit.residuals) if fit.residuals else np.zeros(0),
        "lengths": lengths,
        "cost": np.array(fit.cost),
        "converged": np.array(fit.converged),
        "message": np.array(fit.message),
        "n_evaluations": np.array(fit.n_evaluations),
    }


def unpack_fit(data: Mapping[str, np.ndarray]) -> Fit:
    """Rebuild a fit from the arrays of `pack_fit`."""
    residuals = np.split(data["residuals"], np.cumsum(data["lengths"])[:-1]) if len(data["lengths"]) else []
    n_tables = sum(key.endswith(f"-{_KNOWN[0]}") for key in data)
    known = []
    for i in range(n_tables):
        packed, unknowns, tangents = (data[f"orbits-{i}-{name}"] for name in _KNOWN)
        known.append(Solution(packed, unknowns, tangents))
    return Fit(
        data["theta"],
        data["starts"],
        float(data["cost"]),
        bool(data["converged"]),
        str(data["message"]),
        int(data["n_evaluations"]),
        tuple(residuals),
        data["rows"],
        data["jacobian"],
        tuple(known),
    )


def search(
    problem: Problem,
    *,
    n_starts: int,
    seed: int,
    spread: float,
    method: str = "sobol",
    n_samples: int = 256,
    keep: Kept | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Fit]:
    """Fit from many first guesses. Return the fits sorted by cost, converged ones first.

    The first of the `n_starts` guesses that are followed to an optimum is the problem's own; the others are at most
    `spread` away from it, relative to the unknowns' sizes, and within the bounds. With the method ``sobol``, the best
    of `n_samples` points of a Sobol sequence are followed, and CMA-ES is tried if none of them converges; with ``cma``,
    CMA-ES over the shortest stretches finds the guesses. `keep` stores outcomes, so that a killed search can continue;
    `tell` prints a line about each.
    """
    import_extra("cma", "rig", "identify")  # now, and not when the first starts have failed
    stages = _stages(problem)
    first = choose_phases(stages[-1], problem.start)
    problem = replace(problem, free=tuple(replace(f, start=float(x)) for f, x in zip(problem.free, first, strict=True)))
    guesses = guess(problem, n_starts, seed, spread, method, n_samples, stages[0])
    fits = [_kept(problem, stages, k, theta, len(guesses), keep, tell) for k, theta in enumerate(guesses)]
    if method == "sobol" and not any(fit.converged for fit in fits):
        tell("no start has converged; CMA-ES looks for a better one")
        theta = _evolve(stages[0], problem.start, seed, spread)
        fits.append(_kept(problem, stages, len(guesses), theta, len(guesses) + 1, keep, tell))
    return sorted(fits, key=lambda fit: (not fit.converged, fit.cost))


def _kept(
    problem: Problem,
    stages: Sequence[Problem],
    k: int,
    theta: Array,
    total: int,
    keep: Kept | None,
    tell: Callable[[str], None],
) -> Fit:
    fit = keep.recall(k) if keep is not None else None
    if fit is None:
        fit = refine(
            problem, theta, stages=stages, echo=lambda _, cost: report(f"start {k + 1}, cost {cost:.6g}", k, total)
        )
        if keep is not None:
            keep.store(k, fit)
    words = "" if fit.converged else f", not converged: {fit.message}"
    tell(f"start {k + 1} of {total}: cost {fit.cost:.6g}{words}")
    return fit


def guess(
    problem: Problem, n_starts: int, seed: int, spread: float, method: str, n_samples: int, shortest: Problem
) -> list[Array]:
    """Return first guesses: that of the specification, then the best Sobol points or results of CMA-ES."""
    if n_starts == 1:
        return [problem.start]
    if method == "cma":
        return [problem.start, *(_evolve(shortest, problem.start, seed + k, spread) for k in range(n_starts - 1))]
    points = sobol(problem, max(n_samples, n_starts) - 1, seed, spread)
    if len(points) > n_starts - 1:
        order = np.argsort(costs(shortest, points), kind="stable")
        points = points[order[: n_starts - 1]]
    return [problem.start, *points]


def sobol(problem: Problem, n: int, seed: int, spread: float) -> Array:
    """Return scrambled Sobol points around the specification's first guess of the unknowns, (n, n_free)."""
    from scipy.stats import qmc

    if n < 1 or not problem.free:
        return np.zeros((max(n, 0), len(problem.free)))
    unit = qmc.Sobol(len(problem.free), seed=seed).random_base2(max(int(np.ceil(np.log2(n))), 0))[:n]
    sizes = np.array([f.size for f in problem.free])
    points = problem.start + spread * (2 * unit - 1) * sizes
    return np.asarray(np.clip(points, problem.lower, problem.upper))


def costs(problem: Problem, thetas: Array) -> Array:
    """Return the cost of each row of unknowns at the guessed initial states; infinite for diverging ones."""
    found = []
    for at in range(0, len(thetas), POPULATION):
        members = thetas[at : at + POPULATION]
        starts = np.broadcast_to(problem.starts, (len(members), *problem.starts.shape))
        found += [np.inf if e.failed else e.cost for e in evaluate(problem, members, starts, slopes=False)]
    return np.array(found)


def _evolve(problem: Problem, start: Array, seed: int, spread: float) -> Array:
    """Minimise the cost over short stretches by the evolution strategy CMA-ES, with one engine call per population."""
    import cma

    if problem.pieces:
        problem = replace(problem, orbits=())
    sizes = np.array([f.size for f in problem.free])
    lower, upper = problem.lower / sizes, problem.upper / sizes
    options = {
        "bounds": [list(lower), list(upper)],
        "seed": seed + 1,
        "verbose": -9,
        "popsize": POPULATION,
        "maxiter": 200,
        "tolfun": 1e-3,
        "tolx": 1e-5,
    }
    evolution = cma.CMAEvolutionStrategy(np.clip(start / sizes, lower, upper), max(spread, 0.05), options)
    while not evolution.stop():
        members = np.array(evolution.ask())
        found = costs(problem, members * sizes)
        worst = np.max(found[np.isfinite(found)], initial=0.0)
        evolution.tell(list(members), list(np.where(np.isfinite(found), found, 10 * worst + 1e12)))
    return np.asarray(evolution.result.xbest * sizes)


def refine(problem: Problem, theta: Array, *, stages: Sequence[Problem] | None = None, echo: Echo | None = None) -> Fit:
    """Fit from one first guess over short stretches, then longer ones, then whole pieces.

    Noise may lead short stretches to a wrong optimum from which longer ones do not return. The last fit
    therefore begins from the stage whose outcome has the least cost over whole pieces.
    """
    evaluations, tolerance = 25, 1e-4
    # measured orbits are known at the guess itself, and may be lost where the stages end
    candidates = [np.clip(theta, problem.lower, problem.upper)] if problem.orbits else []
    for stage in _stages(problem) if stages is None else stages:
        theta = choose_phases(stage, theta)
        fit = fit_local(stage, theta, max_evaluations=evaluations, tolerance=tolerance)
        if np.isfinite(fit.cost):
            theta = fit.theta
            candidates.append(theta)
    candidates = candidates or [np.clip(theta, problem.lower, problem.upper)]
    if problem.phases:
        candidates += [choose_phases(problem, one) for one in candidates]
    starts = [fit_starts(problem, one, problem.starts).starts for one in candidates]
    found = evaluate(problem, np.array(candidates), np.array(starts), slopes=False)
    best = int(np.argmin([np.inf if e.failed else e.cost for e in found]))
    fit = fit_local(problem, candidates[best], starts=starts[best], echo=echo)
    whole = np.array(fit.theta)
    whole[list(problem.phases.values())] %= 1.0
    return replace(fit, theta=whole)


def _stages(problem: Problem) -> list[Problem]:
    """Return the problem with short, longer and still longer stretches, whose starts the recordings give."""
    # lengths of stretches, in periods of the recordings' slowest oscillation, before whole pieces
    stretches = (0.35, 0.8, 1.8)
    if not problem.pieces:
        return [problem]
    longest = max(p.time[-1] for p in problem.pieces)
    period = slowest_period(problem)
    lengths = [share * period for share in stretches if share * period < 0.8 * longest]
    return [cut(problem, length) for length in lengths or [longest]]


def slowest_period(problem: Problem) -> float:
    """Return the longest oscillation period of the channels [s], estimated from the crossings of their mean.

    Without crossings, return the length of the longest piece.
    """
    found = []
    for k in range(len(problem.channels)):
        times, crossings = 0.0, 0
        for p in problem.pieces:
            x = p.measured[:, k]
            x = x[np.isfinite(x)]
            signs = np.signbit(x - x.mean()) if len(x) else np.zeros(0, bool)
            crossings += int(np.count_nonzero(signs[1:] != signs[:-1]))
            times += p.time[-1]
        if crossings:
            found.append(2 * times / crossings)
    return max(found, default=max(p.time[-1] for p in problem.pieces))


def cut(problem: Problem, length_s: float) -> Problem:
    """Return the least-squares problem with its pieces cut into stretches of about `length_s` seconds, with fewer
    samples. The initial states are estimated from the data.

    Local cubic polynomials through a sixth of a stretch on either side give the rates at the starts.
    """
    pieces = [stretch for p in problem.pieces for stretch in _stretches(problem, p, length_s)]
    return replace(problem, pieces=tuple(pieces), continuity=None, loss="linear")


def _stretches(problem: Problem, piece: Piece, length_s: float) -> list[Piece]:
    n_samples = 40  # of a stretch that are used before whole pieces
    n = len(piece.time)
    count = max(int(piece.time[-1] / length_s), 1)
    bounds = np.linspace(0, n, count + 1).astype(int)
    found = []
    for a, b in pairwise(bounds):
        if b - a < 4 or not np.isfinite(piece.measured[a]).all():
            continue
        start = piece.start if a == 0 else _read_off(problem, piece, int(a), (b - a) // 6 + 2)
        step = max((b - a) // n_samples, 1)
        drive = piece.drive
        if drive is not None:
            begin = drive.start_s + piece.time[a]
            drive = drive.window(begin, drive.start_s + piece.time[b - 1])
        time = piece.time[a:b:step] - piece.time[a]
        measured, begin_s = piece.measured[a:b:step], piece.begin_s + float(piece.time[a])
        found.append(
            replace(piece, time=time, measured=measured, start=start, drive=drive, follows=-1, begin_s=begin_s)
        )
    return found


def _read_off(problem: Problem, piece: Piece, at: int, half: int) -> Array:
    """Estimate the state at a sample from the data: value and slope of a cubic polynomial fitted to each channel."""
    window = slice(max(at - half, 0), at + half + 1)
    t = piece.time[window] - piece.time[at]
    state = np.array(piece.start)
    names = problem.model.state_names
    zeros = problem.offsets(piece) @ problem.start
    for k, name in enumerate(problem.channels):
        x = piece.measured[window, k]
        good = np.isfinite(x)
        if good.sum() < 4:
            continue
        value, rate = np.polynomial.polynomial.polyfit(t[good], x[good], min(3, int(good.sum()) - 1))[:2]
        state[names.index(name)] = value - zeros[min(at, len(zeros) - 1), k]
        rate_name = problem.model.state(name).rate
        if rate_name and rate_name not in problem.channels:
            state[names.index(rate_name)] = rate
    return state
