"""Find the ends of attractors that are one event: at one bifurcation or crisis, or at mirror images of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.bifurcations import SAME_PLACE
from pipeline.analysis.branches.kinds import SNIC
from pipeline.analysis.events.crises import Crisis
from pipeline.analysis.events.kinds import EVENTS, RANGE_END, UNDECIDED
from pipeline.analysis.events.lines import Fate
from pipeline.analysis.events.scene import Event, Scene
from pipeline.layout.vocabulary import EQUILIBRIUM
from pipeline.results.tolerances import SAME_ON_BRANCH


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
        own = [group for group in groups if any(_is_same(scene, named[i], one) for i in group)]
        groups = [group for group in groups if group not in own] + [[*(i for group in own for i in group), k]]
    found = [0] * len(named)
    for group in groups:
        lead = min(group, key=lambda k: (_is_seen_from_elsewhere(scene.located, named[k]), k))
        for k in group:
            found[k] = lead
    return found


def with_images(scene: Scene, named: Sequence[Event]) -> list[Event]:
    """Give ends that are not decided the verdict of their mirror images, if these are decided."""
    decided = [one for one in named if one.what not in (UNDECIDED, RANGE_END)]
    found = []
    for one in named:
        image = next((i for i in decided if _is_image(scene, one, i)), None) if one.what == UNDECIDED else None
        if image is not None:
            fate = replace(image.fate, why=f"of its mirror image: {image.fate.why}")
            born = image.born
            if isinstance(born, Crisis) and born.twin == one.stretch.attractor:
                born = replace(born, twin=image.stretch.attractor)
            one = replace(one, what=image.what, error=image.error, fate=fate, born=born)
        found.append(one)
    return found


def _is_image(scene: Scene, one: Event, other: Event) -> bool:
    """Tell whether an attractor is the mirror image of another one where it ends, and both end for one reason.

    The images of orbits share a branch, so the other one may be seen further on. Of other sets both end at one value.
    """
    ds, row, place = scene.attractors, one.stretch.rows[one.rises], one.stretch.places[one.rises]
    mine, its = one.stretch, other.stretch
    if "mirror_partner" not in ds or (mine.kind, mine.period, one.rises) != (its.kind, its.period, other.rises):
        return False
    if not mine.period and mine.kind != EQUILIBRIUM:
        return are_mirrored(scene, one, other) and are_mirrored(scene, other, one)
    partner = int(ds["mirror_partner"].values[row])
    is_there = its.places[0] <= place <= its.places[1]
    is_same = ds["mirror_distance"].values[row] <= SAME_ON_BRANCH
    return bool(is_there and is_same and scene.names.get((place, partner), partner) == its.attractor)


def _is_seen_from_elsewhere(ds: xr.Dataset, one: Event) -> bool:
    if isinstance(one.born, Crisis):
        return one.born.lives_beyond
    return not is_own(ds, one.fate)


def _is_same(scene: Scene, a: Event, b: Event) -> bool:
    """Tell whether two ends are one event: of one kind, at one value, and of one orbit or of mirror images."""
    if a.what != b.what or not is_at_one_value(a, b):
        return False
    if a.what == SNIC and (on_circle(scene, a, b) or on_circle(scene, b, a)):
        return True
    ds, (j, k) = scene.located, (a.fate.bifurcation, b.fate.bifurcation)
    if EVENTS[a.what].two_sided and (
        a.fate.value == b.fate.value or b.stretch.attractor == getattr(a.born, "twin", -1)
    ):
        return True  # one crisis told from both sides, or by both sets that merge
    if min(j, k) >= 0:
        points = ds["bifurcation_section"].values[[j, k]]
        away = geometry_of(scene.attractors).distance(points[0], points[1, 0])
        if j == k or np.nanmin(away) <= SAME_PLACE:
            return True
    return a.rises == b.rises and are_mirrored(scene, a, b)


def is_at_one_value(a: Event, b: Event) -> bool:
    """Tell whether two ends are at one value within their errors; those without a value, which is NaN, are not."""
    return bool(abs(a.fate.value - b.fate.value) <= a.error + b.error)


def on_circle(scene: Scene, one: Event, cycle: Event) -> bool:
    """Tell whether an equilibrium ends, from the other side, in a fold at which a cycle comes to rest."""
    ds, k = scene.located, one.fate.bifurcation
    if k < 0 or cycle.fate.limit != SNIC or one.rises == cycle.rises or not is_at_one_value(one, cycle):
        return False
    rests = ds["limit_state"].values[cycle.fate.branch, int(cycle.fate.node > 0)]
    away = geometry_of(scene.attractors).distance(rests, ds["bifurcation_section"].values[k, 0])
    return bool((away <= SAME_PLACE).any())


def are_mirrored(scene: Scene, a: Event, b: Event) -> bool:
    """Tell whether two attractors are mirror images of each other at the ends of their stretches."""
    ds, (i, j) = scene.attractors, (one.stretch.rows[one.rises] for one in (a, b))
    if a.stretch.places[a.rises] != b.stretch.places[b.rises] or "mirror_partner" not in ds:
        return False
    return int(ds["mirror_partner"].values[i]) == int(ds["attractor"].values[j])


def is_own(ds: xr.Dataset, fate: Fate) -> int:
    """Return 1 if an orbit ends at a bifurcation on its own branch, 0 if its branch springs from it or turns there."""
    return int(fate.bifurcation >= 0 and int(ds["of_branch"].values[fate.bifurcation]) == fate.branch)
