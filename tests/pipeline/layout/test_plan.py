"""Plans: every cell once, whole chunks, nothing that depends on the machine; and what the kernel sees of cells."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import qmc

from magpend_core import load_preset
from magpend_core.models import load_model
from pipeline.layout import identity
from pipeline.layout import plan as planning
from pipeline.layout.cells import CellMap, coordinates, initial_states
from pipeline.layout.identity import differences, digest_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.specification.spec import Spec
from pipeline.specification.starts import starts_model

ROOT = Path(__file__).parents[3]

SHAPES = st.lists(st.integers(1, 9), min_size=0, max_size=4)


@pytest.mark.slow
@given(SHAPES, st.integers(1, 40), st.data())
def test_tasks__every_cell_in_one_task(shape, wanted, data):
    path = data.draw(st.sampled_from([None, *range(len(shape))]))
    block = planning._block(tuple(shape), path, wanted)
    cells = SimpleNamespace(dims=tuple("abcd"[: len(shape)]), shape=tuple(shape), path=path)
    plan = Plan(None, cells, block)
    seen = np.zeros(shape, dtype=int)
    for task in plan.tasks():
        seen[task] += 1
    assert (seen == 1).all()
    assert sum(plan.cells_in(i) for i in range(plan.n_tasks)) == plan.n_cells
    if path is not None:
        assert block[path] == shape[path]


@given(st.integers(1, 400), st.integers(1, 70), st.integers(1, 300))
@example(266, 16, 290)  # the ceil of a ceil
@example(400, 70, 300)
@example(7, 3, 60_000)
def test_chunks__tasks_own_whole_chunks(n_points, n_branches, n_keep):
    shape = (n_points, n_branches)
    block = planning._block(shape, 0, 16)
    cells = SimpleNamespace(dims=("frequency", "branch"), shape=shape, path=0)
    spec = SimpleNamespace(model=load_model(), products={}, integration=SimpleNamespace(n_keep=n_keep))
    plan = Plan(spec, cells, block)
    for variable in plan.variables:
        chunks = plan.chunks(variable)
        for task in plan.tasks():
            for s, c, n in zip(task, chunks, shape, strict=False):
                assert s.start % c == 0
                assert s.stop % c == 0 or s.stop == n
        size = np.dtype(variable.dtype).itemsize * np.prod(chunks)
        assert size <= planning.PLAN_CHUNK_BYTES or chunks[0] == 1


def test_make_plan__same_on_any_machine(monkeypatch, sweep_text):
    import os

    spec = Spec.parse(tomllib.loads(sweep_text))
    plan = make_plan(spec)
    monkeypatch.setattr(os, "cpu_count", lambda: 97)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(97)), raising=False)
    assert make_plan(spec) == plan


def test_identity__what_counts(sweep_text):
    def digest(text):
        spec = Spec.parse(tomllib.loads(text))
        return digest_of(make_plan(spec).identity)

    same = digest(sweep_text)
    assert digest(sweep_text.replace("small sweep", "another title")) == same
    assert digest(sweep_text.replace("stop = 30", "stop = 30.0")) == same
    for old, new in [("n_keep = 3", "n_keep = 4"), ("1.6]", "1.7]"), ("= 24", "= 12"), ("rtol = 1e-6", "rtol = 1e-7")]:
        assert digest(sweep_text.replace(old, new)) != same


def test_digest_of__numbers_without_loss():
    assert digest_of({"seed": 2**53 + 1}) != digest_of({"seed": 2**53})
    assert digest_of({"seed": 2**200 + 1}) != digest_of({"seed": 2**200})
    assert digest_of({"a": 2, "b": [1.0]}) == digest_of({"a": 2.0, "b": [1]})
    assert digest_of({"a": 0.0}) == digest_of({"a": 0}) != digest_of({"a": -0.0})
    assert digest_of({"a": 1}) != digest_of({"a": True})
    assert differences({"seed": 2**53 + 1}, {"seed": 2**53})
    assert not differences({"a": 2.0}, {"a": 2})


def test_identity__versions_of_what_is_computed(sweep_text):
    """A product that a run does not ask for bars nobody from completing it."""
    plain = Spec.parse(tomllib.loads(sweep_text))
    spectra = Spec.parse(tomllib.loads(f"{sweep_text}\n[products]\nlyapunov = {{}}"))
    assert set(identity.versions_of(plain)) == {"engine", "cells"}
    assert set(identity.versions_of(spectra)) == {"engine", "cells", "lyapunov"}
    lines = differences(*(make_plan(s).identity for s in (plain, spectra)))
    assert any(line.startswith("versions.lyapunov: (absent)") for line in lines)


def test_differences__key_by_key():
    old = {"a": {"b": 1, "c": [1, 2]}, "d": "x"}
    new = {"a": {"b": 1.0, "c": [1, 3]}, "e": 5}
    lines = differences(old, new)
    assert [line.split(":")[0] for line in lines] == ["a.c", "d", "e"]
    assert lines[0] == "a.c: [1, 2] in the directory, [1, 3] now"


# ---- between the cells of the cube and what the kernel sees ----------------------------------------------

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


def test_spread__takes_cells_from_the_first_to_the_last(sweep_text):
    cells = CellMap(Spec.parse(tomllib.loads(sweep_text)))
    found, every = cells.spread(5), cells.inputs(whole(cells.shape))
    rows = [0, *(np.arange(1, 4) * (np.prod(cells.shape) - 1) // 4), -1]
    assert (found.initial_states == every.initial_states[rows]).all()
    assert (found.frequency_hz == every.frequency_hz[rows]).all()
    one = {"kind": "sweep", "model": "duffing", "parameters": {"frequency_hz": 0.2}, "initial_conditions": {"x": 0.1}}
    one["initial_conditions"]["kind"] = "grid"
    assert CellMap(Spec.parse(one)).spread(5).initial_states.tolist() == [[0.1, 0.0]]


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


@pytest.mark.parametrize("sampling", ["sobol", "latin-hypercube"])
def test_samples__cover_the_box_more_evenly(sampling: str) -> None:
    def samples(**more: Any) -> np.ndarray:
        table = {"kind": "random", "n": 300, "x": [-1.0, 3.0], "v": [0.0, 2.0], **more}
        starts = starts_model("random", load_model("duffing")).model_validate(table)
        return initial_states(starts).at(np.arange(300))

    found, plain = samples(sampling=sampling), samples()
    box = [[-1.0, 0.0], [3.0, 2.0]]
    even, independent = (qmc.discrepancy(qmc.scale(s, *box, reverse=True)) for s in (found, plain))
    assert even < 0.3 * independent
    np.testing.assert_array_equal(found, samples(sampling=sampling))
    assert (found != samples(sampling=sampling, seed=1)).any()
    if sampling == "latin-hypercube":  # one sample in each of 300 parts of each state
        assert np.unique(np.floor(75.0 * (found[:, 0] + 1.0))).size == 300
