"""Decide whether the branch of an orbit ends where the orbit begins to touch a surface of impacts or switches.

The map of the section has no derivative where an orbit touches such a surface without crossing it, so that Newton's
method stops there and the branch is stuck. Up to it the orbit and the height of its peak below the surface are smooth
in the parameter (di Bernardo et al., Piecewise-smooth Dynamical Systems, 2008, chapter 6). So the value at which the
peak reaches the surface follows from the last orbits of the branch.

An orbit that sticks to the surface of a switch may end at the same place, seen from the other side (grazing-sliding,
ibid., chapter 8): its stay shrinks to a touch. It shortens as the root of the distance, so that the parameter is a
smooth function of the length of the stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magpend_core.pointwise import surfaces_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.known import at_value
from pipeline.analysis.branches.lockstep import run_together
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.events.kinds import GRAZING, SLIDING
from pipeline.analysis.events.lines import LOCATED, Line
from pipeline.analysis.events.scene import Event, Scene
from pipeline.results.tolerances import BRANCH_RTOL

ON_SURFACE = 1e-9
"""Values of the surface's function, in units of its range, that are 0 at neighbouring instants: sliding, or at rest."""


def name_touch(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of an orbit that begins to touch a surface of impacts or switches, at the end of its branch."""
    fate = one.fate
    line = next((line for line in scene.lines if line.branch == fate.branch), None)
    if line is None or fate.node not in (0, len(line.value) - 1):
        return one
    found = grazing_of(line, fate.node, scene.family(one.place, line.period))
    if found is None:
        return one
    what, value, error, why = found
    fate = replace(fate, value=value, why=f"{fate.why}; {why}")
    return replace(one, fate=fate, what=what, error=max(error, LOCATED * scene.scale))


def grazing_of(line: Line, node: int, family: Family, n_samples: int = 4000) -> tuple[str, float, float, str] | None:
    """Return the name of the touch at which an orbit ends, its value, error and evidence; None if there is no touch.

    Parameters
    ----------
    line, node
        Branch of the orbit, and its end.
    family
        Family of the orbits of the branch.
    n_samples
        Instants of an orbit between which its peaks are interpolated.
    """
    n_nodes = 30  # last points of the branch that are looked at
    # distance of the touch from the last orbit, and largest error, in units of the interval of the parameter
    largest = 1e-4
    system = family.system
    if not system.n_switches + system.n_impacts or not line.period:
        return None
    nodes = range(node, max(node - n_nodes, -1), -1) if node else range(min(n_nodes, len(line.value)))
    guesses = [family.unknowns(line.points[i][0], [line.value[i]]) for i in nodes if line.bifurcation[i] < 0]
    points = [p for p in run_together([at_value(family, guess) for guess in guesses]) if p is not None]
    values = np.array([family.values(point.u)[0] for point in points])
    orbits = [_heights(family, point, np.linspace(0.0, point.value.seconds, n_samples)) for point in points]
    peaks = [_peaks(h, rate, p.value.seconds / (n_samples - 1)) for (h, rate), p in zip(orbits, points, strict=True)]
    stays = [_stays(family, point, h) for (h, _), point in zip(orbits, points, strict=True)]
    for name, measured in ((GRAZING, peaks), (SLIDING, stays)):
        for of in range(len(measured[0]) if measured else 0):
            touch = _touch(values, [one[of] for one in measured])
            if touch is not None and max(abs(touch[0] - values[0]), touch[1]) <= largest * family.scales[0]:
                return name, touch[0], touch[1], _evidence(name, of, touch[2], system.n_switches)
    return None


def _evidence(name: str, of: int, heights: Sequence[float], n_switches: int) -> str:
    """Say how near peaks come to a surface, or how short the stays on it are."""
    surface = of // 2 if name == GRAZING else of
    is_switch = surface < n_switches
    what = f"{'switch' if is_switch else 'impact'} {surface + 1 - (0 if is_switch else n_switches)}"
    listed = ", ".join(f"{-height:.1e}" for height in heights)
    if name == GRAZING:
        return f"a peak of the orbit comes as near to the surface of {what} as {listed}"
    return f"the orbit sticks to the surface of {what} for {listed} of its period"


def _touch(values: np.ndarray, peaks: Sequence[float]) -> tuple[float, float, list[float]] | None:
    """Extrapolate a branch to the value at which the peak of its orbits is 0, given in order from the end inwards.

    Peaks are shares of the range of the surface's function. Return the value, its error, and the peaks used.
    """
    apart, most = 2.0, 4  # least ratio of the heights of the orbits that are used, and the most orbits
    near = 0.02  # largest height of the last peak below the surface, in units of that function's range on the orbit
    chosen: list[int] = []
    for i, peak in enumerate(peaks):
        if not peak < 0.0:  # no peak on this side
            break
        if not chosen or peak < apart * peaks[chosen[-1]]:
            chosen.append(i)
    chosen = chosen[:most]
    if len(chosen) < 3 or peaks[chosen[0]] < -near:
        return None
    x, y = values[chosen], np.array(peaks)[chosen]
    if not (np.diff(x) > 0.0).all() and not (np.diff(x) < 0.0).all():
        return None
    whole, less = _at_zero(y, x), _at_zero(y[:-1], x[:-1])
    return whole, abs(whole - less), y.tolist()


def _at_zero(y: np.ndarray, x: np.ndarray) -> float:
    """Return the polynomial x(y) at y = 0 (Neville's method)."""
    table = list(x)
    for width in range(1, len(x)):
        table = [(y[i + width] * table[i] - y[i] * table[i + 1]) / (y[i + width] - y[i]) for i in range(len(table) - 1)]
    return float(table[0])


def _heights(family: Family, point: Point, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the functions of all surfaces and their rates at some instants of an orbit, shape (n, surface)."""
    system, rows, seconds = family.system, family.rows(point.u[None]), point.value.seconds
    frequency, packed = float(rows.frequency_hz[0]), rows.parameters
    is_flow = system.section is not None
    drive = Drive(np.array([seconds]) if is_flow else np.full(family.period, 1.0 / frequency))
    orbit = sample(system, packed, rows.states, [times], drives=[drive], **tolerances_at(BRANCH_RTOL))
    return surfaces_at(system, np.mod(times, 1.0 / frequency), orbit.states[0], packed[0], frequency)


def _peaks(values: np.ndarray, rates: np.ndarray, step: float) -> list[float]:
    """Return the highest smooth peak of an orbit below each surface, and above it with the sign changed, as shares of
    the range of the surface's function; NaN if there is none.
    """
    found: list[float] = []
    for h, rate in zip(values.T, rates.T, strict=True):
        extent = max(float(np.ptp(h)), 1e-300)
        found += [_peak(sign * h, sign * rate, step) / extent for sign in (1.0, -1.0)]
    return found


def _stays(family: Family, point: Point, values: np.ndarray) -> list[float]:
    """Return minus the share of its period for which an orbit sticks to the surface of each switch.

    NaN if it does not stick, more than once, at its ends, or if it comes in across the surface.
    """
    # largest value of the function one stay before an orbit comes to stick, in units of its range and of the square of
    # the stay's share of the period: beyond it the orbit comes in across the surface, and not along it
    tangent = 100.0
    times = np.linspace(0.0, point.value.seconds, len(values))
    found = []
    for of, h in enumerate(values.T[: family.system.n_switches]):
        extent = max(float(np.ptp(h)), 1e-300)
        on = np.flatnonzero(np.abs(h) <= max(ON_SURFACE * extent, float(np.abs(h).min())))
        share = np.nan
        n = len(on)
        before = on[0] - n
        if before >= 0 and on[-1] < len(h) - 1 and abs(h[before]) <= tangent * extent * (n / len(h)) ** 2:
            near = np.linspace(times[on[0] - 1], times[on[-1] + 1], len(h))
            share = _stay(_heights(family, point, near)[0][:, of] / extent) * (near[-1] - near[0]) / times[-1]
        found.append(-share)
    return found


def _stay(h: np.ndarray) -> float:
    """Return the share of some instants for which a function is 0; NaN if that is not one stay between others.

    The function comes to 0 along a straight line, and leaves it along a parabola.
    """
    stuck = 1e-12  # value of a switch's function, in units of its range, up to which an orbit sticks
    on = np.flatnonzero(np.abs(h) <= stuck)
    if not len(on) or len(on) != on[-1] - on[0] + 1 or on[0] < 2 or on[-1] > len(h) - 3:
        return np.nan
    before, after = np.abs(h[on[0] - 2 : on[0]]), np.sqrt(np.abs(h[on[-1] + 1 : on[-1] + 3]))
    begin = on[0] - 1 + before[1] / (before[0] - before[1])
    end = on[-1] + 1 - after[0] / (after[1] - after[0])
    return float(end - begin) / (len(h) - 1)


def _peak(h: np.ndarray, rate: np.ndarray, step: float) -> float:
    """Return the highest maximum below 0 of a function at equal steps, without those at jumps of its rate.

    NaN if there is none, or if the function stays at 0 for a while.
    """
    # change of a rate between two instants, in units of those before and after, from which on it is a jump: an impact
    corner = 3.0
    on = np.abs(h) <= ON_SURFACE * np.ptp(h)
    if (on[:-2] & on[1:-1] & on[2:]).any():
        return np.nan
    jump = np.abs(np.diff(rate))
    usual = np.maximum(np.append(jump[1:], 0.0), np.append(0.0, jump[:-1]))
    at = np.flatnonzero((rate[:-1] > 0.0) & (rate[1:] <= 0.0) & (jump <= corner * usual))
    a, b, ra, rb = h[at], h[at + 1], step * rate[at], step * rate[at + 1]
    s = ra / (ra - rb)
    # the cubic through both values and rates
    tops = (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * ra + s**2 * (3 - 2 * s) * b - s**2 * (1 - s) * rb
    below = tops[tops < 0.0]
    return float(below.max()) if len(below) else np.nan
