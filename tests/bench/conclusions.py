"""What conclusions cost beside the cells that they rest on, and beside another version of magpend.

Run it alone on a machine that does nothing else::

    python tests/bench/conclusions.py [CASE ...] [--against FOLDER] [--rounds 1]

Each case is a run and the commands that ask what its cells mean, in the order in which a user gives them, each in a
process of its own, with nothing compiled before the first. A line is printed for each command: its processor time over
that of the run, its largest memory [MB], and, if ``--against`` names a checkout of another version, its time over that
of the same command there, which runs just before it. Cases:

* **map**: 40 x 50 parameter points of the Duffing oscillator with 16 starts each, and its attractors;
* **quickstart**: the first diagram, its attractors, branches and events;
* **planar**: a predator-prey model's equilibria, and their bifurcations in the plane of two parameters;
* **starts**: what the program takes to answer where nothing is to be computed;
* **smooth**, **impacts**: a second model after a first one was compiled, of flows and of oscillators with impacts.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from analysis_scaling import SPEC, measured

MAP, TINY_MAP = {"columns": 40, "rows": 50, "starts": 16}, {"columns": 3, "rows": 2, "starts": 4}

PLANAR = """
kind = "sweep"
[model]
name = "predator"
states = {{ x = {{}}, z = {{}} }}
parameters = {{ alpha = 0.3, delta = 0.3 }}
equations = {{ x = "x - x*z/(1 + alpha*x) - 0.01*x**2", z = "-z + x*z/(1 + alpha*x) - delta*z**2" }}
[section]
of = "x"
value = 3.0
longest = 300.0
[axes]
alpha = {{ start = 0.05, stop = 0.55, num = {columns} }}
[initial_conditions]
kind = "random"
n = 6
seed = 0
x = [0.5, 60.0]
z = [0.2, 20.0]
[integration]
n_transient = 100
n_keep = 8
"""
"""Bazykin's predator and prey: its equilibria reach 100, on a branch with two folds."""

ATTRACTORS = ("analyse", "attractors", "RUN")
CURVES = ("--second", "delta", "--second-from", "0.1", "--second-to", "0.5")


@dataclass(frozen=True)
class Case:
    """A run, and the commands that follow it; ``RUN`` stands for its folder."""

    spec: str
    commands: Sequence[tuple[str, ...]] = ()
    before: Sequence[tuple[str, ...]] = ()  # commands after the run that are not measured
    run: Sequence[str] = ()  # further words of the run


def cases(tiny: bool) -> dict[str, Case]:
    """Return the cases by name."""
    size = TINY_MAP if tiny else MAP
    smoke = ("--smoke",) if tiny else ()
    branches, events = ("analyse", "branches", "RUN"), ("analyse", "events", "RUN")
    return {
        "map": Case(SPEC.format(**size), [ATTRACTORS]),
        "quickstart": Case("quickstart", [ATTRACTORS, branches, *([] if tiny else [events])], run=smoke),
        "planar": Case(
            PLANAR.format(columns=4 if tiny else 21),
            [branches, *([] if tiny else [("analyse", "curves", "RUN", *CURVES)])],
        ),
        "starts": Case(
            "quickstart", [("status", "RUN"), ("run", "quickstart", "--dry-run"), ATTRACTORS], [ATTRACTORS], smoke
        ),
        "smooth": Case("rossler", [("run", "van-der-pol", "--smoke", "--out", "OTHER", "--quiet")], run=("--smoke",)),
        "impacts": Case("impact", [("run", "belt", "--smoke", "--out", "OTHER", "--quiet")], run=("--smoke",)),
    }


def processor_times(case: Case, tree: Path, folder: Path) -> list[tuple[str, float, float]]:
    """Run the commands of a case in the code of `tree`; return words, processor time [s] and memory [MB] of each."""
    folder.mkdir(parents=True)
    spec, run = case.spec, folder / "run"
    if "\n" in spec:
        spec = str(folder / "spec.toml")
        Path(spec).write_text(case.spec)
    places = {"RUN": str(run), "OTHER": str(folder / "other")}
    os.environ |= {
        "PYTHONPATH": os.pathsep.join([str(tree), str(tree / "pipeline" / "face")]),
        "MAGPEND_CACHE_DIR": str(folder / "cache"),
    }

    def measure(words: Sequence[str]) -> tuple[str, float, float]:
        seconds, _, most = measured(*(places.get(word, word) for word in words))
        return " ".join(word for word in words if word not in places), seconds, most

    found = [("run", *measure(("run", spec, "--out", "RUN", "--quiet", *case.run))[1:])]
    for words in case.before:
        measure(words)
    return [*found, *(measure(words) for words in case.commands)]


def main() -> None:
    """Print a line for each command of each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"{', '.join(cases(False))}; all by default")
    parser.add_argument("--against", type=Path, help="checkout of another version")
    parser.add_argument("--rounds", type=int, default=1, help="how often each case is run; medians are printed")
    parser.add_argument("--tiny", action="store_true", help="in sizes that only show that it works")
    options = parser.parse_args()
    here, known = Path(__file__).parents[2], cases(options.tiny)
    trees = [*([options.against.resolve()] if options.against else []), here]
    print(
        f"{'case':<12}{'command':<28}{'over the run':>14}{'MB':>8}"
        + ("   over the other version" if options.against else "")
    )
    for name in options.cases or known:
        found = []
        for _ in range(options.rounds):
            with tempfile.TemporaryDirectory() as folder:
                found.append([processor_times(known[name], tree, Path(folder, str(k))) for k, tree in enumerate(trees)])
        seconds = np.median([[[step[1] for step in tree] for tree in one] for one in found], axis=0)
        for k, (words, _, most) in enumerate(found[0][-1]):
            ratio = f"{seconds[-1, k] / seconds[0, k]:15.2f}" if options.against else ""
            print(f"{name:<12}{words[:27]:<28}{seconds[-1, k] / seconds[-1, 0]:14.2f}{most:8.0f}{ratio}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
