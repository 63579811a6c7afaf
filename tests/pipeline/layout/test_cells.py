"""Between the cells of the cube and what the kernel sees."""

from __future__ import annotations

import itertools
import tomllib

import numpy as np
import pytest

from magpend_core import load_preset
from pipeline.layout.cells import CellMap, coordinates, initial_states
from pipeline.layout.plan import make_plan
from pipeline.specification.spec import Spec

NAMES = load_preset().names


def whole(shape):
    return tuple(slice(0, n) for n in shape)


def test_inputs__sweep_cell_by_cell(sweep_text):
    spec = Spec.parse(tomllib.loads(sweep_text))
    cells = CellMap(spec)
    assert cells.dims == ("frequency", "q", "psi1_0", "psi2_0")
    coords = {c.name: c.values for c in coordinates(spec)}
    block = (slice(1, 3), slice(1, 2), slice(0, 3), slice(2, 4))
    inputs = cells.inputs(block)
    places = list(itertools.product(*(range(s.start, s.stop) for s in block)))
    assert inputs.parameters.shape == (len(places), 1, len(NAMES))
    for row, (i, j, k, m) in enumerate(places):
        assert inputs.frequency_hz[row, 0] == coords["frequency"][i]
        expected = load_preset(q=float(coords["q"][j])).pack()
        assert (inputs.parameters[row, 0] == expected).all()
        start = [coords["psi1_0"][k], coords["psi2_0"][m], 0.1, 0.0]
        assert inputs.initial_states[row].tolist() == start


def test_inputs__branches_walk_up_and_down(walk_text):
    spec = Spec.parse(tomllib.loads(walk_text.replace("[axes]", "[axes]\nq = { values = [1.5, 1.6] }")))
    cells = CellMap(spec)
    assert cells.dims == ("q", "frequency", "branch")
    assert cells.shape == (2, 6, 10)
    inputs = cells.inputs((slice(1, 2), slice(0, 6), slice(4, 7)))
    path = spec.axes["frequency_hz"].array()
    assert (inputs.frequency_hz == [path, path[::-1], path[::-1]]).all()
    assert (inputs.parameters[..., NAMES.index("q")] == 1.6).all()
    starts = initial_states(spec.initial_conditions).at(np.array([4, 0, 1]))
    assert (inputs.initial_states == starts).all()


@pytest.mark.parametrize("extra", ["", "q = { values = [1.5, 1.6] }"])
@pytest.mark.parametrize("first", [True, False])
def test_outputs__every_cell_gets_its_own_numbers(walk_text, extra, first):
    axis = "frequency_hz = { start = 2.0, stop = 2.5, num = 6 }"
    axes = f"{axis}\n{extra}" if first else f"{extra}\n{axis}"
    spec = Spec.parse(tomllib.loads(walk_text.replace(axis, axes)))
    cells = CellMap(spec)
    coords = {c.name: c.values for c in coordinates(spec)}
    q = coords.get("q", np.array([load_preset()["q"]]))
    for block in make_plan(spec).tasks():
        inputs = cells.inputs(block)
        echo = np.stack([inputs.frequency_hz, inputs.parameters[..., NAMES.index("q")]], axis=-1)
        out = cells.outputs(block, echo)
        index = dict(zip(cells.dims, np.indices(out.shape[:-1]), strict=True))
        offset = {d: s.start for d, s in zip(cells.dims, block, strict=True)}
        assert (out[..., 0] == coords["frequency"][index["frequency"] + offset["frequency"]]).all()
        assert (out[..., 1] == q[index["q"] + offset["q"] if "q" in index else 0]).all()


def test_initial_states__samples_do_not_depend_on_what_is_fixed(walk_text):
    free = Spec.parse(tomllib.loads(walk_text)).initial_conditions
    fixed = Spec.parse(tomllib.loads(walk_text.replace("psi1_deg = [-40, 40]", "psi1_deg = 3"))).initial_conditions
    rows = np.arange(5)
    assert (initial_states(free).at(rows)[:, 1] == initial_states(fixed).at(rows)[:, 1]).all()
    assert (np.abs(initial_states(free).at(rows)[:, :2]) <= np.deg2rad(40)).all()


def test_coordinates__fixed_frequency_and_single_cell():
    text = """
    kind = "sweep"
    [parameters]
    frequency_hz = 2.2
    [initial_conditions]
    kind = "grid"
    psi1 = 0.1
    """
    spec = Spec.parse(tomllib.loads(text))
    cells = CellMap(spec)
    assert cells.shape == ()
    inputs = cells.inputs(())
    assert inputs.frequency_hz.tolist() == [[2.2]]
    assert inputs.initial_states.tolist() == [[0.1, 0, 0, 0]]
    assert cells.outputs((), np.ones((1, 1, 3))).shape == (3,)
    assert {c.name: c.dims for c in coordinates(spec)}["frequency"] == ()
