"""Tell on which known attractor further trajectories at a parameter point end, as the run's cells are told.

Trajectories are integrated leg by leg. After each leg `assigning.decide` tells which of them are on, or certain
to end on, a known orbit, `equilibria.approaching` which of them go to rest, and `clouds.members` which of them
are on a known set that does not close. What is left after the time that the run gave its own cells is
integrated further by `extension.extending`, which also finds new orbits. What is left then is undecided.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.attractors.declaration import IdentifyOptions
from pipeline.analysis.attractors.extension.clouds import INSIDE, REACHED, Cloud, members
from pipeline.analysis.attractors.extension.courses import COURSE_DIVERGED, Course, rest_number
from pipeline.analysis.attractors.extension.extending import Outcome, extend
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, polish
from pipeline.analysis.attractors.finding.equilibria import approaching, equilibria_near, rest_near
from pipeline.analysis.attractors.finding.points import Dynamics, Point
from pipeline.analysis.attractors.finding.requests import LEG, Settings, answer_all
from pipeline.analysis.attractors.finding.spirals import keys_of
from pipeline.analysis.attractors.flight import Flight
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, EQUILIBRIUM, PERIODIC_ORBIT, split_dims
from pipeline.results.outcomes import DIVERGED
from pipeline.results.ragged import dense, isel
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import CELL_CLOSURE

UNDECIDED, ELSEWHERE = -1, -3
"""Labels of trajectories that end on no known attractor: undecided, and on an attractor that no cell shows."""


IN_CLOUD = 2 * LEG
"""Section points that a trajectory needs on a set that does not close to count as on it."""


@dataclass(frozen=True)
class Followed:
    """Ends of trajectories."""

    label: np.ndarray  # int64, (n,): attractor's id, `outcomes.DIVERGED`, `ELSEWHERE` or `UNDECIDED`
    # (n,): drive periods or returns after which each stays near its attractor; NaN if not asked for, not decided or
    # not seen
    entered: np.ndarray


class KnownSets:
    """The orbits and the sets that do not close at a parameter point, each with its number.

    Parameters
    ----------
    point
        Parameter point with its cells.
    geometry
        Geometry of the states.
    tolerance
        Scaled distance within which a closed trajectory is on an orbit.
    residual
        Scaled residual that Newton's method is to reach.
    """

    def __init__(self, point: Point, geometry: Geometry, tolerance: float, residual: float) -> None:
        self.point, self.geometry, self._tolerance, self._residual = point, geometry, tolerance, residual
        self.orbits: list[Orbit] = []
        self.orbit_ids: list[int] = []
        self.clouds: list[Cloud] = []
        self.cloud_ids: list[int] = []

    def polished(self, points: np.ndarray, periods: np.ndarray) -> list[Orbit | None]:
        """Return the orbits to which Newton's method converges from states (n, state) with periods (n,)."""
        n = len(points)
        return polish(
            np.tile(self.point.packed, (n, 1)),
            np.full(n, self.point.frequency),
            points,
            periods,
            geometry=self.geometry,
            system=self.point.integrates,
            tolerance=self._residual,
        )

    def add_orbit(self, orbit: Orbit, number: int) -> None:
        """Add an orbit; threads may ask for orbits at the same time."""
        self.orbits.append(orbit)
        self.orbit_ids.append(number)

    def add_cloud(self, ids: np.ndarray, number: int, least: float) -> None:
        """Add a set that does not close by the section points of the cells whose id is its number, if there are any;
        `least` is the smallest spacing of its points.
        """
        paths: list[np.ndarray] = []
        for block in self.point.blocks():
            paths += list(block.section[np.flatnonzero((ids[block.cells] == number) & block.is_bounded)])
        if paths:
            self.clouds.append(Cloud.of(paths, self.geometry, least))
            self.cloud_ids.append(number)

    def on_orbits(self, block: Block, *, only_stable: bool = False) -> np.ndarray:
        """Return the number of the orbit that each trajectory has reached or surely reaches, -1 for none."""
        ids = np.array([*self.orbit_ids, -1])
        orbits = self.orbits[: len(ids) - 1]
        label, _ = decide(block, orbits, self._tolerance, self.geometry)
        stable = np.array([*(orbit.is_stable or not only_stable for orbit in orbits), False])
        return np.where(stable[label], ids[label], -1)

    def on_clouds(self, section: np.ndarray) -> np.ndarray:
        """Return the number of the set that does not close on which sections (n, k, state) lie, -1 for none."""
        return np.asarray(np.array([*self.cloud_ids, -1])[members(section, self.clouds)])


class Destinations(KnownSets):
    """The known attractors of a parameter point, as ends of trajectories.

    Parameters
    ----------
    point
        Parameter point with its cells, from `points.slabs`.
    here
        Attractors of the point: result of `match` without its parameter dims.
    settings
        Settings of the integration.
    options
        Options by which the attractors were found.
    """

    def __init__(self, point: Point, here: xr.Dataset, settings: Settings, options: IdentifyOptions) -> None:
        super().__init__(point, settings.geometry, 10.0 * settings.closure, settings.residual)
        self.here, self.settings, self.options = here, settings, options
        self._rest_ids: list[int] = []
        point.equilibria = []
        for number in np.flatnonzero(here["stability"].values == ATTRACTS).tolist():
            self._add(number)

    def _add(self, number: int) -> None:
        """Add an attractor of the run to the known ones."""
        kind, period = (int(self.here[name].values[number]) for name in ("kind", "orbit_period"))
        stored = self.here["attractor_points"].transpose("attractor", "point", "state").values[number]
        points = stored[np.isfinite(stored).all(axis=-1)]
        if kind == EQUILIBRIUM:
            self.point.equilibria += equilibria_near(self.point, points[:1], self.geometry)
            self._rest_ids += [number] * (len(self.point.equilibria) - len(self._rest_ids))
        elif kind == PERIODIC_ORBIT and period:
            (orbit,) = self.polished(points[:1], np.array([period]))
            if orbit is not None:
                self.add_orbit(orbit, number)
        elif kind in APERIODIC:
            ids = self.here["attractor_id"].transpose(*self.point.start_dims).values.ravel()
            self.add_cloud(ids, number, self.settings.closure)

    # ---- trajectories --------------------------------------------------------------------------

    @property
    def told(self) -> set[int]:
        """Ids of the attractors that trajectories can be told to end on."""
        return {*self.orbit_ids, *self._rest_ids, *self.cloud_ids}

    def orbit(self, number: int) -> Orbit | None:
        """Return the polished orbit of an attractor's id; None if it is no orbit."""
        return self.orbits[self.orbit_ids.index(number)] if number in self.orbit_ids else None

    def fly(self, states: np.ndarray, most: int = LEG) -> Flight:
        """Return trajectories from section states (n, state); of an autonomous flow from any states."""
        return self.settings.fly(self.point.packed, self.point.frequency, states, most)

    def follow(self, states: np.ndarray, near: float = 0.0) -> Followed:
        """Integrate trajectories from section states until the attractor on which each ends is known.

        Parameters
        ----------
        states
            States at a section, shape (n, state); of an autonomous flow any states.
        near
            If above 0, also find when each trajectory came within this scaled distance of its attractor for good.
        """
        least, most = 256, 4096  # sections after which undecided trajectories are handed to the extension, and most
        flight = self.fly(states, most if near else IN_CLOUD)
        ends = Followed(np.full(len(states), UNDECIDED, np.int64), np.full(len(states), np.nan))
        for size in _legs(min(max(self.settings.seen, least), most)):
            if not len(flight.rows):
                break
            self._take(flight, flight.advance(size), ends, near)
        if len(flight.rows) and self.options.extend and self.options.budget:
            self._extend(flight, ends.label)
        return ends

    def _take(self, flight: Flight, leg: Block, ends: Followed, near: float) -> None:
        """End the trajectories whose attractor is known after a leg."""
        rows, states = flight.rows, leg.state
        ends.label[rows[leg.status == Status.DIVERGED]] = DIVERGED
        for i in np.flatnonzero(leg.status == Status.NO_RETURN) if self.point.can_rest else ():
            number = rest_near(self.point, states[i], self.geometry)
            if number is not None:
                ends.label[rows[i]] = self._rest_id(number)
        leg = leg.take(flight.flying)
        flight.keep(flight.flying)
        rows = flight.rows
        if not len(rows):
            return
        found = self._reached(replace(leg, section=flight.section[:, -LEG:]), flight)
        ends.label[rows[found >= 0]] = found[found >= 0]
        done = ends.label[rows] != UNDECIDED
        if near > 0.0:
            entered = ends.entered[rows] = self._entered(flight, np.where(done, ends.label[rows], UNDECIDED), near)
            done &= np.isfinite(entered)
        flight.keep(~done)

    def _reached(self, block: Block, flight: Flight) -> np.ndarray:
        """Return the id of the attractor that each trajectory has reached or surely reaches, -1 for none."""
        found = self.on_orbits(block, only_stable=True)
        if self.point.can_rest and self.point.equilibria:
            left = np.flatnonzero(found < 0)
            seconds = flight.seconds[left, -LEG:]
            number = approaching(self.point, block.section[left], seconds, self.settings.closure, self.geometry)
            for i in np.flatnonzero(number >= 0):
                found[left[i]] = self._rest_id(int(number[i]))
        if self.clouds and flight.section.shape[1] >= IN_CLOUD:
            left = np.flatnonzero(found < 0)
            found[left] = self.on_clouds(flight.section[left, -IN_CLOUD:])
        return found

    def _rest_id(self, number: int) -> int:
        return self._rest_ids[number] if number < len(self._rest_ids) else ELSEWHERE

    def _entered(self, flight: Flight, label: np.ndarray, near: float) -> np.ndarray:
        """Return after how many sections each trajectory stays near its attractor; NaN where it is not near yet, or
        undecided.
        """
        entered = np.full(len(label), np.nan)
        path = np.concatenate([flight.start[flight.rows][:, None], flight.section], axis=1)
        for row in np.flatnonzero(label != UNDECIDED).tolist():
            inside = self._is_near(path[row], int(label[row]), near)
            if inside[-1]:
                entered[row] = len(inside) - int(np.argmin(inside[::-1])) if not inside.all() else 0
        return entered

    def _is_near(self, path: np.ndarray, number: int, near: float) -> np.ndarray:
        """Return for each state of a path whether it is near an attractor, an orbit's states at their phases."""
        orbit, units = self.orbit(number), Geometry.in_units(self.point.integrates)
        if orbit is not None:
            phase = int(np.argmin(self.geometry.distance(orbit.points, path[-1])))
            on_phase = orbit.points[(phase - np.arange(len(path))[::-1]) % orbit.period]
            return np.asarray(units.distance(path, on_phase) <= near)
        if number in self._rest_ids:
            rest = self.point.equilibria[self._rest_ids.index(number)]
            return np.asarray(units.distance(path, rest.state) <= near)
        if number not in self.cloud_ids:
            return np.ones(len(path), bool)
        inside = self.clouds[self.cloud_ids.index(number)].distances(path) <= REACHED
        share = np.cumsum(inside[::-1])[::-1] / np.arange(len(inside), 0, -1)
        return np.asarray(share >= INSIDE)

    def _extend(self, flight: Flight, label: np.ndarray) -> None:
        """Integrate the undecided trajectories further by the extension of the run's cells, and label them."""
        section, rows = flight.section[:, -LEG:], flight.rows
        n, zero = len(rows), np.zeros(len(rows), np.int16)
        block = flight.block(section, np.zeros((n, self.point.n_angles), np.int64), zero)
        cells = self.point.holding(block, n * flight.section.shape[1])
        loose = np.full(n, UNDECIDED, np.int64)
        work = extend(cells, self.orbits, loose, self.settings, self.options.budget, self.options.n_sample)
        found = answer_all({(): work}, {(): cells}, self.settings)[()]
        ends = {course.key: self._end_of(course, found) for course in found.courses}
        keys = keys_of(section, self.settings.closure, self.geometry)
        label[rows] = [ends.get(key, UNDECIDED) for key in keys.tolist()]

    def _end_of(self, course: Course, found: Outcome) -> int:
        """Return the label of a trajectory that the extension integrated."""
        if course.end >= 0:
            if course.end < len(self.orbit_ids):
                return self.orbit_ids[course.end]
            return ELSEWHERE if found.orbits[course.end].is_stable else UNDECIDED
        rest = rest_number(course.end)
        if course.end == COURSE_DIVERGED:
            return DIVERGED
        if rest is not None:
            return self._rest_id(rest)
        if course.goes_on and course.length >= IN_CLOUD:
            return int(self.on_clouds(course.extension[None, -IN_CLOUD:])[0])
        return UNDECIDED


def _legs(most: int) -> Iterator[int]:
    """Yield lengths of legs, short ones first, up to `most` sections in all."""
    done, size = 0, 8
    while done < most:
        yield size
        done += size
        size = min(max(size, done), LEG)


def destinations_at(
    cube: xr.Dataset, attractors: xr.Dataset, points: dict[tuple[int, ...], Point]
) -> Iterator[tuple[tuple[int, ...], Destinations]]:
    """Yield the known attractors of some parameter points, by index in the cube, as ends of trajectories."""
    dynamics, options = Dynamics.of(cube), IdentifyOptions.from_attrs(attractors.attrs)
    settings = Settings.of(
        cube,
        dynamics.system,
        dynamics.geometry,
        closure=CELL_CLOSURE,
        longest=options.max_orbit_period,
        residual=options.residual,
    )
    dims, _ = split_dims(attractors["attractor_id"])
    for index, point in points.items():
        here = dense(isel(attractors, dict(zip(dims, index, strict=True))), points=True)
        yield index, Destinations(point, here, settings, options)
