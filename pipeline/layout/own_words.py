"""Show datasets in the words of their specification: the drive's rate as omega or period, parameters by their names.

Analyses read and write plain names, which are those of `pipeline.products.column`: ``parameter`` is the value of the
swept parameter. Results have own names, such as ``F``, when they are stored and when users get them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models.model import Model
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_of, parameter_name
from pipeline.specification.tables import FREQUENCY, RATES, Rate, word_named

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.products.column import Column

RATE = "drive_rate"
"""Attribute with the word, if it is not ``frequency_hz``."""

OWN_NAMES = "own_names"
"""Attribute with the plain name of each variable that has an own name; empty for a rate beside the frequency."""

_FLIPPED = ("jump_rises", "rises_before", "rises_after", "rises")
"""Variables that tell whether the frequency rises: the period falls."""

_ERRORS = {
    "bracket": "value",
    "value_error": "value",
    "jump_value_error": "jump_value",
    "deviation": "value",
    "special_first_error": "special_first",
    "special_second_error": "special_second",
}
"""Variables with the width of an interval of frequencies, and those with the frequency."""


def rate_attribute(word: str) -> dict[str, str]:
    """Return the dataset attribute that names the word; `in_own_words` reads it."""
    return {} if word == FREQUENCY else {RATE: word}


def spelling_of(name: str, model: Model) -> tuple[str, Callable[[Any], Any]]:
    """Return the axis that a name in a user's file stands for, and the function that converts a value to its unit.

    The drive's rate may be ``frequency_hz``, ``omega`` or ``period``, unless the model has a parameter of that name; an
    angle may end in ``_deg``. Any other name stands for itself.
    """
    word = "" if name in model.parameter_names else word_named(name)
    if word:
        return FREQUENCY_DIM, RATES[word].hertz
    base = name.removesuffix("_deg")
    is_angle = base in model.parameter_names and model.parameter(base).unit.startswith("rad")
    if name not in model.parameter_names and is_angle:
        return base, np.radians
    return axis_name(name), np.asarray


def axis_in_own_words(name: str, word: str) -> tuple[str, Callable[[Any], Any]]:
    """Return the name of an axis or parameter in a specification, and the function that converts its values to those
    there: the drive's frequency has the name and unit of the rate's word.
    """
    if axis_name(name) != FREQUENCY_DIM:
        return name, np.asarray
    return (FREQUENCY, np.asarray) if word == FREQUENCY else (word, lambda hertz: _rounded(RATES[word].given(hertz)))


def width_in_own_words(name: str, word: str, value: float, width: float) -> float:
    """Return the width of a small interval around a value of an axis or parameter, in the unit of a specification with
    a word for the rate.
    """
    return float(width * RATES[word].slope(value)) if axis_name(name) == FREQUENCY_DIM else width


def place_in_words(name: str, word: str, *values: float, digits: int = 7, between: str = ", ") -> str:
    """Return ``NAME = VALUE`` of an axis or parameter, as in the tables of a specification with a word for the rate.

    Two values with ``between=" to "`` are a range, from the lower to the higher one.
    """
    own = parameter_name(dims_in_own_words([axis_name(name)], word)[0])
    found = axis_in_own_words(name, word)[1](np.array(values)).tolist()
    found = sorted(found) if between == " to " else found
    return f"{own} = {between.join(f'{x:.{digits}g}' for x in found)}"


def rate_of(ds: xr.Dataset) -> str:
    """Return the word for the drive's rate in the specification of a dataset's run."""
    return str(ds.attrs.get(RATE, FREQUENCY))


def dims_in_own_words(dims: Iterable[str], word: str) -> tuple[str, ...]:
    """Return the names of dims with that of the drive's frequency as the word of its rate."""
    return tuple(RATES[word].column if dim == FREQUENCY_DIM and word != FREQUENCY else dim for dim in dims)


def in_own_words(ds: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the drive's rate in the word of its specification, for tables and figures.

    All variables in Hz are converted and rounded to 15 digits, unless their names end in ``_hz``. The dim and the
    coordinate ``frequency`` are named like the word, and so are attributes whose value is this name. Others are
    returned unchanged; analyses write texts in the word (`place_in_words`).
    """
    ds = with_plain_names(ds)
    word = str(ds.attrs.get(RATE, FREQUENCY))
    if word == FREQUENCY:
        return ds
    rate, unit = RATES[word], _unit_of_rate(ds)
    found = {}
    for name, variable in ds.variables.items():
        if variable.attrs.get("units") == "Hz" and not str(name).endswith("_hz"):
            about = {**variable.attrs, "units": unit}
            if name == FREQUENCY_DIM:
                about["long_name"] = about["long_name"].replace("drive frequency", rate.meaning)
            of = _ERRORS.get(str(name))
            values = rate.given(variable.values) if of is None else variable.values * rate.slope(ds[of].values)
            found[name] = (variable.dims, _rounded(values), about)
        elif rate.inverse and name in _FLIPPED:
            found[name] = (variable.dims, 1 - variable.values, variable.attrs)
    if "elasticity" in ds:
        found |= _sensitivities(ds, rate)
    coordinates = {name: value for name, value in found.items() if name in ds.coords}
    shown = ds.assign_coords(coordinates).assign({n: v for n, v in found.items() if n not in ds.coords})
    named = {FREQUENCY: rate.column, FREQUENCY_DIM: rate.column, "Hz": unit}
    shown.attrs = {k: named.get(v, v) if isinstance(v, str) else v for k, v in ds.attrs.items()}
    if FREQUENCY_DIM not in ds.variables:
        return shown
    shown = shown.rename({FREQUENCY_DIM: rate.column})
    return shown.sortby(rate.column) if rate.inverse and rate.column in shown.dims else shown


def _sensitivities(ds: xr.Dataset, rate: Rate) -> dict[Any, Any]:
    """Return derivatives of, and by, the drive's frequency as those of, and by, its rate; a period falls with it."""
    sign = -1.0 if rate.inverse else 1.0
    by, size = np.ones((2, ds.sizes["bifurcation"], ds.sizes["parameter"]))
    values, deviation = ds["parameter_value"].values.copy(), ds["parameter_deviation"].values.copy()
    names, units = ([str(v) for v in ds[n].values] for n in ("parameter", "unit"))
    if ds.attrs["parameter"] == FREQUENCY_DIM:
        by *= sign
        size *= rate.slope(ds["value"].values)[:, None] if rate.inverse else rate.factor
    if FREQUENCY_DIM in names:
        i = names.index(FREQUENCY_DIM)
        slope = rate.slope(values[:, i])
        by[:, i] *= sign
        size[:, i] /= slope
        deviation[i] *= np.max(slope, initial=0.0)
        values[:, i] = rate.given(values[:, i])
        names[i], units[i] = rate.column, rate.unit
    factors = {"derivative": by * size, "derivative_error": size, "elasticity": by}
    found = {name: (ds[name].dims, ds[name].values * factor, ds[name].attrs) for name, factor in factors.items()}
    return found | {
        "parameter_value": (ds["parameter_value"].dims, values, ds["parameter_value"].attrs),
        "parameter_deviation": ("parameter", deviation, ds["parameter_deviation"].attrs),
        "parameter": ("parameter", names, ds["parameter"].attrs),
        "unit": ("parameter", units, ds["unit"].attrs),
    }


def hertz_of(ds: xr.Dataset) -> xr.DataArray | None:
    """Return the drive frequency of a dataset [Hz], also of one from `in_own_words`; None if there is none."""
    word = str(ds.attrs.get(RATE, FREQUENCY))
    rate = RATES[word]
    if FREQUENCY_DIM in ds.coords or rate.column not in ds.coords:
        return ds.coords.get(FREQUENCY_DIM)
    found: xr.DataArray = rate.hertz(ds.coords[rate.column])
    return found


def arguments_in_own_words(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a figure with datasets, arrays over their cells and ``at`` in the word of the first."""
    import xarray as xr

    first = next((value for value in given.values() if isinstance(value, xr.Dataset)), None)
    if first is None or RATE not in first.attrs:
        return {name: with_plain_names(value) for name, value in given.items() if isinstance(value, xr.Dataset)}
    rate, found = RATES[str(first.attrs[RATE])], dict[str, Any]()
    for name, value in given.items():
        if isinstance(value, xr.Dataset):
            found[name] = in_own_words(value)
        elif isinstance(value, xr.DataArray):
            found[name] = in_own_words(value.to_dataset(name="value").assign_attrs(first.attrs))["value"]
        elif name == "at" and value and FREQUENCY_DIM in value:
            own = float(_rounded(rate.given(value[FREQUENCY_DIM])))
            found[name] = {key: at for key, at in value.items() if key != FREQUENCY_DIM} | {rate.column: own}
    return found


def _unit_of_rate(ds: xr.Dataset) -> str:
    return "1" if all(state.unit == "1" for state in model_of(ds).states) else RATES[str(ds.attrs[RATE])].unit


def with_own_names(ds: xr.Dataset, columns: Iterable[Column] = ()) -> xr.Dataset:
    """Return a result with its swept parameters as coordinates under the names that the specification gives them.

    Parameters
    ----------
    ds
        Result of an analysis with plain names, or a cube.
    columns
        The columns of the analysis.

    Returns
    -------
    Dataset
        Beside coordinates of the drive's frequency there are those in the word of the specification, such as ``omega``.
        A parameter that has the name of another variable has the name ``parameter_NAME``.
    """
    columns = tuple(columns)
    # frequency is a column of branches along other parameters alone
    taken = {*(c.name for c in columns if c.name != FREQUENCY_DIM), *map(str, ds.dims), *map(str, ds.variables)}
    names, of = {}, {FREQUENCY_DIM: FREQUENCY_DIM}
    for column in columns:
        parameter = str(ds.attrs[column.unit.strip("{}")]) if column.own and column.name in ds.variables else ""
        if parameter:
            own = names[column.name] = _free(column.own.replace(column.unit, parameter), taken)
            of[own] = parameter
    found = ds.rename(names).set_coords([*names.values(), *{FREQUENCY_DIM} & set(ds.variables)])
    plain = {own: name for name, own in names.items()}
    word = str(ds.attrs.get(RATE, FREQUENCY))
    if word != FREQUENCY:
        for name in [name for name, parameter in of.items() if parameter == FREQUENCY_DIM and name in found.coords]:
            rate, hertz = RATES[word], found[name]
            own = _free(name.removesuffix(FREQUENCY_DIM) + rate.column, taken)
            about = rate.meaning if name == FREQUENCY_DIM else hertz.attrs["long_name"]
            attrs = {"units": _unit_of_rate(ds), "long_name": about}
            found = found.assign_coords({own: (hertz.dims, _rounded(rate.given(hertz.values)), attrs)})
            plain[own] = ""
    return found.assign_attrs({OWN_NAMES: json.dumps(plain)}) if plain else found


def _free(name: str, taken: Iterable[str]) -> str:
    return f"parameter_{name}" if name in taken else name


def with_plain_names(ds: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the names that analyses use, from one that `with_own_names` has returned."""
    if OWN_NAMES not in ds.attrs:
        return ds
    names = {own: plain for own, plain in json.loads(ds.attrs[OWN_NAMES]).items() if own in ds.variables}
    found = ds.drop_vars([own for own, plain in names.items() if not plain])
    named = {own: plain for own, plain in names.items() if plain}
    found = found.reset_coords(list(named)).rename(named)
    found.attrs = {key: value for key, value in ds.attrs.items() if key != OWN_NAMES}
    return found


def _rounded(values: Any) -> np.ndarray:
    """Round to 15 digits, so that a decimal number that was converted to Hz and back is what it was."""
    found = np.asarray(values, np.float64)
    return np.array([float(f"{value:.15g}") for value in found.ravel().tolist()]).reshape(found.shape)
