"""A specification whose preset is a file: read once, from where the specification is, and kept whole."""

from __future__ import annotations

import pytest

from magpend_core import load_model
from magpend_core.models.preset_writing import write_preset
from pipeline.layout.identity import digest_of
from pipeline.layout.plan import make_plan
from pipeline.runs.run import identity_here
from pipeline.runs.zoom import Changes, to_toml, zoom
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec

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
    return digest_of(identity_here(spec, make_plan(spec)))


def test_load_spec__reads_the_preset_beside_it_and_keeps_it_whole(tmp_path):
    path = write(tmp_path)
    spec = Spec.read(path)
    (tmp_path / "rig.toml").unlink()
    assert spec.values == load_model("pendulum").load("wojna2018", **FIT, q=1.5)
    again = Spec.parse(spec.as_dict())
    assert again == spec
    assert again.parameters.chosen.provenance["c1"] == "fit of curve 3"
    assert identity_here(spec, make_plan(spec))["spec"]["parameters"]["preset"]["title"] == "test rig"


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
