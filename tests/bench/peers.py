"""magpend beside other solvers, at equal achieved error.

Run from the repository's root, on a machine that does nothing else::

    python tests/bench/peers.py                                # all models: some ten minutes
    python tests/bench/peers.py --models belt pendulum --peers scalar heyoka --points
    python tests/bench/peers.py --figure work_precision.png    # error against time, too
    python tests/bench/peers.py --stiff                        # stiff problems, beside solvers of these

Every shipped text, and the paper's pendulum with its magnets and with steep edges of the drive, beside

* a scalar numba loop: Dormand-Prince 5(4), textbook control;
* numbalsoda: LSODA and DOP853 in C++;
* heyoka: Taylor series in batches of 8, each order;
* scipy: `solve_ivp` with DOP853 and RK45 on the compiled right-hand side.

Each solver is swept over its tolerance, magpend by both of its methods. Its error is the median over 16
trajectories of the scaled error after a few periods, against scipy's DOP853 at 1e-13; its cost is CPU time of one
thread per trajectory and period over many more periods, the least of the rounds, in which all take turns. Where there
is no drive a period is a while. Where all settings of a solver are better than an error, the cheapest counts. The
equations of the peers are made from a text's expressions with parameters as numbers (`solvers`); magpend's parameters
are read per lane. The pendulum with magnets is functions by hand in magpend, and compared with its text first.

Models whose motion sticks or jumps (belt-stick, impact) have no peer: none of them says what comes after.

With ``--stiff``, ensembles of HIRES, ROBER, the Oregonator, Hodgkin and Huxley's axon and van der Pol's oscillator at
mu = 1000 run from start to end beside

* numbalsoda: LSODA;
* SUNDIALS: CVODE's BDF from the wheel of scikit-sundae, called from compiled code, with the exact Jacobian;
* diffrax: Kvaerno's method of order 5, all trajectories at once (``vmap``, ``jit``, time of compilation left out);
* scipy: `solve_ivp` with LSODA and Radau on the compiled right-hand side and Jacobian.

Errors are those at the end, against scipy's Radau at 1e-10; a period is a run from start to end.

All peers are the dependency group ``bench``; a missing one is reported and left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import solvers
import stiff
from racing import HEAD, Contestant, Curve, Runner, decades, lanes, points, race, ratios, scaled_error

from magpend_core import load_model, pointwise
from magpend_core.engine.system import System
from magpend_core.engine.threads import using_threads
from magpend_core.models.text import read_model

N_ERROR = 16
METHODS = ("dopri5", "dop853")
PEERS = ("scalar", "numbalsoda", "heyoka", "scipy")
TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Case:
    """What is integrated of a model.

    Attributes
    ----------
    period : float
        Of the drive [s], or a while.
    low, high : tuple of float
        Corners of the box of initial states.
    horizon : int
        Periods after which errors are taken; few where motion is chaotic.
    model : str
        Name of magpend's model where it is not that of the case.
    changes : dict
        Parameters.
    """

    period: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    horizon: int
    model: str = ""
    changes: Mapping[str, float] = field(default_factory=dict)

    def starts(self, n: int) -> np.ndarray:
        """Return seeded initial states (n, n_states)."""
        return np.random.default_rng(1).uniform(self.low, self.high, (n, len(self.low)))


HANGING = (1.0 / 2.8, (-0.3, -0.3, -1.0, -1.0), (0.3, 0.3, 1.0, 1.0), 5)
CASES = {
    "duffing5": Case(TURN, (-1.0, -0.5), (1.0, 1.0), 4),
    "driven-pendulum": Case(TURN, (-3.0, -2.0), (3.0, 2.0), 2),
    "three-magnets": Case(5.0, (-1.5, -1.5, 0.0, 0.0), (1.5, 1.5, 0.0, 0.0), 2),
    "belt": Case(TURN, (-2.0, -2.0), (2.0, 2.0), 3),
    "van-der-pol": Case(TURN, (-2.0, -2.0), (2.0, 2.0), 3),
    "rossler": Case(18.0, (-5.0, -5.0, 0.0), (5.0, 5.0, 1.0), 1),
    "lorenz": Case(4.0, (-10.0, -10.0, 15.0), (10.0, 10.0, 35.0), 1),
    "pendulum-text": Case(*HANGING),
    "pendulum": Case(*HANGING),
    "pendulum, steep drive": Case(*HANGING, "pendulum", {"eps_drive": 1000.0}),
}


def text_of(name: str) -> Any:
    """Return a model as text; for the paper's pendulum that of the library with its magnets added (Eq. 18-20).

    Angles are not brought back to one turn there: the trajectories of the benchmark do not rotate.
    """
    model = load_model(name)
    if name != "pendulum":
        return model
    table = load_model("pendulum-text").definition.table
    moment = {
        f"f{i}": f"alpha{i}/2*exp(-((rel + beta{i})/gamma{i})**2 - ((psi1 + p{i}*rel + r{i})/c{i}_mag)**2)"
        for i in (1, 2)
    }
    define = {
        "rel": "psi2 - psi1",
        **moment,
        "side": "2/pi*atan(eps_mag*(psi1 + (p1 + p2)/2*rel + (r1 + r2)/2))",
        "fx": "((f1 - f2)*side + f1 + f2)/h",
        "dx": "l1*s1 + l2*s2",
        "fy": "fx*(h - l1*c1 - l2*c2)*dx/(dx**2 + delta**2)",
        **table["define"],
        "b1": table["define"]["b1"] + " + l1*(fx*c1 + fy*s1)",
        "b2": table["define"]["b2"] + " + l2*(fx*c2 + fy*s2)",
    }
    values = model.load().as_dict()
    own = {f"{k}_mag" if k in ("c1", "c2") else k: v for k, v in values.items()}
    return read_model(
        {
            "name": "pendulum-magnets",
            "states": table["states"],
            "parameters": own,
            "define": define,
            "equations": table["equations"],
        }
    )


def engine_entry(
    name: str, system: System, packed: np.ndarray, case: Case, size: tuple[int, int], methods: Sequence[str]
) -> Contestant:
    """Enter the engine, swept over rtol = atol = 1e-3 ... 1e-11 by each method."""
    sweep = {
        f"{method} {t:.0e}": lanes(dataclasses.replace(system, method=method), packed, 1.0 / case.period, t)
        for method in methods
        for t in decades(3, 11, 2)
    }
    return Contestant(name, sweep, *size)


def rhs_of(text: Any, case: Case) -> Any:
    """Compile the scalar right-hand side of a text."""
    return solvers.scalar_rhs(text, text.load(**case.changes).as_dict(), 1.0 / case.period)


def peer_entries(text: Any, case: Case, peers: Sequence[str], n_most: int, periods: int) -> Iterator[Contestant]:
    """Enter the peers that were asked for."""
    n, rhs = len(case.low), rhs_of(text, case)
    few = max(8, n_most // 8)
    if "scalar" in peers:
        loop = solvers.scalar_loop(rhs, n, case.period)
        yield Contestant("scalar numba", {f"{t:.0e}": loop(t) for t in decades(3, 11, 1)}, few, periods)
    if "numbalsoda" in peers:
        for method in ("lsoda", "dop853"):
            solver = solvers.numbalsoda_loop(rhs, n, case.period, method)
            settings = {f"{t:.0e}": solver(t) for t in decades(4, 11, 1)}
            yield Contestant(f"numbalsoda {method.upper()}", settings, 8, max(1, periods // 4))
    if "heyoka" in peers:
        values = text.load(**case.changes).as_dict()
        settings = {
            f"order {order}": solvers.heyoka_batch(text, values, 1.0 / case.period, tolerance, 8)
            for order, tolerance in solvers.orders(2, 14)
        }
        yield Contestant("heyoka", settings, few, periods)
    if "scipy" in peers:
        for method, last in (("DOP853", 10), ("RK45", 9)):
            settings = {f"{t:.0e}": solvers.scipy_runner(rhs, case.period, t, method) for t in decades(4, last, 1)}
            yield Contestant(f"scipy {method}", settings, 4, case.horizon)


def installed(peers: Sequence[str]) -> list[str]:
    """Return those of the peers that can be imported; the others are reported."""
    found = []
    for name in peers:
        try:
            if name != "scalar":
                __import__(name)
            found.append(name)
        except ImportError as error:
            print(f"{name} is left out: {error} (it comes with the group `bench`)")
    return found


def error_by(rhs: Any, case: Case, system: System) -> Callable[[Runner], float]:
    """Return a function from a runner to its median error at the horizon, against scipy's DOP853."""
    initial = case.starts(N_ERROR)
    reference = solvers.scipy_runner(rhs, case.period, 1e-13, "DOP853")(initial, case.horizon)

    def error_of(runner: Runner) -> float:
        found = runner(initial, case.horizon)
        return float(np.median(scaled_error(found, reference, system.is_angle, system.scales)))

    return error_of


def check_equations(parameters: Any, rhs: Any, case: Case) -> float:
    """Return the largest relative difference of the peers' rates from magpend's.

    Raises
    ------
    AssertionError
        If it is above 1e-10: the timings would be of something else.
    """
    states = case.starts(64)
    ours = pointwise.rates(0.1, states, parameters, 1.0 / case.period)
    theirs = np.array([rhs(0.1, *y) for y in states.tolist()])
    largest = float(np.max(np.abs(theirs - ours) / np.abs(ours).max(axis=1, keepdims=True)))
    if not largest < 1e-10:
        raise AssertionError(f"the equations of the peers differ from magpend's by {largest:.1e}, more than 1e-10")
    return largest


def compare(name: str, peers: Sequence[str], size: tuple[int, int], rounds: int) -> list[Curve]:
    """Race on a case, and print its table."""
    case = CASES[name]
    parameters, text = load_model(case.model or name).load(**case.changes), text_of(case.model or name)
    system, rhs = parameters.model.system, rhs_of(text, case)
    same = check_equations(parameters, rhs, case)
    error_of = error_by(rhs, case, system)
    engine = engine_entry("magpend", system, parameters.pack(), case, size, METHODS)
    agreed = error_of(engine.settings["dopri5 1e-11"])
    entries = [engine, *peer_entries(text, case, peers, *size)]
    curves = race(entries, case.starts(size[0]), error_of, rounds)
    print(f"\n{name}: {case.horizon} periods of {case.period:.3g} s; reference and magpend at 1e-11 differ by")
    print(f"  {agreed:.0e}, rates by {same:.0e}\n{HEAD}")
    print("\n".join(ratios(curves)), flush=True)
    return curves


def draw(results: Mapping[str, list[Curve]], path: Path) -> None:
    """Draw error against time, a panel for each case: lines along fronts, other settings as faint markers."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    n = len(results)
    figure, row = plt.subplots(1, n, figsize=(3.6 * n + 0.2, 3.9), sharey=True, squeeze=False, layout="constrained")
    for axes, (name, curves) in zip(row[0], results.items(), strict=True):
        for curve, marker in zip(curves, "osD^vxP+", strict=False):
            (line,) = axes.plot(*curve.front(), marker=marker, label=curve.name)
            axes.plot(curve.error, curve.cost, marker, color=line.get_color(), alpha=0.25, zorder=1)
        axes.set(xscale="log", yscale="log", xlim=(3e-3, 1.3e-11), title=name, xlabel="median scaled error")
        axes.grid(color="0.9", linewidth=0.6)
    row[0][0].set_ylabel("CPU time per period and trajectory [\N{MICRO SIGN}s]")
    figure.legend(*row[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=300)
    print(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--stiff", action="store_true", help="stiff problems and solvers of them")
    p.add_argument("--models", nargs="+", choices=[*CASES, *stiff.SPREAD], help="all")
    p.add_argument("--peers", nargs="*", choices=[*PEERS, *stiff.PEERS[1:3]], help="all")
    p.add_argument("--trajectories", type=int, default=128, help="a multiple of 8 (128)")
    p.add_argument("--periods", type=int, default=100, help="periods that are timed (100)")
    p.add_argument("--rounds", type=int, default=3)
    p.add_argument("--points", action="store_true", help="print every measured point")
    p.add_argument("--figure", type=Path, help="PNG, PDF or SVG of error against time")
    options = p.parse_args(arguments)
    models, peers = (stiff.SPREAD, stiff.PEERS) if options.stiff else (CASES, PEERS)
    peers, size = installed(peers if options.peers is None else options.peers), (options.trajectories, options.periods)
    with using_threads(1):
        results = {
            name: stiff.compare(name, peers, size[0], options.rounds)
            if options.stiff
            else compare(name, peers, size, options.rounds)
            for name in options.models or models
        }
    if options.points:
        for name, curves in results.items():
            print(f"\n{name}", *points(curves), sep="\n")
    if options.figure:
        draw(results, options.figure)


if __name__ == "__main__":
    main()
