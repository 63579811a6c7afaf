"""What is said of an attractor: ranges, rotation, side, energy, mirror partner.

Half a drive period
-------------------
The drive with a duty cycle of one half changes its sign after half a period, and with it the pendulum
has the symmetry ``psi(t) -> -psi(t + T/2)``. On the section (t = 0) the image of a point x is
therefore minus the state that the motion from x has at t = T/2, not minus x itself. The image of a
closed orbit is found in this way from its polished orbit, that of a bounded set from its stored points;
the mirror partner is the attractor nearest to the image whose rotation is opposite. A motion that is its
own image is its own partner. With the preset's duty cycle of 0.4927 and its magnets' fit the symmetry
is approximate; `mirror_distance` says how well it holds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from magpend_core.models.parameters import Parameters
from magpend_core.models.pendulum.mechanics import energy
from magpend_core.status import Status
from magpend_core.trajectory import trajectory
from pipeline.analysis.attractors.bounded import mean_rotation
from pipeline.analysis.attractors.cells import Block
from pipeline.analysis.sets import TWO_PI, Geometry, hashes, mean_distance, rounded_points
from pipeline.analysis.sides import Side, side

SAMPLES = 256
"""Times per drive period at which a polished orbit is sampled for its ranges; even."""

RTOL = 1e-9
"""Tolerance of these trajectories: their errors stay far below what their sampling leaves open."""


@dataclass
class Cells:
    """Running numbers of the cells of one attractor; independent of the order of the blocks.

    Attributes
    ----------
    n : int
        Cells.
    low, high : ndarray, (state,)
        Range of the kept sections.
    rotation : ndarray, (link,)
        Sum over cells of the mean rotation.
    sides : ndarray, (len(Side),)
        Cells by side.
    points : ndarray, (m, state)
        Section points of least hash.
    """

    n_points: int
    n: int = 0
    low: np.ndarray = field(default_factory=lambda: np.full(1, np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(1, -np.inf))
    rotations: list[np.ndarray] = field(default_factory=list)
    sides: np.ndarray = field(default_factory=lambda: np.zeros(len(Side), np.int64))
    points: np.ndarray | None = None

    def add(self, block: Block, cells: np.ndarray, labels: np.ndarray, geometry: Geometry) -> None:
        """Take in some cells of a block; `labels` are the codes of `Side` of all its cells."""
        section = block.section[cells]
        self.n += len(cells)
        flat = section.reshape(-1, section.shape[-1])
        self.low = np.minimum(self.low, flat.min(axis=0))
        self.high = np.maximum(self.high, flat.max(axis=0))
        self.rotations.append(mean_rotation(section, block.turns[cells], geometry))
        self.sides += np.bincount(labels[cells], minlength=len(Side))
        both = flat if self.points is None else np.concatenate([self.points, flat])
        least = np.unique(hashes(both), return_index=True)[1][: self.n_points]
        self.points = both[least]

    @property
    def mean_rotation(self) -> np.ndarray:
        """Mean over cells; summed in rising order, so that the last bit does not depend on theirs."""
        return np.asarray(np.sort(np.concatenate(self.rotations), axis=0).mean(axis=0))

    @property
    def side(self) -> int:
        """Side of the set: that of all its cells, or rotating if most rotate, or straddling."""
        known = self.sides.copy()
        known[Side.UNKNOWN] = 0
        present = np.flatnonzero(known)
        if len(present) <= 1:
            return int(present[0]) if len(present) else int(Side.UNKNOWN)
        return int(Side.ROTATING if 2 * known[Side.ROTATING] > known.sum() else Side.STRADDLING)


@dataclass
class Features:
    """One attractor at one parameter point; ``None`` and NaN mean not known.

    The attributes become variables of the same name; see `pipeline.analysis.attractors.attractors`.
    """

    points: np.ndarray
    kind: int
    orbit_period: int
    rotation: np.ndarray
    side: int
    state_min: np.ndarray
    state_max: np.ndarray
    energy_min: float = np.nan
    energy_max: float = np.nan
    multipliers: np.ndarray | None = None
    residual: float = np.nan
    is_polished: bool = False
    is_stable: int = -1
    lyapunov_max: float = np.nan
    image: np.ndarray | None = None
    mirror_partner: int = -1
    mirror_distance: float = np.nan


def sides_of(section: np.ndarray, turns: np.ndarray, frequency: float, names: tuple[str, ...]) -> np.ndarray:
    """Codes of `Side` for rows of sections, by the rule of `pipeline.analysis.sides`."""
    if not {"psi1", "psi2"} <= set(names):
        return np.full(len(section), Side.UNKNOWN, np.int64)
    ds = xr.Dataset(
        {
            "section": (("cell", "period_index", "state"), section),
            "turns": (("cell", "link"), turns),
            "status": ("cell", np.full(len(section), Status.PERIODIC, np.int8)),
        },
        coords={"state": list(names), "frequency": frequency},
    )
    return np.asarray(side(ds).values, np.int64)


def follow_orbit(found: Features, parameters: Parameters, frequency: float, geometry: Geometry) -> None:
    """Fill in what the whole of a polished orbit shows: ranges, exact rotation, energy, image."""
    p = found.orbit_period
    times = np.arange(p * SAMPLES + 1) / (SAMPLES * frequency)
    states = trajectory(parameters, frequency, found.points[0], times, rtol=RTOL, atol=RTOL)
    angles = np.flatnonzero(geometry.is_angle)
    turns = np.round((states[-1] - states[0])[angles] / TWO_PI)
    found.rotation = turns / p + 0.0  # no -0.0
    found.state_min, found.state_max = states.min(axis=0), states.max(axis=0)
    found.state_min[angles[turns != 0]], found.state_max[angles[turns != 0]] = -np.pi, np.pi
    energies = energy(states, parameters)
    found.energy_min, found.energy_max = float(energies.min()), float(energies.max())
    found.image = -states[SAMPLES // 2 :: SAMPLES]


def follow_points(found: Features, parameters: Parameters, frequency: float) -> None:
    """Fill in energy and image of a set from its stored points."""
    times = np.array([0.5 / frequency])
    ends = [trajectory(parameters, frequency, x, times, rtol=RTOL, atol=RTOL)[0] for x in found.points]
    found.image = -np.array(ends)
    energies = energy(found.points, parameters)
    found.energy_min, found.energy_max = float(energies.min()), float(energies.max())


def pair_mirrors(found: list[Features], threshold: float, geometry: Geometry) -> None:
    """Fill in the mirror partners: the attractor nearest to the image, if within `threshold`."""
    for a in found:
        if a.image is None:
            continue
        distances = [
            mean_distance(a.image, b.points, geometry) + float(np.abs(a.rotation + b.rotation).max())
            for b in found
        ]
        nearest = int(np.argmin(distances))
        a.mirror_distance = distances[nearest]
        a.mirror_partner = nearest if distances[nearest] <= threshold else -1


def sorted_points(points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Points in lexicographic order of their rounded, scaled values."""
    rounded = rounded_points(points, geometry)
    return np.asarray(points[np.lexsort(rounded.T[::-1])])
