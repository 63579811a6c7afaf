"""Runs at single points beside a run: the bits of its cells, more starts, resumption, and what is refused."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from pipeline.compute.clients import Where
from pipeline.runs import beside
from pipeline.runs import run as running
from pipeline.runs.choices import Choices
from pipeline.runs.derive import AnalysedRun, derive
from pipeline.runs.run import carry_out_all
from pipeline.specification.problems import SpecError
from pipeline.store.errors import RefusedError
from tests.pipeline.factories import LOOPBACK, duffing, quietly, silent

MAP = """
kind = "sweep"
model.name = "sheared"
model.kind = "map"
model.states = { x = {}, y = {} }
model.parameters = { r = 3.2, e = 0.0, d = 0.1 }
model.equations = { x = "r*x*(1 - x) + e + d*y", y = "d*x" }
axes = { r = { values = [2.8, 3.1, 3.4] }, e = { start = 0.0, stop = 0.03, num = 4 } }
integration = { n_transient = 20, n_keep = 4 }
products = { lyapunov = {} }
execution = { trajectories_per_task = 16 }
initial_conditions = STARTS
smoke = { integration.n_transient = 2 }
"""
RANDOM = '{ kind = "random", n = 6, seed = 3, x = [0.2, 0.8], y = 0.1 }'
AT = {"r": 3.1, "e": 0.02}


def run_of(folder, starts=RANDOM, text=MAP, **options):
    """Run a specification, and open the run for analyses in this thread."""
    quietly(tomllib.loads(text.replace("STARTS", starts)), folder / "run", **options)
    return AnalysedRun.of(folder / "run", silent, workers=0)


@pytest.fixture
def run(tmp_path):
    return run_of(tmp_path)


@pytest.fixture
def alone(monkeypatch):
    """Copy no cells from other runs."""
    monkeypatch.setattr(beside, "_sources", lambda *words: [])


def assert_same_cells(here, own):
    """All variables of a point's run have the bits of those of the run at this point, at its starts."""
    assert here.sizes == own.sizes
    assert int((here["status"] > 0).sum()) == here["status"].size
    for name in here.data_vars:
        assert here[name].dtype == own[name].dtype
        assert here[name].values.tobytes() == own[name].values.tobytes(), name


# ---- cells ------------------------------------------------------------------------------------


def test_cells__are_those_of_the_run(run, tmp_path, bytes_of, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(beside, "_sources", lambda *words: [])
        (integrated,) = run.at_points([AT], 9)
    cube, own = integrated.cube().isel(r=0, e=0), run.cube().sel(AT)
    assert cube.sizes["initial_condition"] == 9
    assert_same_cells(cube.isel(initial_condition=slice(6)), own[list(cube.data_vars)])
    assert cube["x_0"].values[:6].tolist() == own["x_0"].values.tolist()
    assert integrated.directory == tmp_path / "run-points" / "r=3.1,e=0.02,n=9"
    before = bytes_of(integrated.directory)
    shutil.rmtree(tmp_path / "run-points")
    (copied,) = run.at_points([AT], 9)
    assert bytes_of(copied.directory) == before
    assert '"reused": 6' in (copied.directory / "timings.jsonl").read_text()
    (more,) = run.at_points([AT], 12)
    assert '"reused": 9' in (more.directory / "timings.jsonl").read_text()


def test_specification__differs_in_point_starts_products_and_tasks(run):
    (one,) = run.at_points([{"r": 3, "e": 0.015}], [7])
    found, own = one.spec.as_dict(), run.spec.as_dict()
    assert found.pop("axes") == {"r": {"values": [3.0]}, "e": {"values": [0.015]}}
    assert found.pop("initial_conditions") == {**own["initial_conditions"], "n": 7}
    assert found.pop("products") == found.pop("execution") == {}
    assert found == {name: own[name] for name in found}
    assert own.keys() - found.keys() == {"axes", "initial_conditions", "products", "execution"}


def test_points__of_a_smoke_run_are_as_short(tmp_path):
    (one,) = run_of(tmp_path, smoke=True).at_points([AT], 7)
    assert one.spec.integration.n_transient == 2


KINDS = {
    "random": (RANDOM, 20),
    "sobol": (RANDOM.replace("seed", 'sampling = "sobol", seed'), 20),
    "counted from a parameter": (RANDOM.replace("seed", 'origin = { x = "0.1*r" }, seed'), 20),
    "a grid": ('{ kind = "grid", x = { start = 0.2, stop = 0.8, num = 4 }, y = { values = [0.1, 0.3] } }', 7 * 3),
    "a step": ('{ kind = "grid", x = { start = 0.2, stop = 0.85, step = 0.1 }, y = 0.1 }', 6 * 4 + 1),
    "values": ('{ kind = "grid", x = { values = [0.2, 0.3, 0.7] }, y = { values = [0.1] } }', 2 * 10 + 1),
}


@pytest.mark.parametrize("kind", KINDS)
def test_starts__contain_those_of_the_run(tmp_path, kind, alone):
    starts, n = KINDS[kind]
    run = run_of(tmp_path, starts)
    (one,) = run.at_points([AT], 20)
    cube, own = one.cube().isel(r=0, e=0), run.cube().sel(AT)
    assert cube["status"].size == n
    assert one.name.endswith(f",n={n}")
    for dim in [name for name in cube["status"].dims if name != "initial_condition"]:
        steps, places = np.arange(cube.sizes[dim]), np.linspace(0, cube.sizes[dim] - 1, own.sizes[dim])
        assert np.allclose(cube[dim], np.interp(steps, places, own[dim]), rtol=1e-14)
    if "initial_condition" in cube.dims:
        same = cube.isel(initial_condition=slice(6))
    else:
        same = cube.sel({dim: own[dim].values for dim in own["status"].dims})
    assert_same_cells(same, own[list(cube.data_vars)])


def test_starts__of_a_latin_hypercube_are_others(tmp_path):
    run = run_of(tmp_path, RANDOM.replace("seed", 'sampling = "latin-hypercube", seed'))
    few, many = (one.cube()["x_0"].values for one in run.at_points([AT, AT], [6, 12]))
    assert few.tolist() == run.cube()["x_0"].values.tolist()
    assert not np.isin(few, many).any()
    # one in each twelfth of the interval
    assert sorted(((many - 0.2) / 0.05).astype(int)) == list(range(12))


@pytest.mark.parametrize("word", ["frequency_hz", "omega", "period"])
def test_frequency__in_any_word(tmp_path, word, alone):
    """A frequency of the cube is the axis' own value, even if converted back it is another; others are converted."""
    ranges = {"frequency_hz": "0.15, stop = 0.25", "omega": "1.3, stop = 1.6", "period": "5.98, stop = 6.04"}
    axes = f"{word} = {{ start = {ranges[word]}, num = 4 }}\namplitude = {{ values = [0.2, 0.3] }}"
    run = run_of(tmp_path, text=duffing(axes, 'kind = "random"\nn = 3\nx = [-1.0, 1.0]'))
    own, given = run.cube(), run.spec.axes["frequency_hz"].given()
    for hertz in own["frequency"].values:
        (one,) = run.at_points([{"frequency": hertz, "amplitude": 0.3}], 5)
        (value,) = one.spec.axes["frequency_hz"].given()
        assert value in given
        assert one.directory.name == f"{word}={float(value)!r},amplitude=0.3,n=5"
        cube = one.cube().isel(frequency=0, amplitude=0)
        assert float(cube["frequency"]) == hertz
        same = cube.isel(initial_condition=slice(3))
        assert_same_cells(same, own.sel(frequency=hertz, amplitude=0.3)[list(cube.data_vars)])
    told = {"frequency_hz": 0.2, "omega": 1.23, "period": 4.5}
    (one,) = run.at_points([{word: told[word], "amplitude": 0.25}], 2)
    assert one.directory.name == f"{word}={told[word]},amplitude=0.25,n=2"
    (same,) = run.at_points([{"omega": 2.0 * np.pi / 4.5, "amplitude": 0.25}], 2)
    assert np.isclose(float(same.cube()["frequency"][0]), 1.0 / 4.5, rtol=1e-15)


# ---- several points ---------------------------------------------------------------------------

FOUR = [AT, {"e": 0.015, "r": 3.0}, {"r": 3.4, "e": 0.0}, AT]
COUNTS = [9, 8, 40, 9]


def test_points__each_with_its_starts(run, monkeypatch):
    found = run.at_points(FOUR, COUNTS)
    assert [one.cube()["status"].size for one in found] == COUNTS
    assert [(float(one.cube()["r"][0]), float(one.cube()["e"][0])) for one in found] == [
        (point["r"], point["e"]) for point in FOUR
    ]
    assert found[0].directory == found[3].directory
    monkeypatch.setattr(beside, "carry_out_all", None)  # complete ones are opened
    assert [one.digest for one in run.at_points(FOUR, COUNTS)] == [one.digest for one in found]


@pytest.mark.parametrize("n_finished", [0, 1, 2])
def test_points__go_on_after_a_kill(run, tmp_path, bytes_of, monkeypatch, n_finished):
    whole = {one.directory: bytes_of(one.directory) for one in run.at_points(FOUR, COUNTS)}
    shutil.rmtree(tmp_path / "run-points")
    logged = []

    def log(info, entry):
        if len(logged) == n_finished:
            raise SystemExit
        logged.append(entry)

    with monkeypatch.context() as patch:
        patch.setattr(running, "log_timing", log)
        with pytest.raises(SystemExit):
            run.at_points(FOUR, COUNTS)
    assert len(list((tmp_path / "run-points").glob("*/commits/*.json"))) == n_finished + 1
    assert {one.directory: bytes_of(one.directory) for one in run.at_points(FOUR, COUNTS)} == whole


@pytest.mark.parametrize("lost", ["run.json", "commits/000000.json", "cube.zarr/section", "cube.zarr/x_0"])
def test_points__damaged_ones_are_completed(run, bytes_of, lost):
    (one,) = run.at_points([AT], 9)
    before = bytes_of(one.directory)
    place = one.directory / lost
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    (again,) = run.at_points([AT], 9)
    assert bytes_of(again.directory) == before


def test_points__share_the_workers(tmp_path, bytes_of, monkeypatch):
    """Two threads, or processes, compute all points at one time, with the same bytes."""
    run = run_of(tmp_path)
    before = {one.directory: bytes_of(one.directory) for one in run.at_points(FOUR, COUNTS)}
    calls = []
    monkeypatch.setattr(
        beside, "carry_out_all", lambda works, **how: (calls.append(works), carry_out_all(works, **how))
    )
    shutil.rmtree(tmp_path / "run-points")
    found = AnalysedRun.of(run, silent, workers=2).at_points(FOUR, COUNTS)
    assert {one.directory: bytes_of(one.directory) for one in found} == before
    assert [len(works) for works in calls] == [3]


@pytest.mark.slow
def test_points__on_processes_and_dask(tmp_path, bytes_of):
    from distributed import LocalCluster

    run = run_of(tmp_path)
    before = {one.directory: bytes_of(one.directory) for one in run.at_points(FOUR, COUNTS)}
    with LocalCluster(n_workers=2, threads_per_worker=1, **LOOPBACK) as cluster:
        for scheduler in ("processes", cluster.scheduler_address):
            shutil.rmtree(tmp_path / "run-points")
            there = AnalysedRun.of(run, silent, where=Where.of(scheduler))
            assert {one.directory: bytes_of(one.directory) for one in there.at_points(FOUR, COUNTS)} == before


def test_attractors__are_found_as_those_of_the_run(run):
    derive(run, "attractors", {"polish": False}, echo=silent)
    (one,) = run.at_points([AT], 9)
    assert Choices.of(one) == Choices.of(run)
    assert one.derive("attractors").attrs["derived_options"] == run.derive("attractors").attrs["derived_options"]


# ---- errors -----------------------------------------------------------------------------------

LIST = '{ kind = "list", points = [[0.3, 0.1], [0.6, 0.1]] }'
STATE = '{ kind = "grid", x = 0.3, y = { values = [0.1] } }'


@pytest.mark.parametrize(("starts", "n", "what"), [(LIST, 2, "a list of 2"), (STATE, 1, "one state")])
def test_starts__that_cannot_be_more(tmp_path, starts, n, what):
    run = run_of(tmp_path, starts)
    (one,) = run.at_points([{"r": 3.0, "e": 0.001}], n)
    assert one.cube()["status"].size == n
    with pytest.raises(SpecError) as caught:
        run.at_points([AT], 300)
    assert str(caught.value) == (
        f"{run.name}: initial_conditions: 300 starts at a point are wanted, and {what} gives no more; begin a run with "
        'random starts (kind = "random") or with a range of a state.'
    )


def test_continuation__has_no_single_points(tmp_path):
    text = MAP.replace('"sweep"', '"continuation"\ncontinuation = { path = "r" }')
    run = run_of(tmp_path, text=text)
    with pytest.raises(
        SpecError, match=r"neighbours end, and has no cells of one point alone; begin a run with kind ="
    ):
        run.at_points([AT], 6)


@pytest.mark.parametrize(
    ("point", "told"),
    [
        ({"r": 3.1}, "r = 3.1"),
        ({}, "no value"),
        ({**AT, "d": 0.2}, "r = 3.1, e = 0.02, d = 0.2"),
        ({"r": 3.1, "omega": 1.0}, "r = 3.1, omega = 1.0"),
    ],
)
def test_points__without_a_value_for_each_axis(run, point, told):
    with pytest.raises(SpecError, match=rf"run: a point has {told}; give one value for each of r, e\."):
        run.at_points([point], 6)
    assert not Path(f"{run.name}-points").exists()


def test_points__with_a_value_out_of_bounds(run):
    with pytest.raises(SpecError, match=r"axes\.r\.values"):
        run.at_points([{"r": np.nan, "e": 0.0}], 6)
    with pytest.raises(SpecError, match=r"initial_conditions\.n = 0"):
        run.at_points([AT], 0)


def test_points__of_another_run_are_refused(run, tmp_path):
    (one,) = run.at_points([AT], 9)
    shutil.rmtree(run.directory)
    other = run_of(tmp_path, RANDOM.replace("seed = 3", "seed = 4"))
    with pytest.raises(RefusedError) as caught:
        other.at_points([AT], 9)
    assert str(caught.value).startswith(
        f"{one.directory}: exists, and is not {other.name} at this point; move it away."
    )
    assert "initial_conditions.seed" in str(caught.value)
