"""Judge an atlas by computations of its own: orbits are followed here with numpy and scipy alone.

Each attractor that cells found is followed in small steps to the neighbouring parameter points, from the equations
that a test gives. What becomes of it there is compared with what the atlas says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as tableau

from pipeline.analysis.atlas.ends import GOES_ON
from pipeline.analysis.atlas.plane import plane_of
from pipeline.analysis.atlas.table import audit_of
from pipeline.analysis.events.kinds import LIVES_ON, UNDECIDED
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.runs.derive import AnalysedRun, derive

STEPS, DEPTH = 12, 3
"""Steps along a way, and how often a step that fails is divided into as many."""

GRID = np.linspace(0.0, 1.0, STEPS + 1)

SHARP = 1e-4
"""Share of a way within which a fold of an orbit that shrinks onto one of half its period is that end itself."""

LIVES = GOES_ON, LIVES_ON

UNSURE = "lost", "unstable", "no_orbit"

ORBITS = ("equilibrium", "periodic_orbit")


class Fate(NamedTuple):
    """What becomes of an orbit on its way: `lives_on`, a bifurcation, or `unstable` at its start."""

    what: str
    share: float = 1.0  # of the way
    state: np.ndarray | None = None


class Rest:
    """Equilibria of rates (x, p), which may be complex; p has both parameters."""

    def __init__(self, rates: Callable[[Any, Any], Sequence[Any]], period: int = 1) -> None:
        self.rates = rates

    def period(self, n: int) -> Rest:
        """Return itself."""
        return self

    def start(self, state: np.ndarray) -> np.ndarray:
        """Return the unknowns of an orbit through a state."""
        return state

    def away(self, points: np.ndarray, state: np.ndarray) -> float:
        """Return the distance of a state from the nearest of some points."""
        return float(np.abs(points - state).max(axis=1).min())

    half = None
    kinds = ("fold", "hopf")

    def residual(self, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rates and their derivatives at states (batch, n) and parameters (batch, 2)."""
        return _with_slopes(self.rates, x, p)

    def smooth(self, slopes: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return tests whose zeros are bifurcations, stable or not; of Hopf points in two or three states."""
        n = slopes.shape[-1]
        trace = slopes.trace(axis1=1, axis2=2)
        minors = 0.5 * (trace**2 - (slopes @ slopes).trace(axis1=1, axis2=2))
        return {"fold": np.linalg.det(slopes), "hopf": trace if n < 3 else trace * minors - np.linalg.det(slopes)}

    def critical(self, slopes: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return tests that are positive for stable equilibria: a fold and a Hopf point have zeros."""
        values = np.linalg.eigvals(slopes)
        n = slopes.shape[-1]
        fold = np.linalg.det(slopes) * (-1.0) ** n
        pairs = np.where(np.abs(values.imag) > 1e-12, -values.real, np.inf).min(axis=-1)
        return {"fold": fold, "hopf": np.where(np.isfinite(pairs), pairs, 1.0)}


class Orbits:
    """Orbits of a period of a map, given as a function of states and parameters; returns states and derivatives."""

    kinds = ("fold", "period_doubling", "neimark_sacker")

    def __init__(self, step: Callable[[Any, Any], Any], n: int = 1, is_angle: bool = False) -> None:
        self.step, self.n, self.is_angle = step, n, is_angle

    @classmethod
    def of_map(cls, rule: Callable[[Any, Any], Sequence[Any]], is_angle: bool = False) -> Orbits:
        """Return the orbits of a map of complex numbers."""
        return cls(lambda x, p: _with_slopes(rule, x, p), 1, is_angle)

    def period(self, n: int) -> Orbits:
        """Return the orbits of another period."""
        return Orbits(self.step, n, self.is_angle)

    @property
    def half(self) -> Orbits | None:
        """Orbits of half the period."""
        return Orbits(self.step, self.n // 2, self.is_angle) if self.n % 2 == 0 else None

    def start(self, state: np.ndarray) -> np.ndarray:
        """Return the unknowns of an orbit through a state."""
        return state

    def away(self, points: np.ndarray, state: np.ndarray) -> float:
        """Return the distance of a state from the nearest of some points."""
        return float(np.abs(_wrapped(points - state) if self.is_angle else points - state).max(axis=1).min())

    def residual(self, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much orbits do not close, and its derivatives."""
        end, slopes = x, np.broadcast_to(np.eye(x.shape[-1]), (len(x), x.shape[-1], x.shape[-1]))
        for _ in range(self.n):
            end, one = self.step(end, p)
            slopes = one @ slopes
        away = _wrapped(end - x) if self.is_angle else end - x
        return away, slopes - np.eye(x.shape[-1])

    def smooth(self, slopes: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return tests whose zeros are bifurcations, stable or not; of tori in two states."""
        one = np.eye(slopes.shape[-1])
        det = np.linalg.det
        return {
            "fold": det(slopes),
            "period_doubling": det(slopes + 2.0 * one),
            "neimark_sacker": det(slopes + one) - 1.0,
        }

    def critical(self, slopes: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return tests that are positive for stable orbits."""
        one = np.eye(slopes.shape[-1])
        values = np.linalg.eigvals(slopes + one)
        pairs = np.where(np.abs(values.imag) > 1e-9, 1.0 - np.abs(values), np.inf).min(axis=-1)
        n = slopes.shape[-1]
        return {
            "fold": np.linalg.det(slopes) * (-1.0) ** n,
            "period_doubling": np.linalg.det(slopes + 2.0 * one),
            "neimark_sacker": np.where(np.isfinite(pairs), pairs, 1.0),
        }


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.asarray(np.remainder(angles + np.pi, 2.0 * np.pi) - np.pi)


def periods_of(rates: Callable[[Any, Any, Any], Sequence[Any]], seconds: Callable[[Any], Any], n: int = 40) -> Orbits:
    """Return the orbits of a drive of some seconds, for rates (t, x, p), by steps of the eighth order."""

    return Orbits.of_map(lambda x, p: of_rates(rates, 0.0, seconds(p), x, p, n))


def of_rates(rates: Any, t: float, seconds: Any, x: Any, p: Any, n: int) -> Any:
    """Return states after some seconds, in n steps of the eighth order."""
    h = seconds / n
    x = np.stack(np.broadcast_arrays(*x)).astype(complex)
    for i in range(n):
        x = x + h * _increment(rates, t + i * h, x, p, h)
    return x


def _increment(rates: Any, t: Any, x: Any, p: Any, h: Any) -> Any:
    slopes: list[Any] = []
    for k in range(tableau.N_STAGES):
        at = x + h * sum(a * s for a, s in zip(tableau.A[k, :k], slopes, strict=True) if a) if k else x
        slopes.append(np.stack(np.broadcast_arrays(*rates(t + tableau.C[k] * h, at, p))))
    return sum(b * s for b, s in zip(tableau.B, slopes, strict=True) if b)


def curve_errors(ds: Any, orbits_of: Callable[[str, int], Any], every: int = 1) -> dict[int, float]:
    """Return the largest distance of each curve from the bifurcation as located here, in units of the plane.

    From each of its points the bifurcation is located anew along either parameter; the smaller distance counts.
    """
    from pipeline.analysis.branches.kinds import CURVE_KINDS

    names = ds.attrs["first_parameter"], ds.attrs["second_parameter"]
    found = {}
    span = [np.ptp(ds[f"here_{w}"].values) or 1.0 for w in names]
    for number in range(ds.sizes["curve"]):
        kind, period, n = (
            CURVE_KINDS[int(ds["kind"][number])],
            int(ds["orbit_period"][number]),
            int(ds["n_points"][number]),
        )
        orbits = orbits_of("periodic_orbit" if period else "equilibrium", period)
        if orbits is None or kind not in ("fold", "period_doubling", "neimark_sacker", "hopf"):
            continue
        values = np.stack([ds[w].values[number, :n] for w in names], axis=-1)
        states = np.array([orbits.start(x) for x in ds["section"].values[number, :n]])
        found[number] = distance(orbits, kind, states[::every], values[::every], np.asarray(span))
    return found


def distance(orbits: Any, kind: str, x: np.ndarray, p: np.ndarray, span: np.ndarray) -> float:
    """Return the largest distance of points from a bifurcation, along the nearer of both parameters."""
    away = []
    with np.errstate(all="ignore"):
        for axis in (0, 1):
            there = p.copy()
            there[:, axis] += span[axis]
            _, share, good = critical_points(orbits, kind, x, p, there, np.zeros(len(x)))
            away.append(np.where(good, np.abs(share), np.inf))
    return float(np.min(away, axis=0).max())


def _with_slopes(rule: Callable[[Any, Any], Sequence[Any]], x: np.ndarray, p: np.ndarray) -> tuple[Any, Any]:
    """Return values of a function at states (batch, n), and its derivatives by complex steps."""
    n, h = x.shape[-1], 1e-30
    turned = x[:, None].astype(complex) + 1j * h * np.eye(n)
    out = rule(np.moveaxis(turned, -1, 0), np.moveaxis(np.broadcast_to(p[:, None], (len(x), n, 2)), -1, 0))
    values = np.stack([np.broadcast_to(one, (len(x), n)) for one in out], axis=-1)  # (batch, direction, component)
    return values[:, 0].real, np.swapaxes(values.imag / h, -1, -2)


@dataclass
class Way:
    """An orbit to follow from one point of the plane to another, and the part of the way that is done."""

    orbits: Any
    state: np.ndarray
    here: np.ndarray
    there: np.ndarray
    fate: Fate = Fate("lost", np.nan)
    is_stable: bool = True  # whether its end is that of its stability
    share: float = 0.0
    ahead: list[tuple[np.ndarray, int]] = field(default_factory=lambda: [(GRID, 0)])  # shares to come, and their depths

    def at(self, share: float) -> np.ndarray:
        """Return the parameters at a share of the way."""
        return np.asarray(self.here + share * (self.there - self.here))

    @property
    def place(self) -> np.ndarray:
        """Parameters at which the fate comes."""
        return self.at(self.fate.share)


def _newton(orbits: Any, x: np.ndarray, p: np.ndarray, rounds: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corrected states, whether they are solutions, and derivatives there."""
    x = np.where(np.isfinite(x), x, 0.0)
    for _ in range(rounds):
        value, slopes = orbits.residual(x, p)
        step = _solved(slopes, value)
        x = x - step
        if not (np.abs(step) > 1e-12 * (1.0 + np.abs(x))).any():
            break
    value, slopes = orbits.residual(x, p)
    good = np.isfinite(value).all(axis=1) & (np.abs(value) < 1e-8 * (1.0 + np.abs(x))).all(axis=1)
    return x, good, np.where(np.isfinite(slopes), slopes, 0.0)


def _solved(slopes: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return Newton's steps; 0 where something is not finite."""
    good = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(value).all(axis=1)
    slopes = np.where(good[:, None, None], slopes, np.eye(value.shape[-1])) + 1e-14 * np.eye(value.shape[-1])
    value = np.where(good[:, None], value, 0.0)
    try:
        return np.asarray(np.linalg.solve(slopes, value[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.einsum("bij,bj->bi", np.linalg.pinv(slopes), value)


def critical_points(
    orbits: Any, kind: str, x: np.ndarray, here: np.ndarray, there: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Locate bifurcations of a kind near states and shares of ways; return states, shares, and whether it succeeded."""

    def at(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slopes = orbits.residual(z[:, :-1], here + z[:, -1:] * (there - here))
        return np.append(value, orbits.smooth(slopes, z[:, :-1])[kind][:, None], axis=1), slopes

    z, h = np.append(x, share[:, None], axis=1), 1e-6
    n = z.shape[1]
    for _ in range(12):
        value, _ = at(z)
        columns = [(at(z + h * one)[0] - at(z - h * one)[0]) / (2.0 * h) for one in np.eye(n)]
        step = _solved(np.stack(columns, axis=-1), value)
        z = z - np.clip(step, -1.0, 1.0)
        if not (np.abs(step) > 1e-13).any():
            break
    value, _ = at(z)
    return z[:, :-1], z[:, -1], np.isfinite(value).all(axis=1) & (np.abs(value).max(axis=1) < 1e-8)


def follow(ways: Sequence[Way]) -> None:
    """Follow orbits of one kind along their ways, and write their fates."""
    with np.errstate(all="ignore"):
        ends: list[_Lost] = []
        left = list(ways)
        while left:
            left = _advance(left, ends)
        _name(ends)


class _Lost(NamedTuple):
    way: Way
    low: float
    high: float
    state: np.ndarray
    why: tuple[str, ...]  # tests that changed their signs; none: the orbit is not there any more, or merged


def _advance(ways: Sequence[Way], ends: list[_Lost]) -> list[Way]:
    """Take one part of each way; return those that have parts left."""
    orbits = ways[0].orbits
    longest = max(len(w.ahead[-1][0]) for w in ways)
    shares = np.stack([np.pad(w.ahead[-1][0], (0, longest - len(w.ahead[-1][0])), "edge") for w in ways], axis=1)
    here, there = np.array([w.here for w in ways]), np.array([w.there for w in ways])
    x = np.array([w.state for w in ways], float)
    states, oks, tests, merged = [], [], [], []
    for k, share in enumerate(shares):
        guess = 2.0 * states[-1] - states[-2] if k > 1 else x
        p = here + share[:, None] * (there - here)
        x, good, slopes = _newton(orbits, guess, p)
        states.append(x)
        oks.append(good)
        tests.append(orbits.critical(slopes, x))
        half = orbits.half
        merged.append(np.abs(half.residual(x, p)[0]).max(axis=1) < 1e-7 if half else np.zeros(len(ways), bool))
    left = []
    for i, way in enumerate(ways):
        own = [{name: v[i] for name, v in one.items()} for one in tests]
        if (
            way.share == 0.0
            and len(way.ahead) == 1
            and not (oks[0][i] and (min(own[0].values()) > 0.0 or not way.is_stable))
        ):
            way.fate = Fate("unstable" if oks[0][i] else "no_orbit", 0.0)
            continue
        present = [ok[i] and not half[i] for ok, half in zip(oks, merged, strict=True)]
        if _settle(way, shares[:, i], [x[i] for x in states], present, own, ends):
            left.append(way)
    return left


def _settle(way: Way, shares: Any, states: list, oks: list, tests: list, ends: list[_Lost]) -> bool:
    """Read one part of a way; return whether there is more to follow."""
    depth = way.ahead[-1][1]
    typical = 1e-3 + np.abs(states[0]).max()
    for k in range(1, len(shares)):
        move = np.abs(states[k] - states[k - 1]).max()
        before = np.abs(states[k - 1] - states[k - 2]).max() if k > 1 else np.inf
        jumps = not oks[k] or move > 0.3 * typical or move > 4.0 * before + 0.01 * typical
        why = tuple(name for name, value in tests[k].items() if value <= 0.0) if way.is_stable else ()
        if (jumps or "fold" in why) and depth < DEPTH:
            way.state, way.share = states[k - 1], shares[k - 1]
            way.ahead[-1] = shares[k:], depth
            way.ahead.append((shares[k - 1] + GRID * (shares[k] - shares[k - 1]), depth + 1))
            return True
        if jumps or why:
            ends.append(_Lost(way, shares[k - 1], shares[k], states[k - 1], () if jumps or "fold" in why else why))
            return False
    way.state, way.share = states[-1], shares[-1]
    way.ahead.pop()
    while way.ahead and way.ahead[-1][0][-1] <= way.share:
        way.ahead.pop()
    if not way.ahead:
        way.fate = Fate("lives_on", 1.0, way.state)
    return bool(way.ahead)


def _name(ends: Sequence[_Lost]) -> None:
    """Locate and name the bifurcations at which orbits are lost."""
    if not ends:
        return
    orbits = ends[0].way.orbits
    tried = [(orbits, kind, kind) for kind in orbits.kinds]
    if orbits.half is not None:
        tried.insert(0, (orbits.half, "period_doubling", ""))
    for problem, kind, name in tried:
        own = [one for one in ends if (name in one.why if one.why else name in ("", "fold"))]
        if not own:
            continue
        here, there = (np.array([getattr(one.way, w) for one in own]) for w in ("here", "there"))
        middle = np.array([0.5 * (one.low + one.high) for one in own])
        start = np.array([one.state for one in own])
        if not name:
            start, _, _ = _newton(problem, start, here + middle[:, None] * (there - here))
        x, share, good = critical_points(problem, kind, start, here, there, middle)
        for i, one in enumerate(own):
            width = one.high - one.low
            if not (good[i] and one.low - 3.0 * width <= share[i] <= one.high + 3.0 * width):
                continue
            what = kind
            if kind == "fold" and not _is_fold(problem, x[i], one.way, float(share[i])):
                what = "branch_point"
                half, p = problem.half, one.way.at(float(share[i]))[None]
                if half is not None and np.abs(half.residual(x[i][None], p)[0]).max() < 1e-5:
                    what = "period_doubling"
            if one.way.fate.what == "lost" or share[i] < one.way.fate.share - SHARP:
                one.way.fate = Fate(what, float(share[i]), x[i])
    for one in ends:
        if one.way.fate.what == "lost":
            one.way.fate = Fate("lost", 0.5 * (one.low + one.high), one.state)


def _is_fold(orbits: Any, x: np.ndarray, way: Way, share: float) -> bool:
    """Return whether the residual depends on the parameter at a zero of the determinant, as at no branch point."""
    above, below = (orbits.residual(x[None], way.at(share + d)[None])[0][0] for d in (1e-6, -1e-6))
    left = np.linalg.svd(orbits.residual(x[None], way.at(share)[None])[1][0])[0][:, -1]
    return bool(abs(left @ (above - below)) / 2e-6 > 1e-5)


# ---- comparison --------------------------------------------------------------------------------


@dataclass
class Report:
    """What a check found: the row of the table, and each contradiction in words."""

    row: dict[str, Any]
    wrong: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    n_passing: int = 0  # orbits that are stable at both points, but not between
    n_not_judged: int = 0  # changes of orbits that are not followed here
    away: float = 0.0  # largest distance of a place that is not wrong, in units of the plane
    doubtful: list[str] = field(default_factory=list)  # the judge itself cannot say


KINDS = {"pitchfork": "branch_point", "transcritical": "branch_point", "snic": "fold", "branch_point": "branch_point"}


def judged(source: Any, fate_of: Callable[..., Any], near: float = 1e-6, change: Any = None) -> tuple[Any, Report]:
    """Compare the atlas of a run with orbits that are followed here.

    Parameters
    ----------
    source
        The run.
    fate_of
        Orbits of a kind of attractor and a period.
    near
        Tolerance of places, in units of the plane.
    change
        Function that falsifies the atlas, to see whether it is found out.
    """
    run = AnalysedRun.of(source)
    ds = derive(run, "atlas", {"windows": 0})
    ds = ds if change is None else change(ds)
    names = ds.attrs["first_parameter"], ds.attrs["second_parameter"]
    plane = plane_of(derive(run, "attractors"), names)
    kinds = [SETS[code] for code in plane.kind]
    rows_at: dict[int, list[int]] = {k: [] for k in range(len(plane.values))}
    for row, node in enumerate(plane.node.tolist()):
        rows_at[node].append(row)
    ways: dict[tuple[int, int], Way] = {}
    for a, b in [(int(a), int(b)) for e in plane.edges for a, b in (e, e[::-1])]:
        for row in rows_at[a]:
            orbits = fate_of(kinds[row], int(plane.period[row]), plane.points[row][0], plane.values[a])
            if kinds[row] in ORBITS and orbits is not None:
                ways[row, b] = Way(orbits, orbits.start(plane.points[row][0]), plane.values[a], plane.values[b])
    groups: dict[tuple[str, int], list[Way]] = {}
    for (row, _), way in ways.items():
        groups.setdefault((kinds[row], int(plane.period[row])), []).append(way)
    for own in groups.values():
        follow(own)
    words = np.array(ds["what"].attrs["flag_meanings"].split())[ds["what"].values]
    report, listed, orbit_rows = Report({}), set(), []
    node_of = {tuple(value): node for node, value in enumerate(plane.values.tolist())}
    for k, word in enumerate(words):
        a, b = (node_of[tuple(float(ds[f"{role}_{w}"][k]) for w in names)] for role in ("here", "there"))
        here, there = plane.values[[a, b]]
        (row,) = (one for one in rows_at[a] if plane.attractor[one] == ds["change_attractor"].values[k])
        listed.add((row, b))
        is_orbit = kinds[row] in ORBITS
        orbit_rows.append(is_orbit)
        if word == UNDECIDED or not is_orbit:
            continue
        place, way = np.array([float(ds[f"change_{w}"][k]) for w in names]), ways.get((row, b))
        what = f"{kinds[row]} {plane.period[row]} (id {plane.attractor[row]})"
        text = f"{word} at {place} of {what}, {here} -> {there}"
        if way is None:
            report.n_not_judged += 1
        elif way.fate.what in UNSURE:
            report.doubtful.append(f"{text}; here {way.fate}")
        else:
            error = float(ds["change_error"][k])
            away = float(np.abs(plane.scaled(place) - plane.scaled(way.place)).max())
            good = _is_alike(word, way, rows_at[b], plane.points)
            at_place = word in LIVES or away < max(near, 2.0 * error)
            if not (good and at_place):
                report.wrong.append(f"{text} +- {error:.1e}; here {way.fate.what} at {way.place}")
            elif word not in LIVES:
                report.away = max(report.away, away)
    for (row, there), way in ways.items():
        if (row, there) in listed:
            continue
        text = f"id {plane.attractor[row]} ({kinds[row]}, {plane.period[row]}) {way.here} -> {way.there}"
        if way.fate.what in UNSURE:
            report.doubtful.append(f"no change of {text}; here {way.fate}")
            continue
        there_is = [r for r in rows_at[there] if plane.attractor[r] == plane.attractor[row]]
        if way.fate.what not in ("lives_on", "fold", "branch_point"):
            again = Way(way.orbits, way.state, way.here, way.there, is_stable=False)
            follow([again])
            if again.fate.what == "lives_on" and _is_met(again, there_is, plane.points):
                report.n_passing += 1  # stable at both points, unstable between: cells cannot see it
                continue
        if way.fate.what != "lives_on":
            report.missing.append(f"{text}: here {way.fate.what} at {way.place}")
        elif not _is_met(way, there_is, plane.points):
            report.missing.append(f"{text}: another orbit has its id")
    is_set = ~np.array(orbit_rows, bool)
    report.row = {
        "points": len(plane.values),
        **audit_of(ds),
        "of_sets": int(is_set.sum()),
        "orbits_not_explained": int((~is_set & (words == UNDECIDED)).sum()),
        "goes_on": int((words == GOES_ON).sum()),
        "wrong": len(report.wrong),
        "missing": len(report.missing),
        "doubtful": len(report.doubtful),
        "passing": report.n_passing,
        "not_judged": report.n_not_judged,
        "place": report.away,
    }
    return ds, report


def _is_met(way: Way, rows: Sequence[int], points: Sequence[np.ndarray]) -> bool:
    return any(way.orbits.away(points[row], way.fate.state) < 1e-3 for row in rows)


def _is_alike(word: str, way: Way, rows: Sequence[int], points: Sequence[np.ndarray]) -> bool:
    """Return whether a verdict names what became of an orbit here."""
    if way.fate.what == "lives_on":
        return bool(word == (GOES_ON if _is_met(way, rows, points) else LIVES_ON))
    return KINDS.get(word, word) == KINDS.get(way.fate.what, way.fate.what)
