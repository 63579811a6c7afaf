"""Models as text beside the same models by hand and in other solvers, at equal achieved error.

Run from the repository's root, on a machine that does nothing else::

    python tests/bench/text_models.py                        # all tables: some ten minutes
    python tests/bench/text_models.py --models belt lorenz --peers scalar heyoka --points
    python tests/bench/text_models.py --skip peers           # what text costs, and layers, and compiling

Four tables:

* **by hand**: a text against functions written by hand for the same equations (the Duffing oscillator and
  the paper's pendulum without magnets); CPU time of the same cells at the same tolerance;
* **layers**: oscillators with dry friction with their layers, which the text alone tells, and without, at
  equal error. A mass on a belt that sticks for half of the time moves there within the layer, where
  stability limits the steps; one that is driven through the layer gains;
* **peers**: every shipped text beside a scalar numba loop (Dormand-Prince 5(4), textbook control),
  numbalsoda (LSODA and DOP853 in C++) and heyoka (Taylor series in batches of 8, each order): CPU time of
  each solver over magpend's at the median errors 1e-4, 1e-6 and 1e-8;
* **compiling**: CPU time to the first result in a new process with an empty cache, and with a filled one.

Each solver is swept over its tolerance, magpend by both of its methods beside the peers. Its error is the
median over 16 trajectories of the scaled error after a few periods, against scipy's DOP853 at 1e-13; its cost
is CPU time of one thread per trajectory and period over many more periods, the least of the rounds, in which
all take turns. Where there is no drive a period is a while. Where all settings of a solver are better than an
error, the cheapest counts. The equations of the peers are made from the text's expressions with parameters as
numbers (`text_peers`); magpend's parameters are read per lane.

Models whose motion sticks or jumps (belt-stick, impact) have no peer: none of them says what comes after.

heyoka and numbalsoda are the optional extra ``bench``; a missing one is reported and left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import text_peers
from problem import Curve
from text_peers import Runner

from magpend_core import load_model, run_branches
from magpend_core.engine.system import System
from magpend_core.engine.tableau import METHODS

ERRORS = (1e-4, 1e-6, 1e-8)
"""Median errors at which the solvers are compared."""

N_ERROR = 16
PEERS = ("scalar", "numbalsoda", "heyoka")
PAIRS = ("duffing", "pendulum-free")


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
    """

    period: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    horizon: int


TURN = 2.0 * math.pi
CASES = {
    "duffing5": Case(TURN, (-1.0, -0.5), (1.0, 1.0), 4),
    "driven-pendulum": Case(TURN, (-3.0, -2.0), (3.0, 2.0), 2),
    "three-magnets": Case(5.0, (-1.5, -1.5, 0.0, 0.0), (1.5, 1.5, 0.0, 0.0), 2),
    "belt": Case(TURN, (-2.0, -2.0), (2.0, 2.0), 3),
    "van-der-pol": Case(TURN, (-2.0, -2.0), (2.0, 2.0), 3),
    "rossler": Case(18.0, (-5.0, -5.0, 0.0), (5.0, 5.0, 1.0), 1),
    "lorenz": Case(4.0, (-10.0, -10.0, 15.0), (10.0, 10.0, 35.0), 1),
    "pendulum-text": Case(1.0 / 2.8, (-0.3, -0.3, -1.0, -1.0), (0.3, 0.3, 1.0, 1.0), 5),
}

FRICTION = {
    "name": "driven-friction",
    "states": {"x": {"unit": "1"}, "v": {"unit": "1/s"}},
    "parameters": {"zeta": 0.02, "mu": 0.3, "amplitude": 1.0, "eps": 1e3},
    "equations": {"x": "v", "v": "amplitude*cos(2*pi*f*t) - 2*zeta*v - x - mu*tanh(eps*v)"},
}
"""An oscillator with dry friction, driven so that it does not stick."""
SLOW = Case(TURN / 0.6, (-2.0, -2.0), (2.0, 2.0), 4)
OSCILLATORS: dict[str, tuple[dict[str, float], Case]] = {
    "driven-1e3": ({}, SLOW),
    "driven-1e4": ({"eps": 1e4}, SLOW),
    "pendulum-text": ({}, CASES["pendulum-text"]),
    "belt": ({}, CASES["belt"]),
}
"""Oscillators with friction: changed parameters, and what is integrated."""

DUFFING = {
    "name": "duffing-text",
    "states": {"x": {"unit": "1"}, "v": {"unit": "1/s"}},
    "parameters": {"damping": 0.15, "linear": -1.0, "cubic": 1.0, "amplitude": 0.2},
    "equations": {"x": "v", "v": "amplitude*cos(2*pi*f*t) - damping*v - linear*x - cubic*x**3"},
}


@dataclass(frozen=True)
class Setting:
    """How much is run."""

    trajectories: int
    periods: int
    rounds: int


@dataclass(frozen=True)
class Contestant:
    """A solver: its settings, and how many trajectories over how many periods it is timed on."""

    name: str
    settings: dict[str, Runner]
    n: int
    periods: int


def lanes(system: System, packed: np.ndarray, frequency: float, tolerance: float, on_steps: Any = None) -> Runner:
    """Runner of the engine."""

    def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
        n = len(initial)
        found = run_branches(
            np.tile(packed, (n, 1, 1)),
            np.full((n, 1), frequency),
            initial,
            n_transient=n_periods - 1,
            n_keep=1,
            rtol=tolerance,
            atol=tolerance,
            system=system,
            max_steps_per_period=1_000_000,
        )
        if on_steps is not None:
            on_steps(found)
        return found.section[:, 0, 0]

    return runner


def starts(case: Case, n: int) -> np.ndarray:
    """Seeded initial states (n, n_states)."""
    return np.random.default_rng(1).uniform(case.low, case.high, (n, len(case.low)))


def median_error(found: np.ndarray, reference: np.ndarray, system: System) -> float:
    """Median of the largest scaled difference of the states."""
    difference = found - reference
    turned = np.remainder(difference + np.pi, TURN) - np.pi
    difference = np.where(system.is_angle, turned, difference)
    return float(np.median(np.max(abs(difference) / system.scales, axis=-1)))


def decades(first: float, last: float, per_decade: int) -> list[float]:
    """Powers of ten from ``10**-first`` down to ``10**-last``."""
    n = round((last - first) * per_decade)
    return [10.0 ** -(first + i / per_decade) for i in range(n + 1)]


def cpu_time(runner: Runner, initial: np.ndarray, n_periods: int) -> float:
    """CPU time of this thread [us] per trajectory and period."""
    started = time.thread_time()
    runner(initial, n_periods)
    return 1e6 * (time.thread_time() - started) / (len(initial) * n_periods)


def deeper(function: Callable[[], None], depth: int) -> None:
    """Call a function from `depth` more frames down the C stack (see `peers.race`)."""
    if depth == 0:
        function()
    else:
        next(map(lambda _: deeper(function, depth - 1), (0,)))


def race(
    contestants: Sequence[Contestant], case: Case, reference: np.ndarray, system: System, rounds: int
) -> list[Curve]:
    """Errors of all settings, which also compiles everything, then costs in turns."""
    initial = starts(case, max(c.n for c in contestants))
    curves = []
    for c in contestants:
        found = [runner(initial[:N_ERROR], case.horizon) for runner in c.settings.values()]
        errors = [median_error(states, reference, system) for states in found]
        curves.append(Curve(c.name, list(c.settings), errors, [math.inf] * len(errors)))

    def one_round() -> None:
        for c, curve in zip(contestants, curves, strict=True):
            costs = [cpu_time(runner, initial[: c.n], c.periods) for runner in c.settings.values()]
            curve.cost = [min(pair) for pair in zip(curve.cost, costs, strict=True)]

    for i_round in range(rounds):
        deeper(one_round, i_round)
    return curves


def engine_entry(
    name: str, system: System, packed: np.ndarray, case: Case, setting: Setting, methods: Sequence[str] = ("dopri5",)
) -> Contestant:
    """Enter the engine, swept over rtol = atol = 1e-3 ... 1e-11 by each method."""
    sweep = {
        f"{method} {t:.0e}": lanes(dataclasses.replace(system, method=method), packed, 1.0 / case.period, t)
        for method in methods
        for t in decades(3, 11, 2)
    }
    return Contestant(name, sweep, setting.trajectories, setting.periods)


def peer_entries(model: Any, case: Case, peers: Sequence[str], setting: Setting) -> Iterator[Contestant]:
    """Enter the peers that were asked for and are installed."""
    values, frequency, n = model.load().as_dict(), 1.0 / case.period, len(case.low)
    rhs = text_peers.scalar_rhs(model, values, frequency)
    few = max(8, setting.trajectories // 8)
    if "scalar" in peers:
        loop = text_peers.scalar_loop(rhs, n, case.period)
        settings = {f"{t:.0e}": loop(t) for t in decades(3, 11, 1)}
        yield Contestant("scalar numba", settings, few, setting.periods)
    if "numbalsoda" in peers:
        for method in ("lsoda", "dop853"):
            solver = text_peers.numbalsoda_loop(rhs, n, case.period, method)
            settings = {f"{t:.0e}": solver(t) for t in decades(4, 11, 1)}
            yield Contestant(f"numbalsoda {method.upper()}", settings, 8, max(1, setting.periods // 4))
    if "heyoka" in peers:
        settings = {
            f"order {order}": text_peers.heyoka_batch(model, values, frequency, tolerance, 8)
            for order, tolerance in text_peers.orders(2, 14)
        }
        yield Contestant("heyoka", settings, few, setting.periods)


def installed(peers: Sequence[str]) -> list[str]:
    """Those of the peers that can be imported; the others are reported."""
    found = []
    for name in peers:
        try:
            if name != "scalar":
                __import__(name)
            found.append(name)
        except ImportError as error:
            print(f"{name} is left out: {error} (it comes with the extra `bench`)")
    return found


def solved(model: Any, case: Case, over: Mapping[str, float] | None = None) -> np.ndarray:
    """States of the first trajectories at the horizon by scipy's DOP853."""
    rhs = text_peers.scalar_rhs(model, model.load(**over or {}).as_dict(), 1.0 / case.period)
    return text_peers.scipy_states(rhs, starts(case, N_ERROR), case.horizon * case.period, 1e-13)


def cost_at(curve: Curve, error: float) -> float:
    """Cost [us] of a median error; where all settings are better, that of the cheapest."""
    errors, costs = curve.front()
    if len(errors) and error > errors[0]:
        return float(costs[0])
    return curve.cost_at(error)


def ratios(curves: list[Curve]) -> Iterator[str]:
    """One line for each solver: its cost over the first one's, at each error."""
    for curve in curves:
        cells = []
        for error in ERRORS:
            own, first = cost_at(curve, error), cost_at(curves[0], error)
            text = f"{own:9.2f} us" + (f" {own / first:6.2f}" if curve is not curves[0] else " " * 7)
            cells.append("-".rjust(19) if math.isnan(own) else text)
        yield f"  {curve.name:<20}" + "".join(cells)


def points(curves: list[Curve]) -> Iterator[str]:
    """Every measured point."""
    for curve in curves:
        for setting, error, cost in zip(curve.setting, curve.error, curve.cost, strict=True):
            yield f"    {curve.name:<20}{setting:<10}{error:>12.2e}{cost:>12.3f}"


HEAD = f"  {'us per period, ratio':<20}" + "".join(f"{f'error {e:.0e}':>19}" for e in ERRORS)


def compare_peers(names: Sequence[str], peers: Sequence[str], setting: Setting, all_points: bool) -> None:
    """The table of peers."""
    for name in names:
        model, case = load_model(name), CASES[name]
        reference = solved(model, case)
        packed = model.load().pack()
        engine = engine_entry("magpend", model.system, packed, case, setting, tuple(METHODS))
        best = engine.settings["dopri5 1e-11"](starts(case, N_ERROR), case.horizon)
        agreed = median_error(best, reference, model.system)
        entries = [engine, *peer_entries(model, case, peers, setting)]
        curves = race(entries, case, reference, model.system, setting.rounds)
        print(f"\n{name}: {case.horizon} periods of {case.period:.3g} s; reference and magpend at 1e-11")
        print(f"  differ by {agreed:.0e}\n{HEAD}")
        print("\n".join(ratios(curves)), flush=True)
        if all_points:
            print("\n".join(points(curves)), flush=True)


def compare_layers(names: Sequence[str], setting: Setting, all_points: bool) -> None:
    """Oscillators with friction with and without their layers."""
    from magpend_core.models.text import read_model

    for name in names:
        over, case = OSCILLATORS[name]
        model = load_model(name) if name in CASES else read_model(FRICTION)
        parameters, system = model.load(**over), model.system
        without = dataclasses.replace(system, name=f"{system.name}_without", has_layers=False)
        entries = [
            engine_entry("with its layer", system, parameters.pack(), case, setting),
            engine_entry("without", without, parameters.pack(), case, setting),
        ]
        curves = race(entries, case, solved(model, case, over), system, setting.rounds)
        print(f"\n{name}; layers found: {system.has_layers}\n{HEAD}\n" + "\n".join(ratios(curves)), flush=True)
        if all_points:
            print("\n".join(points(curves)), flush=True)


def pairs(names: Sequence[str]) -> Iterator[tuple[str, System, np.ndarray, System, np.ndarray, Case]]:
    """Systems by hand and as text with the same equations."""
    from magpend_core.models.text import read_model

    for name in names:
        if name == "duffing":
            text, case = read_model(DUFFING), Case(TURN, (-1.5, -1.5), (1.5, 1.5), 4)
        else:
            text, case = load_model("pendulum-text"), CASES["pendulum-text"]
        hand, values = load_model(name), text.load().as_dict()
        shared = {p.name: values[p.name] for p in hand.parameters}
        yield name, hand.system, hand.load(**shared).pack(), text.system, text.load().pack(), case


def compare_by_hand(names: Sequence[str], setting: Setting) -> None:
    """Texts beside systems by hand: CPU time of the same cells, and steps."""
    print(f"\n  {'at tolerance 1e-6':<18}{'by hand':>14}{'as text':>14}{'ratio':>8}{'attempts':>18}")
    for name, hand, hand_packed, text, text_packed, case in pairs(names):
        attempts: list[float] = []

        def note(found: Any, attempts: list[float] = attempts) -> None:
            attempts.append(float(np.mean(found.n_steps + found.n_rejected)))

        frequency, initial = 1.0 / case.period, starts(case, setting.trajectories)
        runners = [
            lanes(system, packed, frequency, 1e-6, note)
            for system, packed in ((hand, hand_packed), (text, text_packed))
        ]
        for runner in runners:
            runner(initial, setting.periods)
        per_period = [a / setting.periods for a in attempts]
        cost = [math.inf, math.inf]

        def one_round(runners: list[Runner] = runners, initial: Any = initial, cost: Any = cost) -> None:
            for i, runner in enumerate(runners):
                cost[i] = min(cost[i], cpu_time(runner, initial, setting.periods))

        for i_round in range(2 * setting.rounds):
            deeper(one_round, i_round)
        print(
            f"  {name:<18}{cost[0]:14.3f} us{cost[1]:11.3f} us{cost[1] / cost[0]:8.3f}"
            f"{per_period[0]:9.2f}{per_period[1]:9.2f}",
            flush=True,
        )


CHILD = """
import time
clock = time.{clock}
started = clock()
import numpy as np
from magpend_core import load_model, run_branches
model = load_model({name!r})
system = model.system
read = clock()
run_branches(model.load().pack()[None, None], np.array([[{frequency!r}]]), np.array([{start!r}]),
             n_transient=0, n_keep=1, rtol=1e-6, atol=1e-6, system=system)
print(read - started, clock() - read)
"""


def compare_compiling(names: Sequence[str]) -> None:
    """Time to the first result in new processes."""
    print(f"\n  {'CPU s':<18}{'imports, text':>15}{'first run':>12}{'later process':>15}")
    for name in names:
        case = CASES[name]
        start = [float(v) for v in starts(case, 1)[0]]
        script = CHILD.format(clock="process_time", name=name, frequency=1.0 / case.period, start=start)
        with tempfile.TemporaryDirectory() as folder:
            environment = {**os.environ, "MAGPEND_CACHE_DIR": folder, "MAGPEND_CACHE": "1"}
            rows = []
            for _ in range(2):
                done = subprocess.run(
                    [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
                )
                rows.append([float(v) for v in done.stdout.split()])
        print(f"  {name:<18}{rows[0][0]:>15.2f}{rows[0][1]:>12.2f}{rows[1][1]:>15.2f}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--models", nargs="+", choices=list(CASES), default=list(CASES))
    p.add_argument("--peers", nargs="*", choices=PEERS, default=list(PEERS))
    p.add_argument("--pairs", nargs="+", choices=PAIRS, default=list(PAIRS), help="systems by hand")
    p.add_argument("--oscillators", nargs="+", choices=list(OSCILLATORS), default=list(OSCILLATORS))
    p.add_argument("--trajectories", type=int, default=128, help="a multiple of 8 (128)")
    p.add_argument("--periods", type=int, default=100, help="periods that are timed (100)")
    p.add_argument("--rounds", type=int, default=3)
    p.add_argument("--skip", nargs="*", choices=["hand", "layers", "peers", "compiling"], default=[])
    p.add_argument("--points", action="store_true", help="print every measured point")
    options = p.parse_args(arguments)
    if options.trajectories < N_ERROR or options.trajectories % 8:
        p.error(f"--trajectories {options.trajectories} must be a multiple of 8, and at least {N_ERROR}")
    setting = Setting(options.trajectories, options.periods, options.rounds)
    if "hand" not in options.skip:
        compare_by_hand(options.pairs, setting)
    if "layers" not in options.skip:
        compare_layers(options.oscillators, setting, options.points)
    if "peers" not in options.skip:
        compare_peers(options.models, installed(options.peers), setting, options.points)
    if "compiling" not in options.skip:
        compare_compiling(options.models)


if __name__ == "__main__":
    main()
