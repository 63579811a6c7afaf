"""The ends of attractors along a parameter, before and after they are named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.starting_orbits import family_of, parameters_at
from pipeline.analysis.events.kinds import UNDECIDED
from pipeline.analysis.events.lines import LOCATED, Fate, Line


@dataclass(frozen=True)
class Stretch:
    """Neighbouring parameter values at which an attractor has one kind and period."""

    attractor: int
    kind: int
    period: int
    places: tuple[int, int]  # numbers of its first and last value, in rising order
    rows: tuple[int, int]  # its rows there


@dataclass(frozen=True)
class Born:
    """Verdict on the end of a chaotic set or a torus; `what` is empty if it is not decided."""

    what: str
    why: str
    value: float = np.nan
    error: float = np.nan
    doublings: tuple[float, ...] = ()
    ratio: float = np.nan
    exponent: float = np.nan  # minus the power of the distance with which laminar phases grow
    exponent_error: float = np.nan
    rotation: str = ""  # p/q of the orbit to which a torus locks


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

    @property
    def place(self) -> int:
        """Number of the last value at which the attractor is seen, in rising order."""
        return self.stretch.places[self.rises]

    @property
    def row(self) -> int:
        """Row of the attractor there."""
        return self.stretch.rows[self.rises]

    @property
    def way(self) -> int:
        """1 if the parameter rises, else -1."""
        return 1 if self.rises else -1


@dataclass(frozen=True, eq=False)
class Scene:
    """Attractors along one axis, the located branches, and what both need."""

    attractors: xr.Dataset
    located: xr.Dataset
    axis: str
    base: Parameters
    order: np.ndarray  # positions on the axis by rising value
    scale: float  # length of the whole axis
    lines: Sequence[Line]
    names: Mapping[tuple[int, int], int] = field(default_factory=dict)  # ids of joined attractors, by place and id
    verdicts: dict[Any, Any] = field(default_factory=dict)  # of detectors that look at several ends at once
    between: tuple[float, float] | None = None  # neighbouring values between which ends of sets are decided; None: all

    @property
    def along(self) -> np.ndarray:
        """Values of the axis in rising order."""
        return np.asarray(self.attractors[self.axis].values[self.order], np.float64)

    def is_asked(self, place: int, way: int) -> bool:
        """Return whether ends of chaotic sets and tori between a place and the next one are to be decided."""
        return self.between is None or {*self.along[[place, place + way]].tolist()} == {*self.between}

    def values_at(self, one: Event) -> tuple[float, float]:
        """Return the next value beyond an end, and the last one before it."""
        return float(self.along[one.place + one.way]), float(self.along[one.place])

    def family(self, place: int, period: int) -> Family:
        """Return the family of orbits of a period, or of equilibria (0), at the parameters of a place on the axis."""
        frequency, packed = parameters_at(self.attractors.isel({self.axis: int(self.order[place])}), self.base)
        return family_of(self.base.model.system, period, frequency, packed, self.axis, self.scale)

    def ids_of(self, attractor: int, place: int) -> list[int]:
        """Return the ids that an attractor has at a place."""
        return [i for (p, i), name in self.names.items() if (p, name) == (place, attractor)]


def opposite_ends(one: Event, named: Sequence[Event]) -> list[Event]:
    """Return the ends, at the next value, of the attractor to which the cells go on, if its cells go back."""
    heir = next(iter(one.to), -1)
    return [
        other
        for other in named
        if other.rises != one.rises
        and other.stretch.attractor == heir
        and other.place == one.place + one.way
        and next(iter(other.to), -1) == one.stretch.attractor
    ]


def orbit_beyond(one: Event, named: Sequence[Event]) -> Fate | None:
    """Return the end, at a bifurcation, of the orbit to which all cells go on; None if they go on to no such orbit."""
    fates = [other.fate for other in opposite_ends(one, named) if other.fate.bifurcation >= 0]
    return fates[0] if fates and len(one.to) == 1 else None


def judged(scene: Scene, one: Event, fate: Fate, found: Born) -> Event:
    """Return an end with a verdict on it that rests on the end of the orbit beyond."""
    fate = replace(fate, value=found.value, why=found.why)
    if not found.what:
        return replace(one, fate=replace(fate, bifurcation=-1))
    return replace(one, fate=fate, what=found.what, error=max(found.error, LOCATED * scene.scale), born=found)
