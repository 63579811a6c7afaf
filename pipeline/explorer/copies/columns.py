"""Fit the points of exported diagrams to a size limit: in full, or rounded, or with fewer section points."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.explorer.copies.content import Column
from pipeline.explorer.copies.packing import packed


@dataclass(frozen=True)
class Level:
    """Level of detail of exported diagrams: precision of the numbers, and which section points are kept.

    Attributes
    ----------
    dtype : str
        Type of the values.
    each : int
        Step between kept section points of cells on no closed orbit; 0 keeps all points of all cells. With any
        other number, cells on closed orbits keep one period.
    """

    dtype: str
    each: int


@dataclass(frozen=True)
class Fitted:
    """Diagram points that fit the size limit, packed, with their level of detail.

    Attributes
    ----------
    objects : dict
        Data by name of the vertical axis.
    kept, total : int
        Points of the first vertical axis, here and in the run.
    closed, others : int
        Cells with points that are on closed orbits, and that are not.
    """

    objects: dict[str, bytes]
    level: Level
    kept: int
    total: int
    closed: int
    others: int

    def sentences(self) -> list[str]:
        """Return sentences that tell the reader of the page about rounded numbers and omitted points."""
        found = []
        if self.level.dtype == "float32":
            found.append("Numbers are rounded to 24 bits, so each is right to 6e-8 of its size.")
        if self.kept < self.total:
            each = self.level.each
            rest = "all sections" if each == 1 else f"every {_ordinal(each)} section, the last one among them"
            found.append(
                f"Sections were left out: this copy has {self.kept:,} of {self.total:,} points. Of "
                f"{self.closed:,} cells on closed orbits it has the last period; of {self.others:,} others "
                f"{rest}. "
                "magpend export --folder leaves nothing out."
            )
        return found


def _ordinal(n: int) -> str:
    return f"{n}{'th' if 10 < n % 100 < 14 else {1: 'st', 2: 'nd', 3: 'rd'}.get(n % 10, 'th')}"


def levels(most: int) -> Iterator[Level]:
    """Yield levels of detail, from all section points in full precision to one point per cell."""
    yield Level("float64", 0)
    yield Level("float32", 0)
    for each in itertools.chain([1], *([2 * 2**k, 3 * 2**k] for k in range(most.bit_length()))):
        yield Level("float32", each)


def fit(columns: Mapping[str, Column], period: np.ndarray, most_bytes: float) -> Fitted | None:
    """Pack the diagram points at the finest level of detail that fits a size limit; None if no level fits.

    Parameters
    ----------
    columns
        Columns by vertical axis, all for the same cells.
    period
        Period of each cell's closed orbit; 0 where there is none.
    most_bytes
        Size limit for all columns together [bytes].
    """
    longest = max((int(c.count.max(initial=0)) for c in columns.values()), default=0)
    first = next(iter(columns.values()))
    closed = int(((first.count > 0) & (period > 0)).sum())
    others = int((first.count > 0).sum()) - closed
    for level in levels(longest):
        objects = _packed(columns, period, level, most_bytes)
        if objects is not None:
            kept = int(thinned(first, period, level.each).count.sum())
            return Fitted(objects, level, kept, len(first.y), closed, others)
    return None


def _packed(
    columns: Mapping[str, Column], period: np.ndarray, level: Level, most_bytes: float
) -> dict[str, bytes] | None:
    objects, size = {}, 0
    for name, column in columns.items():
        part = thinned(column, period, level.each)
        objects[name] = packed({"count": part.count, "y": part.y.astype(level.dtype)})
        size += len(objects[name])
        if size > most_bytes:
            return None
    return objects


def thinned(column: Column, period: np.ndarray, each: int) -> Column:
    """Keep the last period of each periodic cell, and every `each`-th section point of the others; 0 keeps all points.

    The last section of every cell stays. Nothing is left out if `each` is 0.
    """
    if each == 0:
        return column
    count = column.count.astype(np.int64)
    first = np.cumsum(count) - count
    # sections that come after each one, in its cell
    after = np.repeat(count, count) - 1 - (np.arange(len(column.y)) - np.repeat(first, count))
    orbit = np.repeat(period.astype(np.int64), count)
    stays = np.where(orbit > 0, after < orbit, after % each == 0)
    kept = np.add.reduceat(np.append(stays, False), first, dtype=np.int64) if len(first) else count
    return Column(np.where(count > 0, kept, 0).astype(np.uint32), column.y[stays])
