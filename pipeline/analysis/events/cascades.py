"""Decide whether a chaotic set ends in a cascade of doublings, and whether a torus ends on an orbit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.kinds import DOUBLING, KINDS, TORUS
from pipeline.analysis.events.kinds import CASCADE
from pipeline.analysis.events.lines import Fate, at
from pipeline.analysis.events.passages import may_pass
from pipeline.analysis.events.scene import Born, Event, Scene, judged, orbit_beyond
from pipeline.results.ragged import points_of_rows, rows_at
from pipeline.results.sets import Geometry, mean_distance
from pipeline.results.tabular import words_of

DELTA = 4.669201609
"""Feigenbaum's constant: the limit of the ratio of successive intervals between doublings of smooth maps."""


def name_cascade(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a chaotic set by the cascade of doublings of the orbit to which its cells go on."""
    fate = orbit_beyond(one, named)
    if fate is None or may_pass(scene.located, fate.bifurcation, is_torus=False):
        return one
    points = points_of_rows(scene.attractors)[one.row]
    found = cascade_of(scene.located, fate, scene.values_at(one), points, geometry_of(scene.attractors))
    return judged(scene, one, fate, found)


def cascade_of(
    ds: xr.Dataset, fate: Fate, bracket: tuple[float, float], points: np.ndarray, geometry: Geometry
) -> Born:
    """Judge whether a chaotic set ends where a cascade of doublings accumulates.

    Parameters
    ----------
    ds
        Located branches.
    fate
        End of the orbit to which the cells of the set go on.
    bracket
        Values of the run on the orbit's side and on the set's side.
    points
        Section points of the set at its last value.
    geometry
        Geometry of the states.

    Returns
    -------
    Born
        The limit follows from the last two doublings and Feigenbaum's constant; its error is the change if the
        measured ratio takes the place of the constant.
    """
    allowed = (4.0, 5.5)  # range of the last ratio within which doublings count as a cascade
    # distance from the limit at which the bands of chaos have merged to those of a doubling, as a share of that
    # doubling's distance: (3.592572 - 3.569946)/(3.569946 - 3.449490) for the logistic map, where four bands merge to
    # two. The bands merge at the same rate as orbits double. So nearer to the limit a chaotic set has the cascade's
    # bands, and no crisis lies between.
    merging = 0.187
    near = 0.15  # largest mean distance of a chaotic set from the last doubled orbit, in units of the orbit's size
    chain = _chain(ds, fate.bifurcation)
    way = np.sign(bracket[1] - bracket[0])
    found = ds["value"].values[chain]
    if len(chain) < 3 or (np.diff(found) * way <= 0.0).any():
        listed = f"at {at(ds, *found)}" if chain else "none"
        return Born("", f"a cascade needs three doublings of the orbit to which its cells go; located: {listed}")
    steps = np.diff(found)
    ratio = float(steps[-2] / steps[-1])
    limit = float(found[-1] + steps[-1] / (DELTA - 1.0))
    error = abs(float(steps[-1]) * (1.0 / (DELTA - 1.0) - 1.0 / (ratio - 1.0))) if ratio > 1.0 else np.inf
    told = f"doublings at {at(ds, *found)}, last ratio {ratio:.4f}, limit at {at(ds, limit)}"
    if not allowed[0] < ratio < allowed[1]:
        return Born("", f"{told}: the ratio is not near {DELTA:.4f}")
    if (limit - bracket[0]) * way < -error or (limit - bracket[1]) * way > error:
        return Born("", f"{told}: the limit lies outside of {at(ds, *bracket)}")
    orbit = ds["bifurcation_section"].values[chain[-1]]
    orbit = orbit[np.isfinite(orbit).all(axis=-1)]
    ratios = steps[:-1] / steps[1:]
    regular = next(k for k in range(len(ratios)) if ((ratios[k:] > allowed[0]) & (ratios[k:] < allowed[1])).all())
    if abs(bracket[1] - limit) > merging * abs(limit - found[regular]):
        return Born("", f"{told}: the set is seen so far from the limit that crises may lie between")
    size = float(geometry.distance(orbit[:, None], orbit[None]).max())
    away = mean_distance(points, orbit, geometry) / size
    if away > near:
        return Born("", f"{told}: the set is {away:.2f} of the orbit's size away from the last orbit")
    why = f"{told}; the set is {away:.3f} of the orbit's size away from the last orbit"
    return Born(CASCADE, why, limit, error, tuple(map(float, found)), ratio)


def _chain(ds: xr.Dataset, k: int) -> list[int]:
    """Return the doublings that lead to one and on from it, by rising period."""
    kind, of, to = (ds[name].values for name in ("kind", "of_branch", "to_branch"))
    doubling = kind == KINDS.index(DOUBLING)
    if k < 0 or not doubling[k]:
        return []
    chain = [k]
    while (before := np.flatnonzero(doubling & (to == of[chain[0]]))).size:
        nearest = before[np.abs(ds["value"].values[before] - ds["value"].values[chain[0]]).argmin()]
        if int(nearest) in chain:
            break
        chain.insert(0, int(nearest))
    loses = np.minimum(ds["n_unstable_before"].values, ds["n_unstable_after"].values) == 0
    while to[chain[-1]] >= 0 and (after := np.flatnonzero(doubling & loses & (of == to[chain[-1]]))).size:
        nearest = after[np.abs(ds["value"].values[after] - ds["value"].values[chain[-1]]).argmin()]
        if int(nearest) in chain:
            break
        chain.append(int(nearest))
    return chain


def name_torus(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a torus by the Neimark-Sacker point of the orbit to which its cells go on."""
    fate, stretch = orbit_beyond(one, named), one.stretch
    if fate is None or may_pass(scene.located, fate.bifurcation, is_torus=True):
        return one
    if stretch.places[0] == stretch.places[1]:
        why = "one value of the run shows the torus; two are needed to see it shrink"
        return judged(scene, one, fate, Born("", why))
    place, points = one.place - one.way, points_of_rows(scene.attractors)
    rows = rows_at(scene.attractors)[(int(scene.order[place]),)]
    inner = next(row for row in rows if scene.attractors["attractor"].values[row] == stretch.attractor)
    values = *scene.values_at(one), float(scene.along[place])
    found = torus_of(scene.located, fate, values, (points[one.row], points[inner]), geometry_of(scene.attractors))
    return judged(scene, one, fate, found)


def torus_of(
    ds: xr.Dataset, fate: Fate, bracket: tuple[float, float, float], tori: Sequence[np.ndarray], geometry: Geometry
) -> Born:
    """Judge whether a torus ends on an orbit, at a supercritical Neimark-Sacker point.

    Parameters
    ----------
    ds, fate, geometry
        As in `cascade_of`.
    bracket
        Values of the run: on the orbit's side, and the two nearest on the side of the torus.
    tori
        Section points of the torus at these two values.
    """
    largest = 0.25  # deviation from 1 of the ratio of a torus's squared sizes to that of its distances from the point
    k, (beyond, seen, inner) = fate.bifurcation, bracket
    value, kind = float(ds["value"].values[k]), KINDS[int(ds["kind"].values[k])]
    degree = words_of(ds["criticality"])[int(ds["criticality"].values[k])]
    told = f"the orbit to which its cells go ends at {at(ds, value)}: {degree} {kind.replace('_', ' ')}"
    if kind != TORUS or degree != "supercritical" or not min(beyond, seen) <= value <= max(beyond, seen):
        return Born("", told)
    orbit = ds["bifurcation_section"].values[k]
    orbit = orbit[np.isfinite(orbit).all(axis=-1)]
    near, far = (mean_distance(points, orbit, geometry) for points in tori)
    share = near**2 / far**2 / ((seen - value) / (inner - value))
    told += f"; the torus shrinks as the root of the distance to {share:.2f}"
    if abs(share - 1.0) > largest:
        return Born("", told)
    return Born(TORUS, told, value, float(ds["bracket"].values[k]))
