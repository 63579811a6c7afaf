"""Translate the spellings that users may give of axes, parameters and states to the names in a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.layout.own_words import axis_in_own_words, rate_of, spelling_of
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, grid_dim, is_grid_dim, parameter_name
from pipeline.products.product import Options
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.tables import FREQUENCY, RATES, Rate, word_named

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.store.run import RunDirectory

Some = TypeVar("Some", bound=Options)

DEGREES = "_deg"


def named(run: RunDirectory, options: Options) -> Options:
    """Translate the names of axes, parameters and states in some options to those of the run.

    ``at`` accepts ``frequency``, ``frequency_hz``, ``omega`` or ``period`` of the drive, a parameter, and for a grid
    of initial states its axis ``x_0``, the state ``x`` or, for an angle, ``x_deg``. ``parameter`` and ``second``
    accept these names, too; bounds are then in their unit. ``start`` accepts the parameter in any of its words. An
    empty ``parameter`` stands for the swept one, an empty ``second`` for the other one of two,
    an empty ``state`` for the first state that varies between sections.

    Raises
    ------
    SpecError
        If names do not exist (the message lists the nearest ones), or if an empty option is ambiguous.
    """
    fields, problems = type(options).model_fields, []
    changes: dict[str, Any] = {}
    given: dict[str, Any] = {name: getattr(options, name) for name in fields}
    if given.get("at"):
        changes["at"] = {}
        for name, value in given["at"].items():
            try:
                axis, number = place(run.cube(), name, value, bool(given.get("degrees")))
                changes["at"][axis] = number
            except SpecError as error:
                problems += error.problems
    model = run.model
    if {"parameter", "second", "state"} & fields.keys():
        is_left_out = {role: given.get(role) == "" for role in _BOUNDS}
        if given.get("second") == "":
            given |= _plane(run, given["parameter"], given.get("at", {}))
        if given.get("parameter") == "":
            given["parameter"] = _swept(run, [given.get("second", ""), *given.get("at", {})])
        for role in {"parameter", "second"} & fields.keys():
            word = run.spec.rate if is_left_out[role] and given[role] == FREQUENCY else _rate(run, given[role])
            changes[role] = FREQUENCY if word else parameter_name(given[role])
            changes |= _bounds(role, given, RATES[word], partial(_hertz, word)) if word else {}
            problems += _unknown(
                "parameter", given[role], changes[role], (*model.parameter_names, FREQUENCY), run.spec.rate
            )
        if given.get("start") and "parameter" in fields:
            changes["start"] = _start(run, given["start"], changes["parameter"], problems)
        if "state" in fields:
            changes["state"] = given["state"] or model.section_states[0]
            problems += _unknown("state", given["state"], changes["state"], model.state_names)
    if problems:
        raise SpecError(problems)
    return options.model_copy(update=changes)


def _start(run: RunDirectory, start: Mapping[str, float], parameter: str, problems: list[str]) -> dict[str, float]:
    """Return a start with the name and unit of the parameter that may be among its states."""
    found: dict[str, float] = {}
    words: dict[str, str] = {}
    for given, value in start.items():
        name, convert = spelling_of(given, run.model)
        name = parameter_name(name)
        if given in run.model.state_names or name != parameter:
            name, convert = given, np.asarray
        if name in found:
            problems.append(f"--start: {words[name]} and {given} are both {parameter}; leave one of them out.")
        elif word_named(given) and name == FREQUENCY and not value > 0.0:
            problems.append(f"--start: {given} = {value:g} must be greater than 0.")
        else:
            found[name], words[name] = float(convert(value)), given
    return found


_BOUNDS = {"parameter": ("low", "high", "before", "after"), "second": ("second_low", "second_high")}
"""Options with values of a parameter, by the option that names it."""


def _rate(run: RunDirectory, name: str) -> str:
    """Return the word for the drive's rate that an option's name is; empty if it is none."""
    return "" if name in run.model.parameter_names else word_named(name)


def _hertz(word: str, value: float) -> float:
    """Return the frequency for a value of the drive's rate; raise SpecError for a period of 0."""
    if not value and RATES[word].inverse:
        raise SpecError(f"{word} = {value:g} must be greater than 0.")
    return float(RATES[word].hertz(value))


def _bounds(role: str, given: Mapping[str, Any], rate: Rate, convert: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the given bounds of a role, converted from or to a rate; those of a period in the opposite order."""
    found = {key: convert(given[key]) for key in _BOUNDS[role] if given.get(key) is not None}
    low, high = _BOUNDS[role][:2]
    if rate.inverse and (low in found or high in found):
        found[low], found[high] = found.get(high), found.get(low)
    return found


def options_in_own_words(options: Some, word: str) -> Some:
    """Return options from `named` with the drive's rate, where it occurs, in a word for it."""
    rate, fields, changes = RATES[word], type(options).model_fields, dict[str, Any]()
    if at := getattr(options, "at", None):
        changes["at"] = {
            word if name == FREQUENCY_DIM else name: rate.given(value) if name == FREQUENCY_DIM else value
            for name, value in at.items()
        }
    if FREQUENCY in (start := getattr(options, "start", {})):
        changes["start"] = {
            word if name == FREQUENCY else name: rate.given(value) if name == FREQUENCY else value
            for name, value in start.items()
        }
    for role in _BOUNDS.keys() & fields.keys():
        if getattr(options, role) == FREQUENCY:
            changes |= {role: word, **_bounds(role, dict(options), rate, rate.given)}
    return options.model_copy(update=changes)


def _swept(run: RunDirectory, others: Iterable[str]) -> str:
    """Return the one parameter that a run sweeps besides `others`, or the drive frequency if it sweeps none; raise
    SpecError if it sweeps several.
    """
    swept = _all_swept(run, others)
    if len(swept) > 1:
        raise SpecError(
            f"{run.name} sweeps {', '.join(swept)}; say which of them to follow: "
            + " or ".join(f"--parameter={name}" for name in swept)
            + "."
        )
    if swept or run.model.clock.hertz is None:
        return swept[0] if swept else FREQUENCY
    known = ", ".join(run.model.parameter_names)
    raise SpecError(
        f"{run.name} sweeps no parameter, and {run.model.name} has no drive frequency to follow; give "
        f"--parameter: {known}."
    )


def _all_swept(run: RunDirectory, others: Iterable[str]) -> list[str]:
    cube = run.cube()
    swept = [name for name in run.spec.axes if cube.sizes.get(axis_name(name), 1) > 1]
    return [name for name in swept if axis_name(name) not in map(axis_name, others)]


def _plane(run: RunDirectory, first: str, at: Iterable[str]) -> dict[str, str]:
    """Return the two parameters of a plane, the first as it is given or else the run's first axis; raise SpecError if
    the run does not sweep two.
    """
    swept = _all_swept(run, at)
    if len(swept) < 2 or "branch" in run.cube().dims:
        raise SpecError(
            "a plane needs a sweep over two parameters, each with several values: "
            f"{run.name} {'is a continuation of' if 'branch' in run.cube().dims else 'sweeps'} "
            f"{', '.join(swept) or 'none'}."
        )
    first = first or swept[0]
    return {"parameter": first, "second": next(name for name in swept if axis_name(name) != axis_name(first))}


def _unknown(what: str, given: str, name: str, known: Iterable[str], rate: str = FREQUENCY) -> list[str]:
    return [] if name in known else [unknown_name(what, given, [rate if n == FREQUENCY else n for n in known])]


def place(cube: xr.Dataset, name: str, value: float, degrees: bool = False) -> tuple[str, float]:
    """Return the axis that a name given by the user refers to, and the value in the unit of this axis.

    Parameters
    ----------
    cube
        Cube from `pipeline.open_run`.
    name
        Any spelling of the axis, see `named`.
    value
        Value on the axis, in degrees if the name ends in ``_deg``, or with `degrees` if the axis is an angle
        or its rate.

    Raises
    ------
    SpecError
        If there is no such axis.
    """
    dims = [str(dim) for dim in cube["status"].dims]
    plain = name.removesuffix(DEGREES)
    for axis in (axis_name(name), grid_dim(name), grid_dim(plain), plain):
        if axis in dims:
            turned = axis in cube.coords and str(cube[axis].attrs.get("units", "")).startswith("rad")
            in_degrees = is_grid_dim(axis) and turned and (degrees or name != plain)
            return axis, math.radians(value) if in_degrees else value
    if (word := word_named(name)) and FREQUENCY_DIM in dims:
        return FREQUENCY_DIM, _hertz(word, value)
    known = [d for d in dims if d in cube.coords] or dims
    raise SpecError(unknown_name("axis", name, [axis_in_own_words(d, rate_of(cube))[0] for d in known]))
