"""A page of a report: what stands on it, and how it becomes one HTML file.

A page is data: a title, sections, and in each section blocks of a few kinds (`Picture`, `Grid`, `Text`,
`Note`, `Facts`, `Source`, `Outcome`). The template turns every text into text: nothing that a run, a
specification or a study says becomes markup. The file needs nothing beside itself, asks nothing of a network
and runs no script.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.report.verdicts import Verdict

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

_TEMPLATES = Path(__file__).with_name("templates")
_DPI = 150
"""Of the pictures on a page: 1050 pixels for the width of a journal's page, sharp on most screens."""

MOST_ROWS = 60
"""Rows of a table that a page shows; the command beside it gives them all."""


@dataclass(frozen=True)
class Picture:
    """A picture with its caption.

    Attributes
    ----------
    png : bytes
    width, height : int
        [pixels]
    alt : str
        What it shows, for those who do not see it.
    caption : str
    command : str
        What draws it alone.
    """

    png: bytes
    width: int
    height: int
    alt: str
    caption: str = ""
    command: str = ""
    kind: str = "picture"

    @property
    def source(self) -> str:
        """The picture as an address that holds it."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Grid:
    """A table.

    Attributes
    ----------
    columns : sequence of str
    rows : sequence of sequences of str
    caption : str
    command : str
        What gives all its rows.
    n_more : int
        Rows that are left out.
    stacked : bool
        Whether a row becomes lines on a narrow screen, for tables with sentences in them.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    command: str = ""
    n_more: int = 0
    stacked: bool = False
    kind: str = "grid"


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    kind: str = "text"


@dataclass(frozen=True)
class Note:
    """A sentence, with the command that gives what it says is missing."""

    text: str
    command: str = ""
    kind: str = "note"


@dataclass(frozen=True)
class Facts:
    """Names and values, such as digests and versions."""

    items: Mapping[str, str]
    kind: str = "facts"


@dataclass(frozen=True)
class Source:
    """A text as it is, folded away: a specification."""

    title: str
    text: str
    kind: str = "source"


@dataclass(frozen=True)
class Outcome:
    """A statement, what came out, and whether it holds.

    Attributes
    ----------
    statement : str
        What is claimed, in words of our own.
    source : str
        Who claims it, and where.
    found : str
        What came out, with its interval.
    verdict : str
        See `pipeline.report.verdicts`.
    reason : str
        Why, where the numbers alone do not say.
    required : bool
    command : str
        What computes the numbers alone.
    """

    statement: str
    source: str
    found: str
    verdict: Verdict
    reason: str = ""
    required: bool = False
    command: str = ""
    kind: str = "outcome"


Block = Picture | Grid | Text | Note | Facts | Source | Outcome


@dataclass(frozen=True)
class Part:
    """A section of a page."""

    title: str
    blocks: Sequence[Block]
    parts: Sequence[Part] = ()


@dataclass(frozen=True)
class Page:
    """All of a report.

    Attributes
    ----------
    title : str
    summary : sequence of blocks
        Above the sections.
    parts : sequence of Part
    made_by : str
        Program and version.
    """

    title: str
    summary: Sequence[Block]
    parts: Sequence[Part]
    made_by: str


def render(page: Page) -> str:
    """Return a page as HTML: the same page, the same bytes."""
    style = (_TEMPLATES / "page.css").read_text("utf-8")
    return (
        _environment().get_template("page.html.j2").render(page=page, style=style, parts=anchored(page.parts))
    )


def write(page: Page, path: Path) -> None:
    """Write a page; it is at its place whole or not at all."""
    from pipeline.layout.writing import write_atomically

    write_atomically(path, render(page))


def anchored(parts: Sequence[Part], prefix: str = "part") -> list[dict[str, Any]]:
    """Return the sections with an anchor each, for the list of contents."""
    return [
        {"title": part.title, "blocks": part.blocks, "anchor": name, "parts": anchored(part.parts, name)}
        for name, part in ((f"{prefix}-{i}", part) for i, part in enumerate(parts, 1))
    ]


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip


def picture_of(figure: Figure, alt: str, caption: str = "", command: str = "") -> Picture:
    """Return a figure as a picture of a page."""
    from pipeline.plots.style import TEXT_LOCK

    buffer = io.BytesIO()
    with TEXT_LOCK:
        figure.savefig(buffer, format="png", dpi=_DPI, facecolor="white", metadata={"Software": None})
    width, height = (round(side * _DPI) for side in figure.get_size_inches())
    return Picture(buffer.getvalue(), width, height, plain(alt), caption, command)


def grid_of(
    rows: Sequence[Mapping[str, Any]], caption: str = "", command: str = "", most: int = MOST_ROWS
) -> Grid:
    """Return rows of numbers and words as a table; columns in which nothing stands are left out."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[text_of(row.get(name)) for name in names] for row in rows[:most]]
    kept = [k for k in range(len(names)) if any(line[k] not in ("", "-") for line in cells)]
    shown = [[line[k] for k in kept] for line in cells]
    heads = [names[k].replace("_", " ") for k in kept]
    return Grid(heads, shown, caption, command, max(0, len(rows) - most))


def text_of(value: Any) -> str:
    """Spell a value of a table: six digits, a dash where there is none."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, float):
        return f"{number:.6g}" if math.isfinite(number) else "-"
    return str(number)


def plain(text: str) -> str:
    """Return a label without the marks of mathematics: for those who hear it."""
    return re.sub(r"\s+", " ", re.sub(r"[$\\{}]", "", text)).strip()
