"""A basin decided early against one after a fixed transient: periods, time, labels.

Run it alone on a machine that does nothing else::

    python tests/bench/basins.py [--size 200]

A grid of ``size x size`` starts at rest, |psi1| and |psi2| up to 1 rad, at 2.2 Hz, is computed twice in
one process on one core, in bands of rows that alternate between the two ways so that both meet the same
machine: after a fixed transient, and with ``stop_when_closed`` and a loose closure tolerance. Attractors
are identified in both and the labels compared cell by cell: two cells agree if their orbits do, or if
both show a bounded set. The target is a third of the integration, with the same labels for 99.9 % of
the cells. At 200 x 200 this takes some ten minutes.

The last lines say what the fixed way would take with scipy's ``solve_ivp`` (RK45, the same tolerances,
the compiled text as its right-hand side), extrapolated from a few trajectories.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import solvers
import xarray as xr
from peers import text_of

from magpend_core import load_preset, sections
from magpend_core.models.model import Parameters
from pipeline.analysis.attractors.attractors import identify
from pipeline.layout.vocabulary import PERIODIC_ORBIT

FREQUENCY_HZ = 2.2
TOLERANCE = 1e-8
SAME = 1e-6
"""Largest difference between the first section points of orbits that count as one [rad, rad/s]."""

OWN_DIMS = {"section": ("period_index", "state"), "turns": ("link",), "status": (), "orbit_period": (), "n_periods": ()}


@dataclass
class Way:
    """One way of computing the basin, and what it took.

    Attributes
    ----------
    name : str
    options : dict
        Of `sections`.
    wall_s, cpu_s : float
        Integration.
    identify_s : float
        Wall time of the identification.
    """

    name: str
    options: dict[str, Any]
    wall_s: float = 0.0
    cpu_s: float = 0.0
    identify_s: float = 0.0

    def run(self, parameters: Parameters, starts: np.ndarray) -> Any:
        """Integrate some cells."""
        wall, cpu = time.perf_counter(), time.thread_time()
        result = sections(parameters, FREQUENCY_HZ, starts, rtol=TOLERANCE, atol=TOLERANCE, **self.options)
        self.wall_s += time.perf_counter() - wall
        self.cpu_s += time.thread_time() - cpu
        return result

    def identify(self, parameters: Parameters, cube: xr.Dataset) -> xr.Dataset:
        """Find the attractors."""
        started = time.perf_counter()
        found = identify(cube, parameters=parameters)
        self.identify_s += time.perf_counter() - started
        return found


def starts_of(size: int) -> np.ndarray:
    """Starts at rest, shape (size, size, 4)."""
    line = np.linspace(-1.0, 1.0, size)
    starts = np.zeros((size, size, 4))
    starts[..., :2] = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    return starts


def cube_of(parts: Sequence[Any], size: int, options: dict[str, Any]) -> xr.Dataset:
    """Cube of all bands."""
    data = {}
    for name, own in OWN_DIMS.items():
        values = np.concatenate([getattr(part, name) for part in parts])
        data[name] = (("psi1_0", "psi2_0", *own), values.reshape(size, size, *values.shape[1:]))
    model = load_preset().model
    coords = {"state": list(model.state_names), "link": list(model.angles), "frequency": FREQUENCY_HZ}
    tolerance = options.get("closure_tolerance", 1e-6)
    return xr.Dataset(data, coords, attrs={"closure_tolerance": tolerance})


def same_labels(a: xr.Dataset, b: xr.Dataset) -> np.ndarray:
    """Where both say the same: one orbit, or a bounded set, or nothing."""
    (kind, period, point), (other_kind, other_period, other_point) = (_labels(x) for x in (a, b))
    near = np.abs(point - other_point).max(axis=-1) <= SAME
    return (kind == other_kind) & ((kind != PERIODIC_ORBIT) | ((period == other_period) & near))


def _labels(found: xr.Dataset) -> tuple[np.ndarray, ...]:
    rows = found["attractor_id"].values
    kind = np.where(rows >= 0, found["kind"].values[rows], 0)
    return kind, found["orbit_period"].values[rows], found["attractor_points"].values[rows, 0]


def scipy_seconds(starts: np.ndarray, n_periods: int) -> float:
    """Seconds per drive period and trajectory of `solve_ivp` on a few of the starts."""
    text = text_of("pendulum")
    rhs = solvers.scalar_rhs(text, text.load().as_dict(), FREQUENCY_HZ)
    runner = solvers.scipy_runner(rhs, 1.0 / FREQUENCY_HZ, TOLERANCE, "RK45")
    runner(starts[:1], 1)  # compile
    started = time.perf_counter()
    runner(starts, n_periods)
    return (time.perf_counter() - started) / (n_periods * len(starts))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=200, help="cells along each axis")
    parser.add_argument("--transient", type=int, default=800, help="fixed transient, and longest early one")
    parser.add_argument("--closure-tolerance", type=float, default=2e-2, help="of the early way")
    parser.add_argument("--bands", type=int, default=20, help="bands of rows that alternate")
    parser.add_argument("--scipy-trajectories", type=int, default=8)
    parser.add_argument("--scipy-periods", type=int, default=40)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    options = parse(arguments)
    parameters, starts = load_preset(), starts_of(options.size)
    # the slow spirals of period 7 are told from 32 sections, what has closed from fewer
    fixed = Way("fixed transient", {"n_transient": options.transient, "n_keep": 32})
    loose = {"stop_when_closed": True, "closure_tolerance": options.closure_tolerance}
    early = Way("stopped early", {"n_transient": options.transient, "n_keep": 16, **loose})
    for way in (fixed, early):  # compile
        Way("", {**way.options, "n_transient": 64}).run(parameters, starts[0, :1])
    parts: dict[str, list[Any]] = {fixed.name: [], early.name: []}
    for i, band in enumerate(np.array_split(starts, min(options.bands, options.size))):
        for way in (fixed, early) if i % 2 else (early, fixed):
            parts[way.name].append(way.run(parameters, band.reshape(-1, 4)))
    found, periods = {}, {}
    for way in (fixed, early):
        cube = cube_of(parts[way.name], options.size, way.options)
        periods[way.name] = float(cube["n_periods"].mean())
        found[way.name] = way.identify(parameters, cube)
    _report(fixed, early, found, periods, options.size**2)
    pick = np.random.default_rng(1).choice(options.size**2, min(options.scipy_trajectories, options.size**2))
    each = scipy_seconds(starts.reshape(-1, 4)[np.sort(pick)], options.scipy_periods)
    work = options.size**2 * periods[fixed.name]
    print(f"scipy solve_ivp RK45: {1e6 * each:.0f} us per period and trajectory")
    print(f"the fixed way with it: {each * work / 3600:.1f} h, {each * work / fixed.wall_s:.0f} times as long")


def _report(fixed: Way, early: Way, found: dict[str, xr.Dataset], periods: dict[str, float], n_cells: int) -> None:
    print(f"{n_cells} cells at {FREQUENCY_HZ} Hz")
    print(f"{'':16s} {'periods':>9s} {'wall s':>8s} {'cpu s':>8s} {'identify s':>10s} {'cells/s':>8s}")
    for way in (fixed, early):
        rate = n_cells / (way.wall_s + way.identify_s)
        numbers = f"{way.wall_s:8.1f} {way.cpu_s:8.1f} {way.identify_s:10.1f} {rate:8.1f}"
        print(f"{way.name:16s} {periods[way.name]:9.1f} {numbers}")
    whole = (early.wall_s + early.identify_s) / (fixed.wall_s + fixed.identify_s)
    print(
        f"ratio: periods {periods[early.name] / periods[fixed.name]:.3f}, "
        f"integration wall {early.wall_s / fixed.wall_s:.3f}, cpu {early.cpu_s / fixed.cpu_s:.3f}, "
        f"with identification {whole:.3f}"
    )
    same = same_labels(found[fixed.name], found[early.name])
    kind, _, _ = _labels(found[fixed.name])
    on_orbit = same[kind == PERIODIC_ORBIT]
    share = f"{100 * on_orbit.mean():.3f} %" if len(on_orbit) else "none"
    print(
        f"same labels: {100 * same.mean():.3f} % of all cells, "
        f"{share} of the {len(on_orbit)} that the fixed way sees on an orbit"
    )
    for way in (fixed, early):
        one = found[way.name]
        counts = zip(one["orbit_period"].values, one["n_cells"].values, strict=True)
        words = [f"{p or 'bounded'}: {n}" for p, n in counts]
        print(f"{way.name}, cells by period: {', '.join(words)}")


if __name__ == "__main__":
    main()
