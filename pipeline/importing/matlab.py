"""Read right-hand sides in MATLAB: the files that MatCont writes, and functions ``dydt = f(t, y, a, b)`` like them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import Dialect, RefusedError
from pipeline.importing.procedural import Procedure
from pipeline.importing.source import Source, text_of

_COMPARE = dict.fromkeys(("<", "<=", ">", ">=", "==", "~="), 5)
DIALECT = Dialect(
    binary={
        **{"||": 1, "&&": 2, "|": 3, "&": 4, **_COMPARE, "+": 6, "-": 6},
        **dict.fromkeys(("*", "/", ".*", "./"), 7),
        **dict.fromkeys(("^", ".^"), 9),
    },
    prefix={"-": 8, "+": 8, "~": 8},
)
PREFIX = "par_"
"""Beginning of the names of parameters in files that MatCont writes."""
_HEAD = re.compile(r"function\s+(?:\[?\s*([\w\s,]+?)\s*\]?\s*=\s*)?(\w+)\s*(?:\(([^)]*)\))?")
_ASSIGNMENT = re.compile(r"([A-Za-z]\w*)\s*(?:\(\s*(\d{1,6})\s*(?:,\s*1\s*)?\))?\s*=(?!=)(.*)", re.DOTALL)
_MADE_EMPTY = re.compile(r"(zeros|NaN|nan)\s*\([^()]*(\([^()]*\))?[^()]*\)")


def read(path: Path) -> Source:
    """Read a file of MATLAB. What cannot be carried over stands in `Source.problems`."""
    source = Source(path, "MatCont")
    functions = list(_functions(text_of(path)))
    chosen = [f for f in functions if f[0] == "fun_eval"] or [f for f in functions if len(f[2]) >= 2 and f[1]]
    if not chosen:
        source.refuse(1, "there is no function dydt = f(t, y, ...)")
        return source
    _, out, arguments, statements = chosen[0]
    procedure = Procedure(source, DIALECT, {arguments[1]: "state", out: "rate"}, 1, {})
    for i, argument in enumerate(arguments[2:], 1):
        name = procedure.element("parameter", i)
        source.spelling[name] = argument.removeprefix(PREFIX)
        procedure.values[argument] = Tree("name", 1, name)
    if arguments[0] != "t":
        procedure.values[arguments[0]] = Tree("name", 1, "t")
    for line, text in statements:
        try:
            _statement(procedure, out, line, text)
        except RefusedError as error:
            source.refuse(line, str(error))
    procedure.finish(_starts(procedure, functions), {})
    return source


def _statement(procedure: Procedure, out: str, line: int, text: str) -> None:
    match = _ASSIGNMENT.fullmatch(text)
    if match is None:
        if text in ("end", "return"):
            return
        raise RefusedError(f"{text[:60]!r}: only assignments are read")
    right = match[3].strip()
    if match[1] == out and match[2] is None:
        if _MADE_EMPTY.fullmatch(right):
            return
        for i, entry in enumerate(_entries(right), 1):
            procedure.assign(line, out, i, procedure.tree(entry))
        return
    procedure.assign(line, match[1], None if match[2] is None else int(match[2]), procedure.tree(right))


def _entries(text: str) -> list[str]:
    """Return the entries of a column ``[a; b]``."""
    match = re.fullmatch(r"\[(.*)\]\s*(\.?')?", text, re.DOTALL)
    if match is None:
        raise RefusedError("the rates must be a column [a; b; ...]")
    entries = re.split(r"[;\n]" if match[2] is None else r"[;\n,]", match[1])
    return [entry.strip().rstrip(",") for entry in entries if entry.strip()]


def _starts(
    procedure: Procedure, functions: list[tuple[str, str, list[str], list[tuple[int, str]]]]
) -> dict[int, Tree]:
    """Return the initial values ``y0`` of the function ``init``."""
    for name, _, _, statements in functions:
        for _, text in statements if name == "init" else ():
            match = re.fullmatch(r"y0\s*=\s*\[(.*)\]\s*'?", text, re.DOTALL)
            if match is not None:
                try:
                    return {i: procedure.tree(e) for i, e in enumerate(re.split(r"[;,\s]+", match[1].strip()), 1) if e}
                except RefusedError:
                    return {}
    return {}


def _functions(text: str) -> Iterator[tuple[str, str, list[str], list[tuple[int, str]]]]:
    """Yield the functions of a file: name, output, arguments, statements with their lines."""
    head: re.Match[str] | None = None
    body: list[tuple[int, str]] = []
    for line, statement in _statements(text):
        if match := _HEAD.fullmatch(statement):
            if head is not None:
                yield _described(head, body)
            head, body = match, []
        elif head is not None:
            body.append((line, statement))
    if head is not None:
        yield _described(head, body)


def _described(head: re.Match[str], body: list[tuple[int, str]]) -> tuple[str, str, list[str], list[tuple[int, str]]]:
    arguments = [a.strip() for a in (head[3] or "").split(",") if a.strip()]
    return head[2], (head[1] or "").strip(), arguments, body


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield statements with their lines: ends are semicolons and lines outside of brackets."""
    begun, number, depth = "", 0, 0
    for n, raw in enumerate(text.split("\n"), 1):
        line = raw.partition("%")[0]
        goes_on = line.rstrip().endswith("...")
        line = line.rstrip()[:-3] if goes_on else line
        for char in line:
            depth = max(0, depth + (char in "([{") - (char in ")]}"))
            if char == ";" and depth == 0:
                if begun.strip():
                    yield number, begun.strip()
                begun = ""
                continue
            if not begun.strip():
                begun, number = "", n
            begun += char
        if depth:
            begun += "\n" if not goes_on else " "
        elif not goes_on:
            if begun.strip():
                yield number, begun.strip()
            begun = ""
    if begun.strip():
        yield number, begun.strip()
