"""Make a notebook of a page of the gallery, to download and execute.

Blocks that the page marks as executed become cells with code; the text around them, and what they print, becomes cells
with text. The cell after the commands shows the picture that they draw. A notebook stands alone, so the specifications
to which the page links are in it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

_RUN = re.compile(r"<!-- run -->\n```(\w+)\n(.*?)```\n", re.DOTALL)
_PICTURE = re.compile(r"<!-- picture: (\S+) -->\n!\[[^\]]*\]\([^)]+\)\n")
_MARK = re.compile(r"<!-- [^>]*-->\n")
_FILE = re.compile(r"\[([^\]]+)\]\((?!https?:)([^)#]+)\)")

_FIRST = """\
# commands of the magpend that this kernel has; beside the notebook they write runs and pictures
import os
import sys
from IPython.display import Image

os.environ["PATH"] = os.path.dirname(sys.executable) + os.pathsep + os.environ["PATH"]"""


def notebook_of(page: Path) -> dict[str, Any]:
    """Return a page of the gallery as the data of a notebook, format 4.5."""
    text = page.read_text("utf-8")
    pictures = _PICTURE.findall(text)
    parts = _RUN.split(_PICTURE.sub("", text))
    title, _, rest = parts[0].partition("\n")
    cells = [_text(title), _code(_FIRST), _text(rest)]
    for language, block, after in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        cells += [_code(block if language == "python" else _commands(block))]
        cells += [_code(f'Image("{name}")') for name in pictures]
        cells += [_text(_FILE.sub(r"`\1`", _MARK.sub("It prints\n\n", after)))]
        pictures = []
    for name, file in _FILE.findall(text):
        if file.endswith(".toml"):
            cells.append(_text(f"**{name}**\n\n```toml\n{(page.parent / file).read_text('utf-8')}```"))
    kept = [{**cell, "id": f"cell-{k}"} for k, cell in enumerate(cell for cell in cells if cell["source"])]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": kept, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def write_notebooks(pages: Path, folder: Path) -> list[Path]:
    """Write the notebooks of all pages of a folder; return their files."""
    written = [folder / f"{page.stem}.ipynb" for page in sorted(pages.glob("*.md"))]
    for file in written:
        file.write_text(json.dumps(notebook_of(pages / f"{file.stem}.md"), indent=1) + "\n", "utf-8")
    return written


def _commands(block: str) -> str:
    """Return commands of a shell as lines of IPython."""
    return "\n".join(f"!{line}" for line in re.sub(r"\s*\\\n\s*", " ", block).splitlines() if line.strip())


def _text(source: str) -> dict[str, Any]:
    return {"cell_type": "markdown", "metadata": {}, "source": source.strip()}


def _code(source: str) -> dict[str, Any]:
    return {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": [], "source": source.strip()}
