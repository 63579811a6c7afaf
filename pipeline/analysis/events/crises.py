"""Name the crises of chaotic sets: find the unstable orbit that a set meets, and what becomes of the set beyond.

The orbits are looked for: those of the located branches at the last value at which the set lives, and those that
deflated Newton iterations find around the set. An orbit is met if the clearance between the set and its stable manifold
is 0 at one parameter value, seen from both sides, and if the mean lifetime beyond is a power of the distance from the
same value (see `contact`). Trajectories that leave beyond contact tell the kind of the crisis: if they do not come
back, the set is lost (boundary crisis). If they do, it has grown (interior crisis), merged with another set, or merged
its bands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import xarray as xr

from pipeline.analysis.branches.deflation import DeflationSettings, search_orbits, starts_around
from pipeline.analysis.events.connections import connection_of
from pipeline.analysis.events.contact import (
    SETTLE,
    Approach,
    Contact,
    Effort,
    Saddle,
    Sample,
    SectionMap,
    contact_of,
    count_bands,
    map_along,
    sample_of,
)
from pipeline.analysis.events.kinds import BANDS, BOUNDARY, INTERIOR, TRANSIENT, TWINS
from pipeline.analysis.events.lines import at, own_width
from pipeline.analysis.events.scene import Born, Event, Scene, Stretch
from pipeline.analysis.events.transients import Lifetimes, lifetimes_of, transient_of
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.layout.vocabulary import letter, parameter_name
from pipeline.products.reporting import track
from pipeline.results.ragged import points_of_rows, rows_at
from pipeline.results.sets import nearest_distances
from pipeline.results.tolerances import SEARCH_CLOSE, SEARCH_RTOL

OF_MAP, OF_FLOW = Effort(256, 1024, 6, 48, 2), Effort(128, 256, 3, 36, 1, is_flow=True)
"""Effort for maps, and for flows, whose trajectories cost a thousand times as much."""


BEYOND_SET = 0.1
"""Distance from a set, as a share of its size, beyond which points are outside."""


@dataclass(frozen=True)
class Crisis(Born):
    """Verdict on the crisis of a chaotic set, with the law of the mean lifetimes beyond."""

    period: int = 0  # of the orbit that is met
    bands: tuple[int, int] = (0, 0)  # before and after; 0 unknown
    twin: int = -1  # id of the set with which it merges
    lives_beyond: bool = False  # whether the set that meets the orbit is the one on the other side


def name_crisis(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a chaotic set by the crisis of this set, or of a set that its cells go on to, as seen from the
    other side, else by lifetimes beyond; add what was tried if it stays open.
    """
    return Crises(scene).name(one)


@dataclass(eq=False)
class Crises:
    """The crises of the chaotic sets of a scene; each end of a set is looked at once."""

    scene: Scene

    def name(self, one: Event) -> Event:
        """Name the end of a chaotic set as in `name_crisis`."""
        place, way = one.place, one.way
        tries = [self.at(one.stretch.attractor, place, way)]
        if not tries[0].what:
            heirs = [i for i in one.to if self._row(i, place + way) is not None][:2]
            tries += [replace(self.at(i, place + way, -way), lives_beyond=True) for i in heirs]
            tries += [self._joined(one.stretch.attractor, place, way)]
        found = next((crisis for crisis in tries if crisis.what), None)
        if found is None:
            found = self._transient(one.stretch.attractor, place, way)
            tried = "; ".join(filter(None, dict.fromkeys([one.fate.why, *(x.why for x in tries), found.why])))
            if not found.what:
                return replace(one, fate=replace(one.fate, why=tried))
            found = replace(found, why=tried)
        fate = replace(one.fate, value=found.value, bifurcation=-1, why=found.why)
        return replace(one, fate=fate, what=found.what, error=found.error, born=found)

    def at(self, attractor: int, place: int, way: int) -> Crisis:
        """Return the crisis in which a chaotic set at a place ends as the parameter goes on to the next place."""
        key, known = (attractor, place, way), self.scene.verdicts
        if key not in known:
            known[key] = self._crisis(*key)
        found: Crisis = known[key]
        return found

    def _joined(self, attractor: int, place: int, way: int) -> Crisis:
        """Return the crisis in which another set at a place merges with this one as the parameter goes on."""
        ids = self.scene.attractors["attractor"].values
        for row in rows_at(self.scene.attractors)[(int(self.scene.order[place]),)]:
            other = self.scene.names.get((place, int(ids[row])), int(ids[row]))
            crisis = self.at(other, place, way) if other != attractor else Crisis("", "")
            if crisis.what == TWINS and self.scene.names.get((place, crisis.twin), crisis.twin) == attractor:
                return replace(crisis, twin=other)
        return Crisis("", "")

    def split(self, stretches: Sequence[Stretch]) -> list[Stretch]:
        """Divide the stretches of chaotic sets where a crisis changes the size of a set or the number of its bands."""
        found = []
        for one in track(stretches, "chaotic sets that change"):
            parts = [one]
            for place in self._changes(one) if SETS[one.kind] == "chaotic_set" else ():
                tries = (
                    (self.at, place, 1),
                    (self.at, place + 1, -1),
                    (self._joined, place, 1),
                    (self._joined, place + 1, -1),
                )
                is_asked = self.scene.is_asked(place, 1)
                if not is_asked or not any(crisis(one.attractor, k, way).what for crisis, k, way in tries):
                    continue
                left, right = self._row(one.attractor, place), self._row(one.attractor, place + 1)
                last = parts.pop()
                assert left is not None
                assert right is not None
                parts.append(replace(last, places=(last.places[0], place), rows=(last.rows[0], left)))
                parts.append(replace(last, places=(place + 1, last.places[1]), rows=(right, last.rows[1])))
            found += parts
        return found

    def _changes(self, one: Stretch) -> list[int]:
        """Return the places of a stretch beyond which the set changes its number of bands or its size."""
        # ratio of the set's growth between neighbouring values to its motion from which a crisis is looked for
        jump = 5.0
        places = range(one.places[0], one.places[1] + 1)
        if len(places) < 2:
            return []
        along, effort = self._map(places[0])
        geometry, rows = along.geometry, [self._row(one.attractor, place) for place in places]
        states = np.array([points_of_rows(self.scene.attractors)[row][-1] for row in rows if row is not None])
        if len(states) < len(places):
            return []
        paths = along.paths(self.scene.along[list(places)], states, SETTLE + 8 * effort.length)[:, SETTLE:]
        sets = [path[np.isfinite(path).all(axis=1)] for path in paths]
        if min(map(len, sets)) < effort.length:
            return []
        bands = [count_bands(points, geometry) for points in sets]
        found = []
        for k in range(len(places) - 1):
            size = float(geometry.distance(sets[k], sets[k][:1]).max())
            ways = [float(nearest_distances(sets[i], sets[j], geometry).max()) for i, j in ((k, k + 1), (k + 1, k))]
            grows = max(ways) > BEYOND_SET * size and max(ways) > jump * min(ways)
            if bands[k] != bands[k + 1] or grows:
                found.append(places[k])
        return found

    # ---- one end -------------------------------------------------------------------------------

    def _crisis(self, attractor: int, place: int, way: int) -> Crisis:
        scene, row = self.scene, self._row(attractor, place)
        if row is None or not 0 <= place + way < len(scene.along):
            return Crisis("", "")
        seen, beyond = (float(x) for x in scene.along[[place, place + way]])
        along, effort = self._map(place)
        points, sample = points_of_rows(scene.attractors), self._sample(row, along, seen, effort)
        if sample is None:
            return Crisis("", "its trajectories end")
        met = self._met(along, effort, sample, (seen, beyond), self._orbits(along, sample, seen, effort))
        if isinstance(met, str):
            connected = self._connected(along, effort, sample, (seen, beyond))
            told = "; ".join(filter(None, (met, connected.why)))
            return connected if connected.what else replace(connected, why=told)
        others = {
            int(scene.attractors["attractor"].values[k]): points[k]
            for k in rows_at(scene.attractors)[(int(scene.order[place]),)]
            if k != row and SETS[int(scene.attractors["kind"].values[k])] == "chaotic_set"
        }
        return _judged(scene, *met, beyond, others)

    def _connected(self, along: SectionMap, effort: Effort, sample: Sample, values: tuple[float, float]) -> Crisis:
        """Judge whether a set is lost where the unstable manifold of an equilibrium in it meets an unstable orbit."""
        scene, ds = self.scene, self.scene.located
        if scene.base.model.crossing is None:
            return Crisis("", "")
        far = values[0] + 2.0 * scene.scale * float(np.sign(values[1] - values[0]))
        parameter = scene.base.model.parameter(parameter_name(scene.axis))
        while parameter.problem(far):
            far = 0.5 * (far + values[1])
        found = connection_of(along, sample, (*values, far), effort)
        if isinstance(found, str):
            return Crisis("", found)
        contact = found.contact
        state = ", ".join(f"{x:.6g}" for x in found.saddle.points[0])
        told = (
            f"the set contains the saddle equilibrium at {found.rest}: {found.rest.told}; a trajectory that leaves it "
            f"meets the stable manifold of the unstable orbit of period {found.saddle.period} at ({state}): the "
            f"clearance is 0 at {at(ds, contact.value)}, by lines from both sides at "
            f"{at(ds, contact.living, contact.beyond)}; no trajectory leaves the set at {at(ds, found.lives)}; "
            f"beyond, {_lifetimes(ds, found.values, found.means)} grow towards it"
        )
        error = max(contact.error, 1e-9 * scene.scale)
        return Crisis(BOUNDARY, told, contact.value, error, period=found.saddle.period, bands=(sample.n_bands, 0))

    def _transient(self, attractor: int, place: int, way: int) -> Crisis:
        """Judge by lifetimes alone whether a chaotic set is lost between a place and the next one."""
        scene, row = self.scene, self._row(attractor, place)
        if row is None or not 0 <= place + way < len(scene.along):
            return Crisis("", "")
        seen, beyond = (float(x) for x in scene.along[[place, place + way]])
        along, effort = self._map(place)
        sample = self._sample(row, along, seen, effort)
        if sample is None:
            return Crisis("", "")
        found = transient_of(along, sample, seen, beyond, effort)
        if isinstance(found, str):
            return Crisis("", found)
        exponent, error = found.free_exponent
        why = f"beyond, its trajectories leave for good: {_law(scene.located, found, exponent, error)}"
        return Crisis(TRANSIENT, why, found.value, found.value_error, exponent=exponent, exponent_error=error)

    def _sample(self, row: int, along: SectionMap, seen: float, effort: Effort) -> Sample | None:
        """Return trajectories on the chaotic set of a row; None if they end."""
        known = self.scene.verdicts
        if ("sample", row) not in known:
            try:
                known["sample", row] = sample_of(along, seen, points_of_rows(self.scene.attractors)[row][-1], effort)
            except ValueError:
                known["sample", row] = None
        found: Sample | None = known["sample", row]
        return found

    def _row(self, attractor: int, place: int) -> int | None:
        """Return the row of a chaotic set at a place; None if it is not there."""
        ds = self.scene.attractors
        for row in rows_at(ds)[(int(self.scene.order[place]),)] if 0 <= place < len(self.scene.order) else ():
            name = self.scene.names.get((place, int(ds["attractor"].values[row])), int(ds["attractor"].values[row]))
            if name == attractor and SETS[int(ds["kind"].values[row])] == "chaotic_set":
                return row
        return None

    def _map(self, place: int) -> tuple[SectionMap, Effort]:
        return map_along(self.scene, place), OF_FLOW if self.scene.base.model.clock.is_continuous else OF_MAP

    def _orbits(self, along: SectionMap, sample: Sample, seen: float, effort: Effort) -> list[Saddle]:
        """Return the saddle orbits at a parameter value: those of located branches, and those around the set."""
        longest = 12  # period of the orbits that are looked for because it is one to three times the number of bands
        system = along.family.system
        rows = along.rows(seen, sample.points[:1])
        m = sample.n_bands
        periods = sorted({*range(1, effort.longest + 1), *(p for p in (m, 2 * m, 3 * m) if p <= longest)})
        starts = [starts_around(sample.points[::7], effort.starts, 0, system)] * len(periods)
        asked = np.repeat(periods, effort.starts)
        for line in self.scene.lines:
            for node in np.flatnonzero((line.value[:-1] - seen) * (line.value[1:] - seen) <= 0.0).tolist():
                if line.period:
                    starts.append(line.points[node, :1])
                    asked = np.append(asked, line.period)
        found = search_orbits(
            np.concatenate(starts),
            asked,
            float(rows.frequency_hz[0]),
            rows.parameters[0],
            system,
            settings=DeflationSettings(rounds=effort.rounds, rtol=SEARCH_RTOL, close=SEARCH_CLOSE),
        )
        states = np.array([one.points[0] for one in found]).reshape(-1, system.n_states)
        return [one for one in along.saddles(seen, states, [one.period for one in found]) if one is not None]

    def _met(
        self, along: SectionMap, effort: Effort, sample: Sample, values: tuple[float, float], orbits: Sequence[Saddle]
    ) -> tuple[Approach, Contact] | str:
        """Return the orbit that the set meets first, or why it meets none."""
        ds, (seen, beyond) = self.scene.located, values
        ways = [Approach(along, sample, seen, orbit, effort) for orbit in orbits]
        few, length = effort.looked_at, SETTLE + effort.length
        some = along.paths(seen, sample.starts[:few], length) if orbits else np.zeros(0)

        @cache
        def here() -> np.ndarray:
            return np.concatenate([some, along.paths(seen, sample.starts[few:], length)])

        ways = [one for one in ways if one.begin(some, here)]
        there = ways[0].paths(beyond) if ways else some
        near = [one for one in ways if one.least(beyond, there).is_beyond]
        near.sort(key=lambda one: one.least(seen, here()).least)
        first: tuple[Approach, Contact] | None = None
        before, earlier = seen, here() if near else some
        for one in near:
            # where the set has grown, it crosses other orbits too: only one that it crosses before counts
            if first is not None and not one.least(before, earlier).is_beyond:
                continue
            contact = contact_of(one, beyond)
            if contact is not None and (first is None or abs(contact.value - seen) < abs(first[1].value - seen)):
                first = one, contact
                before = contact.value - 0.5 * contact.span * float(np.sign(beyond - seen))
                earlier = one.paths(before)
        return first or (
            f"no crisis: of {len(orbits)} unstable orbits at {at(ds, seen)}, {len(ways)} lie beside the set, "
            f"{len(near)} of them are crossed at {at(ds, beyond)}, and none is met at one value from both sides"
        )


def _judged(
    scene: Scene, approach: Approach, contact: Contact, beyond: float, others: Mapping[int, np.ndarray]
) -> Crisis:
    """Return the crisis at a contact, without a name if lifetimes disagree with the contact or no kind is seen."""
    sure = 4.0  # largest distance of the value from lifetimes, in units of its error
    ds, period = scene.located, approach.first.period
    state = ", ".join(f"{x:.6g}" for x in approach.first.points[0])
    told = (
        f"the set meets the stable manifold of the unstable orbit of period {period} at ({state}): the clearance is 0 "
        f"at {at(ds, contact.value)}, by lines from both sides at {at(ds, contact.living, contact.beyond)}"
    )
    times = lifetimes_of(approach, contact, beyond)
    if times is None:
        return Crisis("", f"{told}; too few trajectories leave beyond it for lifetimes")
    told += f"; {_law(scene.located, times, times.exponent, times.exponent_error)}"
    far = max(abs(times.values[0] - contact.value), 1e-300)
    if abs(times.value - contact.value) > sure * times.value_error + contact.error or times.value_error > 0.25 * far:
        return Crisis("", f"{told}: they do not agree with the clearance")
    what, twin, bands = _kind(approach, contact, times, others)
    if not what:
        return Crisis("", f"{told}: the trajectories that leave show no kind of crisis")
    told += f"; {bands[0]} bands before and {bands[1]} beyond" if bands[1] else ""
    told += f"; beyond, its trajectories reach {letter(twin)}" if twin >= 0 else ""
    error = max(contact.error, 1e-9 * scene.scale)
    found = Crisis(what, told, contact.value, error, period=period, bands=bands, twin=twin)
    return replace(found, exponent=times.exponent, exponent_error=times.exponent_error)


def _law(ds: xr.Dataset, times: Lifetimes, exponent: float, error: float) -> str:
    return (
        f"{_lifetimes(ds, times.values, times.means)} grow with the power -{exponent:.3f} ± {error:.3f} of the "
        f"distance from {at(ds, times.value)} ± {own_width(ds, times.value, times.value_error):.0e}"
    )


def _lifetimes(ds: xr.Dataset, values: Sequence[float], means: Sequence[float]) -> str:
    return f"mean lifetimes {', '.join(f'{mean:.4g}' for mean in means)} at {at(ds, *values)}"


def _kind(
    approach: Approach, contact: Contact, times: Lifetimes, others: Mapping[int, np.ndarray]
) -> tuple[str, int, tuple[int, int]]:
    """Return the kind of a crisis (empty if open), the id of the set that is joined, and the numbers of bands."""
    # shares of trajectories that leave and pass the orbit again: at most, of a lost set; at least, of one that lives on
    lost, returning = 0.02, 0.5
    stray = 1e-3  # share of points that may lie outside of a set
    # least share of the points outside that lie on another set, if the two merge, as a merged set may be larger than
    # both; and the largest share of the set itself that lies on the other one
    joins = 0.5
    along, sample, effort = approach.along, approach.sample, approach.effort
    k = next((i for i, mean in enumerate(times.means) if mean > 2 * SETTLE), 0)
    value, length = times.values[k], max(4 * effort.length, int(32 * times.means[k]))
    paths = approach.paths(value, length)
    share = approach.returning(value, paths)
    m = sample.n_bands
    if share <= lost:
        return BOUNDARY, -1, (m, 0)
    if share < returning:
        return "", -1, (m, 0)
    geometry, size = along.geometry, approach.size
    old = approach.paths(2.0 * contact.value - value, effort.length)[:, SETTLE:].reshape(-1, geometry.n_states)
    new = paths[:, length // 2 :].reshape(-1, geometry.n_states)
    new = new[np.isfinite(new).all(axis=1)]
    after = count_bands(paths[int(np.isfinite(paths).all(axis=2).sum(axis=1).argmax())], geometry)
    outside = new[nearest_distances(new, old, geometry) > BEYOND_SET * size]
    if len(outside) <= stray * len(new):
        return (BANDS, -1, (m, after)) if after < m else ("", -1, (m, after))
    for number, points in others.items():
        here = along.paths(2.0 * contact.value - value, points[-effort.lanes :], effort.length)[:, SETTLE:]
        here = here.reshape(-1, geometry.n_states)
        here = here[np.isfinite(here).all(axis=1)]
        same, joined = (nearest_distances(x, here, geometry) <= BEYOND_SET * size for x in (old, outside))
        if same.mean() < joins <= joined.mean():
            return TWINS, number, (m, after)
    return INTERIOR, -1, (m, after)
