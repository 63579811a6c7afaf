"""Tell what curves do to the attractors beside them, and why some do nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.analysis.atlas.ends import beside_all
from pipeline.analysis.atlas.plane import Array, Change, Plane
from pipeline.analysis.atlas.verdicts import Verdict, met_at, rows_at
from pipeline.analysis.branches.curves import Curve
from pipeline.analysis.branches.kinds import BRANCH_POINTS, HOMOCLINIC
from pipeline.analysis.events.kinds import LIVES_ON
from pipeline.results.tabular import counted

FOLLOWED_BACK = 8
"""Most places of a curve without a change from which the orbits beside it are followed to the neighbouring points."""

UNSTABLE = "its orbits are unstable on both sides"
NOT_CROSSED = "its stable part passes between no two neighbouring points"


@dataclass(frozen=True)
class Effect:
    """Number of pairs of neighbouring points that a curve separates, of those whose attractors differ, and why others
    do not.
    """

    n_crossed: int
    n_effects: int
    why: str = ""


@dataclass(eq=False)
class Crossings:
    """Edges that the stable parts of curves cross, with the place of each crossing in units of the plane."""

    curve: list[int] = field(default_factory=list)
    edge: list[int] = field(default_factory=list)
    segment: list[int] = field(default_factory=list)
    share: list[float] = field(default_factory=list)


def crossings(plane: Plane, tracks: Sequence[Array], stable: Sequence[Array]) -> Crossings:
    """Find the edges between neighbouring points that the stable parts of curves cross.

    Parameters
    ----------
    plane
        The plane.
    tracks
        Points of each curve (point, 2), in units of the plane.
    stable
        Whether the orbits beside each point of a curve may be stable.
    """
    found = Crossings()
    n, m = plane.shape
    grid = [plane.scaled(plane.values)[::m, 0], plane.scaled(plane.values)[:m, 1]]
    upright = (n - 1) * m
    for number, (track, good) in enumerate(zip(tracks, stable, strict=True)):
        for k in range(len(track) - 1):
            if not (good[k] and good[k + 1]):
                continue
            for axis in (0, 1):
                a, b = track[k, axis], track[k + 1, axis]
                low, high = min(a, b), max(a, b)
                first, stop = np.searchsorted(grid[axis], [low, high], side="left")
                for line in range(int(first), int(stop)):
                    share = (grid[axis][line] - a) / (b - a)
                    other = track[k, 1 - axis] + share * (track[k + 1, 1 - axis] - track[k, 1 - axis])
                    cell = int(np.searchsorted(grid[1 - axis], other, side="right")) - 1
                    if not 0 <= cell < len(grid[1 - axis]) - 1:
                        continue
                    # on a line of constant first parameter lie the edges along the second
                    edge = upright + line * (m - 1) + cell if axis == 0 else cell * m + line
                    found.curve.append(number)
                    found.edge.append(edge)
                    found.segment.append(k)
                    found.share.append(float(share))
    return found


def effects_of(
    plane: Plane,
    changes: Sequence[Change],
    found: Sequence[Verdict],
    curves: Sequence[Curve],
    crossed: Crossings,
    stable: Sequence[Array],
) -> list[Effect]:
    """Return the effect of each curve, and why it has none at some or all crossings.

    Parameters
    ----------
    plane, changes, found
        The plane, its changes and the verdicts on them.
    curves
        The curves.
    crossed, stable
        Crossings of their stable parts with edges, see `crossings`.
    """
    effects = []
    for number, curve in enumerate(curves):
        own = [k for k, one in enumerate(crossed.curve) if one == number]
        edges = {crossed.edge[k] for k in own}
        changed = {int(plane.parent[c.edge]) for c, v in zip(changes, found, strict=True) if v.curve == number}
        silent = [k for k in own if crossed.edge[k] not in changed]
        why = ""
        if silent:
            why = _silence(plane, curve, crossed, silent)
        elif not changed:
            why = NOT_CROSSED if stable[number].any() else UNSTABLE
        effects.append(Effect(len(edges | changed), len(changed), why))
    return effects


def _silence(plane: Plane, curve: Curve, crossed: Crossings, own: Sequence[int]) -> str:
    """Follow the stable orbits at some crossings to the neighbouring points, and say why no change was seen there."""
    if curve.kind in (HOMOCLINIC, *BRANCH_POINTS):
        return "not followed from this kind of point"
    chosen = [own[int(k)] for k in np.unique(np.linspace(0, len(own) - 1, FOLLOWED_BACK).round())]
    places = []
    for k in chosen:
        a, b = curve.points[crossed.segment[k] : crossed.segment[k] + 2]
        u, axis = a.u + crossed.share[k] * (b.u - a.u), plane.axis_of(crossed.edge[k])
        family, values = curve.family, curve.family.values(u)
        other = plane.names[1 - axis]
        packed, frequency = family.parameters.copy(), family.frequency_hz
        if other in family.system.parameter_names:
            packed[family.system.parameter_names.index(other)] = values[1 - axis]
        else:
            frequency = float(values[1 - axis])
        along = replace(
            family, free=(plane.names[axis],), scales=(family.scales[axis],), parameters=packed, frequency_hz=frequency
        )
        n = family.system.n_states
        ends = plane.values[plane.edges[crossed.edge[k]], axis]
        here = np.append(u[:n], values[axis] / family.scales[axis])
        places.append((along, here, (float(ends[0]), float(ends[1]))))
    rows = rows_at(plane)
    told: Counter[str] = Counter()
    for k, found in zip(chosen, beside_all(places), strict=True):
        nodes = plane.edges[crossed.edge[k]]
        reached = [one for one in found if one.what == LIVES_ON]
        for one in reached:
            axis = plane.axis_of(crossed.edge[k])
            node = nodes[int(np.argmin(np.abs(plane.values[nodes, axis] - one.value)))]
            is_met = met_at(plane.points, rows[node], np.asarray(one.state), curve.family.system) >= 0
            told["the stable orbit is met on its side" if is_met else "no cell finds the stable orbit"] += 1
        if not reached:
            told["the stable orbit ends before the next point" if found else "no stable orbit could be followed"] += 1
    return "; ".join(f"{text} ({counted(n, 'place')})" for text, n in told.most_common())
