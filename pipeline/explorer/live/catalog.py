"""List the known attractors at a parameter point, and decide which of them a live trajectory has reached.

Where the run's attractors are kept in ``derived/``, those of the point are taken from there with their ids,
and a trajectory is matched as `pipeline.analysis.attractors` matches the cube's cells: closed or on its way
to a polished orbit (`assigning.decide`), at an equilibrium, on a limit cycle, or on a set that does not close
by the section points that it shares with it (`clouds.members`). What closes elsewhere is polished and
becomes an entry of its own, without an id: so live trajectories are told apart by the same rules where no
analysis was made. There is no search for sets that do not close then: cells that do not close have one entry
for each motion that the model's classifier tells, and are not settled.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.attractors import features
from pipeline.analysis.attractors.declaration import IdentifyOptions
from pipeline.analysis.attractors.destinations import KnownSets
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, number_of, raw_orbit
from pipeline.analysis.attractors.finding.equilibria import tell_rest
from pipeline.analysis.attractors.finding.known_sets import Cycle
from pipeline.analysis.attractors.finding.limit_cycles import number_of_cycle, tell_cycles
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.spirals import Recurrence
from pipeline.explorer.data.orbits import orbit_series
from pipeline.explorer.live.settling import Place
from pipeline.layout.vocabulary import ABSENT, APERIODIC, ATTRACTS, EQUILIBRIUM, NOT_SETTLED, PERIODIC_ORBIT, split_dims
from pipeline.results.ragged import N_IDS, dense, dims_of, isel
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import SAME_SECONDS, STRICT


@dataclass(frozen=True, eq=False)
class Entry:
    """Entry of a catalog: an attractor, or a class of trajectories that reached no known attractor."""

    number: int  # number of the entry in slices: the run's id of an attractor, or a larger number for any other entry
    attractor: int | None  # the run's id
    kind: int  # of `vocabulary.KINDS`; absent for a class of cells that is no attractor
    period: int  # drive periods or returns; 0 if not closed
    motion: int  # code of the model's classifier
    status: int  # code of `Status`, of a class of cells that ended; 0 else
    points: np.ndarray  # (n, state); section points; none of a class of cells
    seconds: float = np.nan  # period of a limit cycle; NaN else
    stability: int = 0  # of `vocabulary.STABILITIES`; 0 of a class of cells that ended


@dataclass(frozen=True, eq=False)
class Known:
    """The attractors and cells that a run holds at one parameter point; None where it holds none."""

    attractors: xr.Dataset | None = None  # attractors of all parameter points of the run
    cells: xr.Dataset | None = None  # the cube at the point; None where it has no such point
    index: tuple[int, ...] | None = None  # index of the point in the cube

    def here(self) -> xr.Dataset | None:
        """Return the stored attractors of this parameter point; None if there are none."""
        if self.attractors is None or self.index is None or self.cells is None:
            return None
        at = dict(zip(dims_of(self.attractors), self.index, strict=True))
        return dense(isel(self.attractors, at), points=True)


class Catalog:
    """Catalog of the attractors at one parameter point, which grows as new ones are found. Threads can share it."""

    def __init__(self, place: Place, known: Known, closure_tolerance: float) -> None:
        self.place, self.model = place, place.parameters.model
        self._geometry = Geometry.of(self.model)
        here = known.here()
        self.options = IdentifyOptions.from_attrs({} if here is None else here.attrs)
        self.tolerance = _tolerance_of(here, closure_tolerance)
        self._point = self._point_of(known.cells)
        self._sets = KnownSets(self._point, self._geometry, self.tolerance, self.options.residual)
        self._lock = threading.RLock()
        self.entries: list[Entry] = []
        self.n_ids = 0 if known.attractors is None else int(known.attractors.attrs[N_IDS])
        if here is not None:
            self._take(here)

    # ---- what the run knows ------------------------------------------------------------------

    def _take(self, here: xr.Dataset) -> None:
        """Add the run's stored attractors of this parameter point to the catalog."""
        present = np.flatnonzero(here["kind"].values != ABSENT)
        points = {int(i): _finite(here["attractor_points"].values[i]) for i in present}
        periods = here["orbit_period"].values
        closed = [i for i in points if here["kind"].values[i] == PERIODIC_ORBIT and periods[i] > 0]
        orbits = self._sets.polished(
            np.array([points[i][0] for i in closed]), np.array([periods[i] for i in closed], np.int64)
        )
        found = dict(zip(closed, orbits, strict=True))
        ids = here["attractor_id"].transpose(*self._point.start_dims).values.ravel()
        for i, own in points.items():
            kind = int(here["kind"].values[i])
            side = int(here["side"].values[i]) if "side" in here else 0
            seconds = float(here["period_s"].values[i])
            stability = int(here["stability"].values[i])
            entry = Entry(i, i, kind, int(periods[i]), side, 0, own, seconds, stability)
            self.entries.append(entry)
            if i in found:
                self._sets.add_orbit(found[i] or raw_orbit(own, self._geometry), i)
            elif kind in APERIODIC:
                self._sets.add_cloud(ids, i, self.tolerance)

    # ---- where trajectories are ----------------------------------------------------------------

    def on_orbits(self, block: Block) -> np.ndarray:
        """Return the catalog number of the periodic orbit that each cell has reached or surely will reach; -1 for
        none.
        """
        return self._sets.on_orbits(block)

    def unsure(self, block: Block, numbers: np.ndarray) -> np.ndarray:
        """Return the undecided cells that nearly return to earlier section points: they are worth integrating on."""
        rows = np.flatnonzero(block.is_bounded & (numbers < 0))
        near = np.zeros(len(numbers), bool)
        longest = self.options.max_orbit_period
        near[rows] = Recurrence.of(block.section[rows], longest, self._geometry).is_near
        if self.tolerance > STRICT:
            near |= block.is_closed & (numbers < 0)
        return near

    def conclude(self, block: Block, *, final: bool = True, strictly: bool = False) -> np.ndarray:
        """Return the catalog number of the attractor on which each cell ends. An unknown orbit becomes a new entry.

        With `final` every cell gets one; else -1 stays for what is neither on an orbit nor at rest. With `strictly`
        cells count as closed within a small distance, however loosely the run's own do.
        """
        numbers = np.full(len(block.status), -1, np.int64)
        if self._point.can_rest:
            block = self._rest(block, numbers)
        numbers = np.where(numbers < 0, self.on_orbits(block), numbers)
        if strictly or self.tolerance <= STRICT:
            self._learn(block, numbers)
        if final:
            self._in_sets(block, numbers)
            for row in np.flatnonzero(numbers < 0):
                numbers[row] = self._class_of(block, int(row)).number
        return numbers

    def _rest(self, block: Block, numbers: np.ndarray) -> Block:
        """Decide which cells of a flow end at equilibria or on limit cycles, and write their catalog numbers into
        `numbers`.
        """
        point = self._point.holding(block)
        tell_rest([point], self.tolerance, self._geometry)
        for k, found in enumerate(point.equilibria):
            here = self._entry_near(EQUILIBRIUM, found.state)
            entry = here or self._new(EQUILIBRIUM, 0, found.state[None], stability=found.stability)
            assert point.at_rest is not None
            numbers[point.at_rest == k] = entry.number
        if self.model.crossing is None:
            options = self.options
            tell_cycles([point], self.tolerance, options.max_orbit_period, options.residual, self._geometry)
            for k, cycle in enumerate(point.cycles):
                assert point.on_cycle is not None
                own = point.on_cycle == k
                last = block.section[own][0, -1:]
                entry = self._entry_of(cycle, point) or self._new(
                    PERIODIC_ORBIT, 0, last, seconds=cycle.seconds, stability=ATTRACTS
                )
                numbers[own] = entry.number
        status = np.where(numbers >= 0, np.int8(Status.NO_RETURN), block.status)
        return replace(block, status=status)

    def _learn(self, block: Block, numbers: np.ndarray) -> None:
        """Add the periodic orbits of undecided cells to the catalog, and write their catalog numbers into `numbers`."""
        most = 64  # attractors told apart besides those of the run; what closes elsewhere is told by its period alone
        for row in np.flatnonzero(block.is_closed & (numbers < 0)):
            if numbers[row] >= 0 or self._n_new >= most:
                continue
            own = block.section[row]
            period = min(int(block.orbit_period[row]), len(own))
            (orbit,) = self._sets.polished(own[-1:], np.array([period]))
            self._enter(orbit or raw_orbit(own[-period:], self._geometry))
            again = self.on_orbits(block)
            numbers[numbers < 0] = again[numbers < 0]

    def _enter(self, orbit: Orbit) -> None:
        with self._lock:
            if number_of(orbit, self._sets.orbits, self._geometry) == len(self._sets.orbits):
                motion = self._motion_of(orbit)
                entry = self._new(
                    PERIODIC_ORBIT, orbit.period, orbit.points, motion, seconds=orbit.seconds, stability=orbit.stability
                )
                self._sets.add_orbit(orbit, entry.number)

    def _in_sets(self, block: Block, numbers: np.ndarray) -> None:
        """Write into `numbers` which cells are on the run's non-periodic attractors."""
        rows = np.flatnonzero(block.is_bounded & (numbers < 0))
        if len(rows):
            numbers[rows] = self._sets.on_clouds(block.section[rows])

    # ---- entries -------------------------------------------------------------------------------

    @property
    def _n_new(self) -> int:
        return sum(entry.attractor is None and entry.kind != ABSENT for entry in self.entries)

    def _new(
        self,
        kind: int,
        period: int,
        points: np.ndarray,
        motion: int = 0,
        status: int = 0,
        seconds: float = np.nan,
        stability: int = 0,
    ) -> Entry:
        with self._lock:
            number = max([self.n_ids, *(e.number + 1 for e in self.entries)])
            entry = Entry(number, None, kind, period, motion, status, points, seconds, stability)
            self.entries.append(entry)
            return entry

    def entry(self, number: int) -> Entry:
        """Return the catalog entry with a given number."""
        return next(entry for entry in self.entries if entry.number == number)

    def _entry_near(self, kind: int, state: np.ndarray) -> Entry | None:
        same = 1e-5  # largest scaled distance between an equilibrium of the run and the same one found again
        for entry in self.entries:
            if entry.kind == kind and self._geometry.distance(entry.points[0], state) <= same:
                return entry
        return None

    def _entry_of(self, cycle: Cycle, point: Point) -> Entry | None:
        alike = [
            entry
            for entry in self.entries
            if entry.kind == PERIODIC_ORBIT
            and not entry.period
            and abs(entry.seconds - cycle.seconds) <= SAME_SECONDS * cycle.seconds
        ]
        states, near = [entry.points[0] for entry in alike], [self.tolerance] * len(alike)
        return [*alike, None][number_of_cycle(cycle, states, near, point, self._geometry)]

    def _class_of(self, block: Block, row: int) -> Entry:
        """Return the entry for cells without an attractor that share status, period and motion with a given cell."""
        status = int(block.status[row])
        alive = bool(block.is_bounded[row] or block.is_closed[row])
        period = int(block.orbit_period[row]) if alive else 0
        motion = int(self.motions(block)[row]) if alive else 0
        key = (period, motion, 0 if alive else status)
        with self._lock:
            for entry in self.entries:
                if entry.kind == ABSENT and (entry.period, entry.motion, entry.status) == key:
                    return entry
            stability = NOT_SETTLED if alive else 0
            return self._new(ABSENT, period, block.section[row][:0], motion, key[2], stability=stability)

    # ---- motions -------------------------------------------------------------------------------

    def motions(self, block: Block) -> np.ndarray:
        """Return the class of motion (a code) of each cell, by the model's classifier."""
        return features.sides_of(block.section, block.turns, self.place.frequency, self.place.parameters)

    def _motion_of(self, orbit: Orbit) -> int:
        if self.model.classifier is None:
            return 0
        has_returns = self.model.crossing is not None
        known = np.isfinite(orbit.seconds)
        seconds = orbit.seconds if known else orbit.period / self.place.frequency
        clock = orbit.period / seconds if has_returns and known else self.place.frequency
        states = orbit_series(self.place.parameters, clock, orbit.points[0], orbit.period, seconds)["states"]
        angles = np.flatnonzero(self._geometry.is_angle)
        turns = np.round((states[-1] - states[0])[angles] / (2.0 * np.pi)).astype(np.int64)
        place = self.place
        return int(features.sides_of(orbit.points[None], turns[None], place.frequency, place.parameters)[0])

    def _point_of(self, cells: xr.Dataset | None) -> Point:
        """Return this parameter point with the run's cells there."""
        n_cells = 4096  # of the run that are read at once
        return Point(
            xr.Dataset() if cells is None else cells,
            {},
            () if cells is None else split_dims(cells["status"])[1],
            self.place.frequency,
            self.place.parameters.pack(),
            self.place.parameters,
            sum(self._geometry.is_angle),
            n_cells,
            self.model.system,
            has_returns=self.model.crossing is not None,
            can_rest=self.model.clock.has_equilibria,
        )


def _finite(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[np.isfinite(points).all(axis=-1)])


def _tolerance_of(here: xr.Dataset | None, closure_tolerance: float) -> float:
    """Return the distance within which a cell counts as on a known orbit, as in the run's stored analysis."""
    found = 0.0 if here is None else float(here.attrs.get("identify_tolerance", 0.0))
    return found or max(1e-4, 10.0 * closure_tolerance)
