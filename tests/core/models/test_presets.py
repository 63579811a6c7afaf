"""Presets in files: what is written reads back, and what is wrong is said."""

import tomllib

import pytest

from magpend_core import ParameterError, load_model
from magpend_core.models.preset_writing import write_preset
from magpend_core.models.presets import Preset, find_preset

FIT = {"alpha1": 1.7512345678901234, "alpha2": -1.7, "c1": 0.068}
SOURCES = {
    "alpha1": 'fit of "six" curves,\n+- 0.003 N m',
    "alpha2": "fit of six curves \u2212 synthetic\x7f",
    "c1": "fit",
}


@pytest.fixture
def written(tmp_path):
    return write_preset(tmp_path / "rig.toml", "pendulum", FIT, SOURCES, "discs of the rig", base="wojna2018")


def problems_of(path, model="pendulum"):
    with pytest.raises(ParameterError) as caught:
        load_model(model).load(path)
    return caught.value.problems


def test_write_preset__reads_back_to_the_same_numbers_and_phrases(written):
    model = load_model("pendulum")
    found = model.preset(written)
    assert model.load(written) == model.load("wojna2018", **FIT)
    assert {n: found.provenance[n] for n in FIT} == SOURCES
    assert found.provenance["l1"] == "paper, Table 1"
    assert (found.name, found.title, found.base) == ("rig", "discs of the rig", "wojna2018")
    for name in ("pendulum", "pendulum-dipole"):
        model = load_model(name)
        assert model.load(model.preset(written)) == model.load(written)
    found = find_preset("rig.toml", written.parent)
    assert isinstance(found, Preset)
    assert dict(found.values) == FIT
    assert find_preset("wojna2018", written.parent) == "wojna2018"


@pytest.mark.parametrize("kind", [str, lambda path: path, Preset.read])
def test_load__takes_a_file_by_its_name_its_path_or_as_read(written, kind):
    model = load_model("pendulum")
    assert model.load(kind(written), q=1.6) == model.load("wojna2018", **FIT, q=1.6)


def test_load__a_file_serves_all_models_that_share_its_presets(written, tmp_path):
    assert load_model("pendulum-sine").load(written)["alpha1"] == FIT["alpha1"]
    assert load_model("pendulum-free").load(written) == load_model("pendulum-free").load()
    (problem,) = problems_of(written, "duffing")
    assert "rig.toml: is of model 'pendulum'" in problem
    model = load_model("duffing")
    values = model.load().as_dict()
    path = write_preset(tmp_path / "d.toml", "duffing", values, dict.fromkeys(values, "fit"))
    assert model.load(path) == model.load()
    assert "base" not in tomllib.loads(path.read_text())


def test_write_preset__takes_over_the_values_and_sources_of_a_base_from_a_file(written, tmp_path):
    second = write_preset(
        tmp_path / "second.toml",
        "pendulum",
        {"q": 1.5, "c1": 0.07},
        {"q": "scale", "c1": "ruler"},
        base=Preset.read(written),
    )
    written.unlink()
    model = load_model("pendulum")
    assert model.load(second) == model.load("wojna2018", **FIT | {"q": 1.5, "c1": 0.07})
    found = model.preset(second)
    assert (found.provenance["c1"], found.provenance["alpha1"]) == ("ruler", SOURCES["alpha1"])
    assert found.base == "wojna2018"


@pytest.mark.parametrize(
    ("values", "sources", "words"),
    [
        ({"alpha9": 1.0}, {"alpha9": "fit"}, "'alpha9' is not a parameter"),
        ({"c1": -1.0}, {"c1": "fit"}, "c1 = -1.0 is out of bounds"),
        ({"c1": float("nan")}, {"c1": "fit"}, "c1 = nan is not finite"),
        ({"c1": 1.0}, {}, "c1: has no provenance"),
    ],
)
def test_write_preset__writes_nothing_that_would_not_load(tmp_path, values, sources, words):
    with pytest.raises(ParameterError, match=words):
        write_preset(tmp_path / "x.toml", "pendulum", values, sources, base="wojna2018")
    with pytest.raises(ParameterError, match="suffix"):
        write_preset(tmp_path / "x.txt", "pendulum", FIT, SOURCES, base="wojna2018")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("values = 1", ["values: is no table of values"]),
        ("model = 3", ["model = 3: must be a text"]),
        ("bse = 'x'", ["bse: is no table of values", "did you mean base"]),
        ("[values]\nc1 = 1.0", ["model: missing"]),
        ("model = 'pendulun'", ["did you mean pendulum"]),
        ("model = 'pendulum'\nbase = 'wojna2019'", ["base: preset 'wojna2019'", "did you mean wojna2018"]),
        ("model = 'pendulum'\n[values]\nc1 = 1\n[provenance]\nc1 = 'x'", ["q", "set base", "'wojna2018'"]),
        ("model = 'pendulum'\n[a]\nc1 = 1\n[b]\nc1 = 2", ["c1: has two values"]),
        ("[values]\nc1 = 1\n[provenance]\nc1 = 3", ["provenance.c1 = 3: must be a text"]),
        ("[values]\nc1 = 1\n[provenance]\nc2 = 'x'", ["provenance.c2: nothing of this name"]),
        ("[values", ["is not valid TOML"]),
    ],
)
def test_load__says_what_is_wrong_with_a_file(tmp_path, text, words):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    (problem,) = problems_of(path)
    assert "bad.toml: " in problem
    for word in words:
        assert word in problem


def test_load__says_all_that_is_wrong_with_a_file_at_once(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("model = 'pendulum'\nbase = 'zzz'\n[values]\nalpa1 = 1\nc1 = -1\n[provenance]\nvalues = 'fit'")
    problems = problems_of(path)
    assert [("zzz" in p, "alpa1" in p, "c1 = -1" in p) for p in problems] == [
        (True, False, False),
        (False, True, False),
        (False, False, True),
    ]
    (problem,) = problems_of(tmp_path / "absent.toml")
    assert "cannot be read" in problem
