"""Runs that grow: the bytes of a fresh run of the wider one, with the cells that are there."""

from __future__ import annotations

import json
import tomllib
from importlib import import_module

import numpy as np
import pytest

from magpend_core import Status, extension
from pipeline import open_run
from pipeline.compute import exponents, task
from pipeline.compute.execute import TaskFailedError
from pipeline.layout.cells import initial_states
from pipeline.runs import extend as extending
from pipeline.runs.extend import extend
from pipeline.runs.zoom import Widening, widened
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.errors import RefusedError
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import duffing, quietly, silent

sections = import_module("magpend_core.sections")  # `magpend_core.sections` is a function

pytestmark = pytest.mark.slow

BASE = duffing(
    "frequency_hz = { start = 0.10, stop = 0.14, num = 5 }",
    'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 5 }\nv = 0.1',
    n_transient=3,
    n_keep=4,
    execution="trajectories_per_task = 7",
)
RANDOM = BASE.replace(
    'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 5 }\nv = 0.1',
    'kind = "random"\nn = 6\nseed = 4\nx = [-1.0, 1.0]',
)


class Count:
    """Cells that went through the kernel, those that warm it up aside, and those that products took."""

    def __init__(self, monkeypatch):
        self.cells = self.tangents = self.more = 0
        self.count(monkeypatch, sections, "run_branches", "cells")
        self.count(monkeypatch, exponents, "lyapunov_exponents", "tangents")
        self.count(monkeypatch, extension, "more_sections", "more")
        monkeypatch.setattr(task, "warm_up", lambda spec: 0.0)

    def count(self, monkeypatch, module, function, name):
        original = getattr(module, function)

        def counted(parameters, *words, **options):
            n = parameters.shape[0] * (parameters.shape[1] if name == "cells" else 1)
            setattr(self, name, getattr(self, name) + n)
            return original(parameters, *words, **options)

        monkeypatch.setattr(module, function, counted)


@pytest.fixture
def count(monkeypatch):
    return Count(monkeypatch)


@pytest.fixture
def grown(write_spec, tmp_path, bytes_of, count):
    """Run one text, widen it to another, and hold that against a fresh run; returns the cells integrated."""

    def grow(old, new, **more):
        quietly(write_spec(old, "old.toml"), tmp_path / "old")
        before = bytes_of(tmp_path / "old")
        path = write_spec(new, "new.toml")
        quietly(path, tmp_path / "fresh")
        count.cells = count.tangents = count.more = 0
        found = extend(tmp_path / "old", path, tmp_path / "new", workers=0, echo=silent, **more)
        assert found.complete
        assert bytes_of(tmp_path / "new") == bytes_of(tmp_path / "fresh")
        assert bytes_of(tmp_path / "old") == before
        return count.cells

    return grow


WIDER = {
    "a longer axis": (BASE, BASE.replace("stop = 0.14, num = 5", "stop = 0.16, num = 7"), 10),
    "a finer and longer grid": (
        BASE,
        BASE.replace("x = { start = -1.0, stop = 1.0, num = 5 }", "x = { start = -1.0, stop = 1.5, num = 11 }"),
        30,
    ),
    "a grid of another state": (BASE, BASE.replace("v = 0.1", "v = { values = [0.0, 0.1] }"), 25),
    "a further parameter": (
        BASE.replace("[axes]", "[parameters]\noverrides = { amplitude = 0.3 }\n[axes]"),
        BASE.replace("[axes]", "[axes]\namplitude = { values = [0.2, 0.3] }"),
        25,
    ),
    "more samples": (RANDOM, RANDOM.replace("n = 6", "n = 10"), 20),
    "a list of some of the grid": (
        BASE,
        BASE.replace(
            'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 5 }\nv = 0.1',
            'kind = "list"\npoints = [[0.5, 0.1], [0.25, 0.1], [-1.0, 0.1], [0.5, 0.1]]',
        ),
        5,
    ),
    "other tasks": (BASE, BASE.replace("task = 7", "task = 4"), 0),
    "less": (BASE, BASE.replace("stop = 0.14, num = 5", "stop = 0.12, num = 3"), 0),
}


@pytest.mark.parametrize("what", WIDER)
def test_extend__integrates_what_is_new_alone(grown, what):
    old, new, expected = WIDER[what]
    assert grown(old, new) == expected


WALK = (
    BASE.replace('"sweep"', '"continuation"')
    .replace("[integration]", '[continuation]\ndirection = "both"\n[integration]')
    .replace("task = 7", "task = 5\npoints_per_task = 2")
)
WALKS = {
    "a longer path": (WALK, WALK.replace("stop = 0.14, num = 5", "stop = 0.16, num = 7"), 10 + 35),
    "more seeds": (WALK, WALK.replace("stop = 1.0, num = 5", "stop = 1.5, num = 6"), 10),
    "the other direction": (WALK.replace('"both"', '"down"'), WALK, 25),
    "a further parameter": (
        WALK.replace("[axes]", "[parameters]\noverrides = { amplitude = 0.3 }\n[axes]"),
        WALK.replace("[axes]", "[axes]\namplitude = { values = [0.2, 0.3] }"),
        50,
    ),
    "other tasks": (WALK, WALK.replace("points_per_task = 2", "points_per_task = 3"), 0),
}


@pytest.mark.parametrize("what", WALKS)
def test_walk__goes_on_where_it_ended(grown, what):
    old, new, expected = WALKS[what]
    assert grown(old, new) == expected


def test_walk__new_products(grown, count):
    new = WALK.replace("[execution]", LYAPUNOV).replace("stop = 0.14, num = 5", "stop = 0.15, num = 6")
    assert grown(WALK.replace('"both"', '"up"'), new.replace('"both"', '"up"')) == 5
    assert count.tangents == 30


KEPT = BASE.replace("n_transient = 3\nn_keep = 4", "n_transient = 40\nn_keep = 30")
KEPT_MORE = KEPT.replace("n_keep = 30", "n_keep = 70")
WATCHED = "[products]\nextremes = { quantities = ['energy', 'v'] }\nlyapunov = { n_periods = 4, n_blocks = 2 }\n[ex"
STOPS = "stop_when_closed = true\nclosure_tolerance = 1e-6\n[execution]"
CLOSING = (
    KEPT.replace("[execution]", STOPS)
    .replace("n_transient = 40", "n_transient = 70")
    .replace("[axes]", "[parameters]\noverrides = { amplitude = 0.3 }\n[axes]")
)
FAILING = KEPT.replace("n_transient = 40", "max_steps_per_period = 44\nn_transient = 40")
LONGER_CELLS = {
    "all go on": (KEPT, KEPT_MORE, 0, 25),
    "with a wider axis": (KEPT, KEPT_MORE.replace("stop = 0.14, num = 5", "stop = 0.15, num = 6"), 5, 25),
    "with what is watched": (KEPT.replace("[ex", WATCHED), KEPT_MORE.replace("[ex", WATCHED), 0, 25),
    "where cells fail": (FAILING, FAILING.replace("n_keep = 30", "n_keep = 70"), None, None),
    "where some have closed": (CLOSING, CLOSING.replace("n_keep = 30", "n_keep = 70"), None, None),
}


@pytest.mark.parametrize("what", LONGER_CELLS)
def test_more_sections__go_on_from_the_last(grown, count, tmp_path, what):
    old, new, cells, more = LONGER_CELLS[what]
    found = grown(old, new)
    if cells is not None:
        assert (found, count.more) == (cells, more)
        return
    assert len(np.unique(open_run(tmp_path / "new").n_periods)) > 1, "all cells are of one kind"
    assert found < 25
    assert count.more > 0


LYAPUNOV = "[products]\nlyapunov = { n_transient = 2, n_periods = 4, n_blocks = 2 }\n[execution]"


@pytest.mark.parametrize("had", [False, True])
def test_extend__products_go_on_from_the_sections_or_are_taken(grown, count, had):
    new = BASE.replace("[execution]", LYAPUNOV)
    assert grown(new if had else BASE, new.replace("stop = 0.14, num = 5", "stop = 0.15, num = 6")) == 5
    assert count.tangents == (5 if had else 30)


def test_extend__two_halves(tmp_path, write_spec, bytes_of, count):
    """What merging is for: two halves that were computed apart."""
    low = write_spec(BASE.replace("stop = 0.14, num = 5", "stop = 0.12, num = 3"), "low.toml")
    high = write_spec(BASE.replace("start = 0.10, stop = 0.14, num = 5", "values = [0.12, 0.13, 0.14]"), "high.toml")
    quietly(low, tmp_path / "low")
    quietly(high, tmp_path / "high")
    whole = write_spec(BASE, "whole.toml")
    count.cells = 0
    extend(tmp_path / "low", whole, tmp_path / "new", also=[tmp_path / "high"], workers=0, echo=silent)
    assert count.cells == 0
    quietly(whole, tmp_path / "fresh")
    assert bytes_of(tmp_path / "new") == bytes_of(tmp_path / "fresh")
    record = json.loads((tmp_path / "new" / "extended.json").read_text())
    assert [s["cells"] for s in record["sources"]] == [15, 10]
    assert record["reused"] == 25


LONGER = BASE.replace("stop = 0.14, num = 5", "stop = 0.16, num = 7")


@pytest.fixture
def place(tmp_path, write_spec, count):
    """A finished run, a wider specification, and a fresh run of that."""
    quietly(write_spec(BASE, "old.toml"), tmp_path / "runs" / "mine")
    wide = write_spec(LONGER, "new.toml")
    quietly(wide, tmp_path / "fresh")
    count.cells = 0
    return tmp_path / "runs" / "mine", wide, tmp_path / "fresh"


def test_in_place__the_old_run_stays_beside(place, bytes_of, count):
    mine, wide, fresh = place
    before = bytes_of(mine)
    assert extend(mine, wide, workers=0, echo=silent).name == str(mine)
    assert bytes_of(mine) == bytes_of(fresh)
    assert bytes_of(mine.with_name("mine.before")) == before
    assert sorted(p.name for p in mine.parent.iterdir()) == ["mine", "mine.before"]
    lines = []
    extend(mine, wide, workers=0, echo=lines.append)
    assert lines == [f"{mine} has all these cells already; nothing to do."]
    assert count.cells == 10


@pytest.mark.parametrize("crash", ["cells", "first rename", "second rename"])
def test_in_place__the_same_command_goes_on(place, bytes_of, monkeypatch, count, crash):
    mine, wide, fresh = place
    before = bytes_of(mine)
    calls = []

    def fail_at(n, original):
        def call(*words, **options):
            calls.append(1)
            if len(calls) >= n:
                raise OSError("the power went")
            return original(*words, **options)

        return call

    with monkeypatch.context() as broken:
        if crash == "cells":
            broken.setattr(task, "write_task", fail_at(4, task.write_task))
        else:
            n = 1 if crash == "first rename" else 2
            broken.setattr(extending, "sync_folder", fail_at(n, extending.sync_folder))
        with pytest.raises((OSError, TaskFailedError), match="the power went"):
            extend(mine, wide, workers=0, echo=silent)
    assert bytes_of(mine if crash == "cells" else mine.with_name("mine.before")) == before
    extend(mine, wide, workers=0, echo=silent)
    assert bytes_of(mine) == bytes_of(fresh)
    assert bytes_of(mine.with_name("mine.before")) == before
    assert not mine.with_name("mine.extending").exists()
    if crash != "cells":
        assert count.cells == 10


def test_extend__refuses_what_would_lose_or_take_nothing(place, write_spec):
    mine, *_ = place
    changes = {
        "10 of its cells would be lost": ("start = 0.10, stop = 0.14", "start = 0.12, stop = 0.16"),
        r"integration\.rtol: 1e-06 in the directory, 1e-07 now": ("rtol = 1e-06", "rtol = 1e-07"),
        "no initial state is the same": ("v = 0.1", "v = 0.2"),
        "judged by the last 43 sections: keep as many": ("n_keep = 4", "n_keep = 40"),
    }
    for words, change in changes.items():
        assert change[0] in BASE
        out = None if "lost" in words else mine.with_name("new")
        with pytest.raises(RefusedError, match=words):
            extend(mine, write_spec(BASE.replace(*change), "other.toml"), out, echo=silent)
    with pytest.raises(SpecError, match="nothing to change"):
        extend(mine, None, mine.with_name("new"), echo=silent)
    assert [p.name for p in mine.parent.iterdir()] == ["mine"]


def test_incomplete__what_is_committed_and_sound_is_taken(place, tmp_path, bytes_of, count):
    mine, wide, fresh = place
    for record in sorted((mine / "commits").iterdir())[:2]:
        record.unlink()
    chunk = next((mine / "cube.zarr" / "section").glob("c.4.*"))
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    lines = []
    extend(mine, wide, tmp_path / "new", workers=0, echo=lines.append)
    assert f"{mine}: is not complete; only its 15 of 25 committed cells are reused" in lines
    assert count.cells == 25
    assert bytes_of(tmp_path / "new") == bytes_of(fresh)


def test_command__says_what_is_taken(place, main, bytes_of, tmp_path):
    mine, _, fresh = place
    words = ("extend", mine, "--axis", "frequency=0.1:0.16:7")
    code, out, err = main(*words, "--dry-run")
    assert code == 0, err
    assert f"25 of 35 cells are reused from {mine}\n10 cells are left to integrate\n" in out
    assert "time: about" in out
    assert [p.name for p in mine.parent.iterdir()] == ["mine"]
    code, out, err = main(*words, "--workers", 0)
    assert code == 0, err
    assert f"the old run is in {mine}.before" in err
    assert "25 of 35 cells were reused\n" in err
    assert open_run(mine).section.equals(open_run(fresh).section)
    # the text that was written is a specification like any other
    text = tmp_path / "again.toml"
    text.write_text(RunDirectory.open(mine).info.spec_text)
    quietly(text, tmp_path / "again")
    assert bytes_of(tmp_path / "again") == bytes_of(mine)


FULL = duffing(
    "frequency_hz = { values = [0.2] }",
    'kind = "grid"\nx = { start = 0.5, stop = 1.5, num = 9 }\nv = { start = 0.0, stop = 0.5, num = 9 }',
    n_transient=100,
    n_keep=2,
    more="[parameters]\noverrides = { amplitude = 0.02 }",
).replace("n_keep = 2", "n_keep = 2\nclosure_tolerance = 1e-3")
REFINED = FULL.replace("num = 9 }\n[int", "num = 9 }\nrefine = 4\n[int")


@pytest.mark.parametrize(("old", "new"), [("full", "refined"), ("refined", "full"), ("refined", "wider")])
def test_refined__integrated_cells_alone_are_taken(grown, tmp_path, old, new):
    texts = {"full": FULL, "refined": REFINED, "wider": REFINED.replace("stop = 1.5, num = 9", "stop = 2.0, num = 13")}
    cells = grown(texts[old], texts[new])
    found = open_run(tmp_path / ("new" if new != "full" else "old")).status.values
    n_inferred = int((found == Status.INFERRED).sum())
    assert n_inferred > 10
    if (old, new) == ("full", "refined"):
        assert cells == 0
    elif new == "full":
        assert cells == n_inferred
    else:
        assert cells < found.size - n_inferred


def test_widened__samples_stay_but_those_of_a_hypercube():
    def wider(**sampling: str) -> np.ndarray:
        table = {"kind": "random", "n": 5, "x": [-1.0, 1.0], "v": [0.0, 1.0], **sampling}
        spec = Spec.parse({**tomllib.loads(BASE), "initial_conditions": table})
        few, more = (initial_states(s.initial_conditions) for s in (spec, widened(spec, Widening(starts=40))))
        np.testing.assert_array_equal(few.at(np.arange(5)), more.at(np.arange(5)))
        return more.at(np.arange(40))

    assert wider().shape == wider(sampling="sobol").shape == (40, 2)
    with pytest.raises(SpecError, match="more samples of a latin hypercube are all others"):
        wider(sampling="latin-hypercube")
