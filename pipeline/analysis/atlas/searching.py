"""Search all orbits at some points of a plane: those that attract, though no cell ends on them, lead to curves that
nothing else reaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.atlas.ends import End, at_node, follow_all
from pipeline.analysis.atlas.plane import Array, Plane
from pipeline.analysis.atlas.verdicts import met_at, rows_at
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.searching import VERDICTS, place_at
from pipeline.analysis.branches.starting_orbits import family_of


@dataclass(frozen=True, eq=False)
class Searched:
    """The orbits at one point of the grid, and what the sum of their indices says."""

    node: int
    n_orbits: int
    hidden: list[tuple[Array, int]]  # a section point and the period of each stable orbit on which no cell ends
    verdict: str  # of `VERDICTS`


def nodes_for(plane: Plane, n: int) -> list[int]:
    """Return about `n` points of the grid, evenly spaced along both parameters."""
    side = max(1, round(np.sqrt(n)))
    along = [np.unique(((np.arange(side) + 0.5) / side * size).astype(int)) for size in plane.shape]
    return [int(i * plane.shape[1] + j) for i in along[0] for j in along[1]] if n else []


def searched_at(plane: Plane, cube: xr.Dataset, node: int, base: Parameters, longest: int) -> Searched:
    """Search all orbits up to a period at a point of the grid."""
    where = dict(zip(plane.names, plane.values[node].tolist(), strict=True))
    cells = cube.sel(where)
    frequency, packed = at_node(plane, node, base)
    family = family_of(base.model.system, 1, frequency, packed, plane.names[0], float(plane.size[0]))
    place, periods = place_at(cells, base, family, where[plane.names[0]]), np.arange(1, longest + 1)
    place.search(periods)
    own = rows_at(plane)[node]
    hidden = [
        (one.points[0], one.period)
        for one in place.found
        if np.abs(one.multipliers).max() < 1.0 and met_at(plane.points, own, one.points[0], base.model.system) < 0
    ]
    told = place.verdicts(periods)
    verdict = next((one for one in VERDICTS[1:] if one in told), VERDICTS[0])
    return Searched(node, len(place.found), hidden, verdict)


def followed_from(plane: Plane, found: Sequence[Searched], base: Parameters) -> list[tuple[Searched, int, End]]:
    """Follow the orbits on which no cell ends along both parameters, up to the plane's borders; with each end the
    parameter along which.
    """
    ways = []
    for one in found:
        frequency, packed = at_node(plane, one.node, base)
        for state, period in one.hidden:
            for axis, name in enumerate(plane.names):
                family = family_of(base.model.system, period, frequency, packed, name, float(plane.size[axis]))
                start = Start(family, state, float(plane.values[one.node, axis]))
                for target in (plane.low[axis], plane.low[axis] + plane.size[axis]):
                    if target != start.value:
                        ways.append((one, axis, start, float(target)))
    ends = follow_all([(start, target) for _, _, start, target in ways])
    return [(one, axis, end) for (one, axis, _, _), end in zip(ways, ends, strict=True)]
