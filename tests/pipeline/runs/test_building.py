"""Specifications built in Python: the same runs as their TOML texts, and all problems at once."""

from __future__ import annotations

import inspect
import tomllib
from pathlib import Path

import numpy as np
import pytest

import magpend
from pipeline.layout.plan import make_plan
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.files import shipped_workflows
from pipeline.specification.parsing import KEYS
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.starts import start_remarks
from tests.pipeline.factories import silent

EQUATIONS = "x' = v\nv' = -k*x - 0.2*v + A*cos(2*pi*f*t)"
TEXT = """
kind = "sweep"
title = "forces"
[parameters]
frequency_hz = 0.2
[axes]
A = { start = 0.1, stop = 0.3, num = 3 }
k = { values = [1.0, 1.5] }
[initial_conditions]
kind = "grid"
x = { start = -1.0, stop = 1.0, num = 4 }
v = 0.5
[integration]
n_transient = 20
n_keep = 4
[products]
extremes = { quantities = ["x"] }
[smoke]
"integration.n_keep" = 2
[model]
name = "oscillator"
states = { x = "m", v = "m/s" }
parameters = { k = 1.0, A = 0.5 }
equations = { x = "v", v = "-k*x - 0.2*v + A*cos(2*pi*f*t)" }
"""


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda s: s.with_parameters(A=0.4), r"parameters\.A: .* is given by overrides=\{'A': 0\.4\}"),
        (lambda s: s.with_parameters(overides={}), r"parameters\.overides: unknown key; did you mean overrides or"),
        (
            lambda s: s.with_integration(n_transients=4),
            r"integration\.n_transients: unknown key; did you mean n_transient",
        ),
        (lambda s: s.with_axis("A", stap=0.3), r"axis\.stap: unknown key; did you mean st"),
        (lambda s: type(s)("sweep", intergation={}), r"^Spec\.intergation: unknown key; did you mean integration or"),
        (lambda s: s.with_extremes(quantites=["x"]), r"products\.extremes\.quantites: unknown key; did you mean q"),
        (lambda s: s.with_extremes(), r"^products\.extremes\.quantities: missing; add quantities=\.\.\.$"),
        (lambda s: s.with_lyapunov(800), r"^products\.lyapunov: 800 has no key; give values by name, as in n_exp"),
        (lambda s: s.with_drift(), r"^drift\.name: missing; add name=\.\.\.$"),
    ],
)
def test_methods__say_what_is_right_for_a_wrong_argument(wrong, message):
    with pytest.raises(TypeError, match=message):
        wrong(magpend.Spec("sweep"))


@pytest.mark.slow
def test_starts__that_are_not_given_are_said_by_run_and_preview(tmp_path):
    spec = magpend.Spec("sweep", "duffing").with_parameters(frequency_hz=0.2).with_integration(n_transient=2, n_keep=2)
    for starts, left in (
        (spec.with_start_grid(x=(-1.0, 1.0, 2)), ["v"]),
        (spec.with_start_grid(x=(-1.0, 1.0, 2), v=0.0), []),
        (spec.with_start_random(n=3, v=(-1.0, 1.0)), ["x"]),
        (spec.with_start_list([[1.0], [2.0]]), ["v"]),
    ):
        lines = start_remarks(Spec.read(starts).initial_conditions)
        assert [line.partition(": ")[2][0] for line in lines if line.startswith("starts not given")] == left
    spec, told = spec.with_start_grid(x=(-1.0, 1.0, 2)).with_axis("amplitude", 0.1, 0.2, 2), []
    magpend.run(spec, tmp_path / "run", workers=0, echo=told.append)
    for lines in (told, repr(magpend.preview(spec, tmp_path / "other")).splitlines()):
        assert sum(line.startswith("starts not given, so taken as 0: v = 0") for line in lines) == 1


def oscillator():
    return magpend.model(EQUATIONS, name="oscillator", states={"x": "m", "v": "m/s"}, k=1.0, A=0.5)


def built():
    return (
        magpend.Spec("sweep", oscillator(), "forces")
        .with_parameters(frequency_hz=0.2)
        .with_axis("A", 0.1, 0.3, 3)
        .with_axis("k", values=np.array([1.0, 1.5]))
        .with_start_grid(x=(-1, 1, 4), v=0.5)
        .with_integration(n_transient=20)
        .with_integration(n_keep=np.int64(4))
        .with_extremes(quantities=["x"])
        .with_smoke({"integration.n_keep": 2})
    )


def identity(spec):
    return make_plan(spec).identity


def same_run(spec, text):
    return identity(Spec.read(spec)) == identity(Spec.read(text))


def test_model__is_that_of_the_toml_text():
    of_text = magpend.load_model(TEXT)
    assert oscillator() is of_text
    assert oscillator().digest == of_text.digest
    assert magpend.model("duffing") is magpend.load_model("duffing")
    assert magpend.model({"x": "v", "v": "-x"}) is magpend.model("x' = v\nv' = -x")
    lines = repr(oscillator()).splitlines()
    assert lines[0] == "model oscillator"
    assert lines[-2:] == ["  x' = v", "  v' = -k*x - 0.2*v + A*cos(2*pi*f*t)"]


def test_model__refuses_keywords_for_a_model_that_is_given(tmp_path):
    with pytest.raises(SpecError, match=r"amplitude=\.\.\..*keywords belong to equations.*\.load\(NAME=VALUE\)"):
        magpend.model("duffing", amplitude=0.3)
    (tmp_path / "m.toml").write_text(TEXT, "utf-8")
    assert magpend.model(tmp_path / "m.toml") is oscillator()
    with pytest.warns(UserWarning, match="c: nothing uses it"):
        magpend.model("x' = -x", c=1.0)


def test_spec__is_the_run_of_its_toml_text(tmp_path):
    spec = built()
    assert same_run(spec, TEXT)
    assert same_run(spec.toml(), TEXT)
    assert identity(Spec.read(spec.save(tmp_path / "spec.toml"))) == identity(Spec.read(spec))
    assert identity(Spec.read(spec, smoke=True)) == identity(Spec.read(TEXT, smoke=True))
    assert magpend.Spec.read(spec.toml()) == spec
    assert magpend.Spec.read(TEXT).tables["axes"] == tomllib.loads(TEXT)["axes"]
    assert Spec.read(spec).directory == Spec.read(spec.toml()).directory == Spec.read(spec.tables).directory
    assert not same_run(spec.with_axis("A", 0.1, 0.4, 3), TEXT)
    tables = {key: value for key, value in spec.tables.items() if key != "model"}
    assert magpend.Spec(**tables, model=oscillator()) == spec


def test_spec__is_not_changed_by_its_methods():
    spec = built()
    before = spec.toml()
    spec.with_integration(n_keep=1).with_axis("A", 0, 1, 2).with_start_list([[0.0, 0.0]]).with_lyapunov(n_exponents=1)
    assert spec.toml() == before
    assert spec.with_start_list([[0.0, 0.0]]).tables["initial_conditions"] == {"kind": "list", "points": [[0.0, 0.0]]}
    assert spec.with_lyapunov().tables["products"] == {"extremes": {"quantities": ["x"]}, "lyapunov": {}}


def test_products__can_be_asked_for_by_name_or_by_their_methods():
    spec = built().with_products(lyapunov={"n_periods": 64}).with_products(rotation={}, lyapunov={"n_blocks": 4})
    same = built().with_lyapunov(n_periods=64).with_lyapunov(n_blocks=4).with_rotation()
    assert spec.tables["products"] == same.tables["products"]
    assert set(spec.products) == set(CELL_PRODUCTS)
    assert all(hasattr(Spec, f"with_{name}") for name in CELL_PRODUCTS)


@pytest.mark.parametrize(
    ("products", "message"),
    [
        ({"lyapunof": {}}, "products.lyapunof: unknown key; did you mean lyapunov?"),
        ({"basins": {}}, "products.basins: is made of a finished run; drop it here, and use magpend analyse basins."),
        ({"section": {}}, "products.section: is made of a finished run; drop it here, and use magpend plot section."),
        (
            {"rotation": True},
            "products.rotation = True: must be a table of of, center, section, n_periods; {} takes the defaults.",
        ),
        ({"extremes": ["x"]}, "products.extremes = ['x']: must be a table with the key quantities."),
    ],
)
def test_products__that_are_wrong(products, message):
    for spec in (built().with_products(**products), magpend.Spec(**{**built().tables, "products": products})):
        with pytest.raises(SpecError) as caught:
            spec.check()
        assert caught.value.problems == [message]


def test_spec__reports_all_problems_at_once():
    wrong = built().with_integration(n_keep=0).with_axis("B", 1, 2, 3).with_start_grid(y=3)
    with pytest.raises(SpecError) as caught:
        wrong.check()
    assert len(caught.value.problems) == 3
    for key in ("integration.n_keep = 0", "axes.B", "initial_conditions.y"):
        assert key in str(caught.value)
    with pytest.raises(SpecError, match=r"axes = 3: must be a table"):
        magpend.Spec("sweep", axes=3, initial_conditions={"kind": "list", "points": [[0, 0, 0, 0]]}).check()


def test_spec__has_a_method_for_every_table_and_its_keys():
    """Signatures are explicit, and complete."""
    named = {"axes": "axis", "initial_conditions": "start_grid"}
    for key in (*KEYS, *CELL_PRODUCTS):
        if key not in ("kind", "title", "model", "products", "measured"):
            assert callable(getattr(magpend.Spec, f"with_{named.get(key, key)}")), key
    assert "stop_when_closed" in inspect.signature(magpend.Spec.with_integration).parameters
    assert "from_" in inspect.signature(magpend.Spec.with_drift).parameters
    assert magpend.Spec("sweep").with_drift("A", from_=0.0, to=1.0).tables["drift"] == {"A": {"from": 0.0, "to": 1.0}}
    assert "Relative tolerance of a step" in magpend.Spec.with_integration.__doc__


@pytest.mark.slow
def test_spec__reads_and_writes_what_ships():
    for name, path in shipped_workflows().items():
        spec, shipped = magpend.Spec.read(name), Spec.read(path)
        for tables in (spec.tables, tomllib.loads(spec.toml())):
            again = Spec.parse({key: value for key, value in tables.items() if key != "smoke"})
            assert again.as_dict() == shipped.as_dict(), name
            assert again.model.reference == shipped.model.reference, name


def test_spec__names_files_from_where_it_is(tmp_path, monkeypatch):
    folder, other = tmp_path / "specs", tmp_path / "other"
    folder.mkdir(), other.mkdir()
    (folder / "model.toml").write_text(TEXT.partition("[model]")[2], "utf-8")
    text = TEXT.partition("[model]")[0].replace('title = "forces"', 'title = "forces"\nmodel = "model.toml"')
    (folder / "spec.toml").write_text(text, "utf-8")
    monkeypatch.chdir(tmp_path)
    spec = magpend.Spec.read(Path("specs") / "spec.toml")
    assert same_run(spec, TEXT)
    saved = spec.save(other / "spec.toml")
    assert 'model = "../specs/model.toml"' in saved.read_text("utf-8")
    assert Spec.read(saved).model is oscillator()
    assert spec.save(saved) == saved
    with pytest.raises(SpecError, match="exists already and is not overwritten"):
        spec.with_parameters(frequency_hz=0.3).save(saved)


@pytest.mark.slow
def test_preview__is_the_dry_run(tmp_path):
    found = magpend.preview(built(), tmp_path / "run", workers=2)
    assert (found.n_cells, found.dims) == (24, {"A": 3, "k": 2, "x_0": 4})
    assert found.n_bytes == make_plan(Spec.read(TEXT)).n_bytes
    assert found.times.core_seconds > 0
    assert not (tmp_path / "run").exists()


def test_run__of_a_text_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    first = magpend.run(TEXT, workers=0, echo=silent)
    again = magpend.run(TEXT, workers=0, echo=said.append)
    assert again.directory == first.directory
    assert first.directory.name.startswith("oscillator-")
    assert any("nothing to do" in line for line in said)


@pytest.mark.slow
def test_table__has_a_row_per_attractor_and_parameter_point(tmp_path):
    """Of a run of a table with numpy's arrays and a model as a table."""
    table = {
        "kind": "sweep",
        "model": tomllib.loads(TEXT)["model"],
        "axes": {"A": {"values": np.array([0.1, 0.2, 0.3])}},
        "parameters": {"frequency_hz": 0.2},
        "initial_conditions": {"kind": "list", "points": [[0.0, 0.0], (0.5, np.float64(0.1))]},
        "integration": {"n_transient": 200, "n_keep": 4},
    }
    run = magpend.run(table, tmp_path / "run", workers=0, echo=silent)
    found = magpend.table(magpend.attractors(run))
    assert found["A"].tolist() == [0.1, 0.2, 0.3]
    assert set(found["kind"]) == {"periodic_orbit"}
    with pytest.raises(ValueError, match="not the result of an analysis"):
        magpend.table(run.cube())


def test_sections__of_one_set_or_of_many():
    model = oscillator()
    sets = [model.load(A=a) for a in (0.1, 0.3)]
    starts = [[0.0, 0.0], [0.0, 0.0]]
    both = magpend.sections(sets, 0.2, starts, n_transient=5, n_keep=2)
    for i, one in enumerate(sets):
        alone = magpend.sections(one, 0.2, starts[:1], n_transient=5, n_keep=2)
        assert np.array_equal(both.section[i], alone.section[0])
    with pytest.raises(ValueError, match="of one model"):
        magpend.sections([sets[0], magpend.load_model("duffing").load()], 0.2, starts, n_transient=0, n_keep=1)
    with pytest.raises(ValueError, match="3 sets for 2 cells"):
        magpend.sections([*sets, sets[0]], 0.2, starts, n_transient=0, n_keep=1)
