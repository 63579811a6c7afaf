"""Cells of one run in another: found where the same numbers go in, and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.layout.cells import CellMap
from pipeline.layout.matching import NOWHERE, Finder, apart, way_of
from pipeline.layout.plan import make_plan
from pipeline.specification.spec import Spec

pytestmark = pytest.mark.slow

values = st.lists(st.sampled_from([-1.0, -0.5, -0.0, 0.0, 0.1, 1 / 3, 0.5, 1.0]), min_size=1, max_size=4)


def rising(numbers):
    return sorted({x + 0.0 if x else x for x in numbers} - {-0.0}) or [0.25]


@st.composite
def starts(draw):
    kind = draw(st.sampled_from(["grid", "list", "random"]))
    if kind == "grid":
        x, v = rising(draw(values)), draw(st.sampled_from([0.0, 0.5]))
        return {"kind": "grid", "x": {"values": x}, "v": v}
    if kind == "list":
        rows = st.tuples(st.sampled_from([-0.5, -0.0, 0.0, 0.5]), st.sampled_from([0.0, 0.5]))
        return {"kind": "list", "points": [list(row) for row in draw(st.lists(rows, min_size=1, max_size=4))]}
    return {"kind": "random", "n": draw(st.integers(1, 5)), "seed": draw(st.integers(0, 1)), "x": [-1.0, 1.0]}


@st.composite
def specs(draw, kind):
    hz = [f for f in (0.1, 0.2, 0.3, 0.4) if draw(st.booleans())] or [0.2]
    data = {
        "kind": kind,
        "model": "duffing",
        "axes": {"frequency_hz": {"values": hz}},
        "initial_conditions": draw(starts()),
        "parameters": {"overrides": {}},
        "execution": {"trajectories_per_task": draw(st.integers(1, 4))},
    }
    if draw(st.booleans()):
        data["axes"]["amplitude"] = {"values": rising(draw(values))}
    else:
        data["parameters"]["overrides"]["amplitude"] = draw(st.sampled_from([0.5, 1.0]))
    if kind == "continuation":
        data["continuation"] = {"direction": draw(st.sampled_from(["up", "down", "both"]))}
        data["execution"]["points_per_task"] = draw(st.integers(1, 3))
    return Spec.parse(data)


def histories(spec: Spec, wanted: Spec | None = None) -> dict[int, bytes]:
    """What goes into each cell, all of its walk up to it, by its flat index."""
    cells, plan = CellMap(spec), make_plan(spec)
    whole = [slice(0, n) for n in cells.shape]
    found = {}
    for branch in range(cells.shape[-1] if cells.shape else 1):
        block = (*whole[:-1], slice(branch, branch + 1)) if cells.path is not None else tuple(whole)
        inputs = cells.inputs(block)
        flat = np.arange(plan.n_cells).reshape(plan.shape)[block]
        # `outputs` brings a kernel's order into the cube's, so its inverse is that of the flat indices
        order = np.arange(flat.size).reshape(inputs.frequency_hz.shape)
        places = np.empty(flat.size, np.int64)
        places[cells.outputs(block, order).ravel()] = flat.ravel()
        for i in range(inputs.frequency_hz.shape[0]):
            history = inputs.initial_states[i].tobytes()
            for j in range(inputs.frequency_hz.shape[1]):
                history += inputs.parameters[i, j].tobytes() + inputs.frequency_hz[i, j].tobytes()
                found[int(places[order[i, j]])] = history
        if cells.path is None:
            break
    return found


@pytest.mark.parametrize("kind", ["sweep", "continuation"])
@given(st.data())
def test_find__what_the_same_numbers_go_into(kind, data):
    old, new = data.draw(specs(kind)), data.draw(specs(kind))
    have, wanted = histories(old), histories(new)
    by_history = {}
    for place, history in have.items():
        by_history.setdefault(history, set()).add(place)
    cells, plan, finder = CellMap(new), make_plan(new), Finder(CellMap(old))
    n_found = 0
    for block in plan.tasks():
        inputs = cells.inputs(block)
        found = cells.outputs(block, finder.find(inputs, way_of(cells, block)))
        flat = np.arange(plan.n_cells).reshape(plan.shape)[block]
        for place, there in zip(flat.ravel(), found.ravel(), strict=True):
            same = by_history.get(wanted[int(place)], set())
            assert (there in same) if same else (there == NOWHERE)
            n_found += bool(same)
    if not n_found and kind == "sweep":
        assert apart(CellMap(old), cells)


@pytest.mark.parametrize("kind", ["sweep", "continuation"])
@given(st.data())
def test_find__every_cell_in_its_own_run(kind, data):
    spec = data.draw(specs(kind))
    cells, plan = CellMap(spec), make_plan(spec)
    finder = Finder(cells)
    states = {}
    for block in plan.tasks():
        found = cells.outputs(block, finder.find(cells.inputs(block), way_of(cells, block)))
        flat = np.arange(plan.n_cells).reshape(plan.shape)[block]
        states |= dict(zip(flat.ravel().tolist(), found.ravel().tolist(), strict=True))
    assert NOWHERE not in states.values()
    assert len(states) == math.prod(plan.shape)
    if spec.initial_conditions.kind != "list":  # rows of a list may be given twice
        assert all(place == there for place, there in states.items())
