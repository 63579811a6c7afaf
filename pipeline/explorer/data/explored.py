"""Open a run for the explorer, such that its result cube and its stored analyses are read only once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.explorer import RequestError
from pipeline.layout.cells import parameter_axes
from pipeline.layout.evaluation import origins_at
from pipeline.layout.own_words import with_plain_names
from pipeline.layout.vocabulary import FREQUENCY_DIM, is_start_dim
from pipeline.motion.steady import Inputs
from pipeline.runs.derive import stored_each
from pipeline.specification.problems import unknown_name
from pipeline.specification.tables import FREQUENCY
from pipeline.store.files import DERIVED
from pipeline.store.products import products_in
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Mapping

    import xarray as xr


T = TypeVar("T")


@dataclass(frozen=True)
class Axis:
    """Axis of a run that a diagram can have as its horizontal axis."""

    name: str  # name of the cube's dim; in a run that sweeps nothing, name of the one value that it has
    parameter: str  # its name in a specification
    values: np.ndarray  # in the order of the cube
    swept: bool = True  # whether it is a dim of the cube


@dataclass(frozen=True)
class ExploredRun(RunDirectory):
    """A run opened for the explorer. It reads its result cube and its stored analyses only once.

    Reading never computes: what is not in the cube or in ``derived/`` is not there.
    """

    curves: RunDirectory | None = None  # run whose bifurcation curves are shown; None for those of the run itself

    _opened: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)
    _lock: Any = field(default_factory=threading.RLock, compare=False, repr=False)

    def cube(self, chunks: Any = None, *, check: bool | None = None) -> xr.Dataset:
        """Return the run's result cube as a lazy dataset; each chunk is verified when it is read."""
        if chunks is not None or check is not None:
            return super().cube(chunks, check=check)
        return self.remembered("cube", self._loaded_cube)

    def _loaded_cube(self) -> xr.Dataset:
        opened = super().cube()
        # each use of a coordinate would read it again
        return opened.assign_coords({n: c.load() for n, c in opened.coords.items()})

    def kept(self, name: str) -> xr.Dataset | None:
        """Return the stored result of an analysis; None if it has not been computed."""
        return self.remembered(f"derived {name}", lambda: next(map(with_plain_names, stored_each(self, name)), None))

    def kept_each(self, name: str) -> list[xr.Dataset]:
        """Return all stored results of an analysis, such as one for each pair of attractors; see `stored_each`."""
        return self.remembered(f"each {name}", lambda: [with_plain_names(ds) for ds in stored_each(self, name)])

    def bifurcation_curves(self) -> xr.Dataset | None:
        """Return the stored bifurcation curves of this run, or of the run named for them; None if there are none."""
        if self.curves is not None:
            return ExploredRun.open(self.curves).bifurcation_curves()
        found = self.atlas()
        return self.kept("curves") if found is None else found

    def atlas(self) -> xr.Dataset | None:
        """Return the stored atlas; None if there is none, or if another run is named for the curves."""
        return self.kept("atlas") if self.curves is None else None

    def refreshed(self) -> ExploredRun:
        """Return the run as it is now, with the cells and results that were added since it was opened."""
        if not self.complete:
            return replace(ExploredRun.open(self.info.files), curves=self.curves)
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
        """Return the cached value of a key; compute it at the first request only."""
        with self._lock:
            lock = self._opened.setdefault(f"lock {key}", threading.Lock())
        with lock:
            if key not in self._opened:
                self._opened[key] = make()
            found: T = self._opened[key]
            return found

    def large(self, key: str, make: Callable[[], T]) -> T:
        """Return the cached value of a key; compute it if it is not cached. The last few values stay in memory."""
        most = 2  # diagrams that are kept in memory, of up to some 200 MB each
        with self._lock:
            last: list[str] = self._opened.setdefault("large", [])
            if key in last:
                last.remove(key)
            last.append(key)
            while len(last) > most:
                self._opened.pop(last.pop(0), None)
            alone = self._opened.setdefault("large alone", threading.Lock())
        with alone:
            return self.remembered(key, make)

    def drop_large(self) -> None:
        """Forget the large values, which are computed again when they are needed."""
        with self._lock:
            for key in self._opened.pop("large", []):
                self._opened.pop(key, None)

    @property
    def path(self) -> str | None:
        """Name of the axis along which the continuation runs; None if the run is a sweep."""
        return None if self.plan.path is None else self.plan.dims[self.plan.path]

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Axes that a diagram can have: the swept parameters or, if there are none, one fixed parameter."""
        swept = tuple(Axis(a.dim, a.parameter, a.values) for a in parameter_axes(self.spec))
        if swept:
            return swept
        if self.spec.frequency_hz is not None and self.model.clock.hertz is None:
            return (Axis(FREQUENCY_DIM, "frequency_hz", np.array([self.spec.frequency_hz]), False),)
        first = self.parameters.names[0]
        return (Axis(first, first, np.array([self.parameters[first]]), False),)

    def axis(self, name: str) -> Axis:
        """Return an axis by name; raise RequestError with similar names if there is none."""
        for axis in self.axes:
            if axis.name == name:
                return axis
        raise RequestError(unknown_name("axis", name, [a.name for a in self.axes]))

    @property
    def start_dims(self) -> tuple[str, ...]:
        """Dims along which the cells of one parameter point differ, such as the initial condition."""
        return tuple(d for d in self.plan.dims if is_start_dim(d))

    @property
    def n_keep(self) -> int:
        """Number of section points stored for each cell."""
        return int(self.plan.sizes["period_index"])

    def origins(self, index: Mapping[str, int]) -> dict[str, float]:
        """Return the values from which the starts of each state are counted, at indices on the parameter dims."""
        spec = self.plan.spec
        swept = {axis.parameter: float(axis.values[index.get(axis.dim, 0)]) for axis in parameter_axes(spec)}
        (found,) = origins_at(spec, [{**spec.values, FREQUENCY: spec.frequency_hz, **swept}])
        return dict(zip(spec.model.state_names, found.tolist(), strict=True))

    def check_axes(self, at: Mapping[str, int]) -> None:
        """Raise RequestError if the run has no axis of one of the given names."""
        known = [a.name for a in self.axes]
        for name in at:
            if name not in known:
                raise RequestError(unknown_name("axis", name, known or ["none"]))

    def place(self, at: Mapping[str, int], *, but: str = "") -> dict[str, int]:
        """Return the index on every swept axis except `but`; raise RequestError if one is unknown or missing."""
        wanted = {a.name: len(a.values) for a in self.axes if a.swept and a.name != but}
        shared = {a.name for a in self.axes if not a.swept or a.name == but}
        for name in at:
            if name not in wanted and name not in shared:
                raise RequestError(unknown_name("axis", name, list(wanted) or ["none"]))
        found = {}
        for name, size in wanted.items():
            index = at.get(name, 0 if size == 1 else None)
            if index is None:
                raise RequestError(f"at.{name} is missing: give an index from 0 to {size - 1}.")
            if not 0 <= index < size:
                raise RequestError(f"at.{name} = {index} is out of bounds: it must be 0 to {size - 1}.")
            found[name] = int(index)
        return found

    def cell(self, number: int) -> dict[str, int]:
        """Convert the flat number of a cell to its index on each dim; raise RequestError if there is none."""
        if not 0 <= number < self.plan.n_cells:
            raise RequestError(f"cell = {number} is out of bounds: the cube has cells 0 to {self.plan.n_cells - 1}.")
        index = np.unravel_index(number, self.plan.shape)
        return {dim: int(i) for dim, i in zip(self.plan.dims, index, strict=True)}

    def number(self, index: Mapping[str, int]) -> int:
        """Return the flat number of the cell at an index on each dim."""
        return int(np.ravel_multi_index([index[d] for d in self.plan.dims], self.plan.shape))

    def inputs(self, index: Mapping[str, int]) -> Inputs:
        """Return the inputs of a cell's integration: packed parameters, frequency and initial state."""
        return self.plan.cells.inputs(tuple(slice(index[d], index[d] + 1) for d in self.plan.dims))
