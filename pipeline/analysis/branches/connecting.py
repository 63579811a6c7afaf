"""Detect which periodic orbits at different parameter points lie on one branch, or on one sheet over two parameters.

The parameter points form a grid. Orbits are followed from point to point along every axis, stable or not, all of them
at once:

* Orbits at neighbouring points are compared first. They are linked if a step along the tangent from each leads to the
  other, within a tenth of the step's length.
* Where no neighbour is known, Newton's method finds it from the step along the tangent, under the same test and with
  shorter steps where the test fails. The new orbit is linked, and followed further.
* An orbit of even period that reaches the orbit of half its period, at a period doubling, continues as that orbit.

An orbit ends where a branch turns back in the parameter (fold). A fold is foreseen where det(1 - M) falls to 0 and the
slope rises, and it is one if a step beyond finds no orbit. Where a symmetric orbit loses its symmetry, det(1 - M) also
passes 0, but the orbit goes on. The end is open if no fold could be shown, or where the orbit is very unstable.
Sheets are followed only as far as they can meet others: the smaller of two, and not where both have orbits at one
point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from magpend_core.ordering import canonical_order
from pipeline.analysis.branches.sheets import ENDED, GOING, OPEN, UNTRIED, Array, Grid, Orbits, SheetSettings, Values
from pipeline.analysis.branches.strobe import other_side
from pipeline.products.reporting import report
from pipeline.results.tolerances import SAME_CONNECTED

_STEP, _SETTLE, _HALVE = range(3)


@dataclass(frozen=True, eq=False)
class Web:
    """Orbits with the links between them; the given orbits come first, in their order."""

    place: Array  # int, (orbit,): parameter point of each
    links: Array  # int, (link, 3): two orbits, and the number of period doublings between them
    ways: Array  # int, (orbit, axis, 2): state of the way up and down each axis, of `UNTRIED` to `GOING`


def connect(grid: Grid, place: Array, orbits: list[Array], settings: SheetSettings = SheetSettings()) -> Web:
    """Link the orbits that lie on one branch or sheet.

    The grid has an axis or more. Each orbit has its parameter point, and section points (period, n_states) in the order
    of time.
    """
    scaled = [np.asarray(x) / np.asarray(grid.system.scales) for x in orbits]
    # the result depends neither on the order of the orbits nor on where they begin
    scaled = [np.roll(x, -int(canonical_order(x)[0]), axis=0) for x in scaled]
    firsts = np.array([x[0] for x in scaled])
    order = canonical_order(np.column_stack([place, [len(x) for x in scaled], firsts]))
    flood = _Flood(grid, place[order], [scaled[i] for i in order], settings=settings)
    flood.run()
    back = np.concatenate([order, np.arange(len(order), len(flood.nodes))])
    inverse = np.argsort(back)
    links = np.column_stack([back[flood.links[:, :2]], flood.links[:, 2]])
    return Web(flood.nodes["place"][inverse], links, flood.nodes["ways"][inverse])


class _Flood(Orbits):
    """Orbits on a grid together with those that are on their way to another point (`walk`)."""

    def __init__(self, grid: Grid, place: Array, orbits: list[Array], settings: SheetSettings) -> None:
        super().__init__(grid, place, orbits, settings)
        n = grid.system.n_states
        numbers = "u end h shortest det det_before u_before gap sign limit reach end_at"
        walk: Any = [(k, "i8") for k in ("origin", "axis", "way", "period", "halvings", "stage", "tries")]
        walk += [(k, "f8") for k in numbers.split()]
        walk += [(k, "f8", n) for k in ("z", "slope", "slope_before", "half")]
        walk += [(k, "?") for k in ("is_fold", "has_moved", "is_rough", "is_ending")]
        self.walk: Any = np.zeros(0, walk)

    def run(self) -> None:
        """Follow all orbits as far as they can meet others."""
        self._compare(np.arange(len(self.nodes)))
        total = self.component.max() + 1
        while True:
            active = self._active()
            report("connecting orbits", total - min(active.sum(), total), total)
            leaves = ~active[self.component[self.walk["origin"]]]
            self._mark(self.walk[leaves], UNTRIED)
            self.walk = self.walk[~leaves]
            self._start(active)
            if not len(self.walk):
                return
            for _ in range(self.settings.together):
                self._advance()

    def _mark(self, walk: Any, state: int) -> None:
        self.nodes["ways"][walk["origin"], walk["axis"], (walk["way"] < 0).astype(int)] = state

    def _join(self) -> None:
        super()._join()
        ways = self.nodes["ways"][self.walk["origin"], self.walk["axis"], (self.walk["way"] < 0).astype(int)]
        self.walk = self.walk[ways == GOING]

    # ---- which to follow -----------------------------------------------------------------------

    def _active(self) -> Array:
        """Return for each component whether its orbits are to be followed further.

        Of two components that may meet, the smaller is. Those that have orbits at one point stay apart, whether they
        meet or not.
        """
        n, component = int(self.component.max()) + 1, self.component
        period = np.zeros(n, np.int64)
        period[component] = self.nodes["period"]
        ways = self.nodes["ways"].reshape(len(component), -1)
        has_work, is_open = np.zeros(n, bool), np.zeros(n, bool)
        has_work[component[((ways == UNTRIED) | (ways == GOING)).any(axis=1)]] = True
        is_open[component[(ways == OPEN).any(axis=1)]] = True
        is_open |= has_work
        rank = np.empty(n, np.int64)
        rank[np.lexsort((np.arange(n), np.bincount(component, minlength=n)))] = np.arange(n)
        active = np.zeros(n, bool)
        halved = np.zeros(n, bool)
        links = self.links
        halved[component[links[links[:, 2] > 0, 0]]] = True
        present = set(period.tolist())
        first, second = self._sharing_a_point(is_open)
        for one in sorted(present):
            own = np.flatnonzero((period == one) & is_open)
            if any(one % 2**k == 0 and one // 2**k in present for k in range(1, one.bit_length())):
                active[own] |= has_work[own] & ~halved[own]
            if len(own) < 2:
                continue
            weight = np.where(has_work[own], rank[own], n)
            larger = len(own) - np.searchsorted(np.sort(weight), weight, side="right")
            shares = np.flatnonzero(period[first] == one)
            local = np.full(n, -1)
            local[own] = np.arange(len(own))
            a, b = local[first[shares]], local[second[shares]]
            larger -= np.bincount(a[weight[b] > weight[a]], minlength=len(own))
            active[own] |= has_work[own] & (larger > 0)
        return active

    def _sharing_a_point(self, chosen: Array) -> tuple[Array, Array]:
        """Return the pairs of chosen components that have orbits of one period at one point, in both orders."""
        rows = np.flatnonzero(chosen[self.component])
        column = np.unique(self._key(self.nodes["period"][rows], self.nodes["place"][rows]), return_inverse=True)[1]
        shape = (len(chosen), column.max(initial=0) + 1)
        held = csr_array((np.ones(len(rows)), (self.component[rows], column)), shape=shape)
        first, second = (held @ held.T).nonzero()
        return first, second

    def _start(self, active: Array) -> None:
        """Send orbits of active components to neighbouring points, one of each component to each point."""
        new = []
        for axis in range(len(self.grid.axes)):
            for side, way in enumerate((1, -1)):
                here = np.flatnonzero((self.nodes["ways"][:, axis, side] == UNTRIED) & active[self.component])
                walk: Any = np.zeros(len(here), self.walk.dtype)
                walk["origin"], walk["axis"], walk["way"] = here, axis, way
                new.append(walk)
        walk = np.concatenate([self.walk, *new])
        key = self.component[walk["origin"]] * len(self.grid.packed) + self._targets(walk)
        _, first = np.unique(key, return_index=True)
        going = np.zeros(len(walk), bool)
        going[first] = True
        going[: len(self.walk)] = True
        walk = walk[np.flatnonzero(going)[len(self.walk) :]]
        nodes, rows = self.nodes[walk["origin"]], np.arange(len(walk))
        for k in ("period", "det"):
            walk[k] = nodes[k]
        walk["z"], walk["slope"] = nodes["points"][:, 0], nodes["slopes"][rows, walk["axis"]]
        images = np.concatenate([nodes["points"][:, 1:], nodes["points"][:, :1]], axis=1)
        walk["gap"] = self._gap(walk["z"], images, walk["period"])
        half = nodes["points"][rows, walk["period"] // 2]
        walk["half"] = self._difference(half * self.scales, walk["z"] * self.scales)
        targets = self._targets(walk)
        for axis in range(len(self.grid.axes)):
            on = np.flatnonzero(walk["axis"] == axis)
            walk["u"][on], walk["end"][on] = (self.grid.value(place[on], axis) for place in (nodes["place"], targets))
        whole = np.abs(walk["end"] - walk["u"])
        reach = np.minimum(nodes["reach"][rows, walk["axis"]], _longest(walk["slope"], self.settings))
        walk["h"] = np.minimum(whole, reach)
        walk["shortest"] = np.minimum(self.settings.shortest, whole / self.settings.least_steps)
        self._mark(walk, GOING)
        self.walk = np.concatenate([self.walk, walk])

    def _targets(self, walk: Any) -> Array:
        place, target = self.nodes["place"][walk["origin"]], np.full(len(walk), -1)
        for axis in range(len(self.grid.axes)):
            for way in (1, -1):
                rows = np.flatnonzero((walk["axis"] == axis) & (walk["way"] == way))
                target[rows] = self.grid.neighbour(place[rows], axis, way)
        return target

    # ---- steps ---------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Make one Newton step of each orbit on its way; add those that arrive to the known ones."""
        w, rows = self.walk, np.arange(len(self.walk))
        h = np.where(w["stage"] == _STEP, w["h"], 0.0)
        move = w["way"] * h
        last = h >= np.abs(w["end"] - w["u"]) - 1e-12
        u = np.where(last & (w["stage"] == _STEP), w["end"], w["u"] + move)
        guess = w["z"] + w["slope"] * move[:, None]
        place = self.nodes["place"][w["origin"]]
        v = self._evaluated(place, w["axis"], u, guess, w["period"], w["stage"] == _SETTLE)
        z, slope = guess + v.step, v.slopes[rows, w["axis"]]
        size = np.linalg.norm(v.step, axis=1)
        gap = self._gap(guess, v.images, w["period"])
        half = self._difference(v.images[rows, np.maximum(w["period"] // 2 - 1, 0)] * self.scales, guess * self.scales)
        length = np.hypot(np.linalg.norm(w["slope"], axis=1) * h, h)
        back = np.linalg.norm(z - slope * move[:, None] - w["z"], axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.maximum(size, back) / length
        is_step, converged = w["stage"] == _STEP, size <= SAME_CONNECTED
        good = np.isfinite(v.det) & np.isfinite(slope).all(axis=1) & (gap >= self.settings.collapsed * w["gap"])
        passed = is_step & good & (error <= self.settings.near)
        # after a doubling det(1 + M) of the orbit of half the period must change its sign before long
        same = passed & (w["sign"] == v.sign)
        lost = same & ((u - w["limit"]) * w["way"] >= 0.0)
        passed &= ~lost
        fixed = ~is_step & np.isfinite(size) & (size < self.settings.longest) & (w["tries"] < self.settings.corrections)
        settled = fixed & (w["stage"] == _SETTLE) & good & converged
        arrived = settled & (w["u"] == w["end"])
        self._take(w, passed, u, v.det)
        for k, value in (("z", z), ("slope", slope), ("half", half), ("gap", gap)):
            w[k][passed | fixed] = value[passed | fixed]
        w["sign"][passed & ~same] = 0.0
        w["tries"] += 1
        refused = is_step & ~passed & ~lost
        ended = refused & w["is_ending"] & ~(good & (error <= self.settings.beyond))
        # an orbit after one Newton step is good enough for a step as long, not for shorter ones
        w["stage"][(passed & last) | (refused & w["is_rough"] & ~ended)] = _SETTLE
        w["tries"][is_step] = 0
        w["is_ending"] = self._foresees_an_end(w, passed)
        w["is_rough"][passed], w["is_rough"][settled] = ~converged[passed], False
        w["stage"][settled], w["det"][settled] = _STEP, v.det[settled]
        w["h"][passed] *= np.minimum(2.0, 0.7 * self.settings.near / np.maximum(error[passed], 1e-12))
        w["h"][refused] *= np.clip(np.nan_to_num(0.7 * self.settings.near / error[refused], nan=0.25), 0.25, 0.5)
        self._begin_half(w, fixed & (w["stage"] == _HALVE) & converged, v)
        w["reach"][is_step] = w["h"][is_step]
        self._keep_off_zero(w, passed, refused)
        w["h"] = np.minimum(w["h"], np.minimum(np.abs(w["end"] - w["u"]), _longest(w["slope"], self.settings)))
        self._finish(w, arrived, lost | (~is_step & ~fixed), ended, np.maximum(h, w["shortest"]), v)

    def _take(self, w: Any, passed: Array, u: Array, det: Array) -> None:
        for before, now, value in (("u_before", "u", u), ("det_before", "det", det)):
            w[before][passed] = w[now][passed]
            w[now][passed] = value[passed]
        w["slope_before"][passed] = w["slope"][passed]
        w["has_moved"][passed] = True

    def _keep_off_zero(self, w: Any, passed: Array, refused: Array) -> None:
        """Change steps that would end where det(1 - M) vanishes, as Newton's method has no direction there.

        A step goes as far beyond as the orbit is before; if this step is refused, the next goes half of the way. At a
        fold no orbit is beyond. An orbit that loses its symmetry goes on.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            zero = np.abs(w["u"] - w["u_before"]) * w["det"] / (w["det_before"] - w["det"])
        close = w["has_moved"] & (w["h"] > 0.5 * zero) & (w["h"] < 2.0 * zero)
        over = passed & (close | w["is_ending"])
        w["h"][over] = 2.0 * zero[over]
        w["stage"][over & (~w["is_ending"] | (w["period"] % 2 == 0))] = _SETTLE
        w["h"][refused & close] = 0.5 * zero[refused & close]

    def _foresees_an_end(self, w: Any, passed: Array) -> Array:
        """Return whether two steps foresee a fold or a doubling at one value before the next point."""
        ahead, before = _distance_to_fold(w), w["end_at"].copy()
        at = w["u"] + w["way"] * ahead
        w["end_at"][passed] = at[passed]
        near = (ahead > 0.0) & (ahead <= 4.0 * np.abs(w["u"] - w["u_before"]))
        with np.errstate(invalid="ignore"):  # both are infinite where the derivative stays constant
            agrees = np.abs(at - before) <= self.settings.agreed * ahead
        return np.asarray(passed & near & ((w["end"] - at) * w["way"] > 0.0) & agrees & self._steepens(w))

    def _steepens(self, w: Any) -> Array:
        """Return whether a slope has a part that grows as det(1 - M) falls, as it does towards a fold or a doubling."""
        slope = w["slope"]
        with np.errstate(invalid="ignore", divide="ignore"):
            part = (slope - w["slope_before"]) * (w["det_before"] / (w["det_before"] - w["det"]))[:, None]
            return np.asarray((part * slope).sum(axis=1) >= self.settings.singular * (slope**2).sum(axis=1))

    def _begin_half(self, w: Any, ready: Array, v: Values) -> None:
        """Go on with orbits of half the period: the next step must pass a doubling of theirs."""
        w["stage"][ready], w["sign"][ready], w["tries"][ready] = _STEP, v.sign[ready], 0
        w["h"][ready] = np.abs(w["limit"] - w["u"])[ready]
        w["halvings"][ready] += 1
        w["det"][ready], w["has_moved"][ready] = v.det[ready], False

    def _finish(self, w: Any, arrived: Array, lost: Array, ended: Array, tried: Array, v: Values) -> None:
        """Take the orbits that arrived, halve those that reach a doubling, and end those that are stuck."""
        short = np.minimum(
            w["shortest"] * np.where(w["has_moved"], 1.0, self.settings.before_first), np.abs(w["end"] - w["u"])
        )
        stuck = ~arrived & (w["stage"] == _STEP) & ((w["h"] < short) | (w["h"] <= 1e-12) | ended)
        ahead = _distance_to_fold(w)
        fold = w["has_moved"] & (ahead > 0.0) & (ahead < 10.0 * tried) & self._steepens(w)
        first = stuck & (w["halvings"] == 0)
        w["is_fold"][first] = fold[first]
        halves = (
            stuck
            & (w["sign"] == 0.0)
            & (w["period"] % 2 == 0)
            & (np.linalg.norm(w["half"], axis=1) < self.settings.halved)
        )
        w["z"][halves] += 0.5 * w["half"][halves]
        w["period"][halves] //= 2
        w["gap"][halves] = 0.0
        beyond = 4.0 * np.maximum(np.where(fold, ahead, 0.0), tried)
        beyond = np.minimum(beyond, np.abs(w["end"] - w["u"]))
        w["limit"][halves] = (w["u"] + w["way"] * beyond)[halves]
        w["stage"][halves], w["tries"][halves] = _HALVE, 0
        ends = ((stuck & ~halves) | lost) & ~self._beyond_strobe(w, first & w["has_moved"] & ~fold & ~halves, tried)
        self._mark(w[ends & w["is_fold"]], ENDED)
        self._mark(w[ends & ~w["is_fold"]], OPEN)
        self.walk = w[~ends & ~arrived]
        self._add(w[arrived], v, np.flatnonzero(arrived))

    def _beyond_strobe(self, w: Any, stuck: Array, tried: Array) -> Array:
        """Let orbits go on beyond an impact that coincides with the strobe; return which do."""
        passes = np.zeros(len(w), bool)
        for row in np.flatnonzero(stuck & (2.0 * tried < np.abs(w["end"] - w["u"]))):
            one, states = w[row : row + 1], []
            for move in one["way"] * tried[row] * np.array([[0.0], [-1.0]]):
                place, u = self.nodes["place"][one["origin"]], one["u"] + move
                packed, frequency = self.grid.parameters(place, one["axis"], u)
                here = (one["z"] + one["slope"] * move)[0] * self.scales
                states.append(other_side(self.grid.system, here, packed[0], float(frequency[0]), int(one["period"][0])))
            if states[0] is None or states[1] is None:
                continue
            passes[row] = True
            one["z"] = states[0] / self.scales + 2.0 * self._difference(states[0], states[1])
            one["u"] += 2.0 * tried[row] * one["way"]
            one["h"], one["stage"], one["tries"] = 4.0 * one["shortest"], _SETTLE, 0
            one["has_moved"], one["is_ending"], one["is_rough"] = False, False, True
        return passes

    def _add(self, w: Any, v: Values, rows: Array) -> None:
        """Add the orbits that arrived, unless they are known, and link them with those from which they came."""
        if not len(w):
            return
        n = len(self.nodes)
        new: Any = np.zeros(len(w), self.nodes.dtype)
        new["place"], new["period"] = self._targets(w), w["period"]
        new["slopes"], new["det"] = v.slopes[rows], v.det[rows]
        new["points"], new["reach"] = np.nan, np.inf
        new["reach"][np.arange(len(w)), w["axis"]] = w["reach"]
        width = v.images.shape[1]
        new["points"][:, 1:width] = v.images[rows, : width - 1]
        new["points"][:, 0] = w["z"]
        new["points"][np.arange(new["points"].shape[1]) >= w["period"][:, None]] = np.nan
        target = self._taken(new)
        doubled = w["halvings"] > 0
        self._mark(w[doubled], ENDED)
        self._links.append(np.column_stack([w["origin"], target, w["halvings"]])[doubled])
        self._mark(w[~doubled], OPEN)
        for axis in range(len(self.grid.axes)):
            own = np.flatnonzero(~doubled & (w["axis"] == axis))
            up = w["way"][own] > 0
            a, b = np.where(up, w["origin"][own], target[own]), np.where(up, target[own], w["origin"][own])
            a, b = self._free(a, b, axis)
            _, one = np.unique(a, return_index=True)
            a, b = a[one], b[one]
            _, one = np.unique(b, return_index=True)
            self._link(a[one], b[one], axis)
        self._compare(np.arange(n, len(self.nodes)))


def _distance_to_fold(w: Any) -> Array:
    """Return how far a fold is ahead: towards it det(1 - M) falls as the root of the distance."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.abs(w["u"] - w["u_before"]) * w["det"] ** 2 / (w["det_before"] ** 2 - w["det"] ** 2))


def _longest(slope: Array, settings: SheetSettings) -> Array:
    """Return the longest change of a parameter within the longest step."""
    return np.asarray(0.999 * settings.longest / np.hypot(np.linalg.norm(slope, axis=1), 1.0))
