"""How often 95 % intervals hold the truth: a virtual double pendulum, identified for each seed of the noise.

Free swings with potentiometers of 12 bits, white noise and a dead band that the second link passes through.
``python tests/bench/intervals.py 200`` prints the share of seeds for each parameter.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

from magpend_core.models import load_model
from pipeline.rig.identify.build import pieces_of
from pipeline.rig.identify.linearise import linearise
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.search import refine
from pipeline.rig.identify.specification import RecordingTable
from pipeline.rig.identify.statistics import covariance_of
from pipeline.rig.recordings import smooth
from pipeline.rig.virtual import Sensor, record

MODEL = load_model("double-pendulum")
TRUTH = MODEL.load(None, T1=4e-4, T2=2e-4, c1=2e-4, c2=2e-5, k1=0.03, k2=0.01, eps=50.0)
UNKNOWN = ("l1", "e1", "J1", "J2", "T1", "T2", "c1", "c2", "k1", "k2")
SENSOR = Sensor("potentiometer", noise=2e-3, bits=12, dead_band=0.15)
N_PIECES, LENGTH_S, RATE_HZ = 12, 1.5, 200.0
CHANNELS = MODEL.angles


@dataclass(frozen=True)
class Outcome:
    """Of one seed: estimates, standard errors, half widths of the intervals, how they were found."""

    theta: np.ndarray
    errors: np.ndarray
    half: np.ndarray
    estimator: str
    n_missing: int


def problem_of(seed: int) -> Problem:
    """The problem that a rig's recordings pose; swings differ by piece, noise by seed."""
    table = RecordingTable.model_validate({"file": "", "mapping": ""})
    times = np.arange(int(LENGTH_S * RATE_HZ)) / RATE_HZ
    pieces, rng = [], np.random.default_rng(7)
    for k in range(N_PIECES):
        start = [*rng.uniform(-1.8, 1.8, 1), *rng.uniform(-2.9, 2.9, 1), *rng.uniform(-3.0, 3.0, 2)]
        ds = record(TRUTH, None, start, times, sensors=dict.fromkeys(CHANNELS, SENSOR), seed=100 * seed + k)
        pieces += pieces_of(MODEL, CHANNELS, (ds, smooth(ds)), table, k)
    lower = {name: -3 * TRUTH[name] if name in ("c1", "c2") else 0.0 for name in UNKNOWN}
    free = tuple(Free(name, 1.1 * TRUTH[name], lower[name], 5 * TRUTH[name]) for name in UNKNOWN)
    return Problem(model=MODEL, fixed=TRUTH, free=free, channels=CHANNELS, pieces=tuple(pieces), noise=np.full(2, 2e-3))


def outcome(seed: int) -> Outcome:
    """Identify the rig of one seed.

    Raises
    ------
    ArithmeticError
        If the fit did not converge.
    """
    problem = problem_of(seed)
    fit = refine(problem, problem.start)
    if not fit.converged:
        raise ArithmeticError(f"seed {seed}: {fit.message}")
    covariance = covariance_of(linearise(problem, fit), np.array([TRUTH[name] for name in UNKNOWN]))
    missing = sum(int(np.isnan(p.measured).sum()) for p in problem.pieces)
    return Outcome(fit.theta, covariance.errors, covariance.critical * covariance.errors, covariance.estimator, missing)


def coverage(n_seeds: int) -> tuple[np.ndarray, list[Outcome]]:
    """Share of seeds whose interval holds the truth, by parameter."""
    truth = np.array([TRUTH[name] for name in UNKNOWN])
    found = [outcome(seed) for seed in range(n_seeds)]
    return np.mean([np.abs(o.theta - truth) <= o.half for o in found], axis=0), found


def main(n_seeds: int = 200) -> None:
    """Print the table."""
    share, found = coverage(n_seeds)
    spread = np.std([o.theta for o in found], axis=0)
    errors = np.mean([o.errors for o in found], axis=0)
    print(f"{n_seeds} seeds, {found[0].n_missing} samples in dead bands in the first")
    for k, name in enumerate(UNKNOWN):
        held = f"{name:3} {TRUTH[name]:<10g} {100 * share[k]:5.1f} %"
        print(f"{held}   spread {spread[k]:.3g}, stated {errors[k]:.3g}")
    print(f"all {100 * share.mean():.1f} %; counted by {sorted({o.estimator for o in found})}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
