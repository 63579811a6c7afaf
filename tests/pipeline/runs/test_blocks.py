"""Analyses in blocks of parameter points or parts: the same bytes whatever the blocks and workers, stopped or not."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import xarray as xr
from distributed import LocalCluster

from magpend_core.engine.threads import number_of_threads
from pipeline.analysis.attractors import analysis
from pipeline.compute import execute
from pipeline.products.registry import ANALYSES, OWN
from pipeline.products.reporting import reporting
from pipeline.results.ragged import stacked
from pipeline.runs import blocks
from pipeline.runs.derive import AnalysedRun, derive, prune
from pipeline.runs.stopping import InterruptedRunError
from tests.pipeline.factories import LOOPBACK, WELL, contents

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
CHAOTIC_ROW = CHAOTIC.replace("frequency_hz = { start = 0.12, stop = 0.2, num = 3 }\n", "").replace(
    'preset = "twin-well"\n', 'preset = "twin-well"\nfrequency_hz = 0.12\n'
)
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


def test_analyses__are_divided_or_say_why_not():
    for name in {*OWN, "identified"} & set(ANALYSES):
        one = ANALYSES[name]
        assert [one.by_point, bool(one.parts), bool(one.whole)].count(True) == 1, name
        assert bool(one.parts) == bool(one.rows), name


def test_stacked__pads_to_the_longest():
    values = np.arange(12.0).reshape(4, 3)
    values[[0, 3], 2] = np.nan
    whole = xr.Dataset(
        {
            "point": (("row", "bin"), values, {"units": "m"}),
            "n": ("row", np.array([2, 3, 3, 2], np.int8)),
            "of": ("state", [7.0]),
        },
        coords={"where": ("row", ["a", "bcd", "e", "f"])},
        attrs={"title": "rows"},
    )
    parts = [whole.isel(row=[0], bin=slice(2)), whole.isel(row=[1, 2]), whole.isel(row=[3], bin=slice(2))]
    xr.testing.assert_identical(stacked(parts, "row"), whole)


AT = {"at": {"frequency_hz": 0.12, "amplitude": 0.3}}
PARTS = {
    "spectrum": {"averages": 3, "segment": 16},
    "manifolds": {**AT, "length": 0.5, "chord": 0.1, "starts": 60},
    "tangency": {**AT, "length": 0.5, "starts": 60, "parameter": "amplitude", "low": 0.3, "high": 0.31},
    "sensitivities": {"parameter": "amplitude", "deviation": {"damping": 0.01}},
    "bands": {"parameter": "amplitude", "posterior": "posterior.nc"},
    "phase": {"phases": 16},
    "orbit_ends": {"parameter": "frequency_hz", "second": "amplitude"},
    "set_ends": {"parameter": "a", "second": "b", "windows": 6},
}
BANDED = """
kind = "sweep"
model = "henon"
axes = { a = { values = [1.0, 1.04, 1.08, 1.12, 1.16, 1.2, 1.24, 1.28] }, b = { values = [0.28, 0.3] } }
initial_conditions = { kind = "random", n = 4, seed = 1, x = [-0.5, 0.5], y = [-0.2, 0.2] }
integration = { n_transient = 500, n_keep = 100 }
"""
CYCLES = """
kind = "sweep"
model.name = "hopf"
model.states = { x = {}, y = {} }
model.parameters = { a = 1.0 }
model.equations.x = "a*x - 3*y - (x*x + y*y)*x"
model.equations.y = "3*x + a*y - (x*x + y*y)*y"
section = { of = "y", value = 0.0, direction = "up", longest = 20.0 }
axes = { a = { values = [0.5, 0.75, 1.0] } }
initial_conditions = { kind = "list", points = [[0.3, 0.0], [1.2, 0.0]] }
integration = { n_transient = 10, n_keep = 4 }
"""


def test_divided__parts_are_in_blocks_of_some(copy, monkeypatch):
    run = copy("run")
    monkeypatch.setattr(blocks, "function_of", lambda name: lambda run, options: list(range(200)))
    for together, sizes in ((1, [4] * 50), (16, [16] * 12 + [8])):
        analysis = replace(ANALYSES["manifolds"], together=together)
        assert [len(part) for part in blocks.divided(run, analysis, None)] == sizes


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, one in ANALYSES.items() if one.parts])
def test_in_blocks__every_analysis_of_parts(name, pairs, monkeypatch, tmp_path):
    one, other = pairs({"bands": CHAOTIC_ROW, "phase": CYCLES, "set_ends": BANDED}.get(name, CHAOTIC))
    monkeypatch.chdir(tmp_path)
    draws = xr.Dataset({"value": (("draw", "parameter"), [[0.099], [0.1], [0.101]])}, {"parameter": ["damping"]})
    draws.assign_attrs(identified="damping").to_netcdf("posterior.nc", engine="scipy")
    monkeypatch.setattr(blocks, "WANTED", 1)
    derive(one, name, PARTS[name], workers=0)
    divided = blocks.divided

    def singly(run, analysis, options):
        found = divided(run, analysis, options)
        return [[part] for block in found for part in block] if analysis.parts else found

    monkeypatch.setattr(blocks, "divided", singly)
    found, real = [], blocks.compute_block
    monkeypatch.setattr(blocks, "compute_block", lambda *a, **o: found.append(a[-1]) or real(*a, **o))
    derive(other, name, PARTS[name], workers=0)
    assert len(found) > 2
    assert files_of(other, name) == files_of(one, name)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["none", "threads", "processes", "dask"])
def test_in_blocks__parts_anywhere(copy, whole, monkeypatch, where):
    monkeypatch.setattr(blocks, "WORTH_PROCESSES", -np.inf)
    derive(whole, "manifolds", PARTS["manifolds"], workers=0)
    run, lines = copy(where), []
    places, real = [], execute.run_tasks
    monkeypatch.setattr(execute, "run_tasks", lambda *a, **o: places.append(o["scheduler"]) or real(*a, **o))
    if where == "dask":
        with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **LOOPBACK) as cluster:
            derive(run, "manifolds", PARTS["manifolds"], scheduler=cluster.scheduler_address, echo=lines.append)
    else:
        place = None if where == "processes" else where
        derive(run, "manifolds", PARTS["manifolds"], workers=2, scheduler=place, echo=lines.append)
        assert places[-1].resolved() == where
    assert files_of(run, "manifolds") == files_of(whole, "manifolds")


@pytest.mark.slow
def test_in_blocks__progress_is_of_all_blocks(copy):
    run, heard = copy("run"), []
    with reporting(lambda what, done, total, expected_s=0.0: heard.append((what, done, total))):
        derive(run, "manifolds", PARTS["manifolds"], workers=0)
    n = heard[-1][2]
    assert n > 2
    assert [one for one in heard if "manifolds" in one[0]] == [("manifolds, blocks", k, n) for k in range(n + 1)]


KILLED = """
import os, signal, sys
from pipeline.runs import blocks
from pipeline.runs.derive import derive
real, written = blocks.write_block, []
def write(*given):
    real(*given)
    written.append(given[1])
    if len(written) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
blocks.write_block = write
derive(sys.argv[1], "manifolds", OPTIONS, scheduler="none")
"""


@pytest.mark.slow
def test_in_blocks__parts_after_a_kill(copy, whole):
    derive(whole, "manifolds", PARTS["manifolds"], workers=0)
    run, lines = copy("killed"), []
    script = KILLED.replace("OPTIONS", repr(PARTS["manifolds"]))
    assert subprocess.run([sys.executable, "-c", script, run.directory], check=False).returncode == -signal.SIGKILL
    (folder,) = (run.directory / "derived").glob("manifolds-*.blocks")
    assert len(list(folder.iterdir())) == 2
    derive(run, "manifolds", PARTS["manifolds"], workers=0, echo=lines.append)
    assert any(line.startswith("manifolds: 2 of ") for line in lines)
    assert files_of(run, "manifolds") == files_of(whole, "manifolds")
    assert not folder.exists()


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
    assert sorted(path.name for path in folder.iterdir()) == ["000000-of-4.npz", "000001-of-4.npz"]

    def goes_on(*args, **options):
        computed.append(args[-1])
        return real(*args, **options)

    monkeypatch.setattr(blocks, "compute_block", goes_on)
    content = bytearray((folder / "000001-of-4.npz").read_bytes())
    (folder / "000002-of-12.npz").write_bytes(content)  # by a magpend that divides the points otherwise
    content[len(content) // 2] ^= 1  # damaged since
    (folder / "000001-of-4.npz").write_bytes(content)
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
    assert "uncertainty exponent and Wada test: the starts are no grid" in out
