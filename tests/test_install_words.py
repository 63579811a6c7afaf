"""What docs and messages say to install can be installed: magpend is on no index, so extras come from a checkout."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LATER = {"clients.py", "jobqueue.py"}
"""Modules of `pipeline.compute` whose messages are written anew elsewhere."""


def test_docs_and_messages__name_no_distribution_of_an_index():
    files = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "pipeline").rglob("*.py")]
    assert len(files) > 300
    for file in files:
        if file.name not in LATER:
            assert not re.search(r"pip install (-\S+ )*['\"]?magpend", file.read_text("utf-8")), file


def test_docs__extras_exist():
    known = set(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"])
    named = set()
    for file in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        for names in re.findall(r"pip install '\.\[([^\]]*)\]'", file.read_text("utf-8")):
            named |= set(names.split(","))
    assert named
    assert named <= known
