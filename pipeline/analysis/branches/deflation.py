"""Search for all periodic orbits of some periods at a parameter point, by deflated Newton iterations from many starts.

Newton's method from many starts finds the same orbits again and again. After the first round the map's mismatch is
multiplied by ``1 + 1/|x - x_k|^2`` for every known section point x_k, so that iterations are driven away from known
orbits and find others (Farrell, Birkisson and Funke, SIAM J. Sci. Comput. 37, 2015, A2026). Each round starts
elsewhere.
The factor does not need to be computed: the deflated Newton step is the plain one times a number.

Two figures tell how complete the result is. ``coverage`` estimates the share of all starts that end on a known orbit,
from the orbits that the first round met only once (Good, Biometrika 40, 1953, 237). The index of an orbit is the
sign of det(1 - M); over all fixed points of the p-fold map the indices add up to the Euler characteristic of the
state space, 1, or 0 if a state is an angle, provided that all trajectories stay bounded (Lefschetz).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import polish_orbits, scaled_distance, section_map, wrap_angles
from magpend_core.pointwise import rates_at
from pipeline.products.reporting import report
from pipeline.results.tolerances import BRANCH_RTOL, SAME_EQUILIBRIUM, SAME_ON_BRANCH


@dataclass(frozen=True)
class DeflationSettings:
    """Numbers of the search for orbits by deflated Newton iterations."""

    rounds: int = 6  # most rounds of deflated iterations; the search ends earlier with a round that finds nothing
    # standard deviation by which starts move from round to round, as a share of that of all starts; more looks further
    # away, and loses more iterations
    elsewhere: float = 0.3
    # Newton steps of one iteration; more reach more orbits, and cost as much on starts that reach none
    iterations: int = 30
    # longest step [scaled], and in units of the distance from the middle of the starts, where this is more; a longer
    # one is shortened to this
    longest_step: float = 0.5
    close: float = 1e-9  # scaled residual at which an iteration ends; the orbits found are polished further
    rtol: float = BRANCH_RTOL  # of the integrations up to there


@dataclass(frozen=True, eq=False)
class FoundOrbit:
    """A periodic orbit found by the search: its section points, its monodromy matrix and the number of starts that led
    to it.
    """

    points: np.ndarray  # (period, n_states): section points in the order of time
    monodromy: np.ndarray  # (n_states, n_states): derivative of the section map over the period
    n_hits: int  # starts of the first round, in which nothing is deflated, that led to it
    search_round: int  # round in which it was found, from 0
    seconds: float = float("nan")  # period [s]
    is_rest: bool = False  # whether it is an equilibrium on the section, which the return map maps to itself

    @property
    def period(self) -> int:
        """Least period [drive periods or returns]."""
        return len(self.points)

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers by falling modulus."""
        found = np.linalg.eigvals(self.monodromy)
        return found[np.argsort(-np.abs(found), kind="stable")]

    def index(self, times: int = 1) -> int:
        """Return the fixed-point index of the orbit run through `times` times: the sign of det(1 - M^times)."""
        power = np.linalg.matrix_power(self.monodromy, times)
        return int(np.sign(np.linalg.det(np.eye(len(power)) - power)))


def search_orbits(
    starts: np.ndarray,
    periods: np.ndarray,
    frequency_hz: float,
    packed: np.ndarray,
    system: System,
    *,
    what: str = "searching orbits",
    settings: DeflationSettings = DeflationSettings(),
) -> list[FoundOrbit]:
    """Find the periodic orbits near many starts by plain and then by deflated Newton iterations, each orbit once.

    Parameters
    ----------
    starts
        Section points to start from, shape (n, n_states) [the model's units].
    periods
        Period that is looked for from each start, shape (n,) [drive periods or returns].
    frequency_hz
        Drive frequency [Hz].
    packed
        Packed parameters.
    system
        System of equations to integrate.
    what
        Name of the work in progress reports.
    settings
        Numbers to choose.

    Returns
    -------
    list of FoundOrbit
        Orbits found, sorted by rising period, then by falling number of hits. Equilibria on the section are not among
        them; the search deflates them, too.
    """
    found: list[FoundOrbit] = []
    generator, spread = np.random.default_rng(0), settings.elsewhere * starts.std(axis=0)
    rounds = settings.rounds
    for number in range(1 + rounds):
        report(what, number, 1 + rounds)
        moved = starts + spread * generator.standard_normal(starts.shape) if number else starts
        ends = _iterate(moved, periods, frequency_hz, packed, system, found, settings)
        n_before = len(found)
        add_orbits(found, *ends, number, frequency_hz, packed, system)
        if len(found) == n_before:
            break
    return sorted((one for one in found if not one.is_rest), key=lambda one: (one.period, -one.n_hits))


def orbit_near(
    state: np.ndarray, period: int, frequency_hz: float, packed: np.ndarray, system: System
) -> FoundOrbit | None:
    """Return the orbit that Newton's method finds from a state, of a period or a part of it; None if it finds none."""
    found = search_orbits(
        state[None], np.array([period]), frequency_hz, packed, system, settings=DeflationSettings(rounds=0)
    )
    return found[0] if found else None


def starts_around(
    section: np.ndarray, n: int, seed: int, system: System, reach: np.ndarray | None = None
) -> np.ndarray:
    """Return states from which a search starts: half of them section points that were seen, half random in boxes of
    all sizes around them.

    Parameters
    ----------
    section
        Section points that were seen, shape (any, n_states).
    n
        Number of starts.
    seed
        Seed of the random numbers.
    system
        System of equations.
    reach
        Further states that the box spans, of the same shape.
    """
    # sides of the least and the largest box, in units of that which the states seen span: orbits that no cell meets may
    # be far from those that are seen
    least, largest = 1.5, 10.0
    generator = np.random.default_rng(seed)
    if not len(section):
        section = np.zeros((1, system.n_states)) + np.asarray(system.scales) * [[-1.0], [1.0]]
    spanned = section if reach is None else np.concatenate([section, reach])
    low, high = spanned.min(axis=0), spanned.max(axis=0)
    middle, half = (low + high) / 2.0, np.maximum(high - low, np.asarray(system.scales)) / 2.0
    n_drawn = n // 2
    drawn = section[generator.integers(len(section), size=n_drawn)]
    sides = np.geomspace(least, largest, n - n_drawn)[:, None] * half
    middle, sides = np.where(system.is_angle, 0.0, middle), np.where(system.is_angle, np.pi, sides)
    return np.concatenate([drawn, middle + sides * generator.uniform(-1.0, 1.0, sides.shape)])


def _iterate(
    starts: np.ndarray,
    periods: np.ndarray,
    frequency_hz: float,
    packed: np.ndarray,
    system: System,
    known: Sequence[FoundOrbit],
    settings: DeflationSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Iterate Newton's method from all starts. Return the section points to which it converged, and their periods."""
    state, scales, middle = starts.astype(np.float64), np.asarray(system.scales), np.median(starts, axis=0)
    rows, done = np.arange(len(state)), []
    for _ in range(settings.iterations):
        ends = section_map(
            np.tile(packed, (len(rows), 1)),
            np.full(len(rows), frequency_hz),
            state[rows],
            periods[rows],
            rtol=settings.rtol,
            system=system,
        )
        image = ends.images[np.arange(len(rows)), periods[rows] - 1]
        mismatch = wrap_angles(image - state[rows], system) / scales
        is_finite = np.isfinite(mismatch).all(axis=1) & np.isfinite(ends.derivatives).all(axis=(1, 2))
        has_converged = is_finite & (np.abs(mismatch).max(axis=1) < settings.close)
        done.append(rows[has_converged])
        going = is_finite & ~has_converged
        rows = rows[going]
        if not len(rows):
            break
        matrices = ends.derivatives[going] * scales / scales[:, None] - np.eye(len(scales))
        steps = _newton(matrices, mismatch[going])
        steps *= stretch(state[rows], periods[rows], steps, known, system)[:, None]
        away = wrap_angles(state[rows] - middle, system) / scales
        allowed = settings.longest_step * np.maximum(1.0, np.abs(away).max(axis=1, keepdims=True))
        longest = np.abs(steps).max(axis=1, keepdims=True)
        steps *= np.minimum(1.0, allowed / np.maximum(longest, allowed * 1e-9))
        state[rows] = wrap_angles(state[rows] + steps * scales, system)
    ended = np.concatenate(done)
    return state[ended], periods[ended]


def _newton(matrices: np.ndarray, mismatch: np.ndarray) -> np.ndarray:
    return np.array([np.linalg.lstsq(a, -b, rcond=None)[0] for a, b in zip(matrices, mismatch, strict=True)])


def stretch(
    states: np.ndarray, periods: np.ndarray, steps: np.ndarray, known: Sequence[FoundOrbit], system: System
) -> np.ndarray:
    """Return the factor by which deflation stretches each Newton step, to keep it away from the orbits that are
    known.
    """
    scales, along = np.asarray(system.scales), np.zeros(len(states))
    for one in known:
        own = np.flatnonzero(periods % one.period == 0)
        for point in one.points:
            away = wrap_angles(states[own] - point, system) / scales
            square = np.maximum((away**2).sum(axis=1), 1e-16)
            along[own] -= 2.0 * (away * steps[own]).sum(axis=1) / (square * (1.0 + square))
    nearly = np.abs(1.0 - along) < 1e-3  # the step is without bound there
    return np.asarray(1.0 / np.where(nearly, 1e-3, 1.0 - along))


def add_orbits(
    found: list[FoundOrbit],
    states: np.ndarray,
    periods: np.ndarray,
    number: int,
    frequency_hz: float,
    packed: np.ndarray,
    system: System,
) -> None:
    """Refine section points close to orbits, and add new orbits to `found`, and equilibria on the section as such.
    Count how often each was hit in the first round, which has the number 0.
    """
    if not len(states):
        return
    n = len(states)
    polished = polish_orbits(np.tile(packed, (n, 1)), np.full(n, frequency_hz), states, periods, system=system)
    for row in np.flatnonzero(polished.converged):
        points = polished.points[row, : polished.orbit_period[row]]
        place = place_of(found, points, system)
        if place < 0:
            seconds = float(polished.seconds[row])
            is_rest = stays(points, seconds, packed, system)
            found.append(FoundOrbit(points, polished.derivative[row], int(number == 0), number, seconds, is_rest))
        elif number == 0:
            found[place] = replace(found[place], n_hits=found[place].n_hits + 1)


def stays(points: np.ndarray, seconds: float, packed: np.ndarray, system: System) -> bool:
    """Return whether a root of a flow's return map is an equilibrium: its rates vanish, or it returns in no time.

    Spirals about an equilibrium on the section cross it for ever, so that the return map has a root there. At the rates
    of its section points a trajectory gets no further than `SAME_EQUILIBRIUM` in the time of all returns.
    """
    if system.section is None:
        return False
    way = seconds * np.abs(rates_at(system, points, packed)) / np.asarray(system.scales)
    return bool(way.max() < SAME_EQUILIBRIUM)


def place_of(found: Sequence[FoundOrbit], points: np.ndarray, system: System) -> int:
    """Return the index of an orbit, given by its section points, among those that are known; -1 if it is not."""
    for k, one in enumerate(found):
        if one.period == len(points) and scaled_distance(one.points, points[0], system).min() < SAME_ON_BRANCH:
            return k
    return -1


# ---- completeness ------------------------------------------------------------------------------


def coverage(found: Sequence[FoundOrbit]) -> float:
    """Estimate the probability that one more random start leads to an orbit that is already known; NaN if none is
    known.
    """
    hits = np.array([one.n_hits for one in found])
    return float(1.0 - (hits == 1).sum() / hits.sum()) if hits.sum() else float("nan")


def index_sums(found: Sequence[FoundOrbit], longest: int) -> dict[int, int]:
    """For each p up to `longest`, add up the indices of the fixed points of the section map taken p times."""
    return {
        p: sum(one.period * one.index(p // one.period) for one in found if p % one.period == 0)
        for p in range(1, longest + 1)
    }


def expected_index(system: System) -> int:
    """Return the value to which the fixed-point indices add up if no orbit is missing: 0 if a state is an angle, else
    1.
    """
    return 0 if any(system.is_angle) else 1
