"""The parameter points of a cube: their cells in blocks, and what is integrated there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.models.parameters import Parameters, load_preset
from magpend_core.models.pendulum.systems import PENDULUM_FITTED, system_of
from pipeline.analysis.attractors.cells import Block
from pipeline.layout.vocabulary import START_DIMS

BUDGET = 256 * 2**20
"""Bytes of sections held at once."""


@dataclass
class Point:
    """One parameter point: where its cells are, and what is integrated there."""

    cube: xr.Dataset
    start_dims: tuple[str, ...]
    frequency: float
    packed: np.ndarray
    parameters: Parameters | None
    state_names: tuple[str, ...]
    block_cells: int

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return math.prod(self.cube.sizes[d] for d in self.start_dims)

    def blocks(self) -> Iterator[Block]:
        """All cells in blocks, in the order of the start dims."""
        first = self.start_dims[0] if self.start_dims else None
        length = self.cube.sizes[first] if first else 1
        inner = self.n_cells // max(length, 1)
        step = max(1, self.block_cells // max(inner, 1))
        for begin in range(0, length, step):
            part = self.cube.isel({first: slice(begin, begin + step)}) if first else self.cube
            n = min(step, length - begin) * inner
            yield self._block(part, slice(begin * inner, begin * inner + n), n)

    def _block(self, part: xr.Dataset, cells: slice, n: int) -> Block:
        def values(name: str, own: tuple[str, ...]) -> np.ndarray:
            array = part[name].transpose(*self.start_dims, *own)
            return np.asarray(array.values).reshape(n, *array.shape[len(self.start_dims) :])

        section = values("section", ("period_index", "state")).astype(np.float64)
        links = sum(name in ("psi1", "psi2") for name in self.state_names)
        turns = values("turns", ("link",)) if "turns" in part else np.zeros((n, links), np.int64)
        return Block(cells, section, values("status", ()), values("orbit_period", ()), turns)


def parameters_of(ds: xr.Dataset) -> Parameters:
    """Parameters that a run's attribute ``parameters`` tells, a line ``name = value`` for each.

    Raises
    ------
    ValueError
        If it is not there.
    """
    lines = str(ds.attrs.get("parameters", "")).splitlines()
    values = {name.strip(): float(value) for name, _, value in (line.partition("=") for line in lines)}
    if not values:
        raise ValueError(
            "The dataset has no attribute 'parameters'; give parameters, or set polish to False."
        )
    return load_preset().replace(**values)


def engine_inputs(
    ds: xr.Dataset, parameters: Parameters | np.ndarray | None, system: System | None, *, needed: bool
) -> tuple[Parameters | np.ndarray | None, System]:
    """Parameters and system: those given, else those of the run."""
    base = parameters_of(ds) if parameters is None and needed else parameters
    if system is None:
        system = system_of(base) if isinstance(base, Parameters) else PENDULUM_FITTED
    return base, system


# ---- reading -----------------------------------------------------------------------------------


def slabs(
    ds: xr.Dataset,
    start_dims: tuple[str, ...],
    base: Parameters | np.ndarray | None,
    system: System,
    budget: int,
) -> Iterator[dict[tuple[int, ...], Point]]:
    """Parameter points, some at a time: what fits is loaded at once, since chunks span many points."""
    names = [n for n in ("section", "status", "orbit_period", "turns") if n in ds]
    cube = ds[names].reset_coords(drop=True) if "frequency" in ds.dims else ds[names]
    dims = [str(d) for d in ds["status"].dims if d not in START_DIMS]
    shape = [ds.sizes[d] for d in dims]
    per_point = ds["section"].size * 8 // max(math.prod(shape), 1)
    cell = 8 * math.prod(ds.sizes[d] for d in ("period_index", "state"))
    rows = max(1, budget // max(per_point * math.prod(shape[1:]), 1))
    for begin in range(0, shape[0] if dims else 1, rows):
        slab = cube.isel({dims[0]: slice(begin, begin + rows)}) if dims else cube
        if slab["section"].size * 8 <= budget:
            slab = slab.load()
        sizes = [slab.sizes[d] for d in dims]
        points = {}
        for local in np.ndindex(*sizes):
            index = (local[0] + begin, *local[1:]) if dims else ()
            one = slab.isel(dict(zip(dims, local, strict=True)))
            values = {d: float(ds[d].values[i]) for d, i in zip(dims, index, strict=True)}
            points[index] = _point(one, ds, start_dims, values, base, system, max(1, budget // (4 * cell)))
        yield points


def _point(
    one: xr.Dataset, ds: xr.Dataset, start_dims: tuple[str, ...], values: Mapping[str, float],
    base: Parameters | np.ndarray | None, system: System, block_cells: int,
) -> Point:  # fmt: skip
    own = dict(values)
    fixed = float(ds["frequency"]) if "frequency" in ds.coords and not ds["frequency"].ndim else math.nan
    frequency = own.pop("frequency", fixed)
    parameters = base.replace(**own) if isinstance(base, Parameters) else None
    if parameters is not None:
        packed = parameters.pack()
    else:
        packed = np.zeros(len(system.parameter_names)) if base is None else np.array(base, np.float64)
        for name, value in own.items():
            if name in system.parameter_names:
                packed[system.parameter_names.index(name)] = value
    return Point(one, start_dims, frequency, packed, parameters, system.state_names, block_cells)
