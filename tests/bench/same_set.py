"""How often are two cells on one chaotic set taken for two sets, or two sets for one?

    python tests/bench/same_set.py [--cells 24]

prints the rate of errors of `clouds.mixing`, which decides this, for systems with one chaotic attractor
each: as many sections as a run keeps (20, 60, 300), and as many as a cell has at least after its extension.
Pairs that must be one set are cells of the system. Pairs that must be two are such cells, one of them shifted
along the first state that varies, until a gap of 2 % of the set's extent is between them. `groups` is the
number of sets that all cells together make; right is 1. Sets that are interwoven more finely than their
points are one in any case.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core import Crossing, load_model, sections
from pipeline.analysis.attractors.extension.clouds import OTHER, group, mixing
from pipeline.analysis.attractors.finding.requests import Effort
from pipeline.results.sets import Geometry

UEDA = {
    "name": "ueda",
    "states": {"x": {}, "v": {}},
    "parameters": {"k": 0.05, "B": 7.5},
    "equations": {"x": "v", "v": "-k*v - x**3 + B*cos(2*pi*f*t)"},
}
"""Ueda, J. Stat. Phys. 20, 181 (1979)."""

KEPT = (20, 60, 300, Effort.least_stay)
GAP = 0.02
"""Distance of two sets in units of their extent."""


@dataclass(frozen=True)
class Case:
    """A system with one chaotic attractor: parameters, the drive's frequency or a section, starts."""

    model: Any
    changes: dict[str, float]
    frequency_hz: float | None
    section: Crossing | None
    spread: float


CASES = {
    "Ueda": Case(UEDA, {}, 0.5 / np.pi, None, 1.0),
    "Roessler": Case("rossler", {}, None, Crossing("y", 0.0, "up"), 1.0),
    "Lorenz": Case("lorenz", {}, None, Crossing("z", 27.0, "down"), 5.0),
    "driven pendulum": Case("driven-pendulum", {"d": 0.5, "A": 1.5}, 1.0 / (3.0 * np.pi), None, 1.0),
    "double pendulum": Case("pendulum", {}, 2.4, None, 0.3),
}


@dataclass(frozen=True)
class Rates:
    """Errors for one system and number of sections."""

    split: float
    merged: float
    groups: int


def cells_of(case: Case, n: int) -> tuple[np.ndarray, Geometry]:
    """Sections (cell, section, state) on the attractor of a case, of cells that get there."""
    model = load_model(case.model)
    parameters = model.load(**case.changes)
    starts = 0.1 + case.spread * np.random.default_rng(1).uniform(-1.0, 1.0, (n, len(model.states)))
    found = sections(
        parameters, case.frequency_hz, starts, n_transient=500, n_keep=Effort.least_stay, section=case.section
    )
    return found.section[found.status == 2], Geometry(model.is_angle, model.scales)


def rates_of(cells: np.ndarray, geometry: Geometry) -> Iterator[Rates]:
    """Rates of errors for each number of sections."""
    extent = np.ptp(cells.reshape(-1, cells.shape[-1]), axis=0)
    shift = np.zeros_like(extent)
    first = int(np.argmax((extent > 0.0) & ~np.asarray(geometry.is_angle)))
    shift[first] = (1.0 + GAP) * extent[first]
    pairs = list(itertools.combinations(range(len(cells)), 2))
    for n in KEPT:
        own = cells[:, :n]
        same = [mixing(own[a], own[b], geometry) for a, b in pairs]
        two = [mixing(own[a], own[b] + shift, geometry) for a, b in pairs]
        groups = int(group(list(own), geometry)[0].max()) + 1
        yield Rates(float(np.mean(np.less(same, OTHER))), float(np.mean(np.greater_equal(two, OTHER))), groups)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=24, help="cells of each system")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    given = parser.parse_args(arguments)
    print(f"{'system':16} {'sections':>8} {'one as two':>11} {'two as one':>11} {'groups':>7}")
    for name in given.cases:
        cells, geometry = cells_of(CASES[name], given.cells)
        for n, rates in zip(KEPT, rates_of(cells, geometry), strict=True):
            print(f"{name:16} {n:8} {100 * rates.split:9.2f} % {100 * rates.merged:9.2f} % {rates.groups:7}")


if __name__ == "__main__":
    main(sys.argv[1:])
