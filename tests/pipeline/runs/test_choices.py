"""The options of a run's attractors and branches, on which all else rests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import magpend
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.runs.choices import branches_in_words
from pipeline.runs.derive import AnalysedRun, derive, prepared, shown_table, stale, stored
from pipeline.specification.problems import SpecError
from pipeline.store.errors import DamagedError
from tests.pipeline.factories import finished

MAP = """
kind = "sweep"
model.name = "parabola"
model.kind = "map"
model.states = { x = {} }
model.parameters = { r = 3.2, e = 0.0 }
model.equations = { x = "r*x*(1 - x) + e" }
axes = { r = { start = 2.801, stop = 3.199, num = 5 } }
initial_conditions = { kind = "list", points = [[0.4]] }
integration = { n_transient = 500, n_keep = 4 }
"""
"""Its fixed point doubles at r = 3."""

FEW = {"generations": 0, "max_period": 1}


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = finished(tmp_path_factory.mktemp("map") / "run", MAP)
    derive(directory, "branches", FEW)
    derive(directory, "sensitivities")
    return directory


@pytest.fixture
def run(computed: Path, tmp_path: Path) -> magpend.Run:
    """A copy of the run, which has the branches of its original."""
    shutil.copytree(computed, tmp_path / "run")
    return magpend.Run.open(tmp_path / "run")


def folder_of(ds):
    return Path(ds.encoding["source"]).name


def test_branches__hold_for_the_run(run):
    """A copy has them without being asked; results that rest on them are stale while there are others."""
    first, rests = run.branches(), run.sensitivities()
    assert json.loads(first.attrs["derived_options"])["max_period"] == 1
    assert json.loads(rests.attrs["branch_options"]) == {"r": FEW}
    assert stale(run) == []
    derive(run, "branches", {**FEW, "low": 3.05})
    assert stored(run, "sensitivities") is None
    assert [Path(path).name for path in stale(run)] == [folder_of(rests)]
    assert run.sensitivities().sizes["bifurcation"] == 0
    assert derive(run, "branches", FEW).encoding["source"] == first.encoding["source"]
    assert folder_of(stored(run, "sensitivities")) == folder_of(rests)
    assert folder_of(stored(run, "branches")) == folder_of(first)


def test_branches__a_default_that_is_given_leads_back_to_the_defaults(run):
    derive(run, "branches", {"generations": 3})
    assert json.loads(run.sensitivities().attrs["branch_options"]) == {}


def test_branches__each_parameter_has_its_own(run):
    with pytest.raises(SpecError, match="does not sweep e; give the interval"):
        run.sensitivities(parameter="e")
    run.branches(parameter="e", low=0.0, high=0.05, **FEW)
    assert run.sensitivities().sizes["bifurcation"] == 1
    assert stale(run) == []
    along = run.sensitivities(parameter="e")
    assert json.loads(along.attrs["branch_options"]) == {"e": {"low": 0.0, "high": 0.05, **FEW}}
    assert stored(run, "branches").attrs["parameter"] == "r"


def test_branches__of_an_analysis_alone_change_nothing(run):
    opened = AnalysedRun.of(run)
    assert opened.derive("branches", low=3.05, **FEW).sizes["bifurcation"] == 0
    assert opened.derive("branches").sizes["bifurcation"] == 1
    assert stale(run) == []


def test_branches__are_named_by_tables_that_rest_on_them(run):
    *_, last = shown_table("sensitivities", run.sensitivities()).lines
    assert last == "on branches along r, found with --period 1 --generations 0"
    told = []
    derive(run, "branches", echo=told.append)
    assert told[0] == "branches along r, found with --period 1 --generations 0"
    changed = json.dumps({"frequency_hz": {"low": 0.25, "high": 0.5, "start": {"x": 1.0, "frequency_hz": 0.4}}})
    assert branches_in_words(changed, "period") == [
        "branches along period, found with --start x=1 --start period=2.5 --from 2 --to 4"
    ]
    assert branches_in_words("{}", "period") == []


def test_branches__are_no_options_of_others():
    """What rests on branches names their parameter; a backbone also has an interval of its own."""
    own = {"backbone": {"low", "high"}}
    options = {"low", "high", "max_period", "generations", "isolas", "recurrences", "stable", "all_equilibria", "start"}
    for registry in (ANALYSES, FIGURES):
        for name, product in registry.items():
            if "branches" in getattr(product, "builds_on", ()) or name in ("branches", "multipliers", "genealogy"):
                left = options & set(product.options.model_fields)
                assert (left == options) if product is ANALYSES["branches"] else left <= own.get(name, set()), name


def test_branches__of_a_run_beside_are_those_of_the_run(run):
    finer = AnalysedRun.of(run, workers=0).with_values([2.85])
    assert finer.cube().sizes["r"] == 6
    assert finer.branch_options("r") == AnalysedRun.of(run).branch_options("r")
    assert prepared(finer, ANALYSES["branches"], ANALYSES["branches"].options()).max_period == 1


def test_choices__that_cannot_be_read(run):
    (run.info.directory / "derived" / "chosen.json").write_text('{"branches": {"r": {"low": "much"}}}')
    with pytest.raises(DamagedError, match=r"chosen\.json is damaged; remove it"):
        run.sensitivities()
