"""Which chunk belongs to which task: keys such as ``section/c.0.3.0.0`` follow from the plan, and lead back."""

from __future__ import annotations

import itertools

from pipeline.layout.plan import Plan


def chunk_keys(
    name: str, region: tuple[slice, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> list[str]:
    """Keys of the chunks in a region; a region that cuts a chunk would lose a neighbour's cells."""
    for s, c, n in zip(region, chunks, shape, strict=True):
        if s.start % c or (s.stop % c and s.stop != n):
            raise ValueError(f"{name}: region {region} cuts chunks of {chunks}.")
    places = [range(s.start // c, -(-s.stop // c)) for s, c in zip(region, chunks, strict=True)]
    return [".".join((f"{name}/c", *map(str, place))) for place in itertools.product(*places)]


def keys_of(plan: Plan, index: int) -> list[str]:
    """Keys of all chunks of a task."""
    block, found = plan.task(index), []
    for variable in plan.variables:
        own = tuple(plan.sizes[dim] for dim in variable.own_dims)
        region = (*block, *(slice(0, n) for n in own))
        found += chunk_keys(variable.name, region, plan.chunks(variable), (*plan.shape, *own))
    return found


class Owners:
    """The task that a chunk belongs to."""

    def __init__(self, plan: Plan) -> None:
        self._n_dims = len(plan.shape)
        self._chunks = {v.name: plan.chunks(v)[: self._n_dims] for v in plan.variables}
        self._block, self._grid = plan.block, plan.task_grid

    def task(self, key: str) -> int | None:
        """Return the task of a chunk's key; None for what is no chunk of a cell."""
        name, _, rest = key.partition("/")
        chunks = self._chunks.get(name)
        mark, *places = rest.split(".")
        if chunks is None or mark != "c" or len(places) < self._n_dims:
            return None
        index = 0
        for place, c, b, n in zip(places, chunks, self._block, self._grid, strict=False):
            task = int(place) * c // b if place.isdecimal() else n
            if task >= n:
                return None
            index = index * n + task
        return index
