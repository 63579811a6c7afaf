"""Find the bifurcations that are images of each other under the mirror symmetry of the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magpend_core.models.model import Mirror, Model
from magpend_core.orbits import scaled_distance
from magpend_core.precision import limits_at, tolerances_at
from magpend_core.sampling import Drive, sample
from magpend_core.sections import run_branches
from pipeline.analysis.branches.bifurcations import SAME_PLACE, Bifurcation
from pipeline.analysis.branches.problems import Family
from pipeline.results.tolerances import BRANCH_RTOL

Located = tuple[Family, Bifurcation]
"""A bifurcation with the family of its orbit."""


def images_of(located: Sequence[Located], model: Model) -> np.ndarray:
    """Return for each bifurcation the number of its mirror image, -1 if it has none apart from itself.

    Two are images if they are of one kind at one value of the parameter, and the mirror image of one orbit passes
    through the section point of the other one, both within `SAME_PLACE`, and if each is the other's nearest.
    """
    found: np.ndarray = np.full(len(located), -1)
    mirror = model.flow.mirror
    if mirror is None:
        return found
    away = np.full((len(located), len(located)), np.inf)
    for k, one in enumerate(located):
        others = [i for i, other in enumerate(located) if _may_be_images(one, other)]
        if len(others) > 1:
            points = _image(*one, mirror)
            away[k, others] = [_distance(points, *located[i]) for i in others]
    away[away > SAME_PLACE] = np.inf
    both = np.maximum(away, away.T)
    for k in np.flatnonzero(np.isinf(np.diag(away))).tolist():  # other orbits are their own images
        nearest = int(np.argmin(both[k]))
        if np.isfinite(both[k, nearest]) and int(np.argmin(both[nearest])) == k:
            found[k] = nearest
    return found


def _may_be_images(one: Located, other: Located) -> bool:
    """Tell whether two bifurcations are of one kind at one place of the parameters, or one and the same."""
    (a, mine), (b, its) = one, other
    if mine.kind != its.kind or (a.period == 0) != (b.period == 0):
        return False
    rows = [family.rows(bifurcation.point.u[None]) for family, bifurcation in (one, other)]
    values = [[*row.parameters[0], *([] if a.system.section else row.frequency_hz)] for row in rows]
    here, there = np.array(values)
    return bool((np.abs(here - there) <= SAME_PLACE * np.maximum(np.abs(here), a.scales[0])).all())


def _distance(points: np.ndarray, family: Family, one: Bifurcation) -> float:
    """Return the scaled distance of the nearest of some states from an orbit's section point."""
    away = scaled_distance(points, family.state(one.point.u), family.system)
    return float(np.nanmin(away, initial=np.inf))


def _image(family: Family, one: Bifurcation, mirror: Mirror) -> np.ndarray:
    """Return the section points (period, state) of an orbit's mirror image, or the image of an equilibrium."""
    signs, rows, system, period = np.array(mirror.signs), family.rows(one.point.u[None]), family.system, family.period
    state = family.state(one.point.u)
    if not period:
        return np.asarray(signs * state[None])
    if system.section is not None:
        # the image may lie on another side of the section: its points are where it crosses next
        returns = run_branches(
            rows.parameters[:, None],
            rows.frequency_hz[:, None],
            signs * state[None],
            n_transient=0,
            n_keep=period + 1,
            **limits_at(BRANCH_RTOL),
            system=system,
        )
        return np.asarray(returns.section[0, 0])
    if not mirror.half_period:
        return np.asarray(signs * np.concatenate([state[None], one.point.value.images[: period - 1]]))
    seconds = 1.0 / rows.frequency_hz[0]
    later = sample(
        system,
        rows.parameters,
        rows.states,
        [(np.arange(period) + 0.5) * seconds],
        drives=[Drive(np.full(period, seconds))],
        limits_first_step=False,
        **tolerances_at(BRANCH_RTOL),
    )
    return np.asarray(signs * later.states[0])
