"""Names and codes that runs, analyses, tables and figures share, and the model of a dataset.

Imports no kernel, so that figures need none.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from magpend_core.models import DEFAULT, load_model
from magpend_core.models.model import Model
from magpend_core.models.parameters import Parameters
from magpend_core.status import Status
from pipeline.spec.tables import FREQUENCY

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.engine.system import System

FREQUENCY_DIM = "frequency"
"""Its dim in a cube [Hz]."""

BRANCH, START = "branch", "initial_condition"
"""Dims of a continuation's walks, and of starts that are no grid."""

ABSENT, CLOSED_ORBIT, BOUNDED_SET = range(3)
"""Values of `kind`, see `pipeline.analysis.attractors`."""

PENDING, PERIODIC, BOUNDED, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED, INFERRED = Status

FAILED = (STEP_LIMIT, STEP_UNDERFLOW, UNREACHED)
"""What became of cells that could not be integrated to the end."""

_GRID_SUFFIX = "_0"


def grid_dim(state: str) -> str:
    """Dim of a grid of initial values of a state."""
    return f"{state}{_GRID_SUFFIX}"


def is_grid_dim(dim: str) -> bool:
    """Whether a cube's dim is one of a grid of initial states."""
    return dim.endswith(_GRID_SUFFIX)


def is_start_dim(dim: str) -> bool:
    """Whether a cube's dim tells the cells of one parameter point apart."""
    return dim in (BRANCH, START) or is_grid_dim(dim)


def start_dims(dims: Iterable[object]) -> tuple[str, ...]:
    """Return those of a cube's dims that tell the cells of one parameter point apart."""
    return tuple(str(d) for d in dims if is_start_dim(str(d)))


def split_dims(cells: xr.DataArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the parameter dims and the start dims of an array over the cells."""
    dims = [str(dim) for dim in cells.dims]
    return tuple(d for d in dims if not is_start_dim(d)), start_dims(dims)


def axis_name(parameter: str) -> str:
    """Name of a parameter's axis in a cube; both names of the frequency are understood."""
    return FREQUENCY_DIM if parameter in (FREQUENCY, FREQUENCY_DIM) else parameter


def parameter_name(axis: str) -> str:
    """Name in a specification of what an axis of a cube sweeps."""
    return FREQUENCY if axis in (FREQUENCY, FREQUENCY_DIM) else axis


def model_of(ds: xr.Dataset) -> Model:
    """Return the model of a cube, or of what was derived from it, by its attribute ``model``."""
    return load_model(str(ds.attrs.get("model", DEFAULT)))


def parameters_of(ds: xr.Dataset) -> Parameters:
    """Return the parameters of a run, by its attribute ``parameters``: a line ``name = value`` for each.

    Raises
    ------
    ValueError
        If they are not there, or not those of the model.
    """
    lines = str(ds.attrs.get("parameters", "")).splitlines()
    values = {name.strip(): float(value) for name, _, value in (line.partition("=") for line in lines)}
    if not values:
        raise ValueError("The dataset has no attribute 'parameters'; it tells what was integrated.")
    return Parameters(model_of(ds), values)


def system_of(ds: xr.Dataset) -> System:
    """Return what the engine integrated; imports the compiler."""
    return model_of(ds).system
