"""Read the equations files of AUTO (E. J. Doedel and others): ``FUNC`` and ``STPNT`` in Fortran or C."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import Dialect, RefusedError, replaced
from pipeline.importing.procedural import Procedure
from pipeline.importing.source import Source, text_of

_COMPARE = dict.fromkeys(("<", "<=", ">", ">=", "==", "!=", "/="), 5)
_ARITHMETIC = {"+": 6, "-": 6, "*": 7, "/": 7}
FORTRAN = Dialect(
    binary={"||": 2, "&&": 3, **_COMPARE, **_ARITHMETIC, "**": 8},
    prefix={"-": 7, "+": 7, "!": 4},
    from_right=frozenset({"**"}),
    fold=True,
)
C = Dialect(binary={"?": 1, "||": 2, "&&": 3, **_COMPARE, **_ARITHMETIC}, prefix={"-": 8, "+": 8, "!": 8}, square=True)
_WORDS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=", "and": "&&", "or": "||", "not": "!"}
_DOTTED = re.compile(r"\.(lt|le|gt|ge|eq|ne|and|or|not)\.", re.IGNORECASE)
_FORTRAN_FUNCTIONS = {
    **{f"d{name}": name for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "abs", "atan")},
    **dict.fromkeys(("dmax1", "amax1"), "max"),
    **dict.fromkeys(("dmin1", "amin1"), "min"),
    "mod": "mod of Fortran",
}
_C_FUNCTIONS = {"fabs": "abs", "fmax": "max", "fmin": "min", "fmod": "fmod of C", "abs": "abs of C"}
_DECLARATION = re.compile(
    r"(implicit|integer|double|real|doublereal|dimension|logical|character|const|int|external|use|include|return|end|"
    r"continue|call\s+rab|save|#)\b",
    re.IGNORECASE,
)
_ASSIGNMENT = re.compile(r"([A-Za-z_]\w*)\s*(?:[(\[]\s*(\d{1,6})\s*[)\]])?\s*=(?!=)(.*)", re.DOTALL)


def read_fortran(path: Path) -> Source:
    """Read an equations file in Fortran. What cannot be carried over stands in `Source.problems`."""
    source = Source(path, "AUTO")
    routines = dict(_fortran_routines(text_of(path)))
    arrays = {"u": "state", "par": "parameter", "f": "rate"}
    return _read(source, routines, Procedure(source, FORTRAN, arrays, 1, _FORTRAN_FUNCTIONS))


def read_c(path: Path) -> Source:
    """Read an equations file in C. What cannot be carried over stands in `Source.problems`."""
    source = Source(path, "AUTO")
    routines = dict(_c_routines(text_of(path)))
    arrays = {"u": "state", "par": "parameter", "f": "rate"}
    return _read(source, routines, Procedure(source, C, arrays, 0, _C_FUNCTIONS))


def _read(source: Source, routines: dict[str, list[tuple[int, str]]], procedure: Procedure) -> Source:
    if "func" not in routines:
        source.refuse(1, "there is no routine FUNC")
    for line, text in routines.get("func", ()):
        try:
            if re.fullmatch(r"if\s*\(\s*ijac\b.*\)\s*return\b.*", text, re.IGNORECASE):
                break  # derivatives, which magpend makes itself
            _assign(procedure, line, text)
        except RefusedError as error:
            source.refuse(line, str(error))
    points: dict[str, dict[int, Tree]] = {"u": {}, "par": {}}
    locals_: dict[str, Tree] = {}
    for line, text in routines.get("stpnt", ()):
        try:
            _point(procedure, text, points, locals_)
        except RefusedError as error:
            source.notes.append(f"line {line}: {text[:40]} is left out of the starting point: {error}.")
    procedure.finish(points["u"], points["par"])
    return source


def _assign(procedure: Procedure, line: int, text: str) -> None:
    match = _ASSIGNMENT.fullmatch(text)
    if match is None or _DECLARATION.match(text):
        if _DECLARATION.match(text) and "=" not in text:
            return
        raise RefusedError(f"{text[:60]!r}: only assignments are read")
    target = match[1].lower() if procedure.dialect.fold else match[1]
    index = None if match[2] is None else int(match[2])
    procedure.assign(line, target, index, procedure.tree(match[3], whole_numbers=True))


def _point(procedure: Procedure, text: str, points: dict[str, dict[int, Tree]], own: dict[str, Tree]) -> None:
    """Take an assignment of the starting point."""
    match = _ASSIGNMENT.fullmatch(text)
    if match is None or (_DECLARATION.match(text) and match[1].lower() not in points):
        if _DECLARATION.match(text):
            return
        raise RefusedError("only assignments are read")
    known = dict(own)
    for kind, table in (("u", procedure.states), ("par", procedure.parameters)):
        known |= {table[i]: tree for i, tree in points[kind].items() if i in table}
    outer, procedure.values = procedure.values, {}
    tree = replaced(procedure.tree(match[3], whole_numbers=True), known)
    procedure.values = outer
    target = match[1].lower() if procedure.dialect.fold else match[1]
    if target in points and match[2] is not None:
        points[target][int(match[2])] = tree
        if target == "par" and int(match[2]) not in procedure.parameters:
            own[f"par{int(match[2]) - procedure.base + 1}"] = tree
    else:
        own[target] = tree


def _fortran_routines(text: str) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    """Yield the subroutines of a Fortran file with their statements."""
    name = ""
    body: list[tuple[int, str]] = []
    for line, statement in _fortran_statements(text):
        if match := re.match(r"subroutine\s+(\w+)", statement, re.IGNORECASE):
            name, body = match[1].lower(), []
        elif re.fullmatch(r"end(\s+subroutine.*)?", statement, re.IGNORECASE):
            yield name, body
            name, body = "", []
        else:
            body.append((line, statement))


def _fortran_statements(text: str) -> Iterator[tuple[int, str]]:
    begun, number = "", 0
    lines = text.split("\n")
    for n, raw in enumerate(lines, 1):
        line = raw.partition("!")[0].rstrip() if raw[:1] not in "Cc*" or raw[1:2].isalnum() else ""
        line = _DOTTED.sub(lambda m: _WORDS[m[1].lower()], line)
        if not line.strip():
            continue
        if re.match(r" {5}[^\s0]", line) and begun:  # fixed form
            begun += line[6:]
        elif begun.endswith("&"):
            begun = begun[:-1] + line.strip().removeprefix("&")
        else:
            if begun:
                yield from ((number, part.strip()) for part in begun.split(";") if part.strip())
            begun, number = line.strip(), n
    if begun:
        yield from ((number, part.strip()) for part in begun.split(";") if part.strip())


def _c_routines(text: str) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    """Yield the functions of a C file with their statements."""
    text = re.sub(r"/\*.*?\*/", lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=re.DOTALL)
    text = re.sub(r"//[^\n]*|^[ \t]*#[^\n]*", "", text, flags=re.MULTILINE)
    for match in re.finditer(r"\b(func|stpnt)\s*\([^)]*\)\s*\{", text):
        depth, end = 1, match.end()
        while end < len(text) and depth:
            depth += (text[end] == "{") - (text[end] == "}")
            end += 1
        body, statements = text[match.end() : end - 1], []
        place = match.end()
        for part in body.split(";"):
            lead = len(part) - len(part.lstrip())
            if part.strip():
                statements.append((text.count("\n", 0, place + lead) + 1, " ".join(part.split())))
            place += len(part) + 1
        yield match[1], statements
