"""What all tests share: a command called in this process, and how hypothesis draws examples.

Those are the same ones in every run of the suite, unless one asks for fresh ones.

``HYPOTHESIS_PROFILE=fresh`` draws new examples in every run, more of them, and remembers what failed.
"""

from __future__ import annotations

import os
import sys

import pytest
from hypothesis import settings

# a deadline would fail where the machine is busy, and what is compiled at first use takes long once
settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, print_blob=True)
settings.register_profile("fresh", deadline=None, max_examples=300, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


@pytest.fixture
def command(monkeypatch, capsys):
    """Call ``magpend WORDS`` in a folder, which must succeed; returns its output and its notes."""
    from pipeline.cli.main import main

    def call(folder, *words):
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["magpend", *map(str, words)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capsys.readouterr()
        assert code == 0, captured.err
        return captured.out, captured.err

    return call
