"""Commands of batch systems, made up for a test, and a run with made-up numbers."""

from __future__ import annotations

import shutil

import pytest


@pytest.fixture
def command_of(tmp_path, monkeypatch):
    """Put commands on the PATH, which has no others of a batch system; returns the path of each."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("sh", "cat", "bash"):
        (folder / name).symlink_to(shutil.which(name))
    monkeypatch.setenv("PATH", str(folder))
    for variable in ("SGE_ROOT", "MAGPEND_CLUSTER"):
        monkeypatch.delenv(variable, raising=False)

    def write(name, text, shell="#!/bin/sh"):
        (folder / name).write_text(f"{shell}\n{text}\n")
        (folder / name).chmod(0o755)
        return str(folder / name)

    return write


@pytest.fixture
def whole(made):
    """A run directory of five tasks with made-up numbers, all of them committed."""
    for index in range(made.plan.n_tasks):
        made.commit(index)
    return made
