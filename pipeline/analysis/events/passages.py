"""Decide whether a chaotic set or a torus ends at the local bifurcation of the orbit to which its cells go on.

Beyond a fold, a subcritical Neimark-Sacker point or a subcritical doubling, trajectories pass slowly where the stable
orbit has been: intermittency of type I, II or III (Pomeau and Manneville, Commun. Math. Phys. 74, 1980, 189). A torus
that passes slowly where two orbits have met in a fold locks onto them. With d the distance from the bifurcation, the
passages through the channel of a fold take d**-1/2; near an orbit that repels with the rate d they take 1/d.

The mean length of the laminar phases depends on where trajectories come back to the channel (Elaskar and del Rio, New
Advances on Chaotic Intermittency and its Applications, 2017). A ratio of the means of two powers, l**m and l**(m - 1),
does so less: of type I with m = 6 it is near to the longest passage, which has the exponent -1/2. For types II and III
m = 2, the length of the phase in which a laminar instant lies: its exponent is -1 if arrivals on a line through the
orbit are spread evenly near it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import least_squares

from magpend_core.extension import more_sections
from magpend_core.precision import limits_at
from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.dataset import CRITICALITIES
from pipeline.analysis.branches.kinds import DOUBLING, FOLD, KINDS, TORUS
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.events.kinds import INTERMITTENCY, LOCKING
from pipeline.analysis.events.lines import at, own_width
from pipeline.analysis.events.scene import Born, Event, Scene, judged, orbit_beyond
from pipeline.layout.vocabulary import TORUS as TORUS_SET
from pipeline.results.ragged import points_of_rows
from pipeline.results.sets import Geometry
from pipeline.results.tabular import plain
from pipeline.results.tolerances import PASSAGE_RTOL

TYPES = {FOLD: "i", TORUS: "ii", DOUBLING: "iii"}
"""Types of intermittency by the bifurcation of the orbit."""

EXPONENTS = {FOLD: -0.5, TORUS: -1.0, DOUBLING: -1.0}
"""Exponents of the length over the distance from the bifurcation."""


class Effort(NamedTuple):
    """Number and length of the trajectories near a bifurcation, and the least number of laminar phases for the fit."""

    n_values: int  # distances, each half of the one before
    many: int  # trajectories at each
    n_sections: int  # of each trajectory
    longest: float  # length, as a share of the sections
    n_phases: int  # least number at a value


_OF_CHAOS = Effort(6, 64, 16384, 1.0 / 12.0, 60)

MEASURED = {
    FOLD: Effort(10, 16, 4096, 1.0 / 12.0, 60),
    TORUS: _OF_CHAOS,
    DOUBLING: _OF_CHAOS,
    LOCKING: Effort(10, 8, 8192, 0.25, 16),
}
"""Effort by the bifurcation of the orbit, and of tori: they pass it in equal times, of which a few tell the length."""

POWERS = {FOLD: 6, TORUS: 2, DOUBLING: 2}
"""Powers m in the ratio of means that is the length of laminar phases."""


@dataclass(frozen=True)
class PassageSettings:
    """Numbers of the measurement of laminar phases and of the verdict on their law."""

    # least length that is fitted, in periods of the orbit; less fits more values, farther from the law
    least_length: float = 10.0
    least_values: int = 4  # numbers of values that are fitted, the nearest ones
    most_values: int = 6
    looked_at: int = 8  # trajectories at each value that are looked at first
    groups: int = 8  # groups of trajectories whose spread gives the error of a length
    agrees: float = 0.12  # largest deviation of an exponent from the expected one beyond its error, and largest error
    largest_error: float = 0.15
    regular: float = 0.2  # largest spread of the lengths of laminar phases on a torus; on chaotic sets it is larger


@dataclass(frozen=True)
class Phases:
    """Laminar phases at some distances from a bifurcation: length, its relative error, number and spread."""

    distance: np.ndarray
    length: np.ndarray
    error: np.ndarray
    number: np.ndarray
    spread: np.ndarray  # standard deviation of the lengths over their mean, seen from laminar instants


def may_pass(ds: xr.Dataset, k: int, is_torus: bool) -> bool:
    """Return whether a set can end at a bifurcation of an orbit, by slow passages near it."""
    kind, degree = KINDS[int(ds["kind"].values[k])], CRITICALITIES[int(ds["criticality"].values[k])]
    return kind == FOLD or (not is_torus and kind in EXPONENTS and degree == "subcritical")


def name_passage(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a chaotic set or a torus by the slow passages near the orbit to which its cells go on."""
    fate, is_torus = orbit_beyond(one, named), one.stretch.kind == TORUS_SET
    if fate is None or not may_pass(scene.located, fate.bifurcation, is_torus):
        return one
    points, family = points_of_rows(scene.attractors)[one.row], scene.family(one.place, 1)
    about = geometry_of(scene.attractors), is_torus
    found = passage_of(scene.located, fate.bifurcation, family, scene.values_at(one), points, *about)
    return judged(scene, one, fate, found)


def passage_of(
    ds: xr.Dataset,
    k: int,
    family: Family,
    bracket: tuple[float, float],
    points: np.ndarray,
    geometry: Geometry,
    is_torus: bool,
    settings: PassageSettings = PassageSettings(),
) -> Born:
    """Judge whether a chaotic set or a torus ends at a bifurcation of the orbit to which its cells go on.

    Parameters
    ----------
    ds, k
        Located branches, and the number of a bifurcation at which the set may end, see `may_pass`.
    family
        Family of section points at the parameters of the set; its free parameter is that of the branches.
    bracket
        Values of the run on the orbit's side and on the set's side.
    points
        Section points of the set at its last value.
    geometry
        Geometry of the states.
    is_torus
        Whether the set is a torus.
    settings
        Numbers to choose.

    Returns
    -------
    Born
        With the exponent of the length and its error: 1/2 or 1, if it is named.
    """
    value, kind = float(ds["value"].values[k]), KINDS[int(ds["kind"].values[k])]
    degree = "" if kind == FOLD else "subcritical "
    told = f"the orbit to which its cells go ends at {at(ds, value)}: {degree}{plain(kind)}"
    if not min(bracket) < value < max(bracket):
        return Born("", told)
    ghost = ds["bifurcation_section"].values[k]
    ghost = ghost[np.isfinite(ghost).all(axis=-1)]
    effort = MEASURED[LOCKING if is_torus else kind]
    distances = abs(bracket[1] - value) * 0.5 ** np.arange(effort.n_values)
    values = value + np.sign(bracket[1] - value) * distances
    starts = points[np.linspace(0, len(points) - 1, effort.many).astype(int)]
    gate, power = _gate(points, ghost, geometry), POWERS[kind]
    few = _sections(family, values, starts[: settings.looked_at], effort.n_sections)
    may_serve = _may_serve(phases(few, ghost, gate, distances, geometry, power, settings), effort)
    if may_serve.sum() < settings.least_values:
        return _judged(ds, None, None, kind, told, value, is_torus, settings)
    values, distances, sections = values[may_serve], distances[may_serve], few[may_serve]
    if len(starts) > settings.looked_at:
        more = _sections(family, values, starts[settings.looked_at :], effort.n_sections)
        sections = np.concatenate([sections, more], axis=1)
    found = phases(sections, ghost, gate, distances, geometry, power, settings)
    fitted = scaling(found, kind, len(ghost), effort, settings)
    born = replace(
        _judged(ds, found, fitted, kind, told, value, is_torus, settings), error=float(ds["bracket"].values[k])
    )
    if born.what != LOCKING or fitted is None:
        return born
    return replace(born, rotation=rotation_of(sections[fitted[2][-1]], len(ghost), geometry))


def _judged(
    ds: xr.Dataset,
    found: Phases | None,
    fitted: tuple[float, float, np.ndarray] | None,
    kind: str,
    told: str,
    value: float,
    is_torus: bool,
    settings: PassageSettings = PassageSettings(),
) -> Born:
    """Name the end if the lengths grow towards the bifurcation with its exponent."""
    if found is None or fitted is None:
        return Born("", f"{told}; its trajectories show too few laminar phases near this orbit to scale their lengths")
    exponent, error, chosen = fitted
    lengths, away = found.length[chosen], [own_width(ds, value, x) for x in found.distance[chosen]]
    told += f"; lengths of laminar phases near it from {lengths[0]:.3g} to {lengths[-1]:.3g} sections at distances from"
    told += f" {away[0]:.2g} to {away[-1]:.2g}: exponent {exponent:.3f} ± {error:.1g}"
    if (found.spread[chosen].max() <= settings.regular) != is_torus:
        return Born("", f"{told}, but they are {'uneven, as in chaos' if is_torus else 'equally long, as on a torus'}")
    expected = EXPONENTS[kind]
    if error > settings.largest_error or abs(exponent - expected) > max(settings.agrees, error):
        return Born("", f"{told}, and {expected:g} is expected")
    what = LOCKING if is_torus else INTERMITTENCY[TYPES[kind]]
    return Born(what, told, value, exponent=-exponent, exponent_error=error)


def _gate(points: np.ndarray, ghost: np.ndarray, geometry: Geometry) -> float:
    """Return the distance from the orbit up to which a section belongs to a laminar phase."""
    # largest distance from the orbit in a laminar phase: as a share of the extent of the set, and at most as a share of
    # the least distance between two section points of the orbit
    gate, of_gap = 0.1, 0.25
    extent = float(np.ptp(geometry.difference(points, points[0]), axis=0).max())
    gaps = geometry.distance(ghost[:, None], ghost[None])[np.triu_indices(len(ghost), 1)]
    return float(min([gate * extent, *(of_gap * gaps)]))


def _sections(family: Family, values: np.ndarray, starts: np.ndarray, n: int) -> np.ndarray:
    """Integrate trajectories from the same starts at some values, shape (value, trajectory, section, state)."""
    unknowns = [family.unknowns(state, [value]) for value in values for state in starts]
    rows = family.rows(np.array(unknowns))
    found = more_sections(
        rows.parameters[:, None],
        rows.frequency_hz[:, None],
        rows.states,
        np.zeros(len(rows.states)),
        n_more=n,
        **limits_at(PASSAGE_RTOL),
        system=family.system,
    )
    return np.asarray(found.section[:, 0].reshape(len(values), len(starts), n, -1))


def _may_serve(found: Phases, effort: Effort) -> np.ndarray:
    """Return at which values a part of the trajectories shows no length that is too long by more than its error."""
    least = np.where(found.number >= effort.n_phases, found.length * (1.0 - found.error), 0.0)
    return np.asarray(least <= effort.longest * effort.n_sections)


def phases(
    sections: np.ndarray,
    ghost: np.ndarray,
    gate: float,
    distances: np.ndarray,
    geometry: Geometry,
    power: int,
    settings: PassageSettings = PassageSettings(),
) -> Phases:
    """Measure the lengths of the laminar phases of trajectories: of their stays near an orbit.

    Parameters
    ----------
    sections
        Shape (distance, trajectory, section, state).
    ghost
        Section points of the orbit, shape (phase, state).
    gate
        Largest scaled distance from the orbit in a laminar phase.
    distances
        Distances from the bifurcation.
    geometry
        Geometry of the states.
    power
        The power m of `POWERS`.
    settings
        Numbers to choose.
    """
    rows = []
    for one in sections:
        near = np.zeros(one.shape[:-1], bool)
        for point in ghost:
            near |= geometry.distance(one, point) <= gate
        # at the ends of a channel some points of the orbit are near and others are not
        stays = [stay[stay >= 2 * len(ghost)] for stay in map(_runs, near)]
        groups = [_ratio(np.concatenate(stays[i :: settings.groups]), power) for i in range(settings.groups)]
        every = np.concatenate(stays)
        length, middle = _ratio(every, power), _ratio(every, 2)
        # a length is a whole number of sections
        error = float(np.std(groups)) / np.sqrt(settings.groups - 1.0) + 0.5
        spread = np.sqrt(max(_ratio(every, 3) / middle - 1.0, 0.0))
        rows.append((length, error / length, spread, len(every)))
    length, error, spread, number = np.array(rows).T
    return Phases(distances, length, error, number, spread)


def _runs(near: np.ndarray) -> np.ndarray:
    """Return the lengths of the runs of True in a row that begin and end within it."""
    edges = np.diff(near.astype(np.int8))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    if near[0]:
        ends = ends[1:]
    return np.asarray(ends - begins[: len(ends)], np.float64)


def _ratio(lengths: np.ndarray, power: int) -> float:
    """Return the mean of a power of some lengths over that of the power before it; NaN without lengths."""
    return float((lengths**power).sum() / (lengths ** (power - 1)).sum()) if len(lengths) else np.nan


def scaling(
    found: Phases, kind: str, period: int, effort: Effort, settings: PassageSettings = PassageSettings()
) -> tuple[float, float, np.ndarray] | None:
    """Fit the power with which the lengths grow near the bifurcation, with its error.

    The difference between the exponents without the farthest and without the nearest distance is part of the error.
    Return also the numbers of the distances; None if there are too few.
    """
    longest = effort.longest * effort.n_sections
    serves = (
        (found.length >= settings.least_length * period) & (found.length <= longest) & (found.number >= effort.n_phases)
    )
    chosen = np.flatnonzero(serves)[-settings.most_values :]
    if len(chosen) < settings.least_values:
        return None
    law = passage if kind == FOLD else straight
    x, y, error = np.log(found.distance[chosen]), np.log(found.length[chosen]), found.error[chosen]
    slope, own = _fit(law, x, y, error)
    parts = slice(1, None), slice(-1)
    near, far = (_fit(law, x[part], y[part], error[part])[0] for part in parts)
    return slope, float(np.hypot(own, near - far)), chosen


def straight(u: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the logarithm of the length over that of the distance: a straight line."""
    return np.asarray(u[1] + u[0] * x)


def passage(u: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the logarithm of the length of the passage from -c to c of y' = d + y**2, with d**-1/2 for any power.

    It is 2 d**-1/2 atan(c d**-1/2); the powers of d and the two factors are fitted.
    """
    return np.asarray(u[1] + u[0] * x + np.log(np.arctan(np.exp(u[2] + u[0] * x))))


def _fit(law: Callable[..., np.ndarray], x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Fit a law to the logarithms of lengths; return the exponent, its first coefficient, and its error."""
    slope = -0.5 if law is passage else -1.0
    rise = [1.0 - slope * float(x.mean())] if law is passage else []  # a channel of some length, at the middle
    start = np.array([slope, float((y - slope * x).mean()), *rise])
    found = least_squares(lambda u: (law(u, x) - y) / error, start, x_scale="jac")
    excess = max(1.0, 2.0 * found.cost / max(len(x) - len(start), 1))
    return float(found.x[0]), float(np.sqrt(excess * np.linalg.pinv(found.jac.T @ found.jac)[0, 0]))


def rotation_of(trajectories: np.ndarray, period: int, geometry: Geometry) -> str:
    """Return the rotation number p/q of an orbit of period q from section points of a torus that passes it slowly.

    The section points of each trajectory, shape (trajectory, section, state), turn on an angle of the model if it has
    one alone, else in the plane of the first two states about the middle of their extent, clockwise as in `rotation`;
    p is known up to multiples of q. The text is empty if the points do not turn by p/q.
    """
    # largest distance of the turns over the period of an orbit from a whole number, on a torus that passes it
    whole = 0.1
    flat = trajectories.reshape(-1, trajectories.shape[-1])
    away = geometry.difference(trajectories, 0.5 * (flat.max(axis=0) + flat.min(axis=0)))
    if sum(geometry.is_angle) == 1:
        i = geometry.is_angle.index(True)
        angle = away[..., i] * geometry.scales[i]
    else:
        angle = np.arctan2(-away[..., 1], away[..., 0])
    moved = np.diff(angle, axis=1)
    # the cut of the angles lies opposite to their mean direction
    middle = float(np.angle(np.exp(1j * moved).mean()))
    turns = (middle + np.angle(np.exp(1j * (moved - middle)))).mean() / (2.0 * np.pi) * period
    p = round(turns)
    return f"{p % period}/{period}" if abs(turns - p) < whole and gcd(p, period) == 1 else ""
