"""Find where the unstable manifold of a saddle equilibrium in a chaotic set meets the stable manifold of an orbit.

If a chaotic set of a flow comes arbitrarily near to a saddle equilibrium with one unstable direction, on both sides of
its stable manifold, then both trajectories that leave the equilibrium lie in the set. They are its edge, and the set
comes near to them so seldom that its least clearance from another manifold cannot be measured: the distance is a small
power of that from the stable manifold of the equilibrium. But the clearance of these two trajectories can. It is a
smooth function of the parameter, and where it is 0 they connect the equilibrium with a saddle orbit. So ends the set of
Lorenz's equations (Kaplan and Yorke, Commun. Math. Phys. 67, 1979, 93; Sparrow, The Lorenz Equations, 1982).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from magpend_core.equilibria import find_equilibria
from magpend_core.orbits import section_map
from magpend_core.pointwise import rates_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.starting_orbits import orbits_near
from pipeline.analysis.events.contact import (
    SETTLE,
    Approach,
    Clearance,
    Contact,
    Effort,
    Saddle,
    Sample,
    SectionMap,
    contact_of,
    last_stays,
    sample_of,
)
from pipeline.analysis.events.transients import LifetimeSettings, Place
from pipeline.results.tolerances import BRANCH_RTOL, SAME_EQUILIBRIUM


@dataclass(frozen=True)
class ConnectionSettings:
    """Numbers of the search for equilibria in a set, and of their contact with an orbit."""

    # returns of each trajectory on which passages of an equilibrium are looked for, and states of each; more show
    # equilibria that the set nears less often
    returns: int = 64
    per_return: int = 64
    radius: float = 0.2  # distance within which a trajectory passes an equilibrium, as a share of the set's extent
    # largest clearance of the nearest passages on each side of the stable manifold of an equilibrium that counts as in
    # the set, as a share of the radius
    beside: float = 0.05
    # lengths of the step from an equilibrium along its unstable direction, as shares of the set's extent. They change
    # the clearance by their squares, so that the second one shows the error of the first.
    steps: tuple[float, ...] = (1e-6, 1e-5)
    # bisections for the value at which a trajectory from the equilibrium begins to leave, and doublings of the distance
    # from there at which its clearance is looked at
    halvings: int = 16
    ratio: float = 0.8  # ratio and number of the distances beyond a contact at which lifetimes are taken
    most_lifetimes: int = 24
    lifetimes: LifetimeSettings = LifetimeSettings()  # of their measurement


@dataclass(frozen=True, eq=False)
class Rest:
    """A saddle equilibrium with one unstable direction, and the scaled right and left eigenvectors of it.

    The largest component of the right one is 1, and its product with the left one.
    """

    state: np.ndarray
    direction: np.ndarray
    covector: np.ndarray
    rate: float  # 1/s
    told: str = ""  # how near the set comes

    def __str__(self) -> str:
        return f"({', '.join(f'{round(x, 9) + 0.0:.6g}' for x in self.state)})"

    def is_same(self, other: Rest, along: SectionMap) -> bool:
        """Tell whether two equilibria at one value are one."""
        return bool(along.geometry.distance(self.state, other.state) <= SAME_EQUILIBRIUM)


def rest_at(along: SectionMap, value: float, state: np.ndarray) -> Rest | None:
    """Return the saddle equilibrium with one unstable direction to which Newton's method leads; None without it."""
    packed = along.rows(value, state[None]).parameters[0]
    found = find_equilibria(along.family.system, state[None], packed)
    if not found.converged[0] or (found.eigenvalues[0].real > 0.0).sum() != 1:
        return None
    values, right = np.linalg.eig(along.family.scaled(found.jacobians[0]))
    k = int(values.real.argmax())
    v, w = right[:, k].real, np.linalg.inv(right)[k].real
    v = v / v[np.abs(v).argmax()]
    return Rest(found.states[0], v, w / (w @ v), float(values[k].real))


def motion_of(
    along: SectionMap, value: float, own: Sample, settings: ConnectionSettings = ConnectionSettings()
) -> tuple[np.ndarray, float]:
    """Return states of a set's trajectories at equal times, shape (trajectory, time, state), and their interval [s]."""
    rows = along.rows(value, own.starts)
    times = section_map(
        rows.parameters[:1], rows.frequency_hz[:1], rows.states[:1], settings.returns, system=along.family.system
    ).times
    seconds = float(times.sum())
    if not np.isfinite(seconds):
        return np.zeros((0, 0, rows.states.shape[1])), seconds
    grid = np.linspace(0.0, seconds, settings.returns * settings.per_return)
    found = sample(
        along.family.system,
        rows.parameters,
        rows.states,
        [grid],
        piece=np.zeros(len(rows.states), np.int64),
        drives=[Drive(np.array([seconds]))],
        **tolerances_at(along.rtol),
    )
    return found.states, float(grid[1])


def rests_in(
    along: SectionMap, value: float, own: Sample, settings: ConnectionSettings = ConnectionSettings()
) -> list[Rest]:
    """Return the saddle equilibria that a set contains: it comes near to them on both sides of the stable manifold."""
    states, step = motion_of(along, value, own, settings)
    states = states[np.isfinite(states).all(axis=(1, 2))]
    if not len(states):
        return []
    geometry, packed = along.geometry, along.rows(value, own.starts[:1]).parameters[0]
    extent = float(geometry.distance(states, states[0, 0]).max())
    speed = np.abs(rates_at(along.family.system, states.reshape(-1, states.shape[2]), packed)) / geometry.scales
    speed = speed.max(axis=1).reshape(states.shape[:2])
    is_slow = (speed[:, 1:-1] <= speed[:, :-2]) & (speed[:, 1:-1] <= speed[:, 2:])
    found = find_equilibria(along.family.system, states[:, 1:-1][is_slow], packed)
    places: list[np.ndarray] = []
    for state in found.states[found.converged]:
        if all(geometry.distance(state, place) > SAME_EQUILIBRIUM for place in places):
            places.append(state)
    rests = [one for one in (rest_at(along, value, place) for place in places) if one is not None]
    radius = settings.radius * extent
    sides = [_sides(states, rest, step, radius, along) for rest in rests]
    contained = []
    for rest, a in zip(rests, sides, strict=True):
        nearest = [float(side.min(initial=np.inf)) for side in (a[a > 0.0], -a[a < 0.0])]
        if max(nearest) <= settings.beside * radius:
            told = (
                f"of {len(a)} passages within {radius:.3g}, the nearest ones are {nearest[0]:.1e} and {nearest[1]:.1e}"
            )
            contained.append(replace(rest, told=f"{told} beside its stable manifold, one on each side"))
    return contained


def _sides(states: np.ndarray, rest: Rest, step: float, radius: float, along: SectionMap) -> np.ndarray:
    """Return the clearances from the stable manifold of an equilibrium with which trajectories come within a radius.

    The coordinate along the unstable direction at the closest approach is divided by its growth since then.
    """
    offset = along.geometry.difference(states, rest.state)
    away = np.abs(offset).max(axis=2)
    lane, time = np.nonzero(away < radius)
    if not len(lane):
        return np.zeros(0)
    begins = np.append(True, (np.diff(lane) != 0) | (np.diff(time) != 1))
    number = np.cumsum(begins) - 1
    closest = np.lexsort((away[lane, time], number))[np.flatnonzero(begins)]
    gone = step * (time[closest] - time[begins])
    across = offset[lane[closest], time[closest]] @ rest.covector
    return np.asarray(across * np.exp(-rest.rate * gone))


# ---- the trajectories that leave an equilibrium ------------------------------------------------


@dataclass(frozen=True, eq=False)
class Leaving:
    """A trajectory that leaves a saddle equilibrium along its unstable direction, as the parameter changes."""

    along: SectionMap
    rest: Rest  # at `value`
    value: float
    steps: np.ndarray  # scaled, with their sign

    def rest_at(self, value: float) -> Rest | None:
        """Follow the equilibrium to a parameter value; its unstable direction keeps its sense."""
        n_values = 5  # of the parameter at which the equilibrium is followed
        rest: Rest | None = self.rest
        for x in np.linspace(self.value, value, n_values)[1:].tolist() if value != self.value else []:
            if rest is None:
                break
            direction, rest = rest.direction, rest_at(self.along, x, rest.state)
            if rest is not None and rest.direction @ direction < 0.0:
                rest = replace(rest, direction=-rest.direction, covector=-rest.covector)
        return rest

    def paths(self, value: float, length: int) -> np.ndarray:
        """Return the section points of the trajectories of all steps; NaN if there is no such equilibrium."""
        rest, geometry = self.rest_at(value), self.along.geometry
        if rest is None:
            return np.full((len(self.steps), length, geometry.n_states), np.nan)
        starts = rest.state + self.steps[:, None] * rest.direction * np.asarray(geometry.scales)
        return self.along.paths(value, starts, length)


@dataclass(eq=False)
class Edge(Approach):
    """The approach of a trajectory that leaves an equilibrium to a saddle orbit along the parameter."""

    leaving: Leaving = field(kw_only=True)
    time: int = 0  # section at which the passage begins
    phase: int = 0  # section point of the orbit there
    side: float = 1.0

    def paths(self, value: float, length: int | None = None) -> np.ndarray:
        """Return the section points of the trajectories at a parameter value."""
        return self.leaving.paths(value, length or self.effort.length)

    def least(self, value: float, paths: np.ndarray | None = None) -> Clearance:
        """Return the clearance of the passage, and its change by a longer step from the equilibrium."""
        paths, saddle = self.paths(value) if paths is None else paths, self.saddle(value)
        has_left = not np.isfinite(paths[:, -1]).all()
        if saddle is None:
            return Clearance(np.nan, np.nan, has_left)
        step, factor = saddle.turn(1)
        offset = self.along.geometry.difference(paths[:, self.time :: step], saddle.points[self.phase])
        away = np.abs(offset).max(axis=2)
        away = np.where(np.logical_and.accumulate(away < 2.0 * self.near * self.size, axis=1), away, np.inf)
        closest = away.argmin(axis=1)
        across = (offset @ saddle.covectors[self.phase])[range(len(paths)), closest]
        a = np.where(np.isfinite(away[:, 0]), self.side * across / factor**closest, np.nan)
        return Clearance(float(a[0]), float(abs(a[0] - a[1])), has_left)


def _edge(leaving: Leaving, own: Sample, beyond: float, effort: Effort, settings: ConnectionSettings) -> Edge | None:
    """Find the saddle orbit from which a trajectory turns away at the value where it begins to leave the set.

    Just beyond this value, it stays near to the orbit for long: there it nearly returns to itself.
    """
    along, geometry, length = leaving.along, leaving.along.geometry, 4 * effort.length
    size = own.size(geometry)

    def stays(x: float) -> bool:
        paths = leaving.paths(x, length)[:1]
        last = last_stays(paths, own.points, effort.around * size, geometry)
        return bool(np.isfinite(paths).all() and last[0] > (1.0 - effort.away) * length)

    low, high = leaving.value, beyond
    if not stays(low) or stays(high):
        return None
    for _ in range(settings.halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    paths = leaving.paths(high, length)
    path = paths[0][np.isfinite(paths[0]).all(axis=1)]
    rows = along.rows(high, path[:1])
    orbits = orbits_near(
        path[None], float(rows.frequency_hz[0]), rows.parameters[0], effort.longest, along.family.system
    )
    saddles = [one for one in (along.saddle(high, *orbit) for orbit in orbits) if one is not None]
    away = [float(geometry.distance(path, one.points[0]).min()) for one in saddles]
    if not away or min(away) > effort.near[0] * size:
        return None
    effort = replace(effort, is_flow=False)  # one trajectory: nothing to lower
    edge = Edge(along, replace(own, n_bands=1), high, saddles[int(np.argmin(away))], effort, leaving=leaving)
    return edge if _is_aimed(edge, paths, low, settings) else None


def _is_aimed(edge: Edge, paths: np.ndarray, low: float, settings: ConnectionSettings) -> bool:
    """Set the side and the time of the passage from paths just beyond the zero of the clearance, and the value on the
    other side of it at which the clearance is a share of the distance of passages; return whether there is one.
    """
    saddle = edge.first
    away = np.array([edge.along.geometry.distance(paths[0], point) for point in saddle.points])
    away = np.where(np.isfinite(away), away, np.inf)
    edge.phase, closest = (int(i) for i in np.unravel_index(away.argmin(), away.shape))
    step, _ = saddle.turn(1)
    is_far = away[edge.phase, closest % step : closest + 1 : step] >= edge.near * edge.size
    edge.time = closest % step + step * int(np.append(-1, np.flatnonzero(is_far))[-1] + 1)
    edge.side = -float(np.sign(edge.least(edge.value, paths).least))
    high, living = edge.value, np.nan
    for number in range(settings.halvings + 1):
        x = high + (low - high) * 2.0**number
        least = edge.least(x).least
        if np.isfinite(living) and not least > 0.0:
            break
        living = x if least > 0.0 else living
        if least >= edge.effort.shares[False] * edge.near * edge.size:
            break
    edge.value = living
    return bool(np.isfinite(living))


# ---- the set -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Connection:
    """Contact of a trajectory that leaves an equilibrium in a chaotic set with a saddle orbit: there it is lost."""

    rest: Rest
    saddle: Saddle
    contact: Contact
    lives: float  # value before it at which no trajectory leaves
    values: list[float]  # values beyond, the nearest one last
    means: list[float]  # mean lifetimes there [sections]


def connection_of(
    along: SectionMap,
    own: Sample,
    values: tuple[float, float, float],
    effort: Effort,
    settings: ConnectionSettings = ConnectionSettings(),
) -> Connection | str:
    """Find the first contact of the unstable manifold of an equilibrium in a set with a saddle orbit, with proof that
    the set is lost there.

    Parameters
    ----------
    along
        Section map of an autonomous flow.
    own
        Trajectories on the set at the last value at which it was seen.
    values
        This value, the next one, and a far one beyond, up to which lifetimes may be taken.
    effort
        Trajectories of the set and their length.
    settings
        Numbers to choose.

    Returns
    -------
    Connection or str
        Or why there is none.
    """
    seen, beyond, far = values
    exact = replace(along, rtol=BRANCH_RTOL)
    rests = rests_in(along, seen, own, settings)
    if not rests:
        return "it contains no saddle equilibrium with one unstable direction"
    touching: list[tuple[Edge, Contact]] = []
    steps = own.size(along.geometry) * np.array(settings.steps)
    for rest, sign in product(rests, (1.0, -1.0)):
        edge = _edge(Leaving(exact, rest, seen, sign * steps), own, beyond, effort, settings)
        contact = contact_of(edge, beyond) if edge is not None else None
        if edge is not None and contact is not None:
            touching.append((edge, _with_tolerance(edge, contact)))
    if not touching:
        return f"the unstable manifolds of equilibria in it, {'; '.join(map(str, rests))}, meet no unstable orbit"
    edge, contact = min(touching, key=lambda one: abs(one[1].value - seen))
    return _lost(along, own, edge, contact, far, effort, settings)


def _with_tolerance(edge: Edge, contact: Contact) -> Contact:
    """Add to the error of a contact what a larger tolerance of the integration changes."""
    rough = replace(edge.along, rtol=10.0 * edge.along.rtol)
    found = replace(edge, along=rough, leaving=replace(edge.leaving, along=rough)).least(contact.value)
    return replace(contact, error=contact.error + 2.0 * abs(found.least / contact.slope))


def _lost(
    along: SectionMap,
    own: Sample,
    edge: Edge,
    contact: Contact,
    far: float,
    effort: Effort,
    settings: ConnectionSettings,
) -> Connection | str:
    """Check that a set lives up to a contact and contains the equilibrium there, and that it is lost beyond."""
    value = contact.value - contact.span * float(np.sign(far - contact.value))
    saddle, rest = edge.saddle(value), edge.leaving.rest_at(value)
    told = f"the unstable manifold of the equilibrium at {rest} meets an unstable orbit at {contact.value:.10g}, but"
    try:
        near = sample_of(along, value, along.paths(value, own.starts[:1], SETTLE)[0, -1], effort)
    except ValueError:
        return f"{told} the trajectories of the set end before"
    rests = rests_in(along, value, near, settings)
    rest = next((one for one in rests if rest is not None and one.is_same(rest, along)), None)
    if saddle is None or rest is None:
        return f"{told} the set does not contain it there"
    place = Place(along, near.starts, near.points, near.size(along.geometry), effort)
    found, _ = Approach(along, near, value, saddle, effort).passages(value, place.stays(value)[0])
    if any((edge.side * a).min() <= 0.0 for (phase, _), (a, _, _) in found.items() if phase == edge.phase):
        return f"{told} the set lies on both sides of it before"
    if place.lifetime(value)[1]:
        return f"{told} trajectories leave the set before"
    values, means = _lifetimes(place, contact.value, far, settings)
    if len(values) < settings.lifetimes.fewest or not (np.diff(means) > 0.0).all():
        listed = ", ".join(f"{mean:.4g} at {x:.6g}" for x, mean in zip(values, means, strict=True)) or "none measured"
        return f"{told} lifetimes beyond ({listed}) do not show that the set is lost there"
    _, until = place.stays(values[0])
    if (until <= (SETTLE + place.length) // 2).mean() < settings.lifetimes.stay_away:
        return f"{told} beyond, the trajectories of the set stay near it or come back"
    return Connection(rest, saddle, contact, value, values, means)


def _lifetimes(
    place: Place, contact: float, far: float, settings: ConnectionSettings
) -> tuple[list[float], list[float]]:
    """Return values from a far one to a contact, and the mean lifetimes there, as far as they can be measured."""
    values: list[float] = []
    means: list[float] = []
    for k in range(settings.most_lifetimes):
        value = contact + (far - contact) * settings.ratio**k
        mean, n = place.lifetime(value)
        if n >= settings.lifetimes.fewest_escapes and mean >= SETTLE:
            values, means = [*values, value], [*means, mean]
        elif values:
            break
    return values, means
