"""The paper's pendulum as a virtual rig: are the parameters of its Table 1 found again, by honest intervals?

    OMP_NUM_THREADS=1 python tests/bench/virtual_rig.py [--seeds 200]

Free swings and forced motions without magnets, potentiometers of 12 bits with a dead band and 1 mrad of
white noise, the torque recorded with a duty cycle of 49.27 %; weighed masses, a measured length, gravity and
a guess of the friction's steepness as priors, drawn anew for each seed like the noise. The first seed is
fitted from guesses a tenth off. Then, for many seeds, how often the 95 % intervals hold the truth; these fits
start at the truth, which changes no optimum.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace

import numpy as np

from magpend_core.models import load_model
from pipeline.rig.identify.build import apply_settings, noise_of, pieces_of
from pipeline.rig.identify.identifiability import sizes_of
from pipeline.rig.identify.local import Fit, fit_local
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.search import refine
from pipeline.rig.identify.specification import RecordingTable
from pipeline.rig.identify.statistics import covariance_of, linearise
from pipeline.rig.recordings import smooth
from pipeline.rig.virtual import DriveSensor, Sensor, Step, record

MODEL = load_model("pendulum-free")
TRUTH = MODEL.load()
UNKNOWN = ("g", "l1", "m1", "m2", "e1", "e2", "J1", "J2", "T1", "T2", "c", "mu", "mu0", "c0", "eps")
PRIOR_SD = {"g": 0.002, "l1": 2e-4, "m1": 0.01, "m2": 0.005, "eps": 200.0}
POTENTIOMETER = Sensor("potentiometer", noise=1e-3, bits=12, dead_band=math.radians(3.0))
SENSORS = {**dict.fromkeys(MODEL.angles, POTENTIOMETER), "drive": DriveSensor("torque", noise=2e-3)}
RATE_HZ, LENGTH_S, PIECE_S = 500.0, 12.0, 1.5
FREE_SWINGS = ((1.0, 2.0, 0.0, 0.0), (1.5, -0.6, 0.0, 0.0), (-0.6, 3.0, 0.0, 0.0))
FORCED = ((1.2, (0.0, 0.0, 0.0, 0.0)), (2.1, (0.5, 0.0, 0.0, 0.0)), (1.6, (0.0, 0.3, 0.0, 0.0)))


@dataclass(frozen=True)
class Outcome:
    """Of one seed: the estimates, standard errors and half widths of the intervals."""

    fit: Fit
    errors: np.ndarray
    half: np.ndarray

    @property
    def hits(self) -> np.ndarray:
        """Which intervals hold the truth."""
        return np.abs(self.fit.theta - truth()) <= self.half


def truth() -> np.ndarray:
    """True values of the unknowns."""
    return np.array([TRUTH[name] for name in UNKNOWN])


def problem_of(seed: int, shorten: int = 1) -> Problem:
    """The problem that the rig's recordings pose; noise and priors go by the seed."""
    times = np.arange(int(LENGTH_S * RATE_HZ) // shorten) / RATE_HZ
    off = TRUTH.replace(q=0.0)
    made = [
        record(off, None, start, times, sensors=SENSORS, seed=100 * seed + k) for k, start in enumerate(FREE_SWINGS)
    ]
    made += [
        record(
            TRUTH,
            [Step(frequency, math.ceil(LENGTH_S * frequency) + 1, {})],
            start,
            times,
            sensors=SENSORS,
            seed=100 * seed + 10 + k,
        )
        for k, (frequency, start) in enumerate(FORCED)
    ]
    pieces, smoothed = [], [smooth(ds) for ds in made]
    for k, ds in enumerate(made):
        drive = "none" if k < len(FREE_SWINGS) else "recorded"
        table = RecordingTable.model_validate({"file": "", "mapping": "", "drive": drive, "piece_s": PIECE_S})
        pieces += [replace(p, follows=-1) for p in pieces_of(MODEL, MODEL.angles, (ds, smoothed[k]), table, k)]
    rng = np.random.default_rng(seed)
    free = []
    for name in UNKNOWN:
        value, sd = TRUTH[name], PRIOR_SD.get(name, math.nan)
        mean = value + sd * rng.normal()
        free.append(Free(name, value, 0.2 * value, 5.0 * value, prior_mean=mean, prior_sd=sd))
    noise = noise_of(MODEL, MODEL.angles, smoothed, {})
    return Problem(
        MODEL, TRUTH, tuple(free), MODEL.angles, tuple(apply_settings(pieces, {})), noise, rtol=1e-9, recorded=True
    )


def judged(problem: Problem, fit: Fit) -> Outcome:
    """Say how sure a fit is."""
    if not fit.converged:
        raise ArithmeticError(f"the fit did not converge: {fit.message}")
    scale = sizes_of(fit.theta, problem.start, problem.lower, problem.upper, np.full(len(UNKNOWN), np.nan))
    found = covariance_of(linearise(problem, fit), scale)
    return Outcome(fit, found.errors, found.critical * found.errors)


def outcome(seed: int, shorten: int = 1) -> Outcome | None:
    """Fit one seed from the truth; None if that does not converge."""
    problem = problem_of(seed, shorten)
    fit = fit_local(problem, truth())
    found = judged(problem, fit) if fit.converged else None
    note = f"{found.hits.sum()} of {len(UNKNOWN)} intervals hold the truth" if found else fit.message
    print(f"seed {seed}: {fit.n_evaluations} evaluations, {note}", file=sys.stderr, flush=True)
    return found


def from_afar(seed: int) -> Outcome:
    """Fit one seed from guesses a tenth off, either way; those with a prior from its mean."""
    problem = problem_of(seed)
    signs = np.random.default_rng(seed).choice([-1, 1], len(UNKNOWN))
    guess = [
        f.prior_mean if f.has_prior else f.start * (1 + 0.1 * sign) for f, sign in zip(problem.free, signs, strict=True)
    ]
    return judged(problem, refine(problem, np.array(guess)))


def main(arguments: list[str] | None = None) -> None:
    """Print truth, estimate and interval of a seed, and the coverage over many."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    options = parser.parse_args(arguments)
    first = from_afar(0)
    print(f"one rig: {first.fit.n_evaluations} evaluations, rms {np.round(1e3 * first.fit.rms, 3)} mrad")
    for name, value, theta, half, hit in zip(UNKNOWN, truth(), first.fit.theta, first.half, first.hits, strict=True):
        print(f"  {name:4s} {value:12.6g} {theta:12.6g} +- {half:9.3g} {'' if hit else 'outside'}")
    found = [o for o in map(outcome, range(1, options.seeds + 1)) if o is not None]
    if found:
        hits = np.array([o.hits for o in found])
        z = np.array([(o.fit.theta - truth()) / o.errors for o in found])
        print(f"coverage over {len(found)} of {options.seeds} seeds: {100 * hits.mean():.1f} %")
        for k, name in enumerate(UNKNOWN):
            print(f"  {name:4s} {100 * hits[:, k].mean():6.1f} %   z {z[:, k].mean():+.2f} +- {z[:, k].std():.2f}")


if __name__ == "__main__":
    main()
