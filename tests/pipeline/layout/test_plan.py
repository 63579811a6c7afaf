"""Plans: every cell once, whole chunks, nothing that depends on the machine."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from magpend_core.models import load_model
from pipeline.layout import identity
from pipeline.layout import plan as planning
from pipeline.layout.identity import differences, digest_of, identity_of
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.schema import base_variables, sizes_of
from pipeline.specification.spec import Spec

VARIABLES = base_variables(load_model())


def sizes(n_keep):
    return sizes_of(load_model(), {}, n_keep)


ROOT = Path(__file__).parents[3]

SHAPES = st.lists(st.integers(1, 9), min_size=0, max_size=4)


@pytest.mark.slow
@given(SHAPES, st.integers(1, 40), st.data())
def test_tasks__every_cell_in_one_task(shape, wanted, data):
    path = data.draw(st.sampled_from([None, *range(len(shape))]))
    block = planning._block(tuple(shape), path, wanted)
    plan = Plan("sweep", tuple("abcd"[: len(shape)]), tuple(shape), path, block, VARIABLES, sizes(3), 1.0)
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
    plan = Plan("continuation", ("frequency", "branch"), shape, 0, block, VARIABLES, sizes(n_keep), 1.0)
    for variable in VARIABLES:
        chunks = plan.chunks(variable)
        for task in plan.tasks():
            for s, c, n in zip(task, chunks, shape, strict=False):
                assert s.start % c == 0
                assert s.stop % c == 0 or s.stop == n
        size = np.dtype(variable.dtype).itemsize * np.prod(chunks)
        assert size <= planning.CHUNK_BYTES or chunks[0] == 1


@pytest.mark.parametrize("n_seeds", [1, 5, 6, 7, 12])
@pytest.mark.parametrize("wanted", [1, 2, 4, 5, 8, 24])
def test_make_plan__no_task_walks_both_ways(walk_text, n_seeds, wanted):
    text = walk_text.replace("n = 5", f"n = {n_seeds}").replace("task = 2", f"task = {wanted}")
    plan = make_plan(Spec.parse(tomllib.loads(text)))
    assert plan.shape[-1] == 2 * n_seeds
    for block in plan.tasks():
        assert block[-1].start // n_seeds == (block[-1].stop - 1) // n_seeds


def test_make_plan__same_on_any_machine(monkeypatch, sweep_text):
    import os

    spec = Spec.parse(tomllib.loads(sweep_text))
    plan = make_plan(spec)
    monkeypatch.setattr(os, "cpu_count", lambda: 97)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(97)), raising=False)
    assert make_plan(spec) == plan


def test_task__out_of_range(sweep_text):
    plan = make_plan(Spec.parse(tomllib.loads(sweep_text)))
    with pytest.raises(IndexError, match="does not exist"):
        plan.task(plan.n_tasks)


def test_identity__what_counts(sweep_text):
    def digest(text):
        spec = Spec.parse(tomllib.loads(text))
        return digest_of(identity_of(spec, make_plan(spec)))

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


def test_identity__other_starts_under_the_same_specification(sweep_text, monkeypatch):
    """Another version of what makes numbers of a specification is another run."""
    spec = Spec.parse(tomllib.loads(sweep_text))
    before = identity_of(spec, make_plan(spec))
    original = identity.coordinates

    def moved(spec):
        found = list(original(spec))
        i = next(i for i, c in enumerate(found) if c.name == "psi1_0")
        found[i] = replace(found[i], values=found[i].values + 1e-15)
        return tuple(found)

    monkeypatch.setattr(identity, "coordinates", moved)
    lines = differences(before, identity_of(spec, make_plan(spec)))
    assert [line.split(":")[0] for line in lines] == ["coordinates"]


def test_identity__versions_of_what_is_computed(sweep_text):
    """A product that a run does not ask for bars nobody from completing it."""
    plain = Spec.parse(tomllib.loads(sweep_text))
    spectra = Spec.parse(tomllib.loads(f"{sweep_text}\n[products]\nlyapunov = {{}}"))
    assert set(identity.versions_of(plain)) == {"engine", "cells"}
    assert set(identity.versions_of(spectra)) == {"engine", "cells", "lyapunov"}
    lines = differences(*(identity_of(s, make_plan(s)) for s in (plain, spectra)))
    assert any(line.startswith("versions.lyapunov: (absent)") for line in lines)


def test_differences__key_by_key():
    old = {"a": {"b": 1, "c": [1, 2]}, "d": "x"}
    new = {"a": {"b": 1.0, "c": [1, 3]}, "e": 5}
    lines = differences(old, new)
    assert [line.split(":")[0] for line in lines] == ["a.c", "d", "e"]
    assert lines[0] == "a.c: [1, 2] in the directory, [1, 3] now"
