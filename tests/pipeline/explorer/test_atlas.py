"""The atlas of a plane as the explorer's page gets it: on a made-up plane, and on a run of a map."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.explorer.data.atlas import atlas
from pipeline.explorer.data.explored import Axis, ExploredRun
from pipeline.explorer.data.overlays import attractors
from pipeline.explorer.data.parameter_plane import curve_orbit, parameter_plane
from pipeline.explorer.data.view import describe_view
from pipeline.layout.own_words import with_plain_names
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive, stored
from pipeline.store.run import RunDirectory
from tests.pipeline.analysis.atlas.test_figure import made_up
from tests.pipeline.factories import finished


def explored_plane():
    """A run of 3 by 2 points with the made-up atlas, and without attractors."""
    ds = made_up().assign(node_region=("node", np.array([0, 0, 1, 0, 0, 0, 1])))  # the last one is a further point
    ds = ds.assign(
        {f"{role}_{which}": ds[f"change_{which}"] for role in ("here", "there") for which in ("first", "second")}
    )
    axes = [
        Axis("amplitude", "amplitude", np.array([2.0, 0.0, 1.0])),
        Axis("damping", "damping", np.array([0.0, 2.0])),
        Axis("linear", "linear", np.array([0.0, 0.5])),
    ]
    ds = ds.assign_attrs(derived_options='{"at": {"linear": 0.5}}')
    own = {axis.name: axis for axis in axes}
    return SimpleNamespace(atlas=lambda: ds, kept=lambda name: None, axes=axes, axis=own.__getitem__)


def test_atlas__regions_lines_marks_and_points():
    found = atlas(explored_plane())
    outer, inner = found["regions"]
    assert [len(ring["x"]) for ring in outer["rings"]] == [5, 5]
    assert inner["rings"][0]["x"] == [0.5, 1.5, 1.5, 0.5, 0.5]
    assert (outer["label"], inner["label"]) == ("1", "1 + 2")
    assert outer["colour"] != inner["colour"]
    assert "may be missing" in inner["text"]
    assert "may be missing" not in outer["text"]
    assert inner["attractors"] == [
        "A, equilibrium of period 1: 0.600 (0.500 to 0.700)",
        "B, equilibrium of period 2: 0.400 (0.300 to 0.500)",
    ]
    # a line that nothing explains is shown by marks alone
    assert found["lines"] == [{"kind": "boundary crisis", "x": [0.1, 0.2], "y": [1.5, 1.7]}]
    (mark,) = found["marks"]
    assert (mark["x"], mark["y"], mark["why"], mark["cells"]) == (0.5, 1.8, "tried", [])
    assert found["grid"] == {
        "axes": ["amplitude", "damping"],
        "names": ["amplitude", "damping"],
        "values": [[0.0, 1.0, 2.0], [0.0, 2.0]],
        "indices": [[1, 2, 0], [0, 1]],
        "region": [0, 0, 1, 0, 0, 0],
        "at": {"linear": 1},
    }


@pytest.mark.slow
def test_plane__cells_of_marks_are_on_the_attractor_that_ends(plane_with_atlas):
    run = ExploredRun.open(RunDirectory.open(plane_with_atlas))
    found, ds = parameter_plane(run)["atlas"], with_plain_names(stored(run, "atlas"))
    ids = dense(stored(run, "attractors"))["attractor_id"].transpose("a", "b", ...)
    words = ds["what"].attrs["flag_meanings"].split()
    own = np.flatnonzero(ds["what"].values == words.index("not_decided"))
    assert len(own) == len(found["marks"]) > 0
    for k, mark in zip(own, found["marks"], strict=True):
        here, there = mark["cells"]
        for one, side in ((here, "here"), (there, "there")):
            assert float(ids["a"][one["at"]["a"]]) == float(ds[f"{side}_first"][k])
            assert float(ids["b"][one["at"]["b"]]) == float(ds[f"{side}_second"][k])
        assert ids.values.ravel()[here["cell"]] == int(ds["change_attractor"][k])
        assert there["cell"] % 6 == here["cell"] % 6  # the same start
        assert there["cell"] // 6 == there["at"]["a"] * 2 + there["at"]["b"]


@pytest.mark.slow
def test_plane__points_and_their_attractors(plane_with_atlas):
    run = ExploredRun.open(RunDirectory.open(plane_with_atlas))
    found = parameter_plane(run)
    grid, ids = found["atlas"]["grid"], dense(stored(run, "attractors"))["attractor_id"].transpose("a", "b", ...).values
    assert grid["values"] == [[1.0, 1.1, 1.2], [0.2, 0.3]]
    assert grid["indices"] == [[0, 1, 2], [0, 1]]
    assert found["map"] is None
    for a, b in np.ndindex(3, 2):
        here = attractors(run, {"a": a, "b": b})["attractors"]
        assert {one["id"] for one in here} == set(ids[a, b]) - {-1}
        assert all(ids.ravel()[one["cell"]] == one["id"] for one in here)
        assert all(one["cell"] // 6 == a * 2 + b for one in here)


RESTING = """
kind = "sweep"
section = { of = "x", value = 0.0, direction = "up", longest = 50.0 }
axes = { a = { values = [0.0] }, b = { values = [0.5] } }
initial_conditions = { kind = "random", n = 6, seed = 1, x = [-1.5, 1.5] }
integration = { rtol = 1e-8, atol = 1e-8, n_transient = 100, n_keep = 8 }
model.name = "cusp"
model.states = { x = {} }
model.parameters = { a = 0.0, b = 0.5 }
model.equations = { x = "a + b*x - x**3" }
"""


@pytest.mark.slow
def test_attractors__equilibria_of_a_flow_have_no_cell_with_an_orbit(tmp_path):
    directory = finished(tmp_path, RESTING)
    derive(directory, "attractors")
    here = attractors(RunDirectory.open(directory), {"a": 0, "b": 0})["attractors"]
    assert [(one["kind"], one["cell"]) for one in here] == [("equilibrium", None)] * 2


@pytest.mark.slow
def test_curve_orbit__of_the_curves_of_an_atlas(plane_with_atlas):
    run = ExploredRun.open(RunDirectory.open(plane_with_atlas))
    (curve, *_) = parameter_plane(run)["curves"]
    assert len(curve["pale"]) == len(curve["x"])
    assert curve_orbit(run, curve["id"], 0)


@pytest.mark.slow
def test_view__names_the_command_where_there_is_no_atlas(plane_with_atlas, bent):
    line, plane = bent
    of = {
        name: describe_view(ExploredRun.open(RunDirectory.open(directory)), False)
        for name, directory in (("charted", plane_with_atlas), ("plane", plane), ("line", line))
    }
    assert [of[name]["has"]["atlas"] for name in of] == [True, False, False]
    assert of["plane"]["commands"]["atlas"] == "magpend analyse atlas run"
    assert "atlas" not in of["charted"]["commands"]
    assert "atlas" not in of["line"]["commands"]  # it sweeps one parameter
