"""Count how often the 95 % bands of a fold, a Hopf point and a period doubling cover their true values.

    python tests/bench/coverage.py [--rigs 200] [--draws 100]

Each virtual rig measures amplitudes (and frequencies) of orbits with white noise. The model is fitted to them, draws
of the Gaussian posterior are carried to the bifurcations as `magpend identify posterior` does, and the central 95 % of
them is compared with the truth. Two systems: the normal form of the generalised Hopf point (fold of cycles, Hopf point,
known in closed form), and an oscillator with two wells (first doubling along the amplitude of its drive).
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.analysis.branches.bands import bifurcation_data
from pipeline.analysis.branches.carrying import OrbitData, Solution, settled, solve
from pipeline.analysis.branches.kinds import DOUBLING, FOLD, HOPF
from pipeline.results.draws import LEVELS
from pipeline.rig.identify.build import build
from pipeline.rig.identify.local import fit_local
from pipeline.rig.identify.measured_orbits import read_orbits
from pipeline.rig.identify.orbit_residuals import quantities_of
from pipeline.rig.identify.specification import parse_identification
from pipeline.rig.identify.statistics import covariance_of, linearise

RADIAL = {
    "name": "radial",
    "states": {"x": {"scale": 1.0}, "y": {"scale": 1.0}},
    "parameters": {name: {"value": v} for name, v in {"m": 0.0, "g": 1.2, "h": 0.05, "w": 6.0}.items()},
    "define": {"r2": "x**2 + y**2", "growth": "m - h + r2 - g*r2**2"},
    "equations": {"x": "growth*x - w*y", "y": "growth*y + w*x"},
}

WELLS = {
    "name": "wells",
    "states": {"x": {"scale": 1.0}, "v": {"scale": 1.0}},
    "parameters": {name: {"value": v} for name, v in {"d": 0.2, "a": 1.0, "b": 1.0, "F": 0.2}.items()},
    "equations": {"x": "v", "v": "-d*v + a*x - b*x**3 + F*cos(2*pi*f*t)"},
}

CASES = {
    "radial": (
        RADIAL,
        {"section": {"of": "y", "longest": 20.0}, "range": [-0.35, 0.3]},
        {"g": 1.2, "h": 0.05, "w": 6.0},
        ("m", [-0.1, -0.06, 0.0, 0.1], "yes"),
        (FOLD, HOPF),
    ),
    "wells": (
        WELLS,
        {"frequency_hz": 0.19, "range": [0.05, 0.4]},
        {"d": 0.2, "a": 1.0, "b": 1.0},
        ("F", [0.08, 0.12, 0.16, 0.2], "yes"),
        (DOUBLING,),
    ),
}


def built(case: str, folder: Path, sd: float):
    """Return the problem with exact data at the truth, and its bifurcations with their true values."""
    model, keys, truth, (parameter, values, stable), kinds = CASES[case]
    with (folder / f"{case}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([parameter, "stable", "amplitude", "amplitude_sd", "frequency", "frequency_sd"])
        writer.writerows([v, stable, 0.3, sd, 1.0, 0.003] for v in values)
    tables = {
        "kind": "identification",
        "model": model,
        "identify": {name: {"start": value, "bounds": [0.02 * value, 5 * value]} for name, value in truth.items()},
        "orbits": [{"file": f"{case}.csv", **keys}],
    }
    spec = parse_identification(tables, folder)
    read = read_orbits(spec)
    problem = build(spec, [], read).problem
    orbits = problem.orbits[0]
    packed = orbits.packed(problem.values(problem.start))[None]
    exact = quantities_of(orbits, packed, solve(orbits, packed))[0]
    data = tuple(replace(d, measured=v) for d, v in zip(orbits.data, exact, strict=True))
    branches, _ = read[0].branches(problem.values(problem.start))
    points, states, _ = bifurcation_data(branches)
    chosen = [i for i, point in enumerate(points) if point.kind in kinds]
    firsts = {points[i].kind: i for i in reversed(chosen)}
    own = [firsts[kind] for kind in kinds]
    guess = np.array([states[i] for i in own])
    known = Solution(packed[0], guess, np.zeros_like(guess))
    table = settled(OrbitData(orbits.along, orbits.state, tuple(points[i] for i in own), known))
    return replace(problem, orbits=(replace(orbits, data=data),)), table


def covered(problem, table, draws: int, random: np.random.Generator) -> np.ndarray:
    """Return for one virtual rig whether the band of each bifurcation holds its true value; NaN if too few draws."""
    orbits = problem.orbits[0]
    noisy = tuple(replace(d, measured=d.measured + d.sd * random.standard_normal(len(d.sd))) for d in orbits.data)
    own = replace(problem, orbits=(replace(orbits, data=noisy),))
    fit = fit_local(own, own.start)
    found = covariance_of(linearise(own.with_orbits(fit.known), fit), np.abs(fit.theta))
    thetas = random.multivariate_normal(fit.theta, found.matrix, draws, method="eigh")
    packed = np.array([table.packed(own.values(theta)) for theta in thetas])
    values = np.array([[v[0] for v in row] for row in quantities_of(table, packed, solve(table, packed))])
    low, _, high = np.nanquantile(values, LEVELS, axis=0)
    truth = table.known.unknowns[:, -1]
    return np.where(np.isfinite(values).mean(axis=0) > 0.9, (low <= truth) & (truth <= high), np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--draws", type=int, default=100)
    asked = parser.parse_args()
    for case, sd in (("radial", 0.01), ("wells", 0.003)):
        with tempfile.TemporaryDirectory() as folder:
            problem, table = built(case, Path(folder), sd)
        begin = time.perf_counter()
        found = np.array(
            [covered(problem, table, asked.draws, np.random.default_rng([7, k])) for k in range(asked.rigs)]
        )
        seconds = time.perf_counter() - begin
        for datum, column in zip(table.data, found.T, strict=True):
            known = column[np.isfinite(column)]
            share, error = 100.0 * known.mean(), 100.0 * np.sqrt(0.95 * 0.05 / max(len(known), 1))
            print(f"{case}, {datum.kind} at {datum.value:.6g}: {share:.1f} % of {len(known)} bands hold the truth")
            print(f"  expected 95 %, standard error {error:.1f} %")
        print(f"{case}: {seconds / asked.rigs:.2f} s per rig")


if __name__ == "__main__":
    main()
