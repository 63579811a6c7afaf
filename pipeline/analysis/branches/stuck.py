"""Say what was met where a branch is stuck: whether the period grows without bound, and which saddles are near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magpend_core.orbits import scaled_distance
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.following import Branch, Limit, problem_of
from pipeline.analysis.branches.limits import (
    grows_without_bound,
    has_cycles,
    last_orbit,
    limit_of,
    saddles_near,
    towards,
)
from pipeline.analysis.branches.lockstep import run_together


def stuck_ends(branches: Sequence[Branch]) -> list[str]:
    """Return a text line for each end of a branch that is stuck, with what was met there."""
    lines = []
    for i, branch in enumerate(branches):
        for which in (0, 1):
            if branch.ends[which] == "stuck":
                points = towards(branch, which)
                name, value = branch.family.free[0], branch.family.values(points[-1].u)[0]
                lines.append(f"branch {i} at {name} {value:.7g}: {'; '.join(_met(branch, points))}")
    return lines


def _met(branch: Branch, points: Sequence[Point]) -> list[str]:
    """Describe the end of a branch whose last points are given, from within the branch to the end."""
    met = [_why(branch, points[-1])]
    if not has_cycles(branch):
        return met
    grows = grows_without_bound(np.array([p.u for p in points]), np.array([p.value.seconds for p in points]))
    if grows:
        last = ", ".join(f"{p.value.seconds:.4g}" for p in points[-4:])
        met.append(f"the period grows faster and faster: {last} s, as if without bound")
    saddles = _saddles(branch, points[-1])
    met += [text for text, _ in saddles]
    if grows and not saddles:
        met.append("no saddle found near the last orbit")
    if grows and saddles:
        kind = "homoclinic" if len(saddles) == 1 else "heteroclinic"
        focus = " of a saddle focus (Shilnikov)" if any(is_focus for _, is_focus in saddles) else ""
        met.append(f"this suggests a {kind} bifurcation{focus}")
    if grows and not isinstance(why := limit_of(branch, points), Limit):
        met.append(f"not decided: {why}")
    return met


def _why(branch: Branch, end: Point) -> str:
    settings = Settings()
    guess = end.u + settings.shortest_step * end.tangent
    (found,) = run_together([correct(problem_of(branch.family), guess, end.tangent, settings)])
    if found is None:
        return f"Newton's method found no next orbit, even after a step of {settings.shortest_step:g}"
    return (
        f"the branch turns, or its multipliers change, too fast for steps of {settings.shortest_step:g}, the shortest"
    )


def _saddles(branch: Branch, end: Point) -> list[tuple[str, bool]]:
    """Return a text on each saddle near the last orbit of a branch of a flow, and whether it is a saddle focus."""
    system, states = branch.family.system, last_orbit(branch.family, end)
    texts = []
    for place, values in zip(*saddles_near(branch.family, end, states), strict=True):
        size = float((np.ptp(states, axis=0) / np.asarray(system.scales)).max())
        away = float(scaled_distance(states, place, system).min()) / size
        leading = [min((v for v in values if v.real * sign > 0.0), key=lambda v: abs(v.real)) for sign in (1.0, -1.0)]
        is_focus = any(abs(v.imag) > 0.0 for v in leading)
        where = ", ".join(f"{name} {x + 0.0:.6g}" for name, x in zip(system.state_names, place.round(12), strict=True))
        own = ", ".join(f"{v.real:.5g}{v.imag:+.5g}i" if v.imag else f"{v.real:.5g}" for v in values)
        what = "saddle focus" if is_focus else "saddle"
        texts.append(
            (f"a {what} at {where} with eigenvalues {own} [1/s], {away:.2g} of the orbit's size from it", is_focus)
        )
    return texts
