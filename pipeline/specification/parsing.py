"""Validate the tables of a specification, each alone and then together."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unicodedata import category

from magpend_core.models import DEFAULT
from magpend_core.models.drift.ramps import Ramp
from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError
from magpend_core.models.presets import Preset, is_file
from magpend_core.models.text.reading import KINDS as MODEL_KINDS
from pipeline.products.product import Options
from pipeline.products.registry import ANALYSES, CELL_PRODUCTS, FIGURES
from pipeline.specification import drift as moving
from pipeline.specification.files import IDENTIFICATION, odd_data, with_text
from pipeline.specification.models import A_MODEL, add_model, stand_in
from pipeline.specification.noise import NoiseTable, disturbed, follows, noise_of
from pipeline.specification.parameters import parameter_problems, size_problems
from pipeline.specification.problems import SpecError, checked, shown, unknown_choice, unknown_key
from pipeline.specification.recorded_drive import HOW, DriveTable, recorded, run_problems
from pipeline.specification.section import SectionTable, section_of, seen_through
from pipeline.specification.starts import STARTS, STATES, Starts, refine_problems, starts_model, state_below
from pipeline.specification.tables import (
    AUTO,
    EXPLICIT,
    FREQUENCY,
    RANGES,
    RATES,
    STIFF,
    Continuation,
    Execution,
    Integration,
    ParametersTable,
    Range,
    Table,
)

KINDS = ("sweep", "continuation")


TABLES: dict[str, type[Table]] = {
    "parameters": ParametersTable,
    "continuation": Continuation,
    "integration": Integration,
    "execution": Execution,
    "drive": DriveTable,
    "section": SectionTable,
    "noise": NoiseTable,
}
_AS_GIVEN = re.compile(rf"\b(axes|parameters)\.{FREQUENCY}\b")
_OPTIONAL = ("drive", "section", "noise")
_NO_TABLES = ("kind", "title", "model", "measured")
KEYS = (
    "kind",
    "title",
    "model",
    "parameters",
    "axes",
    "initial_conditions",
    "continuation",
    "integration",
    "products",
    "execution",
    "drive",
    "section",
    "drift",
    "noise",
    "measured",  # orbits of a rig, which magpend measured branch reads: no part of a run
)


def valid_tables(data: Mapping[str, Any], folder: str | Path | None) -> dict[str, Any]:
    """Validate the tables of a specification; return its keys and tables by the names of `Spec`.

    Every table is validated on its own, so that errors in one do not hide errors in others. Then the valid
    tables are checked against each other. Files of presets, drives and models are read here, and their
    content replaces their names: a run does not need the files any more. A model that is a Python object is
    imported, unless `folder` is `KEPT`.

    Parameters
    ----------
    data
        Tables from TOML or from `Spec.as_dict`.
    folder
        Folder that paths of files are relative to; `KEPT` for data that a run keeps.

    Raises
    ------
    SpecError
        With all problems at once.
    """
    if odd := odd_data(data):
        raise SpecError(odd)
    if data.get("kind") == IDENTIFICATION:
        raise SpecError(f'kind = "{IDENTIFICATION}": is not a run; use magpend identify SPEC --out DIR.')
    if data.get("kind") in (None, *MODEL_KINDS) and "equations" in data:
        raise SpecError(A_MODEL)
    problems = [unknown_key(key, key, KEYS) for key in data if key not in KEYS]
    data, wrong = _only_tables(data, problems)
    data = _with_preset(data, folder, problems)
    data = data if folder is None else _with_texts(data, folder, problems)
    kind, title = _kind(data, problems), _title(data, problems)
    model = add_model(data.get("model", DEFAULT), folder, problems)
    data, word = _in_hertz(data, () if model is None else model.parameter_names, problems)
    tables = {name: None if name in wrong else _table(data, name, table, problems) for name, table in TABLES.items()}
    axes, drift = _axes(data, word, problems), moving.drift_tables(data, problems)
    walk = _walk(kind, data, tables["continuation"], axes, problems)
    data = {**data, "parameters": _with_frequency(data.get("parameters", {}))}
    if model is None:  # the remaining checks need the model's states and parameters
        model = stand_in(data.get("model"), folder, forced="section" not in data)
    if model is None:
        raise SpecError(problems)
    if not model.clock.is_continuous:
        problems += _map_problems(model, data)
        data = {key: table for key, table in data.items() if key not in _NOT_OF_MAPS}
        tables, drift = {**tables, **dict.fromkeys(_NOT_OF_MAPS)}, {}
    section = section_of(tables["section"], model, data, problems)
    ramps = moving.checked_ramps(drift, model, axes, problems)
    noise = noise_of(tables["noise"], model, data, problems)
    seen = disturbed(moving.moved(seen_through(model, section), ramps, problems), noise)
    starts = None if "initial_conditions" in wrong else _starts(data, model, problems)
    problems += refine_problems(kind, starts, tables["integration"], model)
    products = _products(data, model, problems)
    problems += run_problems(recorded(tables["drive"], problems), model, data, tables["integration"], starts)
    if drift and starts is not None and starts.origin:
        problems.append("initial_conditions.origin: moving parameters leave no fixed origin; drop origin or [drift].")
    problems += moving.run_problems(drift, data, tables["integration"], starts)
    problems += size_problems(axes, starts)
    problems += _method_problems(tables["integration"], products, "drive" in data)
    known = _valid_keys(data.get("parameters", {}))
    is_periodic = model.clock.has_drive and "drive" not in data and "section" not in data
    complete = is_periodic and not any(p.startswith(("axes", "parameters")) for p in problems)
    own = parameter_problems(known, seen, tuple(data.get("axes", {})), axes, complete)
    problems += [p for p in own if not follows(p, data, noise)]
    if ramps and not problems:
        problems += _drift_problems(ramps, known, seen, axes, imports=folder is not None)
    if problems:
        raise SpecError([_AS_GIVEN.sub(rf"\1.{word}", p) for p in problems])
    return {
        "kind": kind,
        "title": title,
        "reference": model.reference,
        **tables,
        "axes": axes,
        "initial_conditions": starts,
        "continuation": walk,
        "products": products,
        "section": section,
        "drift": drift,
        "noise": noise,
    }


def _only_tables(data: Mapping[str, Any], problems: list[str]) -> tuple[dict[str, Any], set[str]]:
    """Put an empty table in place of each value that must be a table and is none; return also the keys."""
    wrong = {key for key in KEYS if key in data and key not in _NO_TABLES and not isinstance(data[key], dict)}
    problems += [f"{key} = {shown(data[key])}: must be a table; write [{key}]." for key in data if key in wrong]
    return {**data, **{key: {} for key in wrong}}, wrong


def _with_preset(data: Mapping[str, Any], folder: str | Path | None, problems: list[str]) -> Mapping[str, Any]:
    """Replace the file name of a parameter preset by the file's content; drop the name if the file cannot be read."""
    table = data.get("parameters", {})
    name = table.get("preset")
    if not isinstance(name, str) or not is_file(name):
        return data
    rest = {key: value for key, value in table.items() if key != "preset"}
    if folder is None:
        problems.append(f"parameters.preset = {name!r}: a run keeps the content of a preset's file.")
        return {**data, "parameters": rest}
    try:
        content = asdict(Preset.read(Path(folder) / name))
    except ParameterError as error:
        problems += [f"parameters.preset: {p}" for p in error.problems]
        return {**data, "parameters": rest}
    return {**data, "parameters": {"preset": content, **rest}}


def _with_texts(data: Mapping[str, Any], folder: str | Path, problems: list[str]) -> Mapping[str, Any]:
    """Add the texts of the files that ``[drive]`` and the tables of ``[drift]`` name."""
    found = dict(data)
    if "drive" in data:
        found["drive"] = with_text(data["drive"], folder, "drive", problems, HOW)
    if "drift" in data:
        drift = data["drift"].items()
        found["drift"] = {name: with_text(table, folder, f"drift.{name}", problems) for name, table in drift}
    return found


def _products(data: Mapping[str, Any], model: Model, problems: list[str]) -> dict[str, Options]:
    """Validate ``[products]``, the results stored for each cell; fill in options that follow from the model."""
    found: dict[str, Options] = {}
    for name, table in data.get("products", {}).items():
        path = f"products.{name}"
        if name not in CELL_PRODUCTS:
            problems.append(_no_product(path, name))
            continue
        product = CELL_PRODUCTS[name]
        options = checked(product.options, table, path, problems)
        if options is None:
            continue
        try:
            found[name] = product.settle(options, model)
        except ValueError as error:
            problems.append(f"{path}.{error}")
    # a fixed order, independent of the file's: the cube's layout follows from it
    return {name: found[name] for name in CELL_PRODUCTS if name in found}


def _no_product(path: str, name: str) -> str:
    """Return the message for a name that is no product of cells; analyses and figures are made of a finished run."""
    for products, command in ((ANALYSES.listed, "analyse"), (FIGURES, "plot")):
        if name in products:
            return f"{path}: is made of a finished run; drop it here, and use magpend {command} {name}."
    return unknown_key(path, name, CELL_PRODUCTS)


def _valid_keys(table: dict[str, Any]) -> ParametersTable:
    """Return the table ``[parameters]`` with its valid keys alone."""
    valid = {k: value for k, value in table.items() if checked(ParametersTable, {k: value}, "", []) is not None}
    return ParametersTable.model_validate(valid)


def _kind(data: Mapping[str, Any], problems: list[str]) -> str:
    kind = data.get("kind")
    if kind is None:
        problems.append('kind: missing; add kind = "sweep" or kind = "continuation".')
    elif kind not in KINDS:
        problems.append(unknown_choice("kind", kind, KINDS))
    return str(kind)


def _title(data: Mapping[str, Any], problems: list[str]) -> str:
    title = data.get("title", "")
    if not isinstance(title, str):
        problems.append(f"title = {shown(title)}: must be a text in quotes.")
    elif not all(c.isprintable() or category(c) == "Zs" for c in title):
        problems.append(f"title = {shown(title)}: has control characters or line breaks; remove them.")
    return str(title)


def _table(data: Mapping[str, Any], name: str, model: type[Table], problems: list[str]) -> Any:
    is_left_out = name not in data and name in _OPTIONAL
    return None if is_left_out else checked(model, data.get(name, {}), name, problems)


def _in_hertz(data: Mapping[str, Any], own: tuple[str, ...], problems: list[str]) -> tuple[Mapping[str, Any], str]:
    """Name an axis of the drive's rate, whatever its word, ``frequency_hz``; return also the word of the rate.

    A parameter of the model that has one of the words for its name stays what it is.
    """
    axes, parameters = dict(data.get("axes", {})), data.get("parameters", {})
    swept = [word for word in RATES if word in axes and word not in own]
    given = [*(f"axes.{word}" for word in swept), *(f"parameters.{word}" for word in RATES if word in parameters)]
    if len(given) > 1:
        problems.append(f"{' and '.join(given)}: all give the rate of the drive; keep one.")
        return {**data, "axes": {name: axis for name, axis in axes.items() if name not in swept}}, FREQUENCY
    word = given[0].partition(".")[2] if given else FREQUENCY
    found = {FREQUENCY if name in swept else name: value for name, value in axes.items()}
    walk = data.get("continuation", {})
    if data.get("kind") == "continuation" and walk.get("path", FREQUENCY) in (FREQUENCY, *swept):
        data = {**data, "continuation": {**walk, "path": FREQUENCY}}
        if word == "period":
            problems.append("continuation.path = 'period': branches follow frequency_hz or omega; sweep one of these.")
    return {**data, "axes": found}, word


def _with_frequency(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table ``[parameters]`` with the drive's rate, whatever its word, as ``frequency_hz``."""
    words = [word for word in RATES if word in parameters]
    found = {key: value for key, value in parameters.items() if key not in words}
    for word in words:
        value = parameters[word]
        is_rate = isinstance(value, float | int) and not isinstance(value, bool) and value > 0
        found[FREQUENCY] = RATES[word].hertz(value) if is_rate else value
    return found


def _axes(data: Mapping[str, Any], word: str, problems: list[str]) -> dict[str, Range]:
    axes = {
        name: checked(RANGES[word] if name == FREQUENCY else Range, value, f"axes.{name}", problems)
        for name, value in data.get("axes", {}).items()
    }
    return {name: axis for name, axis in axes.items() if axis is not None}


def _starts(data: Mapping[str, Any], model: Model, problems: list[str]) -> Starts | None:
    if "initial_conditions" not in data:
        problems.append('initial_conditions: missing; add this table with kind = "grid", "list" or "random".')
        return None
    table = data["initial_conditions"]
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in STARTS:
        choices = list(STARTS)
        problems.append(
            'initial_conditions.kind: missing; set it to "grid", "list" or "random".'
            if kind is None
            else unknown_choice("initial_conditions.kind", kind, choices)
        )
        return None
    if kind != "grid" and "refine" in table:
        problems.append(
            f'initial_conditions.refine: only a grid can be refined; drop the key, or set kind = "grid" '
            f"instead of {kind!r}."
        )
        table = {key: value for key, value in table.items() if key != "refine"}
    own: list[str] = []
    starts: Starts | None = checked(starts_model(kind, model), table, "initial_conditions", own)
    hidden = [name for name in model.state_names if kind != "list" and name in (*STARTS[kind].model_fields, STATES)]
    for problem in own:
        words = problem.replace(":", " ").split(maxsplit=1)[0]
        key = words.removeprefix("initial_conditions.")
        problems.append(f"{problem} To start the state, give {state_below(key)}." if key in hidden else problem)
    return starts


def _walk(
    kind: str, data: Mapping[str, Any], walk: Continuation | None, axes: dict[str, Range], problems: list[str]
) -> Continuation | None:
    if kind != "continuation":
        if kind == "sweep" and "continuation" in data:
            problems.append('continuation: a sweep has no such table; set kind = "continuation" or drop the table.')
        return None
    declared = tuple(data.get("axes", {}))
    if walk is not None and walk.path not in declared:
        known = ", ".join(f"axes.{name}" for name in declared) or "none yet"
        problems.append(
            f"continuation.path = {walk.path!r}: must be an axis ({known}); add it to [axes] or set the path."
        )
    return walk


def _drift_problems(
    ramps: tuple[Ramp, ...], table: ParametersTable, model: Model, axes: dict[str, Range], *, imports: bool
) -> list[str]:
    """Return the problems of moving parameters: their values, and what the model's equations do not allow."""
    values = model.load(table.chosen, **table.overrides)
    problems = moving.motion_problems(ramps, values, axes, table.hertz)
    if problems or not imports:
        return problems
    return moving.system_problems(model, ramps, values, axes, table.hertz)


_NOT_OF_MAPS = {
    "section": "whose sections are its iterations",
    "drive": "which has no drive",
    "drift": "and parameters move in time",
    "noise": "and noise acts on the rates of a flow",
}
"""Tables of a specification that a map cannot have, with the reason."""


def _map_problems(model: Model, data: Mapping[str, Any]) -> list[str]:
    """Return the problems of tables and keys that a map, which has no time and no steps, cannot have."""
    what = f"{model.name} is a map"
    problems = [f"{name}: {what}, {why}; drop the table." for name, why in _NOT_OF_MAPS.items() if name in data]
    for table in ("parameters", "axes"):
        if FREQUENCY in data.get(table, {}):
            problems.append(f"{table}.{FREQUENCY}: {what}, which has no drive; drop the key.")
    given = data.get("integration", {})
    # a stored specification has all keys, with their defaults
    fields = Integration.model_fields
    steps = [k for k in ("rtol", "atol", "max_steps_per_period") if given.get(k, d := fields[k].default) != d]
    steps += ["method"] * (given.get("method", AUTO) not in (AUTO, EXPLICIT))
    problems += [f"integration.{key}: {what}, whose iterations have no steps; drop the key." for key in steps]
    between = [name for name, product in CELL_PRODUCTS.items() if product.follows_motion]
    for name in (n for n in between if n in data.get("products", {})):
        problems.append(f"products.{name}: {what}, without motion between its iterations; drop the product.")
    return problems


def _method_problems(integration: Integration | None, products: Mapping[str, Options], is_recorded: bool) -> list[str]:
    """Return the problems of `integration.method`: products that interpolate within steps need the method of order
    5.
    """
    if integration is None or integration.method in (AUTO, EXPLICIT, STIFF):
        return []
    inside = [f"products.{n} looks" for n, o in products.items() if CELL_PRODUCTS[n].watches(o)]
    inside += ["a recorded drive has edges"] * is_recorded
    key = f'integration.method = "{integration.method}"'
    return [f'{key}: {what} within steps; drop one of the two, or set method = "dopri5".' for what in inside]
