"""Open a run for the explorer; its cube and its stored analyses are each read once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.layout.cells import CellMap, Inputs, parameter_axes
from pipeline.layout.vocabulary import FREQUENCY_DIM, is_start_dim
from pipeline.runs.derive import stored
from pipeline.specification.problems import unknown_name
from pipeline.store.files import DERIVED
from pipeline.store.products import products_in
from pipeline.store.run import Run

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import xarray as xr


T = TypeVar("T")

MOST_LARGE = 2
"""Diagrams that are kept in memory, of up to some 200 MB each."""


class ExplorerError(ValueError):
    """Raised for a request for something that does not exist; the message is shown on the page."""


@dataclass(frozen=True)
class Axis:
    """A possible horizontal axis of a diagram.

    Attributes
    ----------
    name : str
        Of the cube's dim; of a run that sweeps nothing, of the one value that it has.
    parameter : str
        Its name in a specification.
    values : ndarray
        In the order of the cube.
    swept : bool
        Whether it is a dim of the cube.
    """

    name: str
    parameter: str
    values: np.ndarray
    swept: bool = True


@dataclass(frozen=True)
class ExploredRun(Run):
    """An opened run that reads its cube and the stored results of analyses only once.

    Reading never computes: what is not in the cube or in ``derived/`` is not there.

    Attributes
    ----------
    curves : Run or None
        Run whose bifurcation curves are shown; None for those of the run itself.
    """

    curves: Run | None = None

    _opened: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)
    _lock: Any = field(default_factory=threading.RLock, compare=False, repr=False)

    @classmethod
    def of(cls, source: str | Path | Run) -> ExploredRun:
        """Open a run directory for the explorer, or wrap an opened run."""
        run = Run.open(source)
        if isinstance(run, cls):
            return run
        return cls(**{f.name: getattr(run, f.name) for f in fields(Run)})

    def cube(self, chunks: Any = None, *, check: bool | None = None) -> xr.Dataset:
        """Return the cube as a lazy dataset; each chunk is verified when it is read."""
        if chunks is not None or check is not None:
            return super().cube(chunks, check=check)
        with self._lock:
            if "cube" not in self._opened:
                opened = super().cube()
                # once: each use of a coordinate would read it again
                self._opened["cube"] = opened.assign_coords({n: c.load() for n, c in opened.coords.items()})
            found: xr.Dataset = self._opened["cube"]
            return found

    def kept(self, name: str) -> xr.Dataset | None:
        """Return the stored result of an analysis from ``derived/``; None if there is none."""
        with self._lock:
            key = f"derived {name}"
            if key not in self._opened:
                self._opened[key] = None if self.spec.unsteady else stored(self, name)
            found: xr.Dataset | None = self._opened[key]
            return found

    def bifurcation_curves(self) -> xr.Dataset | None:
        """Return the stored curves of `curves`, or of the run itself; None if there are none."""
        return self.kept("curves") if self.curves is None else ExploredRun.of(self.curves).kept("curves")

    def refreshed(self) -> ExploredRun:
        """Return the run with cells and results added since it was opened."""
        if not self.complete:
            return replace(ExploredRun.of(Run.open(self.info.files)), curves=self.curves)
        if self._derived_names() == self.remembered("derived names", self._derived_names):
            return self
        # the cells of a complete run stay as they are
        found = replace(self, _opened={}, _lock=threading.RLock())
        found._opened["cube"] = self.cube()
        found.remembered("derived names", found._derived_names)
        return found

    def _derived_names(self) -> list[str]:
        return sorted(place.name for place in products_in(self.info.files.below(DERIVED)))

    def remembered(self, key: str, make: Callable[[], T]) -> T:
        """Return the value of a key, computed once, even under concurrent requests."""
        with self._lock:
            lock = self._opened.setdefault(f"lock {key}", threading.Lock())
        with lock:
            if key not in self._opened:
                self._opened[key] = make()
            found: T = self._opened[key]
            return found

    def large(self, key: str, make: Callable[[], T]) -> T:
        """Return the value of a key, computed at first use, one at a time; only the last few large values stay in
        memory.
        """
        with self._lock:
            last: list[str] = self._opened.setdefault("large", [])
            if key in last:
                last.remove(key)
            last.append(key)
            while len(last) > MOST_LARGE:
                self._opened.pop(last.pop(0), None)
            alone = self._opened.setdefault("large alone", threading.Lock())
        with alone:
            return self.remembered(key, make)

    @property
    def path(self) -> str | None:
        """Name of the axis along which a continuation runs; None for a sweep."""
        return None if self.plan.path is None else self.plan.dims[self.plan.path]

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Possible horizontal axes: the swept parameters, or, if none is swept, the frequency or first parameter."""
        swept = tuple(Axis(a.dim, a.parameter, a.values) for a in parameter_axes(self.spec))
        if swept:
            return swept
        if self.spec.frequency_hz is not None and self.model.crossing is None:
            return (Axis(FREQUENCY_DIM, "frequency_hz", np.array([self.spec.frequency_hz]), False),)
        first = self.parameters.names[0]
        return (Axis(first, first, np.array([self.parameters[first]]), False),)

    def axis(self, name: str) -> Axis:
        """Return an axis by name; raise `ExplorerError` with the nearest names if there is none."""
        for axis in self.axes:
            if axis.name == name:
                return axis
        raise ExplorerError(unknown_name("axis", name, [a.name for a in self.axes]))

    @property
    def start_dims(self) -> tuple[str, ...]:
        """Dims over initial conditions: they distinguish the cells at one parameter point."""
        return tuple(d for d in self.plan.dims if is_start_dim(d))

    @property
    def n_keep(self) -> int:
        """Number of section points stored for each cell."""
        return int(self.plan.sizes["period_index"])

    def check_axes(self, at: Mapping[str, int]) -> None:
        """Raise `ExplorerError` if an axis name does not exist in the run."""
        known = [a.name for a in self.axes]
        for name in at:
            if name not in known:
                raise ExplorerError(unknown_name("axis", name, known or ["none"]))

    def place(self, at: Mapping[str, int], *, but: str = "") -> dict[str, int]:
        """Check the index on every swept axis except `but`, and return these indices by axis.

        Parameters
        ----------
        at
            Index by axis.
        but
            The axis that is left out.

        Raises
        ------
        ExplorerError
            If an axis is unknown or missing, or an index lies off it.
        """
        wanted = {a.name: len(a.values) for a in self.axes if a.swept and a.name != but}
        shared = {a.name for a in self.axes if not a.swept or a.name == but}
        for name in at:
            if name not in wanted and name not in shared:
                raise ExplorerError(unknown_name("axis", name, list(wanted) or ["none"]))
        found = {}
        for name, size in wanted.items():
            index = at.get(name, 0 if size == 1 else None)
            if index is None:
                raise ExplorerError(f"at.{name} is missing: give an index from 0 to {size - 1}.")
            if not 0 <= index < size:
                raise ExplorerError(f"at.{name} = {index} is out of bounds: it must be 0 to {size - 1}.")
            found[name] = int(index)
        return found

    def cell(self, number: int) -> dict[str, int]:
        """Return a cell's index on each of the cube's dims, from its flat number.

        Raises
        ------
        ExplorerError
            If there is no such cell.
        """
        if not 0 <= number < self.plan.n_cells:
            raise ExplorerError(f"cell = {number} is out of bounds: the cube has cells 0 to {self.plan.n_cells - 1}.")
        index = np.unravel_index(number, self.plan.shape)
        return {dim: int(i) for dim, i in zip(self.plan.dims, index, strict=True)}

    def inputs(self, index: Mapping[str, int]) -> Inputs:
        """Return the kernel's inputs for a cell: packed parameters, frequency, initial state."""
        return CellMap(self.spec).inputs(tuple(slice(index[d], index[d] + 1) for d in self.plan.dims))
