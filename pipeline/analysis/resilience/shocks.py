"""Search the smallest shock that leads away from an attractor.

A shock is a jump of some states, in their units. The search has four stages, and each asks for many
trajectories at once:

1. shells: shocks in many directions, at every base state, of rising size, until one leads away;
2. rays: the size at which those shocks begin to lead away, by dividing the interval of each;
3. descent: nearby directions and base states at slightly smaller sizes, with steps that shrink where none leads
   away, from the best rays;
4. confirmation: random smaller shocks, many of them near the best ray; if one leads away, the descent goes on
   from it.

The idea of the search from outside inwards is that of `minimal_critical_shock` of Attractors.jl (Datseris, Rossi
and Wagemakers, Chaos 33, 073151, 2023), after Halekotte and Feudel (Sci. Rep. 10, 11783, 2020).
"""

from __future__ import annotations

from collections.abc import Generator, Hashable, Mapping
from dataclasses import dataclass, fields
from typing import Literal, TypeVar

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.analysis.attractors.destinations import UNDECIDED, Destinations
from pipeline.analysis.flown import flown
from pipeline.analysis.resilience.declaration import ResilienceOptions
from pipeline.analysis.together import answer_together
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.products.reporting import report
from pipeline.results.outcomes import DIVERGED

Norm = Literal["euclidean", "largest"]
K = TypeVar("K", bound=Hashable)


@dataclass(frozen=True)
class ShockSettings:
    """Numbers of the search for the smallest shock that leads away."""

    ratio: float = 2.0 ** (1.0 / 3.0)  # ratio of the sizes of neighbouring shells
    shells: int = 25  # number of shells: the least is 2**-8 of the largest; more find smaller shocks, and take longer
    parts: int = 8  # parts into which a ray's interval is divided at once
    coarse: float = 1e-2  # relative length to which rays are divided before the best are chosen for the descent
    # most rays that are divided, and most descents; more find minima that others hide, and take longer
    most_rays: int = 64
    most_descents: int = 4
    # relative decreases of the size that a descent tries: factors and powers of its angle
    ladder: tuple[tuple[float, int], ...] = ((0.5, 1), (0.1, 1), (1.0, 2), (0.1, 2))
    last_angle: float = 2e-3  # angle [rad] at which a descent ends: its size is then within 1e-6 of a smooth minimum
    most_steps: int = 80  # most steps of a descent, and random directions in each
    n_random: int = 4
    rounds: int = 20  # most rounds of confirmation
    # decimal logarithms of the least and largest relative distance from the best ray at which shocks are tried
    beside: tuple[float, float] = (-5.0, -0.3)
    precision: float = 1e-6  # relative length to which the last ray is divided


@dataclass(frozen=True)
class Trials:
    """Shocks whose ends are wanted."""

    base: np.ndarray  # int64, (n,): number of the base state
    shock: np.ndarray  # (n, dim): scaled jump of each of the shocked states


Search = Generator[Trials, np.ndarray, "Found"]
"""A search: yields trials, receives their labels, returns what it found."""


Seeds = tuple[Trials, np.ndarray]
"""Shocks whose ends are known, with their labels."""


def sizes(shocks: np.ndarray, norm: Norm) -> np.ndarray:
    """Return the scaled sizes of shocks (..., dim)."""
    return np.asarray(np.linalg.norm(shocks, axis=-1) if norm == "euclidean" else np.abs(shocks).max(axis=-1))


@dataclass(frozen=True)
class Found:
    """The smallest shock that leads away from an attractor."""

    # scaled sizes. Every shock smaller than `low` that was tried stayed. The shock of size `high` leads away;
    # infinite if none was found. The ends of some shocks between them are not known.
    low: float
    high: float
    shock: np.ndarray  # (dim,): the shock of size `high`; NaN if none was found
    base: int  # number of its base state, -1 if none was found
    to: int  # label of the end, `UNDECIDED` if none was found
    safe: float  # size of the largest shell below `low` of which all shocks stayed; 0 if there is none
    n_below: int  # number of shocks smaller than `low` that were tried; all of them stayed
    n_undecided: int  # number of shocks smaller than `high` whose end is not known


@dataclass
class _Rays:
    """Rays from base states: on each, the interval in which shocks begin to lead away."""

    base: np.ndarray
    unit: np.ndarray
    low: np.ndarray
    high: np.ndarray
    label: np.ndarray

    def take(self, rows: np.ndarray) -> _Rays:
        return _Rays(self.base[rows], self.unit[rows], self.low[rows], self.high[rows], self.label[rows])

    def smallest(self, n: int) -> _Rays:
        return self.take(np.argsort(self.high, kind="stable")[:n])

    def joined(self, other: _Rays) -> _Rays:
        return _Rays(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(_Rays)))


class ShockSearch:
    """The search for the smallest shock of `dim` states that leads away from an attractor, which is given by its id.

    Base states on it that are neighbours in time are next to each other. Seeds are shocks that lead away.
    """

    def __init__(
        self,
        own: int,
        n_bases: int,
        dim: int,
        options: ResilienceOptions,
        seeds: Seeds | None = None,
        settings: ShockSettings = ShockSettings(),
    ) -> None:
        self.settings = settings
        self._own, self._n_bases, self._dim, self._options, self._seeds = own, n_bases, dim, options, seeds
        self._rng = np.random.default_rng([options.seed, dim])
        self._sizes: list[np.ndarray] = []
        self._codes: list[np.ndarray] = []
        self._shells: list[tuple[float, bool]] = []

    def _size(self, shocks: np.ndarray) -> np.ndarray:
        return sizes(shocks, self._options.norm)

    def _unit(self, shocks: np.ndarray) -> np.ndarray:
        """Return shocks of size 1 in the same directions."""
        return np.asarray(shocks / self._size(shocks)[..., None])

    def _compass(self) -> np.ndarray:
        """Return the directions of a shell, shape (n, dim): both axes of each state first."""
        n, dim = self._options.directions, self._dim
        if dim == 1:
            return np.array([[1.0], [-1.0]])
        if dim == 2:
            angles = 2.0 * np.pi * np.arange(n) / n
            return self._unit(np.column_stack([np.cos(angles), np.sin(angles)]))
        drawn = self._rng.standard_normal((max(n - 2 * dim, 0), dim))
        return self._unit(np.concatenate([np.eye(dim), -np.eye(dim), drawn]))

    def run(self) -> Search:
        """Search: a generator that yields trials, receives their labels and returns a `Found`."""
        rays = yield from self._outer()
        if not len(rays.base):
            return self._found(None)
        yield from self._narrow(rays, self.settings.coarse)
        best = self._best(rays)
        if self._dim > 1 or self._n_bases > 1:
            yield from self._descend(best)
        for _ in range(self.settings.rounds):
            best = best.smallest(1)
            yield from self._narrow(best, self.settings.precision)
            worse = yield from self._contradictions(best)
            if not len(worse.base):
                break
            worse = worse.smallest(self.settings.most_rays)
            yield from self._narrow(worse, self.settings.coarse)
            best = self._best(worse)
            yield from self._descend(best)
        best = best.smallest(1)
        yield from self._narrow(best, self.settings.precision)
        return self._found(best)

    # ---- trials --------------------------------------------------------------------------------

    def _ask(self, base: np.ndarray, shock: np.ndarray) -> Generator[Trials, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the label of each shock, and its code: 1 leads away, 0 stays, -1 not known."""
        if not len(base):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        label = yield Trials(base, shock)
        code = np.where(label == UNDECIDED, -1, (label != self._own).astype(np.int64))
        self._sizes.append(self._size(shock))
        self._codes.append(code)
        return label, code

    def _outer(self) -> Generator[Trials, np.ndarray, _Rays]:
        """Try shells of rising size until a shock leads away; return the rays of the shocks that do."""
        units = self._compass()
        base, unit = np.repeat(np.arange(self._n_bases), len(units)), np.tile(units, (self._n_bases, 1))
        low = np.zeros(len(base))
        rays = _Rays(*(x[:0] for x in (base, unit, low, low, base)))
        for size in self._options.largest * self.settings.ratio ** np.arange(1.0 - self.settings.shells, 1.0):
            label, code = yield from self._ask(base, size * unit)
            self._shells.append((float(size), bool((code == 0).all())))
            away = np.flatnonzero(code == 1)
            if len(away):
                away = np.sort(away[self._rng.permutation(len(away))[: self.settings.most_rays]])
                rays = _Rays(base[away], unit[away], low[away], np.full(len(away), size), label[away])
                break
            low = np.where(code == 0, size, low)
        return rays.joined(self._seeded(*self._seeds, rays.high.min(initial=np.inf))) if self._seeds else rays

    def _seeded(self, trials: Trials, label: np.ndarray, below: float) -> _Rays:
        """Return the rays of known shocks that are smaller than those found."""
        size = self._size(trials.shock)
        rows = np.flatnonzero((size < below) & (size > 0.0))
        return _Rays(trials.base[rows], self._unit(trials.shock[rows]), np.zeros(len(rows)), size[rows], label[rows])

    def _narrow(self, rays: _Rays, precision: float) -> Generator[Trials, np.ndarray, None]:
        """Divide the interval of each ray until it is short or holds undecided shocks only, in place."""
        going = np.arange(len(rays.base))
        share = np.arange(1, self.settings.parts) / self.settings.parts
        while True:
            going = going[rays.high[going] - rays.low[going] > precision * rays.high[going]]
            if not len(going):
                return
            low, high = rays.low[going], rays.high[going]
            sizes = low[:, None] + (high - low)[:, None] * share
            shock = sizes[..., None] * rays.unit[going][:, None]
            label, code = yield from self._ask(
                np.repeat(rays.base[going], self.settings.parts - 1), shock.reshape(-1, self._dim)
            )
            label, code = label.reshape(-1, self.settings.parts - 1), code.reshape(-1, self.settings.parts - 1)
            for i, row in enumerate(going):
                first = int(np.argmax(code[i] == 1)) if (code[i] == 1).any() else self.settings.parts - 1
                if first < self.settings.parts - 1:
                    rays.high[row], rays.label[row] = sizes[i, first], label[i, first]
                stays = np.flatnonzero(code[i, :first] == 0)
                if len(stays):
                    rays.low[row] = sizes[i, stays[-1]]
            # an interval that no longer halves holds undecided shocks
            going = going[rays.high[going] - rays.low[going] <= 0.5 * (high - low)]

    def _best(self, rays: _Rays) -> _Rays:
        """Return the rays of the smallest shocks that are not neighbours of a smaller one."""
        kept: list[int] = []
        for row in np.argsort(rays.high, kind="stable").tolist():
            beside = np.linalg.norm(rays.unit[kept] - rays.unit[row], axis=1) < 4.0 * self._angle
            if not (beside & (rays.base[kept] == rays.base[row])).any() and len(kept) < self.settings.most_descents:
                kept.append(row)
        return rays.take(np.array(kept))

    @property
    def _angle(self) -> float:
        """Typical angle between neighbouring directions of a shell [rad]."""
        return 2.0 * np.pi / self._options.directions if self._dim == 2 else 0.5

    # ---- descent -------------------------------------------------------------------------------

    def _descend(self, rays: _Rays) -> Generator[Trials, np.ndarray, None]:
        """Move each ray, in place, to nearby directions and base states from which smaller shocks lead away."""
        angle = np.full(len(rays.base), min(self._angle, 0.5))
        for _ in range(self.settings.most_steps):
            going = np.flatnonzero(angle > self.settings.last_angle)
            if not len(going):
                return
            asked = [self._near(rays, int(row), float(angle[row])) for row in going]
            label, code = yield from self._ask(*(np.concatenate(part) for part in zip(*asked, strict=True)))
            ends = np.cumsum([len(base) for base, _ in asked])
            for row, (base, shock), end in zip(going.tolist(), asked, ends.tolist(), strict=True):
                own = slice(end - len(base), end)
                size = np.where(code[own] == 1, self._size(shock), np.inf)
                k = int(np.argmin(size))
                if not size[k] < rays.high[row]:
                    angle[row] /= 3.0
                    continue
                rays.base[row], rays.unit[row], rays.label[row] = base[k], shock[k] / size[k], label[own][k]
                rays.high[row], rays.low[row] = size[k], 0.0

    def _near(self, rays: _Rays, row: int, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Return trials in nearby directions and at neighbouring base states, slightly smaller than a ray's shock."""
        unit, base = rays.unit[row], int(rays.base[row])
        units, bases = [unit[None]], [np.array([base])]
        if self._dim > 1:
            plane = np.linalg.svd(unit[None])[2][1:]
            drawn = self._rng.standard_normal((self.settings.n_random, len(plane))) @ plane
            drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
            turned = unit / np.linalg.norm(unit) + angle * np.concatenate([plane, -plane, drawn])
            units.append(self._unit(turned))
            bases.append(np.full(len(turned), base))
        if self._n_bases > 1:
            units.append(np.repeat(unit[None], 2, axis=0))
            bases.append(np.array([base - 1, base + 1]) % self._n_bases)
        every, numbers = np.concatenate(units), np.concatenate(bases)
        sizes = rays.high[row] * (1.0 - np.array([factor * angle**power for factor, power in self.settings.ladder]))
        shock = sizes[:, None, None] * every
        return np.tile(numbers, len(sizes)), shock.reshape(-1, self._dim)

    def _contradictions(self, best: _Rays) -> Generator[Trials, np.ndarray, _Rays]:
        """Try random shocks below the smallest one found; return those that lead out of the basin, if any.

        Half of them have any direction and base state. The others are near the best ray at all distances below its
        shock: where the boundary is fractal, thin parts of other basins lie there, which dividing a ray misses.
        """
        n, least, dim = self._options.confirmations, float(best.high[0]), self._dim
        base = np.concatenate([self._rng.integers(self._n_bases, size=n), np.full(n, best.base[0])])
        drawn = self._rng.standard_normal((2 * n, dim))
        if dim > 1:
            turned = 10.0 ** self._rng.uniform(*self.settings.beside, n)
            turned[: n // 2] = 0.0
            drawn[n:] = best.unit[0] + turned[:, None] * drawn[n:]
        else:
            drawn[n:] = best.unit[0]
        below = 10.0 ** self._rng.uniform(np.log10(self.settings.precision), self.settings.beside[1], n)
        share = np.concatenate([self._rng.uniform(0.25, 1.0 - self.settings.precision, n), 1.0 - below])
        unit, size = self._unit(drawn), least * share
        label, code = yield from self._ask(base, size[:, None] * unit)
        away = np.flatnonzero(code == 1)
        return _Rays(base[away], unit[away], np.zeros(len(away)), size[away], label[away])

    # ---- result --------------------------------------------------------------------------------

    def _found(self, best: _Rays | None) -> Found:
        """Return the best shock, with what was tried below it; without a ray, that none was found."""
        size, code = np.concatenate([np.zeros(0), *self._sizes]), np.concatenate([np.zeros(0, int), *self._codes])
        low, high, shock, base, label = self._options.largest, np.inf, np.full(self._dim, np.nan), -1, UNDECIDED
        if best is not None:
            low, high, base, label = float(best.low[0]), float(best.high[0]), int(best.base[0]), int(best.label[0])
            shock = high * best.unit[0]
        unknown = size[(code == -1) & (size < high)]
        if len(unknown):
            low = float(unknown.min()) if best is not None else min(low, float(unknown.min()))
        safe = max([0.0, *(shell for shell, stays in self._shells if stays and shell <= low)])
        n_below = int(((size <= low) & (code == 0)).sum())
        return Found(low, high, shock, base, label, safe, n_below, len(unknown))


@dataclass(frozen=True)
class Bases:
    """States on an attractor from which shocks start."""

    states: np.ndarray  # (n, state): neighbours in time next to each other
    # (n,): time since the section before each state, as a share of the drive period, or of the period of an orbit of
    # a flow
    phase: np.ndarray
    # bool, (n,): whether each state lies on the section, so that its grid of initial states applies
    at_section: np.ndarray

    @property
    def sections(self) -> Bases:
        """The states that lie on the section."""
        return Bases(self.states[self.at_section], self.phase[self.at_section], self.at_section[self.at_section])


def bases_of(one: xr.Dataset, parameters: Parameters, frequency: float, n_phases: int) -> Bases:
    """Sample the states on an attractor at equally spaced phases of a drive period, or of the period of a flow's orbit.

    The attractor is given by the variables of `match` without parameter dims and `attractor`.
    """
    most = 8  # section points of a set that does not close from which shocks start
    stored = one["attractor_points"].transpose("point", "state").values
    points = stored[np.isfinite(stored).all(axis=-1)]
    kind = int(one["kind"])
    if kind == EQUILIBRIUM:
        return Bases(points[:1], np.zeros(1), np.ones(1, bool))
    if parameters.model.clock.has_equilibria:
        if kind == PERIODIC_ORBIT:
            period = float(one["period_s"])
            return _sampled(of_flow(parameters), points[:1], period, n_phases)
        points = points[:most]
        return Bases(points, np.zeros(len(points)), np.ones(len(points), bool))
    n = int(one["orbit_period"]) if kind == PERIODIC_ORBIT else most
    return _sampled(parameters, points[:n], 1.0 / frequency, parameters.model.clock.samples(n_phases))


def _sampled(parameters: Parameters, points: np.ndarray, period: float, n_phases: int) -> Bases:
    """Integrate from section points, and return the states at equally spaced phases of the next period."""
    phase, n = np.arange(n_phases) / n_phases, len(points)
    states = points
    if n_phases > 1:
        states = flown(parameters, points, phase * period, Drive(np.array([period]))).states
    return Bases(states.reshape(-1, points.shape[1]), np.tile(phase, n), np.tile(phase == 0.0, n))


def labels_after(there: Destinations, states: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the label of the attractor on which each shocked trajectory ends; see `Destinations.follow`.

    Shocked states (n, state) have phases (n,), shares of the drive period. They are integrated to the next section
    first.
    """
    states, label = states.copy(), np.full(len(states), UNDECIDED, np.int64)
    status = np.full(len(states), int(Status.BOUNDED), np.int64)
    rows = np.flatnonzero(phase > 0.0) if not there.point.can_rest else np.zeros(0, np.int64)
    if len(rows):
        phases, piece = np.unique(phase[rows], return_inverse=True)
        period = 1.0 / there.point.frequency
        found = sample(
            there.point.integrates,
            np.tile(there.point.packed, (len(rows), 1)),
            states[rows],
            [np.array([period * (1.0 - p)]) for p in phases],
            piece=piece,
            drives=[Drive(np.array([period]), start_s=float(p) * period) for p in phases],
            rtol=there.settings.rtol,
            atol=there.settings.atol,
        )
        states[rows], status[rows] = found.states[:, 0], found.status
    label[status == Status.DIVERGED] = DIVERGED
    good = np.flatnonzero(status == Status.BOUNDED)
    label[good] = there.follow(states[good]).label
    return label


@dataclass(frozen=True)
class Asked:
    """A search for shocks, with the base states and the states that are shocked."""

    search: Search  # see `ShockSearch.run`
    bases: Bases
    which: np.ndarray  # numbers of the shocked states

    @classmethod
    def of(
        cls, own: int, bases: Bases, which: np.ndarray, options: ResilienceOptions, seeds: Seeds | None = None
    ) -> Asked:
        """Begin a search from the attractor with an id; see `ShockSearch`."""
        return cls(ShockSearch(own, len(bases.states), len(which), options, seeds).run(), bases, which)


def search_together(asked: Mapping[K, Asked], there: Destinations, units: np.ndarray) -> dict[K, Found]:
    """Run searches for shocks in step, so that their trajectories fill the engine's lanes together."""

    def answer(trials: dict[K, Trials], results: Mapping[K, Found]) -> dict[K, np.ndarray]:
        report("searching shocks", len(results), len(asked))
        states, phase = zip(*(_states(trial, asked[key], units) for key, trial in trials.items()), strict=True)
        found = labels_after(there, np.concatenate(states), np.concatenate(phase))
        ends = np.cumsum([len(trial.base) for trial in trials.values()])[:-1]
        return dict(zip(trials, np.split(found, ends), strict=True))

    return answer_together({key: one.search for key, one in asked.items()}, answer)


def _states(trials: Trials, asked: Asked, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shocked states and their phases."""
    states = asked.bases.states[trials.base].copy()
    states[:, asked.which] += trials.shock * units[asked.which]
    return states, asked.bases.phase[trials.base]
