"""Read the parameter points of a run's result cube: their cells in blocks, their parameters and their system."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.models.model import Model, Parameters
from magpend_core.poincare import section_of
from magpend_core.pointwise import rates_at
from magpend_core.status import Status
from pipeline.analysis.attractors.extension.growth import volumes_of
from pipeline.analysis.attractors.finding.cell_blocks import Block, marks_of
from pipeline.analysis.attractors.finding.known_sets import Cycle, Equilibrium
from pipeline.layout.vocabulary import FREQUENCY_DIM, START, frequency_of, model_of, parameters_of, split_dims
from pipeline.products.reporting import UNTOLD, report
from pipeline.results.sets import Geometry

_READ = ("section", "status", "orbit_period", "turns", "rest_state", "return_time", "n_periods", "step_size")
"""Variables that are read from a cube."""

_MARK = "mark"
"""Hashes of the cells' sections beside these variables: many short rows are hashed at the price of a few."""

PASSING = "passing through the cells of a point"
"""Name of the work while the blocks of a parameter point are read one after another."""

SECTION_BYTES = 256 * 2**20
"""Most memory for sections held at once [bytes]."""


@dataclass(frozen=True)
class Dynamics:
    """Model, parameters and compiled system of the cells of a run's result cube."""

    model: Model | None  # None if another system was given
    # parameters of the run; swept values are replaced at each point. A packed vector if another system was given.
    # None if nothing is integrated.
    parameters: Parameters | np.ndarray | None
    system: System | None  # None if nothing is integrated, since a system imports the compiler
    geometry: Geometry  # geometry of the states

    @classmethod
    def of(
        cls,
        ds: xr.Dataset,
        parameters: Parameters | np.ndarray | None = None,
        system: System | None = None,
        *,
        needed: bool = True,
    ) -> Dynamics:
        """Collect the model, the parameters and the system from the arguments. Missing ones are read from the
        attributes of the run.

        Raises
        ------
        ValueError
            If the parameters are `needed` and missing.
        """
        if system is not None:
            return cls(None, parameters, system, Geometry.of(system))
        if parameters is None and (needed or ds.attrs.get("parameters")):
            parameters = parameters_of(ds)
        model = parameters.model if isinstance(parameters, Parameters) else model_of(ds)
        return cls(model, parameters, model.system if needed else None, Geometry.of(model))

    @property
    def integrates(self) -> System:
        """System to integrate; AssertionError if the analysis was given no system."""
        assert self.system is not None
        return self.system

    @property
    def can_rest(self) -> bool:
        """Whether to search for equilibria: the model can have some, and its equations may be integrated."""
        return self.model is not None and self.model.clock.has_equilibria and self.system is not None

    @property
    def has_returns(self) -> bool:
        """Whether the section points are crossings of a Poincare section by an autonomous flow."""
        return self.model is not None and self.model.crossing is not None

    @property
    def n_angles(self) -> int:
        """Number of states that are angles."""
        return sum(self.geometry.is_angle)


@dataclass
class Point:
    """One parameter point: its cells (trajectories), its parameters and its system."""

    # cells of some parameter points, and the indices of this point among them
    cube: xr.Dataset
    at: Mapping[str, int]
    start_dims: tuple[str, ...]
    frequency: float  # drive frequency [Hz]; for a flow seen at crossings, one over the longest wait for a return
    packed: np.ndarray  # packed parameter vector for the engine
    parameters: Parameters | None  # parameters with the swept values of this point; None for a system without a model
    n_angles: int
    block_cells: int
    system: System | None = None  # system to integrate
    # equilibria that cells are at, see `equilibria.tell_rest`
    equilibria: list[Equilibrium] = field(default_factory=list)
    # (cell,): index of the equilibrium that each cell is at, -1 for none. Cells at rest count as neither closed nor
    # bounded.
    at_rest: np.ndarray | None = None
    # (cell, state): last state of each cell, of cells without a return after the wait; NaN if it returned or failed
    last_states: np.ndarray | None = None
    # limit cycles that cells are on, for a flow sampled at equal times; see `limit_cycles.tell_cycles`
    cycles: list[Cycle] = field(default_factory=list)
    # (cell,): index of the limit cycle that each cell is on, -1 for none. These cells, too, count as neither closed
    # nor bounded.
    on_cycle: np.ndarray | None = None
    n_periods: int = 0  # drive periods or returns that the run integrated here, summed over cells
    has_returns: bool = False  # whether sections are crossings of a flow
    can_rest: bool = False  # whether equilibria are searched
    # variables of all cells, shapes (cell, ...), if they fit the memory; else they are read from the cube
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    _whole: Block | None = None

    @property
    def n_neutral(self) -> int:
        """Number of Lyapunov exponents that are 0 because the flow is autonomous: 1 if it is sampled at equal times,
        else 0.
        """
        return int(self.can_rest and not self.has_returns)

    def volumes(self, derivatives: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Compute the logarithm of the factor by which the flow changes phase volume from each section point to the
        next, shape (n,).
        """

        def flow(states: np.ndarray) -> np.ndarray:
            return rates_at(self.integrates, states, self.packed)

        section = section_of(self.integrates)
        normals = None if section is None else [section.normals(states, self.packed) for states in (before, after)]
        return volumes_of(derivatives, before, after, normals, flow)

    @property
    def integrates(self) -> System:
        """System to integrate; AssertionError if the analysis was given no system."""
        assert self.system is not None
        return self.system

    @property
    def n_cells(self) -> int:
        """Number of cells (trajectories) of this parameter point."""
        return math.prod(self.cube.sizes[d] for d in self.start_dims)

    @property
    def n_states(self) -> int:
        """Number of state variables."""
        return int(self.cube.sizes["state"])

    def holding(self, block: Block, n_periods: int = 0) -> Point:
        """Return this parameter point with the trajectories of a block as its cells."""
        n, n_kept = block.section.shape[:2]
        seconds = np.full((n, n_kept), 1.0 / self.frequency) if block.seconds is None else block.seconds
        return replace(
            self,
            cube=xr.Dataset({"section": ((START, "period_index", "state"), block.section)}),
            at={},
            arrays={},
            start_dims=(START,),
            block_cells=n,
            at_rest=None,
            on_cycle=None,
            n_periods=n_periods,
            _whole=replace(block, cells=slice(0, n), seconds=seconds),
        )

    def blocks(self) -> Iterator[Block]:
        """Yield all cells in blocks, in the order of their initial conditions (or branches, in a continuation).

        Several blocks take time: the number of cells that are done is reported as progress.
        """
        first = self.start_dims[0] if self.start_dims else None
        length = self.cube.sizes[first] if first else 1
        inner = self.n_cells // max(length, 1)
        step = max(1, self.block_cells // max(inner, 1))
        if step >= length:
            self._whole = self._whole or self._read(slice(0, length), slice(0, self.n_cells))
            yield _without(self._whole, self.is_elsewhere)
            return
        for begin in range(0, length, step):
            report(PASSING, begin * inner, self.n_cells, UNTOLD)
            end = min(begin + step, length)
            cells = slice(begin * inner, end * inner)
            yield _without(self._read(slice(begin, end), cells), self.is_elsewhere[cells])

    @property
    def is_elsewhere(self) -> np.ndarray:
        """Whether each cell is at an equilibrium, or on a limit cycle of a flow sampled at equal times."""
        found = np.zeros(self.n_cells, bool)
        for told in (self.at_rest, self.on_cycle):
            if told is not None:
                found |= told >= 0
        return found

    def _read(self, rows: slice, cells: slice) -> Block:
        """Read the cells of some values of the first start dim."""
        arrays = {name: array[cells] for name, array in self.arrays.items()}
        if not arrays:
            part = self.cube.isel({**self.at, **dict.fromkeys(self.start_dims[:1], rows)})
            arrays = _arrays(part, (), self.start_dims)
        return _block(cells, arrays, np.full(len(arrays["status"]), 1.0 / self.frequency), self.n_angles)


def _block(cells: slice, arrays: Mapping[str, np.ndarray], seconds: np.ndarray, n_angles: int) -> Block:
    """Return cells as a block, with the time between their sections [s] unless it is among the arrays."""
    n, n_keep = arrays["section"].shape[:2]
    turns, times = arrays.get("turns"), arrays.get("return_time")
    return Block(
        cells,
        arrays["section"],
        arrays["status"],
        arrays["orbit_period"],
        np.zeros((n, n_angles), np.int64) if turns is None else turns,
        arrays.get("rest_state"),
        np.repeat(seconds[:, None], n_keep, axis=1) if times is None else times,
        arrays.get("step_size"),
        arrays.get(_MARK),
    )


def _without(block: Block, elsewhere: np.ndarray) -> Block:
    """Set the status of some cells to ``NO_RETURN``, so that the search for orbits skips them."""
    if not elsewhere.any():
        return block
    return replace(block, status=np.where(elsewhere, np.int8(Status.NO_RETURN), block.status))


class Slab(dict[tuple[int, ...], Point]):
    """Parameter points that are analysed together, by their indices in the result cube; all have as many cells."""

    # variables of all cells, shapes (point, cell, ...), if they fit the memory; else the points read them
    arrays: Mapping[str, np.ndarray]

    @property
    def points(self) -> list[Point]:
        """Points by number."""
        return list(self.values())

    @property
    def n_cells(self) -> int:
        """Number of cells (trajectories) of all points."""
        return sum(point.n_cells for point in self.values())

    def only(self, which: np.ndarray) -> Slab:
        """Return the points that are marked in `which` (point,)."""
        if which.all():
            return self
        part = Slab(one for one, own in zip(self.items(), which.tolist(), strict=True) if own)
        part.arrays = {name: array[which] for name, array in self.arrays.items()}
        return part

    def blocks(self) -> Iterator[Block]:
        """Yield the cells of all points in blocks: those of some points together, or a part of the cells of one."""
        points = self.points
        each = points[0].n_cells if points else 1
        n = points[0].block_cells // max(each, 1) if self.arrays and points else 0
        for first in range(0, len(points), max(n, 1)):
            some, start = points[first : first + max(n, 1)], first * each
            if not n:
                for block in some[0].blocks():
                    cells = slice(start + block.cells.start, start + block.cells.stop)
                    yield replace(block, cells=cells, owners=np.full(len(block.status), first))
                continue
            rows = len(some) * each
            arrays = {k: x[first : first + n].reshape(rows, *x.shape[2:]) for k, x in self.arrays.items()}
            seconds = np.repeat([1.0 / point.frequency for point in some], each)
            block = _block(slice(start, start + rows), arrays, seconds, some[0].n_angles)
            block = replace(block, owners=np.repeat(np.arange(first, first + len(some)), each))
            yield _without(block, np.concatenate([point.is_elsewhere for point in some]))


def _arrays(part: xr.Dataset, dims: tuple[str, ...], start_dims: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the variables of some cells as arrays of shape (*dims, cell, ...), sections as float64."""
    found, n = {}, math.prod(part.sizes[d] for d in start_dims)
    for name, variable in part.data_vars.items():
        own = [d for d in ("period_index", "state") if d in variable.dims]
        values = variable.transpose(*dims, *start_dims, ..., *own).values
        values = values.reshape(*values.shape[: len(dims)], n, *values.shape[len(dims) + len(start_dims) :])
        found[str(name)] = values.astype(np.float64, copy=False) if name == "section" else values
    return found


def slabs(ds: xr.Dataset, dynamics: Dynamics, budget: int) -> Iterator[Slab]:
    """Yield parameter points in groups, by their indices in the result cube. A group that fits the memory budget is
    read at once.
    """
    names = [name for name in _READ if name in ds]
    cube = ds[names].reset_coords(drop=True) if FREQUENCY_DIM in ds.dims else ds[names]
    dims, start_dims = split_dims(ds["status"])
    shape = [ds.sizes[d] for d in dims]
    per_point = ds["section"].size * 8 // max(math.prod(shape), 1)
    block_cells = max(1, budget // (32 * math.prod(ds.sizes[d] for d in ("period_index", "state"))))
    axes, fixed = {d: ds[d].values.tolist() for d in dims}, _fixed(ds)
    rows = max(1, budget // max(per_point * math.prod(shape[1:]), 1))
    for begin in range(0, shape[0] if dims else 1, rows):
        slab = cube.isel({dims[0]: slice(begin, begin + rows)}) if dims else cube
        arrays = {}
        if slab["section"].size * 8 <= budget:
            slab = slab.load()
            arrays = _arrays(slab, dims, start_dims)
            section = arrays["section"]
            arrays[_MARK] = marks_of(section.reshape(-1, *section.shape[-2:])).reshape(section.shape[:-2])
        n_periods = slab["n_periods"].sum(start_dims).transpose(*dims).values if "n_periods" in slab else None
        points = Slab()
        points.arrays = {
            name: x.reshape(math.prod(x.shape[: len(dims)]), *x.shape[len(dims) :]) for name, x in arrays.items()
        }
        for local in np.ndindex(*(slab.sizes[d] for d in dims)):
            index = (local[0] + begin, *local[1:]) if dims else ()
            values = {**fixed, **{d: float(axes[d][i]) for d, i in zip(dims, index, strict=True)}}
            at = dict(zip(dims, local, strict=True))
            point = points[index] = _point(slab, at, start_dims, values, dynamics, block_cells)
            point.n_periods = point.n_cells * ds.sizes["period_index"] if n_periods is None else int(n_periods[local])
            point.arrays = {name: array[local] for name, array in arrays.items()}
        yield points


def _fixed(ds: xr.Dataset) -> dict[str, float]:
    return {str(name): float(c) for name, c in ds.coords.items() if not c.ndim and c.dtype.kind in "fiu"}


def _point(
    cube: xr.Dataset,
    at: Mapping[str, int],
    start_dims: tuple[str, ...],
    values: Mapping[str, float],
    dynamics: Dynamics,
    block_cells: int,
) -> Point:
    frequency, base = frequency_of(dynamics.model, values), dynamics.parameters
    own: dict[str, Any] = {"has_returns": dynamics.has_returns, "can_rest": dynamics.can_rest}
    if isinstance(base, Parameters):
        parameters = base.replace(**{name: value for name, value in values.items() if name in base})
        return Point(
            cube,
            at,
            start_dims,
            frequency,
            parameters.pack(),
            parameters,
            dynamics.n_angles,
            block_cells,
            dynamics.system,
            **own,
        )
    names = dynamics.system.parameter_names if dynamics.system is not None else ()
    packed = np.zeros(len(names)) if base is None else np.array(base, np.float64)
    for name, value in values.items():
        if name in names:
            packed[names.index(name)] = value
    return Point(cube, at, start_dims, frequency, packed, None, dynamics.n_angles, block_cells, dynamics.system, **own)
