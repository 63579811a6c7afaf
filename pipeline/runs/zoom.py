"""Make a new specification from an old one: with narrower ranges and fixed parameters, or with more of everything."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models.imported import KEY
from pipeline.specification.files import check_new_file, find_spec, merged, nested, specification_toml, write_new
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.spec import Spec
from pipeline.specification.starts import (
    GridStarts,
    ListStarts,
    RandomStarts,
    degrees_key,
    put_start,
    state_keys,
    state_of_key,
)
from pipeline.specification.tables import FREQUENCY, RATES, Range
from pipeline.store.local import refuse_place

MARK = "(zoom)"
_ROUNDING = 1e-9
"""Relative amount by which a range may exceed the old one without a note, for conversion of degrees."""


@dataclass(frozen=True)
class Source:
    """A specification, with the run or the file that it comes from."""

    spec: Spec  # the specification
    origin: str  # phrase for the comment at the head of the new file
    smoke: Mapping[str, Any] = field(default_factory=dict)  # its ``[smoke]`` table; empty if it has none


@dataclass(frozen=True)
class Changes:
    """Changes to a specification: new ranges, fixed values and numbers of points, by state or parameter."""

    # lowest and highest value by key: a state (with ``_deg`` in degrees), ``frequency_hz`` or a parameter
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pins: Mapping[str, float] = field(default_factory=dict)  # one value by key, as in `ranges`
    num: int | None = None  # number of points of every new range
    # number of points by state, frequency or parameter; takes precedence over `num`
    nums: Mapping[str, int] = field(default_factory=dict)
    samples: int | None = None  # number of random initial conditions


def read_source(path: str | Path) -> Source:
    """Read the specification of a run directory, a TOML file or a shipped workflow.

    Raises
    ------
    SpecError, store.RefusedError
        If there is no specification, or it is not valid.
    """
    from pipeline.store.files import is_url, local_path
    from pipeline.store.runfile import read_run

    if is_url(path) or local_path(path).is_dir():
        info = read_run(path)
        name = info.files.local.resolve().name if info.files.local else info.name
        return Source(info.parsed_spec(), f"run {name}, digest {info.digest}", _smoke_in(info.spec_text))
    spec = Spec.read(path)
    return Source(spec, f"specification {find_spec(path).name}", spec.tables.get("smoke", {}))


def _smoke_in(text: str) -> Mapping[str, Any]:
    """Return the table ``[smoke]`` of a specification's text; empty for a text without one."""
    try:
        table = tomllib.loads(text).get("smoke")
    except tomllib.TOMLDecodeError:  # of a run that came from a table of Python
        table = None
    return table if isinstance(table, dict) else {}


def zoom(spec: Spec, changes: Changes) -> tuple[Spec, list[str]]:
    """Change the ranges and values of a specification; return also notes on ranges that exceed the old ones.

    A range keeps its number of points. A state or parameter with one value can get a range with a given
    number of points. New ranges are evenly spaced.

    Raises
    ------
    SpecError
        If nothing changes, a change does not fit, or the result is not a valid specification.
    """
    problems = _check(spec, changes)
    if problems:
        raise SpecError(problems)
    data = spec.as_dict()
    notes: list[str] = []
    for key, value in changes.pins.items():
        put_value(spec, data, key, value)
    for key, (low, high) in changes.ranges.items():
        old = _extent(spec, key)
        if old and not (old[0] - _slack(old) <= low and high <= old[1] + _slack(old)):
            notes.append(f"{key}: {low:g} to {high:g} reaches beyond the old {old[0]:g} to {old[1]:g}.")
        num = _points(spec, key, changes)
        as_interval = _state(spec, key) is not None and isinstance(spec.initial_conditions, RandomStarts)
        put_value(spec, data, key, [low, high] if as_interval else {"start": low, "stop": high, "num": num})
    if changes.samples is not None:
        data["initial_conditions"]["n"] = changes.samples
    data["title"] = spec.title if spec.title.endswith(MARK) else f"{spec.title} {MARK}".strip()
    return Spec.parse(data, KEPT), notes


def write_zoom(source: Source, changes: Changes, out: Path) -> list[str]:
    """Write a changed specification to a TOML file; return notes on ranges that exceed the old ones.

    Raises
    ------
    SpecError
        See `zoom`; also if `out` exists or cannot be written to. Nothing is written then.
    """
    check_new_file(out, [".toml"])
    refuse_place(out, "--out")
    spec, notes = zoom(source.spec, changes)
    smoke = source.smoke
    try:
        Spec.parse(merged(spec.as_dict(), nested(smoke)), KEPT)
    except SpecError:
        smoke = {}
        notes = [*notes, "[smoke]: is left out, since it does not fit the new ranges."]
    text = derived_toml("Zoom", source.origin, spec, smoke)
    if isinstance(spec.reference, Mapping) and (place := spec.reference.get(KEY)):
        notes = [*notes, f"model: running {out} imports the Python object {place}; read its code first."]
    write_new(out, text, "--out")
    return notes


# ---- changes -----------------------------------------------------------------------------------


def _state(spec: Spec, key: str) -> str | None:
    return state_of_key(key, spec.model)


def _check(spec: Spec, changes: Changes) -> list[str]:
    """Return messages on changes that do not fit the specification."""
    keys = [*changes.ranges, *changes.pins]
    if not keys:
        return ["zoom: nothing to change; give a range such as --axis NAME=LOW:HIGH, or --at frequency_hz=2.2."]
    names = [_state(spec, key) or key for key in keys]
    known = (*RATES, *state_keys(spec.model), *spec.model.parameter_names)
    unknown = [f"zoom: {unknown_name('axis', key, known)}" for key in keys if key not in known]
    if unknown:
        return unknown
    problems = [f"{n}: is changed twice; keep one." for n in dict.fromkeys(names) if names.count(n) > 1]
    for key, (low, high) in changes.ranges.items():
        if not low < high:
            problems.append(f"{key} = {low!r} {high!r}: the second number must be greater than the first.")
    starts = spec.initial_conditions
    if not isinstance(starts, GridStarts | RandomStarts):
        problems += [
            f"{key}: the initial conditions are a list, which has no ranges; zoom into parameters only."
            for key in keys
            if _state(spec, key)
        ]
        return problems
    ranged = {_state(spec, key) or key for key in changes.ranges}
    sampled = isinstance(starts, RandomStarts)
    if changes.samples is not None and not sampled:
        problems.append(f"samples = {changes.samples}: the initial conditions are not random; drop it.")
    if changes.num is not None and all(sampled and _state(spec, key) for key in changes.ranges):
        problems.append(f"num = {changes.num}: no new range has points; give one, or drop it.")
    for name in changes.nums:
        if name not in ranged:
            problems.append(f"points of {name}: no range is given for it; give one or drop it.")
        elif sampled and name in spec.model.state_names:
            problems.append(f"number of points of {name}: random samples have no grid; give --samples instead.")
    for key in changes.ranges:
        if not (sampled and _state(spec, key)) and _points(spec, key, changes) < 2:
            problems.append(f"{key}: a range has 2 points or more; say how many, such as --num 101.")
    return problems


def _points(spec: Spec, key: str, changes: Changes) -> int:
    asked = changes.nums.get(_state(spec, key) or key, changes.num)
    old = _old_range(spec, key)
    return asked if asked is not None else (len(old.array()) if old is not None else 0)


def _old(spec: Spec, key: str) -> tuple[Any, float]:
    """Return the old value or range of a state or parameter, and the factor to the unit of the new value."""
    state = _state(spec, key)
    if state is None:
        return spec.axes.get(FREQUENCY if is_rate(spec, key) else key), 1.0
    for name in (state, degrees_key(state)):
        starts = spec.initial_conditions
        value = None if isinstance(starts, ListStarts) else starts.of(name)
        if value is not None:
            same = name == key
            return value, 1.0 if same else (math.pi / 180 if name != state else 180 / math.pi)
    return None, 1.0


def _old_range(spec: Spec, key: str) -> Range | None:
    value, _ = _old(spec, key)
    return value if isinstance(value, Range) else None


def _extent(spec: Spec, key: str) -> tuple[float, float] | None:
    value, factor = _old(spec, key)
    if isinstance(value, Range):
        array = np.sort(RATES[key].given(value.array())) if is_rate(spec, key) else value.array()
        return float(array[0]) * factor, float(array[-1]) * factor
    return (value[0] * factor, value[1] * factor) if isinstance(value, tuple) else None


def _slack(extent: tuple[float, float]) -> float:
    return _ROUNDING * max(abs(extent[0]), abs(extent[1]))


def is_rate(spec: Spec, key: str) -> bool:
    """Return whether a key is a word for the drive's rate, and no parameter of the model."""
    return key in RATES and key not in spec.model.parameter_names


def put_value(spec: Spec, data: dict[str, Any], key: str, value: Any) -> None:
    """Set the value or range of a state or parameter in the plain data (dicts) of a specification."""
    state = _state(spec, key)
    if state is not None:
        assert not isinstance(spec.initial_conditions, ListStarts)
        put_start(data["initial_conditions"], key, value, spec.initial_conditions)
        return
    table = data["parameters"] if is_rate(spec, key) else data["parameters"]["overrides"]
    for name in RATES if is_rate(spec, key) else (key,):
        table.pop(name, None)
        if name != key or not isinstance(value, dict):
            data["axes"].pop(name, None)
    (data["axes"] if isinstance(value, dict) else table)[key] = value


# ---- TOML --------------------------------------------------------------------------------------


def derived_toml(how: str, origin: str, spec: Spec, smoke: Mapping[str, Any] | None = None) -> str:
    """Return a derived specification as TOML, below a comment that names its origin; with a ``[smoke]`` table if one is
    given.
    """
    printable = "".join(c if c.isprintable() else "?" for c in origin)
    return f"# {how}. Derived from {printable}.\n{to_toml(spec, smoke)}"


def to_toml(spec: Spec, smoke: Mapping[str, Any] | None = None) -> str:
    """Return a specification as TOML text, from which the same specification is read.

    A model as text comes last, with its own tables. A Python object is written as its import path.
    """
    data = {key: value for key, value in spec.as_dict().items() if value != ""}
    tables = {name: _filled(table) if name != "model" else table for name, table in data.items()}
    text = specification_toml({**tables, **({"smoke": smoke} if smoke else {})})
    read = tomllib.loads(text)
    read.pop("smoke", None)
    assert not isinstance(read["model"], dict) or read["model"] == spec.reference
    assert Spec.parse({**read, "model": spec.reference}, KEPT) == spec
    return text


def _filled(table: Any) -> Any:
    """Return a table without its empty tables; any other value unchanged."""
    return {key: value for key, value in table.items() if value != {}} if isinstance(table, dict) else table


@dataclass(frozen=True)
class Widening:
    """Changes that enlarge a specification: longer axes, more initial conditions, section points or products."""

    # new ranges, as the tables of ``[axes]``, by ``frequency_hz``, parameter, or state of a grid
    axes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    starts: int | None = None  # number of random initial states
    keep: int | None = None  # kept sections
    # options of additional products by name, as in the tables of ``[products]``
    products: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.axes or self.products) or self.starts is not None or self.keep is not None


def widened(spec: Spec, widening: Widening) -> Spec:
    """Return a specification enlarged by longer axes, more initial conditions, section points or products.

    Raises
    ------
    SpecError
        If a change does not fit, or the result is not a valid specification.
    """
    problems = _problems(spec, widening)
    if problems:
        raise SpecError(problems)
    data = spec.as_dict()
    for name, table in widening.axes.items():
        put_value(spec, data, name, dict(table))
    if widening.starts is not None:
        data["initial_conditions"]["n"] = widening.starts
    if widening.keep is not None:
        data["integration"]["n_keep"] = widening.keep
    data["products"] |= {name: dict(options) for name, options in widening.products.items()}
    return Spec.parse(data, KEPT)


def _problems(spec: Spec, widening: Widening) -> list[str]:
    known = (*RATES, *spec.model.parameter_names, *state_keys(spec.model))
    problems = [f"extend: {unknown_name('axis', name, known)}" for name in widening.axes if name not in known]
    states = [name for name in widening.axes if state_of_key(name, spec.model)]
    kind = spec.initial_conditions.kind
    if states and not isinstance(spec.initial_conditions, GridStarts):
        problems.append(
            f"axis {states[0]}: the initial conditions are a {kind}, and a range widens only a grid; "
            "give a SPEC with the new starts."
        )
    if widening.starts is not None and getattr(spec.initial_conditions, "sampling", None) == "latin-hypercube":
        problems.append(
            f"starts = {widening.starts}: more samples of a latin hypercube are all others; begin a new run, or take "
            'sampling = "sobol", whose first samples stay.'
        )
    if widening.starts is not None and not isinstance(spec.initial_conditions, RandomStarts):
        problems.append(
            f"starts = {widening.starts}: the initial conditions are a {kind}, not random samples; "
            + ("widen a state's range instead." if kind == "grid" else "give a SPEC with more rows.")
        )
    return problems
