"""Read tables of text and numbers, and report all their problems at once, each with the path of its key."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from magpend_core.models.parameters import has_controls, near_names
from magpend_core.models.text.calls import Writing
from magpend_core.models.text.grammar import (
    BUILT_IN,
    GrammarError,
    Tree,
    name_problem,
    names,
    parse,
    parse_condition,
    unknown,
)

MAX_TEXT = 2000
"""Characters of a title, a unit, a phrase."""
SHOWN = 60
"""Characters of an expression that a sentence repeats."""


def shown(value: object, around: int = 1) -> str:
    """Format a value for an error message; of a long value, show only the text near one character."""
    text = " ".join(value.split()) if isinstance(value, str) else repr(value)
    if len(text) > SHOWN:
        begin = max(0, min(around - 1 - SHOWN // 2, len(text) - SHOWN))
        end = begin + SHOWN
        text = ("..." if begin else "") + text[begin:end] + ("..." if end < len(text) else "")
    return f'"{text}"' if isinstance(value, str) else text


FUNCTION = "function"
"""Meaning of the name of a function of the text."""

MOST_PROBLEMS = 8
"""Problems of one expression that are named."""


class Reader:
    """A reader of table entries. It appends problems to `problems` and returns a harmless value for a bad entry.

    Expressions may call the functions in `writing`; their trees have calls, indices and sums written out.
    """

    def __init__(self) -> None:
        self.problems: list[str] = []
        self.writing = Writing()

    def report(self, place: str, sentence: str) -> None:
        """Append a problem to `problems`, with the path of its key."""
        self.problems.append(f"{place}: {sentence}")

    def table(self, value: Any, place: str, most: int, what: str = "entries") -> dict[str, Any]:
        """Return a value if it is a table, with its text keys only; else report the value and return {}."""
        if not isinstance(value, Mapping):
            self.report(place, f"{shown(value)} must be a table; write {place.rpartition('.')[2]} = {{ ... }}.")
            return {}
        if len(value) > most:
            self.report(place, f"has {len(value)} {what}; {most} are the most.")
            return {}
        bad = [key for key in value if not isinstance(key, str)]
        for key in bad:
            self.report(place, f"the key {shown(key)} must be a text.")
        return {key: value[key] for key in value if isinstance(key, str)}

    def keys(self, table: Mapping[str, Any], place: str, known: Iterable[str]) -> None:
        """Report the keys of a table that are not among the known ones."""
        known = tuple(known)
        for key in table:
            if key not in known:
                self.report(f"{place}.{key[:SHOWN]}", f"is no key here; {near_names(key[:SHOWN], known, 'keys')}")

    def text(self, table: Mapping[str, Any], key: str, place: str, default: str = "", most: int = MAX_TEXT) -> str:
        """Return a table's value if it is a text of at most `most` characters; else report it and return `default`."""
        value = table.get(key, default)
        if not isinstance(value, str):
            self.report(f"{place}.{key}", f"{shown(value)} must be a text in quotes.")
            return default
        if len(value) > most:
            self.report(f"{place}.{key}", f"has {len(value)} characters; {most} are the most.")
            return default
        if has_controls(value):
            self.report(f"{place}.{key}", f"{ascii(value)[:SHOWN]} has control characters; remove them.")
            return default
        return value

    def flag(self, table: Mapping[str, Any], key: str, place: str) -> bool:
        """Return a table's value if it is true or false; else report it and return false."""
        value = table.get(key, False)
        if not isinstance(value, bool):
            self.report(f"{place}.{key}", f"{shown(value)} must be true or false.")
        return value is True

    def number(self, value: Any, place: str, default: float = 0.0) -> float:
        """Return a value if it is a finite number; else report it and return `default`."""
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.report(place, f"{shown(value)} must be a number.")
            return default
        if not -1e300 < value < 1e300:  # an integer may be too long for a float
            self.report(place, "must be a finite number, below 1e300.")
            return default
        return float(value)

    def positive(self, table: Mapping[str, Any], key: str, place: str, default: float) -> float:
        """Return a table's value if it is a number above 0 or infinity; else report it and return `default`."""
        value = table.get(key, default)
        if isinstance(value, float) and value == math.inf:
            return value
        number = self.number(value, f"{place}.{key}", default)
        if not number > 0.0:
            self.report(f"{place}.{key}", f"{shown(value)} must be greater than 0.")
            return default
        return number

    def name(self, value: Any, place: str, taken: Mapping[str, str]) -> bool:
        """Return whether a name may be defined; report the problem if not. `taken` maps used names to meanings."""
        problem = name_problem(value, () if value in taken else BUILT_IN)
        if problem is None and value in taken:
            problem = f"is the name of a {taken[value]} already; choose another"
        if problem is not None:
            self.report(place, f"{problem}.")
        return problem is None

    def expression(self, value: Any, place: str, known: Mapping[str, str]) -> Tree | None:
        """Parse an expression that uses only known names; report problems and return None for any other value."""
        return self._tree(value, place, known, parse)

    def condition(self, value: Any, place: str, known: Mapping[str, str]) -> Tree | None:
        """Parse a condition that uses only known names; report problems and return None for any other value."""
        return self._tree(value, place, known, parse_condition)

    def _tree(self, value: Any, place: str, known: Mapping[str, str], read: Callable[..., Tree]) -> Tree | None:
        tree = self.as_written(value, place, known, read)
        return None if tree is None else self.written_out(tree, value, place, known)

    def written_out(
        self, tree: Tree, value: Any, place: str, known: Mapping[str, str], indices: Mapping[str, int] | None = None
    ) -> Tree | None:
        """Return an expression with its calls, indices and sums written out; report a problem and return None for any
        other.
        """
        try:
            return self.writing.out(tree, known, indices)
        except GrammarError as error:
            self.report(place, f"{shown(value)}: {error}.")
            return None

    def as_written(
        self, value: Any, place: str, known: Mapping[str, str], read: Callable[..., Tree] = parse
    ) -> Tree | None:
        """Parse an expression that uses only known names, and leave its calls as they are."""
        tree: Tree | None = None
        found: tuple[tuple[str, int], ...] = ()
        wrong: list[tuple[str, str]] = []
        try:
            tree = read(value, {name: len(f.arguments) for name, f in self.writing.functions.items()}, known)
            found = tuple(names(tree))
        except GrammarError as error:
            wrong = [(shown(value), problem) for problem in error.problems]
            found = error.names
        bad = {name: at for name, at in reversed(found) if known.get(name, FUNCTION) == FUNCTION}
        wrong += [(shown(value, at), _unknown(name, at, known)) for name, at in reversed(bad.items())]
        for text, problem in wrong[:MOST_PROBLEMS]:
            self.report(place, f"{text}: {_closed(problem)}")
        if len(wrong) > MOST_PROBLEMS:
            self.report(place, f"{shown(value)}: {len(wrong) - MOST_PROBLEMS} more problems.")
        return None if wrong else tree


def _unknown(name: str, at: int, known: Mapping[str, str]) -> str:
    if name in known:
        return f"{name!r} at character {at} is a function; write its arguments in brackets"
    return unknown(name, at, known, "name")


def _closed(sentence: str) -> str:
    return sentence if sentence.endswith(("?", ".")) else f"{sentence}."
