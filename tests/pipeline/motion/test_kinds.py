"""Kinds of motion: which one a specification has, and what each allows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.motion.steady import Steady
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.runs.suitability import unsuited
from pipeline.specification.spec import Spec

DUFFING: dict[str, Any] = {
    "kind": "sweep",
    "model": "duffing",
    "parameters": {"frequency_hz": 0.2},
    "initial_conditions": {"kind": "random", "n": 2, "x": [-1.0, 1.0], "v": 0.0},
    "integration": {"n_transient": 1, "n_keep": 2},
}
RAMP = {"to": 0.3, "duration_s": 2.0}
TABLES: dict[str, dict[str, Any]] = {
    "steady": {},
    "drifting": {"drift": {"amplitude": RAMP}},
    "noisy": {"noise": {"strengths": {"v": 0.1}, "steps_per_period": 8}},
    "recorded": {"drive": {"file": "drive.csv", "section_hz": 0.2}, "parameters": {}},
}


def motion(folder: Path, kind: str, **more: Any) -> Steady:
    rows = "".join(f"{t},{(-1) ** t}\n" for t in range(31))
    (folder / "drive.csv").write_text(f"time_s,drive\n{rows}", "utf-8")
    return Spec.parse({**DUFFING, **TABLES[kind], **more}, folder).motion


@pytest.mark.parametrize("kind", TABLES)
def test_unsuited__all_analyses_but_those_of_the_kind(tmp_path: Path, kind: str) -> None:
    own = motion(tmp_path, kind)
    assert own.kind == kind
    suited = {name for name, analysis in ANALYSES.items() if not unsuited(own, analysis)}
    assert suited == {name for name, analysis in ANALYSES.items() if kind in analysis.motions}
    assert ("basins" in suited) == (kind == "steady")


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("steady", ""),
        (
            "drifting",
            "its parameter amplitude moves ([drift]); an orbit needs a run with constant parameters, without [drift].",
        ),
        ("noisy", "its cells have noise; an orbit needs a run without [noise]."),
        (
            "recorded",
            "its drive is the recording drive.csv, which ends; an orbit needs a run at a fixed frequency "
            "(frequency_hz = 0.2 instead of [drive]).",
        ),
    ],
)
def test_refusal__of_an_orbit(tmp_path: Path, kind: str, sentence: str) -> None:
    assert motion(tmp_path, kind).refusal("an orbit") == sentence


def test_unsuited__says_what_a_run_allows_and_what_it_lacks(tmp_path: Path) -> None:
    for kind, own in (
        ("drifting", "analyse tipping, analyse delay, plot drift, plot section"),
        ("noisy", "analyse transfer, analyse escapes, analyse density, plot bifurcation, plot section"),
        ("recorded", "plot bifurcation, plot section"),
    ):
        assert unsuited(motion(tmp_path, kind), ANALYSES["basins"]).endswith(f" Of this run: magpend {own}.")
    steady = motion(tmp_path, "steady")
    assert unsuited(steady, ANALYSES["escapes"]).startswith("escapes needs a run with noise; add a table [noise]")
    assert unsuited(steady, ANALYSES["delay"]).startswith("delay needs a run whose parameters move; add a table [drift")


def test_unsuited__what_follows_the_motion_of_a_map(tmp_path: Path) -> None:
    plain = {"parameters": {}, "initial_conditions": {"kind": "random", "n": 2, "x": [-0.1, 0.1], "y": 0.0}}
    iterated = motion(tmp_path, "steady", model="henon", **plain)
    refused = {
        name for name, one in {**FIGURES, **ANALYSES}.items() if unsuited(iterated, one) and "steady" in one.motions
    }
    assert refused == {"response", "backbone", "spectrum", "series", "phase", "gallery"}
    assert unsuited(iterated, FIGURES["gallery"]).endswith("and henon is a map, of iterates alone; draw its section.")


def test_obstacle__of_two_parameters(tmp_path: Path) -> None:
    two = motion(tmp_path, "drifting", drift={"amplitude": RAMP, "damping": RAMP})
    assert two.obstacle == "its parameters amplitude and damping move ([drift])"


def test_seconds_per_period__counts_intervals_and_steps(tmp_path: Path) -> None:
    """A period of 5 s takes 116.5 us by the rule; an interval of a torque adds 0.9 us, a noisy step takes 0.25 us."""
    seconds = {kind: motion(tmp_path, kind).seconds_per_period(np.array([0.2])) for kind in TABLES}
    assert seconds["steady"] == pytest.approx(116.5e-6)
    assert seconds["drifting"] == seconds["steady"]
    assert seconds["recorded"] - seconds["steady"] == pytest.approx(5 * 0.9e-6)
    assert seconds["noisy"] == pytest.approx(8 * 0.25e-6)


def test_no_extension__of_moving_parameters_and_recordings(tmp_path: Path) -> None:
    problems = {kind: motion(tmp_path, kind).no_extension() for kind in TABLES}
    assert problems == {
        "steady": "what closes is judged by the last 3 sections: keep as many",
        "drifting": "cells whose parameters move do not go on",
        "recorded": "cells under a recorded drive do not go on",
        "noisy": "",
    }
    assert not motion(tmp_path, "steady", integration={"n_transient": 0, "n_keep": 3}).no_extension()
