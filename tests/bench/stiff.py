"""The race on stiff equations: problems of `tests.core.stiff`, from starts that differ by some per cent."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import implicit
import numpy as np
import solvers
from racing import HEAD, Contestant, Curve, Runner, decades, lanes, race, ratios

from magpend_core import pointwise

sys.path.append(str(Path(__file__).parents[2]))  # tests are no package

from tests.core.stiff import PROBLEMS, Stiff

METHOD, EXPLICIT = "rodas5p", "dop853"
N_ERROR, N_SLOW = 8, 2
PEERS = ("numbalsoda", "sksundae", "diffrax", "scipy")
SPREAD = {
    "hires": (0.1, 0, 0, 0, 0, 0, 0, 0.02),
    "rober": (0.1, 0, 0),
    "orego": (0.05, 0.05, 0.05),
    "hodgkin-huxley": (5.0, 0.02, 0.05, 0.02),
    "van der pol": (0.1, 0),
}
"""Starts are drawn from a box of these halves of sides around the problem's own."""

HARDLY_STIFF = ("hodgkin-huxley",)
"""Problems on which the explicit method races, too."""


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """Trajectories of a problem, states in units of their sizes for the peers."""

    problem: Stiff
    spread: tuple[float, ...]

    def starts(self, n: int) -> np.ndarray:
        """Return initial states (n, n_states), the problem's own first."""
        start, half = np.array(self.problem.start), np.array(self.spread)
        drawn = np.random.default_rng(1).uniform(start - half, start + half, (n, len(start)))
        drawn[0] = start
        return drawn

    def equations(self, sizes: Sequence[float] = ()) -> tuple[Any, ...]:
        """Return the arguments of `solvers.rhs_source`."""
        model = self.problem.model
        return model, model.load().as_dict(), 1.0 / self.problem.time, sizes

    def engine(self, name: str, method: str, n: int, counts: dict[str, str]) -> Contestant:
        """Enter the engine with a method; `counts` takes the steps of each setting."""
        model, frequency = self.problem.model, 1.0 / self.problem.time
        system = dataclasses.replace(model.system, method=method)

        def counting(setting: str) -> Callable[[Any], None]:
            def count(found: Any) -> None:
                accepted, rejected = found.n_steps, found.n_rejected
                counts[setting] = f"{np.mean(accepted):.0f} + {np.mean(rejected):.1f} (most {np.max(accepted)})"

            return count

        tolerances = {f"{t:.0e}": t for t in decades(2, 11, 2)}
        packed = model.load().pack()
        settings = {word: lanes(system, packed, frequency, t, counting(word)) for word, t in tolerances.items()}
        return Contestant(name, settings, n, 1)

    def peers(self, names: Sequence[str]) -> Iterator[Contestant]:
        """Enter the peers that were asked for."""
        sizes, stop = self.problem.sizes, self.problem.time
        source, rhs = (make(*self.equations(sizes)) for make in (solvers.rhs_source, solvers.scalar_rhs))
        n, jacobian = len(sizes), implicit.jacobian_of(source, len(sizes))

        def entry(name: str, with_tolerance: Callable[[float], Runner], last: int, n_most: int) -> Contestant:
            settings = {f"{t:.0e}": self.unscaled(with_tolerance(t)) for t in decades(3, last, 1)}
            return Contestant(name, settings, n_most, 1)

        if "numbalsoda" in names:
            yield entry("numbalsoda LSODA", solvers.numbalsoda_loop(rhs, n, stop, "lsoda"), 11, 16)
        if "sksundae" in names:
            yield entry("CVODE", implicit.cvode_loop(rhs, jacobian, n, stop), 11, 16)
        if "diffrax" in names:
            yield entry("diffrax Kvaerno5", implicit.diffrax_batch(source, stop), 9, 8)
        if "scipy" in names:
            for method, last in (("LSODA", 10), ("Radau", 8)):
                yield entry(f"scipy {method}", implicit.scipy_loop(rhs, jacobian, stop, method), last, N_SLOW)

    def unscaled(self, runner: Runner) -> Runner:
        """Return a runner of states from one of states in units of their sizes."""
        sizes = np.array(self.problem.sizes)
        return lambda initial, n_periods: runner(initial / sizes, n_periods) * sizes

    def error_by(self) -> Callable[[Runner], float]:
        """Return a function from a runner to its median error at the end, against scipy's Radau at 1e-10.

        Errors of a state are relative, or in units of its size where it is smaller.
        """
        initial, sizes, stop = self.starts(N_ERROR), np.array(self.problem.sizes), self.problem.time
        rhs, source = (make(*self.equations(sizes.tolist())) for make in (solvers.scalar_rhs, solvers.rhs_source))
        jacobian = implicit.jacobian_of(source, len(sizes))
        reference = self.unscaled(implicit.scipy_loop(rhs, jacobian, stop, "Radau")(1e-10))(initial, 1)
        unit = np.maximum(np.abs(reference), sizes)
        print(
            f"  reference and published end differ by {np.max(np.abs(reference[0] - self.problem.end) / unit[0]):.0e}"
        )

        def error_of(runner: Runner) -> float:
            return float(np.median(np.max(np.abs(runner(initial, 1) - reference) / unit, axis=1)))

        return error_of

    def check_equations(self) -> None:
        """Raise unless the peers' rates are magpend's."""
        states, rhs = self.starts(64), solvers.scalar_rhs(*self.equations())
        ours = pointwise.rates(0.1, states, self.problem.model.load(), 1.0 / self.problem.time)
        theirs = np.array([rhs(0.1, *y) for y in states.tolist()])
        np.testing.assert_allclose(theirs, ours, rtol=1e-10, atol=1e-10 * np.abs(ours).max())


def compare(name: str, peers: Sequence[str], n: int, rounds: int) -> list[Curve]:
    """Race on a problem, and print its table: CPU time of the process per trajectory, from its start to its end."""
    print(f"\n{name}:")
    ensemble, counts = Ensemble(PROBLEMS[name], SPREAD[name]), {}
    ensemble.check_equations()
    entries = [ensemble.engine("magpend", METHOD, n, counts), *ensemble.peers(peers)]
    if name in HARDLY_STIFF:
        entries.insert(1, ensemble.engine(f"magpend {EXPLICIT}", EXPLICIT, n, {}))
    # threads of jax count too
    curves = race(entries, ensemble.starts(n), ensemble.error_by(), rounds, time.process_time)
    print(HEAD, *ratios(curves), sep="\n")
    own = curves[0]
    for setting, error, cost in zip(own.setting, own.error, own.cost, strict=True):
        print(
            f"    {METHOD} {setting}: error {error:.1e}, {cost:.1f} us, steps + rejected {counts[setting]}", flush=True
        )
    return curves
