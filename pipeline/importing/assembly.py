"""Make the table of a model as text from what a reader has found: functions, drive, noise and names."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from magpend_core.models.text.grammar import FUNCTIONS, Tree, name_problem
from magpend_core.models.text.reading import MAX_DEFINED, OF_RUNS, read_definition
from magpend_core.models.text.views import MAX_OTHERS
from pipeline.importing.drive import OMEGA, PHASE, TIME, drive_of
from pipeline.importing.expressions import (
    ZERO,
    RefusedError,
    arguments_problem,
    names_in,
    replaced,
    size,
    walk,
    written,
)
from pipeline.importing.functions import Functions
from pipeline.importing.noise import strengths_of
from pipeline.importing.source import Source

BUILT_IN = {"t", "pi", OMEGA, PHASE}


@dataclass
class Assembled:
    """A model as text, with what a specification needs to know of it.

    Attributes
    ----------
    model : dict
        The table ``[model]``.
    omega : float or None
        Angular frequency of the drive; None without a drive.
    strengths : dict
        Strength of the noise by state.
    names : dict
        Name in the model by name in the source.
    """

    source: Source
    model: dict[str, Any]
    omega: float | None
    strengths: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)

    @property
    def starts(self) -> list[float]:
        """Initial values in the order of the states."""
        return [self.source.starts.get(name, 0.0) for name in self.source.states]


def assembled(source: Source) -> Assembled:
    """Return the model of a source.

    Raises
    ------
    SpecError
        If a part of it cannot be carried over; the message lists all such parts with their lines.
    """
    _write_out_functions(source)
    _order_resets(source)
    _check_names(source)
    source.check()
    strengths = strengths_of(source)
    source.check()
    omega = drive_of(source)
    _leave_out(source, strengths)
    names = _final_names(source, omega is not None)
    found = Assembled(source, _table(source, names), omega, {}, names)
    found.strengths = {names[n]: written(tree, names) for n, tree in strengths.items()}
    for problem in read_definition(found.model)[1]:
        source.refuse(_line_of(source, problem, names), problem.removeprefix("model."))
    source.check()
    return found


def _each(source: Source) -> list[tuple[dict[str, Tree], str, int]]:
    """Return where each tree of the equations, parts, quantities and events stands: its dict, key and line."""
    places = [(t, n, source.line_of(n)) for t in (source.states, source.parts, source.quantities) for n in t]
    return places + [(reset.set, n, reset.line) for reset in source.resets for n in reset.set]


def _write_out_functions(source: Source) -> None:
    parts: dict[str, Tree] = {}
    functions = Functions(source, parts)
    for table, name, line in _each(source):
        try:
            table[name] = functions.written_out(table[name])
        except RefusedError as error:
            source.refuse(line, str(error))
    for reset in source.resets:
        try:
            reset.of = functions.written_out(reset.of)
        except RefusedError as error:
            source.refuse(reset.line, str(error))
    source.parts = {**parts, **source.parts}


def _order_resets(source: Source) -> None:
    """Let later values of an event take earlier ones, and make parameters that an event changes states."""
    for reset in source.resets:
        done: dict[str, Tree] = {}
        for name, tree in reset.set.items():
            if name in source.parameters:
                source.starts[name] = source.parameters.pop(name)
                source.states[name] = ZERO
                source.notes.append(f"the parameter {source.spelled(name)} is a state, since an event changes it.")
                for preset in source.presets.values():
                    preset.pop(name, None)
            if name not in source.states:
                source.refuse(reset.line, f"global: {name} is neither a variable nor a parameter")
            done[name] = replaced(tree, done)
        reset.set = done


def _check_names(source: Source) -> None:
    """Refuse unknown names and functions; tell of parts that use later ones."""
    known = {*source.states, *source.parameters, *source.parts, *source.noises, *BUILT_IN}
    trees = [(table[name], line) for table, name, line in _each(source)]
    for tree, line in [*trees, *((reset.of, reset.line) for reset in source.resets)]:
        for name in sorted(names_in(tree) - known):
            what = "is a function" if name in source.functions else "is not defined"
            source.refuse(line, f"{source.spelled(name)} {what}")
        for node in walk(tree):
            if node.kind == "call" and node.value not in FUNCTIONS:
                source.refuse(line, f"{node.value}: the text of a model has no such function")
            elif node.kind == "call" and (problem := arguments_problem(node)) is not None:
                source.refuse(line, problem)
    if source.program != "XPPAUT":
        return
    for name, tree in source.parts.items():
        later = [n for n in names_in(tree) & source.parts.keys() if source.line_of(n) > source.line_of(name)]
        if later:
            place = f"line {source.line_of(name)}: {source.spelled(name)} uses {source.spelled(later[0])}"
            source.notes.append(
                f"{place}, which comes later: XPPAUT takes its value of the step before, the model that of now."
            )


def _leave_out(source: Source, strengths: dict[str, Tree]) -> None:
    """Leave out parts and parameters that nothing uses, and quantities beyond the most that a model has."""
    for name in list(source.quantities)[MAX_OTHERS:]:
        source.notes.append(
            f"line {source.line_of(name)}: {name} is left out: a model has {MAX_OTHERS} quantities at most."
        )
        del source.quantities[name]
    pending = [*source.states.values(), *source.quantities.values(), *strengths.values()]
    pending += [tree for reset in source.resets for tree in (reset.of, *reset.set.values())]
    used: set[str] = set()
    while pending:
        new = names_in(pending.pop()) - used
        used |= new
        pending += [source.parts[name] for name in new & source.parts.keys()]
    unused = [n for n in (*source.parts, *source.parameters) if n not in used]
    for name in unused:
        source.parts.pop(name, None)
        source.parameters.pop(name, None)
        for preset in source.presets.values():
            preset.pop(name, None)
    if unused:
        source.notes.append(f"left out, since no equation uses them: {', '.join(map(source.spelled, unused))}.")
    source.presets = {name: values for name, values in source.presets.items() if values}
    _inline_smallest(source, strengths)


def _inline_smallest(source: Source, strengths: dict[str, Tree]) -> None:
    """Put the shortest parts where they are used if there are more than a model may have."""
    too_many = len(source.parts) + 1 - MAX_DEFINED
    for name in sorted(source.parts, key=lambda n: size(source.parts[n]))[: max(0, too_many)]:
        own = {name: source.parts.pop(name)}
        source.rewrite(partial(replaced, names=own))
        for key, tree in strengths.items():
            strengths[key] = replaced(tree, own)


def _final_names(source: Source, driven: bool) -> dict[str, str]:
    """Return the model's name for each name of the file, and note those that changed."""
    trees = [*(table[name] for table, name, _ in _each(source)), *(reset.of for reset in source.resets)]
    uses_time = any(TIME in names_in(tree) for tree in trees)
    # the word omega has its meaning in texts with t
    names = {OMEGA: "omega" if uses_time else "(2*pi*f)", PHASE: "phase"}
    taken, free = ({"omega"}, ()) if driven else (set(), ("f", "phase"))
    every = [*source.states, *source.parameters, *source.parts, *source.quantities, *source.presets]
    for name in every:
        wanted = source.spelled(name) if name not in source.presets else name
        new = wanted
        if name_problem(new, free) is not None:
            new = re.sub(r"[^A-Za-z0-9]+", "_", new).strip("_")
            new = (new if new[:1].isalpha() else f"x{new}")[:36]
        while name_problem(new, free) is not None or new in OF_RUNS or new in taken:
            new += "_"
        taken.add(new)
        names[name] = new
        if new != wanted:
            source.notes.append(f"{wanted} is called {new}.")
    return names


def _table(source: Source, names: dict[str, str]) -> dict[str, Any]:
    """Return the table of the model."""
    stem = re.sub(r"[^A-Za-z0-9_-]", "-", source.path.stem)[:50]
    table: dict[str, Any] = {"name": stem if stem[:1].isalpha() and stem[:1].isascii() else f"model-{stem}"}
    if source.is_map:
        table["kind"] = "map"
    if source.head:
        table["title"] = plain(source.head[0])[:200]
    table["source"] = f"{plain(source.path.name)}, a file of {source.program}"
    circle = {"unit": "rad", "on_circle": True}
    table["states"] = {names[n]: circle if n in source.circles else {} for n in source.states}
    table["parameters"] = {names[n]: value for n, value in source.parameters.items()}
    table["define"] = {names[n]: written(tree, names) for n, tree in source.parts.items()}
    table["equations"] = {names[n]: written(tree, names) for n, tree in source.states.items()}
    table["quantities"] = {names[n]: written(tree, names) for n, tree in source.quantities.items()}
    table["impacts"] = [
        {
            "of": written(reset.of, names),
            "direction": "up" if reset.direction > 0 else "down",
            "set": {names[n]: written(tree, names) for n, tree in reset.set.items()},
        }
        for reset in source.resets
    ]
    table["presets"] = {
        names[n]: {"source": f"set {n} of {plain(source.path.name)}"} | {names[p]: v for p, v in values.items()}
        for n, values in source.presets.items()
    }
    return {key: value for key, value in table.items() if value not in ({}, [], "")}


def plain(text: str) -> str:
    """Return a text without control characters."""
    return "".join(c if c.isprintable() else " " for c in text).strip()


def _line_of(source: Source, problem: str, names: dict[str, str]) -> int:
    """Return the line of the entry that a problem of the model's text names."""
    words = problem.split(":")[0].split(".")
    of = {new: old for old, new in names.items()}
    return source.line_of(of.get(words[-1], "")) if len(words) > 2 else 1
