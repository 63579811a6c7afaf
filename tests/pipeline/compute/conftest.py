"""Tasks that go wrong."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


@pytest.fixture
def faulty(monkeypatch):
    """The tasks, from a folder that processes and workers find."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import faulty

    yield faulty
    sys.modules.pop("faulty", None)
