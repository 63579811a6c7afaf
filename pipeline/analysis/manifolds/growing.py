"""Grow the one-dimensional manifolds of a saddle orbit of the section map, point by point.

The unstable manifold begins as a short straight segment along the unstable eigenvector, from x0 + d q to its image.
Each further generation is the image of the one before, and all its points are integrated side by side. Where
neighbouring points are too far apart, or the curve turns too much between them, points are inserted on the first
segment and integrated from there, so that no point of the curve is interpolated (Hobson, J. Comput. Phys. 104, 1993,
14). An orbit with a negative multiplier is taken twice, so that each side of the manifold maps to itself.

The stable manifold is made of preimages: Newton's method solves P(y) = x from the preimage of the neighbour, and
inserted points from the middle of their neighbours. So nothing is integrated backwards, where dissipative systems
run away.

The first segment is straight, which costs an error of the order of d^2; the map shrinks it along the unstable
manifold, and preimages shrink it along the stable one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import on_section, section_map, wrap_angles
from pipeline.results.tolerances import BRANCH_RTOL, SAME_POINT


@dataclass(frozen=True, eq=False)
class Saddle:
    """A saddle orbit of the section map: system, parameters, one section point and the monodromy matrix."""

    system: System  # system of equations to integrate
    frequency_hz: float  # drive frequency [Hz]
    packed: np.ndarray  # packed parameters
    state: np.ndarray  # (n_states,): a section point of the orbit
    period: int  # period [drive periods or returns]
    monodromy: np.ndarray  # (n_states, n_states): derivative of the section map over the period

    @property
    def scales(self) -> np.ndarray:
        """Scales of the states."""
        return np.asarray(self.system.scales)

    def direction(self, stable: bool) -> tuple[float, np.ndarray]:
        """Return the multiplier and the unit eigenvector of the orbit's one stable or unstable direction, in scaled
        states.

        Raises
        ------
        ValueError
            If there are several such directions, or none.
        """
        values, vectors = np.linalg.eig(self.monodromy * self.scales / self.scales[:, None])
        sizes = np.abs(values)
        chosen = np.flatnonzero((sizes < 1.0) & (sizes > 0.0) if stable else sizes > 1.0)
        if len(chosen) != 1:
            kind = "stable" if stable else "unstable"
            raise ValueError(
                f"the orbit has {len(chosen)} {kind} directions; a manifold is a curve only if it has one."
            )
        vector = vectors[:, chosen[0]].real
        return float(values[chosen[0]].real), vector / np.linalg.norm(vector)

    def images(self, states: np.ndarray, n_periods: int) -> tuple[np.ndarray, np.ndarray]:
        """Map section points over some periods; return their images and the derivatives of the map."""
        n = len(states)
        ends = section_map(
            np.tile(self.packed, (n, 1)),
            np.full(n, self.frequency_hz),
            states,
            n_periods,
            rtol=BRANCH_RTOL,
            system=self.system,
        )
        return ends.images[:, -1], ends.derivatives

    def scaled(self, difference: np.ndarray) -> np.ndarray:
        """Divide a difference of states by the states' scales, with angles wrapped to between -pi and pi."""
        return np.asarray(wrap_angles(difference, self.system) / self.scales)


@dataclass(frozen=True)
class Resolution:
    """Resolution of a manifold: how far it grows, and how fine; finer ones take longer."""

    chord: float = 0.02  # longest distance between points [scaled]
    length: float = 20.0  # total length [scaled]
    most: int = 20_000  # largest number of points
    first: float = 1e-5  # scaled distance of the first segment from the orbit; less errs less, and takes more images
    turn: float = 0.2  # largest angle between neighbouring chords [rad]
    # largest product of that angle and the chord: where the curve is sharply bent, short chords may turn more
    turn_distance: float = 2e-4
    shortest: float = 1e-12  # least difference of two places on the first segment
    most_generations: int = 60  # after which a manifold that stays short ends


@dataclass(eq=False)
class Manifold:
    """One side of a manifold of a saddle orbit: its points from the orbit outwards, and the reason why it ends."""

    points: np.ndarray  # (n, n_states): section points in order
    # (n,): generation and the place within it: one more is the next image (of a stable manifold: the next preimage)
    time: np.ndarray
    stable: bool  # whether trajectories approach the orbit along it
    # reason for its end: ``length``, ``most`` points, ``generations``, or ``lost`` where a point has no image or
    # preimage
    end: str = field(default="length")


Step = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From points of a generation and guesses to the points of the next; rows of NaN where it fails."""


def unstable_manifold(saddle: Saddle, side: float, resolution: Resolution = Resolution()) -> Manifold:
    """Grow the unstable manifold on one side (1 or -1) of a saddle orbit.

    Raises
    ------
    ValueError
        If the orbit does not have one unstable direction.
    """
    return _grow(saddle, side, False, resolution)


def stable_manifold(saddle: Saddle, side: float, resolution: Resolution = Resolution()) -> Manifold:
    """Grow the stable manifold on one side (1 or -1) of a saddle orbit.

    Raises
    ------
    ValueError
        If the orbit does not have one stable direction.
    """
    return _grow(saddle, side, True, resolution)


def _grow(saddle: Saddle, side: float, stable: bool, resolution: Resolution) -> Manifold:
    multiplier, vector = saddle.direction(stable)
    n_periods = saddle.period * (2 if multiplier < 0.0 else 1)
    rate = abs(np.log(abs(multiplier))) * (2.0 if multiplier < 0.0 else 1.0)

    def first(places: np.ndarray) -> np.ndarray:
        away = side * resolution.first * np.exp(rate * places)[:, None] * vector
        return np.asarray(saddle.state + away * saddle.scales)

    def ahead(points: np.ndarray, guesses: np.ndarray) -> np.ndarray:
        return saddle.images(points, n_periods)[0]

    def back(points: np.ndarray, guesses: np.ndarray) -> np.ndarray:
        return _preimages(saddle, points, guesses, n_periods)

    curve = _Curve(saddle, resolution, first, back if stable else ahead, stable, n_periods)
    return curve.grow()


@dataclass(eq=False)
class _Curve:
    """A manifold while it grows: a first segment, and its repeated images (or preimages) under the section map."""

    saddle: Saddle
    resolution: Resolution
    first: Callable[[np.ndarray], np.ndarray]
    step: Step
    stable: bool
    n_periods: int

    def __post_init__(self) -> None:
        self.places = np.linspace(0.0, 1.0, 9)
        self.generations = [self.first(self.places)]

    def grow(self) -> Manifold:
        """Add images (or preimages) of the first segment until the manifold has the requested length."""
        points, times, length, end = [self.generations[0][:1]], [np.zeros(1)], 0.0, "generations"
        for number in range(self.resolution.most_generations):
            if number:
                (self._add_preimages if self.stable else self._add_images)()
            self._refine()
            here = self.generations[-1]
            good = np.isfinite(here).all(axis=1)
            n = len(here) if good.all() else int(np.argmin(good))
            points.append(here[1:n])
            times.append(number + self.places[1:n])
            length += float(np.linalg.norm(self.saddle.scaled(np.diff(here[:n], axis=0)), axis=1).sum())
            if length > self.resolution.length:
                end = "length"
            elif n < len(here):
                end = "lost"
            elif sum(map(len, points)) > self.resolution.most:
                end = "most"
            else:
                continue
            break
        return self._cut(np.concatenate(points), np.concatenate(times), end)

    def _cut(self, points: np.ndarray, times: np.ndarray, end: str) -> Manifold:
        away = np.linalg.norm(self.saddle.scaled(np.diff(points, axis=0)), axis=1)
        far = np.flatnonzero(np.cumsum(away) > self.resolution.length)
        n = min(int(far[0]) + 2 if len(far) else len(points), self.resolution.most)
        return Manifold(points[:n], times[:n], self.stable, end)

    def _add_images(self) -> None:
        self.generations.append(self.step(self.generations[-1], self.generations[-1]))

    def _add_preimages(self) -> None:
        """Compute the preimages of a stable manifold's latest points one after another; each starts from the preimage
        before it.

        If the step to the next point is long, or Newton's method fails, a position is inserted between them.
        """
        saddle, longest = self.saddle, 2.0 * self.resolution.chord
        found, length = [self.generations[-1][-1]], 0.0  # a generation begins where the one before ends
        matrix = saddle.images(found[0][None], self.n_periods)[1][0]
        tangent, away, bend = np.zeros(len(found[0])), 0.0, np.zeros(len(found[0]))
        while len(found) < len(self.places) and length < self.resolution.length:
            i = len(found)
            before = self.generations[-1]
            change = wrap_angles(before[i] - before[i - 1], saddle.system)
            step = np.linalg.lstsq(matrix, change, rcond=None)[0] / saddle.scales
            ahead = float(np.linalg.norm(step))
            if not 0.0 < ahead < np.inf:  # two points coincide: the curve cannot be resolved further
                break
            # the map expands so much that the predictor must follow the curve's bend
            bend = (step / ahead - tangent) / away if away > 0.0 else bend
            guess = found[-1] + (step + 0.5 * ahead * ahead * bend) * saddle.scales
            here = self.step(before[i : i + 1], guess[None])[0] if ahead <= longest else found[-1] * np.nan
            moved = float(np.linalg.norm(saddle.scaled(here - found[-1])))
            if moved <= longest:
                tangent, away, length = step / ahead, moved, length + moved
                found.append(here)
                matrix = saddle.images(here[None], self.n_periods)[1][0]
            elif self.places[i] - self.places[i - 1] > self.resolution.shortest:
                self._insert(np.array([i - 1]), float(np.clip(self.resolution.chord / ahead, 1e-3, 0.5)))
            else:
                break
        rest = np.full((len(self.places) - len(found), len(found[0])), np.nan)
        self.generations.append(np.concatenate([np.array(found), rest]))

    def _refine(self) -> None:
        """Insert positions on the first segment until the points of its latest image (or preimage) are close enough to
        each other.
        """
        while len(self.places) < self.resolution.most:
            coarse = self._coarse(self.generations[-1]) & (np.diff(self.places) > self.resolution.shortest)
            if not coarse.any():
                break
            self._insert(np.flatnonzero(coarse))

    def _insert(self, at: np.ndarray, share: float = 0.5) -> None:
        """Insert a new position after each given one on the manifold's first segment, and compute its images (or
        preimages).
        """
        middle = self.places[at] + share * (self.places[at + 1] - self.places[at])
        new = [self.first(middle)]
        for points in self.generations[1:]:
            new.append(self.step(new[-1], self._between(points, at, middle)))
        self.places = np.insert(self.places, at + 1, middle)
        pairs = zip(self.generations, new, strict=True)
        self.generations = [np.insert(points, at + 1, inserted, axis=0) for points, inserted in pairs]

    def _between(self, points: np.ndarray, at: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Interpolate an image of the first segment at new positions, by cubics through four points (at the ends by
        lines).
        """
        last = len(points) - 1
        result = np.empty((len(at), points.shape[1]))
        for row, (k, place) in enumerate(zip(at, middle, strict=True)):
            near = np.arange(k - 1, k + 3) if 0 < k < last - 1 else np.arange(k, k + 2)
            near = near if np.isfinite(points[near]).all() else np.arange(k, k + 2)
            offsets = wrap_angles(points[near] - points[k], self.saddle.system)
            nodes = self.places[near]
            weights = [np.prod([(place - o) / (n - o) for o in nodes if o != n]) for n in nodes]
            result[row] = points[k] + np.array(weights) @ offsets
        return result

    def _coarse(self, points: np.ndarray) -> np.ndarray:
        """Return which chords of a curve are too long, or turn too sharply at one of their ends."""
        chords = self.saddle.scaled(np.diff(points, axis=0))
        lengths = np.linalg.norm(chords, axis=1)
        inner = (chords[1:] * chords[:-1]).sum(axis=1) / np.maximum(lengths[1:] * lengths[:-1], 1e-300)
        turns = np.arccos(np.clip(inner, -1.0, 1.0))
        bent = (turns > self.resolution.turn) & (
            turns * np.maximum(lengths[1:], lengths[:-1]) > self.resolution.turn_distance
        )
        coarse = lengths > self.resolution.chord
        coarse[1:] |= bent
        coarse[:-1] |= bent
        return np.asarray(coarse & np.isfinite(lengths))


def _preimages(saddle: Saddle, points: np.ndarray, guesses: np.ndarray, n_periods: int) -> np.ndarray:
    """Compute the preimage of each point under the section map by Newton's method; NaN where the method fails.

    The map expands and contracts by large factors, so that the size of P(y) - x says little. A step is accepted if the
    next step, with the same derivative, is shorter (natural monotonicity; Deuflhard, Newton Methods for
    Nonlinear Problems, 2004, Sect. 3.3); else it is divided by four.
    """
    # most Newton steps, and the length of the last one [scaled]: the next would be its square
    most_steps, close = 20, 1e-8
    found = np.where(np.isfinite(guesses).all(axis=1, keepdims=True), guesses, np.nan).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(found).all(axis=1) & np.isfinite(points).all(axis=1))
    converged = np.zeros(len(points), bool)
    n = len(saddle.scales)
    steps, share, matrices = np.zeros_like(found), np.zeros(len(points)), np.zeros((len(points), n, n))
    for number in range(most_steps):
        trial = found[rows] + share[rows, None] * steps[rows] * saddle.scales
        images, derivatives = saddle.images(trial, n_periods)
        residual = saddle.scaled(points[rows] - images)
        is_finite = np.isfinite(residual).all(axis=1) & np.isfinite(derivatives).all(axis=(1, 2))
        scaled = derivatives * saddle.scales / saddle.scales[:, None]
        for k, row in enumerate(rows):
            length = np.linalg.norm(steps[row])
            if is_finite[k] and (not number or np.linalg.norm(_solve(matrices[row], residual[k])) < length):
                found[row], matrices[row], share[row] = trial[k], scaled[k], 1.0
                steps[row] = _solve(scaled[k], residual[k])
                left = np.linalg.norm(residual[k] - scaled[k] @ steps[row])  # 0, unless the derivative is singular
                converged[row] = np.abs(steps[row]).max() < close and left < SAME_POINT
                found[row] += converged[row] * steps[row] * saddle.scales
            else:
                share[row] *= 0.25
        rows = rows[~converged[rows]]
        if not len(rows):
            break
    found[~converged] = np.nan
    # Newton's method leaves one state of a point on a section of an expression as it was
    return np.asarray(wrap_angles(on_section(found, saddle.packed, saddle.system), saddle.system))


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])
