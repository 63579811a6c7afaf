"""Define what a report page consists of, and write it as one HTML file.

A page is data: a title, and sections with blocks of a few kinds (`Picture`, `Grid`, `Text`, `Note`, `Facts`,
`Source`, `Outcome`). The template escapes every text, so no text of a run, a specification or a study becomes
markup. The file has no external resources and no script.
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

from pipeline.report.estimates import Verdict

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

_TEMPLATES = Path(__file__).with_name("templates")
_DPI = 150
"""Resolution of pictures: 1050 pixels for the width of a journal's page, sharp on most screens."""

ROWS_OF_PAGE = 60
"""Most rows of a table on a page; the command beside the table lists all."""


@dataclass(frozen=True)
class Picture:
    """Block of a page: a picture with its caption."""

    png: bytes  # content of the PNG file
    width: int  # width, height: size [pixels]
    height: int
    alt: str  # description for readers who do not see the picture
    caption: str = ""  # caption below the picture
    command: str = ""  # command that draws the picture
    kind: str = "picture"

    @property
    def source(self) -> str:
        """Address (data URL) that contains the picture itself."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Grid:
    """Block of a page: a table."""

    columns: Sequence[str]  # names of the columns
    rows: Sequence[Sequence[str]]  # cells of each row
    caption: str = ""  # caption of the table
    command: str = ""  # command that lists all rows
    n_more: int = 0  # number of rows that are left out
    stacked: bool = False  # whether each row becomes several lines on a narrow screen, for tables with sentences
    kind: str = "grid"


@dataclass(frozen=True)
class Text:
    """Block of a page: a paragraph."""

    text: str
    kind: str = "text"


@dataclass(frozen=True)
class Note:
    """Block of a page: a sentence, and a command that computes a missing or further result."""

    text: str
    command: str = ""
    kind: str = "note"


@dataclass(frozen=True)
class Facts:
    """Block of a page: names with values, such as digests and versions."""

    items: Mapping[str, str]
    kind: str = "facts"


@dataclass(frozen=True)
class Source:
    """Block of a page: text to be shown as it is, such as a specification; it is collapsed at first."""

    title: str
    text: str
    kind: str = "source"


@dataclass(frozen=True)
class Outcome:
    """Block of a page: a claim, the measured result, and the verdict."""

    statement: str  # the claim, paraphrased
    source: str  # author and place of the claim
    found: str  # the measured result with its interval
    verdict: Verdict  # see `pipeline.report.estimates`
    reason: str = ""  # reason for the verdict, if the numbers alone do not show it
    required: bool = False  # whether the command fails if the claim is contradicted
    command: str = ""  # command that computes the result
    kind: str = "outcome"


Block = Picture | Grid | Text | Note | Facts | Source | Outcome


@dataclass(frozen=True)
class Part:
    """Section of a page: its title, blocks and subsections."""

    title: str
    blocks: Sequence[Block]
    parts: Sequence[Part] = ()


@dataclass(frozen=True)
class Page:
    """Content of a report page: its title, summary and sections."""

    title: str  # title of the page
    summary: Sequence[Block]  # blocks above the sections
    parts: Sequence[Part]  # sections of the page
    made_by: str  # program and version


def render(page: Page) -> str:
    """Return a page as HTML; equal pages give equal bytes."""
    style = (_TEMPLATES / "page.css").read_text("utf-8")
    return _environment().get_template("page.html.j2").render(page=page, style=style, parts=anchored(page.parts))


def write(page: Page, path: Path) -> None:
    """Write a page as an HTML file, which is complete or absent at any time."""
    from pipeline.layout.writing import write_atomically

    write_atomically(path, render(page))


def anchored(parts: Sequence[Part], prefix: str = "part") -> list[dict[str, Any]]:
    """Return the sections of a page as nested dictionaries, each with an anchor for the table of contents."""
    return [
        {"title": part.title, "blocks": part.blocks, "anchor": name, "parts": anchored(part.parts, name)}
        for name, part in ((f"{prefix}-{i}", part) for i, part in enumerate(parts, 1))
    ]


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def picture_of(figure: Figure, alt: str, caption: str = "", command: str = "") -> Picture:
    """Make a picture block from a matplotlib figure."""
    from pipeline.plots.looks import LOCK

    buffer = io.BytesIO()
    with LOCK:
        figure.savefig(buffer, format="png", dpi=_DPI, facecolor="white", metadata={"Software": None})
    width, height = (round(side * _DPI) for side in figure.get_size_inches())
    return Picture(buffer.getvalue(), width, height, plain(alt), caption, command)


def grid_of(rows: Sequence[Mapping[str, Any]], caption: str = "", command: str = "") -> Grid:
    """Make a table block from rows of values; empty columns are left out."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[text_of(row.get(name)) for name in names] for row in rows[:ROWS_OF_PAGE]]
    kept = [k for k in range(len(names)) if any(line[k] not in ("", "-") for line in cells)]
    shown = [[line[k] for k in kept] for line in cells]
    heads = [names[k].replace("_", " ") for k in kept]
    return Grid(heads, shown, caption, command, max(0, len(rows) - ROWS_OF_PAGE))


def text_of(value: Any) -> str:
    """Format a value for a table: six digits, or a dash for a number that is not finite."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, float):
        return f"{number:.6g}" if math.isfinite(number) else "-"
    return str(number)


def plain(text: str) -> str:
    """Remove the math markup from a label, for screen readers."""
    return re.sub(r"\s+", " ", re.sub(r"[$\\{}]", "", text)).strip()
