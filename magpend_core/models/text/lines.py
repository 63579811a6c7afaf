"""Read a model from lines of equations, as one writes them on paper, into the table of a model as text.

    x'' = -d*x' + x - x**3 + drive      a rate; the states are x and x_dot
    drive = A*cos(omega*t)              a part with a name
    d = 0.2                             a parameter and its value

    g(u, v) = u*v/(1 + v)           a part with arguments
    y[i=1..20]' = y[i+1] - y[i]     a rate for each of several states

A comment begins with #. A line with an open bracket goes on in the next one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magpend_core.models.parameters import ParameterError, near_names
from magpend_core.models.text.grammar import BUILT_IN, ELSEWHERE, name_problem
from magpend_core.models.text.keys import read_key
from magpend_core.models.text.reading import KEYS, read_definition
from magpend_core.models.text.tables import shown

SUFFIXES = ("", "_dot", "_ddot", "_dddot")
"""Ends of the names of a state's derivatives, by order."""

_LEFT = re.compile(r"\s*([A-Za-z_]\w*)\s*(\[[^\[\]]*\]|\([^()]*\)|)\s*('*)\s*=(?!=)")
_FRACTION = re.compile(r"\s*d([A-Za-z]\w*)\s*/\s*dt\s*=")
_PRIMED = re.compile(r"([A-Za-z_]\w*)(\[[^\[\]]*\]|)('+)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_QUOTES = str.maketrans({"′": "'", "’": "'", "″": "''"})
_UNKNOWN = re.compile(r"unknown name '(\w+)'")
_FORMS = "write NAME' = ... for a rate, NAME = ... for a part, or NAME = NUMBER for a parameter"


def is_equations(text: str) -> bool:
    """Return whether a text is lines of equations: whether any line has a primed name on its left side."""
    matches = (_LEFT.match(line) for line in text.translate(_QUOTES).splitlines())
    return any(match is not None and match[3] for match in matches)


@dataclass(frozen=True)
class Entry:
    """A line: the name on its left side, the order of the derivative, the right side, its place for messages, and the
    index or the arguments behind the name.
    """

    name: str
    order: int
    right: str
    place: str
    behind: str = ""

    @property
    def left(self) -> str:
        """The left side."""
        return self.name + self.behind + "'" * self.order


@dataclass
class Lines:
    """Table of a model read from equations, with the problems that were found.

    Attributes
    ----------
    table : dict
        Table with the keys of ``[model]``.
    problems : list of str
        A sentence for each problem, with its line.
    places : dict
        Place of each entry in the text, such as ``line 2``, by its path in the table.
    """

    table: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    places: dict[str, str] = field(default_factory=dict)

    def judged(self) -> list[str]:
        """Return the problems of the lines, and those of the table with the places of its entries in the text."""
        if not self.table["equations"]:
            return self.problems
        found = read_definition(self.table)[1]
        return [*self.problems, *(self._placed(problem) for problem in found)]

    def _placed(self, problem: str) -> str:
        path, _, sentence = problem.removeprefix("model.").partition(": ")
        place = self.places.get(path)
        names = [n for n in _UNKNOWN.findall(sentence) if n not in ELSEWHERE]
        remedy = "".join(f" If {n} is a parameter, give its value: {n}=1.0." for n in names)
        return f"{f'{place}, ' if place else ''}{path}: {sentence}{remedy}"


def read_lines(
    equations: str | Mapping[str, Any], tables: Mapping[str, Any], values: Mapping[str, Any] | None = None
) -> Lines:
    """Read equations, and tables that go with them, into the table of a model.

    Parameters
    ----------
    equations
        Lines of text, or right sides by left side: ``{"x''": "-x"}``; without a prime a key is a state.
    tables
        Further keys of ``[model]``. Entries of ``states``, ``parameters`` and ``define`` are added to those
        of the lines.
    values
        Values of parameters by name, or tables with a value.
    """
    found = Lines()
    entries = list(_entries(equations, found))
    orders = _orders(entries, found)
    if tables.get("kind") == "map":
        found.problems += [
            f"{e.place}: {e.left}: an equation of a map has one prime, {e.name}' = ... for the next "
            f"{e.name}; make the {e.name} before a state of its own."
            for e in entries
            if e.order > 1
        ]
    names = {name: [name + suffix for suffix in SUFFIXES[:order]] for name, order in orders.items()}
    spans = {name: _span([e for e in entries if e.order and e.name == name], found) for name in names}
    rates: dict[str, Any] = {}
    states: dict[str, str] = {}
    for k in range(max(orders.values(), default=0)):  # first all positions, then all their rates
        for name in [*(n for n in names if k + 1 < orders[n]), *(n for n in names if k + 1 == orders[n])]:
            states[names[name][k]] = spans[name]
            if k + 1 < orders[name]:
                every, one = (spans[name].replace("[", "[i="), "[i]") if spans[name] else ("", "")
                rates[names[name][k] + every] = names[name][k + 1] + one
            else:
                rates |= {names[name][k] + e.behind: "" for e in entries if e.order and e.name == name}
    parts: dict[str, Any] = {}
    numbers: dict[str, Any] = {}
    for entry in entries:
        right = _unprimed(entry, names, found)
        if entry.order and orders.get(entry.name) != entry.order:
            continue  # reported already
        if entry.order:
            state = entry.name + SUFFIXES[entry.order - 1] + entry.behind
            if rates.get(state) == "":
                rates[state], found.places[f"equations.{state}"] = right, entry.place
        elif entry.left in parts or entry.left in numbers:
            found.problems.append(f"{entry.place}: {entry.left} is given in a line before; remove one of the two.")
        elif _NUMBER.fullmatch(right) and not entry.behind.startswith("("):
            numbers[entry.left] = float(right) if re.search("[.eE]", right) else int(right)
            found.places[f"parameters.{entry.left}"] = entry.place
        else:
            parts[entry.left], found.places[f"define.{entry.left}"] = right, entry.place
    table = {"name": "model", **_plain({key: value for key, value in tables.items() if value is not None})}
    table["states"] = _states(table.get("states", {}), names, states, found)
    if every := _parameters(numbers, table.get("parameters", {}), _plain(values or {}), found):
        table["parameters"] = every
    if parts or "define" in table:
        table["define"] = _joined(parts, table.get("define", {}), "define", found)
    table["equations"] = rates
    found.table = {key: table[key] for key in (*KEYS, *table) if key in table}
    return found


def _span(entries: list[Entry], found: Lines) -> str:
    """Return the range of the indices of a state's equations, such as ``[1..20]``; empty for a state without index."""
    if not entries[0].behind:
        return ""
    keys = [read_key(entry.name + entry.behind) for entry in entries]
    for entry, key in zip(entries, keys, strict=True):
        if key.problem:
            found.problems.append(f"{entry.place}: {entry.left}: {key.problem}.")
    indices = sorted({k for key in keys for k in key.indices or ()}) or [1]
    if missing := sorted(set(range(indices[0], indices[-1])) - set(indices)):
        name = entries[0].name
        found.problems.append(f"{entries[0].place}: there is no equation for {name}[{missing[0]}].")
    return f"[{indices[0]}..{indices[-1]}]"


def expanded(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the table of a model with its equations read by `read_lines` if they are lines or have primed keys.

    Raises
    ------
    ParameterError
        If the equations are wrong; the message lists all problems.
    """
    given = table.get("equations")
    if not isinstance(given, str) and not (isinstance(given, Mapping) and any("'" in str(key) for key in given)):
        return table
    found = read_lines(given, {key: value for key, value in table.items() if key != "equations"})
    if problems := found.judged():
        raise ParameterError(problems)
    return found.table


def _entries(equations: str | Mapping[str, Any], found: Lines) -> Iterator[Entry]:
    if isinstance(equations, str):
        yield from _entries_of_text(equations.translate(_QUOTES), found)
        return
    for key, value in equations.items():
        match = re.fullmatch(r"\s*([A-Za-z_]\w*)\s*(\[[^\[\]]*\]|)\s*('*)\s*", str(key).translate(_QUOTES))
        if match is None:
            found.problems.append(f"equations.{str(key)[:60]}: must be a name, or a name with primes, such as x''.")
        elif isinstance(value, bool) or not isinstance(value, str | float | int):
            found.problems.append(f"equations.{key} = {shown(value)}: must be an expression in quotes.")
        else:
            yield Entry(match[1], max(1, len(match[3])), str(value), f"equations[{key!r}]", match[2])


def _entries_of_text(text: str, found: Lines) -> Iterator[Entry]:
    for number, line in _whole_lines(text):
        match, place = _LEFT.match(line), f"line {number}"
        if match is not None:
            yield Entry(match[1], len(match[3]), line[match.end() :].strip(), place, match[2])
            continue
        fraction, begin = _FRACTION.match(line), _PRIMED.match(line)
        how = f"write {fraction[1]}' = ... for this rate" if fraction else _FORMS
        found.problems.append(f"{place}: {shown(line)} is no equation; {how}.")
        if fraction is not None:  # the state is known all the same, so that other lines can use it
            yield Entry(fraction[1], 1, "0", place)
        elif begin is not None:
            yield Entry(begin[1], len(begin[3]), "0", place, begin[2])


def _whole_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines with their numbers; comments are removed, and a line with an open bracket takes the next ones."""
    open_line, first = "", 0
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.partition("#")[0].strip()
        if not line:
            continue
        if open_line and (open_line.count("(") <= open_line.count(")") or _LEFT.match(line)):
            yield first, open_line
            open_line = ""
        open_line, first = (f"{open_line} {line}", first) if open_line else (line, number)
    if open_line:
        yield first, open_line


def _orders(entries: list[Entry], found: Lines) -> dict[str, int]:
    """Return the order of the equation of each primed name; report names with several equations."""
    first: dict[str, Entry] = {}
    for entry in entries:
        if not entry.order:
            continue
        before = first.get(entry.name)
        if before is not None and not (before.behind and entry.behind and before.order == entry.order):
            found.problems.append(
                f"{entry.place}: {entry.name} has an equation already ({before.place}); remove one of the two."
            )
        elif before is not None:
            continue
        elif entry.behind.startswith("("):
            found.problems.append(f"{entry.place}: {entry.left}: a rate has no arguments; take them out.")
        elif entry.order > len(SUFFIXES):
            found.problems.append(
                f"{entry.place}: {entry.left}: an equation has at most {len(SUFFIXES)} primes; name a derivative "
                "yourself."
            )
        elif (problem := name_problem(entry.name, BUILT_IN)) is not None:
            found.problems.append(f"{entry.place}: {entry.name} {problem}.")
        else:
            first[entry.name] = entry
    if not first and not found.problems:
        found.problems.append(
            "equations: there is no rate; write NAME' = ... for the rate of each state, such as x' = -x."
        )
    taken = {entry.name for entry in entries}
    for name, entry in first.items():
        for made in (name + suffix for suffix in SUFFIXES[1 : entry.order]):
            if made in taken:
                found.problems.append(
                    f"{entry.place}: {name}{chr(39) * entry.order} makes a state {made}, and a line defines {made}, "
                    "too; rename that."
                )
    return {name: entry.order for name, entry in first.items()}


def _unprimed(entry: Entry, names: Mapping[str, list[str]], found: Lines) -> str:
    """Return the right side of a line with ``x'`` replaced by the state's name; report primes that are no state."""

    def state(match: re.Match[str]) -> str:
        name, order = match[1], len(match[3])
        if order < len(names.get(name, ())):
            return names[name][order] + match[2]
        why = (
            f"there is no equation {name}{match[3]}' = ...; {near_names(name, names, 'states')}"
            if name not in names
            else f"it is the rate that an equation gives; define it in a line of its own, rate = ..., and use {name}"
            f"{chr(39) * len(names[name])} = rate."
        )
        found.problems.append(f"{entry.place}: {match[0]} on a right side: {why}")
        return "0"

    return _PRIMED.sub(state, entry.right)


def _states(
    given: Any, names: Mapping[str, list[str]], states: Mapping[str, str], found: Lines
) -> dict[str, Any] | Any:
    """Return the states in the order of their equations, with units; a derivative's unit follows from its state's.

    `states` has the range of the indices of each, which is empty for none. An entry under the name of a state holds for
    all its indices.
    """
    if not isinstance(given, Mapping):
        return given  # the reader of the table reports it
    given = {
        key.removesuffix(states.get(read_key(key).name, "")) if isinstance(key, str) else key: value
        for key, value in given.items()
    }
    for name in given:
        if name not in states:
            hint = near_names(str(name)[:60], states, "states")
            found.problems.append(f"states.{str(name)[:60]}: no equation gives its rate; {hint}")
    units: dict[str, Any] = {}
    for own in names.values():
        unit = given.get(own[0], "1")
        unit = unit.get("unit", "1") if isinstance(unit, Mapping) else unit
        if isinstance(unit, str):
            for k, name in enumerate(own):
                units[name] = unit if k == 0 or unit == "1" else f"{unit}/s{k if k > 1 else ''}"
    return {name + span: given.get(name, units.get(name, "1")) for name, span in states.items()}


def _parameters(numbers: Mapping[str, Any], tables: Any, values: Mapping[str, Any], found: Lines) -> Any:
    """Return the parameters of the lines, then those of the keywords; a table without a value describes a line's."""
    if not isinstance(tables, Mapping):
        return tables
    result = dict(numbers)
    for where, given in (("parameters.", tables), ("", values)):
        for name, value in given.items():
            if isinstance(value, str):
                hint = near_names(name, KEYS, "keywords") if where == "" else "give a number."
                found.problems.append(f"{where}{name} = {shown(value)}: the value of a parameter is a number; {hint}")
            elif name in result and isinstance(value, Mapping) and "value" not in value:
                result[name] = {"value": result[name], **value}
            elif name in result:
                found.problems.append(f"{where}{name} = {shown(value)}: has a value already; remove one of the two.")
            else:
                result[name] = value
    return result


def _joined(lines: Mapping[str, Any], given: Any, key: str, found: Lines) -> Any:
    if not isinstance(given, Mapping):
        return given
    for name in lines:
        if name in given:
            found.problems.append(f"{key}.{name}: is given in a line, too; remove one of the two.")
    return {**lines, **given}


def _plain(value: Any) -> Any:
    """Convert mappings, sequences and numpy numbers to plain data."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value.item() if isinstance(value, np.generic) else value
