"""Models as text beside the same models by hand, with and without layers, and what they compile for.

Run from the repository's root, on a machine that does nothing else::

    python tests/bench/text_models.py

Three tables:

* **by hand**: a text against functions written by hand for the same equations (the Duffing oscillator and
  the paper's pendulum without magnets); CPU time of the same cells at the same tolerance;
* **layers**: oscillators with dry friction with their layers, which the text alone tells, and without, at
  equal error (see `peers`). A mass on a belt that sticks for half of the time moves there within the layer, where
  stability limits the steps; one that is driven through the layer gains;
* **compiling**: CPU time to the first result in a new process with an empty cache, and with a filled one.

`peers` compares texts with other solvers.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from kernel import DUFFING
from peers import CASES, TURN, Case, engine_entry, error_by, lanes, rhs_of
from racing import HEAD, least, points, race, ratios

from magpend_core import load_model
from magpend_core.engine.system import System
from magpend_core.models.text import read_model

PAIRS = ("duffing", "pendulum-free")
TIMED = [name for name, case in CASES.items() if not case.model]
FRICTION = {
    "name": "driven-friction",
    "states": {"x": {"unit": "1"}, "v": {"unit": "1/s"}},
    "parameters": {"zeta": 0.02, "mu": 0.3, "amplitude": 1.0, "eps": 1e3},
    "equations": {"x": "v", "v": "amplitude*cos(2*pi*f*t) - 2*zeta*v - x - mu*tanh(eps*v)"},
}
"""An oscillator with dry friction, driven so that it does not stick."""
SLOW = Case(TURN / 0.6, (-2.0, -2.0), (2.0, 2.0), 4)
OSCILLATORS: dict[str, Case] = {
    "driven-1e3": SLOW,
    "driven-1e4": dataclasses.replace(SLOW, changes={"eps": 1e4}),
    "pendulum-text": CASES["pendulum-text"],
    "belt": CASES["belt"],
}


def compare_layers(names: Sequence[str], size: tuple[int, int], rounds: int, all_points: bool) -> None:
    """Compare oscillators with friction with and without their layers."""
    for name in names:
        case = OSCILLATORS[name]
        model = load_model(name) if name in CASES else read_model(FRICTION)
        packed, system = model.load(**case.changes).pack(), model.system
        without = dataclasses.replace(system, name=f"{system.name}_without", has_layers=False)
        entries = [
            engine_entry("with its layer", system, packed, case, size, ("dopri5",)),
            engine_entry("without", without, packed, case, size, ("dopri5",)),
        ]
        error_of = error_by(rhs_of(model, case), case, system)
        curves = race(entries, case.starts(size[0]), error_of, rounds)
        print(f"\n{name}; layers found: {system.has_layers}\n{HEAD}\n" + "\n".join(ratios(curves)), flush=True)
        if all_points:
            print("\n".join(points(curves)), flush=True)


def pairs(names: Sequence[str]) -> Iterator[tuple[str, System, np.ndarray, System, np.ndarray, Case]]:
    """Yield systems by hand and as text with the same equations."""
    for name in names:
        if name == "duffing":
            text, case = read_model(DUFFING), Case(TURN, (-1.5, -1.5), (1.5, 1.5), 4)
        else:
            text, case = load_model("pendulum-text"), CASES["pendulum-text"]
        hand, values = load_model(name), text.load().as_dict()
        shared = {p.name: values[p.name] for p in hand.parameters}
        yield name, hand.system, hand.load(**shared).pack(), text.system, text.load().pack(), case


def compare_by_hand(names: Sequence[str], size: tuple[int, int], rounds: int) -> None:
    """Compare texts with systems by hand: CPU time of the same cells, and attempted steps."""
    n, n_periods = size
    print(f"\n  {'at tolerance 1e-6':<18}{'by hand':>14}{'as text':>14}{'ratio':>8}{'attempts':>18}")
    for name, hand, hand_packed, text, text_packed, case in pairs(names):
        initial, attempts = case.starts(n), {}

        def run(key: str, system: System, packed: np.ndarray, case: Any = case, initial: Any = initial) -> Any:
            def note(found: Any) -> None:
                attempts[key] = float(np.mean(found.n_steps + found.n_rejected)) / n_periods  # noqa: B023

            runner = lanes(system, packed, 1.0 / case.period, 1e-6, note)
            return lambda: runner(initial, n_periods)

        runs = {"hand": run("hand", hand, hand_packed), "text": run("text", text, text_packed)}
        a, b = (1e6 * seconds / (n * n_periods) for seconds, _ in least(runs, 2 * rounds).values())
        print(
            f"  {name:<18}{a:14.3f} us{b:11.3f} us{b / a:8.3f}{attempts['hand']:9.2f}{attempts['text']:9.2f}",
            flush=True,
        )


CHILD = """
import time
clock = time.process_time
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
    """Take the time to the first result in new processes."""
    print(f"\n  {'CPU s':<18}{'imports, text':>15}{'first run':>12}{'later process':>15}")
    for name in names:
        case = CASES[name]
        start = case.starts(1)[0].tolist()
        script = CHILD.format(name=name, frequency=1.0 / case.period, start=start)
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
    p.add_argument("--models", nargs="*", choices=TIMED, default=list(TIMED), help="compiled")
    p.add_argument("--pairs", nargs="*", choices=PAIRS, default=list(PAIRS), help="systems by hand")
    p.add_argument("--oscillators", nargs="*", choices=list(OSCILLATORS), default=list(OSCILLATORS))
    p.add_argument("--trajectories", type=int, default=128)
    p.add_argument("--periods", type=int, default=100, help="periods that are timed (100)")
    p.add_argument("--rounds", type=int, default=3)
    p.add_argument("--points", action="store_true", help="print every measured point")
    options = p.parse_args(arguments)
    size = options.trajectories, options.periods
    compare_by_hand(options.pairs, size, options.rounds)
    compare_layers(options.oscillators, size, options.rounds, options.points)
    compare_compiling(options.models)


if __name__ == "__main__":
    main()
