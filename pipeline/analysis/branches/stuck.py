"""Say what was met where a branch is stuck: whether the period grows without bound, and which saddles are near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magpend_core.equilibria import find_equilibria
from magpend_core.orbits import crossed_state, scaled_distance
from magpend_core.pointwise import rates_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.following import Branch, opposite, problem_of
from pipeline.analysis.branches.lockstep import run_together
from pipeline.analysis.tolerances import BRANCH_RTOL

STEEPER = 6.0
"""Natural logarithm of the factor by which the period's slope along the branch rises, if the period grows."""

KEEPS_GROWING = 0.6
"""Least growth of the period over the second half of this rise, in units of that over the first half.

Towards a homoclinic orbit both are equal, since the period grows by the same time whenever the distance in the
parameter halves. Towards an end with a finite period, as at a square root, the second is many times less.
"""

NEAR = 0.05
"""Largest distance of a saddle that is near to an orbit, in units of the orbit's size."""

SAMPLES, GUESSES = 4000, 8
"""Points on an orbit, and most of its slow places from which equilibria are looked for."""


def stuck_ends(branches: Sequence[Branch]) -> list[str]:
    """Return a text line for each end of a branch that is stuck, with what was met there."""
    lines = []
    for i, branch in enumerate(branches):
        for which, points in ((0, [opposite(p) for p in reversed(branch.points)]), (1, branch.points)):
            if branch.ends[which] == "stuck":
                name, value = branch.family.free[0], branch.family.values(points[-1].u)[0]
                lines.append(f"branch {i} at {name} {value:.7g}: {'; '.join(_met(branch, points))}")
    return lines


def _met(branch: Branch, points: Sequence[Point]) -> list[str]:
    """Describe the end of a branch whose last points are given, from within the branch to the end."""
    met = [_why(branch, points[-1])]
    if not branch.family.period or crossed_state(branch.family.system) is None:
        return met
    seconds = np.array([p.value.seconds for p in points])
    grows = grows_without_bound(np.array([p.u for p in points]), seconds)
    if grows:
        last = ", ".join(f"{s:.4g}" for s in seconds[-4:])
        met.append(f"the period grows faster and faster: {last} s, as if without bound")
    saddles = _saddles(branch, points[-1])
    met += [text for text, _ in saddles]
    if grows and not saddles:
        met.append("no saddle found near the last orbit")
    if grows and saddles:
        kind = "homoclinic" if len(saddles) == 1 else "heteroclinic"
        focus = " of a saddle focus (Shilnikov)" if any(is_focus for _, is_focus in saddles) else ""
        met.append(f"this suggests a {kind} bifurcation{focus}")
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


def grows_without_bound(unknowns: np.ndarray, seconds: np.ndarray) -> bool:
    """Return whether the period grows towards the end of a branch as it does towards infinity.

    The slope of the period along the branch must rise towards the end, by the factor exp(`STEEPER`) at least, and
    the growth that this takes must not fade (`KEEPS_GROWING`).

    Parameters
    ----------
    unknowns
        Section points and parameter values, scaled, shape (point, unknown), in order to the end.
    seconds
        Period at the points, shape (point,) [s].
    """
    growth, middle = np.diff(seconds), 0.5 * (seconds[1:] + seconds[:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        steepness = np.log(growth / np.linalg.norm(np.diff(unknowns, axis=0), axis=1))
    rises = np.isfinite(steepness) & (growth > 0.0)
    rises[:-1] &= steepness[1:] > steepness[:-1]
    first = len(rises) - int(np.argmin(np.append(rises[::-1], False)))
    steepness, middle = steepness[first:], middle[first:]
    far = np.flatnonzero(steepness[-1:] - steepness >= STEEPER)
    if len(steepness) < 3 or not len(far):
        return False
    begin = min(int(far[-1]), len(steepness) - 3)
    ends = np.array([steepness[begin], 0.5 * (steepness[begin] + steepness[-1]), steepness[-1]])
    first_half, second_half = np.diff(np.interp(ends, steepness, middle))
    return bool(second_half >= KEEPS_GROWING * first_half)


def _saddles(branch: Branch, end: Point) -> list[tuple[str, bool]]:
    """Return a text on each saddle near the last orbit of a branch of a flow, and whether it is a saddle focus."""
    family = branch.family
    system, rows = family.system, family.rows(end.u[None])
    packed, seconds = rows.parameters[0], end.value.seconds
    times = np.linspace(0.0, seconds, SAMPLES)
    drive = Drive(np.array([seconds]))
    orbit = sample(system, packed[None], rows.states, [times], drives=[drive], rtol=BRANCH_RTOL, atol=BRANCH_RTOL)
    states = orbit.states[0][np.isfinite(orbit.states[0]).all(axis=1)]
    if not len(states):
        return []
    scales = np.asarray(system.scales)
    speed = np.linalg.norm(rates_at(system, states, packed) / scales, axis=1)
    slow = np.flatnonzero((speed <= np.roll(speed, 1)) & (speed <= np.roll(speed, -1)))
    slow = slow[np.argsort(speed[slow])][:GUESSES]
    found = find_equilibria(system, states[slow], packed)
    size = float((np.ptp(states, axis=0) / scales).max())
    names, texts, known = system.state_names, [], np.empty((0, system.n_states))
    for k in np.flatnonzero(found.converged):
        place, values = found.states[k], found.eigenvalues[k]
        away = float(scaled_distance(states, place, system).min()) / size
        is_known = bool((scaled_distance(known, place, system) < NEAR * size).any())
        if away > NEAR or is_known or not values.real.min() < 0.0 < values.real.max():
            continue
        known = np.vstack([known, place])
        leading = [min((v for v in values if v.real * sign > 0.0), key=lambda v: abs(v.real)) for sign in (1.0, -1.0)]
        is_focus = any(abs(v.imag) > 0.0 for v in leading)
        where = ", ".join(f"{name} {x + 0.0:.6g}" for name, x in zip(names, np.round(place, 12), strict=True))
        own = ", ".join(f"{v.real:.5g}{v.imag:+.5g}i" if v.imag else f"{v.real:.5g}" for v in values)
        what = "saddle focus" if is_focus else "saddle"
        texts.append(
            (f"a {what} at {where} with eigenvalues {own} [1/s], {away:.2g} of the orbit's size from it", is_focus)
        )
    return texts
