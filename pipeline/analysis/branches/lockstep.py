"""Run many continuations side by side: each yields a `Query`, and receives the `Value` of its problem.

A call of the engine costs as much as its groups of `WIDTH` trajectories, full or not. So the trajectories that do not
fill a group wait for those of the next call.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from magpend_core.engine.simd import WIDTH
from magpend_core.engine.system import System
from magpend_core.orbits import section_map
from pipeline.analysis import together
from pipeline.analysis.branches.problems import Ends, Problem, Rows, Value
from pipeline.products.reporting import report
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(eq=False)
class Query:
    """Request to evaluate the equations of a problem at the unknowns `u`."""

    problem: Problem
    u: np.ndarray

    @cached_property
    def rows(self) -> Rows:
        """The trajectories that the problem needs next."""
        return self.problem.rows(self.u)

    def value(self, ends: Ends) -> Value | None:
        """Return the value from the ends of `rows`; None if the problem needs more trajectories, then in `rows`."""
        del self.rows
        return self.problem.value(self.u, ends)


T = TypeVar("T")
Steps = Generator[Query, Value, T]
"""A computation that returns a `T`."""


@dataclass(eq=False)
class Begun(Generic[T]):
    """A computation that advances beside others before its result is needed."""

    computation: Steps[T]
    query: Query | None = field(init=False)  # not yet answered; None at the end
    result: T = field(init=False)

    def __post_init__(self) -> None:
        self.send(None)

    def send(self, value: Value | None) -> None:
        """Answer the query, and advance to the next one or to the end."""
        try:
            self.query = self.computation.send(value)  # type: ignore[arg-type]
        except StopIteration as end:
            self.query, self.result = None, end.value

    def rest(self) -> Steps[T]:
        """Run the computation from here to its end."""
        while self.query is not None:
            self.send((yield self.query))
        return self.result


Beside = Callable[[Sequence[Query]], Iterable[Begun[Any]]]
"""Function that returns the computations that advance beside others, from the queries of the others."""


def run_together(
    computations: Sequence[Steps[T]], what: str = "", rtol: float = BRANCH_RTOL, beside: Beside = lambda _: ()
) -> list[T]:
    """Run computations side by side to their ends, and return their results in the given order.

    If the work has a name, progress is reported. The length of a trace is unknown before its end, so it
    counts by the part of the parameter's interval that it has covered, up to nine tenths. `rtol` is the
    tolerance of the integrations. The computations that `beside` returns advance until these have ended.
    """
    covered = [0.0] * len(computations)
    seen: dict[int, tuple[float, float]] = {}
    waiting: dict[Query, int | Begun[Any]] = {}  # whose they are, in the order in which they were asked

    def answer(queries: dict[int, Query], results: Mapping[int, T]) -> dict[int, Value]:
        for i, query in queries.items():
            last = float(query.u[-1])
            low, high = seen.get(i, (last, last))
            seen[i] = min(low, last), max(high, last)
            covered[i] = min(seen[i][1] - seen[i][0], 0.9)
        if what:
            report(what, round(len(results) + sum(covered[i] for i in queries), 1), len(computations))
        values: dict[int, Value] = {}
        while not values:
            for i, query in queries.items():
                waiting.setdefault(query, i)
            for begun in beside(list(queries.values())):
                if begun.query is not None:
                    waiting.setdefault(begun.query, begun)
            for query, value in _evaluated(waiting, rtol):
                owner = waiting.pop(query)
                if isinstance(owner, Begun):
                    owner.send(value)
                else:
                    values[owner] = value
        return values

    found = together.answer_together(dict(enumerate(computations)), answer)
    if what:
        report(what, len(computations), len(computations))
    return list(found.values())


def within(most: int, computation: Steps[T]) -> Steps[T | None]:
    """Run a computation until its end, or until it has asked for as many values as it may: then return None."""
    try:
        query = next(computation)
        for _ in range(most):
            query = computation.send((yield query))
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    computation.close()
    return None


def run_alone(computation: Steps[T]) -> T:
    """Run one computation and return its result."""
    return run_together([computation])[0]


def _evaluated(queries: Iterable[Query], rtol: float) -> list[tuple[Query, Value]]:
    """Return values of some queries: integrate the next trajectories of those that together fill the engine's lanes."""
    by_system: dict[str, list[Query]] = {}
    for query in queries:
        by_system.setdefault(query.problem.system.label, []).append(query)
    found = []
    for asked in by_system.values():
        chosen = [asked[i] for i in _filling([len(query.rows.states) for query in asked])]
        ends = integrated([query.rows for query in chosen], chosen[0].problem.system, rtol)
        values = [query.value(end) for query, end in zip(chosen, ends, strict=True)]
        found += [(query, value) for query, value in zip(chosen, values, strict=True) if value is not None]
    return found


def _filling(sizes: Sequence[int]) -> list[int]:
    """Choose queries for a call, the first ones first, by their numbers of trajectories: all, or those that fill whole
    groups of lanes if the others fill at most half of one.
    """
    total = sum(sizes)
    rest = total % WIDTH if total > WIDTH else 0
    room = total - rest if rest <= WIDTH // 2 else total
    chosen: list[int] = []
    for i, n in enumerate(sizes):
        if n <= room or not chosen:
            chosen.append(i)
            room -= n
    return chosen


def integrated(rows: Sequence[Rows], system: System, rtol: float = BRANCH_RTOL) -> list[Ends]:
    """Integrate in one call of the engine the trajectories that several computations have requested."""
    if not any(len(r.states) for r in rows):  # equilibria alone
        n = system.n_states
        none = np.zeros((0, n))
        return [Ends(none, none[:, None], none[:, None], none[:, :0]) for _ in rows]
    ends = section_map(
        np.concatenate([r.parameters for r in rows]),
        np.concatenate([r.frequency_hz for r in rows]),
        np.concatenate([r.states for r in rows]),
        np.concatenate([np.full(len(r.states), r.period) for r in rows]),
        rtol=rtol,
        system=system,
    )
    found, first = [], 0
    for r in rows:
        own = slice(first, first + len(r.states))
        found.append(Ends(r.states, ends.images[own, : r.period], ends.derivatives[own], ends.times[own, : r.period]))
        first += len(r.states)
    return found
