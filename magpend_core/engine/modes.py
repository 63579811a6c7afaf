"""Apply events to a trajectory: change the modes of switches, apply impact maps to states and tangent vectors.

These templates belong to the engine's scalar pass, see `lanes`: they run once per event, on plain numbers of one
lane.

At a switch the right-hand side changes from f- to f+. If f on both sides points to the surface, the trajectory
slides along it (Filippov): the mode is 0 until the equivalent control leaves its bounds. With the event function
g, a tangent vector v becomes v + (f+ - f-) (grad g . v)/(dg/dt-) (saltation matrix). At an impact with the map R
it becomes R'(v + f- s) - f+ s, where s = -(grad g . v)/(dg/dt-) is the shift of the impact time (di Bernardo et
al., Piecewise-smooth Dynamical Systems, Springer 2008, section 2.5). R' is a finite difference of order four,
exact for polynomial maps up to degree four.

Reading order: `act_on_events` is called by `lanes.serve`. It finds the event that happened, then switches a mode or
applies an impact, and corrects the tangent vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import WIDTH
from magpend_core.engine.system import System
from magpend_core.engine.tangents import DIVERGENCE
from magpend_core.engine.vecmath import log

STEP = 1e-3
"""Step of the finite differences of an impact map, in units of the states' scales."""

NEAR = 1e-12
"""An instant is resolved to this [steps that error control allows]: surfaces that are reached within it coincide."""

GRAIN = 1e-14
"""Relative rounding error of the terms of an event function."""

AWAY = 1e-7
"""After a forcing edge, a switch further from zero than this (times rate and period) has left its surface."""

CHATTERED = 6.0
"""Event code, like `lanes.NOTHING`: the impacts chatter, and the trajectory ends."""

CHATTER, LEAST_LOSS = 1e-6, 0.3
"""Chatter begins at a flight between impacts shorter than ``CHATTER * max(loss, LEAST_LOSS)`` [periods].

The loss is the fraction of the speed that an impact takes. All later flights together then last for about
1e-6 periods, or longer if the loss is below `LEAST_LOSS`.
"""

ELASTIC = 1e-9
"""An impact that takes less than this fraction of the speed counts as elastic."""

LOOK = 1e-6
"""Time step of the finite difference for a second derivative [periods]."""

AT_REST = 1e-5
"""A state rests on a surface at the start if it would fall onto it within this time [periods]."""

LEAST_VOLUME = 1e-300
"""Least change of a volume, so that its logarithm is finite where it vanishes: where a trajectory begins to slide."""


def _numbers(n: int) -> Callable[..., Any]:
    """Return a function that reads `n` rows of one SIMD lane as a tuple."""
    entries = "".join(f"w[at + {i * WIDTH}], " for i in range(n))
    scope: dict[str, Any] = {"__name__": __name__}
    exec(f"def numbers(w, at):\n    return ({entries})\n", scope)
    return inline(scope["numbers"])


def _reset_along(system: System, n: int) -> Callable[..., Any]:
    """Return a function that applies the impact maps to the state ``y + s*dy`` at the time ``t + s*dt``."""
    line = "".join(f"y[{i}] + s * dy[{i}], " for i in range(n))
    scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_reset": system.reset}
    exec(f"def reset_along(k, t, y, c, dt, dy, s):\n    return _reset(k, t + s * dt, ({line}), c)\n", scope)
    return inline(scope["reset_along"])


def mode_bindings(system: System) -> dict[str, Any]:
    """Return the values of this module's free global names (such as ``N_VECTORS``) for a system."""
    base = system.tangents_of or system
    has_divergence = system.tangents_of is not None and system.state_names[-1] == DIVERGENCE
    n_vectors = (system.n_states - has_divergence) // base.n_states - 1
    n_stages = system.tableau.n_stages
    if has_divergence and system.n_impacts and base.n_states**2 > n_stages * system.n_states:
        raise ValueError(
            f"{system.name} has impacts and {base.n_states} states: the change of volumes at an impact needs "
            f"{base.n_states**2 // n_stages // base.n_states} tangent vectors at least; give more exponents."
        )
    return {
        "HAS_SEGMENTS": system.has_segments,
        "HAS_SWITCHES": system.n_switches > 0,
        "HAS_IMPACTS": system.n_impacts > 0,
        "HAS_VECTORS": n_vectors > 0,
        "HAS_CONTACTS": system.n_contacts > 0,
        "SLIDES": (*system.slides, False),
        "STICKS": (*system.sticks, 0),
        "ZEROS": (0.0,) * system.known,
        "N_BASE": base.n_states,
        "N_VECTORS": n_vectors,
        # the unit vectors are needed only for the change of volumes
        "N_THROUGH": n_vectors + (base.n_states if has_divergence else 0),
        "HAS_DIVERGENCE": has_divergence,
        "lane_states": _numbers(system.known),
        "lane_base": _numbers(base.n_states),
        "lane_constants": _numbers(system.n_constants + system.n_modes),
        "reset_along": _reset_along(system, base.n_states),
    }


def lane_pairs(w: Any, base: int, lane: int, dy: Any) -> Any:
    """Return value and time derivative of each event function in a SIMD lane; `dy` are the time derivatives of the
    states.
    """
    y = lane_states(w, base + ROWS.state + lane)
    c = lane_constants(w, base + ROWS.constants + lane)
    level = w[base + ROWS.level + lane] if HAS_SECTION else 0.0
    return event_values(w[base + ROWS.time + lane], y, dy, c, level)


def lane_rates(w: Any, base: int, lane: int) -> Any:
    """Return the time derivatives of the states in a SIMD lane."""
    c = lane_constants(w, base + ROWS.constants + lane)
    u = forcing(w[base + ROWS.time + lane], c)
    return rhs(lane_states(w, base + ROWS.state + lane), u, c)


def seat_switches(w: Any, base: int, lane: int, given: bool) -> None:
    """Set the mode of each switch to the sign of its event function, +1 or -1. Where the sign is 0, set +1, or keep the
    mode if `given`.
    """
    for k in range(N_SWITCHES):
        mode = base + ROWS.constants + (N_OWN + k) * WIDTH + lane
        if not given or w[mode] == 0.0:
            w[mode] = 1.0
    pairs = lane_pairs(w, base, lane, lane_states(w, base + ROWS.state + lane))
    for k in range(N_SWITCHES):
        mode = base + ROWS.constants + (N_OWN + k) * WIDTH + lane
        if pairs[2 * k] != 0.0:
            w[mode] = 1.0 if pairs[2 * k] > 0.0 else -1.0
        w[base + ROWS.side + k * WIDTH + lane] = w[mode]


def gradient_along(w: Any, base: int, lane: int, k: int, vector: Any) -> float:
    """Return the derivative of event function `k` in the direction `vector` of state space."""
    at_rest = lane_pairs(w, base, lane, ZEROS)
    return lane_pairs(w, base, lane, vector)[2 * k + 1] - at_rest[2 * k + 1]


def switch_rate(w: Any, base: int, lane: int, k: int, side: float) -> float:
    """Set the mode of switch `k` to `side`, and return the time derivative of its event function in that mode."""
    w[base + ROWS.constants + (N_OWN + k) * WIDTH + lane] = side
    return lane_pairs(w, base, lane, lane_rates(w, base, lane))[2 * k + 1]


def next_mode(w: Any, base: int, lane: int, k: int, mode: float) -> float:
    """Return the mode of switch `k` after its event: +1 or -1 for the side of the switching surface, 0 for sliding
    along it.
    """
    if not SLIDES[k]:
        return -mode
    above, below = switch_rate(w, base, lane, k, 1.0), switch_rate(w, base, lane, k, -1.0)
    if mode == 0.0:
        return 1.0 if above + below > 0.0 else -1.0
    if above < 0.0 and below > 0.0:
        return 0.0
    if above > 0.0 and below > 0.0:
        return 1.0
    if above < 0.0 and below < 0.0:
        return -1.0
    return -mode


def keep_switches(w: Any, base: int, lane: int) -> None:
    """Correct the modes of all switches after a forcing edge, where event functions and their rates can jump."""
    pairs = lane_pairs(w, base, lane, lane_states(w, base + ROWS.state + lane))
    for k in range(N_SWITCHES):
        own = base + ROWS.constants + (N_OWN + k) * WIDTH + lane
        mode = w[own]
        if mode == 0.0:
            # the surface can have jumped away from the state that slid on it
            fastest = max(abs(switch_rate(w, base, lane, k, 1.0)), abs(switch_rate(w, base, lane, k, -1.0)))
            value = lane_pairs(w, base, lane, lane_states(w, base + ROWS.state + lane))[2 * k]
            w[own] = mode
            if abs(value) > AWAY * fastest * w[base + ROWS.period + lane]:
                mode = 1.0 if value > 0.0 else -1.0
            elif pairs[2 * k] < 0.0:
                mode = next_mode(w, base, lane, k, mode)
        elif mode != 0.0 and pairs[2 * k] != 0.0:
            mode = 1.0 if pairs[2 * k] > 0.0 else -1.0
        w[own] = mode
        w[base + ROWS.side + k * WIDTH + lane] = mode if mode != 0.0 else 1.0


def begin_events(w: Any, base: int, lane: int) -> None:
    """Reset the event data of a SIMD lane; set the modes of its switches and its resting contacts from its state."""
    for k in range(N_EVENTS):
        w[base + ROWS.side + k * WIDTH + lane] = 0.0
        w[base + ROWS.fired + k * WIDTH + lane] = 0.0
    w[base + ROWS.aimed + lane] = 0.0
    w[base + ROWS.resolution + lane] = 0.0
    if HAS_SWITCHES:
        seat_switches(w, base, lane, False)
    if HAS_CONTACTS:
        for k in range(N_IMPACTS):
            w[contact_row(base, lane, k)] = 1.0
        seat_contacts(w, base, lane, True)


def contact_row(base: int, lane: int, k: int) -> int:
    """Return the work-array index of the contact mode of impact `k`. The mode is 0 while the state rests on the impact
    surface, else 1.
    """
    return base + ROWS.constants + (N_OWN + N_SWITCHES + k) * WIDTH + lane


def bend(w: Any, base: int, lane: int, event: int) -> float:
    """Return the second time derivative of an event function along the trajectory, by a finite difference."""
    step = LOOK * w[base + ROWS.period + lane]
    y, t = lane_states(w, base + ROWS.state + lane), w[base + ROWS.time + lane]
    dy = lane_rates(w, base, lane)
    before = lane_pairs(w, base, lane, dy)[2 * event + 1]
    for i in range(N_KNOWN):
        w[base + ROWS.state + i * WIDTH + lane] = y[i] + step * dy[i]
    w[base + ROWS.time + lane] = t + step
    after = lane_pairs(w, base, lane, lane_rates(w, base, lane))[2 * event + 1]
    for i in range(N_KNOWN):
        w[base + ROWS.state + i * WIDTH + lane] = y[i]
    w[base + ROWS.time + lane] = t
    return (after - before) / step


def is_chatter(w: Any, base: int, lane: int, k: int, arriving: float) -> bool:
    """Return whether an impact at speed `arriving` begins chatter: ever smaller bounces that soon end."""
    event = N_SWITCHES + k
    leaving = -DIRECTIONS[event] * lane_pairs(w, base, lane, lane_rates(w, base, lane))[2 * event + 1]
    if not (abs(leaving) < arriving and leaving > -ELASTIC * arriving):
        return False
    lost = 1.0 - max(leaving, 0.0) / arriving
    pushes = DIRECTIONS[event] * bend(w, base, lane, event)
    flight = 2.0 * max(leaving, 0.0)  # flight time, multiplied by the acceleration `pushes`
    return lost > ELASTIC and flight < CHATTER * max(lost, LEAST_LOSS) * w[base + ROWS.period + lane] * pushes


def rest_on(w: Any, base: int, lane: int, k: int) -> None:
    """Bring a trajectory to rest on the surface of impact `k`. End it if it already rests on a surface that excludes
    this one.
    """
    for i in range(N_IMPACTS):
        if i != k and STICKS[k] == 2 and STICKS[i] == 2 and w[contact_row(base, lane, i)] == 0.0:
            w[base + ROWS.event + lane] = CHATTERED
    if HAS_VECTORS:
        set_units(w, base, lane)
        t, y = w[base + ROWS.time + lane], lane_base(w, base + ROWS.state + lane)
        for j in range(N_THROUGH):
            map_vector(w, base, lane, N_IMPACTS + k, vector_row(base, lane, j), 0.0, t, y)
        if HAS_DIVERGENCE:
            w[base + ROWS.state + (N - 1) * WIDTH + lane] += log_volume(w, base + ROWS.slopes + lane)
    hold_on(w, base, lane, k)
    w[contact_row(base, lane, k)] = 0.0
    w[base + ROWS.side + (N_SWITCHES + k) * WIDTH + lane] = STARTS[N_SWITCHES + k]


def hold_on(w: Any, base: int, lane: int, k: int) -> None:
    """Move the states onto the surface of impact `k`, at rest relative to it."""
    t, y = w[base + ROWS.time + lane], lane_base(w, base + ROWS.state + lane)
    new = reset_along(N_IMPACTS + k, t, y, lane_constants(w, base + ROWS.constants + lane), 0.0, y, 0.0)
    for i in range(N_BASE):
        w[base + ROWS.state + i * WIDTH + lane] = new[i]
    w[base + ROWS.fresh + lane] = 1.0


def hold_contacts(w: Any, base: int, lane: int) -> None:
    """Move a resting state back onto its contact surfaces, to remove the drift from rounding and step errors."""
    for k in range(N_IMPACTS):
        if STICKS[k] > 0 and w[contact_row(base, lane, k)] == 0.0:
            hold_on(w, base, lane, k)


def seat_contacts(w: Any, base: int, lane: int, begins: bool) -> None:
    """Test for each impact surface whether the trajectory rests on it, and set the contact mode.

    With `begins` (start of a parameter point), test every surface, else only those of earlier rest.
    """
    for k in range(N_IMPACTS):
        mode, event = contact_row(base, lane, k), N_SWITCHES + k
        if STICKS[k] > 0 and (begins or w[mode] == 0.0):
            w[mode] = 1.0
            pairs = lane_pairs(w, base, lane, lane_rates(w, base, lane))
            pushes = DIRECTIONS[event] * bend(w, base, lane, event)
            reach = AT_REST * w[base + ROWS.period + lane]
            if abs(pairs[2 * event + 1]) < reach * pushes and abs(pairs[2 * event]) < reach * reach * pushes:
                rest_on(w, base, lane, k)
            elif not begins:
                w[base + ROWS.side + event * WIDTH + lane] = STARTS[event]


def turn_switch(w: Any, base: int, lane: int, k: int) -> None:
    """Change the mode of switch `k` for a trajectory on its surface, and apply the saltation matrix to the tangent
    vectors.
    """
    own = base + ROWS.constants + (N_OWN + k) * WIDTH + lane
    mode = w[own]
    if HAS_VECTORS:
        before = lane_rates(w, base, lane)
        rate = lane_pairs(w, base, lane, before)[2 * k + 1]
        for j in range(N_VECTORS):
            at = base + ROWS.state + N_BASE * (1 + j) * WIDTH + lane
            along = gradient_along(w, base, lane, k, lane_base(w, at))
            w[base + ROWS.trial + j * WIDTH + lane] = along / rate if rate != 0.0 else 0.0
    new = next_mode(w, base, lane, k, mode)
    w[own] = new
    if HAS_VECTORS:
        after = lane_rates(w, base, lane)
        for j in range(N_VECTORS):
            share = w[base + ROWS.trial + j * WIDTH + lane]
            for i in range(N_BASE):
                w[base + ROWS.state + (N_BASE * (1 + j) + i) * WIDTH + lane] += (after[i] - before[i]) * share
        if HAS_DIVERGENCE:
            # the determinant of the saltation matrix is the ratio of the event function's rates after and before
            w[own] = mode
            quotient = lane_pairs(w, base, lane, after)[2 * k + 1] / rate if rate != 0.0 else 1.0
            w[own] = new
            w[base + ROWS.state + (N - 1) * WIDTH + lane] += log(max(abs(quotient), LEAST_VOLUME))
    w[base + ROWS.side + k * WIDTH + lane] = new if new != 0.0 else 1.0


def vector_row(base: int, lane: int, j: int) -> int:
    """Return the work-array index of vector `j` to be mapped at an impact: first the tangent vectors, then unit
    vectors.
    """
    if j < N_VECTORS:
        return base + ROWS.state + N_BASE * (1 + j) * WIDTH + lane
    return base + ROWS.slopes + N_BASE * (j - N_VECTORS) * WIDTH + lane


def map_vector(w: Any, base: int, lane: int, k: int, at: int, shift: float, t: float, y: Any) -> None:
    """Replace a tangent vector (stored at `at`) by its image under the linearised impact map `k`, by finite
    differences.
    """
    c, size = lane_constants(w, base + ROWS.constants + lane), 0.0
    for i in range(N_BASE):
        size = max(size, abs(w[at + i * WIDTH]) / SCALES[i])
    s = STEP / size if size > 0.0 else 1.0
    v = lane_base(w, at)
    far, near = reset_along(k, t, y, c, shift, v, 2.0 * s), reset_along(k, t, y, c, shift, v, s)
    back, behind = reset_along(k, t, y, c, shift, v, -s), reset_along(k, t, y, c, shift, v, -2.0 * s)
    for i in range(N_BASE):
        w[at + i * WIDTH] = (8.0 * (near[i] - back[i]) - (far[i] - behind[i])) / (12.0 * s)


def jump_vectors(w: Any, base: int, lane: int, k: int) -> None:
    """Map all tangent and unit vectors through impact `k`; store each vector's shift of the impact time."""
    t, y = w[base + ROWS.time + lane], lane_base(w, base + ROWS.state + lane)
    before = lane_rates(w, base, lane)
    rate = lane_pairs(w, base, lane, before)[2 * (N_SWITCHES + k) + 1]
    for j in range(N_THROUGH):
        at = vector_row(base, lane, j)
        along = gradient_along(w, base, lane, N_SWITCHES + k, lane_base(w, at))
        shift = -along / rate if rate != 0.0 else 0.0
        w[base + ROWS.trial + j * WIDTH + lane] = shift
        for i in range(N_BASE):
            w[at + i * WIDTH] += before[i] * shift
        map_vector(w, base, lane, k, at, shift, t, y)


def set_units(w: Any, base: int, lane: int) -> None:
    """Write unit vectors to the work array. Mapped through an impact, they give the determinant of its Jacobian."""
    for j in range(N_VECTORS, N_THROUGH):
        for i in range(N_BASE):
            w[vector_row(base, lane, j) + i * WIDTH] = 1.0 if i == j - N_VECTORS else 0.0


def log_volume(w: Any, at: int) -> float:
    """Return log |det| of the matrix stored in the work array from index `at` on; overwrite the matrix."""
    total, n = 0.0, N_BASE
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(w[at + (n * i + j) * WIDTH]) > abs(w[at + (n * best + j) * WIDTH]):
                best = i
        for i in range(n):
            a, b = at + (n * j + i) * WIDTH, at + (n * best + i) * WIDTH
            w[a], w[b] = w[b], w[a]
        pivot = w[at + (n * j + j) * WIDTH]
        total += log(max(abs(pivot), LEAST_VOLUME))
        for i in range(j + 1, n):
            factor = w[at + (n * i + j) * WIDTH] / pivot if pivot != 0.0 else 0.0
            for m in range(j, n):
                w[at + (n * i + m) * WIDTH] -= factor * w[at + (n * j + m) * WIDTH]
    return total


def jump(w: Any, base: int, lane: int, k: int) -> None:
    """Apply the map of impact `k` to the states and tangent vectors of a trajectory on the impact surface."""
    event = N_SWITCHES + k
    pairs = lane_pairs(w, base, lane, lane_rates(w, base, lane))
    value, rate = pairs[2 * event], pairs[2 * event + 1]
    t, y = w[base + ROWS.time + lane], lane_base(w, base + ROWS.state + lane)
    new = reset_along(k, t, y, lane_constants(w, base + ROWS.constants + lane), 0.0, y, 0.0)
    if HAS_VECTORS:
        set_units(w, base, lane)
        jump_vectors(w, base, lane, k)
    for i in range(N_BASE):
        w[base + ROWS.state + i * WIDTH + lane] = new[i]
    if HAS_SWITCHES:
        seat_switches(w, base, lane, True)
    if HAS_VECTORS:
        after = lane_rates(w, base, lane)
        for j in range(N_THROUGH):
            shift, at = w[base + ROWS.trial + j * WIDTH + lane], vector_row(base, lane, j)
            for i in range(N_BASE):
                w[at + i * WIDTH] -= after[i] * shift
        if HAS_DIVERGENCE:
            volume = log_volume(w, base + ROWS.slopes + lane)
            w[base + ROWS.state + (N - 1) * WIDTH + lane] += volume
    if HAS_CONTACTS:
        seat_contacts(w, base, lane, False)
    now = lane_pairs(w, base, lane, ZEROS)[2 * event]
    beyond = DIRECTIONS[event] * now > 4.0 * abs(value) + blur_of(w, base, lane, event, now, rate)
    if not beyond and is_chatter(w, base, lane, k, DIRECTIONS[event] * rate):
        if STICKS[k] > 0:
            rest_on(w, base, lane, k)
        else:
            w[base + ROWS.event + lane] = CHATTERED


def blur_of(w: Any, base: int, lane: int, event: int, value: float, rate: float) -> float:
    """Return the size up to which the value of an event function may be rounding, at an instant at which its rate is
    `rate`. Of a value that is larger in any case, return a lower bound.
    """
    blur = NEAR * abs(rate) * w[base + ROWS.wish + lane]
    if abs(value) <= blur:
        return blur
    for i in range(N_BASE):
        # the row is free between steps: a vector with the state number i alone
        for j in range(N_BASE):
            own = w[base + ROWS.state + i * WIDTH + lane] if j == i else 0.0
            w[base + ROWS.trial + j * WIDTH + lane] = own
        blur += GRAIN * abs(gradient_along(w, base, lane, event, lane_base(w, base + ROWS.trial + lane)))
    return blur


def rests(w: Any, base: int, lane: int, k: int) -> bool:
    """Return whether the state rests on the surface of impact `k`."""
    return HAS_CONTACTS and STICKS[k] > 0 and w[contact_row(base, lane, k)] == 0.0


def gather_impacts(w: Any, base: int, lane: int) -> bool:
    """Return whether an impact happens at the end of the last step.

    Surfaces that the state reaches at the same instant, up to rounding, and the section then count as reached, too:
    which of them a step passes first is rounding.
    """
    hit, reached = False, False
    for event in range(N_SWITCHES, N_EVENTS):
        if w[base + ROWS.fired + event * WIDTH + lane] > 0.5:
            reached = True
            hit = hit or event < N_SWITCHES + N_IMPACTS
    if not reached or N_EVENTS - N_SWITCHES == 1:
        return hit
    pairs = lane_pairs(w, base, lane, lane_rates(w, base, lane))
    for event in range(N_SWITCHES, N_EVENTS):
        armed = DIRECTIONS[event] * w[base + ROWS.side + event * WIDTH + lane] < 0.0
        is_impact = event < N_SWITCHES + N_IMPACTS
        value, rate = pairs[2 * event], pairs[2 * event + 1]
        if not armed or DIRECTIONS[event] * rate <= 0.0 or (is_impact and rests(w, base, lane, event - N_SWITCHES)):
            continue
        if abs(value) <= blur_of(w, base, lane, event, value, rate):
            w[base + ROWS.fired + event * WIDTH + lane] = 1.0
            hit = hit or is_impact
    return hit


def strike(w: Any, base: int, lane: int) -> None:
    """Carry out the impacts of an instant, in the order of the model; then arm their surfaces."""
    before = lane_pairs(w, base, lane, lane_rates(w, base, lane))
    jumped = False
    for k in range(N_IMPACTS):
        if w[base + ROWS.fired + (N_SWITCHES + k) * WIDTH + lane] > 0.5:
            if rests(w, base, lane, k):
                # a resting state lifts off: neither states nor rates jump
                w[contact_row(base, lane, k)] = 1.0
                w[base + ROWS.side + (N_SWITCHES + k) * WIDTH + lane] = STARTS[N_SWITCHES + k]
            else:
                jump(w, base, lane, k)
                jumped = True
    if jumped:
        arm(w, base, lane, before)


def arm(w: Any, base: int, lane: int, before: Any) -> None:
    """Set after impacts on which side of each surface the state is. On a surface its side is the one to which the
    rates carry it.

    A surface that the state leaves beyond is not armed, so that its impact happens once at each passage.

    Parameters
    ----------
    before
        Values and rates of all event functions before the impacts.
    """
    after = lane_pairs(w, base, lane, lane_rates(w, base, lane))
    for k in range(N_IMPACTS):
        event = N_SWITCHES + k
        if rests(w, base, lane, k):
            continue
        value, rate = after[2 * event], after[2 * event + 1]
        fired = w[base + ROWS.fired + event * WIDTH + lane]
        room = 4.0 * fired * abs(before[2 * event])
        side = 1.0 if value > 0.0 else -1.0
        if abs(value) <= room or abs(value) <= room + blur_of(w, base, lane, event, value, before[2 * event + 1]):
            unclear = ELASTIC * max(abs(before[2 * event + 1]), abs(rate))
            onward = DIRECTIONS[event] * rate
            returns = onward < -unclear or (onward <= unclear and DIRECTIONS[event] * bend(w, base, lane, event) < 0.0)
            side = STARTS[event] if returns else -STARTS[event]
        w[base + ROWS.side + event * WIDTH + lane] = side
    if HAS_SECTION:
        w[base + ROWS.side + (N_EVENTS - 1) * WIDTH + lane] = 0.0


def act_on_events(w: Any, base: int, lane: int) -> bool:
    """Carry out the events at which a SIMD lane's last step ended; return whether the step ended on the Poincare
    section.
    """
    on_section = False
    hit = gather_impacts(w, base, lane) if HAS_IMPACTS else False
    if HAS_SECTION:
        on_section = section_counts(w, base, lane)
    fired = base + ROWS.fired + lane
    if HAS_SWITCHES:
        for k in range(N_SWITCHES):
            if w[fired + k * WIDTH] > 0.5:
                turn_switch(w, base, lane, k)
                w[base + ROWS.fresh + lane] = 1.0
    if hit:
        strike(w, base, lane)
        w[base + ROWS.fresh + lane] = 1.0
    for k in range(N_EVENTS):
        w[fired + k * WIDTH] = 0.0
    return on_section


INLINE = ("lane_pairs", "lane_rates", "gradient_along", "switch_rate", "vector_row", "contact_row", "rests")
"""Templates of this module that are inlined into their callers. Callees come first; `CALLED` follows after them."""

CALLED = (
    "seat_switches",
    "next_mode",
    "keep_switches",
    "set_units",
    "log_volume",
    "map_vector",
    "bend",
    "is_chatter",
    "hold_on",
    "hold_contacts",
    "rest_on",
    "seat_contacts",
    "begin_events",
    "turn_switch",
    "jump_vectors",
    "blur_of",
    "jump",
    "gather_impacts",
    "arm",
    "strike",
    "act_on_events",
)
"""Templates of this module that are compiled as functions of their own."""
