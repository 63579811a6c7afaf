"""Define the names and codes shared by runs, analyses, tables and figures; look up the model of a dataset.

This module imports no kernel, so that figures need no compiler.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from magpend_core.crossing import Crossing
from magpend_core.disturbance import Disturbance
from magpend_core.models import DEFAULT, load_model
from magpend_core.models.drift.model import DriftingModel, drifting
from magpend_core.models.drift.ramps import ramps_as_data, ramps_from_data
from magpend_core.models.model import Model, Parameters, by_method
from magpend_core.models.noisy import noisy
from magpend_core.models.sectioned import sectioned
from magpend_core.sizes import REALIZATION
from magpend_core.status import Status
from pipeline.specification.tables import FREQUENCY, STIFF

if TYPE_CHECKING:
    import xarray as xr

FREQUENCY_DIM = "frequency"
"""Dim of the drive frequency in a cube [Hz]."""

BRANCH, START = "branch", "initial_condition"
"""Dims of a continuation's branches, and of starts that are not a grid."""

KINDS = ("absent", "equilibrium", "periodic_orbit", "torus", "chaotic_set", "bounded_set")
ABSENT, EQUILIBRIUM, PERIODIC_ORBIT, TORUS, CHAOTIC_SET, BOUNDED_SET = range(len(KINDS))
"""Values of `kind`, see `pipeline.analysis.attractors`."""

APERIODIC = (TORUS, CHAOTIC_SET, BOUNDED_SET)
"""Kinds of sets whose orbits do not close."""

STABILITIES = ("absent", "attracts", "unstable", "transient", "not_settled", "neutral")
_, ATTRACTS, UNSTABLE, TRANSIENT, NOT_SETTLED, NEUTRAL = range(len(STABILITIES))
"""Values of `stability`; see `pipeline.analysis.attractors.finding.stability`."""

EVIDENCE = (
    *("none", "eigenvalues", "multipliers", "approach", "stayed", "left", "volume", "one_side"),
    *("step_limit", "no_return", "no_convergence"),
)
"""Values of `evidence`: the grounds for the stability of a set, or how Newton's method ended where it showed none."""

DECISIONS = ("undecided", "closed", "certain", "approaching", "same_set", "extended", "at_rest", "diverges", "grows")
UNDECIDED, CLOSED, CERTAIN, APPROACHING, SAME_SET, EXTENDED, AT_REST, DIVERGES, GROWS = range(len(DECISIONS))
"""How a cell was decided: values of `decision`."""

(PENDING, PERIODIC, BOUNDED, DIVERGED, STEP_LIMIT, STEP_UNDERFLOW, UNREACHED, INFERRED, NO_RETURN, CHATTER) = Status

FAILED = (STEP_LIMIT, STEP_UNDERFLOW, UNREACHED, NO_RETURN, CHATTER)
"""Status of cells that could not be integrated to the end."""

ORIGIN = "counted_from"
"""Attribute of a coordinate of starts: the expression of the parameters from which they are counted."""

_GRID_SUFFIX = "_0"


def grid_dim(state: str) -> str:
    """Return the name of the dim of the result cube that runs over the initial values of a state."""
    return f"{state}{_GRID_SUFFIX}"


def is_grid_dim(dim: str) -> bool:
    """Return whether a dim of the result cube belongs to a grid of initial states."""
    return dim.endswith(_GRID_SUFFIX)


def is_start_dim(dim: str) -> bool:
    """Return whether a dim of the result cube runs over initial conditions or branches, not over a parameter."""
    return dim in (BRANCH, START, REALIZATION) or is_grid_dim(dim)


def has_origins(ds: xr.Dataset) -> bool:
    """Return whether the starts of cells are counted from expressions of the parameters."""
    return any(ORIGIN in coordinate.attrs for coordinate in ds.coords.values())


def start_dims(dims: Iterable[object]) -> tuple[str, ...]:
    """Return those dims of the result cube that run over initial conditions or branches, not over parameters."""
    return tuple(str(d) for d in dims if is_start_dim(str(d)))


def split_dims(cells: xr.DataArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split the dims of an array over cells into parameter dims and initial-condition or branch dims."""
    dims = [str(dim) for dim in cells.dims]
    return tuple(d for d in dims if not is_start_dim(d)), start_dims(dims)


def axis_name(parameter: str) -> str:
    """Return the name of a parameter's dim in the result cube. The drive frequency may be given as ``frequency`` or
    ``frequency_hz``.
    """
    return FREQUENCY_DIM if parameter in (FREQUENCY, FREQUENCY_DIM) else parameter


def parameter_name(axis: str) -> str:
    """Return the name that the specification uses for the parameter of an axis of the result cube."""
    return FREQUENCY if axis in (FREQUENCY, FREQUENCY_DIM) else axis


def axes_of(model: Model) -> tuple[str, ...]:
    """Return the axes along which orbits of a model can change: its parameters, and the frequency of its drive."""
    return (*model.parameter_names, *((FREQUENCY_DIM,) if model.clock.has_drive else ()))


def parameter_units(parameter: str, model: Model | None) -> str:
    """Return the unit of a parameter or of the drive frequency; an empty text if there is no model."""
    if axis_name(parameter) == FREQUENCY_DIM:
        return "Hz"
    return model.parameter(parameter).unit if model is not None else ""


def model_attribute(model: Model) -> str:
    """Return the attribute ``model`` of a dataset: a model's name, or its text as JSON."""
    reference = model.reference
    return reference if isinstance(reference, str) else json.dumps(reference, ensure_ascii=False)


def model_of(ds: xr.Dataset) -> Model:
    """Return the model of a result cube, or of a dataset derived from it, from the attribute ``model``.

    If the attributes ``section_...`` name a section by crossing, the model has that section. With the attribute
    ``drift`` its parameters move. If the attribute ``method`` is that for stiff systems, it is integrated by it.

    Raises
    ------
    ModelError
        If the attribute names no model. A Python object is not imported: its description suffices to draw.
    """
    model = load_model(str(ds.attrs.get("model", DEFAULT)))
    if ds.attrs.get("method") == STIFF:
        model = by_method(model, STIFF)
    if _NOISE in ds.attrs:
        strengths, interpretation = json.loads(ds.attrs[_NOISE])
        return noisy(model, Disturbance(tuple((name, value) for name, value in strengths), interpretation))
    of = ds.attrs.get(f"{_SECTION}of")
    if DRIFT in ds.attrs:
        return drifting(model, ramps_from_data(json.loads(str(ds.attrs[DRIFT]))))
    if of is None:
        return model
    value, longest = (float(ds.attrs[f"{_SECTION}{key}"]) for key in ("value", "longest"))
    return sectioned(model, Crossing(str(of), value, ds.attrs[f"{_SECTION}direction"], longest))


OVERRIDES = "overrides"
"""Attribute with a line ``name = value`` for each parameter that a specification sets itself."""

DRIFT = "drift"
"""Attribute that describes the motion of a model's parameters, as JSON."""

_NOISE = "noise"
"""Attribute that describes the noise on the model's equations, as JSON."""


def noise_attributes(disturbance: Disturbance | None) -> dict[str, Any]:
    """Return the dataset attribute that describes noise; `model_of` reads it."""
    if disturbance is None:
        return {}
    return {_NOISE: json.dumps([disturbance.strengths, disturbance.interpretation])}


_SECTION = "section_"
"""Prefix of the attributes that describe a section by crossing."""


def section_attributes(crossing: Crossing | None) -> dict[str, Any]:
    """Return the dataset attributes that describe a Poincare section; `model_of` reads them."""
    if crossing is None:
        return {}
    return {f"{_SECTION}{key}": value for key, value in asdict(crossing).items()}


def drift_attributes(model: Model) -> dict[str, str]:
    """Return the dataset attribute that describes how a model's parameters move; `model_of` reads it."""
    return {DRIFT: json.dumps(ramps_as_data(model.ramps))} if isinstance(model, DriftingModel) else {}


def told_by(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Select the dataset attributes that describe the integration: model, parameters, section."""
    return {
        str(key): value
        for key, value in attrs.items()
        if key in ("model", "parameters", OVERRIDES, DRIFT, _NOISE)
        or str(key).startswith(_SECTION)
        or (key == "method" and value == STIFF)
    }


def frequency_of(model: Model | None, values: Mapping[str, Any]) -> float:
    """Return the drive frequency at a parameter point [Hz]; NaN if it is unknown.

    For a map, and for a flow with sections at crossings, it is `Model.clock.hertz`, as in the engine.

    Parameters
    ----------
    model
        Model that is integrated.
    values
        Coordinates of the point by name.
    """
    if model is not None and model.clock.hertz is not None:
        return model.clock.hertz
    return float(values.get(FREQUENCY_DIM, math.nan))


def overrides_attribute(overrides: Mapping[str, float]) -> dict[str, str]:
    """Return the dataset attribute that lists a specification's overrides; `overrides_of` reads it."""
    return {OVERRIDES: "\n".join(f"{name} = {value!r}" for name, value in overrides.items())} if overrides else {}


def overrides_of(ds: xr.Dataset) -> dict[str, float]:
    """Return the values that a run's specification sets in place of its preset's, by parameter."""
    return _values(ds, OVERRIDES)


def _values(ds: xr.Dataset, attribute: str) -> dict[str, float]:
    lines = str(ds.attrs.get(attribute, "")).splitlines()
    return {name.strip(): float(value) for name, _, value in (line.partition("=") for line in lines)}


def parameters_of(ds: xr.Dataset) -> Parameters:
    """Read a run's parameters from the dataset attribute ``parameters``, which has a line ``name = value`` for each
    parameter.

    Raises
    ------
    ValueError
        If the attribute is missing, or its names are not the model's parameters.
    """
    if "parameters" not in ds.attrs:
        raise ValueError("The dataset has no attribute 'parameters'; it tells what was integrated.")
    return Parameters(model_of(ds), _values(ds, "parameters"))


def letter(attractor: int) -> str:
    """Return the letter of an attractor id: A to Z, then AA and so on; a dash for a negative id."""
    if attractor < 0:
        return "-"
    text = ""
    attractor += 1
    while attractor:
        attractor, digit = divmod(attractor - 1, 26)
        text = chr(ord("A") + digit) + text
    return text
