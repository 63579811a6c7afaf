"""The ends of attractors along a parameter, before and after they are named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.starting_orbits import family_of, parameters_at
from pipeline.analysis.events.cascades import Born
from pipeline.analysis.events.lines import Fate, Line
from pipeline.analysis.events.names import UNDECIDED


@dataclass(frozen=True)
class Stretch:
    """Neighbouring parameter values at which an attractor has one kind and period."""

    attractor: int
    kind: int
    period: int
    places: tuple[int, int]  # numbers of its first and last value, in rising order
    rows: tuple[int, int]  # its rows there


@dataclass(frozen=True)
class Event:
    """An end of a stretch, or a change between two stretches of one attractor."""

    stretch: Stretch
    rises: bool
    fate: Fate
    what: str = UNDECIDED
    error: float = np.nan
    beyond: int = -1  # place of the run's next value, or of the one after it if the event lies at the next value
    to: Mapping[int, int] = field(default_factory=dict)  # numbers of cells by the id on which they go on there
    n_cells: int = 0
    after: Stretch | None = None  # the attractor beyond a change
    born: Born | None = None  # evidence of the end of a chaotic set or a torus


@dataclass(frozen=True, eq=False)
class Scene:
    """Attractors along one axis, the located branches, and what both need."""

    attractors: xr.Dataset
    located: xr.Dataset
    axis: str
    base: Parameters
    order: np.ndarray  # positions on the axis by rising value
    lines: Sequence[Line]
    names: Mapping[tuple[int, int], int] = field(default_factory=dict)  # ids of joined attractors, by place and id

    @property
    def along(self) -> np.ndarray:
        """Values of the axis in rising order."""
        return np.asarray(self.attractors[self.axis].values[self.order], np.float64)

    @property
    def scale(self) -> float:
        """Length of the axis."""
        return float(np.ptp(self.along))

    def family(self, place: int, period: int) -> Family:
        """Return the family of orbits of a period, or of equilibria (0), at the parameters of a place on the axis."""
        frequency, packed = parameters_at(self.attractors.isel({self.axis: int(self.order[place])}), self.base)
        return family_of(self.base.model.system, period, frequency, packed, self.axis, self.scale)

    def ids_of(self, attractor: int, place: int) -> list[int]:
        """Return the ids that an attractor has at a place."""
        return [i for (p, i), name in self.names.items() if (p, name) == (place, attractor)]
