"""Packages that only some commands need."""

from __future__ import annotations

import math

import pytest

from pipeline.specification.problems import SpecError, import_extra


def test_import_extra():
    assert import_extra("math", "rig", "--format") is math
    with pytest.raises(SpecError, match=r"--format: needs no_such_package, which is not installed: .*\[rig\]"):
        import_extra("no_such_package", "rig", "--format")
