"""Name the ends of branches of limit cycles whose period grows without bound, and fit the law of the period; say what
was met at ends that are stuck.

A cycle whose period grows without bound comes to rest at an equilibrium. With d the distance of the parameter from its
limit (Kuznetsov 2004, sections 6.2 and 7.1):

``homoclinic``: the equilibrium is a saddle. The period is a - ln(d)/rate, where the rate is the smaller one of the
saddle's leading eigenvalues, without signs: the unstable one if the saddle quantity, their sum, is negative. Then
stable cycles end there. If the sum is positive, the cycles are unstable.

``snic``: a saddle node on an invariant circle. The period is a + pi/sqrt(a2 b d), where x' = a2 d + b x**2 is the
normal form of the fold of the equilibria. If several saddle nodes lie on the circle, as they do by symmetry, the period
is a plus the sum of their terms.

The law's slope is fitted to the last points, and computed from the equilibrium. An end is named if both agree.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from magpend_core.equilibria import find_equilibria
from magpend_core.orbits import scaled_distance, wrap_angles
from magpend_core.pointwise import jacobian_at, rates_at
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.bifurcations import Bifurcation
from pipeline.analysis.branches.following import (
    Branch,
    Limit,
    grows_without_bound,
    leading_of,
    leads_nowhere,
    opposite,
    problem_of,
)
from pipeline.analysis.branches.lockstep import run_together
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.resting import RestSettings, last_orbit, saddles_near, size_of, slow_places
from pipeline.layout.own_words import place_in_words
from pipeline.products.reporting import track
from pipeline.specification.tables import FREQUENCY


@dataclass(frozen=True)
class LimitSettings(RestSettings):
    """Numbers of the search for the equilibrium at the end of a branch, and of the fit of the law of its period."""

    # largest distance between the values of two folds of equilibria that happen at once, in units of the interval
    same_fold: float = 1e-9
    agrees: float = 0.05  # largest relative difference between the fitted and the computed slope of the period's law
    # largest deviation of a period from its law, in units of the range of the fitted periods; more confirms laws nearer
    # to the end of a branch, also false ones
    fits: float = 0.003
    # natural logarithms of the ranges of distances that are fitted, each with the least number of points. The first
    # gives the numbers; the change from one to the other is part of their errors.
    windows: tuple[tuple[float, int], ...] = ((3.0, 8), (4.5, 12))
    least_range: float = 2.5  # least natural logarithm of the first range of distances, if it is to confirm a law


CRAWLED = (
    "the last steps led nowhere: Newton's method finds the next orbit very near alone, as at a touch or near a canard"
)

TOO_FAR = "the last points are too few, or too far from a limit, to confirm a law of the period"


def towards(branch: Branch, end: int) -> list[Point]:
    """Return the points of a branch in the order that leads to its first (0) or last (1) end."""
    return list(branch.points) if end else [opposite(p) for p in reversed(branch.points)]


def settle_limits(branches: Sequence[Branch]) -> None:
    """Name the ends of branches, stuck or with too many points, at which the period grows without bound by a law."""
    for branch in track(branches, "naming ends of branches"):
        for end in (0, 1):
            if branch.ends[end] in ("stuck", "max_points") and has_cycles(branch):
                found = limit_of(branch, towards(branch, end))
                if isinstance(found, Limit):
                    one, other = found, branch.limits[1 - end]
                    branch.limits = (other, one) if end else (one, other)
                    branch.ends = (branch.ends[0], one.kind) if end else (one.kind, branch.ends[1])


def has_cycles(branch: Branch) -> bool:
    """Return whether the orbits of a branch are limit cycles of a flow."""
    return bool(branch.family.period) and branch.family.system.section is not None


def limit_of(branch: Branch, points: Sequence[Point], settings: LimitSettings = LimitSettings()) -> Limit | str:
    """Find the equilibrium at which the cycles of a branch come to rest, and fit the law of their period.

    `points` are in order to the end. Returns the reason if neither law is confirmed.
    """
    family = branch.family
    if len(points) < settings.windows[-1][1]:
        return TOO_FAR
    states = last_orbit(family, points[-1], settings)
    places, eigenvalues = saddles_near(family, points[-1], states, settings)
    reason = "no equilibrium found at which the orbit comes to rest"
    if len(places) == 1:
        found = _homoclinic(family, points, places[0], eigenvalues[0], settings)
        if isinstance(found, Limit):
            return found
        reason = found
    elif len(places) > 1:
        reason = f"{len(places)} saddles are near"
    fold = _snic(family, points, states, settings)
    return fold if fold is not None and (isinstance(fold, Limit) or not len(places)) else reason


# ---- the laws ----------------------------------------------------------------------------------

Law = Callable[[np.ndarray], np.ndarray]
"""Terms of a law of the period: the term whose coefficient is the slope, and others, from distances d > 0."""


def logarithm(d: np.ndarray) -> np.ndarray:
    """Return the terms of the law at a homoclinic orbit."""
    return np.stack([-np.log(d), np.ones_like(d)])


def root(d: np.ndarray) -> np.ndarray:
    """Return the terms of the law at a saddle node on a circle, with the next order of 1/sqrt(d)."""
    return np.stack([1.0 / np.sqrt(d), np.ones_like(d), np.sqrt(d)])


def fit_law(
    law: Law,
    values: np.ndarray,
    seconds: np.ndarray,
    floors: Sequence[float],
    settings: LimitSettings = LimitSettings(),
) -> tuple[float, float, float, float, float] | None:
    """Fit a law of the period to the last points of a branch.

    Parameters
    ----------
    law
        Terms of the law.
    values
        Parameter values, in order to the end, shape (point,).
    seconds
        Periods, shape (point,) [s].
    floors
        Least periods of the points that are fitted, one for each of `settings.windows` [s].
    settings
        Numbers to choose.

    Returns
    -------
    tuple or None
        The limit of the parameter, its error, the slope, its error, and the largest deviation in units of the range of
        the periods; None if there are too few points, or their distances from the limit range over less than
        `settings.least_range`.
    """
    way = np.sign(values[-1] - values[-2])
    turns = np.flatnonzero(np.diff(values) * way <= 0.0)
    first = int(turns[-1]) + 1 if len(turns) else 0
    if len(values) - first < settings.windows[-1][1]:
        return None
    fits, further = [], np.nan
    for floor, (_, least) in zip(floors, settings.windows, strict=True):
        chosen = seconds >= floor
        chosen[-least:] = True
        chosen[:first] = False
        away = np.abs(values - values[-1])[chosen]
        fits.append(_fit(law, away, seconds[chosen]))
        if len(fits) == 1:  # with the next order, of eigenvalues that vary with the parameter
            further = _fit(lambda d: np.vstack([law(d), d * np.log(d)]), away, seconds[chosen])[0]
        if np.log1p(away.max() / fits[0][0]) < settings.least_range:
            return None
    (gap, gap_error, slope, slope_error, rest), (other_gap, _, other_slope, _, _) = fits
    error = float(np.linalg.norm([gap_error, gap - other_gap, gap - further]))
    return float(values[-1] + way * gap), error, slope, float(np.hypot(slope_error, slope - other_slope)), rest


def _fit(law: Law, away: np.ndarray, seconds: np.ndarray) -> tuple[float, float, float, float, float]:
    """Fit a law to the distances from the last point. Return the last point's distance from the limit, its error, the
    slope, its error, and the largest relative deviation.
    """

    def started(log_gap: float) -> np.ndarray:
        return np.append(log_gap, np.linalg.lstsq(law(away + np.exp(log_gap)).T, seconds, rcond=None)[0])

    def rest(x: np.ndarray) -> np.ndarray:
        return np.asarray(x[1:] @ law(away + np.exp(x[0])) - seconds)

    low, high = np.log(away[-2]) - 8.0, np.log(away.max()) + 4.0
    best = min(map(started, np.linspace(low, high, 60)[1:-1]), key=lambda x: float(np.abs(rest(x)).max()))
    free = np.full(len(best) - 1, np.inf)
    bounds = (np.append(low, -free), np.append(high, free))
    found = least_squares(rest, best, bounds=bounds, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    variance = np.linalg.pinv(found.jac.T @ found.jac) * float(found.fun @ found.fun) / (len(away) - len(best))
    errors, gap = np.sqrt(np.diag(variance)), float(np.exp(found.x[0]))
    deviation = float(np.abs(found.fun).max() / np.ptp(seconds))
    return gap, gap * float(errors[0]), float(found.x[1]), float(errors[1]), deviation


def _laid(branch_points: Sequence[Point], family: Family) -> tuple[np.ndarray, np.ndarray]:
    values = np.array([family.values(p.u)[0] for p in branch_points])
    return values, np.array([p.value.seconds for p in branch_points])


def _packed(family: Family, value: float) -> np.ndarray:
    """Return the packed parameters at a value of the free one."""
    unknowns = family.unknowns(np.zeros(family.system.n_states), [value])
    return np.asarray(family.rows(unknowns[None]).parameters[0])


def _homoclinic(
    family: Family, points: Sequence[Point], saddle: np.ndarray, eigenvalues: np.ndarray, settings: LimitSettings
) -> Limit | str:
    """Fit the law of the period near a saddle, given at the last point; return the reason if it fails."""
    values, seconds = _laid(points, family)
    rate = min(abs(v.real) for v in leading_of(eigenvalues))
    fitted = fit_law(
        logarithm, values, seconds, [seconds[-1] - reach / rate for reach, _ in settings.windows], settings
    )
    if fitted is None:
        return TOO_FAR
    value, error, slope, slope_error, rest = fitted
    at = find_equilibria(family.system, saddle[None], _packed(family, value))
    own = at.eigenvalues[0]
    if not (at.converged[0] and own.real.min() < 0.0 < own.real.max()):
        return "the saddle does not go on to the end that the law of the period gives"
    slowest = min(leading_of(own), key=lambda v: abs(v.real))
    if slowest.imag:
        return "the period oscillates about its law near a saddle focus whose leading eigenvalues are complex"
    limit = Limit("homoclinic", value, error, at.states, own, slope, slope_error, 1.0 / abs(slowest.real))
    return limit if (why := _contradiction(limit, rest, settings)) == "" else why


def _contradiction(limit: Limit, rest: float, settings: LimitSettings) -> str:
    """Return why a fitted law is not confirmed by the computed slope; an empty text if it is."""
    law = "-ln|p - p_h|" if limit.kind == "homoclinic" else "1/sqrt|p - p_h|"
    if rest > settings.fits:
        return f"the period does not follow {law}: it deviates by {rest:.1%} of its range"
    if not abs(limit.slope / limit.expected - 1.0) <= settings.agrees:
        return f"the period's slope over {law} is {limit.slope:.4g}; from the equilibrium follows {limit.expected:.4g}"
    return ""


def _snic(family: Family, points: Sequence[Point], states: np.ndarray, settings: LimitSettings) -> Limit | str | None:
    """Fit the law of the period near saddle nodes on a circle. Return the reason if it fails, None without a fold."""
    values, seconds = _laid(points, family)
    folds = _folds(family, values[-1], states, settings)
    if not folds:
        return None
    state, value, error, _ = folds[0]
    expected = sum(slope for *_, slope in folds)
    fitted = fit_law(
        root, values, seconds, [seconds[-1] * np.exp(-0.5 * reach) for reach, _ in settings.windows], settings
    )
    if fitted is None:
        return TOO_FAR
    by_law, law_error, slope, slope_error, rest = fitted
    eigenvalues = np.linalg.eigvals(jacobian_at(family.system, state[None], _packed(family, value))[0])
    eigenvalues = eigenvalues[np.lexsort((eigenvalues.imag, -eigenvalues.real))]
    places = wrap_angles(np.array([place for place, *_ in folds]), family.system)
    limit = Limit("snic", value, error, places, eigenvalues, slope, slope_error, expected)
    if why := _contradiction(limit, rest, settings):
        return why
    if abs(by_law - value) > max(3.0 * law_error, settings.agrees * abs(values[-1] - value)):
        return f"the law of the period ends at {by_law:.7g}, and the fold of the equilibria is at {value:.7g}"
    return limit


Fold = tuple[np.ndarray, float, float, float]
"""State of a fold of equilibria, its parameter value, the error of this value (the last step), and the slope of the
period over 1/sqrt(d) [s times the root of the parameter's unit], pi over the root of the normal form's coefficients."""


def _folds(family: Family, value: float, states: np.ndarray, settings: LimitSettings) -> list[Fold]:
    """Find the folds of equilibria on an orbit, given at a parameter value: that at its slowest place, and those at
    other slow places that happen at the same value.
    """
    if not len(states):
        return []
    system, size, folds = family.system, size_of(family, states), list[Fold]()
    for place in slow_places(family, _packed(family, value), states, settings):
        with np.errstate(all="ignore"):
            found = _fold(family, value, states[place])
        is_near = found is not None and scaled_distance(states, found[0], system).min() <= settings.near * size
        if found is None or not is_near:
            if not folds:
                return []
            continue
        is_known = any(scaled_distance(found[0], own, system) < settings.near * size for own, *_ in folds)
        if not folds or (not is_known and abs(found[1] - folds[0][1]) <= settings.same_fold * family.scales[0]):
            folds.append(found)
    return folds


def _fold(family: Family, value: float, state: np.ndarray) -> Fold | None:
    """Find the fold of equilibria near a state by Newton's method; None without a fold."""
    system, n = family.system, family.system.n_states
    scales, unit = np.asarray(system.scales), family.scales[0]

    def rates(z: np.ndarray) -> np.ndarray:
        return np.asarray(rates_at(system, z[None, :n] * scales, _packed(family, z[-1] * unit))[0] / scales)

    def jacobian(z: np.ndarray) -> np.ndarray:
        return family.scaled(jacobian_at(system, z[None, :n] * scales, _packed(family, z[-1] * unit))[0])

    def equations(z: np.ndarray) -> np.ndarray:
        return np.concatenate([rates(z), jacobian(z) @ z[n : 2 * n], [start @ z[n : 2 * n] - 1.0]])

    slowest = state / scales
    start = np.linalg.svd(jacobian(np.append(slowest, value / unit)))[2][-1]
    z, steps = np.concatenate([slowest, start, [value / unit]]), 1e-6 * np.eye(2 * n + 1)
    for _ in range(20):
        slopes = np.array([equations(z + h) - equations(z - h) for h in steps]).T / 2e-6
        if not np.isfinite(slopes).all() or np.linalg.cond(slopes) > 1e12:
            return None
        step = np.linalg.solve(slopes, -equations(z))
        z = z + step * min(1.0, 0.5 / np.abs(step).max(initial=1e-300))
        if np.abs(step).max() < 1e-10:
            break
    else:
        return None
    left, _, right = np.linalg.svd(jacobian(z))
    w, v = left[:, -1] / (left[:, -1] @ right[-1]), right[-1]
    along, by = np.zeros((2, 2 * n + 1))
    along[:n], by[-1] = 1e-4 * v, 1e-6
    curvature = w @ (jacobian(z + along) - jacobian(z - along)) @ v / 4e-4
    drift = w @ (rates(z + by) - rates(z - by)) / (2e-6 * unit)
    product = abs(float(curvature * drift))
    expected = np.pi / np.sqrt(product) if product > 0.0 else np.inf
    return z[:n] * scales, float(z[-1] * unit), max(abs(float(step[-1])), 1e-14) * unit, float(expected)


# ---- ends within the interval ------------------------------------------------------------------


def cut_ends(branches: Sequence[Branch], word: str = FREQUENCY, settings: LimitSettings = LimitSettings()) -> list[str]:
    """Return text lines on the ends at which a branch was cut off: one that is stuck, with what was met there, one with
    too many points, and those at the bounds of the parameter, together; and on doubled branches that are stuck where
    they begin. The rate has the specification's `word`.
    """
    lines, beyond = [], dict[str, list[int]]()
    for i, branch in enumerate(branches):
        for which in (0, 1):
            points, why = towards(branch, which), branch.ends[which]
            at = place_in_words(branch.family.free[0], word, branch.family.values(points[-1].u)[0])
            if why == "stuck":
                lines.append(f"branch {i} at {at}: {'; '.join(_met(branch, points, settings))}")
            elif why == "max_points":
                lines.append(f"branch {i} at {at}: {len(points)} points, no more are followed; see the rest by --start")
            elif why == "bound":
                beyond.setdefault(at, []).append(i)
        lines += [_begun(i, one, word, settings) for one in branch.bifurcations if one.stuck and not one.child]
    return [*lines, *(f"{_numbered(ones)} beyond {at}, a bound of the interval" for at, ones in beyond.items())]


def _begun(i: int, one: Bifurcation, word: str, settings: LimitSettings) -> str:
    """Describe the doubled branch at a period doubling of branch `i` that is stuck where it begins."""
    branch: Branch = one.stuck
    points = towards(branch, 1)
    at = place_in_words(branch.family.free[0], word, branch.family.values(points[0].u)[0])
    met = "; ".join(_met(branch, points, settings))
    return (
        f"the branch of period {branch.family.period} that leaves branch {i} at {at}, after {len(points)} points: {met}"
    )


def _numbered(branches: Sequence[int]) -> str:
    """Name branches by their numbers, with how often each occurs."""
    counts = Counter(branches)
    told = [f"{i}{f' ({n} times)' if n > 1 else ''}" for i, n in counts.items()]
    return f"branch{'es' if len(counts) > 1 else ''} {', '.join(told)}"


def _met(branch: Branch, points: Sequence[Point], settings: LimitSettings) -> list[str]:
    """Describe the end of a branch whose last points are given, from within the branch to the end."""
    met = [CRAWLED if leads_nowhere(branch.family, list(points)) else _why(branch, points[-1])]
    if not has_cycles(branch):
        return met
    grows = grows_without_bound(np.array([p.u for p in points]), np.array([p.value.seconds for p in points]))
    if grows:
        last = ", ".join(f"{p.value.seconds:.4g}" for p in points[-4:])
        met.append(f"the period grows faster and faster: {last} s, as if without bound")
    saddles = _saddles(branch, points[-1], settings)
    met += [text for text, _ in saddles]
    if grows and not saddles:
        met.append("no saddle found near the last orbit")
    if grows and saddles:
        kind = "homoclinic" if len(saddles) == 1 else "heteroclinic"
        focus = " of a saddle focus (Shilnikov)" if any(is_focus for _, is_focus in saddles) else ""
        met.append(f"this suggests a {kind} bifurcation{focus}")
    if grows and not isinstance(why := limit_of(branch, points, settings), Limit):
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


def _saddles(branch: Branch, end: Point, settings: LimitSettings) -> list[tuple[str, bool]]:
    """Return a text on each saddle near the last orbit of a branch of a flow, and whether it is a saddle focus."""
    system, states = branch.family.system, last_orbit(branch.family, end, settings)
    texts = []
    for place, values in zip(*saddles_near(branch.family, end, states, settings), strict=True):
        away = float(scaled_distance(states, place, system).min()) / size_of(branch.family, states)
        is_focus = any(abs(v.imag) > 0.0 for v in leading_of(values))
        where = ", ".join(f"{name} {x + 0.0:.6g}" for name, x in zip(system.state_names, place.round(12), strict=True))
        own = ", ".join(f"{v.real:.5g}{v.imag:+.5g}i" if v.imag else f"{v.real:.5g}" for v in values)
        what = "saddle focus" if is_focus else "saddle"
        texts.append(
            (f"a {what} at {where} with eigenvalues {own} [1/s], {away:.2g} of the orbit's size from it", is_focus)
        )
    return texts
