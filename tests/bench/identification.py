"""What the lanes are worth in a fit: residuals of the shipped recording, and their slopes.

Run it alone on a machine that does nothing else::

    OMP_NUM_THREADS=1 python tests/bench/identification.py [--rounds 5] [--pieces 26]

The same residuals (pieces of the real double pendulum, samples, parameters, tolerance) by the lanes and by
`scipy.integrate.solve_ivp` with the same pair of Dormand and Prince and a jitted right-hand side; the target
is a factor of 20. Then residuals with slopes, as a step of the fit needs them: by one-sided differences
between lanes and by the variational equations, with the largest difference of the two in the correlations of
the normal matrix. CPU times of one process, the least of some rounds, taken in turn.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit
from racing import least
from scipy.integrate import solve_ivp

from pipeline.rig.identify.build import build, read_all
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import Problem
from pipeline.rig.identify.specification import load_identification

SPEC = Path(__file__).parents[2] / "workflows" / "multiarm.toml"
TARGET = 20.0


@njit(fastmath={"contract"}, error_model="numpy")
def right_hand_side(t, y, p):
    """The double pendulum, for scipy: drive off; `p` as in `arguments`."""
    B1, B2, N12, M1, M2, T1, T2, c1, c2, mu0, c0, eps, k1, k2, l1, l2 = p
    a, b, v, w = y
    s, c = np.sin(a - b), np.cos(a - b)
    r = w - v
    stribeck1 = (1 - mu0) * np.exp(-c0 * abs(v)) + mu0
    stribeck2 = (1 - mu0) * np.exp(-c0 * abs(r)) + mu0
    R1 = T1 * 2 / np.pi * np.arctan(eps * v) * stribeck1 + c1 * v
    R2 = T2 * 2 / np.pi * np.arctan(eps * r) * stribeck2 + c2 * r
    force = moment = 0.0
    for k in range(3):
        x = l2 * (0.5 + (k - 1) * np.sqrt(0.15))
        across = l1 * v * c + x * w
        drag = k2 * l2 * (8.0 if k == 1 else 5.0) / 18.0 * abs(across) * across
        force += drag
        moment += x * drag
    q1 = -R1 + R2 - 0.25 * k1 * l1**4 * abs(v) * v - l1 * c * force - N12 * s * w * w - M1 * np.sin(a)
    q2 = N12 * s * v * v - M2 * np.sin(b) - R2 - moment
    det = B1 * B2 - (N12 * c) ** 2
    return np.array([v, w, (B2 * q1 - N12 * c * q2) / det, (B1 * q2 - N12 * c * q1) / det])


def arguments(p: dict[str, float]) -> np.ndarray:
    """What `right_hand_side` takes, from parameters by name."""
    B1 = p["J1"] + p["m1"] * p["e1"] ** 2 + p["m2"] * p["l1"] ** 2
    B2 = p["J2"] + p["m2"] * p["e2"] ** 2
    M1 = (p["m1"] * p["e1"] + p["m2"] * p["l1"]) * p["g"]
    names = ("T1", "T2", "c1", "c2", "mu0", "c0", "eps", "k1", "k2", "l1", "l2")
    own = [B1, B2, p["m2"] * p["e2"] * p["l1"], M1, p["m2"] * p["g"] * p["e2"]]
    return np.array(own + [p[name] for name in names])


def by_scipy(problem: Problem) -> np.ndarray:
    """Residuals of all pieces in units of the noise."""
    p = arguments(problem.values(problem.start))
    rows = []
    for piece in problem.pieces:
        end = float(piece.time[-1])
        found = solve_ivp(
            right_hand_side,
            (0.0, end),
            piece.start,
            "RK45",
            piece.time,
            args=(p,),
            rtol=problem.rtol,
            atol=problem.rtol,
        )
        rows.append((piece.measured - found.y[: len(problem.channels)].T) / problem.noise)
    return np.concatenate(rows).ravel()


def by_lanes(problem: Problem) -> np.ndarray:
    """The same."""
    return evaluate(problem, problem.start[None], problem.starts[None], slopes=False)[0].rows


def with_slopes(problem: Problem) -> np.ndarray:
    """Normal matrix of a step, scaled to correlations."""
    jacobian = evaluate(problem, problem.start[None], problem.starts[None], slopes=True)[0].jacobian
    size = np.linalg.norm(jacobian, axis=0)
    return (jacobian.T @ jacobian) / np.outer(size, size)


def shipped_problem(n_pieces: int) -> Problem:
    """The shipped identification at its start, with the first pieces."""
    spec = load_identification(SPEC)
    problem = build(spec, read_all(spec)).problem
    return replace(problem, pieces=problem.pieces[:n_pieces])


def main(arguments: list[str] | None = None) -> None:
    """Print times and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--pieces", type=int, default=26)
    options = parser.parse_args(arguments)

    def times(*functions: Callable[[], object]) -> list[float]:
        found = least(dict(enumerate(functions)), options.rounds, time.process_time)
        return [seconds for seconds, _ in found.values()]

    problem = shipped_problem(options.pieces)
    variational = replace(problem, slopes="variational")
    same = np.abs(by_scipy(problem) - by_lanes(problem)).max() * problem.noise.max()
    assert same < 1e-4, "the two integrate something else"
    lanes, scipy = times(lambda: by_lanes(problem), lambda: by_scipy(problem))
    print(f"residuals of {len(problem.pieces)} pieces, largest difference {same:.1e} rad")
    print(f"  lanes      {1e3 * lanes:9.2f} ms")
    print(f"  solve_ivp  {1e3 * scipy:9.2f} ms   {scipy / lanes:.0f} times (target {TARGET:.0f})")
    differences, tangents = times(lambda: with_slopes(problem), lambda: with_slopes(variational))
    apart = np.abs(with_slopes(problem) - with_slopes(variational)).max()
    print(f"residuals with slopes by {len(problem.free)} unknowns and the starts")
    print(f"  differences between lanes  {1e3 * differences:9.2f} ms")
    print(f"  variational equations      {1e3 * tangents:9.2f} ms   {tangents / differences:.1f} times")
    print(f"  largest difference of the normal matrices, scaled to correlations: {apart:.1e}")


if __name__ == "__main__":
    main()
