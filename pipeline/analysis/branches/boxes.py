"""Find all equilibria of a flow in a box of states, with a proof of their number where the model's text allows it.

The proof divides the box. Enclosures of the rates, by interval arithmetic, exclude a part in which one of them has no
zero. In another part the Krawczyk operator K(Z) = c - Y f(c) + (1 - Y J(Z)) (Z - c), with the middle c of Z, a matrix Y
near the inverse of the Jacobian there, and an enclosure J(Z) of the Jacobian, contains all equilibria of Z; if it lies
in the inside of Z, then Z has exactly one (Krawczyk, Computing 4, 1969, 187; Moore, SIAM J. Numer. Anal. 14, 1977,
611). Parts without a decision are divided again. Each part is tested with a margin about it, so that an equilibrium on
a cut lies inside.

Without a text, or where rates jump, Newton's method from many starts finds equilibria, and deflation of those that are
known drives it to others. Their number is not proved then.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from magpend_core.engine.system import System
from magpend_core.equilibria import find_equilibria, newton_steps
from magpend_core.models.text.intervals import Rates
from magpend_core.orbits import scaled_distance, wrap_angles
from pipeline.analysis.branches.deflation import DeflationSettings, FoundOrbit, stretch
from pipeline.results.tolerances import SAME_ON_BRANCH


@dataclass(frozen=True)
class BoxSettings:
    """Numbers of the search for all equilibria in a box."""

    batch: int = 2048  # boxes looked at together; more are faster, and take memory
    most_boxes: int = 300_000  # boxes looked at in all; what is left then is not decided
    # size of a box, as a share of the whole, that is not divided any more; smaller ones prove more, and cost more boxes
    smallest: float = 1e-8
    # width by which a box is widened on either side before the test, in its own width: a wider one owns its
    # neighbourhood, but fails the test more often
    margin: float = 0.1
    cut: float = 0.4871  # share at which a box is divided: not in its middle, where equilibria of symmetric models lie
    overlap: float = 0.01  # angle by which two copies of a full turn overlap [rad], so that it has no border
    starts: int = 400  # starts of Newton's method for a count that is not proved; more find more, and take longer
    newton: DeflationSettings = DeflationSettings()  # of their iterations


@dataclass(frozen=True, eq=False)
class Box:
    """Box of states: its corners (n_states,), and which states are angles that it contains in full."""

    low: np.ndarray
    high: np.ndarray
    is_full: np.ndarray

    @property
    def width(self) -> np.ndarray:
        """Widths of the box, shape (n_states,)."""
        return np.asarray(self.high - self.low)


@dataclass(eq=False)
class Enclosed:
    """Equilibria in a box: the enclosure of each, and the corners of the parts in which nothing is decided."""

    low: list[np.ndarray] = field(default_factory=list)
    high: list[np.ndarray] = field(default_factory=list)
    undecided: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    on_border: list[np.ndarray] = field(default_factory=list)  # equilibria that may lie in the box or beside it

    @property
    def is_proved(self) -> bool:
        """Whether the box has exactly these equilibria."""
        return not self.undecided and not self.on_border

    @property
    def states(self) -> np.ndarray:
        """Middles of the enclosures, shape (n, n_states)."""
        return np.asarray(0.5 * (np.array(self.low) + np.array(self.high)))


def enclose_equilibria(rates: Rates, box: Box, settings: BoxSettings = BoxSettings()) -> Enclosed:
    """Enclose all equilibria of a box; parts in which they touch, or nearly do, stay undecided.

    The enclosures of rates and Jacobian have no obstacle.
    """
    search = _Search(rates, box, settings=settings)
    turn = np.where(box.is_full, settings.overlap, 0.0)
    pending = [((box.low - turn)[None], (box.high + turn)[None])]
    n_seen = 0
    while pending and n_seen < settings.most_boxes:
        low, high = pending.pop()
        if len(low) > settings.batch:
            pending.append((low[settings.batch :], high[settings.batch :]))
            low, high = low[: settings.batch], high[: settings.batch]
        n_seen += len(low)
        parts = search.look_at(low, high)
        if len(parts[0]):
            pending.append(parts)
    rest = [*search.small, *((a, b) for low, high in pending for a, b in zip(low, high, strict=True))]
    search.found.undecided += [part for part in rest if not search.is_covered(*(end[None] for end in part))[0]]
    return search.found


class _Search:
    """State of a search: the equilibria found, and the regions that are known to have exactly one each."""

    def __init__(self, rates: Rates, box: Box, settings: BoxSettings) -> None:
        self.settings = settings
        self.rates, self.box, self.found = rates, box, Enclosed()
        n = len(box.low)
        self.regions = np.empty((0, n)), np.empty((0, n))
        self.own: list[tuple[np.ndarray, np.ndarray]] = []  # region of each equilibrium found, in its order
        self.small: list[tuple[np.ndarray, np.ndarray]] = []

    def is_covered(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return which of some boxes lie in a region that has one equilibrium, which is known."""
        first, last = self.regions
        inside = (first <= low[:, None]) & (high[:, None] <= last)
        return np.asarray(np.any(np.all(inside, axis=2), axis=1))

    def look_at(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Exclude boxes, record the equilibria of others, and return the halves of the rest."""
        least, greatest = self.rates.rates(low, high)
        may = (least <= 0.0).all(axis=1) & (greatest >= 0.0).all(axis=1) & ~self.is_covered(low, high)
        low, high = low[may], high[may]
        if not len(low):
            return low, high
        margin = self.settings.margin * (high - low)
        wide = low - margin, high + margin
        first, last = krawczyk(self.rates, *wide)
        has_one = ((wide[0] < first) & (last < wide[1])).all(axis=1)
        for row in np.flatnonzero(has_one):
            self._record(*(end[row] for end in (*wide, first, last)))
        low, high = np.maximum(low, first), np.minimum(high, last)
        rest = ~has_one & (low <= high).all(axis=1)
        return self._halves(low[rest], high[rest])

    def _halves(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        share = (high - low) / self.box.width
        is_small = share.max(axis=1, initial=0.0) < self.settings.smallest
        self.small += list(zip(low[is_small], high[is_small], strict=True))
        low, high, share = low[~is_small], high[~is_small], share[~is_small]
        rows, widest = np.arange(len(low)), share.argmax(axis=1) if len(low) else np.zeros(0, int)
        cut = low[rows, widest] + self.settings.cut * (high[rows, widest] - low[rows, widest])
        upper, lower = low.copy(), high.copy()
        upper[rows, widest] = lower[rows, widest] = cut
        return np.concatenate([low, upper]), np.concatenate([lower, high])

    def _record(self, wide_low: np.ndarray, wide_high: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        """Record the equilibrium of a region, unless it is known."""
        tiny = 1e-14  # error of an angle that is moved by a full turn [rad]
        self.regions = np.vstack([self.regions[0], wide_low]), np.vstack([self.regions[1], wide_high])
        for _ in range(20):
            first, last = krawczyk(self.rates, low[None], high[None])
            closer = np.maximum(low, first[0]), np.minimum(high, last[0])
            if not (closer[1] - closer[0] < 0.9 * (high - low)).any():
                break
            low, high = closer
        for shift, (a, b), (c, d) in self._known():
            error = tiny * abs(np.sign(shift))
            moved = low + shift - error, high + shift + error
            if ((c <= moved[0]) & (moved[1] <= d)).all() or ((wide_low + shift <= a) & (b <= wide_high + shift)).all():
                return
            if ((moved[0] <= b) & (a <= moved[1])).all():
                self.found.undecided.append((low, high))
                return
        if not (self.box.is_full | ((self.box.low <= low) & (high <= self.box.high))).all():
            beside = ~self.box.is_full & ((high < self.box.low) | (low > self.box.high))
            middle, others = 0.5 * (low + high), self.found.on_border
            if not beside.any() and not any(
                (np.abs(middle - one) < self.settings.smallest * self.box.width).all() for one in others
            ):
                others.append(middle)
            return
        self.found.low.append(low)
        self.found.high.append(high)
        self.own.append((wide_low, wide_high))

    def _known(self) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]]:
        """Yield each known equilibrium's enclosure and region, with each shift of angles by full turns."""
        turns = [(0.0, -2.0 * np.pi, 2.0 * np.pi) if full else (0.0,) for full in self.box.is_full]
        for shift in map(np.array, product(*turns)):
            for low, high, region in zip(self.found.low, self.found.high, self.own, strict=True):
                yield shift, (low, high), region


def krawczyk(rates: Rates, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the Krawczyk operator of boxes with corners of shape (n, n_states): it has all their equilibria.

    The result is without bounds where the Jacobian has none, or is singular in the middle.
    """
    relative = 1e-12  # bounds the rounding of products of matrices, by a factor of 1000 at least
    n = low.shape[1]
    first, last = rates.jacobian(low, high)
    with np.errstate(all="ignore"):
        middle = 0.5 * (first + last)
        radius = np.nextafter(np.maximum(last - middle, middle - first), np.inf)
        good = np.asarray(np.isfinite(radius).all(axis=(1, 2)))
        good[good] = np.abs(np.linalg.det(middle[good])) > 0.0
        inverse = np.linalg.inv(np.where(good[:, None, None], middle, np.eye(n)))
        good &= np.isfinite(inverse).all(axis=(1, 2))
        centre = 0.5 * (low + high)
        reach = np.nextafter(np.maximum(high - centre, centre - low), np.inf)
        at = rates.rates(centre, centre)
        value = 0.5 * (at[0] + at[1])
        spread = np.nextafter(np.maximum(at[1] - value, value - at[0]), np.inf)
        size = np.abs(inverse)
        rounding = relative * (1.0 + size @ np.abs(middle))
        slope = np.abs(np.eye(n) - inverse @ middle) + size @ radius + rounding
        step = (inverse @ value[..., None])[..., 0]
        error = (size @ (spread + relative * np.abs(value))[..., None])[..., 0] + (slope @ reach[..., None])[..., 0]
        error = error * (1.0 + relative) + 4.0 * np.spacing(np.abs(centre) + np.abs(step))
        found = centre - step - error, centre - step + error
        good &= np.isfinite(found[0]).all(axis=1) & np.isfinite(found[1]).all(axis=1)
    return np.where(good[:, None], found[0], -np.inf), np.where(good[:, None], found[1], np.inf)


def search_equilibria(
    system: System, packed: np.ndarray, box: Box, known: np.ndarray, settings: BoxSettings = BoxSettings()
) -> np.ndarray:
    """Search a box for equilibria by Newton's method from random starts; each one found is deflated.

    Return the known ones first, shape (n, n_states). The system is a flow without a drive.
    """
    generator, found = np.random.default_rng(0), list(known)
    for _ in range(1 + settings.newton.rounds):
        starts = generator.uniform(box.low, box.high, (settings.starts, len(box.low)))
        ends = find_equilibria(system, _deflated(system, packed, starts, found, settings.newton), packed)
        n_before = len(found)
        for state in wrap_angles(ends.states[ends.converged], system):
            inside = (box.is_full | ((box.low <= state) & (state <= box.high))).all()
            if inside and all(scaled_distance(one, state, system) > SAME_ON_BRANCH for one in found):
                found.append(state)
        if len(found) == n_before:
            break
    return np.array(found).reshape(-1, system.n_states)


def _deflated(
    system: System, packed: np.ndarray, starts: np.ndarray, found: list[np.ndarray], settings: DeflationSettings
) -> np.ndarray:
    """Iterate Newton's method with deflation of known equilibria; return the last states."""
    state, scales = starts.copy(), np.asarray(system.scales)
    known = [FoundOrbit(one[None], np.eye(len(one)), 0, 0) for one in found]
    once = np.ones(len(state), np.int64)
    for _ in range(settings.iterations):
        good = np.isfinite(state).all(axis=1)
        steps = np.zeros(state.shape)
        steps[good] = newton_steps(system, state[good], packed)[0] / scales
        steps *= stretch(state, once, steps, known, system)[:, None]
        longest = np.abs(steps).max(axis=1, keepdims=True)
        steps *= np.minimum(1.0, settings.longest_step / np.maximum(longest, 1e-9))
        state = wrap_angles(state + steps * scales, system)
    return state
