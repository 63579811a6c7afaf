"""README leads a new user to a system of their own first."""

from __future__ import annotations

import re

from tests.programs import ROOT


def test_readme__links_to_python_and_own_systems_first():
    links = re.findall(r"(?<!!)\[[^\]]+\]\(([^)]+)\)", (ROOT / "README.md").read_text("utf-8"))
    assert links[:2] == ["docs/python-start.md", "docs/own-system.md"]
