"""Join ends of attractors that were found between neighbouring points, and lie on no curve, to lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.analysis.atlas.plane import Array, Plane

Key = tuple[Any, ...]


@dataclass(frozen=True)
class Line:
    """Places that lie on edges side by side: what was found at them, and their values."""

    what: str
    period: int
    places: Array  # (place, 2)
    items: tuple[int, ...]  # numbers of the items at the places


def lines_through(plane: Plane, items: Sequence[tuple[int, Key, Array]]) -> list[Line]:
    """Join places on edges of neighbouring faces of the grid that have the same key, where this is unique.

    Parameters
    ----------
    plane
        The plane; a face is the rectangle between four of its points.
    items
        For each place its edge, its key (what, period, ...), and its parameter values.
    """
    by_edge: dict[tuple[int, Key], list[int]] = {}
    for number, (edge, key, _) in enumerate(items):
        by_edge.setdefault((edge, key), []).append(number)
    keys = sorted({key for _, key, _ in items}, key=str)
    beside: dict[int, list[int]] = {number: [] for number in range(len(items))}
    for face in _faces(plane):
        for key in keys:
            on_it = [number for edge in face for number in by_edge.get((edge, key), [])]
            if len(on_it) == 2:
                beside[on_it[0]].append(on_it[1])
                beside[on_it[1]].append(on_it[0])
    return [
        Line(str(items[own[0]][1][0]), int(items[own[0]][1][1]), np.array([items[k][2] for k in own]), tuple(own))
        for own in _chains(beside)
    ]


def _faces(plane: Plane) -> Iterator[tuple[int, int, int, int]]:
    """Yield the four edges of each rectangle of the grid."""
    n, m = plane.shape
    upright = (n - 1) * m  # number of edges along the first parameter
    for i in range(n - 1):
        for j in range(m - 1):
            yield i * m + j, i * m + j + 1, upright + i * (m - 1) + j, upright + (i + 1) * (m - 1) + j


def _chains(beside: dict[int, list[int]]) -> Iterator[list[int]]:
    """Yield chains of places, each from one of its ends; a closed one begins and ends with the same place."""
    left = set(beside)
    for closed in (False, True):
        for first in sorted(beside):
            if first not in left or (not closed and len(beside[first]) > 1):
                continue
            chain, here = [first], first
            left.discard(first)
            while ahead := [one for one in beside[here] if one in left]:
                here = ahead[0]
                left.discard(here)
                chain.append(here)
            if closed and len(chain) > 2 and first in beside[here]:
                chain.append(first)
            yield chain
