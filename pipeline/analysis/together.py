"""Run many computations side by side, so that their trajectories together fill the engine's lanes.

A computation is a generator: it yields what it asks for, receives the answer, and returns its result. A single orbit
would fill one lane of sixteen; one call of the engine answers all, at little more than the cost of one. Each
computation gets the same numbers as if it ran alone.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable, Mapping
from typing import Any, TypeVar

K = TypeVar("K", bound=Hashable)
Q = TypeVar("Q")
V = TypeVar("V")
T = TypeVar("T")


def answer_together(
    computations: Mapping[K, Generator[Q, V, T]], answer: Callable[[dict[K, Q], dict[K, T]], Mapping[K, V]]
) -> dict[K, T]:
    """Run computations side by side to their ends, and return the result of each.

    Parameters
    ----------
    computations
        Generators by key.
    answer
        ``answer(asked, results)`` returns answers to what running computations have asked for, one at least; the
        others wait. `results` has the computations that have ended.
    """
    results: dict[K, T] = {}
    asked: dict[K, Q] = {}
    answers: Mapping[K, Any] = dict.fromkeys(computations)
    while answers:
        for key, value in answers.items():
            try:
                asked[key] = computations[key].send(value)
            except StopIteration as stop:
                asked.pop(key, None)
                results[key] = stop.value
        answers = answer(asked, results) if asked else {}
    return {key: results[key] for key in computations}
