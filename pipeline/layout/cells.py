"""Turn a run's specification into numbers: dims and coordinates of the result cube, and input arrays of each task."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from magpend_core.models.drift.ramps import Ramp, RampOfCells, motion_of
from magpend_core.models.model import Model, State
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import value_of
from pipeline.layout.vocabulary import BRANCH, FREQUENCY_DIM, ORIGIN, START, grid_dim
from pipeline.motion.steady import Inputs
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.expressions import read_expression
from pipeline.specification.spec import Spec
from pipeline.specification.starts import GridStarts, ListStarts, RandomStarts, Starts, degrees_key
from pipeline.specification.tables import FREQUENCY, Range

DIRECTION_CODES = {"up": 1, "down": -1}


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of the result cube: name, dims, values and attributes."""

    name: str
    dims: tuple[str, ...]
    values: np.ndarray
    attrs: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ParameterAxis:
    """A swept parameter: its name, its values, and its dim in the result cube."""

    dim: str
    parameter: str
    values: np.ndarray


@dataclass(frozen=True)
class InitialStates:
    """Initial states numbered by one flat index; a grid is stored as its axes, not as a table of all states."""

    # dims of the initial conditions in a sweep, and their sizes
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    # values of each state, in the model's units: one number for all, one value per row, or with `grid` one value
    # per step of the grid's dim
    columns: tuple[np.ndarray, ...]
    # index of each state's grid dim, None for a fixed state; None as a whole without a grid
    grid: tuple[int | None, ...] | None = None

    def __len__(self) -> int:
        return math.prod(self.shape)

    def at(self, flat: np.ndarray) -> np.ndarray:
        """Return the initial states at given flat indices, shape (n, n_states), in the model's units."""
        out = np.empty((len(flat), len(self.columns)))
        steps = np.unravel_index(flat, self.shape) if self.shape else ()
        for i, column in enumerate(self.columns):
            if column.ndim == 0:
                out[:, i] = column
            else:
                dim = 0 if self.grid is None else self.grid[i]
                assert dim is not None
                out[:, i] = column[steps[dim]]
        return out


@dataclass(frozen=True)
class Origins:
    """Values from which the starts of states are counted: expressions of the parameters, by the number of the state."""

    trees: Mapping[int, Tree]
    names: tuple[str, ...]  # of the packed parameters
    n_states: int

    @classmethod
    def of(cls, spec: Spec) -> Origins:
        """Return those of a specification."""
        texts, states = spec.initial_conditions.origin or {}, spec.model.state_names
        own = spec.model.parameter_names
        trees = {states.index(n): read_expression(f"origin.{n}", text, own) for n, text in texts.items()}
        return cls(trees, spec.values.names, len(states))

    def at(self, parameters: np.ndarray, frequency_hz: np.ndarray) -> np.ndarray:
        """Return the origins at parameter points, shape (n, n_states), from packed parameters (n, n_parameters)."""
        found = np.zeros((len(parameters), self.n_states))
        known = {"pi": np.pi, "f": frequency_hz, **dict(zip(self.names, parameters.T, strict=True))}
        with np.errstate(all="ignore"):
            for i, tree in self.trees.items():
                found[:, i] = value_of(tree, known)
        return found


def parameter_axes(spec: Spec) -> tuple[ParameterAxis, ...]:
    """Return the swept parameters in the order of the result cube's dims."""
    return tuple(
        ParameterAxis(FREQUENCY_DIM if name == FREQUENCY else name, name, axis.array())
        for name, axis in spec.axes.items()
    )


def _state_value(table: Any, state: str) -> tuple[Any, float]:
    """Return a state's value in a table of initial states, and the factor that converts it to SI units."""
    in_degrees = table.of(degrees_key(state))
    if in_degrees is not None:
        return in_degrees, math.pi / 180
    value = table.of(state)
    return (0.0 if value is None else value), 1.0


def initial_states(starts: Starts) -> InitialStates:
    """Return the initial states that a specification gives: as a list, as random samples, or as a grid."""
    if isinstance(starts, GridStarts):
        return _grid(starts)
    columns = _rows(starts) if isinstance(starts, ListStarts) else _samples(starts)
    return InitialStates((START,), (len(columns[0]),), tuple(columns))


def _grid(starts: GridStarts) -> InitialStates:
    dims: list[str] = []
    columns: list[np.ndarray] = []
    grid: list[int | None] = []
    for state in starts.system.state_names:
        value, factor = _state_value(starts, state)
        if isinstance(value, Range):
            grid.append(len(dims))
            dims.append(grid_dim(state))
            columns.append(value.array() * factor)
        else:
            grid.append(None)
            columns.append(np.array(value * factor))
    shape = tuple(len(c) for c in columns if c.ndim)
    return InitialStates(tuple(dims), shape, tuple(columns), tuple(grid))


def _rows(starts: ListStarts) -> list[np.ndarray]:
    rows, factor = (starts.points, 1.0) if starts.points is not None else (starts.points_deg, math.pi / 180)
    assert rows is not None
    n_states = len(starts.system.states)
    table = np.zeros((len(rows), n_states))
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return list((table * factor).T)


def _samples(starts: RandomStarts) -> list[np.ndarray]:
    # a number is drawn for fixed states, too, so that fixing one does not change the others
    names = starts.system.state_names
    uniform = _uniform(starts, len(names))
    columns = []
    for state, u in zip(names, uniform.T, strict=True):
        value, factor = _state_value(starts, state)
        low, high = value if isinstance(value, tuple) else (value, value)
        columns.append((low + (high - low) * u) * factor)
    return columns


def _uniform(starts: RandomStarts, n_states: int) -> np.ndarray:
    """Return samples of the unit box, shape (sample, state)."""
    random = np.random.Generator(np.random.PCG64(starts.seed))
    if starts.sampling is None:
        return random.random((starts.n, n_states))
    from scipy.stats import qmc  # slow to import

    if starts.sampling == "latin-hypercube":
        return np.asarray(qmc.LatinHypercube(n_states, rng=random).random(starts.n))
    # its numbers of samples are powers of two: of others the first are taken
    return np.asarray(qmc.Sobol(n_states, rng=random).random_base2((starts.n - 1).bit_length())[: starts.n])


def coordinates(spec: Spec) -> tuple[Coordinate, ...]:
    """Return the coordinates of the result cube, with numeric values only.

    ``direction`` is +1 (up) or -1 (down) here; `open_run` returns it as text.
    """
    model = spec.model
    found = [Coordinate(a.dim, (a.dim,), a.values, _parameter_attrs(a.parameter, model)) for a in parameter_axes(spec)]
    if FREQUENCY not in spec.axes and spec.model.clock.hertz is None:
        attrs = {"units": "Hz", "long_name": spec.motion.frequency_meaning}
        value = np.array(spec.frequency_hz, dtype=np.float64)
        found.append(Coordinate(FREQUENCY_DIM, (), value, attrs))
    states = initial_states(spec.initial_conditions)
    own = _branch_coords(spec, states) if spec.continuation else _start_coords(model, states)
    return (*found, *(_counted_from(coordinate, spec.initial_conditions.origin or {}) for coordinate in own))


def _counted_from(coordinate: Coordinate, origin: Mapping[str, str]) -> Coordinate:
    """Return a coordinate of starts, with the expression from which they are counted among its attributes."""
    text = next((text for state, text in origin.items() if grid_dim(state) == coordinate.name), None)
    if text is None:
        return coordinate
    meaning = f"{coordinate.attrs['long_name']}, counted from {text}"
    return replace(coordinate, attrs={**coordinate.attrs, "long_name": meaning, ORIGIN: text})


def _parameter_attrs(name: str, model: Model) -> dict[str, str]:
    if name == FREQUENCY:
        return {"units": "Hz", "long_name": "drive frequency"}
    parameter = model.parameter(name)
    return {"units": parameter.unit, "long_name": parameter.meaning}


def _start_attrs(state: State) -> dict[str, str]:
    return {"units": state.unit, "long_name": f"initial {state.meaning}"}


def _start_coords(model: Model, states: InitialStates) -> list[Coordinate]:
    found = []
    for i, (state, column) in enumerate(zip(model.states, states.columns, strict=True)):
        name = grid_dim(state.name)
        dims: tuple[str, ...] = ()
        if column.ndim:
            dims = (name,) if states.grid is not None else states.dims
        found.append(Coordinate(name, dims, np.asarray(states.columns[i]), _start_attrs(state)))
    return found


def _branch_coords(spec: Spec, states: InitialStates) -> list[Coordinate]:
    assert spec.continuation is not None
    directions = spec.continuation.directions
    n = len(states)
    seeds = np.tile(np.arange(n, dtype=np.int32), len(directions))
    codes = np.repeat([DIRECTION_CODES[d] for d in directions], n).astype(np.int8)
    dims = (BRANCH,)
    table = states.at(seeds)
    return [
        Coordinate(BRANCH, dims, np.arange(len(seeds), dtype=np.int32), {"long_name": "branch"}),
        Coordinate(
            "direction",
            dims,
            codes,
            {"long_name": "direction of the walk", "flag_values": [1, -1], "flag_meanings": "up down"},
        ),
        Coordinate("seed", dims, seeds, {"long_name": "index of the initial condition"}),
        *(Coordinate(grid_dim(s.name), dims, table[:, i], _start_attrs(s)) for i, s in enumerate(spec.model.states)),
    ]


class CellMap:
    """Conversion between a block of cells of the result cube and the kernel's arrays with the dims (branch, parameter
    point).

    In a sweep each cell is a branch with one point. In a continuation the branches of a block walk the
    block's part of the path: upward ones from its first point, downward ones from its last.
    """

    def __init__(self, spec: Spec) -> None:
        base = spec.values
        self.names = base.names
        self.packed = base.pack()
        self.fixed_hz = np.nan if spec.frequency_hz is None else spec.frequency_hz
        self.axes = parameter_axes(spec)
        self.states = initial_states(spec.initial_conditions)
        self.origins = Origins.of(spec)
        self.walk = spec.continuation
        if self.walk is None:
            self.dims = (*(a.dim for a in self.axes), *self.states.dims)
            self.shape = (*(len(a.values) for a in self.axes), *self.states.shape)
            self.path: int | None = None
        else:
            n_branches = len(self.states) * len(self.walk.directions)
            self.dims = (*(a.dim for a in self.axes), BRANCH)
            self.shape = (*(len(a.values) for a in self.axes), n_branches)
            self.path = [a.parameter for a in self.axes].index(self.walk.path)

    def inputs(self, block: tuple[slice, ...]) -> Inputs:
        """Return the kernel's input arrays for a block of cells."""
        sizes = [s.stop - s.start for s in block]
        index = self._branch_first(np.indices(sizes).reshape(len(block), math.prod(sizes)), block)
        values = {a.parameter: a.values[index[i]] for i, a in enumerate(self.axes)}
        shape = index.shape[1:]
        parameters = np.broadcast_to(self.packed, (*shape, len(self.packed))).copy()
        for name, value in values.items():
            if name != FREQUENCY:
                parameters[..., self.names.index(name)] = value
        frequency = values.get(FREQUENCY, np.full(shape, self.fixed_hz))
        states = self.states.at(self._start_of(index[:, :, 0]))
        if self.origins.trees:
            states += self.origins.at(parameters[:, 0], frequency[:, 0])
        return Inputs(parameters, frequency, states)

    def spread(self, n: int) -> Inputs:
        """Return the inputs of at most `n` cells, evenly spread over the run."""
        n_cells = math.prod(self.shape)
        rows = np.unique(np.linspace(0, n_cells - 1, min(n, n_cells)).astype(np.int64))
        places = [np.unravel_index(row, self.shape) if self.shape else () for row in rows]
        found = [self.inputs(tuple(slice(int(i), int(i) + 1) for i in place)) for place in places]
        parts = ("parameters", "frequency_hz", "initial_states")
        return Inputs(*(np.concatenate([getattr(one, name) for one in found]) for name in parts))

    def last_cells(self, block: tuple[slice, ...]) -> tuple[slice, ...]:
        """Return slices that select the last cell of each branch of a block. All branches of the block must run in the
        same direction.
        """
        assert self.path is not None
        part = block[self.path]
        down = self._down(np.array([block[-1].start]))[0]
        last = slice(part.start, part.start + 1) if down else slice(part.stop - 1, part.stop)
        return tuple(last if i == self.path else s for i, s in enumerate(block))

    def _start_of(self, index: np.ndarray) -> np.ndarray:
        own = index[len(self.axes) :]
        if self.walk is not None:
            return np.asarray(own[0] % len(self.states))
        if not self.states.shape:
            return np.zeros(index.shape[1], dtype=np.int64)
        return np.asarray(np.ravel_multi_index(tuple(own), self.states.shape))

    def _branch_first(self, cells: np.ndarray, block: tuple[slice, ...]) -> np.ndarray:
        """Return cell indices, shape (dim, branch, point). The points of a branch are in the order in which the
        continuation visits them.
        """
        sizes = [s.stop - s.start for s in block]
        index = cells + np.array([s.start for s in block], dtype=np.int64).reshape(-1, 1)
        if self.path is None:
            return index[..., None]
        grid = np.moveaxis(index.reshape(len(block), *sizes), self.path + 1, -1)
        walked = grid.reshape(len(block), -1, sizes[self.path]).copy()
        down = self._down(walked[-1, :, 0])
        walked[:, down] = walked[:, down, ::-1]
        return walked

    def _down(self, branches: np.ndarray) -> np.ndarray:
        """Return a mask of the branches that are continued towards falling parameter values."""
        assert self.walk is not None
        directions = np.array([d == "down" for d in self.walk.directions])
        return np.asarray(directions[branches // len(self.states)])

    def outputs(self, block: tuple[slice, ...], values: np.ndarray) -> np.ndarray:
        """Reshape a kernel result of shape (branch, point, ...) to the shape of its block of cells."""
        sizes = [s.stop - s.start for s in block]
        own = values.shape[2:]
        if self.path is None:
            return values.reshape(*sizes, *own)
        others = [n for i, n in enumerate(sizes) if i != self.path]
        branches = np.broadcast_to(np.arange(block[-1].start, block[-1].stop), others).ravel()
        down = self._down(branches)
        values = values.copy()
        values[down] = values[down, ::-1]
        grid = values.reshape(*others, sizes[self.path], *own)
        return np.ascontiguousarray(np.moveaxis(grid, len(others), self.path))


def at_section(parameter: str) -> str:
    """Return the name of the coordinate with a moving parameter's values at the sections."""
    return f"{parameter}_at_section"


def further_coordinates(spec: Spec) -> list[Coordinate]:
    """Return the coordinates of the cube that follow from others: labels of states and products, and the values of
    moving parameters at the stored sections, on the axes on which a parameter's motion depends.
    """
    model = spec.model
    found = [
        Coordinate("state", ("state",), _values(model.state_names), {"long_name": "component of the state"}),
        Coordinate("state_units", ("state",), _values(model.state_units), {"long_name": "unit of the component"}),
    ]
    if model.angles:
        dim = model.angle_dim
        found.append(Coordinate(dim, (dim,), _values(model.angles), {"long_name": "by its angle"}))
    for name, options in spec.products.items():
        for dim, values in CELL_PRODUCTS[name].coordinates(options, model).items():
            found.append(Coordinate(dim, (dim,), _values(values)))
    return [*found, *(_coordinate(spec, ramp) for ramp in spec.ramps)]


def _values(labels: Iterable[Any]) -> np.ndarray:
    values = list(labels)
    return np.array(values, dtype=object if isinstance(values[0], str) else np.int32)


def motion_over(spec: Spec, ramp: Ramp) -> tuple[tuple[ParameterAxis, ...], RampOfCells, np.ndarray]:
    """Return the axes on which a ramp depends, its motion at each of their points, and the drive's frequency there.

    The points are in the order of the axes, the last axis varying fastest.
    """
    named = {FREQUENCY, ramp.parameter, *ramp.names}
    axes = tuple(axis for axis in parameter_axes(spec) if axis.parameter in named)
    points = np.meshgrid(*(axis.values for axis in axes), indexing="ij")
    n = int(np.prod([len(axis.values) for axis in axes]))
    values = {axis.parameter: grid.ravel() for axis, grid in zip(axes, points, strict=True)}

    def value_of(name: str) -> np.ndarray:
        return values[name] if name in values else np.full(n, spec.values[name])

    frequency = values.get(FREQUENCY, np.full(n, np.nan if spec.frequency_hz is None else spec.frequency_hz))
    return axes, motion_of(ramp, value_of, frequency), frequency


def _coordinate(spec: Spec, ramp: Ramp) -> Coordinate:
    axes, motion, frequency = motion_over(spec, ramp)
    first, n_keep = spec.integration.n_transient + 1, spec.integration.n_keep
    periods = np.arange(first, first + n_keep)
    table = np.array([motion.at(i, periods / hz) for i, hz in enumerate(frequency)])
    shape = tuple(len(axis.values) for axis in axes)
    return Coordinate(
        at_section(ramp.parameter),
        (*(axis.dim for axis in axes), "period_index"),
        table.reshape(*shape, n_keep),
        _attrs(spec.model, ramp),
    )


def _attrs(model: Model, ramp: Ramp) -> dict[str, str]:
    parameter = model.parameter(ramp.parameter)
    return {"units": parameter.unit, "long_name": f"{parameter.meaning or parameter.name} at the section"}
