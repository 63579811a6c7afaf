"""Finished runs for the commands: each computed once, and copied for every test that changes it."""

from __future__ import annotations

import shutil

import pytest

from tests.pipeline.conftest import WALK


@pytest.fixture
def copied(computed, tmp_path):
    """Copy a run, without results that other tests have derived of it, to the directory ``run`` of a test."""

    def copy(text):
        return shutil.copytree(computed(text), tmp_path / "run", ignore=shutil.ignore_patterns("derived", "figures"))

    return copy


@pytest.fixture
def walk(copied):
    """The small continuation, in ``run``."""
    return copied(WALK)
