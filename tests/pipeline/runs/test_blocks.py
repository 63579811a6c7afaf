"""Analyses in blocks of parameter points: the same bytes whatever the blocks and workers, stopped or not."""

from __future__ import annotations

import shutil
from functools import cache, partial

import numpy as np
import pytest

from magpend_core.engine.threads import number_of_threads
from pipeline.analysis.attractors import analysis
from pipeline.compute import execute
from pipeline.products.registry import ANALYSES
from pipeline.runs import blocks
from pipeline.runs.derive import AnalysedRun, derive, prune
from pipeline.runs.stopping import InterruptedRunError
from tests.pipeline.factories import WELL, contents

MAP = """
kind = "sweep"
model = "duffing"
[parameters]
preset = "twin-well-periodic"
[axes]
frequency_hz = { start = 0.12, stop = 0.2, num = 4 }
amplitude = { start = 0.1, stop = 0.5, num = 3 }
[initial_conditions]
kind = "random"
n = 8
seed = 1
x = [-1.5, 1.5]
v = [-1.0, 1.0]
[integration]
n_transient = 200
n_keep = 32
"""
EACH_POINT, A_ROW = (8, 8), (24, 24)
"""Fewest and most cells of a block, for blocks of one point and of one row."""


@pytest.fixture(scope="module")
def copied(computed):
    """Copies of a run, without results, in a folder."""

    def make(folder, name: str, text: str = MAP) -> AnalysedRun:
        shutil.copytree(computed(text), folder / name, ignore=shutil.ignore_patterns("derived"))
        return AnalysedRun.of(folder / name)

    return make


@pytest.fixture
def copy(copied, tmp_path):
    """Copies of the run, without results."""
    return partial(copied, tmp_path)


def files_of(run, name):
    """Return all files of the stored results of an analysis."""
    found = {folder.name: contents(folder) for folder in (run.directory / "derived").glob(f"{name}-*.zarr")}
    assert found
    return found


@pytest.fixture
def sizes(monkeypatch):
    """Set the fewest and most cells of a block."""

    def put(fewest, most):
        monkeypatch.setattr(blocks, "FEWEST_CELLS", fewest)
        monkeypatch.setattr(blocks, "MOST_CELLS", most)

    return put


@pytest.fixture(scope="module")
def whole(copied, tmp_path_factory):
    """The run analysed at once, which stays below the size of a block."""
    run = copied(tmp_path_factory.mktemp("blocks"), "whole")
    assert len(blocks.blocks_of(run)) == 1
    derive(run, "attractors")
    return run


def test_blocks_of__cover_each_point_once_in_order(copy, sizes):
    run = copy("run")
    for most in (8, 16, 24, 48, 96):
        sizes(most, most)
        points = [
            [(i, j) for i in range(*block["frequency"].indices(4)) for j in range(*block["amplitude"].indices(3))]
            for block in blocks.blocks_of(run)
        ]
        assert [point for one in points for point in one] == [(i, j) for i in range(4) for j in range(3)]
        assert max(map(len, points)) * 8 <= most


@pytest.mark.slow
@pytest.mark.parametrize(("where", "workers"), [("threads", 2), ("none", None), (None, 2)])
def test_in_blocks__same_bytes_for_all_blocks_and_workers(copy, sizes, whole, monkeypatch, where, workers):
    places, real = [], execute.run_tasks
    monkeypatch.setattr(execute, "run_tasks", lambda *a, **o: places.append(o["scheduler"]) or real(*a, **o))
    for bounds in (EACH_POINT, A_ROW):
        sizes(*bounds)
        run = copy(f"blocks{bounds[1]}")
        derive(run, "attractors", workers=workers, scheduler=where)
        for name in ("identified", "attractors"):
            assert files_of(run, name) == files_of(whole, name)
        assert not list((run.directory / "derived").glob("*.blocks"))
    assert {place.resolved() for place in places} == {where or "processes"}


FEWER = MAP.replace("num = 4", "num = 3").replace(
    "start = 0.1, stop = 0.5, num = 3", "start = 0.3, stop = 0.5, num = 2"
)
CHAOTIC = f"""{FEWER.replace("twin-well-periodic", "twin-well").replace("n_keep = 32", "n_keep = 256")}
[products]
lyapunov = {{ n_transient = 20, n_periods = 64 }}
"""
NOISY = (
    WELL.replace("stop = 199", "stop = 19")
    .replace("n_keep = 1000", "n_keep = 200")
    .replace(
        "parameters = { a = 1.0 }",
        "parameters = { a = 1.0 }\n"
        'classifier = { meaning = "side", words = { beyond = "x > 9", right = "x > 0.5", left = "x < -0.5" } }',
    )
)
OPTIONS = {
    "resilience": [{"directions": 4, "confirmations": 4, "phases": 1, "timed": 2}],
    "escapes": [{"high": {"x": 0.8}}, {}],
}
BY_POINT = [(name, given) for name, one in ANALYSES.items() if one.by_point for given in OPTIONS.get(name, [{}])]
NUMBERS = {"chaos": "attractor_lyapunov", "dimension": "correlation_dimension", "escapes": "barrier"}
"""A number of each result that is known only if the analysis has work to do."""


@pytest.fixture(scope="module")
def pairs(copied, tmp_path_factory):
    """Two copies of each run, whose attractors are found once: at once in the first, in blocks in the second."""

    @cache
    def make(text):
        folder = tmp_path_factory.mktemp("pair")
        return copied(folder, "one", text), copied(folder, "other", text)

    return make


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), BY_POINT)
def test_in_blocks__every_analysis_of_points(name, options, pairs, sizes):
    one, other = pairs(NOISY if ANALYSES[name].motions == ("noisy",) else CHAOTIC)
    assert len(blocks.blocks_of(one)) == 1
    found = derive(one, name, options, workers=0)
    if name in NUMBERS:
        assert np.isfinite(found[NUMBERS[name]].values).any()
    sizes(*A_ROW)
    assert len(blocks.blocks_of(other)) > 2
    derive(other, name, options, scheduler="none")
    assert files_of(other, name) == files_of(one, name)


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "threads"), [(0, 1), (1, 1), (3, 3)])
def test_derive__workers_are_threads_without_blocks(copy, monkeypatch, workers, threads):
    seen, real = [], analysis.attractors

    def attractors(*given):
        seen.append(number_of_threads())
        return real(*given)

    monkeypatch.setattr(analysis, "attractors", attractors)
    derive(copy("run"), "attractors", workers=workers)
    assert seen == [threads]


@pytest.mark.slow
def test_in_blocks__stopped_goes_on_to_the_same_bytes(copy, sizes, whole, monkeypatch):
    run, computed, real = copy("run"), [], blocks.compute_block
    sizes(*A_ROW)

    def stops(*args, **options):
        if len(computed) == 2:
            raise KeyboardInterrupt
        computed.append(args[-1])
        return real(*args, **options)

    monkeypatch.setattr(blocks, "compute_block", stops)
    with pytest.raises(InterruptedRunError, match="the same command continues"):
        derive(run, "identified", scheduler="none")
    (folder,) = (run.directory / "derived").glob("identified-*.blocks")
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npz", "000001.npz"]

    def goes_on(*args, **options):
        computed.append(args[-1])
        return real(*args, **options)

    monkeypatch.setattr(blocks, "compute_block", goes_on)
    content = bytearray((folder / "000001.npz").read_bytes())
    content[len(content) // 2] ^= 1  # damaged since
    (folder / "000001.npz").write_bytes(content)
    lines: list[str] = []
    derive(run, "identified", scheduler="none", echo=lines.append)
    assert computed == [0, 1, 1, 2, 3]
    assert "identified: 1 of 4 blocks done before" in lines
    assert files_of(run, "identified") == files_of(whole, "identified")
    assert not folder.exists()


def test_prune__removes_blocks_that_were_left(copy, sizes, monkeypatch):
    run = copy("run")
    (run.directory / "derived" / "identified-00000000.blocks" / "000000.npz").mkdir(parents=True)
    assert [path.rpartition("/")[2] for path in prune(run)] == ["identified-00000000.blocks"]
    assert not list((run.directory / "derived").iterdir())


@pytest.mark.slow
def test_run__analyse(main, write_spec):
    words = ("run", write_spec(MAP), "--out", "run", "--workers", 1, "--analyse")
    for names, said in (("attractor", "unknown analysis 'attractor'"), ("edge", "between: missing")):
        code, _, err = main(*words, names)
        assert code == 2
        assert said in err
    code, out, err = main(*words, " attractors,basins")
    assert code == 0, err
    assert "end on attractors" in out
    assert "boundaries: the starts are no grid" in out
