"""Turn branches into lines with their bifurcations as nodes, find an orbit on them, and follow it to its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.sizes import LEVEL
from pipeline.analysis.branches.analysis import fixed_of
from pipeline.analysis.branches.bifurcations import SAME_PLACE
from pipeline.analysis.branches.exploring import POINTS_BESIDE
from pipeline.analysis.branches.kinds import BRANCHING, FOLD, KINDS, LIMITS, PITCHFORK, TRANSCRITICAL
from pipeline.analysis.branches.known import GUESS, NEAR_FOLD, SAME_VALUE, at_value, error_of
from pipeline.analysis.branches.lockstep import run_together
from pipeline.analysis.branches.problems import Family
from pipeline.layout.own_words import place_in_words, rate_of, width_in_own_words
from pipeline.results.sets import Geometry
from pipeline.results.tabular import words_of
from pipeline.results.tolerances import SAME_ON_BRANCH

CROSSING = [KINDS.index(kind) for kind in (BRANCHING, PITCHFORK, TRANSCRITICAL)]
"""Codes of the bifurcations at which another branch passes."""

LOCATED = 1e-9
"""Least error of a located bifurcation, as a share of the interval: integrations have the tolerance 1e-12."""

AT_BRANCH_POINT = 1e-7
"""The same of branch points, where Newton's method is as exact as the root of its residual."""

SPRUNG = ("start", "period_halving", "equilibrium")
"""Ends of a branch that lie on another branch."""


@dataclass(frozen=True, eq=False)
class Line:
    """A branch as a series of nodes: its points, and between them the bifurcations on it."""

    branch: int
    period: int  # 0 of equilibria
    value: np.ndarray  # parameter, (node,)
    points: np.ndarray  # section points, (node, phase, state)
    bifurcation: np.ndarray  # number of the bifurcation at a node, -1 none
    n_unstable: np.ndarray  # unstable multipliers at a node, -1 at bifurcations
    is_stable: np.ndarray  # whether the orbits between a node and the next one are stable, (node - 1,)
    ends: tuple[str, str]


@dataclass(frozen=True)
class Fate:
    """End of a stable orbit along its branch: at a bifurcation, at a bound of the branches, or unknown."""

    value: float  # parameter value; NaN if unknown
    branch: int = -1
    node: int = -1  # node of the branch's line at which the orbit ends
    bifurcation: int = -1
    why: str = ""  # evidence, or why there is no bifurcation
    is_bound: bool = False
    limit: str = ""  # kind of an end at which the period grows without bound, of `LIMITS`
    error: float = np.nan  # of its value

    def reach(self, bound: float) -> float:
        """Return the value up to which the orbit is known to be stable: `bound` if its branch has no end, NaN if its
        end is not located.
        """
        if self.is_bound:
            return bound
        return self.value if self.bifurcation >= 0 or self.limit else np.nan


def lines_of(ds: xr.Dataset, others: Mapping[str, float], geometry: Geometry) -> list[Line]:
    """Return the branches that have given values of the fixed parameters, as lines."""
    lines = []
    for branch in range(ds.sizes["branch"]):
        period = int(ds["orbit_period"].values[branch])
        own = {name: v for name, v in fixed_of(ds, branch).items() if period or name != LEVEL}
        if all(np.isclose(v, others[name], rtol=1e-9, atol=0.0, equal_nan=True) for name, v in own.items()):
            lines.append(_line(ds, branch, period, geometry))
    return lines


def _line(ds: xr.Dataset, branch: int, period: int, geometry: Geometry) -> Line:
    n, phases = int(ds["n_points"].values[branch]), max(period, 1)
    own = np.flatnonzero(ds["of_branch"].values == branch)
    places = ds["after"].values[own] + 1
    located = ds["bifurcation_section"].values[:, :phases]
    value = np.insert(ds["parameter"].values[branch, :n], places, ds["value"].values[own])
    points = np.insert(ds["section"].values[branch, :n, :phases], places, located[own], axis=0)
    bifurcation = np.insert(np.full(n, -1), places, own)
    unstable = np.insert(ds["n_unstable"].values[branch, :n].astype(int), places, -1)
    scale = max(float(np.ptp(value)), 1e-300)
    for k in np.flatnonzero((ds["to_branch"].values == branch) & np.isin(ds["kind"].values, CROSSING)):
        at, x = located[k, 0], float(ds["value"].values[k])
        near = geometry.distance(points, at).min(axis=1) + np.abs(value - x) / scale
        node = int(near.argmin())
        if near[node] > SAME_PLACE:  # the point is no node yet: it lies before or after the nearest one
            beside = [i for i in (node - 1, node + 1) if 0 <= i < len(near)]
            node = max(node, min(beside, key=near.__getitem__))
            value, points = np.insert(value, node, x), np.insert(points, node, located[k], axis=0)
            bifurcation, unstable = np.insert(bifurcation, node, k), np.insert(unstable, node, -1)
        bifurcation[node], unstable[node] = k, -1
    ends = tuple(words_of(ds[f"{end}_end"])[int(ds[f"{end}_end"].values[branch])] for end in ("first", "last"))
    stable = _stable(ds, branch, bifurcation, unstable)
    return Line(branch, period, value, points, bifurcation, unstable, stable, (ends[0], ends[1]))


def _stable(ds: xr.Dataset, branch: int, bifurcation: np.ndarray, unstable: np.ndarray) -> np.ndarray:
    """Return whether the orbits between neighbouring nodes are stable, also between two bifurcations."""
    both = np.stack([unstable[:-1], unstable[1:]])
    own = (bifurcation >= 0) & (ds["of_branch"].values[bifurcation] == branch) if len(ds["kind"]) else bifurcation > 0
    found = ((both <= 0) & (both.max(axis=0) == 0)).all(axis=0)
    for node in np.flatnonzero((both == -1).all(axis=0)).tolist():
        if own[node]:
            found[node] = ds["n_unstable_after"].values[bifurcation[node]] == 0
        elif own[node + 1]:
            found[node] = ds["n_unstable_before"].values[bifurcation[node + 1]] == 0
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Orbit:
    """An attractor's orbit at a parameter value: its family of orbits and a section point."""

    family: Family
    state: np.ndarray
    value: float


Place = tuple[Line, int, float]
"""A line, the node before an orbit on it, and the scaled distance between the orbit and that of the branch."""


def places_of(orbits: Sequence[Orbit], lines: Sequence[Line], geometry: Geometry) -> list[Place | None]:
    """Find each orbit on the lines; None if it lies on no line or on none that is stable there.

    Newton's method refines the orbits of the lines at the value of the parameter; the section points are compared.
    """
    asked = [
        (i, line, node, guess)
        for i, orbit in enumerate(orbits)
        for line in lines
        if line.period == orbit.family.period
        for node, guess in _guesses(orbit, line, geometry)
    ]
    there = run_together([at_value(orbits[i].family, guess) for i, _, _, guess in asked])
    best: dict[int, tuple[float, Place]] = {}
    for (i, line, node, guess), point in zip(asked, there, strict=True):
        if point is None:
            continue
        family = orbits[i].family
        u = family.unknowns(orbits[i].state, [orbits[i].value])
        away = min(float(np.abs(family.mismatch(u, image)).max()) for image in point.value.images)
        moved = float(np.abs(point.u - guess).max())
        if away <= SAME_ON_BRANCH + error_of(point) and moved < best.get(i, (np.inf,))[0]:
            best[i] = (moved, (line, node, away))
    return [best[i][1] if i in best else None for i in range(len(orbits))]


def bifurcation_at(
    ds: xr.Dataset, line: Line, value: float, points: np.ndarray, geometry: Geometry, scale: float
) -> Place | None:
    """Find a bifurcation at which an orbit lies, and the stable segment of a line that ends there; None without one.

    The orbit of a bifurcation may lie beyond the last one of its branch, and is found to the root of its residual
    alone, so that values are compared within the error of the bifurcation, and all points of the orbit with its own.
    """
    for node in np.flatnonzero(line.bifurcation >= 0).tolist():
        away = geometry.distance(points[:, None], line.points[node]).min(axis=1).max()
        stable = [i for i in (node - 1, node) if 0 <= i < len(line.is_stable) and line.is_stable[i]]
        is_here = abs(line.value[node] - value) <= error_at(ds, int(line.bifurcation[node]), scale)
        if is_here and stable and away <= NEAR_FOLD:
            return line, stable[0], float(away)
    return None


def error_at(ds: xr.Dataset, k: int, scale: float) -> float:
    """Return the error of the value of a bifurcation, given the length of the interval."""
    least = AT_BRANCH_POINT if int(ds["kind"].values[k]) in CROSSING else LOCATED
    return max(float(ds["bracket"].values[k]), least * scale)


def _guesses(orbit: Orbit, line: Line, geometry: Geometry) -> list[tuple[int, np.ndarray]]:
    """Return the stable segments of a line that pass an orbit's parameter value near it, and the orbits there."""
    away = line.value - orbit.value
    away[np.abs(away) <= SAME_VALUE * orbit.family.scales[0]] = 0.0
    found = []
    for node in np.flatnonzero(away[:-1] * away[1:] <= 0.0).tolist():
        a, b = line.points[node], line.points[node + 1]
        if not line.is_stable[node] or away[node] == away[node + 1]:
            continue
        share = away[node] / (away[node] - away[node + 1])
        middle = a + share * geometry.difference(b, a) * np.asarray(geometry.scales)
        chord = float(geometry.distance(a, b).max())
        if geometry.distance(middle, orbit.state).min() < GUESS + 0.5 * chord:
            found.append((node, orbit.family.unknowns(middle[0], [orbit.value])))
    return found


def follow(ds: xr.Dataset, place: Place, way: int) -> Fate:
    """Follow a stable orbit along its line as the parameter rises (`way` 1) or falls (-1), until it ends."""
    line, segment, away = place
    step = 1 if (line.value[segment + 1] - line.value[segment]) * way > 0.0 else -1
    node, last = segment + (step > 0), len(line.value) - 1
    seen = f"branch {line.branch} has this orbit (to {away:.0e} of the states' scales)"

    def lost(why: str) -> Fate:
        return Fate(np.nan, line.branch, node, why=f"{seen} and {why}")

    for _ in range(2 * last + 2):
        if node == (last if step > 0 else 0):
            if line.ends[0] != "closed":
                return _at_end(ds, line, node, seen)
            node = 0 if step > 0 else last  # the last node of a closed line repeats the first
        x, k = float(line.value[node]), int(line.bifurcation[node])
        turns = (line.value[node + step] - x) * way < 0.0
        stays = bool(line.is_stable[node if step > 0 else node - 1])
        if k >= 0 and (turns or not stays):
            return Fate(x, line.branch, node, k, f"{seen} and is stable up to the bifurcation")
        if k < 0 and line.n_unstable[node] > 0:
            return lost(f"loses stability before {at(ds, x)}, where no bifurcation is located")
        if k < 0 and turns:
            return lost(f"turns at {at(ds, x)}, where no bifurcation is located")
        node += step
    return lost("is closed and stable all along")


def at(ds: xr.Dataset, *numbers: float) -> str:
    """Write values of the parameter with its name, in the words of the specification."""
    return place_in_words(str(ds.attrs["parameter"]), rate_of(ds), *numbers, digits=10)


def own_width(ds: xr.Dataset, value: float, width: float) -> float:
    """Return the width of an interval around a value of the parameter, in the unit of the specification."""
    return width_in_own_words(str(ds.attrs["parameter"]), rate_of(ds), value, width)


def _at_end(ds: xr.Dataset, line: Line, node: int, seen: str) -> Fate:
    """Return the fate of an orbit that is stable up to an end of its branch."""
    x, end = float(line.value[node]), line.ends[1 if node else 0]
    where = f"ends at {at(ds, x)} ({end.replace('_', ' ')})"
    if int(line.n_unstable[node]) > 0:
        return Fate(np.nan, line.branch, node, why=f"{seen}, loses stability and {where}")
    if end == "bound":
        why = f"{seen} and is stable up to the bound of the branches"
        return Fate(x, line.branch, node, why=why, is_bound=True)
    if end in LIMITS:
        value, error = (float(ds[f"limit_{name}"].values[line.branch, 1 if node else 0]) for name in ("value", "error"))
        why = f"{seen}, is stable, and its period grows without bound"
        return Fate(value, line.branch, node, why=why, limit=end, error=error)
    k = _sprung_from(ds, line, node, end) if end in SPRUNG else -1
    if k >= 0:
        why = f"{seen}, is stable, and springs from the bifurcation"
        return Fate(float(ds["value"].values[k]), line.branch, node, k, why)
    return Fate(np.nan, line.branch, node, why=f"{seen}, is stable, and {where}")


def crossing_at(ds: xr.Dataset, lines: Sequence[Line], k: int) -> str:
    """Return the kind of a branch point if its two branches prove it: at a pitchfork exactly one of them turns, at a
    transcritical point neither does.
    """
    turning = []
    for branch in (int(ds[name].values[k]) for name in ("of_branch", "to_branch")):
        for line in lines:
            for node in np.flatnonzero(line.bifurcation == k).tolist() if line.branch == branch else ():
                before, after = max(node - POINTS_BESIDE, 0), min(node + POINTS_BESIDE, len(line.value) - 1)
                if before < node < after:
                    turning.append(bool(np.prod(line.value[[before, after]] - line.value[node]) > 0.0))
    kind = KINDS[int(ds["kind"].values[k])]
    proved = {PITCHFORK: [False, True], TRANSCRITICAL: [False, False]}.get(kind)
    return kind if sorted(turning) == proved else BRANCHING


def _sprung_from(ds: xr.Dataset, line: Line, node: int, end: str) -> int:
    """Return the bifurcation from which a branch springs at one of its ends; -1 if none is known."""
    if end == "start":
        return int(ds["origin"].values[line.branch])
    rows = np.flatnonzero((ds["to_branch"].values == line.branch) & ~np.isin(ds["kind"].values, CROSSING))
    rows = rows[ds["kind"].values[rows] != KINDS.index(FOLD)]
    away = np.abs(ds["value"].values[rows] - line.value[node])
    # a branch may spring from two bifurcations, one at each end: the other one lies beyond most of the branch
    near = away <= 0.25 * np.ptp(line.value)
    return int(rows[near][away[near].argmin()]) if near.any() else -1
