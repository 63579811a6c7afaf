"""Compute the features of an attractor: ranges, rotation, class of motion, energy, mirror image.

Half a drive period
-------------------
A drive whose second half is minus its first gives many systems a symmetry that takes half a period, such as
``y(t) -> -y(t + T/2)``. On the section (t = 0) the image of a point x is then minus the state at t = T/2 of
the motion from x, not minus x itself. The model declares its symmetry. The image of a closed orbit is
computed from its polished orbit, the image of a bounded set from its stored points. The mirror partner is the
attractor nearest to the image, where a difference in rotation adds to the distance. A motion that is its own
image is its own partner. If the symmetry is approximate (a duty cycle of 0.4927 instead of one half),
`mirror_distance` measures how well it holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.model import Mirror, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.ordering import SAME_DIGITS
from magpend_core.pointwise import evaluate
from magpend_core.precision import limits_at, tolerances_at
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.known_sets import Cycle, Equilibrium
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.stability import BY_APPROACH, BY_EIGENVALUES, BY_MULTIPLIERS, BY_ONE_SIDE
from pipeline.analysis.attractors.jumps import with_jumps
from pipeline.analysis.flown import flown
from pipeline.layout.vocabulary import ATTRACTS, EQUILIBRIUM, NOT_SETTLED, PERIODIC_ORBIT
from pipeline.results.sets import Geometry, hashes, mean_distance, order_of_points, rows_by_number
from pipeline.results.sides import UNKNOWN
from pipeline.results.tolerances import PORTRAIT_RTOL

ENERGY = "energy"
"""Name of the model's quantity whose range is computed for each attractor."""


@dataclass
class Cells:
    """Statistics of the trajectories (cells) on one attractor, collected from one block of cells after another."""

    n_points: int
    # (state,): range of the kept sections
    low: np.ndarray = field(default_factory=lambda: np.full(1, np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(1, -np.inf))
    # list of ndarray, (cell, angle): mean rotation of the cells
    rotations: list[np.ndarray] = field(default_factory=list)
    # list of ndarray, (cell, angle): full turns of the cells over their sections
    turns: list[np.ndarray] = field(default_factory=list)
    sides: set[int] = field(default_factory=set)  # codes of the classifier
    points: np.ndarray | None = None  # (m, state): section points of least hash
    # list of ndarray, (cell,): mean time between two sections of the cells [s]
    seconds: list[np.ndarray] = field(default_factory=list)

    def add(self, block: Block, point: Point, geometry: Geometry) -> None:
        """Add the cells of a block to the statistics."""
        section = block.section
        flat = section.reshape(-1, section.shape[-1])
        self.low = np.minimum(self.low, flat.min(axis=0))
        self.high = np.maximum(self.high, flat.max(axis=0))
        self.rotations.append(mean_rotation(section, block.turns, geometry))
        self.turns.append(np.abs(block.turns))
        self.sides.update(sides_of(section, block.turns, point.frequency, point.parameters).tolist())
        if block.seconds is not None:
            self.seconds.append(block.seconds.mean(axis=1))
        both = flat if self.points is None else np.concatenate([self.points, flat])
        least = np.unique(hashes(both), return_index=True)[1][: self.n_points]
        self.points = both[least]

    @property
    def _mean_rotation(self) -> np.ndarray:
        """Mean rotation of the cells [turns per drive period]. Its bits do not depend on the order of the cells."""
        return np.asarray(np.sort(np.concatenate(self.rotations), axis=0).mean(axis=0))

    @property
    def mean_seconds(self) -> float:
        """Mean time between two successive section points of the cells [s]; NaN if no times are known."""
        return float(np.sort(np.concatenate(self.seconds)).mean()) if self.seconds else np.nan

    def fill(self, found: Features, point: Point) -> None:
        """Store rotation, class of motion and ranges in the features of the attractor."""
        found.rotation, found.side = self._mean_rotation, self._side(point)
        found.state_min, found.state_max = self.low, self.high

    def _side(self, point: Point) -> int:
        """Return the attractor's class of motion (a code): the class of all its cells or, if they differ, of their
        pooled points.

        The pooled points are classified with the median of the cells' turns.
        """
        known = [code for code in self.sides if code != UNKNOWN] if point.parameters is not None else []
        if len(known) <= 1:
            return known[0] if known else UNKNOWN
        assert self.points is not None
        turns = np.median(np.concatenate(self.turns), axis=0).astype(np.int64)
        return int(sides_of(self.points[None], turns[None], point.frequency, point.parameters)[0])


@dataclass
class Features:
    """Features of one attractor at one parameter point; ``None`` and NaN mean "not known".

    The attributes become variables of the same name; see `pipeline.analysis.attractors.attractors`.
    """

    points: np.ndarray
    kind: int
    orbit_period: int
    rotation: np.ndarray = field(default_factory=lambda: np.full(1, np.nan))
    side: int = UNKNOWN
    state_min: np.ndarray = field(default_factory=lambda: np.full(1, np.nan))
    state_max: np.ndarray = field(default_factory=lambda: np.full(1, np.nan))
    energy_min: float = np.nan
    energy_max: float = np.nan
    multipliers: np.ndarray | None = None
    residual: float = np.nan
    is_polished: bool = False
    stability: int = NOT_SETTLED
    evidence: int = 0
    multiplier_error: float = np.nan
    lyapunov_max: float = np.nan
    lyapunov_low: float = np.nan
    lyapunov_high: float = np.nan
    n_sampled: int = 0
    n_left: int = 0
    n_leaving: int = 0
    time_at_risk: float = np.nan
    mean_lifetime: float = np.nan
    lifetime_low: float = np.nan
    lifetime_high: float = np.nan
    n_to: np.ndarray | None = None
    closes_above: int = 0
    dimension: int = 0
    period_s: float = np.nan
    eigenvalues: np.ndarray | None = None
    image: np.ndarray | None = None
    mirror_partner: int = -1
    mirror_distance: float = np.nan


def mean_rotation(section: np.ndarray, turns: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Compute the mean rotation of each angle over the stored section points [turns per drive period], shape (cell,
    angle).
    """
    angles = np.asarray(geometry.is_angle)
    change = section[:, -1, angles] - section[:, 0, angles]
    n = max(section.shape[1] - 1, 1)
    return np.asarray((change / TWO_PI + turns) / n)


def sides_of(section: np.ndarray, turns: np.ndarray, frequency: float, parameters: Parameters | None) -> np.ndarray:
    """Return the class of motion of each trajectory from its section points, by the model's classifier. It is "unknown"
    if the model has no classifier or a point is NaN.
    """
    classifier = parameters.model.classifier if parameters is not None else None
    if classifier is None or parameters is None:
        return np.full(len(section), UNKNOWN, np.int64)
    code = classifier.classify(np.nan_to_num(section), turns, np.asarray(frequency), parameters)
    return np.where(np.isfinite(section).all(axis=(1, 2)), code, UNKNOWN).astype(np.int64)


def follow_orbits(
    orbits: Sequence[tuple[Features, Parameters, float]], geometry: Geometry, n_samples: int = 256
) -> None:
    """Integrate periodic orbits over their periods, and store their ranges, exact rotations, energy ranges and mirror
    images.

    Parameters
    ----------
    orbits
        Features of each orbit, its parameters, and the drive frequency or the mean frequency of the returns [Hz].
    geometry
        Geometry of the states.
    n_samples
        Times per drive period or return at which an orbit is sampled for its ranges; even.
    """
    most = 2**20  # states of orbits that are held at once
    by_period = rows_by_number(np.array([found.orbit_period for found, _, _ in orbits], np.int64))
    for period, rows in by_period.items():
        n = max(1, most // (period * n_samples))
        for begin in range(0, len(rows), n):
            _follow([orbits[row] for row in rows[begin : begin + n]], period, geometry, n_samples)


def _follow(
    orbits: Sequence[tuple[Features, Parameters, float]], period: int, geometry: Geometry, n_samples: int
) -> None:
    flows = [of_flow(parameters) for _, parameters, _ in orbits]
    model, angles = flows[0].model, np.flatnonzero(geometry.is_angle)
    per = model.clock.samples(n_samples)
    even = [np.arange(period * per + 1) / (per * frequency) for _, _, frequency in orbits]

    def fly(rows: list[int], times: list[np.ndarray]) -> list[np.ndarray]:
        found = sample(
            model.system,
            np.array([flows[row].pack() for row in rows]),
            np.array([orbits[row][0].points[0] for row in rows]),
            times,
            drives=[Drive(np.full(period, 1.0 / orbits[row][2])) for row in rows],
            **tolerances_at(PORTRAIT_RTOL),
            max_steps_per_interval=limits_at(PORTRAIT_RTOL)["max_steps_per_period"],
            limits_first_step=False,
        )
        if (found.status != Status.BOUNDED).any():
            raise ArithmeticError(f"An orbit ended early: {Status(found.status.max()).advice}.")
        return [states[: len(own)] for states, own in zip(found.states, times, strict=True)]

    times = even.copy()
    paths = (
        with_jumps(fly, times, model.system.sizes) if model.clock.is_continuous else fly([*range(len(orbits))], times)
    )
    for row, (found, parameters, frequency) in enumerate(orbits):
        path = paths[row]
        turns = np.round((path[-1] - path[0])[angles] / TWO_PI)
        found.rotation = turns / period + 0.0  # no -0.0
        found.state_min, found.state_max = path.min(axis=0), path.max(axis=0)
        rotating = angles[turns != 0]
        found.state_min[rotating], found.state_max[rotating] = -np.pi, np.pi
        _fill_energy(found, times[row], path, flows[row], frequency)
        mirror = parameters.model.mirror
        if mirror is not None:
            first = n_samples // 2 if mirror.half_period else 0
            at = np.searchsorted(times[row], even[row][first : period * per : per])
            found.image = path[at] * np.array(mirror.signs)


def fill_cycle(found: Features, cycle: Cycle) -> None:
    """Store the features of a limit cycle, for an autonomous flow that is sampled at equal times."""
    found.kind, found.period_s, found.residual = PERIODIC_ORBIT, cycle.seconds, cycle.residual
    found.stability, found.evidence = ATTRACTS, BY_MULTIPLIERS
    found.multipliers, found.lyapunov_max = cycle.multipliers, 0.0
    found.lyapunov_low = found.lyapunov_high = 0.0


def of_equilibrium(found: Equilibrium, parameters: Parameters | None, n_angles: int) -> Features:
    """Return the features of an equilibrium. Its largest Lyapunov exponent is the largest real part of the
    eigenvalues.
    """
    by_probes = BY_APPROACH if found.side is None else BY_ONE_SIDE
    x = Features(
        found.state[None],
        EQUILIBRIUM,
        0,
        np.zeros(n_angles),
        state_min=found.state,
        state_max=found.state,
        residual=found.residual,
        is_polished=True,
        stability=found.stability,
        evidence=by_probes if found.approached_within else BY_EIGENVALUES,
        eigenvalues=found.eigenvalues,
    )
    x.lyapunov_max = x.lyapunov_low = x.lyapunov_high = float(found.eigenvalues.real[0])
    if parameters is None:
        return x
    x.side = int(sides_of(x.points[None], np.zeros((1, n_angles), np.int64), np.inf, parameters)[0])
    follow_points(x, parameters, 1.0)
    return x


def follow_points(found: Features, parameters: Parameters, frequency: float) -> None:
    """Compute the energy range and the mirror image of an attractor or other set from its stored section points."""
    _fill_energy(found, np.zeros(len(found.points)), found.points, of_flow(parameters), frequency)
    mirror = parameters.model.mirror
    if mirror is None:
        return
    ends = found.points
    if mirror.half_period:
        drive, half = Drive(np.array([1.0 / frequency])), np.array([0.5 / frequency])
        ends = flown(parameters, ends, half, drive, limits_first_step=False).states[:, 0]
    found.image = ends * np.array(mirror.signs)


def has_energy(parameters: Parameters) -> bool:
    """Return whether the model has a quantity named energy."""
    return any(quantity.name == ENERGY for quantity in parameters.model.quantities)


def _fill_energy(
    found: Features, times: np.ndarray, states: np.ndarray, parameters: Parameters, frequency: float
) -> None:
    if has_energy(parameters):
        energies = evaluate([ENERGY], times, states, parameters, frequency)
        found.energy_min, found.energy_max = float(energies.min()), float(energies.max())


def pair_mirrors(found: list[Features], mirror: Mirror, threshold: float, geometry: Geometry) -> None:
    """Find each attractor's mirror partner: the attractor nearest to its mirror image, if the two are within
    `threshold`.
    """
    turned = np.array(mirror.signs)[list(geometry.is_angle)]
    for a in found:
        if a.image is None:
            continue
        distances = [
            mean_distance(a.image, b.points, geometry)
            + float(np.abs(turned * a.rotation - b.rotation).max(initial=0.0))
            for b in found
        ]
        # of several that are equally near the first, whatever the last digits say
        nearest = int(np.argmax(distances <= np.min(distances) + SAME_DIGITS))
        a.mirror_distance = distances[nearest]
        a.mirror_partner = nearest if distances[nearest] <= threshold else -1


def sorted_points(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Sort section points (n, state) in canonical order."""
    return np.asarray(points[order_of_points(points, geometry)])
