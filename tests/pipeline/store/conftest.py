"""A finished run to be harmed: computed once, and copied for every test."""

from __future__ import annotations

import shutil

import pytest

from pipeline.runs.derive import derive
from tests.pipeline.factories import SQUARE, duffing, finished

SPEC = duffing(
    "amplitude = { start = 0.2, stop = 0.3, num = 3 }",
    SQUARE,
    n_transient=30,
    n_keep=8,
    execution="trajectories_per_task = 9",
    more="[parameters]\nfrequency_hz = 0.2",
)
QUICK = {"polish": False, "extend": False}
"""Options of the run's stored attractors."""


@pytest.fixture(scope="session")
def sound(tmp_path_factory):
    """A folder with a specification and its finished run of three tasks, with stored attractors."""
    folder = tmp_path_factory.mktemp("sound")
    derive(finished(folder, SPEC), "attractors", QUICK)
    return folder


@pytest.fixture
def place(sound, tmp_path):
    """A copy of the run, beside its specification."""
    shutil.copytree(sound, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


@pytest.fixture
def whole(made):
    """A run directory of five tasks with made-up numbers, all of them committed."""
    for index in range(made.plan.n_tasks):
        made.commit(index)
    return made
