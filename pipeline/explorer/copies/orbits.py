"""Integrate the orbits of an export: one for each attractor at each parameter point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.explorer import RequestError
from pipeline.explorer.copies.content import Copied
from pipeline.explorer.data.arrays import pack_zipped, unpack_arrays
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import orbit
from pipeline.products.reporting import report

NONE = np.uint32(0xFFFFFFFF)
SAME_ATTRACTOR, ALIKE, NEAREST = 1, 2, 3
"""What an orbit is to a cell: of its attractor, of a cell like it at its parameters, or the nearest."""

ORBITS_OF_OBJECT = 32
"""Orbits in an object."""

SERIES = ("time", "states", "quantities", "drawing")
"""Arrays of an orbit that run over time."""


@dataclass(frozen=True)
class Room:
    """Limits of the exported orbits: their number, their bytes, and whether they are shortened."""

    orbits: int
    n_bytes: float  # before they are written as text
    brief: bool  # whether fewer digits and periods are kept, so that there are more of them


@dataclass(frozen=True)
class Chosen:
    """Cells whose orbits are exported, and the exported orbit that is shown for each cell."""

    cells: np.ndarray  # int64 (n,); cells whose orbits are integrated
    orbit: np.ndarray  # uint32 (n_cells,); index into `cells`, or `NONE`
    how: np.ndarray  # uint8 (n_cells,)
    groups: int  # attractors at all parameter points; `cells` are fewer where there was no room


def choose(run: ExploredRun, layers: Mapping[str, np.ndarray], count: np.ndarray, most: int) -> Chosen:
    """Choose the cells whose orbits are exported, and the exported orbit that is shown for each cell.

    `layers` are codes by cell: ``colour_attractor``, or else ``colour_motion``; ``orbit_period`` and ``status``.
    `count` is the number of each cell's points. Where there are more attractors than `most`, some values of the
    horizontal axis go without.
    """
    labels = _labels(layers)
    point, axis = _parameter_points(run)
    there = np.flatnonzero(count > 0)
    keys = np.stack([point[there], labels[there]], axis=1)
    unique, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    taken = np.arange(len(unique))
    if len(unique) > most:
        # whole parameter points, evenly along the axes
        each = -(-len(unique) // max(most, 1))
        taken = np.flatnonzero(unique[:, 0] % each == 0)[:most]
    orbit_of = np.full(len(count), NONE, np.uint32)
    how = np.zeros(len(count), np.uint8)
    if not len(taken):
        return Chosen(np.empty(0, np.int64), orbit_of, how, len(unique))
    same = SAME_ATTRACTOR if "colour_attractor" in layers else ALIKE
    number, means = _nearest(unique, taken, axis, same)
    orbit_of[there], how[there] = number[inverse.ravel()], means[inverse.ravel()]
    return Chosen(there[first[taken]], orbit_of, how, len(unique))


def _labels(layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return a number for each cell that distinguishes the attractors (or classes of motion) at one parameter point."""
    if "colour_attractor" in layers:
        return np.asarray(layers["colour_attractor"], np.int64)
    motion = layers.get("colour_motion", np.zeros_like(layers["status"])).astype(np.int64)
    return np.asarray((motion * 1000 + layers["orbit_period"].astype(np.int64)) * 100 + layers["status"])


def _parameter_points(run: ExploredRun) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameter point of each cell, and the coordinates of the points, scaled to 0 to 1 on each axis."""
    swept = [a.name for a in run.axes if a.swept]
    sizes = [run.plan.shape[run.plan.dims.index(d)] for d in swept]
    index = dict(zip(run.plan.dims, np.indices(run.plan.shape).reshape(len(run.plan.dims), -1), strict=True))
    if not swept:
        return np.zeros(run.plan.n_cells, np.int64), np.zeros((1, 1))
    point = np.ravel_multi_index([index[d] for d in swept], sizes).astype(np.int64)
    grid = np.stack(np.unravel_index(np.arange(int(np.prod(sizes))), sizes), axis=1)
    return point, grid / np.maximum(np.array(sizes) - 1, 1)


def _nearest(groups: np.ndarray, taken: np.ndarray, axis: np.ndarray, same: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the orbit shown for each group of cells: its own, or the nearest, if possible of the same attractor."""
    number = np.full(len(groups), NONE, np.uint32)
    means = np.full(len(groups), NEAREST, np.uint8)
    number[taken], means[taken] = np.arange(len(taken)), same
    for group in np.flatnonzero(number == NONE):
        point, label = groups[group]
        alike = np.flatnonzero(groups[taken, 1] == label)
        among = alike if len(alike) else np.arange(len(taken))
        distance = np.abs(axis[groups[taken[among], 0]] - axis[point]).sum(axis=1)
        number[group] = among[int(np.argmin(distance))]
    return number, means


def add_orbits(copied: Copied, choosing: Callable[[int], Chosen], count: np.ndarray, room: Room) -> int:
    """Integrate the orbits that `choosing` chooses, at most as many as it is told, and add them to an export.

    An orbit starts from the last of the cell's points, whose number is `count`. Return the number of orbits.
    """
    if obstacle := copied.run.spec.motion.obstacle:
        missing = f"This copy has no orbits: {obstacle}."
        copied.about["orbits"] = {"blocks": [], "missing": missing}
        copied.sentences.append(missing)
        return 0
    chosen = choosing(room.orbits)
    each = _bytes_each(copied, chosen, count, room)
    if each * len(chosen.cells) > room.n_bytes:
        chosen = choosing(int(room.n_bytes / each))
    n = len(chosen.cells)
    blocks = list(range(0, n, ORBITS_OF_OBJECT))
    report("integrating orbits", 0, n)
    for number, first in enumerate(blocks):
        held: dict[str, np.ndarray] = {}
        said: dict[str, Any] = {}
        for k in range(first, min(first + ORBITS_OF_OBJECT, n)):
            arrays, said[str(k)] = _orbit(copied.run, int(chosen.cells[k]), count, room)
            held |= {f"{k}.{name}": values for name, values in arrays.items()}
            report("integrating orbits", k + 1, n)
        copied.objects[f"orbits-{number}"] = pack_zipped(held, said)
    copied.objects["orbit-index"] = pack_zipped({"orbit": chosen.orbit, "how": chosen.how})
    missing = "" if n else "This copy was made without orbits; magpend explore integrates them."
    copied.about["orbits"] = {"blocks": blocks, "missing": missing}
    copied.sentences += [missing] if missing else []
    if 0 < n < chosen.groups:
        copied.sentences.append(
            f"Of {chosen.groups:,} orbits, one for each attractor (or period and motion) at its parameters, "
            f"this copy has {n:,}; elsewhere the nearest is shown."
        )
    return n


def _bytes_each(copied: Copied, chosen: Chosen, count: np.ndarray, room: Room) -> float:
    n_orbits = 6  # by which the size of all is judged
    some = chosen.cells[:: max(1, len(chosen.cells) // n_orbits)][:n_orbits]
    sizes = []
    for cell in some.tolist():
        arrays, attrs = _orbit(copied.run, cell, count, room)
        sizes.append(len(pack_zipped(arrays, attrs)))
    return max(1.0, float(np.mean(sizes))) if sizes else 1.0


def _orbit(run: ExploredRun, cell: int, count: np.ndarray, room: Room) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Integrate the orbit from the last section point of a cell, and round it to the precision of the export."""
    try:
        arrays, attrs = unpack_arrays(orbit(run, cell, int(count[cell]) - 1))
    except (RequestError, ArithmeticError) as error:  # of one cell: the page says so where it is asked for
        return {}, {"cell": cell, "failed": str(error)}
    del arrays["section"]  # the columns have it, of every cell
    if room.brief:
        arrays = brief(arrays, closed=attrs["period"] is not None)
    return {
        name: rounded(values, room.brief) if values.dtype.kind == "f" else values for name, values in arrays.items()
    }, attrs


def brief(arrays: Mapping[str, np.ndarray], closed: bool) -> dict[str, np.ndarray]:
    """Shorten an orbit that does not close to its first periods, at every second instant."""
    n_periods = 5  # that a page shows of a motion that does not close
    sections = arrays["section_times"][: n_periods + 1]
    if closed or len(sections) <= n_periods:
        return dict(arrays)
    n = int(np.searchsorted(arrays["time"], sections[-1], side="right"))
    series = {name: values[:n:2] for name, values in arrays.items() if name in SERIES}
    return {**arrays, **series, "section_times": sections}


def rounded(values: np.ndarray, short: bool) -> np.ndarray:
    """Round numbers to 24 bits, or to 16 bits if `short`, so that they compress better."""
    single = np.ascontiguousarray(values, np.float32)
    if not short:
        return single
    bits = single.view(np.uint32)
    shorter = ((bits + np.uint32(0x80)) & np.uint32(0xFFFFFF00)).view(np.float32)
    return np.where(np.isfinite(single), shorter, single)
