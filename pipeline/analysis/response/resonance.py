"""Follow phase resonance in frequency and force, and normal modes of conservative systems in frequency and energy.

At phase resonance the first harmonic of a channel is in quadrature with that of the drive: it lags by 90 degrees, or
by -90 if the channel moves against the force. Unknowns are a section point, the frequency and the force.

A normal mode is a periodic orbit of a system without damping and drive. Unknowns are a point of it and the frequency.
The equations phi_T(x) = x are redundant, since the energy returns by itself: the derivative of their n rows has the
rank n - 1. They are projected on the n - 1 directions that it spans, as by the pseudo-inverse of Peeters et al.
(Nonlinear normal modes, Part II, Mech. Syst. Signal Process. 23 (2009), 195). The point moves at right angles to the
orbit before. An orbit counts if all n rows vanish, so that a system which loses energy has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.pointwise import rates_packed
from pipeline.analysis.branches.arclength import Point, Settings, Trace, correct, trace
from pipeline.analysis.branches.bifurcations import multipliers_of
from pipeline.analysis.branches.following import first_point, opposite
from pipeline.analysis.branches.lockstep import Steps
from pipeline.analysis.branches.problems import FREQUENCY, ONE_SIDED_STEP, Ends, Family, FamilyProblem, Rows, Value
from pipeline.analysis.response.orbits import FEWEST_TIMES, Orbit, harmonics_of, lags_of, sampled

RESONANCE = Settings(5e-3, 4e-2, 1e-5, max_points=1000, tolerance=1e-9, max_iterations=8)
"""Settings of phase resonance; the residual includes the cosine of the lag. A start further than 1 from the origin
has longer steps in proportion."""

MODE = Settings(1e-2, 5e-3, 1e-5, max_points=2000, tolerance=1e-11, max_iterations=8)
"""Settings of normal modes; the frequency of the linear mode counts as 1. The longest step is in units of the longest
distance from the equilibrium."""


NEUTRAL = 1e-4
"""Distance from the unit circle within which a multiplier of a conservative system counts as on it."""

ENDS = ("linear_mode", "bound", "stuck", "max_points")
"""Reasons for the ends of a curve; ``bound`` is one of frequency, force or distance from the equilibrium."""

Array = np.ndarray
Bounds = tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class ResonanceProblem(FamilyProblem):
    """Equations for orbits at phase resonance; not defined outside of the bounds."""

    n_free = 2
    family: Family  # free are the frequency and the force
    base: Parameters
    channel: int
    bounds: Bounds  # of frequency [Hz] and force

    def rows(self, u: Array) -> Rows:
        """Return the orbit, and the same start at a changed frequency and at a changed force."""
        return self.family.rows(_displaced(u)[[0, -2, -1]])

    def value(self, u: Array, ends: Ends) -> Value:
        """Compute the mismatch after one period and the cosine of the lag, with their derivatives."""
        last = np.array([self.family.mismatch(u, image) for image in ends.images[:, -1]])
        cosines = self._cosines(u)
        matrix = self.family.scaled(ends.monodromy[0]) - np.eye(self.system.n_states)
        above = np.column_stack([matrix, (last[1:] - last[0]).T / ONE_SIDED_STEP])
        derivative = np.vstack([above, (cosines[1:] - cosines[0]) / ONE_SIDED_STEP])
        residual = np.append(last[0], cosines[0])
        return Value(residual, derivative, ends.images[0], ends.monodromy[0], float(ends.times[0].sum()))

    def _cosines(self, u: Array) -> Array:
        """Return the cosine of the lag of the motion from a start, and from starts displaced in each unknown."""
        if not _is_within(self.family.values(u), self.bounds):
            return np.full(1 + self.size, np.nan)
        orbits = [self.orbit(one) for one in _displaced(u)]
        return np.asarray(
            np.cos(lags_of(orbits, harmonics_of(sampled(orbits, FEWEST_TIMES), 1, 1)))[:, self.channel, 0]
        )

    def orbit(self, u: Array) -> Orbit:
        """Return the orbit at some unknowns; a displaced force stays within its bounds, which may be the model's."""
        frequency, force = self.family.values(u)
        own = self.base.replace(**{self.family.free[1]: float(np.clip(force, *self.bounds[1]))})
        return Orbit(own, self.family.state(u), 1.0 / float(frequency), 1)


@dataclass(eq=False)
class ModeProblem(FamilyProblem):
    """Equations for periodic orbits of a conservative system; not defined outside of the bounds.

    A problem serves one curve: it remembers the last orbit.
    """

    family: Family  # free is the frequency, in units of that of the linear mode
    base: Parameters
    equilibrium: Array  # scaled state
    bounds: Bounds  # of the frequency [Hz] and of the scaled distance from the equilibrium
    _last: Array = field(init=False, repr=False)  # unknowns of the last orbit
    _along: Array = field(init=False, repr=False)  # unit vector along it

    @property
    def linear_hz(self) -> float:
        """Frequency of the linear mode [Hz]."""
        return self.family.scales[0]

    def keep(self, u: Array) -> None:
        """Keep an orbit's point as the last one: the next is sought at right angles to the orbit there."""
        rows = self.family.rows(u[None])
        rate = rates_packed(self.system, rows.states, rows.parameters, rows.frequency_hz)[0]
        along = np.append(rate / np.asarray(self.system.scales), 0.0)
        self._last, self._along = u, along / np.linalg.norm(along)

    def rows(self, u: Array) -> Rows:
        """Return the orbit."""
        return self.family.rows(u[None])

    def value(self, u: Array, ends: Ends) -> Value:
        """Compute the projected mismatch after one period and the way along the last orbit, with their derivatives."""
        image, n = ends.images[0, -1], self.system.n_states
        mismatch, monodromy = self.family.mismatch(u, image), ends.monodromy[0]
        frequency = float(self.family.values(u)[0])
        if not _is_within((frequency, self.distance(u)), self.bounds):
            mismatch = np.full(n, np.nan)
        rate = rates_packed(self.system, image[None], self.family.rows(u[None]).parameters, np.array([frequency]))[0]
        rate = rate / np.asarray(self.system.scales)
        by_frequency = -rate / frequency**2 * self.family.scales[0]
        closure = np.column_stack([self.family.scaled(monodromy) - np.eye(n), by_frequency])
        if not (np.isfinite(mismatch).all() and np.isfinite(closure).all()):
            return Value(np.full(n, np.nan), np.zeros((n, n + 1)), ends.images[0], monodromy)
        spanned = np.linalg.svd(closure)[0][:, : n - 1].T
        residual = np.append(spanned @ mismatch, self._along @ (u - self._last))
        derivative = np.vstack([spanned @ closure, self._along])
        return Value(residual, derivative, ends.images[0], monodromy, 1.0 / frequency)

    def distance(self, u: Array) -> float:
        """Return how far the orbit's section point is from the equilibrium, in units of the states' scales."""
        return float(np.linalg.norm(self.family.mismatch(np.append(self.equilibrium, 1.0), self.family.state(u))))

    def orbit(self, u: Array) -> Orbit:
        """Return the orbit at some unknowns."""
        return Orbit(self.base, self.family.state(u), 1.0 / float(self.family.values(u)[0]), 1)


def _displaced(u: Array) -> Array:
    return np.vstack([u, u + ONE_SIDED_STEP * np.eye(len(u))])


def _is_within(values: Sequence[float] | Array, bounds: Bounds) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(values, bounds, strict=True))


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of orbits at phase resonance, or of a normal mode, with the reasons for its ends, of `ENDS`."""

    problem: ResonanceProblem | ModeProblem
    points: list[Point]
    ends: tuple[str, str]

    @property
    def kind(self) -> Literal["phase_resonance", "normal_mode"]:
        """Kind of the curve."""
        return "phase_resonance" if isinstance(self.problem, ResonanceProblem) else "normal_mode"

    def gap(self, point: Point) -> float:
        """Return the scaled distance between the two ends of an orbit over one period."""
        return float(np.abs(self.problem.family.mismatch(point.u, point.value.images[-1])).max())

    def multipliers(self, point: Point) -> Array:
        """Return the multipliers that decide the stability of an orbit.

        Those of a normal mode are without the two nearest to 1: of the flow, and of the energy.
        """
        found = multipliers_of(point)
        if isinstance(self.problem, ModeProblem):
            found = np.delete(found, np.argsort(np.abs(found - 1.0))[:2])
        return found

    def n_unstable(self, point: Point) -> int:
        """Return the number of multipliers outside the unit circle."""
        slack = NEUTRAL if isinstance(self.problem, ModeProblem) else 0.0
        return int((np.abs(self.multipliers(point)) > 1.0 + slack).sum())


def phase_resonance(problem: ResonanceProblem, guess: Array) -> Steps[Curve | None]:
    """Refine an orbit at its force, and follow phase resonance in both directions; None if there is no such orbit."""
    start = yield from first_point(problem, guess, RESONANCE)
    if start is None:
        return None
    size = max(1.0, float(np.linalg.norm(start.u[: problem.system.n_states])))
    settings = replace(RESONANCE, size=size)
    back = yield from trace(problem, opposite(start), settings)
    ahead = yield from trace(problem, start, settings)
    points = [opposite(p) for p in reversed(back.points)] + ahead.points[1:]
    return Curve(problem, points, (_end(problem, back), _end(problem, ahead)))


def normal_mode(problem: ModeProblem, direction: Array) -> Steps[Curve | None]:
    """Follow a normal mode from a scaled state of length 1 on its linear mode; None if the orbits do not close."""
    small = 1e-2  # scaled distance from its equilibrium at which the mode begins
    # gap between an orbit's ends, as a share of its distance from the equilibrium, above which energy is lost
    largest = 1e-7
    normal = np.append(direction, 0.0)
    start = np.append(problem.equilibrium, 1.0) + small * normal

    def is_closed(_: Point, there: Point) -> Steps[bool]:
        yield from ()
        gap = np.abs(problem.family.mismatch(there.u, there.value.images[-1])).max()
        if gap > largest * problem.distance(there.u):
            return False
        problem.keep(there.u)
        return True

    problem.keep(start)
    found = yield from correct(problem, start, normal, MODE)
    if found is None or not (yield from is_closed(found, found)):
        return None
    settings = replace(MODE, size=problem.bounds[1][1])
    followed = yield from trace(problem, found, settings, between=is_closed)
    return Curve(problem, followed.points, ("linear_mode", _end(problem, followed)))


def _end(problem: ResonanceProblem | ModeProblem, found: Trace) -> str:
    """Return why a trace ended: at a bound if its next step of twice the shortest length leaves the bounds."""
    last = found.points[-1]
    beyond = last.u + 4.0 * RESONANCE.shortest_step * last.tangent
    values = problem.family.values(beyond)
    own = values if isinstance(problem, ResonanceProblem) else (values[0], problem.distance(beyond))
    return found.end if found.end != "stuck" or _is_within(own, problem.bounds) else "bound"


def mode_start(base: Parameters, vector: Array, channel: int) -> Array:
    """Return a scaled state of length 1 on a linear mode, at an instant at which the channel's state is largest.

    The mode is an eigenvector of the Jacobian at the equilibrium. Where the channel is a quantity, or a state that does
    not take part, it is the state with the largest part.
    """
    scaled = vector / np.asarray(base.model.system.scales)
    takes_part = channel < len(scaled) and abs(scaled[channel]) > 1e-6 * np.abs(scaled).max()
    k = channel if takes_part else int(np.abs(scaled).argmax())
    real = np.asarray((scaled * np.conj(scaled[k])).real)
    return np.asarray(real / np.linalg.norm(real))


def mode_family(base: Parameters, linear_hz: float) -> Family:
    """Return the family of the orbits of a conservative system, with the frequency as the free parameter."""
    return Family(base.model.system, 1, linear_hz, base.pack(), (FREQUENCY,), (linear_hz,))
