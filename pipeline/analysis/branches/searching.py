"""Search all periodic orbits at several values of a branches' parameter, to start from those of detached branches.

A closed branch that bifurcations connect to no other one, an isola, is reached from cells only if one of them ends on
it. The search of `deflation` needs no such cell. After the branches are followed, the orbits at each value are those of
the search and of all branches that pass it, each once, and their indices are added up. The sum is expected to be the
Euler characteristic of the state space if all trajectories stay bounded (Lefschetz). A sum that differs proves that
orbits are missing; an equal sum does not prove that none is, as the two orbits of an isola have opposite indices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.models.model import Model, Parameters
from pipeline.analysis.branches.deflation import (
    FoundOrbit,
    add_orbits,
    coverage,
    expected_index,
    index_sums,
    search_orbits,
    starts_around,
)
from pipeline.analysis.branches.following import Branch
from pipeline.analysis.branches.known import Start, chords_at, same_others
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.starting_orbits import family_of, parameters_at, sections_of
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import DIVERGED, FAILED, ORIGIN, PENDING, grid_dim, parameter_units, split_dims

VERDICTS = ("agrees", "missing", "diverged", "unfinished", "flow")
"""Values of `index_verdict`: whether the indices add up as expected. There is nothing to expect if cells of the run
diverged or did not finish, or for the return map of a flow, which need not be defined everywhere."""


@dataclass(eq=False)
class Place:
    """A parameter point at which all orbits are searched."""

    family: Family  # of period 1, with the parameter's value among its parameters
    value: float  # value of the continuation parameter
    where: Mapping[str, float]  # values of the run's other axes, by dim
    seen: np.ndarray  # section points of the run's cells with these values, (any, n_states)
    reach: np.ndarray  # least and largest initial state of these cells, (2, n_states)
    hindrance: str  # verdict if the sum of the indices is not known, else empty
    found: list[FoundOrbit] = field(default_factory=list)
    coverage: float = np.nan  # estimated share of starts that lead to an orbit found

    @property
    def system(self) -> System:
        """System of equations."""
        return self.family.system

    def search(self, periods: np.ndarray, n_starts: Sequence[int] = (100, 400)) -> None:
        """Search the orbits of some periods, with the next number of starts if the sum of the indices shows that some
        are missing.
        """
        for n in n_starts:
            starts = starts_around(self.seen, n, 0, self.system, self.reach)
            found = search_orbits(
                np.tile(starts, (len(periods), 1)),
                np.repeat(periods, n),
                self.family.frequency_hz,
                self.family.parameters,
                self.system,
                what=f"searching orbits at {self.value:g}",
            )
            self.coverage = coverage(found)
            self._add([(one.points[0], one.period) for one in found])
            if "missing" not in self.verdicts(periods):
                return

    def starts(self) -> list[Start]:
        """Return the orbits found as starts of branches."""
        return [Start(replace(self.family, period=one.period), one.points[0], self.value) for one in self.found]

    def add_branches(self, branches: Sequence[Branch], longest: int) -> None:
        """Add the orbits of branches that pass this point, up to a longest period."""
        own = [b for b in branches if 0 < b.family.period <= longest and same_others(b.family, self.family)]
        scaled = self.value / self.family.scales[0]
        self._add([(b.family.state(guess), b.family.period) for b in own for *_, guess in chords_at(b, scaled)])

    def verdicts(self, periods: np.ndarray) -> list[str]:
        """Judge the sum of the indices for each of some periods: values of `VERDICTS`."""
        sums, expected = index_sums(self.found, int(periods[-1])), expected_index(self.system)
        return [self.hindrance or ("agrees" if sums[p] == expected else "missing") for p in periods.tolist()]

    def _add(self, near: Sequence[tuple[np.ndarray, int]]) -> None:
        states, periods = np.array([s for s, _ in near]), np.array([p for _, p in near])
        add_orbits(self.found, states, periods, 1, self.family.frequency_hz, self.family.parameters, self.system)
        self.found = [one for one in self.found if not one.is_rest]


def places_of(
    cube: xr.Dataset, parameters: Parameters, parameter: str, interval: tuple[float, float], n: int
) -> list[Place]:
    """Return the parameter points at which orbits are searched: some values of the parameter, for all other axes.

    Parameters
    ----------
    cube
        Result cube of the run.
    parameters
        Parameters of the run, apart from those on the cube's axes.
    parameter, interval
        Continuation parameter and its interval; its length counts as 1.
    n
        Number of values, the middles of as many equal parts of the interval.
    """
    low, high = interval
    values = low + (high - low) * (np.arange(n) + 0.5) / max(n, 1)
    places = []
    for cells, where, family in rows_of(cube, parameters, parameter, high - low):
        one = place_at(cells, parameters, family, np.nan)
        for value in values.tolist():
            places.append(replace(one, family=family_at(family, value), value=value, where=where, found=[]))
    return places


def place_at(cells: xr.Dataset, parameters: Parameters, family: Family, value: float) -> Place:
    """Return the parameter point of a family at which orbits are searched, near the sections of some cells."""
    return Place(family, value, {}, sections_of(cells), _reach(cells, parameters), _hindrance(cells, parameters))


def rows_of(
    cube: xr.Dataset, parameters: Parameters, parameter: str, scale: float
) -> Iterator[tuple[xr.Dataset, dict[str, float], Family]]:
    """Yield, for each point of the run's axes other than a parameter, its cells, its values and a family of period
    1.
    """
    dims = [d for d in split_dims(cube["status"])[0] if d != parameter]
    for index in np.ndindex(*(cube.sizes[d] for d in dims)):
        cells = cube.isel(dict(zip(dims, index, strict=True)))
        frequency, packed = parameters_at(cells.isel({parameter: 0}, missing_dims="ignore"), parameters)
        family = family_of(parameters.model.system, 1, frequency, packed, parameter, scale)
        yield cells, {d: float(cells.coords[d]) for d in dims}, family


def family_at(family: Family, value: float) -> Family:
    """Return a family whose fixed parameters, too, have a value of the free one."""
    row = family.rows(family.unknowns(np.zeros(family.system.n_states), [value])[None])
    return replace(family, frequency_hz=float(row.frequency_hz[0]), parameters=row.parameters[0])


def _reach(cells: xr.Dataset, parameters: Parameters) -> np.ndarray:
    """Return the least and the largest initial state of some cells; 0 for a state without initial values."""
    own = [cells.coords.get(grid_dim(name)) for name in parameters.model.system.state_names]
    own = [None if a is None or ORIGIN in a.attrs else a for a in own]  # counted from elsewhere
    return np.array([[0.0 if a is None else float(end(a)) for a in own] for end in (np.nanmin, np.nanmax)])


def _hindrance(cells: xr.Dataset, parameters: Parameters) -> str:
    if parameters.model.crossing is not None:
        return "flow"
    status = cells["status"].values
    if (status == DIVERGED).any():
        return "diverged"
    return "unfinished" if np.isin(status, (PENDING, *FAILED)).any() else ""


def where_variables(dim: str, places: Sequence[Any], model: Model) -> dict[str, Any]:
    """Return the values of the parameter (``DIM_value``) and of other axes at the places of a search."""
    columns = {"value": [p.value for p in places], **{d: [p.where[d] for p in places] for d in places[0].where}}
    units = {name: parameter_units(places[0].family.free[0] if name == "value" else name, model) for name in columns}
    return {
        f"{dim}_{name}": (dim, values, {"units": units[name], "long_name": "where it was searched"})
        for name, values in columns.items()
    }


def searched_variables(
    places: Sequence[Place], branches: Sequence[Branch], periods: np.ndarray, model: Model
) -> dict[str, Any]:
    """Count the orbits at each place, with those on branches, and return variables on the counts; none without places.

    Returns, over ``searched``: ``searched_value`` and the values of other axes (``searched_...``), and ``coverage``,
    the estimated share of starts that lead to a known orbit. Over ``searched`` and ``times``: ``n_orbits``, the number
    of orbits of this least period, ``index_sum`` of the fixed points of the map taken so many times, and
    ``index_verdict``.
    """
    if not places:
        return {}
    for place in places:
        place.add_branches(branches, int(periods[-1]))
    counts = [[sum(one.period == p for one in place.found) for p in periods.tolist()] for place in places]
    sums = [list(index_sums(place.found, int(periods[-1])).values()) for place in places]
    codes = [[VERDICTS.index(verdict) for verdict in place.verdicts(periods)] for place in places]
    both = ("searched", "times")
    return {
        **where_variables("searched", places, model),
        "coverage": ("searched", [p.coverage for p in places]),
        "n_orbits": (both, np.array(counts, np.int32)),
        "index_sum": (both, np.array(sums, np.int32)),
        "index_verdict": (both, np.array(codes, np.int8), code_flags(VERDICTS)),
        "times": ("times", periods.astype(np.int32)),
    }
