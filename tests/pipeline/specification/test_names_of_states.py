"""States whose names are those of keys, arguments and columns: they are given in a table of their own."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import magpend
from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.branches.orbit_search import orbits_table
from pipeline.layout.cells import initial_states
from pipeline.results.tabular import state_columns
from pipeline.runs.zoom import Changes, Widening, put_value, widened, zoom
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec

NAMES = ("n", "seed", "points", "value", "label", "p", "refine", "states", "self", "copy", "index", "period", "cells")


def model():
    """A map: n' = a n - n^3, with fixed points 0 and +-sqrt(a - 1); all other states decay."""
    equations = {**{name: f"0.4*{name}" for name in NAMES}, "n": "a*n - n**3"}
    states = {name: {} for name in NAMES}
    return {"name": "named", "kind": "map", "states": states, "parameters": {"a": 1.5}, "equations": equations}


def spec(**starts):
    tables = {"kind": "sweep", "model": model(), "axes": {"a": {"values": [1.4, 1.6]}}, "initial_conditions": starts}
    return Spec(**tables, integration={"n_transient": 100, "n_keep": 8})


RANDOM = {"kind": "random", "n": 5, "seed": 3}


def test_states__random_by_either_way():
    inside = spec(**RANDOM, states={"n": [-0.5, 0.5], "seed": 0.25, "states": [0.0, 1.0], "p": [2.0, 3.0]})
    beside = spec(**RANDOM, p=[2.0, 3.0], states={"n": [-0.5, 0.5], "seed": 0.25, "states": [0.0, 1.0]})
    assert inside == beside
    named = spec(kind="list", points=[[0.0] * len(NAMES)]).with_start_random(
        n=5, seed=3, states={"n": (-0.5, 0.5), "seed": 0.25, "states": (0.0, 1.0)}, p=(2.0, 3.0)
    )
    assert named == inside
    columns = dict(zip(NAMES, np.array(initial_states(inside.initial_conditions).columns), strict=True))
    assert len(columns["n"]) == 5
    np.testing.assert_array_equal(columns["seed"], 0.25)
    np.testing.assert_array_equal(columns["self"], 0.0)
    assert (np.abs(columns["n"]) < 0.5).all()
    assert (columns["p"] > 2.0).all()
    # they read back, from dicts and from TOML
    assert Spec.parse(inside.as_dict()) == inside
    assert Spec.parse(tomllib.loads(inside.toml())) == inside


def test_states__grid_zoomed_and_extended():
    grid = spec(kind="grid", refine=2, states={"refine": {"start": 0.0, "stop": 1.0, "num": 4}}, n=0.5)
    named = grid.with_start_grid(refine=2, states={"refine": (0.0, 1.0, 4)}, n=0.5)
    assert named == grid
    assert initial_states(grid.initial_conditions).shape == (4,)
    near, _ = zoom(grid, Changes({"refine": (0.2, 0.4)}, {"n": 0.25}, num=4))
    assert near.refine == 2
    np.testing.assert_allclose(near.initial_conditions.of("refine").array(), np.linspace(0.2, 0.4, 4))
    assert near.initial_conditions.of("n") == 0.25
    wider = widened(grid, Widening({"refine": {"start": 0.0, "stop": 1.0, "num": 7}}))
    assert initial_states(wider.initial_conditions).shape == (7,)
    data = grid.as_dict()
    put_value(grid, data, "refine", 0.5)
    assert data["initial_conditions"]["states"] == {"refine": 0.5}
    assert data["initial_conditions"]["refine"] == 2
    # the short run of a specification without [smoke] takes the ends
    assert initial_states(grid._small().initial_conditions).shape == (2,)


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ({"kind": "random", "n": [-1.0, 1.0]}, "give the state n in its table states = {n = ...}"),
        ({**RANDOM, "seed": [0.0, 1.0]}, "give the state seed in its table states = {seed = ...}"),
        ({**RANDOM, "states": {"q": 1.0}}, "initial_conditions.states.q: unknown key"),
        ({**RANDOM, "states": 1.0}, "states = 1.0: must be a table of states"),
        ({**RANDOM, "p": 1.0, "states": {"p": 2.0}}, "p and states.p are both given; keep one"),
        ({**RANDOM, "states": {"n": [1.0, 0.0]}}, "the second number must be the greater one"),
    ],
)
def test_states__errors_name_the_way(starts, message):
    with pytest.raises(SpecError, match=message.replace("(", r"\(").replace("[", r"\[")):
        spec(**starts).check()


def test_state_columns__beside_columns_of_their_names():
    assert state_columns(["x", "index"], ["period", "index"]) == {"x": "x", "index": "state_index"}


@pytest.mark.slow
def test_states__through_a_run(tmp_path):
    made = spec(**RANDOM, states={"n": [-0.5, 0.5], "seed": [-0.1, 0.1], "index": [0.0, 1.0]})
    run = magpend.run(made, tmp_path / "run", workers=0)
    found = attractors_table(run.attractors()).rows
    assert len(found) == 4
    np.testing.assert_allclose(sorted(abs(row["section_n"]) for row in found), np.sqrt([0.4, 0.4, 0.6, 0.6]), rtol=1e-9)
    assert run.branches(parameter="a").sizes["branch"] == 2
    table = orbits_table(run.orbits(at={"a": 1.6}, max_period=1, starts=40))
    row = next(row for row in table.rows if row["n_unstable"] == 1)
    assert row["period"] == 1
    assert abs(row["state_period"]) < 1e-9
    started = run.orbits(at={"a": 1.6}, max_period=1, starts=40, start={name: 0.0 for name in NAMES} | {"n": 0.77})
    at = int(started.attrs["start_orbit"])
    assert float(started["section"][at, 0, 0]) == pytest.approx(np.sqrt(0.6))
