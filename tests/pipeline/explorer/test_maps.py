"""The explorer of a run of a map: what the page asks, and what it computes live."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.explorer.answers import ANSWERS, Query
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.explored import ExploredRun
from pipeline.runs.derive import derive
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import finished

HENON = """
kind = "sweep"
model = "henon"
axes.a = { values = [0.3, 0.5] }
initial_conditions.kind = "grid"
initial_conditions.x = { start = -0.5, stop = 0.5, num = 3 }
initial_conditions.y = { start = -0.2, stop = 0.2, num = 3 }
integration = { n_transient = 200, n_keep = 20 }
"""


@pytest.fixture(scope="module")
def henon(tmp_path_factory):
    directory = finished(tmp_path_factory.mktemp("henon"), HENON)
    derive(directory, "attractors")
    return directory


def ask(run, name, **words):
    return ANSWERS[name].give(run, Query({key.replace("_", "."): str(value) for key, value in words.items()}), None)


@pytest.mark.slow
def test_answers__of_a_map_name_iterations_and_no_frequency(henon):
    run = ExploredRun.open(RunDirectory.open(henon))
    view = json.loads(ask(run, "view").content)
    assert (view["model"]["period"], view["model"]["time"], view["model"]["forced"]) == (
        "iteration",
        "iteration",
        False,
    )
    assert [axis["name"] for axis in view["axes"]] == ["a"]
    for name, words in {
        "diagram": {"x": "a", "y": view["verticals"][0]["name"]},
        "curves": {"x": "a"},
        "attractors": {"at_a": 0},
        "disturbances": {"at_a": 0},
        "plane": {"at_a": 0},
    }.items():
        assert ask(run, name, **words).content
    arrays, attrs = unpack_arrays(ask(run, "orbit", cell=9, point=3).content)
    x, y = arrays["states"].T
    np.testing.assert_allclose(x[1:], 1.0 - 0.5 * x[:-1] ** 2 + y[:-1], atol=1e-15)  # iterates, and nothing between
    assert attrs["frequency"] is None
    assert attrs["period"] == 2
    np.testing.assert_array_equal(arrays["section_times"], [0.0, 1.0, 2.0])


@pytest.mark.slow
def test_live__starts_and_follows_orbits_of_a_map(henon, watch):
    watcher = watch(RunDirectory.open(henon))
    number = watcher.send(do="start", parameters={"a": 0.45}, state={"x": 0.1, "y": 0.1})
    end = watcher.wait(number, "done", "error")
    assert (end["kind"], end["period"]) == ("done", 2), end
    x = watcher.sections(number)[:, 0]
    assert x[0] == 1.0 - 0.45 * 0.1**2 + 0.1
    found = watcher.ask("orbit", "error", do="follow", **{"from": {"cell": 0, "point": 0}}, parameter="a", value=0.35)
    assert (found["period"], found["stable"], found["frequency"]) == (1, True, None), found
    square = {"plane": ["x", "y"], "ranges": [[-1, 1], [-1, 1]], "resolution": 16}
    assert watcher.ask("done", "error", do="slice", parameters={"a": 0.5}, **square)["kind"] == "done"
    refused = watcher.ask("error", do="start", parameters={"a": 0.3}, state={"x": 0.1, "y": 0.1}, noise=0.1)
    assert "is a map" in str(refused)
