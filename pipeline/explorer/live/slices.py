"""Compute live on which attractors the initial states of a plane end, on grids from coarse to fine.

The cells of the finest grid are squares of the plane, and the starts their centres. A coarser grid takes
every second, fourth, ... of these starts, so that a finer one computes only what lies between. What a start
ends on is told by `catalog`: by the run's attractors where they are known, else by the closed orbits that
are met, and for what does not close by its motion.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.explorer import RequestError
from pipeline.explorer.live.catalog import Catalog
from pipeline.explorer.live.jobs import Job
from pipeline.explorer.live.messages import LEAST_RESOLUTION, SliceRequest
from pipeline.explorer.live.settling import Place, settle_cells

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun


NOT_YET = -1


def slice_of(live: LiveRun, job: Job) -> None:
    """Compute for a job on which attractors the initial states of a plane end, and send one grid after another."""
    request = job.request
    assert isinstance(request, SliceRequest)
    place = live.place(request.parameters, request.frequency)
    grid = _Grid.of(live, request, place)
    catalog = live.catalog(place)
    work = _Slice(live, job, grid, catalog)
    for n in grid.levels():
        work.compute(n)
        work.show(n, 1.0)
    counts = {int(k): int(c) for k, c in zip(*np.unique(grid.labels, return_counts=True), strict=True)}
    shares = {str(k): c / grid.labels.size for k, c in counts.items()}
    lines = [line for line in live.legend(catalog).lines() if str(line["id"]) in shares]
    job.tell("done", resolution=grid.n, labels=lines, shares=shares)


class _Grid:
    """Grid of initial states in a plane, with the number of the attractor on which each of them ends.

    `axes` has the values of the two states at the centres of the finest grid's cells. In `labels`, rows run along the
    second state, and cells not decided yet are `NOT_YET`.
    """

    def __init__(self, columns: tuple[int, int], base: np.ndarray, axes: tuple[np.ndarray, np.ndarray]) -> None:
        self._columns, self._base, self.axes = columns, base, axes
        self.n = len(axes[0])
        self.labels = np.full((self.n, self.n), NOT_YET, np.int32)

    @classmethod
    def of(cls, live: LiveRun, request: SliceRequest, place: Place) -> _Grid:
        """Make the grid that a message of the page requests; its resolution is raised to 16, 32, 64, ..."""
        names = live.model.state_names
        known = ", ".join(names)
        for name in request.plane:
            if name not in names:
                raise RequestError(f"plane: {name!r} is no state of {live.model.name}; it has {known}.")
        if request.plane[0] == request.plane[1]:
            raise RequestError(f"plane: {request.plane[0]} is named twice; name two states.")
        n = LEAST_RESOLUTION
        while n < request.resolution:
            n *= 2
        axes = []
        for name, (low, high) in zip(request.plane, request.ranges, strict=True):
            if not low < high:
                raise RequestError(f"ranges: that of {name} is {low:g} to {high:g}; the second must be greater.")
            axes.append(low + (high - low) * ((np.arange(n) + 0.5) / n))
        base = live.state({k: v for k, v in request.fixed.items() if k not in request.plane}, place)
        grid = cls((names.index(request.plane[0]), names.index(request.plane[1])), base, (axes[0], axes[1]))
        ends = np.array([0, n - 1])
        live.check_states(grid.starts(np.repeat(ends, 2), np.tile(ends, 2)), place)
        return grid

    def levels(self) -> Iterator[int]:
        n = LEAST_RESOLUTION
        while n <= self.n:
            yield n
            n *= 2

    def missing(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of the n x n grid that have no label yet, as rows and columns of the finest grid."""
        step = self.n // n
        rows, columns = np.nonzero(self.labels[::step, ::step] == NOT_YET)
        return rows * step, columns * step

    def starts(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        states = np.tile(self._base, (len(rows), 1))
        states[:, self._columns[0]] = self.axes[0][columns]
        states[:, self._columns[1]] = self.axes[1][rows]
        return states

    def image(self, n: int) -> np.ndarray:
        """Return the labels of the n x n grid; a missing label is that of the next coarser grid."""
        step = self.n // n
        own = self.labels[::step, ::step].astype(np.int16)
        if n == LEAST_RESOLUTION:
            return own
        coarser = self.image(n // 2).repeat(2, axis=0).repeat(2, axis=1)
        return np.where(own == NOT_YET, coarser, own)


class _Slice:
    """Computation of the labels of a grid of initial states, in several threads and from coarse to fine."""

    def __init__(self, live: LiveRun, job: Job, grid: _Grid, catalog: Catalog) -> None:
        self._live, self._job, self._grid, self._catalog = live, job, grid, catalog

    def compute(self, n: int) -> None:
        """Compute the labels that the n x n grid still lacks, and send the unfinished grid to the page now and then."""
        first_batch, batch = 64, 256  # starts that a thread takes at once: of the coarsest grid, and of the others
        every_s = 0.5  # how often an unfinished grid is shown [s]
        rows, columns = self._grid.missing(n)
        total, done, shown = len(rows), 0, time.perf_counter()
        size = first_batch if n == LEAST_RESOLUTION else batch
        parts = [slice(i, i + size) for i in range(0, total, size)]
        if n == LEAST_RESOLUTION:  # alone, so that the others find the attractors that it meets
            part = parts.pop(0)
            starts = self._grid.starts(rows[part], columns[part])
            self._take(part, rows, columns, self._settle(starts))
            done = len(starts)
        at_work: dict[Future[np.ndarray], slice] = {}
        try:
            while parts or at_work:
                self._job.check()
                while parts and len(at_work) < 2 * self._live.threads:
                    part = parts.pop(0)
                    starts = self._grid.starts(rows[part], columns[part])
                    at_work[self._live.pool.submit(self._settle, starts)] = part
                finished, _ = wait(at_work, timeout=0.1, return_when=FIRST_COMPLETED)
                for future in finished:
                    part = at_work.pop(future)
                    self._take(part, rows, columns, future.result())
                    done += len(rows[part])
                if time.perf_counter() - shown > every_s:
                    self.show(n, done / total)
                    shown = time.perf_counter()
        finally:
            for future in at_work:
                future.cancel()

    def _settle(self, starts: np.ndarray) -> np.ndarray:
        live = self._live
        return settle_cells(self._catalog.place, live.integration, self._catalog, starts, self._job.check)

    def _take(self, part: slice, rows: np.ndarray, columns: np.ndarray, labels: np.ndarray) -> None:
        self._grid.labels[rows[part], columns[part]] = labels

    def show(self, n: int, share: float) -> None:
        step = self._grid.n // n
        own: dict[str, Any] = {
            "label": self._grid.image(n),
            "u": self._grid.axes[0][::step].copy(),
            "v": self._grid.axes[1][::step].copy(),
        }
        lines = self._live.legend(self._catalog).lines()
        self._job.show(
            "slice",
            own,
            resolution=n,
            share_done=float(min(share, 1.0)),
            labels=lines,
            states=list(self._job.request.plane),  # type: ignore[union-attr]
        )
