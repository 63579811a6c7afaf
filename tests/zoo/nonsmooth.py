"""Answers of the systems with impacts and with dry friction, from event to event.

Between events the equations are linear, or are integrated by DOP853; the instants of impact, of sticking and
of slipping are roots. Orbits are fixed points of the stroboscopic or return map, whose derivative is taken by
differences. ``python -m tests.zoo.nonsmooth`` prints all numbers; `impact_one` has the one in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

TWO_PI = 2.0 * math.pi


# ---- a stop ------------------------------------------------------------------------------------


def linear_motion(t0: float, x0: float, v0: float, w: float, amplitude: float, zeta: float) -> Callable:
    """Motion of x'' + 2 zeta x' + x = amplitude cos(w t) from a state, in closed form: t -> (x, v)."""
    d = (1.0 - w * w) ** 2 + (2.0 * zeta * w) ** 2
    c, s = amplitude * (1.0 - w * w) / d, amplitude * 2.0 * zeta * w / d
    q = math.sqrt(1.0 - zeta * zeta)
    a = x0 - c * math.cos(w * t0) - s * math.sin(w * t0)
    u = v0 + w * (c * math.sin(w * t0) - s * math.cos(w * t0))
    b = (u + zeta * a) / q

    def motion(t: float | np.ndarray) -> tuple:
        e, co, si = np.exp(-zeta * (t - t0)), np.cos(q * (t - t0)), np.sin(q * (t - t0))
        x = e * (a * co + b * si) + c * np.cos(w * t) + s * np.sin(w * t)
        v = e * ((b * q - zeta * a) * co - (a * q + zeta * b) * si) - w * (c * np.sin(w * t) - s * np.cos(w * t))
        return x, v

    return motion


def impact_map(state, w: float, amplitude: float, zeta: float, gap: float, r: float, n: int = 1) -> tuple:
    """State after n periods of the drive, and the number of impacts."""
    x, v = state
    t, end, hits = 0.0, n * TWO_PI / w, 0
    while True:
        motion = linear_motion(t, x, v, w, amplitude, zeta)
        if end - t < 1e-9:
            return np.array(motion(end)), hits
        # close to an impact the next may follow soon
        after = t + np.geomspace(1e-9, end - t, 60)
        grid = np.unique(np.append(after, np.linspace(t, end, max(8, int((end - t) * w * 100)))[1:]))
        side = motion(grid)[0] - gap
        up = np.flatnonzero((side[:-1] < 0.0) & (side[1:] >= 0.0))
        if not len(up):
            return np.array(motion(end)), hits
        i = up[0]
        t = brentq(lambda s, m=motion: float(m(s)[0]) - gap, grid[i], grid[i + 1], xtol=1e-15, rtol=1e-14)
        x, v = gap, -r * float(motion(t)[1])
        hits += 1
        if hits > 1000 * n:
            raise RuntimeError("Chatter.")


def multipliers_of(fixed: Callable, point: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Moduli of the eigenvalues of a map's derivative, by central differences."""
    columns = [(fixed(point + h * e) - fixed(point - h * e)) / (2.0 * h) for e in np.eye(len(point))]
    return np.abs(np.linalg.eigvals(np.stack(columns, axis=1)))


def impact_one(w: float, amplitude: float, zeta: float, gap: float, r: float) -> tuple[float, float, float]:
    """Period-1 orbit with one impact: phase and velocity of the impact and multipliers' product.

    The motion that starts at the stop with -r v returns to it one period later with v: two equations for the
    phase and v. Each impact multiplies areas by r^2, the damping by exp(-2 zeta T).
    """
    period = TWO_PI / w

    def residual(z: np.ndarray) -> list[float]:
        x, v = linear_motion(z[0], gap, -r * z[1], w, amplitude, zeta)(z[0] + period)
        return [float(x) - gap, float(v) - z[1]]

    best = [
        fsolve(residual, [p, u], full_output=True, xtol=1e-13)
        for p in np.linspace(0, period, 9)
        for u in (0.3, 1.0, 2.0)
    ]
    found = [tuple(z) for z, _, ok, _ in best if ok == 1 and z[1] > 0.0]
    return *found[0], r * r * math.exp(-2.0 * zeta * period)


# ---- dry friction ------------------------------------------------------------------------------


def coulomb_map(state, w: float, amplitude: float, mu: float) -> tuple[np.ndarray, int]:
    """State of x'' + x + mu sign(x') = amplitude cos(w t) after a period, and the number of stops."""
    x, v = state
    t, end, stops = 0.0, TWO_PI / w, 0
    while t < end - 1e-13:
        push = amplitude * math.cos(w * t) - x
        if abs(v) < 1e-13 and abs(push) <= mu:  # sticks until the push exceeds the friction
            stops += 1
            grid = np.linspace(t, end, 4000)
            over = np.abs(amplitude * np.cos(w * grid) - x) - mu
            first = np.flatnonzero((over[:-1] <= 0.0) & (over[1:] > 0.0))
            if not len(first):
                return np.array([x, 0.0]), stops
            i = first[0]
            t = brentq(lambda s, x=x: abs(amplitude * math.cos(w * s) - x) - mu, grid[i], grid[i + 1], xtol=1e-15)
            t, v = t + 1e-12, 0.0
            push = amplitude * math.cos(w * t) - x
        sign = math.copysign(1.0, v if abs(v) >= 1e-13 else push)
        motion = linear_motion(t, x + sign * mu, v, w, amplitude, 0.0)
        grid = np.linspace(t, end, max(8, int((end - t) * w * 400)))
        speed = sign * motion(grid)[1]
        turn = np.flatnonzero((speed[1:-1] > 0.0) & (speed[2:] <= 0.0)) + 1
        if not len(turn):
            x, v = (float(s) for s in motion(end))
            return np.array([x - sign * mu, v]), stops
        i = turn[0]
        t = brentq(lambda s, m=motion: float(m(s)[1]), grid[i], grid[i + 1], xtol=1e-15, rtol=1e-14)
        x, v = float(motion(t)[0]) - sign * mu, 0.0
    return np.array([x, v]), stops


# ---- a belt ------------------------------------------------------------------------------------

BELT = {"belt": 1.5, "zeta": 0.05, "mu": 0.5, "ratio": 2.0, "v0": 0.5}


def _friction(u: float) -> float:
    p = BELT
    return math.copysign(p["mu"] * (1.0 + (p["ratio"] - 1.0) * math.exp(-abs(u) / p["v0"])), u)


def belt_motion(x: float, v: float, seconds: float) -> tuple[np.ndarray, list[float]]:
    """State of the mass on the belt after some seconds, and the instants at which v rises through 0."""
    belt, zeta, most = BELT["belt"], BELT["zeta"], BELT["mu"] * BELT["ratio"]
    t, ups = 0.0, []
    while t < seconds:
        hold = x + 2.0 * zeta * belt
        if abs(v - belt) < 1e-12 and abs(hold) <= most:  # sticks until the spring is as strong as friction
            leave = t + (most - hold) / belt
            stop = min(leave, seconds)
            x, v, t = x + belt * (stop - t), belt, stop
            if stop == seconds:
                break
            v -= 1e-9
        side = math.copysign(1.0, belt - v)

        def rates(_, y, side=side):
            return [y[1], side * abs(_friction(belt - y[1])) - y[0] - 2.0 * zeta * y[1]]

        def meets(_, y, side=side):
            return side * (belt - y[1])

        meets.terminal, meets.direction = True, -1.0
        rises = lambda _, y: y[1]  # noqa: E731
        rises.direction = 1.0
        run = solve_ivp(rates, (t, seconds), [x, v], events=[meets, rises], rtol=1e-10, atol=1e-12, method="DOP853")
        ups += list(run.t_events[1])
        t = run.t[-1]
        x, v = run.y[:, -1]
        if len(run.t_events[0]):
            v = belt
    return np.array([x, v]), ups


def belt_cycle() -> tuple[float, float]:
    """Period of stick and slip [s], and the displacement at which the mass begins to stick.

    Each turn begins where the spring overcomes the largest friction; so the multiplier is 0.
    """
    belt, zeta, most = BELT["belt"], BELT["zeta"], BELT["mu"] * BELT["ratio"]
    leave = most - 2.0 * zeta * belt

    def rates(_, y):
        return [y[1], abs(_friction(belt - y[1])) - y[0] - 2.0 * zeta * y[1]]

    def meets(t, y):
        return belt - y[1] if t > 1.0 else 1.0

    meets.terminal, meets.direction = True, -1.0
    run = solve_ivp(rates, (0.0, 50.0), [leave, belt], events=meets, rtol=1e-13, atol=1e-14, method="DOP853")
    return run.t[-1] + (leave - run.y[0, -1]) / belt, float(run.y[0, -1])


def report() -> None:
    """Print the numbers of all systems of this module."""
    for name, n, p in (
        ("impact-one", 10, {"w": 2.5, "amplitude": 1.0, "zeta": 0.1, "gap": 0.0, "r": 0.6}),
        ("impact-beside-free", 200, {"w": 1.5, "amplitude": 0.5, "zeta": 0.05, "gap": 0.6, "r": 0.8}),
    ):
        print(name, _census(lambda s, p=p: impact_map(s, **p)[0], [-2.0, -2.0], [p["gap"] - 0.05, 2.0], n))
    print("impact-one in closed form: phase, velocity, product", impact_one(2.5, 1.0, 0.1, 0.0, 0.6))
    for w in (0.7, 1.6):
        print("coulomb", w, _census(lambda s, w=w: coulomb_map(s, w, 1.0, 0.2)[0], [-2.0, -2.0], [2.0, 2.0], 20))
    rng = np.random.default_rng(1)
    ends = [belt_motion(*s, 150.0) for s in rng.uniform([-1.0, -2.0], [3.0, 2.0], (200, 2))]
    rest = _friction(BELT["belt"])
    print("belt: rest at", rest, "share", np.mean([abs(e[0][0] - rest) < 0.05 for e in ends]))
    print(
        "belt: period of the cycle",
        belt_cycle(),
        {round(float(np.diff(u)[-1]), 5) for _, u in ends if len(u) and u[-1] > 130.0},
    )


def _census(fixed: Callable, low: list[float], high: list[float], n: int = 60, n_periods: int = 150) -> list:
    """Orbits of period 1, 2, 3, 4 that random starts end on: point, period, share, multipliers."""
    found: dict[tuple, int] = {}
    for start in np.random.default_rng(0).uniform(low, high, (n, 2)):
        y = start
        for _ in range(n_periods):
            y = fixed(y)
        points = [y]
        for _ in range(8):
            points.append(fixed(points[-1]))
        period = next((k for k in range(1, 9) if np.abs(points[k] - y).max() < 1e-7), 0)
        key = (period, *np.round(min((tuple(q) for q in points[:period]), default=(0.0, 0.0)), 6).tolist())
        found[key] = found.get(key, 0) + 1
    lines = []
    for (period, *point), count in sorted(found.items()):

        def power(y, period=period):
            for _ in range(period):
                y = fixed(y)
            return y

        moduli = multipliers_of(power, np.array(point)) if period else []
        lines.append((period, point, count / n, np.round(moduli, 7).tolist()))
    return lines


if __name__ == "__main__":
    report()
