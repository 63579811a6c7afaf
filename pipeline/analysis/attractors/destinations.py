"""Tell on which known attractor further trajectories at a parameter point end, as the run's cells are told.

Trajectories are integrated leg by leg. After each leg `assigning.decide` tells which of them are on, or certain
to end on, a known orbit, `equilibria.approaching` which of them go to rest, and `clouds.members` which of them
are on a known set that does not close. What is left after the time that the run gave its own cells is
integrated further by `extension.extending`, which also finds new orbits. What is left then is undecided.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.extension.clouds import INSIDE, REACHED, Cloud, members
from pipeline.analysis.attractors.extension.courses import DIVERGED as COURSE_DIVERGED
from pipeline.analysis.attractors.extension.courses import Course, rest_number
from pipeline.analysis.attractors.extension.extending import Outcome, extend
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, polish
from pipeline.analysis.attractors.finding.equilibria import approaching, equilibria_near, rest_near
from pipeline.analysis.attractors.finding.points import Dynamics, Point
from pipeline.analysis.attractors.finding.requests import LEG, Settings, answer_all
from pipeline.analysis.attractors.finding.spirals import keys_of
from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.ragged import dense, isel
from pipeline.analysis.sets import Geometry
from pipeline.analysis.tolerances import CLOSURE
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, EQUILIBRIUM, PERIODIC_ORBIT, START, split_dims
from pipeline.products.attractors import IdentifyOptions

UNDECIDED, ELSEWHERE = -1, -3
"""Labels of trajectories that end on no known attractor: undecided, and on an attractor that no cell shows."""

LEAST, MOST = 256, 4096
"""Least and most sections after which undecided trajectories are handed to the extension."""

IN_CLOUD = 2 * LEG
"""Section points that a trajectory needs on a set that does not close to count as on it."""


@dataclass(frozen=True)
class Followed:
    """Ends of trajectories.

    Attributes
    ----------
    label : ndarray of int64, (n,)
        Attractor's id, `outcomes.DIVERGED`, `ELSEWHERE` or `UNDECIDED`.
    entered : ndarray, (n,)
        Drive periods or returns after which each stays near its attractor; NaN if not asked for, not decided or
        not seen.
    """

    label: np.ndarray
    entered: np.ndarray


class Destinations:
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
        self.point, self.here, self.settings, self.options = point, here, settings, options
        self.geometry: Geometry = settings.geometry
        self.orbits: list[Orbit] = []
        self.orbit_ids: list[int] = []
        self._clouds: list[Cloud] = []
        self._cloud_ids: list[int] = []
        self._rest_ids: list[int] = []
        point.equilibria = []
        for number in np.flatnonzero(here["stability"].values == ATTRACTS).tolist():
            self._add(number, here)

    def _add(self, number: int, here: xr.Dataset) -> None:
        """Add an attractor of the run to the known ones."""
        kind = int(here["kind"].values[number])
        stored = here["attractor_points"].transpose("attractor", "point", "state").values[number]
        points = stored[np.isfinite(stored).all(axis=-1)]
        if kind == EQUILIBRIUM:
            self.point.equilibria += equilibria_near(self.point, points[:1], self.geometry)
            self._rest_ids += [number] * (len(self.point.equilibria) - len(self._rest_ids))
        elif kind == PERIODIC_ORBIT and int(here["orbit_period"].values[number]):
            orbit = self._polished(points[:1], int(here["orbit_period"].values[number]))
            if orbit is not None:
                self.orbits.append(orbit)
                self.orbit_ids.append(number)
        elif kind in APERIODIC:
            cloud = self._cloud_of(here, number)
            if cloud is not None:
                self._clouds.append(cloud)
                self._cloud_ids.append(number)

    def _polished(self, point: np.ndarray, period: int) -> Orbit | None:
        return polish(
            self.point.packed[None],
            np.array([self.point.frequency]),
            point,
            np.array([period]),
            geometry=self.geometry,
            system=self.point.integrates,
            tolerance=self.settings.residual,
        )[0]

    def _cloud_of(self, here: xr.Dataset, number: int) -> Cloud | None:
        """Return the section points of the run's cells on a set that does not close; None if there are none."""
        ids = here["attractor_id"].transpose(*self.point.start_dims).values.ravel()
        paths: list[np.ndarray] = []
        for block in self.point.blocks():
            own = np.flatnonzero((ids[block.cells] == number) & block.is_bounded)
            paths += list(block.section[own])
        return Cloud.of(paths, self.geometry, self.settings.closure) if paths else None

    # ---- trajectories --------------------------------------------------------------------------

    @property
    def told(self) -> set[int]:
        """Ids of the attractors that trajectories can be told to end on."""
        return {*self.orbit_ids, *self._rest_ids, *self._cloud_ids}

    def orbit(self, number: int) -> Orbit | None:
        """Return the polished orbit of an attractor's id; None if it is no orbit."""
        return self.orbits[self.orbit_ids.index(number)] if number in self.orbit_ids else None

    def advance(self, states: np.ndarray, n: int, step: np.ndarray | None = None) -> Any:
        """Integrate trajectories over `n` sections with the run's tolerances; see `run_branches`."""
        m = len(states)
        return run_branches(
            np.broadcast_to(self.point.packed, (m, 1, len(self.point.packed))),
            np.full((m, 1), self.point.frequency),
            states,
            n_transient=0,
            n_keep=n,
            rtol=self.settings.rtol,
            atol=self.settings.atol,
            max_steps_per_period=self.settings.max_steps,
            closure_tolerance=self.settings.closure,
            max_orbit_period=self.settings.longest,
            system=replace(self.point.integrates, method=self.settings.method),
            step_size=step,
        )

    def follow(self, states: np.ndarray, near: float = 0.0) -> Followed:
        """Integrate trajectories from section states until the attractor on which each ends is known.

        Parameters
        ----------
        states
            States at a section, shape (n, state); of an autonomous flow any states.
        near
            If above 0, also find when each trajectory came within this scaled distance of its attractor for good.
        """
        flights = _Flights(states, 1.0 / self.point.frequency, near > 0.0)
        for size in _legs(min(max(self.settings.seen, LEAST), MOST)):
            if not len(flights.going):
                break
            self._take(flights, self.advance(flights.state, size, flights.step), near)
        if len(flights.going) and self.options.extend and self.options.budget:
            self._extend(flights)
        return Followed(flights.label, flights.entered)

    def _take(self, flights: _Flights, leg: Any, near: float) -> None:
        """Add a leg to the trajectories, and end those whose attractor is known."""
        rows, status = flights.going, leg.status[:, 0].copy()
        alive = np.isin(status, (Status.PERIODIC, Status.BOUNDED))
        flights.label[rows[status == Status.DIVERGED]] = DIVERGED
        for i in np.flatnonzero(status == Status.NO_RETURN) if self.point.can_rest else ():
            number = rest_near(self.point, leg.final_state[i, 0], self.geometry)
            if number is not None:
                flights.label[rows[i]] = self._rest_id(number)
        flights.add(leg, alive)
        if not len(flights.going):
            return
        section = flights.section[:, -LEG:]
        block = Block(slice(0, len(section)), section, status[alive], leg.orbit_period[alive, 0], leg.turns[alive, 0])
        found = self._labels(flights, block)
        flights.label[flights.going[found >= 0]] = found[found >= 0]
        done = flights.label[flights.going] != UNDECIDED
        if near > 0.0:
            entered = self._entered(flights, np.flatnonzero(done), near)
            flights.entered[flights.going] = entered
            done &= np.isfinite(entered)
        flights.keep(~done)

    def _labels(self, flights: _Flights, block: Block) -> np.ndarray:
        """Return the id of the attractor that each trajectory has reached or surely reaches, -1 for none."""
        label, _ = decide(block, self.orbits, 10.0 * self.settings.closure, self.geometry)
        stable = np.array([*(orbit.is_stable for orbit in self.orbits), False])
        found = np.where(stable[label], np.array([*self.orbit_ids, UNDECIDED])[label], UNDECIDED)
        if self.point.can_rest and self.point.equilibria:
            left = np.flatnonzero(found < 0)
            seconds = flights.seconds[left, -LEG:]
            number = approaching(self.point, block.section[left], seconds, self.settings.closure, self.geometry)
            for i in np.flatnonzero(number >= 0):
                found[left[i]] = self._rest_id(int(number[i]))
        if self._clouds and flights.section.shape[1] >= IN_CLOUD:
            left = np.flatnonzero(found < 0)
            number = members(flights.section[left, -IN_CLOUD:], self._clouds)
            found[left] = np.array([*self._cloud_ids, UNDECIDED])[number]
        return found

    def _rest_id(self, number: int) -> int:
        return self._rest_ids[number] if number < len(self._rest_ids) else ELSEWHERE

    def _entered(self, flights: _Flights, rows: np.ndarray, near: float) -> np.ndarray:
        """Return after how many sections each of the trajectories `rows` stays near its attractor; NaN where it is
        not near yet.
        """
        entered = np.full(len(flights.going), np.nan)
        path = np.concatenate([flights.start[flights.going][:, None], flights.section], axis=1)
        for row in rows.tolist():
            inside = self._is_near(path[row], int(flights.label[flights.going[row]]), near)
            if inside[-1]:
                entered[row] = len(inside) - int(np.argmin(inside[::-1])) if not inside.all() else 0
        return entered

    def _is_near(self, path: np.ndarray, number: int, near: float) -> np.ndarray:
        """Return for each state of a path whether it is near an attractor, an orbit's states at their phases."""
        orbit = self.orbit(number)
        if orbit is not None:
            phase = int(np.argmin(self.geometry.distance(orbit.points, path[-1])))
            on_phase = orbit.points[(phase - np.arange(len(path))[::-1]) % orbit.period]
            return np.asarray(self.geometry.distance(path, on_phase) <= near)
        if number in self._rest_ids:
            rest = self.point.equilibria[self._rest_ids.index(number)]
            return np.asarray(self.geometry.distance(path, rest.state) <= near)
        cloud = self._clouds[self._cloud_ids.index(number)] if number in self._cloud_ids else None
        if cloud is None:
            return np.ones(len(path), bool)
        inside = cloud.distances(path) <= REACHED
        share = np.cumsum(inside[::-1])[::-1] / np.arange(len(inside), 0, -1)
        return np.asarray(share >= INSIDE)

    # ---- extension -----------------------------------------------------------------------------

    def _extend(self, flights: _Flights) -> None:
        """Integrate the undecided trajectories further by the extension of the run's cells, and label them."""
        section, rows = flights.section[:, -LEG:], flights.going
        cells = self._as_point(section, flights)
        loose = np.full(len(rows), UNDECIDED, np.int64)
        work = extend(cells, self.orbits, loose, self.settings, self.options.budget, self.options.n_sample)
        found = answer_all({(): work}, {(): cells}, self.settings)[()]
        ends = {course.key: self._end_of(course, found) for course in found.courses}
        keys = keys_of(section, self.settings.closure, self.geometry)
        flights.label[rows] = [ends.get(key, UNDECIDED) for key in keys.tolist()]

    def _as_point(self, section: np.ndarray, flights: _Flights) -> Point:
        """Return trajectories as the cells of a parameter point."""
        n = len(section)
        cube = xr.Dataset(
            {
                "section": ((START, "period_index", "state"), section),
                "status": ((START,), np.full(n, int(Status.BOUNDED), np.int8)),
                "orbit_period": ((START,), np.zeros(n, np.int16)),
                "step_size": ((START,), flights.step),
            }
        )
        return replace(
            self.point,
            cube=cube,
            at={},
            arrays={},
            start_dims=(START,),
            block_cells=n,
            at_rest=None,
            on_cycle=None,
            n_periods=n * flights.section.shape[1],
            _whole=None,
        )

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
            number = int(members(course.extension[None, -IN_CLOUD:], self._clouds)[0])
            return self._cloud_ids[number] if number >= 0 else UNDECIDED
        return UNDECIDED


class _Flights:
    """Trajectories that are being integrated, with their last states and sections."""

    def __init__(self, states: np.ndarray, period: float, whole: bool) -> None:
        self.start, self.period, self.whole = np.array(states, np.float64), period, whole
        self.label = np.full(len(states), UNDECIDED, np.int64)
        self.entered = np.full(len(states), np.nan)
        self.going = np.arange(len(states))
        self.state, self.step = self.start.copy(), np.zeros(len(states))
        self.section = self.start[:, None][:, :0]
        self.seconds = np.zeros((len(states), 0))

    def add(self, leg: Any, alive: np.ndarray) -> None:
        """Append a leg's sections, and drop the trajectories that it ended."""
        times = leg.return_time
        seconds = np.full(leg.section[:, 0].shape[:2], self.period) if times is None else times[:, 0]
        self.section = np.concatenate([self.section, leg.section[:, 0]], axis=1)
        self.seconds = np.concatenate([self.seconds, seconds], axis=1)
        if not self.whole:
            self.section, self.seconds = self.section[:, -IN_CLOUD:], self.seconds[:, -IN_CLOUD:]
        self.state, self.step = leg.final_state[:, 0], np.nan_to_num(leg.step_size[:, 0])
        self.keep(alive)

    def keep(self, which: np.ndarray) -> None:
        """Keep some of the trajectories that go on."""
        for name in ("going", "state", "step", "section", "seconds"):
            setattr(self, name, getattr(self, name)[which])


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
        closure=CLOSURE,
        longest=options.max_orbit_period,
        residual=options.residual,
    )
    dims, _ = split_dims(attractors["attractor_id"])
    for index, point in points.items():
        here = dense(isel(attractors, dict(zip(dims, index, strict=True))), points=True)
        yield index, Destinations(point, here, settings, options)
