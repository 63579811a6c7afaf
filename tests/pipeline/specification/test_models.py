"""Models in specifications: text, files, Python objects, and what a run keeps of them."""

from __future__ import annotations

import json
import sys
import tomllib

import pytest

from magpend_core.models import import_object, imported, load_model
from magpend_core.models.imported import DescribedModel, origin
from magpend_core.models.parameters import ParameterError
from magpend_core.models.preset_writing import write_preset
from pipeline.layout.identity import digest_of
from pipeline.layout.plan import make_plan
from pipeline.runs.zoom import Changes, Source, to_toml, write_zoom, zoom
from pipeline.specification.files import model_toml
from pipeline.specification.models import KEPT, find_model, read_model_file
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec


def problems_of(call, *arguments):
    with pytest.raises(SpecError) as caught:
        call(*arguments)
    return caught.value.problems


def object_spec(own, module, folder):
    """A specification whose model is an object of a module beside it, and its plain data as a run keeps them."""
    spec = Spec.parse(tomllib.loads(own.spec(f'model = "{module[0]}:MINE"')), folder)
    return spec, json.loads(json.dumps(spec.as_dict()))


@pytest.fixture
def module(own, tmp_path, request):
    """A module beside the specification, under a name that no other test has imported."""
    name = f"own_{abs(hash(request.node.nodeid)) % 10**8}"
    trace = own.write_module(tmp_path, name)
    yield name, trace
    sys.modules.pop(name, None)
    sys.path[:] = [p for p in sys.path if p != str(tmp_path)]


def test_parse_spec__keeps_the_text_and_reads_it_back(own):
    spec = Spec.parse(tomllib.loads(own.spec(own.text)))
    assert spec.model.name == "duffing5"
    assert spec.as_dict()["model"]["equations"] == {"x": "v", "v": "drive - d*v - x**3"}
    kept = json.loads(json.dumps(spec.as_dict()))
    assert Spec.parse(kept, KEPT) == spec
    assert Spec.parse(kept, KEPT).model is spec.model  # parameters compare their models by identity


def test_load_spec__file_of_a_model_takes_the_place_of_its_name(own, tmp_path, write_spec):
    (tmp_path / "shared.toml").write_text(own.text.replace("[model]", "").replace('name = "duffing5"', ""))
    path = write_spec(own.spec('model = "shared.toml"'))
    spec = Spec.read(path)
    assert spec.model.name == "shared"
    (tmp_path / "shared.toml").unlink()
    assert Spec.parse(spec.as_dict(), KEPT) == spec


def test_read_model_file__below_its_head_at_the_top_or_in_a_specification(own, tmp_path):
    texts = {"a": own.text, "b": own.text.replace("[model]", ""), "c": own.spec(own.text)}
    for name, text in texts.items():
        (tmp_path / f"{name}.toml").write_text(text)
    assert len({str(read_model_file(tmp_path / f"{name}.toml")) for name in texts}) == 1
    (found,) = problems_of(Spec.read, tmp_path / "b.toml")  # a model is no specification
    assert "magpend model show" in found


def test_parse_spec__errors_of_the_text_come_with_the_others(own):
    text = own.spec(own.text).replace("- d*v", "- dd*v").replace("rtol = 1e-7", "rtol = -1.0")
    found = problems_of(Spec.parse, tomllib.loads(text))
    assert any(p.startswith("model.equations.v: ") and "did you mean d" in p for p in found)
    assert any(p.startswith("integration.rtol = -1.0") for p in found)


def test_load_spec__errors_of_a_file_name_it(own, tmp_path, write_spec):
    (tmp_path / "shared.toml").write_text(own.text.replace("- d*v", "- dd*v"))
    found = problems_of(Spec.read, write_spec(own.spec('model = "shared.toml"', "[execute]")))
    assert any(p.startswith("shared.toml: equations.v: ") for p in found)
    assert any(p.startswith("execute: unknown key") for p in found)
    found = problems_of(Spec.read, write_spec(own.spec('model = "absent.toml"')))
    assert [p for p in found if p.startswith("model: ") and "absent.toml: cannot be read" in p]


def test_load_spec__smoke_replaces_keys_of_a_text_and_of_a_file(own, tmp_path, write_spec):
    smoke = '[smoke]\n"model.parameters.d" = 0.5\n'
    assert Spec.read(write_spec(own.spec(own.text, smoke)), smoke=True).values["d"] == 0.5
    (tmp_path / "shared.toml").write_text(own.text)
    path = write_spec(own.spec('model = "shared.toml"', smoke))
    assert Spec.read(path, smoke=True).values["d"] == 0.5
    assert Spec.read(path).values["d"] == 0.08


def test_find_model__says_what_a_model_can_be():
    for model in (3, ["duffing"], True):
        (found,) = problems_of(find_model, model)
        assert all(word in found for word in (f"model = {model!r}", "FILE.toml", "package.module:NAME", "table"))
    (found,) = problems_of(find_model, "dufing")
    assert found.startswith("model: ")
    assert "did you mean duffing" in found


@pytest.mark.parametrize("reference", ["belt.toml", "os:system", {"python": "os:system"}, "no-such-model"])
def test_kept_spec__reads_no_file_and_imports_nothing(own, tmp_path, monkeypatch, reference):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "belt.toml").write_text(own.text)
    data = {**tomllib.loads(own.spec("")), "model": reference}
    assert problems_of(Spec.parse, data, KEPT)


def test_kept_spec__reads_no_file_of_a_preset(own, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.toml").write_text(
        'model = "duffing5"\nbase = "default"\n[values]\nd = 0.3\n[provenance]\nd = "mine"\n'
    )
    text = own.spec(own.text).replace("[parameters]\n", '[parameters]\npreset = "p.toml"\n', 1)
    spec = Spec.parse(tomllib.loads(text), tmp_path)
    assert spec.values["d"] == 0.3
    assert Spec.parse(spec.as_dict(), KEPT) == spec
    (found,) = problems_of(Spec.parse, tomllib.loads(text), KEPT)
    assert found.startswith("parameters.preset = 'p.toml'")


def test_parse_spec__imports_the_object_that_a_person_names(own, tmp_path, module):
    (name, trace), (spec, plain) = module, object_spec(own, module, tmp_path)
    assert trace.read_text() == "x"
    assert spec.model.system.name == "mine"
    assert origin(spec.model) == (f"{name}:MINE", str(tmp_path))
    assert plain["model"]["python"] == f"{name}:MINE"
    assert Spec.parse(plain, KEPT) == spec
    assert Spec.parse(plain, KEPT).model is spec.model


def test_kept_spec__describes_an_object_without_importing_it(own, tmp_path, module, monkeypatch):
    (name, trace), (spec, plain) = module, object_spec(own, module, tmp_path)
    trace.unlink()
    sys.modules.pop(name)
    monkeypatch.setattr(imported, "_imported", {})
    model = Spec.parse(plain, KEPT).model
    assert isinstance(model, DescribedModel)
    assert not trace.exists()
    assert name not in sys.modules
    for field in ("name", "title", "states", "parameters", "presets", "section", "mirror", "digest"):
        assert getattr(model, field) == getattr(spec.model, field)
    with pytest.raises(ParameterError, match=f"--import-object {name}:MINE"):
        _ = model.system
    assert load_model(model.reference) is model  # so that parameters compare


def test_import_object__digest_is_that_of_the_module(own, tmp_path, module, monkeypatch):
    """What is commented does not count, what is computed does."""
    name, _ = module
    digests, path_before = [], [*sys.path]
    for i, change in enumerate([("", ""), ("def rhs", "# a remark\ndef rhs"), ("- y[0]", "- 2.0 * y[0]")]):
        own.write_module(tmp_path / str(i), name)
        path = tmp_path / str(i) / f"{name}.py"
        path.write_text(path.read_text().replace(*change) if change[0] else path.read_text())
        monkeypatch.setattr(imported, "_imported", {})
        monkeypatch.setattr(sys, "path", [*path_before])
        sys.modules.pop(name, None)
        digests.append(import_object(f"{name}:MINE", path.parent).digest)
        assert sys.modules[name].__file__ == str(path)
    assert digests[0] == digests[1] != digests[2]


def test_described_model__object_that_was_changed_is_not_the_run_s(own, tmp_path, module):
    _, plain = object_spec(own, module, tmp_path)
    plain["model"]["digest"] = "0123456789abcdef"
    with pytest.raises(ParameterError, match="restore the code"):
        _ = Spec.parse(plain, KEPT).model.system


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("no_such_module_here:NAME", "cannot be imported"),
        ("magpend_core.models:load_model", "must be a Model"),
        ("magpend_core.models:NO_SUCH", "cannot be imported"),
    ],
)
def test_import_object__says_why(path, words):
    with pytest.raises(ParameterError, match=words):
        import_object(path)
    assert problems_of(find_model, path)[0].startswith("model: ")


CHANGED = [
    ({"python": "a b"}, "python"),
    ({"states": {"x; import os": {"unit": "m", "meaning": "place"}}}, "states"),
    ({"states": {"x": {"unit": "m", "meaning": "place", "scale": "1"}}}, "states.x.scale"),
    ({"parameters": {"d": {"unit": "m", "meaning": "place", "bound": "any"}}}, "parameters.d.bound"),
    ({"parameters": {"d": "m"}}, "parameters.d"),
    ({"presets": {"p": {"values": {"d": "1"}}}}, "presets.p.values"),
    ({"mirror": {"signs": [1], "half_period": True}}, "mirror"),
    ({"sources": ["/etc/passwd"]}, "sources"),
]


def test_described_model__checks_what_a_stranger_wrote(own, tmp_path, module):
    _, plain = object_spec(own, module, tmp_path)
    for change, place in CHANGED:
        found = problems_of(find_model, {**plain["model"], **change})
        assert any(place in p for p in found), change


def test_model_toml__reads_back(own):
    table = tomllib.loads(own.text)["model"]
    reference = load_model(table).reference
    assert tomllib.loads(model_toml(reference))["model"] == reference
    assert tomllib.loads(model_toml("duffing"))["model"] == "duffing"
    assert tomllib.loads(model_toml({"python": "a.b:C", "name": "x"}))["model"] == "a.b:C"


def test_find_model__specification_that_names_its_model(own, tmp_path):
    (tmp_path / "shared.toml").write_text(own.text)
    (tmp_path / "spec.toml").write_text(own.spec('model = "shared.toml"'))
    (tmp_path / "named.toml").write_text(own.spec('model = "duffing"'))
    assert find_model("spec.toml", tmp_path).name == "duffing5"
    assert find_model("named.toml", tmp_path) is load_model("duffing")
    (tmp_path / "circle.toml").write_text('model = "circle.toml"')
    assert problems_of(find_model, "circle.toml", tmp_path)


def test_write_zoom__text_goes_with_it_and_an_object_is_named(own, tmp_path, module):
    (name, _), (spec, _) = module, object_spec(own, module, tmp_path)
    notes = write_zoom(Source(spec, "a run"), Changes(ranges={"x": (0.0, 0.5)}), tmp_path / "z.toml")
    assert any(f"imports the Python object {name}:MINE" in note for note in notes)
    assert Spec.read(tmp_path / "z.toml").model is spec.model
    spec = Spec.parse(tomllib.loads(own.spec(own.text)), tmp_path)
    assert write_zoom(Source(spec, "a run"), Changes(pins={"A": 0.3}), tmp_path / "y.toml") == []
    again = Spec.read(tmp_path / "y.toml")
    assert again.model is spec.model
    assert again.values["A"] == 0.3


# ---- presets in files ------------------------------------------------------------------------------------

FIT, SOURCES = {"c1": 0.068, "alpha1": 1.75}, {"c1": "fit of curve 3", "alpha1": "fit"}
HEAD = "model = 'pendulum'\nbase = 'wojna2018'"


def write(folder, preset="rig.toml", **fit):
    write_preset(folder / "rig.toml", "pendulum", FIT | fit, SOURCES, "test rig", base="wojna2018")
    text = f"""
    kind = "sweep"
    [parameters]
    preset = "{preset}"
    frequency_hz = 2.2
    overrides = {{ q = 1.5 }}
    [initial_conditions]
    kind = "list"
    points = [[0.1, 0.2, 0.0, 0.0]]
    [integration]
    n_transient = 1
    n_keep = 2
    """
    path = folder / "spec.toml"
    path.write_text(text)
    return path


def digest(spec):
    return digest_of(make_plan(spec).identity)


def test_load_spec__reads_the_preset_beside_it_and_keeps_it_whole(tmp_path):
    path = write(tmp_path)
    spec = Spec.read(path)
    (tmp_path / "rig.toml").unlink()
    assert spec.values == load_model("pendulum").load("wojna2018", **FIT, q=1.5)
    again = Spec.parse(spec.as_dict())
    assert again == spec
    assert again.parameters.chosen.provenance["c1"] == "fit of curve 3"
    assert make_plan(spec).identity["spec"]["parameters"]["preset"]["title"] == "test rig"


def test_load_spec__smoke_may_choose_another_preset(tmp_path):
    path = write(tmp_path, preset="wojna2018")
    path.write_text(path.read_text() + '\n[smoke]\n"parameters.preset" = "rig.toml"')
    assert Spec.read(path).values["c1"] == 0.05338
    assert Spec.read(path, smoke=True).values["c1"] == FIT["c1"]


def test_identity__covers_values_and_provenance_of_the_file(tmp_path):
    first = digest(Spec.read(write(tmp_path)))
    assert digest(Spec.read(write(tmp_path))) == first
    assert digest(Spec.read(write(tmp_path, c1=0.069))) != first
    path = write(tmp_path)
    rig = tmp_path / "rig.toml"
    rig.write_text(rig.read_text().replace("fit of curve 3", "fit of curve 4"))
    assert digest(Spec.read(path)) != first


def test_zoom__carries_the_preset_along(tmp_path):
    spec = Spec.read(write(tmp_path))
    (tmp_path / "rig.toml").unlink()
    narrower, _ = zoom(spec, Changes(ranges={"q": (1.5, 1.6)}, num=3))
    assert narrower.values["c1"] == FIT["c1"]
    assert "fit of curve 3" in to_toml(narrower)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        (3, "must be a text in quotes"),
        ("model = 'duffing'", "is of model 'duffing'"),
        ("model = 'pendulum'\nbase = 'wojna2018'\n[values]\nc1 = 'x'\n[provenance]\nc1 = 'y'", "must be a number"),
        ("model = 'pendulum'\nbase = 'wojna2018'\n[values]\nc1 = -1\n[provenance]\nc1 = 'y'", "greater than 0"),
    ],
)
def test_load_spec__says_what_is_wrong_with_the_file_beside_all_else(tmp_path, content, words):
    path = write(tmp_path)
    path.write_text(path.read_text().replace("n_keep = 2", "n_keep = 0"))
    rig = tmp_path / "rig.toml"
    if content == 3:
        path.write_text(path.read_text().replace('preset = "rig.toml"', "preset = 3"))
    elif content is None:
        rig.unlink()
    else:
        rig.write_text(content)
    with pytest.raises(SpecError) as caught:
        Spec.read(path)
    own = [p for p in caught.value.problems if p.startswith("parameters.preset")]
    assert len(own) == 1
    assert words in own[0]
    assert any(p.startswith("integration.n_keep") for p in caught.value.problems)
