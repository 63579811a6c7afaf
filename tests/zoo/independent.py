"""Answers of the zoo, computed without magpend: equations by sympy, orbits by scipy, statistics by RK4.

``python -m tests.zoo.independent NAME ...`` recomputes each number of an answer that such a computation can
give (all names by default) and prints it beside the answer. Systems with impacts or dry friction are
integrated by `tests.zoo.nonsmooth`, from event to event.

Orbits and limit cycles are solved by Newton's method on trajectories of DOP853 at a tolerance of 1e-12;
exponents and basin fractions come from the classical Runge-Kutta method with a fixed step.
"""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numba
import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp

HERE = Path(__file__).parent
SYSTEMS = HERE / "systems"
LIBRARY = HERE.parents[1] / "magpend_core" / "models" / "library"

NONSMOOTH = (
    "ball-on-shaken-table",
    "belt-stick",
    "coulomb-forced",
    "coulomb-free",
    "impact-beside-free",
    "impact-one",
    "kicked-rotor",
)
"""Systems whose equations jump."""

DUFFING = {
    "states": {"x": {}, "v": {}},
    "parameters": {"damping": 0.2, "linear": -1.0, "cubic": 1.0, "amplitude": 0.3},
    "equations": {"x": "v", "v": "amplitude*cos(2*pi*f*t) - damping*v - linear*x - cubic*x**3"},
}
"""The model `duffing`, which ships as Python; here from its docstring."""


def model_of(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return the text of a specification's model."""
    model = spec["model"]
    if not isinstance(model, str):
        return model
    if model == "duffing":
        return DUFFING
    path = SYSTEMS / model if model.endswith(".toml") else LIBRARY / f"{model}.toml"
    return tomllib.loads(path.read_text("utf-8"))


@dataclass(frozen=True)
class Field:
    """A system's right-hand side with the values of its parameters, from its text.

    Attributes
    ----------
    names : tuple of str
        Of the states.
    circle : tuple of bool
        Which states are angles on a circle.
    period : float
        Of the drive [s]; NaN for a flow.
    rates : list
        Expressions of `t` and the states, by sympy.
    symbols : list
        Of the states.
    sizes, time : tuple of float and float
        Units of the states and of time [s] in which all is computed.
    """

    names: tuple[str, ...]
    circle: tuple[bool, ...]
    period: float
    rates: list[Any]
    symbols: list[Any]
    sizes: tuple[float, ...]
    time: float = 1.0

    @classmethod
    def of(
        cls,
        spec: Mapping[str, Any],
        where: Mapping[str, float] | None = None,
        sizes: Sequence[float] = (),
        time: float = 1.0,
    ) -> Field:
        """Field of a specification at a parameter point, in units of its own."""
        model, given = model_of(spec), spec.get("parameters", {})
        values = {k: v["value"] if isinstance(v, dict) else v for k, v in model.get("parameters", {}).items()}
        values |= model.get("presets", {}).get(given.get("preset", ""), {})
        values |= given.get("overrides", {}) | dict(where or {})
        frequency = values.pop("frequency_hz", given.get("frequency_hz"))
        names = tuple(model["states"])
        t = sp.Symbol("t", real=True)
        known: dict[str, Any] = {n: sp.Symbol(n, real=True) for n in (*names, *model.get("define", {}))}
        known |= {"t": t, "pi": sp.pi, "abs": sp.Abs, "f": sp.Float(frequency or 0.0, 17)}
        known |= {k: sp.Float(v, 17) for k, v in values.items() if not isinstance(v, str)}
        parts = {known[k]: sp.sympify(text, locals=known) for k, text in model.get("define", {}).items()}
        rates = [sp.sympify(model["equations"][n], locals=known) for n in names]
        for _ in parts:
            rates = [r.subs(parts) for r in rates]
        circle = tuple(bool(dict(s or {}).get("on_circle")) for s in model["states"].values())
        forced = any(r.has(t) for r in rates) or frequency
        period = 1.0 / (frequency * time) if forced else math.nan
        symbols, sizes = [known[n] for n in names], tuple(sizes) or (1.0,) * len(names)
        if time != 1.0 or any(size != 1.0 for size in sizes):
            units = {t: time * t} | {s: size * s for s, size in zip(symbols, sizes, strict=True)}
            rates = [r.subs(units, simultaneous=True) * time / size for r, size in zip(rates, sizes, strict=True)]
        return cls(names, circle, period, [sp.N(r, 17) for r in rates], symbols, sizes, time)

    @cached_property
    def jacobian(self) -> list[Any]:
        """Entries of the Jacobian, row by row."""
        return [sp.diff(r, s) for r in self.rates for s in self.symbols]

    @cached_property
    def f(self) -> Any:
        """Compiled ``f(t, y, out)``."""
        return _compiled(self.rates, self.symbols)

    @cached_property
    def df(self) -> Any:
        """Compiled ``df(t, y, out)``, the Jacobian in a row."""
        return _compiled(self.jacobian, self.symbols)

    def at(self, t: float, y: np.ndarray) -> np.ndarray:
        """Rates at a state."""
        out = np.empty(len(self.names))
        self.f(t, y, out)
        return out

    def slope(self, t: float, y: np.ndarray) -> np.ndarray:
        """Jacobian at a state."""
        out = np.empty(len(self.names) ** 2)
        self.df(t, y, out)
        return out.reshape(len(self.names), -1)

    def tangent(self, t: float, z: np.ndarray) -> np.ndarray:
        """Rates of a state and its variational matrix, in a row."""
        n = len(self.names)
        m = z[n:].reshape(n, n)
        return np.concatenate([self.at(t, z[:n]), (self.slope(t, z[:n]) @ m).ravel()])

    def folded(self, away: np.ndarray) -> np.ndarray:
        """Differences of states, angles on their circle."""
        return np.where(self.circle, away - 2 * np.pi * np.round(away / (2 * np.pi)), away)


def _compiled(expressions: list[Any], symbols: list[Any]) -> Any:
    """Compile expressions of t and y into a function that fills an array."""
    parts, last = sp.cse(expressions)
    lines = [f"    {s} = given_[{i}]" for i, s in enumerate(symbols)]
    lines += [f"    {s} = {sp.pycode(e)}" for s, e in parts]
    lines += [f"    out_[{i}] = {sp.pycode(e)}" for i, e in enumerate(last)]
    scope: dict[str, Any] = {"math": math}
    exec("def fill(t, given_, out_):\n" + "\n".join(lines), scope)
    return numba.njit(scope["fill"])


# ---- orbits ------------------------------------------------------------------------------------


def _flown(field: Field, y: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """State and variational matrix after a time."""
    n = len(y)
    start = np.concatenate([y, np.eye(n).ravel()])
    z = solve_ivp(field.tangent, (0.0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return z[:n], z[n:].reshape(n, n)


def orbit(field: Field, y: np.ndarray, n_periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Orbit of a forced system by Newton's method: its point at the drive's phase 0, its multipliers."""
    y = np.array(y, float)
    for _ in range(30):
        end, m = _flown(field, y, n_periods * field.period)
        step = np.linalg.solve(m - np.eye(len(y)), -field.folded(end - y))
        y = y + step
        if np.abs(step).max() < 1e-11:
            return y, np.linalg.eigvals(_flown(field, y, n_periods * field.period)[1])
    raise RuntimeError("Newton's method did not converge.")


def cycle(field: Field, y: np.ndarray, seconds: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Limit cycle by Newton's method: a point of it, its period [s], its multipliers but that of the flow."""
    y = np.array(y, float)
    n = len(y)
    for _ in range(40):
        end, m = _flown(field, y, seconds)
        rate = field.at(0.0, y)
        a = np.zeros((n + 1, n + 1))
        a[:n, :n], a[:n, n], a[n, :n] = m - np.eye(n), field.at(0.0, end), rate
        step = np.linalg.solve(a, -np.append(field.folded(end - y), 0.0))
        y, seconds = y + step[:n], seconds + step[n]
        if np.abs(step).max() < 1e-10:
            values = np.linalg.eigvals(_flown(field, y, seconds)[1])
            return y, seconds, np.delete(values, np.abs(values - 1.0).argmin())
    raise RuntimeError("Newton's method did not converge.")


def equilibrium(field: Field, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equilibrium of a flow by Newton's method, and its eigenvalues by falling real part."""
    y = np.array(y, float)
    for _ in range(50):
        step = np.linalg.lstsq(field.slope(0.0, y), -field.at(0.0, y), rcond=None)[0]
        y = y + step
        if np.abs(step).max() < 1e-13:
            break
    values = np.linalg.eigvals(field.slope(0.0, y))
    return y, values[np.argsort(-values.real)]


# ---- many trajectories -------------------------------------------------------------------------


@numba.njit
def _step(f, t, y, h, k, z):
    """Advance a state by one step of the classical Runge-Kutta method."""
    n = len(y)
    f(t, y, k[0])
    for i in range(n):
        z[i] = y[i] + 0.5 * h * k[0, i]
    f(t + 0.5 * h, z, k[1])
    for i in range(n):
        z[i] = y[i] + 0.5 * h * k[1, i]
    f(t + 0.5 * h, z, k[2])
    for i in range(n):
        z[i] = y[i] + h * k[2, i]
    f(t + h, z, k[3])
    for i in range(n):
        y[i] += h / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])


@numba.njit
def strobed(f, starts, period, n_steps, n_skip, n_keep):
    """States at every period, shape (start, n_keep, state), after the first `n_skip` periods."""
    n, d = starts.shape
    out = np.empty((n, n_keep, d))
    k, z = np.empty((4, d)), np.empty(d)
    h = period / n_steps
    for i in range(n):
        y = starts[i].copy()
        for j in range(n_skip + n_keep):
            for s in range(n_steps):
                _step(f, s * h, y, h, k, z)
            if not np.abs(y).max() < 1e8:
                y[:] = np.inf
                out[i] = np.inf
                break
            if j >= n_skip:
                out[i, j - n_skip] = y
    return out


@numba.njit
def _exponents(f, df, y, period, n_steps, n_skip, n_periods, n_exponents):
    """Sums of the logarithms of growth per period, shape (n_periods, n_exponents)."""
    d = len(y)
    h = period / n_steps
    k, z, a = np.empty((4, d)), np.empty(d), np.empty(d * d)
    q = np.eye(d)[:, :n_exponents].copy()
    out = np.zeros((n_periods, n_exponents))
    old = np.empty(d)
    for j in range(n_skip + n_periods):
        for s in range(n_steps):
            old[:] = y
            _step(f, s * h, y, h, k, z)
            # the tangents by the same method; the middle state by Hermite's interpolation
            df(s * h, old, a)
            a0 = a.copy().reshape(d, d)
            f(s * h, old, k[0])
            f(s * h + h, y, k[1])
            for i in range(d):
                z[i] = 0.5 * (old[i] + y[i]) + h / 8.0 * (k[0, i] - k[1, i])
            df(s * h + 0.5 * h, z, a)
            a1 = a.copy().reshape(d, d)
            df(s * h + h, y, a)
            a2 = a.copy().reshape(d, d)
            q1 = a0 @ q
            q2 = a1 @ (q + 0.5 * h * q1)
            q3 = a1 @ (q + 0.5 * h * q2)
            q4 = a2 @ (q + h * q3)
            q = q + h / 6.0 * (q1 + 2.0 * (q2 + q3) + q4)
        for i in range(n_exponents):  # Gram-Schmidt
            for m in range(i):
                q[:, i] -= (q[:, m] @ q[:, i]) * q[:, m]
            norm = np.sqrt(q[:, i] @ q[:, i])
            q[:, i] /= norm
            if j >= n_skip:
                out[j - n_skip, i] = np.log(norm)
    return out


def exponents(
    field: Field, y: np.ndarray, n_periods: int, n_steps: int = 200, n_exponents: int = 0, unit: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Lyapunov exponents [1/s] of the attractor that a start leads to, and their standard errors (20 blocks).

    A flow is looked at once per `unit` seconds.
    """
    period = field.period if np.isfinite(field.period) else unit
    y = np.array(y, float)
    k = n_exponents or len(y)
    grown = _exponents(field.f, field.df, y, period, n_steps, n_periods // 5, n_periods, k) / period
    blocks = grown[: n_periods // 20 * 20].reshape(20, -1, k).mean(axis=1)
    return grown.mean(axis=0), blocks.std(axis=0, ddof=1) / math.sqrt(20)


# ---- answers -----------------------------------------------------------------------------------


def read(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a system's specification and its answer."""
    texts = [(SYSTEMS / f"{name}{end}").read_text("utf-8") for end in (".toml", ".answer.toml")]
    return tomllib.loads(texts[0]), tomllib.loads(texts[1])


def crossings(field: Field, y: np.ndarray, seconds: float, section: Mapping[str, Any]) -> int:
    """Times that a limit cycle passes the section in its direction per turn."""
    i, sign = field.names.index(section["of"]), -1.0 if section.get("direction") == "down" else 1.0
    times = np.linspace(0.37 * seconds, 1.37 * seconds, 20_001)  # not from the section itself
    run = solve_ivp(field.at, (0.0, times[-1]), y, method="DOP853", rtol=1e-10, atol=1e-12, t_eval=times).y[i]
    value = section["value"] / field.sizes[i]
    side = np.sin(0.5 * (run - value)) if field.circle[i] else run - value
    side, slope = sign * side, sign * np.diff(run)
    return int(np.count_nonzero((side[:-1] * side[1:] <= 0) & (side[:-1] != 0) & (slope > 0)))


def numbers(field: Field, known: Mapping[str, Any], section: Mapping[str, Any] | None) -> dict[str, Any]:
    """Compute what can be computed of one set of an answer, from its point `at`."""
    sizes, time = np.array(field.sizes), field.time
    at, kind = np.array(known["at"], float) / sizes, known["kind"]
    if kind == "equilibrium":
        at, values = equilibrium(field, at)
        return {"at": at * sizes, "eigenvalue": [float(values[0].real / time), float(abs(values[0].imag) / time)]}
    if kind == "periodic_orbit" and "seconds" not in known:
        at, values = orbit(field, at, known["period"])
        return {"at": at * sizes, "multiplier": float(np.abs(values).max())}
    if kind == "periodic_orbit":
        at, seconds, values = cycle(field, at, known["seconds"] / time)
        found = {"at": at * sizes, "seconds": seconds * time, "multiplier": float(np.abs(values).max(initial=0.0))}
        return found | ({"period": crossings(field, at, seconds, section)} if section else {})
    n = int(known.get("n_periods", 4000))
    rates, errors = exponents(
        field, at, n, int(known.get("n_steps", 200)), min(len(at), 2), float(known.get("unit", 1.0))
    )
    first = int(np.argmax(rates))
    return {"lyapunov": float(rates[first] / time), "error": float(errors[first] / time), "all": rates / time}


def box(spec: Mapping[str, Any], field: Field) -> np.ndarray:
    """Bounds of the starts of a specification, shape (2, state)."""
    given = spec["initial_conditions"]
    sides = []
    for name in field.names:
        side = given[name]
        if isinstance(side, dict):  # a grid's points stand in the middle of equal parts
            half = 0.5 * (side["stop"] - side["start"]) / (side["num"] - 1)
            side = [side["start"] - half, side["stop"] + half]
        sides.append(side if isinstance(side, list) else [side, side])
    return np.array(sides).T / field.sizes


def cloud(field: Field, known: Mapping[str, Any], n: int = 4000) -> np.ndarray:
    """Points of a set: all phases of a flow's, those at phase 0 of a forced one's."""
    y = np.array([known["at"]], float) / field.sizes
    if known["kind"] == "equilibrium":
        return y
    if np.isfinite(field.period):
        return strobed(field.f, y, field.period, 400, 0 if known["kind"] == "periodic_orbit" else 200, n)[0]
    step = known["seconds"] / field.time / n if known["kind"] == "periodic_orbit" else 0.05
    return strobed(field.f, y, step, 4, 0 if known["kind"] == "periodic_orbit" else 2000, 8 * n)[0]


def shares(
    spec: Mapping[str, Any],
    field: Field,
    sets: list[dict[str, Any]],
    n: int = 1000,
    n_periods: int = 400,
    n_steps: int = 100,
) -> tuple[np.ndarray, float]:
    """Fractions of random starts that end nearest to each set, and the distance that 99 % keep within."""
    from scipy.spatial import cKDTree

    low, high = box(spec, field)
    starts = np.random.default_rng(12345).uniform(low, high, (n, len(low)))
    period = field.period if np.isfinite(field.period) else 1.0
    end = strobed(field.f, starts, period, n_steps, n_periods, 1)[:, 0]
    end = end[np.isfinite(end).all(axis=1)]

    def spread(points: np.ndarray) -> np.ndarray:
        angles = [np.cos(points[:, i]) if c else points[:, i] for i, c in enumerate(field.circle)]
        angles += [np.sin(points[:, i]) for i, c in enumerate(field.circle) if c]
        return np.stack(angles, axis=1)

    distances = np.stack([cKDTree(spread(cloud(field, s))).query(spread(end))[0] for s in sets], axis=1)
    nearest = np.bincount(distances.argmin(axis=1), minlength=len(sets)) / len(end)
    return nearest, float(np.quantile(distances.min(axis=1), 0.99))


def _line(what: str, said: Any, found: Any, error: float) -> None:
    """Print a number of an answer beside the one found here."""
    worst = max(abs(a - b) for a, b in zip(np.atleast_1d(said), np.atleast_1d(found), strict=False))
    print(f"    {what:12s} {said!s:24s} {found!s:24s}{'' if worst <= error else '   <-- DIFFERS'}")


def recompute(name: str) -> None:
    """Print each number of an answer beside what this module finds."""
    spec, answer = read(name)
    if name in NONSMOOTH:
        print(f"{name}: see python -m tests.zoo.nonsmooth")
        return
    section = spec.get("section")
    section = {"value": 0.0, **section} if section else None
    points: dict[str, list[dict[str, Any]]] = {}
    for known in answer.get("set", []):
        points.setdefault(str(known.get("where", {})), []).append(known)
    for sets in points.values():
        where = sets[0].get("where", {})
        values = {"frequency_hz" if k == "frequency" else k: v for k, v in where.items()}
        field = Field.of(spec, values, answer.get("sizes", ()), answer.get("time", 1.0))
        print(f"{name} {where or ''}")
        # Newton's method has no unique step at a multiplier of 1
        sets = [s for s in sets if "at" in s and s.get("multiplier") != 1.0]
        for known in sets:
            found = numbers(field, known, section)
            print(f"  {known['kind']} at {np.round(found.get('at', known['at']), 8).tolist()}")
            for key in {"multiplier", "seconds", "period", "lyapunov", "eigenvalue"} & known.keys() & found.keys():
                error = known["lyapunov_error"] if key == "lyapunov" else 1e-6 + 1e-6 * np.max(np.abs(found[key]))
                _line(key, known[key], found[key], error)
        sets = [s for s in sets if s.get("stability", "attracts") == "attracts"]
        if any("share" in s for s in sets):
            found_shares, within = shares(spec, field, sets, **answer.get("sample", {}))
            for known, share in zip(sets, found_shares, strict=True):
                _line("share", known["share"], float(share), 0.03)
            print(f"    (99 % of the starts end within {within:.2e} of a set)")


if __name__ == "__main__":
    every = sorted(p.name.removesuffix(".answer.toml") for p in SYSTEMS.glob("*.answer.toml"))
    for each in sys.argv[1:] or every:
        recompute(each)
