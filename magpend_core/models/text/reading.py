"""Read the tables of a model given as text: check names and expressions, and report all problems at once.

Needs nothing but numpy; takes milliseconds, whatever is given.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from magpend_core.models.model import Mirror, Quantity, State
from magpend_core.models.parameters import FINITE, FRACTION, NON_NEGATIVE, POSITIVE, Parameter, near_names
from magpend_core.models.text.calls import Function
from magpend_core.models.text.definition import OMEGA, Definition, Impact
from magpend_core.models.text.grammar import BUILT_IN, TIMED, Tree, name_problem, names
from magpend_core.models.text.keys import Key, Line, calls, flat, read_key
from magpend_core.models.text.latex import symbol_of
from magpend_core.models.text.scene import mirror_problem
from magpend_core.models.text.tables import FUNCTION, shown
from magpend_core.models.text.views import BUILT_IN_NAME, MAX_OTHERS, MAX_PARAMETERS, ViewsReader
from magpend_core.sizes import MOST_STATES

MAX_DEFINED = 200
ESCAPE = 1e9
"""Bound beyond which a trajectory has diverged, if the text gives none."""
MAX_FUNCTION = 20_000
"""Characters of the source of a Python function from which the equations were read."""
BOUNDS = {"finite": FINITE, "positive": POSITIVE, "non-negative": NON_NEGATIVE, "fraction": FRACTION}
KINDS = ("flow", "map")
"""Values of the key ``kind``: equations for the rates of the states, the default, or for the next states."""
KEYS = (
    "name",
    "kind",
    "title",
    "source",
    "section",
    "states",
    "parameters",
    "define",
    "equations",
    "quantities",
    "impacts",
    "drawing",
    "mirror",
    "presets",
    "classifier",
    "function",
)
_STATE_KEYS = ("unit", "meaning", "symbol", "on_circle", "scale", "size", "escape", "motion")
_PARAMETER_KEYS = ("value", "unit", "meaning", "symbol", "bound")
_QUANTITY_KEYS = ("value", "unit", "meaning", "symbol")
# dims, coordinates and keys of runs: a state, a parameter or a quantity of the name would be taken for them
OF_RUNS = (
    "frequency",
    "frequency_hz",
    "state",
    "quantity",
    "branch",
    "cell",
    "angle",
    "period_index",
    "kind",
    "preset",
    "drive_period",
    "time",
)


def read_definition(table: Any, place: str = "model") -> tuple[Definition | None, list[str]]:
    """Read the tables of a model given as text; return its definition (None if there are problems) and the problems.

    Parameters
    ----------
    table
        Plain data, as TOML has it under ``[model]``.
    place
        How sentences call it.

    Returns
    -------
    Definition or None
        None if there are problems.
    list of str
        All of them, each with its place.
    """
    reading = _Reading(place)
    try:
        definition = reading.definition(table)
    except RecursionError:  # the caller has used up the stack
        return None, [f"{place}: is nested too deep."]
    problems = reading.problems
    if definition is not None and not problems and (wrong := mirror_problem(definition)) is not None:
        problems.append(f"{place}.mirror: {wrong}")
    return (None if problems else definition), problems


class _Reading(ViewsReader):
    """Reader that goes once through the tables of a model given as text.

    Attributes
    ----------
    taken : dict of str to str
        Why a name of the drive cannot be given to something else.
    """

    def __init__(self, place: str) -> None:
        super().__init__(place)
        self.taken: dict[str, str] = {}

    def definition(self, given: Any) -> Definition | None:
        table = self.table(given, self.place, len(KEYS) + 20, "keys")
        if self.problems:
            return None
        self.keys(table, self.place, KEYS)
        for key in ("name", "states", "equations"):
            if key not in table:
                self.report(f"{self.place}.{key}", "missing; a model has name, states and equations at least.")
        head = {key: self.text(table, key, self.place) for key in ("name", "title", "source", "section")}
        self.text(table, "function", self.place, most=MAX_FUNCTION)  # for readers; never executed
        self._model_name(head["name"], "name" in table)
        self._free_names(table)
        states = self._states(table.get("states", {}))
        if isinstance(table.get("states"), Mapping) and not states:
            return None  # every use of a state would be a problem of its own
        parameters, values = self._parameters(table.get("parameters", {}))
        define = self._defined(self._with_omega(table))
        states, equations = self._equations(table.get("equations", {}), states, "equations" in table)
        described, quantities = self._quantities(table.get("quantities", {}))
        state_names = tuple(s.name for s in states)
        impacts = self._impacts(table.get("impacts", []), state_names)
        drawing = self._drawing(table.get("drawing"), define)
        mirror = self._mirror(table.get("mirror"), state_names)
        classifier = self._classifier(table.get("classifier"), define)
        presets = self._presets(table.get("presets", {}), parameters, values, head["source"])
        trees = {"define": define, "equations": equations, "quantities": quantities}
        is_map = self._is_map(table.get("kind", "flow"), trees, impacts, mirror)
        if self.problems:
            return None
        return Definition(
            **head,
            is_map=is_map,
            states=states,
            parameters=parameters,
            define=define,
            equations=equations,
            quantities=quantities,
            described=described,
            impacts=impacts,
            drawing=drawing,
            mirror=mirror,
            presets=presets,
            classifier=classifier,
            table=_plain(table),
            lines=self.lines,
            surface=None,
            surface_unit=1.0,
        )

    def _free_names(self, table: Mapping[str, Any]) -> None:
        """Forget the meaning of f and phase as the drive's if the text defines the name, and no expression has time."""
        tables = [table.get(key) for key in ("define", "equations", "quantities", "impacts", "drawing", "classifier")]
        words = {word for text in _texts(tables) for word in re.findall(r"[A-Za-z_]\w*", text)}
        keys = [key for name in ("states", "parameters", "define") for key in _keys_of(table.get(name))]
        own = {"f", "phase"} & {read_key(key).name for key in keys}
        timed = words & (set(TIMED) - own)
        for name in own:
            if timed:
                self.taken[name] = (
                    f"belongs to the drive in equations with {', '.join(sorted(timed))}; choose another name, such as "
                    f"{name}_, or take it out if it is the drive's: its frequency is given as frequency_hz"
                )
            else:
                del self.known[name]

    def _model_name(self, name: str, given: bool) -> None:
        plain = name.replace("-", "").replace("_", "")
        if given and not (plain.isascii() and plain.isalnum() and len(name) <= 60 and name[0].isalpha()):
            self.report(self.at("name"), f"{shown(name)} must be a letter, then letters, digits, - and _, 60 at most.")

    def _is_map(
        self, kind: Any, tables: Mapping[str, Mapping[str, Tree]], impacts: tuple[Impact, ...], mirror: Mirror | None
    ) -> bool:
        """Return whether the key ``kind`` says that the model is a map; report what a map cannot have."""
        if kind not in KINDS:
            self.report(self.at("kind"), f"{shown(kind)} must be one of {', '.join(KINDS)}.")
        if kind != "map":
            return False
        for key, trees in tables.items():
            for name, tree in trees.items():
                for timed in [n for n, _ in names(tree) if n in TIMED and self.known[n] == BUILT_IN_NAME][:1]:
                    self.report(self.at(key, name), f"needs {timed!r}; a map has no time: count iterations by a state.")
        if impacts:
            self.report(self.at("impacts"), 'a map has none between its iterations; write "where" in its equations.')
        if mirror is not None and mirror.half_period:
            self.report(self.at("mirror.half_period"), "a map has no drive; leave it out.")
        return True

    def _new_name(self, name: str, place: str, kind: str) -> bool:
        if name in OF_RUNS:
            self.report(place, f"{name!r} names something else in runs; choose another name, such as {name}_.")
            return False
        if self.known.get(name) == BUILT_IN_NAME and name in self.taken:
            self.report(place, f"{name} {self.taken[name]}.")
            return False
        if not self.name(name, place, self.known):
            return False
        self.known[name] = kind
        return True

    def _entry(self, value: Any, place: str, keys: tuple[str, ...], short: str) -> dict[str, Any]:
        """Return a table entry as a dict; a plain value ``v`` becomes ``{short: v}``."""
        if not isinstance(value, Mapping):
            return {short: value}
        entry = self.table(value, place, 20, "keys")
        self.keys(entry, place, keys)
        return entry

    def _flat(self, given: Any, place: str, most: int, what: str) -> dict[str, Any]:
        """Return a table with an entry for each name that its keys stand for."""
        table = self.table(given, place, most, what)
        for text in table:
            self._key(text, self.at(place.rpartition(".")[2], text))
        found = flat(table)
        return self.table(found, place, most, what) if len(found) > len(table) else found

    def _motion(self, entry: Mapping[str, Any], place: str) -> tuple[float, float] | None:
        """Return the least and the largest value of a state in the motion of a run; None if the run gives none."""
        given = entry.get("motion")
        if given is None:
            return None
        is_pair = isinstance(given, (list, tuple)) and len(given) == 2
        if not is_pair or not all(isinstance(x, (int, float)) and math.isfinite(x) for x in given):
            self.report(f"{place}.motion", f"= {given!r} must be two numbers, the least and the largest value.")
            return None
        low, high = map(float, given)
        if not low < high:
            self.report(f"{place}.motion", f"= {given!r}: the first number must be below the second.")
            return None
        return low, high

    def _states(self, given: Any) -> tuple[State, ...]:
        states = []
        for name, value in self._flat(given, self.at("states"), MOST_STATES, "states").items():
            place = self.at("states", name)
            if not self._new_name(name, place, "state"):
                continue
            entry = self._entry(value, place, _STATE_KEYS, "unit")
            unit, symbol = self.text(entry, "unit", place, "1"), self.text(entry, "symbol", place)
            meaning = self.text(entry, "meaning", place) or name
            on_circle = self.flag(entry, "on_circle", place)
            size = self.positive(entry, "size", place, 1.0)
            scale = self.positive(entry, "scale", place, size)
            escape = self.positive(entry, "escape", place, ESCAPE * size)
            motion = self._motion(entry, place)
            states.append(State(name, unit, meaning, symbol, on_circle, scale, escape, size=size, motion=motion))
        if isinstance(given, Mapping) and not given and not self.problems:
            self.report(self.at("states"), "is empty; a model has one state at least.")
        return tuple(states)

    def _parameters(self, given: Any) -> tuple[tuple[Parameter, ...], dict[str, float]]:
        parameters, values = [], {}
        for name, value in self._flat(given, self.at("parameters"), MAX_PARAMETERS, "parameters").items():
            place = self.at("parameters", name)
            if not self._new_name(name, place, "parameter"):
                continue
            entry = self._entry(value, place, _PARAMETER_KEYS, "value")
            unit, symbol = self.text(entry, "unit", place, "1"), self.text(entry, "symbol", place)
            meaning = self.text(entry, "meaning", place) or name
            bound = entry.get("bound", "finite")
            if not isinstance(bound, str) or bound not in BOUNDS:
                self.report(f"{place}.bound", f"{shown(bound)} must be one of {', '.join(BOUNDS)}.")
                bound = "finite"
            parameter = Parameter(name, unit, meaning, BOUNDS[bound], symbol)
            if "value" not in entry:
                self.report(place, "has no value; add value = ... .")
            elif (problem := parameter.problem(entry["value"])) is not None:
                self.report(place, problem)
            else:
                values[name] = self.number(entry["value"], place)
            parameters.append(parameter)
        return tuple(parameters), values

    def _with_omega(self, table: Mapping[str, Any]) -> Any:
        """Return the table of definitions; where a text uses time and an ``omega`` that it does not define, that is the
        drive's angular frequency.
        """
        given = table.get("define", {})
        words = set(re.findall(r"[A-Za-z_]\w*", json.dumps(_plain(table), default=str)))
        is_drive = {"t", OMEGA} <= words and OMEGA not in self.known and isinstance(given, Mapping)
        return {OMEGA: "2*pi*f", **given} if is_drive else given

    def _defined(self, given: Any) -> dict[str, Tree]:
        table = self.table(given, self.at("define"), MAX_DEFINED, "definitions")
        keys = [self._key(text, self.at("define", text)) for text in table]
        kinds = {key.text: "definition" if key.arguments is None else FUNCTION for key in keys}
        good = {
            key.text: all(
                [self._new_name(name, self.at("define", key.text), kinds[key.text]) for name, _ in key.elements]
            )
            for key in keys
        }
        self._functions([key for key in keys if key.arguments is not None and good[key.text]], table)
        found: dict[str, Tree] = {}
        for key in keys:
            if key.arguments is None and good[key.text]:
                found |= self._elements(key, table[key.text], self.at("define", key.text), self.known, self.lines)
        circle = _circle({name: [n for n, _ in names(tree)] for name, tree in found.items()})
        if circle:
            self.report(self.at("define", circle[0]), f"goes round in a circle: {' needs '.join(circle)}.")
            return {}
        return found

    def _key(self, text: str, place: str) -> Key:
        """Read a key; report what is wrong with its index."""
        key = read_key(text)
        if key.problem:
            self.report(place, f"{key.problem}.")
        return key

    def _functions(self, keys: list[Key], table: Mapping[str, Any]) -> None:
        """Read the definitions with arguments to `writing`."""
        nothing = Tree("number", 1, 0.0)
        for key in keys:
            arguments = key.arguments or ()
            for arg in dict.fromkeys(arguments):
                problem = "is given twice" if arguments.count(arg) > 1 else name_problem(arg, BUILT_IN)
                if problem is not None:
                    self.report(self.at("define", key.text), f"the argument {shown(arg)} {problem}.")
            self.writing.functions[key.name] = Function(arguments, nothing)
        for key in keys:
            known = {**self.known, **dict.fromkeys(key.arguments or (), "argument")}
            text = table[key.text]
            body = self.as_written(text, self.at("define", key.text), known)
            if body is not None:
                self.writing.functions[key.name] = Function(key.arguments or (), body)
                self.lines[key.name] = Line(key, str(text), body)
        own = self.writing.functions
        if circle := _circle({name: list(calls(f.body, own)) for name, f in own.items()}):
            self.report(self.at("define", circle[0]), f"calls itself: {' needs '.join(circle)}; write it without.")
            self.writing.functions = {name: Function(f.arguments, nothing) for name, f in own.items()}

    def _elements(
        self, key: Key, value: Any, place: str, known: Mapping[str, str], lines: dict[str, Line] | None = None
    ) -> dict[str, Tree]:
        """Return the expression of each name that a key stands for, and add the line of each to `lines`."""
        raw = self.as_written(value, place, {**known, **({key.variable: "index"} if key.variable else {})})
        found: dict[str, Tree] = {}
        if raw is None:
            return found
        for name, indices in key.elements:
            tree = self.written_out(raw, value, place, known, indices)
            if tree is None:
                break
            found[name] = tree
        if lines is not None:
            lines |= dict.fromkeys(found, Line(key, str(value), raw))
        return found

    def _equations(
        self, given: Any, states: tuple[State, ...], wanted: bool
    ) -> tuple[tuple[State, ...], dict[str, Tree]]:
        table = self.table(given, self.at("equations"), MOST_STATES, "equations")
        own = [s.name for s in states]
        trees: dict[str, Tree] = {}
        given_by: dict[str, str] = {}
        for text, value in table.items():
            place = self.at("equations", text)
            key = self._key(text, place)
            elements = [name for name, _ in key.elements]
            for name in elements:
                if name not in own:
                    self.report(place, f"there is no such state; {near_names(name[:60], own, 'states')}")
                elif name in given_by:
                    self.report(place, f"{name} has an equation already, {given_by[name]}; remove one of the two.")
            if set(elements) <= set(own):
                trees |= self._elements(key, value, place, self.known, self.lines)
            given_by |= dict.fromkeys(elements, text)
        for name in own if wanted else ():
            if name not in given_by:
                self.report(self.at("equations", name), f"missing; give the rate of the state {name}.")
        found = {name: trees[name] for name in own if name in trees}
        return _with_dots([_with_rate(s, found.get(s.name), own) for s in states]), found

    def _quantities(self, given: Any) -> tuple[tuple[Quantity, ...], dict[str, Tree]]:
        trees: dict[str, Tree] = {}
        described = []
        known = dict(self.known)
        for text, value in self.table(given, self.at("quantities"), MAX_OTHERS, "quantities").items():
            place = self.at("quantities", text)
            key = self._key(text, place)
            # a definition may be shown under its own name
            if not all(
                [known.get(name) == "definition" or self._new_name(name, place, "quantity") for name, _ in key.elements]
            ):
                continue
            entry = self._entry(value, place, _QUANTITY_KEYS, "value")
            found = self._elements(key, entry.get("value", ""), place, known)
            unit, symbol = self.text(entry, "unit", place, "1"), self.text(entry, "symbol", place)
            meaning = self.text(entry, "meaning", place)
            trees |= found
            described += [Quantity(name, unit, meaning or name, symbol) for name in found]
        return tuple(described), trees

    def _impacts(self, given: Any, states: tuple[str, ...]) -> tuple[Impact, ...]:
        if not isinstance(given, (list, tuple)):
            self.report(self.at("impacts"), "must be a list of tables; write [[model.impacts]].")
            return ()
        if len(given) > 8:
            self.report(self.at("impacts"), f"has {len(given)} entries; 8 are the most.")
            return ()
        found = [self._impact(value, self.at(f"impacts[{i}]"), states) for i, value in enumerate(given)]
        return tuple(i for i in found if i is not None)

    def _impact(self, given: Any, place: str, states: tuple[str, ...]) -> Impact | None:
        table = self.table(given, place, 10, "keys")
        self.keys(table, place, ("of", "direction", "set", "stick"))
        for word in ("of", "direction", "set"):
            if word not in table:
                self.report(f"{place}.{word}", "missing; an impact has of, direction and set.")
                return None
        direction = table["direction"]
        if not isinstance(direction, str) or direction not in ("up", "down"):
            self.report(f"{place}.direction", f'{shown(direction)} must be "up" or "down".')
        stick = table.get("stick", False)
        if not isinstance(stick, bool):
            self.report(f"{place}.stick", f"{shown(stick)} must be true or false.")
        of = self.expression(table["of"], f"{place}.of", self.known)
        values: dict[str, Tree] = {}
        for text, value in self.table(table["set"], f"{place}.set", MOST_STATES, "states").items():
            key = self._key(text, f"{place}.set.{text[:60]}")
            if unknown := [name for name, _ in key.elements if name not in states]:
                hint = near_names(unknown[0][:60], states, "states")
                self.report(f"{place}.set.{text[:60]}", f"there is no such state; {hint}")
                continue
            values |= self._elements(key, value, f"{place}.set.{text}", self.known)
        return None if of is None else Impact(of, 1 if direction == "up" else -1, values, stick is True)


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in tables and lists that may be expressions."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _texts(inner) if key not in ("unit", "meaning", "symbol") else ()
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _texts(inner)


def _keys_of(table: Any) -> list[str]:
    return [key for key in table if isinstance(key, str)] if isinstance(table, Mapping) else []


def _circle(needs: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the names along a circle of definitions that need one another, the first one again at the end; empty if
    there is none.
    """
    complete: set[str] = set()
    for first in needs:
        path: list[str] = []
        pending: list[tuple[str, bool]] = [(first, False)]
        while pending:
            name, leaving = pending.pop()
            if leaving:
                complete.add(path.pop())
            elif name in path:
                return [*path[path.index(name) :], name]
            elif name not in complete:
                path.append(name)
                pending.append((name, True))
                inner = dict.fromkeys(n for n in needs[name] if n in needs)
                pending += [(n, False) for n in inner]
    return []


def _with_rate(state: State, tree: Tree | None, states: Iterable[str]) -> State:
    """Set the `rate` of a state whose equation is just the name of another state; return any other state unchanged."""
    if tree is None or tree.kind != "name" or str(tree.value) not in states or tree.value == state.name:
        return state
    return State(**{**vars(state), "rate": str(tree.value)})


def _with_dots(states: list[State]) -> tuple[State, ...]:
    """Give each state that is named as the rate of another (x_dot, xdot, dx or v of x) a symbol with a dot."""
    symbols = {s.name: s.symbol for s in states if s.symbol}
    for one in states:
        stem = one.name.rstrip("0123456789")
        element = f"{stem}_dot{one.name.removeprefix(stem)}"
        names = (f"{one.name}_dot", f"{one.name}dot", f"d{one.name}", "v", one.name.replace("_dot", "_ddot"), element)
        if one.rate in names and one.rate not in symbols:
            head, mark, index = symbol_of(one.name, symbols).partition("_")
            symbols[one.rate] = rf"\dot{{{head}}}{mark}{index}"
    return tuple(replace(s, symbol=symbols.get(s.name, "")) for s in states)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    return value
