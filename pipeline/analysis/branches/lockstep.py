"""Many computations in step, whose trajectories share the engine's lanes.

A computation is a generator: it yields a `Query`, gets the `Value` of its problem there, and returns its
result. A single orbit would fill one lane of sixteen; all computations that wait are served in one call,
for little more than the price of one. The numbers of each are those that it would get alone.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from magpend_core.engine.simd import WIDTH
from magpend_core.engine.system import System
from magpend_core.orbits import section_map
from pipeline.analysis.branches.problems import RTOL, Ends, Problem, Rows, Value
from pipeline.products.reporting import report

T = TypeVar("T")


@dataclass(frozen=True)
class Query:
    """A problem to be evaluated at `u`."""

    problem: Problem
    u: np.ndarray


Steps = Generator[Query, Value, T]
"""A computation that returns a `T`."""


def run_together(computations: Sequence[Steps[T]], what: str = "") -> list[T]:
    """Run computations to their ends and return their results, in their order.

    With a name for the work it is reported how far it is. A trace's length is not known before its end: it
    counts by the part of the parameter's interval that it has seen, up to nine tenths.
    """
    results: list[T | None] = [None] * len(computations)
    waiting: dict[int, Query] = {}
    seen: dict[int, tuple[float, float]] = {}

    def advance(i: int, value: Value | None) -> None:
        try:
            waiting[i] = next(computations[i]) if value is None else computations[i].send(value)
        except StopIteration as stop:
            results[i] = stop.value

    for i in range(len(computations)):
        advance(i, None)
    while waiting:
        queries, waiting = waiting, {}
        for i, value in zip(queries, _evaluate(list(queries.values())), strict=True):
            advance(i, value)
        if what:
            _report(what, queries, waiting, seen, len(computations))
    return results  # type: ignore[return-value]


def _report(
    what: str,
    queries: Mapping[int, Query],
    waiting: Iterable[int],
    seen: dict[int, tuple[float, float]],
    n: int,
) -> None:
    """Say how far computations are; `seen` has the range of the last unknown of those that go on."""
    for i, query in queries.items():
        last = float(query.u[-1])
        low, high = seen.get(i, (last, last))
        seen[i] = min(low, last), max(high, last)
    going = [min(seen[i][1] - seen[i][0], 0.9) for i in waiting]
    report(what, round(n - len(going) + sum(going), 1), n)


def run_alone(computation: Steps[T]) -> T:
    """Run one computation."""
    return run_together([computation])[0]


def _evaluate(queries: Sequence[Query]) -> list[Value]:
    rows = [q.problem.rows(q.u) for q in queries]
    ends: list[Ends | None] = [None] * len(rows)
    for chosen in _calls(rows, [q.problem.system for q in queries]):
        system = queries[chosen[0]].problem.system
        for i, found in zip(chosen, _integrate([rows[i] for i in chosen], system), strict=True):
            ends[i] = found
    return [q.problem.value(q.u, e) for q, e in zip(queries, ends, strict=True) if e is not None]


def _calls(rows: Sequence[Rows], systems: Sequence[System]) -> list[list[int]]:
    """Which queries share a call: those of one system and period, all periods if they fit into a group."""
    by_system: dict[str, list[int]] = {}
    for i, system in enumerate(systems):
        by_system.setdefault(system.label, []).append(i)
    calls: list[list[int]] = []
    for members in by_system.values():
        if sum(len(rows[i].states) for i in members) <= WIDTH:
            calls.append(members)
            continue
        by_period: dict[int, list[int]] = {}
        for i in members:
            by_period.setdefault(rows[i].period, []).append(i)
        calls.extend(by_period.values())
    return calls


def _integrate(rows: Sequence[Rows], system: System) -> list[Ends]:
    ends = section_map(
        np.concatenate([r.parameters for r in rows]),
        np.concatenate([r.frequency_hz for r in rows]),
        np.concatenate([r.states for r in rows]),
        np.concatenate([np.full(len(r.states), r.period) for r in rows]),
        rtol=RTOL,
        system=system,
    )
    found, first = [], 0
    for r in rows:
        own = slice(first, first + len(r.states))
        found.append(Ends(ends.images[own, : r.period], ends.derivatives[own], ends.times[own, : r.period]))
        first += len(r.states)
    return found
