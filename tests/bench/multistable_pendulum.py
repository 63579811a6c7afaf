"""Basin fractions of a pendulum with constant torque, as other programs publish their times for it.

    python tests/bench/multistable_pendulum.py

prints what 1e5 random starts of ::

    th'' = -0.1 th' + torque - sin(th),   torque = 0.5

over 1000 time units at rtol 1e-8 and atol 1e-6 take from drawing the starts to fractions of rest and
rotation with their intervals: every start to the end, and the same with each start given up as soon
as its outcome is certain. It is the first case of bSTAB (Stender and Hoffmann, Nonlinear Dyn. 107,
1451, 2022), with starts in [asin(0.5) - pi, asin(0.5) + pi] x [-10, 10].

The lane engine integrates the system as it does any other: nothing here is magpend's pendulum. It is
autonomous, so that its "drive period" is a matter of choice: the time between two looks at the state.

When is an outcome certain? `Regions` has two sets that no trajectory leaves, and that every
trajectory enters which does not lie on the boundary between the basins.

* Rest: inside the well below the energy of the saddle. Energy never increases.
* Rotation: above the upper branch of the saddle's unstable manifold, if that comes round to the next
  saddle with positive speed. Trajectories do not cross, so what is above it stays above; and there is
  one periodic motion to go to, because over a turn the speed of any has the integral 2 pi
  torque/damping, which two that do not cross cannot share.

Two threads share the work; the kernels hold no lock. Times are wall-clock times, with the CPU time of
all threads beside them: where other work runs on the machine, half of the latter is the better guide.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from magpend_core import run_branches
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI, sin
from magpend_core.sections import Sections
from magpend_core.status import Status
from pipeline.analysis.basins.numbers import basin_fractions

GOAL = 12.0  # s, on two cores

PUBLISHED = {"Julia, 24 threads, integration only": 12.4, "pyBasin": 63.0, "pynamicalsys": 116.0, "bSTAB": 309.0}
"""Seconds that others report for the same starts, on laptops with 24 cores."""

UNDECIDED, REST, ROTATION = -1, 0, 1
NAMES = {REST: "rest", ROTATION: "rotation", UNDECIDED: "undecided"}

DAMPING, TORQUE = 0.1, 0.5
RTOL, ATOL = 1e-8, 1e-6
SPEED = 10.0
"""Largest initial speed."""

CHUNK = 4096
"""Starts per call of the engine: enough to keep its lanes full, few enough to share among threads."""

CLOSURE = 1e-3
"""Distance between sections at which a start counts as at rest; the tolerance leaves 1e-6 or so."""

SECTION_TIME = 100.0
"""Time between sections of starts that run to the end: few sections, no time lost at them."""

LOOK_TIME = 10.0
"""Time between looks at starts that are given up early."""

MARGIN = 1e-6
"""Distance from the unstable manifold, in speed, that counts as above it."""


@inline
def _constants(frequency, p, out):
    out[0] = p[0]
    out[1] = p[1]


@inline
def _no_forcing(t, c):
    return 0.0 * t


@inline
def _rhs(y, u, c):
    return y[1], c[1] - c[0] * y[1] - sin(y[0])


@inline
def _no_edges(frequency, p, times, half_widths, jumps):
    return


@inline
def _no_layers(y, dy, c):
    return ()


@inline
def _jacobian(y, u, c):
    zero = 0.0 * y[0]
    return zero, zero + 1.0, -sin(y[0] + 0.25 * TWO_PI), zero - c[0]


PENDULUM = System(
    name="pendulum_with_torque",
    state_names=("th", "th_dot"),
    is_angle=(True, False),
    scales=(1.0, 1.0),
    parameter_names=("damping", "torque"),
    n_constants=2,
    constants=_constants,
    forcing=_no_forcing,
    rhs=_rhs,
    n_edges=0,
    edges=_no_edges,
    layers=_no_layers,
    jacobian=_jacobian,
    escape=(1e6, 1e3),
    has_layers=False,
)


def draw_starts(n: int, seed: int) -> np.ndarray:
    """Seeded starts (n, 2) in the box of the published case."""
    rest = np.arcsin(TORQUE)
    return np.random.default_rng(seed).uniform((rest - np.pi, -SPEED), (rest + np.pi, SPEED), (n, 2))


def integrate(
    starts: np.ndarray,
    torque: np.ndarray | float,
    *,
    n_sections: int,
    section_time: float,
    n_keep: int,
    threads: int,
    step_size: np.ndarray | None = None,
) -> Sections:
    """Sections of all starts, dims (start, 1, ...), by as many threads as asked for."""
    n = len(starts)
    packed = np.empty((n, 1, 2))
    packed[..., 0], packed[:, 0, 1] = DAMPING, torque
    frequency = np.full((n, 1), 1.0 / section_time)

    def run(first: int) -> Sections:
        rows = slice(first, first + CHUNK)
        return run_branches(
            packed[rows],
            frequency[rows],
            starts[rows],
            n_transient=n_sections - n_keep,
            n_keep=n_keep,
            rtol=RTOL,
            atol=ATOL,
            closure_tolerance=CLOSURE,
            max_orbit_period=1,
            system=PENDULUM,
            step_size=None if step_size is None else step_size[rows],
        )

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(run, range(0, n, CHUNK)))
    known = [k for k, value in vars(parts[0]).items() if value is not None]
    return Sections(**{k: np.concatenate([getattr(p, k) for p in parts]) for k in known})


def classify(sections: Sections) -> np.ndarray:
    """Rotation if the angle makes full turns between the last two sections, rest if they coincide."""
    label = np.full(len(sections.status), UNDECIDED)
    label[sections.status[:, 0] == Status.PERIODIC] = REST
    label[sections.turns[:, 0, 0] != 0] = ROTATION
    return label


@dataclass(frozen=True)
class Regions:
    """Two sets that are never left (see the text of this module).

    Attributes
    ----------
    saddle : float
        Angle of the saddle, the right end of the well.
    torque : float
    manifold : CubicSpline or None
        Speed on the unstable manifold over the angle from one saddle to the next; None if it does not
        come round.
    """

    saddle: float
    torque: float
    manifold: CubicSpline | None

    @classmethod
    def of(cls, torque: float) -> Regions:
        """Regions for a torque between 0 and 1."""
        saddle = np.pi - np.arcsin(torque)
        growth = -0.5 * DAMPING + np.sqrt(0.25 * DAMPING**2 - np.cos(saddle))
        step = 1e-6
        start = (saddle - TWO_PI + step, growth * step)

        def rates(t: float, y: np.ndarray) -> tuple[float, float]:
            return y[1], torque - DAMPING * y[1] - np.sin(y[0])

        def comes_round(t: float, y: np.ndarray) -> float:
            return float(y[0] - saddle)

        def turns_back(t: float, y: np.ndarray) -> float:
            return float(y[1])

        comes_round.terminal = turns_back.terminal = True  # type: ignore[attr-defined]
        found = solve_ivp(
            rates,
            (0.0, 1e3),
            start,
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
            max_step=0.02,
            events=(comes_round, turns_back),
        )
        round_it = len(found.t_events[0]) and found.y[1, -1] > MARGIN
        return cls(saddle, torque, CubicSpline(found.y[0], found.y[1]) if round_it else None)

    def certain(self, states: np.ndarray) -> np.ndarray:
        """Outcome of each state (n, 2) that is certain, else ``UNDECIDED``."""
        angle = self.saddle - np.mod(self.saddle - states[:, 0], TWO_PI)
        speed = states[:, 1]
        label = np.full(len(states), UNDECIDED)
        energy = 0.5 * speed * speed - np.cos(angle) - self.torque * angle
        label[energy < -np.cos(self.saddle) - self.torque * self.saddle] = REST
        if self.manifold is not None:
            label[speed > self.manifold(angle) + MARGIN] = ROTATION
        return label


def run_to_the_end(starts: np.ndarray, duration: float, threads: int) -> tuple[np.ndarray, int]:
    """Labels of all starts after `duration`, and attempted steps."""
    n_sections = round(duration / SECTION_TIME)
    found = integrate(starts, TORQUE, n_sections=n_sections, section_time=SECTION_TIME, n_keep=2, threads=threads)
    return classify(found), int(found.n_steps.sum() + found.n_rejected.sum())


def run_until_certain(starts: np.ndarray, duration: float, threads: int) -> tuple[np.ndarray, int]:
    """Labels of all starts, each integrated until it is certain, and attempted steps."""
    regions = Regions.of(TORQUE)
    label = regions.certain(starts)
    rest, attempts = np.flatnonzero(label == UNDECIDED), 0
    states, step = starts[rest], None
    for _ in range(round(duration / LOOK_TIME)):
        if not len(rest):
            break
        found = integrate(
            states, TORQUE, n_sections=1, section_time=LOOK_TIME, n_keep=1, threads=threads, step_size=step
        )
        attempts += int(found.n_steps.sum() + found.n_rejected.sum())
        label[rest] = regions.certain(found.final_state[:, 0])
        going = label[rest] == UNDECIDED
        rest, states, step = rest[going], found.final_state[going, 0], found.step_size[going, 0]
    return label, attempts


VARIANTS = {"to the end": run_to_the_end, "until certain": run_until_certain}


@dataclass(frozen=True)
class Outcome:
    """What a variant found, and what it took: wall-clock and CPU time, and that of its parts [s]."""

    label: np.ndarray
    fractions: xr.Dataset
    attempts: int
    seconds: float
    cpu_seconds: float
    parts: dict[str, float]


def whole(variant: str, n: int, duration: float, threads: int, seed: int) -> Outcome:
    """Draw, integrate and classify, and take the fractions."""
    cpu, times = time.process_time(), [time.perf_counter()]
    starts = draw_starts(n, seed)
    times.append(time.perf_counter())
    label, attempts = VARIANTS[variant](starts, duration, threads)
    times.append(time.perf_counter())
    fractions = basin_fractions(label, ids=(REST, ROTATION), method="clopper-pearson")
    times.append(time.perf_counter())
    names = ("drawing", "integration and classes", "fractions")
    parts = dict(zip(names, np.diff(times).tolist(), strict=True))
    return Outcome(label, fractions, attempts, times[-1] - times[0], time.process_time() - cpu, parts)


def print_outcome(variant: str, one: Outcome) -> None:
    parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in one.parts.items())
    print(
        f"\n{variant}: {one.seconds:.2f} s, CPU {one.cpu_seconds:.2f} s "
        f"({parts}; {one.attempts / len(one.label):.0f} attempts each)"
    )
    for code in (REST, ROTATION):
        row = one.fractions.sel(label=code)
        print(f"  {NAMES[code]:10s} {row.fraction:.4f}  [{row.low:.4f}, {row.high:.4f}]")
    print(f"  {NAMES[UNDECIDED]:10s} {int(one.fractions.n_unfinished)} starts")


def main(argv: Sequence[str] | None = None) -> None:
    """Print the times, the fractions and the published times."""
    parser = argparse.ArgumentParser(description="Basin fractions of a pendulum with constant torque.")
    parser.add_argument("--starts", type=int, default=100_000)
    parser.add_argument("--duration", type=float, default=1000.0, help="time units")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3, help="the best counts")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(argv)
    cpu, begin = time.process_time(), time.perf_counter()
    integrate(draw_starts(1, 0), TORQUE, n_sections=1, section_time=1.0, n_keep=1, threads=1)
    compiling, cpu = time.perf_counter() - begin, time.process_time() - cpu
    print(
        f"{options.starts} starts, {options.duration:g} time units, rtol {RTOL:g}, atol {ATOL:g}, "
        f"{options.threads} threads on {os.cpu_count()} cores; compiling, once a process: "
        f"{compiling:.1f} s, CPU {cpu:.1f} s"
    )
    labels = {}
    for variant in VARIANTS:
        rounds = [
            whole(variant, options.starts, options.duration, options.threads, options.seed)
            for _ in range(options.rounds)
        ]
        best = min(rounds, key=lambda one: one.seconds)
        print_outcome(variant, best)
        print(f"  with compiling {compiling + best.seconds:.1f} s; goal without: {GOAL:g} s")
        labels[variant] = best.label
    first, second = labels.values()
    print(f"\nstarts with other labels in the two: {np.count_nonzero(first != second)}")
    print("published: " + ", ".join(f"{name} {seconds:g} s" for name, seconds in PUBLISHED.items()))


if __name__ == "__main__":
    main()
