"""Finished runs for the commands: each computed once, and copied for every test that changes it."""

from __future__ import annotations

import shutil

import pytest

from pipeline.runs.run import run
from tests.pipeline.conftest import WALK


@pytest.fixture(scope="session")
def computed(tmp_path_factory):
    """Compute a specification once: ``computed(text)`` is its run directory."""
    kept = {}

    def once(text):
        if text not in kept:
            folder = kept[text] = tmp_path_factory.mktemp("computed")
            (folder / "spec.toml").write_text(text, "utf-8")
            run(folder / "spec.toml", folder / "run", workers=0, echo=lambda line: None)
        return kept[text] / "run"

    return once


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
