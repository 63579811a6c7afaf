"""Read shapes in the plane from the result of an atlas: regions, curves by the stability of their orbits, and lines."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import xarray as xr

from pipeline.analysis.atlas.plane import Array


class Piece(NamedTuple):
    """A stretch of a curve within the plane: the curve's number, its points, and whether it bounds stability."""

    curve: int
    places: Array  # (point, 2)
    is_stable: bool


def bounds_of(ds: xr.Dataset) -> tuple[Array, Array]:
    """Return the least and the largest values of both parameters in the plane."""
    corners = np.stack([ds["corner_first"].values, ds["corner_second"].values], axis=-1)
    return corners.min(axis=0), corners.max(axis=0)


def rings_of(ds: xr.Dataset) -> list[list[Array]]:
    """Return the rings of each region as points (point, 2): its boundary, then its holes."""
    corners = np.stack([ds["corner_first"].values, ds["corner_second"].values], axis=-1)
    parts = np.split(corners, np.cumsum(ds["ring_size"].values)[:-1])
    rings: list[list[Array]] = [[] for _ in range(ds.sizes["region"])]
    for k in np.argsort(ds["is_hole"].values, kind="stable").tolist():
        rings[int(ds["ring_region"][k])].append(parts[k])
    return rings


def pieces_of(ds: xr.Dataset) -> Iterator[Piece]:
    """Yield the stretches of all curves within the plane, cut where the stability of their orbits changes.

    A stretch is stable if no multiplier but the critical ones is unstable.
    """
    for number, n in enumerate(ds["n_points"].values.tolist()):
        places = np.stack([ds[which].values[number, :n] for which in ("first", "second")], axis=-1)
        good = ds["others_unstable"].values[number, :n] == 0
        solid = good[1:] & good[:-1]
        cuts = [0, *(np.flatnonzero(np.diff(solid)) + 1).tolist(), len(solid)]
        for first, stop in pairwise(cuts):
            if stop > first:
                for part in _within(ds, places[first : stop + 1]):
                    yield Piece(number, part, bool(solid[first]))


def line_places(ds: xr.Dataset, line: int) -> Array:
    """Return the points of a line, (point, 2)."""
    n = int(ds["line_size"][line])
    return np.stack([ds[f"line_{which}"].values[line, :n] for which in ("first", "second")], axis=-1)


def _within(ds: xr.Dataset, places: Array) -> Iterator[Array]:
    """Yield the parts of a line within the plane."""
    import shapely

    low, high = bounds_of(ds)
    for part in shapely.get_parts(shapely.clip_by_rect(shapely.linestrings(places), *low, *high)):
        yield shapely.get_coordinates(part)
