"""Two-parameter curves: our continuation on lanes against scalar continuation with scipy's solve_ivp.

Run it alone on a machine that does nothing else::

    python tests/bench/curves.py [--points 30] [--rounds 3]

The fold curve of x'' + .1 x' + x + x^3 = F cos wt. Ours follows it by arclength, with its points of codimension two.
The other one solves the fold equations at some of our frequencies by `scipy.optimize.fsolve`, each from the
solution before, with the variational equations by DOP853 at 1e-10. CPU time per point, the least of the rounds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from racing import least
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from magpend_core.models import load_model
from pipeline.analysis.branches import Scope, Start, explore
from pipeline.analysis.branches.curves import Curve, continue_curves
from pipeline.analysis.branches.problems import Family

DAMPING = 0.1
BOUNDS = ((0.1, 0.4), (0.01, 2.0))


def starting_fold() -> tuple[Family, np.ndarray]:
    """The family of the curve, and the unknowns of a fold on it."""
    model, frequency = load_model("duffing"), 1.4 / (2.0 * np.pi)
    packed = model.load(damping=DAMPING, linear=1.0, cubic=1.0, amplitude=0.4).pack()
    family = Family(model.system, 1, frequency, packed, ("amplitude",), (2.0,))
    fold = explore([Start(family, np.zeros(2), 0.011)], Scope(0.01, 2.0, 1))[0].bifurcations[0]
    both = Family(model.system, 1, frequency, packed, ("frequency", "amplitude"), (0.3, 2.0))
    return both, both.unknowns(family.state(fold.point.u), [frequency, family.values(fold.point.u)[0]])


def fold_equations(unknowns: np.ndarray, frequency: float) -> list[float]:
    """Mismatch of the orbit and det(M - 1), by scipy."""
    omega = 2.0 * np.pi * frequency

    def rates(t: float, z: np.ndarray) -> list[float]:
        x, v, a, b, c, d = z
        slope = -1.0 - 3.0 * x * x
        force = unknowns[2] * np.cos(omega * t) - DAMPING * v - x - x**3
        return [v, force, c, d, slope * a - DAMPING * c, slope * b - DAMPING * d]

    start = [*unknowns[:2], 1.0, 0.0, 0.0, 1.0]
    end = solve_ivp(rates, (0.0, 1.0 / frequency), start, method="DOP853", rtol=1e-10, atol=1e-10).y[:, -1]
    matrix = end[2:].reshape(2, 2) - np.eye(2)
    return [end[0] - unknowns[0], end[1] - unknowns[1], float(np.linalg.det(matrix))]


def scalar(curve: Curve, places: Sequence[int]) -> np.ndarray:
    """Amplitudes of the folds at the frequencies of some points of a curve, each from the one before."""
    first = curve.points[places[0]]
    here = np.array([*curve.family.state(first.u), curve.family.values(first.u)[1]])
    found = []
    for k in places:
        here = fsolve(fold_equations, here, args=(float(curve.values[k, 0]),), xtol=1e-10)
        found.append(here[2])
    return np.array(found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=30, help="points of the scalar continuation")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    family, start = starting_fold()
    (curve,) = continue_curves([(0, family, "fold", start)], BOUNDS)
    # on one side of the cusp, where a frequency has one fold of this family
    cusp = int(np.argmin(curve.values[:, 0]))
    places = list(range(cusp + 20, min(cusp + 20 + options.points, len(curve.points) - 1)))
    amplitudes = scalar(curve, places)
    print(f"largest difference of the amplitudes: {np.abs(amplitudes - curve.values[places, 1]).max():.1e}")
    runs = {
        "ours": lambda: continue_curves([(0, family, "fold", start)], BOUNDS),
        "theirs": lambda: scalar(curve, places),
    }
    ours, theirs = (seconds for seconds, _ in least(runs, options.rounds, time.process_time).values())
    ours, theirs = ours / len(curve.points), theirs / len(places)
    print(f"magpend  {1e3 * ours:8.2f} ms per point, points of codimension two located ({len(curve.points)} points)")
    print(f"scalar   {1e3 * theirs:8.2f} ms per point ({len(places)} points)")
    print(f"ratio    {theirs / ours:8.1f}")


if __name__ == "__main__":
    main()
