"""Convert between tasks and the keys (relative paths) of their chunks, such as ``section/c.0.3.0.0``."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from pipeline.layout.plan import Plan


def chunk_keys(name: str, region: tuple[slice, ...], chunks: tuple[int, ...], shape: tuple[int, ...]) -> list[str]:
    """Return the keys of the chunks that an index region of an array covers.

    A region that cuts a chunk is refused with a `ValueError`: writing it would lose a neighbour's cells.
    """
    for s, c, n in zip(region, chunks, shape, strict=True):
        if s.start % c or (s.stop % c and s.stop != n):
            raise ValueError(f"{name}: region {region} cuts chunks of {chunks}.")
    places = [range(s.start // c, -(-s.stop // c)) for s, c in zip(region, chunks, strict=True)]
    return [".".join((f"{name}/c", *map(str, place))) for place in itertools.product(*places)]


def keys_of(plan: Plan, index: int) -> list[str]:
    """Return the keys (relative paths) of all chunks that a task writes."""
    block, found = plan.task(index), []
    for variable in plan.variables:
        own = tuple(plan.sizes[dim] for dim in variable.own_dims)
        region = (*block, *(slice(0, n) for n in own))
        found += chunk_keys(variable.name, region, plan.chunks(variable), (*plan.shape, *own))
    return found


class Owners:
    """A map from the keys (relative paths) of stored chunks to the tasks that write them."""

    def __init__(self, plan: Plan) -> None:
        self._block, self._grid = plan.block, plan.task_grid
        self._chunks: dict[str, tuple[int, ...]] = {}
        self._counts: dict[str, tuple[int, ...]] = {}
        for variable in plan.variables:
            chunks = plan.chunks(variable)
            shape = (*plan.shape, *(plan.sizes[dim] for dim in variable.own_dims))
            self._chunks[variable.name] = chunks
            self._counts[variable.name] = tuple(-(-n // c) for n, c in zip(shape, chunks, strict=True))

    def keys(self, name: str) -> Iterator[str]:
        """Yield the keys of all chunks of a variable, in order."""
        for place in itertools.product(*(map(str, range(n)) for n in self._counts[name])):
            yield ".".join((f"{name}/c", *place))

    def task(self, key: str) -> int | None:
        """Return the task that a chunk's key belongs to; None if the key names no chunk of a variable."""
        name, _, rest = key.partition("/")
        mark, *words = rest.split(".")
        counts = self._counts.get(name)
        if counts is None or mark != "c" or len(words) != len(counts):
            return None
        places = [int(word) if word.isdecimal() and len(word) < 12 else -1 for word in words]
        if any(not 0 <= p < n or str(p) != w for p, n, w in zip(places, counts, words, strict=True)):
            return None
        index = 0
        for place, c, b, n in zip(places, self._chunks[name], self._block, self._grid, strict=False):
            index = index * n + place * c // b
        return index
