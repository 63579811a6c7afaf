"""Split the text of an XPPAUT file into its lines, with loops and arrays written out as XPPAUT does.

x[1..3]' = -x[j] + [j]      stands for x1' = -x1 + 1 and so on
%[1..3] ... %               repeats the lines between for each j
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.importing.source import Source

MOST_EXPANDED = 5_000
"""Lines after all arrays have been written out."""
_RANGE = re.compile(r"\[\s*(-?\d{1,6})\s*\.\.\s*(-?\d{1,6})\s*\]")
_FIXED = re.compile(r"\[\s*(\d{1,6})\s*\]")
_INDEX = re.compile(r"\[([^\[\]]{0,60})\]")
_TERM = re.compile(r"([-+]?)(?:(\d{1,6})\*)?(j|\d{1,6})(?:\*(\d{1,6}))?")


@dataclass(frozen=True)
class Line:
    """A line of an XPPAUT file, with its number and the comments before it."""

    number: int
    text: str
    comments: tuple[str, ...] = ()


def lines_of(text: str, source: Source) -> Iterator[Line]:
    """Yield the lines of the text up to ``done``, without comments and with arrays written out; refuse bad arrays."""
    count = 0
    for line in _looped(_joined(text), source):
        for expanded in _expanded(line, source):
            count += 1
            if count > MOST_EXPANDED:
                source.refuse(line.number, f"arrays make more than {MOST_EXPANDED} lines")
                return
            yield expanded


def _joined(text: str) -> Iterator[Line]:
    """Yield lines with those joined that end in a backslash, and with the comments that stand before them."""
    comments: list[str] = []
    begun, number = "", 0
    for n, raw in enumerate(text.split("\n"), 1):
        line = raw.rstrip()
        if not begun and line.lstrip()[:1] in ("#", '"') and not line.lstrip().startswith("#include"):
            comments.append(line.lstrip()[1:])
            continue
        number = number if begun else n
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        whole, begun = (begun + line).strip(), ""
        if re.fullmatch(r"d(one)?", whole, re.IGNORECASE):
            break
        if whole:
            yield Line(number, whole, tuple(comments))
            comments = []
    if comments or begun:
        yield Line(number + 1, begun.strip(), tuple(comments))


def _looped(lines: Iterator[Line], source: Source) -> Iterator[Line]:
    """Yield lines with those between ``%[1..n]`` and ``%`` repeated."""
    for line in lines:
        if not line.text.startswith("%"):
            yield line
            continue
        span = _RANGE.match(line.text[1:].lstrip())
        if span is None:
            source.refuse(line.number, f"{line.text[:40]!r} is no loop; XPPAUT writes %[1..20]")
            continue
        body = []
        for inner in lines:
            if inner.text.startswith("%"):
                break
            body.append(inner)
        for n, j in enumerate(_steps(int(span[1]), int(span[2]))):
            for inner in body:
                yield Line(inner.number, _indexed(inner, j, source), inner.comments if n == 0 else ())


def _steps(first: int, last: int) -> range:
    first, last = max(-2 * MOST_EXPANDED, first), min(2 * MOST_EXPANDED, last)
    return range(first, last + 1) if first <= last else range(first, last - 1, -1)


def _expanded(line: Line, source: Source) -> Iterator[Line]:
    """Yield a line once for each index of the array in it."""
    span = _RANGE.search(line.text)
    if span is None:
        yield Line(line.number, _FIXED.sub(r"\1", line.text), line.comments)
        return
    rest = Line(line.number, _RANGE.sub("[j]", line.text))
    for n, j in enumerate(_steps(int(span[1]), int(span[2]))):
        yield Line(line.number, _indexed(rest, j, source), line.comments if n == 0 else ())


def _indexed(line: Line, j: int, source: Source) -> str:
    def value(match: re.Match[str]) -> str:
        found = _index(match[1].replace(" ", ""), j)
        if found is None:
            source.refuse(line.number, f"[{match[1]}] is no index; XPPAUT writes [j], [j+1] or [j-1]")
            return "0"
        return str(found)

    return _INDEX.sub(value, line.text)


def _index(text: str, j: int) -> int | None:
    """Return the value of an index such as ``j+1`` or ``2*j``; None if it is none."""
    total, place = 0, 0
    while place < len(text):
        match = _TERM.match(text, place)
        if match is None or (place > 0 and not match[1]):
            return None
        factor = int(match[2] or 1) * int(match[4] or 1) * (j if match[3] == "j" else int(match[3]))
        total += -factor if match[1] == "-" else factor
        place = match.end()
    return total if text else None
