"""Follow the second branch through each branch point, and list each branch point once.

At a pitchfork one branch passes straight through and the other turns back, so that its two arms lie on one side.
The point belongs to the first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.bifurcations import BRANCHING, FOLD, SAME_PLACE, Bifurcation, settle_sides
from pipeline.analysis.branches.following import Branch, crossing_half, joined
from pipeline.analysis.branches.known import gap, same_others
from pipeline.analysis.branches.lockstep import run_together

FOLLOWING = "following branches"
"""First words of the work's name in progress reports."""

BESIDE = 3
"""Points of a branch away from a bifurcation at which it is seen on which side of it the branch lies."""


def cross(
    points: Sequence[tuple[Branch, Bifurcation]],
    branches: list[Branch],
    interval: tuple[float, float],
    settings: Settings,
) -> None:
    """Follow the second branch through each branch point in both directions, and append it to `branches`."""
    for parent, one in points:
        known = _crossing(parent, one, branches)
        if known is not None:
            branch, other = known
            one.child, other.child = branch, parent
            continue
        halves = run_together(
            [
                crossing_half(parent.family, one, _direction(parent, one), way, *interval, settings)
                for way in (-1.0, 1.0)
            ],
            FOLLOWING,
        )
        child = joined(parent.family, *halves)
        if len(child.points) > 2:
            child.origin, one.child = one, child
            branches.append(child)


def _direction(branch: Branch, at: Bifurcation) -> np.ndarray:
    """Return the direction of a branch at a bifurcation: the difference of the points after and before it."""
    u = np.array([p.u for p in branch.points])
    i = int(np.argmin(np.linalg.norm(u - at.point.u, axis=1)))
    return np.asarray(u[min(i + 1, len(u) - 1)] - u[max(i - 1, 0)])


def _crossing(parent: Branch, one: Bifurcation, branches: Sequence[Branch]) -> tuple[Branch, Bifurcation] | None:
    """Find a branch on which the same branch point was located as well, and the point there."""
    for branch in branches:
        if branch.family.period != parent.family.period or not same_others(branch.family, parent.family):
            continue
        for other in branch.bifurcations:
            away = gap(branch.family, one.point.u, other.point), abs(one.point.u[-1] - other.point.u[-1])
            if other is not one and other.kind == BRANCHING and max(away) < SAME_PLACE:
                return branch, other
    return None


def settle_crossings(branches: Sequence[Branch]) -> None:
    """Leave each branch point on one of its two branches: at a pitchfork on the one that passes straight through.

    The branch that turns there tells the criticality: its arms lie on one side.
    """
    for branch in branches:
        for one in [one for one in branch.bifurcations if one.kind == BRANCHING]:
            if one.child is None or not any(one is own for own in branch.bifurcations):
                continue
            twin = _crossing(branch, one, [one.child])
            if twin is not None:
                kept, dropped = (twin[1], one) if _side(branch, one) else (one, twin[1])
                other = branch if dropped is one else one.child
                side = _side(other, dropped)
                _drop(dropped, other)
                kept.child, other.origin = other, other.origin or kept
            elif _side(branch, one) and not _side(one.child, one):
                kept, side = one, _side(branch, one)
                _move(one, branch)
            else:
                kept, side = one, _side(one.child, one)
            if side:
                kept.criticality = _criticality(kept, side)


def _side(branch: Branch, at: Bifurcation) -> int:
    """Return on which side of a bifurcation in the parameter a branch lies that turns there: 1 above, -1 below; 0 if it
    passes through.
    """
    after = _place(branch, at)
    before, beyond = (
        branch.points[max(after - BESIDE + 1, 0)],
        branch.points[min(after + BESIDE, len(branch.points) - 1)],
    )
    sides = np.sign([p.u[-1] - at.point.u[-1] for p in (before, beyond)])
    return int(sides[0]) if sides[0] == sides[1] else 0


def _place(branch: Branch, at: Bifurcation) -> int:
    """Return the index of a branch's point after which a bifurcation lies; the point itself if the branch has it."""
    if any(at is own for own in branch.bifurcations):
        return at.after
    return next((i for i, p in enumerate(branch.points) if p.u is at.point.u), 0)


def _move(one: Bifurcation, turning: Branch) -> None:
    """Make a branch point, located where a branch turns, one of the branch that passes straight through."""
    straight: Branch = one.child
    _drop(one, turning)
    place = _place(straight, one)
    del straight.points[place]
    for own in straight.bifurcations:
        own.after -= own.after >= place
    one.after, one.child = place - 1, turning
    straight.bifurcations = sorted([*straight.bifurcations, one], key=lambda own: own.after)
    straight.origin, turning.origin = None, turning.origin or one
    settle_sides(straight.points, straight.bifurcations)


def _drop(one: Bifurcation, branch: Branch) -> None:
    """Drop a branch point that belongs to another branch, and the fold where a branch turns there."""
    branch.bifurcations = [
        own
        for own in branch.bifurcations
        if own is not one and (own.kind != FOLD or np.abs(own.point.u - one.point.u).max() >= SAME_PLACE)
    ]
    settle_sides(branch.points, branch.bifurcations)


def _criticality(at: Bifurcation, side: int) -> str:
    """Decide whether a pitchfork is sub- or supercritical, from the side on which the branch that turns there lies."""
    if at.n_unstable_before == at.n_unstable_after:
        return ""
    worse = 1 if (at.n_unstable_after > at.n_unstable_before) == at.rises_before else -1
    return "supercritical" if side == worse else "subcritical"
