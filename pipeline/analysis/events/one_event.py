"""Find the ends of attractors that are one event: at one bifurcation or crisis, or at mirror images of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.bifurcations import SAME_PLACE
from pipeline.analysis.events.crises import Crisis
from pipeline.analysis.events.lines import Fate
from pipeline.analysis.events.names import BREAKUP, CRISES
from pipeline.analysis.events.scene import Event, Scene


def same_as(scene: Scene, named: Sequence[Event]) -> list[int]:
    """Return for each end of an attractor the number of the end that leads: ends at one bifurcation are one event.

    Parameters
    ----------
    scene
        Attractors and located branches.
    named
        Ends of attractors, after they are named.

    Returns
    -------
    list of int
        The leading end is that of the orbit on which the bifurcation lies, or of the set that meets the orbit of a
        crisis; it is the first one of mirror images.
    """
    groups: list[list[int]] = []
    for k, one in enumerate(named):
        own = next((group for group in groups if any(_is_same(scene, named[i], one) for i in group)), None)
        if own is None:
            groups.append([k])
        else:
            own.append(k)
    found = [0] * len(named)
    for group in groups:
        lead = min(group, key=lambda k: (_is_seen_from_elsewhere(scene.located, named[k]), k))
        for k in group:
            found[k] = lead
    return found


def _is_seen_from_elsewhere(ds: xr.Dataset, one: Event) -> bool:
    if isinstance(one.born, Crisis):
        return one.born.lives_beyond
    return not is_own(ds, one.fate)


def _is_same(scene: Scene, a: Event, b: Event) -> bool:
    """Tell whether two ends are one event: of one kind, at one value, and of one orbit or of mirror images."""
    # comparisons with the errors of events that have no value, which are NaN, are false
    if a.what != b.what or not abs(a.fate.value - b.fate.value) <= a.error + b.error:
        return False
    ds, (j, k) = scene.located, (a.fate.bifurcation, b.fate.bifurcation)
    if a.what in (*CRISES, BREAKUP) and (
        a.fate.value == b.fate.value or b.stretch.attractor == getattr(a.born, "twin", -1)
    ):
        return True  # one crisis told from both sides, or by both sets that merge
    if min(j, k) >= 0:
        points = ds["bifurcation_section"].values[[j, k]]
        away = geometry_of(scene.attractors).distance(points[0], points[1, 0])
        if j == k or np.nanmin(away) <= SAME_PLACE:
            return True
    return a.rises == b.rises and _are_mirrored(scene, a, b)


def _are_mirrored(scene: Scene, a: Event, b: Event) -> bool:
    """Tell whether two attractors are mirror images of each other at the ends of their stretches."""
    ds, (i, j) = scene.attractors, (one.stretch.rows[one.rises] for one in (a, b))
    if a.stretch.places[a.rises] != b.stretch.places[b.rises] or "mirror_partner" not in ds:
        return False
    return int(ds["mirror_partner"].values[i]) == int(ds["attractor"].values[j])


def is_own(ds: xr.Dataset, fate: Fate) -> int:
    """Return 1 if an orbit ends at a bifurcation on its own branch, 0 if its branch springs from it or turns there."""
    return int(fate.bifurcation >= 0 and int(ds["of_branch"].values[fate.bifurcation]) == fate.branch)
