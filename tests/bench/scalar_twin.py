"""The full model and its integration for one trajectory at a time: numba with libm's functions.

What one would write without lanes, and an independent check of the engine: the same equations,
tableau, tolerances and step control, written again without a line of `magpend_core`. Forces in the
joints are taken in the fixed frame here. Control is chosen when `sections_of` is compiled:

`LIMITED`
    As in `magpend_core.engine.lanes`: steps in proportion to the distance from the nearest layer or edge.
`TEXTBOOK`
    Hairer, Norsett and Wanner, Solving ODEs I, II.4: the factor 0.9 e^(-1/5) in [0.2, 5], and
    nothing else. Steps end on the known switch times of the drive.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

LIMITED, TEXTBOOK = "limited", "textbook"
OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
# what compiled functions alone call has no doors for Python and C, which cost a fifth of the compilation
WITHOUT_DOORS = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
inlined = njit(forceinline=True, **WITHOUT_DOORS)  # calls with so many parameters cost a fifth of the time
TWO_PI = 2.0 * math.pi
SLACK = 1e4  # times rtol + atol

# Dormand-Prince 5(4)
A21 = 1 / 5
A31, A32 = 3 / 40, 9 / 40
A41, A42, A43 = 44 / 45, -56 / 15, 32 / 9
A51, A52, A53, A54 = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
A61, A62, A63, A64, A65 = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
B1, B3, B4, B5, B6 = 35 / 384, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
E1, E3, E4, E5, E6, E7 = 71 / 57600, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40


class Model(NamedTuple):
    """Parameters as the paper names them [SI], and what follows from them."""

    g: float
    l1: float
    m1: float
    m2: float
    e1: float
    e2: float
    J1: float
    J2: float
    T1: float
    T2: float
    c: float
    mu: float
    mu0: float
    c0: float
    eps: float
    duty_cycle: float
    q: float
    eps_drive: float
    alpha1: float
    alpha2: float
    beta1: float
    beta2: float
    gamma1: float
    gamma2: float
    p1: float
    p2: float
    r1: float
    r2: float
    c1: float
    c2: float
    eps_mag: float
    l2: float
    h: float
    delta: float
    frequency: float
    inertia1: float  # kg m2, B1 of the paper
    inertia2: float
    coupling: float  # kg m2, N12
    weight1: float  # N m, M1
    weight2: float
    omega: float  # rad/s
    phase: float  # rad
    bias: float  # a of Eq. 13
    share: float  # of the lever of link 1 on joint 2, what it is more on joint 1
    middle: float  # slope of the line between the magnet's bumps
    offset: float  # rad
    jump1: float  # rad/s2, of the acceleration of link 1 as it reverses
    jump2: float
    jump_magnet: float  # rad/s2, without the bump's exponential
    jump_drive: float
    edge_width: float  # s


def model_of(p: dict[str, float], frequency: float) -> Model:
    """Build the model from the parameters by name and the drive frequency [Hz]."""
    b1 = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"]
    b2 = p["J2"] + p["e2"] ** 2 * p["m2"]
    n12 = p["m2"] * p["e2"] * p["l1"]
    det = b1 * b2 - n12**2
    omega, phase = TWO_PI * frequency, math.pi / 2 - math.pi * p["duty_cycle"]
    dry1 = p["T1"] + p["mu"] * p["g"] * (p["m1"] + p["m2"])
    dry2 = p["T2"] + p["mu"] * p["g"] * p["m2"]
    return Model(
        **p,
        frequency=frequency,
        inertia1=b1,
        inertia2=b2,
        coupling=n12,
        weight1=p["g"] * (p["m1"] * p["e1"] + p["m2"] * p["l1"]),
        weight2=p["g"] * p["m2"] * p["e2"],
        omega=omega,
        phase=phase,
        bias=-math.sin(phase),
        share=p["m1"] * p["e1"] / (p["m2"] * p["l1"]),
        middle=-0.5 * (p["p1"] + p["p2"]),
        offset=-0.5 * (p["r1"] + p["r2"]),
        jump1=2.0 * dry1 * b2 / det,
        jump2=2.0 * dry2 * (b1 + n12) / det,
        jump_magnet=(abs(p["alpha1"]) + abs(p["alpha2"])) * b2 / det,
        jump_drive=2.0 * p["q"] * b2 / det,
        edge_width=1.0 / (p["eps_drive"] * omega * math.cos(phase)),
    )


@inlined
def wrap(angle: float) -> float:
    return angle - TWO_PI * np.rint(angle / TWO_PI)


@inlined
def drive_torque(t: float, m: Any) -> float:
    wave = math.sin(m.omega * t + m.phase) + m.bias
    return 2.0 / math.pi * m.q * math.atan(m.eps_drive * wave)


@inlined
def dry_friction(v: float, m: Any) -> float:
    return 2.0 / math.pi * math.atan(m.eps * v) * ((1.0 - m.mu0) * math.exp(-m.c0 * abs(v)) + m.mu0)


@inlined
def magnet_torques(psi1: float, psi2: float, s1: float, c1: float, s2: float, c2: float, m: Any) -> Any:
    relative, angle = wrap(psi2 - psi1), wrap(psi1)
    across1 = (relative + m.beta1) / m.gamma1
    across2 = (relative + m.beta2) / m.gamma2
    along1 = (angle + m.p1 * relative + m.r1) / m.c1
    along2 = (angle + m.p2 * relative + m.r2) / m.c2
    f1 = 0.5 * m.alpha1 * math.exp(-across1 * across1 - along1 * along1)
    f2 = 0.5 * m.alpha2 * math.exp(-across2 * across2 - along2 * along2)
    side = 2.0 / math.pi * math.atan(m.eps_mag * (angle - m.middle * relative - m.offset))
    fx = ((f1 - f2) * side + f1 + f2) / m.h
    dx = m.l1 * s1 + m.l2 * s2
    dy = m.h - m.l1 * c1 - m.l2 * c2
    fy = fx * dy * dx / (dx * dx + m.delta * m.delta)
    return m.l1 * (fx * c1 + fy * s1), m.l2 * (fx * c2 + fy * s2)


@inlined
def newton_step(a: Any, free: Any, effect: Any, rest: Any, lever1: Any, lever2: Any, m: Any) -> Any:
    """One step for a = free + effect N(a), with the inverse of 1 - K taken as 1 + K.

    The force on joint 2 is rest + lever1 a1 + lever2 a2, each an (x, y) pair.
    """
    (p11, p12), (p21, p22) = effect
    first = 1.0 + m.share
    x2 = rest[0] + lever1[0] * a[0] + lever2[0] * a[1]
    y2 = rest[1] + lever1[1] * a[0] + lever2[1] * a[1]
    x1 = rest[2] + first * lever1[0] * a[0] + lever2[0] * a[1]
    y1 = rest[3] + first * lever1[1] * a[0] + lever2[1] * a[1]
    n1, n2 = math.sqrt(x1 * x1 + y1 * y1), math.sqrt(x2 * x2 + y2 * y2)
    r1 = free[0] - a[0] + p11 * n1 + p12 * n2
    r2 = free[1] - a[1] + p21 * n1 + p22 * n2
    dx2, dy2 = lever1[0] * r1 + lever2[0] * r2, lever1[1] * r1 + lever2[1] * r2
    dx1 = first * lever1[0] * r1 + lever2[0] * r2
    dy1 = first * lever1[1] * r1 + lever2[1] * r2
    dn1, dn2 = (x1 * dx1 + y1 * dy1) / n1, (x2 * dx2 + y2 * dy2) / n2
    return a[0] + r1 + p11 * dn1 + p12 * dn2, a[1] + r2 + p21 * dn1 + p22 * dn2


@inlined
def rates(t: float, y: np.ndarray, out: np.ndarray, m: Any) -> None:
    """Fill `out` with the time derivative of the state `y`."""
    w1, w2 = y[2], y[3]
    s1, c1, s2, c2 = math.sin(y[0]), math.cos(y[0]), math.sin(y[1]), math.cos(y[1])
    s12, c12 = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2
    q1, q2 = magnet_torques(y[0], y[1], s1, c1, s2, c2, m)
    v2 = w2 - w1
    g1, g2 = dry_friction(w1, m), dry_friction(v2, m)
    joint2 = m.T2 * g2 + m.c * v2
    n = m.coupling
    b1 = drive_torque(t, m) + q1 - n * s12 * w2 * w2 - m.weight1 * s1 - m.T1 * g1 - 2.0 * m.c * w1 + joint2
    b2 = q2 + n * s12 * w1 * w1 - m.weight2 * s2 - joint2
    n = m.coupling * c12
    per_det = 1.0 / (m.inertia1 * m.inertia2 - n * n)
    free = ((m.inertia2 * b1 - n * b2) * per_det, (m.inertia1 * b2 - n * b1) * per_det)
    u1, u2 = m.mu * g1 * per_det, m.mu * g2 * per_det
    effect = ((-m.inertia2 * u1, (m.inertia2 + n) * u2), (n * u1, -(m.inertia1 + n) * u2))
    inner, outer, near = m.m2 * m.l1, m.m2 * m.e2, m.m1 * m.e1
    x2 = -inner * s1 * w1 * w1 - outer * s2 * w2 * w2
    y2 = inner * c1 * w1 * w1 + outer * c2 * w2 * w2 + m.m2 * m.g
    rest = (x2, y2, x2 - near * s1 * w1 * w1, y2 + near * c1 * w1 * w1 + m.m1 * m.g)
    lever1, lever2 = (inner * c1, inner * s1), (outer * c2, outer * s2)
    a = newton_step(free, free, effect, rest, lever1, lever2, m)
    a = newton_step(a, free, effect, rest, lever1, lever2, m)
    out[0], out[1], out[2], out[3] = w1, w2, a[0], a[1]


@inlined
def try_step(t: float, h: float, y: np.ndarray, k: np.ndarray, new: np.ndarray, m: Any) -> None:
    """Fill the slopes k[1:] and the new state; k[0] is given."""
    for i in range(4):
        new[i] = y[i] + h * (A21 * k[0, i])
    rates(t + h / 5, new, k[1], m)
    for i in range(4):
        new[i] = y[i] + h * (A31 * k[0, i] + A32 * k[1, i])
    rates(t + 3 * h / 10, new, k[2], m)
    for i in range(4):
        new[i] = y[i] + h * (A41 * k[0, i] + A42 * k[1, i] + A43 * k[2, i])
    rates(t + 4 * h / 5, new, k[3], m)
    for i in range(4):
        new[i] = y[i] + h * (A51 * k[0, i] + A52 * k[1, i] + A53 * k[2, i] + A54 * k[3, i])
    rates(t + 8 * h / 9, new, k[4], m)
    for i in range(4):
        total = A61 * k[0, i] + A62 * k[1, i] + A63 * k[2, i] + A64 * k[3, i] + A65 * k[4, i]
        new[i] = y[i] + h * total
    rates(t + h, new, k[5], m)
    for i in range(4):
        total = B1 * k[0, i] + B3 * k[2, i] + B4 * k[3, i] + B5 * k[4, i] + B6 * k[5, i]
        new[i] = y[i] + h * total
    rates(t + h, new, k[6], m)


@inlined
def error_norm(h: float, y: np.ndarray, k: np.ndarray, new: np.ndarray, rtol: float, atol: float) -> float:
    """Root mean square of the scaled error estimate."""
    total = 0.0
    for i in range(4):
        e = E1 * k[0, i] + E3 * k[2, i] + E4 * k[3, i] + E5 * k[4, i] + E6 * k[5, i] + E7 * k[6, i]
        e = h * e / (atol + rtol * max(abs(y[i]), abs(new[i])))
        total += e * e
    return math.sqrt(0.25 * total)


@inlined
def step_ratio(room: float) -> float:
    return min(max(room, 1e-30), 1e30) ** (1.0 / 6.0)


@inlined
def hypot_rough(x, y):
    """Hypotenuse to 2.2 %, by two straight lines, as the engine takes it."""
    longer = max(x, y)
    return max(longer, 0.898 * longer + 0.486 * min(x, y))


@inlined
def layer_limit(value: float, rate: float, width: float, jump: float, slack: float) -> float:
    """Longest step beside a layer at value = 0 that `value` nears or leaves at `rate`."""
    speed = abs(rate)
    c = step_ratio(slack * speed / (width * jump))
    if value * rate < 0.0:
        return max(c * abs(value) / (1.0 + c), c * width) / speed
    return c * hypot_rough(abs(value), width) / speed


@inlined
def limited_step(
    wish: float, t: float, start: float, end: float, edge_ratio: float, slack: float, y: Any, dy: Any, m: Any
) -> float:
    """Step of the next attempt in the segment from `start` to `end`."""
    relative, angle = wrap(y[1] - y[0]), wrap(y[0])
    across = (relative + m.beta1) / m.gamma1
    x = angle - m.middle * relative - m.offset
    dx = y[2] - m.middle * (y[3] - y[2])
    h = wish
    h = min(h, layer_limit(y[2], dy[2], 1.0 / m.eps, m.jump1, slack))
    h = min(h, layer_limit(y[3] - y[2], dy[3] - dy[2], 1.0 / m.eps, m.jump2, slack))
    h = min(h, layer_limit(x, dx, 1.0 / m.eps_mag, m.jump_magnet * math.exp(-across * across), slack))
    c, passed, remaining = edge_ratio, t - start, end - t
    h = min(h, c * hypot_rough(passed, m.edge_width))
    h = min(h, max(c / (1.0 + c) * remaining, c * m.edge_width))
    if remaining <= h:
        return remaining
    return 0.5 * remaining if remaining < 2.0 * h else h


@inlined
def limited_wish(wish: float, h: float, error: float, rejected_before: bool) -> float:
    """Step that the error control wants after an attempt."""
    factor = 0.85 * max(error, 1e-10) ** -0.2
    bounded = min(max(factor, 0.2), 5.0)
    if rejected_before:
        bounded = min(bounded, 1.0)
    if error <= 1.0 and h < wish:
        return min(h * factor, max(wish, h * bounded))
    return h * bounded


@inlined
def plain_step(
    wish: float, t: float, start: float, end: float, edge_ratio: float, slack: float, y: Any, dy: Any, m: Any
) -> float:
    return min(wish, end - t)


@inlined
def plain_wish(wish: float, h: float, error: float, rejected_before: bool) -> float:
    """Textbook control; a step cut short by the segment's end does not lower the wish."""
    proposed = h * min(max(0.9 * max(error, 1e-10) ** -0.2, 0.2), 5.0)
    return max(wish, proposed) if error <= 1.0 and h < wish else proposed


CONTROLS = {LIMITED: (limited_step, limited_wish), TEXTBOOK: (plain_step, plain_wish)}


@inlined
def take_section(y: np.ndarray, section: np.ndarray) -> bool:
    """Wrap the angles of `y`, copy it, and return whether an angle changed."""
    changed = False
    for i in range(2):
        if not -math.pi < y[i] <= math.pi:
            y[i] = wrap(y[i])
            changed = True
    section[:] = y
    return changed


@cache
def sections_of(control: str) -> Any:
    """Compile ``run(model, initial, rtol, atol, section, steps)`` for a step control.

    It fills `section` (n, periods, 4) and `steps` (n, 2), accepted and rejected, for the `initial`
    states (n, 4).
    """
    choose, next_wish = CONTROLS[control]

    @njit(**WITHOUT_DOORS)
    def run_segment(
        start: float,
        end: float,
        wish: float,
        y: Any,
        k: Any,
        new: Any,
        m: Any,
        rtol: float,
        atol: float,
        edge_ratio: float,
        steps: Any,
    ) -> float:
        t, rejected = start, False
        slack = SLACK * (rtol + atol)
        while t < end:
            h = choose(wish, t, start, end, edge_ratio, slack, y, k[0], m)
            try_step(t, h, y, k, new, m)
            error = error_norm(h, y, k, new, rtol, atol)
            wish = next_wish(wish, h, error, rejected)
            rejected = not error <= 1.0
            steps[1 if rejected else 0] += 1
            if not rejected:
                y[:] = new
                k[0] = k[6]
                t = t + h if h < end - t else end
        return wish

    @njit(**OPTIONS)
    def run(m: Any, initial: Any, rtol: float, atol: float, section: Any, steps: Any) -> None:
        period = 1.0 / m.frequency
        edge_ratio = step_ratio(SLACK * (rtol + atol) / (m.jump_drive * m.edge_width))
        k, new, y = np.empty((7, 4)), np.empty(4), np.empty(4)
        for n in range(len(initial)):
            y[:] = initial[n]
            wish, fresh = 1e-3 * period, True
            for i in range(section.shape[1]):
                if fresh:
                    rates(0.0, y, k[0], m)
                switch = m.duty_cycle * period
                wish = run_segment(0.0, switch, wish, y, k, new, m, rtol, atol, edge_ratio, steps[n])
                wish = run_segment(switch, period, wish, y, k, new, m, rtol, atol, edge_ratio, steps[n])
                fresh = take_section(y, section[n, i])

    return run


def run_twin(
    control: str, parameters: Any, frequency_hz: float, initial: np.ndarray, n_periods: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sections (n, periods, 4) and steps (n, 2) of the initial states (n, 4)."""
    model = model_of(parameters.as_dict(), float(frequency_hz))
    section = np.empty((len(initial), n_periods, 4))
    steps = np.zeros((len(initial), 2), np.int64)
    sections_of(control)(model, np.ascontiguousarray(initial), tolerance, tolerance, section, steps)
    return section, steps
