"""Continue the bifurcations at which attractors end as curves, until each of them lies on one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magpend_core.orbits import wrap_angles
from pipeline.analysis.atlas.plane import Array
from pipeline.analysis.branches.bifurcations import multipliers_of
from pipeline.analysis.branches.codimension_two import BT, merged
from pipeline.analysis.branches.curves import CURVE, CurveStart, continue_curves
from pipeline.analysis.branches.curves import Curve as Followed
from pipeline.analysis.branches.equilibrium_curves import EquilibriumCurve
from pipeline.analysis.branches.homoclinic_curves import Bounds, homoclinic_curves, loops_beside
from pipeline.analysis.branches.kinds import BRANCH_POINTS, DOUBLING, FOLD, HOMOCLINIC, HOPF, SNIC, TORUS
from pipeline.analysis.branches.problems import TESTS, Family

Key = tuple[str, int]
"""Kind of a bifurcation, and the period of the orbit."""

PLANE_CURVE = replace(CURVE, max_points=200)
"""Settings of curves: one that needs more points to cross the plane crawls, and the bifurcations beyond start another.
"""

TRIES = 3
"""Most starts of one attractor's bifurcations of a kind and period that lead to no curve."""


@dataclass(frozen=True, eq=False)
class Located:
    """A bifurcation that was located between two neighbouring points of the plane."""

    family: Family  # with both parameters free
    kind: str
    attractor: int
    state: Array
    values: Array  # of both parameters
    near: float  # largest error of the values, in units of the plane

    @property
    def key(self) -> Key:
        """Kind and period."""
        return FOLD if self.kind == SNIC else self.kind, self.family.period

    def start(self, number: int) -> CurveStart | None:
        """Return the start of its curve; None if bifurcations of this kind are not continued."""
        kind, period = self.key
        if kind not in (TESTS if period else (HOPF, FOLD, *BRANCH_POINTS)):
            return None
        u = self.family.unknowns(self.state, self.values)
        return number, self.family, kind, u if period else EquilibriumCurve(self.family, kind).start(u)


@dataclass(frozen=True, eq=False)
class _Track:
    """Points of a curve as arrays: parameters (point, 2) and section points (point, phase, state), scaled."""

    family: Family
    values: Array
    images: Array

    @classmethod
    def of(cls, curve: Followed) -> _Track:
        scales = np.asarray(curve.family.system.scales)
        values = np.array([p.u[-2:] for p in curve.points])
        return cls(curve.family, values, np.array([p.value.images for p in curve.points]) / scales)

    def holds(self, one: Located) -> bool:
        """Return whether the curve passes through a bifurcation, at any of the orbit's section points."""
        here = one.values / np.asarray(self.family.scales)
        chords = np.diff(self.values, axis=0)
        squares = np.maximum((chords**2).sum(axis=1), 1e-300)
        share = np.clip(((here - self.values[:-1]) * chords).sum(axis=1) / squares, 0.0, 1.0)
        away = np.linalg.norm(self.values[:-1] + share[:, None] * chords - here, axis=1)
        # a chord of a curve deviates by some per cent of its length, in the states as well
        near = np.flatnonzero(away < 0.02 * np.sqrt(squares) + 1e-6 + one.near)
        return any(self._passes(k, float(share[k]), one) for k in near.tolist())

    def _passes(self, k: int, share: float, one: Located) -> bool:
        a, b = self.images[k : k + 2]
        scales = np.asarray(self.family.system.scales)
        chord = wrap_angles((b - a) * scales, self.family.system) / scales
        offset = wrap_angles((a + share * chord) * scales - one.state, self.family.system) / scales
        length = np.hypot(np.abs(chord).max(), np.linalg.norm(np.diff(self.values[k : k + 2], axis=0)))
        return bool(np.abs(offset).max(axis=1).min() < 0.05 * length + 1e-4 + np.sqrt(one.near))


@dataclass(eq=False)
class Chart:
    """Curves in the plane, and for each located bifurcation the curve on which it lies, -1 none."""

    located: Sequence[Located]
    curves: list[Followed]
    curve_of: Array
    lost: dict[int, str]  # why a located bifurcation that was tried has no curve

    def _take(self, curve: Followed) -> bool:
        """Add a curve, unless points all along it lie on one that is known; return whether it was added."""
        family, points = curve.family, curve.points
        chosen = [points[int(share * (len(points) - 1))] for share in (0.1, 0.3, 0.5, 0.7, 0.9)]
        ones = [Located(family, curve.kind, -1, family.state(p.u), np.asarray(family.values(p.u)), 0.0) for p in chosen]
        alike = [c for c in self.curves if (c.kind, c.family.period) == (curve.kind, family.period)]
        is_new = not any(all(_Track.of(c).holds(one) for one in ones) for c in alike)
        self.curves += [curve] * is_new
        return is_new

    def _settle(self, curves: Sequence[Followed]) -> None:
        """Find the bifurcations that lie on new curves."""
        first = len(self.curves) - len(curves)
        for number, curve in enumerate(curves, first):
            track, key = _Track.of(curve), (curve.kind, curve.family.period)
            for i in np.flatnonzero(self.curve_of < 0).tolist():
                if self.located[i].key == key and track.holds(self.located[i]):
                    self.curve_of[i] = number

    def holding(self, one: Located) -> int:
        """Return the curve on which a bifurcation lies, -1 none."""
        own = (k for k, c in enumerate(self.curves) if (c.kind, c.family.period) == one.key and _Track.of(c).holds(one))
        return next(own, -1)

    def grow(self, bounds: Bounds, longest: int, generations: int) -> None:
        """Start a curve of each kind and period at a time, until all bifurcations lie on curves or no start helps."""
        tried: dict[tuple[Any, ...], int] = {}
        asked: set[int] = set()
        while True:
            groups: dict[Key, dict[int, list[int]]] = {}
            for i in np.flatnonzero(self.curve_of < 0).tolist():
                one = self.located[i]
                if i not in asked and tried.get((*one.key, one.attractor), 0) < TRIES:
                    groups.setdefault(one.key, {}).setdefault(one.attractor, []).append(i)
            largest = [max(groups[key].values(), key=len) for key in sorted(groups)]
            chosen = [own[len(own) // 2] for own in largest]
            starts = [s for i in chosen if (s := self.located[i].start(i)) is not None]
            asked |= set(chosen)
            if not starts:
                if not chosen:
                    return
                for i in chosen:  # bifurcations of this kind have no curve
                    tried[(*self.located[i].key, self.located[i].attractor)] = TRIES
                continue
            found = continue_curves(starts, bounds, PLANE_CURVE, longest, generations, self.lost, self.curves)
            self._settle([curve for curve in found if self._take(curve)])
            for i in chosen:
                key = (*self.located[i].key, self.located[i].attractor)
                tried[key] = 0 if self.curve_of[i] >= 0 else tried.get(key, 0) + 1

    def add_homoclinic(self, bounds: Bounds) -> None:
        """Follow the homoclinic orbits that spring from Bogdanov-Takens points."""
        takens = [p for p in merged({i: c.special for i, c in enumerate(self.curves)}) if p.kind == BT]
        loops = [loop for point in takens for loop in loops_beside(point)]
        found = [
            Followed(c.family, HOMOCLINIC, c.points, c.ends, -1, c.special, c.n_missed)
            for c in homoclinic_curves(loops, bounds)
        ]
        self.curves += found
        for number, curve in enumerate(found, len(self.curves) - len(found)):
            track = _Track.of(curve)
            for i in np.flatnonzero(self.curve_of < 0).tolist():
                if self.located[i].kind == HOMOCLINIC and track.holds(self.located[i]):
                    self.curve_of[i] = number


def charted(located: Sequence[Located], bounds: Bounds, longest: int, generations: int = 1) -> Chart:
    """Continue bifurcations as curves in the plane, and the curves that start at points of codimension two on them.

    Parameters
    ----------
    located
        Bifurcations between neighbouring points.
    bounds
        Ranges of both parameters.
    longest
        Longest period of orbits on curves that spring from others.
    generations
        Number of generations of these.
    """
    chart = Chart(located, [], np.full(len(located), -1), {})
    chart.grow(bounds, longest, generations)
    chart.add_homoclinic(bounds)
    return chart


def others_unstable(curve: Followed) -> Array:
    """Return for each point of a curve how many multipliers or eigenvalues are unstable beside the critical ones.

    Where there are none, the curve bounds the stability of its orbits.
    """
    return np.array([_others(curve.kind, point) for point in curve.points])


def _others(kind: str, point: Any) -> int:
    values = point.value.multipliers
    if kind == HOMOCLINIC:
        real = np.sort(values.real)
        leading = real[real > 0.0][:1].sum() + real[real < 0.0][-1:].sum()
        return int((real > 0.0).sum()) - 1 + int(leading > 0.0)
    if point.value.is_rest:
        critical = np.argsort(np.abs(values.real), kind="stable")[: 2 if kind == HOPF else 1]
        return int((np.delete(values, critical).real > 0.0).sum())
    ordered = multipliers_of(point)
    if kind == TORUS:
        away = np.where(ordered.imag != 0.0, np.abs(np.abs(ordered) - 1.0), np.inf)
        critical = np.argsort(away, kind="stable")[:2]
    else:
        critical = np.argsort(np.abs(ordered - (-1.0 if kind == DOUBLING else 1.0)), kind="stable")[:1]
    return int((np.abs(np.delete(ordered, critical)) > 1.0).sum())
