"""Analysis products: what is computed again and what is not, damage, concurrent writers."""

from __future__ import annotations

import ast
import json
import multiprocessing
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from pipeline.products.product import Analysis, Options, option
from pipeline.products.registry import ANALYSES
from pipeline.runs import blocks, versions
from pipeline.runs import derive as deriving
from pipeline.runs.derive import AnalysedRun, derive
from pipeline.store.commits import withdraw
from pipeline.store.errors import DamagedError
from pipeline.store.run import RunDirectory

QUICK = {"polish": False, "extend": False}


class MeanOptions(Options):
    """Of an analysis for these tests."""

    a: int = option(1, "A number.", ge=0)


def register(patch, compute):
    """Put an analysis named ``mean`` beside the others, computed by a function."""
    mean = Analysis("mean", "A mean.", MeanOptions, compute="tests:mean", table="tests:none")
    real, version = deriving.function_of, versions.version_of
    for module in (deriving, blocks):
        patch.setattr(module, "function_of", lambda name: compute if name == "tests:mean" else real(name))
    for module in (deriving, versions):
        patch.setattr(module, "ANALYSES", {**ANALYSES, "mean": mean})
    patch.setattr(versions, "version_of", lambda name: "test" if name == "mean" else version(name))
    return compute


@pytest.fixture
def compute(monkeypatch):
    """The function of the analysis ``mean``: counts its calls."""
    return register(monkeypatch, Counted())


class Counted:
    """An analysis that counts its calls."""

    def __init__(self):
        self.calls = 0

    def __call__(self, run, options):
        self.calls += 1
        ds = run.cube()
        words = ("row", ["left", "right", "left"], {"long_name": "words"})
        return xr.Dataset(
            {
                "mean": (("frequency",), ds["section"].mean(set(ds["section"].dims) - {"frequency"}).values),
                "seen": ((), bool((ds["status"] > 0).any())),
                "none": (("empty", "frequency"), np.zeros((0, ds.sizes["frequency"]), np.int16)),
                "by_link": ("link", np.array([np.nan, 1.0]), {"flag_values": np.arange(2, dtype=np.int8)}),
            },
            coords={"frequency": ds["frequency"], "link": ds["link"], "row": words, "fixed": 2.5},
            attrs={"parameters": ds.attrs["parameters"], "number": np.float64(0.1)},
        )


def products(made, name="mean"):
    return sorted((made.info.directory / "derived").glob(f"{name}-*.zarr"))


@pytest.mark.slow
def test_derive__returns_what_was_computed_and_keeps_it_as_plain_zarr(whole, compute):
    said = []
    expected = compute(RunDirectory.open(whole.info.directory), MeanOptions())
    first = derive(whole.info.directory, "mean", {"a": 1}, echo=said.append)
    xr.testing.assert_identical(first, derive(whole.info.directory, "mean", echo=said.append))
    assert compute.calls == 2  # the first of them here
    assert "computed in" in said[0]
    assert "taken from" in said[1]
    for name in expected.variables:
        np.testing.assert_array_equal(first[name].values, expected[name].values)
        assert (first[name].dtype.kind, first[name].dims) == (expected[name].dtype.kind, expected[name].dims)
    assert first["by_link"].attrs["flag_values"].tolist() == [0, 1]
    assert first.attrs["number"] == 0.1
    (path,) = products(whole)
    assert first.encoding["source"] == str(path)
    ds = xr.open_zarr(path, consolidated=False)
    assert json.loads(ds.attrs["derived_options"]) == {"a": 1}
    assert [ds["row"].attrs["words"][code] for code in ds["row"].values] == ["left", "right", "left"]


@pytest.mark.slow
def test_derive__other_options_cells_and_code_compute_again(made, compute, monkeypatch):
    made.commit(0)
    directory = made.info.directory
    before = derive(directory, "mean", {"a": 1})
    derive(directory, "mean", {"a": 2})
    assert compute.calls == 2
    made.commit(1)
    after = derive(directory, "mean", {"a": 1})
    assert compute.calls == 3
    assert not after["mean"].equals(before["mean"])
    assert len(products(made)) == 3
    withdraw(made.info, ["000001.json"])
    xr.testing.assert_identical(derive(directory, "mean", {"a": 1}), before)
    assert compute.calls == 3
    monkeypatch.setattr(versions, "version_of", lambda name: "another")
    derive(directory, "mean", {"a": 1})
    assert compute.calls == 4


def test_builds_on__is_what_the_code_derives():
    """Every analysis that a function derives is declared, so that an edit of it is seen."""
    for name, analysis in ANALYSES.items():
        module, _, function = analysis.compute.partition(":")
        tree = ast.parse(Path(find_spec(module).origin).read_text())
        (body,) = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
        derived = {
            node.args[0].value
            for node in ast.walk(body)
            if isinstance(node, ast.Call)
            and getattr(node.func, "attr", "") == "derive"
            and isinstance(node.args[0], ast.Constant)
        }
        assert derived <= set(analysis.builds_on), name


def test_run__does_not_see_later_commits(made):
    made.commit(0)
    run = AnalysedRun.of(made.info.directory)
    made.commit(1)
    assert int((run.cube()["status"] > 0).sum()) == made.plan.cells_in(0)
    assert int((RunDirectory.open(made.info.directory).cube()["status"] > 0).sum()) > made.plan.cells_in(0)


def flip(path: Path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["flipped", "metadata gone", "more"])
def test_derive__damage_is_said_and_mended(whole, compute, harm):
    said = []
    first = derive(whole.info.directory, "mean")
    (path,) = products(whole)
    if harm == "flipped":
        flip(path / "mean" / "c.0")
    elif harm == "more":
        (path / "more").write_text("")
    else:
        (path / "zarr.json").unlink()
    again = derive(whole.info.directory, "mean", echo=said.append)
    assert "damaged" in said[0]
    xr.testing.assert_identical(again, first)
    xr.testing.assert_identical(derive(whole.info.directory, "mean"), first)
    assert compute.calls == 2
    assert len(list((whole.info.directory / "derived").iterdir())) == 1


def test_derive__a_damaged_cube_is_no_result(whole, compute):
    chunk = next((whole.info.directory / "cube.zarr" / "section").glob("c.*"))
    flip(chunk)
    with pytest.raises(DamagedError, match="magpend verify"):
        derive(whole.info.directory, "mean")
    assert not products(whole)


def test_derive__an_error_leaves_nothing(whole, monkeypatch):
    register(monkeypatch, lambda run, options: xr.Dataset({"a": ("x", np.array([object()], dtype=object))}))
    with pytest.raises(TypeError, match="a: objects other than texts"):
        derive(whole.info.directory, "mean")
    assert not any((whole.info.directory / "derived").iterdir())


def _write_often(directory, barrier, n):
    register(pytest.MonkeyPatch(), Counted())
    for i in range(n):
        barrier.wait()
        derive(directory, "mean", {"a": i})


@pytest.mark.slow
def test_derive__writers_at_once(whole, compute):
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(2)
    writers = [context.Process(target=_write_often, args=(whole.info.directory, barrier, 5)) for _ in range(2)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [w.exitcode for w in writers] == [0, 0]
    assert len(products(whole)) == len(list((whole.info.directory / "derived").iterdir())) == 5
    for i in range(5):
        derive(whole.info.directory, "mean", {"a": i})
    assert compute.calls == 0


@pytest.mark.slow
def test_attractors__matching_again_identifies_nothing_again(whole):
    said = []
    found = derive(whole.info.directory, "attractors", {**QUICK}, echo=said.append)
    assert found.attrs["matched"] == 1
    assert found["state"].values.tolist() == ["psi1", "psi2", "psi1_dot", "psi2_dot"]
    defaults = {"threshold": 0.3, "look_back": 3, "n_sample": 24, "n_points": 64.0}
    same = derive(whole.info.directory, "attractors", {**defaults, **QUICK})
    assert same.encoding["source"] == found.encoding["source"]
    again = derive(whole.info.directory, "attractors", {"threshold": 0.2, **QUICK}, echo=said.append)
    (identified,) = products(whole, "identified")
    assert [line for line in said if "taken from" in line] == [f"identified: taken from {identified}"]
    assert again.attrs["match_threshold"] == 0.2
    assert len(products(whole, "attractors")) == 2


@pytest.mark.slow
def test_attractors__options_hold_for_the_run(whole):
    """Options last given hold without being given again, and results that rest on other attractors are stale."""
    directory = whole.info.directory
    first = derive(directory, "attractors", {**QUICK})
    settling = derive(directory, "settling")
    assert derive(directory, "attractors").encoding["source"] == first.encoding["source"]
    other = derive(directory, "attractors", {**QUICK, "n_points": 8})
    assert derive(directory, "attractors").encoding["source"] == other.encoding["source"]
    assert deriving.stored(directory, "attractors").encoding["source"] == other.encoding["source"]
    assert settling.encoding["source"] in deriving.stale(directory)
    assert deriving.stored(directory, "settling") is None
    again = derive(directory, "settling")
    assert again.encoding["source"] != settling.encoding["source"]
    derive(directory, "attractors", {**QUICK})
    assert deriving.stored(directory, "settling").encoding["source"] == settling.encoding["source"]


def test_attractors__options_that_cannot_be_read(whole):
    (whole.info.directory / "derived").mkdir(exist_ok=True)
    (whole.info.directory / "derived" / "chosen.json").write_text('{"attractors": {"budget": "much"}}')
    with pytest.raises(DamagedError, match=r"chosen\.json is damaged; remove it"):
        derive(whole.info.directory, "settling")
