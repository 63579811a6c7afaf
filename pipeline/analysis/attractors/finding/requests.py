"""Collect the integrations that the analyses of all parameter points request, and run them together in the engine.

The work on a point is a generator: it yields a request and receives the answer. All points advance in step,
so that their trajectories fill the engine's lanes together.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from magpend_core.defaults import ATOL, MOST_STEPS, RTOL
from magpend_core.engine.system import System
from magpend_core.orbits import section_map
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block, Guesses
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, polish, run_on
from pipeline.analysis.attractors.finding.points import Point
from pipeline.analysis.attractors.finding.spirals import near_closed
from pipeline.analysis.attractors.flight import Flight
from pipeline.analysis.together import answer_together
from pipeline.products.reporting import UNTOLD, report
from pipeline.results.sets import Geometry, hashes
from pipeline.results.tolerances import SLOPE_RTOL, STRICT

FINDING, EXTENDING = "finding attractors", "extending cells"
"""Names of the work before and after the first leg of an extension."""

LEG = 64
"""Number of drive periods or returns in a leg of an extension: what a trajectory does is looked at leg by leg."""


@dataclass(frozen=True)
class Leg:
    """Request to integrate trajectories over some legs of `LEG` sections, from states (n, state) with step sizes (n,).

    With a step size of 0 the engine chooses the step. `spent` is the part of the point's budget that is spent. The
    answer is a `Block` of the new sections, with a row for each leg: first those of the first trajectory. The `state`
    and `step` of its last leg continue a trajectory bit for bit.
    """

    state: np.ndarray
    step: np.ndarray
    spent: float = 0.0
    n_legs: int = 1


@dataclass(frozen=True)
class Polish:
    """Request to refine guesses of closed orbits by Newton's method. The answer has an `Orbit` or None for each guess.

    Guesses without a period are first integrated until they close.
    """

    guesses: Guesses


@dataclass(frozen=True)
class Slopes:
    """Request to map points (n, state) by the section map once, and to compute the map's derivatives there.

    The answer is a pair of arrays, shapes (n, state) and (n, state, state).
    """

    point: np.ndarray
    rtol: float = SLOPE_RTOL


@dataclass(frozen=True)
class Decide:
    """Request to assign the rows of a block to orbits. The answer has the index of each row's orbit, -1 for none; see
    `assigning.decide`.
    """

    block: Block
    orbits: Sequence[Orbit]


@dataclass(frozen=True)
class Recur:
    """Request to guess orbits from section points (n, k, state) that recur ever more closely. The answer has the
    guesses; see `spirals.near_closed`.
    """

    section: np.ndarray


Request = Leg | Polish | Slopes | Decide | Recur
T = TypeVar("T")
Work = Generator[Request, Any, T]
"""The analysis of a point: a generator that yields requests, receives answers and returns its result."""


@dataclass(frozen=True)
class Effort:
    """Numbers of the extension of cells on no known orbit: more of each decides more sets, and takes longer."""

    least_budget: int = 16_384  # least budget of a parameter point [periods], however short the run was
    # Fewest trajectories that must stay on a chaotic set before it is said to attract, for a budget of 1; and the most
    # that a larger budget asks for, in proportion. Beside too few cells neighbours are drawn. A single cell can outlive
    # the bound on a set that most cells leave before.
    least_paths: int = 8
    most_paths: int = 64
    # least extension of a cell [sections]: enough points to separate two sets, and chaos from a torus
    least_stay: int = 512
    times_longest: float = 10.0  # a sample has stayed long enough after this many times the longest transient seen
    doublings: int = 3  # most doublings of the extension while a set is in doubt
    rounds: int = 6  # most samples of a parameter point; each is twice as large as the one before
    # orbits are searched after 1, 2, 4, ... legs and every `search_each` legs: Newton steps are expensive
    search_each: int = 32
    most_legs: int = 8  # most legs that are integrated at once: as many as before, and so twice as many each time
    look_back: int = 4  # legs searched for a period: four legs show periods of up to two legs
    # most derivatives of the section map for the exponents of a set: at first, and if the first are too few
    slopes: tuple[int, ...] = (1024, 4096)
    asked: int = 4  # most trajectories of a set whose neighbours show whether it is a torus or a family
    shaped: int = 1024  # most section points that the test for a torus uses


@dataclass(frozen=True)
class Settings:
    """Settings with which trajectories of a run are integrated further: tolerances, limits, system and method."""

    # tolerances of the run
    rtol: float
    atol: float
    max_steps: int  # most steps per period
    closure: float  # scaled distance at which extended cells count as closed
    longest: int  # longest orbit period in the search
    residual: float  # scaled residual that Newton's method is to reach
    seen: int  # drive periods or returns for which the run integrated a cell
    system: System | None  # system to integrate
    method: str  # integration method of the run, also used for legs
    geometry: Geometry  # geometry of the states
    # orbits that were polished before, see `closed_orbits.polish`
    known: dict[bytes, Orbit | None] = field(default_factory=dict, compare=False, repr=False)
    effort: Effort = Effort()

    @classmethod
    def of(cls, ds: xr.Dataset, system: System | None, geometry: Geometry, **asked: Any) -> Settings:
        """Read the settings of the run from the attributes of its result cube."""
        given = ds.attrs
        method = str(given.get("method", system.method if system is not None else ""))
        seen = int(given.get("n_transient", 0)) + int(given.get("n_keep", ds.sizes["period_index"]))
        return cls(
            float(given.get("rtol", RTOL)),
            float(given.get("atol", ATOL)),
            int(given.get("max_steps_per_period", MOST_STEPS)),
            seen=seen,
            system=system,
            method=method,
            geometry=geometry,
            **asked,
        )

    def fly(
        self,
        packed: np.ndarray,
        frequency: np.ndarray | float,
        states: np.ndarray,
        most: int = LEG,
        step: np.ndarray | None = None,
    ) -> Flight:
        """Return trajectories that are integrated as those of the run; see `Flight`."""
        assert self.system is not None
        return Flight(
            replace(self.system, method=self.method),
            packed,
            frequency,
            states,
            rtol=self.rtol,
            atol=self.atol,
            max_steps=self.max_steps,
            closure=self.closure,
            longest=self.longest,
            most=most,
            step=step,
        )


def answer_all(
    works: Mapping[tuple[int, ...], Work[T]], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], T]:
    """Run the analyses of all parameter points side by side, and answer their requests together. Return the result of
    each point.

    Progress is the number of points that are decided, and of a point whose cells are extended the part of its budget
    that is spent. A point may take a thousand times longer than another, so this number does not tell the time left.

    Requests of one kind are answered at a time. What costs little comes first, so that many points wait for what costs
    much, and share it.
    """
    what = FINDING

    def answer(asked: dict[tuple[int, ...], Request], results: Mapping[tuple[int, ...], T]) -> dict[Any, Any]:
        nonlocal what
        legs = [one for one in asked.values() if isinstance(one, Leg)]
        what = EXTENDING if legs else what
        report(what, round(len(results) + sum(leg.spent for leg in legs), 2), len(works), UNTOLD)
        kind = min({type(one) for one in asked.values()}, key=list(_ANSWERS).index)
        answers = _ANSWERS[kind]({i: one for i, one in asked.items() if type(one) is kind}, points, settings)
        report(what, len(results), len(works), UNTOLD)
        return answers

    report(what, 0, len(works), UNTOLD)
    found = answer_together(works, answer)
    report(what, len(works), len(works), UNTOLD)
    return found


def _legs(
    asked: Mapping[tuple[int, ...], Leg], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], Block]:
    found: dict[tuple[int, ...], Block] = {}
    for n in {leg.n_legs for leg in asked.values()}:
        own = {index: leg for index, leg in asked.items() if leg.n_legs == n}
        sizes = [len(leg.state) for leg in own.values()]
        packed, frequency = _of_points([points[i] for i in own], np.repeat(range(len(own)), sizes))
        state, step = (np.concatenate([getattr(leg, name) for leg in own.values()]) for name in ("state", "step"))
        block = settings.fly(packed, frequency, state, step=step).legs(n, LEG)
        found |= {index: block.take(slice(n * at.start, n * at.stop)) for index, at in _slices(own, sizes)}
    return found


def _slices(asked: Mapping[tuple[int, ...], Any], sizes: Sequence[int]) -> list[tuple[tuple[int, ...], slice]]:
    ends = np.cumsum(sizes).tolist()
    return [(i, slice(end - n, end)) for i, n, end in zip(asked, sizes, ends, strict=True)]


def _polished(
    asked: Mapping[tuple[int, ...], Polish], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], list[Orbit | None]]:
    guesses = [replace(one.guesses, owner=np.full(len(one.guesses.key), k)) for k, one in enumerate(asked.values())]
    sizes = [len(one.key) for one in guesses]
    found, _ = polish_guesses(guesses[0].followed_by(*guesses[1:]), [points[i] for i in asked], settings)
    return {index: found[own] for index, own in _slices(asked, sizes)}


def polish_guesses(
    guesses: Guesses, points: Sequence[Point], settings: Settings
) -> tuple[list[Orbit | None], np.ndarray]:
    """Refine guesses of closed orbits by Newton's method, those of all parameter points together. Return an orbit or
    None for each guess, and the `Status` with which its search ended.
    """
    assert settings.system is not None
    packed, frequency = _of_points(points, guesses.owner)
    start, period = guesses.point.copy(), guesses.period.copy()
    unknown = np.flatnonzero(period == 0)
    start[unknown], period[unknown] = run_on(
        packed[unknown], frequency[unknown], start[unknown], settings.longest, settings.system
    )
    rows, place = _each_once(guesses.owner, start, period, guesses.mark, unknown, settings.geometry)
    status = np.full(len(rows) + 1, int(Status.BOUNDED))  # the last one is that of guesses that have not closed
    polished = polish(
        packed[rows],
        frequency[rows],
        start[rows],
        period[rows],
        geometry=settings.geometry,
        system=settings.system,
        tolerance=settings.residual,
        known=settings.known,
        status=status[:-1],
    )
    return [polished[i] if i >= 0 else None for i in place.tolist()], status[place]


def _each_once(
    search: np.ndarray, start: np.ndarray, period: np.ndarray, mark: np.ndarray, ended: np.ndarray, geometry: Geometry
) -> tuple[np.ndarray, np.ndarray]:
    """Drop duplicates from guesses of orbits. Return the guesses to refine, and for each given guess the one that
    stands for it.

    Rows that were integrated further and ended in one box are on one orbit; the row of least hash represents
    them. Rows without a period have no representative.
    """
    rows = np.arange(len(period))
    key = mark.copy()
    boxes = geometry.boxes(start[ended], STRICT)
    key[ended] = hashes(np.concatenate([period[ended, None], boxes], axis=1))
    group = np.stack([search.astype(np.uint64), np.isin(rows, ended).astype(np.uint64), key], axis=1)
    order = rows[np.lexsort((mark, *group.T[::-1]))]
    order = order[period[order] > 0]
    new = np.ones(len(order), bool)
    new[1:] = (group[order][1:] != group[order][:-1]).any(axis=1) | ~np.isin(order[1:], ended)
    place = np.full(len(period), -1)
    place[order] = np.cumsum(new) - 1
    return order[new], place


def _slopes(
    asked: Mapping[tuple[int, ...], Slopes], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]:
    found: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}
    for rtol in {request.rtol for request in asked.values()}:
        own = {index: request for index, request in asked.items() if request.rtol == rtol}
        sizes = [len(request.point) for request in own.values()]
        start, owner = np.concatenate([request.point for request in own.values()]), np.repeat(range(len(own)), sizes)
        images, derivatives = map_slopes(start, owner, [points[i] for i in own], settings, rtol)
        for index, rows in _slices(own, sizes):
            found[index] = images[rows], derivatives[rows]
    return found


def map_slopes(
    start: np.ndarray, owner: np.ndarray, points: Sequence[Point], settings: Settings, rtol: float
) -> tuple[np.ndarray, np.ndarray]:
    """Map states (n, state) by the section map once, each at its parameter point; return the images and the map's
    derivatives.
    """
    most = 16_384  # derivatives of the section map in one call of the engine
    assert settings.system is not None
    packed, frequency = _of_points(points, owner)
    images, derivatives = np.empty_like(start), np.empty((*start.shape, start.shape[1]))
    # some at a time: the map needs far more memory than its results
    for begin in range(0, len(start), most):
        some = slice(begin, begin + most)
        ways = section_map(packed[some], frequency[some], start[some], 1, rtol=rtol, system=settings.system)
        images[some], derivatives[some] = ways.images[:, -1], ways.derivatives
    return images, derivatives


def _of_points(points: Sequence[Point], owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the packed parameters and the frequency of the parameter point of each trajectory."""
    return np.array([point.packed for point in points])[owner], np.array([point.frequency for point in points])[owner]


def _decided(
    asked: Mapping[tuple[int, ...], Decide], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], np.ndarray]:
    blocks = [one.block for one in asked.values()]
    sizes, names = [len(block.status) for block in blocks], ("section", "status", "orbit_period", "turns")
    arrays = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    whole = Block(slice(0, sum(sizes)), owners=np.repeat(np.arange(len(sizes)), sizes), **arrays)
    owner = np.repeat(np.arange(len(sizes)), [len(one.orbits) for one in asked.values()])
    orbits = [orbit for one in asked.values() for orbit in one.orbits]
    label, _ = decide(whole, orbits, 10.0 * settings.closure, settings.geometry, owner)
    label = np.where(label < 0, -1, label - np.searchsorted(owner, whole.owner))
    return {index: label[own] for index, own in _slices(asked, sizes)}


def _recurring(
    asked: Mapping[tuple[int, ...], Recur], points: Mapping[tuple[int, ...], Point], settings: Settings
) -> dict[tuple[int, ...], Guesses]:
    found: dict[tuple[int, ...], Guesses] = {}
    for length in {one.section.shape[1] for one in asked.values()}:
        own = {index: one.section for index, one in asked.items() if one.section.shape[1] == length}
        owner = np.repeat(np.arange(len(own)), [len(section) for section in own.values()])
        section = np.concatenate([*own.values()])
        near = near_closed(section, settings.longest, settings.geometry, owner=owner, closing_only=True)
        found |= {index: near.of(k) for k, index in enumerate(own)}
    return found


_ANSWERS: dict[type, Callable[..., dict[tuple[int, ...], Any]]] = {
    Decide: _decided,
    Recur: _recurring,
    Polish: _polished,
    Slopes: _slopes,
    Leg: _legs,
}
"""Functions that answer the requests of all points, by their kind; the first kind is answered first."""
