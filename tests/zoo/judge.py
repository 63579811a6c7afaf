"""Judge the rows of a table of attractors against a known answer.

Right is a point where each row is right. A row that says 'not_settled' is allowed, and counted. An
attracting torus or chaotic set that is listed as an attracting 'bounded_set' has an *undecided kind*:
allowed, and counted apart. Wrong is

* a row with 'attracts' that is none of the attractors, or the second row of one attractor;
* any other row that says of an attractor what is not true of it, or a stability that nothing there has;
* numbers of a row that contradict its stability;
* an attractor without a row where nothing is left open and the starts could not all miss it;
* a basin fraction or a lifetime whose interval excludes the known value.

An interval of 95 % is taken twice as wide: some 600 settings are judged, and 5 % of them must not fail.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from tests.zoo.answers import ATTRACTS, Answer, Known

Row = Mapping[str, Any]

UNDECIDED = ("torus", "chaotic_set")
"""Kinds that an attracting bounded set may turn out to be."""

CHANCE = 1e-3
"""Chance that all starts miss a basin, below which its attractor must be listed."""


@dataclass
class Verdict:
    """What is to be said of a run.

    Attributes
    ----------
    wrong : list of str
        Reasons; empty if nothing is wrong.
    n_right, n_open, n_undecided : int
        Sets listed as they are, those not settled (rows, and cells without a set), those of undecided kind.
    """

    wrong: list[str] = field(default_factory=list)
    n_right: int = 0
    n_open: int = 0
    n_undecided: int = 0

    @property
    def word(self) -> str:
        """Verdict in a word."""
        if self.wrong:
            return "WRONG"
        if self.n_undecided:
            return "kind undecided"
        return "not settled" if self.n_open else "right"

    def add(self, other: Verdict) -> None:
        """Take in the verdict on another parameter point."""
        self.wrong += other.wrong
        self.n_right += other.n_right
        self.n_open += other.n_open
        self.n_undecided += other.n_undecided


def judge_point(
    answer: Answer,
    where: Mapping[str, float],
    rows: Sequence[Row],
    *,
    n_cells: int,
    n_left: int = 0,
    geometry: Any = None,
) -> Verdict:
    """Judge the rows of one parameter point.

    Parameters
    ----------
    answer, where
        The known answer and the point.
    rows
        Of the table, at that point; with `points`, shape (n, state), if these are known.
    n_cells, n_left
        Cells of the point, and those that are bounded and belong to no set.
    geometry
        Callable that returns scaled differences of states, angles on their circle; plain by default.
    """
    known = answer.at(where)
    verdict = Verdict(n_open=int(n_left > 0))
    for row in rows:
        if reason := contradiction(row):
            verdict.wrong.append(f"{words(row)}: {reason}")
    attracting = [r for r in rows if r["stability"] == ATTRACTS]
    given = _assigned([k for k in known if k.attracts], attracting, verdict, geometry)
    for row in rows:
        if row["stability"] == "not_settled":
            verdict.n_open += 1
        elif row["stability"] != ATTRACTS:
            _judge_other(row, known, answer, verdict, geometry)
    if not verdict.n_open:
        _judge_completeness(known, given, rows, n_cells, answer, verdict)
    place = ", ".join(f"{k} = {v:g}" for k, v in where.items())
    if place:
        verdict.wrong = [f"{place}: {reason}" for reason in verdict.wrong]
    return verdict


def _assigned(known: Sequence[Known], rows: Sequence[Row], verdict: Verdict, geometry: Any) -> dict[int, Row]:
    """Give each attracting row an attractor of its own; returns the rows by the attractor's place."""
    reasons = [[mismatch(k, r, geometry) for r in rows] for k in known]
    cost = np.array([[bool(reason) for reason in line] for line in reasons], float).reshape(len(known), len(rows))
    pairs = [(k, r) for k, r in zip(*linear_sum_assignment(cost), strict=True) if not reasons[k][r]]
    taken = {r for _, r in pairs}
    for k, r in pairs:
        undecided = known[k].kind in UNDECIDED and rows[r]["kind"] == "bounded_set"
        verdict.n_undecided += undecided
        verdict.n_right += not undecided
    for r, row in enumerate(rows):
        if r in taken:
            continue
        fits = [known[k].words for k in range(len(known)) if not reasons[k][r]]
        if fits:
            verdict.wrong.append(f"{words(row)}: a second row of one attractor ({fits[0]})")
        else:
            nearest = min((line[r] for line in reasons), key=len, default="no attractor is known here")
            verdict.wrong.append(f"{words(row)}: is no attractor ({nearest})")
    return {int(k): rows[r] for k, r in pairs}


def mismatch(known: Known, row: Row, geometry: Any = None) -> str:
    """Say why a row cannot be a known set; empty if it can."""
    kind = row["kind"]
    if known.kind not in ("any", kind) and not (known.kind in UNDECIDED and kind == "bounded_set"):
        return f"known: {known.words}"
    return _odd_number(known, row) or _misplaced(known, row, geometry)


def _odd_number(known: Known, row: Row) -> str:
    """Say which number of a row is not the known one."""
    is_orbit, is_rest = (row["kind"] == kind for kind in ("periodic_orbit", "equilibrium"))
    if is_orbit and known.period and row["orbit_period"] not in (0, known.period):
        return f"known period {known.period}"
    s, m = known.seconds, known.multiplier
    if s and not _near(row.get("period_s"), s, known.seconds_error or 1e-5 * s):
        return f"known {s:.6g} s"
    told = np.nan_to_num(row.get("multiplier_error", 0.0))
    if is_orbit and m is not None and not _near(row.get("multiplier_modulus"), m, 2e-5 + 1e-3 * m + told):
        return f"known multiplier {m:.6g}"
    if is_rest and known.eigenvalue is not None:
        said = (row.get("eigenvalue_real"), row.get("eigenvalue_imag"))
        if not all(_near(x, k, 1e-5 + 1e-4 * abs(k)) for x, k in zip(said, known.eigenvalue, strict=False)):
            return f"known eigenvalue {known.eigenvalue}"
    if known.lyapunov is not None and not _fits(row, known.lyapunov, known.lyapunov_error):
        return f"known exponent {known.lyapunov:.4g} +- {known.lyapunov_error:.2g}"
    return ""


def _misplaced(known: Known, row: Row, geometry: Any) -> str:
    """Say whether a row's points are not where the set is."""
    points = row.get("points")
    if not known.at or points is None or known.kind not in ("equilibrium", "periodic_orbit"):
        return ""
    points = np.asarray(points, float)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return ""
    difference = geometry or (lambda a, b: a - b)
    distance = np.abs(difference(points, np.array(known.at))).max(axis=1).min()
    bound = known.at_error or 0.02 * max(1.0, np.abs(known.at).max())
    return "" if distance <= bound else f"known at {np.round(known.at, 4).tolist()}, {distance:.2g} away"


def _near(said: float | None, known: float, error: float) -> bool:
    """Whether a number is as known; one that is not given is no error."""
    return said is None or not math.isfinite(said) or abs(said - known) <= error


def _fits(row: Row, known: float, error: float) -> bool:
    """Whether a row's interval of the largest exponent, taken twice as wide, reaches the known one's."""
    said, low, high = (row.get(f"lyapunov_{k}", math.nan) for k in ("max", "low", "high"))
    if said is None or not math.isfinite(said):
        return True
    below, above = (abs(said - x) if x is not None and math.isfinite(x) else 0.0 for x in (low, high))
    return said - 2.0 * below <= known + error and said + 2.0 * above >= known - error


def contradiction(row: Row) -> str:
    """Say whether a row's own numbers contradict its stability."""
    stability, kind = row["stability"], row["kind"]
    modulus, rate = row.get("multiplier_modulus", math.nan), row.get("eigenvalue_real", math.nan)
    if stability == ATTRACTS:
        if kind == "periodic_orbit" and modulus > 1.0 + 1e-6:
            return "attracts with a multiplier above 1"
        if kind == "equilibrium" and rate > 1e-6:
            return "attracts with an eigenvalue above 0"
    if stability == "unstable":
        if kind == "periodic_orbit" and modulus < 1.0 - 1e-6:
            return "unstable with all multipliers below 1"
        if kind == "equilibrium" and rate < -1e-6:
            return "unstable with all eigenvalues below 0"
    if kind == "equilibrium" and row.get("orbit_period", 0) > 1:
        return "an equilibrium with a period"
    return ""


def _judge_other(row: Row, known: Sequence[Known], answer: Answer, verdict: Verdict, geometry: Any) -> None:
    """Judge a row that is said not to attract."""
    stability = row["stability"]
    same = [k for k in known if not mismatch(k, row, geometry)]
    if any(k.stability in (stability, "semistable") for k in same):
        verdict.n_right += 1
        _judge_lifetime(row, [k for k in same if k.stability == stability], verdict)
    elif stability == "neutral" and any(k.or_neutral for k in same):
        verdict.n_right += 1
    elif any(k.stability == "semistable" for k in known):
        verdict.n_undecided += 1
    elif stability in answer.also or (stability == "unstable" and row["kind"] in ("periodic_orbit", "equilibrium")):
        # every chaotic set has unstable orbits; the numbers have been looked at
        pass
    elif any(k.attracts for k in same):
        verdict.wrong.append(f"{words(row)}: is an attractor ({same[0].words})")
    else:
        verdict.wrong.append(f"{words(row)}: nothing here is {stability.replace('_', ' ')}")


def _judge_lifetime(row: Row, same: Sequence[Known], verdict: Verdict) -> None:
    """Judge a transient's mean lifetime."""
    bounds = [k.lifetime for k in same if k.lifetime]
    low, high = (row.get(f"lifetime_{k}", math.nan) for k in ("low", "high"))
    if not bounds or not math.isfinite(low):
        return
    high = high if math.isfinite(high) else math.inf
    if not any(low / 1.5 <= b and high * 1.5 >= a for a, b in bounds):
        verdict.wrong.append(f"{words(row)}: lifetime {low:.4g} to {high:.4g}, known {bounds[0]}")


def _judge_completeness(
    known: Sequence[Known],
    given: Mapping[int, Row],
    rows: Sequence[Row],
    n_cells: int,
    answer: Answer,
    verdict: Verdict,
) -> None:
    """Judge whether attractors are missing, and the shares of those listed; nothing is left open."""
    attractors = [k for k in known if k.attracts]
    others = [r for r in rows if r["stability"] == "neutral"]
    for i, one in enumerate(attractors):
        share = one.share if one.share is not None else (1.0 if len(attractors) == 1 else None)
        if i not in given:
            alike = one.or_neutral and any(not mismatch(one, r) for r in others)
            if share and (1.0 - share) ** n_cells < CHANCE and not alike:
                verdict.wrong.append(f"missing: {one.words}, share {share:.3g}")
        elif one.share is not None and len(given) == len(attractors):
            _judge_share(one, attractors, given, i, answer, verdict)


def _judge_share(
    one: Known, attractors: Sequence[Known], given: Mapping[int, Row], i: int, answer: Answer, verdict: Verdict
) -> None:
    """Judge one basin fraction; attractors that only their points tell apart may have swapped theirs."""
    row = given[i]
    alike = [k for k in attractors if not mismatch(k, row) and k.share is not None]
    said, low, high = (float(row.get(k, math.nan)) for k in ("fraction", "low", "high"))
    if not math.isfinite(said):
        return
    error = one.share_error or answer.share_error
    low, high = said - 2.0 * (said - low) - error, said + 2.0 * (high - said) + error
    if not any(low <= k.share <= high for k in ([one] if row.get("points") is not None else alike)):
        verdict.wrong.append(f"{words(row)}: share {said:.3f}, known {one.share:.3f}")


def words(row: Row) -> str:
    """Describe a row in a few words."""
    parts = [row["stability"].replace("_", " "), row["kind"].replace("_", " ")]
    parts += [f"period {row['orbit_period']}"] if row.get("orbit_period") else []
    for key, name in (("multiplier_modulus", "|m|"), ("eigenvalue_real", "eigenvalue"), ("lyapunov_max", "exponent")):
        value = row.get(key)
        parts += [f"{name} {value:.4g}"] if value is not None and math.isfinite(value) else []
    return " ".join([*parts, f"({row.get('n_cells', 0)} cells)"])
