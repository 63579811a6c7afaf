"""Hold the validated definition of a model given as text."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from magpend_core.models.clock import DRIVEN, MAP, STROBED, Clock
from magpend_core.models.model import Mirror, Preset, Quantity, State
from magpend_core.models.parameters import Parameter
from magpend_core.models.text.grammar import TIMED, Tree, names
from magpend_core.models.text.keys import Line, calls
from magpend_core.models.text.writing import written

OMEGA = "omega"
"""The drive's angular frequency, in a text that uses time and gives the name no other meaning."""


@dataclass(frozen=True)
class Impact:
    """An impact: the states jump where an expression passes zero in a given direction.

    Attributes
    ----------
    direction : int
        +1 for rising through zero, -1 for falling.
    set : dict
        New value by name of the state; the others stay.
    stick : bool
        Whether the state rests on the surface after infinitely many impacts in a finite time.
    """

    of: Tree
    direction: int
    set: Mapping[str, Tree]
    stick: bool = False


@dataclass(frozen=True)
class DrawingText:
    """Drawing of a model given as text, with the positions of its points as expressions."""

    points: Mapping[str, tuple[Tree, Tree]]
    fixed: Mapping[str, tuple[Tree, Tree]]
    lines: tuple[tuple[str, ...], ...]
    trace: str
    unit: str


@dataclass(frozen=True)
class ClassifierText:
    """Classes of motion. A motion is in a class if all its stored section points meet the class's condition on the
    states.
    """

    meaning: str
    words: Mapping[str, Tree]


@dataclass(frozen=True)
class Definition:
    """Validated definition of a model given as text: all names are known and all expressions are parsed.

    Attributes
    ----------
    define, equations, quantities : mapping of str to Tree
        Equations in the order of the states.
    described : tuple of Quantity
        In the order of `quantities`.
    impacts, drawing, mirror, presets, classifier
        The first of the presets has the values of the table of parameters.
    table : dict
        The text as plain data.
    lines : mapping of str to Line
        The line of the text of each definition, function and state.
    is_map : bool
        Whether the equations give the next state, and not the rate of the state.
    surface, surface_unit
        Expression whose level is the Poincare section, if that is of no state, and its unit; see `System`.
    """

    name: str
    title: str
    source: str
    section: str
    states: tuple[State, ...]
    parameters: tuple[Parameter, ...]
    define: Mapping[str, Tree]
    equations: Mapping[str, Tree]
    quantities: Mapping[str, Tree]
    described: tuple[Quantity, ...]
    impacts: tuple[Impact, ...]
    drawing: DrawingText | None
    mirror: Mirror | None
    presets: tuple[Preset, ...]
    classifier: ClassifierText | None
    table: Mapping[str, Any] = field(repr=False)
    lines: Mapping[str, Line] = field(repr=False)
    is_map: bool = False
    surface: Tree | None = None
    surface_unit: float = 1.0

    def used(self, trees: Iterable[Tree]) -> tuple[str, ...]:
        """Return all names that expressions use, directly or through definitions, each after the names that
        it needs.
        """
        found: dict[str, None] = {}
        pending = [(name, False) for tree in trees for name, _ in names(tree)][::-1]
        while pending:
            name, complete = pending.pop()
            if name in found:
                continue
            if complete or name not in self.define:
                found[name] = None
            else:
                pending.append((name, True))
                pending += [(inner, False) for inner, _ in names(self.define[name])][::-1]
        return tuple(found)

    def lines_of(self, trees: Iterable[Tree]) -> list[Line]:
        """Return the lines of the definitions and functions that expressions use, each after those that it needs."""
        found: dict[str, Line] = {}
        functions = {name for name, line in self.lines.items() if line.key.arguments is not None}

        def add(line: Line) -> None:
            for name in calls(line.tree, functions):
                add(self.lines[name])
            found[line.key.text] = line

        for name in self.used(trees):
            if name in self.define:
                add(self.lines[name])
        for name in self.equations:
            for called in calls(self.lines[name].tree, functions):
                add(self.lines[called])
        return list(found.values())

    @property
    def dynamics(self) -> list[Tree]:
        """Expressions of all equations and impacts."""
        of_impacts = [tree for i in self.impacts for tree in (i.of, *i.set.values())]
        return [*self.equations.values(), *of_impacts]

    @property
    def clock(self) -> Clock:
        """How the model counts time; a flow whose equations and impacts depend on neither time nor frequency is seen at
        even times.
        """
        return MAP if self.is_map else DRIVEN if self.has_drive else STROBED

    @property
    def timed(self) -> frozenset[str]:
        """The names by which time and the drive's frequency enter expressions; a text without them may use such a name
        for something else.
        """
        return frozenset(TIMED) - {s.name for s in self.states} - {p.name for p in self.parameters} - self.define.keys()

    @property
    def has_drive(self) -> bool:
        """Whether an expression of the equations or the impacts depends on time or on the drive's frequency."""
        return not self.timed.isdisjoint(self.used(self.dynamics))

    def remarks(self) -> list[str]:
        """Return a sentence for each parameter and each definition that no expression uses, and for a state with the
        name of the drive's angular frequency.
        """
        trees = [*self.dynamics, *self.quantities.values()]
        if self.drawing is not None:
            trees += [t for pair in (*self.drawing.points.values(), *self.drawing.fixed.values()) for t in pair]
        if self.classifier is not None:
            trees += self.classifier.words.values()
        used = set(self.used(trees))
        own = {**{p.name: "parameters" for p in self.parameters}, **dict.fromkeys(self.define, "define")}
        hidden = [
            f"model.states.{s.name}: this state hides the drive's angular frequency, for which {s.name} stands "
            f"elsewhere; write 2*pi*f for that of the drive, or rename the state, such as {s.name}_."
            for s in self.states
            if s.name == OMEGA and self.has_drive
        ]
        return hidden + [
            f"model.{table}.{name}: nothing uses it; {_suggestion(name, table, used)}"
            for name, table in own.items()
            if name not in used
        ]

    def meaning(self) -> str:
        """Return the model's equations, impacts and bounds as JSON; equal for texts that differ only in layout or
        wording.
        """
        bounds = [[p.name, p.bound] for p in self.parameters]
        plain = {
            "states": [
                [s.name, s.on_circle, repr(s.scale), repr(s.escape), *([repr(s.size)] if s.size != 1.0 else [])]
                for s in self.states
            ],
            "parameters": bounds,
            "define": {name: written(tree) for name, tree in self.define.items()},
            "equations": {name: written(tree) for name, tree in self.equations.items()},
            "quantities": [[name, written(tree)] for name, tree in self.quantities.items()],
            "impacts": [
                [
                    written(i.of),
                    i.direction,
                    {name: written(tree) for name, tree in i.set.items()},
                    *["stick"] * i.stick,
                ]
                for i in self.impacts
            ],
            **({"kind": "map"} if self.is_map else {}),
        }
        return json.dumps(plain, sort_keys=True)


def _suggestion(name: str, table: str, used: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, sorted(used), n=1, cutoff=0.6)
    meant = f"did you mean it where an expression has {near[0]}? Else" if near else ""
    effect = " (to sweep it would change nothing)" if table == "parameters" else ""
    return f"{meant} use it in an expression, or take it out{effect}.".strip()


def needed(tree: Tree, define: Mapping[str, Tree]) -> Iterator[str]:
    """Yield the names that an expression uses, directly or through definitions."""
    seen: set[str] = set()
    pending = [name for name, _ in names(tree)]
    while pending:
        name = pending.pop()
        if name not in seen:
            seen.add(name)
            yield name
            pending += [inner for inner, _ in names(define[name])] if name in define else []
