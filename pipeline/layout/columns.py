"""Write the declared meanings and units of an analysis' variables to its result."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from magpend_core.models.clock import DRIVEN
from pipeline.layout.vocabulary import parameter_name
from pipeline.products.column import OWN, POINTS, STATES, Column, over
from pipeline.specification.tables import FREQUENCY

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model

COMMON = (
    *over("state", state="component of the state"),
    *over("exponent", exponent="rank of the exponent, from the largest on"),
    *over("branch", branch="number of the branch", seed="index of the initial condition"),
    *over("branch", direction="direction of the walk"),
)
"""Columns of coordinates that many results have."""

_FILLED_IN = re.compile(r"\{(\w+)\}")


def described(ds: xr.Dataset, columns: Iterable[Column], model: Model | None = None) -> xr.Dataset:
    """Return a result whose variables have the meanings and units that their columns declare.

    Parameters
    ----------
    ds
        Result of an analysis. Attributes that its variables have already stay.
    columns
        Columns that the analysis declares. ``{period}``, ``{periods}`` and ``{time}`` in them are the words and the
        unit of the model's clock, ``{unit}`` is the attribute ``unit`` of the result; any other name in braces is an
        attribute that names a parameter or a state, and stands for its unit.
    model
        Model of the run; None for a recording, which has neither states nor parameters.

    Returns
    -------
    Dataset
        Texts have no unit.
    """
    clock = DRIVEN if model is None else model.clock
    words = {"period": clock.period, "periods": clock.periods, "time": clock.unit}
    words |= {"unit": str(ds.attrs.get("unit", "1"))}
    units = ", ".join(model.state_units) if model is not None else ""

    def filled(text: str) -> str:
        return _FILLED_IN.sub(lambda one: words.get(one[1]) or _unit_of(str(ds.attrs[one[1]]), model), text)

    found = ds.copy(deep=False)
    for column in (*columns, *COMMON):
        if column.name not in found.variables:
            continue
        variable = found.variables[column.name]
        attrs = {"long_name": filled(column.text)}
        if column.unit != OWN and variable.dtype.kind in "biufc":
            attrs["units"] = units if column.unit == STATES else filled(column.unit)
        variable.attrs = {**attrs, **variable.attrs}
    return found


def _unit_of(name: str, model: Model | None) -> str:
    """Return the unit of a parameter or state."""
    if parameter_name(name) == FREQUENCY:
        return "Hz"
    if not name:
        return "1"
    assert model is not None
    return model.state(name).unit if name in model.state_names else model.parameter(name).unit


def on_points(columns: Iterable[Column], values: Mapping[str, Any], dims: Sequence[str]) -> dict[str, Any]:
    """Return the variables with some values by name, over the dims of their columns.

    Parameters
    ----------
    columns
        Columns with the names of the values.
    values
        Arrays by name.
    dims
        The swept parameters, for which `POINTS` stands.
    """
    own = {column.name: column.dims.split() for column in columns}
    return {
        name: ([part for dim in own[name] for part in (dims if dim == POINTS else [dim])], value)
        for name, value in values.items()
    }
