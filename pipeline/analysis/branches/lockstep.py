"""Run many continuations side by side: each yields a `Query`, and receives the `Value` of its problem."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from magpend_core.engine.system import System
from magpend_core.orbits import section_map
from pipeline.analysis import together
from pipeline.analysis.branches.problems import Ends, Problem, Rows, Value
from pipeline.products.reporting import report
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(frozen=True)
class Query:
    """Request to evaluate the equations of a problem at the unknowns `u`."""

    problem: Problem
    u: np.ndarray


T = TypeVar("T")
Steps = Generator[Query, Value, T]
"""A computation that returns a `T`."""


def run_together(computations: Sequence[Steps[T]], what: str = "", rtol: float = BRANCH_RTOL) -> list[T]:
    """Run computations side by side to their ends, and return their results in the given order.

    If the work has a name, progress is reported. The length of a trace is unknown before its end, so it
    counts by the part of the parameter's interval that it has covered, up to nine tenths. `rtol` is the
    tolerance of the integrations.
    """
    covered = [0.0] * len(computations)
    seen: dict[int, tuple[float, float]] = {}

    def answer(queries: dict[int, Query], results: Mapping[int, T]) -> dict[int, Value]:
        for i, query in queries.items():
            last = float(query.u[-1])
            low, high = seen.get(i, (last, last))
            seen[i] = min(low, last), max(high, last)
            covered[i] = min(seen[i][1] - seen[i][0], 0.9)
        if what:
            report(what, round(len(results) + sum(covered[i] for i in queries), 1), len(computations))
        return dict(zip(queries, _evaluate(list(queries.values()), rtol), strict=True))

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


def _evaluate(queries: Sequence[Query], rtol: float) -> list[Value]:
    values: list[Value | None] = [None] * len(queries)
    while open_ones := [i for i, value in enumerate(values) if value is None]:
        rows = {i: queries[i].problem.rows(queries[i].u) for i in open_ones}
        for chosen in _calls([(i, queries[i].problem.system) for i in open_ones]):
            system = queries[chosen[0]].problem.system
            for i, ends in zip(chosen, integrated([rows[i] for i in chosen], system, rtol), strict=True):
                values[i] = queries[i].problem.value(queries[i].u, ends)
    return [value for value in values if value is not None]


def _calls(systems: Sequence[tuple[int, System]]) -> list[list[int]]:
    by_system: dict[str, list[int]] = {}
    for i, system in systems:
        by_system.setdefault(system.label, []).append(i)
    return list(by_system.values())


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
