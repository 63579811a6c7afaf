"""Detect events, the zeros of functions along a trajectory, and let a step end at each.

These functions are templates for the engine, see `lanes`. An attempted step that ends beyond a zero is taken
back. The next attempt ends at the zero of the cubic through values and rates at both ends, and so on, until an
attempt ends beyond the zero by no more than the resolution. The resolution is `NARROW` times the first
attempt's length; it grows by `WIDEN` with each further attempt, so that there are at most about 25 attempts. An
attempt that ends before the zero is an ordinary step. So the state at an event is computed by a step of the
integrator, with its accuracy, and not interpolated.

An event function can pass zero twice within a step, so that it has the same sign at both ends. Where the rates
at the ends allow this, the next attempt ends at the minimum of the cubic. But a surface can move faster than
the states: a ball flies along a parabola, which a step of any length follows, above a table that shakes. So the
value in the middle of an attempt is compared with the cubic there. Where the difference is so large that two
zeros may be hidden, the attempt is repeated with half the step. The check misses two zeros only if the
excursion beyond zero is shorter than a step and does not include the step's middle. A section at a level of a state
needs no such check, since the states follow their cubics; one at a level of an expression has it. A step turns the
angle of a section by half a turn at most, whatever length the error control allows.

Each event function has a stored sign, its *side*: +1 or -1 as of the last step, reversed where a step ends
beyond zero. Right after an event the side, not the computed value (which is zero up to rounding), says where
the trajectory goes.

Reading order: `lanes.finish_step` calls `hides_events`, then `judge_events`. Most steps end there. If a zero is
possible, `settle_events` accepts the step or takes it back, and `aim` sets the length of the next attempt.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import (
    WIDTH,
    absolute,
    any_nonzero,
    copysign,
    load,
    load_rows,
    maximum,
    minimum,
    multiply_add,
    sqrt,
    store,
    store_rows,
    where_less,
)
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI, cos, sincos

NARROW = 2e-15
"""Resolution of an event's instant, in units of the attempt that first passed it."""

WIDEN = 4.0
"""Growth of the resolution with each attempt: rounding can hide a zero at which the rate is small."""

ROOT_STEPS = 4
"""Number of Newton steps for the zero of a cubic; the next attempt corrects the remaining error."""

SAME = 1e-9
"""A start closer to the section than this, in units of the state's scale, lies on the section and is no crossing."""

ACCEPT, TAKE_BACK, LANDED = 0.0, 1.0, 2.0

RESOLVED = 1e-4
"""An attempt shorter than this [periods] is not halved in search of a pair of zeros."""

ROUNDED = 1e-12
"""Relative difference from a cubic that counts as rounding."""


def _events_of(system: System) -> Callable[..., Any]:
    """Return a function that gives values and time derivatives of all event functions as one flat tuple.

    The order is: switches, impacts, section. The cache treats the function as part of the system's module.
    """
    lines, parts = ["def event_values(t, y, dy, c, level):"], []
    for name, n in (("switches", system.n_switches), ("impacts", system.n_impacts)):
        if n:
            lines.append(f"{name} = _{name}(t, y, dy, c)")
            parts += [f"{name}[{k}][{j}]" for k in range(n) for j in range(2)]
    if system.section is not None:
        i = system.section[0]
        if i is None:
            lines.append("surface = _surface(t, y, dy, c)")
            parts += ["surface[0][0] - level", "surface[0][1]"]
        elif system.is_angle[i]:
            # the sine has a second zero half a turn away; `section_counts` excludes it
            lines.append(f"s, k = sincos(y[{i}] - level)")
            parts += ["s", f"k * dy[{i}]"]
        else:
            parts += [f"y[{i}] - level", f"dy[{i}]"]
    lines.append(f"return ({', '.join(parts)},)" if parts else "return ()")
    scope: dict[str, Any] = {
        "__name__": system.rhs.__module__,
        "_switches": system.switches,
        "_impacts": system.impacts,
        "_surface": system.surface,
        "sincos": sincos,
    }
    exec("\n    ".join(lines), scope)
    return inline(scope["event_values"])


def _middle_of(n: int) -> Callable[..., Any]:
    """Return a function that computes the states in the middle of a step by cubic Hermite interpolation."""
    lines = ["def middle_of(y0, dy0, y1, dy1, h):", "eighth = 0.125 * h"]
    parts = [f"multiply_add(eighth, dy0[{i}] - dy1[{i}], 0.5 * (y0[{i}] + y1[{i}]))" for i in range(n)]
    lines.append(f"return ({', '.join(parts)},)")
    scope: dict[str, Any] = {"__name__": __name__, "multiply_add": multiply_add}
    exec("\n    ".join(lines), scope)
    return inline(scope["middle_of"])


def event_bindings(system: System) -> dict[str, Any]:
    """Return the values of this module's free global names (such as ``N_EVENTS``) for a system."""
    of, direction = system.section or (None, 0)
    turns = of is not None and system.is_angle[of]
    directions = [0.0] * system.n_switches + [float(d) for d in system.impact_directions]
    starts = [1.0] * system.n_switches + [-float(d) for d in system.impact_directions]
    same = [0.0] * (system.n_switches + system.n_impacts)
    if system.section is not None:
        directions, starts = [*directions, float(direction)], [*starts, float(direction)]
        same = [*same, SAME * (system.surface_unit if of is None else 1.0 if turns else system.units[of])]
    return {
        "HAS_EVENTS": system.n_events > 0,
        "HAS_SECTION": system.section is not None,
        "SECTION_OF": of or 0,
        "N_EVENTS": system.n_events,
        "N_SWITCHES": system.n_switches,
        "N_IMPACTS": system.n_impacts,
        "DIRECTIONS": np.array(directions),
        "STARTS": np.array(starts),
        "SAME_VALUE": np.array(same),
        "event_values": _events_of(system),
        "middle_of": _middle_of(system.known),
        "N_SURFACES": system.n_surfaces,
        "HAS_SURFACES": system.n_surfaces > 0,
        "SECTION_TURNS": turns,
    }


def cubic_dip(a: Any, da: Any, b: Any, db: Any) -> Any:
    """Return where in (0, 1) a cubic has a negative minimum, or 2 if it has none. The cubic has end values `a`, `b` and
    end slopes `da`, `db`.
    """
    c3 = 2.0 * (a - b) + (da + db)
    c2 = multiply_add(3.0, b - a, -(da + da) - db)
    square = multiply_add(c2, c2, (-3.0 * c3) * da)
    root = sqrt(maximum(square, 0.0))
    x = where_less(0.0, c2, -da / (c2 + root), (root - c2) / (3.0 * c3))
    lowest = multiply_add(multiply_add(multiply_add(c3, x, c2), x, da), x, a)
    found = where_less(lowest, 0.0, x, 2.0)
    found = where_less(0.0, square, found, 2.0)
    return where_less(0.0, found, where_less(found, 1.0, found, 2.0), 2.0)


def may_dip(a: Any, da: Any, b: Any, db: Any) -> Any:
    """Return 1 where a cubic may fall below 0 between its ends, else 0. This is the fast test before `cubic_dip`."""
    least = minimum(multiply_add(1.0 / 3.0, da, a), multiply_add(-1.0 / 3.0, db, b))
    steepest = maximum(maximum(da, db), multiply_add(3.0, b - a, -(da + db)))
    return where_less(least, 0.0, where_less(0.0, steepest, 1.0, 0.0), 0.0)


def cubic_root(a: Any, da: Any, b: Any, db: Any, right: Any) -> Any:
    """Return the zero in [0, right] of the cubic on [0, 1] with end values `a` >= 0, `b` and end slopes `da`, `db`."""
    c3 = 2.0 * (a - b) + (da + db)
    c2 = multiply_add(3.0, b - a, -(da + da) - db)
    left = 0.0 * right
    # begin at the end whose value is nearer to zero; at the left end only if its slope leads to the right
    x = where_less(a, -b, where_less(da, 0.0, left, right), right)
    for _ in range(ROOT_STEPS):
        value = multiply_add(multiply_add(multiply_add(c3, x, c2), x, da), x, a)
        slope = multiply_add(multiply_add(3.0 * c3, x, c2 + c2), x, da)
        left = where_less(0.0, value, x, left)
        right = where_less(0.0, value, right, x)
        newton = x - value / slope
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        # bisect if Newton's step leaves the bracket; the margin admits the end itself, if it is the zero
        x = where_less(absolute(newton - middle), 1.000001 * half, newton, middle)
    # at the left end the value is 0 and falls: the zero is there
    return where_less(0.0, a, x, where_less(da, 0.0, 0.0 * x, x))


def margin(w: Any, base: int, k: int, near: Any, far: Any) -> Any:
    """Return value and rate of event function `k` at both ends of a step, multiplied by its sign before the event.

    Before the event both values are thus positive. `near` and `far` are pairs of value and rate at the start and
    the end of the step. A start value that is slightly beyond zero (rounding, or just after an event) is set to
    zero, and the end value is shifted by the same amount.
    """
    side = load(w, base + ROWS.side + k * WIDTH)
    value = side * near[0]
    excess = minimum(value, 0.0)
    return value - excess, side * near[1], side * far[0] - excess, side * far[1]


def pair(w: Any, row: int, k: int) -> Any:
    """Return the value and the time derivative of event function `k`, stored in the work array from `row` on."""
    return load(w, row + 2 * k * WIDTH), load(w, row + (2 * k + 1) * WIDTH)


def fires(w: Any, base: int, k: int) -> Any:
    """Return 1 where a zero of event function `k` is an event (a sign change in the declared direction), else 0."""
    return where_less(DIRECTIONS[k] * load(w, base + ROWS.side + k * WIDTH), 0.5, 1.0, 0.0)


def hides_events(w: Any, base: int) -> Any:
    """Return 1 where an event function may pass zero twice within a step, since its mid-step value differs from the
    cubic interpolant; else 0.
    """
    h, t, level = load(w, base + ROWS.step), load(w, base + ROWS.time), load(w, base + ROWS.level)
    y0, y1 = load_rows(w, base + ROWS.state, N_KNOWN), load_rows(w, base + ROWS.trial, N_KNOWN)
    dy0 = load_rows(w, base + ROWS.slopes, N_KNOWN)
    dy1 = load_rows(w, base + ROWS.slopes + (N_STAGES - 1) * N * WIDTH, N_KNOWN)
    c = load_rows(w, base + ROWS.constants, NC)
    middle = event_values(multiply_add(0.5, h, t), middle_of(y0, dy0, y1, dy1, h), dy1, c, level)
    store_rows(w, base + ROWS.halfway_events, middle)
    store_rows(w, base + ROWS.found, event_values(t + h, y1, dy1, c, level))
    hides = 0.0 * h
    for k in range(N_SURFACES):
        known, found = pair(w, base + ROWS.known, k), pair(w, base + ROWS.found, k)
        a, da, b, db = margin(w, base, k, known, found)
        da, db = h * da, h * db
        side = load(w, base + ROWS.side + k * WIDTH)
        value = side * load(w, base + ROWS.halfway_events + 2 * k * WIDTH) - minimum(side * known[0], 0.0)
        off = absolute(value - multiply_add(0.125, da - db, 0.5 * (a + b)))
        least = minimum(multiply_add(1.0 / 3.0, da, a), multiply_add(-1.0 / 3.0, db, b))
        size = ROUNDED * (absolute(a) + absolute(b) + absolute(da) + absolute(db))
        # a step that ends beyond zero is taken back anyway, so look only at the others
        may = where_less(b, 0.0, 0.0, fires(w, base, k))
        hides = maximum(hides, where_less(least, off + off, where_less(size, off, may, 0.0), 0.0))
    return where_less(RESOLVED * load(w, base + ROWS.period), h, hides, 0.0)


def turns_too_far(w: Any, base: int) -> Any:
    """Return 1 where the angle of the section turns by more than half a turn within a step, which hides crossings."""
    row = base + SECTION_OF * WIDTH
    turn = absolute(load(w, row + ROWS.trial) - load(w, row + ROWS.state))
    return where_less(0.5 * TWO_PI, turn, 1.0, 0.0)


def judge_events(w: Any, base: int, failed: Any) -> Any:
    """Return for each SIMD lane a verdict on the attempted step: accept it, take it back, or end on an event.

    The verdict is ACCEPT, TAKE_BACK or LANDED (on an event). After LANDED, the rows `fired` mark the events.
    `failed` is 1 for a step that error control rejects.
    """
    h = load(w, base + ROWS.step)
    y = load_rows(w, base + ROWS.trial, N_KNOWN)
    dy = load_rows(w, base + ROWS.slopes + (N_STAGES - 1) * N * WIDTH, N_KNOWN)
    c = load_rows(w, base + ROWS.constants, NC)
    found = event_values(load(w, base + ROWS.time) + h, y, dy, c, load(w, base + ROWS.level))
    store_rows(w, base + ROWS.found, found)
    # cheap test for all lanes; the expensive `settle_events` runs only if a lane of the group needs it
    doubt = where_less(0.0, load(w, base + ROWS.resolution), 1.0, 0.0 * h)
    for k in range(N_EVENTS):
        value = load(w, base + ROWS.found + 2 * k * WIDTH)
        side = load(w, base + ROWS.side + k * WIDTH)
        first = where_less(SAME_VALUE[k], absolute(value), copysign(1.0, value), STARTS[k])
        store(w, base + ROWS.side + k * WIDTH, where_less(absolute(side), 0.5, first, side))
        a, da, b, db = margin(w, base, k, pair(w, base + ROWS.known, k), pair(w, base + ROWS.found, k))
        doubt = maximum(doubt, where_less(b, 0.0, 1.0, may_dip(a, h * da, b, h * db)))
    verdict = 0.0 * h
    if any_nonzero(doubt):
        verdict = settle_events(w, base, failed)
    stays = maximum(failed, where_less(absolute(verdict - TAKE_BACK), 0.5, 1.0, 0.0))
    for k in range(2 * N_EVENTS):
        row = base + k * WIDTH
        old, new = load(w, row + ROWS.known), load(w, row + ROWS.found)
        store(w, row + ROWS.known, where_less(0.5, stays, old, new))
    return verdict


def settle_events(w: Any, base: int, failed: Any) -> Any:
    """Accept an attempted step that may have passed an event, or take it back; set the length of the next one."""
    h = load(w, base + ROWS.step)
    narrow = load(w, base + ROWS.resolution)
    first = where_less(0.0, narrow, 0.0, 1.0)
    narrow = where_less(0.0, narrow, narrow, NARROW * h)
    passed, beyond = 0.0 * h, 0.0 * h
    for k in range(N_EVENTS):
        a, da, b, db = margin(w, base, k, pair(w, base + ROWS.known, k), pair(w, base + ROWS.found, k))
        crossed = where_less(b, 0.0, fires(w, base, k), 0.0)
        passed = maximum(passed, crossed)
        beyond = maximum(beyond, where_less(narrow * absolute(db), -b, crossed, 0.0))
        # look for a dip in the first attempt of a step only, so that the attempts come to an end
        may, dip = first * may_dip(a, h * da, b, h * db), 2.0 + 0.0 * h
        if any_nonzero(may):
            dip = where_less(0.5, may, cubic_dip(a, h * da, b, h * db), dip)
        store(w, base + ROWS.dip + k * WIDTH, dip)
        beyond = maximum(beyond, where_less(dip, 1.0, 1.0, 0.0))
    judged = where_less(0.0, h, 1.0 - failed, 0.0)
    takes = judged * beyond
    lands = judged * passed * (1.0 - beyond)
    turn_sides(w, base, judged * (1.0 - beyond), lands)
    aim(w, base, takes, (judged - takes) * (1.0 - lands) * (1.0 - first), narrow)
    return where_less(0.5, takes, TAKE_BACK, where_less(0.5, lands, LANDED, ACCEPT * h))


def turn_sides(w: Any, base: int, accepted: Any, lands: Any) -> None:
    """Flip the stored sign of each event function that passed zero in an accepted step, and mark its event as fired."""
    for k in range(N_EVENTS):
        row = base + k * WIDTH
        _, _, b, _ = margin(w, base, k, pair(w, base + ROWS.known, k), pair(w, base + ROWS.found, k))
        crossed = where_less(b, 0.0, accepted, 0.0)
        store(w, row + ROWS.fired, where_less(0.5, crossed, lands * fires(w, base, k), 0.0 * lands))
        side = load(w, row + ROWS.side)
        store(w, row + ROWS.side, where_less(0.5, crossed, -side, side))


def hidden_zero(w: Any, base: int) -> Any:
    """Return 1 where the earlier attempt passed an event, though a step up to its end has not; else 0."""
    hidden = 0.0 * load(w, base + ROWS.step)
    for k in range(N_EVENTS):
        _, _, b, _ = margin(w, base, k, pair(w, base + ROWS.found, k), pair(w, base + ROWS.passed, k))
        hidden = maximum(hidden, where_less(b, 0.0, fires(w, base, k), 0.0))
    return hidden


def aim(w: Any, base: int, takes: Any, goes_on: Any, narrow: Any) -> None:
    """Set the length of the next step so that it ends at the nearest zero of the event functions.

    If the attempt is taken back (`takes`), the zero lies within its length. If the step ended before the zero
    (`goes_on`), the zero lies within the rest of an earlier attempt. Where nothing is left of an attempt that passed
    the zero, rounding has hidden it from the shorter steps; then the next attempts keep the resolution.
    """
    h, ahead = load(w, base + ROWS.step), load(w, base + ROWS.ahead)
    length = where_less(0.5, takes, h, ahead - h)
    on = maximum(takes, where_less(0.0, length, goes_on, 0.0))
    ends, kept = where_less(0.0, ahead, goes_on * (1.0 - on), 0.0), 0.0 * h
    if any_nonzero(ends):
        kept = ends * hidden_zero(w, base) * narrow
    if not any_nonzero(on):
        store(w, base + ROWS.resolution, kept)
        store(w, base + ROWS.ahead, 0.0 * h)
        store(w, base + ROWS.aimed, 0.0 * h)
        return
    nearest = length
    for k in range(2 * N_EVENTS):
        row = base + k * WIDTH
        far, new = load(w, row + ROWS.passed), load(w, row + ROWS.found)
        store(w, row + ROWS.passed, where_less(0.5, takes, new, far))
    for k in range(N_EVENTS):
        known, found = pair(w, base + ROWS.known, k), pair(w, base + ROWS.found, k)
        near = (where_less(0.5, takes, known[0], found[0]), where_less(0.5, takes, known[1], found[1]))
        a, da, b, db = margin(w, base, k, near, pair(w, base + ROWS.passed, k))
        da, db = length * da, length * db
        dip = where_less(0.5, takes, load(w, base + ROWS.dip + k * WIDTH), 2.0)
        root = cubic_root(a, da, b, db, minimum(dip, 1.0))
        x = where_less(b, 0.0, where_less(0.5, fires(w, base, k), root, dip), dip)
        nearest = minimum(nearest, x * length)
    narrow = WIDEN * narrow
    store(w, base + ROWS.resolution, where_less(0.5, on, narrow, kept))
    store(w, base + ROWS.ahead, where_less(0.5, on, length, 0.0 * h))
    # end slightly beyond the zero, so that rounding does not leave the step before it
    store(w, base + ROWS.aimed, where_less(0.5, on, multiply_add(0.125, narrow, nearest), 0.0 * h))


def section_counts(w: Any, base: int, lane: int) -> bool:
    """Return whether the last step ended on the Poincare section. For an angle, exclude the point half a turn away,
    where the sine is also zero.
    """
    if w[base + ROWS.fired + (N_EVENTS - 1) * WIDTH + lane] < 0.5:
        return False
    if not SECTION_TURNS:
        return True
    x = w[base + ROWS.state + SECTION_OF * WIDTH + lane]
    return cos(x - w[base + ROWS.level + lane]) > 0.0


INLINE = ("cubic_dip", "may_dip", "cubic_root", "margin", "pair", "fires", "section_counts")
"""Templates of this module that are inlined into their callers. Callees come first; `CALLED` follows after them."""

CALLED = ("turn_sides", "hidden_zero", "aim", "settle_events", "hides_events", "turns_too_far", "judge_events")
"""Templates of this module that are compiled as functions of their own."""
